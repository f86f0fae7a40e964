"""The certificate of bodies torn into subdomains: without a factor of the whole K.

With K = TᵀK_T T,  K_T = diag(K_1 … K_S), an admissible û and multipliers λ̂ of contact
and friction leave the residual

    ρ = Kû − f + Bᵀλ̂   on the components that no support holds.

Share it among the copies of each component, Tᵀb = ρ, such that the forces b balance in
every subdomain, R_Tᵀb = 0, and solve  K_T d = b,  one small Neumann problem for each
subdomain. Then v = Tû − d is in equilibrium with f, λ̂ and forces between subdomains
that are opposite on both sides: it is a u_λ of the torn problem, whose solution is the
same, and identity (1) of `harness.verify.certificate` reads

    ½‖û − u*‖² + ½‖v − Tu*‖² + …  =  ½‖d‖²_{K_T} + Σ(g|v̂| − λ̂v̂)

So the bound is the energy of d, which is small itself: nothing cancels but in ρ, and
that is formed in extended precision. Multipliers of gluing and supports that a solver
may have found are not looked at.

Forces are shared as balancing domain decomposition does (Mandel 1993), in proportion to
the stiffness W of the copies,

    b = WT(TᵀWT)⁻¹ρ − ZR_T μ,   R_TᵀZR_T μ = R_TᵀWT(TᵀWT)⁻¹ρ,
      Z = W − WT(TᵀWT)⁻¹TᵀW

where (TᵀWT)⁻¹ is put to zero where a support holds, so that TᵀZ = 0 elsewhere: Z spans
the forces of gluing and supports. The sparse coarse matrix R_TᵀZR_T has three rows for
each subdomain of the plane. It is singular along motions of the whole that only contact
can hold; along these λ̂ balances the load, see `harness.verify.admissible.balanced`.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from scipy.linalg import qr
from scipy.sparse import csc_matrix, csr_array, diags_array
from scipy.sparse.linalg import splu

from harness.mechanics import Extended, Mechanics, Real
from harness.qp import Vector


class Torn(NamedTuple):
    """Forces of an admissible û that local problems do not balance, and what they do.

    Of torn displacements v, products are  vᵀKw  with the stiffness of the subdomains.
    """

    u: Extended  #: Tû (N,)
    Ku: Extended  #: K_T Tû
    d: Vector  #: (N,) Tû − u_λ, as far as it was solved for
    left: float  #: energy norm of the rest of d


def equilibrated(mechanics: Mechanics, u: Extended, multipliers: Extended) -> Torn:
    """Find the u_λ of an admissible û (n,) and λ̂ (m,) that is near Tû."""
    exact, parts = mechanics.exact, mechanics.substructures
    torn = parts.spread.astype(Real) @ u
    pull = parts.product(torn)
    residual = parts.spread.T @ pull - exact.f + exact.B.T @ multipliers
    residual[exact.held] = 0
    b = _sharing(mechanics)(residual.astype(np.float64))
    d = parts.solve(b)
    b = b - parts.product(d)
    step = parts.solve(b)
    return Torn(torn, pull, d, float(np.sqrt(abs(float(b @ step)))))


def _sharing(mechanics: Mechanics) -> Callable[[Vector], Vector]:
    """Return the map from a residual ρ (n,) to forces b (N,) of subdomains."""
    parts, held = mechanics.substructures, mechanics.exact.held
    T, R, w = parts.spread, parts.kernel, parts.weight
    total = T.multiply(T).T @ w
    total[held] = np.inf
    WT = csr_array(diags_array(w) @ T)
    WR = csr_array(diags_array(w) @ R)
    TWR = csr_array(T.T @ WR)
    coarse = R.T @ WR - TWR.T @ (diags_array(1 / total) @ TWR)
    solve = _coarse_solve(csr_array(coarse), _moved_together(mechanics))

    def share(residual: Vector) -> Vector:
        b = WT @ (residual / total)
        for _ in range(2):  # the second one for the digits that the first one lost
            mu = solve(R.T @ b)
            b = b - WR @ mu + WT @ ((TWR @ mu) / total)
        return np.asarray(b)

    return share


def _moved_together(mechanics: Mechanics) -> Any:
    """Return the coefficients (r, q) of R of the motions that no support holds."""
    parts, kernel = mechanics.substructures, mechanics.kernel
    return np.asarray((parts.kernel.T @ (parts.spread @ kernel)).toarray(), dtype=float)


def _coarse_solve(A: csr_array, kernel: Any) -> Callable[[Vector], Vector]:
    """Return x ↦ A⁺x, with as many components held as `kernel` (r, q) has columns."""
    pins = qr(kernel.T, mode="r", pivoting=True)[1][: kernel.shape[1]]
    free = np.setdiff1d(np.arange(A.shape[0]), pins)
    factor = splu(
        csc_matrix(A[free][:, free]), permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0,
        options={"SymmetricMode": True},
    )  # fmt: skip

    def solve(b: Vector) -> Vector:
        x = np.zeros_like(b)
        x[free] = factor.solve(b[free])
        return x

    return solve
