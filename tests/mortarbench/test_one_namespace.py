"""All modules are in one package, so a user's files may be named like its folders."""

import subprocess
import sys

import pytest

pytestmark = pytest.mark.together  # one process lists the modules that it imports

PLUGIN = """
from dataclasses import dataclass
import numpy as np
from mortarbench import QP, Solution, Status
from factors import FACTOR

@dataclass(frozen=True)
class Exact:
    def declines(self, qp: QP):
        return "has rows" if qp.b.size or qp.h.size else None
    def prepare(self, qp, tol):
        x = np.clip(-FACTOR * qp.q / qp.P.diagonal(), qp.lb, qp.ub)
        z_box = -qp.P @ x - qp.q
        none = np.zeros(0)
        return lambda: Solution(status=Status.SOLVED, x=x, y=none, z=none, z_box=z_box)

SOLVERS = {"exact": Exact()}
"""
PROGRAM = """
import mortarbench as mb

qp = mb.QP.from_arrays([[2.0, 0], [0, 1]], [-2.0, 3.0], lb=[0, 0])
by_plugin = mb.solve(qp, "exact", plugins=["mine/plug.py"])
assert by_plugin.verdict is mb.Verdict.VERIFIED, by_plugin
assert by_plugin.solution.x.tolist() == [1, 0]
suite = {
    "name": "own", "tolerances": [1e-6], "repeats": 1, "solvers": ["smalbe"],
    "problems": [{"family": "string", "forms": ["primal"], "params": {"n": [8]}}],
}
results = mb.run(suite, out="out", fresh=True)
assert list(results.df.status) == ["verified"], results.df
import harness, problems, reports, solvers
assert {m.OF_USER for m in (harness, problems, reports, solvers)} == {True}
from mortarbench.solvers.smalbe.solver import SMALBE
from mortarbench.problems import PROBLEMS
assert "smalbe" in mb.solvers().names and set(PROBLEMS) <= set(mb.problems().names)
"""


@pytest.fixture(scope="module")
def folder_of_user(tmp_path_factory):
    folder = tmp_path_factory.mktemp("of-user")
    for name in ("harness", "problems", "solvers", "reports/__init__"):
        file = folder / f"{name}.py"
        file.parent.mkdir(exist_ok=True)
        file.write_text("OF_USER = True\n")
    (folder / "mine").mkdir()
    (folder / "mine" / "plug.py").write_text(PLUGIN)
    (folder / "mine" / "factors.py").write_text("FACTOR = 1.0\n")
    (folder / "script.py").write_text(PROGRAM)
    return folder


@pytest.mark.slow
@pytest.mark.parametrize(
    "command",
    [["script.py"], pytest.param(["-c", PROGRAM], marks=pytest.mark.slow)],
)
def test_a_working_directory_may_contain_folders_with_our_package_names(
    folder_of_user, command
):
    done = subprocess.run(
        [sys.executable, *command], cwd=folder_of_user, capture_output=True, text=True
    )

    assert (done.returncode, done.stderr) == (0, "")


@pytest.fixture(scope="module")
def imported(folder_of_user):
    """Return the names of the modules that our packages import."""
    program = (
        "import sys, mortarbench.cli.main, mortarbench.processes, "
        "mortarbench.reports.folder, mortarbench.solvers.smalbe.solver; "
        "import mortarbench.problems.fem.mesh; print(*sys.modules)"
    )
    done = subprocess.run(
        [sys.executable, "-c", program], cwd=folder_of_user,
        capture_output=True, text=True, check=True,
    )  # fmt: skip
    return done.stdout.split()


@pytest.mark.parametrize("name", ["harness", "problems.fem.mesh", "solvers", "reports"])
def test_no_package_is_imported_under_a_top_level_name(name, imported):
    assert name not in imported
    assert f"mortarbench.{name}" in imported
