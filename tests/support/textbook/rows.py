"""Equality rows, orthonormalised by QR, and models of their penalty term."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import qr, solve_triangular

from mortarbench.harness import Matrix, Vector
from mortarbench.harness.distributed.sparse import BorderedFactor
from mortarbench.solvers.smalbe import compiled
from mortarbench.solvers.smalbe.rows import (
    RANK,
    DenseRows,
    Mask,
    Rows,
    SparseRows,
    _consistent,
    as_dense,
)
from tests.support.textbook import kernels
from tests.support.textbook.model import BoxModel, Model, Tilted, minimised

NO_SHIFT = 1e-13  #: ratio ‖x̃‖/‖ν‖ up to which x̃ is attributed to rounding of e = 0


def met(rows: Rows, nu: Vector, tol: float, least: float) -> bool:
    """Return True if ‖Cν‖ ≤ tol‖x̃‖ and ‖Gν‖ ≤ tol‖e‖.

    If e = 0, or if x̃ is within the rounding error of ν, the criterion is
    ‖Cν‖ ≤ tol·max(‖ν‖, `least`).
    """
    Cnu, nu_size = rows.C @ nu, float(np.linalg.norm(nu))
    size = float(np.linalg.norm(rows.x_tilde))
    if rows.e_size == 0 or size <= NO_SHIFT * nu_size:
        return bool(np.linalg.norm(Cnu) <= tol * max(nu_size, least))
    return bool(
        np.linalg.norm(Cnu) <= tol * size
        and np.linalg.norm(_missed(rows, nu, Cnu)) <= tol * rows.e_size
    )


def _missed(rows: Rows, nu: Vector, Cnu: Vector) -> Vector:
    """Return Gν (m,)."""
    if isinstance(rows, DenseRows):
        return np.asarray(rows.GC @ Cnu)
    assert isinstance(rows, SparseRows)
    return np.asarray(rows.G @ nu)


def violation(rows: Rows, nu: Vector) -> float:
    """Return ‖Cν‖."""
    return float(np.linalg.norm(rows.C @ nu))


def model_of(
    rows: Rows, tau: float, above: Vector, U: NDArray[np.float64], rho: float
) -> BoxModel:
    """Model τI + Σ (aboveᵢ − τ)uᵢuᵢᵀ + (ρ − τ)CᵀC; drop terms with negative factors."""
    if isinstance(rows, DenseRows):
        w = np.append(above, np.full(len(rows.C), rho))
        return Model(0.0, np.vstack([U, rows.C]), w).with_tail(tau)
    assert isinstance(rows, SparseRows)
    # many rows indicate many subdomains; the spectrum then has no isolated eigenvalues
    if rho <= tau:
        return Model.of_norm(tau, rows.x_tilde.size)
    return PenaltyModel(tau, rows, rho - tau)


@dataclass(frozen=True, eq=False)
class PenaltyModel:
    """B = τI + w Gᵀ(GGᵀ)⁻¹G, which is τI + wCᵀC."""

    tau: float
    rows: SparseRows
    w: float  #: positive weight of CᵀC

    has_directions = True

    def step(self, x: Vector, g: Vector, bounds: tuple[Vector, Vector]) -> Vector:
        """Return s = argmin gᵀs + ½sᵀBs subject to l ≤ x + s ≤ u.

        The method is that of `Model.step` with the multiplier y = w(GGᵀ)⁻¹Gs of t = Gs:
        the gradient of the dual function is Gs(y) − GGᵀy/w. On components without
        bounds, s = −(g + Gᵀy)/τ, so that only the components b with bounds are
        evaluated for each y:

            Gs = G_b(s_b + (g_b + G_bᵀy)/τ) − (Gg + GGᵀy)/τ
        """
        rows, tau, w = self.rows, self.tau, self.w
        b, G_b = rows.bounded, rows.of_bounded
        x_b, g_b, box = x[b], g[b], (bounds[0][b], bounds[1][b])
        Gg = rows.unit.transposed_times(g)

        def at(y: Vector) -> Tilted:
            tilt = g_b + G_b @ y
            s_b, piece = kernels.tilted_step(x_b, tilt, tau, *box)
            held = G_b.transposed_times(kernels.combined(1 / tau, tilt, 1.0, s_b))
            shift = kernels.combined(1 / tau, Gg, 1 / tau + 1 / w, rows.matrix @ y)
            return Tilted(s_b, piece, held - shift)

        def newton(slope: Vector, free: Mask) -> Vector:
            of_all = np.ones(x.size, dtype=bool)
            of_all[b] = free
            return tau * factor_in_face(rows, of_all, tau / w)(slope)

        found = minimised(at, newton, rows.unit.shape[1])
        if found is None:
            return Model.of_norm(tau + w, x.size).step(x, g, bounds)
        y, there = found
        s: Vector = kernels.combined(-1 / tau, g, -1 / tau, rows.unit @ y)
        s[b] = there.s
        return s

    def raised(self, s: Vector, sHs: float) -> BoxModel:
        """Return the model with τ raised as in `Model.raised`."""
        Cs = self.rows.C @ s
        part, square = float(Cs @ Cs), float(s @ s)
        rest = square - part
        missing = sHs - self.tau * square - self.w * part
        tau = self.tau + missing / rest if rest > 0 else np.inf
        tau = min(max(tau, self.tau), 10 * self.tau)
        w = self.w + self.tau - tau
        if w <= 0:
            return Model.of_norm(tau, s.size)
        return PenaltyModel(tau, self.rows, w)

    def relaxed(self, factor: float) -> PenaltyModel:
        """Return the model with τ divided as in `Model.relaxed`."""
        return replace(self, tau=self.tau / factor)

    def inverse_in(self, free: Mask) -> Callable[[Vector], Vector]:
        """Return v → B_FF⁻¹v_F, zero off the face F."""
        G, solve = self.rows.unit, factor_in_face(self.rows, free, self.tau / self.w)
        inverse = np.where(free, 1 / self.tau, 0.0)

        def apply(v: Vector) -> Vector:
            v = np.where(free, v, 0.0)
            y = solve(G.transposed_times(v))
            return kernels.weighted_difference(v, G @ y, inverse)

        return apply


def factor_in_face(rows: SparseRows, free: Mask, shift: float) -> BorderedFactor:
    """Return the factor of G_F G_Fᵀ + shift·GGᵀ, where F is `free` (n,)."""
    if not rows.has_border:
        return rows.factorised(free, shift)
    active = (~np.asarray(free)[rows.bounded]).astype(float)
    return rows.factor.shifted_without(shift, rows.of_bounded, active)


def orthonormal_rows(G: Matrix, e: Vector) -> DenseRows:
    """Compute C by a pivoted QR factorisation of the normalised rows of G (m, n)."""
    dense = as_dense(G)
    size = np.linalg.norm(dense, axis=1)
    size[size == 0] = 1.0
    Q, R, pivot = qr((dense / size[:, None]).T, mode="economic", pivoting=True)
    rank = int((np.abs(np.diag(R)) > RANK).sum())
    C, R, kept = Q[:, :rank].T, R[:rank, :rank], pivot[:rank]
    x_tilde = C.T @ solve_triangular(R, (e / size)[kept], trans="T")
    triangle = np.ascontiguousarray(R), kept.astype(np.int32), size
    multipliers = partial(compiled.multipliers, e.size, *triangle)
    consistent = _consistent((dense @ x_tilde - e) / size, x_tilde, e / size)
    C, e_size = np.ascontiguousarray(C), float(np.linalg.norm(e))
    pivot_size = float(np.abs(np.diag(R)).min(initial=1.0))
    return DenseRows(
        dense, C, e_size, pivot_size, x_tilde, consistent, multipliers, dense @ C.T
    )
