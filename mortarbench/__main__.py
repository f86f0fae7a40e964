"""Composition root: the only module that imports problems, solvers and reports."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from threadpoolctl import threadpool_limits

from harness import Reference
from harness.plugin import Fields
from harness.processes.supervisor import ONE_THREAD
from harness.verify.kkt import VERIFIED_FACTOR
from mortarbench.cli import main as cli
from mortarbench.cli.registries import Registries
from problems import PROBLEMS
from solvers import SOLVERS
from solvers.reference.solve import reference_solution

if TYPE_CHECKING:
    from harness.crossval.discretisation import Discretisation


def main() -> None:
    """Run the command line, with one thread in every library."""
    threadpool_limits(limits=1)  # of the BLASes that are loaded: numpy's, CHOLMOD's
    os.environ.update(ONE_THREAD)  # what a solver loads later reads these, once
    sys.exit(cli.main(_workbench(), sys.argv[1:]))


def _workbench() -> Registries:
    return Registries(
        families=PROBLEMS,
        solvers=SOLVERS,
        reference=reference_solution,
        report=_report,
        compare=_compare,
        plot=_plot,
        vtu=_vtu,
        series=_series,
        paper=_paper,
        validation=_validation,
    )


def _report(
    folder: Path, formats: Sequence[str], *, factor: float = VERIFIED_FACTOR
) -> list[Path]:
    from reports import write_report  # late: workers must not carry matplotlib

    return write_report(folder, formats, factor)


def _compare(
    before: Path, after: Path, formats: Sequence[str], *, factor: float
) -> tuple[list[str], list[Path]]:
    from reports import write_comparison

    return write_comparison(before, after, formats, factor)


def _validation(
    folder: Path, data: Mapping[str, Any], meshes: Sequence[Discretisation]
) -> list[Path]:
    from reports.validation.report import write_validation

    return write_validation(folder, data, meshes)


def _plot(fields: Fields, path: Path) -> None:
    from reports.figures.deformed import draw_deformed

    draw_deformed(fields, path)


def _series(states: Sequence[tuple[float, Fields]], path: Path) -> None:
    from reports.export.vtu import write_series

    write_series(states, path)


def _vtu(fields: Fields, path: Path) -> None:
    from reports.export.vtu import write_vtu

    write_vtu(fields, path)


def _paper(out: Path, quick: bool, say: Callable[[str], None]) -> list[Path]:
    from harness.environment.environment import capture
    from harness.files.experiment import save_experiment
    from mortarbench.cli.paper import measured
    from problems.experiments import PAPER, QUICK, paper_experiment
    from reports.paper.report import write_paper

    plan = QUICK if quick else PAPER
    data = out / "data"
    experiment = paper_experiment(
        plan, _answer("smalbe"), capture(), say,
        baseline=_answer("smalbe-paper"), reference=reference_solution,
    )  # fmt: skip
    save_experiment(experiment, data)
    for name, narrowed in BEYOND.items():
        say(f"Suite {name}")
        measured(_workbench(), name, data / name, **(narrowed if quick else {}))
    return write_paper(out)


def _answer(name: str) -> Reference:
    """Solve with a solver of ours to the paper's accuracy, which it does not state."""
    return lambda qp: SOLVERS[name].prepare(qp, 1e-8)()


#: suites whose figures the paper does not have, and what is left of them in --quick
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


if __name__ == "__main__":
    main()
