"""The command line: options, exit codes, and which function does what.

Exit codes: 0 done; 1 done, and the answer is no; 2 the input was wrong, one line on
stderr; 3 a fault of ours, with a traceback; 130 interrupted.
"""

from __future__ import annotations

import argparse
import io
import os
import sys
import traceback
from collections.abc import Callable, Sequence
from importlib import import_module
from pathlib import Path
from typing import NoReturn

from harness.errors import InputError, one_line
from harness.registry import PluginFile
from mortarbench.arguments import FORMATS
from mortarbench.registries import Registries, installed

_Run = Callable[[Registries, argparse.Namespace], int]  #: returns the exit code


class _Parser(argparse.ArgumentParser):
    """A parser for which a bad command line is bad input like any other: one line."""

    def error(self, message: str) -> NoReturn:
        usage = " ".join(self.format_usage().split())
        raise InputError(f"{message}; {usage}")

    def exit(self, status: int = 0, message: str | None = None) -> NoReturn:
        """End after a help text, while a reader that has gone is no surprise."""
        print(end="", flush=True)
        super().exit(status, message)


def main(registries: Registries, argv: Sequence[str]) -> int:
    """Run one command and return its exit code."""
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
    if argv[:1] in (["worker"], ["generator"]):  # how runs start their processes
        from mortarbench.cli import processes

        start = processes.worker if argv[0] == "worker" else processes.case_worker
        return start(registries, argv[1:])
    options, left = _parser().parse_known_args(argv)
    if left:
        options.parser.error(f"unknown argument {left[0]!r}")
    run: _Run = import_module(options.module).run
    code = run(registries, options)
    print(end="", flush=True)  # here, where a reader that has gone is no surprise
    return code


def _told(e: OSError) -> int:
    """Name the file that something is wrong with, or the disk that is full."""
    from harness.files.durable import FULL  # late: a help text needs no files

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
    print(f"mortarbench: {one_line(message)}", file=sys.stderr)
    return 2


def _show_what_can_be_shown() -> None:
    """Have a terminal of few characters show a question mark instead of a λ."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="replace")


def _print_no_more() -> None:
    """Make the last flush of the streams, when Python ends, succeed."""
    for stream in filter(None, (sys.stdout, sys.stderr)):
        os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())


def _parser() -> argparse.ArgumentParser:
    parser = _Parser(
        prog="mortarbench",
        description="Compare QP solvers on elastic contact problems.",
        allow_abbrev=False,
    )
    found = parser.add_subparsers(
        metavar="COMMAND", required=True, parser_class=_Parser
    )

    def add(name: str, what: str, module: str) -> _Parser:
        command: _Parser = found.add_parser(name, help=what, allow_abbrev=False)
        command.set_defaults(module=f"mortarbench.cli.{module}", parser=command)
        return command

    _add_list_options(add("list", "what there is", "list_"))
    _add_run_options(add("run", "measure a suite; continues a run", "run"))
    _add_solve_options(add("solve", "one solver on one case, once", "solve"))
    _add_export_options(add("export", "one QP as a file", "export"))
    _add_validate_options(
        add("validate", "do all answers of a folder agree", "validate")
    )
    _add_report_options(add("report", "report on a result folder", "report"))
    _add_replay_options(add("replay", "one measurement again", "replay"))
    _add_test_options(
        add("test-solver", "the conformance suite, on solvers", "test_solver")
    )
    _add_new_options(add("new", "a solver, problem or suite to start from", "new"))
    _add_paper_options(add("paper", "every figure of the paper", "paper"))
    _add_json(add("doctor", "is this machine fit to measure", "doctor"))
    return parser


def _add_list_options(command: _Parser) -> None:
    command.add_argument("what", choices=("problems", "solvers", "suites"))
    command.add_argument(
        "--markdown", action="store_true", help="solvers: all about them, as in docs/"
    )
    _add_plugin(command)
    _add_json(command)


def _add_solve_options(command: _Parser) -> None:
    command.add_argument("case", metavar="CASE", help="FAMILY/key=value/…/FORM")
    command.add_argument("--solver", metavar="NAME", required=True)
    command.add_argument("--tol", metavar="T", type=float, default=1e-8)
    _add_option(command, "of the solver, instead of its default")
    command.add_argument(
        "--plot", metavar="FILE.png", type=Path, help="the deformed bodies"
    )
    command.add_argument(
        "--vtu",
        metavar="FILE.vtu",
        type=Path,
        help="the same for ParaView; FILE.pvd: all load steps up to this one",
    )
    _add_plugin(command)
    _add_json(command)


def _add_export_options(command: _Parser) -> None:
    command.add_argument("case", metavar="CASE")
    command.add_argument("file", metavar="FILE.npz|mat|parquet|qps", type=Path)
    _add_plugin(command)


def _add_validate_options(command: _Parser) -> None:
    command.add_argument("folder", metavar="DIR", type=Path)
    command.add_argument(
        "--budget",
        metavar="SECONDS",
        type=float,
        default=300.0,
        help="for finer meshes, that tell discretisation errors; default: 300",
    )
    _add_plugin(command)
    _add_json(command)


def _add_report_options(command: _Parser) -> None:
    command.add_argument("folder", metavar="DIR", type=Path)
    command.add_argument(
        "other",
        metavar="DIR2",
        type=Path,
        nargs="?",
        help="what changed from DIR to DIR2, into DIR2/report/against-DIR",
    )
    command.add_argument(
        "--format", metavar=",".join(FORMATS), default=",".join(FORMATS)
    )
    command.add_argument(
        "--factor",
        metavar="F",
        type=float,
        help="verified: every residual within F times the tolerance; default: 10",
    )


def _add_replay_options(command: _Parser) -> None:
    command.add_argument("folder", metavar="DIR", type=Path)
    command.add_argument(
        "run_id", metavar="RUN_ID", help="of a journal line, or its first digits"
    )
    _add_plugin(command)
    _add_json(command)


def _add_test_options(command: _Parser) -> None:
    command.add_argument("solver", metavar="NAME", nargs="+", help="or a pattern")
    _add_plugin(command)
    shown = command.add_mutually_exclusive_group()
    shown.add_argument(
        "--markdown",
        action="store_true",
        help="only what equivalent formulations change, as in docs/weaknesses.md",
    )
    _add_json(shown)


def _add_new_options(command: _Parser) -> None:
    command.add_argument("kind", choices=("solver", "problem", "suite"))
    command.add_argument(
        "name", metavar="NAME", help="the file is NAME.py, of a suite NAME.toml"
    )


def _add_paper_options(command: _Parser) -> None:
    command.add_argument("--out", metavar="DIR", type=Path, default=Path("out/paper"))
    command.add_argument(
        "--quick", action="store_true", help="fewer sizes and repeats: a minute or so"
    )


def _add_run_options(command: _Parser) -> None:
    command.add_argument("suite", metavar="SUITE.toml", help="or the name of a suite")
    command.add_argument(
        "--out", metavar="DIR", type=_folder, help="default: out/NAME-OF-SUITE"
    )
    command.add_argument(
        "--solver", metavar="NAME", action="append", default=[], help="only this one"
    )
    command.add_argument(
        "--case", metavar="PATTERN", action="append", default=[], help="only these"
    )
    _add_option(command, "of the solvers that have it; VALUE,VALUE measures both")
    _add_plugin(command)
    command.add_argument("--repeats", metavar="N", type=int)
    command.add_argument("--time-limit", metavar="SECONDS", type=float)
    command.add_argument("--memory-limit", metavar="MIB", type=float)
    command.add_argument(
        "--fresh", action="store_true", help="forget what the folder holds"
    )
    command.add_argument(
        "--dask",
        metavar="ADDRESS|local",
        help="measure on the workers of a Dask scheduler, see docs/cluster.md",
    )


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
        help="more solvers or problems; of LABEL=FILE.py solvers are LABEL:NAME",
    )


def _add_json(command: argparse._ActionsContainer) -> None:
    command.add_argument("--json", action="store_true", help="for machines")
