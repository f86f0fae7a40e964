"""What a user is told: errors of the input, faults, remarks beside the results."""

from __future__ import annotations

import os
import re
import sys
from collections.abc import Iterable
from contextlib import suppress
from difflib import get_close_matches

MOST_SHOWN = 200  #: characters of somebody's input that a message repeats
_MOST_WORDS = 600  #: characters of a message without the paths in it
_PIECES = re.compile(r"""'(?:[^'\\]|\\.)*+'|"(?:[^"\\]|\\.)*+"|\S++""")


class InputError(Exception):
    """Bad input: one line that says what was wrong, where, and what would be right.

    The command line prints it without a traceback and exits with code 2.
    """

    def __str__(self) -> str:
        return " ".join(super().__str__().splitlines())  # of names, too


class PastEndError(InputError):
    """There are fewer problems than that, as of a fixed point that has settled before.

    A sequence that asks for more ends at the last one there is.
    """


class FaultError(Exception):
    """A fault of ours or of the machine, never a solver's: a full disk, a lost file.

    One line says what failed. It costs no solver a verdict: what was being measured is
    tried once more, and counts as not measured if that fails, too.
    """


def shown(value: object) -> str:
    """Show a value of somebody's input in a message, the middle left out if need be."""
    try:
        return shortened(repr(value))
    except (RecursionError, ValueError):  # nested for ever; an integer of many digits
        return f"a {type(value).__name__} too long to show"


def shortened(text: str, most: int = MOST_SHOWN) -> str:
    """Leave the middle out of what is too long; names differ at their ends."""
    tail = most // 4
    return text if len(text) <= most else f"{text[: most - tail - 1]}…{text[-tail:]}"


def one_line(message: str) -> str:
    """Bring a message to one line that repeats little of a long input.

    Every word or quotation is cut, and the middle of what is left; paths that exist are
    not, since one needs them whole.
    """
    line = " ".join(message.splitlines())
    if len(line) <= MOST_SHOWN:
        return line
    paths: list[str] = []

    def brief(piece: re.Match[str]) -> str:
        text = piece[0]
        if len(text) > MOST_SHOWN and os.path.lexists(text.strip("'\"").rstrip(":,;")):
            paths.append(text)
            return text
        return shortened(text)

    line = _PIECES.sub(brief, line)
    return shortened(line, _MOST_WORDS + sum(map(len, paths)))


PLUGINS = "; others come with --plugin FILE.py"  #: after the names that are known


def unknown(
    what: str, got: str, known: Iterable[str], where: str = "", more: str = ""
) -> InputError:
    """Build the error for a name that is not among `known`, with the nearest one.

    more : what follows the known names
    """
    names = sorted(known)
    folded = {name.casefold(): name for name in names}
    got = shortened(got)  # also because the search takes a time ~ length²
    near = get_close_matches(got.casefold(), folded, n=1, cutoff=0.6)
    hint = f"did you mean {folded[near[0]]!r}? " if near else ""
    prefix = f"{where}: " if where else ""
    listed = ", ".join(names) or "none"
    return InputError(f"{prefix}unknown {what} {got!r}; {hint}known: {listed}{more}")


def some(names: Iterable[str], most: int = 3) -> str:
    """Enumerate the first few of `names`, and say how many more there are."""
    first, rest = (listed := list(names))[:most], len(listed) - most
    return ", ".join(map(shortened, first)) + (f" and {rest} more" if rest > 0 else "")


def say(text: str) -> None:
    """Say something on stderr, beside the results."""
    with suppress(BrokenPipeError):  # nobody listens: no reason to stop
        print(f"mortarbench: {text}", file=sys.stderr)
