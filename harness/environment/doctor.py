"""Advice on changes that make a machine fit for timing measurements."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from rich.text import Text

from mortarbench.harness.environment.environment import REFERENCE_BLAS

MIN_MEMORY_MIB = 2048
MAX_QUIET_LOAD = 0.5  #: largest acceptable one-minute load average, in cores


def advice(environment: Mapping[str, Any]) -> dict[str, str]:
    """Return the recommended changes, by the dotted key of the value to change.

    Values that the operating system does not report (None) are not criticised.

    environment : result of `harness.environment.environment.capture`
    """
    values = dict(entries(environment))
    versions = [key for key in values if key.startswith("versions.")]
    pools = [key for key in values if key.startswith("threads.pools.")]
    limit, memory = values["machine.cpu_limit"], values["now.available_memory_mib"]
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
        "now.available_memory_mib": (
            memory is not None and memory < MIN_MEMORY_MIB,
            f"provide {MIN_MEMORY_MIB} MiB, or lower memory_limit in the suite",
        ),
        "now.load": (
            is_busy(values["now.load"]),
            "stop other programs (top lists them) and wait until the load is below "
            f"{MAX_QUIET_LOAD}",
        ),
        "cholmod.blas": (
            values["cholmod.blas"] == REFERENCE_BLAS,
            "this BLAS is several times slower than others: "
            "sudo apt-get install libopenblas0-pthread (if it is installed: "
            "sudo update-alternatives --config "
            f"libblas.so.3-{values['machine.architecture']}-linux-gnu)",
        ),
        **{
            key: (
                values[key] > 1,
                "several threads increase the scatter of times: export "
                "OMP_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1 MKL_NUM_THREADS=1 "
                "RAYON_NUM_THREADS=1",
            )
            for key in pools
        },
        **{key: (values[key] is None, "missing: make setup") for key in versions},
        "source.dirty": (
            values.get("source.dirty"),
            "commit before you publish, so that others can measure the same code",
        ),
    }
    return {key: text for key, (is_bad, text) in changes.items() if is_bad}


def is_busy(load: float) -> bool:
    """Return True if a one-minute load average, in cores, disturbs measurements."""
    return load > MAX_QUIET_LOAD


def entries(data: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Yield the values of an environment with dotted keys; thread pools by library."""
    for key, value in data.items():
        if key == "pools":
            for pool in value:
                owner = f"{pool['library']} ({pool['owner']})"
                yield f"{prefix}{key}.{owner}", pool["threads"]
        elif isinstance(value, Mapping):
            yield from entries(value, f"{prefix}{key}.")
        else:
            yield f"{prefix}{key}", value


def render(environment: Mapping[str, Any], digest: str) -> Text:
    """Return the output of `mortarbench doctor`: all values, with advice below.

    digest : digest of the environment, as in records
    """
    text, changes, values = Text(), advice(environment), dict(entries(environment))
    width = max(map(len, values))
    for key, value in values.items():
        shown = "none or not reported" if value is None else value
        text.append(
            f"{key:<{width}}  {shown}\n", "bold yellow" if key in changes else ""
        )
        if key in changes:
            text.append(f"{'':<{width}}  → {changes[key]}\n", "yellow")
    things = f"{len(changes)} thing{'s' * (len(changes) != 1)} to change (→)"
    verdict = f"{things} before measuring." if changes else "Fit for measuring."
    return text.append(f"\n{verdict} Environment {digest}.")
