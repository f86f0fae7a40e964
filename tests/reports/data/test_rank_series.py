"""Strong and weak scaling and the cost model, from records with manufactured times."""

from pathlib import Path

import pytest

from mortarbench.harness import Verdict
from mortarbench.reports.data.evidence import Evidence, arrange
from mortarbench.reports.data.rank_series import (
    rank_counts,
    rank_memory,
    rank_parts,
    strong_series,
    weak_series,
)
from mortarbench.reports.data.size_series import size_series
from mortarbench.reports.document.figure import Area, Series
from mortarbench.reports.folder import compose
from mortarbench.reports.sections import Analysis
from mortarbench.reports.sections.ranks import predicted, ranks
from mortarbench.reports.statistics.cost_model import CostModel
from tests.support.manufactured_ranks import (
    ALIKE,
    BYTE,
    BYTES,
    MESSAGE,
    MESSAGES,
    REDUCTION,
    REDUCTIONS,
    SLOWDOWN,
    SPENT,
    WORK,
    copies_seconds,
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


@pytest.mark.parametrize("n", [2, 4])
def test_copies_show_the_slowdown_of_simultaneous_solves(strong, n):
    assert strong.reach(n, "solve").value == pytest.approx(n / SLOWDOWN)
    true = copies_seconds(DOFS) / (n * solve_seconds(DOFS, n))
    assert strong.against_copies(n, "solve").value == pytest.approx(true)
    # ranks share all work of the preparation and are as slow as copies
    assert strong.against_copies(n, "prepare").value == pytest.approx(1.0)


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
    assert series.model.speed_up(8).samples == 1


def test_the_model_recovers_known_work_latency_and_bandwidth(strong):
    model = strong.model
    assert model.work == pytest.approx(WORK * DOFS)
    assert model.repeated == pytest.approx(ALIKE)
    assert model.slowdown == pytest.approx(SLOWDOWN)
    on_four = 2 * REDUCTIONS * REDUCTION, 3 * MESSAGES * MESSAGE, BYTES * BYTE
    assert model.communication == pytest.approx(on_four)
    assert model.misfit < 1e-9
    assert model.speed_up(64).value == pytest.approx(
        solve_seconds(DOFS, 1) / solve_seconds(DOFS, 64)
    )


def test_the_model_ignores_ranks_that_shared_a_cpu():
    slow = [
        r.replace(solve_seconds=10 * r.solve_seconds) if r.ranks == 4 else r
        for r in rank_records(sizes=[DOFS])
    ]
    (series,) = strong_series(evidence(slow, cpus=2))
    assert series.crowded(4)
    assert series.model.measured == (1, 2)
    assert series.model.speed_up(64).value == pytest.approx(
        solve_seconds(DOFS, 1) / solve_seconds(DOFS, 64)
    )


def test_records_without_message_counts_have_no_model():
    silent = (r.replace(rank_counts={}) for r in rank_records(sizes=[DOFS]))
    (series,) = strong_series(evidence(silent))
    assert series.model is None


@pytest.mark.parametrize(
    "change",
    [
        {"rank_network": {"hops": (1.0, 1.0)}},
        {"rank_network": {"reduction_seconds": (1.0, 1.0)}},
        {"rank_counts": {"reductions": (1.0, 1.0)}},
        {"solve_seconds": None},
    ],
)
def test_records_with_invalid_entries_have_no_model(change):
    records = [r.replace(**change) for r in rank_records(sizes=[DOFS])]
    (series,) = strong_series(evidence(records))
    assert series.model is None
    assert ranks(Analysis(evidence(records))).name == "ranks"


def test_further_network_data_are_ignored():
    records = [
        r.replace(rank_network={**r.rank_network, "hops": (1.0, 1.0)})
        if r.ranks > 1
        else r
        for r in rank_records(sizes=[DOFS])
    ]
    (series,) = strong_series(evidence(records))
    assert series.model.work == pytest.approx(WORK * DOFS)


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
    of = found[50_000].against_copies(last, "solve")
    assert of.value == pytest.approx(copies_seconds(50_000) / solve_seconds(200_000, 4))


def test_cases_of_other_sizes_are_not_weak_scaling():
    found = weak_series(evidence(rank_records(sizes=[50_000, 120_000, 150_000])))
    assert found == []


def test_answers_that_were_not_verified_are_left_out():
    wrong = (
        r.replace(verdict=Verdict.WRONG) if r.ranks == 2 and not r.role else r
        for r in rank_records(sizes=[DOFS])
    )
    (series,) = strong_series(evidence(wrong))
    assert tuple(series.answers) == (1, 4)


def test_parts_are_medians_of_means_and_of_the_largest(strong):
    parts, whole = rank_parts(strong.answers[2]), solve_seconds(DOFS, 2)
    assert {k: p.mean / whole for k, p in parts.items()} == pytest.approx(SPENT)
    assert parts["coarse"].largest == pytest.approx(1.1 * parts["coarse"].mean)
    assert rank_counts(strong.answers[2])["bytes"].mean == BYTES
    assert rank_memory(strong.answers[2]) == (90.0, 99.0)
    assert rank_parts(strong.answers[1]) == {}
    assert rank_memory(strong.answers[1]) is None


def test_copies_do_not_appear_in_series_of_sizes(manufactured):
    (series,) = size_series(manufactured)
    assert not any("copies" in solver for solver in series.solvers)


def test_the_section_separates_model_and_measurements(
    manufactured,
):
    section = ranks(Analysis(manufactured))
    (model,) = (p for p in section.pictures if p.name == "ranks-model")
    assert model.caption.startswith(
        "Predicted speed-up of the solve on more ranks (dashed; not m"
    )
    for panel in model.figure.panels:
        assert any(t.text == "model, not measured" for t in panel.texts)
        (edge,) = panel.rules
        dashed = [m for m in panel.marks if isinstance(m, Area)]
        dashed += [m for m in panel.marks if isinstance(m, Series) and not m.runs
                     and m.solver]  # fmt: skip
        assert len(dashed) == 2
        assert all(min(m.x) == edge.at for m in dashed)
        (measured,) = (m for m in panel.marks if isinstance(m, Series) and m.runs)
        assert max(measured.x) == edge.at
    told = [t.caption for t in section.tables if "odel" in t.caption]
    assert len(told) == 2
    assert all("not measured" in caption for caption in told)


def test_a_model_with_a_large_misfit_makes_no_predictions():
    worse = (  # slower on two ranks than any time of the model
        r.replace(solve_seconds=9 * r.solve_seconds)
        if r.ranks == 2 and not r.role
        else r
        for r in rank_records(sizes=[DOFS], ranks=[1, 2])
    )
    (series,) = strong_series(evidence(worse))
    assert isinstance(series.model, CostModel)
    assert series.model.misfit > 0.2
    assert predicted(series) == ()


def test_no_more_ranks_than_subdomains_are_predicted(strong):
    assert predicted(strong) == (8, 16, 32, 64)


def test_a_report_without_ranks_states_the_requirements(manufactured):
    alone = evidence(r for r in manufactured.records if r.ranks == 1)
    page = compose(alone)
    assert "ranks" not in [s.name for s in page.sections]
    (absent,) = (s for s in page.sections if s.name == "absent")
    assert any("ranks = [1, 2]" in point for point in absent.points)
    assert "ranks" in [s.name for s in compose(manufactured).sections]


def test_weak_scaling_alone_explains_grey_numbers_and_needs_no_model():
    records = [
        r
        for r in rank_records(sizes=[DOFS // 4, DOFS], ranks=[1, 4])
        if not r.role and (r.ranks == 4) is r.case.endswith("S=100/dual")
    ]
    alone = evidence(records, cpus=2)
    assert weak_series(alone)
    assert not strong_series(alone)
    said = " ".join(ranks(Analysis(alone)).prose)
    assert "Grey numbers are for more ranks" in said
    assert "There is no cost model" not in said
