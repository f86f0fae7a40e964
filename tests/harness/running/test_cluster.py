"""Runs on a real Dask scheduler with two worker processes, some of which are lost."""

import json
import os
import re
import signal
import subprocess
import sys
import threading
from contextlib import contextmanager, suppress
from functools import partial
from pathlib import Path

import pytest

from mortarbench.harness import InputError
from mortarbench.harness.environment.environment import capture, digest
from mortarbench.harness.registry import load_plugin
from mortarbench.harness.results.folder import environment_of
from mortarbench.harness.results.journal import read_journal
from tests.support import ROOT, TOY_PROBLEM, WRITE_REPORT, no_report
from tests.support.toy_registries import toy_registries
from tests.support.waiting import LONGEST, soon

Client = pytest.importorskip("distributed").Client

PLUGIN = load_plugin(TOY_PROBLEM)
SOLVERS = 4  #: number of measurements per block
CASES = 2  #: default number of cases
SUITE = """
name = "toy_problem"
repeats = 1
time_limit = 30
solvers = ["exact", "slow", "picky", "dies"]
[[problems]]
family = "well"
params = {{ depth = {depths}, n = 3 }}
forms = ["dual"]
"""


def suite_of(cases):
    return SUITE.format(depths=[*range(1, cases + 1)])


class Cluster:
    """Dask scheduler with workers that tests can kill."""

    def __init__(self, folder, forks, *options):
        self.folder = folder
        self._forks = forks
        self.starts = folder / "starts"
        self.starts.touch()
        self._env = os.environ | {
            "STARTS": str(self.starts),
            "DASK_DISTRIBUTED__WORKER__PROFILE__ENABLED": "False",
        }
        self._file = folder / "scheduler.json"
        self.scheduler = self._started(
            "scheduler", "--port", "0", "--host", "127.0.0.1", "--no-dashboard",
            "--scheduler-file", str(self._file), *options,
        )  # fmt: skip
        self.workers = []
        assert soon(lambda: self._file.exists() and self._file.read_text())

    @property
    def address(self):
        return json.loads(self._file.read_text())["address"]

    def join(self, nthreads=1, serves=True):
        worker = self._started(
            "worker", "--scheduler-file", str(self._file), "--nthreads", str(nthreads),
            "--no-nanny", "--no-dashboard", "--memory-limit", "0",
            "--local-directory", str(self.folder), serves=serves,
        )  # fmt: skip
        self.workers.append(worker)
        return worker

    def _started(self, *arguments, serves=False):
        return self._forks.dask(arguments, self._env, serves)

    def started_solvers(self):
        """Return the IDs of processes that started a slow solve, in order of starts."""
        return [int(line.split()[0]) for line in self.starts.read_text().splitlines()]

    def close(self):
        for process in (*self.workers, self.scheduler):
            process.kill()
            process.wait()


@pytest.fixture
def cluster(tmp_path, forks):
    cluster = Cluster(tmp_path, forks)
    yield cluster
    cluster.close()


@pytest.fixture
def cli(command, monkeypatch, tmp_path):
    """Return a function that runs a command line on the toy problem in a folder with a
    suite.
    """
    monkeypatch.setattr(WRITE_REPORT, no_report)
    monkeypatch.setenv("STARTS", str(tmp_path / "starts"))
    (tmp_path / "toy.toml").write_text(suite_of(CASES))
    return partial(command, registries=toy_registries())


def measured(folder):
    """Return the verdicts in a journal by run_id; assert that no run_id
    occurs twice.
    """
    records = read_journal(Path(folder))
    found = {r.run_id: r.status for r in records}
    assert len(found) == len(records)
    return found


def stored(folder):
    """Return the number of measurements in a journal; 0 if there is none."""
    with suppress(InputError):
        return len(read_journal(Path(folder)))
    return 0


def node_of(solver):
    """Return the ID of the Dask worker of a solver: the parent of its sub-reaper."""
    reaper = parent(solver)
    return None if reaper is None else parent(reaper)


def parent(process):
    """Return the ID of the parent of a process; None if the process has ended."""
    with suppress(OSError):
        return int(
            Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[1]
        )


@contextmanager
def meanwhile(action):
    thread = threading.Thread(target=action)
    thread.start()
    yield
    thread.join()


def test_two_workers_measure_the_same_as_one_although_one_is_killed(
    cli, cluster, tmp_path
):
    cli("run", "toy.toml", "--out", "alone")
    victim = cluster.join()
    cluster.join()
    cluster.starts.write_text("")
    with Client(cluster.address) as client:
        client.wait_for_workers(2, LONGEST)

    def kill():
        assert soon(lambda: victim.pid in map(node_of, cluster.started_solvers()))
        victim.kill()  # in the middle of a measurement

    with meanwhile(kill):
        code, _, err = cli(
            "run", "toy.toml", "--out", "both", "--dask", cluster.address
        )
    records = read_journal(tmp_path / "both")
    slow = [r for r in records if r.solver == "slow"]

    assert code == 0, err
    assert len(cluster.started_solvers()) > len(slow)  # a lost measurement was repeated
    assert measured("both") == measured("alone")
    assert victim.poll() == -signal.SIGKILL
    assert {r.node for r in records} == {os.uname().nodename}
    (there,) = {r.environment for r in records}
    stored = environment_of(tmp_path / "both", there)
    assert stored.pop("digest") == digest(stored) == there
    for number in {r.block for r in records}:  # each block has a single case
        assert len({r.case for r in records if r.block == number}) == 1


def test_the_block_of_a_lost_worker_is_measured_again_as_a_whole(
    cli, cluster, tmp_path
):
    Path("toy.toml").write_text(suite_of(1))
    victim = cluster.join()

    def kill():
        assert soon(cluster.started_solvers)
        victim.kill()
        cluster.join()

    with meanwhile(kill):
        code, _, err = cli("run", "toy.toml", "--out", "d", "--dask", cluster.address)
    records = read_journal(tmp_path / "d")

    assert code == 0, err
    assert len(measured("d")) == SOLVERS
    assert len({r.block for r in records}) == 1
    assert len({*cluster.started_solvers()}) == 2  # one is the lost measurement


@pytest.mark.slow
def test_a_cluster_without_workers_ends_the_run_which_the_same_command_continues(
    cli, cluster, monkeypatch
):
    monkeypatch.setattr("mortarbench.harness.running.cluster.LOST_SECONDS", 1.0)
    victim = cluster.join()

    def kill():
        assert soon(lambda: stored("d"))  # the first block
        victim.kill()

    with meanwhile(kill):
        code, _, err = cli("run", "toy.toml", "--out", "d", "--dask", cluster.address)
    before = measured("d")

    assert code == 2
    assert "Traceback" not in err
    assert "all its workers are gone" in err.splitlines()[-1]
    assert err.splitlines()[-1].endswith("and repeat the command to continue")
    cluster.join()
    assert cli("run", "toy.toml", "--out", "d", "--dask", cluster.address)[0] == 0
    assert len(before) == SOLVERS < len(measured("d"))


def test_an_address_without_a_scheduler_is_reported_in_one_line(cli, monkeypatch):
    monkeypatch.setattr("mortarbench.harness.running.cluster.CONNECT_SECONDS", 0.5)
    for address in (
        "tcp://127.0.0.1:9",
        "tls://127.0.0.1:9",
        "nonsense://x",
        "ucx://x",
        "",
    ):
        code, _, err = cli("run", "toy.toml", "--out", "d", "--dask", address)
        assert code == 2
        assert err.splitlines()[-1].startswith(f"mortarbench: --dask {address}:")
        assert not Path("d").exists()


def test_a_missing_dask_is_reported_with_the_package_to_install(cli, monkeypatch):
    monkeypatch.setitem(sys.modules, "distributed", None)
    code, _, err = cli("run", "toy.toml", "--out", "d", "--dask", "local")

    assert (code, err.count("\n")) == (2, 1)
    assert "[cluster]" in err


@pytest.mark.slow
def test_a_lost_scheduler_ends_the_run_and_the_same_command_continues(
    cli, cluster, tmp_path
):
    cluster.join()

    def kill():
        assert soon(lambda: stored("d"))  # a worker has begun the next block
        cluster.scheduler.kill()

    with meanwhile(kill):
        code, _, err = cli("run", "toy.toml", "--out", "d", "--dask", cluster.address)
    before = measured("d")
    assert code == 2
    assert err.splitlines()[-1].endswith("and repeat the command to continue")

    cluster.close()
    assert cli("run", "toy.toml", "--out", "d")[0] == 0
    cli("run", "toy.toml", "--out", "alone")
    assert measured("d") == measured("alone")
    assert 0 < len(before) < len(measured("d"))


def descendants(process):
    """Return all descendants of a process."""
    tasks = Path(f"/proc/{process}/task").glob("*/children")
    children = [int(child) for task in tasks for child in task.read_text().split()]
    return [*children, *(d for child in children for d in descendants(child))]


@pytest.mark.slow
def test_a_finished_run_leaves_nothing_on_the_nodes(cli, cluster):
    worker = cluster.join()
    assert soon(lambda: descendants(worker.pid))  # the fork server, which outlives runs
    before, idle = set(descendants(worker.pid)), []

    def look():
        assert soon(cluster.started_solvers)
        idle.extend(set(descendants(worker.pid)) - before)

    with meanwhile(look):
        run = ("run", "toy.toml", "--out", "d", "--case", "well/depth=2/dual")
        assert cli(*run, "--dask", cluster.address)[0] == 0

    assert len(idle) >= 2  # a solver and the case worker
    assert soon(lambda: set(descendants(worker.pid)) == before)


def start(*arguments, **how):
    """Start a run of the toy problem in a separate process."""
    program = (
        "import sys; sys.path.insert(0, sys.argv[1]); import toy_problem; "
        "from mortarbench.cli.main import main; "
        "from mortarbench.registries import Registries; "
        "nothing = {'reference': None}; "
        "sys.exit(main(Registries(families=toy_problem.PROBLEMS, "
        "solvers=toy_problem.SOLVERS, "
        "**nothing, "
        "start=(sys.executable, '-P', toy_problem.__file__)), sys.argv[2:]))"
    )
    command = [sys.executable, "-c", program, str(TOY_PROBLEM.parent)]
    return subprocess.Popen([*command, "run", "toy.toml", *arguments], **how)


@pytest.mark.slow
def test_after_a_killed_parent_the_next_run_cleans_up_and_continues(
    cli, cluster, tmp_path
):
    worker = cluster.join(serves=False)
    run = start("--out", "d", "--dask", cluster.address)
    assert soon(lambda: stored("d"))  # the worker has begun the next block
    run.kill()
    run.wait()
    before = measured("d")

    code, _, err = cli("run", "toy.toml", "--out", "d", "--dask", cluster.address)
    assert code == 0, err
    cli("run", "toy.toml", "--out", "alone")
    assert measured("d") == measured("alone")
    assert 0 < len(before) < len(measured("d"))
    assert soon(lambda: not descendants(worker.pid))


SCRIPT = """
import mortarbench as mb

if __name__ == "__main__":
    df = mb.run("string.toml", out="d", dask="local").df
    print(len(df), sorted(map(int, set(df.cpu))))
"""


@pytest.mark.slow
def test_each_worker_of_a_local_cluster_has_its_own_cpu(tmp_path):
    (tmp_path / "script.py").write_text(SCRIPT)
    text = suite_of(0).replace("well", "string").replace('"dual"', '"primal"')
    sizes = [*range(10, 60, 10)]
    text = re.sub("params.*", f"params = {{ n = {sizes} }}", text)
    text = re.sub("solvers.*", 'solvers = ["smalbe"]', text)
    (tmp_path / "string.toml").write_text(text)
    done = subprocess.run(
        [sys.executable, "script.py"], cwd=tmp_path, capture_output=True, text=True,
        env=os.environ | {"PYTHONPATH": str(ROOT)},
    )  # fmt: skip

    cpus = [*os.sched_getaffinity(0)]
    assert (done.returncode, done.stdout) == (0, f"{len(sizes)} {cpus}\n"), done.stderr


@pytest.mark.slow
def test_a_block_that_kills_every_worker_is_abandoned_and_others_are_measured(
    cli, tmp_path
):
    (tmp_path / "toy.toml").write_text(suite_of(6))
    code, out, err = cli(
        "run", "toy.toml", "--out", "d", "--dask", "local",
        "--solver", "exact", "--solver", "murders",
    )  # fmt: skip

    assert code == 1, err
    assert "well/depth=4/dual was given up" in err
    assert "1 case could not be built: well/depth=4/dual" in out
    made = {(r.solver, r.params["depth"]) for r in read_journal(tmp_path / "d")}
    assert {("murders", depth) for depth in (1, 2, 3, 5, 6)} < made
    assert {("exact", depth) for depth in (1, 2, 3, 5, 6)} < made
    assert len(measured("d")) == len(made)
    assert ("murders", 4) not in made


@pytest.mark.parametrize(
    "change",
    [
        lambda there: there["versions"].update(mortarbench="9.9"),
        lambda there: there.update(source={"commit": "0", "dirty": False}),
        lambda there: there["plugins"].update({"a.py": "0123456789ab"}),
    ],
)
def test_a_node_with_other_code_is_refused(change):
    from mortarbench.harness.running.cluster import refuse_other_code

    here = capture()
    there = json.loads(json.dumps(here))
    refuse_other_code("node07", here, there)
    change(there)
    with pytest.raises(InputError, match="node07 runs different code"):
        refuse_other_code("node07", here, there)
