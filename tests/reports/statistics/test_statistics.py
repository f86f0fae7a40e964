"""Means, ranks and shares over cases, compared with independently known values."""

from math import comb

import numpy as np
import pytest

from mortarbench.reports.data.aggregation import (
    EVERY,
    USUAL,
    Convention,
    common_cases,
    geometric_means,
    panel,
    rank_of,
    ranking_of,
)
from mortarbench.reports.data.comparison_groups import ComparisonGroup, GroupKey
from mortarbench.reports.statistics.censoring import restricted_mean
from mortarbench.reports.statistics.growth import Trend, growth_of
from mortarbench.reports.statistics.profiles import (
    curve,
    performance_ratios,
    share,
    solved_within,
)
from mortarbench.reports.statistics.resampling import (
    firsts,
    limits,
    significantly_faster,
    symmetric_interval,
    weights,
)

INF = np.inf


def group(times, *, claimed=None, limit=60.0, solvers=None):
    times = np.asarray(times, dtype=float)
    cases, count = times.shape
    return ComparisonGroup(
        key=GroupKey(sweep=False, mode="cold", form="dual", at=1e-6),
        cases=tuple(f"case {i}" for i in range(cases)),
        solvers=tuple(solvers or (f"s{i}" for i in range(count))),
        times=times,
        claimed=times if claimed is None else np.asarray(claimed, dtype=float),
        stopped=np.full_like(times, np.nan),
        limit=limit,
    )


def lognormal(rng, shape, scatter=1.0):
    return 0.01 * rng.lognormal(0, scatter, shape)


# ---- means


def test_the_shifted_geometric_mean_by_hand():
    found = group([[1, 1], [3, 1], [7, 1]])
    assert found.shift == 1.0  # the median of the best times
    assert geometric_means(found, USUAL) == pytest.approx([3, 1])  # ∛(2·4·8) − 1


def test_a_convention_changes_the_shift_by_a_factor():
    found = geometric_means(group([[1, 1], [3, 1], [7, 1]]), Convention(shift=10.0))
    assert found == pytest.approx([(11 * 13 * 17) ** (1 / 3) - 10, 1])


def test_a_failure_is_charged_multiples_of_the_limit():
    found = group([[1, 1], [1, 1], [INF, 1]], limit=5)
    assert geometric_means(found, Convention(penalty=3.0))[0] == pytest.approx(3)
    one = geometric_means(found, Convention(penalty=1.0))[0]
    assert one == pytest.approx((2 * 2 * 6) ** (1 / 3) - 1)


def test_the_shift_follows_the_time_scale_up_to_ten_seconds():
    rng = np.random.default_rng(11)
    times = lognormal(rng, (9, 3))
    assert group(1e-3 * times).shift == pytest.approx(1e-3 * group(times).shift)
    assert group(1e6 * times).shift == 10.0


def test_milliseconds_are_not_averaged_arithmetically():
    times = lognormal(np.random.default_rng(12), (500, 2), scatter=2.0)
    mean = geometric_means(group(times), USUAL)
    arithmetic, geometric = times.mean(axis=0), np.exp(np.log(times).mean(axis=0))
    assert (mean < 0.4 * arithmetic).all()
    assert (mean > geometric).all()


def test_common_cases_leave_out_solvers_that_solve_little():
    times = np.ones((8, 3))
    times[0, 1] = times[1, 0] = INF
    times[2:, 2] = INF  # solves two of eight
    rows, columns = common_cases(group(times))
    assert list(columns) == [True, True, False]
    assert list(np.flatnonzero(~rows)) == [0, 1]
    found = geometric_means(group(times), Convention(common=True))
    assert found[:2] == pytest.approx([1, 1])
    assert np.isnan(found[2])


@pytest.mark.parametrize("factor", [1e-3, 250.0])
def test_ranks_do_not_depend_on_the_unit_of_time(factor):
    rng = np.random.default_rng(13)
    times = lognormal(rng, (15, 6))
    times[rng.random(times.shape) < 0.15] = INF
    one, other = group(times), group(factor * times, limit=60 * factor)
    assert other.shift < 10
    a, b = panel(one), panel(other)
    assert (a.usual == b.usual).all()
    for name, changed in a.single.items():
        np.testing.assert_array_equal(changed.ranking, b.single[name].ranking)
    np.testing.assert_allclose(ranking_of(one).ratios, ranking_of(other).ratios)
    assert (ranking_of(one).tiers == ranking_of(other).tiers).all()


def test_the_order_of_the_solvers_does_not_matter():
    times = lognormal(np.random.default_rng(14), (12, 5))
    turned = group(times[:, ::-1])
    assert (panel(group(times)).usual[::-1] == panel(turned).usual).all()
    assert (
        ranking_of(group(times)).faster[::-1, ::-1] == ranking_of(turned).faster
    ).all()


# ---- intervals


@pytest.mark.parametrize("cases", [5, 10, 40])
def test_intervals_of_a_mean_have_nominal_coverage(cases):
    rng = np.random.default_rng(15)
    drawn = weights([str(i) for i in range(cases)])
    low, high = limits(drawn @ rng.normal(3, 1, (cases, 3000)), cases)
    assert np.mean((low <= 3) & (high >= 3)) == pytest.approx(0.95, abs=0.025)


@pytest.mark.parametrize("count", [60, pytest.param(300, marks=pytest.mark.slow)])
def test_a_planted_ratio_is_inside_its_interval_at_the_nominal_rate(count):
    """For times far above the shift, the ratio of means equals the ratio of medians."""
    rng = np.random.default_rng(16)
    hits = []
    for _ in range(count):
        times = rng.lognormal(0, 1, (25, 1)) * rng.lognormal(0, 0.5, (25, 2))
        anchor = np.full((25, 1), 1e-9)  # the leader, which makes the shift small
        found = ranking_of(group(np.hstack([anchor, times * [1, 1.5]])))
        draws = found.draws[:, 2] / found.draws[:, 1]
        low, high = limits(draws, 25)
        hits.append(low <= 1.5 <= high)
    within = 0.035 * (300 / count) ** 0.5  # > 2.5 σ
    assert np.mean(hits) == pytest.approx(0.95, abs=within)


def test_a_constant_ratio_has_no_uncertainty():
    found = ranking_of(group(np.full((6, 2), 2.0) * [1, 3]))
    assert [float(part[1]) for part in found.ratios] == pytest.approx([3, 3, 3])
    assert found.faster.tolist() == [[False, True], [False, False]]
    assert found.tiers.tolist() == [1, 2]
    assert found.first.tolist() == [1, 0]


def test_equal_cases_give_equal_draws():
    names = ["a", "b", "c", "d", "e"]
    assert (weights(names) == weights(names)).all()
    assert not (weights(names) == weights(names[::-1])).all()
    assert weights(names).sum(axis=1) == pytest.approx(1)


# ---- ties


@pytest.mark.parametrize(
    ("cases", "solvers", "failing"),
    [
        (6, 3, 0.0),
        (6, 3, 0.1),
        (30, 8, 0.1),
        pytest.param(30, 8, 0.0, marks=pytest.mark.slow),
        pytest.param(12, 20, 0.0, marks=pytest.mark.slow),
        pytest.param(12, 20, 0.1, marks=pytest.mark.slow),
    ],
)
def test_equal_solvers_differ_significantly_in_at_most_five_percent(
    cases, solvers, failing
):
    rng = np.random.default_rng(17)
    names = [str(i) for i in range(cases)]
    found = 0
    for _ in range(250):
        logs = rng.normal(0, 1, (cases, 1)) + rng.exponential(0.5, (cases, solvers))
        logs[rng.random(logs.shape) < failing] = 9.0
        found += significantly_faster(logs, names).any()
    assert found / 250 <= 0.05 + 3 * (0.05 * 0.95 / 250) ** 0.5


def test_significance_needs_six_cases():
    logs = np.log([[1.0, 100.0]] * 6)
    assert not significantly_faster(logs[:5], list("abcde")).any()
    assert significantly_faster(logs, list("abcdef")).tolist() == [
        [False, True],
        [False, False],
    ]


def test_two_failures_do_not_hide_a_consistently_slower_solver():
    rng = np.random.default_rng(27)
    logs = rng.normal(0, 1, (12, 1)) + rng.normal(0, 0.3, (12, 8))
    logs[:, 3] += 1.5
    logs[:2, 3] = 16
    faster = significantly_faster(logs, [str(i) for i in range(12)])
    assert np.delete(faster[:, 3], 3).all()
    assert faster.sum() == 7


def test_two_failures_do_not_make_a_faster_solver_slower():
    """The mean is larger, but the solver is faster on 18 of 20 cases."""
    rng = np.random.default_rng(28)
    logs = rng.normal(0, 0.2, (20, 2))
    logs[:, 1] -= 0.7
    logs[:2, 1] = 9
    assert logs[:, 1].mean() > logs[:, 0].mean()
    assert not significantly_faster(logs, [str(i) for i in range(20)]).any()


def test_equal_solvers_share_one_tier_and_every_rank():
    times = lognormal(np.random.default_rng(18), (30, 1)) * np.ones((1, 4))
    found = ranking_of(group(times))
    assert found.tiers.tolist() == [1, 1, 1, 1]
    assert found.spans == [(1, 4)] * 4
    assert found.first == pytest.approx([0.25] * 4)
    assert panel(found.group).usual.tolist() == [1, 1, 1, 1]
    assert not panel(found.group).turned.any()


def test_a_faster_pair_forms_a_separate_tier():
    rng = np.random.default_rng(19)
    times = rng.lognormal(0, 2, (40, 1)) * rng.lognormal(0, 0.1, (40, 4))
    found = ranking_of(group(times * [1, 1, 3, 3]))
    assert found.tiers.tolist() == [1, 1, 2, 2]
    assert found.spans == [(1, 2), (1, 2), (3, 4), (3, 4)]
    assert found.first[2:].tolist() == [0, 0]


def test_shares_of_firsts_add_up_and_ties_share_one():
    logs = np.array([[0.0, 0.0, 1.0], [2.0, 1.0, 3.0]])
    assert firsts(logs).tolist() == [0.25, 0.75, 0]


def test_solvers_that_solve_nothing_tie_at_the_end():
    times = np.ones((6, 4)) * [1, 2, INF, INF]
    assert panel(group(times)).usual.tolist() == [1, 2, 3, 3]
    assert ranking_of(group(times)).tiers[2] == ranking_of(group(times)).tiers[3]


# ---- conventions


def test_there_is_a_convention_for_each_shift_penalty_and_gate():
    assert len(set(EVERY)) == 18
    assert USUAL in EVERY


def test_a_solver_with_false_claims_is_first_only_if_claims_count():
    honest = np.full(8, 1.0)
    times = np.column_stack([honest, np.full(8, INF)])
    claimed = np.column_stack([honest, np.full(8, 0.01)])
    found = panel(group(times, claimed=claimed))
    assert found.usual.tolist() == [1, 2]
    assert found.single["claimed"].ranking.tolist() == [2, 1]
    assert found.single["claimed"].turned.any()
    assert not found.single["10 limits"].turned.any()


def test_a_penalty_that_reverses_two_solvers_is_found():
    """One solver fails once and is otherwise fast; the penalty decides its rank."""
    fast = np.full(5, 1.0)
    fast[0] = INF
    steady = np.full(5, 4.0)
    found = panel(group(np.column_stack([fast, steady]), limit=60))
    assert found.single["1 limit"].ranking.tolist() == [1, 2]
    assert found.single["10 limits"].ranking.tolist() == [2, 1]
    assert found.turned[0, 1]
    assert found.turned[1, 0]


def test_ranks_are_nan_for_solvers_that_are_not_compared():
    np.testing.assert_array_equal(rank_of(np.array([2.0, np.nan, 1.0])), [2, np.nan, 1])


# ---- profiles

BY_HAND = np.array([[1, 2], [4, 2], [INF, 3], [INF, INF]])


def test_a_performance_profile_by_hand():
    ratios = performance_ratios(BY_HAND)
    assert ratios.tolist() == [[1, 2], [2, 1], [INF, 1], [INF, INF]]
    assert solved_within(ratios[:, 0], [1, 1.9, 2, 1e9]).value.tolist() == [
        0.25, 0.25, 0.5, 0.5,
    ]  # fmt: skip
    assert solved_within(ratios[:, 1], [1, 2]).value.tolist() == [0.5, 0.75]


def test_a_data_profile_by_hand():
    found = curve(BY_HAND[:, 0], 0.5, 60)
    assert found.at.tolist() == [0.5, 1, 4, 60]
    assert found.share.value.tolist() == [0, 0.25, 0.5, 0.5]


def test_a_failure_never_counts_as_solved():
    """With a finite charge of 1000 s, a failure would count from τ = 1000/0.1 on."""
    times = np.array([[0.1, INF]] * 4 + [[0.1, 0.1]])
    ratios = performance_ratios(times)
    anywhere = np.concatenate([np.geomspace(1, 1e300, 50), [np.finfo(float).max]])
    assert (solved_within(ratios[:, 1], anywhere).value == 0.2).all()
    assert curve(ratios[:, 1], 1, 1e300).share.value.max() == 0.2


def test_profiles_of_many_cases_are_sampled_exactly():
    values = np.random.default_rng(20).lognormal(3, 1, 5000)
    thin = curve(values, values.min(), values.max())
    assert thin.at.size == 200
    exact = [(values <= at).mean() for at in thin.at]
    assert thin.share.value == pytest.approx(exact)


def test_a_further_solver_may_swap_two_profiles():
    """This effect (Gould and Scott) is the reason for profiles of two solvers."""
    a, b, third = [1, 1, 9, 9, 9], [3, 3, 3, 3, 3], [9, 9, 2, 2, 2]
    two = performance_ratios(np.column_stack([a, b]))
    three = performance_ratios(np.column_stack([a, b, third]))
    best = [(ratios == 1).mean(axis=0)[:2].tolist() for ratios in (two, three)]
    assert best == [[0.4, 0.6], [0.4, 0.0]]


@pytest.mark.parametrize("cases", [5, 23])
def test_bands_of_shares_have_at_least_nominal_coverage(cases):
    counts = np.arange(cases + 1)
    found = share(counts, cases)
    for p in (0.01, 0.2, 0.5, 0.83, 0.99):
        held = (found.low <= p) & (p <= found.high)
        rate = [comb(cases, k) * p**k * (1 - p) ** (cases - k) for k in counts]
        assert np.array(rate)[held].sum() >= 0.95


def test_the_interval_of_a_full_share_has_positive_width():
    found = share([0, 12], 12)
    assert found.high[0] == pytest.approx(1 - 0.025 ** (1 / 12))
    assert found.low[1] == pytest.approx(0.025 ** (1 / 12))
    assert (found.low[0], found.high[1]) == (0, 1)


# ---- time limits


def test_the_restricted_mean_by_hand():
    """The survival function is 3/4 from 1 to 3, 3/8 from 3 to 4, and 0 afterwards.

    At time 3, two cases are at risk.
    """
    nan = np.nan
    found = restricted_mean(
        np.array([1, INF, 3, 4.0]), np.array([nan, 2, nan, nan]), 5.0
    )
    assert found.mean.value == pytest.approx(1 + 2 * 3 / 4 + 3 / 8)
    assert (found.solved, found.stopped, found.never) == (3, 1, 0)


def test_without_early_censoring_times_are_truncated_at_the_limit():
    times = np.random.default_rng(21).exponential(2, 30)
    late = times > 4
    stopped = np.where(late, 4.0, np.nan)
    found = restricted_mean(np.where(late, INF, times), stopped, 4.0)
    cut = np.minimum(times, 4)
    half = 2.045 * cut.std(ddof=1) / np.sqrt(30)  # Student, 29 degrees of freedom
    assert found.mean.value == pytest.approx(cut.mean())
    assert found.mean.high - found.mean.value == pytest.approx(half, rel=1e-3)
    assert late.sum() == found.stopped > 0


def test_refuted_answers_count_as_unsolved_and_late_ones_as_censored():
    times, nan = np.array([1, 1, 1, INF, 5.0]), np.nan
    refuted = restricted_mean(times, np.full(5, nan), 10.0).mean.value
    late = restricted_mean(times, np.array([nan, nan, nan, 2, nan]), 10.0).mean.value
    assert refuted == pytest.approx((1 + 1 + 1 + 10 + 5) / 5)
    assert late == pytest.approx(
        1 + 4 * 2 / 5
    )  # the last case gets the weight of late times


def test_the_restricted_mean_covers_the_truth_under_early_censoring():
    rng = np.random.default_rng(22)
    truth, hits = 1 - np.exp(-2), []
    for _ in range(600):
        times, ends = rng.exponential(1, 40), rng.uniform(0.5, 4, 40)
        late = times > ends
        found = restricted_mean(
            np.where(late, INF, times), np.where(late, ends, np.nan), 2.0
        )
        hits.append(found.mean.low <= truth <= found.mean.high)
    assert np.mean(hits) == pytest.approx(0.95, abs=0.03)


@pytest.mark.parametrize("cases", [6, 9, 30])
def test_the_sign_flip_interval_covers_for_heavy_tails(cases):
    rng = np.random.default_rng(29)
    names = [str(i) for i in range(cases)]
    drawn = 3 + rng.standard_cauchy((400, cases))
    ends = [symmetric_interval(values, names) for values in drawn]
    assert np.mean([low <= 3 <= high for low, high in ends]) > 0.93  # 95 % − 2 σ


def test_six_values_have_the_interval_from_the_least_to_the_largest():
    """All signs agree in 2 of 64 patterns (3 %), at least five signs in over 5 %."""
    names = [str(i) for i in range(6)]
    values = np.array([0.3, -0.01, 5.0, 1.0, 2.0, 4.0])
    assert symmetric_interval(values, names) == (-0.01, 5.0)
    assert symmetric_interval(np.full(6, 0.7), names) == pytest.approx((0.7, 0.7))


# ---- growth


def test_growth_at_the_practical_limit_is_rarely_detected():
    """For p at a limit, 2.5 % of the 95 % intervals lie entirely beyond this limit."""
    rng = np.random.default_rng(23)
    n = np.geomspace(100, 1e5, 6)
    for limit, called in ((1.1, Trend.GROWS), (0.9, Trend.FALLS)):
        v = 30 * n ** np.log10(limit)
        found = [growth_of(n, v * rng.lognormal(0, 0.1, 6)).trend for _ in range(2000)]
        assert np.mean([t is called for t in found]) == pytest.approx(0.025, abs=0.0105)
        assert not any(t in {Trend.GROWS, Trend.FALLS} - {called} for t in found)


@pytest.mark.parametrize(
    ("counts", "trend"),
    [
        (
            [19, 22, 22, 22, 22],
            Trend.UNDECIDED,
        ),  # the smallest size is a little cheaper
        ([19, 22, 22, 22, 22, 22, 22, 22, 22, 22], Trend.FLAT),
        ([22, 22, 22, 22, 22], Trend.FLAT),
        ([1000, 1010, 1020, 1030, 1040], Trend.FLAT),  # significant growth of only 2 %
        ([20, 24, 29, 35, 42], Trend.GROWS),
        ([42, 35, 29, 24, 20], Trend.FALLS),
        ([20, 40, 20, 40, 20], Trend.UNDECIDED),
    ],
)
def test_growth_is_judged_by_its_size_per_decade_and_its_interval(counts, trend):
    sizes = 1000 * 4.0 ** np.arange(len(counts))
    assert growth_of(sizes, counts).trend is trend


def test_planted_growth_is_detected_and_bounded():
    n = np.array([100, 400, 1600, 6400])
    found = growth_of(n, 5 * n**0.25)
    assert found.trend is Trend.GROWS
    assert (found.low, found.exponent, found.high) == pytest.approx((0.25, 0.25, 0.25))
    assert found.per_decade == pytest.approx((10**0.25 - 1,) * 3)


def test_the_interval_of_growth_is_students_of_two_degrees_of_freedom():
    """log n = −3, −1, 1, 3, and log v deviates by ±s from a line of slope ½."""
    n, s = np.exp([-3.0, -1.0, 1.0, 3.0]), 0.1
    found = growth_of(n, np.sqrt(n) * np.exp([s, -s, -s, s]))

    error = np.sqrt(4 * s**2 / 2 / 20)
    assert found.exponent == pytest.approx(0.5)
    assert found.high == pytest.approx(
        0.5 + 4.302652730 * error
    )  # 97.5 % quantile of t
    assert found.low == pytest.approx(0.5 - 4.302652730 * error)
    assert found.scatter == pytest.approx(np.sqrt(2) * s)


def test_constant_counts_are_flat():
    found = growth_of([100, 400, 1600, 6400], [13, 13, 13, 13])
    assert (found.low, found.exponent, found.high) == (0, 0, 0)
    assert found.at(1000) == (pytest.approx(13),) * 3 + (0.95, 4)


def test_falling_counts_do_not_grow():
    found = growth_of([100, 400, 1600, 6400], [40, 30, 25, 20])
    assert found.trend is Trend.FALLS
    assert found.low < found.exponent < found.high < 0


def test_three_sizes_are_refused():
    with pytest.raises(ValueError, match="four different sizes"):
        growth_of([1, 2, 3, 3], [1, 2, 3, 3])


@pytest.mark.parametrize("values", [[0, 1, 2, 3], [1, 2, 3, -1]])
def test_growth_is_that_of_positive_values(values):
    with pytest.raises(ValueError, match="positive values"):
        growth_of([1, 2, 3, 4], values)
    with pytest.raises(ValueError, match="positive values"):
        growth_of(values, [1, 2, 3, 4])


def test_nothing_is_predicted_beyond_the_measured_sizes():
    n = np.array([100, 400, 1600, 6400])
    found = growth_of(n, 2e-6 * n**1.5)
    assert found.at(800).value == pytest.approx(2e-6 * 800**1.5)
    for outside in (99, 6401):
        with pytest.raises(ValueError, match="outside the measured range"):
            found.at(outside)


def test_predictions_equal_the_textbook_formula():
    """The half-width of log v at x is t σ̂ √(1 + xᵀ(XᵀX)⁻¹x).

    x and the rows of X are (1, log n); see Draper and Smith, Applied Regression
    Analysis, §3.1.
    """
    n, v = np.array([100, 200, 800, 1600.0]), np.array([3, 4, 4, 7.0])
    X = np.column_stack([np.ones(4), np.log(n)])
    (c, p), (rss,), _, _ = np.linalg.lstsq(X, np.log(v), rcond=None)
    x = np.array([1, np.log(1000)])
    half = 4.302652730 * np.sqrt(rss / 2 * (1 + x @ np.linalg.inv(X.T @ X) @ x))

    found = growth_of(n, v).at(1000)

    ends = np.log([found.low, found.value, found.high])
    assert ends == pytest.approx(c + p * x[1] + half * np.array([-1, 0, 1]))


def test_prediction_intervals_of_a_further_measurement_have_nominal_coverage():
    rng = np.random.default_rng(24)
    n = np.geomspace(100, 1e5, 5)
    hits = []
    for _ in range(1500):
        noise = rng.lognormal(0, 0.2, 6)
        found = growth_of(n, 1e-6 * n**1.2 * noise[:5]).at(1e4)
        hits.append(found.low <= 1e-6 * 1e4**1.2 * noise[5] <= found.high)
    assert np.mean(hits) == pytest.approx(0.95, abs=0.017)
