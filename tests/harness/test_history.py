"""Histories of the SMALBE presets."""

from dataclasses import replace

import numpy as np
import pytest

from mortarbench.solvers import SOLVERS
from mortarbench.solvers.smalbe.driver import COLUMNS, STEPS

PRESETS = [
    "smalbe",
    "smalbe-permon",
    "smalbe-espreso",
    "smalbe-paper",
]


@pytest.mark.parametrize("name", PRESETS)
@pytest.mark.parametrize("shape", ["box", "some bounds"])
def test_a_history_records_every_iteration(manufactured, name, shape):
    qp, _ = manufactured(shape, seed=271828)
    solver = replace(SOLVERS[name], history=True)
    s = solver.prepare(qp, 1e-8)()
    h = s.history

    two = np.isfinite(qp.lb) & np.isfinite(qp.ub)
    assert tuple(h) == tuple(c for c in COLUMNS if c != "two_sided" or two.any())
    assert {len(column) for column in h.values()} == {s.iterations}
    for letter, step in STEPS.items():
        assert (h["step"] == letter).sum() == s.counts.get(step, 0)
    for growing in ("outer", "products", "seconds"):
        assert (np.diff(h[growing]) >= 0).all()
    assert h["outer"][-1] < s.counts["outer"]
    assert h["products"][-1] <= s.counts["P_products"]
    within = np.diff(h["outer"]) == 0  # at constant multipliers, cost does not grow
    assert np.diff(h["cost"])[within].max(initial=0) <= 1e-12 * abs(h["cost"]).max()
    at_bound = (s.x <= qp.lb) | (s.x >= qp.ub)
    assert h["active"][-1] == at_bound.sum()
    assert h.get("two_sided", [0])[-1] == (at_bound & two).sum()
    size = np.hypot(h["free_gradient"], h["chopped_gradient"])
    assert size[-1] <= 1e-6 * max(size[0], 1e-6)


@pytest.mark.parametrize("name", PRESETS)
def test_a_history_changes_nothing_and_is_off_by_default(manufactured, name):
    qp, _ = manufactured("some bounds", seed=314159)
    plain = SOLVERS[name].prepare(qp, 1e-8)()
    kept = replace(SOLVERS[name], history=True).prepare(qp, 1e-8)()

    assert plain.history == {}
    assert kept.counts == plain.counts
    assert (kept.x == plain.x).all()
