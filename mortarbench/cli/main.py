"""The command line: options, exit codes, and which function does what.

Exit codes: 0 done; 1 done, and the answer is no; 2 the input was wrong, one line on
stderr; 3 a fault of ours, with a traceback; 129 hung up (SIGHUP), 130 interrupted, 143
terminated (SIGTERM).
"""

from __future__ import annotations

import argparse
import io
import os
import re
import sys
import traceback
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from difflib import get_close_matches
from importlib import import_module
from itertools import takewhile
from pathlib import Path
from typing import Any, NamedTuple, NoReturn

from mortarbench.arguments import FORMATS, GATES
from mortarbench.harness.errors import InputError, one_line
from mortarbench.harness.processes.termination import TerminatedError, ended_by_signals
from mortarbench.harness.registry import PluginFile
from mortarbench.registries import Registries, defer_parts_of_numpy, installed

_Run = Callable[[Registries, argparse.Namespace], int]  #: returns the exit code


class _Parser(argparse.ArgumentParser):
    """A parser for which a bad command line is bad input like any other: one line."""

    def error(self, message: str) -> NoReturn:
        usage = " ".join(self.format_usage().split())
        stop = " " if message.endswith("?") else "; "
        raise InputError(f"{message}{stop}{usage}; {self.prog} --help tells more")

    def parse_known_args(  # type: ignore[override]  # argparse overloads it
        self,
        args: Sequence[str] | None = None,
        namespace: argparse.Namespace | None = None,
    ) -> tuple[argparse.Namespace, list[str]]:
        """Parse the options of a command, after naming one that it does not have.

        argparse would miss a required option before it saw the misspelt one.
        """
        if self._subparsers is None:  # a command
            known = [name for name in self._option_string_actions if len(name) > 2]
            for text in takewhile(lambda text: text != "--", args or ()):
                name = text.partition("=")[0]
                if text.startswith("--") and name not in known:
                    near = get_close_matches(name, known, n=1)
                    hint = f"; did you mean {near[0]}?" if near else ""
                    self.error(f"unknown argument {name!r}{hint}")
        return super().parse_known_args(args, namespace)

    def exit(self, status: int = 0, message: str | None = None) -> NoReturn:
        """End after a help text, while a reader that has gone is no surprise."""
        print(end="", flush=True)
        super().exit(status, message)


def main(registries: Registries, argv: Sequence[str]) -> int:
    """Run one command and return its exit code."""
    _open_standard_streams()
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="replace")
    try:
        return _run(registries, argv)
    except InputError as e:
        return _complain(str(e))
    except KeyboardInterrupt:
        goes_on = "; the same command continues" if argv[:1] == ["run"] else ""
        _complain(f"interrupted{goes_on}")
        return 130
    except BrokenPipeError:  # as of `mortarbench list solvers | head -1`
        _print_no_more()
        return 0
    except OSError as e:
        # late: a help text needs no files
        from mortarbench.harness.files.durable import FULL

        if e.filename is not None:
            return _complain(_remedied(e, Path(os.fsdecode(e.filename))))
        if e.errno in FULL:
            return _complain(f"a file could not be written: {e.strerror}")
        traceback.print_exc()
        return 3
    except Exception:
        traceback.print_exc()
        return 3


def _run(registries: Registries, argv: Sequence[str]) -> int:
    registries = installed(registries)
    if argv[:1] in (["worker"], ["ranks"], ["generator"]):  # how runs start processes
        defer_parts_of_numpy()
        from mortarbench import processes

        starts = {
            "worker": processes.worker, "ranks": processes.ranks,
            "generator": processes.case_worker,
        }  # fmt: skip
        return starts[argv[0]](registries, argv[1:])
    for argument in takewhile(lambda text: text != "--", argv):
        if re.fullmatch(r"--[\w-]+=--", argument):  # argparse would drop the value
            option = argument.removesuffix("=--")
            raise InputError(f"{argument}: -- is no value; expected {option}=VALUE")
    options, left = _parser().parse_known_args(argv)
    if left:
        options.parser.error(f"unknown argument {left[0]!r}")
    with ended_by_signals():
        run: _Run = import_module(options.module).run
        try:
            code = run(registries, options)
        except TerminatedError:
            if argv[:1] != ["run"]:  # which says that it can be continued
                _complain("terminated")
            raise
        print(end="", flush=True)  # here, where a reader that has gone is no surprise
    return code


def _remedied(e: OSError, path: Path) -> str:
    """Say what is wrong with a file, and what would be right where that is plain."""
    if isinstance(e, FileExistsError | NotADirectoryError):
        path = next((p for p in (path, *path.parents) if p.is_file()), path)
        return f"{path}: a file is where a folder is needed; move the file away"
    return f"{path}: {e.strerror}"


def _complain(message: str) -> int:
    """Say in one line what is wrong, and return the exit code of wrong input."""
    with suppress(OSError):  # nobody reads it
        print(f"mortarbench: {one_line(message)}", file=sys.stderr, flush=True)
    return 2


def _open_standard_streams() -> None:
    """Open /dev/null where a standard stream is closed.

    Its number would else be that of the next file, into which libraries would print.
    """
    while (fd := os.open(os.devnull, os.O_RDWR)) < len(_STREAMS):
        os.set_inheritable(fd, True)
    os.close(fd)
    for fd, (name, mode) in enumerate(_STREAMS.items()):
        if getattr(sys, name) is None:
            setattr(sys, name, os.fdopen(fd, mode, closefd=False))


def _print_no_more() -> None:
    """Make the last flush of the streams, when Python ends, succeed."""
    for stream in filter(None, (sys.stdout, sys.stderr)):
        os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())


_STREAMS = {
    "stdin": "r",
    "stdout": "w",
    "stderr": "w",
}  #: in the order of their numbers


class _Version(argparse.Action):
    """Prints the version that is installed, which only then is looked up."""

    def __call__(self, parser: argparse.ArgumentParser, *_: object) -> NoReturn:
        from importlib.metadata import version

        print(f"mortarbench {version('mortarbench')}")
        parser.exit()


class _Option(NamedTuple):
    """One argument of a command: an option, or a position where it has no dashes."""

    names: str  #: separated by spaces
    metavar: str  #: empty: a flag, or one of `choices`
    what: str  #: its help
    settings: Mapping[str, Any] = {}  #: of argparse, beside those of the metavar

    def add_to(self, command: argparse._ActionsContainer) -> None:
        """Declare it to argparse."""
        settings: dict[str, Any] = {"help": self.what, **self.settings}
        if self.metavar:
            kind = _KINDS.get(self.metavar)
            settings = {"metavar": self.metavar, **({"type": kind} if kind else {}),
                        **settings}  # fmt: skip
        elif "choices" not in settings:
            settings["action"] = "store_true"
        command.add_argument(*self.names.split(), **settings)


def _folder(text: str) -> Path:
    if not text:
        raise InputError("--out is empty; expected a folder")
    return Path(text)


#: types of arguments, by their metavar; others are texts
_KINDS: Mapping[str, Callable[[str], Any]] = {
    "DIR": Path, "DIR2": Path, "FILE.npz|mat|parquet|qps": Path,
    "FILE.png|pdf|svg": Path, "FILE.vtu": Path, "[LABEL=]FILE.py": PluginFile.of,
    "T": float, "S": float, "F": float, "SECONDS": float, "MIB": float, "N": int,
}  # fmt: skip
_SEVERAL = {"action": "append", "default": []}
_JSON = _Option("--json", "", "print JSON")
_MARKDOWN = "--markdown"
_PLUGIN = _Option(
    "--plugin",
    "[LABEL=]FILE.py",
    "load solvers or problems of your own from a file; may be repeated; solvers of "
    "LABEL=FILE.py are called LABEL:NAME",
    _SEVERAL,
)
_CASE = _Option(
    "case", "CASE", "FAMILY/key=value/…/FORM, as beam-ring/Nr=4/Nh=3/dual; see "
    "docs/cases.md",
)  # fmt: skip
_RESULTS = _Option("folder", "DIR", "a result folder, as `run` writes it")
_INSTEAD = "for each measurement, instead of the suite's"


def _option(what: str) -> _Option:
    return _Option("--option", "KEY=VALUE", what, _SEVERAL)


class _Command(NamedTuple):
    """One command: its module in `mortarbench.cli`, help, and arguments."""

    module: str
    what: str
    options: Sequence[_Option]
    more: str = ""  #: behind `what` in its own help
    excluding: Sequence[_Option] = ()  #: of which one can be given


_COMMANDS = {
    "list": _Command(
        "list_",
        "show which problems, solvers or suites there are",
        [
            _Option("what", "", "what to show",
                    {"choices": ("problems", "solvers", "suites")}),
            _Option(_MARKDOWN, "", "solvers: all about them, as in docs/"),
            _PLUGIN,
            _JSON,
        ],
    ),
    "run": _Command(
        "run",
        "measure what a suite asks for, and write a report on it",
        [
            _Option("suite", "SUITE.toml", "a file, or a name of `list suites`"),
            _Option("--out", "DIR", "result folder; default: out/NAME-OF-SUITE",
                    {"type": _folder}),
            _Option("--solver", "NAME", "measure only this solver; may be repeated",
                    _SEVERAL),
            _Option("--case", "PATTERN",
                    "measure only these cases, e.g. '*/dual'; may be repeated",
                    _SEVERAL),
            _option("an option of every solver that has it; several values are "
                    "measured each"),
            _PLUGIN,
            _Option("--repeats", "N", "instead of the suite's"),
            _Option("--time-limit", "SECONDS", _INSTEAD),
            _Option("--memory-limit", "MIB", _INSTEAD),
            _Option("--fresh", "", "delete first what the folder holds"),
            _Option("--dask", "ADDRESS|local", "measure on the workers of a Dask "
                    "scheduler, or on several processes of this machine; see "
                    "docs/cluster.md"),
            _Option("--strict", "", "exit with 1 where a claim is refuted or a solver "
                    "failed"),
            _Option("--quiet", "", "print only warnings and what could not be "
                    "measured"),
            _JSON,
        ],
        "Results go to a folder. The same command continues a run that was "
        "interrupted, and measures nothing twice.",
    ),
    "solve": _Command(
        "solve",
        "run one solver on one case once, and judge its answer",
        [
            _CASE,
            _Option("--solver", "NAME", "a name of `list solvers`",
                    {"required": True}),
            _Option("--tol", "T", "relative accuracy that the solver is asked for; "
                    "default: 1e-8", {"default": 1e-8}),
            _option("an option of the solver, instead of its default"),
            _Option("--mpi --ranks", "N", "solve on N processes of MPI; a case with "
                    "feti, form dual; default: 1", {"default": 1}),
            _Option("--plot", "FILE.png|pdf|svg", "draw the deformed bodies with their "
                    "stresses, and each contact enlarged"),
            _Option("--scale", "S", "multiply the displacement in the picture; "
                    "default: 1 where it can be seen, else a round factor that the "
                    "picture states; above 1, bodies in contact may seem to overlap"),
            _Option("--vtu", "FILE.vtu", "write them for ParaView, and a CSV along "
                    "each contact; FILE.pvd: all load steps up to this one"),
            _Option("--mesh-error", "", "estimate the error of the mesh, too, from "
                    "finer ones (at most a minute)"),
            _PLUGIN,
            _JSON,
        ],
        "Exit code 1: the answer was not verified.",
    ),
    "export": _Command(
        "export",
        "write the QP of a case to a file for other programs",
        [
            _CASE,
            _Option("file", "FILE.npz|mat|parquet|qps", "for NumPy, MATLAB and "
                    "Octave, qpbenchmark, or what reads QPS"),
            _PLUGIN,
        ],
    ),
    "validate": _Command(
        "validate",
        "check the answers in a result folder against each other and the truth",
        [
            _RESULTS,
            _Option("--budget", "SECONDS", "time to spend on finer meshes, which tell "
                    "how large the errors of the meshes are; default: 300",
                    {"default": 300.0}),
            _PLUGIN,
            _JSON,
        ],
        "Exit code 1: a claim was refuted, or answers contradict each other.",
    ),
    "report": _Command(
        "report",
        "write the report on a result folder, or on what changed between several",
        [
            _RESULTS,
            _Option("others", "DIR2", "what changed from DIR to DIR2, and to each "
                    "further one, into DIR2/report/against-DIR", {"nargs": "*"}),
            _Option("--format", ",".join(FORMATS), "what to write; default: all",
                    {"default": ",".join(FORMATS)}),
            _Option("--factor", "F", "call an answer verified if every residual is "
                    "within F times the tolerance; default: 10"),
            _Option("--pool-forms", "", "compare solvers over the cases of all forms "
                    "together (means, ranks and profiles); otherwise each form is "
                    "compared apart"),
            _Option("--fail-on", ",".join(GATES), "exit with 1 where a verdict became "
                    "worse, or a solver slower beyond chance, from DIR to DIR2"),
            _Option("--verbose", "", "print the path of every file that was written, "
                    "not of the page alone"),
            _JSON,
        ],
    ),
    "replay": _Command(
        "replay",
        "repeat one stored measurement, and compare",
        [
            _RESULTS,
            _Option("run_id", "RUN_ID", "which measurement: the run_id of a journal "
                    "line, or its first digits; a report shows it where one points at "
                    "a number"),
            _PLUGIN,
            _JSON,
        ],
    ),
    "merge": _Command(
        "merge",
        "make one result folder of several",
        [
            _Option("folders", "DIR", "result folders, each as `run` or `merge` writes "
                    "it", {"nargs": "+"}),
            _Option("--out", "DIR", "a new folder, or one that was merged before, "
                    "which is added to", {"type": _folder, "required": True}),
        ],
        "A measurement that several of them hold is taken once; environments stay "
        "apart.",
    ),
    "test-solver": _Command(
        "test_solver",
        "check whether a solver keeps the contract, on QPs with known solutions",
        [
            _Option("solver", "NAME", "a solver, or a pattern such as 'p*'",
                    {"nargs": "+"}),
            _PLUGIN,
        ],
        excluding=[
            _Option(_MARKDOWN, "", "show only what equivalent formulations change, as "
                    "docs/weaknesses.md"),
            _JSON,
        ],
    ),
    "paper": _Command(
        "paper",
        "make every figure and table of the paper again",
        [
            _Option("--out", "DIR", "where to write them; default: out/paper",
                    {"default": Path("out/paper")}),
            _Option("--quick", "", "fewer sizes and repeats: a minute or so"),
        ],
    ),
    "doctor": _Command(
        "doctor",
        "say whether this machine is fit for measuring times, and what to change",
        [_JSON],
    ),
    "new": _Command(
        "new",
        "write a solver, a problem or a suite to start from",
        [
            _Option("kind", "", "what to write",
                    {"choices": ("solver", "problem", "suite")}),
            _Option("name", "NAME", "the file is NAME.py, of a suite NAME.toml"),
        ],
        "The file passes its checks as it is. Nothing is written over.",
    ),
}  # fmt: skip


def _parser() -> argparse.ArgumentParser:
    parser = _Parser(
        prog="mortarbench",
        description="Compare QP solvers on elastic contact problems. To begin with: "
        "mortarbench solve beam-ring/Nr=4/Nh=3/dual --solver smalbe; then "
        "mortarbench run demo.",
        epilog="mortarbench COMMAND --help tells the options of a command.",
        allow_abbrev=False,
    )
    parser.add_argument(
        "--version", action=_Version, nargs=0, help="print the version, and end"
    )
    found = parser.add_subparsers(
        metavar="COMMAND", required=True, parser_class=_Parser
    )
    for name, of in _COMMANDS.items():
        text = f"{of.what[0].upper()}{of.what[1:]}.{of.more and f' {of.more}'}"
        command = found.add_parser(
            name, help=of.what, description=text, allow_abbrev=False
        )
        command.set_defaults(module=f"mortarbench.cli.{of.module}", parser=command)
        for option in of.options:
            option.add_to(command)
        if of.excluding:
            group = command.add_mutually_exclusive_group()
            for option in of.excluding:
                option.add_to(group)
    return parser
