"""Interior points with filtered multigrid: answers, and steps per linear solve."""

from collections import Counter
from dataclasses import replace

import numpy as np
import pytest
from scipy.sparse import csr_array

import mortarbench as mb
from mortarbench.harness import Status
from mortarbench.solvers.baselines import ipm_amg
from mortarbench.solvers.baselines.ipm_amg import IPMAMG
from mortarbench.solvers.baselines.pdas import PDAS


@pytest.mark.parametrize(
    "case",
    [
        "cube-wall/n=4/primal",
        "beam-ring/Nr=2/Nh=2/steps=1/primal",
        *(
            pytest.param(case, marks=pytest.mark.slow)
            for case in (
                "beam-ring/Nr=8/Nh=6/steps=1/primal",
                "contact-patch/dim=3/ratio=100/primal",
                "hertz-sphere/n=3/primal",
                "journal-bearing/primal",
            )
        ),
    ],
)
def test_interior_points_and_active_sets_find_the_same_displacements(case):
    qp = mb.build(case).qp
    interior, active = (s.prepare(qp, 1e-8)() for s in (IPMAMG(), PDAS()))

    answer = (interior.x, interior.y, interior.z, interior.z_box)
    assert mb.verify(qp, *answer, tol=1e-8).verdict == "verified"
    assert np.abs(interior.x - active.x).max() < 1e-5 * np.abs(active.x).max()
    assert interior.counts["factorisations"] == interior.iterations + 1


SPHERES = "hertz-sphere/n=2/against=sphere/primal"  # each row couples two bodies


def steps(case, weights, **change):
    """Return the number of CG steps that reduce a residual by 1e8.

    weights : function of the number of inequality rows that returns W
    change : changed attributes of the `Problem`
    """
    problem = replace(ipm_amg._scale(mb.build(case).qp), **change)
    counts = Counter()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(ipm_amg, "CG_RTOL", 1e-8)
        solve = ipm_amg._solver(problem, weights(problem.d.size), 0.0, counts)
        solve(np.random.default_rng(3).normal(size=problem.D.size))
    return counts["cg"]


def late(rows):
    """Return weights near the solution: large at active rows, small at others."""
    return np.where(np.arange(rows) % 3 == 0, 1e8, 1e-8)


def test_the_filter_solves_for_large_and_small_weights_of_rows():
    """Multigrid alone takes ten times as many CG steps as with the filter."""
    filtered = steps(SPHERES, late)
    assert filtered <= 1.3 * steps(SPHERES, np.ones)
    assert steps(SPHERES, late, filter=np.zeros(0, dtype=int)) > 10 * filtered


def test_steps_in_space_hardly_grow_with_the_size():
    """With 8 times as many cells, a solve takes at most 1.6 times as many CG steps."""
    small, large = (f"cube-wall/n={n}/primal" for n in (5, 10))
    assert steps(large, late) <= 1.6 * steps(small, late)


def test_iterations_do_not_depend_on_the_units():
    """Lengths in mm and forces in GN change no iteration."""
    qp = mb.build("cube-wall/n=3/primal").qp
    scaled = mb.QP.from_arrays(
        1e-12 * qp.P, 1e-9 * qp.q, A=qp.A, b=1e3 * qp.b, G=qp.G, h=1e3 * qp.h
    )  # fmt: skip
    one, other = (IPMAMG().prepare(p, 1e-8)() for p in (qp, scaled))
    assert one.iterations == other.iterations
    assert other.x == pytest.approx(1e3 * one.x, rel=1e-6, abs=1e-9)


def test_an_infeasible_problem_ends_without_a_claim():
    qp = mb.QP.from_arrays(
        csr_array([[1.0, 0.0], [0.0, 1.0]]), [0, 0], G=[[1, 1], [-1, -1]], h=[-1, -1]
    )
    assert IPMAMG().prepare(qp, 1e-8)().status is Status.ITERATION_LIMIT


def test_the_limit_of_iterations_is_named_in_the_message():
    s = IPMAMG(max_iter=1).prepare(mb.build("cube-wall/n=2/primal").qp, 1e-8)()
    assert s.status is Status.ITERATION_LIMIT
    assert s.message.startswith("step limit")


def test_conjugate_gradients_that_do_not_converge_end_the_solve(monkeypatch):
    monkeypatch.setattr(ipm_amg, "MAX_CG", 1)
    s = IPMAMG().prepare(mb.build("cube-wall/n=4/primal").qp, 1e-8)()
    assert (s.status, s.message) == (Status.FAILED, "no convergence in 1 steps of CG")


def test_dense_problems_are_declined():
    reason = IPMAMG().declines(mb.build("cube-wall/n=2/dual").qp)
    assert reason == "P is dense, but multigrid needs a sparse matrix"
