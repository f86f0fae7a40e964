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
body is a single subdomain with eliminated supports: T = I and d = K⁺ρ (`Split`).
For decomposed bodies (`Subdomains`), ρ is distributed over the subdomains as in
balancing domain decomposition (Mandel 1993). The forces b with Tᵀb = ρ are in
equilibrium on every subdomain, R_Tᵀb = 0, where the columns of R_T are the rigid
motions of subdomains. With the diagonal matrix W of the stiffnesses of all copies,

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

from collections.abc import Callable
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import qr
from scipy.sparse import csc_array, csc_matrix, csr_array, diags_array
from scipy.sparse.linalg import splu

from mortarbench.harness.mechanics import (
    DecomposedMechanics,
    Extended,
    Mechanics,
    Real,
    cancelling,
    in_precision,
)
from mortarbench.harness.qp import Vector

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


class Residual(NamedTuple):
    """Residual of a displacement u, and the energy of its deformation u − RRᵀu."""

    rho: Extended  #: (n,)  Ku − f
    v: Extended  #: (N,)  T(u − RRᵀu)
    square: float  #: vᵀK_T v
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


class Neighbour(NamedTuple):
    """Displacement u_λ in equilibrium, near û, represented by d = Tû − u_λ."""

    d: Extended  #: (N,) computed approximation
    Kd: Extended  #: (N,) K_T d
    left: float  #: bound on the energy norm of the error of d
    unbalanced: Extended  #: (r,)  Rᵀ(ρ − TᵀK_T d)


class Split:
    """Operations of the certificate with K = TᵀK_T T + E.

    Vectors (n,) of components have extended precision and are zero on fixed components;
    vectors (N,) contain the copies of components in all subdomains. Columns of R are
    the rigid motions that the supports allow; the first p columns change gaps or slip.
    This class is that of undivided bodies: T = I, and K_T = PKP with P = I − RRᵀ.
    """

    precision: Any = (
        Real  #: type of numbers in which the products of `noise` are rounded
    )

    def __init__(self, bodies: Mechanics | DecomposedMechanics) -> None:
        #: the bodies, unless they are decomposed
        self.undivided = bodies if isinstance(bodies, Mechanics) else None
        self.bodies = bodies
        self.exact, self.motions = bodies.exact, bodies.motions

    @cached_property
    def _stiffness(self) -> csc_array:
        assert self.undivided is not None
        return csc_array(self.undivided.primal.P)

    def spread(self, u: Extended) -> Extended:
        """Return the copies Tu (N,) of u (n,)."""
        return u

    def joined(self, b: Extended) -> Extended:
        """Return the sums Tᵀb (n,) over copies, with zeros on fixed components."""
        return self.free(b.copy())

    def product(self, v: Extended) -> Extended:
        """Return K_T v (N,)."""
        Kv = in_precision(self._stiffness, Real) @ self.motions.without(v)
        return self.motions.without(Kv)

    def forces(self, rho: NDArray[Any]) -> Any:
        """Return forces b (N,) in equilibrium, where Tᵀb is ρ without its part in R."""
        return self.motions.without(rho)

    def solve(self, b: Any) -> Vector:
        """Solve K_T d = b for b (N,) from `forces`; d then satisfies (5)."""
        assert self.undivided is not None
        return np.asarray(self.undivided.apply_inverse(b), dtype=np.float64)

    def variances(self, u: Extended) -> Vector:
        """Return sums (n,) of the squared terms of Ku, without those of KR."""
        deformed = self.motions.without(u).astype(np.float64)
        return np.asarray(self._stiffness.power(2) @ deformed**2)

    def averaged(self, v: Extended) -> Extended:
        """Return averages (n,) of the copies v (N,), which may be moved rigidly."""
        return self.joined(v)

    def theta(self, deformed: Extended, square: float) -> float:
        """Estimate the relative difference of the energies in K and K_T.

        deformed : (n,) displacement without rigid motion
        square : its energy in K_T
        """
        return 0.0

    def rounding(self, supported: NDArray[np.float64]) -> Rounding:
        """Bound E along combinations `supported` (p, h) of the first p columns of R.

        For undivided bodies, ER is KR up to the projection P.
        """
        R, KR = self.motions.constrained, self.motions.KR
        along = np.abs(supported.T @ np.asarray(R.T @ KR) @ supported)
        strain = [length(self, KR @ k) for k in supported.T]
        return Rounding(np.array(strain), along.astype(np.float64))

    def free(self, v: NDArray[Any]) -> NDArray[Any]:
        """Set v (n,) to zero on fixed components, in place."""
        v[self.exact.fixed] = 0
        return v

    def pulled(self, multipliers: Extended) -> Extended:
        """Return the contact forces Bᵀλ (n,)."""
        return self.free(np.asarray(self.exact.B.T @ multipliers))

    def residual(self, u: Extended) -> Residual:
        """Return Ku − f, and vᵀK_T v for v = T(u − RRᵀu).

        With the projection of Kv onto R, the product of K with rigid motions R is KR,
        which is computed by `cancelling`, since its terms cancel. The rounding of K
        along free motions is disregarded.
        """
        R, KR = self.motions.constrained, self.motions.KR
        deformed = self.motions.without(u)
        v = self.spread(deformed)
        Kv = self.product(v)
        rho = self.joined(Kv) - self.exact.f
        if R.shape[1]:
            rho += KR @ (R.T @ u) + R @ (KR.T @ deformed)
        square = float(v @ Kv)
        return Residual(self.free(rho), v, square, self.theta(deformed, square))

    def noise(self, u: Extended) -> Vector:
        """Return a sample (n,) of the rounding of Ku."""
        return self.free(sample(self.variances(u), u, self.precision))

    def excess(self, w: Extended) -> tuple[Extended, float]:
        """Return Ew (n,) and |wᵀEw| for w (n,) with Rᵀw = 0.

        In contrast to other vectors, w may be nonzero on fixed components. Kw is
        computed by `cancelling`, because the terms of Kw cancel if w moves bodies far
        together with their supports. If K is not stored, the result is a sample.
        """
        if (K := self.bodies.stored) is None:
            off = sample(self.variances(w), w, self.precision)
            return self.free(off), float(np.sqrt(w**2 @ off**2))
        v = self.spread(w)
        Kw, Kv = cancelling(K, w[:, None])[:, 0], self.product(v)
        return self.free(Kw - self.joined(Kv)), abs(float(w @ Kw - v @ Kv))

    def scattered(self, v: Vector) -> Extended:
        """Return the standard deviation (p,) of Rᵀv for random signs of v (n,).

        This is √((R∘R)ᵀ(v∘v)), where R contains the motions that change gaps or slip.
        """
        R = self.motions.constrained
        return np.asarray(np.sqrt(R.multiply(R).T @ v**2))


def neighbour(split: Split, rho: Extended) -> Neighbour:
    """Solve (5) with iterative refinement.

    The correction that ends the refinement is not added to d, but is used to bound the
    error. If the norm of each correction is at most q times the norm of the previous
    correction, the norms of the omitted corrections sum to at most size/(1 − q), where
    `size` is the norm of the last correction. If `MAX_REFINEMENTS` corrections do not
    suffice, all of them are added, and the same bound holds.
    """
    step, size = solved(split, rho)
    d = step.astype(Real)
    Kd = split.product(d)
    for _ in range(MAX_REFINEMENTS - 1):
        before, rest = size, rho - split.joined(Kd)
        unbalanced = split.motions.along(rest)
        step, size = solved(split, rest)
        q = size / before if before else 0.0
        if size <= REFINEMENT_TOLERANCE * np.sqrt(max(float(d @ Kd), 0.0)):
            break
        d += step  # in place, since vectors may be large
        Kd += split.product(step.astype(Real))
    return Neighbour(d, Kd, size / (1 - q) if q < 1 else np.inf, unbalanced)


def solved(split: Split, force: NDArray[Any]) -> tuple[Vector, float]:
    """Return a solution of (5), and its energy norm √(bᵀd).

    The norm is the dual norm of the forces (n,) without their part along rigid motions.
    """
    b = split.forces(force)
    d = split.solve(b)
    return d, float(np.sqrt(max(b @ d, 0)))


def length(split: Split, force: NDArray[Any]) -> float:
    """Return the dual norm of forces (n,), see `solved`."""
    return solved(split, force)[1]


def sample(variances: Vector, u: Extended, precision: Any) -> Vector:
    """Return a sample (n,) of the rounding of Ku in the given precision.

    The error of each sum is modelled as a few units in the last place of √`variances`,
    the root of the sum of the squared terms. The first contribution is RANDOM_ULPS with
    a random sign, which excites all modes. The second is SMOOTH_ULPS with the sign of
    u, since u is softer than most modes. The random sign is a hash of the number of the
    component. The hash function is splitmix64, because signs that alternate too
    regularly would do hardly any work along smooth modes.

    variances : (n,) sums of the squared terms
    """
    x = np.arange(1, u.size + 1, dtype=np.uint64)
    for shift, by in ((30, 0xBF58476D1CE4E5B9), (27, 0x94D049BB133111EB)):
        x = (x ^ (x >> np.uint64(shift))) * np.uint64(by)
    units = np.where(x >> np.uint64(63), RANDOM_ULPS, -RANDOM_ULPS)
    sizes = float(np.finfo(precision).eps) * np.sqrt(np.maximum(variances, 0))
    return np.asarray((units + SMOOTH_ULPS * np.sign(u.astype(np.float64))) * sizes)


class Subdomains(Split):
    """Operations for decomposed bodies, with E sampled in double precision.

    Residuals are evaluated with TᵀK_T T and the exact kernels of the subdomains. The
    matrix Z of the module docstring acts only on interfaces and fixed components: for a
    component with a single copy, W − WT(TᵀWT)⁻¹TᵀW vanishes.
    """

    bodies: DecomposedMechanics
    precision = np.float64

    def __init__(self, bodies: DecomposedMechanics) -> None:
        """Assemble the coarse problem."""
        super().__init__(bodies)
        parts, fixed = bodies.parts, self.exact.fixed
        T, w = csr_array(parts.spread), parts.weight
        self._parts, self._T = parts, T
        squares = self._squares
        total = squares.T @ w
        #: (N,) weights D of the copies of a component, a partition of unity: TᵀDT = I
        self._part = w / (squares @ total)
        jointly = squares.T @ np.ones(w.size) > 1 + 1e-9
        jointly[fixed] = True
        rows = np.flatnonzero(squares @ jointly.astype(np.float64) > 1e-9)
        inverse = 1 / total
        inverse[fixed] = 0
        WT = csr_array(T[rows])  # WT(TᵀWT)^(−½)
        WT.data *= np.repeat(w[rows], np.diff(WT.indptr))
        WT.data *= np.sqrt(inverse[WT.indices])
        self._rows, self._R = rows, csr_array(parts.kernel[rows])
        self._Z = csr_array(diags_array(w[rows]) - WT @ WT.T)

    @cached_property
    def _precise(self) -> csr_array:
        """T in extended precision."""
        return csr_array(in_precision(self._T, Real))

    @property
    def _squares(self) -> csr_array:
        """Squares of the entries of T, (N, n); not stored, because T is large."""
        T = self._T
        return csr_array((T.data**2, T.indices, T.indptr), shape=T.shape)

    @cached_property
    def _coarse(self) -> Callable[[Vector], Vector]:
        """Generalised inverse of R_TᵀZR_T, which fixes motions of whole bodies."""
        A = csc_matrix(self._R.T @ (self._Z @ self._R))
        motions = self._T @ self.motions.all.astype(np.float64)
        kernel = (self._parts.kernel.T @ motions).toarray()
        pins = qr(kernel.T, mode="r", pivoting=True)[1][: kernel.shape[1]]
        free = np.setdiff1d(np.arange(A.shape[0]), pins)
        factor = splu(
            A[free][:, free],
            permc_spec="MMD_AT_PLUS_A",
            diag_pivot_thresh=0.0,
            options={"SymmetricMode": True},
        )

        def solve(b: Vector) -> Vector:
            x = np.zeros_like(b)
            x[free] = factor.solve(b[free])
            return x

        return solve

    def spread(self, u: Extended) -> Extended:
        """Return Tu (N,)."""
        return np.asarray(self._precise @ u)

    def joined(self, b: Extended) -> Extended:
        """Return Tᵀb (n,) with zeros on fixed components."""
        return self.free(self._precise.T @ b)

    def averaged(self, v: Extended) -> Extended:
        """Return averages (n,) after the subdomains have moved rigidly.

        The motions minimise jumps, that is, differences between two copies of a
        component or, if the component is fixed, between a copy and zero; jumps are
        weighted by Z. The coefficients α of the motions satisfy R_TᵀZ(v − R_Tα) = 0,
        which has the same matrix as the coarse problem for forces.
        """
        x = v[self._rows].astype(np.float64)
        alpha = self._coarse(self._R.T @ (self._Z @ x))
        return self.joined(self._part * (v - self._parts.kernel @ alpha))

    def product(self, v: Extended) -> Extended:
        """Return K_T v (N,)."""
        return self._parts.product(v)

    def forces(self, rho: NDArray[Any]) -> Any:
        """Return b (N,) with R_Tᵀb = 0, and Tᵀb as in `Split` on free components."""
        R, rho = self._parts.kernel, self.motions.without(rho)
        b = self._part * (self._T @ rho.astype(np.float64))
        for _ in range(2):  # the second pass restores digits lost by cancellation
            b[self._rows] -= self._Z @ (self._R @ self._coarse(R.T @ b))
        return b

    def solve(self, b: Any) -> Vector:
        """Solve K_T d = b."""
        return self._parts.solve(b)

    def variances(self, u: Extended) -> Vector:
        """Return (K∘K)(u∘u), summed over subdomains with the squares of Tu."""
        squares = (self._T @ u.astype(np.float64)) ** 2
        return np.asarray(self._squares.T @ self._parts.squared_product(squares))

    def theta(self, deformed: Extended, square: float) -> float:
        """Estimate the relative difference of energies by `noise`."""
        off = np.sqrt(deformed**2 @ self.noise(deformed) ** 2)
        return SAFETY * float(off / square) if square > 0 else 0.0

    def rounding(self, supported: NDArray[np.float64]) -> Rounding:
        """Return bounds on ER from samples."""
        off = [self.noise(self.motions.constrained @ k) for k in supported.T]
        strain, curvature = np.zeros(len(off)), np.zeros((len(off), len(off)))
        for k, v in enumerate(off):
            strain[k] = length(self, v)
            curvature[k] = np.abs(supported.T) @ self.scattered(v)
        return Rounding(strain, curvature)
