"""Times at equal certified errors, and the error of the mesh beside them.

The sweeps follow known laws, because times and errors are planted.
"""

import re
from pathlib import Path

import numpy as np
import pytest
from scipy.optimize import isotonic_regression

from mortarbench.harness import Record, Verdict
from mortarbench.reports.data.evidence import Evidence, arrange
from mortarbench.reports.data.time_at_accuracy import (
    isotonic,
    time_at_accuracy,
    times_at,
)
from mortarbench.reports.folder import compose
from mortarbench.reports.render.markdown import markdown
from mortarbench.reports.sections.sweeps import certified_picture, certified_sweeps

TOLS = (1e-2, 1e-4, 1e-6, 1e-8)


def record(solver="a", tol=1e-6, repeat=0, **changes):
    defaults = dict(
        run_id=f"{solver}-{tol}-{repeat}-{changes.get('case', 'box/dual')}",
        case="box/dual", family="box", params={}, form="dual", sizes={},
        solver=solver, options={}, tol=tol, repeat=repeat, block=repeat,
        status=Verdict.VERIFIED, claimed="solved", total_seconds=0.01, primal=1e-9,
        dual=1e-9, complementarity=1e-9, gap=1e-9, energy_bound=tol,
        started="2026-11-21T06:00:00.000+00:00",
    )  # fmt: skip
    return Record(**(defaults | changes))


def sweep(solver="a", seconds=lambda tol: 1e-3 * tol**-0.25, repeats=3, **changes):
    """Return the records of a solver whose certified error equals the tolerance."""
    return [
        record(solver, tol, i, total_seconds=seconds(tol) * (1 + 0.01 * i), **changes)
        for tol in TOLS
        for i in range(repeats)
    ]


def outcomes(records):
    evidence = Evidence(directory=Path(), records=arrange(records))
    return [o for o in evidence.flat if o.solver == records[0].solver]


@pytest.fixture
def page(tmp_path):
    def make(records):
        return compose(Evidence(directory=tmp_path, records=arrange(records)))

    return make


def tables(page, name):
    (section,) = (s for s in page.sections if s.name == name)
    return [
        [dict(zip(t.columns, row, strict=True)) for row in t.rows]
        for t in section.tables
    ]


@pytest.mark.parametrize("error", [1e-2, 3e-3, 1e-5, 1e-8])
def test_a_power_law_is_interpolated_exactly(error):
    found = time_at_accuracy(outcomes(sweep(repeats=1)), error)

    assert found.kind == "between"
    assert found.time.value == pytest.approx(1e-3 * error**-0.25)
    assert found.time.samples == 1


def test_times_are_not_extrapolated_beyond_the_sweep():
    points = outcomes(sweep(repeats=1))

    assert time_at_accuracy(points, 0.9e-8) == ("not reached", None)
    looser = time_at_accuracy(points, 0.5)
    assert looser.kind == "looser"
    assert looser.time.value == pytest.approx(1e-3 * 1e-2**-0.25)


def test_a_better_answer_never_takes_less_time():
    """If a smaller error took less time, the geometric mean replaces both times."""
    errors = np.array([1e-2, 1e-4, 1e-6, 1e-8])
    times = np.array([1.0, 4.0, 1.0, 8.0])
    at = [times_at(e, errors, times) for e in np.geomspace(1e-2, 1e-8, 40)]

    assert (np.diff(at) >= -1e-12).all()
    assert times_at(1e-4, errors, times) == pytest.approx(2)  # √(4·1)
    assert times_at(1e-8, errors, times) == pytest.approx(8)


def test_two_tolerances_with_one_answer_are_one_point():
    errors, times = np.array([1e-2, 1e-4, 1e-4]), np.array([1.0, 2.0, 8.0])

    assert times_at(1e-4, errors, times) == pytest.approx(4)
    assert times_at(1e-3, errors, times) == pytest.approx(2)


@pytest.mark.parametrize(
    "ending",
    [
        dict(status=Verdict.ITERATION_LIMIT, claimed="iteration_limit"),
        dict(status=Verdict.TIME_LIMIT, claimed="time_limit"),
        dict(status=Verdict.FAILED, claimed="failed"),
        dict(status=Verdict.CRASHED, claimed=None, energy_bound=None),
        dict(status=Verdict.MEMORY_LIMIT),
        dict(energy_bound=None),
    ],
)
def test_only_certified_answers_of_completed_solves_are_points(ending):
    records = [r.replace(**ending) if r.tol == 1e-8 else r for r in sweep()]

    assert time_at_accuracy(outcomes(records), 1e-7).kind == "not reached"
    assert time_at_accuracy(outcomes(records), 1e-5).kind == "between"


def test_one_failed_repeat_removes_the_point():
    records = sweep()
    records[-1] = records[-1].replace(status=Verdict.FAILED, claimed="failed")

    assert time_at_accuracy(outcomes(records), 1e-7).kind == "not reached"


def test_a_certified_error_counts_though_the_residuals_refute_the_claim():
    """This occurs at loose tolerances of a sweep judged at a strict accuracy."""
    refuted = [r.replace(status=Verdict.INACCURATE, accuracy=1e-12) for r in sweep()]

    assert time_at_accuracy(outcomes(refuted), 1e-5).kind == "between"


def test_simultaneous_fits_equal_separate_fits():
    rng = np.random.default_rng(141421)
    for k in (1, 2, 5, 9):
        y, weights = rng.standard_normal((20, k)), rng.integers(1, 4, k)
        expected = [isotonic_regression(row, weights=weights).x for row in y]
        assert isotonic(y, weights) == pytest.approx(np.array(expected), abs=1e-14)


def test_the_largest_error_of_the_repeats_is_the_error():
    records = [
        r.replace(energy_bound=0.5) if (r.tol, r.repeat) == (1e-8, 2) else r
        for r in sweep()
    ]

    assert time_at_accuracy(outcomes(records), 1e-7).kind == "not reached"


def test_the_interval_comes_from_the_repeats_and_is_the_same_every_time():
    scattered = [
        r.replace(total_seconds=r.total_seconds * (1 + 0.5 * (r.repeat % 2)))
        for r in sweep(repeats=6)
    ]
    found, again = (time_at_accuracy(outcomes(scattered), 1e-5) for _ in range(2))
    time = found.time

    assert found == again
    assert time.low < time.value < time.high
    assert (time.low, time.high) == (
        pytest.approx(1e-3 * 1e-5**-0.25, rel=0.06),
        pytest.approx(1.5 * 1e-3 * 1e-5**-0.25, rel=0.06),
    )
    assert time.samples == 6


@pytest.mark.parametrize("n", [40, pytest.param(120, marks=pytest.mark.slow)])
def test_intervals_of_medians_have_nearly_nominal_coverage(n):
    """Times are lognormal with 10 % scatter; such bootstrap intervals are too short."""
    rng, held = np.random.default_rng(161803), 0
    for trial in range(n):
        records = [
            r.replace(
                total_seconds=1e-3 * r.tol**-0.25 * np.exp(0.1 * rng.standard_normal()),
                run_id=f"{trial}-{i}",
            )
            for i, r in enumerate(sweep(repeats=9))
        ]
        time = time_at_accuracy(outcomes(records), 1e-5).time
        held += time.low <= 1e-3 * 1e-5**-0.25 <= time.high
    assert 0.85 <= held / n <= 1


def test_the_table_names_the_fastest_at_each_error(page):
    records = [*sweep(), *sweep("b", lambda tol: 5e-3 * tol**-0.05)]
    found, *_ = tables(page(records), "accuracy")

    assert [row["error"].value for row in found] == [1e-2, 1e-4, 1e-6]
    assert [row["a"].kind for row in found] == ["best", "", ""]
    assert [row["b"].kind for row in found] == ["", "best", "best"]


def test_rows_with_upper_bounds_have_no_fastest_solver(page):
    """A time with only an upper bound may be smaller than any other time."""
    direct, other = (sweep(s, repeats=6, energy_bound=1e-12) for s in ("c", "d"))
    bounds, *_ = tables(page([*direct, *other]), "accuracy")
    mixed, *_ = tables(page([*sweep(repeats=6), *direct]), "accuracy")

    assert {row[s].kind for row in bounds for s in "cd"} == {""}
    assert {row[s].kind for row in mixed for s in "ac"} == {""}


def test_intervals_that_overlap_are_marked_at_matched_errors(page):
    """With 5 % scatter, a difference of 2 % is not resolved, and 20 % is resolved."""
    records = [
        r
        for name, factor in (("a", 1.0), ("b", 1.02), ("c", 1.2))
        for r in sweep(name, lambda tol, f=factor: f * tol**-0.25, repeats=6)
    ]
    found, *_ = tables(page(records), "accuracy")

    assert [found[1][s].kind for s in "abc"] == ["best", "tied", ""]
    assert [found[1][s].symbol for s in "abc"] == ["", "≈", ""]


def test_a_null_arm_does_not_compete_at_matched_errors(page):
    null = sweep("a null", lambda tol: 0.5e-3 * tol**-0.25, repeats=6, arm="null")
    found, *_ = tables(page([*sweep(repeats=6), *null]), "accuracy")

    assert {row["a"].kind for row in found} == {"best"}
    assert {row["a null"].kind for row in found} == {""}


def test_the_table_states_why_there_is_no_time(page):
    direct = sweep("direct", repeats=2, energy_bound=1e-12)
    weak = [r for r in sweep("weak") if r.tol > 1e-5]
    none = dict(claimed="declined", energy_bound=None, total_seconds=None)
    refusing = [record("c", tol, status=Verdict.DECLINED, **none) for tol in TOLS]
    found, *_ = tables(page([*sweep(), *direct, *weak, *refusing]), "accuracy")
    last = found[-1]

    assert last["direct"].text.startswith("≤ ")
    assert last["direct"].after == "more accurate at the loosest tolerance"
    assert last["weak"].text == "not reached"
    assert last["weak"].after == "smallest error 1.0e-4"
    assert last["c"].text == "declined"


def test_no_matched_time_is_printed_without_its_uncertainty(page):
    text = markdown(page(sweep()))
    start = text.index("## Time to accuracy")
    section = text[start : text.index("\n## ", start + 4)]
    times = re.findall(r"\d (?:s|ms|µs)\b(.{3})", section)

    assert len(times) == 3
    assert all(re.match(r" \\\[", after) for after in times)


def test_cases_without_certificates_keep_their_residuals(page):
    bare = sweep(case="file/dual", family="file", energy_bound=None, accuracy=1e-6)
    both = page([*sweep(accuracy=1e-6), *bare])
    (section,) = (s for s in both.sections if s.name == "accuracy")

    assert [p.name for p in section.pictures] == ["certified", "sweep"]
    assert len(section.pictures[1].figure.panels) == 1
    assert len(section.tables) == 2


def test_two_tolerances_are_not_a_sweep(page):
    few = [r for r in sweep() if r.tol > 1e-5]
    assert not any(s.name == "accuracy" for s in page(few).sections)


def test_the_curve_joins_certified_points_and_others_are_hollow():
    records = [
        r.replace(claimed="iteration_limit", status=Verdict.ITERATION_LIMIT)
        if r.tol == 1e-8 else r
        for r in sweep()
    ]  # fmt: skip
    evidence = Evidence(directory=Path(), records=arrange(records))
    picture = certified_picture(certified_sweeps(evidence), ("a",))
    (panel,) = picture.figure.panels
    joined, hollow = panel.marks

    assert joined.y == (1e-2, 1e-4, 1e-6)
    assert joined.look.dash is not None
    assert hollow.y == (1e-8,)
    assert (hollow.look.dash, hollow.look.fill) == (None, "none")
