"""Registries of families, solvers and suites, including those of plug-ins."""

from __future__ import annotations

import json
import sys
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from importlib.util import LazyLoader, find_spec, module_from_spec
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from mortarbench.harness import checked
from mortarbench.harness.errors import InputError, shown, unknown
from mortarbench.harness.plugin import Family, Reference, Solver
from mortarbench.harness.processes.locks import ForkSafeLock
from mortarbench.harness.registry import (
    Plugin,
    PluginFile,
    SolverSpec,
    entry_points_of,
    load_plugin,
    merged,
    options_of,
    resolve,
)
from mortarbench.problems import OPERATORS, PROBLEMS
from mortarbench.solvers import SOLVERS

if TYPE_CHECKING:
    from mortarbench.harness.operators import Maker
    from mortarbench.harness.qp import QP
    from mortarbench.harness.results.work_unit import Commands
    from mortarbench.harness.solution import Solution

#: Lock that lets only one thread at a time load plug-ins, build, solve or validate.
#: These actions change global state of the process: the number of threads, standard
#: output and the registered modules.
TURN = ForkSafeLock()

#: Python files that define SOLVERS or PROBLEMS; a string may have the form
#: LABEL=FILE.py. The text is the option of commands
Plugins = Annotated[Sequence[str | Path | PluginFile], "--plugin [LABEL=]FILE.py"]


def _plugin_files(files: Plugins) -> list[PluginFile]:
    """Check that `files` is a list of Python files; return the plug-in files."""
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
    """Return the folder of the suites: in the package, or in a checkout beside it."""
    inside = Path(__file__).parent / "suites"
    return inside if inside.is_dir() else Path(__file__).parents[1] / "suites"


@contextmanager
def one_thread() -> Iterator[None]:
    """Limit every library to one thread, as in the processes of a run.

    With several threads, sums are evaluated in a different order, and the last digits
    of a QP may differ. Only one thread at a time can enter this context; others wait.
    """
    from scipy import linalg  # threadpoolctl limits only libraries that are loaded
    from sksparse import cholmod
    from threadpoolctl import threadpool_limits

    del linalg, cholmod
    with TURN, threadpool_limits(limits=1):
        yield


def defer_parts_of_numpy() -> None:
    """Defer the execution of numpy's modules f2py and testing to their first use.

    mortarbench does not use these modules, but `scipy._lib.array_api_compat.numpy`
    accesses every name of numpy and thus imports them, which takes a quarter of a
    worker's start-up time.
    """
    import numpy

    for part in ("f2py", "testing"):
        spec = find_spec(f"numpy.{part}")
        if spec is None or spec.loader is None or spec.name in sys.modules:
            continue
        spec.loader = LazyLoader(spec.loader)
        module = sys.modules[spec.name] = module_from_spec(spec)
        spec.loader.exec_module(module)
        setattr(numpy, part, module)  # so that numpy.__getattr__ does not import it


def reference(qp: QP) -> Solution:
    """Solve a QP almost to rounding accuracy with a solver that is not under test.

    The KKT residual by which the harness judges answers selects the point.
    """
    from mortarbench.harness.verify.kkt import kkt_residuals
    from mortarbench.solvers.reference.solve import reference_solution

    return reference_solution(qp, lambda qp, s: kkt_residuals(qp, s).worst)


@dataclass(frozen=True, kw_only=True)
class Registries:
    """Families, solvers and operators, and the commands that start processes."""

    families: Mapping[str, Family] = field(default_factory=lambda: PROBLEMS)
    solvers: Mapping[str, Solver] = field(default_factory=lambda: SOLVERS)
    reference: Reference = reference
    #: functions that construct an operator P, see `harness.operators`
    operators: Mapping[str, Maker] = field(default_factory=lambda: OPERATORS)
    #: operators that do not come from plug-in files
    own_operators: Mapping[str, Maker] = field(default_factory=lambda: OPERATORS)
    suites: Path = field(default_factory=suites_folder)  #: folder of the suites
    #: plug-in files, which are also loaded by the processes of a run
    files: tuple[PluginFile, ...] = ()
    #: origin (file or package) of each family that comes from a plug-in, by family name
    origins: Mapping[str, str] = field(default_factory=dict)
    #: First arguments of the command line of each process. The option -P prevents
    #: Python from importing files in the working directory instead of libraries.
    start: Sequence[str] = (sys.executable, "-P", "-m", "mortarbench")

    def extended(self, plugin: Plugin) -> Registries:
        """Return registries extended by the contents of a plug-in.

        Raises
        ------
        InputError
            If a name in the plug-in exists already.

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
        """Return registries extended by the plug-ins in `files` that are not loaded.

        Raises
        ------
        InputError
            If a plug-in cannot be loaded, or a name in it exists already.

        """
        extended = self
        loaded = {file.resolved() for file in self.files}
        for file in _plugin_files(files):
            if file.resolved() in loaded:
                continue
            plugin = load_plugin(file)
            with checked.located(f"{file.path}"):
                extended = extended.extended(plugin)
            extended = replace(extended, files=(*extended.files, file))
        return extended

    def worker_command(
        self, spec: SolverSpec, copy: Path | None = None, *, records: bool = False
    ) -> list[str]:
        """Return the command that starts the worker of a solver.

        The caller appends the file descriptors of the worker's two pipes.

        copy : file that contains the configured solver if it was passed as an object,
            see `harness.processes.solver_file`; else None
        records : True if the solver records its iterations, see `with_history`

        Raises
        ------
        InputError
            If an option cannot be written as JSON.

        """
        request: dict[str, Any] = {
            "solver": vars(spec if copy is None else replace(spec, options={})),
            "plugins": self._absolute_files(spec.name.partition(":")[0]),
            "records": records,
        }
        if copy is not None:
            request["copy"] = str(copy)
        try:
            return [*self.start, "worker", json.dumps(request)]
        except TypeError:
            raise InputError(
                f"{spec.name}: options {shown(dict(spec.options))}; expected numbers, "
                "strings, true or false, or lists and dicts of these"
            ) from None

    def commands(self, specs: Iterable[SolverSpec]) -> Commands:
        """Return the commands that start the processes of a run."""
        from mortarbench.harness.results.work_unit import Commands

        request = {"plugins": self._absolute_files()}
        return Commands(
            solvers={s.label: self.worker_command(s) for s in specs},
            case_worker=[*self.start, "worker", json.dumps(request)],
            own_code_only=self.hold_only_builtins(),
        )

    def hold_only_builtins(self) -> bool:
        """Return True if neither a file nor an installed package adds a plug-in."""
        groups = "mortarbench.problems", "mortarbench.solvers"
        installed = any(entry_points_of(group) for group in groups)
        return self.solvers is SOLVERS and not self.files and not installed

    def environment(self) -> dict[str, Any]:
        """Return the environment of the processes of a run; see `capture`."""
        from mortarbench.harness.environment.environment import capture
        from mortarbench.solvers.common.libraries import PACKAGES

        return capture(self.files, PACKAGES)

    def _absolute_files(self, label: str = "") -> list[str]:
        """Return the plug-in files, those with a label first.

        Imports in calls search the folders of the plug-ins in this order, and two
        versions of a plug-in import different modules with the same names.
        """
        files = sorted(self.files, key=lambda file: file.label != label)
        return [str(file.resolved()) for file in files]

    def suite_path(self, text: str | Path) -> Path:
        """Return the path of a suite, specified by its path or by its name in `suites`.

        Raises
        ------
        InputError
            If there is no such file and no suite of this name.

        """
        path = checked.path("suite", text)
        if path.is_file() or path.suffix or len(path.parts) > 1:
            return path
        suites = {p.stem: p for p in self.suites.glob("*.toml")}
        if str(text) not in suites:
            raise unknown("suite", str(text), suites)
        return suites[str(text)]


def with_history(spec: SolverSpec, solvers: Mapping[str, Solver]) -> SolverSpec:
    """Return a spec that records the iterations, unless its options decide otherwise.

    Recording slows down a solver, but times of single solves are not used in
    comparisons.
    """
    has_option = options_of(resolve(spec, solvers)).get("history") is False
    if not has_option or "history" in spec.options:
        return spec
    return replace(spec, options={**spec.options, "history": True})


@TURN
def load_registries(
    plugins: Plugins = (), registries: Registries | None = None
) -> Registries:
    """Return the built-in registries extended by installed plug-ins and plug-in files.

    plugins : plug-in files
    registries : if not None, these registries are returned unchanged

    Raises
    ------
    InputError
        If a plug-in cannot be loaded, or a name in it exists already.

    """
    if registries is None:
        return Registries().with_files(plugins)
    if not isinstance(registries, Registries):
        raise InputError(f"registries = {shown(registries)}; expected Registries")
    return registries
