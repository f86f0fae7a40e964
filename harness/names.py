"""Cases by name: ``FAMILY/key=value/…/FORM``, parsed strictly, written canonically.

Keys left out take the value that the family's ``complete`` gives them, which may derive
a default from other keys (a number of layers from another one).

A family whose problems lie in files has the key ``path`` and says in ``path_suffix``
how paths end. Its names are ``FAMILY:PATH/key=value/…/FORM``, where PATH is the first
part that ends so; or ``FAMILY:PATH`` if the suffix is empty and there is one form.
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
_FILE = re.compile(r"[^=:]*\.[A-Za-z]\w*(/|$)")  #: a path that ends in a suffix
_TOO_LARGE = 2**63  #: integers from here on fit into no array
_CALLED = {
    int: "an integer, such as 4",
    float: "a finite number, such as 0.5",
    str: "text",
}


@dataclass(frozen=True, kw_only=True)
class CaseId:
    """One case of a family, checked; as a text it is its canonical name."""

    family: Family = field(compare=False, repr=False)
    name: str  #: canonical: it has only those keys that the others do not imply
    params: Mapping[str, Value]  #: every key, in the family's order
    form: str

    def __str__(self) -> str:
        return self.name

    def build(self, reference: Reference) -> Case:
        """Build the case; what its family prints goes to stderr.

        What the family raises comes through.

        Raises
        ------
        TypeError
            When the family returns something else.

        """
        with redirect_stdout(sys.stderr):
            case = self.family.build(self.form, self.params, reference)
        if not isinstance(case, Case):
            raise TypeError(f"build returned {type(case).__name__}, expected Case")
        return case


def parse(text: str, families: Mapping[str, Family]) -> CaseId:
    """Parse ``beam-ring/Nr=30/dual``; keys left out take the family's defaults.

    Raises
    ------
    InputError
        For an unknown family, key or form, a key set twice, a part that is no
        key=value, a value of the wrong type, and whatever ``family.check`` refuses.

    """
    if not isinstance(text, str):
        raise InputError(
            f"case = {shown(text)}; expected its name as a text, such as "
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
        path, parts = _split_path(text, head, suffix)
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
                f"{head}: malformed part {shown(part)}; expected key=value"
            )
        if key in given:
            raise InputError(f"{head}: key {shown(key)} is set twice; set it once")
        given[key] = value
    return assemble(family, given, parts[-1], texts=True)


def _as_file(text: str, families: Mapping[str, Family]) -> str | None:
    """Say how the case of a bare path is called; None where it looks like no path."""
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
    """Make the checked case with the keys `given`.

    texts : whether texts stand for numbers, as in a name

    Raises
    ------
    InputError
        As `parse`.

    """
    if form not in family.forms:
        raise unknown("form", form, family.forms, where=family.name)
    typed: dict[str, Value] = {}
    for key, value in given.items():
        if key not in family.defaults:
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
    """Write the name with only those keys that the other keys do not imply."""
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
    """Say in one line why the case of that name could not be built."""
    match e:
        case InputError():
            why = str(e)
        case MemoryError():
            why = "it needs more memory than there is"
        case _:
            why = f"{type(e).__name__}: {e}"
    return " ".join(f"{name} could not be built: {why}".split())


def is_shared(name: CaseId) -> bool:
    """Return True if ranks can make the QP of a case, see `Family.emission`.

    A family that fails to say so does it when it builds, too.
    """
    try:
        return name.family.emission(name.form, name.params) is not None
    except Exception:  # the family's code
        return False


def match(pattern: str, names: Iterable[str]) -> list[str]:
    """Keep the canonical names that the shell glob `pattern` matches."""
    return [name for name in names if fnmatchcase(name, pattern)]


def completed(family: Family, given: Mapping[str, Value]) -> dict[str, Value]:
    """Fill in the keys that are not given, in the family's order."""
    params = family.complete(given)
    return {key: params[key] for key in family.defaults}


def _path_key(family: Family) -> str:
    """Name the key that holds a path; empty where the family takes none."""
    return "" if family.path_suffix is None else "path"


def _split_path(text: str, head: str, suffix: str) -> tuple[str, list[str]]:
    """Split what follows ``FAMILY:`` into the path and the other parts."""
    path = text[len(head) + 1 :]
    if text[len(head) : len(head) + 1] != ":" or not path:
        raise InputError(f"{shortened(text)}: no file; expected {head}:PATH{suffix}")
    if not suffix:
        return path, []
    parts = path.split("/")
    ends = [i for i, part in enumerate(parts, 1) if part.endswith(suffix)]
    if not ends:
        raise InputError(
            f"{shortened(text)}: no file; expected {head}:PATH{suffix}/…/FORM"
        )
    return "/".join(parts[: ends[0]]), parts[ends[0] :]


def _number(text: str, kind: type) -> object:
    """Read a finite number; what is none, or absurdly long, stays a text."""
    if not (_INTEGER if kind is int else _REAL).fullmatch(text):
        return text  # 1_0 and digits of other scripts are numbers to Python alone
    try:
        number = kind(text)
        return number if math.isfinite(number) else text
    except (ValueError, OverflowError):
        return text


def _typed(where: str, value: object, kind: type, *, free: bool) -> Value:
    """Check that a value has the type of the key's default, or convert it.

    free : whether a text may hold the signs that separate the parts of a name
    """
    match value:
        case str() if kind is str and value and (free or not set("/=") & set(value)):
            if not has_control(value):
                return value
        case bool():
            pass
        case int() if kind is int and abs(value) < _TOO_LARGE:
            return value
        case int() | float() if kind is float and abs(value) <= sys.float_info.max:
            return float(value) + 0.0  # not -0
    raise InputError(f"{where}={shown(value)}; expected {_CALLED[kind]}")
