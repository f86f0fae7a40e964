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
from collections.abc import Callable, Sequence
from contextlib import suppress
from difflib import get_close_matches
from importlib import import_module
from itertools import takewhile
from pathlib import Path
from typing import NoReturn

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
    _show_what_can_be_shown()
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
        return _told(e)
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


def _told(e: OSError) -> int:
    """Name the file that something is wrong with, or the disk that is full."""
    from mortarbench.harness.files.durable import (
        FULL,  # late: a help text needs no files
    )

    if e.filename is not None:
        return _complain(_remedied(e, Path(os.fsdecode(e.filename))))
    if e.errno in FULL:
        return _complain(f"a file could not be written: {e.strerror}")
    traceback.print_exc()
    return 3


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


def _show_what_can_be_shown() -> None:
    """Have a terminal of few characters show a question mark instead of a λ."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="replace")


def _print_no_more() -> None:
    """Make the last flush of the streams, when Python ends, succeed."""
    for stream in filter(None, (sys.stdout, sys.stderr)):
        os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())


_STREAMS = {
    "stdin": "r",
    "stdout": "w",
    "stderr": "w",
}  #: in the order of their numbers
_CASE = "FAMILY/key=value/…/FORM, as beam-ring/Nr=4/Nh=3/dual; see docs/cases.md"
_RESULTS = "a result folder, as `run` writes it"


class _Version(argparse.Action):
    """Prints the version that is installed, which only then is looked up."""

    def __call__(self, parser: argparse.ArgumentParser, *_: object) -> NoReturn:
        from importlib.metadata import version

        print(f"mortarbench {version('mortarbench')}")
        parser.exit()


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

    def add(name: str, what: str, module: str, more: str = "") -> _Parser:
        command: _Parser = found.add_parser(
            name,
            help=what,
            description=f"{what[0].upper()}{what[1:]}.{more and f' {more}'}",
            allow_abbrev=False,
        )
        command.set_defaults(module=f"mortarbench.cli.{module}", parser=command)
        return command

    _add_list_options(
        add("list", "show which problems, solvers or suites there are", "list_")
    )
    _add_run_options(
        add(
            "run",
            "measure what a suite asks for, and write a report on it",
            "run",
            "Results go to a folder. The same command continues a run that was "
            "interrupted, and measures nothing twice.",
        )
    )
    _add_solve_options(
        add(
            "solve",
            "run one solver on one case once, and judge its answer",
            "solve",
            "Exit code 1: the answer was not verified.",
        )
    )
    _add_export_options(
        add("export", "write the QP of a case to a file for other programs", "export")
    )
    _add_validate_options(
        add(
            "validate",
            "check the answers in a result folder against each other and the truth",
            "validate",
            "Exit code 1: a claim was refuted, or answers contradict each other.",
        )
    )
    _add_report_options(
        add(
            "report",
            "write the report on a result folder, or on what changed between several",
            "report",
        )
    )
    _add_replay_options(
        add("replay", "repeat one stored measurement, and compare", "replay")
    )
    _add_merge_options(
        add(
            "merge",
            "make one result folder of several",
            "merge",
            "A measurement that several of them hold is taken once; environments stay "
            "apart.",
        )
    )
    _add_test_options(
        add(
            "test-solver",
            "check whether a solver keeps the contract, on QPs with known solutions",
            "test_solver",
        )
    )
    _add_paper_options(
        add("paper", "make every figure and table of the paper again", "paper")
    )
    _add_json(
        add(
            "doctor",
            "say whether this machine is fit for measuring times, and what to change",
            "doctor",
        )
    )
    _add_new_options(
        add(
            "new",
            "write a solver, a problem or a suite to start from",
            "new",
            "The file passes its checks as it is. Nothing is written over.",
        )
    )
    return parser


def _add_list_options(command: _Parser) -> None:
    command.add_argument(
        "what", choices=("problems", "solvers", "suites"), help="what to show"
    )
    command.add_argument(
        "--markdown", action="store_true", help="solvers: all about them, as in docs/"
    )
    _add_plugin(command)
    _add_json(command)


def _add_solve_options(command: _Parser) -> None:
    command.add_argument("case", metavar="CASE", help=_CASE)
    command.add_argument(
        "--solver", metavar="NAME", required=True, help="a name of `list solvers`"
    )
    command.add_argument(
        "--tol",
        metavar="T",
        type=float,
        default=1e-8,
        help="relative accuracy that the solver is asked for; default: 1e-8",
    )
    _add_option(command, "an option of the solver, instead of its default")
    command.add_argument(
        "--mpi",
        "--ranks",
        metavar="N",
        type=int,
        default=1,
        help="solve on N processes of MPI; a case with feti, form dual; default: 1",
    )
    command.add_argument(
        "--plot",
        metavar="FILE.png|pdf|svg",
        type=Path,
        help="draw the deformed bodies with their stresses, and each contact enlarged",
    )
    command.add_argument(
        "--scale",
        metavar="S",
        type=float,
        help="multiply the displacement in the picture; default: 1 where it can be "
        "seen, else a round factor that the picture states; above 1, bodies in "
        "contact may seem to overlap",
    )
    command.add_argument(
        "--vtu",
        metavar="FILE.vtu",
        type=Path,
        help="write them for ParaView, and a CSV along each contact; FILE.pvd: all "
        "load steps up to this one",
    )
    command.add_argument(
        "--mesh-error",
        action="store_true",
        help="estimate the error of the mesh, too, from finer ones (at most a minute)",
    )
    _add_plugin(command)
    _add_json(command)


def _add_export_options(command: _Parser) -> None:
    command.add_argument("case", metavar="CASE", help=_CASE)
    command.add_argument(
        "file",
        metavar="FILE.npz|mat|parquet|qps",
        type=Path,
        help="for NumPy, MATLAB and Octave, qpbenchmark, or what reads QPS",
    )
    _add_plugin(command)


def _add_validate_options(command: _Parser) -> None:
    command.add_argument("folder", metavar="DIR", type=Path, help=_RESULTS)
    command.add_argument(
        "--budget",
        metavar="SECONDS",
        type=float,
        default=300.0,
        help="time to spend on finer meshes, which tell how large the errors of the "
        "meshes are; default: 300",
    )
    _add_plugin(command)
    _add_json(command)


def _add_report_options(command: _Parser) -> None:
    command.add_argument("folder", metavar="DIR", type=Path, help=_RESULTS)
    command.add_argument(
        "others",
        metavar="DIR2",
        type=Path,
        nargs="*",
        help="what changed from DIR to DIR2, and to each further one, into "
        "DIR2/report/against-DIR",
    )
    command.add_argument(
        "--format",
        metavar=",".join(FORMATS),
        default=",".join(FORMATS),
        help="what to write; default: all",
    )
    command.add_argument(
        "--factor",
        metavar="F",
        type=float,
        help="call an answer verified if every residual is within F times the "
        "tolerance; default: 10",
    )
    command.add_argument(
        "--pool-forms",
        action="store_true",
        help="compare solvers over the cases of all forms together (means, ranks and "
        "profiles); otherwise each form is compared apart",
    )
    command.add_argument(
        "--fail-on",
        metavar=",".join(GATES),
        help="exit with 1 where a verdict became worse, or a solver slower beyond "
        "chance, from DIR to DIR2",
    )
    command.add_argument(
        "--verbose",
        action="store_true",
        help="print the path of every file that was written, not of the page alone",
    )
    _add_json(command)


def _add_merge_options(command: _Parser) -> None:
    command.add_argument(
        "folders",
        metavar="DIR",
        type=Path,
        nargs="+",
        help="result folders, each as `run` or `merge` writes it",
    )
    command.add_argument(
        "--out",
        metavar="DIR",
        type=_folder,
        required=True,
        help="a new folder, or one that was merged before, which is added to",
    )


def _add_replay_options(command: _Parser) -> None:
    command.add_argument("folder", metavar="DIR", type=Path, help=_RESULTS)
    command.add_argument(
        "run_id",
        metavar="RUN_ID",
        help="which measurement: the run_id of a journal line, or its first digits; a "
        "report shows it where one points at a number",
    )
    _add_plugin(command)
    _add_json(command)


def _add_test_options(command: _Parser) -> None:
    command.add_argument(
        "solver", metavar="NAME", nargs="+", help="a solver, or a pattern such as 'p*'"
    )
    _add_plugin(command)
    shown = command.add_mutually_exclusive_group()
    shown.add_argument(
        "--markdown",
        action="store_true",
        help="show only what equivalent formulations change, as docs/weaknesses.md",
    )
    _add_json(shown)


def _add_new_options(command: _Parser) -> None:
    command.add_argument(
        "kind", choices=("solver", "problem", "suite"), help="what to write"
    )
    command.add_argument(
        "name", metavar="NAME", help="the file is NAME.py, of a suite NAME.toml"
    )


def _add_paper_options(command: _Parser) -> None:
    command.add_argument(
        "--out",
        metavar="DIR",
        type=Path,
        default=Path("out/paper"),
        help="where to write them; default: out/paper",
    )
    command.add_argument(
        "--quick", action="store_true", help="fewer sizes and repeats: a minute or so"
    )


def _add_run_options(command: _Parser) -> None:
    command.add_argument(
        "suite", metavar="SUITE.toml", help="a file, or a name of `list suites`"
    )
    command.add_argument(
        "--out",
        metavar="DIR",
        type=_folder,
        help="result folder; default: out/NAME-OF-SUITE",
    )
    command.add_argument(
        "--solver",
        metavar="NAME",
        action="append",
        default=[],
        help="measure only this solver; may be repeated",
    )
    command.add_argument(
        "--case",
        metavar="PATTERN",
        action="append",
        default=[],
        help="measure only these cases, e.g. '*/dual'; may be repeated",
    )
    _add_option(
        command,
        "an option of every solver that has it; several values are measured each",
    )
    _add_plugin(command)
    command.add_argument(
        "--repeats", metavar="N", type=int, help="instead of the suite's"
    )
    command.add_argument(
        "--time-limit",
        metavar="SECONDS",
        type=float,
        help="for each measurement, instead of the suite's",
    )
    command.add_argument(
        "--memory-limit",
        metavar="MIB",
        type=float,
        help="for each measurement, instead of the suite's",
    )
    command.add_argument(
        "--fresh", action="store_true", help="delete first what the folder holds"
    )
    command.add_argument(
        "--dask",
        metavar="ADDRESS|local",
        help="measure on the workers of a Dask scheduler, or on several processes of "
        "this machine; see docs/cluster.md",
    )
    command.add_argument(
        "--strict",
        action="store_true",
        help="exit with 1 where a claim is refuted or a solver failed",
    )
    command.add_argument(
        "--quiet",
        action="store_true",
        help="print only warnings and what could not be measured",
    )
    _add_json(command)


def _folder(text: str) -> Path:
    if not text:
        raise InputError("--out is empty; expected a folder")
    return Path(text)


def _add_option(command: _Parser, what: str) -> None:
    command.add_argument(
        "--option", metavar="KEY=VALUE", action="append", default=[], help=what
    )


def _add_plugin(command: _Parser) -> None:
    command.add_argument(
        "--plugin",
        metavar="[LABEL=]FILE.py",
        type=PluginFile.of,
        action="append",
        default=[],
        help="load solvers or problems of your own from a file; may be repeated; "
        "solvers of LABEL=FILE.py are called LABEL:NAME",
    )


def _add_json(command: argparse._ActionsContainer) -> None:
    command.add_argument("--json", action="store_true", help="print JSON")
