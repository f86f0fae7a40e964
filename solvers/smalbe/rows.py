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

On several ranks, GGᵀ is the matrix of the *coarse problem*, with a row for each rigid
mode of every subdomain. Each rank eliminates the rows whose entries all belong to
components of this rank (`_OverRanks`). If many rows are shared between ranks, every
rank factorises the whole matrix instead.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache, partial
from typing import Any, Protocol, TypeAlias

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csc_array, csr_array, diags_array, issparse

from mortarbench.harness import Matrix, Vector, too_large
from mortarbench.harness.distributed.factor import (
    MAX_ARRAY_ROWS,
    DependentRowsError,
    LocalFactor,
    SummedFactor,
    bordered_factor,
    independent_rows,
    local_factor,
    touched_rows,
)
from mortarbench.harness.distributed.sparse import BorderedFactor, CompressedRows
from mortarbench.harness.distributed.vectors import (
    DistributedColumns,
    Ranks,
    distributed,
)
from mortarbench.solvers.smalbe import compiled

Mask: TypeAlias = NDArray[np.bool_]
SparseColumns: TypeAlias = Any  #: a sparse array, `LocalRows` or `DistributedColumns`

#: largest error of consistent rows, relative to ‖x̃‖∞ + ‖e‖∞, for normalised rows
CONSISTENCY_TOL = 1e-8
RANK = 1e-13  #: squared pivots of normalised rows below this value count as rounding
#: singular values of C on a face below this fraction of the largest one count as zero
FREE_RANK = 1e-10
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
        return self.combined(1.0, v, -1.0, self.C @ v)

    def combined(self, s: float, v: Vector, t: float, a: Vector) -> Vector:
        """Return s·v + t·Cᵀa."""
        return s * v + t * (self.C.T @ a)

    @property
    def no_multipliers(self) -> Vector:
        """Multipliers (r,) of Cx = Cx̃ that are all zero."""
        return np.zeros(len(self.C))

    @abstractmethod
    def fitted(self, free: Mask, r: Vector) -> Vector:
        """Return the minimiser a (r,) of ‖(r + Cᵀa)_F‖ on the free components F."""


@dataclass(frozen=True, eq=False)
class DenseRows(Rows):
    """Equality rows with C (r, n) stored as an array."""

    C: NDArray[np.float64]
    GC: NDArray[np.float64]  #: GCᵀ (m, r), so that Gx − e = GCᵀ C(x − x̃)

    def fitted(self, free: Mask, r: Vector) -> Vector:
        a, *_ = np.linalg.lstsq(self.C.T[free], -r[free], rcond=FREE_RANK)
        return np.asarray(a)


@dataclass(frozen=True, eq=False)
class SparseRows(Rows):
    """Sparse, independent equality rows with a Cholesky factor of GGᵀ."""

    unit: SparseColumns  #: (r, n) rows of G divided by their norms
    gram: GramFactor  #: Cholesky factor of the Gram matrix of `unit`
    bounded: NDArray[np.int64]  #: (b,) components with a bound
    of_bounded: SparseColumns  #: (r, b) columns of `unit` for these components

    def combined(self, s: float, v: Vector, t: float, a: Vector) -> Vector:
        return self.combined_rows(s, v, t, self.gram.backward(a))

    def combined_rows(self, s: float, v: Vector, t: float, y: Vector) -> Vector:
        """Return s·v + t·Gᵀy for the normalised rows G."""
        if isinstance(self.unit, LocalRows):
            return self.unit.T.combined(s, v, t, y)
        return np.asarray(s * v + t * np.asarray(self.unit.T @ y))

    def weighted_difference(self, v: Vector, y: Vector, weights: Vector) -> Vector:
        """Return weights·(v − Gᵀy), componentwise, for the normalised rows G."""
        if isinstance(self.unit, LocalRows):
            return self.unit.T.weighted_difference(v, y, weights)
        return np.asarray((v - np.asarray(self.unit.T @ y)) * weights)

    @property
    def on_one_process(self) -> bool:
        """True if this process stores all rows and columns."""
        return isinstance(self.unit, LocalRows) and self.unit.ranks is None

    @property
    def no_multipliers(self) -> Vector:
        if self.on_one_process:
            return np.zeros(len(self.C))
        return self.C @ np.zeros_like(self.x_tilde)

    def error(self, nu: Vector) -> Vector:
        """Return Gν (m,) for the original rows G."""
        return np.asarray(self.G @ nu)

    def fitted(self, free: Mask, r: Vector) -> Vector:
        return compiled.Rows(self, compiled.Reduction()).fitted(free, r)


class GramFactor(Protocol):
    """Factor of GGᵀ = LLᵀ (r, r) for sparse, normalised rows G."""

    def product(self, y: Vector) -> Vector:
        """Return GGᵀy."""

    def forward(self, t: Vector) -> Vector:
        """Return L⁻¹t."""

    def backward(self, a: Vector) -> Vector:
        """Return L⁻ᵀa."""

    def in_face(self, free: Mask, shift: float) -> Callable[[Vector], Vector]:
        """Return the solution operator of G_F G_Fᵀ + shift·GGᵀ, where F is `free`."""


@dataclass(frozen=True, eq=False)
class WholeGram:
    """Cholesky factor of GGᵀ for all rows, replicated on every rank.

    Active bounds of a face affect only the block of GGᵀ for the rows with entries in
    bounded components. These rows are the border of the factor. On each face, only the
    Schur complement of the border is factorised again.
    """

    unit: LocalRows | DistributedColumns  #: normalised rows G (r, n)
    matrix: Matrix  #: GGᵀ
    factor: BorderedFactor
    has_border: bool  #: False if the border would have more than `MAX_BORDER` rows
    bounded: NDArray[np.int64]  #: (b,) components with a bound
    #: (r, b) columns of G for these components
    of_bounded: LocalRows | DistributedColumns

    def product(self, y: Vector) -> Vector:
        return np.asarray(self.matrix @ y)

    def forward(self, t: Vector) -> Vector:
        return self.factor.forward(t)

    def backward(self, a: Vector) -> Vector:
        return self.factor.backward(a)

    def in_face(self, free: Mask, shift: float) -> BorderedFactor:
        if not self.has_border:
            return self._factorised(free, shift)
        active, part = ~np.asarray(free)[self.bounded], self.of_bounded
        if isinstance(part, LocalRows):
            removed = active.astype(float)
            return self.factor.shifted_without(shift, part.transposed, removed)
        changed = part[self.factor.border_rows].gram(active).toarray()
        return self.factor.shifted(shift, changed)

    def _factorised(self, free: Mask, shift: float) -> BorderedFactor:
        none = np.zeros(0, dtype=np.int64)
        of_free = _gram(self.unit, free)
        while True:
            try:
                return bordered_factor(of_free + shift * self.matrix, none)
            except DependentRowsError:
                shift = min(
                    100 * shift, 1.0
                )  # the loop ends at shift = 1 at the latest, since GGᵀ has a factor


@dataclass(frozen=True, eq=False)
class _OverRanks:
    """Factor of GGᵀ over ranks; each rank stores the rows with entries in its columns.

    The factor is described in `harness.distributed.factor`. Rows with entries in
    bounded components are called *changing*, because active bounds of a face affect the
    block of GGᵀ for these rows.
    """

    matrix: csc_array  #: G_p G_pᵀ with the columns G_p of rank p
    local: LocalFactor
    factor: SummedFactor
    bounded: NDArray[np.int64]  #: (b,) components of rank p with a bound
    of_bounded: LocalRows  #: (k, b) columns of G_p for these components

    def product(self, y: Vector) -> Vector:
        return distributed(self.matrix @ np.asarray(y), self.local.at.ranks)

    def forward(self, t: Vector) -> Vector:
        return self.factor.forward(t)

    def backward(self, a: Vector) -> Vector:
        return self.factor.backward(a)

    def in_face(self, free: Mask, shift: float) -> Callable[[Vector], Vector]:
        with self.local.at.ranks.clocked("coarse"):
            active = (~np.asarray(free)[self.bounded]).astype(float)
            less = self.of_bounded.transposed.outer_products(
                active, self._place, self.local.border.size
            )
            return self.factor.shifted(shift, less)

    @cached_property
    def _place(self) -> NDArray[np.int32]:
        """Positions (k,) of the local rows in the border; −1 for all other rows."""
        place = np.full(self.matrix.shape[0], -1, dtype=np.int32)
        place[self.local.border] = np.arange(self.local.border.size)
        return place


@dataclass(frozen=True, eq=False)
class LocalRows:
    """Rows with entries in the columns of this process; products are sums over ranks.

    Only Gᵀ is stored, row by row. Products with G and Gᵀ both read the rows of Gᵀ in
    order and access vectors (k,) in random order. These vectors are short and remain in
    the cache.
    """

    transposed: CompressedRows  #: (n_p, k)
    ranks: Ranks | None = None  #: None for one process

    @property
    def shape(self) -> tuple[int, int]:
        columns, rows = self.transposed.shape
        return rows, columns

    @property
    def T(self) -> _LocalRowsTransposed:
        return _LocalRowsTransposed(self)

    def __matmul__(self, v: Vector) -> Vector:
        return self.vector(self.transposed.transposed_times(v))

    def vector(self, part: Vector) -> Vector:
        """Return an array as a distributed vector; unchanged on one process."""
        return part if self.ranks is None else distributed(part, self.ranks)


@dataclass(frozen=True, eq=False)
class _LocalRowsTransposed:
    rows: LocalRows

    def __matmul__(self, y: Vector) -> Vector:
        return self.rows.vector(self.rows.transposed @ y)

    def combined(self, s: float, v: Vector, t: float, y: Vector) -> Vector:
        """Return s·v + t·Gᵀy in one pass over memory."""
        return self.rows.vector(self.rows.transposed.combined(s, v, t, y))

    def weighted_difference(self, v: Vector, y: Vector, weights: Vector) -> Vector:
        """Return weights·(v − Gᵀy), componentwise, in one pass over memory."""
        difference = self.rows.transposed.weighted_difference(v, y, weights)
        return self.rows.vector(difference)


@dataclass(frozen=True, eq=False)
class _Factored:
    """Operator C = L⁻¹G for normalised rows G (r, n) with GGᵀ = LLᵀ."""

    unit: SparseColumns
    gram: GramFactor
    count: int  #: r

    def __len__(self) -> int:
        return self.count

    def __matmul__(self, v: Vector) -> Vector:
        return self.gram.forward(self.unit @ v)

    @property
    def T(self) -> _FactoredTransposed:
        return _FactoredTransposed(self)


@dataclass(frozen=True, eq=False)
class _FactoredTransposed:
    C: _Factored

    def __matmul__(self, a: Vector) -> Vector:
        product: Vector = self.C.unit.T @ self.C.gram.backward(a)
        return product


def is_sparse(G: Matrix) -> bool:
    """Return True if G is distributed, or sparse and too large for a dense array."""
    if isinstance(G, DistributedColumns):
        return True
    return bool(issparse(G) and G.shape[0] * G.shape[1] > MAX_DENSE_ENTRIES)


def equality_rows(G: Matrix, e: Vector, bounded: Mask) -> Rows:
    """Orthonormalise the rows of G (m, n), with a sparse factor if G `is_sparse`.

    If the rows of such a G are linearly dependent, G is converted to a dense array. If
    the dense factorisation would exceed the memory limit, or if the columns of G are
    distributed over ranks, a maximal independent subset of the rows is used instead.

    bounded : (n,) mask of components with a bound
    """
    if not is_sparse(G):
        return orthonormal_rows(G, e)
    rows = _factored(G, e, bounded)
    if rows is not None:
        return rows
    m, n = G.shape
    if isinstance(G, DistributedColumns) or too_large(
        max(m, n), 3 * min(m, n) / max(m, n)
    ):
        return _independent_rows(G, e, bounded)
    return orthonormal_rows(G, e)


def _factored(G: SparseColumns, e: Vector, bounded: Mask) -> SparseRows | None:
    """Factorise GGᵀ; return None if the rows are linearly dependent."""
    over_ranks = isinstance(G, DistributedColumns)
    return (rows_over_ranks if over_ranks else sparse_rows)(G, e, bounded)


def _independent_rows(G: SparseColumns, e: Vector, bounded: Mask) -> SparseRows:
    """Replace G (m, n) by independent rows; multipliers of dropped rows are zero.

    Raises
    ------
    ValueError
        If the selected rows are linearly dependent up to rounding.

    """
    gram = _gram(G)
    kept = independent_rows(gram)
    rows = _factored(G[kept], e[kept], bounded)
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
    b = np.flatnonzero(np.asarray(bounded))
    unit: LocalRows | DistributedColumns
    of_bounded: LocalRows | DistributedColumns
    if isinstance(G, DistributedColumns):
        size = np.sqrt(_gram(G).diagonal())
        unit = G.scaled(1 / np.where(size > 0, size, 1.0))
        of_bounded = DistributedColumns(csr_array(unit.part[:, b]), unit.ranks)
        entries = np.diff(of_bounded.part.indptr)
        changing = unit.ranks.total(entries.astype(float)) > 0
    else:
        G = G if G.format == "csc" else csc_array(G)
        by_components, size = CompressedRows.of_transpose(G).unit_columns()
        unit, of_bounded = LocalRows(by_components), LocalRows(by_components.rows(b))
        changing = of_bounded.transposed.touched
    if not (size > 0).all():
        return None
    gram, has_border = _gram(unit), int(changing.sum()) <= MAX_BORDER
    try:
        factor = bordered_factor(gram, np.flatnonzero(changing & has_border))
    except DependentRowsError:
        return None
    if factor.least_pivot**2 <= RANK:
        return None
    whole = WholeGram(unit, gram, factor, has_border, b, of_bounded)
    return SparseRows(
        G=G,
        e_size=float(np.linalg.norm(e)),
        least_pivot=factor.least_pivot,
        C=_Factored(unit, whole, len(e)),
        x_tilde=unit.T @ factor(e / size),
        consistent=True,
        multipliers=lambda a: factor.backward(a) / size,
        unit=unit,
        gram=whole,
        bounded=b,
        of_bounded=of_bounded,
    )


def rows_over_ranks(
    G: DistributedColumns, e: Vector, bounded: Mask
) -> SparseRows | None:
    """Factorise GGᵀ of G (m, n) over ranks; return None for linearly dependent rows.

    e : (m,) replicated on all ranks
    """
    ranks, part = G.ranks, G.part
    size = np.sqrt(ranks.total(part.power(2).sum(axis=1)))
    if not (size > 0).all():
        return None
    with ranks.clocked("coarse"):
        at = touched_rows(np.flatnonzero(np.diff(part.indptr)), ranks)
        if not at.few_shared:
            return sparse_rows(G, e, bounded)
        rows, b = at.rows, np.flatnonzero(np.asarray(bounded))
        unit = csr_array(diags_array(1 / size[rows]) @ part[rows])
        by_components = CompressedRows.of_transpose(csc_array(unit))
        of_bounded = by_components.rows(b)
        changing = of_bounded.touched
        matrix = csc_array(unit @ unit.T)
        try:
            local = local_factor(matrix, at, changing & ~at.is_shared)
            factor = local.completed()
        except DependentRowsError:
            return None
        if factor.least_pivot <= np.sqrt(RANK):
            return None
        part_of_bounded = LocalRows(of_bounded, ranks)
        gram = _OverRanks(matrix, local, factor, b, part_of_bounded)

    def multipliers(a: Vector) -> Vector:
        whole = np.zeros(e.size)
        whole[rows] = np.asarray(factor.backward(a)) / at.touching
        return ranks.total(whole) / size

    own = LocalRows(by_components, ranks)
    return SparseRows(
        G=G,
        C=_Factored(own, gram, len(e)),
        e_size=float(np.linalg.norm(e)),
        least_pivot=factor.least_pivot,
        consistent=True,
        multipliers=multipliers,
        x_tilde=own.T @ factor(at.additive((e / size)[rows])),
        unit=own,
        gram=gram,
        bounded=b,
        of_bounded=part_of_bounded,
    )


def _gram(G: SparseColumns, columns: Mask | None = None) -> Matrix:
    """Return G_F G_Fᵀ for a mask F (n,) of columns; dense for few `LocalRows`."""
    if isinstance(G, DistributedColumns):
        return G.gram(columns)
    if isinstance(G, LocalRows):
        m, n = G.shape
        if m <= MAX_ARRAY_ROWS:
            weights = np.ones(n) if columns is None else columns.astype(float)
            place = np.arange(m, dtype=np.int32)
            return G.transposed.outer_products(weights, place, m)
        G = G.transposed.by_columns
    part = G if columns is None else G[:, np.flatnonzero(columns)]
    return csc_array(part @ part.T)


def orthonormal_rows(G: Matrix, e: Vector) -> DenseRows:
    """Compute C by a pivoted QR factorisation of the normalised rows of G (m, n)."""
    if not e.size:
        return _no_rows(G.shape[1])
    rows, triangle = compiled.orthonormal(as_dense(G), np.ascontiguousarray(e, float))
    dense, C, GC, e_size, least_pivot, x_tilde, consistent = rows
    multipliers = partial(compiled.multipliers, e.size, *triangle)
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
