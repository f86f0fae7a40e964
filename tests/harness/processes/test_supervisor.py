import json
import os
import signal
import sys
from pathlib import Path

import pytest

from mortarbench.harness import Verdict
from mortarbench.harness.environment.cpus import fastest_first
from mortarbench.harness.files.mapped import content_digest
from mortarbench.harness.files.qpfile import save_qp
from mortarbench.harness.processes import supervisor
from mortarbench.harness.processes.parent import descendants
from mortarbench.harness.processes.supervisor import (
    LOG_BYTES,
    WorkerProcess,
    out_of_memory,
)
from mortarbench.harness.registry import load_plugin
from tests.support import ADVERSARIES
from tests.support.waiting import is_alive, soon

PLUGIN = ADVERSARIES

#: a worker that reports how it was started instead of measuring
SHOWS = """
import json, os, sys
requests, replies = map(int, sys.argv[1:])
def reply(**event):
    os.write(replies, (json.dumps(event) + "\\n").encode())
reply(event="ready")
for line in os.fdopen(requests):
    if "warm_up" in line:
        reply(event="warm")
        continue
    reply(event="start")
    reply(
        event="done",
        pid=os.getpid(),
        cpus=list(os.sched_getaffinity(0)),
        threads=os.environ["OPENBLAS_NUM_THREADS"],
    )
"""
#: a parent that asks one worker
ASKS = """
import json, sys
from pathlib import Path
from mortarbench.harness.processes.supervisor import WorkerProcess
command, request, log = map(json.loads, sys.argv[1:])
WorkerProcess(command, Path(log)).ask(request, time_limit=60, memory_limit=2000)
"""


def command(solver):
    return [sys.executable, "-P", str(PLUGIN), solver]


def ignores_sigterm(process):
    status = Path(f"/proc/{process}/status").read_text()
    mask = next(line for line in status.splitlines() if line.startswith("SigIgn:"))
    return bool(int(mask.split()[1], 16) & 1 << (signal.SIGTERM - 1))


def request_for(qp, out):
    return {"qp": str(qp), "digest": content_digest(qp), "tol": 1e-6, "out": out}


@pytest.fixture
def ask(tmp_path):
    """Return a function that starts a worker and requests a solve of the tiny QP."""
    tiny = load_plugin(PLUGIN).problems["tiny"]
    qp = tmp_path / "qp.npz"
    save_qp(qp, tiny.build("plain", None).qp, serialised=True)
    request = request_for(qp, out=str(tmp_path / "point.npz"))
    workers = {}

    def ask(solver, *, start=None, time_limit=30.0, memory_limit=2000.0):
        if solver not in workers:
            log = tmp_path / f"{solver}.log"
            workers[solver] = WorkerProcess(start or command(solver), log)
        return workers[solver].ask(
            request, time_limit=time_limit, memory_limit=memory_limit
        )

    yield ask
    for worker in workers.values():
        worker.close()


def test_one_process_serves_every_measurement_on_one_cpu_with_one_thread(
    tmp_path, monkeypatch
):
    monkeypatch.setenv("OPENBLAS_NUM_THREADS", "7")
    worker = WorkerProcess([sys.executable, "-c", SHOWS], tmp_path / "log")
    limits = {"time_limit": 30.0, "memory_limit": 2000.0}
    first, second = (worker.ask({}, **limits).answer for _ in range(2))
    worker.close()

    assert first["pid"] == second["pid"]
    assert first["cpus"] == [fastest_first(os.sched_getaffinity(0))[0]]
    assert first["threads"] == "1"
    assert not is_alive(first["pid"])


def test_a_solver_that_hangs_in_the_warm_up_is_killed_at_the_time_limit(
    ask, monkeypatch
):
    monkeypatch.setattr(supervisor, "WARM_UP_SECONDS", 0.2)

    assert ask("alwayshangs", time_limit=0.2).verdict is Verdict.TIME_LIMIT


def test_output_of_a_solver_is_dropped_before_it_fills_the_disk(ask, tmp_path):
    reply = ask("prints")

    assert reply.answer["claimed"] == "solved"
    assert (tmp_path / "prints.log").stat().st_size <= LOG_BYTES


def test_children_of_a_solver_end_with_its_measurement(ask):
    child = ask("forks").answer["counts"]["child"]

    assert soon(lambda: not is_alive(child))
    assert ask("forks").answer["claimed"] == "solved"


def test_a_fork_that_returns_from_a_solver_does_not_answer(ask):
    answers = [ask("returnstwice").answer for _ in range(2)]

    assert [a["counts"]["above"] for a in answers] == [os.getpid()] * 2


def test_a_qp_that_a_solver_changed_is_intact_in_the_next_measurement(ask, tmp_path):
    answers = []
    for _ in range(2):
        ask("mutatesbyforce")
        answers.append((tmp_path / "point.npz").read_bytes())

    assert answers[0] == answers[1]


def test_a_worker_that_cannot_start_states_the_reason(ask):
    start = [sys.executable, "-c", "raise SystemExit('no such plug-in')"]
    reply = ask("absent", start=start)

    assert reply.verdict is Verdict.CRASHED
    assert reply.message == "before solving: exit code 1: no such plug-in"


def test_a_worker_dies_with_its_parent_in_the_middle_of_a_solve(tmp_path):
    tiny = load_plugin(PLUGIN).problems["tiny"]
    save_qp(tmp_path / "qp.npz", tiny.build("plain", None).qp, serialised=True)
    request = request_for(tmp_path / "qp.npz", out="unused")
    arguments = [command("hangs"), request, str(tmp_path / "log")]
    parent = os.spawnv(
        os.P_NOWAIT,
        sys.executable,
        [sys.executable, "-P", "-c", ASKS, *map(json.dumps, arguments)],
    )
    assert soon(
        lambda: len(descendants(parent)) == 2
    )  # the worker's parent and the worker
    worker = descendants(parent)[1]
    assert soon(lambda: ignores_sigterm(worker))
    os.kill(parent, signal.SIGKILL)
    os.waitpid(parent, 0)

    assert soon(lambda: not is_alive(worker))


@pytest.mark.parametrize(
    ("message", "peak", "expected"),
    [
        ("SIGSEGV", 95.0, True),
        ("SIGSEGV", 50.0, False),
        ("SIGSEGV", None, False),
        ("MemoryError: Unable to allocate 8.00 TiB for an array", 1.0, True),
        ("SIGABRT: terminate called: std::bad_alloc", 1.0, True),
        ("SIGABRT: memory allocation of 64 bytes failed", 1.0, True),
        ("ScsWork allocation error", 1.0, True),
        ("numerical difficulties", 1.0, False),
        ("step size could not be allocated a sign", 1.0, False),
    ],
)
def test_lack_of_memory_is_recognised_by_the_peak_and_by_the_message(
    message, peak, expected
):
    assert out_of_memory(message, peak, 100.0) is expected
