"""Machine and date of the measurements, and their division by environment."""

from __future__ import annotations

import re
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import replace
from typing import Any

from mortarbench.harness import InputError
from mortarbench.harness.results.folder import environment_of, same_machine
from mortarbench.reports.data.evidence import Evidence
from mortarbench.reports.document.formatting import clean, plural
from mortarbench.reports.document.grouping import grouped

QUIET_LOAD = 0.5  #: load average above which a machine counts as busy
_DIGITS = 6  #: number of digits of an environment's digest in its name


def by_environment(evidence: Evidence) -> tuple[Evidence, ...]:
    """Return the part of the evidence from each environment.

    The environment of environment.json comes first. The others are named: "other
    machine @1a2b3c" or, if they differ from the first only in versions, code or
    plug-ins, "other environment @1a2b3c".
    """
    records = grouped(evidence.records, lambda r: r.environment)
    if len(records) < 2:
        return (evidence,)
    main = evidence.environment.get("digest")
    first, *others = sorted(records, key=lambda digest: digest != main)
    found = {digest: _environment(evidence, digest) for digest in records}
    places = {}
    for digest in others:
        same = same_machine(found[first], found[digest])
        kind = "environment" if same else "machine"
        name = re.sub(r"\W", "", digest)[:_DIGITS]
        places[digest] = f"other {kind} @{name}"
    return tuple(
        replace(
            evidence,
            records=tuple(records[digest]),
            environment=found[digest],
            place=places.get(digest, ""),
            places=places,
        )
        for digest in (first, *others)
    )


def _environment(evidence: Evidence, digest: str) -> Mapping[str, Any]:
    """Return a stored environment; empty if the folder does not contain it."""
    if digest == evidence.environment.get("digest"):
        return evidence.environment
    with suppress(InputError):
        return environment_of(evidence.directory, digest)
    return {}


def busy_with(evidence: Evidence) -> float | None:
    """Return the load average at the start of the run; None if low or unknown."""
    state = evidence.environment.get("now")
    load = state.get("load") if isinstance(state, Mapping) else None
    return load if isinstance(load, int | float) and load > QUIET_LOAD else None


def dateline(evidence: Evidence) -> str:
    """Return date and machines of the measurements in one line."""
    days = sorted({r.started[:10] for r in evidence.records if r.started})
    when = " to ".join(dict.fromkeys((days[0], days[-1]))) if days else "date unknown"
    first, *others = by_environment(evidence)
    named = [machine(first.environment), *(e.place for e in others)]
    return f"{clean(when)} · {', '.join(named)}"


def machine(environment: Mapping[str, Any]) -> str:
    """Describe the machine of environment.json in one line."""
    facts = environment.get("machine")
    if not isinstance(facts, Mapping):
        return "machine unknown"
    parts = [str(facts["cpu"]) if facts.get("cpu") else "processor unknown"]
    if facts.get("usable_cores"):
        parts.append(plural(facts["usable_cores"], "usable core"))
    if isinstance(facts.get("memory_mib"), int | float):
        parts.append(f"{facts['memory_mib'] / 1024:.0f} GiB")
    if facts.get("system"):
        parts.append(f"{facts['system']} {facts.get('architecture') or ''}".strip())
    return clean(", ".join(parts), 160)


def flatten(data: Any, prefix: str = "") -> list[tuple[str, Any]]:
    """Return the values in nested mappings and lists with their dotted names.

    A list is a single value unless it contains a mapping or another list.
    """
    match data:
        case Mapping():
            items = [(str(k), v) for k, v in data.items()]
        case list() | tuple() if any(isinstance(v, Mapping | list) for v in data):
            items = [(str(i), v) for i, v in enumerate(data)]
        case _:
            return [(prefix, data)]
    return [
        leaf
        for key, value in items
        for leaf in flatten(value, f"{prefix}.{key}" if prefix else key)
    ]
