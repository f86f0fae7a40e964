"""Strong and weak scaling, from records with manufactured times."""

from pathlib import Path

import pytest

from mortarbench.harness import Verdict
from mortarbench.reports.data.evidence import Evidence, arrange
from mortarbench.reports.data.rank_series import (
    rank_memory,
    strong_series,
    weak_series,
)
from mortarbench.reports.folder import compose
from mortarbench.reports.sections import Analysis
from mortarbench.reports.sections.ranks import ranks
from tests.support.manufactured_ranks import (
    SLOWDOWN,
    rank_records,
    solve_seconds,
)

DOFS = 100_000


def evidence(records, cpus=None):
    machine = {"machine": {"usable_cores": cpus}} if cpus else {}
    return Evidence(
        directory=Path(), records=arrange(list(records)), environment=machine
    )


@pytest.fixture(scope="module")
def manufactured():
    return evidence(rank_records(), cpus=4)


@pytest.fixture(scope="module")
def strong(manufactured):
    (found,) = (s for s in strong_series(manufactured) if s.case.endswith("S=100/dual"))
    return found


@pytest.mark.parametrize("n", [2, 4])
def test_speed_up_is_the_ratio_of_times_on_one_and_several_ranks(strong, n):
    true = solve_seconds(DOFS, 1) / solve_seconds(DOFS, n)
    assert strong.speed_up(n, "solve").value == pytest.approx(true)
    assert strong.efficiency(n, "solve").value == pytest.approx(true / n)
    assert strong.speed_up(n, "prepare").value == pytest.approx(n / SLOWDOWN)


def test_intervals_of_scattered_times_contain_the_true_speed_up(strong):
    at = strong.speed_up(2, "solve")
    assert at.low == pytest.approx(at.high)
    noisy = evidence(rank_records(sizes=[DOFS], repeats=8, scatter=0.03))
    (series,) = strong_series(noisy)
    at = series.speed_up(4, "solve")
    assert at.low < solve_seconds(DOFS, 1) / solve_seconds(DOFS, 4) < at.high


def test_the_interval_of_a_single_run_has_zero_width():
    (series,) = strong_series(evidence(rank_records(sizes=[DOFS], repeats=1)))
    assert series.speed_up(2, "solve").samples == 1


def test_memory_that_is_not_a_number_is_unknown():
    words = {"rank_peak_mib_mean": "much", "rank_peak_mib_largest": "more"}
    records = [r.replace(reported=words) for r in rank_records(sizes=[DOFS])]
    (series,) = strong_series(evidence(records))
    assert rank_memory(series.answers[2]) is None


def test_weak_scaling_is_recognised_by_equal_dofs_per_rank(manufactured):
    found = {s.members[0].dofs: s for s in weak_series(manufactured)}
    assert [(m.ranks, m.dofs) for m in found[50_000].members] == [
        (1, 50_000), (2, 100_000), (4, 200_000),
    ]  # fmt: skip
    assert [(m.ranks, m.dofs) for m in found[100_000].members] == [
        (1, 100_000), (2, 200_000),
    ]  # fmt: skip
    last = found[50_000].members[-1]
    true = solve_seconds(50_000, 1) / solve_seconds(200_000, 4)
    assert found[50_000].efficiency(last, "solve").value == pytest.approx(true)


def test_cases_of_other_sizes_are_not_weak_scaling():
    found = weak_series(evidence(rank_records(sizes=[50_000, 120_000, 150_000])))
    assert found == []


def test_answers_that_were_not_verified_are_left_out():
    wrong = (
        r.replace(status=Verdict.WRONG) if r.ranks == 2 and not r.arm else r
        for r in rank_records(sizes=[DOFS])
    )
    (series,) = strong_series(evidence(wrong))
    assert tuple(series.answers) == (1, 4)


def test_the_section_shows_products_and_memory(strong, manufactured):
    assert rank_memory(strong.answers[2]) == 99.0
    assert rank_memory(strong.answers[1]) is None
    _, solve, *_ = ranks(Analysis(manufactured)).tables
    shown = [dict(zip(solve.columns, row, strict=True)) for row in solve.rows]
    assert {row["products"].text for row in shown} == {"24"}
    assert [row["peak, MiB"].value for row in shown[:3]] == [100.0, 200.0, 400.0]
    assert [row["peak of a rank, MiB"].text for row in shown[:3]] == ["–", "99", "99"]


def test_a_report_without_ranks_states_the_requirements(manufactured):
    alone = evidence(r for r in manufactured.records if r.ranks == 1)
    page = compose(alone)
    assert "ranks" not in [s.name for s in page.sections]
    (absent,) = (s for s in page.sections if s.name == "absent")
    assert any("ranks = [1, 2]" in point for point in absent.points)
    assert "ranks" in [s.name for s in compose(manufactured).sections]


def test_weak_scaling_alone_explains_grey_numbers():
    records = [
        r
        for r in rank_records(sizes=[DOFS // 4, DOFS], ranks=[1, 4])
        if not r.arm and (r.ranks == 4) is r.case.endswith("S=100/dual")
    ]
    alone = evidence(records, cpus=2)
    assert weak_series(alone)
    assert not strong_series(alone)
    said = " ".join(ranks(Analysis(alone)).prose)
    assert "Grey numbers are for more ranks" in said
