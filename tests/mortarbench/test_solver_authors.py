"""What authors of solvers do: sweeps, versions side by side, files to start from."""

import json
import sys
from pathlib import Path

import pytest

from harness.registry import load_plugin
from harness.results.journal import read_journal
from mortarbench.cli.main import main
from mortarbench.registries import Registries
from tests.support import TOY_PROBLEM

TOY = load_plugin(TOY_PROBLEM)

#: its answer is right in the second version only; what differs is a neighbour
MINE = """
from dataclasses import dataclass
from harness import Solution, Status
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
def cli(capsys, monkeypatch, tmp_path):
    """Run a command line in an empty folder; returns its code, stdout and stderr."""
    monkeypatch.chdir(tmp_path)
    registries = Registries(
        families=TOY.problems,
        solvers=TOY.solvers,
        reference=lambda qp: TOY.solvers["exact"].prepare(qp, 0.0)(),
        report=lambda *_, **__: [],
        start=(sys.executable, "-P", str(TOY_PROBLEM)),
    )

    def cli(*argv):
        return main(registries, [*map(str, argv)]), *capsys.readouterr()

    return cli


@pytest.fixture
def versions(tmp_path):
    """Give the options that load two versions of a plug-in of the same file name."""
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
    assert {s: (str(r.verdict), r.iterations) for s, r in records.items()} == {
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
    assert err.endswith("give --plugin old=mine.py --plugin new=mine.py\n")

    (tmp_path / "old" / "step.py").write_text("LENGTH = 3")
    code, _, err = cli("run", "mine.toml", *versions)
    assert code == 2
    assert "plugins.old=mine.py changed" in err


def test_versions_without_labels_are_told_of_them(cli, versions):
    code, _, err = cli(
        "list", "solvers", "--plugin", "old/mine.py", "--plugin", "new/mine.py"
    )

    assert code == 2
    assert err == (
        "mortarbench: new/mine.py: solver 'mine' of the plug-in exists; rename the new "
        "one, or tell its plug-in apart by --plugin LABEL=FILE.py\n"
    )


def test_options_of_the_command_line_are_swept_and_measured_again(cli, versions):
    sweep = ("--solver", "new:mine", "--option", "factor=1,2")
    code, _, err = cli("run", "mine.toml", *versions, *sweep)
    records = {r.solver: r for r in read_journal(Path("out/mine"))}

    assert code == 0, err
    assert {s: (str(r.verdict), r.options) for s, r in records.items()} == {
        "new:mine factor=1.0": ("verified", {"factor": 1.0}),
        "new:mine factor=2.0": ("wrong", {"factor": 2.0}),
    }
    run_id = records["new:mine factor=2.0"].run_id
    code, out, _ = cli("replay", "out/mine", run_id, *versions, "--json")
    assert (code, json.loads(out)["now"]["options"]) == (0, {"factor": 2.0})


def test_one_solve_has_options_too(cli, versions):
    solve = ("solve", "well/dual", "--solver", "new:mine", *versions)
    codes = [cli(*solve, "--option", f"factor={f}")[0] for f in (1, 2)]

    assert codes == [0, 1]
    assert cli(*solve, "--option", "faktor=2")[2] == (
        "mortarbench: --option: new:mine: unknown option 'faktor'; did you mean "
        "'factor'? known: factor\n"
    )
