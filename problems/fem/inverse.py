"""Generalised inverses of the stiffness by sparse Cholesky, and their condensation.

A floating body's K is made positive definite by fixing nodes (Brzobohatý, Dostál,
Kozubek, Kovář, Markopoulos 2011, the paper's reference [8]): with R* the rows of the
rigid modes at a few nodes (orthonormalised, zero elsewhere) and ρ > 0,

    K_ρ = K + ρ R*R*ᵀ    is positive definite, and    K K_ρ⁻¹ K = K,

so K⁺ = K_ρ⁻¹ is a symmetric generalised inverse, one sparse Cholesky factor away. It is
not the Moore-Penrose inverse; on loads that balance (Rᵀf = 0) the two give solutions
that differ by a rigid motion only. For supported bodies, K⁺ is K_ff⁻¹ on the free
components and zero on the prescribed ones.

Constraints touch only the components c of contact sides and supports. Ordered last,
they leave a trailing block L_cc in the factor, and  (K⁺)_cc = (L_cc L_ccᵀ)⁻¹  gives
F = BK⁺Bᵀ = B_c (K⁺)_cc B_cᵀ  for every load step by one small product. Fixing nodes
are ordered with them: what couples these far nodes then fills no other column.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from time import perf_counter
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag, lapack, null_space, qr
from scipy.sparse import block_diag as sparse_block_diag
from scipy.sparse import csc_array, csc_matrix, csr_array
from sksparse.cholmod import Factor, cholesky

from mortarbench.harness import Matrix, Vector
from mortarbench.problems.fem.dissection import index_arrays
from mortarbench.problems.fem.elimination import scatter_symmetric
from mortarbench.problems.fem.kernels import congruence
from mortarbench.problems.fem.mesh import Nodes
from mortarbench.problems.fem.multifrontal import Multifrontal, multifrontal

NO_NODES: Nodes = np.zeros(0, dtype=np.int64)


class Interface(NamedTuple):
    """What constraints can touch, and where the unknowns are."""

    components: Nodes  #: (c,) ascending
    points: NDArray[np.float64]  #: (N, dim) of the nodes that K's components belong to


class GeneralisedInverse(Protocol):
    """A symmetric K⁺ (n, n) with K K⁺ K = K on the components it acts on."""

    @property
    def seconds(self) -> float:
        """What factorising took, whichever load step it was for."""

    @property
    def kernel(self) -> NDArray[np.float64]:
        """Orthonormal basis R (n, r) of ker K; no columns for a regular K."""

    def __call__(self, b: Vector) -> Vector:
        """Apply K⁺ to one vector (n,) or to several (n, k)."""

    def congruence(self, B: Matrix) -> NDArray[np.float64]:
        """Return BK⁺Bᵀ (m, m) for sparse rows B (m, n), exactly symmetric."""

    def at_constraints(self, b: Vector) -> Vector:
        """Return K⁺b (n,) where constraints can touch, for b (n,) that acts there."""


@dataclass(frozen=True, eq=False)
class CholeskyInverse:
    """K⁺ through CHOLMOD's factor; BK⁺Bᵀ by one solve per row, the paper's way."""

    factor: Factor
    free: Nodes  #: components it acts on; K⁺ is zero on the others
    kernel: NDArray[np.float64]
    seconds: float  #: to factorise

    def __call__(self, b: Vector) -> Vector:
        """Solve."""
        x = np.zeros_like(b)
        x[self.free] = self.factor.solve_A(b[self.free])
        return x

    def congruence(self, B: Matrix) -> NDArray[np.float64]:
        """Solve for all rows of B in one block."""
        F = B @ self(B.T.toarray())
        return np.asarray((F + F.T) / 2)

    def at_constraints(self, b: Vector) -> Vector:
        """Solve: this is right everywhere."""
        return self(b)


@dataclass(frozen=True, eq=False)
class CondensedInverse:
    """K⁺ with its block on the components that constraints can touch."""

    factor: Multifrontal
    interface: Nodes  #: (c,) components, ascending
    compliance: NDArray[np.float64]  #: (K⁺)_cc, zero where a component is prescribed
    kernel: NDArray[np.float64]
    seconds: float  #: to factorise and to condense

    def __call__(self, b: Vector) -> Vector:
        """Solve with the whole factor."""
        x = np.zeros_like(b)
        x[self.factor.order] = self.factor.solve(b[self.factor.order])
        return x

    def congruence(self, B: Matrix) -> NDArray[np.float64]:
        """Return BK⁺Bᵀ; ValueError where B touches other components."""
        B, number = csr_array(B), np.full(B.shape[1], -1, dtype=np.int32)
        number[self.interface] = np.arange(self.interface.size, dtype=np.int32)
        ptr, idx = index_arrays(B)
        F, within = congruence(ptr, idx, B.data, number, self.compliance)
        if not within:
            raise ValueError("rows touch components outside the condensed interface")
        return F

    def at_constraints(self, b: Vector) -> Vector:
        """Multiply with (K⁺)_cc; zero elsewhere."""
        u = np.zeros(b.size)
        u[self.interface] = self.compliance @ b[self.interface]
        return u


def regular_inverse(
    K: Matrix, free: Nodes, interface: Interface | None = None
) -> GeneralisedInverse:
    """Factorise K_ff, condensed onto the free part of `interface` where it is given.

    Raises
    ------
    numpy.linalg.LinAlgError, sksparse.cholmod.CholmodNotPositiveDefiniteError
        When K_ff is singular; the latter without an interface.

    """
    return _inverse(csc_array(K), free, np.zeros((K.shape[0], 0)), interface)


def floating_inverse(
    K: Matrix,
    kernels: Sequence[NDArray[np.float64]],
    fixing: Sequence[Nodes],
    interface: Interface | None = None,
) -> GeneralisedInverse:
    """Factorise the stiffness of floating bodies numbered one after another.

    Parameters
    ----------
    K : (n, n) block diagonal over the bodies
    kernels : per body, an orthonormal basis (n_body, r_body) of its rigid modes
    fixing : per body, components (within it) that no rigid motion leaves all at rest:
        of two nodes that are apart in the plane, of three in space, at least
    interface : to condense onto

    """
    starred, fixed, start = [], [], 0
    for R, rows in zip(kernels, fixing, strict=True):
        Q = np.zeros_like(R)
        Q[rows] = np.linalg.qr(R[rows])[0]
        starred.append(csr_array(Q))
        fixed.append(start + rows)
        start += len(R)
    R_star = csc_array(sparse_block_diag(starred))
    rho = K.diagonal().max()
    K_rho = csc_array(K + rho * (R_star @ R_star.T))
    free, kernel = np.arange(K.shape[0]), block_diag(*kernels)
    return _inverse(K_rho, free, kernel, interface, np.concatenate(fixed))


def supported_inverse(
    K: Matrix,
    free: Nodes,
    rigid: NDArray[np.float64],
    interface: Interface | None = None,
) -> GeneralisedInverse:
    """Factorise K_ff where the supports may leave rigid motions of some body.

    As many further components are held as there are such motions, those that a pivoted
    QR factorisation of the motions finds to fix them best: on loads that balance these,
    they feel no force.

    Parameters
    ----------
    rigid : (n, r) rigid motions of all bodies, supports or not
    interface : to condense onto

    """
    held = np.setdiff1d(np.arange(K.shape[0]), free)
    kernel = rigid @ null_space(rigid[held]) if held.size else rigid
    if not kernel.shape[1]:
        return _inverse(csc_array(K), free, kernel, interface)
    kernel[held] = 0
    kernel = np.linalg.qr(kernel)[0]
    pins = qr(kernel.T, mode="r", pivoting=True)[1][: kernel.shape[1]]
    return _inverse(csc_array(K), np.setdiff1d(free, pins), kernel, interface)


def _inverse(
    K: csc_array,
    free: Nodes,
    kernel: NDArray[np.float64],
    interface: Interface | None,
    fixed: Nodes = NO_NODES,
) -> GeneralisedInverse:
    """Factorise K_ff, the components `fixed` and those of the interface last."""
    start = perf_counter()
    if interface is None:
        K_ff = csc_matrix(K[free][:, free])
        factor = cholesky(K_ff, mode="supernodal", ordering_method="nesdis")
        return CholeskyInverse(factor, free, kernel, perf_counter() - start)
    touched = interface.components
    last = np.concatenate([touched, fixed])
    factor = multifrontal(K, free, interface.points, last)
    number = np.full(K.shape[0], -1, dtype=np.int32)
    number[touched] = np.arange(touched.size, dtype=np.int32)
    compliance = np.zeros((touched.size, touched.size))
    for components, U in factor.trailing() if touched.size else ():
        lower, _ = lapack.dpotri(U.T, lower=1)
        scatter_symmetric(lower.T, number[components], compliance)
    return CondensedInverse(factor, touched, compliance, kernel, perf_counter() - start)
