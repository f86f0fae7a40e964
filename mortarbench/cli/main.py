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
from collections.abc import Sequence
from contextlib import suppress
from importlib import import_module
from typing import NoReturn

import mortarbench
from mortarbench.cli.parser import Parser
from mortarbench.harness.errors import InputError, one_line
from mortarbench.harness.processes.termination import TerminatedError, ended_by_signals
from mortarbench.registries import Registries, defer_parts_of_numpy

#: Function in `mortarbench.cli` and help text of each command. The function runs the
#: command and returns its exit code. The arguments of the command are its arguments and
#: those of the function of `mortarbench` with the same name, if there is one.
COMMANDS = {
    "list": ("list.list_", "list the available problems, solvers or suites"),
    "run": ("run.run", "measure a suite and write a report on the results"),
    "solve": ("solve.solve", "run one solver on one case and verify its answer"),
    "export": ("export.export", "write the QP of a case for other programs"),
    "validate": ("folders.validate", "compare answers with reference solutions"),
    "report": ("folders.report", "write a report on a result folder, or on changes"),
    "replay": ("folders.replay", "repeat one stored measurement and compare both"),
    "merge": ("folders.merge", "merge several result folders into one"),
    "test-solver": ("test_solver.test_solver", "run the conformance suite on solvers"),
    "paper": ("paper.paper", "reproduce all figures and tables of the paper"),
    "doctor": ("doctor.doctor", "check whether this machine is fit for measurements"),
    "new": ("new.new", "write a template for a solver, a problem or a suite"),
    "dataset build": ("dataset.build_dataset", "build the public set in a folder"),
    "dataset check": ("dataset.check_dataset", "check a folder of the public set"),
    "dataset info": ("dataset.dataset_info", "show what the public set contains"),
    "dataset leaderboard": ("dataset.leaderboard", "rank solvers on the public set"),
    "completion": ("completion.completion", "print a script for bash or zsh"),
}
#: help texts of the first words of commands with two words
GROUPS = {"dataset": "build, check or describe the public set, or rank solvers on it"}


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
        _print_error(_ended("interrupted", argv))
        return 130
    except BrokenPipeError:  # e.g. `mortarbench list solvers | head -1`
        _discard_output()
        return 0
    except OSError as e:
        # imported here because a help text does not access files
        from mortarbench.harness.files.durable import FULL

        if e.filename is not None:
            return _print_error(f"{os.fsdecode(e.filename)}: {e.strerror}")
        if e.errno in FULL:
            return _print_error(f"a file could not be written: {e.strerror}")
        traceback.print_exc()
        return 3
    except Exception:
        traceback.print_exc()
        return 3


def _run(registries: Registries, argv: Sequence[str]) -> int:
    if argv[:1] == ["worker"]:  # a process of a run
        defer_parts_of_numpy()
        from mortarbench.processes import worker

        return worker(registries, argv[1:])
    if "_ARGCOMPLETE" in os.environ:  # set by the script of `completion`
        from mortarbench.cli.completion import complete

        complete(registries, command_parser(os.environ["COMP_LINE"].split()[1:]))
    options, left = command_parser(argv).parse_known_args(argv)
    arguments = vars(options)
    run, parser = arguments.pop("run"), arguments.pop("parser")
    if left:
        parser.error(f"unknown argument {left[0]!r}")
    with ended_by_signals():
        try:
            registries = registries.with_files(arguments.pop("plugins", ()))
            code: int = run(registries, **arguments)
        except InputError as e:  # names an argument of a Python function
            text = re.sub(r"^\w+(?=:? )", lambda m: parser.option(m[0]), str(e))
            raise InputError(text) from None
        except TerminatedError:
            _print_error(_ended("terminated", argv))
            raise
        # flush here, where `main` handles a closed pipe, not at interpreter exit
        print(end="", flush=True)
    return code


def _ended(how: str, argv: Sequence[str]) -> str:
    """Return the message for an interrupted or terminated command."""
    continues = argv[:1] in (["run"], ["dataset"])
    return f"{how}; the same command continues" if continues else how


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


def command_parser(argv: Sequence[str]) -> Parser:
    """Return the parser of the command line, with arguments of the command in `argv`.

    Arguments of the other commands are left out, because the modules of their functions
    take longer to import than a help text takes to print.
    """
    parser = Parser(
        prog="mortarbench",
        description="Compare QP solvers on elastic contact problems. To start: "
        "mortarbench solve beam-ring/Nr=4/Nh=3/dual --solver smalbe; then "
        "mortarbench run demo.",
        epilog="mortarbench COMMAND --help shows the options of a command.",
        allow_abbrev=False,
    )
    parser.add_argument(
        "--version",
        action=_Version,
        nargs=0,
        default=argparse.SUPPRESS,
        help="print the version and exit",
    )
    commands = parser.add_subparsers(
        metavar="COMMAND", required=True, parser_class=Parser
    )
    groups: dict[str, argparse._SubParsersAction[Parser]] = {}
    for name, (path, what) in COMMANDS.items():
        *group, last = name.split()
        if group and group[0] not in groups:
            parent = commands.add_parser(group[0], help=GROUPS[group[0]])
            groups[group[0]] = parent.add_subparsers(
                metavar="COMMAND", required=True, parser_class=Parser
            )
        under = groups[group[0]] if group else commands
        command = under.add_parser(last, help=what, allow_abbrev=False)
        if name.split() == [*argv[: len(group) + 1]]:
            module, _, function_name = path.partition(".")
            run = getattr(import_module(f"mortarbench.cli.{module}"), function_name)
            shared = getattr(mortarbench, function_name, None)
            for function in (shared, run) if shared else (run,):
                command.add_function(function)
            command.set_defaults(run=run, parser=command)
    return parser
