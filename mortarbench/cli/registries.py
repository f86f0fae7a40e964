"""What the composition root hands to the commands."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

from harness.errors import InputError, unknown
from harness.plugin import Family, Fields, Reference, Solver
from harness.recipe import Maker
from harness.registry import Plugin, SolverSpec, load_plugin, merged
from harness.results.work_unit import Commands

if TYPE_CHECKING:  # it takes long to import, and workers need none
    from harness.crossval.discretisation import Discretisation

SUITES = Path(__file__).parents[2] / "suites"  #: of the checkout
FORMATS = ("html", "md", "tex", "csv", "parquet")  #: of a report


class Reporter(Protocol):
    """Writes the report on a result folder, and returns the files."""

    def __call__(
        self, folder: Path, formats: Sequence[str], *, factor: float = ...
    ) -> list[Path]:
        """Report; verdicts are those at factor·tol."""


class Comparer(Protocol):
    """Writes what changed between two folders; returns a verdict and the files."""

    def __call__(
        self, before: Path, after: Path, formats: Sequence[str], *, factor: float
    ) -> tuple[list[str], list[Path]]:
        """Compare; verdicts are those at factor·tol."""


@dataclass(frozen=True, kw_only=True)
class Registries:
    """What can be measured, and what to measure and show it with."""

    families: Mapping[str, Family]
    solvers: Mapping[str, Solver]
    reference: Reference
    report: Reporter
    plot: Callable[[Fields, Path], None]
    vtu: Callable[[Fields, Path], None]
    series: Callable[[Sequence[tuple[float, Fields]], Path], object]  #: of load steps
    paper: Callable[[Path, bool, Callable[[str], None]], list[Path]]
    """Measure and write the paper's figures: folder, quick?, progress."""
    compare: Comparer = lambda *_, **__: ([], [])
    #: writes the page of a cross-validation: folder, `harness.crossval.summary.as_data`
    #: and what finer meshes told
    validation: Callable[
        [Path, Mapping[str, Any], Sequence[Discretisation]], list[Path]
    ] = lambda *_: []
    operators: Mapping[str, Maker] = field(default_factory=dict)  #: `harness.recipe`
    suites: Path = SUITES
    #: which plug-in a family came in, for those that did
    origins: Mapping[str, str] = field(default_factory=dict)
    #: starts the command line, less the name of a process that runs need. -P: what lies
    #: in the working directory must not pass for a library
    start: Sequence[str] = (sys.executable, "-P", "-m", "mortarbench")

    def extended(self, plugin: Plugin) -> Registries:
        """Add the solvers, problems and operators of a plug-in.

        Raises
        ------
        InputError
            When one of its names exists.

        """
        return replace(
            self,
            families=merged("problem", self.families, plugin.problems),
            solvers=merged("solver", self.solvers, plugin.solvers),
            operators=merged("operator", self.operators, plugin.operators),
            origins={**self.origins, **dict.fromkeys(plugin.problems, plugin.origin)},
        )

    def with_files(self, files: Sequence[Path]) -> Registries:
        """Add the plug-ins in `files`.

        Raises
        ------
        InputError
            When one cannot be loaded, or a name of it exists.

        """
        extended = self
        for file in files:
            plugin = load_plugin(file)
            try:
                extended = extended.extended(plugin)
            except InputError as e:
                raise InputError(f"{file}: {e}") from None
        return extended

    def worker_command(self, spec: SolverSpec, plugins: Iterable[Path]) -> list[str]:
        """Make the command that starts the worker of a solver, less its two pipes."""
        request = {
            "name": spec.name,
            "options": spec.options,
            "plugins": [str(path.resolve()) for path in plugins],
        }
        return [*self.start, "worker", json.dumps(request)]

    def commands(
        self, specs: Iterable[SolverSpec], plugins: Sequence[Path]
    ) -> Commands:
        """Make the commands that start the processes of a run."""
        request = {"plugins": [str(path.resolve()) for path in plugins]}
        return Commands(
            solvers={s.label: self.worker_command(s, plugins) for s in specs},
            generator=[*self.start, "generator", json.dumps(request)],
        )

    def suite_path(self, text: str) -> Path:
        """Find a suite by path, or by its bare name among the suites of the checkout.

        Raises
        ------
        InputError
            When there is neither.

        """
        path = Path(text)
        if path.is_file():
            return path
        known = {p.stem: p for p in self.suites.glob("*.toml")}
        if text in known:
            return known[text]
        if path.exists():
            return path  # what it is instead of a file, says who reads it
        if len(path.parts) > 1 or path.suffix:
            raise InputError(f"{text}: no such file; expected a suite in TOML")
        raise unknown("suite", text, known)
