"""Cost model of a solve on ranks, fitted to times with known parameters."""

from dataclasses import replace

import numpy as np
import pytest

from mortarbench.reports.statistics.cost_model import Communication, cost_model, growth

SENT = Communication(
    ranks=2, reductions=300, messages=120, sent=4e6,
    reduction_seconds=5e-6, message_seconds=2e-6, seconds_per_byte=5e-10,
)  # fmt: skip


def sent_on(N):
    """Return the communication on N ranks, with a deeper tree and more neighbours."""
    depth, neighbours = int(np.ceil(np.log2(N))), min(N - 1, 6)
    return replace(
        SENT, ranks=N, reduction_seconds=5e-6 * depth, messages=120 * neighbours
    )


def modelled(N, work=2.0, repeated=0.1, slowdown=1.0, sent=SENT):
    """Evaluate the formula of the model directly."""
    depth, neighbours = int(np.ceil(np.log2(N))), min(N - 1, 6)
    waits = 300 * 5e-6 * depth + 120 * 2e-6 * neighbours + (N > 1) * 4e6 / 2e9
    return (slowdown if N > 1 else 1.0) * (work / N + repeated) + waits


@pytest.mark.parametrize("ranks", [(1, 2), (1, 2, 4), (1, 2, 3, 5, 8)])
def test_known_work_is_recovered_and_predicted_beyond(ranks):
    found = cost_model({N: [modelled(N)] * 3 for N in ranks}, {}, [sent_on(ranks[-1])])
    assert found.work == pytest.approx(2.0)
    assert found.repeated == pytest.approx(0.1)
    assert found.misfit < 1e-12
    assert found.speed_up(64).value == pytest.approx(2.1 / modelled(64))


def test_copies_reveal_the_slowdown_of_ranks():
    times = {N: [modelled(N, slowdown=1.25)] * 3 for N in (1, 2, 4)}
    copies = {N: [1.25 * 2.1] * 3 for N in (2, 4)}
    found = cost_model(times, copies, [sent_on(4)])
    assert (found.work, found.repeated) == pytest.approx((2.0, 0.1))
    assert found.slowdown == pytest.approx(1.25)
    assert found.speed_up(16).value == pytest.approx(2.1 / modelled(16, slowdown=1.25))


@pytest.mark.parametrize("copies", [1.3, 1.6, 4.0])
def test_the_slowdown_of_copies_is_limited_by_nonnegative_c(copies):
    """The ranks have a slowdown of 1.25 and C = 0, so that C ≥ 0 implies s ≤ 1.25."""
    times = {N: [modelled(N, repeated=0.0, slowdown=1.25)] * 3 for N in (1, 2)}
    found = cost_model(times, {2: [copies * 2.0] * 3}, [SENT])
    assert (found.slowdown, found.work) == pytest.approx((1.25, 2.0))
    assert found.repeated == pytest.approx(0.0, abs=1e-12)
    assert found.misfit < 1e-12


def test_communication_time_is_count_times_unit_cost():
    assert SENT.seconds == pytest.approx([300 * 5e-6, 120 * 2e-6, 4e6 / 2e9])
    assert (growth(1, 2) == 0).all()
    assert (growth(2, 2) == 1).all()
    # a tree of depth six, six neighbours instead of one, and equally many bytes
    assert growth(64, 2) == pytest.approx([6, 6, 1])


def test_a_network_whose_speed_is_not_known_widens_the_band():
    slow = replace(SENT, reduction_seconds=5e-3)
    times = {N: [modelled(N)] * 4 for N in (1, 2)}
    at = cost_model(times, {}, [SENT, slow, SENT, slow]).speed_up(16)
    assert at.high > 1.2 * at.low


def test_communication_on_other_numbers_of_ranks_is_refused():
    with pytest.raises(ValueError, match="the communication on 4 ranks"):
        cost_model({N: [modelled(N)] for N in (1, 2, 4)}, {}, [SENT])


def test_superlinear_speed_up_gives_no_negative_work():
    faster = cost_model({1: [1.0] * 2, 2: [0.3] * 2}, {}, [SENT])  # super-linear
    assert faster.repeated == 0
    assert faster.misfit > 0.2  # too large for predictions
    slower = cost_model({1: [1.0] * 2, 2: [3.0] * 2}, {}, [SENT])
    assert slower.work == 0
    assert slower.speed_up(16).value < 1


@pytest.mark.parametrize(
    ("runs", "least"), [(10, 8), pytest.param(40, 34, marks=pytest.mark.slow)]
)
def test_the_band_contains_the_true_speed_up(runs, least):
    rng = np.random.default_rng(3)
    held = 0
    for _ in range(runs):
        times = {N: modelled(N) * rng.lognormal(0, 0.02, 5) for N in (1, 2, 4)}
        at = cost_model(times, {}, [sent_on(4)]).speed_up(16)
        assert at.low <= at.value <= at.high
        held += at.low <= 2.1 / modelled(16) <= at.high
    assert held >= least  # 95 % of 10 and of 40 are 9.5 and 38


def test_single_runs_have_no_band():
    found = cost_model({1: [2.0], 2: [1.2]}, {}, [SENT]).speed_up(8)
    assert found.low == found.value == found.high
    assert found.samples == 1


def test_the_largest_number_of_ranks_at_half_efficiency():
    free = Communication(
        ranks=2, reductions=0, messages=0, sent=0, reduction_seconds=1e-6,
        message_seconds=1e-6, seconds_per_byte=1e-9,
    )  # fmt: skip
    found = cost_model({1: [1.1] * 2, 2: [0.6] * 2}, {}, [free])  # W = 1, C = 0.1
    # 1.1/(1/N + 0.1) ≥ N/2 up to N = 12; the largest power of two is 8
    assert found.ranks_at(0.5) == 8


@pytest.mark.parametrize("ranks", [(1,), (2, 4), ()])
def test_a_model_needs_times_on_one_and_several_ranks(ranks):
    with pytest.raises(ValueError, match="one rank and on several"):
        cost_model({N: [1.0] for N in ranks}, {}, [SENT])
