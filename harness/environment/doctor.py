"""Checks whether a machine is fit for timing measurements, with advice on changes."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from enum import StrEnum
from functools import partial
from typing import Any

from rich.text import Text

from mortarbench.harness.environment.environment import digest
from mortarbench.harness.environment.noise import NoiseFloor

MIN_MEMORY_MIB = 2048
MAX_QUIET_LOAD = 0.5  #: largest acceptable one-minute load average, in cores
MAX_CLOCK_STEP_SECONDS = 1e-6
#: Largest acceptable value of `NoiseFloor.one_pair`.
MAX_PAIR_SCATTER = 0.10
MAX_RATIO_BIAS = 0.01  #: largest deviation of an A/A ratio from 1 that is ignored
ONE_THREAD = (
    "export OMP_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1 MKL_NUM_THREADS=1 "
    "RAYON_NUM_THREADS=1"
)


class Level(StrEnum):
    """Outcome of a check."""

    OK = "ok"
    WARN = "warn"
    UNKNOWN = "unknown"  #: the operating system does not report the value


_SWITCH = {True: "on", False: "off", None: None}
_STYLES = {Level.OK: "green", Level.WARN: "bold yellow", Level.UNKNOWN: "dim"}


@dataclass(frozen=True, kw_only=True)
class Check:
    """One property of the machine or its software, with its rating."""

    section: str
    name: str
    value: str
    level: Level = Level.OK
    advice: str = ""  #: recommended change; empty unless the level is WARN


def examine(environment: Mapping[str, Any], noise: NoiseFloor) -> list[Check]:
    """Check the properties of machine and software on which measured times depend.

    environment : result of `harness.environment.environment.capture`
    """
    return [
        *_machine(environment["machine"], environment["now"]),
        *_blas(environment),
        *_threads(environment["threads"]),
        *_clock(noise),
        *_versions(environment),
    ]


def as_json(
    environment: Mapping[str, Any], noise: NoiseFloor, checks: Sequence[Check]
) -> dict[str, Any]:
    """Return the input and the result of `examine` as plain data, for JSON."""
    return {
        "digest": digest(environment),
        "fit": all(check.level is not Level.WARN for check in checks),
        "checks": [asdict(check) for check in checks],
        "noise": asdict(noise),
        "environment": environment,
    }


def load_advice(load: float) -> str:
    """Return the advice to stop other programs, or "" if the load average is low.

    load : one-minute load average, in cores
    """
    if load <= MAX_QUIET_LOAD:
        return ""
    return (
        "Stop other programs (top lists them) and wait until the load is below "
        f"{MAX_QUIET_LOAD}"
    )


def _check(section: str, name: str, value: object, advice: str = "") -> Check:
    """Return a check, whose level follows from the value and the advice.

    The level is WARN if there is advice, UNKNOWN if the value is None, otherwise OK.
    """
    level = Level.WARN if advice else Level.UNKNOWN if value is None else Level.OK
    text = "not reported by the system" if value is None else str(value)
    return Check(section=section, name=name, value=text, level=level, advice=advice)


def _machine(machine: Mapping[str, Any], now: Mapping[str, Any]) -> Iterable[Check]:
    check = partial(_check, "Machine")
    cores, usable = machine["physical_cores"] or "?", machine["usable_cores"]
    virtual = ", a virtual machine" if machine["virtual"] else ""
    yield check(
        "processor",
        f"{machine['cpu'] or machine['architecture']} ({cores} physical cores, "
        f"{usable} usable{virtual})",
        ""
        if usable > 1
        else ("Provide 2 cores: one for measurements and one for supervision"),
    )
    limit = machine["cpu_limit"]
    throttled = limit is not None and limit < 2
    yield check(
        "cpu limit",
        "none" if limit is None else f"{limit:g} cores",
        "The container is throttled: allow at least 2 cores (docker run --cpus=2)"
        * throttled,
    )
    yield check(
        "governor",
        machine["governor"],
        "Fix the frequency: sudo cpupower frequency-set -g performance"
        * (machine["governor"] not in (None, "performance")),
    )
    yield check(
        "turbo",
        _SWITCH[machine["turbo"]],
        "Frequencies above nominal depend on temperature and on other cores: "
        "echo 0 | sudo tee /sys/devices/system/cpu/cpufreq/boost "
        "(Intel: echo 1 | sudo tee /sys/devices/system/cpu/intel_pstate/no_turbo)"
        * bool(machine["turbo"]),
    )
    yield check(
        "hyper-threads",
        _SWITCH[machine["smt"]],
        "Two programs may share a core: stop all other programs, or echo off | sudo "
        "tee /sys/devices/system/cpu/smt/control" * bool(machine["smt"]),
    )
    load = now["load"]
    yield check("load", f"{load:.2f} cores busy", load_advice(load))
    total, available = machine["memory_mib"], now["available_memory_mib"]
    is_known = total is not None and available is not None
    yield check(
        "memory",
        f"{available} of {total} MiB free" if is_known else None,
        f"Provide {MIN_MEMORY_MIB} MiB of free memory, or lower memory_limit in the "
        "suite" * (is_known and available < MIN_MEMORY_MIB),
    )


def _blas(environment: Mapping[str, Any]) -> Iterable[Check]:
    pools = environment["threads"]["pools"]
    for owner in ("numpy", "scipy"):
        yield _check("BLAS", f"of {owner}", _blas_of(owner, pools))
    blas, version = environment["cholmod"]["blas"], environment["cholmod"]["version"]
    advice = ""
    if environment["versions"]["scikit-sparse"] is None:
        advice = (
            "scikit-sparse is missing, so matrices cannot be factorised: make setup"
        )
    elif blas == "reference BLAS":
        link = f"libblas.so.3-{environment['machine']['architecture']}-linux-gnu"
        advice = (
            "The reference BLAS is several times slower: "
            "sudo apt-get install libopenblas0-pthread "
            f"(if it is installed: sudo update-alternatives --auto {link})"
        )
    linked = blas and f"{blas}, linked by CHOLMOD {version or '?'}"
    yield _check("BLAS", "of CHOLMOD", linked, advice)


def _blas_of(owner: str, pools: Sequence[Mapping[str, Any]]) -> str | None:
    """Return the BLAS in a package's wheel, else the system's BLAS, else None."""
    for place in (owner, "system"):
        for pool in pools:
            if pool["owner"] == place and pool["library"] != "libgomp":
                return " ".join(filter(None, (pool["library"], pool["version"])))
    return None


def _threads(threads: Mapping[str, Any]) -> Iterable[Check]:
    for pool in threads["pools"]:
        count = pool["threads"]
        advice = (
            f"Several threads increase the scatter of times: {ONE_THREAD}"
            if count > 1
            else ""
        )
        value = f"{count} thread{'s' if count > 1 else ''}"
        yield _check("Threads", f"{pool['library']} ({pool['owner']})", value, advice)
    variables = ", ".join(f"{k}={v}" for k, v in threads["variables"].items())
    yield _check("Threads", "variables", variables or "none set")


def _clock(noise: NoiseFloor) -> Iterable[Check]:
    step = noise.clock_seconds
    yield _check(
        "Clock",
        "smallest step",
        f"{step * 1e9:.0f} ns",
        "Measure on a machine whose clock has steps of at most 1 µs"
        if step > MAX_CLOCK_STEP_SECONDS
        else "",
    )
    biased = abs(noise.ratio - 1) > MAX_RATIO_BIAS and not noise.low <= 1 <= noise.high
    yield _check(
        "Clock",
        "A/A ratio",
        f"{noise.ratio:.4f}, 95 % interval [{noise.low:.4f}, {noise.high:.4f}], "
        f"{noise.pairs} pairs of {noise.kernel_seconds * 1e3:.2g} ms",
        "Equal measurements differ significantly: repeat when the machine is idle"
        if biased
        else "",
    )
    yield _check(
        "Clock",
        "noise floor",
        f"two equal measurements differ by at most {noise.one_pair:.1%} (in 19 of 20 "
        "pairs)",
        "Raise repeats: a single pair cannot resolve differences below "
        f"{noise.one_pair:.0%}"
        if noise.one_pair > MAX_PAIR_SCATTER
        else "",
    )


def _versions(environment: Mapping[str, Any]) -> Iterable[Check]:
    machine, source = environment["machine"], environment["source"]
    yield _check("Versions", "system", f"{machine['system']} {machine['kernel']}")
    for name, number in environment["versions"].items():
        advice = "" if number else "The package is missing: make setup"
        yield _check("Versions", name, number or "missing", advice)
    dirty = source is not None and source["dirty"]
    commit = (source["commit"][:12] if source else "not a checkout") + (
        " with uncommitted changes" if dirty else ""
    )
    advice = "Commit before you publish, so that others can measure the same code"
    yield _check("Versions", "commit", commit, advice if dirty else "")


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
        text.append(f"{check.name:<{width}}  {check.value}\n")
        if check.advice:
            text.append(f"{'':{width + 13}}→ {check.advice}\n", "yellow")
    return text.append(f"\n{_conclusion(checks)} Environment {environment}.")


def _conclusion(checks: Sequence[Check]) -> str:
    warnings = sum(check.level is Level.WARN for check in checks)
    if not warnings:
        return "Fit for measuring: nothing to change."
    things = "thing" if warnings == 1 else "things"
    return f"{warnings} {things} to change before measuring (marked warn)."
