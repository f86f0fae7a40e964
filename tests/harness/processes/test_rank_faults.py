"""Measurements in which one rank fails, for each stage of a measurement."""

import json
import os
import select
import subprocess
import sys
from contextlib import suppress
from itertools import product
from pathlib import Path

import pytest

import mortarbench as mb
from mortarbench.harness.distributed import failures
from mortarbench.harness.processes import supervisor
from tests.support import ROOT, SUPPORT
from tests.support.waiting import soon

pytestmark = pytest.mark.together

SUITE = """
name = "ranks"
tolerances = [1e-6]
repeats = 1
time_limit = {limit}
memory_limit = 4096
solvers = ["smalbe"]
ranks = [2]
[[problems]]
family = "beam-ring"
forms = ["dual"]
params = {{ Nr = 4, Nh = 3, steps = 1, feti = 4 }}
"""
MEASURING = ("emission", "prepare", "solve")
EVALUATING = ("residuals", "certificate", "quantities")
#: time limit of each stage in s, sufficient for the stages before the planted failure
LIMIT = 20
KILLED = "rank 1 of 2 ranks ended: Killed"
RAISED = "rank 1 of 2: ValueError: planted"


@pytest.fixture
def measured(tmp_path, monkeypatch):
    """Measure once with a failing rank; assert that no process remains."""

    def run(stage, kind, rank="1", limit=LIMIT):
        monkeypatch.setenv("FAULT", str(tmp_path))
        monkeypatch.setenv("FAULT_STAGE", stage)
        monkeypatch.setenv("FAULT_KIND", kind)
        monkeypatch.setenv("FAULT_RANK", rank)
        paths = [str(SUPPORT / "faulty_ranks"), os.environ.get("PYTHONPATH", "")]
        monkeypatch.setenv("PYTHONPATH", os.pathsep.join(filter(None, paths)))
        monkeypatch.setattr(supervisor, "POINT_SECONDS", limit)
        suite = tmp_path / "ranks.toml"
        suite.write_text(SUITE.format(limit=limit))
        results = mb.run(suite, out=tmp_path / "out")
        assert soon(lambda: not processes_of(tmp_path))
        (record,) = results.records
        assert mb.load(tmp_path / "out").records == results.records
        return record

    return run


def processes_of(mark):
    """List the IDs of other processes whose environment has the mark of a test."""
    found = []
    for entry in Path("/proc").glob("[0-9]*"):
        try:
            environment = (entry / "environ").read_bytes().split(b"\0")
        except OSError:
            continue
        if f"FAULT={mark}".encode() in environment and int(entry.name) != os.getpid():
            found.append(int(entry.name))
    return found


def test_records_of_ranks_do_not_mix(monkeypatch):
    """Each record is one line, written atomically with at most PIPE_BUF bytes."""
    written = []
    monkeypatch.setattr(os, "write", lambda fd, data: written.append((fd, data)))
    monkeypatch.setenv(failures.RECORD, "7")
    failures.record(1, "ValueError: \n" + "δ" * 10_000)

    ((fd, line),) = written
    assert fd == 7
    assert line.count(b"\n") == 1
    assert line.endswith(b"\n")
    assert len(line) < select.PIPE_BUF
    assert json.loads(line)["rank"] == 1


def test_a_rank_that_hangs_while_it_emits_is_ended_at_the_time_limit(measured):
    record = measured("emission", "hangs", limit=2)

    assert record.verdict == "time_limit"
    assert record.message == "emission: killed after 2 s"


def test_a_rank_that_cannot_certify_is_named_and_no_rank_certifies(measured):
    record = measured("certificate", "raises-after")

    assert record.verdict == "verified"
    assert f"no energy_bound: RankFailedError: {RAISED}" in record.message
    assert record.energy_bound is None
    assert record.quantities["dofs"] == 848


@pytest.mark.slow
@pytest.mark.parametrize("stage", MEASURING + EVALUATING)
def test_a_killed_rank_ends_the_measurement_with_a_line_that_names_it(measured, stage):
    record = measured(stage, "killed")

    assert record.verdict == "crashed"
    assert KILLED in record.message
    assert names_stage(record.message, stage)


@pytest.mark.slow
@pytest.mark.parametrize("stage", MEASURING + EVALUATING)
@pytest.mark.parametrize("rank", ["0", "1"])
def test_a_rank_that_exits_with_0_before_the_others_is_named(measured, stage, rank):
    record = measured(stage, "exits", rank=rank)

    assert record.verdict == "crashed"
    assert f"rank {rank} of 2 ranks ended: exit code 0" in record.message
    assert names_stage(record.message, stage)


@pytest.mark.slow  # `test_first_rank.py` tests interleaved output without a solve
@pytest.mark.parametrize("stage", ["solve"])
def test_output_of_a_rank_is_not_mistaken_for_the_reason(measured, stage):
    record = measured(stage, "prints")

    assert record.verdict == "crashed"
    assert record.message.endswith(f"{KILLED} (signal 9)")


@pytest.mark.slow
@pytest.mark.parametrize("stage", MEASURING + EVALUATING)
def test_a_hanging_rank_is_killed_in_every_stage(measured, stage):
    record = measured(stage, "hangs")

    assert record.verdict == "time_limit"
    assert f"killed after {LIMIT} s" in record.message
    assert names_stage(record.message, stage)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("stage", "rank"), list(product(MEASURING + EVALUATING, ["0", "1"]))
)
def test_an_exception_on_one_rank_does_not_leave_others_waiting(measured, stage, rank):
    record = measured(stage, "raises", rank=rank)

    if rank == "0" and stage in ("prepare", "solve"):  # the solver on rank 0
        assert (record.verdict, record.claimed) == ("failed", "failed")
        assert "ValueError: planted" in record.message
    else:
        assert record.verdict == "crashed"
        assert f"rank {rank} of 2: ValueError: planted" in record.message
        assert names_stage(record.message, stage)


@pytest.mark.slow
@pytest.mark.parametrize("rank", ["1", "all"])
def test_a_case_that_ranks_cannot_emit_fails_with_the_reason(measured, rank):
    record = measured("emission", "raises-after", rank=rank)

    assert record.verdict == "failed"
    said = RAISED if rank == "1" else "ValueError: planted"
    assert f"emission: {said}" in record.message


@pytest.mark.slow
@pytest.mark.parametrize("rank", ["1", "all"])
def test_an_answer_that_ranks_cannot_verify_is_verified_by_one_process(measured, rank):
    record = measured("residuals", "raises-after", rank=rank)

    assert record.verdict == "verified"
    assert "no evaluation by ranks" in record.message
    assert record.energy_bound < 1e-5
    assert record.quantities["dofs"] == 848


@pytest.mark.slow
def test_failing_quantities_affect_neither_verdict_nor_bound(measured):
    record = measured("quantities", "raises-after", rank="all")

    assert record.verdict == "verified"
    assert "no quantities: ValueError: planted" in record.message
    assert record.energy_bound < 1e-5


@pytest.mark.slow
def test_a_run_that_is_killed_while_ranks_measure_is_continued(tmp_path):
    suite, out = tmp_path / "ranks.toml", tmp_path / "out"
    text = SUITE.format(limit=60).replace("repeats = 1", "repeats = 3")
    suite.write_text(text)
    command = [
        sys.executable,
        "-m",
        "mortarbench",
        "run",
        str(suite),
        "--out",
        str(out),
    ]
    environment = os.environ | {"FAULT": str(tmp_path)}
    run = subprocess.Popen(
        command, cwd=ROOT, env=environment, stderr=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
    )  # fmt: skip
    assert soon(lambda: journal_lines(out))
    assert soon(lambda: any(is_rank(pid) for pid in processes_of(tmp_path)))
    run.kill()
    run.wait()
    assert soon(lambda: not processes_of(tmp_path))
    before = journal_lines(out)

    results = mb.run(suite, out=out)

    assert journal_lines(out)[: len(before)] == before
    assert sorted(r.repeat for r in results.records) == [0, 1, 2]
    assert {r.verdict for r in results.records} == {"verified"}
    assert len({r.qp for r in results.records}) == 1


def journal_lines(folder):
    """Return the lines of the journal in a result folder."""
    files = sorted((folder / "journal").glob("*.jsonl"))
    return [line for file in files for line in file.read_text().splitlines()]


def is_rank(process):
    with suppress(OSError):
        environment = (Path("/proc") / str(process) / "environ").read_bytes()
        return b"PMI_RANK=" in environment
    return False


def names_stage(message, stage):
    """Return True if a message has the prefix of its stage; some stages have none."""
    if stage == "emission":
        return message.startswith("emission: ")
    return message.startswith("evaluation of the answer: ") == (stage in EVALUATING)
