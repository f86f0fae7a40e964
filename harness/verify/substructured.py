"""Stiffness as a sum over subdomains, and the local problems that certificates require.

The certificate (`harness.verify.certificate`) is formulated for a stiffness

    K = TᵀK_T T + E,      K_T = diag(K_1 … K_S),

where T maps the n components of a displacement to their N copies in S subdomains, the
kernel of every K_s consists exactly of the rigid motions of its subdomain, and E is
rounding. For admissible û and λ̂, the certificate requires two vectors. One is the
residual ρ = Kû − f + Bᵀλ̂ on components without support, in extended precision and with
the stored K. The other is a solution d of

    TᵀK_T d = ρ                                                                  (5)

in double precision; the residual of d is evaluated in extended precision. An undivided
body is a single subdomain with eliminated supports: T = I and d = K⁺ρ (`Undivided`).
For decomposed bodies, ρ is distributed over the subdomains as in balancing domain
decomposition (Mandel 1993). The forces b with Tᵀb = ρ are in equilibrium on every
subdomain, R_Tᵀb = 0, where the columns of R_T are the rigid motions of subdomains. With
the diagonal matrix W of the stiffnesses of all copies,

    b = WT(TᵀWT)⁻¹ρ − ZR_T μ,   R_TᵀZR_T μ = R_TᵀWT(TᵀWT)⁻¹ρ,
      Z = W − WT(TᵀWT)⁻¹TᵀW

where (TᵀWT)⁻¹ is set to zero on fixed components, so that TᵀZ = 0 on all other
components. The range of Z contains the gluing and support forces. Then K_T d = b is a
small Neumann problem on each subdomain. The sparse coarse matrix R_TᵀZR_T has three
rows per subdomain in 2D and six in 3D. The matrix is singular along motions of whole
bodies that only contact resists; λ̂ balances the load along these motions
(`harness.verify.admissible.balanced`). The multipliers of gluing and supports in an
answer are not used.
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

#: Safety factor for the relative difference of the energies in K and K_T, which is
#: estimated at û. The relative difference is largest for displacements of low energy,
#: such as û.
SAFETY = 16
#: Amplitude of the rounding errors of random sign that `sample` simulates in Ku, in
#: each row, in units of eps times the root of the sum of the squared terms of the row.
#: The measured standard deviation is 0.4 to 0.5 for sums in extended precision, and 0.2
#: to 3.6 for the difference between the stored Ku and TᵀK_T Tu.
RANDOM_ULPS = 4.0
#: Amplitude of the simulated errors with the sign of u, in the same units. Random signs
#: alone may fail to excite the few soft modes of a slender body. With 0.25, the error
#: for a plate of aspect ratio 60 : ½ exceeded its bound by 1 %.
SMOOTH_ULPS = 1.0
MAX_REFINEMENTS = 6  #: largest number of refinements of d
#: Relative norm of a correction of d below which the refinement ends. Bounds are
#: reported with fewer digits.
REFINEMENT_TOLERANCE = 1e-6


class Split(Protocol):
    """Operations of the certificate with K = TᵀK_T T + E.

    Vectors (n,) of components have extended precision and are zero on fixed components;
    vectors (N,) contain the copies of components in all subdomains. Columns of R are
    the rigid motions that the supports allow; the first p columns change gaps or slip.
    """

    def along(self, v: Extended) -> Extended:
        """Return the coefficients Rᵀv (r,)."""

    def motion(self, alpha: Extended) -> Extended:
        """Return the rigid motion Rα (n,)."""

    def residual(self, u: Extended) -> Residual:
        """Return Ku − f with the stored K, and K_T v for v = T(u − RRᵀu)."""

    def pulled(self, multipliers: Extended) -> Extended:
        """Return the contact forces Bᵀλ (n,)."""

    def spread(self, u: Extended) -> Extended:
        """Return the copies Tu (N,) of u (n,)."""

    def joined(self, b: Extended) -> Extended:
        """Return the sums Tᵀb (n,) over the copies of each component."""

    def averaged(self, v: Extended) -> Extended:
        """Return the averages (n,) of the copies v (N,), after `Sharing.matched`."""

    def product(self, v: Extended) -> Extended:
        """Return K_T v (N,)."""

    def solve(self, rho: Extended) -> Vector:
        """Return a solution d (N,) of (5) in double precision, for ρ with Rᵀρ = 0."""

    def total(self, *numbers: float) -> list[float]:
        """Sum each number over all processes."""

    def rounding(self, supported: NDArray[np.float64]) -> Rounding:
        """Bound E along combinations `supported` (p, h) of the first p columns of R."""

    def excess(self, w: Extended) -> tuple[Extended, float]:
        """Return Ew (n,) and |wᵀEw| for w (n,) with Rᵀw = 0.

        In contrast to other vectors, w may be nonzero on fixed components.
        """

    def scattered(self, v: Extended) -> Extended:
        """Return the standard deviation (r,) of Rᵀv for random signs of v (n,).

        This is √((R∘R)ᵀ(v∘v)).
        """

    def noise(self, u: Extended) -> Extended:
        """Return a sample (n,) of the rounding of Ku − f in `residual`."""


class Residual(NamedTuple):
    """Residual of a displacement u, and products of its deformation u − RRᵀu."""

    rho: Extended  #: (n,)  Ku − f
    v: Extended  #: (N,)  T(u − RRᵀu)
    Kv: Extended  #: (N,)  K_T v
    theta: float  #: estimated relative difference of the energies of u in K and K_T


class Rounding(NamedTuple):
    """Effect of E along h rigid motions R."""

    strain: Vector  #: (h,) dual norms of the columns of ER
    curvature: NDArray[np.float64]  #: (h, h) upper bounds on |RᵀER|

    def work(self, size: float, gamma: Vector, theta: float) -> float:
        """Bound |eᵀEe| for e = e' + Rγ, where |e'ᵀEe'| ≤ θ‖e'‖².

        size : bound on ‖e'‖
        gamma : (h,) bounds on |γ|
        """
        rigid = 2 * size * (gamma @ self.strain) + gamma @ self.curvature @ gamma
        return float(rigid + theta * size * size)

    def stored(self, size: float, gamma: Vector, theta: float) -> float:
        """Bound √(eᵀKe) from the arguments of `work`; ‖e'‖ is the norm in K_T."""
        return float(np.sqrt(size * size + self.work(size, gamma, theta)))


class Neighbour(NamedTuple):
    """Displacement u_λ in equilibrium, near û, represented by d = Tû − u_λ."""

    d: Extended  #: (N,) computed approximation
    Kd: Extended  #: (N,) K_T d
    left: float  #: bound on the energy norm of the error of d
    unbalanced: Extended  #: (r,)  Rᵀ(ρ − TᵀK_T d)


def without_rigid_motion(split: Split, v: Extended) -> Extended:
    """Subtract the rigid motions from v (n,):  v − RRᵀv."""
    alpha = split.along(v)
    return v - split.motion(alpha) if alpha.size else v


def neighbour(split: Split, rho: Extended) -> Neighbour:
    """Solve (5) with iterative refinement.

    The correction that ends the refinement is not added to d, but is used to bound the
    error. If the norm of each correction is at most q times the norm of the previous
    correction, the norms of the omitted corrections sum to at most size/(1 − q), where
    `size` is the norm of the last correction. If `MAX_REFINEMENTS` corrections do not
    suffice, all of them are added, and the same bound holds.
    """
    d = Kd = split.spread(0 * rho)
    rest, before = rho, np.inf
    for _ in range(MAX_REFINEMENTS):
        unbalanced = split.along(rest)
        balanced = rest - split.motion(unbalanced) if unbalanced.size else rest
        step = split.solve(balanced).astype(Real)
        pull = split.product(step)
        square, whole = split.total(float(step @ pull), float(d @ Kd))
        size = np.sqrt(max(square, 0.0))
        q = size / before if before else 0.0
        if before < np.inf and size <= REFINEMENT_TOLERANCE * np.sqrt(max(whole, 0.0)):
            break
        d, Kd, before = d + step, Kd + pull, size
        rest = rho - split.joined(Kd)
    return Neighbour(d, Kd, size / (1 - q) if q < 1 else np.inf, unbalanced)


def length(split: Split, force: Extended) -> float:
    """Return the dual norm of forces (n,) without their part along rigid motions."""
    d = split.solve(without_rigid_motion(split, force)).astype(Real)
    square = split.total(float(d @ split.product(d)))[0]
    return float(np.sqrt(max(square, 0.0)))


def sample(
    variances: Vector, u: Extended, components: NDArray[np.int64], real: Any
) -> Extended:
    """Return a sample (n,) of the rounding of Ku in the precision `real`.

    The error of each sum is modelled as a few units in the last place of √`variances`,
    the root of the sum of the squared terms. The first contribution is RANDOM_ULPS with
    a random sign, which excites all modes. The second is SMOOTH_ULPS with the sign of
    u, since u is softer than most modes. The random sign is a hash of the number of the
    component, so that all ranks use the same sign. The hash function is splitmix64,
    because signs that alternate too regularly would do hardly any work along smooth
    modes.

    variances : (n,) sums of the squared terms
    components : (n,) global numbers of the components
    """
    x = components.astype(np.uint64) + np.uint64(1)
    for shift, by in ((30, 0xBF58476D1CE4E5B9), (27, 0x94D049BB133111EB)):
        x = (x ^ (x >> np.uint64(shift))) * np.uint64(by)
    sign = np.where(
        x >> np.uint64(63), RANDOM_ULPS, -RANDOM_ULPS
    ) + SMOOTH_ULPS * np.sign(u)
    sizes = np.sqrt(np.maximum(variances, 0)).astype(Real)
    return np.asarray(sign * (np.finfo(real).eps * sizes))


class _Stored(ABC):
    """Bodies in one process, with the stored K and R."""

    def __init__(self, mechanics: Mechanics) -> None:
        self.mechanics = mechanics
        motions = mechanics.motions
        self.R = csr_array(hstack([motions.constrained, motions.free]))

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
        """Set v (n,) to zero on fixed components, in place."""
        v[self.mechanics.exact.fixed] = 0
        return v

    def stored(self, u: Extended) -> tuple[Extended, float, Extended]:
        """Return Ku, the energy vᵀKv of the deformation v = u − RRᵀu, and v.

        Ku is evaluated as Kv + (KR)Rᵀu for the constrained motions R, where KR was
        computed by `cancelling`, since its terms cancel. The rounding of K along free
        motions is disregarded.
        """
        K, motions = csc_array(self.mechanics.primal.P), self.mechanics.motions
        deformed = u
        if self.R.shape[1]:
            deformed = u - self.motion(self.along(u))
        Ku = times_columns(K.data, K.indices, K.indptr, deformed, u.size)
        square = float(deformed @ Ku)
        if motions.KR.shape[1]:
            Ku += motions.KR @ (motions.constrained.T @ u)
        return self.free(Ku), square, deformed

    def pulled(self, multipliers: Extended) -> Extended:
        found = np.zeros(self.R.shape[0], dtype=Real)
        at = np.unique(self.mechanics.rows.indices)
        found[at] = self.mechanics.exact.B[:, at].T @ multipliers
        return self.free(found)

    def excess(self, w: Extended) -> tuple[Extended, float]:
        """Return Kw − TᵀK_T Tw on free components, and |wᵀKw − (Tw)ᵀK_T Tw|.

        Kw is computed by `cancelling`, because the terms of Kw cancel if w moves bodies
        far together with their supports.
        """
        K, v = csr_array(self.mechanics.primal.P), self.spread(w)
        Kw, Kv = cancelling(K, w[:, None])[:, 0], self.product(v)
        return self.free(Kw - self.joined(Kv)), abs(float(w @ Kw - v @ Kv))

    def total(self, *numbers: float) -> list[float]:
        return list(numbers)

    def scattered(self, v: Extended) -> Extended:
        return np.asarray(np.sqrt(self.R.multiply(self.R).T @ v**2))


class Undivided(_Stored):
    """Undivided bodies: T = I, and K_T = PKP with P = I − RRᵀ."""

    def residual(self, u: Extended) -> Residual:
        """Return Ku − f; θ = 0, since K_T and K define the same norm."""
        Ku, _, deformed = self.stored(u)
        rho = self.free(Ku - self.mechanics.exact.f)
        return Residual(rho, deformed, self.product(deformed), 0.0)

    def spread(self, u: Extended) -> Extended:
        """Return u."""
        return u

    def joined(self, b: Extended) -> Extended:
        """Return b with zeros on fixed components."""
        return self.free(b.copy())

    def averaged(self, v: Extended) -> Extended:
        """Return v with zeros on fixed components."""
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
        """Return a sample (n,) of the rounding of Kv with v = u − RRᵀu."""
        K = csc_array(self.mechanics.primal.P).power(2)
        deformed = without_rigid_motion(self, u)
        variances = K @ deformed.astype(np.float64) ** 2
        return self.free(sample(variances, deformed, np.arange(u.size), Real))

    def rounding(self, supported: NDArray[np.float64]) -> Rounding:
        """Return bounds on ER, which is KR up to the projection P."""
        motions = self.mechanics.motions
        along = np.abs(
            supported.T @ np.asarray(motions.constrained.T @ motions.KR) @ supported
        )
        strain = [length(self, motions.KR @ k) for k in supported.T]
        return Rounding(np.array(strain), along.astype(np.float64))


class Reduction(Protocol):
    """Sums over the subdomains of all processes.

    Vectors (n,) contain the components of the local subdomains; vectors (r,) contain
    the coarse unknowns of all subdomains.
    """

    def completed(self, v: Any, at: Any = None) -> Any:
        """Add other processes' contributions to v at components `at` (default: all)."""

    def gathered(self, alpha: Vector) -> Vector:
        """Gather the coefficients of the rigid motions of all subdomains: (r,)."""

    def local_part(self, alpha: Vector) -> Vector:
        """Extract the coefficients of the local rigid motions from alpha (r,)."""

    def coarse(self, M: csr_array, S: csr_array, scale: Vector, at: Any) -> csr_array:
        """Return  M − Sᵀ diag(scale) S  (r, r); M and S are sums over all subdomains.

        S : (t, local) matrix with a row for each of the components `at`
        """


class Sharing:
    """Distribution of forces ρ such that each subdomain is in equilibrium.

    The matrix Z of the module docstring acts only on interfaces and fixed components:
    for a component with a single copy, W − WT(TᵀWT)⁻¹TᵀW vanishes.
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
        parts : subdomains of this process
        fixed : prescribed components
        floating : (r, q) coefficients in R_T of the motions that the supports allow
        reduction : completes sums over subdomains

        """
        self._parts, self._reduction, self._floating = parts, reduction, floating
        squares = csr_array(parts.spread)
        squares.data = squares.data**2
        self._squares = squares
        total = reduction.completed(squares.T @ parts.weight)
        #: (N,) weights D of the copies of a component, a partition of unity: TᵀDT = I
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
        """Return (K∘K)(u∘u) (n,), summed over subdomains with the squares of v = Tu."""
        squares = self._parts.squared_product(v.astype(np.float64) ** 2)
        return np.asarray(self._reduction.completed(self._squares.T @ squares))

    def __call__(self, rho: Vector) -> Vector:
        """Return b (N,) with Tᵀb = ρ (n,) on free components and R_Tᵀb = 0."""
        parts, reduction = self._parts, self._reduction
        b = self.part * (parts.spread @ rho)
        for _ in range(2):  # the second pass restores digits lost by cancellation
            mu = reduction.local_part(
                self._coarse(reduction.gathered(parts.kernel.T @ b))
            )
            jumps = self._inverse * reduction.completed(self._TWR @ mu, self._at)
            b[self._rows] -= self._WR @ mu - self._w * (self._T @ jumps)
        return np.asarray(b)

    def matched(self, v: Extended) -> Extended:
        """Subtract from v (N,) the rigid motions of subdomains that minimise jumps.

        A jump is the difference between two copies of a component or, if the component
        is fixed, between a copy and zero; jumps are weighted by Z. The coefficients α
        of the motions satisfy R_TᵀZ(v − R_Tα) = 0, which has the same matrix as the
        coarse problem for forces.
        """
        x, reduction = v[self._rows].astype(np.float64), self._reduction
        pulls = reduction.completed(self._T.T @ (self._w * x), self._at)
        jumps = x - self._T @ (self._inverse * pulls)
        alpha = reduction.local_part(
            self._coarse(reduction.gathered(self._WR.T @ jumps))
        )
        return np.asarray(v - self._parts.kernel @ alpha)


def scaled_rows(M: csr_array, scale: Vector) -> csr_array:
    """Multiply row i of M (k, l) by scale[i]."""
    data = M.data * np.repeat(scale, np.diff(M.indptr))
    return csr_array((data, M.indices, M.indptr), shape=M.shape)


def _coarse_solve(A: csr_array, kernel: Any) -> Callable[[Vector], Vector]:
    """Return a generalised inverse of A with `kernel` (r, q), fixing q components."""
    pins = qr(kernel.T, mode="r", pivoting=True)[1][: kernel.shape[1]]
    free = np.setdiff1d(np.arange(A.shape[0]), pins)
    factor = splu(
        csc_matrix(A[free][:, free]),
        permc_spec="MMD_AT_PLUS_A",
        diag_pivot_thresh=0.0,
        options={"SymmetricMode": True},
    )

    def solve(b: Vector) -> Vector:
        x = np.zeros_like(b)
        x[free] = factor.solve(b[free])
        return x

    return solve
