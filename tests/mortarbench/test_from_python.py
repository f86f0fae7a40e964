"""Use of the library in a script: QPs, solver objects, stored answers and refusals."""

import json
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import cvxpy
import numpy as np
import pytest
import qpsolvers

import mortarbench as mb
from tests.support.active_row import QP, ActiveRow, Hangs

pytestmark = pytest.mark.together

SMALL = "beam-ring/Nr=4/Nh=3/steps=1/dual"


def test_a_qp_is_solved_like_a_case():
    answer = mb.solve(QP, "clarabel", 1e-8)

    assert answer.verdict is mb.Verdict.VERIFIED
    assert answer.solution.x == pytest.approx([0.5, 0.5], abs=1e-7)
    assert answer.solution.z == pytest.approx([0.5], abs=1e-7)
    assert answer.case.name == answer.record.case == "qp"
    assert "verified (claimed solved)" in repr(answer)


def test_problems_of_qpsolvers_and_cvxpy_are_solved_like_a_qp():
    """The minimum of x₁² + x₂² − 2x₁ on x₁ + x₂ = 1 is −1, at (1, 0)."""
    parts = dict(P=2 * np.eye(2), q=np.array([-2.0, 0.0]), A=np.ones(2), b=np.ones(1))
    x = cvxpy.Variable(2)
    problem = cvxpy.Problem(
        cvxpy.Minimize(cvxpy.sum_squares(x) - 2 * x[0]), [cvxpy.sum(x) == 1]
    )
    for one in (qpsolvers.Problem(**parts), problem):
        answer = mb.solve(one, "clarabel")

        assert answer.verdict is mb.Verdict.VERIFIED
        assert answer.record.objective == pytest.approx(-1)
    assert mb.verify(qpsolvers.Problem(**parts), [1, 0]).verdict is mb.Verdict.VERIFIED


def test_an_answer_without_a_point_is_not_written(tmp_path):
    answer = mb.solve(QP, ActiveRow(), options={})
    lost = replace(answer, solution=None)
    for path, message in (("a.npz", "returned no point"), ("a.mat", "unknown format")):
        with pytest.raises(mb.InputError, match=message):
            lost.save(tmp_path / path)


def test_a_solver_object_is_measured_in_a_separate_process():
    answer = mb.solve(QP, ActiveRow())

    assert answer.verdict is mb.Verdict.VERIFIED
    assert answer.residuals.worst == 0
    assert answer.record.solver == "ActiveRow"
    assert answer.record.peak_mib > 0
    assert mb.solve(QP, ActiveRow(shift=1e-3)).verdict is mb.Verdict.WRONG
    assert mb.solve(SMALL, ActiveRow()).record.message == "other sizes"


@pytest.mark.parametrize(
    "solvers", [[ActiveRow()], ["clarabel", ActiveRow], ActiveRow()]
)
def test_a_suite_refuses_solver_objects(tmp_path, solvers):
    suite = {"name": "tiny", "solvers": solvers, "problems": [{"family": "strings"}]}
    for arguments in ({"suite": "demo", "solvers": solvers}, {"suite": suite}):
        with pytest.raises(mb.InputError) as refused:
            mb.run(**arguments, out=tmp_path / "out")
        assert "solvers" in str(refused.value)
        assert "; expected a" in str(refused.value)
    assert not (tmp_path / "out").exists()


def test_fields_of_a_solver_object_are_its_options():
    assert mb.solve(QP, ActiveRow(shift=0.5)).record.options == {"shift": 0.5}
    answer = mb.solve(QP, ActiveRow(), options={"shift": 0.25})
    assert answer.solution.x.tolist() == [0.75, 0.75]
    assert mb.solve(QP, ActiveRow(), shift=0.25).solution.x.tolist() == [0.75, 0.75]
    with pytest.raises(mb.InputError, match="unknown option 'shif'; did you mean 'sh"):
        mb.solve(QP, ActiveRow(), shif=1)


def test_an_option_that_is_not_json_is_refused(tmp_path):
    """An option whose default is None accepts every type until a worker is started."""
    file = tmp_path / "free.py"
    file.write_text(
        "from dataclasses import dataclass\n"
        "@dataclass(frozen=True)\n"
        "class Free:\n"
        "    guess: object = None\n"
        "    def declines(self, qp): return 'always'\n"
        "    def prepare(self, qp, tol): pass\n"
        "SOLVERS = {'free': Free()}\n"
    )
    assert mb.solve(QP, "free", plugins=[file], guess=[1, 2]).verdict == "declined"
    with pytest.raises(
        mb.InputError, match=r"free: options {'guess': <object .*expecte"
    ):
        mb.solve(QP, "free", plugins=[file], guess=object())


SCRIPT = """
import mortarbench as mb, numpy as np
import beside
from beside import HALF

NAMES = {"x": "a name that the class looks up"}

class Exact:
    def __init__(self, scale):
        self.scale = scale
        self.keep = lambda v: v * scale

    def declines(self, qp):
        return None

    def prepare(self, qp, tol):
        assert NAMES["x"]
        x = self.keep(beside.solve(qp.P.diagonal(), qp.q)) / self.scale + 0 * HALF
        zero = np.zeros(0)
        return lambda: mb.Solution(
            status=mb.Status.SOLVED, x=x, y=zero, z=zero, z_box=0 * x
        )

qp = mb.QP.from_arrays(np.diag([1.0, 4.0]), [-1.0, -2.0])
answer = mb.solve(qp, Exact(3.0))
print(answer.verdict, answer.solution.x.tolist(), answer.record.solver)
found = mb.test_solver(Exact(2.0), checks=["solves a sequence"])
print(*(result.grade for result in found.results.values()))
"""


def test_a_class_of_a_script_is_copied_with_the_modules_beside_it(tmp_path):
    """The script, like a notebook, has several threads and must not fork."""
    (tmp_path / "beside.py").write_text(
        "HALF = 0.5\ndef solve(d, q):\n    return -q / d\n"
    )
    start = (
        "import threading, time\n"
        "threading.Thread(target=time.sleep, args=(60,), daemon=True).start()\n"
    )
    (tmp_path / "script.py").write_text(start + SCRIPT)
    done = subprocess.run(
        [sys.executable, "script.py"], cwd=tmp_path, capture_output=True, text=True,
        check=False,
    )  # fmt: skip

    assert done.stdout.splitlines() == ["verified [1.0, 0.5] Exact", "decline"], (
        done.stderr
    )


class _Uncopied(ActiveRow):
    """Solver with an attribute that cannot be pickled."""

    def __reduce__(self):
        raise TypeError("cannot pickle the handle of a library")


class _Unloaded(ActiveRow):
    """Solver that can be pickled but not unpickled."""

    def __reduce__(self):
        return int, ("not a number",)


def test_a_solver_that_cannot_be_copied_is_refused_with_the_remedy():
    message = (
        r"solver _Uncopied cannot be copied into a worker process: cannot pickle the "
        r"handle of a library; expected .* or its name and plugins=\[FILE.py\]"
    )
    for call in (lambda s: mb.solve(QP, s), mb.test_solver):
        with pytest.raises(mb.InputError, match=message):
            call(_Uncopied())


def test_a_solver_whose_copy_fails_has_crashed_with_the_reason():
    answer = mb.solve(QP, _Unloaded())

    assert answer.verdict is mb.Verdict.CRASHED
    assert "cannot be rebuilt in a worker process: ValueError" in answer.record.message


# Verification of given points.


def test_a_point_is_verified_with_and_without_its_multipliers():
    found = mb.verify(QP, [0.5, 0.5], z=[0.5])
    alone = mb.verify(QP, [0.5, 0.5])

    assert found.verdict is alone.verdict is mb.Verdict.VERIFIED
    assert alone.multipliers.z == pytest.approx([0.5], abs=1e-15)
    assert found.residuals == (0, 0, 0, 0)
    assert found.objective == -0.625
    assert repr(alone).startswith("<verified: primal 0, dual ")


def test_a_point_that_is_not_optimal_is_refuted():
    assert mb.verify(QP, [0.5, 0.4]).verdict is mb.Verdict.WRONG
    assert mb.verify(QP, [0.6, 0.5]).verdict is mb.Verdict.WRONG
    assert mb.verify(QP, [0.5, 0.5 + 1e-5]).verdict is mb.Verdict.INACCURATE
    assert mb.verify(QP, [0.5, 0.5 + 1e-5], tol=1e-3).verdict is mb.Verdict.VERIFIED
    assert mb.verify(QP, [np.nan, 0.5]).verdict is mb.Verdict.WRONG


def test_wrong_multipliers_are_refuted_at_the_right_point():
    assert mb.verify(QP, [0.5, 0.5], z=[-0.5]).verdict is mb.Verdict.WRONG
    assert mb.verify(QP, [0.5, 0.5], z=[0.0]).residuals.dual > 0.1


def test_verify_agrees_with_solve():
    """`verify` is called with the point alone and with the multipliers of
    the solver.
    """
    case = mb.build(SMALL)
    answer = mb.solve(case, "clarabel")
    s = answer.solution
    given = mb.verify(case, s.x, s.y, s.z, s.z_box)

    assert answer.verdict is mb.Verdict.VERIFIED
    assert given.residuals == answer.residuals
    assert mb.verify(case.qp, s.x).verdict is mb.Verdict.VERIFIED
    assert mb.verify(case, 0.999 * s.x).verdict is not mb.Verdict.VERIFIED


def test_a_solve_ends_at_its_time_limit():
    answer = mb.solve(QP, Hangs(), time_limit=0.5)

    assert answer.verdict is mb.Verdict.TIME_LIMIT
    assert answer.record.message == "killed after 0.5 s"


def test_a_check_ends_at_its_time_limit_and_the_next_one_is_run():
    checks = ["gives multipliers our signs", "refuses a misspelt option"]
    named = []
    result = mb.test_solver(
        Hangs(), checks=checks, time_limit=2.0, progress=named.append
    )

    assert {n: r.grade.value for n, r in result.results.items()} == {
        checks[0]: "fail", checks[1]: "pass",
    }  # fmt: skip
    assert result.failed == {checks[0]: "killed after 2 s"}
    assert named == [f"Hangs: check {i} of 2, {checks[i - 1]}" for i in (1, 2)]


# Suites, figures, replays, conformance.


@pytest.fixture(scope="module")
def results(tmp_path_factory):
    out = tmp_path_factory.mktemp("results")
    suite = {
        "name": "from-python",
        "tolerances": (1e-6,),
        "repeats": 1,
        "solvers": ["clarabel", {"name": "osqp", "options": {"max_iter": 5000}}],
        "problems": [
            {
                "family": "beam-ring",
                "forms": ["dual"],
                "params": {"Nr": np.array([2, 3, 4]), "Nh": 2, "steps": 1},
            }
        ],
    }
    return mb.run(suite, out=out)


def test_a_suite_may_be_a_dict(results):
    assert len(results) == 6
    assert set(results.df.status) == {"verified"}
    written = (results.folder / "suite.toml").read_text("utf-8")
    again = results.folder.parent / "again.toml"
    again.write_text(written)
    assert (
        len(mb.run(again, out=results.folder)) == 6
    )  # the same suite: no measurement is missing


@pytest.mark.parametrize(
    ("suite", "message"),
    [
        ({}, "suite: name is missing"),
        ({"name": None}, "suite: name = None; expected a string, .*leave out keys"),
        ({5: 5}, "suite: unknown key '5'"),
        ({"name": "a", "solvers": [object()]}, r"suite: solvers = \[<object"),
        ({"name": "a", "problem": []}, "suite: unknown key 'problem'; did you mean"),
        (
            {"name": 'a"\nb', "solvers": ["osqp"], "problems": []},
            "suite: name = .* expected a folder name",
        ),
    ],
)
def test_an_invalid_suite_dict_is_refused_in_one_line(tmp_path, suite, message):
    with pytest.raises(mb.InputError, match=message) as e:
        mb.run(suite, out=tmp_path)
    assert "\n" not in str(e.value)


def test_a_figure_of_the_report_is_drawn(results, tmp_path):
    figure = results.plot("accuracy", tmp_path / "a.svg")

    assert figure.axes
    assert (tmp_path / "a.svg").read_text("utf-8").startswith("<?xml")
    assert results.plot("scaling").axes


def test_an_unknown_figure_is_refused_with_the_available_ones(results, tmp_path):
    with pytest.raises(mb.InputError, match=r"unknown figure 'acuracy'; did you mean "
                       r"'accuracy'\? known: accuracy, answer, .*scaling"):  # fmt: skip
        results.plot("acuracy")
    with pytest.raises(mb.InputError, match=r"unknown format '\.txt'"):
        results.plot("accuracy", tmp_path / "a.txt")


def test_the_name_of_a_function_is_not_taken_by_a_module():
    """A submodule that was imported earlier is an attribute of its package and must not
    hide the function.
    """
    program = (
        "import pkgutil, importlib, mortarbench as mb\n"
        "names = {m.name for m in pkgutil.iter_modules(mb.__path__)}\n"
        "for n in names & {*mb.__all__}: importlib.import_module(f'mortarbench.{n}')\n"
        "print([n for n in mb.__all__ if type(getattr(mb, n)).__name__ == 'module'])\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=True
    )

    assert done.stdout == "['dataset']\n"  # its functions are mb.dataset.build, …


def test_the_conformance_suite_accepts_a_solver_object():
    """The solver handles one QP only, so it declines the check and does not conform."""
    checks = ["solves a sequence"]
    found = mb.test_solver(ActiveRow(), checks=checks)

    assert found.solver == "ActiveRow"
    assert not found.conforms
    assert list(found.results) == checks
    assert json.loads(json.dumps(found.to_dict()))["checks"][0]["grade"] == "decline"
    assert "ActiveRow: 0 pass, 1 decline" in repr(found)
    with pytest.raises(mb.InputError, match="unknown check 'solves'"):
        mb.test_solver("clarabel", checks=["solves"])


# Names.


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: mb.solve(None, "clarabel"), "case = None; expected the name of a cas"),
        (
            lambda: mb.solve(Path("a.npz"), "clarabel"),
            "cvxpy; write 'file:a.npz' for a file",
        ),
        (
            lambda: mb.solve(QP, None),
            "solver: None is of type NoneType; expected a solver",
        ),
        (lambda: mb.solve(QP, ActiveRow), r"is a class; expected .* ActiveRow\(\)"),
        (
            lambda: mb.solve(QP, object()),
            "an object with the methods declines and prep",
        ),
        (
            lambda: mb.solve(QP, "clarabel", "1e-6"),
            "tol = '1e-6'; expected a number be",
        ),
        (
            lambda: mb.solve(QP, "clarabel", options={5: 5}),
            "options = {5: 5}; expected",
        ),
        (
            lambda: mb.solve(QP, "clarabel", plugins="a.py"),
            "expected a list of Python f",
        ),
        (lambda: mb.solve(QP, "clarabel", ranks="2"), "ranks = '2'; expected a number"),
        (lambda: mb.verify(QP, [1, 2, 3]), r"x has shape \(3,\); expected \(2,\)"),
        (lambda: mb.verify(QP, [1, 2], z=[1, 2]), r"z has shape \(2,\); expected \(1,"),
        (lambda: mb.export(QP, "a.txt"), "unknown format '.txt'; expected .npz or"),
        (lambda: mb.replay(None, "abc"), "folder = None; expected a path"),
        (
            lambda: mb.solve(QP, "clarabel", time_limit=0),
            "time_limit = 0; expected a positive number",
        ),
        (lambda: mb.test_solver(5), "solver: 5 is of type int; expected a solver"),
    ],
)
def test_an_argument_of_the_wrong_type_is_refused_with_the_expected_type(call, message):
    with pytest.raises(mb.InputError, match=message) as e:
        call()
    assert "\n" not in str(e.value)
