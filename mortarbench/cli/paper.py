"""The command `paper`: reproduce all figures and tables of the paper."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from mortarbench.harness import checked
from mortarbench.harness.errors import InputError, say
from mortarbench.harness.files.durable import report_full_disk
from mortarbench.registries import Registries

if TYPE_CHECKING:
    from mortarbench.harness.plugin import Reference

#: Suites beyond the paper, each with arguments of `run` that reduce the suite for
#: --quick.
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


def paper(
    registries: Registries,
    *,
    out: Annotated[str, "DIR"] = "out/paper",
    quick: bool = False,
) -> int:
    """Reproduce all figures and tables of the paper.

    out : folder for the results; default: out/paper
    quick : use fewer sizes and repeats; takes about a minute
    """
    folder = checked.path("out", out)
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as e:
        raise InputError(
            f"out {out}: {e.strerror}; expected a folder, or a new path"
        ) from None
    with report_full_disk(folder):
        written = measure_and_write(registries, folder, quick, say)
    print(*(file for file in written if file.suffix == ".html"), sep="\n")
    return 0


def measure_and_write(
    registries: Registries, out: Path, quick: bool, say: Callable[[str], None]
) -> list[Path]:
    """Perform the measurements, write figures and tables, and return the files.

    quick : True for fewer sizes and repeats
    say : called with messages about the progress

    Raises
    ------
    InputError
        If the folder is in use, or contains files that are not results of this command.

    """
    from mortarbench.problems.experiments import PAPER, QUICK, paper_experiment
    from mortarbench.reports.paper.report import write_paper
    from mortarbench.results import run as run_suite

    data = out / "data"
    experiment = paper_experiment(
        QUICK if quick else PAPER,
        _answer(registries, "smalbe"),
        registries.environment(),
        say,
        baseline=_answer(registries, "smalbe-paper"),
    )
    for name, narrowed in BEYOND.items():
        say(f"Suite {name}")
        run_suite(
            name,
            out=data / name,
            fresh=True,
            progress=True,
            registries=registries,
            **(narrowed if quick else {}),
        )
    return write_paper(out, experiment)


def _answer(registries: Registries, name: str) -> Reference:
    """Return a function that solves QPs with a registered solver at tolerance 1e-8."""
    solver = registries.solvers[name]
    return lambda qp: solver.prepare(qp, 1e-8)()
