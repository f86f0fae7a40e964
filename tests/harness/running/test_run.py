"""Complete runs: misbehaving solvers, interruption, resumption, shared folders."""

import errno
import os
import shutil
import subprocess
import sys

import pytest

from mortarbench.harness import InputError, Status, Verdict
from mortarbench.harness.environment.cpus import fastest_first
from mortarbench.harness.errors import FaultError
from mortarbench.harness.files.store import load_fields, load_solution
from mortarbench.harness.names import assemble
from mortarbench.harness.processes import measurement as remote
from mortarbench.harness.registry import load_plugin, resolve
from mortarbench.harness.results.journal import read_journal
from mortarbench.harness.results.work_unit import Commands
from mortarbench.harness.running.run import run
from tests.support import ADVERSARIES
from tests.support.suites import suite_of

PLUGIN = ADVERSARIES
START = [sys.executable, "-P", str(PLUGIN)]
SOLVERS = load_plugin(PLUGIN).solvers
FAMILIES = load_plugin(PLUGIN).problems


class Watcher:
    """Progress callbacks that store records, and may act after a number of records."""

    def __init__(self, interrupt_after=None, after=None, act=None):
        self.total = None
        self.records = []
        self.warnings = []
        self.skipped = 0
        self.unbuilt = None
        self._left = interrupt_after
        self._after, self._act = after, act

    def start(self, total):
        self.total = total

    def say(self, text):
        pass

    def warn(self, text):
        self.warnings.append(text)

    def advance(self, record):
        if record is None:
            self.skipped += 1
            return
        self.records.append(record)
        if len(self.records) == self._after:
            self._act()
        if self._left is not None and len(self.records) == self._left:
            raise KeyboardInterrupt


def suite(*solvers, cases=({},), **changes):
    cold = [assemble("tiny", FAMILIES["tiny"], case, "plain") for case in cases]
    return suite_of(*solvers, cases=cold, **{"time_limit": 30.0} | changes)


@pytest.fixture
def measure(tmp_path):
    """Return a function that runs a suite and returns the watcher of its progress."""

    def measure(
        suite,
        *,
        interrupt_after=None,
        after=None,
        act=None,
        digest="here",
        fresh=False,
        out=tmp_path,
        environment=None,
    ):
        watched = Watcher(interrupt_after, after, act)
        missing = run(
            suite,
            out=out,
            commands=Commands(
                solvers={spec.label: [*START, spec.name] for spec in suite.solvers},
                case_worker=[*START, "generator"],
            ),
            resolve=lambda spec: resolve(spec, SOLVERS),
            environment=environment or {"machine": "test"},
            digest=digest,
            progress=watched,
            fresh=fresh,
        )
        watched.unbuilt, watched.faults = missing.unbuilt, missing.faults
        return watched

    return measure


OUTCOMES = {
    "honest": (Verdict.VERIFIED, "solved", ""),
    "raises": (
        Verdict.FAILED,
        "failed",
        "ValueError: first line second line (adversaries.py:109)",
    ),
    "dies": (Verdict.CRASHED, None, "exit code 7: my last words"),
    "segfaults": (Verdict.CRASHED, None, "SIGSEGV"),
    "hangs": (Verdict.TIME_LIMIT, None, "killed after 3 s"),
    "prints": (Verdict.VERIFIED, "solved", ""),
    "leaks": (Verdict.MEMORY_LIMIT, None, None),
    "printsendlessly": (Verdict.TIME_LIMIT, None, None),
    "asksforthemoon": (Verdict.MEMORY_LIMIT, "failed", None),
    "abortsformemory": (
        Verdict.MEMORY_LIMIT, None, "SIGABRT: memory allocation of 64 bytes failed",
    ),
    "spikesunseen": (Verdict.MEMORY_LIMIT, ..., None),
    "forksahoarder": (Verdict.MEMORY_LIMIT, None, None),
    "wrongsign": (
        Verdict.WRONG, "solved", "with −z all residuals vanish: check the sign of z",
    ),
    "forks": (Verdict.VERIFIED, "solved", ""),
    "returnsnan": (Verdict.WRONG, "solved", "x contains NaN"),
    "zero": (Verdict.WRONG, "solved", None),
    # the timed solves are those of another QP, and the last one is judged
    "mutatesbyforce": (Verdict.FAILED, "failed", ""),
    "declines": (Verdict.DECLINED, "declined", "never on a Monday"),
}  # fmt: skip


#: solvers that take seconds to exhaust a limit; only the slow test includes them
EXHAUSTING = {"printsendlessly", "forksahoarder"}


@pytest.mark.parametrize(
    "solvers",
    [
        OUTCOMES.keys() - EXHAUSTING,
        pytest.param(OUTCOMES.keys(), marks=pytest.mark.slow),
    ],
    ids=["few", "all"],
)
def test_every_misbehaviour_is_one_record_and_the_next_measurement_is_valid(
    measure, tmp_path, solvers
):
    cases = [{"h": 0.5}, {"h": 1.0}]
    chosen = [solver for solver in OUTCOMES if solver in solvers]
    measure(suite(*chosen, cases=cases, time_limit=3.0, memory_limit=300.0))
    records = read_journal(tmp_path)

    assert len(records) == 2 * len(chosen)
    for case in ("tiny/h=0.5/plain", "tiny/plain"):
        got = {r.solver: r for r in records if r.case == case}
        for solver in chosen:
            status, claimed, message = OUTCOMES[solver]
            assert got[solver].status == status, (solver, case)
            assert claimed in (..., got[solver].claimed), (solver, case)
            assert message in (None, got[solver].message)


def test_a_verified_record_contains_costs_and_quantities(measure, tmp_path):
    measure(suite("honest", cases=[{"h": 0.5}]))
    (r,) = read_journal(tmp_path)

    assert r.objective == 0.25 - 2.0
    assert r.quantities == {"first": 0.5, "all": [0.5, 0.0], "number": 2}
    assert r.sizes == {"variables": 2, "equalities": 0, "inequalities": 1, "bounds": 2}
    assert r.params == {"h": 0.5, "fault": "none"}
    assert r.options == {"level": 3}
    assert max(r.primal, r.dual, r.complementarity, r.gap) == 0
    assert r.peak_mib > 10
    assert r.environment == "here"
    assert load_solution(tmp_path, r.vectors, Status.SOLVED).x.tolist() == [0.5, 0.0]
    assert load_fields(tmp_path, r.fields).displacement[2].tolist() == [0.5, 0.5]


def test_a_record_contains_times_of_phases_threads_and_cpu(measure, tmp_path):
    measure(suite("honest", "sleeps"))
    records = read_journal(tmp_path)

    slow, quick = sorted(records, key=lambda r: r.solver == "honest")
    cpu = fastest_first(os.sched_getaffinity(0))[0]
    assert (slow.inner, slow.threads, slow.cpu) == (1, 1, cpu)
    assert slow.solve_seconds >= 0.02
    assert quick.total_seconds == pytest.approx(
        quick.prepare_seconds + quick.solve_seconds
    )
    # the timed solves take 5 ms together, unless their number is limited
    assert quick.inner == 500 or quick.inner * quick.total_seconds >= 0.00499
    assert min(quick.build_seconds, quick.recover_seconds) > 0
    assert quick.dualise_seconds is None
    assert quick.peak_mib > 10


def three_steps(*solvers, cases=(), **changes):
    names = [
        assemble("tiny", FAMILIES["tiny"], {"h": h}, "plain") for h in (0.5, 1.0, 1.5)
    ]
    return suite(*solvers, cases=cases, sequences=(tuple(names),), **changes)


def test_one_solver_drives_all_steps_of_a_sequence(measure, tmp_path):
    watched = measure(three_steps("chains", "honest", repeats=2))
    records = read_journal(tmp_path)

    assert watched.total == len(records) == 12
    assert {r.mode for r in records} == {"sequence"}
    assert {r.status for r in records} == {Verdict.VERIFIED}
    for repeat in (0, 1):
        chain = [r for r in records if (r.solver, r.repeat) == ("chains", repeat)]
        assert [(r.params["h"], r.iterations) for r in chain] == [
            (0.5, 1), (1.0, 2), (1.5, 3),
        ]  # fmt: skip
    assert {r.iterations for r in records if r.solver == "honest"} == {1}


def test_steps_listed_both_ways_are_solved_once_each_cold_and_warm(measure, tmp_path):
    cold = [{"h": h} for h in (0.5, 1.0, 1.5)]
    measure(three_steps("chains", "honest", cases=cold, repeats=2))
    records = read_journal(tmp_path)

    assert len(records) == 2 * 2 * 2 * 3
    assert {r.untimed for r in records} == {0}
    for mode, expected in (("cold", [1, 1, 1]), ("sequence", [1, 2, 3])):
        chain = [
            r for r in records if (r.mode, r.solver, r.repeat) == (mode, "chains", 1)
        ]
        assert [r.params["h"] for r in chain] == [0.5, 1.0, 1.5]
        assert [r.iterations for r in chain] == expected
        assert len({r.block for r in chain}) == 1
    modes = {r.block: r.mode for r in records}  # both ways follow each other
    assert [modes[k] for k in sorted(modes)] == ["cold", "sequence"] * 2


def test_a_sequence_with_too_many_steps_ends_at_the_last_problem(measure, tmp_path):
    cases = ({"h": 0.5}, {"h": 1.0}, {"fault": "end"}, {"fault": "end", "h": 0.5})
    names = tuple(assemble("tiny", FAMILIES["tiny"], case, "plain") for case in cases)
    asked = suite("chains", "honest", cases=(), sequences=(names,))
    measure(asked)
    records = read_journal(tmp_path)

    for solver in ("chains", "honest"):
        steps = [r for r in records if r.solver == solver]
        assert [str(r.status) for r in steps] == 2 * ["verified"] + 2 * ["declined"]
        assert "there is no further problem" in steps[2].message
    measure(asked)
    assert len(read_journal(tmp_path)) == 8  # no measurement is missing


def test_an_interrupted_sequence_is_repeated_from_its_first_step(measure, tmp_path):
    with pytest.raises(KeyboardInterrupt):
        measure(three_steps("chains"), interrupt_after=2)
    measure(three_steps("chains"))

    records = read_journal(tmp_path)
    assert [r.iterations for r in records] == [1, 2, 3]
    assert len({r.run_id for r in records}) == 3


def test_repeats_are_cold_and_the_state_is_stored_for_the_first_only(measure, tmp_path):
    measure(suite("warm", repeats=3))
    records = read_journal(tmp_path)

    assert [r.iterations for r in records] == [9, 9, 9]
    assert [r.repeat for r in records] == [0, 1, 2]
    assert len({r.vectors for r in records}) == 1
    assert [r.fields is None for r in records] == [False, True, True]


def test_an_interrupted_run_leaves_a_whole_journal_and_continues(measure, tmp_path):
    whole = suite("honest", "zero", repeats=3)
    with pytest.raises(KeyboardInterrupt):
        measure(whole, interrupt_after=2)
    assert len(read_journal(tmp_path)) == 2

    assert len(measure(whole).records) == 4
    assert len({r.run_id for r in read_journal(tmp_path)}) == 6


@pytest.mark.parametrize(
    ("fault", "reason"),
    [
        ("build", "ZeroDivisionError: no stiffness"),
        ("input", "tiny: fault=input is out of range"),
        ("memory", "it needs more memory than is available"),
        ("exit", "SystemExit: 3"),
    ],
)
def test_a_case_that_cannot_be_built_is_reported_and_retried(
    measure, tmp_path, fault, reason
):
    whole = suite("honest", "zero", cases=[{"fault": fault}, {}], repeats=2)
    first, second = measure(whole), measure(whole)
    case = f"tiny/fault={fault}/plain"

    assert {r.case for r in read_journal(tmp_path)} == {"tiny/plain"}
    assert (len(first.records), len(second.records)) == (4, 0)
    for watched in (first, second):
        assert watched.unbuilt == [case]
        assert watched.warnings == [f"{case} could not be built: {reason}"]
        assert len(watched.records) + watched.skipped == watched.total


def test_another_suite_or_environment_is_refused_unless_fresh(measure, tmp_path):
    measure(suite("honest"))
    (tmp_path / "notes.txt").write_text("mine")
    (tmp_path / "validation.json").write_text("{}")  # a result of `validate`
    (tmp_path / "report").mkdir()

    other = suite("zero", name="other")
    with pytest.raises(InputError, match=r"'test' in .*, 'other' in .* --fresh"):
        measure(other)
    with pytest.raises(InputError, match=r"another environment \(here, now there\)"):
        measure(suite("honest"), digest="there")
    assert [r.solver for r in read_journal(tmp_path)] == ["honest"]

    measure(other, digest="there", fresh=True)
    assert [r.solver for r in read_journal(tmp_path)] == ["zero"]
    assert (tmp_path / "notes.txt").read_text() == "mine"
    assert not (tmp_path / "validation.json").exists()
    assert not (tmp_path / "report").exists()


@pytest.mark.parametrize("fresh", [False, True])
@pytest.mark.parametrize(
    "name", ["journal/a.txt", "vectors/a.npz", "report/a.html", "suite.toml"]
)
def test_a_folder_with_other_files_under_reserved_names_is_unchanged(
    measure, tmp_path, name, fresh
):
    mine = tmp_path / "home" / name
    mine.parent.mkdir(parents=True)
    mine.write_text("mine")

    with pytest.raises(InputError, match="but is not a result folder"):
        measure(suite("honest"), out=tmp_path / "home", fresh=fresh)

    files = [p for p in (tmp_path / "home").rglob("*") if p.is_file()]
    assert files == [mine]
    assert mine.read_text() == "mine"


def test_a_second_run_on_a_folder_is_refused_while_the_first_is_running(
    measure, tmp_path
):
    hold = (
        "import sys; from pathlib import Path\n"
        "from mortarbench.harness.results.folder import lock_folder\n"
        "with lock_folder(Path(sys.argv[1])):\n"
        "    print('held', flush=True); sys.stdin.read()"
    )
    with subprocess.Popen(
        [sys.executable, "-P", "-c", hold, str(tmp_path)],
        stdin=subprocess.PIPE, stdout=subprocess.PIPE,
    ) as first:  # fmt: skip
        assert first.stdout.readline() == b"held\n"
        with pytest.raises(InputError, match="is being written by another run"):
            measure(suite("honest"), fresh=True)
        first.stdin.close()
        first.wait()

    assert len(measure(suite("honest")).records) == 1


def once_each(folder, count):
    """Return the records of a journal; assert that no measurement occurs twice."""
    records = read_journal(folder)
    assert len({r.run_id for r in records}) == len(records) == count
    return records


@pytest.mark.parametrize("lost", [".scratch", ".mortarbench.lock", "vectors"])
def test_files_deleted_during_a_run_lose_no_measurement(measure, tmp_path, lost):
    def delete():
        path = tmp_path / lost
        path.unlink() if path.is_file() else shutil.rmtree(path)

    watched = measure(suite("honest", "zero", repeats=2), after=1, act=delete)

    records = once_each(tmp_path, 4)
    assert (len(watched.records), watched.skipped, watched.total) == (4, 0, 4)
    assert {r.solver: r.status for r in records} == {
        "honest": Verdict.VERIFIED, "zero": Verdict.WRONG,
    }  # fmt: skip
    assert watched.faults == []
    assert load_solution(tmp_path, records[-1].vectors, Status.SOLVED).x.size == 2


@pytest.mark.parametrize("lost", ["journal", ""])
@pytest.mark.parametrize("moved", [True, False])
def test_a_run_ends_if_its_journal_is_moved_or_deleted(measure, tmp_path, lost, moved):
    out, there = tmp_path / "out", tmp_path / "there"
    path = out / lost

    def lose():
        path.rename(there) if moved else shutil.rmtree(path)

    with pytest.raises(InputError, match="was moved, deleted or changed"):
        measure(suite("honest", "zero"), out=out, after=1, act=lose)
    if moved:
        shutil.rmtree(path, ignore_errors=True)
        there.rename(path)
    measure(suite("honest", "zero"), out=out)

    once_each(out, 2)


def test_on_any_full_disk_a_run_ends_in_one_line_and_can_continue(
    measure, tmp_path, monkeypatch
):
    whole = suite("honest", "zero")
    real, said = os.fsync, set()
    for writes in range(100):
        left = [writes]

        def fsync(fd, left=left):
            left[0] -= 1
            if left[0] < 0:
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
            real(fd)

        monkeypatch.setattr(os, "fsync", fsync)
        try:
            measure(whole)
            break
        except InputError as e:
            said.add(str(e).partition("; ")[2])
        assert not [*tmp_path.rglob("*.tmp")]

    assert said == {"free some space; the same command continues the run"}
    records = once_each(tmp_path, 2)
    assert {r.status for r in records} == {Verdict.VERIFIED, Verdict.WRONG}
    assert writes > 6  # suite and environment need four writes


@pytest.fixture
def faults(monkeypatch):
    """Cause a fault in measurements for which `prevented` returns True."""

    def faults(prevented):
        def measured(worker, qp, record, **request):
            if prevented(record):
                raise FaultError("the worker was killed before its solve")
            return remote.measure_and_judge(worker, qp, record, **request)

        monkeypatch.setattr(
            "mortarbench.harness.running.executor.measure_and_judge", measured
        )

    return faults


def test_after_a_fault_a_sequence_is_repeated_from_its_first_step(
    measure, tmp_path, faults
):
    tries = []
    faults(lambda r: tries.append(r.params["h"]) or tries == [0.5, 1.0])
    watched = measure(three_steps("chains"))

    assert tries == [0.5, 1.0, 0.5, 1.0, 1.5]
    assert [r.iterations for r in once_each(tmp_path, 3)] == [1, 2, 3]
    assert (len(watched.records), watched.skipped) == (3, 0)
