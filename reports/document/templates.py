"""Sentences of pages, from the Jinja template beside each module.

The template NAME.j2 belongs to the module NAME.py. Each of its macros writes a
sentence, a caption or several paragraphs of plain text, which renderers escape. Macros
take unformatted numbers and names; the formats of `reports.document.formatting` are
filters.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from functools import cache, cached_property
from importlib.resources import files
from typing import Any

from jinja2 import Environment, StrictUndefined

from mortarbench.reports.document import formatting
from mortarbench.reports.document.layout import Point
from mortarbench.reports.statistics.intervals import COVERAGE

_FORMATS = (
    "clean",
    "estimate",
    "listing",
    "plural",
    "power",
    "seconds",
    "significant",
    "tolerance",
)
_SPACE = re.compile(r"[ \n]+")


@cache
def environment() -> Environment:
    """Return the Jinja environment of all templates, with the formats as filters."""
    common = Environment(
        undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    common.filters |= {name: getattr(formatting, name) for name in _FORMATS}
    common.filters["format"] = format
    common.globals |= {"COVERAGE": f"{COVERAGE:.0%}", "TIMED": formatting.TIMED}
    return common


class Sentences:
    """Macros of a template, called by name.

    module : full name of the module beside the template
    names : further variables for all macros
    """

    def __init__(self, module: str, **names: Any) -> None:
        self._module = module
        self._names = names

    @cached_property
    def _macros(self) -> Any:
        package, _, name = self._module.rpartition(".")
        text = files(package).joinpath(f"{name}.j2").read_text("utf-8")
        return environment().from_string(text, self._names).module

    def __call__(self, macro: str, *args: Any, **values: Any) -> str:
        """Return the text of a macro in one line."""
        write: Callable[..., str] = getattr(self._macros, macro)
        return _SPACE.sub(" ", write(*args, **values)).strip()

    def parts(self, macro: str, *args: Any, **values: Any) -> list[str]:
        """Return the paragraphs of a macro; a leading dash marks an entry of a list."""
        write: Callable[..., str] = getattr(self._macros, macro)
        texts = re.split(r"\n\s*\n", write(*args, **values).strip())
        lines = [_SPACE.sub(" ", text).strip() for text in texts if text]
        return [Point(line[2:]) if line.startswith("- ") else line for line in lines]
