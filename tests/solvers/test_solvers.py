"""Properties of individual adapters that the conformance suite (test_conformance.py)
does not test.
"""

import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
from scipy.sparse import csc_array, csr_array, diags_array, eye_array, kron

from mortarbench.harness import QP, Status
from mortarbench.harness.conformance.manufactured import (
    infeasible,
    one_of_each,
    unbounded,
)
from mortarbench.harness.environment.environment import PACKAGES as OWN
from mortarbench.harness.registry import options_of
from mortarbench.harness.verify.kkt import kkt_residuals
from mortarbench.problems.families.beam_ring import BeamRing
from mortarbench.solvers import SOLVERS
from mortarbench.solvers.adapters.cvxpy_ import DECLINED_BACKENDS
from mortarbench.solvers.common.conversion import csc, on_present_bounds
from mortarbench.solvers.common.libraries import PACKAGES
from mortarbench.solvers.common.sequence import only_vectors_differ
from mortarbench.solvers.reference.solve import reference_solution

pytestmark = pytest.mark.together


def _module(name):
    about = SOLVERS[name].about
    return about.module or about.package


CONCRETE = {name: s for name, s in SOLVERS.items() if "*" not in name} | {
    "qpsolvers:clarabel": replace(SOLVERS["qpsolvers:*"], backend="clarabel"),
    "qpsolvers:scs": replace(SOLVERS["qpsolvers:*"], backend="scs"),
    "cvxpy:OSQP": replace(SOLVERS["cvxpy:*"], backend="OSQP"),
}
WILDCARDS = ("qpsolvers:*", "cvxpy:*")
#: active-set methods, whose accuracy does not depend on the tolerance
EXACT = ("daqp", "highs")
SPARSE = (
    "osqp", "clarabel", "proxqp", "piqp", "highs-hipo", "scs", "qpalm", "qoco", "qtqp",
)  # fmt: skip
NATIVE = [n for n, s in SOLVERS.items() if s.about.package and "*" not in n]
LIBRARIES = {name: _module(name) for name in NATIVE} | {
    "qpsolvers:clarabel": "qpsolvers",
    "cvxpy:OSQP": "cvxpy",
}

every_native_solver = pytest.mark.parametrize("name", NATIVE)


def solve(name, qp, tol=1e-9):
    solver = CONCRETE[name]
    if reason := solver.declines(qp):
        pytest.skip(reason)
    return solver.prepare(qp, tol)()


@pytest.fixture
def membrane():
    """Return a discrete membrane that is fixed at one side, loaded at a second side and
    supported by an obstacle at a third side.
    """
    k = 45
    end = np.eye(k)[:, [0, -1]].sum(axis=1)
    L = diags_array([-np.ones(k - 1), 2 - end, -np.ones(k - 1)], offsets=[-1, 0, 1])
    eye = eye_array(k, format="csr")
    K = csr_array(4e3 * (kron(L, eye) + kron(eye, L)))
    node = np.arange(k * k).reshape(k, k)
    rows = eye_array(k * k, format="csr")
    q = np.zeros(k * k)
    q[node[-1]] = 30 / k
    return QP(
        P=K, q=q, A=rows[node[:, 0]], b=np.zeros(k),
        G=-rows[node[0, 1:]], h=2e-3 * (0.3 + np.linspace(0, 1, k - 1) ** 2),
        lb=np.full(k * k, -np.inf), ub=np.full(k * k, np.inf),
    )  # fmt: skip


@pytest.mark.parametrize("name", sorted(CONCRETE.keys() - EXACT))
def test_more_digits_take_more_iterations(manufactured, name):
    qp, _ = manufactured("bounds", seed=57721, n=60)
    few, many = (solve(name, qp, tol) for tol in (1e-2, 1e-10))
    if few.iterations is None:
        assert kkt_residuals(qp, many).worst < kkt_residuals(qp, few).worst
    else:
        assert few.iterations < many.iterations


@pytest.mark.parametrize(("energy", "length"), [(1e-6, 1.0), (1e6, 1e-3)])
@every_native_solver
def test_accuracy_does_not_depend_on_the_units(manufactured, name, energy, length):
    qp, _ = manufactured("everything")
    scaled = replace(
        qp, P=qp.P * (energy / length**2), q=qp.q * (energy / length),
        b=qp.b * length, h=qp.h * length, lb=qp.lb * length, ub=qp.ub * length,
    )  # fmt: skip
    solution = solve(name, scaled, tol=1e-6)
    if name == "highs" and length != 1:  # stated by `about.limits`
        assert solution.message == "kSolveError"
        return
    assert solution.status is Status.SOLVED
    assert kkt_residuals(scaled, solution).worst <= 1e-5


@pytest.mark.parametrize("tol", [1e-3, 1e-6])
@pytest.mark.parametrize("name", SPARSE)
def test_a_membrane_in_contact_is_solved_to_the_tolerance(membrane, name, tol):
    # at 1e-3, ProxQP's default initial guess has negative multipliers but passes its
    # stopping criterion
    solution = solve(name, membrane, tol)
    assert solution.status is Status.SOLVED
    assert kkt_residuals(membrane, solution).worst <= 10 * tol


@pytest.mark.parametrize(
    "name", [n for n in NATIVE if "max_iter" in options_of(SOLVERS[n])]
)
def test_an_iteration_limit_is_reported_as_one(manufactured, name):
    qp, _ = manufactured("everything")
    solution = replace(CONCRETE[name], max_iter=1).prepare(qp, 1e-9)()
    assert solution.status is Status.ITERATION_LIMIT
    assert solution.iterations <= 2  # ProxQP also counts inner iterations


@pytest.mark.parametrize("problem", [infeasible, unbounded])
@pytest.mark.parametrize("name", ["osqp", "clarabel", "qpsolvers:scs", "cvxpy:OSQP"])
def test_a_certificate_is_not_returned_as_a_point(name, problem):
    solution = solve(name, problem())
    is_unbounded = problem is unbounded
    assert solution.status is (Status.UNBOUNDED if is_unbounded else Status.INFEASIBLE)
    assert np.isnan(solution.x).all()
    if is_unbounded:
        assert np.isnan(solution.z).all()
        assert np.isnan(solution.z_box).all()


@pytest.mark.parametrize(
    "name", ["osqp", "clarabel", "scs", "piqp", "highs", "qpalm", "qtqp"]
)
def test_a_certificate_of_infeasibility_has_our_signs(name):
    """The QP has x₀ + x₁ = −1, −x₀ ≤ −3 and x₁ ≥ −1, so every kind of row has a
    multiplier.
    """
    qp = QP(
        P=csr_array(np.eye(3)), q=np.ones(3), A=csr_array([[1.0, 1, 0]]),
        b=np.array([-1.0]), G=csr_array([[-1.0, 0, 0], [0, 0, 1]]),
        h=np.array([-3.0, 5]), lb=np.array([-np.inf, -1, -np.inf]),
        ub=np.full(3, np.inf),
    )  # fmt: skip
    s = solve(name, qp, 1e-6)
    assert s.status is Status.INFEASIBLE
    size = np.abs(s.y).max()
    balance = qp.A.T @ s.y + qp.G.T @ s.z + s.z_box
    assert s.z == pytest.approx([s.y[0], 0], abs=1e-2 * size)
    assert s.z_box == pytest.approx([0, -s.y[0], 0], abs=1e-2 * size)
    assert np.abs(balance).max() <= 1e-2 * size
    assert qp.b @ s.y + qp.h @ s.z + qp.lb[1] * s.z_box[1] < 0


def test_the_certificate_of_proxqp_has_our_signs():
    s = solve("proxqp", infeasible(), 1e-6)
    assert s.status is Status.INFEASIBLE
    assert s.z[0] == pytest.approx(s.z[1])
    assert s.z[0] > 0


@pytest.mark.parametrize(("name", "library"), LIBRARIES.items())
def test_a_missing_library_is_an_import_error(manufactured, monkeypatch, name, library):
    qp, _ = manufactured("box")
    monkeypatch.setitem(sys.modules, library, None)
    assert CONCRETE[name].declines(qp) is None
    with pytest.raises(ImportError, match=library):
        CONCRETE[name].prepare(qp, 1e-6)


def test_the_registry_imports_no_solver_library():
    code = "import sys, solvers; print(*sys.modules)"
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, check=True)
    assert set(LIBRARIES.values()).isdisjoint(run.stdout.decode().split())


def test_proxqp_backends_agree(manufactured):
    qp, expected = manufactured("everything")
    for backend in ("dense", "sparse"):
        solution = replace(SOLVERS["proxqp"], backend=backend).prepare(qp, 1e-9)()
        np.testing.assert_allclose(solution.x, expected.x, atol=1e-6)


@pytest.mark.parametrize("wildcard", WILDCARDS)
def test_only_missing_backends_decline(manufactured, wildcard):
    import cvxpy
    import qpsolvers

    installed = {
        "qpsolvers:*": qpsolvers.available_solvers,
        "cvxpy:*": cvxpy.installed_solvers(),
    }[wildcard]
    qp, _ = manufactured("box")
    reasons = {
        backend: replace(SOLVERS[wildcard], backend=backend).declines(qp)
        for backend in SOLVERS[wildcard].backends()
    }

    able = {b for b, reason in reasons.items() if not reason}
    assert able == set(installed) - DECLINED_BACKENDS.keys()
    lacking = [r for b, r in reasons.items() if b not in installed]
    assert all(r.startswith("not installed: ") for r in lacking)


@pytest.mark.parametrize("wildcard", WILDCARDS)
def test_an_unknown_backend_is_declined_with_the_available_ones(manufactured, wildcard):
    qp, _ = manufactured("box")
    solver = replace(SOLVERS[wildcard], backend="foo")
    assert "foo" not in solver.backends()
    reason = solver.declines(qp)
    assert "has no backend 'foo'; installed: " in reason
    assert "osqp" in reason.lower()


def test_an_error_of_cvxpy_is_a_failure_with_its_message(manufactured, monkeypatch):
    import cvxpy

    def fail(*args):
        raise cvxpy.SolverError("gave up")

    qp, _ = manufactured("box")
    call = CONCRETE["cvxpy:OSQP"].prepare(qp, 1e-6)
    monkeypatch.setattr(cvxpy.Problem, "unpack_results", fail)

    solution = call()

    assert solution.status is Status.FAILED
    assert solution.message == "gave up"
    assert np.isnan(solution.x).all()


@pytest.mark.parametrize("backend", ["osqp", "scs", "clarabel", "proxqp"])
def test_qpsolvers_claims_only_reported_success(manufactured, monkeypatch, backend):
    import qpsolvers

    honest = qpsolvers.solve_problem

    def unsure(*args, **options):
        found = honest(*args, **options)
        found.found = False
        return found

    qp, _ = manufactured("box")
    monkeypatch.setattr(qpsolvers, "solve_problem", unsure)
    solution = replace(SOLVERS["qpsolvers:*"], backend=backend).prepare(qp, 1e-6)()
    assert solution.status is Status.FAILED


def test_round_off_on_absent_bounds_is_dropped_and_the_rest_is_kept():
    qp, _ = one_of_each()
    z_box = np.array([-1e-9, 1e-9, 1e-9, -1e-9]), np.array([2.0, -3.0, 0.0, 0.0])
    np.testing.assert_array_equal(on_present_bounds(qp, z_box[0]), np.zeros(4))
    np.testing.assert_array_equal(on_present_bounds(qp, z_box[1]), z_box[1])


def test_a_converted_matrix_shares_nothing_with_the_problem():
    M = csc_array([[1.0, 0], [2, 3]])
    M.data.flags.writeable = False
    assert csc(M).data.flags.writeable
    assert not np.shares_memory(csc(M).data, M.data)


def test_a_vector_update_costs_a_sequence_fewer_iterations(manufactured):
    # the second QP differs from the first only slightly, and only in vectors
    qp, _ = manufactured("everything", n=40)
    moved = replace(qp, q=qp.q * (1 + 1e-4))
    for name in ("osqp", "scs", "qpalm", "daqp"):
        prepare = SOLVERS[name].chain(1e-6)
        first, warm = (prepare(each)().iterations for each in (qp, moved))
        assert warm < SOLVERS[name].prepare(moved, 1e-6)().iterations <= 2 * first


@pytest.mark.parametrize("name", ["osqp", "scs", "qpalm", "proxqp-sparse", "qtqp"])
def test_a_rebuilt_session_starts_from_the_last_point(manufactured, name):
    qp, _ = manufactured("everything", n=40)
    other = replace(
        qp, P=qp.P * (1 + 1e-9)
    )  # nearly equal, but a change of P requires a new session
    prepare = SOLVERS[name].chain(1e-6)
    first, again = prepare(qp)(), prepare(other)()
    assert again.iterations < first.iterations
    assert kkt_residuals(other, again).worst <= 1e-5


def test_sequences_share_no_state(manufactured):
    qp, _ = manufactured("everything")
    one, two = (SOLVERS["osqp"].chain(1e-6)(qp)().iterations for _ in range(2))
    assert one == two == SOLVERS["osqp"].prepare(qp, 1e-6)().iterations


def test_matrices_that_differ_are_not_updated(manufactured):
    qp, _ = manufactured("everything")
    assert only_vectors_differ(qp, replace(qp, q=qp.q + 1, h=qp.h + 1, lb=qp.lb - 1))
    assert not only_vectors_differ(qp, replace(qp, P=qp.P * 2))
    assert not only_vectors_differ(qp, replace(qp, G=qp.G * 2))
    assert not only_vectors_differ(qp, replace(qp, A=qp.A * 2))
    assert not only_vectors_differ(qp, replace(qp, ub=np.full(20, np.inf)))


@pytest.mark.parametrize("name", ["daqp", "piqp-dense", "proxqp-dense"])
def test_a_dense_solver_declines_qps_that_exceed_memory(
    manufactured, monkeypatch, name
):
    qp, _ = manufactured("bounds", n=400)  # 1.2 MiB per matrix
    assert SOLVERS[name].declines(qp) is None
    monkeypatch.setenv("MORTARBENCH_MEMORY_MIB", "2")
    reason = SOLVERS[name].declines(qp)
    assert reason.startswith("needs ")
    assert reason.endswith(" MiB for dense matrices of 400 rows; the limit is 2 MiB")


def test_a_solver_reports_its_linear_solver(manufactured):
    qp, _ = manufactured("box")
    for name in NATIVE:
        assert solve(name, qp, 1e-6).reported["linear_solver"]


def test_highs_has_no_hidden_regularisation(manufactured):
    # 1e-7 on the Hessian's diagonal would change at least the ninth digit
    qp, _ = manufactured("singular")
    small = replace(qp, P=qp.P * 1e-4, q=qp.q * 1e-4)
    for name in ("highs", "highs-hipo"):
        solution = solve(name, small)
        assert kkt_residuals(small, solution).worst <= 1e-9


@pytest.mark.parametrize("name", ["highs", "highs-hipo"])
def test_highs_drops_no_small_entries(name):
    # a flexibility matrix in large units of force; entries below 1e-9 matter
    family = BeamRing()
    configured = family.with_keys(Nr=4, Nh=3, steps=1)
    qp = configured.build("dual", reference_solution).qp
    unit = 1e-5
    small = replace(qp, P=qp.P * unit, b=qp.b / unit)
    assert kkt_residuals(small, solve(name, small)).worst <= 1e-8


def test_quadprog_declines_equal_bounds(manufactured):
    """It claims that one of eight feasible QPs with equal bounds is infeasible."""
    reason = replace(SOLVERS["qpsolvers:*"], backend="quadprog").declines(
        manufactured("fixed")[0]
    )
    assert reason == "takes feasible QPs with equal bounds for infeasible"


def test_qoco_claims_are_rejected_if_its_iterates_diverge():
    solution = solve("qoco", unbounded())
    assert solution.status is Status.FAILED
    assert solution.message == "diverged"


def test_the_versions_of_all_libraries_belong_to_an_environment():
    used = {s.about.package for s in SOLVERS.values() if s.about.package}

    assert used <= {*PACKAGES, *OWN}
