"""The library functions that the command line and notebooks call."""

import json
import os
import subprocess
import sys

import numpy as np
import pandas as pd
import pytest

import mortarbench as mb
from mortarbench.harness import Verdict
from mortarbench.harness.results.journal import read_journal
from mortarbench.solvers import SOLVERS
from tests.support import ROOT, TOY_PROBLEM

pytestmark = pytest.mark.together

SMALL = "beam-ring/Nr=4/Nh=3/steps=1/dual"


@pytest.fixture(scope="module")
def answer():
    return mb.solve(mb.build(SMALL), "smalbe")


@pytest.fixture(scope="module")
def results(tmp_path_factory):
    """Run the solvers of a plug-in on its family."""
    folder = tmp_path_factory.mktemp("results")
    (folder / "s.toml").write_text(
        'name = "s"\nsolvers = ["exact", "picky"]\nrepeats = 2\n'
        '[[problems]]\nfamily = "well"\nforms = ["primal", "dual"]\n'
    )
    return mb.run(folder / "s.toml", out=folder / "out", plugins=[TOY_PROBLEM])


@pytest.fixture(scope="module")
def smoke(tmp_path_factory):
    """Run two built-in solvers on a built-in case."""
    out = tmp_path_factory.mktemp("smoke")
    return mb.run("smoke", out=out, cases=["*/dual"], solvers=["smalbe", "clarabel"])


def test_every_promised_name_is_exported():
    assert {name for name in mb.__all__ if not hasattr(mb, name)} == set()
    assert set(mb.__all__) <= set(dir(mb))
    with pytest.raises(AttributeError, match="no attribute 'solv'"):
        mb.solv  # noqa: B018


def test_a_point_yields_the_physical_results_of_its_case():
    case = mb.build("obstacle/dim=1/n=12/primal")  # exact at nodes: u = (|x| − 1)²
    answer = mb.solve(case, "clarabel")

    u = case.family_case.recover(answer.solution)
    x = np.linspace(-1.5, 1.5, 13)
    assert np.abs(u - np.maximum(np.abs(x) - 1, 0) ** 2).max() < 0.02
    assert case.quantities(answer.solution) == pytest.approx(answer.quantities)
    with pytest.raises(mb.InputError, match="has no bodies to draw"):
        answer.plot()


def test_an_answer_is_verified_certified_and_printed(answer):
    assert answer.verdict is Verdict.VERIFIED
    assert max(answer.residuals) <= 1e-7
    assert 0 < answer.energy_bound < 1e-4
    assert answer.quantities["energy"] == answer.record.quantities["energy"]
    assert {"step", "infeasibility"} <= answer.history.keys()
    assert "verified (claimed solved)" in repr(answer)
    assert "the discretisation error is not included" in repr(answer)
    assert json.loads(json.dumps(answer.to_dict()))["case"] == SMALL


def test_an_answer_is_drawn_and_written_for_paraview(answer, tmp_path):
    figure = answer.plot(tmp_path / "a.pdf")

    assert figure.axes
    assert (tmp_path / "a.pdf").read_bytes().startswith(b"%PDF")
    assert answer.save_vtu(tmp_path / "a.vtu").stat().st_size > 1000
    with pytest.raises(mb.InputError, match=r"unknown format '\.txt'"):
        answer.plot(tmp_path / "a.txt")


def test_options_are_passed_on_and_history_can_be_switched_off():
    case = mb.build(SMALL)
    few = mb.solve(case, "smalbe", options={"max_steps": 3, "history": False})

    assert few.verdict is Verdict.ITERATION_LIMIT
    assert few.record.options["max_steps"] == 3
    assert "solver                    smalbe (max_steps=3, history=False)\n" in repr(
        few
    )
    assert few.history == {}
    with pytest.raises(mb.InputError, match="smalbe: unknown option 'max_step'"):
        mb.solve(case, "smalbe", options={"max_step": 3})


def test_a_run_is_a_table_of_its_journal(results, capfd):
    records = read_journal(results.folder)

    assert list(results.df["run_id"]) == [r.run_id for r in records]
    assert list(results.df.columns) == list(mb.harness.Record.__struct_fields__)
    assert (results.df.query("solver == 'exact'").status == "verified").all()
    assert len(results) == len(results.df) == 6  # declined once, not twice
    pd.testing.assert_frame_equal(mb.load(results.folder).df, results.df)
    assert repr(results).splitlines()[1].split()[:4] == ["exact", "4", "4", "4"]
    assert results.shortfall == []


def test_functions_print_only_on_request(tmp_path, results, capfd):
    suite = results.folder.parent / "s.toml"
    few = {"plugins": [TOY_PROBLEM], "repeats": 1, "cases": ["*/dual"]}
    mb.run(suite, out=tmp_path / "a", **few)
    mb.load(tmp_path / "a")
    assert capfd.readouterr() == ("", "")

    mb.run(suite, out=tmp_path / "b", **few, progress=True)
    out, err = capfd.readouterr()
    assert out == ""
    assert "2/2 " in err


def test_progress_is_passed_to_a_function(tmp_path, results):
    told = []
    mb.run(
        results.folder.parent / "s.toml",
        out=tmp_path / "a",
        plugins=[TOY_PROBLEM],
        progress=told.append,
    )

    measured = [event.record for event in told if event.record is not None]
    assert [r.run_id for r in measured] == [
        r.run_id for r in read_journal(tmp_path / "a")
    ]
    assert (told[-1].done, told[-1].total) == (8, 8)
    assert {event.done for event in told} == set(range(9))


def test_a_report_names_its_page(results, blank):
    with blank():
        found = results.report(formats=["html", "md"])
        compared = mb.report(results.folder, results.folder, formats=["md"])

    assert found.page == results.folder / "report/index.html"
    assert repr(found).splitlines() == [*found.said, str(found.page)]
    assert len(found.said) == 2  # a sentence for each form
    assert all("exact" in line for line in found.said)
    assert compared.said


def test_answers_of_a_folder_are_validated(smoke, blank):
    with blank():
        found = smoke.validate()

    assert found.agreed
    assert found.data["counts"]["answers"] == 2
    assert (smoke.folder / "report/validation.html") in found.pages
    assert "smalbe" in repr(found)
    json.dumps(found.to_dict(), allow_nan=False)


def test_lists_are_tables():
    assert "smalbe" in mb.solvers().names
    assert "beam-ring" in mb.problems().names
    assert "demo" in mb.suites().names
    assert list(mb.solvers().df["name"]) == list(SOLVERS)
    assert "smalbe" in repr(mb.solvers())
    assert len(mb.problems()[:2]) == 2
    assert "well" in mb.problems(plugins=[TOY_PROBLEM]).names


LIGHT = [
    ["--help"],
    ["run", "--help"],
    ["--version"],
    ["list", "suites"],
    ["solve", "beam-rin/dual", "--solver", "smalbe"],
    ["solve", "beam-ring/dual", "--solver", "smalb"],
    ["solve", "beam-ring/dual", "--solver", "smalbe", "--plot", "a.txt"],
    ["run", "dem"],
    ["report", "nowhere"],
    ["validate", "nowhere"],
    ["replay", "nowhere", "abc"],
    ["test-solver", "smalb"],
]


@pytest.fixture(scope="module")
def loaded(tmp_path_factory):
    """Run the commands of `LIGHT` in one process.

    Return the words of the line printed after each command: "loaded" and the libraries
    of `slow` that are imported by then.
    """
    program = (
        "import json, sys, mortarbench.__main__ as m\n"
        "slow = {'numpy', 'scipy', 'pandas', 'matplotlib', 'rich'}\n"
        "for argv in json.loads(sys.argv[1]):\n"
        "    sys.argv = ['mortarbench', *argv]\n"
        "    try: m.main()\n"
        "    except SystemExit: pass\n"
        "    print('loaded', *sorted(slow & set(sys.modules)))\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", program, json.dumps(LIGHT)],
        cwd=tmp_path_factory.mktemp("light"), capture_output=True, text=True,
        check=True,
    )  # fmt: skip
    lines = [line for line in done.stdout.splitlines() if line.startswith("loaded")]
    return [line.split() for line in lines]


@pytest.mark.parametrize("number", range(len(LIGHT)), ids=map(" ".join, LIGHT))
def test_help_and_refusals_import_no_numerical_library(loaded, number):
    assert len(loaded) == len(LIGHT)
    assert loaded[number] == ["loaded"]


@pytest.mark.slow
def test_a_wheel_works_without_the_checkout(tmp_path):
    subprocess.run(
        [sys.executable, "-m", "pip", "wheel", "-q", "--no-deps", "-w", tmp_path, ROOT],
        check=True,
    )
    (wheel,) = tmp_path.glob("*.whl")
    target, empty = tmp_path / "site", tmp_path / "empty"
    empty.mkdir()
    subprocess.run(
        [sys.executable, "-m", "zipfile", "-e", str(wheel), str(target)], check=True
    )
    version = wheel.name.split("-")[1]
    places = {place.name for place in target.iterdir()}
    assert places == {"mortarbench", f"mortarbench-{version}.dist-info"}
    program = (
        "import sys; sys.path.insert(0, sys.argv[1])\n"
        "import mortarbench as mb, os\n"
        "os.environ['PYTHONPATH'] = sys.argv[1]\n"
        "assert mb.__file__.startswith(sys.argv[1])\n"
        "found = mb.run('smoke', repeats=1)\n"
        "print(len(found), found.report().page)\n"
    )
    done = subprocess.run(
        [sys.executable, "-P", "-c", program, str(target)],
        cwd=empty, capture_output=True, text=True, check=True,
    )  # fmt: skip

    assert done.stdout.split() == ["12", "out/smoke/report/index.html"]
    assert (empty / "out/smoke/report/index.html").is_file()


def in_many_threads(program, folder):
    """Run a user's program whose libraries may use eight threads; return its output."""
    many = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"), "8")
    return subprocess.run(
        [sys.executable, "-c", program], env=os.environ | many,
        cwd=folder, capture_output=True, text=True, check=True,
    ).stdout  # fmt: skip


@pytest.mark.slow
def test_a_case_built_in_many_threads_is_the_one_that_was_measured(smoke):
    """With a different digest, no stored answer could be verified."""
    program = (
        "import mortarbench as mb\n"
        "checked = mb.validate('.')\n"
        "print(checked.data['counts']['answers'], checked.agreed)\n"
    )

    assert in_many_threads(program, smoke.folder).split() == ["2", "True"]
