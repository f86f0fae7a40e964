"""CSV tables whose texts are texts, also in spreadsheets.

A spreadsheet takes a cell that begins with ``=``, ``+``, ``-`` or ``@`` for a formula,
and control characters may end a cell or turn its direction. Numbers are written as they
are; a text that would be a formula gets an apostrophe in front, as one types it there.
"""

from __future__ import annotations

import csv
import unicodedata
from collections.abc import Iterable, Sequence
from functools import lru_cache
from io import StringIO

_FORMULA = frozenset("=+-@＝＋－＠")  #: the wide ones in East Asian spreadsheets
_HIDDEN = frozenset({"Cc", "Cf", "Zl", "Zp", "Zs"})  #: categories that programs skip
_CONTROL = frozenset({"Cc", "Cs", "Zl", "Zp"})
#: controls of the category Cf, which has the joiners of scripts and symbols, too
_DIRECTIONS = frozenset("\u061c\u200e\u200f\u202a\u202b\u202c\u202d\u202e"
                        "\u2066\u2067\u2068\u2069")  # fmt: skip


def csv_text(heads: Sequence[str], rows: Iterable[Sequence[object]]) -> str:
    """Write a table with a row of heads; of a float all digits, None as nothing."""
    text = StringIO(newline="")
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(map(_cell, heads))
    writer.writerows(map(_cell, row) for row in rows)
    return text.getvalue()


def _cell(value: object) -> object:
    return visible(inert(value)) if isinstance(value, str) else value


@lru_cache(1 << 16)
def inert(text: str) -> str:
    """Put an apostrophe before a text that a spreadsheet would take for a formula.

    What a program may skip before the sign does not hide it.
    """
    for char in text:
        if char in _FORMULA:
            return f"'{text}"
        if unicodedata.category(char) not in _HIDDEN:
            break
    return text


@lru_cache(1 << 16)
def visible(text: str) -> str:
    r"""Spell out controls, direction overrides and lone surrogates, as ``\n``."""
    if text.isascii() and text.isprintable():
        return text
    return "".join(
        char.encode("unicode_escape").decode() if _is_control(char) else char
        for char in text
    )


def _is_control(char: str) -> bool:
    return char in _DIRECTIONS or unicodedata.category(char) in _CONTROL
