"""Building a case: the code of a family, which may fail in any way or print."""

from __future__ import annotations

import sys
from contextlib import redirect_stdout

from harness.errors import InputError
from harness.names import CaseName
from harness.plugin import Case, Family, Reference


def build(name: CaseName, family: Family, reference: Reference) -> Case:
    """Build a case; what its family prints goes to stderr, and what it raises through.

    Raises
    ------
    TypeError
        When the family returns something else.

    """
    with redirect_stdout(sys.stderr):
        case = family.build(name.form, name.params, reference)
    if not isinstance(case, Case):
        raise TypeError(f"build returned {type(case).__name__}, expected Case")
    return case


def unbuilt(name: str, e: BaseException) -> str:
    """Say in one line why `build` could not build the case of that name."""
    match e:
        case InputError():
            why = str(e)
        case MemoryError():
            why = "it needs more memory than there is"
        case _:
            why = f"{type(e).__name__}: {e}"
    return " ".join(f"{name} could not be built: {why}".split())
