"""Under which conditions two result folders were measured, and how they differ."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any

from mortarbench.harness import InputError
from mortarbench.harness.results.folder import differences, environment_of
from mortarbench.reports.data.environment import flatten
from mortarbench.reports.data.evidence import Evidence

#: parts of an environment that have to be equal for times to be comparable; the others
#: (versions, source, plugins) are what a comparison is usually about
HARDWARE = ("machine", "threads", "cholmod")

Difference = tuple[str, Any, Any]  #: dotted key, value before, value after


def hardware(evidence: Evidence) -> dict[str, str]:
    """Name by each digest of an environment what the times depend on besides the code.

    A digest whose environment the folder does not hold names itself.
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
    """Whether not all measurements of both folders come from equal machines."""
    return len({*hardware(before).values(), *hardware(after).values()}) > 1


def environments(before: Evidence, after: Evidence) -> list[Difference]:
    """List what differs between the two environments, as recorded."""
    return list(differences(before.environment, after.environment))


def settings(before: Evidence, after: Evidence) -> list[Difference]:
    """List what differs between the suites, their problems and solvers aside."""
    a, b = (
        {k: v for k, v in e.suite.items() if k not in ("problems", "solvers")}
        for e in (before, after)
    )
    return _differences(a, b)


def options(before: Evidence, after: Evidence) -> list[Difference]:
    """List the options in which solvers of one label differ, defaults resolved."""
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
