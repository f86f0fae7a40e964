"""Primal-dual active sets with multigrid agree with those that use Cholesky factors."""

import numpy as np
import pytest

import mortarbench as mb
from mortarbench.harness import Status
from mortarbench.solvers.baselines import multigrid
from mortarbench.solvers.baselines.pdas import PDAS
from mortarbench.solvers.baselines.pdas_amg import PDASAMG


@pytest.mark.parametrize(
    "case",
    [
        "cube-wall/n=4/primal",
        pytest.param("beam-ring/Nr=4/Nh=3/steps=1/primal", marks=pytest.mark.slow),
    ],
)
def test_multigrid_and_factors_find_the_same_displacements(case):
    qp = mb.build(case).qp
    amg, direct = (s.prepare(qp, 1e-8)() for s in (PDASAMG(), PDAS()))

    assert mb.verify(qp, amg.x, amg.y, amg.z, amg.z_box, tol=1e-8).verdict == "verified"
    assert np.abs(amg.x - direct.x).max() < 1e-6 * np.abs(direct.x).max()
    assert amg.iterations == direct.iterations
    assert amg.counts["cg"] > amg.iterations


def test_steps_in_space_hardly_grow_with_the_size():
    """With 8 times as many cells, an iteration takes on average less than 1.5 times as
    many CG steps.
    """
    steps = []
    for n in (5, 10):
        s = PDASAMG().prepare(mb.build(f"cube-wall/n={n}/primal").qp, 1e-6)()
        steps.append(s.counts["cg"] / s.iterations)
    assert steps[1] < 1.5 * steps[0]


def test_dense_problems_are_declined():
    reason = PDASAMG().declines(mb.build("cube-wall/n=2/dual").qp)
    assert reason == "P is dense, but multigrid needs a sparse matrix"


def test_conjugate_gradients_that_do_not_converge_end_the_solve(monkeypatch):
    monkeypatch.setattr(multigrid, "MAX_CG", 1)
    s = PDASAMG().prepare(mb.build("cube-wall/n=4/primal").qp, 1e-8)()
    assert (s.status, s.message) == (Status.FAILED, "no convergence in 1 steps of CG")
