"""Result folders of earlier versions can be read, continued and recomputed."""

import json
import shutil

import pytest

import mortarbench as mb
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


def test_the_records_of_an_old_folder_are_read_unchanged(old):
    records = read_journal(old)

    verdicts = [r.verdict for r in records if r.solver == "smalbe"]
    assert verdicts.count(Verdict.VERIFIED) == 4  # two repeats of two dual forms
    assert verdicts.count(Verdict.DECLINED) == 1  # the primal has inequality rows
    assert {r.solver for r in records} == {"smalbe", "osqp", "clarabel", "proxqp"}


@pytest.mark.usefixtures("blank_figures")
def test_an_old_folder_can_be_reported(old, capsys):
    assert command("report", old, "--format", "md,csv") == 0
    assert "beam-ring/Nr=4/Nh=3/step=1/dual" in (old / "report/report.md").read_text()


def test_the_answers_of_an_old_folder_agree(old, capsys):
    assert command("validate", old, "--budget", 0) == 0


def test_a_measurement_of_an_old_folder_can_be_repeated(old, capsys):
    (record, *_) = (r for r in read_journal(old) if r.verdict is Verdict.VERIFIED)

    assert command("replay", old, record.run_id) == 0
    assert record.case in capsys.readouterr().out


def test_records_of_another_environment_are_unchanged(old, capsys):
    before = read_journal(old)

    assert command("run", old / "suite.toml", "--out", old, "--repeats", 2) == 2
    assert "was measured in another environment" in capsys.readouterr().err
    assert read_journal(old) == before


# folders of a version whose packages were top-level packages (e247e1f)

PLUGINS = ROOT / "tests/data/results-e247e1f-plugins"
SMOKE = ROOT / "tests/data/results-e247e1f-smoke"
PLUGIN = PLUGINS / "plug.py"  #: imports `harness`, and a module beside it


class There(Registries):
    """Registries with the environment in which a stored folder was measured."""

    def environment(self):
        stored = json.loads((self.folder / "environment.json").read_text())
        del stored["digest"]
        return stored


@pytest.fixture(
    params=[
        pytest.param(SMOKE, id="smoke", marks=pytest.mark.slow),
        pytest.param(PLUGINS, id="plugins"),
    ]
)
def before_namespace(request, tmp_path, monkeypatch):
    folder = shutil.copytree(request.param, tmp_path / "old")
    monkeypatch.setattr(There, "folder", folder, raising=False)
    return folder, ([PLUGIN] if request.param is PLUGINS else [])


@pytest.mark.usefixtures("blank_figures")
def test_a_run_in_a_folder_from_before_the_namespace_continues(before_namespace):
    folder, plugins = before_namespace
    before = {r.run_id: r for r in read_journal(folder)}
    most = max(r.repeat for r in before.values()) + 1

    results = mb.run(
        folder / "suite.toml", out=folder, repeats=most + 1, plugins=plugins,
        registries=There().with_files(plugins),
    )  # fmt: skip

    after = read_journal(folder)
    declined = {(r.case, r.solver) for r in before.values() if r.verdict == "declined"}
    cells = {(r.case, r.solver) for r in before.values()} - declined
    assert {r.run_id: r for r in after if r.run_id in before} == before
    new = [r for r in after if r.run_id not in before]
    assert {(r.case, r.solver, r.repeat) for r in new} == {(*c, most) for c in cells}
    assert {r.environment for r in new} == {r.environment for r in before.values()}
    assert len(results) == len(after)
    results.report(formats=["md"])
    assert "smalbe" in (folder / "report/report.md").read_text()


def test_records_from_before_the_namespace_can_be_repeated(before_namespace):
    """A new run gives the same verdict and nearly the same number of products."""
    folder, plugins = before_namespace
    records = [r for r in read_journal(folder) if r.repeat == 0]

    for solver in {r.solver for r in records}:
        record = next(
            r for r in records if r.solver == solver and r.verdict.is_verified
        )
        again = mb.replay(folder, record.run_id, plugins=plugins)
        assert (again.then, again.now.verdict) == (record, record.verdict)
        products = record.counts.get("P_products", 0)
        assert again.now.counts.get("P_products", 0) == pytest.approx(
            products, rel=0.03, abs=2
        )


def test_folders_from_before_the_namespace_can_be_merged(tmp_path):
    merged = mb.merge(SMOKE, PLUGINS, out=tmp_path / "both")

    assert len(merged) == len(read_journal(SMOKE)) + len(read_journal(PLUGINS))
