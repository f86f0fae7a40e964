"""Linear triangles as degenerate quadrilaterals, compared with exact elasticity."""

import numpy as np
import pytest
from scipy.sparse.linalg import spsolve
from skfem import Basis, ElementTriP1, ElementVector, MeshTri
from skfem.models.elasticity import lame_parameters, linear_elasticity

from mortarbench.problems.contact.linearise import linearisation
from mortarbench.problems.duality.monolithic import primal_qp
from mortarbench.problems.families.patch import PRESSURE, ContactPatch, model
from mortarbench.problems.fem.elasticity import (
    Material,
    elasticity_matrix,
    rigid_modes,
    stiffness,
)
from mortarbench.problems.fem.mesh import (
    boundary_facets,
    dofs_of,
    half_ring,
    is_triangle,
    rectangle,
)
from mortarbench.problems.fem.stress import centre_stress, recover
from mortarbench.solvers.adapters.clarabel_ import Clarabel
from tests.support.triangles import halved, of_triangles

STEEL = Material(E=200e9, nu=0.3)
MESHES = [rectangle((0, 0), (2, 1), (6, 4)), half_ring((1, 0), (0.3, 0.5), (12, 3))]


@pytest.mark.parametrize("quads", MESHES, ids=["block", "ring"])
def test_the_stiffness_is_that_of_linear_triangles_of_another_code(quads):
    mesh = halved(quads)
    other = Basis(
        MeshTri(mesh.points.T.copy(), mesh.cells[:, :3].T.copy()),
        ElementVector(ElementTriP1()),
    )
    expected = linear_elasticity(*lame_parameters(STEEL.E, STEEL.nu)).assemble(other)
    K = stiffness(mesh, elasticity_matrix(STEEL, "strain"))

    assert is_triangle(mesh.cells).all()
    assert abs(K - expected).max() <= 1e-13 * abs(expected).max()
    assert abs(K @ rigid_modes(mesh.points)).max() <= 1e-12 * abs(K).max()


@pytest.mark.parametrize("quads", MESHES, ids=["block", "ring"])
def test_a_constant_strain_has_its_stress_at_centres_and_at_every_node(quads):
    mesh, D = halved(quads), elasticity_matrix(STEEL, "strain")
    x, y = mesh.points.T
    u = np.column_stack([1e-3 * x + 2e-3 * y, 1e-3 * x - 2e-3 * y]).ravel()
    expected = D @ [1e-3, -2e-3, 3e-3]
    stress = centre_stress(mesh, D, u)

    assert stress == pytest.approx(np.tile(expected, (len(mesh.cells), 1)))
    assert recover(mesh, stress) == pytest.approx(np.tile(expected, (len(x), 1)))


def test_a_linear_stress_is_recovered_from_the_centroids():
    """The centroid of a triangle is not the mean of its four stored corners."""
    mesh = halved(rectangle((0, 0), (1, 1), (5, 4)))
    centroid = mesh.points[mesh.cells[:, :3]].mean(axis=1)
    linear = np.array([[1.0, 2.0, 0.5], [-3.0, 1.0, 2.0]])

    assert recover(mesh, centroid @ linear) == pytest.approx(mesh.points @ linear)


def test_the_boundary_of_triangles_is_that_of_their_quadrilaterals():
    for quads in MESHES:
        one, two = (
            {tuple(edge) for edge in boundary_facets(m.cells, m.dim).tolist()}
            for m in (quads, halved(quads))
        )
        assert one == two


def bending(n):
    """Return energy and stress error of a bent plate of n × n halved squares.

    The exact solution in plane stress with E = 1 is u = (xy, −(x² + νy²)/2) with
    σ_x = y and no load; u is prescribed on the whole boundary.
    """
    mesh = halved(rectangle((0, -0.5), (1, 1), (n, n)))
    D = elasticity_matrix(Material(E=1.0, nu=0.3), "stress")
    K = stiffness(mesh, D)
    x, y = mesh.points.T
    u = np.column_stack([x * y, -(x**2 + 0.3 * y**2) / 2]).ravel()
    fixed = dofs_of(np.unique(boundary_facets(mesh.cells, mesh.dim)), 2)
    free = np.setdiff1d(np.arange(mesh.dofs), fixed)
    u[free] = spsolve(K[free][:, free], -K[free][:, fixed] @ u[fixed])
    exact = np.column_stack([y, 0 * y, 0 * y])
    stress = recover(mesh, centre_stress(mesh, D, u))
    return 0.5 * u @ K @ u, np.sqrt(np.mean((stress - exact) ** 2))


def test_energies_converge_with_the_square_of_the_size_and_stresses_with_the_size():
    """The exact energy is ½∫y² = 1/24; the strain of linear triangles has an error of
    first order."""
    (e1, s1), (e2, s2), (e4, s4) = (bending(n) for n in (8, 16, 32))
    excess = np.array([e1, e2, e4]) - 1 / 24

    assert (excess > 0).all()
    assert excess[:-1] / excess[1:] == pytest.approx([4, 4], rel=0.1)
    assert [s1 / s2, s2 / s4] == pytest.approx([2, 2], rel=0.1)


def pressed(which, **keys):
    """Solve the contact patch test with triangles in the bodies `which`."""
    patch = ContactPatch(lower=7, upper=5, **keys)
    bodies = of_triangles(model(patch), np.array(which))
    rows = linearisation(bodies, patch.contact, patch.basis)(np.zeros(bodies.mesh.dofs))
    primal = primal_qp(bodies, rows)
    s = Clarabel().prepare(primal, 1e-12)()
    stress = centre_stress(bodies.mesh, bodies.D, s.x * bodies.length)
    return bodies, primal, s, np.abs(stress - [0, -PRESSURE, 0]).max() / PRESSURE


@pytest.mark.parametrize("which", [(True, True), (True, False), (False, True)])
@pytest.mark.parametrize("slave", ["lower", "upper"])
@pytest.mark.parametrize("basis", ["dual", "standard"])
def test_mortar_passes_the_patch_test_on_triangles(which, slave, basis):
    assert pressed(which, slave=slave, basis=basis)[-1] <= 1e-8
