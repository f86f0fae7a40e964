"""Permitted changes of a suite that has a result folder, and unions of suites.

Such a suite may only be extended: solvers, cases, tolerances and a `null_arm` may be
added, and the number of repeats may be raised. The limits, the accuracy and the solver
of each label must not change, since the stored measurements depend on these settings.
Suites in which these settings agree can be united. The name of a suite that has a
result folder must not change either.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from itertools import chain, combinations
from typing import Any

from mortarbench.harness.errors import InputError, shown
from mortarbench.harness.suite.suite import DEFAULTS, suite_text

#: settings that must not change, since stored verdicts and times depend on them
FIXED_KEYS = ("time_limit", "memory_limit", "accuracy")
_AND = "-and-"  #: separator of the names of united suites

Table = Mapping[str, Any]  #: content of a suite's TOML


def incompatibility(old: Table, new: Table) -> str:
    """Describe the first change that is not permitted; return "" if all are permitted.

    Cases are not compared here; `harness.running.run` compares them with the journal.
    """
    both = {**DEFAULTS, **old}, {**DEFAULTS, **new}
    return next(chain(_settings(*both), _members(*both)), "")


def _settings(old: Table, new: Table) -> Iterator[str]:
    for key in ("name", *FIXED_KEYS):
        if old.get(key) != new.get(key):
            yield _change(key, old.get(key), new.get(key))
    if new["repeats"] < old["repeats"]:
        yield f"{_change('repeats', old['repeats'], new['repeats'])}; it may only grow"


def _members(old: Table, new: Table) -> Iterator[str]:
    if old["null_arm"] not in (None, new["null_arm"]):
        yield _change("null_arm", old["null_arm"], new["null_arm"])
    for tol in old["tolerances"]:
        if tol not in new["tolerances"]:
            yield f"tolerance {tol:g} is missing; tolerances may be added"
    solvers = _entries(new)
    for label, entry in _entries(old).items():
        if label not in solvers:
            yield f"solver {shown(label)} is missing; solvers may be added"
        elif solvers[label]["name"] != entry["name"]:
            name = f"solver {shown(label)}"
            yield _change(name, entry["name"], solvers[label]["name"])


def _change(name: str, old: object, new: object) -> str:
    return f"{name} was {_text(old)}, now {_text(new)}"


def _text(value: object) -> str:
    return "not set" if value is None else shown(value)


def unite(tables: Mapping[str, Table]) -> dict[str, Any]:
    """Return a suite with the measurements of all suites; the first sets the rest.

    tables : results of `harness.suite.suite.read_stored` by folder

    Raises
    ------
    InputError
        If suites differ in a limit, in the accuracy, or in the solver or the options of
        a label.

    """
    union: dict[str, Any] = {}
    for (one, a), (other, b) in combinations(tables.items(), 2):
        _refuse_unequal(one, a, other, b)
    for table in tables.values():
        _add(union, table)
    return union


def _refuse_unequal(one: str, a: Table, other: str, b: Table) -> None:
    """Refuse suites `a`, `b` of two folders with unequal settings or labels."""
    for key in FIXED_KEYS:
        values = a.get(key, DEFAULTS[key]), b.get(key, DEFAULTS[key])
        if values[0] != values[1]:
            raise InputError(
                f"{key} is {_text(values[0])} in {one}, {_text(values[1])} in {other}; "
                "expected equal settings"
            )
    entries = _entries(a), _entries(b)
    for label in sorted(entries[0].keys() & entries[1].keys()):
        values = entries[0][label], entries[1][label]
        if values[0] != values[1]:
            raise InputError(
                f"the label {shown(label)} is {_text(values[0])} in {one}, "
                f"{_text(values[1])} in {other}; expected labels to denote the same "
                "solver with the same options in all folders"
            )


def _add(union: dict[str, Any], table: Table) -> None:
    """Add the measurements of a suite to the union, in place."""
    if not union:
        union |= table
        return
    names = [
        *str(union.get("name", "")).split(_AND),
        *str(table.get("name")).split(_AND),
    ]
    union["name"] = _AND.join(dict.fromkeys(filter(None, names)))
    if "repeats" in table:
        repeats = union.get("repeats", DEFAULTS["repeats"])
        union["repeats"] = max(table["repeats"], repeats)
    for key in ("tolerances", "solvers", "problems"):
        if key not in union.keys() | table.keys():
            continue
        present = list(union.get(key, DEFAULTS.get(key, ())))
        more = table.get(key, DEFAULTS.get(key, ()))
        union[key] = present + [entry for entry in more if entry not in present]


def _entries(table: Table) -> dict[str, Mapping[str, Any]]:
    """Return the name and the options of each solver of a suite by label."""
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
    """Return a suite as TOML, with nested tables on one line each."""
    blocks = table.get("problems", ())
    head = suite_text({k: v for k, v in table.items() if k != "problems"})
    return "\n[[problems]]\n".join([head, *map(suite_text, blocks)])
