"""Exceptions for invalid input and for faults, and texts of messages for users."""

from __future__ import annotations

import sys
from collections.abc import Iterable
from contextlib import suppress
from difflib import get_close_matches

MAX_SHOWN = 200  #: largest number of characters of input that a message repeats
MAX_MESSAGE = 1000  #: largest number of characters of a message; paths fit


class InputError(Exception):
    """Error for invalid input.

    The message is one line, which usually states the place of the error, the value, and
    the expected value. The command line prints this line without a traceback and exits
    with code 2.
    """

    def __str__(self) -> str:
        return " ".join(super().__str__().splitlines())  # names may contain newlines


class PastEndError(InputError):
    """Error for a step after the end of a sequence, e.g. after convergence.

    If a suite requests more steps than exist, its sequence ends at the last step.
    """


class FaultError(Exception):
    """Error of the harness or the machine, such as a full disk, but not of a solver.

    The message is one line. A fault yields no verdict. The measurement is repeated
    once, and it counts as not measured if the repetition also fails.
    """


def shown(value: object) -> str:
    """Return the repr of a value for a message, without the middle of a long repr."""
    try:
        return shortened(repr(value))
    except (
        RecursionError,
        ValueError,
    ):  # the value is nested too deeply, or is an integer with too many digits
        return f"a {type(value).__name__} too long to show"


def shortened(text: str, most: int = MAX_SHOWN) -> str:
    """Replace the middle of a long text by …; names usually differ at their ends.

    >>> from mortarbench.harness.errors import shortened
    >>> shortened("beam-ring/Nr=30/Nh=15/dual", 16)
    'beam-ring/N…dual'
    """
    tail = most // 4
    return text if len(text) <= most else f"{text[: most - tail - 1]}…{text[-tail:]}"


def one_line(message: str) -> str:
    """Return a message as a single line of at most `MAX_MESSAGE` characters."""
    return shortened(" ".join(message.splitlines()), MAX_MESSAGE)


def described(e: BaseException) -> str:
    """Return the type and the message of an exception as one line."""
    return " ".join(f"{type(e).__name__}: {e}".split())


#: Hint after the list of known solvers or families in an error message.
PLUGINS = "; others come with --plugin FILE.py"


def unknown(
    what: str, got: str, known: Iterable[str], where: str = "", more: str = ""
) -> InputError:
    """Return the error for an unknown name; the message lists the known names.

    The message suggests the most similar known name, if any name is similar.

    what : type of the named object, such as "solver"
    more : text appended to the list of known names

    >>> from mortarbench.harness.errors import unknown
    >>> print(unknown("form", "duel", ["primal", "dual"], where="beam-ring"))
    beam-ring: unknown form 'duel'; did you mean 'dual'? known: dual, primal
    """
    names = sorted(known)
    folded = {name.casefold(): name for name in names}
    # the time of the search for similar names is quadratic in the length of the name
    got = shortened(got)
    near = get_close_matches(got.casefold(), folded, n=1, cutoff=0.6)
    hint = f"did you mean {folded[near[0]]!r}? " if near else ""
    prefix = f"{where}: " if where else ""
    listed = ", ".join(names) or "none"
    return InputError(f"{prefix}unknown {what} {got!r}; {hint}known: {listed}{more}")


def some(names: Iterable[str], most: int = 3) -> str:
    """Return the first `most` names as text, and the number of further names, if any.

    >>> from mortarbench.harness.errors import some
    >>> some(["a", "b", "c", "d", "e"])
    'a, b, c and 2 more'
    """
    first, rest = (listed := list(names))[:most], len(listed) - most
    return ", ".join(map(shortened, first)) + (f" and {rest} more" if rest > 0 else "")


def say(text: str) -> None:
    """Print a remark on stderr, since stdout is reserved for results."""
    with suppress(BrokenPipeError):  # a closed stderr must not stop the program
        print(f"mortarbench: {text}", file=sys.stderr)
