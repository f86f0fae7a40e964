"""Exceptions and messages for users: input errors, faults, remarks on stderr."""

from __future__ import annotations

import os
import re
import sys
from collections.abc import Iterable
from contextlib import suppress
from difflib import get_close_matches

MAX_SHOWN = 200  #: number of characters of the user's input that a message repeats
_MAX_MESSAGE = 600  #: largest number of characters of a message, without paths
#: Quotations and words. Possessive quantifiers bound the time for adversarial input.
_PIECES = re.compile(r"""'(?:[^'\\]|\\.)*+'|"(?:[^"\\]|\\.)*+"|\S++""")


class InputError(Exception):
    """Invalid input: one line that states what is wrong, where, and what is expected.

    The command line prints it without a traceback and exits with code 2.
    """

    def __str__(self) -> str:
        return " ".join(super().__str__().splitlines())  # names may contain newlines


class PastEndError(InputError):
    """Error for a step beyond the end of a sequence, such as a converged fixed point.

    A sequence with more steps is truncated at the last existing step.
    """


class FaultError(Exception):
    """A fault of the harness or the machine, such as a full disk; never of a solver.

    The message is one line. A fault yields no verdict: the measurement is retried once,
    and counts as not measured if it fails again.
    """


def shown(value: object) -> str:
    """Return the repr of a value for a message; abridge it in the middle if long."""
    try:
        return shortened(repr(value))
    except (
        RecursionError,
        ValueError,
    ):  # nested too deeply; an integer of too many digits
        return f"a {type(value).__name__} too long to show"


def shortened(text: str, most: int = MAX_SHOWN) -> str:
    """Replace the middle of a long text by …, since names differ at their ends.

    >>> from mortarbench.harness.errors import shortened
    >>> shortened("beam-ring/Nr=30/Nh=15/dual", 16)
    'beam-ring/N…dual'
    """
    tail = most // 4
    return text if len(text) <= most else f"{text[: most - tail - 1]}…{text[-tail:]}"


def one_line(message: str) -> str:
    """Return a message as one line that repeats little of a long input.

    Long words and quotations are shortened, then the whole line. Paths that exist are
    not shortened, since users copy them.
    """
    line = " ".join(message.splitlines())
    if len(line) <= MAX_SHOWN:
        return line
    paths: list[str] = []

    def brief(piece: re.Match[str]) -> str:
        text = piece[0]
        if len(text) > MAX_SHOWN and os.path.lexists(text.strip("'\"").rstrip(":,;")):
            paths.append(text)
            return text
        return shortened(text)

    line = _PIECES.sub(brief, line)
    return shortened(line, _MAX_MESSAGE + sum(map(len, paths)))


PLUGINS = "; others come with --plugin FILE.py"  #: follows a list of known names


def unknown(
    what: str, got: str, known: Iterable[str], where: str = "", more: str = ""
) -> InputError:
    """Return the error for an unknown name, with the known names and the nearest.

    more : text after the known names

    >>> from mortarbench.harness.errors import unknown
    >>> print(unknown("form", "duel", ["primal", "dual"], where="beam-ring"))
    beam-ring: unknown form 'duel'; did you mean 'dual'? known: dual, primal
    """
    names = sorted(known)
    folded = {name.casefold(): name for name in names}
    got = shortened(got)  # the search below takes O(length²)
    near = get_close_matches(got.casefold(), folded, n=1, cutoff=0.6)
    hint = f"did you mean {folded[near[0]]!r}? " if near else ""
    prefix = f"{where}: " if where else ""
    listed = ", ".join(names) or "none"
    return InputError(f"{prefix}unknown {what} {got!r}; {hint}known: {listed}{more}")


def some(names: Iterable[str], most: int = 3) -> str:
    """Return the first few names, and the number of the others.

    >>> from mortarbench.harness.errors import some
    >>> some(["a", "b", "c", "d", "e"])
    'a, b, c and 2 more'
    """
    first, rest = (listed := list(names))[:most], len(listed) - most
    return ", ".join(map(shortened, first)) + (f" and {rest} more" if rest > 0 else "")


def say(text: str) -> None:
    """Print a remark on stderr; results go to stdout."""
    with suppress(BrokenPipeError):  # a closed stderr must not end the program
        print(f"mortarbench: {text}", file=sys.stderr)
