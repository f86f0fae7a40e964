"""Conformance: every registered solver finds every planted solution it accepts."""

import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
from scipy.sparse import csc_array, csr_array, diags_array, eye_array, kron
from scipy.sparse.linalg import aslinearoperator

from harness import QP, Status, kkt_residuals, no_rows
from solvers import SOLVERS
from solvers.conversion import csc, on_present_bounds

SHAPES = [
    "bounds", "box", "free", "equalities", "inequalities", "some bounds",
    "everything", "singular",
]  # fmt: skip
#: backends that stand for the wildcard entries of the registry
STAND_INS = {"qpsolvers:*": ("clarabel", "scs"), "cvxpy:*": ("CLARABEL", "OSQP")}
CONCRETE = {name: s for name, s in SOLVERS.items() if name not in STAND_INS} | {
    wildcard.replace("*", backend): replace(SOLVERS[wildcard], backend=backend)
    for wildcard, backends in STAND_INS.items()
    for backend in backends
}
FINITE = {"bvls"}  #: ends with the exact active set, whatever the tolerance
NATIVE = ["osqp", "clarabel", "proxqp"]
LIBRARIES = {
    "osqp": "osqp",
    "clarabel": "clarabel",
    "proxqp": "proxsuite",
    "qpsolvers:clarabel": "qpsolvers",
    "cvxpy:OSQP": "cvxpy",
}

every_solver = pytest.mark.parametrize("name", CONCRETE)
every_native_solver = pytest.mark.parametrize("name", NATIVE)


def solve(name, qp, tol=1e-9):
    solver = CONCRETE[name]
    if reason := solver.declines(qp):
        pytest.skip(reason)
    return solver.prepare(qp, tol)()


def arrays(qp):
    """Every buffer of a QP."""
    matrices = (qp.P, qp.A, qp.G)
    buffers = [getattr(M, "data", M) for M in matrices if not isinstance(M, np.ndarray)]
    dense = [M for M in matrices if isinstance(M, np.ndarray)]
    return [*buffers, *dense, qp.q, qp.b, qp.h, qp.lb, qp.ub]


@pytest.fixture
def one_of_each():
    """Four separate problems min ½x² + qx, one active constraint of each kind.

    x₀ ≤ 1 and x₁ ≥ −1 (bounds), 2x₂ ≤ 2 (row), 2x₃ = 2; all multipliers follow by hand.
    """
    inf = np.inf
    qp = QP(
        P=csr_array(np.eye(4)), q=np.array([-3.0, 4.0, -5.0, -9.0]),
        A=csr_array([[0.0, 0, 0, 2]]), b=np.array([2.0]),
        G=csr_array([[0.0, 0, 2, 0]]), h=np.array([2.0]),
        lb=np.array([-inf, -1, -inf, -inf]), ub=np.array([1, inf, inf, inf]),
    )  # fmt: skip
    return qp, dict(x=[1, -1, 1, 1], y=[4], z=[2], z_box=[2, -3, 0, 0])


@pytest.fixture
def membrane():
    """Discrete membrane over a flat obstacle, fixed on one side, pulled on another."""
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


@pytest.mark.parametrize("dense", [False, True], ids=["sparse", "dense"])
@pytest.mark.parametrize("shape", SHAPES)
def test_a_planted_point_is_a_solution(planted, shape, dense):
    qp, expected = planted(shape, seed=314159, dense=dense)
    assert kkt_residuals(qp, expected).worst < 1e-13


@pytest.mark.parametrize("dense", [False, True], ids=["sparse", "dense"])
@pytest.mark.parametrize("shape", SHAPES)
@every_solver
def test_a_solver_finds_the_planted_solution(planted, name, shape, dense):
    qp, expected = planted(shape, dense=dense)

    solution = solve(name, qp, tol=1e-9)

    assert solution.status is Status.SOLVED
    assert solution.mismatch(qp) is None
    assert kkt_residuals(qp, solution).worst <= 1e-8
    assert qp.objective(solution.x) == pytest.approx(qp.objective(expected.x), rel=1e-6)
    if shape != "singular":
        np.testing.assert_allclose(solution.x, expected.x, atol=1e-6)


@every_solver
def test_multipliers_follow_the_sign_convention(one_of_each, name):
    qp, expected = one_of_each
    solution = solve(name, qp)
    for vector, value in expected.items():
        np.testing.assert_allclose(getattr(solution, vector), value, atol=1e-6)


@every_solver
def test_a_multiplier_on_an_absent_bound_is_exactly_zero(planted, name):
    qp, _ = planted("some bounds")
    solution = solve(name, qp, tol=1e-3)
    assert (solution.z_box[np.isinf(qp.lb)] >= 0).all()
    assert (solution.z_box[np.isinf(qp.ub)] <= 0).all()


@pytest.mark.parametrize("tol", [1e-3, 1e-6])
@pytest.mark.parametrize("shape", SHAPES)
@every_solver
def test_the_tolerance_asked_for_is_reached(planted, name, shape, tol):
    qp, _ = planted(shape, seed=161803)
    assert kkt_residuals(qp, solve(name, qp, tol)).worst <= 10 * tol


@every_solver
def test_more_digits_take_more_iterations(planted, name):
    qp, _ = planted("bounds", seed=57721, n=60)
    few, many = (solve(name, qp, tol) for tol in (1e-2, 1e-10))
    if name in FINITE:
        assert kkt_residuals(qp, few).worst < 1e-12
    elif few.iterations is None:
        assert kkt_residuals(qp, many).worst < kkt_residuals(qp, few).worst
    else:
        assert few.iterations < many.iterations


@pytest.mark.parametrize("length", [1.0, 1e-3])
@pytest.mark.parametrize("energy", [1.0, 1e-6, 1e6])
@every_native_solver
def test_accuracy_does_not_depend_on_the_units(planted, name, energy, length):
    qp, _ = planted("everything")
    scaled = replace(
        qp, P=qp.P * (energy / length**2), q=qp.q * (energy / length),
        b=qp.b * length, h=qp.h * length, lb=qp.lb * length, ub=qp.ub * length,
    )  # fmt: skip
    solution = solve(name, scaled, tol=1e-6)
    assert solution.status is Status.SOLVED
    assert kkt_residuals(scaled, solution).worst <= 1e-5


@pytest.mark.parametrize("tol", [1e-3, 1e-6])
@every_native_solver
def test_a_membrane_in_contact_is_solved_to_the_tolerance(membrane, name, tol):
    # at 1e-3 ProxQP's default first guess passes its own test with negative multipliers
    solution = solve(name, membrane, tol)
    assert solution.status is Status.SOLVED
    assert kkt_residuals(membrane, solution).worst <= 10 * tol


@pytest.mark.parametrize("dense", [False, True], ids=["sparse", "dense"])
@every_solver
def test_the_problem_is_left_as_it_was(planted, name, dense):
    qp, _ = planted("everything", dense=dense)
    before = [array.copy() for array in arrays(qp)]
    solve(name, qp)
    for array, copy in zip(arrays(qp), before, strict=True):
        assert not array.flags.writeable
        np.testing.assert_array_equal(array, copy)


@every_solver
def test_repeats_are_cold(planted, name):
    qp, _ = planted("bounds", n=60)
    first, second = solve(name, qp), solve(name, qp)
    assert first.iterations == second.iterations
    np.testing.assert_array_equal(first.x, second.x)


@every_solver
def test_a_misspelt_option_is_rejected(name):
    with pytest.raises(TypeError, match="max_itre"):
        type(CONCRETE[name])(max_itre=5)


@every_native_solver
def test_an_iteration_limit_is_reported_as_one(planted, name):
    qp, _ = planted("everything")
    solution = replace(CONCRETE[name], max_iter=1).prepare(qp, 1e-9)()
    assert solution.status is Status.ITERATION_LIMIT
    assert solution.iterations <= 2  # ProxQP counts inner ones too


@pytest.fixture
def infeasible(planted):
    """x₀ − x₁ ≤ −1 and x₁ − x₀ ≤ −1."""
    qp, _ = planted("inequalities")
    rows = csr_array(np.eye(2, 20) - np.eye(2, 20)[::-1])
    return replace(qp, G=rows, h=np.array([-1.0, -1.0]))


@pytest.fixture
def unbounded(planted):
    """No curvature and no upper bound along x₀, and a slope."""
    qp, _ = planted("bounds")
    return replace(qp, P=csr_array(np.diag([0.0] + [1.0] * 19)), q=-np.ones(20))


@pytest.mark.parametrize("problem", ["infeasible", "unbounded"])
@every_solver
def test_a_problem_without_solution_is_not_reported_as_solved(request, name, problem):
    solution = solve(name, request.getfixturevalue(problem))
    assert solution.status is not Status.SOLVED
    assert solution.message


@pytest.mark.parametrize("problem", ["infeasible", "unbounded"])
@pytest.mark.parametrize("name", ["osqp", "clarabel", "qpsolvers:scs", "cvxpy:OSQP"])
def test_a_certificate_is_not_passed_off_as_a_point(request, name, problem):
    solution = solve(name, request.getfixturevalue(problem))
    assert solution.status is Status.INFEASIBLE
    assert np.isnan(solution.x).all()
    assert np.isnan(solution.z).all()


@every_solver
def test_an_operator_is_declined_with_a_reason(planted, name):
    qp, _ = planted("everything")
    if name in LIBRARIES or name in CONCRETE.keys() - SOLVERS.keys():
        reason = CONCRETE[name].declines(replace(qp, P=aslinearoperator(qp.P)))
        assert reason == "needs explicit matrices"


@pytest.mark.parametrize(("name", "library"), LIBRARIES.items())
def test_a_missing_library_is_an_import_error(planted, monkeypatch, name, library):
    qp, _ = planted("box")
    monkeypatch.setitem(sys.modules, library, None)
    assert CONCRETE[name].declines(qp) is None
    with pytest.raises(ImportError, match=library):
        CONCRETE[name].prepare(qp, 1e-6)


def test_the_registry_imports_no_solver_library():
    code = "import sys, solvers; print(*sys.modules)"
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, check=True)
    assert set(LIBRARIES.values()).isdisjoint(run.stdout.decode().split())


def test_proxqp_backends_agree(planted):
    qp, expected = planted("everything")
    for backend in ("dense", "sparse"):
        solution = replace(SOLVERS["proxqp"], backend=backend).prepare(qp, 1e-9)()
        np.testing.assert_allclose(solution.x, expected.x, atol=1e-6)


@pytest.mark.parametrize("wildcard", STAND_INS)
def test_the_backends_that_decline_are_those_not_installed(planted, wildcard):
    import cvxpy
    import qpsolvers

    installed = {
        "qpsolvers:*": qpsolvers.available_solvers,
        "cvxpy:*": cvxpy.installed_solvers(),
    }[wildcard]
    qp, _ = planted("box")
    reasons = {
        backend: replace(SOLVERS[wildcard], backend=backend).declines(qp)
        for backend in SOLVERS[wildcard].backends()
    }

    assert {b for b, reason in reasons.items() if not reason} == set(installed)
    assert all(r.startswith("not installed: ") for r in reasons.values() if r)


@pytest.mark.parametrize("wildcard", STAND_INS)
def test_an_unknown_backend_is_declined_with_those_there_are(planted, wildcard):
    qp, _ = planted("box")
    solver = replace(SOLVERS[wildcard], backend="foo")
    assert "foo" not in solver.backends()
    reason = solver.declines(qp)
    assert "has no backend 'foo'; installed: " in reason
    assert "osqp" in reason.lower()


def test_an_error_of_cvxpy_is_a_failure_in_its_words(planted, monkeypatch):
    import cvxpy

    def fail(*args):
        raise cvxpy.SolverError("gave up")

    qp, _ = planted("box")
    call = CONCRETE["cvxpy:OSQP"].prepare(qp, 1e-6)
    monkeypatch.setattr(cvxpy.Problem, "unpack_results", fail)

    solution = call()

    assert solution.status is Status.FAILED
    assert solution.message == "gave up"
    assert np.isnan(solution.x).all()


@pytest.mark.parametrize("backend", ["osqp", "scs", "clarabel", "proxqp"])
def test_qpsolvers_claims_no_success_it_was_not_given(planted, monkeypatch, backend):
    import qpsolvers

    honest = qpsolvers.solve_problem

    def unsure(*args, **options):
        found = honest(*args, **options)
        found.found = False
        return found

    qp, _ = planted("box")
    monkeypatch.setattr(qpsolvers, "solve_problem", unsure)
    solution = replace(SOLVERS["qpsolvers:*"], backend=backend).prepare(qp, 1e-6)()
    assert solution.status is Status.FAILED


def test_an_unconstrained_problem_needs_no_rows(planted):
    qp, _ = planted("box")
    inf = np.full(20, np.inf)
    free = replace(qp, A=no_rows(20), G=no_rows(20), lb=-inf, ub=inf)
    for name in NATIVE:
        solution = solve(name, free)
        np.testing.assert_allclose(free.P @ solution.x, -free.q, atol=1e-7)


def test_round_off_on_absent_bounds_is_dropped_and_the_rest_is_kept(one_of_each):
    qp, _ = one_of_each
    z_box = np.array([-1e-9, 1e-9, 1e-9, -1e-9]), np.array([2.0, -3.0, 0.0, 0.0])
    np.testing.assert_array_equal(on_present_bounds(qp, z_box[0]), np.zeros(4))
    np.testing.assert_array_equal(on_present_bounds(qp, z_box[1]), z_box[1])


def test_a_converted_matrix_shares_nothing_with_the_problem():
    M = csc_array([[1.0, 0], [2, 3]])
    M.data.flags.writeable = False
    assert csc(M).data.flags.writeable
    assert not np.shares_memory(csc(M).data, M.data)
