r"""Formulas in prose, LaTeX between \( and \), for pages and for Markdown."""

from __future__ import annotations

import re
from functools import cache
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from math_core import LatexToMathML

_FORMULA = re.compile(r"\\\((.*?)\\\)", re.DOTALL)


def split(text: str) -> list[str]:
    """Split prose into alternating text and formulas, text first."""
    return _FORMULA.split(text)


def mathml(tex: str, *, display: bool = False) -> str:
    r"""Convert one formula to MathML Core, which browsers render without a script.

    Parameters
    ----------
    tex : LaTeX without delimiters; ``\tag{1}`` numbers a displayed formula
    display : True for a formula on its own line

    Raises
    ------
    ValueError
        If a command is unknown or a brace is missing.

    """
    from math_core import LatexError  # imported here: only pages with formulas need it

    if display and r"\tag{" in tex and r"\begin{" not in tex:
        tex = rf"\begin{{equation}}{tex}\end{{equation}}"
    try:
        return str(_converter().convert_with_local_state(tex, displaystyle=display))
    except LatexError as e:
        raise ValueError(f"formula {tex}: {e}") from None


@cache
def _converter() -> LatexToMathML:
    from math_core import LatexToMathML

    return LatexToMathML()
