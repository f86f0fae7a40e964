"""Every solver that accepts discs or cones finds planted solutions."""

import gc

import numpy as np
import pytest

from mortarbench.harness import Box, Cones, Discs, Status, Verdict
from mortarbench.harness import verdict as judged
from mortarbench.harness.conformance.manufactured import (
    SET_SHAPES,
    manufactured_over_sets,
)
from mortarbench.harness.verify.kkt import kkt_residuals
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
#: square root of the gap. These limits on the error in x at the smallest tolerance are
#: about twice the largest error on 1250 QPs.
ENDS_OFF_PATH = {"clarabel": 1e-4, "qoco": 3e-4}
#: solvers that find x and f, but whose claims at `TOL` are refuted now and then
REFUTED = ("scs", "scs-qdldl", "qoco")


@pytest.fixture(scope="module", autouse=True)
def only_own_garbage():
    """Exclude the objects of other tests from the collections of `measure`, which would
    take most of the time.
    """
    gc.collect()
    gc.freeze()


def faults(name, shape, seeds):
    """List the wrong answers and the declined QPs.

    An answer is wrong if it is not verified (except for `REFUTED`), or if the error of
    f exceeds 1e-8, or the error of x exceeds its limit: 1e-6, or the value in
    `ENDS_OFF_PATH`.

    The error of f is relative to |qᵀx*|, since f* may cancel: for one seed, terms of
    size 4 cancel to 0.001. If an error is too large at `TOL`, the smaller error at
    `TIGHT` counts, whatever the solver claims.
    """
    wrong, declined = [], []
    limits = np.array([1e-8, ENDS_OFF_PATH.get(name, 1e-6)])
    for seed in seeds:
        qp, expected = manufactured_over_sets(shape, seed=seed)
        at = expected.x
        best, size = qp.objective(at), abs(qp.q @ at)

        def solved(tol, qp=qp, at=at, best=best, size=size):
            s = measure(SOLVERS[name], qp, tol).solution
            off = abs(qp.objective(s.x) - best) / size, np.abs(s.x - at).max()
            return s, np.array(off)

        s, errors = solved(TOL)
        if s.status is Status.DECLINED:
            declined.append((seed, s.message))
            continue
        verdict = judged(s.status, kkt_residuals(qp, s), TOL)
        if not (errors <= [1e-8, 1e-6]).all():
            errors = np.fmin(errors, solved(TIGHT)[1])
        verified = verdict is Verdict.VERIFIED or name in REFUTED
        if not (verified and (errors <= limits).all()):
            wrong.append((seed, str(verdict), *errors, s.message))
    return wrong, declined


@pytest.mark.parametrize(("name", "shape"), PAIRS)
@pytest.mark.parametrize(
    "count", [1, pytest.param(100, marks=pytest.mark.slow)], ids=["one", "many"]
)
def test_planted_solutions_over_sets_are_found(name, shape, count):
    """A solver may decline all QPs of a shape, for example because of their rows."""
    wrong, declined = faults(name, shape, range(count))
    assert not wrong
    assert len(declined) in (0, count)
