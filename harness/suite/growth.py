"""Settings that all measurements of a result folder share, and unions of suites.

A suite that has a result folder may be extended: solvers, cases, tolerances and repeats
may be added. Stored measurements depend on the limits, the accuracy and the steps of
sequences, which must not change. Suites with equal settings can be united.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import msgspec

from mortarbench.harness.errors import InputError, shown
from mortarbench.harness.suite.suite import SuiteFile

#: settings that must not change, since stored verdicts and times depend on them
FIXED_KEYS = ("time_limit", "memory_limit", "accuracy")

_AND = "-and-"  #: separator of the names of united suites


def refuse_changed(old: SuiteFile, new: SuiteFile, where: str) -> None:
    """Refuse a change of a suite that would mix different measurements in a folder.

    Cases and solvers are not compared here; `harness.running.run` compares them with
    the journal.

    where : file of the old suite

    Raises
    ------
    InputError
        If the name, a fixed setting or a sequence has changed.

    """
    _refuse_unequal(where, old, "the suite", new, ("name", *FIXED_KEYS))
    for problem in old.problems:
        if problem.sequence is not None and problem not in new.problems:
            raise InputError(
                f"{where} has a sequence of {problem.family} along {problem.sequence} "
                "that the suite lacks; a solver carries data from step to step"
            )


def unite(suites: Mapping[str, SuiteFile]) -> dict[str, Any]:
    """Return a suite with the measurements of all suites; the first sets the rest.

    suites : results of `harness.suite.suite.read_stored` by folder

    Raises
    ------
    InputError
        If suites differ in a limit or in the accuracy.

    """
    (one, first), *others = suites.items()
    for other, suite in others:
        _refuse_unequal(one, first, other, suite, FIXED_KEYS)
    merged = {
        key: tuple(e for i, e in enumerate(entries) if e not in entries[:i])
        for key in ("tolerances", "solvers", "problems")
        if (entries := [e for suite in suites.values() for e in getattr(suite, key)])
    }
    names = [name for suite in suites.values() for name in suite.name.split(_AND)]
    union: dict[str, Any] = msgspec.to_builtins(
        msgspec.structs.replace(
            first,
            name=_AND.join(dict.fromkeys(names)),
            repeats=max(suite.repeats for suite in suites.values()),
            **merged,
        )
    )
    return union


def _refuse_unequal(
    one: str, a: SuiteFile, other: str, b: SuiteFile, keys: Sequence[str]
) -> None:
    for key in keys:
        values = getattr(a, key), getattr(b, key)
        if values[0] != values[1]:
            x, y = (f"{v:g}" if isinstance(v, float) else shown(v) for v in values)
            raise InputError(
                f"{key} is {x} in {one}, {y} in {other}; expected equal settings"
            )
