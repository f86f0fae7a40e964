"""Forked workers are isolated and killed like workers started by a command."""

import json
import os
import subprocess
import sys

import pytest

from mortarbench.cli.main import main
from mortarbench.harness.environment.cpus import fastest_first
from mortarbench.harness.limits import ONE_THREAD, VARIABLE
from mortarbench.harness.names import CaseId
from mortarbench.harness.processes.reaper import is_alive
from mortarbench.harness.processes.supervisor import WorkerProcess
from mortarbench.registries import Registries
from tests.support import TOY_PROBLEM
from tests.support.waiting import soon

#: program that sends requests to forked workers, prints the results, and kills
#: itself. It runs in a separate process, since only a process with one thread forks
#: safely
PARENT = '''
import atexit, json, os, signal, subprocess, sys, threading, time
from contextlib import suppress
from math import inf
from pathlib import Path
from mortarbench.harness.processes.forking import is_safe
from mortarbench.harness.processes.protocol import answer_requests
from mortarbench.harness.processes.reaper import descendants
from mortarbench.harness.processes.supervisor import WorkerProcess

folder = Path(sys.argv[1])
COMMAND = [sys.executable, "-S", "-c", """
import json, os, sys
requests, replies = map(int, sys.argv[1:])
def reply(**event):
    os.write(replies, (json.dumps(event) + "\\\\n").encode())
reply(event="ready")
for line in os.fdopen(requests):
    if "warm_up" in line:
        reply(event="warm")
        continue
    reply(event="start")
    reply(event="done", how="command")
"""]
held = open(folder / "held", "w")
atexit.register(lambda: held.write("the parent ends"))


def targets():
    for fd in range(256):
        with suppress(OSError):
            yield fd, os.readlink(f"/proc/self/fd/{fd}")


def answer(request, events):
    events.start()
    if request["do"] == "leave a daemon":
        daemon = subprocess.Popen(["sleep", "60"], env={}, start_new_session=True)
        (folder / "daemon").write_text(str(daemon.pid))
    if request["do"] == "die":
        os.write(2, b"my last words")
        os._exit(7)
    return dict(
        how="fork", process=os.getpid(), open=dict(targets()),
        cpus=sorted(os.sched_getaffinity(0)), environ=dict(os.environ),
        leads=[os.getsid(p) == p for p in (os.getppid(), os.getpid())],
        signals=[signal.getsignal(s).name for s in (signal.SIGCHLD, signal.SIGPIPE)],
    )


def serve(requests, replies):
    answer_requests(answer, lambda: None, requests, replies)


def told(*requests, serve=serve):
    worker = WorkerProcess(COMMAND, folder / "log")
    worker.fork(serve)
    replies = [
        worker.ask({"do": do}, time_limit=20.0, memory_limit=inf) for do in requests
    ]
    if "stay" not in requests:
        worker.close()
    return [[r.verdict, r.message, r.answer] for r in replies]


def raises(requests, replies):
    raise ValueError("not to be had")


def beside_a_thread():
    sleeps = threading.Event()
    thread = threading.Thread(target=sleeps.wait)
    thread.start()
    try:
        return told("tell")
    finally:
        sleeps.set()
        thread.join()
        for _ in range(2000):  # the kernel lists a joined thread for a short time
            if is_safe():
                break
            time.sleep(0.01)


results = dict(
    thread=beside_a_thread(),
    tell=told("tell", "tell"),
    daemon=told("leave a daemon", "tell"),
    die=told("die", "tell"),
    raises=told("tell", serve=raises),
)
results["left"] = descendants(os.getpid())
results["stay"] = told("stay")
print(json.dumps(results), flush=True)
os.kill(os.getpid(), signal.SIGKILL)
'''


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("forks")


@pytest.fixture(scope="module")
def results(folder):
    """Return verdict, message and answer of workers, by their behaviour."""
    done = subprocess.run(
        [sys.executable, "-P", "-c", PARENT, str(folder)],
        env=os.environ | {"SPECIAL": "known"}, stdout=subprocess.PIPE, text=True,
    )  # fmt: skip
    return json.loads(done.stdout)


def test_a_fork_has_the_state_of_a_worker_started_by_a_command(results, folder):
    (_, _, first), (_, _, second) = results["tell"]
    opened = list(first["open"].values())

    assert first["how"] == "fork"
    assert first["process"] == second["process"]
    assert opened[:3] == [os.devnull, str(folder / "log"), str(folder / "log")]
    assert len(opened) == 5
    assert all(target.startswith("pipe:") for target in opened[3:])
    assert first["cpus"] == [fastest_first(os.sched_getaffinity(0))[0]]
    assert first["leads"] == [True, True]  # sub-reaper and worker are session leaders
    assert first["signals"] == ["SIG_DFL", "SIG_IGN"]  # as in a new interpreter
    assert ONE_THREAD.items() <= first["environ"].items()
    assert (first["environ"]["SPECIAL"], first["environ"][VARIABLE]) == ("known", "inf")


def test_a_fork_runs_no_remaining_code_of_its_parent(results, folder):
    assert results["tell"]
    assert (folder / "held").read_text() == ""


def test_a_process_with_a_second_thread_does_not_fork(results):
    assert results["thread"] == [[None, "", {"how": "command"}]]


def test_processes_that_a_fork_starts_end_with_its_measurement(results, folder):
    (verdict, _, first), after = results["daemon"]

    assert (verdict, first["how"]) == (None, "fork")
    assert not is_alive(int((folder / "daemon").read_text()))
    assert results["left"] == []
    assert after == [None, "", {"how": "command"}]


def test_a_fork_that_dies_is_replaced_by_a_worker_that_the_command_starts(results):
    (verdict, message, _), after = results["die"]

    assert (verdict, message) == ("crashed", "exit code 7: my last words")
    assert after == [None, "", {"how": "command"}]
    assert results["raises"] == [after]


def test_a_fork_ends_when_its_parent_is_killed(results):
    ((_, _, answer),) = results["stay"]
    assert soon(lambda: not is_alive(answer["process"]))


def test_the_command_forks_before_it_builds(monkeypatch, capsys):
    events, build = [], CaseId.build

    def fork(worker, serve):
        events.append("fork")

    def built(*arguments):
        events.append("build")
        return build(*arguments)

    monkeypatch.setattr(WorkerProcess, "fork", fork)
    monkeypatch.setattr(CaseId, "build", built)
    code = main(Registries(), ["solve", "string/n=10/primal", "--solver", "smalbe"])

    assert code == 0, capsys.readouterr()
    assert events == ["fork", "build"]


def test_the_command_does_not_fork_once_plug_ins_are_loaded(monkeypatch, capsys):
    forked = []
    monkeypatch.setattr(WorkerProcess, "fork", lambda *_: forked.append(True))
    plugin = ["--plugin", str(TOY_PROBLEM)]
    code = main(Registries(), ["solve", "well/dual", "--solver", "exact", *plugin])

    assert code == 0, capsys.readouterr()
    assert forked == []
