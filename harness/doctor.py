"""Is this machine fit for measuring? Advice, and a noise floor that was measured."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from harness.environment import digest
from harness.qp import Vector

ENOUGH_MEMORY_MIB = 2048
QUIET_LOAD = 0.5  #: cores kept busy by others, as the one-minute load average tells
ONE_THREAD = (
    "export OMP_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1 MKL_NUM_THREADS=1 "
    "RAYON_NUM_THREADS=1"
)


@dataclass(frozen=True, kw_only=True)
class NoiseFloor:
    """How well this machine tells two equal things apart, when one times them."""

    clock_seconds: float  #: smallest step of the clock that was seen
    kernel_seconds: float  #: median time of the kernel
    pairs: int
    ratio: float  #: median of arm A over median of arm B: 1 but for noise
    half_width: float  #: of the ratio's 95 % bootstrap interval


def advice(environment: Mapping[str, Any]) -> list[str]:
    """Say what to change before measuring, one sentence each; empty when all is well.

    environment : as `harness.environment.capture` returns it
    """
    candidates = (
        _about_cholmod(environment),
        _about_threads(environment["threads"]["pools"]),
        _about_processor(environment["machine"]),
        _about_load(environment["now"]["load"]),
        _about_memory(environment["now"]["available_memory_mib"]),
    )
    return [sentence for found in candidates for sentence in found]


def noise_floor(
    seconds: float = 1.0, clock: Callable[[], float] = time.perf_counter
) -> NoiseFloor:
    """Time one kernel against itself: what differs by less than this is noise.

    The arms are interleaved as ABBA…, so that a drift of the machine hits both alike.
    The interval resamples blocks of consecutive pairs, not single ones, because
    disturbances last longer than one pair.

    seconds : how long to go on, by `clock`
    clock : returns seconds
    """
    a, b = _paired_times(seconds, clock)
    blocks = min(20, a.size)
    rng = np.random.default_rng(20260)
    split = [np.array_split(arm, blocks) for arm in (a, b)]
    ratios = [
        np.divide(
            *(np.median(np.concatenate([arm[i] for i in drawn])) for arm in split)
        )
        for drawn in rng.integers(blocks, size=(400, blocks))
    ]
    low, high = np.quantile(ratios, (0.025, 0.975))
    return NoiseFloor(
        clock_seconds=_clock_step(clock),
        kernel_seconds=float(np.median(np.concatenate((a, b)))),
        pairs=a.size,
        ratio=float(np.median(a) / np.median(b)),
        half_width=float((high - low) / 2),
    )


def render(
    environment: Mapping[str, Any],
    sentences: Iterable[str],
    noise: NoiseFloor | None = None,
) -> str:
    """Lay out what `mortarbench doctor` prints: aligned lines, then the advice."""
    rows = [("environment", digest(environment)), *_rows(environment)]
    if noise is not None:
        rows += _noise_rows(noise)
    width = max(len(key) for key, _ in rows)
    lines = [f"{key:<{width}}  {value}" for key, value in rows]
    todo = [f"- {sentence}" for sentence in sentences]
    return "\n".join([*lines, "", *(todo or ["Nothing to change."])])


def _about_cholmod(environment: Mapping[str, Any]) -> list[str]:
    blas, machine = environment["cholmod"]["blas"], environment["machine"]
    if environment["versions"]["scikit-sparse"] is None:
        return ["scikit-sparse is not installed, so nothing is factorised: make setup"]
    if blas != "reference BLAS":
        return []
    link = f"libblas.so.3-{machine['architecture']}-linux-gnu"
    return [
        "CHOLMOD uses the reference BLAS, which is several times slower: "
        "sudo apt-get install libopenblas0-pthread "
        f"(if it is there already: sudo update-alternatives --auto {link})"
    ]


def _about_threads(pools: Iterable[Mapping[str, Any]]) -> list[str]:
    many = [p for p in pools if p["threads"] > 1]
    names = ", ".join(f"{p['library']} of {p['owner']}: {p['threads']}" for p in many)
    if not many:
        return []
    return [f"More than one thread ({names}) blurs times: {ONE_THREAD}"]


def _about_processor(machine: Mapping[str, Any]) -> list[str]:
    found = []
    if machine["governor"] not in (None, "performance"):
        found.append(
            f"The frequency governor is {machine['governor']!r}: "
            "sudo cpupower frequency-set -g performance"
        )
    if machine["cpu_limit"] is not None and machine["cpu_limit"] < 2:
        found.append(
            f"The container is throttled to {machine['cpu_limit']:g} cores: "
            "give it 2 or more (docker run --cpus=2)"
        )
    return found


def _about_load(load: float) -> list[str]:
    if load <= QUIET_LOAD:
        return []
    return [
        f"Other programs keep {load:.1f} cores busy: stop them (top lists them) "
        f"and wait until the load is below {QUIET_LOAD}"
    ]


def _about_memory(available: int | None) -> list[str]:
    if available is None or available >= ENOUGH_MEMORY_MIB:
        return []
    return [
        f"Only {available} MiB of memory are free: make room for {ENOUGH_MEMORY_MIB}, "
        "or lower memory_limit in the suite"
    ]


def _rows(environment: Mapping[str, Any]) -> list[tuple[str, str]]:
    machine, versions = environment["machine"], environment["versions"]
    source, cholmod = environment["source"], environment["cholmod"]
    dirty = " with changes" if source and source["dirty"] else ""
    cores = (
        f"{machine['physical_cores'] or '?'} physical, {machine['usable_cores']} usable"
    )
    memory = (
        f"{machine['memory_mib']} MiB, {environment['now']['available_memory_mib']}"
    )
    return [
        ("processor", f"{machine['cpu'] or machine['architecture']} ({cores} cores)"),
        ("cpu limit", _or_unknown(machine["cpu_limit"], "none")),
        ("governor", _or_unknown(machine["governor"])),
        ("turbo", _or_unknown(machine["turbo"])),
        ("memory", f"{memory} free"),
        ("load", f"{environment['now']['load']:.2f}"),
        ("system", f"{machine['system']} {machine['kernel']}"),
        *((name, _or_unknown(number, "missing")) for name, number in versions.items()),
        ("commit", source["commit"][:12] + dirty if source else "not a checkout"),
        (
            "CHOLMOD",
            f"{cholmod['version'] or 'missing'}, {_or_unknown(cholmod['blas'])}",
        ),
        *(("threads", _pool_text(pool)) for pool in environment["threads"]["pools"]),
    ]


def _pool_text(pool: Mapping[str, Any]) -> str:
    name = " ".join(filter(None, (pool["library"], pool["version"])))
    return f"{pool['threads']} in {name} ({pool['owner']})"


def _noise_rows(noise: NoiseFloor) -> list[tuple[str, str]]:
    return [
        ("clock step", f"{noise.clock_seconds * 1e9:.0f} ns"),
        (
            "noise floor",
            f"±{noise.half_width:.2%} (A/A ratio {noise.ratio:.4f}, "
            f"{noise.pairs} pairs of {noise.kernel_seconds * 1e6:.0f} µs)",
        ),
    ]


def _or_unknown(value: object, absent: str = "unknown") -> str:
    return absent if value is None else str(value)


def _paired_times(seconds: float, clock: Callable[[], float]) -> tuple[Vector, Vector]:
    """Time arms A and B of the same kernel; returns two arrays of equal length."""
    matrix, vector = np.ones((512, 512)), np.ones(512)

    def timed() -> float:
        start = clock()
        matrix @ vector
        return clock() - start

    timed()  # the first product finds cold caches
    arms: tuple[list[float], list[float]] = ([], [])
    first, end = 0, clock() + seconds
    while clock() < end or not arms[0]:
        arms[first].append(timed())
        arms[1 - first].append(timed())
        first = 1 - first
    return np.array(arms[0]), np.array(arms[1])


def _clock_step(clock: Callable[[], float], tries: int = 1000) -> float:
    """Find the smallest step between consecutive readings that is not zero."""
    readings = np.array([clock() for _ in range(tries)])
    steps = np.diff(readings)
    return float(steps[steps > 0].min(initial=np.inf))
