"""Command line: commands with their options, and exit codes.

The exit codes are 0 for success, 1 for completion with a negative result, 2 for invalid
input (with one line on stderr), 3 for an internal error (with a traceback), 129 after
SIGHUP, 130 after an interrupt and 143 after SIGTERM.
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
from math import inf
from pathlib import Path
from typing import Any, NamedTuple, NoReturn

from mortarbench.arguments import FORMATS, GATES
from mortarbench.harness.errors import InputError, one_line
from mortarbench.harness.processes.termination import TerminatedError, ended_by_signals
from mortarbench.harness.registry import PluginFile
from mortarbench.registries import Registries, defer_parts_of_numpy, installed

_Run = Callable[[Registries, argparse.Namespace], int]  #: command; returns an exit code


class _Parser(argparse.ArgumentParser):
    """Parser that raises an `InputError` if the command line is invalid."""

    def error(self, message: str) -> NoReturn:
        usage = " ".join(self.format_usage().split())
        stop = " " if message.endswith("?") else "; "
        raise InputError(f"{message}{stop}{usage}; see {self.prog} --help")

    def parse_known_args(  # type: ignore[override]  # argparse overloads it
        self,
        args: Sequence[str] | None = None,
        namespace: argparse.Namespace | None = None,
    ) -> tuple[argparse.Namespace, list[str]]:
        """Check that all options of a command are known, then parse the arguments.

        Without this check, argparse would report a misspelt required option as missing.
        """
        if self._subparsers is None:  # a command
            options = [name for name in self._option_string_actions if len(name) > 2]
            for text in takewhile(lambda text: text != "--", args or ()):
                name = text.partition("=")[0]
                if text.startswith("--") and name not in options:
                    near = get_close_matches(name, options, n=1)
                    hint = f"; did you mean {near[0]}?" if near else ""
                    self.error(f"unknown argument {name!r}{hint}")
        return super().parse_known_args(args, namespace)

    def exit(self, status: int = 0, message: str | None = None) -> NoReturn:
        """Exit after a help text has been printed."""
        # flush here, where `main` handles a closed pipe, not at interpreter exit
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
        return _print_error(str(e))
    except KeyboardInterrupt:
        goes_on = "; the same command continues" if argv[:1] == ["run"] else ""
        _print_error(f"interrupted{goes_on}")
        return 130
    except BrokenPipeError:  # e.g. `mortarbench list solvers | head -1`
        _discard_output()
        return 0
    except OSError as e:
        # imported here because a help text does not access files
        from mortarbench.harness.files.durable import FULL

        if e.filename is not None:
            return _print_error(_file_error(e, Path(os.fsdecode(e.filename))))
        if e.errno in FULL:
            return _print_error(f"a file could not be written: {e.strerror}")
        traceback.print_exc()
        return 3
    except Exception:
        traceback.print_exc()
        return 3


def _run(registries: Registries, argv: Sequence[str]) -> int:
    registries = installed(registries)
    if argv[:1] in (["worker"], ["ranks"]):  # processes of a run
        defer_parts_of_numpy()
        from mortarbench import processes

        start = processes.worker if argv[0] == "worker" else processes.ranks
        return start(registries, argv[1:])
    for argument in takewhile(lambda text: text != "--", argv):
        if re.fullmatch(r"--[\w-]+=--", argument):  # argparse would ignore this value
            option = argument.removesuffix("=--")
            raise InputError(f"{argument}: -- is not a value; expected {option}=VALUE")
    options, left = _parser().parse_known_args(argv)
    if left:
        options.parser.error(f"unknown argument {left[0]!r}")
    with ended_by_signals():
        run: _Run = import_module(options.module).run
        try:
            code = run(registries, options)
        except TerminatedError:
            if argv[:1] != ["run"]:  # `run` prints its own message
                _print_error("terminated")
            raise
        # flush here, where `main` handles a closed pipe, not at interpreter exit
        print(end="", flush=True)
    return code


def _file_error(e: OSError, path: Path) -> str:
    """Return the one-line message for an operating-system error concerning a file."""
    if isinstance(e, FileExistsError | NotADirectoryError):
        path = next((p for p in (path, *path.parents) if p.is_file()), path)
        return f"{path}: a file exists where a folder is needed; move the file away"
    return f"{path}: {e.strerror}"


def _print_error(message: str) -> int:
    """Print an error in one line; return the exit code of invalid input."""
    with suppress(OSError):  # stderr may be closed
        print(f"mortarbench: {one_line(message)}", file=sys.stderr, flush=True)
    return 2


def _open_standard_streams() -> None:
    """Open /dev/null for standard streams that are closed.

    Otherwise the next file that is opened would get the file descriptor of the stream,
    and libraries would print into this file.
    """
    while (fd := os.open(os.devnull, os.O_RDWR)) < len(_STREAMS):
        os.set_inheritable(fd, True)
    os.close(fd)
    for fd, (name, mode) in enumerate(_STREAMS.items()):
        if getattr(sys, name) is None:
            setattr(sys, name, os.fdopen(fd, mode, closefd=False))


def _discard_output() -> None:
    """Redirect the streams to /dev/null, so that the flush at exit does not fail."""
    for stream in filter(None, (sys.stdout, sys.stderr)):
        os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())


_STREAMS = {
    "stdin": "r",
    "stdout": "w",
    "stderr": "w",
}  #: modes of the standard streams, in the order of their file descriptors


class _Version(argparse.Action):
    """Action that looks up the installed version and prints it."""

    def __call__(self, parser: argparse.ArgumentParser, *_: object) -> NoReturn:
        from importlib.metadata import version

        print(f"mortarbench {version('mortarbench')}")
        parser.exit()


class _Option(NamedTuple):
    """Argument of a command: an option, or positional if its name has no dashes."""

    names: str  #: names, separated by spaces
    #: name of the value in help texts; empty for a flag or an argument with `choices`
    metavar: str
    what: str  #: help text
    settings: Mapping[str, Any] = {}  #: further settings of argparse

    def add_to(self, command: argparse._ActionsContainer) -> None:
        """Add the argument to a parser of argparse."""
        settings: dict[str, Any] = {"help": self.what, **self.settings}
        if self.metavar:
            kind = _KINDS.get(self.metavar)
            settings = {
                "metavar": self.metavar,
                **({"type": kind} if kind else {}),
                **settings,
            }
        elif "choices" not in settings:
            settings["action"] = "store_true"
        command.add_argument(*self.names.split(), **settings)


def _folder(text: str) -> Path:
    if not text:
        raise InputError("--out is empty; expected a folder")
    return Path(text)


#: types of arguments by metavar; arguments with other metavars are strings
_KINDS: Mapping[str, Callable[[str], Any]] = {
    "DIR": Path,
    "DIR2": Path,
    "FILE.npz|mat|parquet|qps|hdf5": Path,
    "FILE.png|pdf|svg": Path,
    "FILE.vtu": Path,
    "[LABEL=]FILE.py": PluginFile.of,
    "T": float,
    "S": float,
    "F": float,
    "SECONDS": float,
    "MIB": float,
    "N": int,
}
_SEVERAL = {"action": "append", "default": []}
_JSON = _Option("--json", "", "print JSON")
_MARKDOWN = "--markdown"
_PLUGIN = _Option(
    "--plugin",
    "[LABEL=]FILE.py",
    "load your own solvers or problems from a file; may be repeated; solvers of "
    "LABEL=FILE.py are named LABEL:NAME",
    _SEVERAL,
)
_CASE = _Option(
    "case",
    "CASE",
    "FAMILY/key=value/…/FORM, for example beam-ring/Nr=4/Nh=3/dual; see docs/cases.md",
)
_RESULTS = _Option("folder", "DIR", "result folder of `run`")
_INSTEAD = "limit for each measurement; overrides the limit in the suite"


def _option(what: str) -> _Option:
    return _Option("--option", "KEY=VALUE", what, _SEVERAL)


class _Command(NamedTuple):
    """Subcommand with its module in `mortarbench.cli`, its help and its arguments."""

    module: str  #: module name, without `mortarbench.cli`
    what: str  #: help text
    options: Sequence[_Option]  #: arguments of the command
    more: str = ""  #: further sentences of ``COMMAND --help``
    excluding: Sequence[_Option] = ()  #: options that exclude each other


_COMMANDS = {
    "list": _Command(
        "list_",
        "list the available problems, solvers or suites",
        [
            _Option(
                "what",
                "",
                "what to list",
                {"choices": ("problems", "solvers", "suites")},
            ),
            _Option(
                _MARKDOWN, "", "solvers: print the notes on all solvers as Markdown"
            ),
            _PLUGIN,
            _JSON,
        ],
    ),
    "run": _Command(
        "run",
        "measure a suite and write a report on the results",
        [
            _Option("suite", "SUITE.toml", "a file, or a name from `list suites`"),
            _Option(
                "--out",
                "DIR",
                "result folder; default: out/NAME-OF-SUITE",
                {"type": _folder},
            ),
            _Option(
                "--solver",
                "NAME",
                "measure only this solver; may be repeated",
                _SEVERAL,
            ),
            _Option(
                "--case",
                "PATTERN",
                "measure only these cases, e.g. '*/dual'; may be repeated",
                _SEVERAL,
            ),
            _option(
                "set an option of every solver that has it, or of one by SOLVER.KEY; "
                "if it is set several times, every value is measured"
            ),
            _PLUGIN,
            _Option(
                "--repeats", "N", "number of repeats; overrides the number in the suite"
            ),
            _Option("--time-limit", "SECONDS", _INSTEAD),
            _Option("--memory-limit", "MIB", _INSTEAD),
            _Option("--fresh", "", "delete the previous results in the folder first"),
            _Option(
                "--dask",
                "ADDRESS|local",
                "measure on the workers of the Dask scheduler at ADDRESS, or (local) "
                "in several processes on this machine; see docs/cluster.md",
            ),
            _Option(
                "--strict",
                "",
                "exit with 1 if a claim is refuted, or a solver fails or reaches a "
                "limit",
            ),
            _Option("--quiet", "", "print only warnings and missing measurements"),
            _JSON,
        ],
        "Results are stored in a folder. The same command continues an interrupted "
        "run without repeating a measurement.",
    ),
    "solve": _Command(
        "solve",
        "run one solver on one case, once, and verify its answer",
        [
            _CASE,
            _Option(
                "--solver", "NAME", "a name from `list solvers`", {"required": True}
            ),
            _Option(
                "--tol",
                "T",
                "requested relative accuracy; default: 1e-8",
                {"default": 1e-8},
            ),
            _option("set an option of the solver"),
            _Option(
                "--time-limit",
                "SECONDS",
                "limit for the solve; default: 300",
                {"default": 300.0},
            ),
            _Option(
                "--mpi --ranks",
                "N",
                "solve on N MPI processes; N > 1 only for cases that are decomposed "
                "into subdomains; default: 1",
                {"default": 1},
            ),
            _Option(
                "--plot",
                "FILE.png|pdf|svg",
                "draw the deformed bodies with their "
                "stresses, and each contact enlarged",
            ),
            _Option(
                "--scale",
                "S",
                "magnification of the displacements in the picture; default: 1 if the "
                "displacements are then visible, else a rounded value, which the "
                "picture states; magnified bodies in contact may appear to overlap",
            ),
            _Option(
                "--vtu",
                "FILE.vtu",
                "write the deformed bodies for ParaView, and a CSV file for each "
                "contact; FILE.pvd: write all load steps up to this one",
            ),
            _Option(
                "--out",
                "FILE.npz",
                "write x, the multipliers y, z and z_box and, for bodies, the "
                "displacements of the nodes",
                {"type": Path},
            ),
            _PLUGIN,
            _JSON,
        ],
        "Exit code 1: the answer is not verified.",
    ),
    "export": _Command(
        "export",
        "write the QP of a case to a file for other programs",
        [
            _CASE,
            _Option(
                "file",
                "FILE.npz|mat|parquet|qps|hdf5",
                "file to write; the suffix selects the format: npz (NumPy), mat "
                "(MATLAB, Octave), parquet (qpbenchmark), qps, or hdf5 (FCLIB)",
            ),
            _PLUGIN,
        ],
    ),
    "validate": _Command(
        "validate",
        "compare the answers in a result folder with reference solutions",
        [
            _RESULTS,
            _Option(
                "--budget",
                "SECONDS",
                "time after which no further case is begun; default: no limit",
                {"default": inf},
            ),
            _PLUGIN,
            _JSON,
        ],
        "Exit code 1: a claim is refuted, or answers contradict each other.",
    ),
    "report": _Command(
        "report",
        "write the report on a result folder, or on changes between result folders",
        [
            _RESULTS,
            _Option(
                "others",
                "DIR2",
                "report the changes from DIR to DIR2, and to "
                "each further folder, in DIR2/report/against-DIR",
                {"nargs": "*"},
            ),
            _Option(
                "--format",
                ",".join(FORMATS),
                "formats to write; default: all",
                {"default": ",".join(FORMATS)},
            ),
            _Option(
                "--factor",
                "F",
                "an answer is verified if every residual or, with a proven optimum, "
                "its error is at most F times the tolerance; default: 10",
            ),
            _Option(
                "--pool-forms",
                "",
                "compute means, ranks and profiles over the cases of all forms "
                "together, not within each form",
            ),
            _Option(
                "--fail-on",
                ",".join(GATES),
                "exit with 1 if, from DIR to DIR2, "
                "a verdict became worse (worse) or a solver "
                "became significantly slower (slower)",
            ),
            _Option(
                "--verbose",
                "",
                "print the paths of all written files, not only the path of the page",
            ),
            _JSON,
        ],
    ),
    "replay": _Command(
        "replay",
        "repeat one stored measurement and compare it with the old one",
        [
            _RESULTS,
            _Option(
                "run_id",
                "RUN_ID",
                "run_id of a line of the journal, or SESSION-RUN_ID, or the first "
                "digits; an HTML report shows it when the mouse points at a number",
            ),
            _PLUGIN,
            _JSON,
        ],
    ),
    "merge": _Command(
        "merge",
        "merge several result folders into one",
        [
            _Option(
                "folders", "DIR", "result folders of `run` or `merge`", {"nargs": "+"}
            ),
            _Option(
                "--out",
                "DIR",
                "a new folder, or the result of an earlier merge, which is extended",
                {"type": _folder, "required": True},
            ),
        ],
        "Duplicate measurements are stored once; environments are kept separate.",
    ),
    "test-solver": _Command(
        "test_solver",
        "run the conformance suite on solvers: QPs with known solutions",
        [
            _Option(
                "solver", "NAME", "a solver, or a pattern such as 'p*'", {"nargs": "+"}
            ),
            _PLUGIN,
            _Option(
                "--time-limit",
                "SECONDS",
                "limit for each check; default: 10",
                {"default": 10.0},
            ),
        ],
        excluding=[
            _Option(
                _MARKDOWN,
                "",
                "print only how answers change under equivalent formulations, as a "
                "page",
            ),
            _JSON,
        ],
    ),
    "paper": _Command(
        "paper",
        "reproduce all figures and tables of the paper",
        [
            _Option(
                "--out",
                "DIR",
                "folder for the results; default: out/paper",
                {"default": Path("out/paper")},
            ),
            _Option("--quick", "", "use fewer sizes and repeats; takes about a minute"),
        ],
    ),
    "doctor": _Command(
        "doctor",
        "check whether this machine is suitable for measurements",
        [_JSON],
    ),
    "new": _Command(
        "new",
        "write a template for a solver, a problem or a suite",
        [
            _Option(
                "kind",
                "",
                "kind of the template",
                {"choices": ("solver", "problem", "suite")},
            ),
            _Option("name", "NAME", "the file is NAME.py, or NAME.toml for a suite"),
        ],
        "The file passes all checks unchanged. Existing files are not overwritten.",
    ),
}


def _parser() -> argparse.ArgumentParser:
    parser = _Parser(
        prog="mortarbench",
        description="Compare QP solvers on elastic contact problems. To start: "
        "mortarbench solve beam-ring/Nr=4/Nh=3/dual --solver smalbe; then "
        "mortarbench run demo.",
        epilog="mortarbench COMMAND --help shows the options of a command.",
        allow_abbrev=False,
    )
    parser.add_argument(
        "--version", action=_Version, nargs=0, help="print the version and exit"
    )
    commands = parser.add_subparsers(
        metavar="COMMAND", required=True, parser_class=_Parser
    )
    for name, spec in _COMMANDS.items():
        text = f"{spec.what[0].upper()}{spec.what[1:]}.{spec.more and f' {spec.more}'}"
        command = commands.add_parser(
            name, help=spec.what, description=text, allow_abbrev=False
        )
        command.set_defaults(module=f"mortarbench.cli.{spec.module}", parser=command)
        for option in spec.options:
            option.add_to(command)
        if spec.excluding:
            group = command.add_mutually_exclusive_group()
            for option in spec.excluding:
                option.add_to(group)
    return parser
