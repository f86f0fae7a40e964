"""Finite elements as data: reference cells with shape functions and facets.

The corners ξ_a determine a multilinear element on [−1, 1]^dim:

    N_a(ξ) = Π_k (1 + ξ_ak ξ_k) / 2,   a = 1 … 2^dim,

with 2^dim Gauss points at ξ_a/√3, all of weight 1. An isoparametric cell is the image
of the reference cell under x(ξ) = Σ N_a(ξ) x_a.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from mortarbench.harness import Vector

Floats = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Element:
    """A multilinear element with n corners."""

    kind: str  #: name of its cells in meshio
    corners: NDArray[np.int64]  #: (n, dim) corners of the reference cell, each −1 or 1
    facets: NDArray[np.int64]  #: (f, m) corners of each facet, the cell on its left

    @property
    def dim(self) -> int:
        """Dimension of the reference cell."""
        return int(self.corners.shape[1])

    @property
    def points(self) -> Floats:
        """Gauss points of the reference cell, (q, dim)."""
        return np.asarray(self.corners / np.sqrt(3))

    @property
    def weights(self) -> Vector:
        """Weights of the Gauss points, (q,)."""
        return np.ones(len(self.corners))

    def gradients(self, xi: Vector) -> Floats:
        """Return ∂N_a/∂ξ (n, dim) at the point ξ (dim,) of the reference cell."""
        factors = 1 + self.corners * xi
        others = [np.delete(factors, k, axis=1).prod(axis=1) for k in range(self.dim)]
        return np.asarray(self.corners * np.stack(others, axis=-1) / 2**self.dim)

    @cached_property
    def table(self) -> Floats:
        """∂N_a/∂ξ_k at all Gauss points, (q, dim, n)."""
        return np.stack([self.gradients(xi).T for xi in self.points]).copy()

    @cached_property
    def edges(self) -> NDArray[np.int32]:
        """First and last corners (dim, n/2, 2) of the edges along each axis."""
        edges = []
        for k in range(self.dim):
            first = np.flatnonzero(self.corners[:, k] < 0)
            across = self.corners[first]
            across[:, k] = 1
            same = (self.corners == across[:, None]).all(axis=2)
            edges.append(np.stack([first, same.argmax(axis=1)], axis=-1))
        return np.array(edges, dtype=np.int32)


QUAD = Element(
    "quad",
    corners=np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]),
    facets=np.array([[0, 1], [1, 2], [2, 3], [3, 0]]),
)
HEXAHEDRON = Element(
    "hexahedron",
    corners=np.vstack([np.insert(QUAD.corners, 2, z, axis=1) for z in (-1, 1)]),
    facets=np.array([  # anticlockwise, seen from outside
        [0, 3, 2, 1], [4, 5, 6, 7], [0, 1, 5, 4], [1, 2, 6, 5], [2, 3, 7, 6],
        [3, 0, 4, 7],
    ]),
)  # fmt: skip
#: elements by dimension and number of columns of a table of cells
ELEMENTS = {
    (element.dim, len(element.corners)): element for element in (QUAD, HEXAHEDRON)
}


def determinant(A: Floats) -> Floats:
    """Return det A (…) of matrices (…, dim, dim)."""
    if A.shape[-1] != 2:
        return np.asarray(np.linalg.det(A))
    return cross(A[..., 0, :], A[..., 1, :])


def inverse_transpose(A: Floats) -> Floats:
    """Return A⁻ᵀ (…, dim, dim)."""
    if A.shape[-1] != 2:
        return np.asarray(np.swapaxes(np.linalg.inv(A), -1, -2))
    cofactors = np.empty_like(A)
    cofactors[..., 0, 0], cofactors[..., 1, 1] = A[..., 1, 1], A[..., 0, 0]
    cofactors[..., 0, 1], cofactors[..., 1, 0] = -A[..., 1, 0], -A[..., 0, 1]
    return np.asarray(cofactors / determinant(A)[..., None, None])


def cross(a: Floats, b: Floats) -> Vector:
    """Return a_x b_y − a_y b_x of vectors (…, 2)."""
    return np.asarray(a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0])
