"""Runs of suites, and the measurements in result folders."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from functools import cached_property, partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from msgspec import to_builtins

from mortarbench.answer import PICTURES
from mortarbench.harness import checked
from mortarbench.harness.checked import located
from mortarbench.harness.errors import InputError, some, unknown
from mortarbench.harness.errors import shown as given
from mortarbench.harness.files.reading import toml
from mortarbench.harness.record import REFUTED, Record, Verdict
from mortarbench.harness.registry import resolve
from mortarbench.harness.results.folder import keep_environment, refuse_links
from mortarbench.harness.results.journal import read_journal
from mortarbench.harness.suite.solver_options import listed_options, selected, sweep
from mortarbench.harness.suite.suite import as_toml, expanded, read_suite, suite_file
from mortarbench.progress import Callback, ignore, shown
from mortarbench.registries import TURN, Plugins, Registries, load_registries
from mortarbench.reporting import Report, report
from mortarbench.text import summary
from mortarbench.validation import Validation, validate

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from pandas import DataFrame

    from mortarbench.harness.results.work_unit import Execute
    from mortarbench.harness.running.run import Missing


@dataclass(frozen=True, eq=False, repr=False, kw_only=True)
class Results:
    """Measurements of a result folder."""

    folder: Path
    records: tuple[Record, ...]  #: one per measurement, in the order of the journal
    #: labels of the requested solvers, in the order of the suite; after `load`, the
    #: labels of all solvers in the records
    solvers: tuple[str, ...] = ()
    #: names of the requested cases; if empty, all cases in the records
    cases: frozenset[str] = frozenset()
    #: requested measurements that are missing; another call of `run` retries them
    missing: Missing | None = None

    @cached_property
    def df(self) -> DataFrame:
        """Table with a row per measurement and a column per field of the journal."""
        from mortarbench.harness.results.frame import frame_of

        return frame_of(self.records)

    @property
    def refuted(self) -> tuple[Record, ...]:
        """Requested measurements in which the solver's claim is refuted."""
        return tuple(r for r in self._requested if r.status in REFUTED)

    @property
    def failed(self) -> tuple[Record, ...]:
        """Requested measurements in which the solver crashed, gave up or hit a limit.

        Declined measurements are not included.
        """
        excluded = (*REFUTED, Verdict.DECLINED)
        return tuple(
            r
            for r in self._requested
            if r.status not in excluded and not r.status.is_verified
        )

    @property
    def _requested(self) -> tuple[Record, ...]:
        return tuple(
            r
            for r in self.records
            if (not self.solvers or r.solver in self.solvers)
            and (not self.cases or r.case in self.cases)
        )

    def to_dict(self) -> dict[str, Any]:
        """Return counts and failures as plain data, the output of ``run --json``."""
        counts: dict[str, Counter[str]] = {}
        for r in self._requested:
            counts.setdefault(r.solver, Counter())[r.status.value] += 1
        return {
            "folder": str(self.folder),
            "measurements": len(self.records),
            "solvers": {solver: dict(count) for solver, count in counts.items()},
            "refuted": [_named(r) for r in self.refuted],
            "failed": [_named(r) for r in self.failed],
            "not_measured": self.shortfall,
        }

    @property
    def shortfall(self) -> list[str]:
        """Reasons why requested measurements are missing, one line for each reason."""
        lines: list[str] = []
        if self.missing is None:
            return lines
        if count := len(self.missing.unbuilt):
            cases = "case" if count == 1 else "cases"
            names = some(self.missing.unbuilt)
            lines.append(f"{count} {cases} could not be built: {names}")
        if faults := self.missing.faults:
            measured = f"{len(faults)} measurement{'s' * (len(faults) != 1)}"
            lines.append(
                f"{measured} failed for reasons other than the solver: {some(faults)}; "
                "the same command tries again"
            )
        return lines

    def report(self, **options: object) -> Report:
        """Write the report; see `mortarbench.report`."""
        return report(self.folder, **options)  # type: ignore[arg-type]

    def plot(
        self,
        kind: str,
        path: str | Path | None = None,
        *,
        x: str | None = None,
        solvers: Sequence[str] = (),
        cases: Sequence[str] = (),
    ) -> Figure:
        """Draw a figure of the report.

        Parameters
        ----------
        kind : name of the figure in the folder ``figures`` of the report, such as
            ``accuracy`` or ``scaling``
        path : file to which the figure is also written: .png, .pdf or .svg
        x : size on the horizontal axis of ``scaling`` and ``iterations``: m, n, or a
            key of the cases; default: m
        solvers : labels of the solvers to draw; empty: all
        cases : names or patterns of the cases to draw; empty: all

        Raises
        ------
        InputError
            If the report has no such figure (the message lists its figures), a label is
            unknown, or the file cannot be written.

        """
        from mortarbench.reports.figures.style import save
        from mortarbench.reports.folder import plot
        from mortarbench.reports.measurements import read_measurements

        target = None if path is None else checked.output_file(path, PICTURES)
        run = read_measurements(self.folder)
        for label in checked.texts("solvers", solvers):
            if label not in run.solvers:
                raise unknown("solver", label, run.solvers, where=str(self.folder))
        run = run.selected(solvers, checked.texts("cases", cases))
        figure = plot(run, kind, x)
        if target is not None:
            save(figure, target)
        return figure

    def validate(self, **options: object) -> Validation:
        """Cross-validate the answers; see `mortarbench.validate`."""
        return validate(self.folder, **options)  # type: ignore[arg-type]

    def __len__(self) -> int:
        return len(self.records)

    def __repr__(self) -> str:
        text = [summary(self.records, self.solvers), *self.shortfall]
        return "\n".join(text)


#: fields that name a measurement, and its verdict
_NAMED = (
    "session", "run_id", "case", "solver", "tol", "repeat", "status", "claimed",
    "message",
)  # fmt: skip


def _named(r: Record) -> dict[str, Any]:
    """Return the identity and the verdict of a measurement."""
    return {name: getattr(r, name) for name in _NAMED}


def load(folder: str | Path, *, warn: Callable[[str], None] = ignore) -> Results:
    """Read the measurements of a result folder.

    Parameters
    ----------
    folder : result folder, as `run` writes it
    warn : called with a message if lines of the journal repeat earlier lines

    Raises
    ------
    InputError
        If the folder contains no measurements, or its journal is damaged.

    Examples
    --------
    >>> import mortarbench as mb
    >>> results = mb.run("smoke", out="out/smoke", cases=["*/dual"], solvers=["pdas"])
    >>> len(mb.load("out/smoke")) == len(results)
    True
    >>> sorted(set(mb.load("out/smoke").df.solver))
    ['pdas']

    """
    path = checked.path("folder", folder)
    records = read_journal(path, warn)
    if not records:
        raise InputError(f"{path}: no measurements; expected a result folder of `run`")
    return Results(
        folder=path,
        records=tuple(records),
        solvers=tuple(dict.fromkeys(r.solver for r in records)),
        cases=frozenset(r.case for r in records),
    )


def merge(
    *folders: Annotated[str | Path, "DIR"],
    out: Annotated[str | Path, "DIR"],
    tell: Callable[[str], None] = ignore,
) -> Results:
    """Merge result folders into a new folder.

    All measurements are kept: sessions on one machine are pooled in reports, and
    environments are reported separately. A measurement that several folders contain is
    stored once.

    Parameters
    ----------
    folders : result folders of `run` or `merge`
    out : a new folder
    tell : called with messages about repeated measurements, files too large to be
        copied, and missing solutions and environments

    Raises
    ------
    InputError
        If a folder contains no measurements, if two folders contain different records
        of one measurement, or if the suites of two folders differ in their limits,
        their accuracy or the meaning of a label, or if `out` contains measurements.

    """
    if not folders:
        raise InputError("no folder to merge; expected result folders of `run`")
    from mortarbench.harness.results.merge import merge as merge_folders

    sources = [checked.result_folder("folders", folder) for folder in folders]
    target = checked.path("out", out)
    records = merge_folders(sources, target, tell)
    return Results(folder=target, records=tuple(records))


@TURN
def run(
    suite: Annotated[str | Path | Mapping[str, Any], "SUITE.toml"],
    *,
    out: Annotated[str | Path | None, "DIR"] = None,
    solvers: Annotated[Sequence[str], "--solver NAME"] = (),
    cases: Annotated[Sequence[str], "--case PATTERN"] = (),
    repeats: Annotated[int | None, "N"] = None,
    time_limit: Annotated[float | None, "SECONDS"] = None,
    memory_limit: Annotated[float | None, "MIB"] = None,
    options: Mapping[str, Any] | None = None,
    fresh: bool = False,
    dask: Annotated[str | None, "ADDRESS|local"] = None,
    plugins: Plugins = (),
    progress: bool | Callback | None = None,
    registries: Registries | None = None,
) -> Results:
    """Measure a suite and store the results in a folder; existing results are kept.

    Parameters
    ----------
    suite : path of a TOML file, or a name from `list suites`. In Python also a dict
        with the keys of such a file, whose relative paths refer to the working
        directory
    out : result folder; default: ``out/NAME`` for the suite NAME
    solvers : measure only these solvers, which need not be in the suite
    cases : measure only these cases: names or patterns such as ``*/dual``
    repeats : number of repeats, instead of the number in the suite
    time_limit : limit for each measurement in s, instead of the limit in the suite
    memory_limit : limit for each measurement in MiB, instead of that in the suite
    options : options to set in every solver that has them; if the value of an option is
        a list, each value in the list is measured
    fresh : delete the previous results in the folder first
    dask : measure on the workers of the Dask scheduler at this address, or (``local``)
        of a cluster that is started on this machine; see docs/compare.md
    plugins : Python files with more solvers or families
    progress : True for a bar, or for lines if stderr is not a terminal; a function to
        be called with every `Event`; False for no display; None for a bar in a notebook
        and no display elsewhere
    registries : used instead of built-in registries, installed plug-ins and `plugins`

    Raises
    ------
    InputError
        If an argument is invalid, the folder is in use, or its disk is full.

    Examples
    --------
    >>> import mortarbench as mb
    >>> results = mb.run(
    ...     {
    ...         "name": "steps",
    ...         "tolerances": [1e-6],
    ...         "repeats": 1,
    ...         "solvers": ["smalbe"],
    ...         "problems": [
    ...             {
    ...                 "family": "beam-ring",
    ...                 "forms": ["dual"],
    ...                 "params": {"Nr": 4, "Nh": 3, "step": [1, 10]},
    ...             }
    ...         ],
    ...     },
    ...     out="out/steps",
    ... )
    >>> [str(verdict) for verdict in results.df.status]
    ['verified', 'verified']

    """
    registries = load_registries(plugins, registries)
    folder = None if out is None else checked.path("out", out)
    if not isinstance(dask, str | None):
        raise InputError(f"dask = {given(dask)}; expected the address of a scheduler")
    if isinstance(suite, Mapping):
        path = Path("suite")
        with located(f"{path}"):
            file = suite_file(toml(as_toml(suite)))
    else:
        path = registries.suite_path(suite)
        file = read_suite(path)
    folder = folder or Path("out") / file.name
    if folder.is_dir():
        refuse_links(folder)
    changes = {
        "repeats": repeats,
        "time_limit": time_limit,
        "memory_limit": memory_limit,
    }
    changed = {key: value for key, value in changes.items() if value is not None}
    file = suite_file({**to_builtins(file), **changed})
    solvers = checked.texts("solvers", solvers)
    patterns = checked.texts("cases", cases)
    options = listed_options({} if options is None else options)
    families, known = registries.families, registries.solvers
    with located(f"{path}"):
        asked = expanded(file, path.parent, families, known)
    if patterns:
        chosen = asked.cases.selected(patterns)
        asked = replace(asked, cases=chosen)
    specs = selected(asked.solvers, solvers, known) if solvers else asked.solvers
    asked = replace(asked, solvers=sweep(specs, options, known))
    from mortarbench.harness.environment.doctor import is_busy
    from mortarbench.harness.environment.environment import digest
    from mortarbench.harness.running.executor import execute as execute_here
    from mortarbench.harness.running.run import run as run_suite

    environment = registries.environment()
    with shown(progress) as display, ExitStack() as stack:
        if is_busy(busy := os.getloadavg()[0]):
            display.warn(
                f"mortarbench: other programs keep {busy:.1f} cores busy; times will "
                "be less precise"
            )
        execute: Execute = partial(execute_here, operators=registries.operators)
        if dask is not None:
            from mortarbench.harness.running.cluster import on_cluster

            execute = stack.enter_context(
                on_cluster(
                    dask,
                    plugins=registries.files,
                    operators=registries.own_operators,
                    environment=environment,
                    keep=lambda name, there: keep_environment(folder, name, there),
                )
            )
        missing = run_suite(
            asked,
            out=folder,
            commands=registries.commands(asked.solvers),
            resolve=lambda spec: resolve(spec, registries.solvers),
            environment=environment,
            digest=digest(environment),
            progress=display,
            fresh=fresh,
            execute=execute,
        )
        records = read_journal(folder, display.warn)
    return Results(
        folder=folder,
        records=tuple(records),
        solvers=tuple(s.label for s in asked.solvers),
        cases=frozenset(case.name for case in asked.cases.all),
        missing=missing,
    )
