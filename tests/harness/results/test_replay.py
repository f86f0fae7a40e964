"""Replay of stored measurements: comparison of verdicts, points and times."""

import json
import shutil
from dataclasses import replace
from functools import partial
from pathlib import Path

import pytest

from mortarbench.cli.main import main
from mortarbench.harness.files.qpfile import save_qp
from mortarbench.harness.registry import load_plugin
from mortarbench.harness.results.journal import read_journal
from mortarbench.registries import Registries
from tests.support import TOY_PROBLEM
from tests.support.toy_registries import toy_registries

#: all tests replay the same run, in one process
pytestmark = pytest.mark.together

PLUGIN = load_plugin(TOY_PROBLEM)
SUITE = """
name = "toy_problem"
repeats = 2
time_limit = 30
solvers = [
    "exact", "liar", "picky", "dies",
    { name = "exact", label = "half", options = { factor = 0.5 } },
]
[[problems]]
family = "well"
forms = ["primal"]
params = { depth = [1, 2] }
"""


@pytest.fixture(scope="module")
def registries():
    return toy_registries()


@pytest.fixture(scope="module")
def finished(registries, tmp_path_factory):
    """Return the folder of a run; tests must not change it."""
    folder = tmp_path_factory.mktemp("finished")
    suite = folder / "toy.toml"
    suite.write_text(SUITE)
    assert main(registries, ["run", str(suite), "--out", str(folder / "done")]) == 0
    return folder / "done"


@pytest.fixture
def cli(registries, command):
    return partial(command, registries=registries)


@pytest.fixture
def stored(finished, tmp_path):
    """Return the records of the run in folder `done` by solver, depth and repeat."""
    shutil.copytree(finished, tmp_path / "done")
    records = read_journal(tmp_path / "done")
    return {(r.solver, r.params["depth"], r.repeat): r for r in records}


@pytest.mark.parametrize(
    "solver",
    [
        "liar",
        "picky",
        "dies",
        *(pytest.param(name, marks=pytest.mark.slow) for name in ("exact", "half")),
    ],
)
def test_the_same_solver_on_the_same_case_gets_the_same_verdict(cli, stored, solver):
    then = stored[solver, 2, 0]
    code, out, _ = cli("replay", "done", then.run_id, "--json")
    told = json.loads(out)

    assert code == 0
    assert told["reproduced"] is True
    assert told["now"]["run_id"] == told["then"]["run_id"] == then.run_id
    assert told["now"]["status"] == then.status
    assert told["same_qp"] is True
    assert told["now"]["options"] == told["then"]["options"]
    assert told["now"]["counts"] == told["then"]["counts"]
    assert told["environment"] == []


def test_a_replay_does_not_change_the_folder(cli, stored, tmp_path):
    def content():
        files = (f for f in (tmp_path / "done").rglob("*") if f.is_file())
        return {f: f.read_bytes() for f in files}

    before = content()
    cli("replay", "done", stored["exact", 1, 0].run_id)

    assert content() == before


def rewrite(record, **changes):
    """Replace a record in the journal."""
    (journal,) = Path("done/journal").glob("*.jsonl")
    others = [
        line
        for line in journal.read_text().splitlines()
        if json.loads(line)["run_id"] != record.run_id
    ]
    journal.write_text("\n".join([*others, record.replace(**changes).to_json()]) + "\n")


def test_another_verdict_is_reported_and_exits_with_1(cli, stored):
    then = stored["exact", 1, 0]
    rewrite(then, status="wrong")
    code, out, _ = cli("replay", "done", then.run_id)

    assert code == 1
    assert out.endswith("Not reproduced: wrong then, verified now.\n")


def test_another_qp_is_reported_and_exits_with_1(cli, stored):
    then = stored["exact", 1, 0]
    rewrite(then, qp="0123456789abcdef")
    code, out, _ = cli("replay", "done", then.run_id)

    assert code == 1
    assert "a different QP" in out


def test_a_step_of_a_sequence_is_solved_alone(cli, tmp_path):
    (tmp_path / "steps.toml").write_text(
        SUITE.replace("depth = [1, 2] }", 'depth = [1, 2] }\nsequence = "depth"')
    )
    assert cli("run", "steps.toml", "--out", "done")[0] == 0
    records = [r for r in read_journal(tmp_path / "done") if r.solver == "half"]
    told = json.loads(cli("replay", "done", records[-1].run_id, "--json")[1])

    assert told["reproduced"] is True
    assert told["now"]["mode"] == "cold"


def test_differences_of_the_environment_are_named(cli, stored, tmp_path):
    path = tmp_path / "done" / "environment.json"
    environment = json.loads(path.read_text())
    environment["versions"]["numpy"] = "1.2.3"
    environment["threads"]["OMP_NUM_THREADS"] = "7"
    path.write_text(json.dumps(environment))
    code, out, _ = cli("replay", "done", stored["exact", 1, 0].run_id)
    told = [line.split() for line in out.splitlines()]

    assert code == 0
    assert ["versions.numpy", "1.2.3"] in [words[:2] for words in told]
    assert "threads.OMP_NUM_THREADS" in [words[0] for words in told if words]
    assert "threads.MKL_NUM_THREADS" not in out


def test_an_unknown_run_id_is_reported_with_the_most_similar_one(cli, stored):
    then = stored["exact", 1, 0].run_id
    other = "x" + then[1:]
    code, out, err = cli("replay", "done", other)

    assert (code, out, err.count("\n")) == (2, "", 1)
    assert f"'{other}'" in err
    assert f"the nearest is {then}" in err


def test_a_case_with_a_changed_file_is_refused(cli, manufactured, tmp_path):
    qp, _ = manufactured("box")
    save_qp(tmp_path / "a.npz", qp, {})
    (tmp_path / "a.toml").write_text(
        'name = "a"\nrepeats = 1\nsolvers = ["osqp"]\n'
        '[[problems]]\nfamily = "file"\nparams = { path = "a.npz" }\n'
    )
    ours = Registries()
    code, _, err = cli("run", "a.toml", "--out", "done", registries=ours)
    assert code == 0, err
    (record,) = read_journal(tmp_path / "done")
    code, out, _ = cli("replay", "done", record.run_id, registries=ours)
    assert (code, "Reproduced" in out) == (0, True)

    save_qp(tmp_path / "a.npz", replace(qp, q=2 * qp.q), {})
    code, _, err = cli("replay", "done", record.run_id, registries=ours)
    assert (code, err.count("\n")) == (2, 1)
    assert record.run_id in err
    assert "the file changed" in err
