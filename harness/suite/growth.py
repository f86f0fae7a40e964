"""How a suite may change while its result folder lasts: by asking for more.

What was measured stays what it was asked for: under the same limits, judged at the
same accuracy, by the same solver under one label. Solvers, cases and tolerances may be
added, repeats raised, and a precision may be asked for or tightened.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from itertools import chain
from typing import Any

from harness.errors import shown
from harness.suite.suite import DEFAULTS

SAME = ("time_limit", "memory_limit", "accuracy")  #: what a verdict or time depends on
RAISED = ("repeats", "max_repeats", "budget")  #: may grow

Table = Mapping[str, Any]  #: of a suite's TOML


def refused(then: Table, now: Table) -> str:
    """Say what makes a changed suite another one; empty if it only asks for more.

    Cases are not compared here: `harness.running.run` holds them against the journal.
    """
    both = {**DEFAULTS, **then}, {**DEFAULTS, **now}
    return next(chain(_settings(*both), _members(*both)), "")


def _settings(then: Table, now: Table) -> Iterator[str]:
    for key in ("name", *SAME):
        if then.get(key) != now.get(key):
            yield _was(key, then.get(key), now.get(key))
    for key in RAISED:
        if now[key] < then[key]:
            yield f"{_was(key, then[key], now[key])}; it may only grow"
    finer = "it may only become finer"
    if then["precision"] is not None and (now["precision"] or 1) > then["precision"]:
        yield f"{_was('precision', then['precision'], now['precision'])}; {finer}"


def _members(then: Table, now: Table) -> Iterator[str]:
    if then["null_arm"] not in (None, now["null_arm"]):
        yield _was("null_arm", then["null_arm"], now["null_arm"])
    for tol in then["tolerances"]:
        if tol not in now["tolerances"]:
            yield f"tolerance {tol:g} is missing; tolerances may be added"
    names = named(now)
    for label, name in named(then).items():
        if label not in names:
            yield f"solver {shown(label)} is missing; solvers may be added"
        elif names[label] != name:
            yield _was(f"solver {shown(label)}", name, names[label])


def _was(what: str, then: object, now: object) -> str:
    return f"{what} was {_said(then)}, now {_said(now)}"


def _said(value: object) -> str:
    return "not set" if value is None else shown(value)


def named(table: Table) -> dict[str, str]:
    """Give the names of a suite's solvers by their labels."""
    entries = (
        entry if isinstance(entry, Mapping) else {"name": entry}
        for entry in table.get("solvers", ())
    )
    return {str(e.get("label", e.get("name"))): str(e.get("name")) for e in entries}
