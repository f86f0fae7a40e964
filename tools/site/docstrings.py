"""Our docstrings as griffe, which makes the reference, expects them (an extension).

We say ``tol : relative accuracy`` where numpydoc has the type after the colon and the
description below; types are in the signature. And what an attribute is stands beside
it, after ``#:``.
"""

from __future__ import annotations

import re
from typing import Any

import griffe

#: one or more arguments and what they are, further lines indented
_ENTRY = r"\w+(?:, \w+)* : .*\n(?: +.*\n)*"
_ENTRIES = re.compile(rf"(?:\A|(?<=\n\n))(?:{_ENTRY})+(?=\n|\Z)")
#: a star behind a letter (u*), which Markdown would take for emphasis
_STAR = re.compile(r"(?<=\w)\*(?!\*)")
_SECTION = re.compile(rf"(?<=\nParameters\n----------\n)(?:{_ENTRY})+")


class Docstrings(griffe.Extension):
    """Rewrites docstrings of functions, and finds those of attributes."""

    def on_object(self, *, obj: griffe.Object, **_: Any) -> None:
        """Keep the stars of formulas."""
        if obj.docstring is not None:
            obj.docstring.value = starred(obj.docstring.value)

    def on_function(self, *, func: griffe.Function, **_: Any) -> None:
        """Write arguments as numpydoc has them."""
        if func.docstring is not None:
            func.docstring.value = as_numpydoc(func.docstring.value)

    def on_attribute(self, *, attr: griffe.Attribute, **_: Any) -> None:
        """Take the comment beside an attribute, or above it, for its docstring."""
        if attr.docstring is None and attr.lineno is not None and attr.endlineno:
            sources = attr.parent.module.lines_collection  # type: ignore[union-attr]
            if attr.filepath not in sources:  # in the stub of a compiled module
                return
            if text := beside(
                sources[attr.filepath], attr.lineno - 1, attr.endlineno - 1
            ):
                attr.docstring = griffe.Docstring(text, parent=attr)


def starred(text: str) -> str:
    """Escape stars behind letters, which Markdown would take for emphasis."""
    parts = re.split(r"(`[^`]*`|^ {4,}.*$)", text, flags=re.MULTILINE)
    parts[::2] = [_STAR.sub(r"\\*", part) for part in parts[::2]]
    return "".join(parts)


def as_numpydoc(text: str) -> str:
    """Put descriptions of arguments below their names, in a section of their own."""
    text += "\n"

    def entry(found: re.Match[str]) -> str:
        names, description = found[0].split(" : ", 1)
        return "".join(f"{name}\n    {description}" for name in names.split(", "))

    def entries(found: re.Match[str]) -> str:
        return re.sub(_ENTRY, entry, found[0])

    def section(found: re.Match[str]) -> str:
        return f"Parameters\n----------\n{entries(found)}"

    if _SECTION.search(text):
        return _SECTION.sub(entries, text).rstrip()
    return _ENTRIES.sub(section, text).rstrip()


def beside(lines: list[str], first: int, last: int) -> str:
    """Find the comment ``#:`` at the end of lines, or in those directly above."""
    found = [c for line in lines[first : last + 1] if (c := _comment(line))]
    if not found:
        above = first - 1
        while lines[above].strip().startswith("#:"):
            found.insert(0, _comment(lines[above]))
            above -= 1
    text = " ".join(found)
    return text[:1].upper() + text[1:]


def _comment(line: str) -> str:
    return line.partition("#:")[2].strip()
