"""Permitted changes of a suite that has a result folder, and unions of suites.

Such a suite may only be extended: solvers, cases, tolerances and a `null_arm` may be
added, and the number of repeats may be raised. The limits, the accuracy and the solver
of each label must not change, since the stored measurements depend on these settings.
Suites in which these settings agree can be united. The name of a suite that has a
result folder must not change either.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from itertools import combinations
from typing import Any

import msgspec

from mortarbench.harness.errors import InputError, shown
from mortarbench.harness.suite.suite import SuiteFile

#: settings that must not change, since stored verdicts and times depend on them
FIXED_KEYS = ("time_limit", "memory_limit", "accuracy")

_AND = "-and-"  #: separator of the names of united suites


def incompatibility(old: SuiteFile, new: SuiteFile) -> str:
    """Describe the first change that is not permitted; return "" if all are permitted.

    Cases are not compared here; `harness.running.run` compares them with the journal.
    """
    return next(_changes(old, new), "")


def _changes(old: SuiteFile, new: SuiteFile) -> Iterator[str]:
    for key in ("name", *FIXED_KEYS):
        before, now = getattr(old, key), getattr(new, key)
        if before != now:
            yield f"{key} was {_text(before)}, now {_text(now)}"
    if new.repeats < old.repeats:
        yield f"repeats was {old.repeats}, now {new.repeats}; it may only grow"
    if old.null_arm not in (None, new.null_arm):
        yield f"null_arm was {_text(old.null_arm)}, now {_text(new.null_arm)}"
    for tol in old.tolerances:
        if tol not in new.tolerances:
            yield f"tolerance {tol:g} is missing; tolerances may be added"
    names = {spec.label: spec.name for spec in new.specs()}
    for spec in old.specs():
        if spec.label not in names:
            yield f"solver {shown(spec.label)} is missing; solvers may be added"
        elif names[spec.label] != spec.name:
            now = shown(names[spec.label])
            yield f"solver {shown(spec.label)} was {shown(spec.name)}, now {now}"


def _text(value: object) -> str:
    if isinstance(value, float):
        return f"{value:g}"
    return "not set" if value is None else shown(value)


def unite(suites: Mapping[str, SuiteFile]) -> dict[str, Any]:
    """Return a suite with the measurements of all suites; the first sets the rest.

    suites : results of `harness.suite.suite.read_stored` by folder

    Raises
    ------
    InputError
        If suites differ in a limit, in the accuracy, or in the solver or the options of
        a label.

    """
    for (one, a), (other, b) in combinations(suites.items(), 2):
        _refuse_unequal(one, a, other, b)
    merged = {
        key: tuple(e for i, e in enumerate(entries) if e not in entries[:i])
        for key in ("tolerances", "solvers", "problems")
        if (entries := [e for suite in suites.values() for e in getattr(suite, key)])
    }
    names = [name for suite in suites.values() for name in suite.name.split(_AND)]
    first, *_ = suites.values()
    union: dict[str, Any] = msgspec.to_builtins(
        msgspec.structs.replace(
            first,
            name=_AND.join(dict.fromkeys(names)),
            repeats=max(suite.repeats for suite in suites.values()),
            **merged,
        )
    )
    return union


def _refuse_unequal(one: str, a: SuiteFile, other: str, b: SuiteFile) -> None:
    """Refuse suites `a`, `b` of two folders with unequal settings or labels."""
    for key in FIXED_KEYS:
        values = getattr(a, key), getattr(b, key)
        if values[0] != values[1]:
            raise InputError(
                f"{key} is {_text(values[0])} in {one}, {_text(values[1])} in {other}; "
                "expected equal settings"
            )
    solvers = [
        {s.label: {"name": s.name, **s.options} for s in f.specs()} for f in (a, b)
    ]
    for label in sorted(solvers[0].keys() & solvers[1].keys()):
        values = solvers[0][label], solvers[1][label]
        if values[0] != values[1]:
            raise InputError(
                f"the label {shown(label)} is {_text(values[0])} in {one}, "
                f"{_text(values[1])} in {other}; expected labels to denote the same "
                "solver with the same options in all folders"
            )
