"""Verdicts for a different acceptance factor follow from the data in the journal."""

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mortarbench.harness import Record, Status, Verdict
from mortarbench.harness.record import VERIFIED_FACTOR
from mortarbench.harness.results.journal import Journal, read_journal
from mortarbench.harness.verify.kkt import Residuals, rejudged, verdict
from mortarbench.reports.folder import write_report
from mortarbench.reports.measurements import read_measurements
from mortarbench.reports.sections import compose

sizes = st.one_of(
    st.floats(0, 1, allow_nan=False),
    st.floats(-12, 0).map(lambda e: 10.0**e),
    st.sampled_from([np.inf, np.nan]),
)
residuals = st.builds(Residuals, sizes, sizes, sizes, sizes)
tolerances = st.floats(-10, 0).map(lambda e: 10.0**e)


def record(claimed, found, tol, **changes):
    """Return a record as read from a journal, which stores NaN and inf as null."""
    status = verdict(claimed, found, changes.get("accuracy") or tol)
    made = Record(
        run_id="r", case="box/dual", family="box", params={}, form="dual", sizes={},
        solver="a", options={}, tol=tol, repeat=0, block=0, status=status,
        claimed=claimed.value, **found._asdict(),
    )  # fmt: skip
    return Record.from_json(made.replace(**changes).to_json())


@given(st.sampled_from(list(Status)), residuals, tolerances)
def test_factor_ten_reproduces_every_stored_status(claimed, found, tol):
    stored = record(claimed, found, tol)

    assert rejudged(stored, VERIFIED_FACTOR) is stored.status


@given(
    st.sampled_from(list(Status)), residuals, tolerances,
    st.lists(st.floats(-3, 4).map(lambda e: 10.0**e), min_size=2, max_size=5),
)  # fmt: skip
def test_a_smaller_factor_never_verifies_more(claimed, found, tol, factors):
    stored = record(claimed, found, tol)
    verified = [rejudged(stored, f) is Verdict.VERIFIED for f in sorted(factors)]

    assert all(small <= large for small, large in pairwise(verified))


@pytest.mark.parametrize(
    ("worst", "factor", "expected"),
    [
        (5e-6, 10, Verdict.VERIFIED),
        (5e-6, 1, Verdict.INACCURATE),
        (5e-6, 1e-7, Verdict.WRONG),  # beyond √(1e-13) = 3e-7
        (5e-4, 10, Verdict.INACCURATE),
        (5e-4, 1000, Verdict.VERIFIED),
        (0.5, 1e9, Verdict.WRONG),  # residuals above 0.1 are never verified
    ],
)
def test_the_verdict_is_that_of_the_residuals_at_the_factor(worst, factor, expected):
    stored = record(Status.SOLVED, Residuals(1e-9, worst, 0.0, 1e-9), 1e-6)

    assert rejudged(stored, factor) is expected


def test_a_sweep_is_verified_at_its_accuracy_not_at_the_tolerances():
    stored = record(Status.SOLVED, Residuals(0, 5e-6, 0, 0), 1e-2, accuracy=1e-6)

    assert rejudged(stored, 10) is Verdict.VERIFIED
    assert rejudged(stored, 1) is Verdict.INACCURATE


@pytest.mark.parametrize("factor", [0.01, 10, 1e6])
@pytest.mark.parametrize(
    "changes",
    [
        {"status": Verdict.MEMORY_LIMIT},  # an answer that exceeded the limit
        {"status": Verdict.CRASHED, "claimed": None, "primal": None, "dual": None},
        {"status": Verdict.TIME_LIMIT, "claimed": None},
    ],
)
def test_verdicts_that_do_not_depend_on_residuals_are_unchanged(changes, factor):
    stored = record(Status.SOLVED, Residuals(0, 1e-9, 0, 0), 1e-6).replace(**changes)

    assert rejudged(stored, factor) is changes["status"]


def test_an_answer_without_a_claim_of_success_keeps_the_name_of_its_failure():
    stored = record(Status.ITERATION_LIMIT, Residuals(0, 5e-6, 0, 0), 1e-6)

    assert stored.status is Verdict.VERIFIED
    assert rejudged(stored, 1) is Verdict.ITERATION_LIMIT


@pytest.fixture
def folder(tmp_path):
    """Return a result folder with one answer whose largest residual is 4·tol."""
    stored = record(Status.SOLVED, Residuals(1e-9, 4e-6, 0, 1e-9), 1e-6)
    with Journal(tmp_path, "test") as journal:
        journal.append(stored)
    return tmp_path


def test_the_report_applies_and_states_the_factor(folder):
    run = read_measurements(folder, 1.0)

    assert [*run.answers.status] == ["inaccurate"]
    assert "verdicts recomputed: residuals ≤ 1 × tol" in compose(run).dateline


def test_a_report_at_the_stored_factor_does_not_mention_recomputing(folder, capsys):
    run = read_measurements(folder, VERIFIED_FACTOR)

    assert [*run.answers.status] == ["verified"]
    assert "recomputed" not in compose(run).dateline
    assert capsys.readouterr().err == ""


def test_the_journal_and_its_table_keep_the_status_as_stored(folder):
    import pandas as pd

    write_report(folder, ["parquet"], 0.1)

    assert pd.read_parquet(folder / "report/records.parquet").status[0] == "verified"
    assert read_journal(folder)[0].status is Verdict.VERIFIED
