"""Case names ``FAMILY/key=value/…/FORM``: strict parsing, and canonical names.

Missing keys have their defaults. The value of a key with the default `DERIVED` follows
from other keys; for instance, a number of layers may follow from the number of cells.

A family that reads problems from files has the key ``path``, and its attribute
``path_suffix`` is the suffix of these files. The name of such a case is
``FAMILY:PATH/key=value/…/FORM``. PATH may contain slashes, and ends at the first
component with the suffix. If ``path_suffix`` is empty, PATH is the rest of the name,
``FAMILY:PATH``, and the family has a single form. ``PATH#ROW`` is one problem of a file
that contains several, counted from 1.
"""

from __future__ import annotations

import os
import re
import sys
from collections.abc import Mapping
from contextlib import redirect_stdout, suppress
from dataclasses import dataclass, field

from mortarbench.harness.checked import located
from mortarbench.harness.errors import (
    PLUGINS,
    InputError,
    described,
    shortened,
    shown,
    unknown,
)
from mortarbench.harness.keys import Value, keys_of
from mortarbench.harness.plugin import Case, Family, Reference

_ROW = re.compile(r"(.+)#([1-9][0-9]{0,8})", re.DOTALL)


@dataclass(frozen=True, kw_only=True)
class CaseId:
    """A configured family and a form; `str` is the canonical name."""

    name: str  #: canonical name, without keys whose value follows from the other keys
    family: Family = field(repr=False)  #: family with the values of all keys
    form: str

    @property
    def family_name(self) -> str:
        """Name of the family in the registry, the first component of `name`."""
        return re.split("[:/]", self.name, maxsplit=1)[0]

    @property
    def params(self) -> dict[str, Value]:
        """Values of all keys, in the order of the family."""
        return self.family.params

    def __str__(self) -> str:
        return self.name

    def build(self, reference: Reference) -> Case:
        """Build the case; output that the family prints is redirected to stderr.

        Exceptions of the family are not caught.

        Raises
        ------
        TypeError
            If the family does not return a `Case`.

        """
        with redirect_stdout(sys.stderr):
            case = self.family.build(self.form, reference)
        if not isinstance(case, Case):
            raise TypeError(f"build returned {type(case).__name__}, expected Case")
        return case


def parse(text: str, families: Mapping[str, Family]) -> CaseId:
    """Parse a name such as ``beam-ring/Nr=30/dual``.

    Raises
    ------
    InputError
        If a family, key or form is unknown, the form or the path is missing, a key is
        set twice, a component is not of the form key=value, a value has the wrong type,
        or the family refuses the values.

    Examples
    --------
    Keys with their default values are not part of the canonical name:

    >>> from mortarbench.harness.names import parse
    >>> from mortarbench.problems import PROBLEMS
    >>> case = parse("beam-ring/Nh=15/Nr=4/steps=10/dual", PROBLEMS)
    >>> str(case), case.params["steps"]
    ('beam-ring/Nr=4/Nh=15/dual', 10)

    """
    head = family_name(text, families)
    family = families[head]
    parts, given = text.split("/")[1:], {}
    if family.path_suffix is not None:
        given["path"], parts = _split_path(text, head, family)
    if not parts or "=" in parts[-1]:
        forms = ", ".join(family.forms)
        raise InputError(
            f"{shortened(text)}: no form at the end; expected one of {forms}"
        )
    for part in parts[:-1]:
        key, equals, value = part.partition("=")
        if not equals:
            raise InputError(
                f"{head}: malformed component {shown(part)}; expected key=value"
            )
        if key in given:
            raise InputError(f"{head}: key {shown(key)} is set twice; set it once")
        given[key] = value
    return assemble(head, family, given, parts[-1], texts=True)


def family_name(text: str, families: Mapping[str, Family]) -> str:
    """Return the family in a case name, without importing the family.

    Raises
    ------
    InputError
        If the family is unknown.

    """
    if not isinstance(text, str):
        raise InputError(
            f"case = {shown(text)}; expected its name as a string, such as "
            "beam-ring/Nr=4/Nh=3/dual, or file:PATH"
        )
    head = re.split("[:/]", text, maxsplit=1)[0]
    if head not in families:
        if os.path.isfile(text):
            readers = [
                (f.path_suffix, name)
                for name, f in families.items()
                if f.path_suffix is not None and text.endswith(f.path_suffix)
            ]
            named = f"{max(readers)[1]}:{text}"
            raise InputError(
                f"unknown family {shown(head)}; did you mean {shown(named)}, a file?"
            )
        raise unknown("family", head, families, more=PLUGINS)
    return head


def assemble(
    name: str,
    family: Family,
    given: Mapping[str, object],
    form: str,
    *,
    texts: bool = False,
) -> CaseId:
    """Check the keys `given` and the form, and return the case of a family.

    name : name of the family in the registry
    texts : True to convert the text of a value to a number if its key is a number

    Raises
    ------
    InputError
        If the form or a key is unknown, a value has the wrong type, or the family
        refuses the values.

    """
    if form not in family.forms:
        raise unknown("form", form, family.forms, where=name)
    keys = keys_of(type(family))
    for key in given:
        if key not in keys:
            raise unknown("key", key, keys, where=name)
    if family.path_suffix is not None and not given.get("path"):
        raise InputError(
            f"{name}: path is missing; expected {name}:PATH{family.path_suffix}"
        )
    with located(name):
        typed = {
            key: keys[key].typed(given[key], is_text=texts)
            for key in keys
            if key in given
        }
        for key, value in typed.items():
            keys[key].check(value)
        configured = family.with_keys(**typed)
        needed = _needed(configured, typed)
    return CaseId(
        name=_canonical(name, family, needed, form), family=configured, form=form
    )


def _needed(family: Family, given: dict[str, Value]) -> dict[str, Value]:
    """Return the keys in `given` whose value does not follow from the others."""
    keys = keys_of(type(family))
    needed = {k: v for k, v in given.items() if k == "path" or v != keys[k].default}
    derived = [k for k in needed if keys[k].default is None and k != "path"]
    for key in derived:
        fewer = {k: v for k, v in needed.items() if k != key}
        with suppress(InputError):  # the family may refuse to do without the key
            if family.with_keys(**fewer) == family:
                needed = fewer
    return needed


def _canonical(name: str, family: Family, needed: dict[str, Value], form: str) -> str:
    """Return the case name that lists the values `needed`."""
    if family.path_suffix is not None:
        name = f"{name}:{needed['path']}"
        if not family.path_suffix:
            return name
    middle = [f"{key}={value}" for key, value in needed.items() if key != "path"]
    return "/".join([name, *middle, form])


def unbuilt(name: object, e: BaseException) -> str:
    """Return a one-line message for a case that could not be built because of `e`."""
    match e:
        case InputError():
            why = str(e)
        case MemoryError():
            why = "it needs more memory than is available"
        case _:
            why = described(e)
    return " ".join(f"{name} could not be built: {why}".split())


def _split_path(text: str, head: str, family: Family) -> tuple[str, list[str]]:
    """Split the text after ``FAMILY:`` into the path and the other components.

    If the family has a single form and the form is missing, the form is added.
    """
    path, parts, suffix = text[len(head) + 1 :], list[str](), family.path_suffix
    if suffix:
        parts = path.split("/")
        end = next((i for i, p in enumerate(parts, 1) if p.endswith(suffix)), 0)
        path, parts = "/".join(parts[:end]), parts[end:]
    if text[len(head) : len(head) + 1] != ":" or not path:
        rest = "/…/FORM" if len(family.forms) > 1 else ""
        raise InputError(
            f"{shortened(text)}: the path is missing; expected "
            f"{head}:PATH{suffix}{rest}"
        )
    if len(family.forms) == 1 and (not parts or "=" in parts[-1]):
        parts.append(family.forms[0])
    return path, parts


def split_row(path: str) -> tuple[str, int | None]:
    """Split PATH#ROW into the path of a file and a row, or None if there is no row.

    >>> from mortarbench.harness.names import split_row
    >>> split_row("sets/two.parquet#2"), split_row("a#b.npz")
    (('sets/two.parquet', 2), ('a#b.npz', None))
    """
    match = _ROW.fullmatch(path)
    return (match[1], int(match[2])) if match else (path, None)
