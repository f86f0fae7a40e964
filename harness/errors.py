"""What we tell a user whose input was wrong."""

from __future__ import annotations

from collections.abc import Iterable
from difflib import get_close_matches


class InputError(Exception):
    """Bad input: one line that says what was wrong, where, and what would be right.

    The command line prints it without a traceback and exits with code 2.
    """


class FaultError(Exception):
    """A fault of ours or of the machine, never a solver's: a full disk, a lost file.

    One line says what failed. It costs no solver a verdict: what was being measured is
    tried once more, and counts as not measured if that fails, too.
    """


MOST_SHOWN = 200  #: characters of input that a message repeats


def shortened(text: str, most: int = MOST_SHOWN) -> str:
    """Cut what a message repeats of the input."""
    return text if len(text) <= most else text[: most - 1] + "…"


PLUGINS = "; others come with --plugin FILE.py"  #: after the names that are known


def unknown(
    what: str, got: str, known: Iterable[str], where: str = "", more: str = ""
) -> InputError:
    """Build the error for a name that is not among `known`, with the nearest one.

    more : what follows the known names
    """
    got = shortened(got)  # also because the search takes a time ~ length²
    names = sorted(known)
    folded = {name.casefold(): name for name in names}
    near = get_close_matches(got.casefold(), folded, n=1, cutoff=0.6)
    hint = f"did you mean {folded[near[0]]!r}? " if near else ""
    prefix = f"{where}: " if where else ""
    listed = ", ".join(names) or "none"
    return InputError(f"{prefix}unknown {what} {got!r}; {hint}known: {listed}{more}")


def some(names: Iterable[str], most: int = 3) -> str:
    """Enumerate the first few of `names`, and say how many more there are."""
    first, rest = (listed := list(names))[:most], len(listed) - most
    return ", ".join(first) + (f" and {rest} more" if rest > 0 else "")
