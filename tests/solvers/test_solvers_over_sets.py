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
#: square root of the gap. At their smallest tolerance, this is the largest error in x.
ENDS_OFF_PATH = {"clarabel": 1e-5, "qoco": 1e-4, "ecos": 1e-5}


def error_in_x(name, qp, s, expected):
    """Return max|x − x*|, at the smallest tolerance if that is not small."""
    off = np.abs(s.x - expected.x).max()
    if off > 1e-6:
        s = measure(SOLVERS[name], qp, TIGHT).solution
        off = min(off, np.abs(s.x - expected.x).max())
    return off


def faults(name, shape, seeds):
    """List the seeds where f is off by more than 1e-8, or x by more than 1e-6."""
    wrong, declined = [], []
    for seed in seeds:
        qp, expected = manufactured_over_sets(shape, seed=seed)
        s = measure(SOLVERS[name], qp, TOL).solution
        if s.status is Status.DECLINED:
            declined.append((seed, s.message))
            continue
        f, best = qp.objective(s.x), qp.objective(expected.x)
        verdict = judged(s.status, kkt_residuals(qp, s), TOL)
        off = error_in_x(name, qp, s, expected)
        if not (
            verdict is Verdict.VERIFIED
            and abs(f - best) <= 1e-8 * abs(best)
            and off <= ENDS_OFF_PATH.get(name, 1e-6)
        ):
            wrong.append((seed, str(verdict), abs(f / best - 1), off, s.message))
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
