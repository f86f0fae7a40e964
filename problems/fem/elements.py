"""Finite elements whose reference cells are products of simplices.

A simplex with the vertices v_0 … v_d has the barycentric coordinates λ_0 … λ_d, affine
functions with λ_i(v_j) = δ_ij. The reference cell is the product of one or more
simplices (intervals [−1, 1], unit triangles, unit tetrahedra). A corner is a choice of
one vertex of each simplex, and its shape function is the product

    N_a(ξ) = Π_f λ_{a_f}(ξ_f)

Quadrilaterals and hexahedra are products of intervals, wedges are products of a
triangle and an interval, and tetrahedra are single simplices. An isoparametric cell is
the image of the reference cell under x(ξ) = Σ N_a(ξ) x_a.

The quadrature rule of a simplex has d + 1 points of equal weight, at centroid + (vertex
− centroid)/√(d + 2). It is exact for polynomials of degree 2, and of degree 3 on
intervals (Stroud, Approximate calculation of multiple integrals, 1971, T_n: 2-1). The
stiffness of affine cells is therefore exact. If the cell is a single simplex, gradients
are constant, and the centroid suffices as quadrature point.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from math import factorial

import numpy as np
from numpy.typing import NDArray

from mortarbench.harness import Vector

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

#: vertices (d + 1, d) of each simplex
INTERVAL = np.array([[-1], [1]])
TRIANGLE = np.array([[0, 0], [1, 0], [0, 1]])
TETRAHEDRON = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]])


@dataclass(frozen=True, eq=False)
class Element:
    """A product of simplices with n corners."""

    kind: str  #: name of the cell type in meshio
    simplices: tuple[Ints, ...]  #: vertices (d + 1, d) of each simplex (factor)
    vertices: Ints  #: (n, factors) index of the vertex of each factor at a corner

    @property
    def dim(self) -> int:
        """Dimension of the reference cell."""
        return sum(simplex.shape[1] for simplex in self.simplices)

    @property
    def corners(self) -> Ints:
        """Corners of the reference cell, (n, dim)."""
        parts = zip(self.simplices, self.vertices.T, strict=True)
        return np.hstack([simplex[vertex] for simplex, vertex in parts])

    @property
    def centre(self) -> Vector:
        """Centroid of the reference cell, (dim,)."""
        return np.concatenate([simplex.mean(axis=0) for simplex in self.simplices])

    @property
    def points(self) -> Floats:
        """Quadrature points of the reference cell, (q, dim)."""
        if len(self.simplices) == 1:
            return self.centre[None]
        spread = [np.full(s.shape[1], np.sqrt(s.shape[1] + 2)) for s in self.simplices]
        offset = (self.corners - self.centre) / np.concatenate(spread)
        return np.asarray(self.centre + offset)

    @property
    def weights(self) -> Vector:
        """Weights (q,) of the quadrature points; their sum is the reference volume."""
        volume = np.prod(
            [
                abs(np.linalg.det(s[1:] - s[0])) / factorial(s.shape[1])
                for s in self.simplices
            ]
        )
        return np.full(len(self.points), volume / len(self.points))

    def shapes(self, xi: Vector) -> Vector:
        """Return all N_a (n,) at the point ξ (dim,) of the reference cell."""
        return np.asarray(np.prod(self._coordinates(xi)[0], axis=0))

    def gradients(self, xi: Vector) -> Floats:
        """Return all ∂N_a/∂ξ (n, dim) at the point ξ (dim,) of the reference cell."""
        values, slopes = self._coordinates(xi)
        others = [np.delete(values, f, axis=0).prod(axis=0) for f in range(len(values))]
        columns = zip(slopes, others, strict=True)
        return np.hstack([slope * rest[:, None] for slope, rest in columns])

    def _coordinates(self, xi: Vector) -> tuple[Floats, list[Floats]]:
        """Return the barycentric coordinates λ_{a_f} of all corners a, and gradients.

        The coordinates at ξ are (factors, n). The list contains one array of gradients
        (n, d) for each factor.
        """
        values, slopes, start = [], [], 0
        for simplex, vertex in zip(self.simplices, self.vertices.T, strict=True):
            d = simplex.shape[1]
            # λ_i(x) = coefficients[0, i] + x·coefficients[1:, i], and λ_i(v_j) = δ_ij
            coefficients = np.linalg.inv(np.insert(simplex, 0, 1, axis=1))
            own = coefficients[0] + xi[start : start + d] @ coefficients[1:]
            values.append(own[vertex])
            slopes.append(coefficients[1:].T[vertex])
            start += d
        return np.array(values), slopes

    @cached_property
    def table(self) -> Floats:
        """∂N_a/∂ξ_k at all quadrature points, (q, dim, n)."""
        return np.stack([self.gradients(xi).T for xi in self.points]).copy()

    @cached_property
    def edges(self) -> NDArray[np.int32]:
        """First and last corners (dim, p, 2) of the edges along each axis.

        Axis k of a simplex runs from vertex 0 to vertex k + 1. An axis with fewer than
        p edges is padded with pairs of equal corners.
        """
        axes = []
        for f, simplex in enumerate(self.simplices):
            first = np.flatnonzero(self.vertices[:, f] == 0)
            for k in range(simplex.shape[1]):
                across = self.vertices[first]
                across[:, f] = k + 1
                same = (self.vertices == across[:, None]).all(axis=2)
                axes.append(np.stack([first, same.argmax(axis=1)], axis=-1))
        edges = np.zeros((len(axes), max(map(len, axes)), 2), dtype=np.int32)
        for k, pairs in enumerate(axes):
            edges[k, : len(pairs)] = pairs
        return edges


QUAD = Element(
    "quad",
    simplices=(INTERVAL, INTERVAL),
    vertices=np.array([[0, 0], [1, 0], [1, 1], [0, 1]]),
)
HEXAHEDRON = Element(
    "hexahedron",
    simplices=(INTERVAL, INTERVAL, INTERVAL),
    vertices=np.vstack([np.insert(QUAD.vertices, 2, z, axis=1) for z in (0, 1)]),
)
WEDGE = Element(
    "wedge",
    simplices=(TRIANGLE, INTERVAL),
    vertices=np.array([[0, 0], [1, 0], [2, 0], [0, 1], [1, 1], [2, 1]]),
)  # fmt: skip
TETRA = Element(
    "tetra",
    simplices=(TETRAHEDRON,),
    vertices=np.arange(4)[:, None],
)
#: mapping from the dimension and the number of corners to the element
ELEMENTS = {
    (element.dim, len(element.vertices)): element
    for element in (QUAD, HEXAHEDRON, WEDGE, TETRA)
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
    """Return a_x b_y − a_y b_x (…) for vectors (…, 2)."""
    return np.asarray(a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0])
