"""Extension of griffe that converts docstrings to Markdown for the API reference.

Docstrings of this project describe an argument as ``tol : relative accuracy``, because
its type is in the signature. In Markdown, these lines become a list. griffe-sphinx
reads the comments ``#:`` of attributes.
"""

from __future__ import annotations

import re
from typing import Any

import griffe

#: code, in which no character has a meaning in Markdown
CODE = re.compile(r"(`[^`]*`|^ {4,}.*$)", re.MULTILINE)


class Docstrings(griffe.Extension):
    """Extension that rewrites every docstring."""

    def on_object(self, *, obj: griffe.Object, **_: Any) -> None:
        """Convert the docstring of a module, class, function or attribute."""
        if obj.docstring is not None:
            obj.docstring.value = as_markdown(obj.docstring.value)


def as_markdown(text: str) -> str:
    """List the arguments, and escape asterisks as in u*, which Markdown interprets."""
    text = re.sub(r"^Parameters\n-+\n", "", text, flags=re.MULTILINE)
    text = re.sub(r"^(\w+(?:, \w+)*) : ", r"- `\1`: ", text, flags=re.MULTILINE)
    parts = CODE.split(text)
    parts[::2] = [re.sub(r"(?<=\w)\*(?!\*)", r"\\*", part) for part in parts[::2]]
    return "".join(parts)
