"""How a suite may change while its result folder lasts: by asking for more.

What was measured stays what it was asked for: under the same limits, judged at the
same accuracy, by the same solver under one label. Solvers, cases and tolerances may be
added, repeats raised, and a precision may be asked for or tightened. Of several suites
that are alike in this sense, one can be made.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from itertools import chain
from typing import Any

from mortarbench.harness.errors import InputError, shown
from mortarbench.harness.suite.suite import DEFAULTS, suite_text

FIXED_KEYS = (
    "time_limit",
    "memory_limit",
    "accuracy",
)  #: what a verdict or time depends on
GROWING_KEYS = ("repeats", "max_repeats", "budget")  #: may grow

_AND = "-and-"  #: between the names of suites that were united

Table = Mapping[str, Any]  #: of a suite's TOML


def incompatibility(then: Table, now: Table) -> str:
    """Say what makes a changed suite another one; empty if it only asks for more.

    Cases are not compared here: `harness.running.run` holds them against the journal.
    """
    both = {**DEFAULTS, **then}, {**DEFAULTS, **now}
    return next(chain(_settings(*both), _members(*both)), "")


def _settings(then: Table, now: Table) -> Iterator[str]:
    for key in ("name", *FIXED_KEYS):
        if then.get(key) != now.get(key):
            yield _was(key, then.get(key), now.get(key))
    for key in GROWING_KEYS:
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
    solvers = _entries(now)
    for label, entry in _entries(then).items():
        if label not in solvers:
            yield f"solver {shown(label)} is missing; solvers may be added"
        elif solvers[label]["name"] != entry["name"]:
            yield _was(f"solver {shown(label)}", entry["name"], solvers[label]["name"])


def _was(what: str, then: object, now: object) -> str:
    return f"{what} was {_said(then)}, now {_said(now)}"


def _said(value: object) -> str:
    return "not set" if value is None else shown(value)


def unite(tables: Mapping[str, Table]) -> dict[str, Any]:
    """Unite suites: the first one's settings, and all that any of them asks for.

    tables : by the folder that each is from, as `harness.suite.suite.read_stored` reads

    Raises
    ------
    InputError
        When two differ in a limit, the accuracy, or in what one label means.

    """
    whole: dict[str, Any] = {}
    of = ""
    for folder, table in tables.items():
        _refuse_unequal(of, whole, folder, table)
        _add(whole, table)
        of = of or folder
    return whole


def _refuse_unequal(of: str, whole: Table, folder: str, table: Table) -> None:
    if not whole:
        return
    a, b = {**DEFAULTS, **whole}, {**DEFAULTS, **table}
    for key in FIXED_KEYS:
        if a[key] != b[key]:
            raise InputError(
                f"{key} is {_said(a[key])} in {of}, {_said(b[key])} in {folder}; "
                "expected suites whose measurements are alike"
            )
    mine, its = _entries(whole), _entries(table)
    for label in mine.keys() & its.keys():
        if mine[label] != its[label]:
            raise InputError(
                f"the label {shown(label)} is {_said(mine[label])} in {of}, "
                f"{_said(its[label])} in {folder}; expected one solver for a label"
            )


def _add(whole: dict[str, Any], table: Table) -> None:
    """Add to a suite what another one asks for."""
    if not whole:
        whole |= table
        return
    names = [
        *str(whole.get("name", "")).split(_AND),
        *str(table.get("name")).split(_AND),
    ]
    whole["name"] = _AND.join(dict.fromkeys(filter(None, names)))
    for key in GROWING_KEYS:
        if key in table:
            whole[key] = max(table[key], whole.get(key, DEFAULTS[key]))
    for key in ("tolerances", "solvers", "problems"):
        if key not in whole.keys() | table.keys():
            continue
        there = list(whole.get(key, DEFAULTS.get(key, ())))
        more = table.get(key, DEFAULTS.get(key, ()))
        whole[key] = there + [one for one in more if one not in there]


def _entries(table: Table) -> dict[str, Mapping[str, Any]]:
    """Give the name and options of a suite's solvers by their labels."""
    entries = (
        entry if isinstance(entry, Mapping) else {"name": entry}
        for entry in table.get("solvers", ())
    )
    return {
        str(e.get("label", e.get("name"))): {
            "name": str(e.get("name")),
            **dict(e.get("options", {})),
        }
        for e in entries
    }


def as_toml(table: Table) -> str:
    """Write a suite as TOML: what is nested stands in one line."""
    blocks = table.get("problems", ())
    head = suite_text({k: v for k, v in table.items() if k != "problems"})
    return "\n[[problems]]\n".join([head, *map(suite_text, blocks)])
