"""SMALBE: steps, invariants and difficult problems."""

import re
from dataclasses import replace
from functools import partial
from itertools import pairwise

import numpy as np
import pytest

from mortarbench.harness import QP, Status, no_rows
from mortarbench.harness.verify.kkt import kkt_residuals
from mortarbench.problems import PROBLEMS
from mortarbench.solvers import SOLVERS
from mortarbench.solvers.common.stopping import relative_residual
from mortarbench.solvers.reference.solve import reference_solution
from mortarbench.solvers.smalbe import driver
from mortarbench.solvers.smalbe.projected import (
    by_lanczos,
    projected_problem,
)
from mortarbench.solvers.smalbe.rows import orthonormal_rows
from mortarbench.solvers.smalbe.solver import SMALBE
from tests.support.small_qps import floating_dual

INHOUSE = [name for name in SOLVERS if name.startswith("smalbe")]


def projected(qp, steps=10):
    return projected_problem(qp, partial(by_lanczos, steps=steps))


def hessian(problem, rho):
    """Return H (n, n)."""
    C, N = problem.rows.C, problem.spectrum.norm
    columns = np.eye(problem.b.size)
    PFP = [
        problem.rows.project(problem.F(problem.rows.project(v))) / N for v in columns
    ]
    return np.column_stack(PFP) + rho * C.T @ C


def lanczos(H, start, steps):
    """Return the Ritz pairs of a symmetric matrix H (n, n)."""
    n = len(H)
    qp = bounded(H, np.zeros(n))
    problem = projected_problem(qp, partial(by_lanczos, steps=steps, start=start))
    return problem.spectrum.ritz


@pytest.fixture
def outer_loop():
    def run(problem, *, M=1.0, eta=0.1, rho=3.0, tol=1e-8):
        options = SMALBE(preconditioner="none", M=M, eta=eta, recycle=False)
        chosen = driver.outer_loop(problem, None, options)
        x, mu = np.zeros(problem.b.size), np.zeros(len(problem.rows.C))
        return chosen.solve(tol, chosen.first(x, mu, M=M, rho=rho))

    return run


def bounded(P, q, A=None, b=(), lb=-np.inf, ub=np.inf):
    q = np.asarray(q, dtype=float)
    n = q.size
    lb, ub = np.broadcast_to(lb, n).astype(float), np.broadcast_to(ub, n).astype(float)
    return QP(
        P=np.asarray(P, dtype=float), q=q,
        A=no_rows(n) if A is None else np.asarray(A, dtype=float),
        b=np.asarray(b, dtype=float), G=no_rows(n), h=np.zeros(0),
        lb=lb, ub=ub,
    )  # fmt: skip


@pytest.fixture
def dual():
    return floating_dual


def test_rows_that_contradict_each_other_by_rounding_end_the_solve():
    """The entries of two rows differ by up to 5·10⁻⁹, and their right-hand sides by
    10⁻¹². No penalty reduces ‖Cν‖ to its tolerance.
    """
    n = 6
    A = np.vstack([np.ones(n), 1 + 1e-9 * np.arange(n)])
    qp = QP(
        P=np.eye(n), q=np.ones(n), A=A, b=np.array([1, 1 - 1e-12]), G=no_rows(n),
        h=np.zeros(0), lb=np.zeros(n), ub=np.full(n, np.inf),
    )  # fmt: skip
    s = SMALBE().prepare(qp, 1e-8)()

    assert s.status is Status.ITERATION_LIMIT
    assert "stagnated" in s.message
    assert s.counts["P_products"] <= 20


def test_nearly_parallel_rows_are_independent():
    """x = (0, 10⁴, ·): the rows differ by 5·10⁻¹¹ only, and this difference determines
    x₂.
    """
    qp = bounded(np.eye(3), [0.0, 0, 1], [[1, 0, 0], [1, 5e-11, 0]], [0.0, 5e-7])
    rows = orthonormal_rows(qp.A, qp.b)

    assert len(rows.C) == 2
    assert rows.consistent
    assert rows.x_tilde == pytest.approx([0, 1e4, 0], rel=1e-4)


@pytest.mark.parametrize("off", [1e-6, -1e-3])
def test_repeated_rows_need_equal_right_hand_sides(off):
    rows = orthonormal_rows(np.ones((2, 3)), np.array([1.0, 1.0 + off]))

    assert not rows.consistent


def test_a_stalled_multiplier_increases_the_penalty():
    """The free variables have little effect on the rows, since most variables are
    fixed. With constant ρ, more than ten thousand outer iterations were needed.
    """
    rng = np.random.default_rng(271828)
    W = rng.standard_normal((6, 6))
    A = rng.standard_normal((2, 6)) * [1, 1, 1, 1, 1e-3, 1e-3]
    x = rng.standard_normal(6)
    lb = np.where(np.arange(6) < 4, x, -np.inf)
    ub = np.where(np.arange(6) < 4, x, np.inf)
    qp = bounded(W @ W.T, rng.standard_normal(6), A, A @ x, lb=lb, ub=ub)

    s = SMALBE().prepare(qp, 1e-6)()

    assert s.status is Status.SOLVED
    assert s.counts["outer"] < 100


def test_the_model_uses_the_lanczos_process_and_the_rows(dual):
    """The model is ρ on C, and the Ritz value plus its residual on a Ritz vector.
    Elsewhere the model is far below the norm, because the spectrum decays like 1/k².
    """
    rng = np.random.default_rng(271828)
    V = np.linalg.qr(rng.standard_normal((60, 60)))[0]
    F = V / np.arange(1, 61) ** 2 @ V.T
    G, x = rng.standard_normal((3, 60)), rng.random(60)
    qp = bounded((F + F.T) / 2, rng.standard_normal(60), G, G @ x, lb=0.0)
    problem = projected(qp, 12)
    ritz, C = problem.spectrum.ritz, problem.rows.C
    solver = driver.outer_loop(problem, qp, SMALBE(preconditioner="model")).solver
    known = (ritz.values + ritz.residuals)[:10] / problem.spectrum.norm

    def inverse(rows):
        free = np.full(60, True)
        return np.array([solver.precondition(free, v, 1e4) for v in rows])

    assert inverse(C) == pytest.approx(C / 1e4, abs=1e-8)
    vectors = ritz.vectors[:10]
    assert known[:, None] * inverse(vectors) == pytest.approx(vectors, abs=1e-6)
    rest = problem.rows.project(rng.standard_normal(60))
    rest -= vectors.T @ (vectors @ rest)
    tau = (rest @ rest) / (rest @ inverse([rest])[0])
    assert tau < 1 / 100


@pytest.mark.parametrize(
    "wrong",
    [dict(rho=-1.0), dict(rho=np.inf), dict(M=0.0), dict(beta=1.0), dict(beta=2.0),
     dict(Gamma=-1.0), dict(lanczos_steps=0), dict(max_steps=-1), dict(alpha=2.1),
     dict(expansion="gp"), dict(preconditioner="ilu")],
    ids=str,
)  # fmt: skip
def test_options_that_cannot_work_are_refused(wrong):
    with pytest.raises(ValueError, match=f"{next(iter(wrong))} = .*; expected"):
        SMALBE(**wrong)


def test_products_are_explained_by_the_steps(dual):
    """The total is 5 for Lanczos (n = 30), one for homogenisation, none for the start
    at 0, 1 for each c, b or p, 2 for each e, 3 for each f, and one for the residual of
    the original problem.
    """
    s = SMALBE().prepare(dual(271828), 1e-6)()
    c = s.counts

    steps = c.get("cg", 0) + c.get("beyond", 0) + c.get("proportioning", 0)
    steps += 2 * c.get("expansion", 0) + 3 * c.get("fallback", 0)
    assert c["P_products"] == 5 + 1 + steps + 1


@pytest.mark.parametrize("orders", [6, 9])
@pytest.mark.parametrize("bounds", [False, True])
def test_a_tolerance_beyond_rounding_ends_in_the_residual_that_was_reached(
    orders, bounds
):
    """The eigenvalues are 1 … 10^orders, and no point in double precision has the
    required residual.
    """
    rng, n = np.random.default_rng(1), 60
    Q = np.linalg.qr(rng.standard_normal((n, n)))[0]
    P = (Q * np.logspace(0, orders, n)) @ Q.T
    qp = QP(
        P=(P + P.T) / 2, q=rng.standard_normal(n), A=no_rows(n), b=np.zeros(0),
        G=no_rows(n), h=np.zeros(0), ub=np.full(n, np.inf),
        lb=np.where(np.arange(n) % 3 == 0, 0.0 if bounds else -np.inf, -np.inf),
    )  # fmt: skip
    s = SMALBE(lanczos_steps=5).prepare(qp, 1e-300)()

    assert s.status is Status.ITERATION_LIMIT
    assert s.counts["P_products"] <= 10_000
    worst = relative_residual(qp, s, 1e-300)
    assert 0 < worst <= 10.0 ** (orders - 16)
    reported = float(re.match(r"stagnated at residual ([\d.e-]+):", s.message)[1])
    # the rest is rounding of Px
    assert reported == pytest.approx(worst, rel=0.3, abs=10.0 ** (orders - 18))


@pytest.mark.parametrize("seed", [271828, 314159])
def test_M_shrinks_while_the_lagrangian_grows_too_little(outer_loop, dual, seed):
    """M shrinks only in this case, as the recorded L, ‖Cν‖ and M show."""
    rho = 3.0
    outer = outer_loop(projected(dual(seed)), M=1e3, eta=1e9, rho=rho).outer

    needed = [rho / 2 * o.infeasibility**2 for o in outer[1:]]
    grown = np.diff([o.lagrangian for o in outer])
    cut = [later.M == o.M / 2 for o, later in pairwise(outer[1:])]
    kept = [later.M == o.M for o, later in pairwise(outer[1:])]
    assert cut == (grown < needed)[:-1].tolist()
    assert kept == [not c for c in cut]
    assert True in cut
    assert False in cut


@pytest.mark.parametrize(("rho", "rounding"), [(1e-3, 1e-12), (3.0, 1e-13)])
def test_the_carried_gradient_is_the_gradient(outer_loop, dual, rho, rounding):
    """This includes changes of the penalty."""
    problem = projected(dual(271828))
    end = outer_loop(problem, M=10.0, rho=rho, tol=1e-6)
    C = problem.rows.C

    assert end.rho > rho

    fresh = hessian(problem, end.rho) @ end.nu - problem.b + C.T @ end.mu
    assert end.g == pytest.approx(fresh, abs=rounding)


def test_rank_is_found_among_badly_scaled_rows():
    G = np.array([[1e8, 0, 0, 0], [1e-8, 1e-8, 0, 0], [1, 1, 0, 0]])
    rows = orthonormal_rows(G, G @ np.array([1.0, 2.0, 3.0, 4.0]))

    assert len(rows.C) == 2
    assert rows.consistent
    assert rows.x_tilde == pytest.approx([1, 2, 0, 0])


@pytest.mark.parametrize("seed", [271828, 314159, 161803])
def test_a_short_lanczos_process_bounds_the_norm_closely_from_above(seed):
    rng = np.random.default_rng(seed)
    W = rng.standard_normal((60, 60))
    H = W @ W.T
    norm = np.linalg.norm(H, 2)

    ritz = lanczos(H, rng.standard_normal(60), 12)
    distances = abs(np.linalg.eigvalsh(H)[:, None] - ritz.values).min(axis=0)

    assert norm * (1 - 1e-12) <= ritz.norm <= 1.25 * norm
    assert (distances <= ritz.residuals * (1 + 1e-9)).all()
    V = ritz.vectors  # empty if the first pair has not converged
    assert V @ V.T == pytest.approx(np.eye(len(V)), abs=1e-12)


def test_the_norm_of_a_low_rank_operator_ends_early():
    u = np.arange(1.0, 6.0)

    assert lanczos(np.outer(u, u), u + 1, 5).norm == pytest.approx(u @ u)


def test_inequality_rows_are_declined_with_an_alternative(manufactured):
    qp, _ = manufactured("inequalities")

    assert "no inequality rows" in SMALBE().declines(qp)


@pytest.mark.parametrize("exponent", [-30, 30])
def test_scaling_the_rows_changes_no_step(dual, exponent):
    qp, factor = dual(271828), 2.0**exponent
    scaled = replace(qp, A=qp.A * factor, b=qp.b * factor)
    plain, other = (SMALBE().prepare(p, 1e-8)() for p in (qp, scaled))

    assert other.counts == plain.counts
    assert (other.x == plain.x).all()


@pytest.mark.parametrize("shape", ["bounds", "box", "equalities", "some bounds"])
def test_random_planted_problems_are_solved_and_certified(manufactured, shape):
    """Every answer has small residuals and equals the planted solution."""
    for seed in range(1000, 1040):
        qp, planted_point = manufactured(shape, seed=seed, dense=seed % 2 == 0)
        s = SMALBE().prepare(qp, 1e-9)()

        assert s.status is Status.SOLVED, seed
        assert kkt_residuals(qp, s).worst <= 1e-8, seed
        assert s.x == pytest.approx(planted_point.x, abs=1e-6), seed


@pytest.mark.parametrize("expansion", ["model", "spectral"])
@pytest.mark.parametrize("preconditioner", ["none", "diagonal", "model", "sparse"])
def test_every_combination_of_rules_solves(
    manufactured, dual, expansion, preconditioner
):
    solver = SMALBE(expansion=expansion, preconditioner=preconditioner)
    dense = preconditioner == "sparse"
    for qp in (manufactured("box", seed=161803, dense=dense)[0], dual(161803)):
        s = solver.prepare(qp, 1e-8)()

        assert s.status is Status.SOLVED
        assert kkt_residuals(qp, s).worst <= 1e-7


@pytest.mark.parametrize(
    ("Nr", "Nh", "step", "half_of_permons_best"),
    [
        (4, 3, 1, (46, 56)), (4, 3, 10, (54, 73)),
        (12, 6, 5, (59, 84)), (12, 6, 10, (72, 103)), (12, 7, 10, (58, 87)),
        pytest.param(30, 15, 1, (57, 90), marks=pytest.mark.slow),
        pytest.param(30, 15, 5, (58, 91), marks=pytest.mark.slow),
        pytest.param(30, 15, 10, (67, 107), marks=pytest.mark.slow),
        pytest.param(60, 30, 5, (64, 105), marks=pytest.mark.slow),
    ],
)  # fmt: skip
def test_half_the_products_of_permons_best(Nr, Nh, step, half_of_permons_best):
    """The products of PERMON were measured on these QPs with its best setting at 1e-6
    and 1e-8; the stopping criterion is recomputed from the QP.
    """
    family = PROBLEMS["beam-ring"]
    configured = family.with_keys(Nr=Nr, Nh=Nh, step=step)
    qp = configured.build("dual", reference_solution).qp
    x_tilde = np.linalg.lstsq(qp.A, qp.b)[0]
    project = np.eye(qp.q.size) - np.linalg.pinv(qp.A) @ qp.A
    size = np.linalg.norm(project @ (qp.q + qp.P @ x_tilde))
    for tol, most in zip((1e-6, 1e-8), half_of_permons_best, strict=True):
        s = SMALBE().prepare(qp, tol)()
        slope = qp.P @ s.x + qp.q + qp.A.T @ s.y
        projected_gradient = np.where(s.x > qp.lb, slope, np.minimum(slope, 0))

        assert np.linalg.norm(projected_gradient) <= tol * size
        assert np.linalg.norm(qp.A @ s.x - qp.b) <= tol * np.linalg.norm(qp.b)
        assert s.counts["P_products"] <= most


@pytest.mark.parametrize("tol", [1e-2, 1e-4, 1e-6])
def test_the_residual_of_the_original_problem_decides(dual, tol):
    """The residual of the projected problem may be smaller."""
    for seed in range(2000, 2020):
        qp = dual(seed)
        for name in ("smalbe", "smalbe-permon"):
            s = SOLVERS[name].prepare(qp, tol)()

            assert s.status is Status.SOLVED
            assert relative_residual(qp, s, tol) <= tol * (1 + 1e-9)


def test_an_inner_run_ends_at_eta_at_the_latest(outer_loop, dual):
    """M is so large that only η stops the inner run."""
    problem = projected(dual(271828))
    loose, tight = (
        outer_loop(problem, M=1e9, eta=eta).outer[0].trace for eta in (0.5, 1e-4)
    )

    assert len(loose) < len(tight)


def test_steps_and_outer_iterations_together_count_for_the_limit(dual):
    s = SMALBE(max_steps=30, rho=1e-3).prepare(dual(271828), 1e-10)()

    assert s.status is Status.ITERATION_LIMIT
    assert s.iterations > 0
    assert s.iterations + s.counts["outer"] <= 31
    assert s.message == "step limit"


def mixed(P, q, lb, ub, A, b):
    return bounded(P, q, A, b, lb=np.asarray(lb), ub=np.asarray(ub))


@pytest.mark.parametrize(
    "qp",
    [
        mixed(np.diag([7e-4, 2e-3, 37, 405]), [-0.25, 1.37, -0.61, 1.79], 0.0, np.inf,
              [[8.9, 1166, 0, 0.53], [26, 150, 0.015, 3.3]], [0, 0]),
        mixed(np.diag([5.5, 0.77, 0.054]), [-0.955, 0.604, -6.2e-4], 0.0, np.inf,
              [[0.007, 0.69, 0.082]], [0]),
        mixed(np.diag([1, 1e-5]), [0, 0], -np.inf, np.inf, [[1, 1]], [1]),
        mixed(np.eye(3), [1, -1, 1], [0, 0, -np.inf], np.inf, [[1, 1, 1e-6]], [1]),
        mixed(np.diag([0.4, 5.8]), [-1, -0.8], 0.0, np.inf,
              [[1.04, -0.06], [-1.25, 0.75]], [0.4298, -0.32]),
    ],
    ids=["x = 0 is the answer", "x = 0, positive row", "a first residual of 1e-2",
         "an entry of 1e-6 for the free variable", "as many rows as variables"],
)  # fmt: skip
def test_earlier_failures_do_not_recur(qp):
    s = SOLVERS["smalbe"].prepare(qp, 1e-6)()

    assert s.status is Status.SOLVED
    assert relative_residual(qp, s, 1e-6) <= 5e-6
    assert s.counts["P_products"] <= 100


def test_two_distinct_eigenvalues_are_known_after_two_lanczos_steps():
    """The large eigenvalue must be among the Ritz values and not in the tail of the
    model.
    """
    rng = np.random.default_rng(28)
    v, A, x = rng.standard_normal(8), rng.standard_normal((1, 8)), rng.random(8)
    P = np.eye(8) + 1e6 * np.outer(v, v) / (v @ v)
    s = SMALBE().prepare(bounded(P, rng.standard_normal(8), A, A @ x, lb=0.0), 1e-8)()

    assert s.status is Status.SOLVED
    assert s.counts["P_products"] <= 40


@pytest.mark.parametrize("name", INHOUSE)
def test_a_large_box_with_a_far_feasible_point_is_not_called_infeasible(name):
    """(0, 10⁷) satisfies x₁ + 10⁻⁷x₂ = 1, x₁ ≤ ½."""
    qp = mixed(np.eye(2), [0, 0], 0.0, [0.5, 2e7], [[1, 1e-7]], [1])

    assert SOLVERS[name].prepare(qp, 1e-8)().status is not Status.INFEASIBLE


@pytest.mark.parametrize("rows", [1, 2])
@pytest.mark.parametrize("seed", range(10))
def test_a_box_whose_only_feasible_point_is_a_corner_is_not_called_infeasible(
    rows, seed
):
    """This holds even if the search is cut short, because Ax − b then consists of
    rounding errors.
    """
    rng = np.random.default_rng(seed)
    A, lb = rng.uniform(0.1, 1, (rows, 6)), rng.standard_normal(6)
    W = rng.standard_normal((6, 6))
    qp = bounded(W @ W.T, rng.standard_normal(6), A, A @ lb, lb, lb + 1)
    claims = {SMALBE(max_steps=k).prepare(qp, 1e-8)().status for k in (1, 2, 3, 50)}

    assert claims <= {Status.ITERATION_LIMIT, Status.SOLVED}
