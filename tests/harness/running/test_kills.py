"""Runs that are killed, or run out of disk space, at random times and continue."""

import os
import random
import resource
import signal
import subprocess
import sys
import time
from contextlib import suppress
from pathlib import Path
from unittest.mock import ANY

import pytest

from mortarbench.harness.results.journal import read_journal
from tests.support import ADVERSARIES
from tests.support.fork_server import INSTALL

PLUGIN = ADVERSARIES
SUITE = """
name = "killed"
repeats = {repeats}
time_limit = 20
solvers = ["sleeps", "honest", "dies", "declines", "chains"]
[[problems]]
family = "tiny"
params = {{ h = [0.5, 1.0] }}
[[problems]]
family = "tiny"
sequence = "h"
params = {{ h = [0.5, 1.0, 1.5] }}
"""
#: program of a run in a separate process; arguments: suite, folder
RUNS = f"""
import sys
from pathlib import Path
from mortarbench.harness import InputError
from mortarbench.harness.results.work_unit import Commands
from mortarbench.progress import display_on
from mortarbench.harness.registry import load_plugin, resolve
from mortarbench.harness.running.run import run
from mortarbench.harness.suite.suite import load_suite

exec(sys.argv[3])
start = [sys.executable, "-P", {str(PLUGIN)!r}]
plugin = load_plugin(Path({str(PLUGIN)!r}))
suite = load_suite(Path(sys.argv[1]), plugin.problems, plugin.solvers)
try:
    with display_on(sys.stderr) as progress:
        run(
            suite, out=Path(sys.argv[2]),
            commands=Commands(
                solvers={{s.label: [*start, s.name] for s in suite.solvers}},
                case_worker=[*start, "generator"],
            ),
            resolve=lambda spec: resolve(spec, plugin.solvers),
            environment={{}}, digest="here", progress=progress,
        )
except InputError as e:
    print(e, file=sys.stderr)
    sys.exit(2)
except KeyboardInterrupt:
    sys.exit(130)
"""
#: possible exit codes of a run by signal, which may arrive at any time
ASKED = {
    signal.SIGINT: (130, -signal.SIGINT, 1, 0),
    signal.SIGTERM: (143, -signal.SIGTERM, 0),
}


def start(suite, out):
    """Start a run whose first child is the server that forks its processes."""
    return subprocess.Popen(
        [sys.executable, "-P", "-c", RUNS, str(suite), str(out), INSTALL],
        stderr=subprocess.PIPE, text=True,
    )  # fmt: skip


def end_of(run):
    """Return the exit code of a run and the last line of its stderr."""
    said = run.communicate()[1].splitlines()
    return run.returncode, said[-1] if said else ""


def children(process):
    tasks = Path(f"/proc/{process}/task").glob("*/children")
    with suppress(OSError):
        return [int(child) for task in tasks for child in task.read_text().split()]
    return []


def family(process):
    """Yield a process and all of its descendants."""
    yield process
    for child in children(process):
        yield from family(child)


def kill_one(run, rng, out):
    """Kill the run or one of its child processes."""
    if rng.random() < 0.5 and (young := children(run.pid)[1:]):
        with suppress(ProcessLookupError):
            os.kill(rng.choice(young), signal.SIGKILL)
        return
    run.kill()
    run.communicate()


def ask_to_end(run, rng, out):
    """Send SIGINT, as Ctrl-C does, or SIGTERM, as a batch system does."""
    number = rng.choice(list(ASKED))
    run.send_signal(number)
    assert end_of(run)[0] in ASKED[number]


def fill_by_limit(run, rng, out):
    """Set a file size limit of zero for all processes of the run; check its end."""
    for process in family(run.pid):  # new child processes inherit the limit
        with suppress(ProcessLookupError, PermissionError):
            hard = resource.prlimit(process, resource.RLIMIT_FSIZE)[1]
            resource.prlimit(process, resource.RLIMIT_FSIZE, (0, hard))
    assert_told(run)


def fill_by_files(run, rng, out):
    """Fill the file system of the folder; check the end of the run."""
    filler = out.parent / "filler"
    try:
        with suppress(OSError), filler.open("wb", buffering=0) as file:
            while True:
                file.write(bytes(4096))
        assert_told(run)
    finally:
        filler.unlink()


def assert_told(run):
    """Assert that a run on a full disk ended with code 0, or with 2 and a remedy."""
    code, said = end_of(run)
    assert code in (0, 2), (code, said)
    if code == 2:
        assert said.endswith("free some space; the same command continues the run")


def disturb(suite, out, events, rng, longest):
    """Apply all `events` to runs at random times, then let one run finish."""
    run = start(suite, out)
    for event in events:
        with suppress(subprocess.TimeoutExpired):
            run.wait(rng.uniform(0.0, longest))
        if run.poll() is None:
            event(run, rng, out)
        if run.poll() is None:
            continue
        if not run.stderr.closed:  # the run ended by itself
            assert end_of(run) == (0, ANY)
        run = start(suite, out)
    assert end_of(run)[0] == 0
    # cases that could not be built are built again
    assert end_of(start(suite, out))[0] == 0


def check(tmp_path, events, seed, out=None, repeats=4):
    suite = tmp_path / "suite.toml"
    suite.write_text(SUITE.format(repeats=repeats))
    begin = time.monotonic()
    assert end_of(start(suite, tmp_path / "whole"))[0] == 0
    longest = (time.monotonic() - begin) / 2
    whole = read_journal(tmp_path / "whole")
    assert len(whole) == 5 * (4 * repeats + 1)

    rng = random.Random(seed)
    rng.shuffle(events)
    out = out or tmp_path / "disturbed"
    disturb(suite, out, events, rng, longest)
    got = read_journal(out)

    assert len({r.run_id for r in got}) == len(got)  # exactly once
    assert {r.run_id for r in got} == {r.run_id for r in whole}
    verdicts = {r.run_id: r.status for r in whole}
    changed = [r for r in got if r.status != verdicts[r.run_id]]
    assert len(changed) <= 3 * events.count(
        kill_one
    )  # a killed worker affects at most the three steps of a sequence
    for record in changed:
        assert record.message.endswith("SIGKILL"), record
    assert not list(out.glob(".scratch/*"))
    assert not list(out.rglob("*.tmp"))


def test_a_run_disturbed_a_few_times_completes_all_measurements(tmp_path):
    # kills a worker, later the run
    check(tmp_path, [kill_one, kill_one], seed=161803, repeats=1)


@pytest.mark.slow
def test_kills_and_full_disks_lose_no_measurement(small_disk):
    tmp_path, fill = small_disk
    events = [kill_one] * 15 + [ask_to_end] * 6 + [fill] * 4 + [fill_by_limit] * 2
    check(tmp_path, events, seed=141421, out=tmp_path / "disk" / "out")


@pytest.fixture
def small_disk(tmp_path):
    """Mount a file system of 8 MiB on the folder `disk`; return the parent folder, and
    a function that fills the file system.

    For users who may not mount file systems, a file size limit is used instead.
    """
    disk = tmp_path / "disk"
    disk.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", "size=8m", "tmpfs", str(disk)]
    if subprocess.run(mount, capture_output=True).returncode:
        yield tmp_path, fill_by_limit
        return
    yield tmp_path, fill_by_files
    subprocess.run(["umount", str(disk)], check=True)
