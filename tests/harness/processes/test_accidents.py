"""Solvers that disturb a run by accident, and verdicts on other solvers of the run."""

import os
import re
import secrets
import signal
import subprocess
import sys
from contextlib import suppress
from pathlib import Path

import pytest

from mortarbench.harness import Verdict
from mortarbench.harness.errors import FaultError
from mortarbench.harness.files.mapped import content_digest
from mortarbench.harness.files.qpfile import save_qp
from mortarbench.harness.names import assemble
from mortarbench.harness.processes import supervisor
from mortarbench.harness.processes.measurement import (
    measure_and_judge,
)
from mortarbench.harness.processes.protocol import event_of
from mortarbench.harness.processes.scratch import scratch_folder
from mortarbench.harness.processes.supervisor import (
    REPLACEMENT_NOTE,
    WorkerProcess,
)
from mortarbench.harness.registry import SolverSpec, load_plugin, resolve
from mortarbench.harness.results.journal import read_journal
from mortarbench.harness.results.work_unit import Commands
from mortarbench.harness.running.run import run
from mortarbench.harness.verify.verdicts import new_record
from tests.support import ACCIDENTS, ROOT
from tests.support.suites import suite_of
from tests.support.waiting import is_alive, soon

PLUGIN = ACCIDENTS
START = [sys.executable, "-P", str(PLUGIN)]
ACCIDENTS = load_plugin(PLUGIN)
TINY = ACCIDENTS.problems["tiny"]
CASE = assemble("tiny", TINY, {}, "plain")

FOREIGN = "was received, expected 'solved'"
PARENTS_TIME = "the parent's time is recorded"
#: expected verdict and pattern of the message, by solver
OUTCOMES = {
    "writesnoise": (Verdict.FAILED, f"no JSON .*{FOREIGN}|no JSON .* a reply"),
    "writesendlessly": (Verdict.FAILED, "4 MiB were received without an end of line"),
    "daemon": (Verdict.VERIFIED, "^$"),
    "executeddaemon": (Verdict.VERIFIED, "^$"),
    "forkbomb": (Verdict.VERIFIED, "^$"),
    "hangswithadaemon": (Verdict.TIME_LIMIT, "killed after 1 s"),
    "burns": (Verdict.VERIFIED, REPLACEMENT_NOTE),
    "pools": (Verdict.VERIFIED, "^$"),
    "hoardsinshm": (Verdict.MEMORY_LIMIT, "above the limit of 400 MiB"),
    "sharespages": (Verdict.VERIFIED, "^$"),
    "hoardsinadaemon": (Verdict.MEMORY_LIMIT, "above the limit of 400 MiB"),
    "patchestheclock": (Verdict.VERIFIED, PARENTS_TIME),
    "stopsitself": (Verdict.TIME_LIMIT, "killed after 1 s"),
    "killsitself": (Verdict.CRASHED, "^SIGKILL$"),
    "closesall": (Verdict.CRASHED, "Bad file descriptor"),
}
#: one solver of each type; the others are slow tests
QUICK = {
    "writesnoise", "writesendlessly", "daemon", "forkbomb", "burns", "hoardsinshm",
    "hoardsinadaemon", "closesall", "sharespages",
}  # fmt: skip
RUN_TOGETHER = ("daemon", "burns", "writesendlessly", "writesnoise", "patchestheclock")


@pytest.fixture
def watched(monkeypatch):
    """Mark the processes that this test starts with an environment variable."""
    name = secrets.token_hex(8)
    monkeypatch.setenv("WATCHED", name)
    return name


@pytest.fixture(scope="module")
def beside_a_witness(tmp_path_factory):
    """Return a function that measures a solver and then a witness.

    The witness fails if another process of the test runs during its solve. The function
    asserts that the solver leaves no process.
    """
    with pytest.MonkeyPatch.context() as patch:
        name = secrets.token_hex(8)
        patch.setenv("WATCHED", name)
        bench = Bench(tmp_path_factory.mktemp("accidents"))
        assert bench("witness").status is Verdict.VERIFIED
        alone = processes_of(name)
        assert len(alone) == 2  # worker and its parent

        def measured_beside(solver, time_limit):
            patch.setenv("WATCHED", name)
            try:
                record = bench(solver, time_limit=time_limit)
                assert len(set(processes_of(name)) - set(alone)) in (
                    0,
                    2,
                )  # worker and its parent
                assert bench("witness").status is Verdict.VERIFIED
                return record
            finally:
                bench.workers.pop(solver).close()
                assert processes_of(name) == alone

        yield measured_beside
        bench.close()
    assert processes_of(name) == []


def processes_of(watched):
    """List the living processes of a test, except this one."""
    found = []
    for entry in Path("/proc").glob("[0-9]*"):
        with suppress(OSError):
            environment = (entry / "environ").read_bytes().split(b"\0")
            mine = f"WATCHED={watched}".encode() in environment
            if mine and int(entry.name) != os.getpid() and is_alive(int(entry.name)):
                found.append(int(entry.name))
    return found


class Bench:
    """Measurements of solvers on a tiny QP, each in a separate worker."""

    def __init__(self, folder, *, memory_limit=400.0):
        self.folder, self.workers = folder, {}
        self.qp = TINY.build("plain", None).qp
        self.digest = save_qp(folder / "qp.npz", self.qp, serialised=True)
        self.file_digest = content_digest(folder / "qp.npz")
        self.memory_limit = memory_limit

    def __call__(self, solver, *, command=None, time_limit=30.0):
        if solver not in self.workers:
            log = self.folder / f"{solver}.log"
            self.workers[solver] = WorkerProcess(command or [*START, solver], log)
        record = new_record(
            CASE, SolverSpec(name=solver, label=solver),
            options={}, tol=1e-6, repeat=0, environment="",
        ).replace(qp=self.digest)  # fmt: skip
        file = self.folder / "qp.npz"
        return measure_and_judge(
            self.workers[solver], lambda: self.qp, record,
            out=self.folder / "point.npz", qp_file=(file, self.file_digest),
            time_limit=time_limit, memory_limit=self.memory_limit,
        )[0]  # fmt: skip

    def process(self, solver):
        worker = self.workers[solver]._worker
        return worker and worker.pid

    def close(self):
        for worker in self.workers.values():
            worker.close()


@pytest.fixture
def bench(tmp_path, watched):
    bench = Bench(tmp_path)
    yield bench
    bench.close()
    assert processes_of(watched) == []


@pytest.mark.parametrize(
    "solver",
    [a if a in QUICK else pytest.param(a, marks=pytest.mark.slow) for a in OUTCOMES],
)
def test_a_failure_affects_only_its_own_verdict_and_leaves_no_process(
    beside_a_witness, solver
):
    verdict, message = OUTCOMES[solver]
    hangs = verdict is Verdict.TIME_LIMIT
    record = beside_a_witness(solver, 1.0 if hangs else 30.0)

    assert record.status is verdict, record.message
    assert re.search(message, record.message), record.message
    assert len(record.message) < 500


@pytest.mark.parametrize(
    "line",
    [
        b"", b"\xff\xfe\x00", b'"text"', b"[]", b'{"event": []}', b"9" * 100_000,
        b"{" * 1000, b'{"event": "start"}',
    ],
)  # fmt: skip
def test_a_line_other_than_a_reply_to_the_request_is_refused(line):
    assert event_of(b'{"event": "done"}', "done")
    with pytest.raises(ValueError, match="was received") as e:
        event_of(line, "done")

    assert len(str(e.value)) < 300


def suite(*solvers, repeats=2):
    return suite_of(
        *solvers, name="accidents", cases=(CASE,), repeats=repeats, time_limit=10.0,
        memory_limit=400.0,
    )  # fmt: skip


class Silent:
    def start(self, total):
        pass

    say = warn = advance = start


def run_together(out, *solvers):
    given = suite(*solvers)
    run(
        given, out=out, environment={"machine": "test"},
        commands=Commands(
            solvers={s: [*START, s] for s in solvers}, case_worker=[*START, "generator"]
        ),
        resolve=lambda spec: resolve(spec, ACCIDENTS.solvers), digest="here",
        progress=Silent(),
    )  # fmt: skip
    return {s: [r for r in read_journal(out) if r.solver == s] for s in solvers}


@pytest.mark.parametrize(
    "careless",
    [RUN_TOGETHER[:3], pytest.param(RUN_TOGETHER, marks=pytest.mark.slow)],
    ids=["few", "all"],
)
def test_measurements_beside_misbehaving_solvers_are_kept_and_undisturbed(
    tmp_path, watched, careless
):
    got = run_together(tmp_path, "witness", *careless, "honest")

    for neighbour in ("witness", "honest"):
        found = [(r.status, r.message) for r in got[neighbour]]
        assert found == [(Verdict.VERIFIED, "")] * 2
    for solver in careless:
        assert {r.status for r in got[solver]} == {OUTCOMES[solver][0]}
    assert processes_of(watched) == []


def test_sleeping_threads_may_stay_and_busy_threads_may_not(bench):
    bench("pools")
    pool = bench.process("pools")
    bench("pools")
    bench("burns")

    assert bench.process("pools") == pool
    assert bench.process("burns") is None


def test_a_time_that_the_parents_clock_contradicts_is_replaced(bench):
    record = bench("patchestheclock")

    assert record.total_seconds >= 0.002
    assert record.prepare_seconds is record.solve_seconds is None


def test_work_in_declines_is_timed(bench):
    record = bench("worksindeclines")

    assert record.prepare_seconds >= 0.02
    assert record.message == ""


@pytest.mark.parametrize("solver", ["diesonothers", "hangsonothers"])
def test_a_process_that_ends_in_a_repetition_does_not_affect_the_verdict(
    bench, monkeypatch, solver
):
    monkeypatch.setattr(supervisor, "REPEAT_SECONDS", 0.5)
    record = bench(solver)

    assert record.status is Verdict.VERIFIED
    assert (record.inner, record.untimed, record.remembered) == (1, 0, None)
    assert record.message.startswith("solved only once, since a repeated solve ended: ")


def test_a_worker_that_is_killed_before_its_solve_is_a_fault(bench):
    kills = "import os, signal; os.kill(os.getpid(), signal.SIGKILL)"
    command = [sys.executable, "-c", kills]

    with pytest.raises(FaultError, match="before solving: SIGKILL"):
        bench("honest", command=command)


def test_a_worker_killed_in_the_warm_up_is_replaced_without_a_loss(
    bench, tmp_path, monkeypatch
):
    monkeypatch.setenv("KILLED", str(tmp_path / "killed"))
    record = bench("killedoncewarmingup")

    assert (tmp_path / "killed").exists()
    assert record.status is Verdict.VERIFIED


def test_a_solver_that_used_the_memory_of_the_machine_and_was_killed_lacked_memory(
    bench, monkeypatch
):
    monkeypatch.setattr(supervisor.limits, "memory_limit_mib", lambda: 1.0)
    record = bench("killsitself")
    assert record.status is Verdict.MEMORY_LIMIT
    assert "SIGKILL: the machine ran out of memory" in record.message


def test_a_command_that_does_not_exist_is_a_fault(bench):
    with pytest.raises(FaultError, match="no-such-python cannot be started"):
        bench("honest", command=["no-such-python"])


def test_a_plug_in_that_crashes_on_import_yields_the_verdict_crashed(bench):
    record = bench("honest", command=[sys.executable, "-c", "raise SystemExit(3)"])

    assert record.status is Verdict.CRASHED


def test_a_log_that_cannot_be_written_is_a_fault(bench, tmp_path):
    (tmp_path / "honest.log").mkdir()

    with pytest.raises(FaultError, match="Is a directory"):
        bench("honest")


def test_a_qp_that_changed_on_disk_is_a_fault(bench):
    bench("honest")
    file = bench.folder / "qp.npz"
    content = bytearray(file.read_bytes())
    content[7] ^= 1  # in a number: the file remains readable
    file.write_bytes(content)

    with pytest.raises(FaultError, match=r"qp\.npz: was changed on disk"):
        bench("honest")


@pytest.mark.parametrize(
    ("write", "message"),
    [
        ("raise OSError(28, 'No space left on device')", "No space left on device"),
        ("pass", r"point\.npz: No such file"),
    ],
)
def test_a_full_disk_and_a_lost_file_are_faults(bench, tmp_path, write, message):
    program = tmp_path / "program.py"
    program.write_text(
        "import sys\n"
        "import mortarbench.harness.processes.worker as w\n"
        f"def write_point(*_): {write}\n"
        "w.write_point = write_point\n"
        f"sys.path.insert(0, {str(PLUGIN.parent)!r})\n"
        "import accidents\n"
        "worker = w.Worker(solver=accidents.SOLVERS['honest'])\n"
        "w.serve(worker, *map(int, sys.argv[1:]))\n"
    )

    with pytest.raises(FaultError, match=message):
        bench("honest", command=[sys.executable, "-P", str(program)])


@pytest.mark.parametrize("waits", [True, False])
def test_a_worker_killed_while_it_is_idle_costs_nothing(bench, waits):
    bench("honest")
    process = bench.process("honest")
    os.kill(process, signal.SIGKILL)
    assert not waits or soon(lambda: not is_alive(process))

    assert bench("honest").status is Verdict.VERIFIED


#: program that measures a hanging solver repeatedly, and prints the results
RUNS = f"""
import sys
from pathlib import Path
sys.path.insert(0, {str(PLUGIN.parent)!r})
from tests.harness.processes.test_accidents import Bench
bench = Bench(Path(sys.argv[1]))
while True:
    record = bench("hangswithadaemon", time_limit=3600)
    print(record.status, record.message, file=sys.stderr, flush=True)
"""


def test_daemons_do_not_outlive_a_run_that_is_killed(tmp_path, watched):
    parent = subprocess.Popen([sys.executable, "-c", RUNS, str(tmp_path)], cwd=ROOT)
    try:
        # run, parent of the worker, worker, daemon
        assert soon(lambda: len(processes_of(watched)) == 4)
    finally:
        parent.kill()
        parent.wait()

    assert soon(lambda: processes_of(watched) == [])


def test_scratch_folders_of_killed_processes_are_removed_at_the_next_start(
    tmp_path, monkeypatch
):
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    stale = tmp_path / "mortarbench-tmp-1"
    stale.mkdir()
    os.utime(stale, (0, 0))
    with scratch_folder() as used, scratch_folder():
        assert sorted(tmp_path.iterdir()).count(used) == 1
        assert not stale.exists()

    assert list(tmp_path.iterdir()) == []
