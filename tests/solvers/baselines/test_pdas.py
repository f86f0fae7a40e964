"""Primal-dual active sets: iterates, safeguards and certificates."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.sparse import csr_array
from scipy.sparse.linalg import aslinearoperator

from mortarbench.harness import QP, Status
from mortarbench.harness.names import parse
from mortarbench.harness.verify.kkt import kkt_residuals
from mortarbench.problems import PROBLEMS
from mortarbench.solvers.baselines.pdas import PDAS
from mortarbench.solvers.common.infeasibility_certificate import (
    proves_infeasible,
    proves_unbounded,
)
from mortarbench.solvers.reference.solve import reference_solution
from tests.support.small_qps import floating_dual


def solve(qp, tol=1e-9):
    return PDAS().prepare(qp, tol)()


#: the plain method cycles through three active sets
CYCLES = {
    "n = 3": ([[13, 11, -9], [11, 11, -6], [-9, -6, 10]], [4, 1, -5]),
    "n = 4": (
        [[9, 13, -8, -3], [13, 26, -20, -4], [-8, -20, 18, 3], [-3, -4, 3, 11]],
        [1, 4, -4, -3],
    ),
}


@pytest.fixture(params=CYCLES.values(), ids=CYCLES)
def cycling(request):
    return QP.from_arrays(*request.param, lb=0.0)


def test_the_two_sided_box_is_crossed_in_three_solves():
    """The iterates are 0 at the lower bound, the free minimum 10, and the
    upper bound.
    """
    s = solve(QP.from_arrays([[1.0]], [-10.0], lb=0.0, ub=1.0))

    assert s.x == 1
    assert s.z_box == pytest.approx([9])
    assert s.iterations == s.counts["factorisations"] == 3
    assert s.counts["set_changes"] == 2


def test_separate_variables_settle_after_one_change_each():
    qp = QP.from_arrays(np.diag([1.0, 2, 4, 1]), [-1.0, -4, 8, 3], lb=0.0)
    s = solve(qp)

    assert s.x == pytest.approx([1, 2, 0, 0], abs=1e-8)
    assert s.z_box == pytest.approx([0, 0, -8, -3], abs=1e-8)
    assert s.counts["set_changes"] == 2
    assert s.counts["factorisations"] == 2


def test_violated_contact_rows_are_added():
    """For min ½‖x‖² − x₁ − 2x₂ with x₁ ≤ 0.5, x₂ ≤ 3, no row is active in the first
    iterate, and the first row is active in the second iterate.
    """
    qp = QP.from_arrays(np.eye(2), [-1.0, -2], G=np.eye(2), h=[0.5, 3.0])
    s = solve(qp)

    assert s.x == pytest.approx([0.5, 2])
    assert s.z == pytest.approx([0.5, 0])
    assert s.counts["set_changes"] == 1
    assert s.counts["factorisations"] == 2


def test_a_row_whose_only_free_variable_is_stiff_gets_a_larger_weight():
    """x₁ is at its bound. With the weight of the soft x₁, x₂ would not converge."""
    qp = QP.from_arrays(
        np.diag([1.0, 1e8]), [1.0, 0], A=[[1, 1]], b=[1.0], ub=[0.0, np.inf]
    )
    s = solve(qp)

    assert s.status is Status.SOLVED
    assert s.x == pytest.approx([0, 1], abs=1e-9)
    assert s.y == pytest.approx([-1e8])


def test_single_exchanges_break_a_cycle(cycling):
    s = solve(cycling)
    exact = reference_solution(cycling)

    assert s.status is Status.SOLVED
    assert s.counts["exchanges"] > 0
    assert s.x == pytest.approx(exact.x, abs=1e-7)


def test_the_step_limit_is_reported_with_the_point_reached(cycling):
    s = PDAS(max_iter=5).prepare(cycling, 1e-9)()

    assert s.status is Status.ITERATION_LIMIT
    assert s.iterations == 5
    assert s.message == "step limit"


@pytest.mark.parametrize("exponent", [-30, 30])
@pytest.mark.parametrize("seed", [271828, 314159])
def test_scaling_objective_or_rows_changes_no_counter(seed, exponent):
    """The factors are powers of two, so that the arithmetic is exact."""
    qp, factor = floating_dual(seed), 2.0**exponent
    plain = solve(qp)
    for scaled in (
        replace(qp, P=qp.P * factor, q=qp.q * factor),
        replace(qp, A=qp.A * factor, b=qp.b * factor),
    ):
        s = solve(scaled)
        assert s.counts == plain.counts
        assert s.iterations == plain.iterations
        assert (s.x == plain.x).all()


@pytest.mark.parametrize("store", [np.asarray, csr_array], ids=["dense", "sparse"])
def test_an_unbounded_objective_is_reported(store):
    qp = QP.from_arrays(store([[1, 0], [0, 0]]), [1, -1], lb=0)
    s = solve(qp)

    assert s.status is Status.UNBOUNDED
    assert "unbounded below" in s.message


def test_an_indefinite_P_is_a_failure():
    qp = QP.from_arrays(np.eye(2), [1, 1])
    s = solve(replace(qp, P=np.array([[1.0, 2], [2, 1]])))

    assert s.status is Status.FAILED
    assert "not positive semidefinite" in s.message


@pytest.mark.parametrize("store", [np.asarray, csr_array])
@pytest.mark.parametrize("repeats", [1, 20_000])
def test_a_linear_program_is_not_called_indefinite(store, repeats):
    """max x₁ + x₂ with x₁ + x₂ ≤ 1, x ≥ 0. Repeated rows add up their penalties."""
    qp = QP.from_arrays(
        store(np.zeros((2, 2))), [-1, -1], G=store(np.ones((repeats, 2))),
        h=np.ones(repeats), lb=0,
    )  # fmt: skip
    s = solve(qp)

    assert "semidefinite" not in s.message
    assert s.status is Status.FAILED or qp.objective(s.x) == pytest.approx(-1)
    assert repeats > 1 or s.status is Status.SOLVED


def test_without_an_objective_a_feasible_point_is_found():
    rng = np.random.default_rng(0)
    A = rng.standard_normal((2, 3))
    qp = QP.from_arrays(
        np.zeros((3, 3)), np.zeros(3), A=A, b=A @ rng.random(3), lb=0, ub=1
    )
    s = solve(qp)

    assert s.status is Status.SOLVED
    assert A @ s.x == pytest.approx(qp.b)
    assert (s.x >= 0).all()
    assert (s.x <= 1).all()


def test_a_certificate_must_hold():
    qp = QP.from_arrays(np.eye(2), [0.0, 0], A=[[1, 1]], b=[-1.0], lb=0.0)
    feasible = replace(qp, b=np.array([1.0]))
    y, none = np.array([1.0]), np.zeros(0)

    assert proves_infeasible(qp, y, none)
    assert not proves_infeasible(qp, -y, none)
    assert not proves_infeasible(feasible, y, none)
    assert not proves_infeasible(replace(qp, lb=np.array([0, -np.inf])), y, none)


def test_a_direction_of_descent_must_be_free_of_curvature_and_constraints():
    qp = QP.from_arrays(np.diag([1.0, 0]), [-1.0, -1], lb=0.0)
    down = np.array([0.0, 1])

    assert proves_unbounded(qp, down)
    assert not proves_unbounded(qp, -down)
    assert not proves_unbounded(replace(qp, q=np.array([-1.0, 1])), down)
    assert not proves_unbounded(qp, np.array([1.0, 0]))
    assert not proves_unbounded(replace(qp, ub=np.full(2, 5.0)), down)
    row = replace(qp, A=np.array([[0.0, 1]]), b=np.zeros(1))
    assert not proves_unbounded(row, down)


def test_a_sequence_starts_from_the_last_active_set():
    qp = floating_dual(271828)
    prepare = PDAS().chain(1e-9)
    cold, warm = prepare(qp)(), prepare(replace(qp, q=1.0001 * qp.q))()

    assert cold.counts["set_changes"] > 0
    assert "set_changes" not in warm.counts
    assert kkt_residuals(replace(qp, q=1.0001 * qp.q), warm).worst <= 5e-9


def test_a_sequence_continues_after_a_problem_of_another_size():
    prepare = PDAS().chain(1e-9)
    for n in (30, 20, 30):
        assert prepare(floating_dual(271828, n))().status is Status.SOLVED


def test_an_operator_is_declined():
    qp = floating_dual(271828)
    operator = replace(qp, P=aslinearoperator(qp.P))
    assert PDAS().declines(operator) == "needs explicit matrices"


def test_the_forms_of_a_contact_problem_agree():
    """The displacements and the multipliers of contact rows equal those of the
    reference.
    """
    forms = ("dual-bounds", "dual", "primal")
    names = [parse(f"beam-ring/Nr=4/Nh=3/step=7/{form}", PROBLEMS) for form in forms]
    cases = [n.build(reference_solution) for n in names]
    exact = reference_solution(cases[0].qp)
    u = cases[0].recover(exact)
    contact = exact.x.size
    for case in cases:
        s = PDAS().prepare(case.qp, 1e-10)()
        multipliers = s.z if s.z.size else s.x[-contact:]
        assert s.status is Status.SOLVED
        assert multipliers == pytest.approx(exact.x, abs=1e-7 * exact.x.max())
        assert case.recover(s) == pytest.approx(u, abs=1e-7 * np.abs(u).max())
