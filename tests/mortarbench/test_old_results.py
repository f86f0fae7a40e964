"""A result folder of November 2026 reads as it did; schema 2, journal and vectors."""

import shutil

import pytest

from mortarbench.cli.main import main
from mortarbench.harness import Verdict
from mortarbench.harness.results.journal import read_journal
from mortarbench.registries import Registries
from tests.support import ROOT

FOLDER = ROOT / "tests/data/results-2026-11"


@pytest.fixture
def old(tmp_path):
    return shutil.copytree(FOLDER, tmp_path / "old")


def command(*argv):
    return main(Registries(), list(map(str, argv)))


def test_its_records_are_those_that_were_written(old):
    records = read_journal(old)

    verdicts = [r.verdict for r in records if r.solver == "smalbe"]
    assert verdicts.count(Verdict.VERIFIED) == 4  # two repeats of two dual forms
    assert verdicts.count(Verdict.DECLINED) == 1  # the primal has inequality rows
    assert {r.solver for r in records} == {"smalbe", "osqp", "clarabel", "proxqp"}


@pytest.mark.usefixtures("only_svg")
def test_it_is_reported_on(old, capsys):
    assert command("report", old, "--format", "md,csv") == 0
    assert "beam-ring/Nr=4/Nh=3/step=1/dual" in (old / "report/report.md").read_text()


def test_its_answers_agree(old, capsys):
    assert command("validate", old, "--budget", 0) == 0


def test_a_measurement_of_it_is_made_again(old, capsys):
    (record, *_) = (r for r in read_journal(old) if r.verdict is Verdict.VERIFIED)

    assert command("replay", old, record.run_id) == 0
    assert record.case in capsys.readouterr().out


def test_what_another_environment_measured_is_left_alone(old, capsys):
    before = read_journal(old)

    assert command("run", old / "suite.toml", "--out", old, "--repeats", 2) == 2
    assert "was measured in another environment" in capsys.readouterr().err
    assert read_journal(old) == before
