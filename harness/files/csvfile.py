"""CSV tables that are safe to open in spreadsheets.

Spreadsheets interpret a cell that begins with ``=``, ``+``, ``-`` or ``@`` as a
formula, so text that begins in this way is prefixed with an apostrophe. Characters that
may end a cell or reverse the direction of its text are escaped. Numbers are written
unchanged.
"""

from __future__ import annotations

import csv
import unicodedata
from collections.abc import Iterable, Sequence
from functools import lru_cache
from io import StringIO

#: first characters of formulas; the full-width characters occur in East Asian
#: spreadsheets
_FORMULA = frozenset("=+-@＝＋－＠")
#: Unicode categories of characters that programs may skip at the start of a cell
_HIDDEN = frozenset({"Cc", "Cf", "Zl", "Zp", "Zs"})
_CONTROL = frozenset({"Cc", "Cs", "Zl", "Zp"})  #: Unicode categories that are escaped
#: Direction controls, which are escaped. They are listed individually because other
#: characters of their category, Cf, are harmless, e.g. joiners of letters.
_DIRECTIONS = frozenset(
    "\u061c\u200e\u200f\u202a\u202b\u202c\u202d\u202e\u2066\u2067\u2068\u2069"
)


def csv_text(heads: Sequence[str], rows: Iterable[Sequence[object]]) -> str:
    """Return a table as CSV, with floats in full precision and empty cells for None."""
    text = StringIO(newline="")
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(map(safe, heads))
    writer.writerows(map(safe, row) for row in rows)
    return text.getvalue()


def safe(value: object) -> object:
    """Return a text without formulas and control characters; other values unchanged."""
    return visible(inert(value)) if isinstance(value, str) else value


@lru_cache(1 << 16)
def inert(text: str) -> str:
    """Prefix a text with an apostrophe if a spreadsheet would evaluate it as a formula.

    Hidden characters and spaces before the first sign are ignored, since spreadsheets
    may skip them.
    """
    for char in text:
        if char in _FORMULA:
            return f"'{text}"
        if unicodedata.category(char) not in _HIDDEN:
            break
    return text


@lru_cache(1 << 16)
def visible(text: str) -> str:
    r"""Escape control characters (``\n``), direction controls and lone surrogates."""
    if text.isascii() and text.isprintable():
        return text
    return "".join(
        char.encode("unicode_escape").decode() if _is_control(char) else char
        for char in text
    )


def _is_control(char: str) -> bool:
    return char in _DIRECTIONS or unicodedata.category(char) in _CONTROL
