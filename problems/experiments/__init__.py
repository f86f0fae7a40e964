"""Experiments that reproduce the figures and tables of the paper."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import asdict
from typing import Any

from mortarbench.harness import Reference
from mortarbench.harness.results.experiment import Experiment
from mortarbench.problems.experiments.analysis import scaling, states
from mortarbench.problems.experiments.parts import (
    Rows,
    assembly,
    contact,
    counts,
    inverse,
)
from mortarbench.problems.experiments.plan import PAPER, QUICK, Plan
from mortarbench.problems.families.beam_ring import BEAM, LOAD, RING

__all__ = ["PAPER", "QUICK", "Plan", "paper_experiment"]


def paper_experiment(
    plan: Plan,
    solve: Reference,
    environment: Mapping[str, Any],
    say: Callable[[str], None],
    *,
    baseline: Reference,
) -> Experiment:
    """Run all experiments; the caller sets the number of threads.

    Parameters
    ----------
    solve : solver of this project for the dual QPs, timed
    baseline : solver of the paper for the dual QPs, timed
    environment : description of the environment, stored with the measurements
    say : callback that receives one line before each experiment

    """
    tables = {"table1": list(counts(plan.scaling[-1], plan.Nh))}
    experiments: tuple[tuple[str, str, Callable[[], Rows]], ...] = (
        ("figure3", "Figure 3: assembly", lambda: assembly(plan)),
        ("figure4", "Figure 4: contact rows", lambda: contact(plan)),
        ("figure5", "Figure 5: generalised inverse", lambda: inverse(plan)),
        ("figure6", "Figure 6: the whole analysis",
         lambda: scaling(plan, solve, baseline)),
    )  # fmt: skip
    for name, title, rows in experiments:
        say(title)
        tables[name] = list(rows())
    say("Figures 2 and 7: deformed bodies")
    return Experiment(
        setting={
            "plan": asdict(plan),
            "load": LOAD,
            "materials": {"beam": asdict(BEAM), "ring": asdict(RING)},
            "environment": environment,
        },
        tables=tables,
        states=states(plan, solve),
    )
