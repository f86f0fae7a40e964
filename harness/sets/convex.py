"""Convex sets of the variables of a QP, and the operations on them.

A QP constrains x ∈ S₀ × S₁ × …: S₀ is a `Box` of all variables, and each further set
constrains a block of variables that are free in S₀ and in all other sets. KKT
residuals, verdicts, transforms and files use the operations below, and do not depend on
the kind of a set.

A vector z is normal to S at x ∈ S if zᵀ(y − x) ≤ 0 for all y ∈ S. With the support
function σ(z) = sup zᵀy over y ∈ S, this means  σ(z) − zᵀx = 0.  The left-hand side, the
support gap, is nonnegative for x ∈ S (Rockafellar 1970, Theorem 23.5). For a box it is
the sum of the complementarity terms, multiplier times distance to the bound.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple, Protocol, TypeVar, runtime_checkable

import numpy as np
from numpy.typing import NDArray

Vector = NDArray[np.float64]
S = TypeVar("S", bound="ConvexSet")


class Limits(NamedTuple):
    """Scalar constraints at a point; the slack is nonnegative if they are satisfied."""

    slack: Vector  #: distance to the limit, negative outside
    size: Vector  #: absolute value of the limit
    terms: Vector  #: sum of the absolute terms of the variables in the slack
    sized: Callable[[Vector], Vector]  #: the same for variables of sizes (n,)


class Sum(NamedTuple):
    """A sum, and the sum of the absolute values of its terms."""

    value: Any
    terms: Any


@runtime_checkable
class ConvexSet(Protocol):
    """A closed convex set of n variables; those outside its block are free."""

    @property
    def block(self) -> NDArray[np.int64]:
        """The variables that the set constrains, in ascending order."""

    def check(self, n: int) -> None:
        """Raise ValueError if the set is empty, holds NaN or does not fit n."""

    def hull(self, n: int) -> tuple[Vector, Vector]:
        """Return the smallest box (n,), (n,) that contains the set."""

    def project(self, x: Vector) -> Vector:
        """Return the point (n,) of the set that is nearest to x (n,)."""

    def limits(self, x: Vector) -> Sequence[Limits]:
        """Return the slacks of x (n,)."""

    def admissible(self, z: Vector) -> Vector:
        """Return the part of z (n,) that is normal to the set at some point."""

    def support(self, z: Vector) -> Sum:
        """Evaluate σ at an admissible z (n,)."""

    def support_gaps(
        self, x: Vector, z: Vector, limits: Sequence[Limits]
    ) -> Sequence[Sum]:
        """Evaluate σ(z) − zᵀx limit by limit; x and z are (n,).

        limits : result of `limits` at x
        """

    def substituted(self: S, T: Any, a: Vector) -> S:
        """Return the set of all x' with T x' + a in this set.

        T : (n, n) sparse, one entry in each row and column
        """

    def arrays(self) -> dict[str, NDArray[Any]]:
        """Return the arrays that files hold, by name."""


def hull(sets: Sequence[ConvexSet], n: int) -> tuple[Vector, Vector]:
    """Return the smallest box (n,), (n,) that contains the product of sets."""
    lower, upper = sets[0].hull(n)
    for one in sets[1:]:
        low, high = one.hull(n)
        lower, upper = np.maximum(lower, low), np.minimum(upper, high)
    return lower, upper


def admissible(sets: Sequence[ConvexSet], z: Vector) -> Vector:
    """Return the part of z (n,) that is normal to a product of sets at some point."""
    total, *others = (one.admissible(z) for one in sets)
    for other in others:
        total = total + other
    return total
