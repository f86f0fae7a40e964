"""Arguments of commands, read from the signatures and docstrings of their functions.

Every bool and `Literal` parameter of a function is an argument of its command, and so
is every parameter annotated with a text: ``Annotated[str, "--solver NAME"]``. The
text contains the name of the value in help texts and, where they differ from the name
of the parameter, the names of the option. Parameters without a default are positional
unless they are keyword-only. An option for a sequence may be repeated; it is a list
separated by commas if the name of its value contains a comma. The help text is the
first sentence on the parameter in the docstring.
"""

from __future__ import annotations

import argparse
import re
from collections.abc import Callable, Iterator, Sequence
from difflib import get_close_matches
from inspect import Parameter, getdoc, signature
from itertools import takewhile
from math import isfinite
from typing import Annotated, Any, Literal, NoReturn, get_args, get_origin

from mortarbench.harness.errors import InputError, unknown

_ENTRY = re.compile(r"\*?(\w+(?:, \w+)*) : (.+)")  #: names of parameters, and a text
_PARAMETERS = re.compile(rf"\n\n(?:Parameters\n|{_ENTRY.pattern})")  #: their beginning


class Parser(argparse.ArgumentParser):
    """Parser that raises an `InputError` if the command line is invalid."""

    def error(self, message: str) -> NoReturn:
        """Raise an `InputError` with the usage of the command."""
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
                if name.startswith("--") and name not in options:
                    near = get_close_matches(name, options, n=1)
                    hint = f"; did you mean {near[0]}?" if near else ""
                    self.error(f"unknown argument {name!r}{hint}")
        return super().parse_known_args(args, namespace)

    def _check_value(self, action: argparse.Action, value: object) -> None:
        """Suggest the most similar choice, which argparse does not before 3.14."""
        if action.choices is not None and value not in action.choices:
            what = action.metavar if isinstance(action.metavar, str) else action.dest
            self.error(str(unknown(what.lower(), str(value), action.choices)))

    def exit(self, status: int = 0, message: str | None = None) -> NoReturn:
        """Exit after a help text has been printed."""
        # flush here, where `main` handles a closed pipe, not at interpreter exit
        print(end="", flush=True)
        super().exit(status, message)

    def add_function(self, function: Callable[..., object]) -> None:
        """Describe a function, and add its arguments.

        Arguments that the user omits are absent from the result, so that the defaults
        of the function apply.
        """
        self.description = _PARAMETERS.split(getdoc(function) or "")[0]
        texts = _texts(function)
        for parameter in signature(function, eval_str=True).parameters.values():
            if names := _names(parameter):
                text = texts[parameter.name]
                self.add_argument(*names, **_settings(parameter, text, names))

    def arguments(self) -> Iterator[argparse.Action]:
        """Yield the arguments of this parser, and those of its commands."""
        for action in self._actions:
            if isinstance(action, argparse._SubParsersAction):
                for command in action.choices.values():
                    yield from command.arguments()
            else:
                yield action

    def option(self, name: str) -> str:
        """Return the option that sets a parameter, or the name of the parameter."""
        options = (a.option_strings for a in self._actions if a.dest == name)
        return next((strings[0] for strings in options if strings), name)


def _texts(function: Callable[..., object]) -> dict[str, str]:
    """Return the first sentence of the docstring on each parameter, by its name."""
    texts: dict[str, str] = {}
    names: list[str] = []
    for line in (getdoc(function) or "").splitlines():
        if entry := _ENTRY.match(line):
            names = entry[1].split(", ")
            texts.update(dict.fromkeys(names, entry[2]))
        elif line.startswith("    "):
            texts.update({name: f"{texts[name]} {line.strip()}" for name in names})
        else:
            names = []
    return {name: text.partition(". ")[0] for name, text in texts.items()}


def _type(parameter: Parameter) -> tuple[Any, str]:
    """Return the type of a parameter, and its text on the command line or ""."""
    annotation = parameter.annotation
    if get_origin(annotation) is not Annotated:
        return annotation, ""
    kind, text = get_args(annotation)
    return kind, text


def _names(parameter: Parameter) -> list[str]:
    """Return the names for argparse; [] if the command line has no such argument."""
    kind, text = _type(parameter)
    if not text and kind is not bool and get_origin(kind) is not Literal:
        return []
    if names := [word for word in text.split() if word.startswith("-")]:
        return names
    is_required = parameter.default is Parameter.empty
    if is_required and parameter.kind is not Parameter.KEYWORD_ONLY:
        return [parameter.name]
    return [f"--{parameter.name.replace('_', '-')}"]


def _settings(parameter: Parameter, text: str, names: Sequence[str]) -> dict[str, Any]:
    """Return the settings of an argument for argparse."""
    kind, value = _type(parameter)
    default = parameter.default
    if type(default) in (int, float) and isfinite(default):
        text = f"{text}; default: {default:g}"
    settings: dict[str, Any] = {"help": text.replace("``", "`").replace("%", "%%")}
    settings["default"] = argparse.SUPPRESS
    is_option = names[0].startswith("-")
    if is_option:
        settings["dest"] = parameter.name
    if kind is bool:
        return {**settings, "action": "store_true"}
    if is_option and default is Parameter.empty:
        settings["required"] = True
    if get_origin(kind) is Literal:
        return {**settings, "choices": get_args(kind)}
    settings["metavar"] = value.split()[-1]
    types = (kind, *get_args(kind))
    settings["type"] = next((t for t in (str, int, float) if t in types), str)
    if parameter.kind is Parameter.VAR_POSITIONAL:
        settings["nargs"] = "*"
    elif get_origin(kind) is Sequence:
        if "," in settings["metavar"]:
            settings["type"] = lambda texts: texts.split(",")
        elif is_option:
            settings |= {"action": "append", "help": f"{settings['help']}; repeatable"}
        else:
            settings["nargs"] = "+"
    return settings
