"""The compiled conjugate gradient steps against MPRGP as it is written."""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest

from harness import Status
from problems import PROBLEMS
from solvers import SOLVERS
from solvers.reference.solve import reference_solution
from solvers.smalbe import face_run as facerun
from solvers.smalbe.face_run import face_run
from solvers.smalbe.mprgp import Point, Rules, mprgp, split
from solvers.smalbe.outer_loop import Until
from solvers.smalbe.projected import by_lanczos, projected_problem


@pytest.fixture(scope="module", params=["dual", "dual-bounds"])
def qp(request):
    family = PROBLEMS["beam-ring"]
    params = family.complete(dict(Nr=4, Nh=3))
    return family.build(request.param, params, reference_solution).qp


def projected(qp):
    return projected_problem(qp, partial(by_lanczos, steps=12))


@pytest.mark.parametrize("n", [1, 3, 4, 7, 30])
def test_the_compiled_product_reads_a_symmetric_matrix_rightly(n):
    W = np.random.default_rng(n).standard_normal((n, n))
    v = np.arange(1.0, n + 1)

    assert facerun._symmetric(W + W.T, v) == pytest.approx((W + W.T) @ v, rel=1e-12)


def test_the_compiled_operator_is_the_operator(qp):
    problem = projected(qp)
    v = np.random.default_rng(271828).standard_normal(qp.q.size)
    C, inverse_norm = problem.rows.C, 1 / problem.spectrum.norm

    compiled = facerun._operator(qp.P, C, inverse_norm, 1e4, v)
    assert compiled == pytest.approx(problem.H(v, 1e4), rel=1e-9, abs=1e-9)


def test_the_compiled_preconditioner_is_the_inverse_in_the_face(qp):
    model = projected(qp).model(1e4)
    rng = np.random.default_rng(271828)
    free = rng.random(qp.q.size) < 0.7
    v = np.where(free, rng.standard_normal(qp.q.size), 0)
    U, core = model.core_in(free)

    compiled = facerun._preconditioned(v, U, core, model.tau)
    assert compiled == pytest.approx(model.inverse_in(free)(v), rel=1e-9, abs=1e-9)


@pytest.mark.parametrize("preconditioner", ["model", "none"])
@pytest.mark.parametrize("expansion", ["model", "mixed", "std"])
def test_compiled_steps_take_the_path_that_is_written(qp, preconditioner, expansion):
    """Letter for letter, with the same number of products, for twenty steps (later,
    without a preconditioner, the rounding of either is far from that of the other)."""
    rules = Rules(1.0, expansion, "cg")
    runs = []
    for compiled in (False, True):
        problem = projected(qp)
        with_model = preconditioner == "model"
        plain = problem.plain_model(1.0, alpha=1.9)
        B = problem.model(1.0) if expansion == "model" else plain
        lower, b = problem.bounds[0], problem.b
        x = np.maximum(-problem.rows.x_tilde, lower)
        stop = 1e-5 * np.linalg.norm(b)
        run = face_run(qp.P, problem, rules, problem.model if with_model else None)
        steps = mprgp(
            partial(problem.H, rho=1.0), b, problem.bounds,
            (x, problem.H(x, 1.0) - b),
            B=B, rules=rules,
            stop=lambda at, face, stop=stop: face.projected_norm <= stop,
            precondition=problem.model(1.0).inverse_in if with_model else None,
            run=run(1.0, Until(stop, 0.0, 0.0)) if compiled else None, max_steps=20,
        )  # fmt: skip
        runs.append((steps, problem.counts["P_products"]))
    (written, products), (compiled, also_products) = runs

    assert compiled.trace == written.trace
    assert also_products == products
    assert compiled.x == pytest.approx(written.x, abs=1e-9)
    assert compiled.g == pytest.approx(written.g, abs=1e-9)
    assert written.trace.count("c") > 1


@pytest.mark.parametrize(
    ("name", "apart"), [("smalbe", 0), ("smalbe-permon", 8), ("smalbe-espreso", 8)]
)
def test_a_solver_that_keeps_a_history_takes_the_same_steps(qp, name, apart):
    """Those are not compiled. Without a preconditioner rounding may cost a few."""
    fast = SOLVERS[name].prepare(qp, 1e-6)()
    slow = replace(SOLVERS[name], history=True).prepare(qp, 1e-6)()

    assert fast.status is Status.SOLVED
    assert abs(fast.counts["P_products"] - slow.counts["P_products"]) <= apart
    assert qp.objective(fast.x) == pytest.approx(qp.objective(slow.x), rel=1e-4)


@pytest.fixture
def unbounded(qp):
    """Every CG step is feasible, and no bound is ever met."""
    return projected(replace(qp, lb=np.full(qp.q.size, -np.inf)))


def test_as_many_steps_as_asked_for(qp, unbounded):
    x = np.ones(qp.q.size)
    at = Point(x, unbounded.H(x, 1.0) - unbounded.b)
    face = split(at, unbounded.bounds)
    run = face_run(qp.P, unbounded, Rules(), None)(1.0, Until(0.0, 0.0, 0.0))
    before = unbounded.counts["P_products"]

    _, _, Hp, steps = run(at, face.phi, face, 1.0, 3)
    assert (steps, Hp) == (3, None)
    assert unbounded.counts["P_products"] == before + 3


def test_the_end_is_asked_for_below_small_and_below_coarse_where_rows_allow(
    qp, unbounded
):
    """‖g^P‖ < M‖Cν‖ counts only if ‖g^P‖ < coarse, and only with rows."""
    x = np.ones(qp.q.size)
    at = Point(x, unbounded.H(x, 1e-3) - unbounded.b)
    face = split(at, unbounded.bounds)

    def steps(*until):
        run = face_run(qp.P, unbounded, Rules(), None)(1e-3, Until(*until))
        return run(at, face.phi, face, 1.0, 5)[3]

    assert steps(1e9, 0.0, 0.0) == 1
    assert steps(0.0, 0.0, 1e9) == 5
    assert steps(0.0, 1e9, 1e9) == (1 if len(unbounded.rows.C) else 5)
