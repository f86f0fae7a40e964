"""Runs that are killed at random instants, and continued."""

import os
import random
import signal
import subprocess
import sys
import time
from contextlib import suppress
from pathlib import Path

import pytest

from harness.journal import read_journal

PLUGIN = Path(__file__).with_name("adversaries.py")
SUITE = """
name = "killed"
repeats = 4
time_limit = 20
solvers = ["sleeps", "honest", "dies", "declines", "chains"]
[[problems]]
family = "tiny"
params = { h = [0.5, 1.0] }
[[problems]]
family = "tiny"
sequence = "h"
params = { h = [0.5, 1.0, 1.5] }
"""
#: a run in a process of its own: suite, folder
RUNS = f"""
import sys
from pathlib import Path
from harness.block import Commands
from harness.progress import shown_on
from harness.registry import load_plugin, resolve
from harness.run import run
from harness.suite import load_suite

start = [sys.executable, "-P", {str(PLUGIN)!r}]
plugin = load_plugin(Path({str(PLUGIN)!r}))
suite = load_suite(Path(sys.argv[1]), plugin.problems, plugin.solvers)
with shown_on(sys.stderr) as progress:
    run(
        suite, families=plugin.problems, out=Path(sys.argv[2]),
        commands=Commands(
            solvers={{s.label: [*start, s.name] for s in suite.solvers}},
            generator=[*start, "generator"],
        ),
        resolve=lambda spec: resolve(spec, plugin.solvers),
        environment={{}}, digest="here", progress=progress,
    )
"""


def started(suite, out):
    return subprocess.Popen(
        [sys.executable, "-P", "-c", RUNS, str(suite), str(out)],
        stderr=subprocess.DEVNULL,
    )


def children(process):
    tasks = Path(f"/proc/{process}/task").glob("*/children")
    with suppress(OSError):
        return [int(child) for task in tasks for child in task.read_text().split()]
    return []


def killed_at_random(suite, out, kills, rng, longest):
    """Kill the run or one of its processes `kills` times, then let it end."""
    run = started(suite, out)
    for _ in range(kills):
        time.sleep(rng.uniform(0.0, longest))
        if run.poll() is None and rng.random() < 0.5 and (young := children(run.pid)):
            with suppress(ProcessLookupError):
                os.kill(rng.choice(young), signal.SIGKILL)
            continue
        run.kill()
        run.wait()
        run = started(suite, out)
    assert run.wait() == 0
    assert started(suite, out).wait() == 0  # what could not be built, again


def check(tmp_path, kills, seed):
    suite = tmp_path / "suite.toml"
    suite.write_text(SUITE)
    begin = time.monotonic()
    assert started(suite, tmp_path / "whole").wait() == 0
    longest = time.monotonic() - begin
    whole = read_journal(tmp_path / "whole")
    assert len(whole) == 2 * (4 * 4 + 1) + 3 * (4 * 4 + 1)

    killed_at_random(suite, tmp_path / "killed", kills, random.Random(seed), longest)
    got = read_journal(tmp_path / "killed")

    assert len({r.run_id for r in got}) == len(got)  # exactly once
    assert {r.run_id for r in got} == {r.run_id for r in whole}
    verdicts = {r.run_id: r.status for r in whole}
    changed = [r for r in got if r.status != verdicts[r.run_id]]
    assert (
        len(changed) <= 3 * kills
    )  # those whose worker was killed: a sequence at most
    for record in changed:
        assert record.message.endswith("SIGKILL"), record
    assert not list((tmp_path / "killed").glob(".scratch/*"))


def test_a_run_killed_a_few_times_ends_as_an_undisturbed_one(tmp_path):
    check(tmp_path, kills=5, seed=161803)


@pytest.mark.slow
def test_a_run_killed_fifty_times_ends_as_an_undisturbed_one(tmp_path):
    check(tmp_path, kills=50, seed=141421)
