"""Displacements without penetration, compared with nearest points computed by hand."""

from functools import partial

import numpy as np
import pytest
from scipy.sparse import csr_array

from mortarbench.harness.mechanics import NO_FRICTION, AdmissibleForces, Exact, Real
from mortarbench.harness.sets.discs import Discs
from mortarbench.harness.verify import admissible as module
from mortarbench.harness.verify.admissible import (
    _feasible_near,
    _nearest_at_rows,
    _newton,
    admissible,
    relative,
    supported_and_floating,
)
from tests.support.supported_by_contact import disc_between_plates


def moved(B, c, u, *, R=None, softness=None, closed=None):
    """Move u to Bu ≤ c; defaults: no rigid motions, unit softness, no closed rows."""
    B, c, u = (np.array(v, dtype=Real) for v in (B, c, u))
    m, n = B.shape
    exact = Exact(
        f=np.zeros(n, dtype=Real), B=csr_array(B), c=c,
        forces=AdmissibleForces(m, NO_FRICTION.discs(m)),
        fixed=np.zeros(0, dtype=np.int64),
        softness=np.ones(n) if softness is None else np.array(softness, dtype=float),
    )  # fmt: skip
    R = csr_array(np.zeros((n, 0)) if R is None else np.array(R, dtype=float))
    closed = np.zeros(m, dtype=bool) if closed is None else np.array(closed)
    with np.errstate(all="ignore"):  # as in `certify`
        nearest = partial(_nearest_at_rows, exact, R)
        return _feasible_near(exact, u, closed, nearest)


def test_an_admissible_displacement_is_unchanged():
    found = moved([[1, 1]], [3], [1, 1])

    assert (found == [1, 1]).all()


def test_corrections_are_distributed_by_compliance():
    """From (1, 1), u₁ + u₂ ≤ 1 and least Σδᵢ²/sᵢ with s = (1, 3) give δ = −(¼, ¾)."""
    found = moved([[1, 1]], [1], [1, 1], softness=[1, 3])

    assert found.astype(float) == pytest.approx([0.75, 0.25], rel=1e-9)
    assert found.sum() <= 1


def test_rigid_motions_come_before_bending():
    """A rigid motion by −1 satisfies the violated row, though bending of the first
    component alone would be smaller.
    """
    found = moved([[1, 0]], [1], [2, 2], R=[[1], [1]])

    assert found.astype(float) == pytest.approx([1, 1], rel=1e-9)


def test_a_closed_row_is_closed_though_it_is_not_violated():
    found = moved([[1, 0]], [3], [1, 1], closed=[True])

    assert found.astype(float) == pytest.approx([3, 1], rel=1e-12)
    assert found[0] <= 3


def test_supported_bodies_are_scaled_until_admissible():
    """Without softness no component can be corrected alone, so (2, 3) is halved."""
    found = moved(np.eye(2), [1, 2], [2, 3], softness=[0, 0])

    assert found.astype(float) == pytest.approx([1, 1.5])
    assert (found <= [1, 2]).all()


def test_a_row_that_is_closed_at_zero_scales_a_displacement_to_zero():
    found = moved(np.eye(2), [0, 2], [2, 3], softness=[0, 0])

    assert (found == 0).all()


def test_rows_with_negative_entries_are_satisfied_in_the_last_digit():
    """From (1, 1), u₁ + u₂ ≥ 3 is satisfied by δ = (½, ½)."""
    found = moved([[-1, -1]], [-3], [1, 1])

    assert found.astype(float) == pytest.approx([1.5, 1.5], rel=1e-12)
    assert found.sum() >= 3


def test_multipliers_are_relative_to_the_largest():
    for given, expected in (([1, 2, 4], [0.25, 0.5, 1]), ([0, -1, 0], [1, 1, 1])):
        assert (relative(np.array(given, dtype=Real)) == expected).all()


@pytest.mark.parametrize("unit", [2.0**-20, 1.0, 2.0**20])
@pytest.mark.parametrize(("size", "supported"), [(1e-4, 2), (1e-6, 1)])
def test_a_motion_floats_relative_to_the_best_supported_one(size, supported, unit):
    G = unit * np.diag([1, size]).astype(Real)
    held, floating = supported_and_floating(G, np.ones(2, dtype=Real))

    assert (held.shape[1], floating.shape[1]) == (supported, 2 - supported)


def near(multipliers, w, G, load, discs):
    """Return the λ with Gᵀλ = load nearest to `multipliers`, for a single motion."""
    multipliers, w, G, load = (
        np.array(v, dtype=Real) for v in (multipliers, w, G, load)
    )
    return _newton(
        AdmissibleForces(w.size, discs), multipliers, w, G[:, None], load,
        lambda lam: np.abs(load) + np.abs(G)[None] @ np.abs(lam),
    )  # fmt: skip


def test_rows_without_weight_keep_their_multipliers():
    """λ₁ + λ₂ + λ₃ = 3.1 with λ₃ = 0.1 fixed adds ½ to λ₁ = λ₂ = 1."""
    G = np.full(3, 0.5**0.5)
    found = near([1, 1, 0.1], [1, 1, 0], G, [G @ [1.5, 1.5, 0.1]], NO_FRICTION.discs(3))

    assert found.astype(float) == pytest.approx([1.5, 1.5, 0.1], rel=1e-15)


def test_friction_at_its_bound_leaves_the_load_to_weakly_coupled_contact():
    """λ₂ ≤ 1 is reached, so λ₁ alone balances 0.1λ₁ + √0.99λ₂ = 0.2 + √0.99."""
    G = np.array([0.1, 0.99**0.5])
    found = near([1, 1], [1, 1], G, [G @ [2, 1]], Discs([[1]], [1]))

    assert found.astype(float) == pytest.approx([2, 1], rel=1e-14)


def test_motions_that_change_no_gap_are_removed():
    mechanics = disc_between_plates().mechanics
    free = mechanics.motions.free
    none = np.zeros(mechanics.exact.c.size, dtype=bool)
    found = admissible(mechanics, free @ np.array([1e-3, 2e-3], dtype=Real), none)

    assert np.abs(free.T @ found).max() <= 1e-18


def test_iterations_for_many_rows_agree_with_a_factorisation(monkeypatch):
    """Only contact supports the disc; the nodes move by about a millimetre."""
    mechanics = disc_between_plates().mechanics
    rng = np.random.default_rng(161803)
    u = 1e-3 * rng.standard_normal(mechanics.exact.f.size).astype(Real)
    none = np.zeros(mechanics.exact.c.size, dtype=bool)
    by_factor = admissible(mechanics, u, none)
    monkeypatch.setattr(module, "MAX_DENSE_ROWS", 2)
    by_iterations = admissible(mechanics, u, none)

    far = mechanics.norm(by_factor - u)
    assert far > 0
    assert mechanics.norm(by_iterations - by_factor) <= 1e-4 * far
    assert (mechanics.exact.B @ by_iterations <= mechanics.exact.c).all()
