"""Discs ‖x_I‖ ≤ r, as bounds of friction have in space."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mortarbench.harness.sets.convex import ConvexSet, Limits, Sum, Vector


@dataclass(frozen=True, eq=False)
class Discs:
    """‖x[index[i]]‖ ≤ radius[i], Euclidean, for blocks of one dimension."""

    index: NDArray[np.int64]  #: (k, d)
    radius: Vector  #: (k,) not negative

    @property
    def block(self) -> NDArray[np.int64]:
        """All components of the discs."""
        return np.sort(self.index.ravel())

    def check(self, n: int) -> None:
        """Raise ValueError for other shapes, negative radii and common variables."""
        if self.index.ndim != 2 or self.radius.shape != self.index.shape[:1]:
            raise ValueError(
                f"Discs: index has shape {self.index.shape} and radius "
                f"{self.radius.shape}; expected (k, d) and (k,)"
            )
        if not (np.isfinite(self.radius) & (self.radius >= 0)).all():
            raise ValueError("Discs: a radius is negative or not finite")
        block = self.block
        if block.size and not (0 <= block[0] and block[-1] < n):
            raise ValueError(f"Discs: an index is not in 0 … {n - 1}")
        if (np.diff(block) == 0).any():
            raise ValueError("Discs: two discs have a variable in common")

    def hull(self, n: int) -> tuple[Vector, Vector]:
        """Return −r and r on the discs."""
        size = np.full(n, np.inf)
        size[self.index] = self.radius[:, None]
        return -size, size

    def project(self, x: Vector) -> Vector:
        """Shorten the blocks that are too long."""
        norms = self._norms(x)
        long = norms > self.radius
        x = x.copy()
        x[self.index[long]] *= (self.radius[long] / norms[long])[:, None]
        return x

    def limits(self, x: Vector) -> list[Limits]:
        """Measure r − ‖x_I‖."""
        norms = self._norms(x)
        return [Limits(self.radius - norms, self.radius, norms, self._norms)]

    def admissible(self, z: Vector) -> Vector:
        """Return the components of z (n,) on discs."""
        part = np.zeros_like(z)
        part[self.index] = z[self.index]
        return part

    def support(self, z: Vector) -> Sum:
        """Evaluate Σ r‖z_I‖."""
        value = self.radius @ self._norms(z)
        return Sum(value, value)

    def support_gaps(self, x: Vector, z: Vector, limits: Sequence[Limits]) -> list[Sum]:
        """Evaluate r‖z_I‖ − z_Iᵀx_I of each disc."""
        work = (z * x)[self.index]
        value = self.radius * self._norms(z)
        return [Sum(value - work.sum(axis=1), value + np.abs(work).sum(axis=1))]

    def substituted(self, T: Any, a: Vector) -> Discs:
        """Return the discs of x', where T scales a disc evenly and a leaves it."""
        coo = T.tocoo()
        column = np.empty(T.shape[0], dtype=np.int64)
        factor = np.empty(T.shape[0])
        column[coo.row], factor[coo.row] = coo.col, np.abs(coo.data)
        factors = factor[self.index]
        if a[self.index].any() or (factors != factors[:, :1]).any():
            raise ValueError("Discs: moved, or scaled unevenly, they are none")
        return Discs(column[self.index], self.radius / factors[:, 0])

    def arrays(self) -> dict[str, NDArray[Any]]:
        """Return `disc_index` and `disc_radius`."""
        return {"disc_index": self.index, "disc_radius": self.radius}

    def _norms(self, v: Vector) -> Vector:
        norms: Vector = np.linalg.norm(v[self.index], axis=1)
        return norms


def further_sets(arrays: Mapping[str, NDArray[Any]]) -> tuple[ConvexSet, ...]:
    """Read the sets other than bounds that a file holds, by the names of `arrays`."""
    if "disc_index" not in arrays:
        return ()
    index = np.atleast_2d(arrays["disc_index"]).astype(np.int64)
    return (Discs(index, np.ravel(arrays["disc_radius"]).astype(float)),)
