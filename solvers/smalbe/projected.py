"""The homogenised, projected and normalised form of a bound and equality QP."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from typing import NamedTuple

import numpy as np

from mortarbench.harness import QP, Status, Vector
from mortarbench.harness.distributed.vectors import DistributedVector, distributed
from mortarbench.solvers.common.conversion import boxed
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

NOTHING = 1e-13  #: a norm of 𝒫F𝒫 below this times that of F is rounding


class Spectrum(NamedTuple):
    """The norm and the upper end of the spectrum of 𝒫F𝒫."""

    norm: float  #: ‖𝒫F𝒫‖, positive
    ritz: Ritz | None  #: None after the power method, which finds nothing else

    def orthogonal_to(self, rows: Rows) -> Spectrum:
        """Project the Ritz vectors of a problem with slightly other rows."""
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
    C: compiled.Rows  #: these, for the compiled loop
    spectrum: Spectrum
    b: Vector
    bounds: tuple[Vector, Vector]  #: of ν = x − x̃
    q: Vector  #: as given
    diagonal: Vector  #: of F; empty where an operator does not tell
    #: besides products with F
    counts: dict[str, int] = field(default_factory=partial(defaultdict, int))
    #: of the free part of a sparse F in scaled variables; None for none
    factor: compiled.IncompleteFactor | None = None
    #: of KKT residuals of the QP as given; None where ‖g^P‖ decides when to stop
    judge: compiled.Judge | None = None


class OuterIteration(NamedTuple):
    """One outer iteration, as it ended."""

    trace: str  #: the steps of its inner run
    M: float  #: with which that ran
    rho: float  #: with which that ran
    infeasibility: float  #: ‖Cν‖
    lagrangian: float  #: L(ν, μ), μ as in the inner run


class Iterate(NamedTuple):
    """The state of the outer loop."""

    nu: Vector  #: (n,)
    g: Vector  #: Hν − b + Cᵀμ
    mu: Vector  #: (r,) multipliers of Cν = 0, relative to ‖𝒫F𝒫‖
    M: float
    rho: float
    outer: tuple[OuterIteration, ...] = ()
    status: Status = Status.ITERATION_LIMIT

    @property
    def steps(self) -> str:
        """All inner steps so far, one letter each."""
        return "".join([o.trace for o in self.outer])


def projected_problem(
    qp: QP, find: Callable[[Product, compiled.Rows], Spectrum]
) -> Projected:
    """Homogenise, project and normalise; one product with F and those of `find`.

    find : looks for the spectrum of 𝒫F𝒫: `by_lanczos`, `by_power`, or one that is known
    """
    over = Reduction()
    if isinstance(qp.q, DistributedVector):
        over = Reduction(qp.q.ranks, distributed)
    F = Product(qp.P, qp.q.size, over)
    if is_sparse(qp.A):
        rows = equality_rows(qp.A, qp.b, boxed(qp))
    else:
        rows = orthonormal_rows(qp.A, qp.b)
    C, diagonal = compiled.Rows(rows, over), _diagonal(qp)
    spectrum = _not_vanishing(find(F, C), diagonal)
    b, bounds = compiled.homogenised(F, C, qp.q, qp.lb, qp.ub, spectrum.norm)
    return Projected(F, rows, C, spectrum, b, bounds, qp.q, diagonal)


def _diagonal(qp: QP) -> Vector:
    """Copy the diagonal of P; empty where that is an operator that does not tell."""
    if isinstance(qp.P, np.ndarray):
        return qp.P.diagonal().astype(float)
    diagonal = qp.diagonal()
    return np.zeros(0) if diagonal is None else np.array(diagonal)


def _not_vanishing(spectrum: Spectrum, diagonal: Vector) -> Spectrum:
    """Take the mean eigenvalue of P for a norm where 𝒫F𝒫 is zero, or rounding."""
    mean = float(np.add.reduce(diagonal)) / max(diagonal.size, 1)
    if spectrum.norm > NOTHING * mean:
        return spectrum
    return spectrum._replace(norm=mean or 1.0)


def by_lanczos(F: Product, C: compiled.Rows, *, steps: int) -> Spectrum:
    """Find the norm and the upper Ritz pairs; `steps` products."""
    start = random_start(C.given.x_tilde.size)
    ritz = Ritz(*compiled.lanczos(F, C, start, steps))
    return Spectrum(ritz.norm or 1.0, ritz)


def by_power(F: Product, C: compiled.Rows) -> Spectrum:
    """Find the norm as PERMON does; up to 50 products."""
    rows = C.given
    norm = power_method(partial(times_projected, F, rows), rows.x_tilde.size)
    return Spectrum(norm or 1.0, None)


def times_projected(F: Product, rows: Rows, v: Vector) -> Vector:
    """Return 𝒫F𝒫v."""
    return rows.project(F(rows.project(v)))
