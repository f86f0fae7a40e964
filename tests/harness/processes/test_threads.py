"""Concurrent threads, forks, closed streams, and reused process IDs."""

import json
import os
import signal
import subprocess
import sys
from functools import partial
from threading import Event, Thread

import pytest

from mortarbench.harness.processes.locks import ForkSafeLock
from mortarbench.harness.processes.supervisor import WorkerProcess
from tests.harness.processes.test_supervisor import SHOWS
from tests.support.waiting import is_alive, soon

LIMITS = {"time_limit": 30.0, "memory_limit": 2000.0}
COMMAND = [sys.executable, "-c", SHOWS]
CASE = "string/n=10/primal"
#: program that builds, solves and runs in several threads, and prints the results
THREADS = """
import gc, json, os, sys, tempfile
from pathlib import Path
from threading import Thread
import mortarbench as mb
import psutil

threads, times, case, acts = *map(int, sys.argv[1:3]), sys.argv[3], sys.argv[4:]
suite = Path(tempfile.gettempdir()) / "suite.toml"
suite.write_text('''
name = "threads"
repeats = 1
time_limit = 60
solvers = ["smalbe"]
[[problems]]
family = "string"
forms = ["primal"]
params = { n = [10] }
''')
answers, errors = [], []

def solved(number):
    answer = mb.solve(case, "smalbe")
    return [str(answer.verdict), answer.record.objective, list(answer.solution.x)]

def built(number):
    return [mb.build(case).qp.q.size]

def ran(number):
    out = Path(tempfile.gettempdir()) / f"out-{number}"
    return [[str(r.status), r.objective] for r in mb.run(suite, out=out).records]

does = {"solve": solved, "build": built, "run": ran}

def work(number):
    for i in range(times):
        act = acts[(number + i) % len(acts)]
        try:
            answers.append((act, does[act](f"{number}-{i}")))
        except BaseException as e:
            errors.append(f"{act}: {type(e).__name__}: {e}")

def open_files():
    return sorted(os.listdir("/proc/self/fd"))

expected = {act: does[act]("first") for act in acts if act != "run"}
expected["run"] = [expected["solve"][:2]]  # the same case, solver and tolerance
before, stdout = open_files(), sys.stdout
crew = [Thread(target=work, args=(i,)) for i in range(threads)]
for thread in crew:
    thread.start()
for thread in crew:
    thread.join()
gc.collect()
print(json.dumps(dict(
    answers=len(answers), errors=errors,
    other=[a for a in answers if a[1] != expected[a[0]]], expected=expected,
    opened=len(open_files()) - len(before), same_stdout=sys.stdout is stdout,
    left=[p.pid for p in psutil.Process().children()],
    scratch=[p.name for p in Path(tempfile.gettempdir()).glob("mortarbench-*")],
)), file=sys.__stdout__)
"""


def of_threads(tmp_path, threads, times, *acts):
    done = subprocess.run(
        [sys.executable, "-c", THREADS, str(threads), str(times), CASE, *acts],
        env=os.environ | {"TMPDIR": str(tmp_path)}, start_new_session=True,
        stdout=subprocess.PIPE, text=True, timeout=1800, check=True,
    )  # fmt: skip
    return json.loads(done.stdout)


def assert_all_right(found, count):
    assert found["errors"] == []
    assert found["answers"] == count
    assert found["other"] == []
    assert found["expected"]["solve"][0] == "verified"
    assert found["opened"] == 0
    assert found["same_stdout"]
    assert found["left"] == []
    assert found["scratch"] == []


def test_concurrent_builds_solves_and_runs_in_threads_are_correct(tmp_path):
    found = of_threads(tmp_path, 3, 1, "solve", "build", "run")
    assert_all_right(found, 3)


@pytest.fixture
def worker(tmp_path):
    worker = WorkerProcess(COMMAND, tmp_path / "log")
    yield worker
    worker.close()


def test_threads_that_share_or_close_a_worker_receive_one_answer_each(worker):
    answers = []

    def ask():
        answers.append(worker.ask({}, **LIMITS).answer)
        worker.close()

    threads = [Thread(target=ask) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert [answer is not None for answer in answers] == [True] * 4


def test_a_fork_of_a_process_leaves_its_workers_alone(worker):
    pid = worker.ask({}, **LIMITS).answer["pid"]
    if (child := os.fork()) == 0:
        code = 1
        try:
            worker.close()
            own = WorkerProcess(COMMAND, worker._log.with_name("fork"))
            answer = own.ask({}, **LIMITS).answer
            own.close()
            code = 0 if answer["pid"] != pid else 2
        finally:
            os._exit(code)

    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 0
    assert worker.ask({}, **LIMITS).answer["pid"] == pid


def test_a_fork_does_not_wait_for_a_thread_of_its_parent():
    turn, taken, done = ForkSafeLock(), Event(), Event()

    def hold():
        with turn:
            taken.set()
            done.wait()

    thread = Thread(target=hold)
    thread.start()
    taken.wait()
    if (child := os.fork()) == 0:
        signal.alarm(20)
        with turn:
            os._exit(0)
    done.set()
    thread.join()
    assert os.waitpid(child, 0)[1] == 0


def test_closed_standard_streams_do_not_affect_answers(tmp_path):
    closed = "<&- >&- 2>&-"
    solve = f"{sys.executable} -m mortarbench solve {CASE} --solver smalbe {closed}"
    assert subprocess.run(["sh", "-c", solve], env=env(tmp_path)).returncode == 0


def env(tmp_path):
    return os.environ | {"TMPDIR": str(tmp_path)}


@pytest.mark.parametrize(
    ("number", "code"), [(signal.SIGHUP, 129), (signal.SIGINT, 130)]
)
def test_a_terminated_solve_cleans_up_and_prints_one_line(tmp_path, number, code):
    plugin = tmp_path / "hangs.py"
    plugin.write_text(HANGS)
    solve = subprocess.Popen(
        [sys.executable, "-m", "mortarbench", "solve", CASE, "--solver", "hangs",
         "--plugin", str(plugin)],
        env=env(tmp_path) | {"STARTED": str(tmp_path / "started")},
        stderr=subprocess.PIPE, text=True,
        # tests that run in the background of a shell ignore Ctrl-C
        preexec_fn=partial(signal.signal, number, signal.SIG_DFL),
    )  # fmt: skip
    assert soon((tmp_path / "started").exists)
    process = int((tmp_path / "started").read_text())
    solve.send_signal(number)
    solve.send_signal(number)  # the second signal does not interrupt the cleanup
    said = solve.communicate()[1].splitlines()

    assert solve.returncode == code
    # a slow machine also prints the progress
    assert len([line for line in said if ": solving " not in line]) == 1, said
    assert not list(tmp_path.glob("mortarbench-*"))
    assert soon(lambda: not is_alive(process))


HANGS = """
import os, time
from dataclasses import dataclass
from pathlib import Path

@dataclass(frozen=True)
class Hangs:
    def declines(self, qp):
        return None

    def prepare(self, qp, tol):
        if qp.q.size == 32:  # the warm-up
            raise ValueError("it does not warm up")
        started = Path(os.environ["STARTED"])
        started.with_suffix(".new").write_text(str(os.getpid()))
        started.with_suffix(".new").rename(started)
        time.sleep(3600)

SOLVERS = {"hangs": Hangs()}
"""


def test_an_ignored_signal_stays_ignored(tmp_path):
    """Test SIGHUP, which nohup ignores."""
    script = (
        "import os, signal; from mortarbench.harness.processes.termination import *\n"
        "signal.signal(signal.SIGHUP, signal.SIG_IGN)\n"
        "with ended_by_signals():\n"
        "    os.kill(os.getpid(), signal.SIGHUP)\n"
        "    print('goes on', flush=True)\n"
        "    os.kill(os.getpid(), signal.SIGTERM)\n"
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True)
    assert (done.returncode, done.stdout) == (143, b"goes on\n")
