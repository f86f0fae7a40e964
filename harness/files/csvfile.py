"""CSV tables that are safe to open in spreadsheets.

Spreadsheets interpret a cell that begins with ``=``, ``+``, ``-`` or ``@`` as a
formula, so text that begins in this way is prefixed with an apostrophe. Characters that
are not printable, which may end a cell or reverse the direction of its text, are
escaped, except joiners of letters. Numbers are written unchanged.
"""

from __future__ import annotations

import csv
from collections.abc import Iterable, Sequence
from functools import lru_cache
from io import StringIO

#: first characters of formulas; the full-width characters occur in East Asian
#: spreadsheets
_FORMULA = tuple("=+-@＝＋－＠")
_JOINERS = "\u200c\u200d"  #: characters that are not printable, but part of words


def csv_text(heads: Sequence[str], rows: Iterable[Sequence[object]]) -> str:
    """Return a table as CSV, with floats in full precision and empty cells for None."""
    text = StringIO(newline="")
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(map(safe, heads))
    writer.writerows(map(safe, row) for row in rows)
    return text.getvalue()


def safe(value: object) -> object:
    """Return a text without formulas and control characters; other values unchanged."""
    return inert(visible(value)) if isinstance(value, str) else value


def inert(text: str) -> str:
    """Prefix a text with an apostrophe if a spreadsheet would evaluate it as a formula.

    Spaces before the first sign are ignored, since spreadsheets may skip them.
    """
    return f"'{text}" if text.lstrip().startswith(_FORMULA) else text


@lru_cache(1 << 16)
def visible(text: str) -> str:
    r"""Escape characters that are not printable, such as ``\n`` and lone surrogates."""
    return "".join(
        char
        if char.isprintable() or char in _JOINERS
        else char.encode("unicode_escape").decode()
        for char in text
    )
