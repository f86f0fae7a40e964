"""K as a sum over subdomains, and the small problems that the certificate solves there.

The certificate (`harness.verify.certificate`) is written for a stiffness that is torn,

    K = TᵀK_T T + E,      K_T = diag(K_1 … K_S),

where every K_s has the rigid motions of its subdomain as its exact kernel, and E is
rounding. Of admissible û and λ̂ it asks for the residual  ρ = Kû − f + Bᵀλ̂  on the
components that no support holds, in extended precision and with the stored K, and for
some d with

    TᵀK_T d = ρ                                                                  (5)

as nearly as doubles allow; what is left of (5) is measured. A body in one piece is one
subdomain, T = I, with its supports eliminated: d = K⁺ρ (`Undivided`). Of bodies that
are torn, forces b with Tᵀb = ρ that balance in every subdomain, R_Tᵀb = 0, come from
balancing domain decomposition (Mandel 1993): they are shared in proportion to the
stiffness W of the copies,

    b = WT(TᵀWT)⁻¹ρ − ZR_T μ,   R_TᵀZR_T μ = R_TᵀWT(TᵀWT)⁻¹ρ,
      Z = W − WT(TᵀWT)⁻¹TᵀW

where (TᵀWT)⁻¹ is put to zero where a support holds, so that TᵀZ = 0 elsewhere: Z spans
the forces of gluing and supports. Then K_T d = b is one small Neumann problem for each
subdomain. The sparse coarse matrix R_TᵀZR_T has three rows for each subdomain of the
plane. It is singular along motions of the whole that only contact can hold; along these
λ̂ balances the load, see `harness.verify.admissible.balanced`. Multipliers of gluing and
supports that a solver may have found are not looked at.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from functools import cached_property
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import qr
from scipy.sparse import csc_array, csc_matrix, csr_array, hstack
from scipy.sparse.linalg import splu

from mortarbench.harness.mechanics import (
    Extended,
    Mechanics,
    Real,
    Substructures,
    cancelling,
)
from mortarbench.harness.qp import Vector
from mortarbench.harness.verify.products import times_columns

#: by how much energies in K and in K_T may differ more than those of û do: it is among
#: the softest displacements, for which they differ most
SAFETY = 16
#: units in the last place that a sum over one row of K is off by in a sample, with
#: signs at random. Sums in extended precision are off by 0.4 to 0.5, as a standard
#: deviation, and the stored K u from TᵀK_T T u by 0.2 to 3.6
RANDOM = 4.0
#: the same with the sign of u, as a slender body needs, whose few soft modes a sample
#: at random may miss: with ¼, a bound of a plate 60 : ½ was exceeded by 1 %
SMOOTH = 1.0
ROUNDS = 6  #: of refining d, at most
#: what is left of d, relative to it, where refining ends: far below what bounds show
REFINED = 1e-6


class Split(Protocol):
    """K = TᵀK_T T + E for the certificate: products, solves, and sums over all of it.

    Vectors of components (n,) are extended, and zero where a support holds. Columns of
    R are the rigid motions that no support holds: first those that contact feels.
    """

    def along(self, v: Extended) -> Extended:
        """Return Rᵀv (r,)."""

    def motion(self, alpha: Extended) -> Extended:
        """Return Rα (n,)."""

    def residual(self, u: Extended) -> Residual:
        """Return Ku − f with the stored K, and what it is the same product for."""

    def pulled(self, multipliers: Extended) -> Extended:
        """Return Bᵀλ (n,)."""

    def spread(self, u: Extended) -> Extended:
        """Return Tu (N,)."""

    def joined(self, b: Extended) -> Extended:
        """Return Tᵀb (n,)."""

    def averaged(self, v: Extended) -> Extended:
        """Average copies v (N,) of components (n,), subdomains moved to agree most."""

    def product(self, v: Extended) -> Extended:
        """Return K_T v (N,)."""

    def solve(self, rho: Extended) -> Vector:
        """Return d (N,) of (5) to the digits of doubles, for ρ with Rᵀρ = 0."""

    def total(self, *numbers: float) -> list[float]:
        """Add numbers over all subdomains."""

    def rounding(self, supported: NDArray[np.float64]) -> Rounding:
        """Return what E does along the motions `supported` (p, h), felt by contact."""

    def excess(self, w: Extended) -> tuple[Extended, float]:
        """Return Ew (n,) and |wᵀEw| for w, not zero at supports, without motion R."""

    def scattered(self, v: Extended) -> Extended:
        """Return √((R∘R)ᵀ(v∘v)) (r,): Rᵀv for v (n,) with random signs."""

    def noise(self, u: Extended) -> Extended:
        """Return a sample (n,) of what rounding does to Ku − f in `residual`."""


class Residual(NamedTuple):
    """The residual of a displacement u, and the same without its rigid motion Rα."""

    rho: Extended  #: (n,)  Ku − f
    v: Extended  #: (N,)  T(u − Rα)
    Kv: Extended  #: (N,)  K_T v
    theta: float  #: estimate of how far vᵀKv and vᵀTᵀK_T Tv differ, relative


class Rounding(NamedTuple):
    """Effect of E along h rigid motions R."""

    strain: Vector  #: (h,) dual norms of ER
    curvature: NDArray[np.float64]  #: (h, h) at least |RᵀER|

    def work(self, size: float, gamma: Vector, theta: float) -> float:
        """Bound |eᵀEe| of e = e' + Rγ from ‖e'‖, sizes of γ, and |e'ᵀEe'| ≤ θ‖e'‖²."""
        rigid = 2 * size * (gamma @ self.strain) + gamma @ self.curvature @ gamma
        return float(rigid + theta * size * size)

    def stored(self, size: float, gamma: Vector, theta: float) -> float:
        """Bound √(eᵀKe) likewise; ‖e'‖ is that of the torn K."""
        return float(np.sqrt(size * size + self.work(size, gamma, theta)))


class Neighbour(NamedTuple):
    """The u_λ near a displacement û, by its distance d = Tû − u_λ."""

    d: Extended  #: (N,) as far as it was solved for
    Kd: Extended  #: (N,) K_T d
    left: float  #: energy norm of the rest of d
    unbalanced: Extended  #: (r,)  Rᵀ(ρ − TᵀK_T d)


def without_rigid_motion(split: Split, v: Extended) -> Extended:
    """Take the rigid motions out of v (n,)."""
    alpha = split.along(v)
    return v - split.motion(alpha) if alpha.size else v


def neighbour(split: Split, rho: Extended) -> Neighbour:
    """Solve (5), refined; what the last step would have changed is left.

    The rest after k steps is a sum of further ones, each at most q times the one
    before: steps add up to no more than the first one over 1 − q.
    """
    d = Kd = split.spread(0 * rho)
    rest, before = rho, np.inf
    for _ in range(ROUNDS):
        unbalanced = split.along(rest)
        balanced = rest - split.motion(unbalanced) if unbalanced.size else rest
        step = split.solve(balanced).astype(Real)
        pull = split.product(step)
        square, whole = split.total(float(step @ pull), float(d @ Kd))
        size = np.sqrt(max(square, 0.0))
        q = size / before if before else 0.0
        if before < np.inf and size <= REFINED * np.sqrt(max(whole, 0.0)):
            break
        d, Kd, before = d + step, Kd + pull, size
        rest = rho - split.joined(Kd)
    return Neighbour(d, Kd, size / (1 - q) if q < 1 else np.inf, unbalanced)


def length(split: Split, force: Extended) -> float:
    """Return the dual norm of forces (n,), by d of what balances of them."""
    d = split.solve(without_rigid_motion(split, force)).astype(Real)
    square = split.total(float(d @ split.product(d)))[0]
    return float(np.sqrt(max(square, 0.0)))


def sample(
    variances: Vector, u: Extended, components: NDArray[np.int64], real: Any
) -> Extended:
    """Return a sample (n,) of the rounding of a product with u in the precision `real`.

    Each sum is off by a few units in the last place of the root of the sum of the
    squares of its terms, `variances` (n,): RANDOM of them with a sign of its own, so
    that no mode is left out, and SMOOTH with the sign of u, which is softer than most.
    Signs are a hash of the component (n,), the same on all ranks that have it. It is
    splitmix64's: smooth modes do no work with signs that alternate more evenly than at
    random.
    """
    x = components.astype(np.uint64) + np.uint64(1)
    for shift, by in ((30, 0xBF58476D1CE4E5B9), (27, 0x94D049BB133111EB)):
        x = (x ^ (x >> np.uint64(shift))) * np.uint64(by)
    sign = np.where(x >> np.uint64(63), RANDOM, -RANDOM) + SMOOTH * np.sign(u)
    sizes = np.sqrt(np.maximum(variances, 0)).astype(Real)
    return np.asarray(sign * (np.finfo(real).eps * sizes))


class _Stored(ABC):
    """Bodies in one process: the stored K, and R."""

    def __init__(self, mechanics: Mechanics) -> None:
        self.mechanics = mechanics
        motions = mechanics.motions
        self.R = csr_array(hstack([motions.felt, motions.free]))

    @abstractmethod
    def spread(self, u: Extended) -> Extended: ...

    @abstractmethod
    def joined(self, b: Extended) -> Extended: ...

    @abstractmethod
    def product(self, v: Extended) -> Extended: ...

    def along(self, v: Extended) -> Extended:
        return np.asarray(self.R.T @ v) if self.R.shape[1] else v[:0]

    def motion(self, alpha: Extended) -> Extended:
        return np.asarray(self.R @ alpha)

    def free(self, v: Extended) -> Extended:
        """Put v (n,) to zero where a support holds, in place."""
        v[self.mechanics.exact.fixed] = 0
        return v

    def stored(self, u: Extended) -> tuple[Extended, float, Extended]:
        """Return Ku; of u − Rα, vᵀKv; and u − Rα. KRα is known to more digits."""
        K, motions = csc_array(self.mechanics.primal.P), self.mechanics.motions
        deformed = u
        if self.R.shape[1]:
            deformed = u - self.motion(self.along(u))
        Ku = times_columns(K.data, K.indices, K.indptr, deformed, u.size)
        square = float(deformed @ Ku)
        if motions.KR.shape[1]:
            Ku += motions.KR @ (motions.felt.T @ u)
        return self.free(Ku), square, deformed

    def pulled(self, multipliers: Extended) -> Extended:
        found = np.zeros(self.R.shape[0], dtype=Real)
        at = np.unique(self.mechanics.rows.indices)
        found[at] = self.mechanics.exact.B[:, at].T @ multipliers
        return self.free(found)

    def excess(self, w: Extended) -> tuple[Extended, float]:
        """Return Kw − TᵀK_T Tw on free components, and the difference of energies.

        Bodies that w moves far with their supports leave Kw as sums that cancel.
        """
        K, v = csr_array(self.mechanics.primal.P), self.spread(w)
        Kw, Kv = cancelling(K, w[:, None])[:, 0], self.product(v)
        return self.free(Kw - self.joined(Kv)), abs(float(w @ Kw - v @ Kv))

    def total(self, *numbers: float) -> list[float]:
        return list(numbers)

    def scattered(self, v: Extended) -> Extended:
        return np.asarray(np.sqrt(self.R.multiply(self.R).T @ v**2))


class Undivided(_Stored):
    """Bodies in one piece: T = I, and K_T = PKP with P = I − RRᵀ."""

    def residual(self, u: Extended) -> Residual:
        """Return Ku − f; K_T shares the norm of K: θ = 0."""
        Ku, _, deformed = self.stored(u)
        rho = self.free(Ku + self.mechanics.primal.q)
        return Residual(rho, deformed, self.product(deformed), 0.0)

    def spread(self, u: Extended) -> Extended:
        """Return u."""
        return u

    def joined(self, b: Extended) -> Extended:
        """Return b where no support holds."""
        return self.free(b.copy())

    def averaged(self, v: Extended) -> Extended:
        """Return v where no support holds."""
        return self.free(v.copy())

    def product(self, v: Extended) -> Extended:
        """Apply PKP with P = I − RRᵀ."""
        K = csc_array(self.mechanics.primal.P)
        v = self.mechanics.without_rigid_motion(v)
        Kv = times_columns(K.data, K.indices, K.indptr, v, v.size)
        return self.mechanics.without_rigid_motion(Kv)

    def solve(self, rho: Extended) -> Vector:
        """Return K⁺ρ."""
        return np.asarray(self.mechanics.apply_inverse(rho), dtype=np.float64)

    def noise(self, u: Extended) -> Extended:
        """Return a sample of the rounding of Ku without rigid motion."""
        K = csc_array(self.mechanics.primal.P).power(2)
        deformed = without_rigid_motion(self, u)
        variances = K @ deformed.astype(np.float64) ** 2
        return self.free(sample(variances, deformed, np.arange(u.size), Real))

    def rounding(self, supported: NDArray[np.float64]) -> Rounding:
        """Return ER, which is KR but for what P takes out of it."""
        motions = self.mechanics.motions
        along = np.abs(
            supported.T @ np.asarray(motions.felt.T @ motions.KR) @ supported
        )
        strain = [length(self, motions.KR @ k) for k in supported.T]
        return Rounding(np.array(strain), along.astype(np.float64))


class Reduction(Protocol):
    """How what some subdomains have is added to what others have elsewhere.

    Components are those that these subdomains have copies of, (n,); coarse unknowns are
    those of all subdomains, (r,).
    """

    def completed(self, v: Any, at: Any = None) -> Any:
        """Add what is elsewhere of the components `at` (t,), or of all (n,)."""

    def gathered(self, alpha: Vector) -> Vector:
        """Put coefficients of own rigid motions together with all others: (r,)."""

    def local_part(self, alpha: Vector) -> Vector:
        """Take the coefficients of own rigid motions out of all (r,)."""

    def coarse(self, M: csr_array, S: csr_array, scale: Vector, at: Any) -> csr_array:
        """Return  M − Sᵀ diag(scale) S  (r, r), with M and S added up over all.

        S : (t, local) its rows are of the components `at`
        """


class Sharing:
    """Shares forces ρ reduction subdomains, balanced in each; factorised once.

    Z acts on interfaces and supports only: elsewhere W − WT(TᵀWT)⁻¹TᵀW vanishes.
    """

    def __init__(
        self,
        parts: Substructures,
        fixed: NDArray[np.int64],
        floating: Any,
        reduction: Reduction,
    ) -> None:
        """Set up the coarse problem.

        Parameters
        ----------
        fixed : prescribed components
        floating : (r, q) coefficients of R_T of the motions that no support holds
        reduction : sums over subdomains that are elsewhere

        """
        self._parts, self._reduction, self._floating = parts, reduction, floating
        squares = csr_array(parts.spread)
        squares.data = squares.data**2
        self._squares = squares
        total = reduction.completed(squares.T @ parts.weight)
        #: (N,) shares D of copies in their components, which add up to one: TᵀDT = 1
        self.part = parts.weight / (squares @ total)
        jointly = reduction.completed(squares.T @ np.ones(squares.shape[0])) > 1 + 1e-9
        jointly[fixed] = True
        rows = np.flatnonzero(squares @ jointly.astype(np.float64) > 1e-9)
        inverse = 1 / total
        inverse[fixed] = 0
        T, R = csr_array(parts.spread[rows]), csr_array(parts.kernel[rows])
        touched = np.zeros(total.size, dtype=bool)
        touched[T.indices] = True
        number, at = np.cumsum(touched) - 1, np.flatnonzero(touched)
        self._T = csr_array(
            (T.data, number[T.indices], T.indptr), shape=(rows.size, at.size)
        )
        self._rows, self._at = rows, at
        self._w, self._inverse = parts.weight[rows], inverse[at]
        self._WR = scaled_rows(R, self._w)
        self._TWR = csr_array(self._T.T @ self._WR)
        self._RWR = csr_array(R.T @ self._WR)

    @cached_property
    def _coarse(self) -> Callable[[Vector], Vector]:
        coarse = self._reduction.coarse(self._RWR, self._TWR, self._inverse, self._at)
        return _coarse_solve(coarse, self._floating)

    def variances(self, v: Extended) -> Vector:
        """Return (K∘K)(u∘u) (n,), with the squares of v = Tu in every subdomain."""
        squares = self._parts.squared_product(v.astype(np.float64) ** 2)
        return np.asarray(self._reduction.completed(self._squares.T @ squares))

    def __call__(self, rho: Vector) -> Vector:
        """Return b (N,) with Tᵀb = ρ (n,) on the components that nothing holds."""
        parts, reduction = self._parts, self._reduction
        b = self.part * (parts.spread @ rho)
        for _ in range(2):  # the second time for the digits that the first one lost
            mu = reduction.local_part(
                self._coarse(reduction.gathered(parts.kernel.T @ b))
            )
            jumps = self._inverse * reduction.completed(self._TWR @ mu, self._at)
            b[self._rows] -= self._WR @ mu - self._w * (self._T @ jumps)
        return np.asarray(b)

    def matched(self, v: Extended) -> Extended:
        """Move subdomains rigidly until the copies v (N,) differ least, as Z weighs.

        α with RᵀZ(v − Rα) = 0, as forces are balanced; copies that a support holds
        differ from zero.
        """
        x, reduction = v[self._rows].astype(np.float64), self._reduction
        pulls = reduction.completed(self._T.T @ (self._w * x), self._at)
        apart = x - self._T @ (self._inverse * pulls)
        alpha = reduction.local_part(
            self._coarse(reduction.gathered(self._WR.T @ apart))
        )
        return np.asarray(v - self._parts.kernel @ alpha)


def scaled_rows(M: csr_array, scale: Vector) -> csr_array:
    """Multiply row i of M (k, l) by scale[i]."""
    data = M.data * np.repeat(scale, np.diff(M.indptr))
    return csr_array((data, M.indices, M.indptr), shape=M.shape)


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
