"""SMALBE on duals of decomposed bodies: bounded numbers of products, and the solution
of the undivided problem.
"""

from dataclasses import replace

import numpy as np
import pytest

from mortarbench import build
from mortarbench.harness import Status
from mortarbench.harness.verify.kkt import kkt_residuals
from mortarbench.problems import PROBLEMS
from mortarbench.solvers.reference.solve import reference_solution
from mortarbench.solvers.smalbe import rows as rows_module
from mortarbench.solvers.smalbe.rows import SparseRows, equality_rows
from mortarbench.solvers.smalbe.solver import SMALBE
from tests.support.supported_by_contact import dual_of_disc_between_plates

pytestmark = pytest.mark.together


def case(**keys):
    family = PROBLEMS["beam-ring"]
    return family.with_keys(**keys).build("dual", reference_solution)


def torn(Nr, **keys):
    return case(Nr=Nr, Nh=Nr // 2, steps=1, feti=8, **keys)


@pytest.fixture(scope="module", params=[1e-6, 1e-8])
def answers(request):
    """Return answers on three meshes with H/h = 8 and 500 to 30 000 degrees
    of freedom.
    """
    qps = [torn(Nr).qp for Nr in (8, 16, 32)]
    return request.param, [(qp, SMALBE().prepare(qp, request.param)()) for qp in qps]


def test_products_do_not_grow_with_the_mesh(answers):
    tol, solved = answers
    products = [s.counts["P_products"] for _, s in solved]

    assert max(products) <= (42 if tol == 1e-6 else 50)
    assert products[2] <= products[1] + 5
    assert all(s.counts["outer"] <= 3 for _, s in solved)


def test_torn_problems_are_solved_and_the_preconditioner_is_counted(answers):
    tol, solved = answers

    for qp, s in solved:
        assert s.status is Status.SOLVED
        assert kkt_residuals(qp, s).worst <= 10 * tol
        assert s.counts["preconditioner_applies"] <= s.counts["P_products"]


def test_rows_of_torn_problems_are_sparse_with_a_flat_spectrum(answers):
    _, solved = answers
    qp, s = solved[-1]

    assert isinstance(equality_rows(qp.A, qp.b, np.isfinite(qp.lb)), SparseRows)
    assert s.counts["P_products"] <= s.iterations + s.counts["expansion"] + 12


@pytest.mark.parametrize("glue", ["orthonormal", "redundant"])
def test_the_displacement_is_that_of_the_undecomposed_body(glue):
    pieces, whole = torn(8, glue=glue), case(Nr=8, Nh=4, steps=1)
    u = pieces.recover(SMALBE().prepare(pieces.qp, 1e-9)())
    v = whole.recover(SMALBE().prepare(whole.qp, 1e-9)())

    assert abs(u - v).max() <= 1e-8 * abs(v).max()


@pytest.mark.parametrize("keys", ["feti=1", "feti=2"])
@pytest.mark.parametrize("tol", [1e-8, 1e-10])
def test_a_semidefinite_dual_ends_at_its_rounding_errors(keys, tol):
    """Directions in the kernel of F do not enlarge the multipliers.

    Without the rule for spent directions, these cases take 1000 products, and their
    residuals are between 1e-7 and 1e-5.
    """
    qp = build(f"hertz-sphere/n=2/{keys}/glue=redundant/dual").qp
    s = SMALBE().prepare(qp, tol)()

    assert (s.status, s.message) == (Status.SOLVED, "converged")
    assert kkt_residuals(qp, s).worst <= 5 * tol
    assert s.counts["P_products"] < 150


@pytest.mark.parametrize("ratio", [1, 1000, 10_000])
@pytest.mark.parametrize("glue", ["orthonormal", "redundant"])
def test_supports_along_the_contact_of_a_stiff_body_do_not_slow_the_solve(glue, ratio):
    """Two slave nodes have tangential supports and friction.

    If their friction rows also acted on the supports, the least eigenvalue of F would
    be proportional to 1/ratio.
    """
    name = f"contact-patch/lower=4/upper=3/ratio={ratio}/friction=tresca/bound=5e7"
    whole, pieces = (
        build(f"{name}{keys}/dual") for keys in ("", f"/feti=3/glue={glue}")
    )
    s = SMALBE().prepare(pieces.qp, 1e-10)()
    u, v = pieces.recover(s), whole.recover(SMALBE().prepare(whole.qp, 1e-10)())

    assert s.status is Status.SOLVED
    assert s.counts["P_products"] <= 25
    assert abs(u - v).max() <= 1e-8 * abs(v).max()


@pytest.mark.parametrize("tol", [1e-6, 1e-9])
@pytest.mark.parametrize(
    "name",
    [
        "membranes/S=4/n=8",
        "membranes/S=3/n=4/glue=redundant",
        "beam-ring/Nr=8/Nh=4/steps=1/feti=4",
        "plate/Sx=4/Sy=4/n=4",
    ],
)
def test_an_operator_in_python_takes_the_same_steps(name, tol):
    """Only products with P and its preconditioner are called through Python."""
    qp = build(f"{name}/dual").qp
    compiled = SMALBE().prepare(qp, tol)()
    called = SMALBE().prepare(replace(qp, P=InPython(qp.P)), tol)()

    assert called.counts == compiled.counts
    assert called.x.tolist() == compiled.x.tolist()
    assert kkt_residuals(qp, compiled).worst <= 5 * tol


class InPython:
    """A dual operator without the compiled maps of its product and preconditioner."""

    def __init__(self, P):
        self.P, self.shape, self.diagonal = P.build(), P.shape, P.diagonal

    def __matmul__(self, x):
        return self.P(x)

    def preconditioner(self, kind, scaling):
        M = self.P.preconditioner(kind, scaling)
        return lambda x: M(x)


@pytest.mark.parametrize("basis", ["standard", "dual"])
@pytest.mark.parametrize("parts", [4, 20])
def test_a_disc_whose_rotation_only_fixed_rows_prevent_is_solved(
    basis, parts, monkeypatch
):
    """With sparse rows, one eigenvalue of G_F G_Fᵀ is a rounding error."""
    monkeypatch.setattr(rows_module, "MAX_DENSE_ENTRIES", 0)
    qp = dual_of_disc_between_plates(9, parts=parts, contact="mortar", basis=basis)
    assert isinstance(equality_rows(qp.A, qp.b, np.isfinite(qp.lb)), SparseRows)
    s = SMALBE().prepare(qp, 1e-8)()
    assert s.status is Status.SOLVED
    assert kkt_residuals(qp, s).worst <= 1e-7


@pytest.mark.parametrize(("jump", "tol"), [(1e8, 1e-9), (1e10, 1e-14)])
def test_a_solve_stalled_by_rounding_ends(jump, tol):
    """The moduli are far apart, and CG cannot find further directions that are
    conjugate to earlier ones.
    """
    given = {"n": 6, "pattern": "checkerboard", "jump": jump}
    plate = PROBLEMS["plate"]
    qp = plate.with_keys(**given).build("dual", reference_solution).qp
    s = SMALBE().prepare(qp, tol)()
    assert s.counts["P_products"] <= 2000
    if s.status is Status.SOLVED:
        assert kkt_residuals(qp, s).worst <= 1e-8
    else:
        assert "stagnated at residual" in s.message


@pytest.mark.parametrize("jump", [1e2, 1e4, 1e6, 1e8])
@pytest.mark.parametrize("tol", [1e-8, 1e-10])
def test_rounding_along_previous_directions_is_removed(jump, tol):
    """Without this correction, the solve took at least 209 products: as many as
    directions are stored, and then further ones. A second outer iteration takes 30.
    """
    plate = PROBLEMS["plate"]
    given = plate.with_keys(pattern="checkerboard", jump=jump)
    qp = given.build("dual", reference_solution).qp
    s = SMALBE().prepare(qp, tol)()
    assert s.status is Status.SOLVED
    assert s.counts["P_products"] <= 90
