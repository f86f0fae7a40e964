"""Machine and date of the measurements."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from mortarbench.reports.data.evidence import Evidence
from mortarbench.reports.document.formatting import clean, plural

QUIET_LOAD = 0.5  #: load average above which a machine counts as busy


def busy_with(evidence: Evidence) -> float | None:
    """Return the load average at the start of the run; None if low or unknown."""
    state = evidence.environment.get("now")
    load = state.get("load") if isinstance(state, Mapping) else None
    return load if isinstance(load, int | float) and load > QUIET_LOAD else None


def dateline(evidence: Evidence) -> str:
    """Return date and machine of the measurements in one line."""
    days = sorted({r.started[:10] for r in evidence.records if r.started})
    when = " to ".join(dict.fromkeys((days[0], days[-1]))) if days else "date unknown"
    return f"{clean(when)} · {machine(evidence.environment)}"


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
