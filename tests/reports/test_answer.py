"""First screen: the fastest solver is named if, and only if, the times decide it."""

import numpy as np
import pytest

from mortarbench.harness import Verdict
from mortarbench.reports.answer import rows, sentence, table
from tests.support.box_records import box_record
from tests.support.measured import measurements, timed


@pytest.fixture
def rng():
    return np.random.default_rng(11)


def said(records):
    return [sentence(row) for row in rows(measurements(records))]


def test_the_fastest_solver_is_named_with_the_next_one(rng):
    records = timed(rng, "a", 6, 3) + timed(rng, "b", 6, 3, 0.036, scatter=0.1)
    (line,) = said(records)
    assert line.startswith("dual, tol 1e-6: a fastest; b 3.")
    (row,) = rows(measurements(records))
    ratio = row.ranked[1].time.ratio
    assert ratio.value == pytest.approx(3.6, rel=0.2)
    assert 1 < ratio.low < ratio.value < ratio.high


def test_a_tie_says_what_more_repeats_would_separate(rng):
    records = timed(rng, "a", 4, 3, noise=0.5) + timed(rng, "b", 4, 3, noise=0.5)
    (line,) = said(records)
    assert "cannot tell" in line
    assert "at 3 repeats; 9 would separate factors above" in line


def test_solvers_of_single_repeats_on_one_case_are_not_compared(rng):
    (line,) = said(timed(rng, "a", 1, 1) + timed(rng, "b", 1, 1))
    assert "cannot tell" in line
    assert "use --repeats 9" in line


def test_a_disturbance_of_a_whole_repeat_cancels(rng):
    slow = [1.0, 30.0, 5.0]
    records = [
        box_record(s, 0, t * slow[r] * rng.lognormal(0, 0.01), r)
        for s, t in (("a", 0.01), ("b", 0.02))
        for r in range(3)
    ]
    assert said(records)[0].startswith("dual, tol 1e-6: a fastest; b 2.0 ×")


def test_a_solver_that_fails_often_is_not_the_fastest(rng):
    """Its time on the cases that it solved is shown, with their number."""
    quick = [
        r if r.params["n"] < 2 else r.replace(status=Verdict.WRONG)
        for r in timed(rng, "quick", 10, 3, 0.001)
    ]
    (row,) = rows(measurements(quick + timed(rng, "sure", 10, 3)))
    assert row.ranked[0].solver == "sure"
    (entry,) = (e for e in row.entries if e.solver == "quick")
    assert (entry.met, entry.cases) == (2, 10)
    assert entry.time.ratio.value == pytest.approx(0.1, rel=0.1)


def test_copies_of_a_solver_and_reused_answers_do_not_compete(rng):
    copy = timed(rng, "a (null)", 4, 3, 0.001, arm="null")
    reused = timed(rng, "clever", 4, 3, 0.001, remembered=True)
    (row,) = rows(measurements(copy + reused + timed(rng, "a", 4, 3)))
    assert [e.solver for e in row.ranked] == ["a"]
    assert [e.note for e in row.entries] == ["", "reuses answers"]


def accurate(solver, tol, seconds, error):
    return [
        box_record(solver, n, seconds, r, tol=tol, energy_bound=error)
        for n in range(3)
        for r in range(3)
    ]


def test_solvers_are_compared_at_equal_error():
    """Solver b stops late: its loosest tolerance already has a small error."""
    records = [
        *accurate("a", 1e-4, 0.01, 1e-3), *accurate("a", 1e-6, 0.02, 5e-5),
        *accurate("b", 1e-4, 0.015, 1e-7), *accurate("b", 1e-6, 0.03, 1e-8),
    ]  # fmt: skip
    first, second = rows(measurements(records))
    assert first.by_error
    assert first.label == "error 1e-4"
    assert first.ranked[0].solver == "b"  # 15 ms against 20 ms
    assert first.ranked[1].time.ratio.value == pytest.approx(20 / 15)
    assert set(first.chosen[first.chosen.solver == "a"].tol) == {1e-6}
    assert second.ranked[0].solver == "b"
    assert len(second.ranked) == 1  # a never reaches 1e-6


def test_without_mechanics_the_error_is_that_of_the_objective():
    """The reference is the verified objective with the least residual."""
    records = []
    for solver, tol, f, residual in (
        ("a", 1e-2, -0.99, 1e-3), ("a", 1e-4, -1 + 1e-8, 1e-5), ("b", 1e-2, -1, 1e-12),
    ):  # fmt: skip
        records += [
            box_record(solver, n, 0.01, r, tol=tol, objective=f, primal=residual)
            for n in range(2)
            for r in range(3)
        ]
    chosen = next(iter(rows(measurements(records)))).chosen
    errors = chosen.groupby("solver").error.max()
    assert errors["a"] == pytest.approx(1e-4, rel=1e-3)
    assert errors["b"] == 0


def test_the_table_has_a_row_per_form_and_a_column_per_solver(rng):
    records = timed(rng, "a", 4, 3) + timed(rng, "b", 4, 3, 0.02, form="primal")
    run = measurements(records)
    shown = table(list(rows(run)), run.solvers)
    assert shown.head == ("form", "accuracy", "a", "b")
    assert [row[0] for row in shown.rows] == ["primal", "dual"]
    assert shown.data.met.tolist() == [4, 4]
