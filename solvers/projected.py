"""The homogenised, projected and normalised form of a bound and equality QP."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import qr, solve_triangular

from harness import QP, Matrix, Vector
from solvers.spectrum import norm_estimate

RANK = 1e-13  #: pivots of the normalised rows below this are rounding errors


class Rows(NamedTuple):
    """Equality rows Gx = e as Cx = C x̃ with orthonormal C."""

    C: NDArray[np.float64]  #: (r, n)
    x_tilde: Vector  #: (n,) the shortest x with Gx = e
    consistent: bool  #: whether there is one
    multipliers: Callable[[Vector], Vector]  #: a (r,) → y (m,) with Gᵀy = Cᵀa


@dataclass(frozen=True, eq=False)
class Projected:
    """Steps 1 to 3 of SMALBE: H = 𝒫F𝒫/‖𝒫F𝒫‖ + ρQ and b."""

    F: Callable[[Vector], Vector]  #: counts its calls
    counts: Counter[str]
    rows: Rows
    norm: float  #: ‖𝒫F𝒫‖
    b: Vector
    bounds: tuple[Vector, Vector]  #: of ν = x − x̃

    def step(self, rho: float) -> float:
        """Length ᾱ < 2/‖H‖ of a gradient projection step, ‖H‖ = max(1, ρ)."""
        return 1.9 / max(1.0, rho if len(self.rows.C) else 0.0)

    def H(self, v: Vector, rho: float) -> Vector:
        """Apply H; one product with F."""
        C = self.rows.C
        Qv = C.T @ (C @ v)
        Fv = self.F(v - Qv)
        return (Fv - C.T @ (C @ Fv)) / self.norm + rho * Qv


def orthonormal_rows(G: Matrix, e: Vector) -> Rows:
    """Find C by a pivoted QR factorisation of the normalised rows of G (m, n)."""
    dense = np.asarray(G.toarray() if hasattr(G, "toarray") else G, dtype=float)
    size = np.linalg.norm(dense, axis=1)
    size[size == 0] = 1.0
    Q, R, pivot = qr((dense / size[:, None]).T, mode="economic", pivoting=True)
    rank = int((np.abs(np.diag(R)) > RANK).sum())
    C, R, kept = Q[:, :rank].T, R[:rank, :rank], pivot[:rank]
    x_tilde = C.T @ solve_triangular(R, (e / size)[kept], trans="T")
    mismatch = np.abs(dense @ x_tilde - e) / size
    scale = np.abs(x_tilde).max(initial=0.0) + np.abs(e / size).max(initial=0.0)

    def multipliers(a: Vector) -> Vector:
        y = np.zeros(e.size)
        y[kept] = solve_triangular(R, a) / size[kept]
        return y

    consistent = bool((mismatch <= 1e-8 * scale).all())
    return Rows(np.ascontiguousarray(C), x_tilde, consistent, multipliers)


def projected_problem(qp: QP, lanczos_steps: int) -> Projected:
    """Homogenise, project and normalise; 1 + `lanczos_steps` products with F."""
    counts: Counter[str] = Counter()

    def F(v: Vector) -> Vector:
        counts["P_products"] += 1
        return np.asarray(qp.P @ v)

    rows = orthonormal_rows(qp.A, qp.b)

    def project(v: Vector) -> Vector:
        return v - rows.C.T @ (rows.C @ v)

    norm = norm_estimate(lambda v: project(F(project(v))), qp.q.size, lanczos_steps)
    norm = norm or 1.0
    d = -qp.q - F(rows.x_tilde) if rows.x_tilde.any() else -qp.q
    bounds = (qp.lb - rows.x_tilde, qp.ub - rows.x_tilde)
    b = project(d) / norm
    if np.linalg.norm(b) <= 1e-14 * np.linalg.norm(d) / norm:
        b = np.zeros_like(b)  # nothing but rounding errors is left of d
    return Projected(F, counts, rows, norm, b, bounds)
