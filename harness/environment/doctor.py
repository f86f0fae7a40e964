"""Advice on changes that make a machine fit for timing measurements."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

MAX_QUIET_LOAD = 0.5  #: largest acceptable one-minute load average, in cores


def advice(environment: Mapping[str, Any]) -> dict[str, str]:
    """Return the recommended changes, by the dotted key of the value to change.

    Values that the operating system does not report (None) are not criticised.

    environment : result of `harness.environment.environment.capture`
    """
    values = dict(entries(environment))
    limit = values["machine.cpu_limit"]
    changes = {
        "machine.usable_cores": (
            values["machine.usable_cores"] < 2,
            "provide 2 cores: one for measurements and one for supervision",
        ),
        "machine.cpu_limit": (
            limit is not None and limit < 2,
            "the container is throttled: allow at least 2 cores (docker run --cpus=2)",
        ),
        "machine.governor": (
            values["machine.governor"] not in (None, "performance"),
            "fix the frequency: sudo cpupower frequency-set -g performance",
        ),
        "machine.turbo": (
            values["machine.turbo"],
            "frequencies above nominal depend on temperature and on other cores: "
            "echo 0 | sudo tee /sys/devices/system/cpu/cpufreq/boost "
            "(Intel: echo 1 | sudo tee /sys/devices/system/cpu/intel_pstate/no_turbo)",
        ),
        "machine.smt": (
            values["machine.smt"],
            "two programs may share a core: stop all other programs, or "
            "echo off | sudo tee /sys/devices/system/cpu/smt/control",
        ),
        "now.load": (
            is_busy(values["now.load"]),
            "stop other programs (top lists them) and wait until the load is below "
            f"{MAX_QUIET_LOAD}",
        ),
    }
    return {key: text for key, (is_bad, text) in changes.items() if is_bad}


def is_busy(load: float) -> bool:
    """Return True if a one-minute load average, in cores, disturbs measurements."""
    return load > MAX_QUIET_LOAD


def entries(data: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Yield the values of an environment with dotted keys."""
    for key, value in data.items():
        if isinstance(value, Mapping):
            yield from entries(value, f"{prefix}{key}.")
        else:
            yield f"{prefix}{key}", value


def render(environment: Mapping[str, Any], digest: str) -> str:
    """Return the output of `mortarbench doctor`: all values, with advice below.

    digest : digest of the environment, as in records
    """
    changes, values = advice(environment), dict(entries(environment))
    width = max(map(len, values))
    lines = []
    for key, value in values.items():
        shown = "none or not reported" if value is None else value
        lines.append(f"{key:<{width}}  {shown}")
        if key in changes:
            lines.append(f"{'':<{width}}  → {changes[key]}")
    verdict = "Fit for measuring."
    if changes:
        verdict = f"To change before measuring (→): {len(changes)}."
    return "\n".join([*lines, "", f"{verdict} Environment {digest}."])
