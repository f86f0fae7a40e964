"""Equality rows Gx = e as orthonormal rows C, dense or with a sparse factor of GGᵀ.

A small number of rows is orthonormalised by a pivoted QR factorisation, which also
reveals the rank (`DenseRows`). Thousands of sparse rows, such as the rows for the rigid
modes of subdomains, are only divided by their norms, and the operators

    GGᵀ = LLᵀ,   C = L⁻¹G,   𝒫 = I − CᵀC = I − Gᵀ(GGᵀ)⁻¹G

are applied by products with G and solves with L (`SparseRows`). Sparse rows must be
independent. The model of the penalty ρCᵀC (model.pxi) requires solves with G_F G_Fᵀ +
κGGᵀ, where F denotes the free components of a face. This matrix differs from (1 + κ)GGᵀ
only in rows with entries in bounded components. In contact problems, only a few
subdomains have rows of this type. These rows are ordered last, so that each face
requires only a factorisation of their Schur complement
(`harness.distributed.sparse.BorderedFactor`).
"""

from __future__ import annotations

from abc import ABC
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Protocol, TypeAlias

import numpy as np
from numpy.typing import NDArray
from scipy.linalg.lapack import dtrtrs
from scipy.sparse import csc_array, csr_array, diags_array, issparse

from mortarbench.harness import Matrix, Vector, too_large
from mortarbench.harness.distributed.factor import (
    DependentRowsError,
    bordered_factor,
    independent_rows,
)
from mortarbench.harness.distributed.sparse import BorderedFactor, CompressedRows
from mortarbench.solvers.smalbe import compiled

Mask: TypeAlias = NDArray[np.bool_]

#: largest error of consistent rows, relative to ‖x̃‖∞ + ‖e‖∞, for normalised rows
CONSISTENCY_TOL = 1e-8
RANK = 1e-13  #: squared pivots of normalised rows below this value count as rounding
#: largest number of rows with entries in bounded components, whose block is dense
MAX_BORDER = 2000
#: a sparse G stays sparse if m·n exceeds this value
MAX_DENSE_ENTRIES = 2000


class Transposed(Protocol):
    """The transpose Cᵀ (n, r) as an operator."""

    def __matmul__(self, a: Vector, /) -> Vector: ...


class Orthonormal(Protocol):
    """Rows C (r, n) with CCᵀ = I, as an array or an operator."""

    @property
    def T(self) -> Transposed: ...
    def __len__(self) -> int: ...
    def __matmul__(self, v: Vector, /) -> Vector: ...


@dataclass(frozen=True, eq=False)
class Rows(ABC):
    """Equality rows Gx = e in the form Cx = Cx̃ with orthonormal C."""

    G: Matrix  #: (m, n) original rows
    C: Orthonormal  #: (r, n)
    e_size: float  #: ‖e‖
    #: smallest pivot of the normalised rows; 1 if they are orthogonal
    least_pivot: float
    x_tilde: Vector  #: (n,) the shortest x with Gx = e
    consistent: bool  #: True if Gx = e has a solution, up to rounding
    multipliers: Callable[[Vector], Vector]  #: function a (r,) ↦ y (m,) with Gᵀy = Cᵀa

    def project(self, v: Vector) -> Vector:
        """Return 𝒫v with 𝒫 = I − CᵀC."""
        return np.asarray(v - self.C.T @ (self.C @ v))

    def fitted(self, free: Mask, r: Vector) -> Vector:
        """Return the minimiser a (r,) of ‖(r + Cᵀa)_F‖ on the free components F."""
        return compiled.Rows(self).fitted(free, r)


@dataclass(frozen=True, eq=False)
class DenseRows(Rows):
    """Equality rows with C (r, n) stored as an array."""

    C: NDArray[np.float64]
    GC: NDArray[np.float64]  #: GCᵀ (m, r), so that Gx − e = GCᵀ C(x − x̃)


@dataclass(frozen=True, eq=False)
class SparseRows(Rows):
    """Sparse, independent equality rows with a Cholesky factor of GGᵀ.

    Only Gᵀ is stored, row by row. Products with G and Gᵀ both read the rows of Gᵀ in
    order and access vectors (r,) in random order. These vectors are short and remain in
    the cache.

    Active bounds of a face affect only the block of GGᵀ for the rows with entries in
    bounded components. These rows are the border of the factor. On each face, only the
    Schur complement of the border is factorised again.
    """

    unit: CompressedRows  #: (n, r) transpose of the rows of G, divided by their norms
    scaled: csr_array  #: (r, n) the same rows
    matrix: csr_array  #: GGᵀ of the normalised rows
    factor: BorderedFactor  #: Cholesky factor of `matrix`
    has_border: bool  #: False if the border would have more than `MAX_BORDER` rows
    bounded: NDArray[np.int64]  #: (b,) components with a bound
    of_bounded: CompressedRows  #: (b, r) rows of `unit` for these components

    def factorised(self, free: Mask, shift: float) -> BorderedFactor:
        """Return a factor of G_F G_Fᵀ + shift·GGᵀ without a border; F is `free` (n,).

        The shift is increased if the sum is singular up to rounding.
        """
        none = np.zeros(0, dtype=np.int64)
        part = self.scaled[:, np.flatnonzero(free)]
        of_free = part @ part.T
        while True:
            try:
                return bordered_factor(of_free + shift * self.matrix, none)
            except DependentRowsError:
                shift = min(
                    100 * shift, 1.0
                )  # the loop ends at shift = 1 at the latest, since GGᵀ has a factor


@dataclass(frozen=True, eq=False)
class _Factored:
    """Operator C = L⁻¹G for normalised rows G (r, n) with GGᵀ = LLᵀ."""

    unit: CompressedRows  #: Gᵀ (n, r)
    factor: BorderedFactor

    def __len__(self) -> int:
        return self.unit.shape[1]

    def __matmul__(self, v: Vector) -> Vector:
        return self.factor.forward(self.unit.transposed_times(v))

    @property
    def T(self) -> _FactoredTransposed:
        return _FactoredTransposed(self)


@dataclass(frozen=True, eq=False)
class _FactoredTransposed:
    C: _Factored

    def __matmul__(self, a: Vector) -> Vector:
        return self.C.unit @ self.C.factor.backward(a)


def is_sparse(G: Matrix) -> bool:
    """Return True if G is sparse and too large for a dense array."""
    return bool(issparse(G) and G.shape[0] * G.shape[1] > MAX_DENSE_ENTRIES)


def equality_rows(G: Matrix, e: Vector, bounded: Mask) -> Rows:
    """Orthonormalise the rows of G (m, n), with a sparse factor if G `is_sparse`.

    If the rows of such a G are linearly dependent, G is converted to a dense array. If
    the dense factorisation would exceed the memory limit, a maximal independent subset
    of the rows is used instead.

    bounded : (n,) mask of components with a bound
    """
    if not is_sparse(G):
        return orthonormal_rows(G, e)
    rows = sparse_rows(G, e, bounded)
    if rows is not None:
        return rows
    m, n = G.shape
    if too_large(max(m, n), 3 * min(m, n) / max(m, n)):
        return _independent_rows(G, e, bounded)
    return orthonormal_rows(G, e)


def _independent_rows(G: Matrix, e: Vector, bounded: Mask) -> SparseRows:
    """Replace G (m, n) by independent rows; multipliers of dropped rows are zero.

    Raises
    ------
    ValueError
        If the selected rows are linearly dependent up to rounding.

    """
    gram = csc_array(G @ G.T)
    kept = independent_rows(gram)
    rows = sparse_rows(G[kept], e[kept], bounded)
    if rows is None:
        raise ValueError("the equality rows are nearly linearly dependent")
    size = np.sqrt(gram.diagonal())
    size[size == 0] = 1.0
    of_kept = rows.multipliers

    def multipliers(a: Vector) -> Vector:
        y = np.zeros(e.size)
        y[kept] = of_kept(a)
        return y

    return replace(
        rows,
        G=G,
        e_size=float(np.linalg.norm(e)),
        multipliers=multipliers,
        consistent=_consistent((G @ rows.x_tilde - e) / size, rows.x_tilde, e / size),
    )


def _consistent(missed: Vector, x_tilde: Vector, e: Vector) -> bool:
    """Return True if normalised rows with the error `missed` (m,) are consistent."""
    scale = np.abs(x_tilde).max(initial=0.0) + np.abs(e).max(initial=0.0)
    return bool((np.abs(missed) <= CONSISTENCY_TOL * scale).all())


def sparse_rows(G: Matrix, e: Vector, bounded: Mask) -> SparseRows | None:
    """Factorise GGᵀ of a sparse G (m, n); return None for linearly dependent rows."""
    b = np.flatnonzero(bounded)
    G = G if G.format == "csc" else csc_array(G)
    size = np.sqrt(G.multiply(G).sum(axis=1))
    if not (size > 0).all():
        return None
    scaled = csr_array(diags_array(1 / size) @ G)
    columns = csr_array(scaled.T)
    unit, of_bounded = CompressedRows(columns), columns[b]
    changing = np.zeros(size.size, dtype=bool)
    changing[of_bounded.indices] = True
    gram, has_border = csr_array(scaled @ columns), int(changing.sum()) <= MAX_BORDER
    try:
        factor = bordered_factor(gram, np.flatnonzero(changing & has_border))
    except DependentRowsError:
        return None
    if factor.least_pivot**2 <= RANK:
        return None
    return SparseRows(
        G=G,
        e_size=float(np.linalg.norm(e)),
        least_pivot=factor.least_pivot,
        C=_Factored(unit, factor),
        x_tilde=unit @ factor(e / size),
        consistent=True,
        multipliers=lambda a: factor.backward(a) / size,
        unit=unit,
        scaled=scaled,
        matrix=gram,
        factor=factor,
        has_border=has_border,
        bounded=b,
        of_bounded=CompressedRows(of_bounded),
    )


def orthonormal_rows(G: Matrix, e: Vector) -> DenseRows:
    """Compute C by a pivoted QR factorisation of the normalised rows of G (m, n)."""
    if not e.size:
        return _no_rows(G.shape[1])
    rows, triangle = compiled.orthonormal(as_dense(G), np.ascontiguousarray(e, float))
    dense, C, GC, e_size, least_pivot, x_tilde, consistent = rows
    R, kept, sizes = triangle

    def multipliers(a: Vector) -> Vector:
        y = np.zeros(e.size)
        if a.size:
            y[kept] = dtrtrs(R, a)[0] / sizes[kept]
        return y

    return DenseRows(
        dense, C, e_size, least_pivot, x_tilde, consistent, multipliers, GC
    )


@lru_cache(maxsize=8)
def _no_rows(n: int) -> DenseRows:
    none, square, x_tilde = np.zeros((0, n)), np.zeros((0, 0)), np.zeros(n)
    x_tilde.flags.writeable = False
    return DenseRows(none, none, 0.0, 1.0, x_tilde, True, _themselves, square)


def _themselves(a: Vector) -> Vector:
    return a


def as_dense(G: Matrix) -> NDArray[np.float64]:
    """Return a matrix as a C-contiguous array."""
    if not G.shape[0]:
        return np.zeros(G.shape)
    dense = G.toarray() if hasattr(G, "toarray") else G
    return np.ascontiguousarray(dense, dtype=float)
