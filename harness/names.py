"""Case names ``FAMILY/key=value/…/FORM``: strict parsing, and canonical names.

The method ``complete`` of a family adds missing keys. The default of a key may depend
on other keys; for instance, a default number of layers may depend on the number of
cells.

A family that reads problems from files has the key ``path``, and its attribute
``path_suffix`` is the suffix of these files. The name of such a case is
``FAMILY:PATH/key=value/…/FORM``. PATH may contain slashes, and ends at the first
component with the suffix. If ``path_suffix`` is empty, PATH is the rest of the name,
``FAMILY:PATH``, and the family has a single form. ``PATH#ROW`` is one problem of a file
that contains several, counted from 1.
"""

from __future__ import annotations

import math
import os
import re
import sys
from collections.abc import Iterable, Mapping
from contextlib import redirect_stdout
from dataclasses import dataclass, field
from fnmatch import fnmatchcase

from mortarbench.harness.checked import has_control
from mortarbench.harness.errors import PLUGINS, InputError, shortened, shown, unknown
from mortarbench.harness.plugin import Case, Family, Reference, Value

_INTEGER = re.compile(r"[+-]?[0-9]+")
_REAL = re.compile(r"[+-]?([0-9]+\.?[0-9]*|\.[0-9]+)([eE][+-]?[0-9]+)?")
_FILE = re.compile(
    r"[^=:]*\.[A-Za-z]\w*(/|$)"
)  #: pattern of a text that begins with the path of a file with a suffix
_ROW = re.compile(r"(.+)#([1-9][0-9]{0,8})", re.DOTALL)
_INTEGER_LIMIT = 2**63  #: smallest positive integer that does not fit in 64 bits
_TYPE_NAMES = {
    int: "an integer, such as 4",
    float: "a finite number, such as 0.5",
    str: "nonempty text without control characters",
}


@dataclass(frozen=True, kw_only=True)
class CaseId:
    """A family, a form, and valid values of all keys; `str` is the canonical name."""

    family: Family = field(compare=False, repr=False)
    name: str  #: canonical name, without keys whose value follows from the other keys
    params: Mapping[str, Value]  #: values of all keys, in the order of the family
    form: str

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
            case = self.family.build(self.form, self.params, reference)
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
        or ``family.check`` refuses the values.

    Examples
    --------
    Keys with their default values are not part of the canonical name:

    >>> from mortarbench.harness.names import parse
    >>> from mortarbench.problems import PROBLEMS
    >>> case = parse("beam-ring/Nh=15/Nr=4/steps=10/dual", PROBLEMS)
    >>> str(case), case.params["steps"]
    ('beam-ring/Nr=4/Nh=15/dual', 10)

    """
    if not isinstance(text, str):
        raise InputError(
            f"case = {shown(text)}; expected its name as a string, such as "
            "beam-ring/Nr=4/Nh=3/dual, or file:PATH"
        )
    head = re.split("[:/]", text, maxsplit=1)[0]
    if head not in families:
        if (named := _as_file(text, families)) is not None:
            raise InputError(
                f"unknown family {shown(head)}; did you mean {shown(named)}, a file?"
            )
        raise unknown("family", head, families, more=PLUGINS)
    family = families[head]
    if (suffix := family.path_suffix) is None:
        parts, given = text.split("/")[1:], {}
    else:
        path, parts = _split_path(text, family, suffix)
        given = {"path": path}
        if not suffix:
            return assemble(family, given, family.forms[0], texts=True)
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
    return assemble(family, given, parts[-1], texts=True)


def _as_file(text: str, families: Mapping[str, Family]) -> str | None:
    """Return the case name for a bare path; None if no family reads such a path."""
    if not _FILE.match(text) and not (text and os.path.isfile(text)):
        return None
    takers = [
        (f.path_suffix, f) for f in families.values() if f.path_suffix is not None
    ]
    for suffix, family in sorted(takers, key=lambda taker: -len(taker[0])):
        if suffix and (end := f"{text}/".find(f"{suffix}/")) >= 0:
            path, rest = text[: end + len(suffix)], text[end + len(suffix) :]
            return f"{family.name}:{path}{rest or f'/{family.forms[0]}'}"
        if not suffix:
            return f"{family.name}:{text}"
    return None


def assemble(
    family: Family, given: Mapping[str, object], form: str, *, texts: bool = False
) -> CaseId:
    """Check the keys `given` and the form, and return the case of a family.

    texts : True to convert the text of a value to a number if the default of its key
        is a number

    Raises
    ------
    InputError
        If the form or a key is unknown, a value has the wrong type, or
        ``family.check`` refuses the values.

    """
    if form not in family.forms:
        raise unknown("form", form, family.forms, where=family.name)
    typed: dict[str, Value] = {}
    for key, value in given.items():
        if key not in family.defaults:
            if instead := family.instead_of(key):
                raise InputError(f"{family.name}: unknown key {key!r}; {instead}")
            raise unknown("key", key, family.defaults, where=family.name)
        where, kind = f"{family.name}: {key}", type(family.defaults[key])
        if texts and kind is not str and isinstance(value, str):
            value = _number(value, kind)
        typed[key] = _typed(where, value, kind, free=key == _path_key(family))
    params = completed(family, typed)
    family.check(params)
    name = _canonical(family, params, form)
    return CaseId(family=family, name=name, params=params, form=form)


def _canonical(family: Family, params: Mapping[str, Value], form: str) -> str:
    """Return the case name without keys whose value follows from the other keys."""
    needed, head = dict(params), family.name
    if (path := needed.pop(_path_key(family), None)) is not None:
        head = f"{head}:{path}"
        if not family.path_suffix:
            return head
    for key in list(needed):
        fewer = {k: v for k, v in needed.items() if k != key}
        given = fewer if path is None else {"path": path, **fewer}
        if completed(family, given) == params:
            needed = fewer
    middle = [f"{key}={value}" for key, value in needed.items()]
    return "/".join([head, *middle, form])


def unbuilt(name: object, e: BaseException) -> str:
    """Return a one-line message for a case that could not be built because of `e`."""
    match e:
        case InputError():
            why = str(e)
        case MemoryError():
            why = "it needs more memory than is available"
        case _:
            why = f"{type(e).__name__}: {e}"
    return " ".join(f"{name} could not be built: {why}".split())


def match(pattern: str, names: Iterable[str]) -> list[str]:
    """Return the canonical `names` that match a shell glob.

    >>> from mortarbench.harness.names import match
    >>> match("*/dual", ["beam-ring/dual", "beam-ring/primal"])
    ['beam-ring/dual']
    """
    return [name for name in names if fnmatchcase(name, pattern)]


def completed(family: Family, given: Mapping[str, Value]) -> dict[str, Value]:
    """Return the values of all keys in the order of the family, including defaults."""
    params = family.complete(given)
    return {key: params[key] for key in family.defaults}


def _path_key(family: Family) -> str:
    """Return "path" for a family that reads files, or "" for other families."""
    return "" if family.path_suffix is None else "path"


def _split_path(text: str, family: Family, suffix: str) -> tuple[str, list[str]]:
    """Split the text after ``FAMILY:`` into the path and the other components.

    If the family has a single form and the form is missing, the form is added.
    """
    head = family.name
    path = text[len(head) + 1 :]
    if text[len(head) : len(head) + 1] != ":" or not path:
        raise InputError(
            f"{shortened(text)}: the path is missing; expected {head}:PATH{suffix}"
        )
    if not suffix:
        return path, []
    parts = path.split("/")
    ends = [i for i, part in enumerate(parts, 1) if part.endswith(suffix)]
    if not ends:
        raise InputError(
            f"{shortened(text)}: the path is missing; expected "
            f"{head}:PATH{suffix}/…/FORM"
        )
    path, parts = "/".join(parts[: ends[0]]), parts[ends[0] :]
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


def _number(text: str, kind: type) -> object:
    """Convert a text to a finite number; return any other text unchanged."""
    if not (_INTEGER if kind is int else _REAL).fullmatch(text):
        return text  # int and float would also accept 1_0 and digits of other scripts
    try:
        number = kind(text)
        return number if math.isfinite(number) else text
    except (ValueError, OverflowError):
        return text


def _typed(where: str, value: object, kind: type, *, free: bool) -> Value:
    """Check a value, and return it; an integer may become a float.

    kind : type of the default of the key
    free : True to allow the characters / and =, which are separators in a name
    """
    match value:
        case str() if kind is str and value and (free or not set("/=") & set(value)):
            if not has_control(value):
                return value
        case bool():
            pass
        case int() if kind is int and abs(value) < _INTEGER_LIMIT:
            return value
        case int() | float() if kind is float and abs(value) <= sys.float_info.max:
            return float(value) + 0.0  # −0.0 becomes 0.0: equal values need equal names
    expected = _TYPE_NAMES[kind]
    if kind is str and not free:
        expected += ", / and ="
    elif kind is int and type(value) is int:
        expected = "an integer of at most 64 bits"
    raise InputError(f"{where}={shown(value)}; expected {expected}")
