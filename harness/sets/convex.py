"""Convex sets of the variables of a QP, and the operations on them.

The feasible set of a QP without its rows is the product S₀ × S₁ × …, where S₀ is a
`Box` of all variables. Each further set constrains a block of variables that are free
in S₀ and in all other sets. KKT residuals, verdicts and transforms use only the
operations of `ConvexSet` and are therefore independent of the class of a set.

A vector z is normal to S at x ∈ S if zᵀ(y − x) ≤ 0 for all y ∈ S. With the support
function σ(z) = sup zᵀy over y ∈ S, this is equivalent to  σ(z) − zᵀx = 0.  The
left-hand side, called the support gap, is nonnegative for x ∈ S (Rockafellar 1970,
Theorem 23.5). For a box, the support gap is the sum of the complementarity terms, that
is, of the products of multiplier and distance to the bound.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple, Protocol, TypeVar, runtime_checkable

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import issparse

from mortarbench.harness.errors import InputError

Vector = NDArray[np.float64]
S = TypeVar("S", bound="ConvexSet")


class Limits(NamedTuple):
    """Scalar constraints at a point, which are satisfied if their slack is ≥ 0."""

    name: str  #: for instance "lower bound"
    slack: Vector  #: (k,) distance to the limit, negative if violated
    size: Vector  #: (k,) absolute value of the limit
    #: (k,) sum of the absolute values of the terms of the slack that contain variables
    terms: Vector
    #: (k,) a variable of each constraint, in whose unit the slack is measured
    variable: NDArray[np.int64]


@runtime_checkable
class ConvexSet(Protocol):
    """Closed convex set in ℝⁿ; variables outside its block are unconstrained."""

    @property
    def block(self) -> NDArray[np.int64]:
        """The variables that the set constrains, in ascending order."""

    def check(self, n: int) -> None:
        """Raise ValueError if the set is empty, contains NaN or does not fit in ℝⁿ."""

    def hull(self, n: int) -> tuple[Vector, Vector]:
        """Return the bounds (n,), (n,) of the smallest box that contains the set."""

    def project(self, x: Vector) -> Vector:
        """Return the point (n,) of the set that is nearest to x (n,)."""

    def limits(self, x: Vector) -> Sequence[Limits]:
        """Return the scalar constraints of the set, evaluated at x (n,)."""

    def admissible(self, z: Vector) -> Vector:
        """Return the part of z (n,) that is normal to the set at some point."""

    def support(self, z: Vector) -> float:
        """Evaluate the support function σ at an admissible z (n,)."""

    def support_gaps(
        self, x: Vector, z: Vector, limits: Sequence[Limits]
    ) -> Sequence[Vector]:
        """Return the contribution of each bound or block to σ(z) − zᵀx at x, z (n,).

        limits : result of `limits` at x
        """

    def substituted(self: S, T: Any, a: Vector) -> S:
        """Return the set of all x' such that x = T x' + a is in this set.

        T : (n, n) sparse matrix with a single entry in each row and column
        """

    def arrays(self) -> dict[str, NDArray[Any]]:
        """Return the arrays that define the set, keyed by their names in files."""


def numeric_array(name: str, value: Any) -> NDArray[np.float64]:
    """Return a dense copy of an array of real numbers, which may contain inf and NaN.

    Raises
    ------
    InputError
        If `value` is None, ragged or not numeric.

    """
    expected = "expected an array of numbers"
    if value is None:
        raise InputError(f"{name} is missing; {expected}")
    try:
        array = np.asarray(value.toarray() if issparse(value) else value)
    except ValueError:  # rows of different lengths
        raise InputError(f"{name} is ragged; {expected}") from None
    if array.dtype.kind not in "biuf":
        kind = type(value).__name__ if array.dtype.kind == "O" else array.dtype
        raise InputError(f"{name} is of type {kind}; {expected}")
    with np.errstate(over="ignore"):  # overflow yields inf, which callers reject
        return np.array(array, dtype=float)


def hull(sets: Sequence[ConvexSet], n: int) -> tuple[Vector, Vector]:
    """Return the bounds (n,), (n,) of the smallest box around a product of sets."""
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
