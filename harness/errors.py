"""What we tell a user whose input was wrong."""

from __future__ import annotations

from collections.abc import Iterable
from difflib import get_close_matches


class InputError(Exception):
    """Bad input: one line that says what was wrong, where, and what would be right.

    The command line prints it without a traceback and exits with code 2.
    """


def unknown(what: str, got: str, known: Iterable[str], where: str = "") -> InputError:
    """Build the error for a name that is not among `known`, with the nearest one."""
    names = sorted(known)
    near = get_close_matches(got, names, n=1, cutoff=0.4)
    hint = f"did you mean {near[0]!r}? " if near else ""
    prefix = f"{where}: " if where else ""
    return InputError(
        f"{prefix}unknown {what} {got!r}; {hint}known: {', '.join(names) or 'none'}"
    )
