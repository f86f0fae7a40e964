"""Sequences: warm starts take fewer products or iterations to the same answers."""

from dataclasses import replace

import numpy as np
import pytest

from mortarbench.harness import Status
from mortarbench.harness.verify.kkt import kkt_residuals
from mortarbench.problems import PROBLEMS
from mortarbench.solvers import SOLVERS
from mortarbench.solvers.reference.solve import reference_solution
from mortarbench.solvers.smalbe.solver import SMALBE

pytestmark = pytest.mark.together


@pytest.fixture(scope="module")
def load_steps():
    family = PROBLEMS["beam-ring"]

    def build(form):
        return [
            family.with_keys(Nr=4, Nh=3, step=k).build(form, reference_solution).qp
            for k in range(1, 11)
        ]

    return {form: build(form) for form in ("primal", "dual", "dual-bounds")}


@pytest.mark.parametrize(("form", "share"), [("dual", 0.8), ("dual-bounds", 0.9)])
def test_every_step_is_solved_and_warm_is_cheaper(load_steps, form, share):
    solver, tol = SMALBE(), 1e-8
    prepare = solver.chain(tol)
    warm = [prepare(qp)() for qp in load_steps[form]]
    cold = [solver.prepare(qp, tol)() for qp in load_steps[form]]

    def products(solutions):
        return sum(s.counts["P_products"] for s in solutions[1:])

    for qp, s in zip(load_steps[form], warm, strict=True):
        assert s.status is Status.SOLVED
        assert kkt_residuals(qp, s).worst <= 10 * tol
    assert products(warm) <= share * products(cold)


def test_steps_without_common_data_are_solved(load_steps, manufactured):
    """The QPs differ in size, scale and sign, and one of them is infeasible."""
    qp, other = load_steps["dual"][9], load_steps["dual"][0]
    box, _ = manufactured("box", seed=271828)
    impossible = replace(qp, A=np.vstack([qp.A, qp.A[:1]]), b=np.append(qp.b, 1e3))
    sequence = [qp, box, qp, replace(qp, P=1e6 * qp.P, q=1e6 * qp.q), other, impossible]
    sequence += [replace(qp, P=1e-6 * qp.P), replace(qp, q=-qp.q), qp]
    prepare = SMALBE().chain(1e-6)
    found = [prepare(qp)() for qp in sequence]

    for qp, s in zip(sequence, found, strict=True):
        if qp is impossible:
            assert s.status is Status.INFEASIBLE
        else:
            assert s.status is Status.SOLVED
            assert kkt_residuals(qp, s).worst <= 1e-5


def test_sequences_are_independent_of_each_other(load_steps):
    qps = load_steps["dual-bounds"][:3]
    solver = SMALBE()
    one, two = solver.chain(1e-8), solver.chain(1e-8)
    alternating = [(one(qp)().counts, two(qp)().counts) for qp in qps]
    alone = solver.chain(1e-8)

    assert [a for a, _ in alternating] == [alone(qp)().counts for qp in qps]
    assert all(a == b for a, b in alternating)


class Counting:
    """A matrix P that counts its products."""

    def __init__(self, P, calls):
        self.P, self.calls, self.shape = P, calls, P.shape

    def __matmul__(self, v):
        self.calls.append(v)
        return self.P @ v


def test_every_product_of_a_sequence_is_counted(load_steps):
    """The products of a spectrum that turns out to be outdated are included."""
    qps = load_steps["dual"]
    steps = [*qps[:3], replace(qps[3], P=1e3 * qps[3].P), qps[4], *qps[4:6]]
    prepare = SMALBE().chain(1e-6)
    for qp in steps:
        calls = []
        s = prepare(replace(qp, P=Counting(qp.P, calls)))()

        assert s.counts["P_products"] == len(calls)


@pytest.mark.parametrize("jump", [1e2, 1e4])
def test_a_spectrum_orthogonal_to_the_last_solution_is_detected(manufactured, jump):
    """P = I is followed by a far larger P that agrees with I on the first component."""
    rng = np.random.default_rng(271828)
    qp, _ = manufactured("bounds", seed=271828, dense=True)
    W = rng.standard_normal((20, 20))
    W[:, 0] = 0
    first = replace(qp, P=np.eye(20), q=-np.eye(20)[0], lb=np.zeros(20))
    then = replace(first, P=np.eye(20) + jump * W.T @ W / 20)
    solver = SMALBE()
    prepare = solver.chain(1e-8)
    prepare(first)()
    s = prepare(then)()
    cold = solver.prepare(then, 1e-8)()

    assert s.status is Status.SOLVED
    assert s.counts["P_products"] <= 2 * cold.counts["P_products"]


def test_a_failure_does_not_affect_the_next_solve(load_steps):
    qp = load_steps["dual"][0]
    broken = replace(qp, A=np.vstack([qp.A, qp.A[:1]]), b=np.append(qp.b, 1e3))
    prepare = SMALBE().chain(1e-8)
    counts = [prepare(q)().counts for q in (qp, broken, qp)]

    assert counts[2] == counts[0]


@pytest.mark.parametrize(("form", "tol"), [("dual", 1e-4), ("dual-bounds", 1e-8)])
def test_qtqp_starts_each_load_step_from_the_last(load_steps, form, tol):
    """Answers meet the same tolerance as from cold starts, with at most nine tenths of
    the iterations.
    """
    solver = SOLVERS["qtqp"]
    prepare = solver.chain(tol)
    warm = [prepare(qp)() for qp in load_steps[form]]
    cold = [solver.prepare(qp, tol)() for qp in load_steps[form]]

    for qp, one, other in zip(load_steps[form], warm, cold, strict=True):
        assert one.status is other.status is Status.SOLVED
        assert kkt_residuals(qp, one).worst <= 10 * tol
        assert kkt_residuals(qp, other).worst <= 10 * tol
    assert [s.counts.get("accepted_starts") for s in warm] == [None] + 9 * [1]
    assert warm[0].iterations == cold[0].iterations
    assert sum(s.iterations for s in warm) <= 0.9 * sum(s.iterations for s in cold)


@pytest.mark.parametrize("form", ["primal", "dual", "dual-bounds"])
def test_qtqp_stops_at_a_start_that_is_the_solution(load_steps, form):
    qp = load_steps[form][9]
    prepare = SOLVERS["qtqp"].chain(1e-6)
    first, second = prepare(qp)(), prepare(qp)()

    assert second.iterations == 0 < first.iterations
    assert kkt_residuals(qp, second).worst <= 1e-5


def test_qtqp_starts_cold_after_a_qp_of_another_shape_or_without_a_solution(load_steps):
    qp, other = load_steps["dual"][9], load_steps["dual-bounds"][9]
    impossible = replace(qp, A=np.vstack([qp.A, qp.A[:1]]), b=np.append(qp.b, 1e3))
    prepare = SOLVERS["qtqp"].chain(1e-6)
    solutions = [prepare(each)() for each in (other, qp, impossible, qp)]

    cold = SOLVERS["qtqp"].prepare(qp, 1e-6)()
    assert all("accepted_starts" not in s.counts for s in solutions)
    assert solutions[1].iterations == solutions[3].iterations == cold.iterations
    np.testing.assert_array_equal(solutions[3].x, cold.x)
