"""Arguments of commands, which are those of the Python functions."""

import os
import subprocess
import sys
from collections.abc import Sequence
from inspect import signature
from pathlib import Path
from typing import Annotated, Literal

import pytest

import mortarbench as mb
from mortarbench.cli.main import COMMANDS, command_parser
from mortarbench.cli.parser import Parser
from mortarbench.harness.errors import InputError

#: options that other people's scripts use
PROMISED = {
    "list": "--json",
    "run": "--out --solver --case --plugin --repeats --time-limit --memory-limit "
    "--fresh --dask --option --strict --quiet --json",
    "solve": "--solver --tol --option --plugin --json --plot --scale --vtu --out "
    "--time-limit --mpi --ranks",
    "export": "",
    "validate": "--json --plugin --budget",
    "report": "--format --factor --fail-on --verbose --json",
    "merge": "--out",
    "new": "",
    "test-solver": "--plugin --markdown",
    "paper": "--out --quick",
    "replay": "--plugin --json",
    "doctor": "--json",
}


def cook(
    dish: Annotated[str, "DISH"],
    kind: Literal["soup", "cake"],
    *,
    heat: Annotated[float, "DEGREES"] = 180.0,
    hands: Annotated[int | None, "--cooks --hands N"] = None,
    herbs: Annotated[Sequence[str], "--herb NAME"] = (),
    colours: Annotated[Sequence[str], "red,green"] = (),
    quick: bool = False,
    helper: object = None,
):
    """Cook a dish.

    It is served at once.

    Parameters
    ----------
    dish, kind : name and kind of the dish
    heat : temperature of the oven, such
        as 200. In Python also a number of an older oven
    hands : number of cooks
    herbs : herbs to add
    colours : colours of the dish
    quick : do not wait
    helper : not an argument of the command
    """


@pytest.fixture
def parser():
    made = Parser(prog="cook", allow_abbrev=False)
    made.add_function(cook)
    return made


def test_arguments_have_the_types_of_the_signature(parser):
    words = "pie cake --heat 2e2 --hands 3 --herb dill --herb mint --colours red,green"

    assert vars(parser.parse_args(words.split())) == {
        "dish": "pie", "kind": "cake", "heat": 200.0, "hands": 3,
        "herbs": ["dill", "mint"], "colours": ["red", "green"],
    }  # fmt: skip


def test_omitted_options_leave_the_defaults_to_the_function(parser):
    assert vars(parser.parse_args(["pie", "soup"])) == {"dish": "pie", "kind": "soup"}


def test_help_texts_are_the_first_sentences_of_the_docstring(parser):
    text = " ".join(parser.format_help().split())

    assert "Cook a dish. It is served at once. positional" in text
    assert "--heat DEGREES temperature of the oven, such as 200; default: 180 " in text
    assert "--cooks N, --hands N number of cooks --herb" in text
    assert "older oven" not in text
    assert "helper" not in text


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("pie tea", "unknown kind 'tea'; known: cake, soup; usage: cook"),
        ("pie", "required: kind"),
        ("pie cake --heat x", "argument --heat: invalid float value: 'x'"),
        ("pie cake --haet 3", "unknown argument '--haet'; did you mean --heat?"),
    ],
)
def test_a_wrong_command_line_is_refused_in_one_line(parser, words, message):
    with pytest.raises(InputError, match=r"cook|VALUE") as e:
        parser.parse_args(words.split())
    assert message in str(e.value)


@pytest.mark.parametrize("name", PROMISED)
def test_a_command_has_the_promised_options(name):
    options = {o for a in command_parser([name]).arguments() for o in a.option_strings}

    assert options >= set(PROMISED[name].split())
    assert COMMANDS.keys() >= PROMISED.keys()


@pytest.mark.parametrize(
    "name",
    ["run", "solve", "export", "validate", "report", "merge", "replay", "test-solver"],
)
def test_a_command_passes_its_options_to_the_python_function_of_its_name(name):
    """All options that are not about output are parameters of the function."""
    function = getattr(mb, name.replace("-", "_"))
    shared = set(signature(function).parameters)
    printed = {"json", "quiet", "verbose", "strict", "markdown", "plot", "scale", "vtu"}
    given = {a.dest for a in command_parser([name]).arguments()}
    output = printed | {"help", "version", "option", "solvers", "out"}

    assert given - output <= shared


def completions(line):
    """Return the words that bash offers at the end of a line."""
    program = (
        'eval "$(mortarbench completion bash)"; COMP_LINE="$1"; COMP_POINT=${#1}; '
        "COMP_TYPE=9; _python_argcomplete mortarbench; "
        'printf "%s\\n" "${COMPREPLY[@]}"'
    )
    folder = Path(sys.executable).parent
    done = subprocess.run(
        ["bash", "-c", program, "bash", line],
        env=os.environ | {"PATH": f"{folder}:{os.environ['PATH']}"},
        capture_output=True, text=True, check=True,
    )  # fmt: skip
    return done.stdout.split()


def test_a_shell_completes_commands_options_and_names():
    assert completions("mortarbench va") == ["validate"]
    assert completions("mortarbench run sm") == ["smoke"]
    assert "beam-ring/dual" in completions("mortarbench solve beam-")
    assert completions("mortarbench solve x --ti") == ["--time-limit"]
    assert "smalbe" in completions("mortarbench solve x --solver smal")
