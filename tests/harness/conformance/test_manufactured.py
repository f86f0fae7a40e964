"""Manufactured QPs: planted solutions and verdicts."""

from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
import pytest

from mortarbench.harness import Box, Cones, Discs, needs_matrices
from mortarbench.harness.conformance.conformance import CHECKS, Grade, run_check
from mortarbench.harness.conformance.manufactured import (
    SET_SHAPES,
    manufactured_over_sets,
)
from mortarbench.harness.verify.kkt import kkt_residuals
from mortarbench.harness.verify.multipliers import with_multipliers
from mortarbench.solvers import SOLVERS
from mortarbench.solvers.reference.solve import reference_solution


@pytest.mark.parametrize("shape", SET_SHAPES)
def test_points_planted_over_sets_are_strictly_complementary_solutions(shape):
    for seed in range(20):
        qp, s = manufactured_over_sets(shape, seed=seed)
        assert kkt_residuals(qp, s).worst <= 1e-13
        assert np.linalg.eigvalsh(qp.P.toarray())[0] >= 0.1 - 1e-12
        states = {}
        for one in qp.sets[1:]:
            for block, slack in zip(one.index, one.limits(s.x)[0].slack, strict=True):
                is_active = slack <= 1e-14 * np.abs(s.x).max()
                is_apex = not s.x[block].any()
                force = np.linalg.norm(s.z_box[block])
                assert (force >= 0.5) == is_active
                state = type(one).__name__, bool(is_active), is_apex
                states[state] = states.get(state, 0) + 1
        discs, cones, _ = SET_SHAPES[shape]
        assert states.get(("Discs", True, False), 0) == discs * 2 // 3
        assert states.get(("Cones", True, True), 0) == cones // 3
        assert states.get(("Cones", True, False), 0) == cones // 3


@dataclass(frozen=True)
class Projections:
    """Adapter of the reference solver that accepts all sets."""

    accepts: ClassVar = (Box, Discs, Cones)

    def declines(self, qp):
        return needs_matrices(qp)

    def prepare(self, qp, tol):
        return lambda: replace(reference_solution(qp), message="converged")


class OnBounds(Projections):
    """Solver that ignores the sets and balances the gradient by z_box."""

    def prepare(self, qp, tol):
        def solve():
            s = reference_solution(replace(qp, sets=(qp.box,)))
            return replace(s, message="converged")

        return solve


class OtherSign(Projections):
    def prepare(self, qp, tol):
        def solve():
            s = reference_solution(qp)
            return replace(s, z_box=np.where(np.isfinite(qp.lb), s.z_box, -s.z_box))

        return solve


class Stops(Projections):
    """Solver that returns a point close to the solution, with its best multipliers."""

    def prepare(self, qp, tol):
        x = reference_solution(qp).x * (1 + 1e-4)
        return lambda: with_multipliers(qp, x)


OVER_SETS = [check for check in CHECKS if check.startswith("solves over")]
#: checks of two kinds of constraints at once
OF_BOTH = [check for check in OVER_SETS if " and " in check]


@pytest.mark.parametrize(
    "check",
    [
        pytest.param(c, marks=[pytest.mark.slow] * (c in OF_BOTH[:-1]))
        for c in OVER_SETS
    ],
)
def test_checks_over_sets_pass_the_reference_and_catch_faults(check):
    grade, message = run_check(check, Projections())
    assert grade is Grade.PASS, message
    for faulty in (OnBounds(), OtherSign(), Stops()):
        assert run_check(check, faulty).grade is Grade.FAIL


def test_a_solver_for_bounds_declines_all_checks_over_sets():
    for check in OVER_SETS:
        result = run_check(check, SOLVERS["osqp"])
        assert result.grade is Grade.DECLINE
        assert "does not accept sets of the class" in result.message
