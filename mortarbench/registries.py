"""What can be measured: families, solvers and suites, with those of plug-ins."""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from importlib.util import LazyLoader, find_spec, module_from_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol, TypeAlias

from mortarbench.harness import checked
from mortarbench.harness.errors import InputError, shown, unknown
from mortarbench.harness.limits import ONE_THREAD
from mortarbench.harness.plugin import Family, Reference, Solver, as_family
from mortarbench.harness.processes.locks import ForkSafeLock
from mortarbench.harness.registry import (
    COPIES,
    Plugin,
    PluginFile,
    SolverSpec,
    entry_point_plugins,
    load_plugin,
    merged,
)
from mortarbench.problems import OPERATORS, PROBLEMS
from mortarbench.solvers import SOLVERS

if TYPE_CHECKING:
    from mortarbench.harness.crossval.discretisation import Discretisation
    from mortarbench.harness.operators import Maker
    from mortarbench.harness.qp import QP
    from mortarbench.harness.results.work_unit import Commands
    from mortarbench.harness.solution import Solution

#: of the thread that loads plug-ins, builds, solves, runs or validates: these set
#: numbers of threads, standard output and modules of the whole process
TURN = ForkSafeLock()

#: Python files that define SOLVERS or PROBLEMS; a text may be LABEL=FILE.py
Plugins = Sequence[str | Path | PluginFile]


class Reporter(Protocol):
    """Writes the report on a result folder, and returns the files."""

    def __call__(
        self,
        folder: Path,
        formats: Sequence[str],
        *,
        factor: float = ...,
        pool_forms: bool = ...,
    ) -> list[Path]:
        """Report; verdicts are those at factor·tol, forms are compared together."""


def _plugin_files(files: Plugins) -> list[PluginFile]:
    """Parse a list of plug-ins; a lone text or path is a likely slip, and refused."""
    if isinstance(files, str | Path) or not isinstance(files, Iterable):
        raise InputError(
            f"plugins = {shown(files)}; expected a list of Python files, such as "
            "['mine.py']"
        )
    listed = list(files)
    for file in listed:
        if not isinstance(file, PluginFile):
            checked.path("plugins", file)
    return [PluginFile.of(file) for file in listed]


def suites_folder() -> Path:
    """Say where the suites lie: in the package, or beside it in a checkout."""
    inside = Path(__file__).parent / "suites"
    return inside if inside.is_dir() else Path(__file__).parents[1] / "suites"


@contextmanager
def one_thread() -> Iterator[None]:
    """Keep every library to one thread, as the processes of a run do.

    Sums in another order would make another QP of the same case, in its last digits.
    Another thread of ours that wants the same waits until this one is done.
    """
    from scipy import linalg  # libraries that are loaded, and only they, can be told
    from sksparse import cholmod
    from threadpoolctl import threadpool_limits

    del linalg, cholmod
    with TURN, threadpool_limits(limits=1):
        yield


def defer_parts_of_numpy() -> None:
    """Execute modules of numpy that scipy imports only when their names are used.

    Nothing here uses them, and they take a quarter of the time in which a process that
    solves starts: `scipy._lib.array_api_compat.numpy` asks for every name of numpy.
    """
    import numpy

    for part in ("f2py", "testing"):
        spec = find_spec(f"numpy.{part}")
        if spec is None or spec.loader is None or spec.name in sys.modules:
            continue
        spec.loader = LazyLoader(spec.loader)
        module = sys.modules[spec.name] = module_from_spec(spec)
        spec.loader.exec_module(module)
        setattr(numpy, part, module)  # or numpy would ask for it again


def reference(qp: QP) -> Solution:
    """Solve to the last digits, by a method that is none of the solvers compared."""
    from mortarbench.solvers.reference.solve import reference_solution

    return reference_solution(qp)


def report_folder(
    folder: Path,
    formats: Sequence[str],
    *,
    factor: float | None = None,
    pool_forms: bool = False,
) -> list[Path]:
    """Write our report on a result folder."""
    from mortarbench.harness.record import VERIFIED_FACTOR
    from mortarbench.reports import write_report

    factor = VERIFIED_FACTOR if factor is None else factor
    return write_report(folder, formats, factor, pool_forms=pool_forms)


ValidationPage: TypeAlias = (
    "Callable[[Path, Mapping[str, Any], Sequence[Discretisation]], list[Path]]"
)


def _validation_page(
    folder: Path, data: Mapping[str, Any], meshes: Sequence[Discretisation]
) -> list[Path]:
    from mortarbench.reports.validation.report import write_validation

    return write_validation(folder, data, meshes)


class _WithCopies(Mapping[str, Family]):
    """Families that take the copies of files which a result folder holds."""

    def __init__(self, families: Mapping[str, Family], folder: Path | None) -> None:
        self._families = families
        self._folder = folder

    def __getitem__(self, name: str) -> Family:
        family = as_family(self._families[name])
        return family if self._folder is None else family.with_copies(self._folder)

    def __contains__(self, name: object) -> bool:
        return name in self._families

    def __iter__(self) -> Iterator[str]:
        return iter(self._families)

    def __len__(self) -> int:
        return len(self._families)


@dataclass(frozen=True, kw_only=True)
class Registries:
    """What can be measured, and how the processes are started that measure it."""

    families: Mapping[str, Family] = field(default_factory=lambda: PROBLEMS)
    solvers: Mapping[str, Solver] = field(default_factory=lambda: SOLVERS)
    reference: Reference = reference
    report: Reporter = report_folder
    validation_page: ValidationPage = _validation_page
    #: what puts an operator P together, see `harness.operators`
    operators: Mapping[str, Maker] = field(default_factory=lambda: OPERATORS)
    #: those of them that did not come in a file
    own_operators: Mapping[str, Maker] = field(default_factory=lambda: OPERATORS)
    suites: Path = field(default_factory=suites_folder)
    files: tuple[
        PluginFile, ...
    ] = ()  #: plug-ins that the processes of a run load, too
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

    @TURN
    def with_files(self, files: Plugins) -> Registries:
        """Add the plug-ins in `files`.

        Raises
        ------
        InputError
            When one cannot be loaded, or a name of it exists.

        """
        extended = self
        for file in _plugin_files(files):
            plugin = load_plugin(file)
            try:
                extended = extended.extended(plugin)
            except InputError as e:
                raise InputError(f"{file.path}: {e}") from None
            extended = replace(extended, files=(*extended.files, file))
        return extended

    def missing(self, files: Plugins) -> list[PluginFile]:
        """List the plug-ins of `files` that are not loaded yet.

        Raises
        ------
        InputError
            When they are not a list of files.

        """
        loaded = {file.resolved() for file in self.files}
        return [f for f in _plugin_files(files) if f.resolved() not in loaded]

    def hold_own_code_only(self) -> bool:
        """Whether nothing of a plug-in has been loaded."""
        return (
            self.families is PROBLEMS
            and self.solvers is SOLVERS
            and self.operators is OPERATORS
            and not self.files
        )

    def worker_command(self, spec: SolverSpec, copy: Path | None = None) -> list[str]:
        """Return the command that starts the worker of a solver, less its two pipes.

        copy : file that holds the configured solver, if it is an object; see
            `harness.processes.solver_file`

        Raises
        ------
        InputError
            When an option is no plain data.

        """
        request: dict[str, Any] = {
            "name": spec.name,
            "options": spec.options if copy is None else {},
            "plugins": self._absolute_files(),
        }
        if copy is not None:
            request["copy"] = str(copy)
        if spec.ranks > 1:
            request |= {"ranks": spec.ranks, "copies": spec.role == COPIES}
        name = "ranks" if spec.ranks > 1 else "worker"
        try:
            return [*self.start, name, json.dumps(request)]
        except TypeError:
            raise InputError(
                f"{spec.name}: options {shown(dict(spec.options))}; expected numbers, "
                "texts, true or false, or lists and dicts of these"
            ) from None

    def families_with_copies(self, folder: Path | None) -> Mapping[str, Family]:
        """Return the families, which take copies of files from a result folder.

        folder : which `refuse_links` has let pass; None: there are no copies
        """
        return _WithCopies(self.families, folder)

    def commands(
        self, specs: Iterable[SolverSpec], folder: Path | None = None
    ) -> Commands:
        """Return the commands that start the processes of a run.

        folder : the result folder, whose copies of files cases may be built from
        """
        from mortarbench.harness.results.work_unit import Commands

        request: dict[str, Any] = {"plugins": self._absolute_files()}
        if folder is not None:
            request["folder"] = str(folder.absolute())
        return Commands(
            solvers={s.label: self.worker_command(s) for s in specs},
            case_worker=[*self.start, "generator", json.dumps(request)],
            own_code_only=self.hold_own_code_only(),
        )

    def environment(self) -> dict[str, Any]:
        """Describe what the processes of a run measure in; see `capture`.

        In a process that is not ours, other libraries and more threads are at work.
        """
        from mortarbench.harness.environment.environment import capture, capture_in
        from mortarbench.solvers.common.libraries import PACKAGES

        if ONE_THREAD.items() <= os.environ.items():
            here = capture(self.files, PACKAGES)
            if all(pool["threads"] == 1 for pool in here["threads"]["pools"]):
                return here  # or they were set when libraries were loaded already
        return capture_in(ONE_THREAD, self.files, PACKAGES)

    def _absolute_files(self) -> list[str]:
        return [str(file.resolved()) for file in self.files]

    def suite_path(self, text: str | Path) -> Path:
        """Find a suite by path, or by its bare name among those that come with us.

        Raises
        ------
        InputError
            When there is neither.

        """
        path = checked.path("suite", text)
        if path.is_file():
            return path
        known = {p.stem: p for p in self.suites.glob("*.toml")}
        if str(text) in known:
            return known[str(text)]
        if path.exists():
            return path  # what it is instead of a file, says who reads it
        if len(path.parts) > 1 or path.suffix:
            raise InputError(f"{text}: no such file; expected a suite in TOML")
        raise unknown("suite", str(text), known)


def installed(registries: Registries) -> Registries:
    """Add what installed packages offer as entry points.

    Raises
    ------
    InputError
        When one fails to import, or one of its names exists.

    """
    return registries.extended(entry_point_plugins())


@TURN
def known(plugins: Plugins = (), registries: Registries | None = None) -> Registries:
    """Give all that is known: ours, installed plug-ins, and those in files.

    registries : what is known instead, where it is given

    Raises
    ------
    InputError
        When a plug-in cannot be loaded, or one of its names exists.

    """
    if registries is None:
        return installed(Registries()).with_files(plugins)
    if not isinstance(registries, Registries):
        raise InputError(f"registries = {shown(registries)}; expected Registries")
    return registries
