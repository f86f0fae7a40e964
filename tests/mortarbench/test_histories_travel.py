"""Histories from a solver's memory to files, JSON and a terminal, including malformed
ones.

Projected descent on min ½|x|² − Σx over x ≥ 0 with n = 3 goes from x = 0, where all
bounds are active and g = −(1, 1, 1), to the minimiser x = (1, 1, 1) in one step.
"""

import json

import numpy as np
import pytest

from mortarbench.harness import Solution, Status
from mortarbench.harness.conformance.manufactured import manufactured as drawn
from mortarbench.harness.files.store import (
    load_solution,
)
from mortarbench.harness.registry import load_plugin
from mortarbench.harness.results.journal import read_journal
from mortarbench.harness.verify.measure import measure
from mortarbench.text import convergence
from tests.support import HISTORIES, WRITE_REPORT, no_report
from tests.support.stored import save_solution
from tests.support.toy_registries import toy_registries

PLUGIN = load_plugin(HISTORIES)
TOLD = {
    "step": ["e", "e"], "products": [1, 2], "free_gradient": [0, 0],
    "chopped_gradient": [pytest.approx(3**0.5), 0], "active": [3, 0],
    "cost": [0, pytest.approx(-1.5)],
}  # fmt: skip


def unsolved(qp):
    """Disable the reference solve, so that residuals decide the verdict."""
    raise ArithmeticError("no reference solve")


@pytest.fixture
def cli(command, monkeypatch):
    """Run a command line that loads both plug-ins."""
    monkeypatch.setattr(WRITE_REPORT, no_report)

    def cli(*words):
        return command(*words, "--plugin", HISTORIES, registries=registries)

    registries = toy_registries(unsolved)
    return cli


@pytest.fixture
def point():
    def make(**history):
        two = np.array([1.0, 2.0])
        return Solution(
            status=Status.SOLVED, x=two, y=two[:0], z=two[:1], z_box=-two,
            history=history,
        )  # fmt: skip

    return make


def strict(text):
    def refuse(constant):
        raise ValueError(f"{constant} is no JSON")

    return json.loads(text, parse_constant=refuse)


def test_a_stored_history_records_the_iterations(manufactured):
    qp, solution = manufactured("box")
    s = measure(PLUGIN.solvers["descent"].__class__(history=True), qp, 1e-8).solution

    assert s.status is Status.SOLVED
    h = s.history
    assert h["products"].tolist() == list(range(1, s.iterations + 1))
    assert h["active"][-1] == np.count_nonzero(solution.z_box)
    assert h["cost"][-1] == pytest.approx(qp.objective(solution.x))
    assert (np.diff(h["cost"]) <= 1e-12).all()
    assert np.hypot(h["free_gradient"], h["chopped_gradient"])[-1] <= 1e-9


@pytest.fixture(scope="module")
def kept():
    """Return the answer of a solver without history."""
    return measure(PLUGIN.solvers["descent"], drawn("box")[0], 1e-8).solution


@pytest.mark.parametrize(
    ("solver", "word"),
    [
        ("ragged", "columns have different lengths: cost 3, active 2"),
        ("square", "cost has shape (2, 2)"),
        ("scalar", "cost has shape ()"),
        ("objects", "cost has dtype object"),
        ("complex", "cost has dtype complex128"),
        ("long", "step has dtype <U17"),
        ("path", "'../cost' is the name of a column"),
        ("number", "7 is the name of a column"),
        ("none", "it is of type NoneType"),
        ("list", "it is of type list"),
        ("angry", "no history for you"),
    ],
)
def test_a_malformed_history_is_dropped_and_the_answer_kept(
    manufactured, kept, solver, word
):
    qp, _ = manufactured("box")
    s = measure(PLUGIN.solvers[solver], qp, 1e-8).solution

    assert (s.status, s.iterations) == (Status.SOLVED, kept.iterations)
    np.testing.assert_array_equal(s.x, kept.x)
    assert s.history == {}
    assert s.message.startswith("history dropped: ")
    assert word in s.message
    assert kept.message == ""


def test_columns_become_whole_numbers_floats_and_texts(manufactured):
    h = measure(PLUGIN.solvers["notes"], manufactured("box")[0], 1e-8).solution.history

    assert h["step"].tolist() == ["a", "bc"]
    assert (h["big"].dtype, h["big"].tolist()) == (np.int64, [1, 2])
    assert (h["flag"].dtype, h["flag"].tolist()) == (np.int64, [1, 0])
    assert h["cost"].dtype == np.float64


def test_a_history_is_stored_with_its_point_bit_for_bit(tmp_path, point):
    history = {
        "step": np.array(["c", "p"]), "outer": np.array([1, 2]),
        "infeasibility": np.array([np.nan, -0.0]),
    }  # fmt: skip
    digest = save_solution(tmp_path, point(**history))
    loaded = load_solution(tmp_path, digest, Status.SOLVED)

    assert loaded.x.tolist() == [1, 2]
    assert loaded.history.keys() == history.keys()
    for name, column in history.items():
        assert loaded.history[name].dtype == column.dtype
        assert loaded.history[name].tobytes() == column.tobytes()


def test_solve_turns_the_history_on_and_prints_its_columns_as_lists(cli):
    code, out, _ = cli("solve", "well/dual", "--solver", "descent", "--json")

    record = strict(out)
    assert code == 0
    assert record["options"]["history"] is True
    seconds = record["history"].pop("seconds")
    assert record["history"] == TOLD
    assert 0 < seconds[0] < seconds[1]


def test_numbers_that_are_not_finite_are_null_in_json(cli):
    _, out, _ = cli("solve", "well/dual", "--solver", "notes", "--json")

    assert strict(out)["history"] == {
        "step": ["a", "bc"], "big": [1, 2], "flag": [1, 0], "cost": [None, None]
    }  # fmt: skip


def test_solve_prints_counters_and_a_table_of_convergence(cli):
    _, out, _ = cli("solve", "well/dual", "--solver", "descent")

    facts, table = out.split("\n\n")
    assert "counts P_products 2 prepare" in " ".join(facts.split())
    head, *rows = (line.split() for line in table.splitlines())
    assert " ".join(head) == "iteration step products ‖φ‖ ‖β‖ at bound own cost"
    assert rows == [
        ["1", "e1", "1", "0", "1.73e+00", "3", "0"],
        ["2", "e1", "2", "0", "0", "0", "-1.5"],
    ]


def test_long_tables_keep_their_first_and_last_row_and_count_every_step():
    history = {"step": np.array(["c"] * 1000), "active": np.arange(1000)}
    rows = [line.split() for line in convergence(history).splitlines()[1:]]

    assert len(rows) <= 20
    assert rows[0] == ["1", "c1", "0"]
    assert rows[-1][0] == "1000"
    assert sum(int(steps[1:]) for _, steps, _ in rows) == 1000


@pytest.mark.parametrize("kept", [True, False])
def test_a_run_stores_histories_if_the_suite_requests_them(cli, tmp_path, kept):
    option = str(kept).lower()
    (tmp_path / "s.toml").write_text(
        "name = 's'\nrepeats = 2\n[[problems]]\nfamily = 'well'\nforms = ['dual']\n"
        f"[[solvers]]\nname = 'descent'\noptions = {{ history = {option} }}\n"
    )
    code, _, _ = cli("run", "s.toml", "--out", "out")

    records = read_journal(tmp_path / "out")
    assert (code, len(records)) == (0, 2)
    for record in records:
        stored = load_solution(tmp_path / "out", record.vectors, Status.SOLVED)
        history = dict(stored.history)
        history.pop("seconds", None)
        found = {name: column.tolist() for name, column in history.items()}
        assert found == (TOLD if kept else {})
