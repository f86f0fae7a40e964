"""Friction laws and the fixed-point iteration, with hand-computed results."""

from itertools import pairwise
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.sparse import csr_array

from mortarbench.harness import Friction, InputError
from mortarbench.harness.mechanics import NO_FRICTION
from mortarbench.problems.contact.bodies import ContactPair
from mortarbench.problems.contact.friction import (
    FrictionLaw,
    coulomb_fixed_point,
    friction_of,
    law_of,
)
from mortarbench.problems.contact.rows import ContactRows

FORCE = 6.0  #: normal force without friction


def friction(mu, bound=0.0, cohesion=0.0):
    one = np.ones(1)
    return Friction(
        T=csr_array((1, 2)), bound=bound * one, start=0 * one, row=np.array([0]),
        cohesion=cohesion * one, mu=mu * one,
    )  # fmt: skip


def lifted(by):
    """Return a function that decreases the normal force by a multiple of the bound."""
    return lambda one: FORCE - by * one.bound


@pytest.mark.parametrize("cohesion", [0.0, 0.25])
def test_the_fixed_point_satisfies_coulombs_law(cohesion):
    """The fixed point of g = c + μ(6 − g) with μ = ½ is g = (c + 3)/1.5."""
    iterates = coulomb_fixed_point(friction(0.5, 1.0, cohesion), lifted(1.0), step=1)

    assert iterates[-1].bound == pytest.approx((cohesion + 3) / 1.5, rel=1e-10)
    for one, after in pairwise(iterates):
        demanded = cohesion + 0.5 * (FORCE - one.bound)
        assert after.bound == pytest.approx(demanded)


def test_the_bound_after_a_bound_of_zero_is_the_bound_of_the_law():
    _, *others = coulomb_fixed_point(friction(0.5), lifted(0.0), step=1)

    assert [float(one.bound[0]) for one in others] == [3.0]


def test_a_coefficient_of_zero_converges_at_once():
    (only,) = coulomb_fixed_point(friction(0.0), lifted(1.0), step=1)

    assert only.bound == 0


def test_divergence_is_refused_with_the_smallest_and_the_last_residual():
    """With μ = 1.01, iterates alternate about the fixed point; their distance from it
    grows by the factor 1.01 per iterate."""
    calls = []

    def normal(one):
        calls.append(float(one.bound[0]))
        return FORCE - one.bound

    with pytest.raises(InputError, match="does not converge in load step 7") as e:
        coulomb_fixed_point(friction(1.01, 3.0), normal, step=7)

    assert "\n" not in str(e.value)
    assert 31 <= len(calls) <= 33
    assert f"after {len(calls)} Tresca problems," in str(e.value)
    demanded = 1.01 * (FORCE - np.array(calls))
    off = abs(np.array(calls) - demanded) / calls
    assert f"is {off[-1]:.1e}, and was {off.min():.1e} at best" in str(e.value)


def test_slow_convergence_ends_after_a_thousand_problems():
    """The relative change of the bound decreases by 0.1 % per iterate."""
    calls = []

    def normal(one):
        calls.append(one)
        return one.bound * (1 + 1e-3 * 0.999 ** len(calls))

    with pytest.raises(InputError, match="after 1000 Tresca problems,"):
        coulomb_fixed_point(friction(1.0, 1.0), normal, step=1)

    assert len(calls) == 1000


def test_a_law_reads_only_its_own_parameter():
    keys = {"bound": 5.0, "mu": 0.3}

    assert law_of("none", **keys) == FrictionLaw()
    assert law_of("tresca", **keys) == FrictionLaw("tresca", bound=5.0)
    assert law_of("coulomb", **keys) == FrictionLaw("coulomb", mu=0.3)
    assert [FrictionLaw(kind).acts for kind in ("none", "tresca", "coulomb")] == [
        False, True, True,
    ]  # fmt: skip


def test_each_row_has_the_law_of_its_pair_the_share_of_its_side_and_its_nodes_force():
    """Two pairs have two and three slave nodes; nodes 1, 2 and 4 have contact rows."""
    pairs = [ContactPair(np.arange(k), np.arange(0)) for k in (2, 3)]
    bodies = SimpleNamespace(pairs=pairs, force=10.0)
    every, eye = np.arange(3), csr_array(np.eye(3))
    rows = ContactRows(
        B=eye, c=np.zeros(3), T=eye, row=every, share=np.array([0.5, 2.0, 4.0]),
        place=np.array([1, 2, 4]), covered=np.ones(3), at=every,
    )  # fmt: skip
    laws = FrictionLaw("tresca", bound=20.0), FrictionLaw("coulomb", mu=0.5)
    before, pressed = np.array([7.0, 8.0, 9.0]), np.array([1.0, 1.0, 3.0, 1.0, 5.0])
    discrete = friction_of(bodies, rows, laws, before, pressed)

    assert discrete.cohesion.tolist() == [20 * 0.5 / 10, 0, 0]
    assert discrete.mu.tolist() == [0, 0.5, 0.5]
    assert discrete.bound.tolist() == [1, 0.5 * 3, 0.5 * 5]
    assert discrete.start.tolist() == [7, 8, 9]


def test_without_rows_friction_is_empty():
    rows = SimpleNamespace(row=np.zeros(0, dtype=np.int64))

    assert friction_of(None, rows, (), np.zeros(0), np.zeros(0)) is NO_FRICTION
