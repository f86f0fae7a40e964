"""The projected problem, its operator, and models of the operator, in NumPy."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import eigh_tridiagonal, eigvalsh_tridiagonal

from mortarbench.harness import QP, Vector
from mortarbench.solvers.common.conversion import has_bound
from mortarbench.solvers.smalbe import projected
from mortarbench.solvers.smalbe import rows as given
from mortarbench.solvers.smalbe.compiled import Product, Rows
from mortarbench.solvers.smalbe.projected import Spectrum, _diagonal
from mortarbench.solvers.smalbe.rows import equality_rows, is_sparse
from mortarbench.solvers.smalbe.spectrum import Ritz, random_start
from tests.support.textbook import kernels
from tests.support.textbook.model import BoxModel, Model
from tests.support.textbook.rows import model_of, orthonormal_rows

FEW = 5  #: number of Lanczos steps after which a flat spectrum is detected
FLAT = 10.0  #: largest ratio of Ritz values in a spectrum that counts as flat
FOUND = 1e-3  #: largest residual / value of the first Ritz pair in a decaying spectrum
TAIL = 1e-4  #: smallest τ of a model, relative to the norm


@dataclass(eq=False)
class Projected(projected.Projected):
    """Steps 1 to 3 of SMALBE: H = 𝒫F𝒫/‖𝒫F𝒫‖ + ρQ and b."""

    def energy_error(self, nu: Vector, gradient: Vector) -> float:
        """Estimate the relative energy error from the residual gradient.

        ‖x − x*‖_F² = rᵀF_ff⁻¹r with the gradient r on the free set, and every rᵢ²/F_ii
        is a lower bound. The certified error of the tested contact problems was 0.8 to
        8.4 times the root of the sum of these bounds. Gradients within the rounding
        error of q are ignored. The estimate is zero if F is an operator.
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

        The penultimate Ritz value plus its residual estimates the norm of 𝒫F𝒫 on the
        complement of the preceding Ritz vectors. (If the process terminated, the last
        Ritz value is used instead; if the residual of an earlier Ritz value exceeds
        this value, the first such Ritz value is used.) ρQ is used exactly. If the
        estimate is too small, MPRGP raises τ according to its products. In a flat
        spectrum, a short process does not even find the first eigenvector, and
        inaccurate Ritz vectors would slow CG down; then only the norm is used.
        """
        above, U, tail = self.upper_end()
        return model_of(self.rows, tail, above, U, rho)

    def upper_end(self) -> tuple[Vector, NDArray[np.float64], float]:
        """Return the Ritz values (k,) and vectors (k, n) of a model, and its τ."""
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
        """Model H by I + (ρ − 1)Q, which needs no Ritz pairs."""
        return model_of(self.rows, 1.0, np.zeros(0), np.zeros((0, self.b.size)), rho)

    def plain_model(self, rho: float, *, alpha: float) -> Model:
        """Model H only by ‖H‖ = max(1, ρ), with ᾱ = alpha/‖H‖."""
        norm = max(1.0, rho if len(self.rows.C) else 0.0)
        return Model.of_norm(norm / alpha, self.b.size)


def projected_problem(
    qp: QP, find: Callable[[Callable[[Vector], Vector], given.Rows], Spectrum]
) -> Projected:
    """Homogenise, project and normalise the QP.

    This needs at most one product with F, and the products of `find`.
    """
    F = Product(qp.P, qp.q.size)
    if is_sparse(qp.A):
        rows = equality_rows(qp.A, qp.b, has_bound(qp))
    else:
        rows = orthonormal_rows(qp.A, qp.b)
    spectrum = find(lambda v: rows.project(F(rows.project(v))), rows)
    diagonal = _diagonal(qp)
    mean = diagonal.mean() if diagonal.size else 0.0
    if not spectrum.norm > 1e-13 * mean:
        spectrum = spectrum._replace(norm=mean or 1.0)
    d = -qp.q - F(rows.x_tilde) if rows.x_tilde.any() else -qp.q
    bounds = (qp.lb - rows.x_tilde, qp.ub - rows.x_tilde)
    b = rows.project(d) / spectrum.norm
    if np.linalg.norm(b) <= 1e-14 * np.linalg.norm(d) / spectrum.norm:
        b = np.zeros_like(b)  # b consists only of rounding errors of d
    C = Rows(rows)
    return Projected(F, rows, C, spectrum, b, bounds, qp.q, diagonal)


def by_lanczos(
    PFP: Callable[[Vector], Vector], rows: given.Rows, *, steps: int
) -> Spectrum:
    """Find the norm and the upper Ritz pairs with at most `steps` products."""
    start = rows.project(random_start(rows.x_tilde.size))
    steps = min(steps, size(start) - len(rows.C))  # the dimension of the range of 𝒫
    ritz = lanczos(PFP, start, steps)
    return Spectrum(ritz.norm or 1.0, ritz)


def size(v: Vector) -> int:
    """Return the number of components of a vector, over all ranks."""
    return int((np.zeros_like(v) + 1).sum())


def lanczos(H: Callable[[Vector], Vector], start: Vector, steps: int) -> Ritz:
    """Run at most `steps` Lanczos steps, fully reorthogonalised, with one product each.

    After the three-term recurrence, a single pass over all vectors makes the next
    vector orthogonal to them up to rounding. The residual of the pair (θ, Vᵀs) is
    |β s_k| with the last off-diagonal entry β. A start vector in an invariant subspace
    keeps the process in that subspace. The process ends after FEW steps if all Ritz
    values are of similar size, because conjugate gradients then need few steps and no
    model.
    """
    basis = np.zeros((min(steps, size(start)), start.size))
    diagonal: list[float] = []
    off: list[float] = []
    v, beta = start, float(np.linalg.norm(start))
    for k in range(len(basis) if beta else 0):
        basis[k] = v / beta
        v = H(basis[k])
        diagonal.append(float(basis[k] @ v))
        v = v - diagonal[-1] * basis[k]
        if k:
            v = v - beta * basis[k - 1]
        v = v - basis[: k + 1].T @ (basis[: k + 1] @ v)
        beta = float(np.linalg.norm(v))
        off.append(beta)
        if beta <= 1e-12 * max(map(abs, diagonal)):
            break
        if k + 1 == FEW:
            values = eigvalsh_tridiagonal(np.array(diagonal), np.array(off[:-1]))
            if values[0] >= values[-1] / FLAT:
                break
    if not diagonal:
        return Ritz(np.zeros(1), np.zeros(1), np.zeros((1, start.size)), 0.0)
    theta, S = eigh_tridiagonal(np.array(diagonal), np.array(off[:-1]))
    vectors = S.T @ basis[: len(theta)]
    residuals = off[-1] * np.abs(S[-1, ::-1])
    return Ritz(theta[::-1], residuals, vectors[::-1], diagonal[0])
