"""Extension of griffe that converts our docstrings to numpydoc for the reference.

We write ``tol : relative accuracy``; numpydoc has the type after the colon and the
description below. Types are in the signature. Attributes are described by comments
``#:`` beside or above them.
"""

from __future__ import annotations

import re
from typing import Any

import griffe

#: one or more arguments with their description, further lines indented
_ENTRY = r"\w+(?:, \w+)* : .*\n(?: +.*\n)*"
_ENTRIES = re.compile(rf"(?:\A|(?<=\n\n))(?:{_ENTRY})+(?=\n|\Z)")
#: asterisk behind a letter (u*), which Markdown would take for emphasis
_STAR = re.compile(r"(?<=\w)\*(?!\*)")
_SECTION = re.compile(rf"(?<=\nParameters\n----------\n)(?:{_ENTRY})+")


class Docstrings(griffe.Extension):
    """Extension that rewrites docstrings of functions and adds those of attributes."""

    def on_object(self, *, obj: griffe.Object, **_: Any) -> None:
        """Escape the asterisks of formulas."""
        if obj.docstring is not None:
            obj.docstring.value = starred(obj.docstring.value)

    def on_function(self, *, func: griffe.Function, **_: Any) -> None:
        """Convert the descriptions of arguments to numpydoc."""
        if func.docstring is not None:
            func.docstring.value = as_numpydoc(func.docstring.value)

    def on_attribute(self, *, attr: griffe.Attribute, **_: Any) -> None:
        """Use the comment beside or above an attribute as its docstring."""
        if attr.docstring is None and attr.lineno is not None and attr.endlineno:
            sources = attr.parent.module.lines_collection  # type: ignore[union-attr]
            if attr.filepath not in sources:  # in the stub of a compiled module
                return
            if text := beside(
                sources[attr.filepath], attr.lineno - 1, attr.endlineno - 1
            ):
                attr.docstring = griffe.Docstring(text, parent=attr)


def starred(text: str) -> str:
    """Escape asterisks behind letters, which Markdown would take for emphasis."""
    parts = re.split(r"(`[^`]*`|^ {4,}.*$)", text, flags=re.MULTILINE)
    parts[::2] = [_STAR.sub(r"\\*", part) for part in parts[::2]]
    return "".join(parts)


def as_numpydoc(text: str) -> str:
    """Move descriptions of arguments below their names, into a section Parameters."""
    text += "\n"

    def entry(match: re.Match[str]) -> str:
        names, description = match[0].split(" : ", 1)
        return "".join(f"{name}\n    {description}" for name in names.split(", "))

    def entries(match: re.Match[str]) -> str:
        return re.sub(_ENTRY, entry, match[0])

    def section(match: re.Match[str]) -> str:
        return f"Parameters\n----------\n{entries(match)}"

    if _SECTION.search(text):
        return _SECTION.sub(entries, text).rstrip()
    return _ENTRIES.sub(section, text).rstrip()


def beside(lines: list[str], first: int, last: int) -> str:
    """Return the comment ``#:`` at the end of lines, or in those directly above."""
    comments = [c for line in lines[first : last + 1] if (c := _comment(line))]
    if not comments:
        above = first - 1
        while lines[above].strip().startswith("#:"):
            comments.insert(0, _comment(lines[above]))
            above -= 1
    text = " ".join(comments)
    return text[:1].upper() + text[1:]


def _comment(line: str) -> str:
    return line.partition("#:")[2].strip()
