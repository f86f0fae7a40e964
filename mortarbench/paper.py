"""Every figure and table of the paper, measured anew."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mortarbench.registries import Registries
from mortarbench.results import run

if TYPE_CHECKING:
    from harness.plugin import Reference

#: suites whose figures the paper does not have, and what is left of them when quick
BEYOND: Mapping[str, Mapping[str, Any]] = {
    "paper-fleet": {
        "cases": ("*/Nr=4/*", "*/Nr=8/*", "*/Nr=15/*", "*/Nr=30/*dual*"),
        "solvers": ("smalbe", "osqp", "piqp"),
        "repeats": 3,
    },
    "paper-accuracy": {
        "cases": ("*/dual",),
        "solvers": ("smalbe", "osqp", "piqp"),
        "repeats": 3,
    },
}


def measured_paper(
    registries: Registries, out: Path, quick: bool, say: Callable[[str], None]
) -> list[Path]:
    """Measure what the paper's figures and tables show, and write them.

    quick : fewer sizes and repeats
    say : is told what happens

    Raises
    ------
    InputError
        When the folder is in use, or no folder of such measurements.

    """
    from harness.files.experiment import save_experiment
    from problems.experiments import PAPER, QUICK, paper_experiment
    from reports.paper.report import write_paper

    data = out / "data"
    experiment = paper_experiment(
        QUICK if quick else PAPER,
        _answer(registries, "smalbe"),
        registries.environment(),
        say,
        baseline=_answer(registries, "smalbe-paper"),
        reference=registries.reference,
    )
    save_experiment(experiment, data)
    for name, narrowed in BEYOND.items():
        say(f"Suite {name}")
        run(
            name,
            out=data / name,
            fresh=True,
            progress=True,
            registries=registries,
            **(narrowed if quick else {}),
        )
    return write_paper(out)


def _answer(registries: Registries, name: str) -> Reference:
    """Solve with a solver of ours to the paper's accuracy, which it does not state."""
    solver = registries.solvers[name]
    return lambda qp: solver.prepare(qp, 1e-8)()
