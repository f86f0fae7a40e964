"""Contact patch test: exact linear states, and methods that fail this test."""

import numpy as np
import pytest

from mortarbench.harness.verify.kkt import kkt_residuals
from mortarbench.problems.families.patch import ContactPatch, model
from mortarbench.problems.fem.mesh import as_vectors
from mortarbench.solvers.adapters.clarabel_ import Clarabel
from mortarbench.solvers.reference.solve import reference_solution
from mortarbench.solvers.smalbe.solver import SMALBE

FAMILY = ContactPatch()
SOLVERS = {"dual": (SMALBE(), 1e-13), "primal": (Clarabel(), 1e-11)}
BASES = [("mortar", "dual"), ("mortar", "standard")]
MESHES = [(6, 4), (7, 5), (24, 20)]


def solved(form="dual", **keys):
    """Return the case, its verified solution and its quantities."""
    solver, tol = SOLVERS[form]
    case = FAMILY.with_keys(**keys).build(form, reference_solution)
    s = solver.prepare(case.qp, tol)()
    assert kkt_residuals(case.qp, s).worst <= 10 * tol
    return case, s, case.quantities(s)


def error(**keys):
    return solved(**keys)[2]["stress_error"]


@pytest.mark.parametrize("ratio", [1.0, 1e-3])
@pytest.mark.parametrize("slave", ["lower", "upper"])
@pytest.mark.parametrize(("contact", "basis"), BASES)
@pytest.mark.parametrize(("lower", "upper"), MESHES)
def test_mortar_reproduces_a_uniform_pressure(
    lower, upper, contact, basis, slave, ratio
):
    assert error(lower=lower, upper=upper, contact=contact, basis=basis, slave=slave,
                 ratio=ratio) <= 1e-10  # fmt: skip


def test_one_element_on_one_element_is_enough():
    assert error(lower=1, upper=1) <= 1e-10


@pytest.mark.parametrize(("basis", "coupled"), [("dual", 1), ("standard", 3)])
def test_only_the_dual_basis_uncouples_the_slave_nodes(basis, coupled):
    case = FAMILY.with_keys(basis=basis).build("primal", reference_solution)
    (pair,) = model(FAMILY).pairs
    vertical = case.qp.G[:, 2 * pair.slave + 1].toarray()

    assert (abs(vertical) > 1e-12).sum(axis=1).max() == coupled


@pytest.mark.parametrize("slave", ["lower", "upper"])
@pytest.mark.parametrize(("lower", "upper"), MESHES)
def test_node_to_segment_fails_and_refinement_does_not_help(lower, upper, slave):
    assert error(contact="nts", lower=lower, upper=upper, slave=slave) >= 0.05


def test_node_to_segment_passes_on_matching_meshes():
    assert error(contact="nts", lower=5, upper=5) <= 1e-10


@pytest.mark.parametrize(
    ("mesh", "slave", "percent"),
    [((6, 4), "upper", 27.8), ((6, 4), "lower", 8.9), ((24, 20), "upper", 9.8)],
)
def test_node_to_segment_has_the_errors_of_an_independent_code(mesh, slave, percent):
    """The expected errors are those of a prototype with different supports."""
    lower, upper = mesh
    got = 100 * error(contact="nts", slave=slave, lower=lower, upper=upper)

    assert got == pytest.approx(percent, abs=0.1)


@pytest.mark.parametrize("contact", ["nts", "mortar"])
def test_the_total_pressure_is_exact_even_if_its_distribution_is_wrong(contact):
    on_lower = solved(contact=contact, slave="upper")[2]
    on_upper = solved(contact=contact, slave="lower")[2]

    assert on_lower["contact_force"] == pytest.approx([0, -1e6], abs=1e-4)
    assert on_upper["contact_force"] == pytest.approx([0, 1e6], abs=1e-4)


@pytest.mark.parametrize("plane", ["strain", "stress"])
@pytest.mark.parametrize("form", ["primal", "dual"])
def test_the_displacement_is_the_exact_linear_one(form, plane):
    """ε_y = −p/E′ and ε_x = ν′p/E′; in plane strain, E′ = E/(1 − ν²) and ν′ = ν/(1 −
    ν)."""
    keys = {"ratio": 0.25, "plane": plane}
    case, s, _ = solved(form, **keys)
    bodies = model(FAMILY.with_keys(**keys))
    E, nu = (10e6 / 0.91, 0.3 / 0.7) if plane == "strain" else (10e6, 0.3)
    x, y = bodies.mesh.points.T
    lower = bodies.body_of_node == 0
    softness = 1e6 / E * np.where(lower, 4, 1)
    exact = np.column_stack([nu * softness * x, -softness * y])
    exact[~lower, 1] -= 1e6 / E * (4 - 1) * 0.5

    assert as_vectors(case.recover(s), 2) == pytest.approx(exact, abs=1e-9)


@pytest.mark.parametrize("form", ["primal", "dual"])
def test_the_energy_is_minus_half_the_work_of_the_pressure(form):
    case, s, result = solved(form)
    expected = -0.5 * 1e6 * 1e6 * 0.91 / 10e6

    assert result["energy"] == pytest.approx(expected, rel=1e-9)
    assert case.scale * case.qp.objective(s.x) + case.constant == pytest.approx(
        expected, rel=1e-9
    )


@pytest.mark.parametrize("distort", [pytest.param(0.0, marks=pytest.mark.slow), 0.2])
@pytest.mark.parametrize("slave", ["lower", "upper"])
@pytest.mark.parametrize("basis", ["dual", "standard"])
def test_face_mortar_reproduces_a_uniform_pressure(basis, slave, distort):
    keys = dict(dim=3, basis=basis, slave=slave, distort=distort)
    assert error(lower=5, upper=4, **keys) <= 1e-10
    assert error(lower=4, upper=4, form="primal", **keys) <= 2e-9  # Clarabel's accuracy


def test_node_to_face_fails_as_in_the_plane():
    assert error(dim=3, lower=5, upper=4, contact="nts") > 0.1
    assert error(dim=3, lower=4, upper=4, contact="nts") <= 1e-10  # matching nodes


@pytest.mark.parametrize("form", ["dual", "primal"])
def test_the_displacement_in_space_is_the_exact_linear_one(form):
    case, s, quantities = solved(form, dim=3, distort=0.2, ratio=1.0, lower=4, upper=3)
    points = model(FAMILY.with_keys(dim=3, distort=0.2, lower=4, upper=3)).mesh
    u = as_vectors(case.recover(s), 3)
    # the strains under uniaxial stress are ν p/E, ν p/E and −p/E
    exact = points.points * [0.03, 0.03, -0.1]
    assert u == pytest.approx(exact, abs=1e-9)
    assert quantities["energy"] == pytest.approx(-0.5 * 1e6 * 0.1, rel=1e-8)
    assert quantities["contact_force"] == pytest.approx([0, 0, -1e6], abs=1e-2)
