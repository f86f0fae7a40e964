"""Convex sets of the variables of a QP, used only through their operations.

A QP constrains x ∈ S₀ × S₁ × …: S₀ is a `Box` of all variables, and each further set
has a block of variables to itself, which S₀ leaves free. KKT residuals, verdicts,
transforms and files use the operations below and no particular kind of set.

A vector z is normal to S at x ∈ S if zᵀ(y − x) ≤ 0 for all y ∈ S. With the support
function σ(z) = sup zᵀy over y ∈ S, that is  σ(z) − zᵀx = 0,  and the left side, the
support gap, is never negative at x ∈ S (Rockafellar 1970, Theorem 23.5). Of a box it is
the sum of what is known as complementarity: multiplier times distance to the bound.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple, Protocol, TypeVar, runtime_checkable

import numpy as np
from numpy.typing import NDArray

Vector = NDArray[np.float64]
S = TypeVar("S", bound="ConvexSet")


class Limits(NamedTuple):
    """Scalar constraints at a point, nonnegative slack where they hold."""

    slack: Vector  #: distance to the limit, negative outside
    size: Vector  #: absolute value of the limit
    terms: Vector  #: size of the variables' part in the slack
    sized: Callable[[Vector], Vector]  #: the same for variables of sizes (n,)


class Sum(NamedTuple):
    """A sum and that of the absolute values of its terms."""

    value: Any
    terms: Any


@runtime_checkable
class ConvexSet(Protocol):
    """A closed convex set of n variables; those outside its block are free."""

    @property
    def block(self) -> NDArray[np.int64]:
        """The variables that the set constrains, in ascending order."""

    def check(self, n: int) -> None:
        """Raise ValueError where the set is empty, holds NaN or does not fit n."""

    def hull(self, n: int) -> tuple[Vector, Vector]:
        """Return the smallest box (n,), (n,) that contains the set."""

    def project(self, x: Vector) -> Vector:
        """Return the point (n,) of the set that is nearest to x (n,)."""

    def limits(self, x: Vector) -> Sequence[Limits]:
        """Measure the slack of x (n,)."""

    def admissible(self, z: Vector) -> Vector:
        """Return z (n,) without components that are normal to the set nowhere."""

    def support(self, z: Vector) -> Sum:
        """Evaluate σ at an admissible z (n,)."""

    def support_gaps(
        self, x: Vector, z: Vector, limits: Sequence[Limits]
    ) -> Sequence[Sum]:
        """Evaluate σ(z) − zᵀx limit by limit; x and z are (n,).

        limits : as `limits` measures them at x
        """

    def substituted(self: S, T: Any, a: Vector) -> S:
        """Return the set of all x' with T x' + a in this one.

        T : (n, n) sparse, one entry in each row and column
        """

    def arrays(self) -> dict[str, NDArray[Any]]:
        """Return the arrays that files hold, by name."""


@dataclass(frozen=True, eq=False)
class Box:
    """Bounds: lower ≤ x ≤ upper, component by component; ±inf where there are none."""

    lower: Vector  #: (n,) less than inf
    upper: Vector  #: (n,) greater than -inf

    @classmethod
    def unbounded(cls, n: int) -> Box:
        """Return the box of all x (n,)."""
        return cls(np.full(n, -np.inf), np.full(n, np.inf))

    @property
    def block(self) -> NDArray[np.int64]:
        """The variables with a finite bound."""
        return np.flatnonzero(np.isfinite(self.lower) | np.isfinite(self.upper))

    def check(self, n: int) -> None:
        """Raise ValueError for other shapes, NaN, or bounds that cross."""
        for name, bound in (("lb", self.lower), ("ub", self.upper)):
            if bound.shape != (n,):
                raise ValueError(f"QP.{name} has shape {bound.shape}, expected {(n,)}")
        if not (self.lower < np.inf).all() or not (self.upper > -np.inf).all():
            raise ValueError("QP bounds hold NaN, lb = +inf or ub = -inf")
        if (self.lower > self.upper).any():
            raise ValueError("QP bounds cross: lb > ub in some component")

    def hull(self, n: int) -> tuple[Vector, Vector]:
        """Return the bounds."""
        return self.lower, self.upper

    def project(self, x: Vector) -> Vector:
        """Clip x (n,) to the bounds."""
        return np.clip(x, self.lower, self.upper)

    def limits(self, x: Vector) -> list[Limits]:
        """Measure the slack of the finite lower, then of the finite upper bounds."""
        size, found = np.abs(x), list[Limits]()
        for bound, sign in ((self.lower, 1), (self.upper, -1)):
            is_finite = np.isfinite(bound)
            if is_finite.any():
                at = bound[is_finite]
                found.append(
                    Limits(
                        sign * (x[is_finite] - at), np.abs(at), size[is_finite],
                        partial(_taken, is_finite),
                    )
                )  # fmt: skip
        return found

    def admissible(self, z: Vector) -> Vector:
        """Return z (n,) without multipliers of absent bounds."""
        above = np.where(np.isfinite(self.upper), np.maximum(z, 0), 0)
        below = np.where(np.isfinite(self.lower), np.maximum(-z, 0), 0)
        return above - below

    def support(self, z: Vector) -> Sum:
        """Evaluate ubᵀz⁺ − lbᵀz⁻ over the finite bounds."""
        sides = [*self._sides(z)]
        return Sum(
            sum(sign * (bound @ part) for bound, part, sign in sides),
            sum(np.abs(bound) @ part for bound, part, _ in sides),
        )

    def support_gaps(self, x: Vector, z: Vector, limits: Sequence[Limits]) -> list[Sum]:
        """Multiply the slack of each finite bound by its multiplier."""
        return [
            Sum(part * limit.slack, part * (limit.terms + limit.size))
            for (_, part, _), limit in zip(self._sides(z), limits, strict=True)
        ]

    def substituted(self, T: Any, a: Vector) -> Box:
        """Return the box of x' for x = T x' + a; a negative entry swaps the bounds."""
        inverse = T.copy()
        inverse.data = 1 / T.data
        ends = [inverse.T @ (bound - a) for bound in (self.lower, self.upper)]
        return Box(np.minimum(*ends), np.maximum(*ends))

    def arrays(self) -> dict[str, NDArray[Any]]:
        """Return `lb` and `ub`."""
        return {"lb": self.lower, "ub": self.upper}

    def _sides(self, z: Vector) -> Iterator[tuple[Vector, Vector, int]]:
        """Yield finite lower, then upper bounds, with the part of z ≥ 0 at each."""
        for bound, sign in ((self.lower, -1), (self.upper, 1)):
            is_finite = np.isfinite(bound)
            if is_finite.any():
                yield bound[is_finite], np.maximum(sign * z, 0)[is_finite], sign


def hull(sets: Sequence[ConvexSet], n: int) -> tuple[Vector, Vector]:
    """Return the smallest box (n,), (n,) that contains the product of sets."""
    lower, upper = sets[0].hull(n)
    for one in sets[1:]:
        low, high = one.hull(n)
        lower, upper = np.maximum(lower, low), np.minimum(upper, high)
    return lower, upper


def admissible(sets: Sequence[ConvexSet], z: Vector) -> Vector:
    """Return z (n,) without components that are normal to no set of a product."""
    total, *others = (one.admissible(z) for one in sets)
    for other in others:
        total = total + other
    return total


def _taken(mask: NDArray[np.bool_], v: Vector) -> Vector:
    return v[mask]
