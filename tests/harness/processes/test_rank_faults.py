"""Measurements in which one rank fails, for each stage of a measurement."""

import os
import subprocess
import sys
from contextlib import suppress
from itertools import product
from pathlib import Path

import pytest

import mortarbench as mb
from mortarbench.harness.processes import supervisor
from tests.support import ROOT, SUPPORT
from tests.support.waiting import soon

pytestmark = pytest.mark.together

CASE = "beam-ring/Nr=2/Nh=1/steps=1/feti=2/dual"
MEASURING = ("build", "prepare", "product")
EVALUATING = ("certificate", "quantities")
#: time limit of each stage in s, sufficient for the stages before the planted failure
LIMIT = 20
KILLED = "rank 1 of 2 ranks ended: Killed"
RAISED = "rank 1 of 2: ValueError: planted"


@pytest.fixture
def measured(tmp_path, monkeypatch):
    """Solve once with a failing rank; assert that no process remains."""

    def run(stage, kind, rank="1", limit=LIMIT):
        monkeypatch.setenv("FAULT", str(tmp_path))
        monkeypatch.setenv("FAULT_STAGE", stage)
        monkeypatch.setenv("FAULT_KIND", kind)
        monkeypatch.setenv("FAULT_RANK", rank)
        paths = [str(SUPPORT / "faulty_ranks"), os.environ.get("PYTHONPATH", "")]
        monkeypatch.setenv("PYTHONPATH", os.pathsep.join(filter(None, paths)))
        monkeypatch.setattr(supervisor, "POINT_SECONDS", limit)
        record = mb.solve(CASE, "smalbe", tol=1e-6, ranks=2, time_limit=limit).record
        assert soon(lambda: not processes_of(tmp_path))
        assert "\n" not in record.message
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


def test_a_case_that_one_rank_cannot_build_fails_with_the_reason(measured):
    record = measured("build", "raises-after")

    assert record.status == "failed"
    assert RAISED in record.message


def test_an_exception_in_a_product_of_one_rank_reaches_the_solver(measured):
    """Rank 0 has computed the product, but no sum of it."""
    record = measured("product", "raises-after")

    assert (record.status, record.claimed) == ("failed", "failed")
    assert RAISED in record.message


def test_a_rank_that_cannot_certify_is_named_and_the_verdict_is_kept(measured):
    record = measured("certificate", "raises-after")

    assert record.status == "verified"
    assert f"no energy_bound: RankFailedError: {RAISED}" in record.message
    assert record.energy_bound is None
    assert record.quantities["dofs"] > 0


@pytest.mark.slow
@pytest.mark.parametrize("stage", MEASURING + EVALUATING)
def test_a_killed_rank_ends_the_measurement_with_a_line_that_names_it(measured, stage):
    record = measured(stage, "killed")

    assert record.status == "crashed"
    assert KILLED in record.message
    assert names_stage(record.message, stage)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("stage", "rank"), [*zip(MEASURING + EVALUATING, "01010", strict=True)]
)
def test_a_rank_that_exits_with_0_before_the_others_is_named(measured, stage, rank):
    record = measured(stage, "exits", rank=rank)

    assert record.status == "crashed"
    assert f"rank {rank} of 2 ranks ended: exit code 0" in record.message
    assert names_stage(record.message, stage)


def test_output_of_a_rank_is_not_mistaken_for_the_reason(measured):
    record = measured("product", "prints")

    assert record.status == "crashed"
    assert record.message.endswith(f"{KILLED} (signal 9)")


@pytest.mark.slow
@pytest.mark.parametrize("stage", MEASURING + EVALUATING)
def test_a_hanging_rank_is_killed_in_every_stage(measured, stage):
    record = measured(stage, "hangs")

    assert record.status == "time_limit"
    assert f"killed after {LIMIT} s" in record.message
    assert names_stage(record.message, stage)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("stage", "rank"), list(product(("build", "product"), ["0", "1"]))
)
def test_a_rank_that_fails_while_others_wait_for_it_is_named(measured, stage, rank):
    """The others wait in a sum, so that the failed rank ends the processes."""
    record = measured(stage, "raises", rank=rank)

    assert record.status in ("failed", "crashed")
    assert f"rank {rank} of 2: ValueError: planted" in record.message


@pytest.mark.slow
@pytest.mark.parametrize("stage", MEASURING)
def test_an_exception_on_all_ranks_is_the_message_of_the_solver(measured, stage):
    record = measured(stage, "raises", rank="all")

    assert record.status == "failed"
    assert "ValueError: planted" in record.message


@pytest.mark.slow
@pytest.mark.parametrize("rank", ["1", "all"])
@pytest.mark.parametrize("stage", EVALUATING)
def test_a_failing_evaluation_does_not_affect_the_verdict(measured, stage, rank):
    record = measured(stage, "raises-after", rank=rank)

    assert record.status == "verified"
    assert "ValueError: planted" in record.message
    assert (record.energy_bound is None) == (stage == "certificate")
    assert (not record.quantities) == (stage == "quantities")


SUITE = """
name = "ranks"
tolerances = [1e-6]
repeats = {repeats}
time_limit = 60
memory_limit = {limit}
solvers = ["smalbe"]
ranks = [2]
[[problems]]
family = "beam-ring"
forms = ["dual"]
params = {{ Nr = 4, Nh = 3, steps = 1, feti = 4 }}
"""


def test_the_memory_limit_is_for_the_sum_over_all_ranks(tmp_path):
    """The limit is above the memory of a single process."""
    suite = tmp_path / "ranks.toml"
    text = SUITE.format(repeats=1, limit=110)
    suite.write_text(text.replace("[2]", "[1, 2]"))
    found = {r.ranks: r for r in mb.run(suite, out=tmp_path / "out").records}
    assert found[1].status == "verified"
    assert found[2].status == "memory_limit"
    assert "above the limit of 110 MiB" in found[2].message


@pytest.mark.slow
def test_a_run_that_is_killed_while_ranks_measure_is_continued(tmp_path):
    suite, out = tmp_path / "ranks.toml", tmp_path / "out"
    suite.write_text(SUITE.format(repeats=3, limit=4096))
    run = subprocess.Popen(
        [sys.executable, "-m", "mortarbench", "run", suite, "--out", out],
        cwd=ROOT, env=os.environ | {"FAULT": str(tmp_path)},
        stderr=subprocess.DEVNULL, stdout=subprocess.DEVNULL,
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
    assert {r.status for r in results.records} == {"verified"}
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
    if stage == "build":
        return message.startswith("build: ")
    return message.startswith("evaluation of the answer: ") == (stage in EVALUATING)
