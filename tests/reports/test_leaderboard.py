"""Leaderboard: tiers follow from planted times, and warm starts win and lose."""

import numpy as np
import pandas as pd
import pytest

from mortarbench.harness import Verdict
from mortarbench.reports.leaderboard import class_rows, compose_leaderboard
from tests.support.measured import measurements, timed


@pytest.fixture
def rng():
    return np.random.default_rng(5)


def problems(run, group="dense"):
    cases = dict.fromkeys(run.df.case)
    return pd.DataFrame(
        [
            {"case": c, "name": c, "group": group, "sequence": "", "step": 0}
            for c in cases
        ]
    )


def tiers(records):
    run = measurements(records)
    (row,) = class_rows(run, problems(run), "cold")
    return {e.solver: e.tier for e in row.entries}


def test_solvers_that_cannot_be_told_apart_share_a_tier(rng):
    """Planted: a and b are equal, c and d too; intervals of 95 % may err in 5 %."""
    shared = 0
    for _ in range(40):
        records = (
            timed(rng, "a", 8, 3)
            + timed(rng, "b", 8, 3, scatter=0.4)
            + timed(rng, "c", 8, 3, seconds=0.1, scatter=0.3)
            + timed(rng, "d", 8, 3, seconds=0.1, scatter=0.3)
            + timed(rng, "e", 8, 3, seconds=2.0)
        )
        of = tiers(records)
        shared += (of["a"] == of["b"]) + (of["c"] == of["d"])
        assert max(of["a"], of["b"]) < min(of["c"], of["d"])
        assert max(of["c"], of["d"]) < of["e"]
    assert shared >= 68


def test_a_solver_that_solved_few_problems_has_no_tier(rng):
    few = [
        r if r.params["n"] < 3 else r.replace(status=Verdict.FAILED)
        for r in timed(rng, "few", 8, 3, 0.0001)
    ]
    assert tiers(few + timed(rng, "all", 8, 3)) == {"all": 1, "few": 0}


def test_warm_starts_that_save_and_cost_time_are_named(rng):
    """Planted: warm starts halve the time of load steps, and double that of jumps."""
    steps, records = [], []
    for kind, first, factor in (("load steps", 0, 0.5), ("jumps", 12, 2.0)):
        for mode, seconds in (("cold", 0.01), ("sequence", 0.01 * factor)):
            for r in timed(rng, "a", first + 12, 3, seconds, mode=mode):
                if r.params["n"] >= first:
                    records.append(r)
        cases = [r.case for r in records if r.params["n"] >= first]
        for k, case in enumerate(dict.fromkeys(cases)):
            name = f"{kind}-{k // 4}"
            steps.append((case, f"{name}-{k % 4}", kind, name, k % 4 + 1))
    items = pd.DataFrame(steps, columns=["case", "name", "group", "sequence", "step"])
    document = compose_leaderboard(measurements(records), items)
    (warm,) = (s for s in document.sections if s.name == "warm")
    saved, lost = warm.items[:2]
    assert saved.startswith("Warm starts save time: a on load steps 0.5")
    assert lost.startswith("Warm starts cost time: a on jumps 2.0")
    table, whole = warm.tables
    cells = dict(zip(table.head, table.rows[0], strict=True))
    assert "faster on 3 of 3" in cells["load steps"]
    assert "faster on 0 of 3" in cells["jumps"]
    assert len(whole.data) == 6 * 3  # a row per sequence and repeat
    assert np.allclose(whole.data.cold, 0.04, rtol=0.1)
    assert len(table.data) == 24 * 3  # a row per step and repeat
