"""Judgement on changes: planted slowdowns are found, unchanged solvers are not."""

import numpy as np
import pytest

from mortarbench.harness import Verdict
from mortarbench.reports.compare import Outcome, compare, judged, mean_ratio, welch
from mortarbench.reports.intervals import PROCESS
from tests.support.measured import measurements, timed

LIMIT = 1.2


def change(rng, factor=1.0, repeats=7, cases=6, noise=0.04, **more):
    before = measurements(timed(rng, "a", cases, repeats, noise=noise), "old")
    after = timed(rng, "a", cases, repeats, 0.01 * factor, noise=noise, **more)
    (found,) = compare(before, measurements(after, "new"), [("a", "a")])
    return found


def ratio(seed, factor, repeats=7, cells=6, noise=0.04):
    """Return the mean ratio of log-normal times, with the noise of each run.

    The repeats of a run share the factor of their process.
    """
    rng = np.random.default_rng(seed)
    before, after = noise * rng.standard_normal((2, cells, repeats))
    after += PROCESS * (rng.standard_normal(2) @ [1, -1])
    return mean_ratio(
        [welch(x, np.log(factor) + y) for x, y in zip(before, after, strict=True)], 1
    )


def outcomes(factor, **more):
    return [judged(ratio(seed, factor, **more), LIMIT) for seed in range(200)]


def test_unchanged_solvers_are_not_slower():
    found = outcomes(1.0)
    assert Outcome.SLOWER not in found
    assert found.count(Outcome.NOT_SLOWER) >= 120


def test_a_slowdown_of_a_quarter_is_found_and_never_passed():
    found = outcomes(1.25)
    assert found.count(Outcome.SLOWER) >= 120
    assert found.count(Outcome.NOT_SLOWER) <= 2
    assert outcomes(1.5).count(Outcome.SLOWER) == 200


def test_noise_leads_to_no_judgement_rather_than_to_a_wrong_one():
    found = outcomes(1.25, noise=0.6, cells=2, repeats=3)
    assert Outcome.CANNOT_TELL in found
    assert found.count(Outcome.NOT_SLOWER) <= 10


def test_what_cannot_be_told_has_a_number():
    rng = np.random.default_rng(4)
    line = change(rng, noise=0.5, cases=2, repeats=3).sentence(LIMIT)
    assert line.startswith("cannot tell: a takes")
    assert "the smallest detectable factor here is" in line
    assert "run again with --repeats" in line


def test_a_single_repeat_has_no_interval():
    found = change(np.random.default_rng(5), repeats=1)
    assert found.outcome(LIMIT) is Outcome.CANNOT_TELL
    assert not found.ratio.is_known


@pytest.mark.parametrize(("repeats", "cells"), [(3, 2), (4, 3), (9, 7)])
def test_the_interval_of_a_mean_over_cells_covers(repeats, cells):
    found = [ratio(seed, 1.1, repeats, cells) for seed in range(2000)]
    assert np.mean([r.low <= 1.1 <= r.high for r in found]) >= 0.93


def test_two_solvers_of_one_run_are_paired_by_repeat():
    """A disturbance of a repeat slows both solvers and cancels."""
    rng = np.random.default_rng(6)
    slow = rng.lognormal(0, 1, 5)
    records = [
        r.replace(total_seconds=r.total_seconds * slow[r.repeat])
        for r in (*timed(rng, "old", 3, 5), *timed(rng, "new", 3, 5, 0.013))
    ]
    run = measurements(records)
    (found,) = compare(run, run, [("old", "new")])
    assert found.outcome(LIMIT) is Outcome.SLOWER
    assert found.ratio.value == pytest.approx(1.3, rel=0.05)


def test_a_worse_status_is_named_with_its_cell():
    rng = np.random.default_rng(7)
    found = change(rng, status=Verdict.INACCURATE)
    assert len(found.worse) == 6
    assert set(found.worse.old) == {"verified"}
    assert set(found.worse.new) == {"inaccurate"}
    assert found.ratio is None  # times of wrong answers are not compared
    assert found.outcome(LIMIT) is Outcome.CANNOT_TELL


def test_welch_equals_student_for_equal_variances_and_sizes():
    """For x and y of equal size n and variance s², the error is s√(2/n)."""
    x, y = np.array([0.0, 1, 2]), np.array([1.0, 2, 3])
    found = welch(x, y)
    assert found.mean == 1
    assert found.square == pytest.approx(2 / 3)
    assert found.freedom == pytest.approx(4)


def test_two_runs_on_a_busy_machine_are_not_judged():
    rng = np.random.default_rng(8)
    busy = {"e": {"now": {"load": 4.2}, "machine": {"usable_cores": 2}}}
    before = measurements(timed(rng, "a", 3, 7), "old")
    after = measurements(timed(rng, "a", 3, 7, 0.02), "new", environments=busy)
    (found,) = compare(before, after, [("a", "a")])
    assert found.outcome(LIMIT) is Outcome.CANNOT_TELL
    assert "other programs were running" in found.sentence(LIMIT)
    (within,) = compare(after, after, [("a", "a")])
    assert within.outcome(LIMIT) is Outcome.NOT_SLOWER
