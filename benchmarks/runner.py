"""Overhead of the runner, and the ratios of times that it can resolve.

    .venv/bin/python benchmarks/runner.py overhead [N]   overhead of N measurements
    .venv/bin/python benchmarks/runner.py growth [N]     memory, open files after N
    .venv/bin/python benchmarks/runner.py null [TRIALS]  intervals of a true ratio of 1
    .venv/bin/python benchmarks/runner.py neighbours [N] times beside careless solvers

The overhead is the time from one record to the next record, minus the times of the
solver and of fsync. In an A/A comparison (``null``), a solver is compared with itself.
"""

import os
import sys
import tempfile
from dataclasses import replace
from pathlib import Path
from statistics import median, quantiles
from time import perf_counter

import numpy as np

from mortarbench.harness.names import assemble
from mortarbench.harness.registry import SolverSpec, load_plugin, resolve
from mortarbench.harness.results.journal import read_journal
from mortarbench.harness.results.work_unit import Commands
from mortarbench.harness.running.run import run
from mortarbench.harness.suite.parameter_grid import Cases
from mortarbench.harness.suite.solver_options import NULL_SUFFIX
from mortarbench.harness.suite.suite import Suite, SuiteFile
from mortarbench.harness.verify.measure import SAMPLE_SECONDS, memory_mib
from mortarbench.reports.intervals import student

PLUGIN = Path(__file__).parents[1] / "tests/support/adversaries.py"
ACCIDENTS = PLUGIN.with_name("accidents.py")


class Watch:
    """Progress callbacks that store the time of each record and the memory in use."""

    def __init__(self):
        self.records, self.at, self.synced, self.sizes = [], [], [], []
        # estimated time of all solves of each record, in s: mean time of the timed
        # solves × number of all solves
        self.solving = []
        self._fsync, self._fsync_seconds = os.fsync, 0.0
        os.fsync = self._timed_fsync

    def _timed_fsync(self, fd):
        start = perf_counter()
        self._fsync(fd)
        self._fsync_seconds += perf_counter() - start

    def start(self, total):
        pass

    def say(self, text):
        pass

    def warn(self, text):
        print(text, file=sys.stderr)

    def advance(self, record):
        self.records.append((record.solver, record.repeat, record.total_seconds))
        self.solving.append(record.total_seconds * (record.inner + record.untimed))
        self.at.append(perf_counter())
        self.synced.append(self._fsync_seconds)
        self.sizes.append((memory_mib("VmRSS"), len(os.listdir("/proc/self/fd"))))

    def overheads(self):
        """Return times between records, without the times of solver and fsync, in s."""
        seconds = []
        for i in range(1, len(self.at)):
            gap = self.at[i] - self.at[i - 1]
            fsync = self.synced[i] - self.synced[i - 1]
            seconds.append(gap - self.solving[i] - fsync)
        return seconds


def measure(out, *solvers, repeats, plugin=PLUGIN):
    """Run solvers of a plug-in on the plug-in's tiny QP; return the `Watch`."""
    start = [sys.executable, "-P", str(plugin)]
    plugin = load_plugin(plugin)
    specs = [SolverSpec(name=s, label=s) for s in solvers]
    specs += [replace(specs[0], label=f"{solvers[0]}{NULL_SUFFIX}", role="null")]
    tiny = plugin.problems["tiny"]
    suite = Suite(
        file=SuiteFile(name="runner", repeats=repeats), solvers=tuple(specs),
        cases=Cases(cold=(assemble("tiny", tiny, {}, "plain"),)),
    )  # fmt: skip
    watch = Watch()
    run(
        suite, out=out, environment={}, digest="here",
        commands=Commands(
            solvers={s.label: [*start, s.name] for s in specs},
            case_worker=[*start, "generator"],
        ),
        resolve=lambda spec: resolve(spec, plugin.solvers), progress=watch,
    )  # fmt: skip
    return watch


def overhead(n=500):
    """Print the median overhead of a tiny measurement, with quartiles."""
    with tempfile.TemporaryDirectory() as out:
        watch = measure(Path(out), "honest", repeats=n // 2)
    low, middle, high = quantiles(watch.overheads()[4:], n=4)
    print(
        f"overhead {1e3 * middle:.2f} ms [{1e3 * low:.2f}, {1e3 * high:.2f}] over "
        f"{n} measurements of {SAMPLE_SECONDS * 1e3:g} ms"
    )


def growth(n=10_000):
    """Print memory and number of open files after a tenth, a half and all of a run."""
    with tempfile.TemporaryDirectory() as out:
        watch = measure(Path(out), "honest", repeats=n // 2)
        lines = len(read_journal(Path(out)))
    for i in (n // 10, n // 2, len(watch.sizes) - 1):
        mib, descriptors = watch.sizes[i]
        print(f"after {i:>6} of {lines}: {mib:.1f} MiB, {descriptors} descriptors")


def null(trials=40, blocks=10):
    """Count A/A ratios whose 95 % interval contains 1; print the median half-width."""
    hits, widths = 0, []
    for _ in range(trials):
        with tempfile.TemporaryDirectory() as out:
            watch = measure(Path(out), "products", repeats=blocks)
        times = {}
        for solver, repeat, seconds in watch.records:
            times.setdefault(solver, {})[repeat] = seconds
        a, b = times.values()
        logs = np.log([a[i] / b[i] for i in a.keys() & b.keys()])
        half = student(logs.size - 1) * logs.std(ddof=1) / np.sqrt(logs.size)
        hits += abs(logs.mean()) <= half
        widths.append(np.expm1(half))
    print(
        f"{hits} of {trials} intervals contain 1; "
        f"median half-width {median(widths):.1%}"
    )


def beside(n=20):
    """Print times of a solver in runs with honest or careless solvers, alternately.

    Careless solvers leave processes or threads running.
    """
    calm, careless = ("honest",), ("daemon", "executeddaemon", "burns", "pools")
    os.environ["WATCHED"] = "benchmark"
    times = {calm: [], careless: []}
    for turn in range(n):
        for neighbours in (calm, careless) if turn % 2 else (careless, calm):
            with tempfile.TemporaryDirectory() as out:
                watch = measure(
                    Path(out), "computes", *neighbours, repeats=5, plugin=ACCIDENTS
                )
            seconds = [t for solver, _, t in watch.records if solver == "computes"]
            times[neighbours].append(median(seconds))
    for neighbours, medians in times.items():
        low, middle, high = quantiles(medians, n=4)
        print(
            f"beside {', '.join(neighbours)}: {1e3 * middle:.3f} ms "
            f"[{1e3 * low:.3f}, {1e3 * high:.3f}]"
        )
    ratios = [a / b for a, b in zip(times[careless], times[calm], strict=True)]
    low, middle, high = quantiles(ratios, n=4)
    print(f"ratio within turns: {middle:.3f} [{low:.3f}, {high:.3f}]")


if __name__ == "__main__":
    name, *numbers = sys.argv[1:] or ["overhead"]
    functions = {
        "overhead": overhead, "growth": growth, "null": null, "neighbours": beside,
    }  # fmt: skip
    functions[name](*map(int, numbers))
