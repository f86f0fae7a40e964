"""Bodies of hexahedra in subdomains: matrices, gluing rows and rigid motions."""

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.sparse import csr_array

from mortarbench.harness import Status
from mortarbench.harness.names import parse
from mortarbench.problems import PROBLEMS
from mortarbench.problems.contact.bodies import Shape, UnassembledBodies
from mortarbench.problems.contact.stepping import load_steps
from mortarbench.problems.duality.decomposed import (
    decompose,
    subdivided,
)
from mortarbench.problems.fem.elasticity import Material, elasticity_matrix, stiffness
from mortarbench.problems.fem.mesh import Mesh, dofs_of
from mortarbench.problems.feti.subdomains import Contact, TornBodies
from mortarbench.solvers import SOLVERS
from mortarbench.solvers.reference.solve import reference_solution
from tests.support.decomposed_bodies import mechanics_of
from tests.support.hexahedra import bricks

STEEL = Material(E=2e11, nu=0.3)


def box() -> Mesh:
    """Return a mesh of 24 different cells, without principal axes along the
    coordinates."""
    mesh = bricks((4, 3, 2), (2.0, 1.0, 0.7))
    bump = 0.05 * np.sin(mesh.points @ [2.0, 3.0, 5.0])
    shear = np.array([[1, 0.3, 0.1], [0, 1, 0.4], [0, 0, 1]])
    return Mesh((mesh.points + bump[:, None]) @ shear, mesh.cells, {})


def torn(
    mesh: Mesh, fixed: np.ndarray, parts: int = 4, glue: str = "orthonormal"
) -> TornBodies:
    """Divide a body under gravity into subdomains by METIS."""
    down = dofs_of(np.arange(len(mesh.points)), 3, 2)
    f = np.zeros(mesh.dofs)
    f[down] = -1.0
    body = np.zeros(len(mesh.cells), dtype=np.int64)
    of = UnassembledBodies(
        shape=Shape(mesh, body), names=("box",), materials=(STEEL,),
        plane=None, length=1.0, force=STEEL.E, fixed=fixed, f=f, pairs=(),
    )  # fmt: skip
    (stage,) = load_steps(1, 1, f, fixed)
    none = Contact(csr_array((0, mesh.dofs)), np.zeros(0), np.zeros(0))
    layout = subdivided(of.shape, parts)
    return TornBodies(decompose(of, layout, glue, stage, none))


def stored(own: TornBodies) -> csr_array:
    """Return the matrix TᵀK_T T."""
    T, domains = own.spread, own.domains
    blocks = [domains.template(k).K @ T[a:b] for k, a, b in zip(
        domains.class_of, domains.start[:-1], domains.start[1:], strict=True
    )]  # fmt: skip
    ends = zip(domains.start[:-1], domains.start[1:], blocks, strict=True)
    return csr_array(sum(T[a:b].T @ block for a, b, block in ends))


def test_subdomains_have_the_stiffness_and_the_load_of_the_body():
    mesh = box()
    own = torn(mesh, dofs_of(np.flatnonzero(mesh.points[:, 2] == 0), 3))
    whole = stiffness(mesh, elasticity_matrix(STEEL, None) / STEEL.E)

    assert own.problem.layout.count == 4
    assert own.spread.shape[1] == mesh.dofs
    assert_allclose(stored(own).toarray(), whole.toarray(), atol=1e-13)
    assert_allclose(own.spread.T @ own.f, np.tile([0.0, 0.0, -1.0], len(mesh.points)))
    free = np.setdiff1d(np.arange(mesh.dofs), own.problem.fixed)
    jumps = own.rows.B @ own.spread[:, free]
    assert abs(jumps).max() <= 1e-15  # copies of a node are equal


def test_a_floating_body_has_six_orthonormal_motions_without_energy():
    own = torn(box(), np.zeros(0, dtype=np.int64))
    bodies = mechanics_of(own.problem)
    R = bodies.kernel.toarray()

    assert_allclose(R.T @ R, np.eye(6), atol=1e-14)
    assert abs(stored(own) @ R).max() <= 1e-13 * abs(stored(own)).max()
    assert (bodies.rigid.toarray() == R).all()
    assert bodies.names == ("box",)


@pytest.mark.parametrize("parts", [6, 12])
@pytest.mark.parametrize("glue", ["orthonormal", "redundant"])
def test_rows_glue_copies_at_faces_edges_and_corners_and_nothing_else(glue, parts):
    """With three or more copies of some nodes, B_E v = 0 exactly if v = T u with u = 0
    at the supports."""
    mesh = box()
    fixed = dofs_of(np.flatnonzero(mesh.points[:, 2] == 0), 3)
    own = torn(mesh, fixed, parts, glue)
    B, T = own.rows.B.toarray(), own.spread.toarray()
    free = np.setdiff1d(np.arange(mesh.dofs), fixed)
    sizes = np.linalg.svd(B, compute_uv=False)
    rank = int((sizes > 1e-10 * sizes[0]).sum())

    assert own.nodes.multiplicity.max() >= 3
    assert rank == B.shape[1] - free.size
    assert abs(B @ T[:, free]).max() <= 1e-14
    if glue == "orthonormal":
        assert_allclose(B @ B.T, np.eye(rank), atol=1e-14)
    assert (rank == len(B)) == (glue != "redundant")


#: number of rigid motions that remain if the face x = 0 is fixed along some axes
LEFT = {"x": 3, "y": 4, "z": 4, "xy": 1, "xz": 1, "yz": 3, "xyz": 0}


@pytest.mark.parametrize("axes", LEFT)
def test_a_face_fixed_along_some_axes_allows_the_other_motions(axes):
    mesh = bricks((4, 3, 2), (2.0, 1.0, 0.7))
    face = np.flatnonzero(mesh.points[:, 0] == 0)
    fixed = np.unique([dofs_of(face, 3, "xyz".index(axis)) for axis in axes])
    own = torn(mesh, fixed)
    bodies, left = mechanics_of(own.problem), LEFT[axes]

    assert bodies.names == (("box",) if left else ())
    assert bodies.kernel.shape[1] == left
    if left:
        R = bodies.kernel.toarray()
        assert_allclose(R.T @ R, np.eye(left), atol=1e-14)
        assert abs(R[fixed]).max() <= 1e-15
        assert abs(stored(own) @ R).max() <= 1e-13 * abs(stored(own)).max()


def test_slip_on_an_ill_conditioned_dual_gives_the_same_displacement_in_few_products():
    """Friction rows are nearly dependent on support rows: κ is 4e4, or 6e4 in
    subdomains.

    With spectral steps alone, the tolerance 1e-8 requires 2013 products in subdomains,
    and 32 063 for undivided bodies.
    """
    name = "contact-patch/dim=3/distort=0.2/ratio=10/friction=coulomb/mu=0.2"
    u, tol = [], 1e-9
    for one in (name, f"{name}/feti=2"):
        case = parse(f"{one}/dual", PROBLEMS).build(reference_solution)
        s = SOLVERS["smalbe"].prepare(case.qp, tol)()
        u.append(case.mechanics.to_primal(s).x)
        assert s.status is Status.SOLVED
        assert s.counts["P_products"] <= 1500
        assert s.counts["newton"] > 0

    assert abs(u[1] - u[0]).max() <= 10 * tol * abs(u[0]).max()
