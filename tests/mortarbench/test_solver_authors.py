"""Tasks of solver authors: sweeps, comparison of versions, file templates."""

import json
from functools import partial
from pathlib import Path

import pytest

from mortarbench.harness.conformance.conformance import (
    CHECKS,
    INVARIANCE_PREFIX,
    Grade,
    run_check,
)
from mortarbench.harness.registry import load_plugin
from mortarbench.harness.results.journal import read_journal
from mortarbench.harness.suite.suite import load_suite
from mortarbench.progress import waiting
from mortarbench.registries import Registries
from mortarbench.validation import Conformance
from tests.support import TOY_PROBLEM, WRITE_REPORT, no_report
from tests.support.toy_registries import toy_registries
from tests.support.waiting import soon


def exact(qp):
    """Solve a QP of the toy problem."""
    return load_plugin(TOY_PROBLEM).solvers["exact"].prepare(qp, 0.0)()


#: solver that is correct only in the second version; the versions differ in `step`
MINE = """
from dataclasses import dataclass
from mortarbench import Solution, Status
import step

@dataclass(frozen=True)
class Mine:
    factor: float = 1.0

    def declines(self, qp):
        return None

    def prepare(self, qp, tol):
        def solve():
            from step import LENGTH
            x = -qp.q / qp.P.diagonal() * step.LENGTH * self.factor
            return Solution(
                status=Status.SOLVED, x=x, y=qp.b, z=qp.h, z_box=0 * x,
                iterations=LENGTH,
            )
        return solve

SOLVERS = {"mine": Mine()}
"""


@pytest.fixture
def cli(command, monkeypatch):
    """Run a command line with the toy problem in an empty folder."""
    monkeypatch.setattr(WRITE_REPORT, no_report)
    return partial(command, registries=toy_registries(exact))


@pytest.fixture
def versions(tmp_path):
    """Return the options that load two versions of a plug-in with the same
    file name.
    """
    for name, length in (("old", 2), ("new", 1)):
        (tmp_path / name).mkdir()
        (tmp_path / name / "mine.py").write_text(MINE)
        (tmp_path / name / "step.py").write_text(f"LENGTH = {length}")
    (tmp_path / "mine.toml").write_text(
        "name = 'mine'\nsolvers = ['old:mine', 'new:mine', 'exact']\nrepeats = 1\n"
        "[[problems]]\nfamily = 'well'\nforms = ['dual']\n"
    )
    return ("--plugin", "old=old/mine.py", "--plugin", "new=new/mine.py")


def test_two_versions_are_measured_in_one_run_and_block(cli, versions, tmp_path):
    code, _, err = cli("run", "mine.toml", *versions)
    records = {r.solver: r for r in read_journal(Path("out/mine"))}
    environment = json.loads(Path("out/mine/environment.json").read_text())

    assert code == 0, err
    assert {s: (str(r.status), r.iterations) for s, r in records.items()} == {
        "old:mine": ("wrong", 2), "new:mine": ("verified", 1),
        "exact": ("verified", None),
    }  # fmt: skip
    assert len({r.block for r in records.values()}) == 1
    assert environment["plugins"].keys() == {"old=mine.py", "new=mine.py"}
    assert len(set(environment["plugins"].values())) == 2

    again = cli("run", "mine.toml", *versions)
    assert again[0] == 0
    assert len(read_journal(Path("out/mine"))) == 3  # nothing was measured twice

    run_id = records["old:mine"].run_id
    code, out, _ = cli("replay", "out/mine", run_id, *versions, "--json")
    assert (code, json.loads(out)["environment"]) == (0, [])
    code, _, err = cli("replay", "out/mine", run_id)
    assert code == 2
    assert err.endswith("add --plugin old=mine.py --plugin new=mine.py\n")

    (tmp_path / "old" / "step.py").write_text("LENGTH = 3")
    code, _, err = cli("run", "mine.toml", *versions)
    assert code == 2
    assert "plugins.old=mine.py: " in err


def test_the_error_for_versions_without_labels_mentions_labels(cli, versions):
    code, _, err = cli(
        "list", "solvers", "--plugin", "old/mine.py", "--plugin", "new/mine.py"
    )

    assert code == 2
    assert err == (
        "mortarbench: new/mine.py: solver 'mine' of the plug-in already exists; rename "
        "the new one, or label the solvers of a plug-in by --plugin LABEL=FILE.py\n"
    )


def test_options_of_the_command_line_are_swept_and_measured_again(cli, versions):
    sweep = ("--solver", "new:mine", "--option", "factor=1", "--option", "factor=2")
    code, _, err = cli("run", "mine.toml", *versions, *sweep)
    records = {r.solver: r for r in read_journal(Path("out/mine"))}

    assert code == 0, err
    assert {s: (str(r.status), r.options) for s, r in records.items()} == {
        "new:mine factor=1.0": ("verified", {"factor": 1.0}),
        "new:mine factor=2.0": ("wrong", {"factor": 2.0}),
    }
    run_id = records["new:mine factor=2.0"].run_id
    code, out, _ = cli("replay", "out/mine", run_id, *versions, "--json")
    assert (code, json.loads(out)["now"]["options"]) == (0, {"factor": 2.0})


def test_a_single_solve_accepts_options(cli, versions):
    solve = ("solve", "well/dual", "--solver", "new:mine", *versions)
    codes = [cli(*solve, "--option", f"factor={f}")[0] for f in (1, 2)]

    assert codes == [0, 1]
    assert cli(*solve, "--option", "faktor=2")[2] == (
        "mortarbench: new:mine: unknown option 'faktor'; did you mean "
        "'factor'? known: factor\n"
    )


# templates


STRICT = [check for check in CHECKS if not check.startswith(INVARIANCE_PREFIX)]
ONE_PER_KIND = list({check.partition(":")[0]: check for check in STRICT}.values())


def test_a_new_solver_passes_the_conformance_suite_as_it_is(command):
    code, out, err = command("new", "solver", "my-own")
    solver = load_plugin("my-own.py").solvers["my-own"]
    results = {check: run_check(check, solver) for check in ONE_PER_KIND}

    assert (code, out) == (0, "my-own.py\n")
    assert "mortarbench test-solver my-own --plugin my-own.py" in err
    assert Conformance(solver="my-own", results=results).conforms
    declined = {c for c, r in results.items() if r.grade is Grade.DECLINE}
    over_sets = {check for check in ONE_PER_KIND if check.startswith("solves over")}
    assert declined == {c for c in ONE_PER_KIND if "sequence" in c} | over_sets


def test_a_new_problem_builds_the_named_case(command):
    """−u″ = −1 outside of the contact zone, and u = −depth = −0.05 in the zone; its
    distance from both ends is √(2·depth).
    """
    command("new", "problem", "mine")
    name = "mine/n=399/primal"
    solve = ("solve", name, "--solver", "clarabel", "--plugin", "mine.py", "--json")
    code, out, err = command(*solve)
    quantities = json.loads(out)["quantities"]

    assert code == 0, err
    assert quantities["lowest"] == pytest.approx(-0.05, rel=1e-6)
    assert quantities["touching"] / 400 == pytest.approx(1 - 2 * 0.1**0.5, abs=0.01)
    assert command(*solve[:1], "mine/n=1/primal", *solve[2:])[2] == (
        "mortarbench: mine: n=1 must be at least 2\n"
    )


def test_a_new_suite_is_one_of_known_solvers_and_cases(command):
    command("new", "suite", "mine")
    registries = Registries()
    suite = load_suite(Path("mine.toml"), registries.families, registries.solvers)

    assert suite.file.name == "mine"
    assert len(suite.cases.cold) == 4
    assert [s.label for s in suite.solvers] == ["smalbe", "osqp", "clarabel-50"]


@pytest.mark.slow
def test_a_new_suite_runs(command):
    command("new", "suite", "mine")

    assert command("run", "mine.toml", "--repeats", "1")[0] == 0
    assert {str(r.status) for r in read_journal(Path("out/mine"))} <= {
        "verified", "declined", "inaccurate"
    }  # fmt: skip


@pytest.mark.parametrize("kind", ["solver", "problem", "suite"])
def test_existing_files_are_not_overwritten(command, tmp_path, kind):
    name = "mine.toml" if kind == "suite" else "mine.py"
    (tmp_path / name).write_text("precious")
    (tmp_path / "other.py").symlink_to("gone")
    code, out, err = command("new", kind, "mine")

    assert (code, out) == (2, "")
    assert err == (f"mortarbench: {name} exists already; expected another name\n")
    assert (tmp_path / name).read_text() == "precious"
    assert command("new", "solver", "other")[0] == 2
    assert not (tmp_path / "gone").exists()


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("solver", "osqp"), "solver 'osqp' exists already; expected another name"),
        (
            ("problem", "obstacle"),
            "problem 'obstacle' exists already; expected another name",
        ),
        (("suite", "demo"), "suite 'demo' exists already; expected another name"),
        (("solver", "a/b"), "name 'a/b'; expected letters, digits, '-' and '_'"),
        (("solver", "../b"), "name '../b'; expected letters"),
        (("solver", ""), "name ''; expected letters"),
        (("solver", "7b"), "name '7b'; expected letters, digits, '-' and '_', start"),
        (("familie", "b"), "unknown kind 'familie'; known: problem, solver, suite"),
    ],
)
def test_an_invalid_name_is_refused(command, tmp_path, words, message):
    code, _, err = command("new", *words)

    assert code == 2
    assert err.startswith(f"mortarbench: {message}")
    assert [*tmp_path.iterdir()] == []


def test_commands_state_their_activity_and_refuse_an_impossible_limit(
    cli, monkeypatch, capsys
):
    with monkeypatch.context() as patch, waiting() as progress:
        patch.setattr("mortarbench.progress.WAIT_SECONDS", 0.01)
        progress("solving")
        assert soon(lambda: "solving" in capsys.readouterr().err)

    for words in (
        ("test-solver", "exact"),
        ("solve", "well/primal", "--solver", "exact"),
    ):
        code, _, err = cli(*words, "--time-limit", "-1")
        assert code == 2
        assert err == ("mortarbench: --time-limit = -1.0; expected a positive number\n")
