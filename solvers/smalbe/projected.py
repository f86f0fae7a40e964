"""The homogenised, projected and normalised form of a bound and equality QP."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from mortarbench.harness import QP, Matrix, Vector
from mortarbench.harness.distributed.vectors import DistributedVector
from mortarbench.solvers.common.conversion import boxed
from mortarbench.solvers.smalbe import compiled, kernels
from mortarbench.solvers.smalbe.compiled import Product
from mortarbench.solvers.smalbe.model import BoxModel, Model
from mortarbench.solvers.smalbe.rows import Rows, equality_rows, prepared_rows
from mortarbench.solvers.smalbe.spectrum import (
    Ritz,
    lanczos,
    power_method,
    random_start,
    size,
)

NOTHING = 1e-13  #: a norm of 𝒫F𝒫 below this times that of F is rounding
FOUND = 1e-3  #: residual over value of the first Ritz pair where the spectrum decays
TAIL = 1e-4  #: least τ of a model, relative to the norm


class Spectrum(NamedTuple):
    """What is known of 𝒫F𝒫."""

    norm: float  #: ‖𝒫F𝒫‖, positive
    ritz: Ritz | None  #: None after the power method, which finds nothing else

    def orthogonal_to(self, rows: Rows) -> Spectrum:
        """Take it over to a problem with slightly other rows."""
        if self.ritz is None:
            return self
        V, R = np.linalg.qr(rows.project(self.ritz.vectors.T))
        vectors = np.ascontiguousarray((V * np.sign(np.diag(R))).T)
        return self._replace(ritz=self.ritz._replace(vectors=vectors))


@dataclass(eq=False)
class CountedProduct:
    """v → Fv of an operator over ranks, counted."""

    F: Matrix
    count: int = 0

    def __call__(self, v: Vector) -> Vector:
        self.count += 1
        product: Vector = self.F @ v
        return product


@dataclass(frozen=True, eq=False)
class Projected:
    """Steps 1 to 3 of SMALBE: H = 𝒫F𝒫/‖𝒫F𝒫‖ + ρQ and b."""

    F: Product | CountedProduct
    rows: Rows
    spectrum: Spectrum
    b: Vector
    bounds: tuple[Vector, Vector]  #: of ν = x − x̃
    q: Vector  #: as given
    diagonal: Vector  #: of F; empty where an operator does not tell
    #: besides products with F
    counts: dict[str, int] = field(default_factory=partial(defaultdict, int))

    def energy_error(self, nu: Vector, gradient: Vector) -> float:
        """Estimate the relative energy error from what is left of the gradient.

        ‖x − x*‖_F² = rᵀF_ff⁻¹r with the gradient r on the free set, of which every
        rᵢ²/F_ii is a lower bound. The root of their sum was 0.8 to 8.4 times below the
        certified error of the contact problems at hand. Gradients that are rounding of
        q do not count. Zero where F is an operator.
        """
        energy = abs(self.q @ (self.rows.x_tilde + nu))
        r = self.spectrum.norm * gradient
        noise = 1e3 * np.finfo(float).eps * np.abs(self.q).max(initial=0.0)
        if not self.diagonal.size:
            return 0.0
        told = (self.diagonal > 0) & (np.abs(r) > noise)
        squares = r[told] ** 2 / self.diagonal[told]
        return float(np.sqrt(squares.sum() / energy)) if energy else 0.0

    def H(self, v: Vector, rho: float) -> Vector:
        """Apply H; one product with F."""
        C = self.rows.C
        Cv = C @ v
        Fv = self.F(self.rows.combined(1.0, v, -1.0, Cv))
        scale = 1 / self.spectrum.norm
        shift = kernels.combined(rho, Cv, -scale, C @ Fv)
        return self.rows.combined(scale, Fv, 1.0, shift)

    def model(self, rho: float) -> BoxModel:
        """Model H by the Ritz pairs and the rows C.

        The last but one Ritz value, with its residual, is taken for the norm of 𝒫F𝒫 on
        what the Ritz vectors before it leave (the last, where the process came to its
        end; the first whose residual exceeds its value); ρQ is taken as it is. Where
        that is too little, MPRGP raises τ by what its products show. In a flat spectrum
        a short process finds not even the first eigenvector, and Ritz vectors that are
        none would slow CG down: then only the norm is used.
        """
        above, U, tail = self.upper_end()
        return self.rows.model(tail, above, U, rho)

    def upper_end(self) -> tuple[Vector, NDArray[np.float64], float]:
        """Return the Ritz pairs (k,), (k, n) that a model holds, and its τ."""
        ritz = self.spectrum.ritz
        if ritz is None:
            raise ValueError("the power method found no Ritz pairs")
        above = (ritz.values + ritz.residuals) / self.spectrum.norm
        ended = ritz.residuals[-1] <= 1e-10 * ritz.values[0]
        kept = max(len(above) - (1 if ended else 2), 0)
        unknown = np.flatnonzero(ritz.residuals > ritz.values)
        kept = min([kept, *unknown[:1]])
        if ritz.residuals[0] > FOUND * ritz.values[0]:
            kept = 0
        return above[:kept], ritz.vectors[:kept], max(float(above[kept]), TAIL)

    def penalty(self, rho: float) -> BoxModel:
        """Model H by I + (ρ − 1)Q, all that is known without Ritz pairs."""
        return self.rows.model(1.0, np.zeros(0), np.zeros((0, self.b.size)), rho)

    def plain_model(self, rho: float, *, alpha: float) -> Model:
        """Model H by ‖H‖ = max(1, ρ) alone, ᾱ = alpha/‖H‖."""
        norm = max(1.0, rho if len(self.rows.C) else 0.0)
        return Model.of_norm(norm / alpha, self.b.size)


def projected_problem(
    qp: QP, find: Callable[[Callable[[Vector], Vector], Rows], Spectrum]
) -> Projected:
    """Homogenise, project and normalise; one product with F and those of `find`.

    find : looks for the spectrum of 𝒫F𝒫: `by_lanczos`, `by_power`, or one that is known
    """
    on_ranks = isinstance(qp.q, DistributedVector)
    F = CountedProduct(qp.P) if on_ranks else Product(qp.P, qp.q.size)
    rows = equality_rows(qp.A, qp.b, boxed(qp))
    spectrum = find(lambda v: rows.project(F(rows.project(v))), rows)
    return _normalised(qp, F, rows, spectrum)


def prepared_problem(qp: QP, steps: int) -> Projected:
    """Do what `projected_problem` does with `by_lanczos`, compiled."""
    F, rows = Product(qp.P, qp.q.size), prepared_rows(qp.A, qp.b)
    ritz = Ritz(*compiled.lanczos(F, rows.C, random_start(qp.q.size), steps))
    diagonal = _diagonal(qp)
    spectrum = _not_vanishing(Spectrum(ritz.norm or 1.0, ritz), diagonal)
    b, bounds = compiled.homogenised(
        F, rows.C, rows.x_tilde, qp.q, qp.lb, qp.ub, spectrum.norm
    )
    return Projected(F, rows, spectrum, b, bounds, qp.q, diagonal)


def _normalised(
    qp: QP, F: Product | CountedProduct, rows: Rows, spectrum: Spectrum
) -> Projected:
    diagonal = _diagonal(qp)
    spectrum = _not_vanishing(spectrum, diagonal)
    d = -qp.q - F(rows.x_tilde) if rows.x_tilde.any() else -qp.q
    bounds = (qp.lb - rows.x_tilde, qp.ub - rows.x_tilde)
    b = rows.project(d) / spectrum.norm
    if np.linalg.norm(b) <= 1e-14 * np.linalg.norm(d) / spectrum.norm:
        b = np.zeros_like(b)  # nothing but rounding errors is left of d
    return Projected(F, rows, spectrum, b, bounds, qp.q, diagonal)


def _diagonal(qp: QP) -> Vector:
    """Copy the diagonal of P; empty where that is an operator that does not tell."""
    if isinstance(qp.P, np.ndarray):
        return qp.P.diagonal().astype(float)
    diagonal = qp.diagonal()
    return np.zeros(0) if diagonal is None else np.array(diagonal)


def _not_vanishing(spectrum: Spectrum, diagonal: Vector) -> Spectrum:
    """Have the mean eigenvalue of P for a norm where 𝒫F𝒫 is zero, or rounding."""
    mean = float(np.add.reduce(diagonal)) / max(diagonal.size, 1)
    if spectrum.norm > NOTHING * mean:
        return spectrum
    return spectrum._replace(norm=mean or 1.0)


def by_lanczos(PFP: Callable[[Vector], Vector], rows: Rows, *, steps: int) -> Spectrum:
    """Find the norm and the upper Ritz pairs; `steps` products."""
    start = rows.project(random_start(rows.x_tilde.size))
    steps = min(steps, size(start) - len(rows.C))  # the dimension of the range of 𝒫
    ritz = lanczos(PFP, start, steps)
    return Spectrum(ritz.norm or 1.0, ritz)


def by_power(PFP: Callable[[Vector], Vector], rows: Rows) -> Spectrum:
    """Find the norm as PERMON does; up to 50 products."""
    return Spectrum(power_method(PFP, rows.x_tilde.size) or 1.0, None)
