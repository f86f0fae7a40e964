"""Discs ‖x_I‖ ≤ r, which bound friction forces in 3D."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar, Self

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csc_array

from mortarbench.harness.sets.blocks import Blocks, norms
from mortarbench.harness.sets.convex import Limits, Vector


@dataclass(frozen=True, eq=False)
class Discs(Blocks):
    """Discs ‖x[index[i]]‖ ≤ radius[i] in the Euclidean norm, on blocks of d variables.

    The normal vector `z_box` is a nonnegative multiple of x at an active disc, zero at
    an inactive disc, and arbitrary for radius 0. A `QP` converts discs of one variable
    (d = 1) to bounds.

    Parameters
    ----------
    index : (k, d) variables of each disc, counted from 0; no variable occurs twice
    radius : (k,) finite and not negative

    Raises
    ------
    InputError
        If the shapes do not match, an index is not an integer, or a radius is negative
        or not finite.

    Examples
    --------
    >>> import numpy as np
    >>> from mortarbench import Discs
    >>> discs = Discs(index=[[0, 2]], radius=[1.0])
    >>> discs.project(np.array([3.0, 7.0, 4.0]))
    array([0.6, 7. , 0.8])

    """

    index: NDArray[np.int64]  #: (k, d) variables of each disc
    radius: Vector  #: (k,) radii

    prefix: ClassVar[str] = "disc"
    least: ClassVar[int] = 1
    columns: ClassVar[str] = "d"

    def hull(self, n: int) -> tuple[Vector, Vector]:
        """Return the bounds −r and r at the variables of the discs."""
        size = np.full(n, np.inf)
        size[self.index] = self.radius[:, None]
        return -size, size

    def project(self, x: NDArray[Any]) -> NDArray[Any]:
        """Project x (n,) onto the discs, in the precision of x."""
        sizes = self._norms(x)
        is_outside = sizes > self.radius
        x, outside = x.copy(), self.index[is_outside]
        outward = x[outside] / sizes[is_outside, None]
        x[outside] = self.radius[is_outside, None] * outward
        return x

    def limits(self, x: Vector) -> list[Limits]:
        """Return the slack r − ‖x_I‖ of each disc."""
        sizes = self._norms(x)
        first = self.index[:, 0]
        return [Limits("disc", self.radius - sizes, self.radius, sizes, first)]

    def admissible(self, z: Vector) -> Vector:
        """Return z (n,) with the components outside the blocks set to zero."""
        part = np.zeros_like(z)
        part[self.index] = z[self.index]
        return part

    def support(self, z: Vector) -> float:
        """Evaluate Σ r‖z_I‖ over all discs."""
        return float(self.radius @ self._norms(z))

    def support_gaps(
        self, x: Vector, z: Vector, limits: Sequence[Limits]
    ) -> list[Vector]:
        """Evaluate r‖z_I‖ − z_Iᵀx_I for each disc."""
        return [self.radius * self._norms(z) - (z * x)[self.index].sum(axis=1)]

    def normals(self, x: Vector) -> tuple[csc_array, Vector]:
        """Return outward normals (n, k) at x (n,), and the slacks r − ‖x_I‖ (k,)."""
        sizes, (k, d) = self._norms(x), self.index.shape
        outward = x[self.index] / np.where(sizes > 0, sizes, 1)[:, None]
        places = self.index.ravel(), np.repeat(np.arange(k), d)
        normals = csc_array((outward.ravel(), places), shape=(x.size, k))
        return normals, self.radius - sizes

    def substituted(self, T: Any, a: Vector) -> Self:
        """Return the discs of all x' such that x = T x' + a is in these discs.

        Raises
        ------
        ValueError
            If T scales the variables of a disc differently, or a is nonzero on a disc.

        """
        columns, entries = self.entries(T, a)
        factors = np.abs(entries)
        if (factors != factors[:, :1]).any():
            raise ValueError("Discs cannot be scaled unevenly")
        return replace(self, index=columns, radius=self.radius / factors[:, 0])

    def _norms(self, v: Vector) -> Vector:
        return norms(v[self.index])
