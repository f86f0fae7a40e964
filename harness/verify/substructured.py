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
that is formed in extended precision, with the stored K: what rounding makes of TᵀK_T T
is as large as the errors of very accurate answers, and u* is the solution for K. For d
the difference is one of the last digits. Multipliers of gluing and supports that a
solver may have found are not looked at.

Norms of û and of what is near it follow from  (Tû)ᵀK_T d = ûᵀTᵀb.

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
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import qr
from scipy.sparse import csc_array, csc_matrix, csr_array
from scipy.sparse.linalg import splu

from harness.mechanics import Extended, Mechanics, Substructures
from harness.qp import Vector
from harness.verify.products import times_columns


class Neighbour(NamedTuple):
    """The u_λ near a displacement û, by its distance d = Tû − u_λ."""

    d: Vector  #: (N,) as far as it was solved for
    Kd: Vector  #: (N,) K_T d
    left: float  #: square of the energy norm of the rest of d, in these subdomains


class Among(Protocol):
    """How what some subdomains have is added to what others have elsewhere.

    Components are those that these subdomains have copies of, (n,); coarse unknowns are
    those of all subdomains, (r,).
    """

    def completed(self, v: Any, at: Any = None) -> Any:
        """Add what is elsewhere of the components `at` (t,), or of all (n,)."""

    def gathered(self, alpha: Vector) -> Vector:
        """Put coefficients of own rigid motions together with all others: (r,)."""

    def own(self, alpha: Vector) -> Vector:
        """Take the coefficients of own rigid motions out of all (r,)."""

    def coarse(self, M: csr_array, S: csr_array, scale: Vector, at: Any) -> csr_array:
        """Return  M − Sᵀ diag(scale) S  (r, r), with M and S added up over all.

        S : (t, own) its rows are of the components `at`
        """


class Alone:
    """All subdomains are here."""

    def completed(self, v: Any, at: Any = None) -> Any:
        """Return v: nothing is elsewhere."""
        return v

    def gathered(self, alpha: Vector) -> Vector:
        """Return all coefficients."""
        return alpha

    def own(self, alpha: Vector) -> Vector:
        """Return all coefficients."""
        return alpha

    def coarse(self, M: csr_array, S: csr_array, scale: Vector, at: Any) -> csr_array:
        """Return  M − Sᵀ diag(scale) S."""
        return csr_array(M - S.T @ scaled_rows(S, scale))


def residual(mechanics: Mechanics, u: Extended, multipliers: Extended) -> Any:
    """Return ρ (n,) of an admissible û and λ̂, extended, and ‖û‖²."""
    K = csc_array(mechanics.primal.P)
    still = mechanics.still(u)
    found = times_columns(K.data, K.indices, K.indptr, still, u.size)
    square = float(still @ found)
    found += mechanics.primal.q
    at = np.unique(mechanics.rows.indices)
    found[at] += mechanics.exact.B[:, at].T @ multipliers
    found[mechanics.exact.held] = 0
    return found, square


def neighbour(
    parts: Substructures, held: NDArray[np.int64], rho: Vector, loose: Any,
    among: Among,
) -> Neighbour:  # fmt: skip
    """Find u_λ near û from the residual ρ (n,) on the components that nothing holds.

    held : components that supports hold
    loose : (r, q) coefficients of R of the motions of the whole that no support holds
    """
    b = _shared(parts, held, rho, loose, among)
    d = parts.solve(b)
    Kd = parts.product(d)
    b -= Kd
    return Neighbour(d, Kd, abs(float(b @ parts.solve(b))))


def _shared(
    parts: Substructures, held: NDArray[np.int64], rho: Vector, loose: Any,
    among: Among,
) -> Vector:  # fmt: skip
    """Share ρ (n,) among the subdomains, balanced in each: b (N,).

    Z acts on interfaces and supports only: elsewhere W − WT(TᵀWT)⁻¹TᵀW vanishes.
    """
    squares = csr_array(parts.spread)
    squares.data = squares.data**2
    total = among.completed(squares.T @ parts.weight)
    part = parts.weight / (squares @ total)
    jointly = among.completed(squares.T @ np.ones(squares.shape[0])) > 1 + 1e-9
    jointly[held] = True
    rows = np.flatnonzero(squares @ jointly.astype(np.float64) > 1e-9)
    inverse = 1 / total
    inverse[held] = 0
    T, R = csr_array(parts.spread[rows]), csr_array(parts.kernel[rows])
    touched = np.zeros(total.size, dtype=bool)
    touched[T.indices] = True
    number, at = np.cumsum(touched) - 1, np.flatnonzero(touched)
    T = csr_array((T.data, number[T.indices], T.indptr), shape=(rows.size, at.size))
    w, inverse = parts.weight[rows], inverse[at]
    WR = scaled_rows(R, w)
    TWR = csr_array(T.T @ WR)
    coarse = among.coarse(csr_array(R.T @ WR), TWR, inverse, at)
    solve = _coarse_solve(coarse, loose)
    b = part * (parts.spread @ rho)
    for _ in range(2):  # the second time for the digits that the first one lost
        mu = among.own(solve(among.gathered(parts.kernel.T @ b)))
        b[rows] -= WR @ mu - w * (T @ (inverse * among.completed(TWR @ mu, at)))
    return np.asarray(b)


def scaled_rows(M: csr_array, scale: Vector) -> csr_array:
    """Multiply row i of M (k, l) by scale[i]."""
    data = M.data * np.repeat(scale, np.diff(M.indptr))
    return csr_array((data, M.indices, M.indptr), shape=M.shape)


def moved_together(mechanics: Mechanics) -> Any:
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
