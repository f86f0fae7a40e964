"""Checks whether a machine is fit for timing measurements, with advice on changes."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from enum import StrEnum
from typing import Any, NamedTuple

from rich.text import Text

from mortarbench.harness.environment.environment import REFERENCE_BLAS, digest

MIN_MEMORY_MIB = 2048
MAX_QUIET_LOAD = 0.5  #: largest acceptable one-minute load average, in cores
_SWITCH = {True: "on", False: "off", None: None}


class Level(StrEnum):
    """Outcome of a check."""

    OK = "ok"
    WARN = "warn"
    UNKNOWN = "unknown"  #: the operating system does not report the value


_STYLES = {Level.OK: "green", Level.WARN: "bold yellow", Level.UNKNOWN: "dim"}


class Check(NamedTuple):
    """One property of the machine or its software."""

    section: str
    name: str
    value: str | None  #: None if the operating system does not report the value
    advice: str = ""  #: recommended change; empty if the value is acceptable

    @property
    def level(self) -> Level:
        """Outcome of the check."""
        known = Level.UNKNOWN if self.value is None else Level.OK
        return Level.WARN if self.advice else known


def examine(environment: Mapping[str, Any]) -> list[Check]:
    """Check the properties of machine and software on which measured times depend.

    environment : result of `harness.environment.environment.capture`
    """
    return [
        *_machine(environment["machine"], environment["now"]),
        *_software(environment),
    ]


def as_json(environment: Mapping[str, Any], checks: Sequence[Check]) -> dict[str, Any]:
    """Return the input and the result of `examine` as plain data, for JSON."""
    return {
        "digest": digest(environment),
        "fit": not any(check.advice for check in checks),
        "checks": [c._asdict() | {"level": c.level} for c in checks],
        "environment": environment,
    }


def load_advice(load: float) -> str:
    """Return the advice to stop other programs, or "" if the load average is low.

    load : one-minute load average, in cores
    """
    return (
        "Stop other programs (top lists them) and wait until the load is below "
        f"{MAX_QUIET_LOAD}"
    ) * (load > MAX_QUIET_LOAD)


def _machine(machine: Mapping[str, Any], now: Mapping[str, Any]) -> Iterator[Check]:
    usable, limit = machine["usable_cores"], machine["cpu_limit"]
    memory, available = machine["memory_mib"], now["available_memory_mib"]
    virtual = ", a virtual machine" if machine["virtual"] else ""
    governor = machine["governor"]
    for name, value, is_bad, advice in (
        (
            "processor",
            f"{machine['cpu'] or machine['architecture']} "
            f"({machine['physical_cores'] or '?'} physical cores, {usable} usable"
            f"{virtual})",
            usable < 2,
            "Provide 2 cores: one for measurements and one for supervision",
        ),
        (
            "cpu limit",
            "none" if limit is None else f"{limit:g} cores",
            limit is not None and limit < 2,
            "The container is throttled: allow at least 2 cores (docker run --cpus=2)",
        ),
        (
            "governor",
            governor,
            governor not in (None, "performance"),
            "Fix the frequency: sudo cpupower frequency-set -g performance",
        ),
        (
            "turbo",
            _SWITCH[machine["turbo"]],
            machine["turbo"],
            "Frequencies above nominal depend on temperature and on other cores: "
            "echo 0 | sudo tee /sys/devices/system/cpu/cpufreq/boost "
            "(Intel: echo 1 | sudo tee /sys/devices/system/cpu/intel_pstate/no_turbo)",
        ),
        (
            "hyper-threads",
            _SWITCH[machine["smt"]],
            machine["smt"],
            "Two programs may share a core: stop all other programs, or echo off | "
            "sudo tee /sys/devices/system/cpu/smt/control",
        ),
        (
            "memory",
            None if available is None else f"{available} of {memory} MiB free",
            available is not None and available < MIN_MEMORY_MIB,
            f"Provide {MIN_MEMORY_MIB} MiB of free memory, or lower memory_limit in "
            "the suite",
        ),
        (
            "load",
            f"{now['load']:.2f} cores busy",
            True,
            load_advice(now["load"]),
        ),
    ):
        yield Check("Machine", name, value, advice * bool(is_bad))


def _software(environment: Mapping[str, Any]) -> Iterator[Check]:
    cholmod, threads = environment["cholmod"], environment["threads"]
    slow = (
        "The reference BLAS is several times slower: "
        "sudo apt-get install libopenblas0-pthread (if it is installed: "
        "sudo update-alternatives --config libblas.so.3-"
        f"{environment['machine']['architecture']}-linux-gnu)"
    )
    linked = cholmod["blas"] and f"{cholmod['blas']} (CHOLMOD {cholmod['version']})"
    yield Check(
        "BLAS", "of CHOLMOD", linked, slow * (cholmod["blas"] == REFERENCE_BLAS)
    )
    for pool in threads["pools"]:
        count = pool["threads"]
        yield Check(
            "Threads",
            f"{pool['library']} ({pool['owner']})",
            f"{count} thread{'s' * (count > 1)}",
            "Several threads increase the scatter of times: export OMP_NUM_THREADS=1 "
            "OPENBLAS_NUM_THREADS=1 MKL_NUM_THREADS=1 RAYON_NUM_THREADS=1"
            * (count > 1),
        )
    variables = ", ".join(f"{k}={v}" for k, v in threads["variables"].items())
    yield Check("Threads", "variables", variables or "none set")
    for name, number in environment["versions"].items():
        missing = "The package is missing: make setup" * (not number)
        yield Check("Versions", name, number or "missing", missing)
    source = environment["source"] or {"commit": "not a checkout", "dirty": False}
    yield Check(
        "Versions",
        "commit",
        source["commit"][:14] + " with uncommitted changes" * source["dirty"],
        "Commit before you publish, so that others can measure the same code"
        * source["dirty"],
    )


def render(checks: Sequence[Check], environment: str) -> Text:
    """Return the output of `mortarbench doctor`: all checks by section, with advice.

    environment : digest of the environment, as in records
    """
    width = max(len(check.name) for check in checks)
    text, section = Text(), ""
    for check in checks:
        if check.section != section:
            section = check.section
            text.append(f"{section}\n", "bold")
        text.append(f"  {check.level:<7}  ", _STYLES[check.level])
        value = check.value or "not reported by the system"
        text.append(f"{check.name:<{width}}  {value}\n")
        if check.advice:
            text.append(f"{'':{width + 13}}→ {check.advice}\n", "yellow")
    warnings = sum(bool(check.advice) for check in checks)
    conclusion = (
        f"{warnings} thing{'s' * (warnings > 1)} to change before measuring (marked "
        "warn)."
        if warnings
        else "Fit for measuring: nothing to change."
    )
    return text.append(f"\n{conclusion} Environment {environment}.")
