"""Fixtures for races, in which functions are timed alternately in one process.

Because the functions alternate, a drift of the machine's speed affects all functions
nearly equally. After the tests, a summary shows medians, quartiles and ratios to the
time of the first function.
"""

from statistics import median, quantiles
from time import perf_counter

import pytest

RACES = pytest.StashKey[list]()
NOTES = pytest.StashKey[list]()


def pytest_configure(config):
    config.stash[RACES] = []
    config.stash[NOTES] = []


@pytest.fixture
def note(request):
    """Return a function ``note(text)`` that adds a line to the summary."""
    return request.config.stash[NOTES].append


@pytest.fixture
def race(request):
    """Return a function ``race(first=f, second=g, rounds=9)``.

    The returned function runs the race and returns the median times in s, by name.
    """

    def run(*, rounds=9, **contestants):
        for function in contestants.values():
            function()  # warm-up, so that imports and caches are not timed
        seconds = {name: [] for name in contestants}
        for _ in range(rounds):
            for name, function in contestants.items():
                start = perf_counter()
                function()
                seconds[name].append(perf_counter() - start)
        request.config.stash[RACES].append((request.node.name, rounds, seconds))
        return {name: median(times) for name, times in seconds.items()}

    return run


def pytest_terminal_summary(terminalreporter, config):
    for line in config.stash[NOTES]:
        terminalreporter.write_line(line)
    for title, rounds, seconds in config.stash[RACES]:
        terminalreporter.section(f"{title}: medians of {rounds} interleaved rounds")
        first = median(next(iter(seconds.values())))
        for name, times in seconds.items():
            low, _, high = quantiles(times, n=4) if len(times) > 1 else 3 * times
            terminalreporter.write_line(
                f"{name:<32} {1e3 * median(times):10.2f} ms   "
                f"[{1e3 * low:.2f}, {1e3 * high:.2f}]   × {median(times) / first:.2f}"
            )
