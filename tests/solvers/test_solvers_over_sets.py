"""Every solver that accepts discs or cones finds planted solutions over them."""

import numpy as np
import pytest

from mortarbench.harness import Box, Cones, Discs, Status, Verdict, kkt_residuals
from mortarbench.harness import verdict as judged
from mortarbench.harness.conformance.manufactured import (
    SET_SHAPES,
    manufactured_over_sets,
)
from mortarbench.harness.verify.measure import measure
from mortarbench.solvers import SOLVERS

TOL, TIGHT = 1e-9, 1e-12
ACCEPTS = {
    name: getattr(solver, "accepts", (Box,))
    for name, solver in SOLVERS.items()
}  # fmt: skip
PAIRS = [
    (name, shape)
    for name, accepted in ACCEPTS.items()
    for shape in SET_SHAPES
    if ("discs" not in shape or Discs in accepted)
    and ("cones" not in shape or Cones in accepted)
]


#: Interior-point methods end off the central path: z and x differ in direction by the
#: square root of the gap. These are the largest errors in x at their smallest
#: tolerance, about twice the largest of 1250 QPs.
ENDS_OFF_PATH = {"clarabel": 1e-4, "qoco": 3e-4, "cvxopt": 5e-6, "ecos": 1e-4}


def faults(name, shape, seeds):
    """List the seeds where f is off by more than 1e-8, or x by more than 1e-6.

    If so at `TOL`, the better error at `TIGHT` counts, whatever is claimed there.
    """
    wrong, declined = [], []
    limits = np.array([1e-8, ENDS_OFF_PATH.get(name, 1e-6)])
    for seed in seeds:
        qp, expected = manufactured_over_sets(shape, seed=seed)
        best = qp.objective(expected.x)

        def solved(tol, qp=qp, expected=expected, best=best):
            s = measure(SOLVERS[name], qp, tol).solution
            off = abs(qp.objective(s.x) / best - 1), np.abs(s.x - expected.x).max()
            return s, np.array(off)

        s, errors = solved(TOL)
        if s.status is Status.DECLINED:
            declined.append((seed, s.message))
            continue
        verdict = judged(s.status, kkt_residuals(qp, s), TOL)
        if not (errors <= [1e-8, 1e-6]).all():
            errors = np.fmin(errors, solved(TIGHT)[1])
        if verdict is not Verdict.VERIFIED or not (errors <= limits).all():
            wrong.append((seed, str(verdict), *errors, s.message))
    return wrong, declined


def accepts_rows(name, shape, declined, count):
    """Skip a solver that declines a shape as a whole, such as for its rows."""
    if len(declined) == count:
        pytest.skip(f"{name} declines {shape}: {declined[0][1]}")
    assert not declined


@pytest.mark.parametrize(("name", "shape"), PAIRS)
def test_planted_solutions_over_sets_are_found(name, shape):
    wrong, declined = faults(name, shape, range(3))
    accepts_rows(name, shape, declined, 3)
    assert not wrong


@pytest.mark.slow
@pytest.mark.parametrize(("name", "shape"), PAIRS)
def test_five_hundred_planted_solutions_over_sets_are_found(name, shape):
    """250 of each shape: 500 over discs, 500 over cones, and 250 over both."""
    wrong, declined = faults(name, shape, range(250))
    accepts_rows(name, shape, declined, 250)
    assert not wrong
