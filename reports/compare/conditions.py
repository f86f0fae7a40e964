"""Conditions of the measurements in two result folders, and their differences."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any

from mortarbench.harness import InputError
from mortarbench.harness.results.folder import HARDWARE, differences, environment_of
from mortarbench.reports.data.environment import flatten
from mortarbench.reports.data.evidence import Evidence

Difference = tuple[str, Any, Any]  #: dotted key, value before, value after


def hardware(evidence: Evidence) -> dict[str, str]:
    """Map the digest of each environment to a description of its hardware.

    A digest without a stored environment is mapped to itself.
    """
    named = {}
    for digest in {r.environment for r in evidence.records}:
        try:
            found = environment_of(evidence.directory, digest)
        except InputError:
            named[digest] = digest
        else:
            parts = {part: found.get(part) for part in HARDWARE}
            named[digest] = json.dumps(parts, sort_keys=True)
    return named


def machines_differ(before: Evidence, after: Evidence) -> bool:
    """Return whether the measurements of the two folders come from several machines."""
    return len({*hardware(before).values(), *hardware(after).values()}) > 1


def environments(before: Evidence, after: Evidence) -> list[Difference]:
    """List the recorded differences between the two environments."""
    return list(differences(before.environment, after.environment))


def settings(before: Evidence, after: Evidence) -> list[Difference]:
    """List the differences between the suites, except problems and solvers."""
    a, b = (
        {k: v for k, v in e.suite.items() if k not in ("problems", "solvers")}
        for e in (before, after)
    )
    return _differences(a, b)


def options(before: Evidence, after: Evidence) -> list[Difference]:
    """List the options, including defaults, in which solvers of one label differ."""
    a, b = ({r.solver: r.options for r in e.records} for e in (before, after))
    return [
        (f"{solver}.{key}", *values)
        for solver in after.solvers
        if solver in a
        for key, *values in _differences(a[solver], b[solver])
    ]


def _differences(a: Mapping[str, Any], b: Mapping[str, Any]) -> list[Difference]:
    one, two = dict(flatten(a)), dict(flatten(b))
    return [
        (key, one.get(key), two.get(key))
        for key in dict.fromkeys((*one, *two))
        if one.get(key) != two.get(key)
    ]
