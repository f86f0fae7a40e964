"""Homogenised, projected and normalised form of a QP with bounds and equalities."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from typing import NamedTuple

import numpy as np
from scipy.sparse import issparse

from mortarbench.harness import QP, Discs, Matrix, Status, Vector
from mortarbench.harness.operators import is_semidefinite
from mortarbench.harness.sets.convex import hull
from mortarbench.solvers.smalbe import compiled
from mortarbench.solvers.smalbe.compiled import Product
from mortarbench.solvers.smalbe.rows import (
    Rows,
    SparseRows,
    equality_rows,
    is_sparse,
    orthonormal_rows,
)
from mortarbench.solvers.smalbe.spectrum import Ritz, random_start


class Spectrum(NamedTuple):
    """Norm and upper end of the spectrum of 𝒫F𝒫."""

    norm: float  #: ‖𝒫F𝒫‖, positive
    ritz: Ritz | None  #: upper Ritz pairs; None if they were not computed


@dataclass(eq=False)
class Projected:
    """Result of steps 1 to 3 of SMALBE: data of H = 𝒫F𝒫/‖𝒫F𝒫‖ + ρQ, and b."""

    F: Product
    rows: Rows
    C: compiled.Rows  #: `rows` for the compiled algorithm
    spectrum: Spectrum
    b: Vector
    bounds: tuple[Vector, Vector]  #: bounds of ν = x − x̃
    q: Vector  #: q of the original QP
    diagonal: Vector  #: diagonal of F; empty for an operator F without a known diagonal
    #: counts of operations other than products with F
    counts: dict[str, int] = field(default_factory=partial(defaultdict, int))
    #: incomplete factor of the free block of a sparse F, or None
    factor: compiled.IncompleteFactor | None = None
    discs: tuple[Discs, ...] = ()  #: discs of x, not of ν
    semidefinite: bool = False  #: True if F has a kernel, see `is_semidefinite`

    @property
    def hull(self) -> tuple[Vector, Vector]:
        """Bounds (n,) of the smallest box that contains all feasible ν."""
        if not self.discs:
            return self.bounds
        lower, upper = (bound.copy() for bound in self.bounds)
        for one in self.discs:
            shift, radius = self.rows.x_tilde[one.index], one.radius[:, None]
            lower[one.index], upper[one.index] = -radius - shift, radius - shift
        return lower, upper


class OuterIteration(NamedTuple):
    """Result of one outer iteration."""

    trace: str  #: letters of the steps of the inner run
    M: float  #: precision M of the inner run
    rho: float  #: penalty ρ of the inner run
    infeasibility: float  #: ‖Cν‖
    lagrangian: float  #: L(ν, μ) with the μ of the inner run


class Iterate(NamedTuple):
    """State of the outer loop."""

    nu: Vector  #: (n,)
    g: Vector  #: Hν − b + Cᵀμ
    mu: Vector  #: (r,) multipliers of Cν = 0, relative to ‖𝒫F𝒫‖
    M: float
    rho: float
    outer: tuple[OuterIteration, ...] = ()
    status: Status = Status.ITERATION_LIMIT

    @property
    def steps(self) -> str:
        """Letters of all inner steps so far."""
        return "".join([o.trace for o in self.outer])


def projected_problem(
    qp: QP,
    find: Callable[[Product, compiled.Rows], Spectrum],
    known: Rows | None = None,
) -> Projected:
    """Homogenise, project and normalise a QP.

    If x̃ ≠ 0, this takes one product in addition to the products of `find`.

    find : function that returns the spectrum of 𝒫F𝒫, such as `by_lanczos`
    known : the rows of an earlier QP with the same A and b, or None
    """
    F = Product(qp.P, qp.q.size)
    discs = tuple(one for one in qp.sets if isinstance(one, Discs))
    rows: Rows
    if is_sparse(qp.A):
        lower, upper = hull(qp.sets, qp.q.size)
        bounded = np.isfinite(lower) | np.isfinite(upper)
        if isinstance(known, SparseRows):
            same = np.array_equal(known.bounded, np.flatnonzero(bounded))
            known = known if same else None
        rows = known or equality_rows(qp.A, qp.b, bounded)
    else:
        rows = known or orthonormal_rows(qp.A, qp.b)
    C, diagonal = compiled.Rows(rows), _diagonal(qp)
    spectrum, box = find(F, C), qp.box
    b, bounds, norm = compiled.homogenised(
        F, C, qp.q, box.lower, box.upper, diagonal, spectrum.norm
    )
    if norm != spectrum.norm:
        spectrum = spectrum._replace(norm=norm)
    return Projected(
        F,
        rows,
        C,
        spectrum,
        b,
        bounds,
        qp.q,
        diagonal,
        discs=discs,
        semidefinite=is_semidefinite(qp.P),
    )


def _diagonal(qp: QP) -> Vector:
    """Return a copy of the diagonal of P, or an empty array if it is unknown."""
    if isinstance(qp.P, np.ndarray):
        return qp.P.diagonal().astype(float)
    diagonal = qp.diagonal()
    return np.zeros(0) if diagonal is None else np.array(diagonal)


def by_lanczos(
    F: Product, C: compiled.Rows, *, steps: int, start: Vector | None = None
) -> Spectrum:
    """Estimate the norm and the upper Ritz pairs with at most `steps` products.

    start : (n,) start vector; default: random
    """
    start = random_start(C.n) if start is None else start
    ritz = Ritz(*compiled.lanczos(F, C, start, steps))
    return Spectrum(ritz.norm or 1.0, ritz)


def unchanged(A: Matrix, B: Matrix) -> bool:
    """Return True if two matrices have the same entries, stored in the same way."""
    if A is B or A.shape != B.shape:
        return A is B
    if not issparse(A) or not issparse(B) or A.format != B.format:
        return type(A) is type(B) and np.array_equal(A, B)
    parts = ("data", "indices", "indptr")
    return all(np.array_equal(getattr(A, p), getattr(B, p)) for p in parts)
