"""Stiffness, rigid modes and stresses, compared with exact linear elasticity."""

import numpy as np
import pytest
from scipy.sparse import csc_array
from scipy.sparse.linalg import spsolve
from skfem import Basis, ElementQuad1, ElementVector, MeshQuad
from skfem.models.elasticity import lame_parameters, linear_elasticity

from mortarbench.problems.fem.elasticity import (
    Material,
    cell_dofs,
    elasticity_matrix,
    rigid_modes,
    shape_gradients,
    stiffness,
    strain_matrix,
)
from mortarbench.problems.fem.elements import QUAD
from mortarbench.problems.fem.mesh import (
    as_vectors,
    boundary_facets,
    box,
    dofs_of,
    half_disc,
    half_ring,
    nodal_lengths,
    rectangle,
)
from mortarbench.problems.fem.stress import (
    centre_stress,
    gauss_stress,
    recover,
)
from tests.support.hexahedra import WEDGES, bent, divided

STEEL = Material(E=200e9, nu=0.3)


def distorted(n, amplitude=0.15):
    """Return the unit square of n × n quadrilaterals, smoothly distorted."""
    mesh = rectangle((0, 0), (1, 1), (n, n))
    x, y = mesh.points.T
    bump = amplitude * np.sin(np.pi * x) * np.sin(np.pi * y)
    mesh.points[:, 0] += bump
    mesh.points[:, 1] += 0.7 * bump
    return mesh


@pytest.mark.parametrize(
    "mesh",
    [
        distorted(5),
        rectangle((0, 0.5), (2, 0.25), (80, 10)),
        half_ring((1, 0), (0.3, 0.49), (24, 4)),
    ],
    ids=["distorted", "beam", "ring"],
)
def test_plane_strain_stiffness_equals_an_independent_code(mesh):
    reference = Basis(
        MeshQuad(mesh.points.T.copy(), mesh.cells.T.copy()),
        ElementVector(ElementQuad1()),
        intorder=2,  # 2×2 Gauss
    )
    expected = linear_elasticity(*lame_parameters(STEEL.E, STEEL.nu)).assemble(
        reference
    )

    K = stiffness(mesh, elasticity_matrix(STEEL, "strain"))

    assert abs(K - expected).max() <= 1e-13 * abs(expected).max()


@pytest.mark.parametrize(
    ("points", "modes"),
    [
        (bent(box((0, 0, 0), (1, 1, 1), (2, 2, 2))).points, 6),
        (distorted(3).points, 3),
        (np.linspace(0, 1, 5)[:, None], 1),
    ],
    ids=["space", "plane", "line"],
)
def test_rigid_modes_of_any_dimension_are_orthonormal_rigid_motions(points, modes):
    R = rigid_modes(points)
    N, dim = points.shape

    assert R.shape == (N * dim, modes)
    np.testing.assert_allclose(R.T @ R, np.eye(modes), atol=1e-14)
    apart = points[:, None] - points  # distances are unchanged to first order
    for mode in R.T:
        v = as_vectors(mode, dim)
        change = np.einsum("abx,abx->ab", apart, v[:, None] - v)
        assert abs(change).max() <= 1e-14


@pytest.mark.parametrize("plane", ["strain", "stress"])
def test_a_linear_displacement_has_its_exact_stress_and_no_inner_force(plane):
    """In this patch test, ε = (1, −2, 3)·10⁻³ on distorted cells."""
    mesh = distorted(5)
    x, y = mesh.points.T
    u = np.column_stack([1e-3 * x + 1e-3 * y, 2e-3 * x - 2e-3 * y]).ravel()
    E, nu = STEEL.E, STEEL.nu
    shear = E / (2 * (1 + nu)) * 3e-3
    if plane == "stress":
        sx = E / (1 - nu**2) * (1e-3 - 2e-3 * nu)
        sy = E / (1 - nu**2) * (nu * 1e-3 - 2e-3)
    else:
        lam, mu = E * nu / ((1 + nu) * (1 - 2 * nu)), E / (2 * (1 + nu))
        sx, sy = lam * -1e-3 + 2 * mu * 1e-3, lam * -1e-3 - 2 * mu * 2e-3
    D = elasticity_matrix(STEEL, plane)
    inner = np.ones(len(mesh.points), dtype=bool)
    for nodes in mesh.boundaries.values():
        inner[nodes] = False

    stress = recover(mesh, centre_stress(mesh, D, u))
    force = as_vectors(stiffness(mesh, D) @ u, 2)

    assert stress == pytest.approx(np.tile([sx, sy, shear], (len(mesh.points), 1)))
    assert abs(force[inner]).max() <= 1e-10 * abs(force).max()


def test_recovered_stress_of_a_finite_element_solution_has_rate_two():
    """The manufactured solution is u = (sin 2x cos y, x² y).

    Its values are prescribed on the boundary, and the body force f follows from
    ∫f·v = ∫σ:ε(v). The rate is measured at inner nodes and at boundary nodes.
    """
    D = elasticity_matrix(Material(E=1.0, nu=0.3), "strain")

    def exact_stress(x, y):
        shear = -np.sin(2 * x) * np.sin(y) + 2 * x * y
        strain = np.stack([2 * np.cos(2 * x) * np.cos(y), x**2, shear], axis=-1)
        return strain @ D

    errors = []
    for n in (8, 16, 32):
        mesh = distorted(n)
        x, y = mesh.points.T
        u = np.column_stack([np.sin(2 * x) * np.cos(y), x**2 * y]).ravel()
        load, corners = np.zeros(mesh.dofs), mesh.points[mesh.cells]
        for xi, eta in QUAD.points:
            N = (1 + QUAD.corners[:, 0] * xi) * (1 + QUAD.corners[:, 1] * eta) / 4
            gradients, det = shape_gradients(corners, np.array([xi, eta]))
            sigma = exact_stress(*np.moveaxis(N @ corners, -1, 0))
            force = np.einsum("esd,es,e->ed", strain_matrix(gradients), sigma, det)
            np.add.at(load, cell_dofs(mesh), force)
        edge = np.unique(np.concatenate(list(mesh.boundaries.values())))
        inner = np.setdiff1d(np.arange(mesh.dofs), dofs_of(edge, 2))
        K = stiffness(mesh, D)
        lift = u.copy()
        lift[inner] = 0
        u[inner] = spsolve(K[inner][:, inner], (load - K @ lift)[inner])
        error = abs(recover(mesh, centre_stress(mesh, D, u)) - exact_stress(x, y))
        mask = np.isin(np.arange(len(x)), edge)
        errors.append([error[~mask].max(), error[mask].max()])

    rates = np.log2(np.divide(errors[:-1], errors[1:]))
    assert rates == pytest.approx(np.full((2, 2), 2.0), abs=0.35)


def test_one_layer_of_cells_gets_cell_means():
    mesh = rectangle((0, 0), (2, 1), (2, 1))

    nodal = recover(mesh, np.array([[1.0], [3.0]]))

    assert nodal.ravel() == pytest.approx([1, 2, 3, 1, 2, 3])


def test_stress_at_the_gauss_points_of_a_bilinear_field():
    """For u = (xy, 0) on the unit square, ε = (y, 0, x); Gauss points are in the order
    of the corners."""
    mesh = rectangle((0, 0), (1, 1), (1, 1))
    u = np.zeros(8)
    u[0::2] = mesh.points.prod(axis=1)
    D = elasticity_matrix(STEEL, "strain")
    a, b = (1 - 1 / np.sqrt(3)) / 2, (1 + 1 / np.sqrt(3)) / 2
    strain = np.array([[a, 0, a], [a, 0, b], [b, 0, b], [b, 0, a]])

    assert gauss_stress(mesh, D, u) == pytest.approx((strain @ D)[None], rel=1e-12)


def test_a_half_disc_with_triangles_at_its_centre_stretches_exactly():
    """For a constant strain ε, uᵀKu is ε·Dε times the area; K has three rigid modes."""
    mesh = half_disc((0, 1), np.linspace(-np.pi, 0, 9), np.array([1, 0.8, 0.3]))
    D = elasticity_matrix(STEEL, "strain")
    K = stiffness(mesh, D)
    strain = np.array([1e-3, -4e-4, 6e-4])
    x, y = mesh.points.T
    u = np.column_stack([strain[0] * x + strain[2] * y, strain[1] * y]).ravel()
    area = 8 * np.sin(np.pi / 8) / 2
    forces = as_vectors(K @ u, 2)
    inside = np.setdiff1d(
        np.arange(len(x)), np.concatenate(list(mesh.boundaries.values()))
    )

    assert u @ K @ u == pytest.approx(strain @ D @ strain * area)
    assert forces[inside] == pytest.approx(0, abs=1e-12 * abs(forces).max())
    assert np.linalg.eigvalsh(K.toarray())[3] > 1e-8 * abs(K).max()


def strained(points):
    """Return a displacement with uniform strain, including a change of volume."""
    gradient = np.array([[1.0, 0.3, -0.2], [0.1, -0.6, 0.4], [0.2, -0.1, 0.5]])
    dim = points.shape[1]
    return (points @ gradient[:dim, :dim].T).ravel()


CUBE = bent(box((0, 0, 0), (1, 1, 1), (2, 2, 2)))
SHAPES = {"quads": distorted(3), "hexahedra": CUBE, "wedges": divided(CUBE, WEDGES)}


@pytest.mark.parametrize("name", SHAPES)
@pytest.mark.parametrize("nu", [0.3, 0.4999])
def test_uniform_strain_has_uniform_stress_in_distorted_cells(name, nu):
    """Patch test: no forces at inner nodes, and the energy ½ εᵀDε V."""
    mesh = SHAPES[name]
    D = elasticity_matrix(Material(E=1.0, nu=nu), "strain" if mesh.dim == 2 else None)
    K, u = stiffness(mesh, D), strained(mesh.points)
    inner = np.setdiff1d(
        np.arange(len(mesh.points)), boundary_facets(mesh.cells, mesh.dim)
    )
    force = K @ u
    stress = centre_stress(mesh, D, u)

    assert inner.size
    assert np.abs(force[dofs_of(inner, mesh.dim)]).max() < 1e-11 * np.abs(force).max()
    np.testing.assert_allclose(
        stress, np.broadcast_to(stress[0], stress.shape), rtol=1e-9, atol=1e-9
    )
    np.testing.assert_allclose(K @ rigid_modes(mesh.points), 0, atol=1e-10 * K.max())


def test_a_nearly_incompressible_cell_has_one_mode_of_dilatation():
    """Fully integrated, a quadrilateral has three such modes and a hexahedron seven."""
    for mesh, plane in ((rectangle((0, 0), (1, 1), (1, 1)), "strain"),
                        (box((0, 0, 0), (1, 1, 1), (1, 1, 1)), None)):  # fmt: skip
        D = elasticity_matrix(Material(E=1.0, nu=0.4999999), plane)
        values = np.linalg.eigvalsh(stiffness(mesh, D).toarray())
        assert (values > 1e3).sum() == 1
        assert values[0] > -1e-8


@pytest.mark.parametrize("nu", [0.3, 0.499, 0.4999])
def test_a_nearly_incompressible_beam_bends_as_beam_theory_says(nu):
    """Deflection PL³/3EI + 6PL/5GA in plane strain, with square cells."""
    mesh = rectangle((0, 0), (10, 1), (80, 8))
    material = Material(E=1.0, nu=nu)
    K = stiffness(mesh, elasticity_matrix(material, "strain"))
    f, tip = np.zeros(mesh.dofs), mesh.boundaries["right"]
    f[2 * tip + 1] = nodal_lengths(mesh.points[tip])
    clamped = dofs_of(mesh.boundaries["left"], 2)
    free = np.setdiff1d(np.arange(mesh.dofs), clamped)
    u = np.zeros(mesh.dofs)
    u[free] = spsolve(csc_array(K[free][:, free]), f[free])
    bending = 12 * 1000 / 3 * (1 - nu**2)
    shear = 6 / 5 * 10 * 2 * (1 + nu)

    assert u[2 * tip + 1].mean() == pytest.approx(bending + shear, rel=0.015)
