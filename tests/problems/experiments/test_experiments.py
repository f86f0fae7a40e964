"""Experiments that reproduce the paper: analyses, interleaved timing."""

import pytest

from mortarbench.problems.experiments.analysis import VARIANTS, analyse
from mortarbench.problems.experiments.clock import Rounds, Stopwatch, race, timed_as_one
from mortarbench.problems.families.beam_ring import BEAM
from mortarbench.problems.fem.elasticity import elasticity_matrix, stiffness
from mortarbench.problems.fem.inverse import CholeskyInverse
from mortarbench.problems.fem.mesh import half_ring
from mortarbench.problems.fem.triplets import stiffness_by_triplets
from mortarbench.solvers.smalbe.solver import SMALBE


def solve(qp):
    return SMALBE().prepare(qp, 1e-8)()


def test_both_methods_give_the_same_final_displacement():
    one, other = (
        analyse(
            2, 2, solve=lambda qp: SMALBE().prepare(qp, 1e-11)(), condense=c, steps=3
        )
        for c in VARIANTS.values()
    )

    assert one.solution.x == pytest.approx(other.solution.x, abs=1e-9)
    assert set(one.laps) == set(other.laps) == {
        "assembly", "factor", "contact", "dualisation", "qp", "recovery",
    }  # fmt: skip


@pytest.mark.parametrize(("way", "solves"), [("per-row", 3), ("condensed", 0)])
def test_only_the_papers_method_solves_for_all_rows_in_each_step(
    way, solves, monkeypatch
):
    calls, congruence = [], CholeskyInverse.congruence
    monkeypatch.setattr(
        CholeskyInverse, "congruence", lambda s, B: calls.append(B) or congruence(s, B)
    )
    done = analyse(1, 1, solve=solve, condense=VARIANTS[way], steps=3)

    assert len(calls) == solves
    assert all(B.shape[0] == done.dual.q.size for B in calls)


def test_an_analysis_solves_the_problem_of_its_last_step():
    """The solution satisfies primal stationarity and the contact rows."""
    a = analyse(2, 2, solve=solve, condense=True, steps=2)
    qp, s = a.primal, a.solution
    residual = qp.P @ s.x + qp.q + qp.A.T @ s.y + qp.G.T @ s.z

    assert abs(residual).max() < 1e-6
    assert (qp.G @ s.x - qp.h).max() < 1e-6
    assert s.z.min() >= 0
    assert s.z.max() > 0.1


def test_an_unsolved_qp_raises_an_error():
    def lost(qp):
        return SMALBE(max_steps=1).prepare(qp, 1e-8)()

    with pytest.raises(RuntimeError, match="not solved"):
        analyse(1, 1, solve=lost, condense=True, steps=1)


def test_triplets_give_the_same_matrix_as_the_compiled_loops():
    mesh = half_ring((1, 0), (0.3, 0.49), (6, 3))
    D = elasticity_matrix(BEAM, "stress")
    K = stiffness(mesh, D)

    assert abs(K - stiffness_by_triplets(mesh, D)).max() <= 1e-13 * abs(K).max()


def test_methods_are_interleaved_with_one_row_per_measurement():
    calls = []
    entrants = {
        name: timed_as_one(lambda name=name: calls.append(name)) for name in "ab"
    }
    rows = race(entrants, Rounds(most=3))

    assert calls == list("abababab")  # the first two calls are a warm-up
    assert [(r["method"], r["repeat"]) for r in rows] == [
        (name, k) for k in range(3) for name in "ab"
    ]
    assert all(r["seconds"] >= 0 and r["part"] == "all" for r in rows)


def test_repeats_end_at_the_time_limit_after_the_minimum_number():
    calls = []
    entrant = {"a": timed_as_one(lambda: calls.append(1))}
    race(entrant, Rounds(most=9, least=4, seconds=-1), warm=False)

    assert len(calls) == 4


def test_a_stopwatch_sums_the_times_of_a_part(monkeypatch):
    times = iter([0.0, 1.0, 3.0, 6.0])
    monkeypatch.setattr(
        "mortarbench.problems.experiments.clock.perf_counter", lambda: next(times)
    )
    watch = Stopwatch()
    for part in "aba":
        watch.lap(part)

    assert watch.laps == {"a": 4.0, "b": 2.0}
