"""Active sets that a pair of displacement and multipliers suggests.

A closed row holds with equality: a contact that touches, or friction that sticks. The
multiplier of a row that is not closed is on the boundary of the set Λ of admissible
multipliers: an open contact has λ = 0, and a slipping node with the friction bound g
has ‖λ‖ = g.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from mortarbench.harness.mechanics import Exact, Extended
from mortarbench.harness.sets.blocks import norms

States = NDArray[np.int8]  #: (m,) state of each row
#: States of a row: multiplier at its lower bound, row closed (multiplier free), or
#: multiplier at its upper bound. For a friction vector of several rows, UPPER denotes
#: any point of the circle ‖λ‖ = g.
LOWER, CLOSED, UPPER = -1, 0, 1


class ActiveSet(NamedTuple):
    """States of the rows, and the multipliers of rows that are not closed."""

    states: States  #: (m,) state of each row
    limits: Extended  #: (m,) multipliers on the boundary of Λ; unused for closed rows

    @property
    def closed(self) -> NDArray[np.bool_]:
        """Mask (m,) of the closed rows."""
        return np.asarray(self.states == CLOSED)

    def at_bounds(self, multipliers: Extended) -> Extended:
        """For rows that are not closed, replace the multipliers (m,) by the limits."""
        return np.where(self.closed, multipliers, self.limits)


def suggested(exact: Exact, u: Extended, multipliers: Extended) -> ActiveSet:
    """Guess the states from a pair (u, λ): rows with λ + v/D inside Λ are closed.

    Here, v = Bu − c, and D is the compliance of the row. A primal-dual active set
    method uses this rule to determine the next active set. For rows that are not
    closed, `limits` of the result is the projection of λ + v/D onto Λ.
    """
    discs, softness, v = exact.forces.discs, exact.compliance, exact.motion(u)
    states = np.where(multipliers * softness <= -v, LOWER, CLOSED)
    limits = np.zeros_like(multipliers)
    soft = softness[discs.index].mean(axis=1, keepdims=True)
    push = multipliers[discs.index] * soft + v[discs.index]
    size = norms(push)[:, None]
    slips = size >= discs.radius[:, None] * soft
    # if λD + v is zero, λ itself is the limit
    limits[discs.index] = np.where(
        size > 0,
        push / np.where(size > 0, size, 1) * discs.radius[:, None],
        multipliers[discs.index],
    )
    states[discs.index] = np.where(slips, _sides(limits[discs.index]), CLOSED)
    return ActiveSet(states.astype(np.int8), limits)


def _sides(limits: Extended) -> States:
    """Return the states of friction vectors (k, d) that are not closed."""
    if limits.shape[1] > 1:
        return np.full(limits.shape, UPPER, dtype=np.int8)
    return np.where(limits < 0, LOWER, UPPER).astype(np.int8)
