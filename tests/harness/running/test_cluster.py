"""Runs on a real Dask scheduler with two worker processes, some of which are lost."""

import json
import multiprocessing
import os
import re
import signal
import subprocess
import sys
import threading
import time
from collections import Counter
from contextlib import contextmanager, suppress
from importlib.util import find_spec
from pathlib import Path

import pytest

from mortarbench.cli.main import main
from mortarbench.harness import InputError
from mortarbench.harness.environment.environment import capture, digest
from mortarbench.harness.registry import load_plugin
from mortarbench.harness.results.folder import environment_of
from mortarbench.harness.results.journal import read_journal
from mortarbench.registries import Registries
from tests.support import ROOT, TOY_PROBLEM
from tests.support.waiting import soon

if find_spec("distributed") is None:
    pytest.skip("no distributed", allow_module_level=True)

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
        # folder of the CPU locks; other test clusters use other folders
        locks = folder / "locks"
        locks.mkdir(exist_ok=True)
        self._env = os.environ | {
            "STARTS": str(self.starts), "TMPDIR": str(locks),
            "DASK_DISTRIBUTED__WORKER__PROFILE__ENABLED": "False",
        }  # fmt: skip
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
def cli(capsys, monkeypatch, tmp_path):
    """Return a function that runs a command line on the toy problem in a folder with a
    suite; it returns the exit code, stdout and stderr.
    """
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(os, "getloadavg", lambda: (0.1, 0.1, 0.1))
    monkeypatch.setenv("STARTS", str(tmp_path / "starts"))
    (tmp_path / "toy.toml").write_text(suite_of(CASES))
    nothing = {"reference": None}
    registries = Registries(
        families=PLUGIN.problems,
        solvers=PLUGIN.solvers,
        report=lambda *_, **__: [],
        start=(sys.executable, "-P", str(TOY_PROBLEM)),
        **nothing,
    )

    def cli(*argv):
        code = main(registries, argv)
        return code, *capsys.readouterr()

    return cli


def measured(folder):
    """Return the verdicts in a journal by run_id; assert that no run_id
    occurs twice.
    """
    records = read_journal(Path(folder))
    found = {r.run_id: r.status for r in records}
    assert len(found) == len(records)
    return found


def partial_blocks(folder):
    """Return the numbers of blocks of which a journal has only some measurements."""
    with suppress(InputError):
        counts = Counter(r.block for r in read_journal(Path(folder)))
        return [number for number, count in counts.items() if count < SOLVERS]
    return []


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


@pytest.fixture
def all_cpus():
    """Allow all CPUs of the machine instead of the CPUs of a pytest worker."""
    before = os.sched_getaffinity(0)
    os.sched_setaffinity(0, range(os.cpu_count()))
    yield
    os.sched_setaffinity(0, before)


@pytest.mark.usefixtures("all_cpus")  # each Dask worker needs its own CPU
def test_two_workers_measure_the_same_as_one_although_one_is_killed(
    cli, cluster, tmp_path
):
    cli("run", "toy.toml", "--out", "alone")
    victim = cluster.join()
    cluster.join()
    cluster.starts.write_text("")

    def kill():
        assert soon(lambda: victim.pid in map(node_of, cluster.started_solvers()))
        victim.kill()  # in the middle of a measurement

    with meanwhile(kill):
        code, _, err = cli(
            "run", "toy.toml", "--out", "both", "--dask", cluster.address
        )
    records = read_journal(tmp_path / "both")
    cpus = {line.partition(" ")[2] for line in cluster.starts.read_text().splitlines()}
    slow = [r for r in records if r.solver == "slow"]

    assert code == 0, err
    assert len(cluster.started_solvers()) > len(slow)  # a lost measurement was repeated
    assert measured("both") == measured("alone")
    assert victim.poll() == -signal.SIGKILL
    assert {r.node for r in records} == {os.uname().nodename}
    assert len(cpus) == min(2, len(os.sched_getaffinity(0)))  # a CPU for each worker
    (there,) = {r.environment for r in records}
    stored = environment_of(tmp_path / "both", there)
    assert stored.pop("digest") == digest(stored) == there
    for number in {r.block for r in records}:  # each block has a single case
        assert len({r.case for r in records if r.block == number}) == 1


def test_results_of_a_lost_worker_are_kept_and_the_rest_is_a_new_block(
    cli, cluster, tmp_path
):
    Path("toy.toml").write_text(suite_of(1))
    victim = cluster.join()
    cut = []

    def kill():
        assert soon(lambda: cut or cut.extend(partial_blocks("d")))
        victim.kill()  # results that it has returned are in the journal
        cluster.join()

    with meanwhile(kill):
        code, _, err = cli("run", "toy.toml", "--out", "d", "--dask", cluster.address)
    records = read_journal(tmp_path / "d")
    blocks = {}
    for r in records:
        blocks.setdefault(r.block, []).append(r)
    (number,) = cut

    assert code == 0, err
    assert len(measured("d")) == SOLVERS
    assert len(blocks) == 2
    (rest,) = [
        n for n, block in blocks.items() if n != number
        and block[0].case == blocks[number][0].case
    ]  # fmt: skip
    both = blocks[number] + blocks[rest]
    assert sorted(r.solver for r in both) == ["dies", "exact", "picky", "slow"]
    assert 0 < len(blocks[number]) < SOLVERS


def test_a_worker_that_takes_two_blocks_at_a_time_is_refused(cli, cluster):
    cluster.join(nthreads=2)
    code, _, err = cli("run", "toy.toml", "--out", "d", "--dask", cluster.address)

    assert code == 2
    assert "--nthreads 1" in err.splitlines()[-1]


def test_an_address_without_a_scheduler_is_reported_in_one_line(cli, monkeypatch):
    monkeypatch.setattr("mortarbench.harness.running.cluster.CONNECT_SECONDS", 0.5)
    for address in ("tcp://127.0.0.1:9", "nonsense://x", "ucx://x", ""):
        code, _, err = cli("run", "toy.toml", "--out", "d", "--dask", address)
        assert code == 2
        assert err.splitlines()[-1].startswith(f"mortarbench: --dask {address}:")
        assert not Path("d").exists()


def test_an_address_without_a_scheduler_leaves_the_folder_unchanged(cli, monkeypatch):
    """Test the option --fresh, which deletes earlier results before a run."""
    monkeypatch.setattr("mortarbench.harness.running.cluster.CONNECT_SECONDS", 0.5)
    assert cli("run", "toy.toml", "--out", "d", "--solver", "exact")[0] == 0
    before = measured("d")

    code = cli("run", "toy.toml", "--out", "d", "--fresh", "--dask", "nonsense://x")[0]

    assert code == 2
    assert measured("d") == before


@pytest.fixture
def ctrl_c_enabled():
    """Restore the effect of Ctrl-C, which background jobs of a shell ignore."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.mark.usefixtures("ctrl_c_enabled")
def test_ctrl_c_during_the_start_of_a_local_cluster_is_deferred():
    from mortarbench.harness.running.cluster import _delay_interrupt

    start = multiprocessing.get_context("spawn").Process  # as Dask does
    child = start(target=time.sleep, args=(60,))
    with pytest.raises(KeyboardInterrupt), _delay_interrupt():  # noqa: PT012
        os.kill(os.getpid(), signal.SIGINT)
        child.start()

    status = Path(f"/proc/{child.pid}/status").read_text()
    child.kill()
    child.join()
    blocked = int(re.search(r"^SigBlk:\s*(\w+)", status, re.M)[1], 16)
    assert blocked >> (signal.SIGINT - 1) & 1
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
    assert signal.SIGINT not in signal.pthread_sigmask(signal.SIG_BLOCK, [])


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
        assert soon(lambda: partial_blocks("d"))  # a worker is in the middle of a block
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


def start(*arguments):
    """Start a run of the toy problem in a separate process."""
    program = (
        "import sys; sys.path.insert(0, sys.argv[1]); import toy_problem; "
        "from mortarbench.cli.main import main; "
        "from mortarbench.registries import Registries; "
        "from mortarbench.harness.plugin import as_family; "
        "families = {k: as_family(f) for k, f in toy_problem.PROBLEMS.items()}; "
        "nothing = {'reference': None}; "
        "main(Registries(families=families, solvers=toy_problem.SOLVERS, "
        "report=lambda *_, **__: [], **nothing, "
        "start=(sys.executable, '-P', toy_problem.__file__)), sys.argv[2:])"
    )
    command = [sys.executable, "-c", program, str(TOY_PROBLEM.parent)]
    return subprocess.Popen([*command, "run", "toy.toml", *arguments])


@pytest.mark.slow
def test_after_a_killed_parent_the_next_run_cleans_up_and_continues(
    cli, cluster, tmp_path
):
    worker = cluster.join(serves=False)
    run = start("--out", "d", "--dask", cluster.address)
    assert soon(lambda: partial_blocks("d"))  # the worker is in the middle of a block
    run.kill()
    run.wait()
    before = measured("d")

    code, _, err = cli("run", "toy.toml", "--out", "d", "--dask", cluster.address)
    assert code == 0, err
    cli("run", "toy.toml", "--out", "alone")
    assert measured("d") == measured("alone")
    assert 0 < len(before) < len(measured("d"))
    assert soon(lambda: not descendants(worker.pid))


@pytest.fixture
def one_cpu():
    """Restrict processes started by the test to one CPU."""
    before = os.sched_getaffinity(0)
    os.sched_setaffinity(0, {max(before)})
    yield
    os.sched_setaffinity(0, before)


@pytest.mark.slow
@pytest.mark.usefixtures("one_cpu")
def test_a_worker_with_one_cpu_serves_a_run_beside_an_orphaned_worker(
    cli, cluster, tmp_path
):
    """A scheduler may detect a dead client only after the start of the next run.

    A stopped parent imitates this delay.
    """
    worker = cluster.join(serves=False)
    run = start("--out", "d", "--dask", cluster.address)
    assert soon(lambda: partial_blocks("d"))
    run.send_signal(signal.SIGSTOP)
    try:
        code, _, err = cli("run", "toy.toml", "--out", "e", "--dask", cluster.address)
        assert code == 0, err
        assert len(measured("e")) == CASES * SOLVERS
    finally:
        run.kill()
        run.wait()
    few = ("run", "toy.toml", "--out", "f", "--case", "well/depth=2/dual")
    assert cli(*few, "--dask", cluster.address)[0] == 0
    assert soon(lambda: not descendants(worker.pid))


UNGUARDED = """
import sys
import mortarbench as mb

try:
    mb.run("string.toml", out="d", dask="local")
except mb.InputError as e:
    sys.exit(str(e))
"""


@pytest.mark.slow
def test_a_script_without_a_main_guard_is_refused_in_one_line(tmp_path):
    (tmp_path / "script.py").write_text(UNGUARDED)
    text = suite_of(CASES).replace("well", "string").replace('"dual"', '"primal"')
    (tmp_path / "string.toml").write_text(
        re.sub(
            "params.*",
            "params = { n = 10 }",
            re.sub("solvers.*", 'solvers = ["smalbe"]', text),
        )
    )
    done = subprocess.run(
        [sys.executable, "script.py"], cwd=tmp_path, stderr=subprocess.PIPE, text=True,
        env=os.environ | {"PYTHONPATH": str(ROOT)},
    )  # fmt: skip

    assert done.returncode == 1
    assert done.stderr.count("\n") == 1, done.stderr
    assert '`if __name__ == "__main__":`' in done.stderr
    assert not (tmp_path / "d").exists()


@pytest.mark.slow
def test_a_block_that_kills_every_worker_is_abandoned_and_others_are_measured(
    cli, tmp_path
):
    (tmp_path / "toy.toml").write_text(suite_of(6))
    code, out, err = cli(
        "run", "toy.toml", "--out", "d", "--dask", "local",
        "--solver", "exact", "--solver", "murders",
    )  # fmt: skip

    assert code == 1
    assert "well/depth=4/dual was given up" in err
    assert "1 case could not be built: well/depth=4/dual" in out
    made = {(r.solver, r.params["depth"]) for r in read_journal(tmp_path / "d")}
    assert {("murders", depth) for depth in (1, 2, 3, 5, 6)} < made
    assert {("exact", depth) for depth in (1, 2, 3, 5, 6)} < made
    assert len(measured("d")) == len(made)
    assert ("murders", 4) not in made


@pytest.fixture
def meet():
    """Return a function that adds a node with a changed environment to `Nodes`.

    The function returns the stored environments and the warnings.
    """
    from mortarbench.harness.running.cluster import Nodes

    kept, said = {}, []
    here = capture()
    nodes = Nodes(here, kept.__setitem__, said.append)

    def meet(change):
        there = json.loads(json.dumps(here))
        change(there)
        nodes.add("node07", digest(there), there)
        return kept, said

    return meet


def test_an_equal_node_is_stored_without_a_warning(meet):
    kept, said = meet(lambda there: there["now"].update(load=3.0))
    assert (len(kept), said) == (1, [])


def test_another_environment_is_stored_with_one_warning(meet):
    for _ in range(2):
        kept, said = meet(lambda there: there["machine"].update(cpu="Another"))
    assert len(kept) == 1
    assert len(said) == 1
    cpu = capture()["machine"]["cpu"]
    assert said[0].startswith(
        "node07 measures under different conditions from this machine "
        f"(machine.cpu: {cpu} here, Another there); "
    )


def test_workers_that_share_a_machine_are_named_in_the_warning(meet):
    _, said = meet(lambda there: there["machine"].update(shared_by_workers=2))
    assert "(machine.shared_by_workers: None here, 2 there)" in said[0]


@pytest.mark.parametrize(
    "change",
    [
        lambda there: there["versions"].update(mortarbench="9.9"),
        lambda there: there.update(source={"commit": "0", "dirty": False}),
        lambda there: there["plugins"].update({"a.py": "0123456789ab"}),
    ],
)
def test_a_node_with_other_code_is_refused(meet, change):
    with pytest.raises(InputError, match="node07 runs different code"):
        meet(change)
