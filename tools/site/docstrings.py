"""Extension of griffe that converts docstrings to numpydoc for the API reference.

Docstrings of this project describe an argument as ``tol : relative accuracy``, because
its type is in the signature. In numpydoc, the type follows the colon, and the
description is on the next lines. Comments ``#:`` beside or above attributes describe
these attributes.
"""

from __future__ import annotations

import re
from typing import Any

import griffe

#: names of one or more arguments, and their description; its further lines are indented
_ENTRY = r"\w+(?:, \w+)* : .*\n(?: +.*\n)*"
_ENTRIES = re.compile(rf"(?:\A|(?<=\n\n))(?:{_ENTRY})+(?=\n|\Z)")
#: asterisk after a letter, as in u*, which Markdown would interpret as start of
#: emphasis
_STAR = re.compile(r"(?<=\w)\*(?!\*)")
_SECTION = re.compile(rf"(?<=\nParameters\n----------\n)(?:{_ENTRY})+")


class Docstrings(griffe.Extension):
    """Extension that rewrites docstrings of functions and adds them to attributes."""

    def on_object(self, *, obj: griffe.Object, **_: Any) -> None:
        """Escape the asterisks of formulas in a docstring."""
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
            if attr.filepath not in sources:  # the stub of a compiled module
                return
            if text := beside(
                sources[attr.filepath], attr.lineno - 1, attr.endlineno - 1
            ):
                attr.docstring = griffe.Docstring(text, parent=attr)


def starred(text: str) -> str:
    """Escape asterisks after letters, which Markdown would interpret as emphasis."""
    parts = re.split(r"(`[^`]*`|^ {4,}.*$)", text, flags=re.MULTILINE)
    parts[::2] = [_STAR.sub(r"\\*", part) for part in parts[::2]]
    return "".join(parts)


def as_numpydoc(text: str) -> str:
    """Convert the descriptions of arguments to a numpydoc section Parameters."""
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
    """Return the text of comments ``#:`` on given lines or, if empty, directly above.

    first, last : indices of the lines of an attribute
    """
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
