"""The homogenised, projected and normalised form of a bound and equality QP."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from typing import NamedTuple

import numpy as np

from mortarbench.harness import QP, Discs, Status, Vector
from mortarbench.harness.distributed.vectors import DistributedVector, distributed
from mortarbench.harness.sets.convex import hull
from mortarbench.solvers.smalbe import compiled
from mortarbench.solvers.smalbe.compiled import Product, Reduction
from mortarbench.solvers.smalbe.rows import (
    DenseRows,
    Rows,
    equality_rows,
    is_sparse,
    orthonormal_rows,
)
from mortarbench.solvers.smalbe.spectrum import Ritz, power_method, random_start

NORM_ROUNDING = 1e-13  #: 𝒫F𝒫 counts as zero if its norm is below this times ‖F‖


class Spectrum(NamedTuple):
    """The norm and the upper end of the spectrum of 𝒫F𝒫."""

    norm: float  #: ‖𝒫F𝒫‖, positive
    ritz: Ritz | None  #: None after the power method

    def orthogonal_to(self, rows: Rows) -> Spectrum:
        """Return the spectrum with Ritz vectors projected onto the kernel of `rows`."""
        if self.ritz is None or not isinstance(rows, DenseRows):
            return self
        V, R = np.linalg.qr(rows.project(self.ritz.vectors.T))
        vectors = np.ascontiguousarray((V * np.sign(np.diag(R))).T)
        return self._replace(ritz=self.ritz._replace(vectors=vectors))


@dataclass(eq=False)
class Projected:
    """Steps 1 to 3 of SMALBE: H = 𝒫F𝒫/‖𝒫F𝒫‖ + ρQ and b."""

    F: Product
    rows: Rows
    C: compiled.Rows  #: `rows` as the compiled loop takes them
    spectrum: Spectrum
    b: Vector
    bounds: tuple[Vector, Vector]  #: of ν = x − x̃
    q: Vector  #: of the original QP
    diagonal: Vector  #: of F; empty for an operator without one
    #: counts other than products with F
    counts: dict[str, int] = field(default_factory=partial(defaultdict, int))
    #: of the free part of a sparse F in scaled variables; None for none
    factor: compiled.IncompleteFactor | None = None
    #: of KKT residuals of the QP as given; None where ‖g^P‖ decides when to stop
    judge: compiled.Judge | None = None
    discs: tuple[Discs, ...] = ()  #: of x

    @property
    def hull(self) -> tuple[Vector, Vector]:
        """The smallest box that contains ν."""
        lower, upper = (bound.copy() for bound in self.bounds)
        for one in self.discs:
            shift, radius = self.rows.x_tilde[one.index], one.radius[:, None]
            lower[one.index], upper[one.index] = -radius - shift, radius - shift
        return lower, upper


class OuterIteration(NamedTuple):
    """Result of one outer iteration."""

    trace: str  #: the steps of its inner run
    M: float  #: precision M of its inner run
    rho: float  #: penalty ρ of its inner run
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
    qp: QP, find: Callable[[Product, compiled.Rows], Spectrum]
) -> Projected:
    """Homogenise, project and normalise; one product with F and those of `find`.

    find : estimates the spectrum of 𝒫F𝒫: `by_lanczos`, `by_power`, or a stored result
    """
    over = Reduction()
    if isinstance(qp.q, DistributedVector):
        over = Reduction(qp.q.ranks, distributed)
    F = Product(qp.P, qp.q.size, over)
    discs = tuple(one for one in qp.sets if isinstance(one, Discs))
    if is_sparse(qp.A):
        lower, upper = hull(qp.sets, qp.q.size)
        rows = equality_rows(qp.A, qp.b, np.isfinite(lower) | np.isfinite(upper))
    else:
        rows = orthonormal_rows(qp.A, qp.b)
    C, diagonal = compiled.Rows(rows, over), _diagonal(qp)
    spectrum = _not_vanishing(find(F, C), diagonal)
    b, bounds = compiled.homogenised(F, C, qp.q, qp.lb, qp.ub, spectrum.norm)
    return Projected(F, rows, C, spectrum, b, bounds, qp.q, diagonal, discs=discs)


def _diagonal(qp: QP) -> Vector:
    """Return a copy of the diagonal of P; empty for an operator without one."""
    if isinstance(qp.P, np.ndarray):
        return qp.P.diagonal().astype(float)
    diagonal = qp.diagonal()
    return np.zeros(0) if diagonal is None else np.array(diagonal)


def _not_vanishing(spectrum: Spectrum, diagonal: Vector) -> Spectrum:
    """Replace a norm that is zero up to rounding by the mean eigenvalue of P."""
    mean = float(np.add.reduce(diagonal)) / max(diagonal.size, 1)
    if spectrum.norm > NORM_ROUNDING * mean:
        return spectrum
    return spectrum._replace(norm=mean or 1.0)


def by_lanczos(
    F: Product, C: compiled.Rows, *, steps: int, start: Vector | None = None
) -> Spectrum:
    """Estimate the norm and the upper Ritz pairs by `steps` products.

    start : (n,), by default random
    """
    start = random_start(C.source.x_tilde.size) if start is None else start
    ritz = Ritz(*compiled.lanczos(F, C, start, steps))
    return Spectrum(ritz.norm or 1.0, ritz)


def by_power(F: Product, C: compiled.Rows) -> Spectrum:
    """Estimate the norm by PERMON's power method; up to 50 products."""
    rows = C.source
    norm = power_method(partial(times_projected, F, rows), rows.x_tilde.size)
    return Spectrum(norm or 1.0, None)


def times_projected(F: Product, rows: Rows, v: Vector) -> Vector:
    """Return 𝒫F𝒫v."""
    return rows.project(F(rows.project(v)))
