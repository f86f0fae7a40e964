"""Whose solution a refuted answer is instead: that of another load step, say."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from mortarbench.harness.crossval.comparison import Answer, Problem
from mortarbench.harness.crossval.ground_truth import Given
from mortarbench.harness.plugin import Reference
from mortarbench.harness.qp import Vector
from mortarbench.harness.verify.references import reference_point

ALIKE = 1e-3  #: relative difference of contact forces up to which they are the same


def true_forces(
    problem: Problem, given: Sequence[Given], solve: Reference, references: Path
) -> Vector | None:
    """Return the multipliers (m,) of the reference; None where there is none."""
    mechanics = given[0].case.mechanics
    if mechanics is None or problem.truth != "reference":
        return None
    point = reference_point(mechanics, solve, references)  # which keeps it
    return np.asarray(point.multipliers, dtype=float)


def suspects(problem: Problem, given: Sequence[Given]) -> dict[str, Vector]:
    """Return the multipliers of refuted answers by run_id."""
    refuted = {a.run_id for a in problem.answers if a.refuted and a.assessment}
    return {
        g.record.run_id: g.case.mechanics.multipliers(g.case.mechanics.back(g.solution))
        for g in given
        if g.record.run_id in refuted and g.case.mechanics is not None
    }


def recognised(
    problems: Iterable[Problem],
    found: Mapping[str, Vector],
    truths: Mapping[str, Vector],
) -> list[Problem]:
    """Remark on each refuted answer that is the solution of another problem.

    found : multipliers of refuted answers by run_id
    truths : multipliers of solutions by the name of the problem
    """

    def remarked(a: Answer, own: str) -> Answer:
        name = _whose(found[a.run_id], truths, own) if a.run_id in found else ""
        if not name:
            return a
        text = f"its contact forces are those of {name}"
        return replace(a, remarks=(*a.remarks, text))

    return [
        replace(p, answers=tuple(remarked(a, p.name) for a in p.answers))
        for p in problems
    ]


def _whose(z: Vector, truths: Mapping[str, Vector], own: str) -> str:
    """Name the problem whose contact forces are nearest.

    Empty if none are alike, or its own are: then something else is wrong.
    """
    differences = {
        name: float(np.linalg.norm(z - lam) / np.linalg.norm(lam))
        for name, lam in truths.items()
        if lam.shape == z.shape and lam.any()
    }
    alike = {name: d for name, d in differences.items() if d <= ALIKE}
    return "" if own in alike else min(alike, key=lambda n: alike[n], default="")
