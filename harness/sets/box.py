"""Bounds on variables as a convex set."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mortarbench.harness.sets.convex import Limits, Vector


@dataclass(frozen=True, eq=False)
class Box:
    """Componentwise bounds lower ≤ x ≤ upper, where ±inf stands for an absent bound.

    Examples
    --------
    >>> import numpy as np
    >>> from mortarbench import Box
    >>> box = Box(np.array([0.0, -np.inf]), np.array([1.0, np.inf]))
    >>> box.project(np.array([2.0, 5.0]))
    array([1., 5.])
    >>> box.block  # variables with a finite bound
    array([0])

    """

    lower: Vector  #: (n,) lower bounds, less than inf
    upper: Vector  #: (n,) upper bounds, greater than -inf

    @classmethod
    def unbounded(cls, n: int) -> Box:
        """Return the box without bounds on n variables."""
        return cls(np.full(n, -np.inf), np.full(n, np.inf))

    @property
    def block(self) -> NDArray[np.int64]:
        """Indices of the variables with a finite bound, in ascending order."""
        return np.flatnonzero(np.isfinite(self.lower) | np.isfinite(self.upper))

    def check(self, n: int) -> None:
        """Raise ValueError if bounds have a wrong shape, are NaN or exclude all x."""
        for name, bound, excluded, expected in (
            ("lb", self.lower, np.inf, "below inf"),
            ("ub", self.upper, -np.inf, "above -inf"),
        ):
            if bound.shape != (n,):
                raise ValueError(f"QP.{name} has shape {bound.shape}, expected {(n,)}")
            wrong = np.asarray(np.isnan(bound) | (bound == excluded))
            if wrong.any():
                i = int(wrong.argmax())
                raise ValueError(
                    f"{name}[{i}] is {bound[i]:g}; expected a number {expected}"
                )
        if (self.lower > self.upper).any():
            lower, upper = np.asarray(self.lower), np.asarray(self.upper)
            i = int((lower > upper).argmax())
            raise ValueError(
                f"bounds cross at {i}: {lower[i]:g} > {upper[i]:g}; expected lb ≤ ub"
            )

    def hull(self, n: int) -> tuple[Vector, Vector]:
        """Return the bounds of the box, which is its own hull."""
        return self.lower, self.upper

    def project(self, x: Vector) -> Vector:
        """Clip x (n,) to the bounds."""
        return np.clip(x, self.lower, self.upper)

    def limits(self, x: Vector) -> list[Limits]:
        """Return the slacks of finite lower bounds, then of finite upper bounds."""
        size, limits = np.abs(x), list[Limits]()
        for name, bound, sign in (
            ("lower bound", self.lower, 1),
            ("upper bound", self.upper, -1),
        ):
            is_finite = np.isfinite(bound)
            if is_finite.any():  # on any rank, if the bounds are distributed
                finite = np.flatnonzero(np.asarray(is_finite))
                at = bound[finite]
                slack = sign * (x[finite] - at)
                limits.append(Limits(name, slack, np.abs(at), size[finite], finite))
        return limits

    def admissible(self, z: Vector) -> Vector:
        """Return z (n,) with the multipliers of absent bounds set to zero."""
        above = np.where(np.isfinite(self.upper), np.maximum(z, 0), 0)
        below = np.where(np.isfinite(self.lower), np.maximum(-z, 0), 0)
        return above - below

    def support(self, z: Vector) -> float:
        """Evaluate ubᵀmax(z, 0) − lbᵀmax(−z, 0) over the finite bounds."""
        sides = self._sides(z)
        return float(sum(sign * (bound @ part) for bound, part, sign in sides))

    def support_gaps(
        self, x: Vector, z: Vector, limits: Sequence[Limits]
    ) -> list[Vector]:
        """Return the products of slack and multiplier of all finite bounds."""
        return [
            part * limit.slack
            for (_, part, _), limit in zip(self._sides(z), limits, strict=True)
        ]

    def substituted(self, T: Any, a: Vector) -> Box:
        """Return the box of all x' such that x = T x' + a is in this box.

        A negative entry of T swaps the bounds of a variable.
        """
        inverse = T.copy()
        inverse.data = 1 / T.data
        ends = [inverse.T @ (bound - a) for bound in (self.lower, self.upper)]
        return Box(np.minimum(*ends), np.maximum(*ends))

    def arrays(self) -> dict[str, NDArray[Any]]:
        """Return the bounds, keyed by their names in files, `lb` and `ub`."""
        return {"lb": self.lower, "ub": self.upper}

    def _sides(self, z: Vector) -> Iterator[tuple[Vector, Vector, int]]:
        """Yield the finite bounds, their multipliers ≥ 0, and the sign of z."""
        for bound, sign in ((self.lower, -1), (self.upper, 1)):
            is_finite = np.isfinite(bound)
            if is_finite.any():
                yield bound[is_finite], np.maximum(sign * z, 0)[is_finite], sign
