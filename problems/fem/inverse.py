"""Generalised inverses K⁺ of the stiffness matrix K by sparse Cholesky factorisation.

The stiffness matrix K of a floating body is regularised by fixing nodes (Brzobohatý,
Dostál, Kozubek, Kovář, Markopoulos 2011, reference [8] of the paper). Let R* contain
the rows of the rigid modes R at the fixing nodes, orthonormalised, and zeros elsewhere.
With ρ > 0,

    K_ρ = K + ρ R*R*ᵀ    is positive definite, and    K K_ρ⁻¹ K = K,

hence K⁺ = K_ρ⁻¹ is a symmetric generalised inverse that requires one sparse Cholesky
factor. K⁺ is not the Moore-Penrose inverse. If the load is balanced (Rᵀf = 0), however,
the solutions computed with both inverses differ only by a rigid motion. For supported
bodies, K⁺ is K_ff⁻¹ on the free components f and zero on the prescribed ones.

B has entries only in its columns c, the components of contact sides and supports. If
these components are eliminated last, the trailing block L_cc of the factor yields
(K⁺)_cc = (L_cc L_ccᵀ)⁻¹, and  F = BK⁺Bᵀ = B_c (K⁺)_cc B_cᵀ  (eq. (3) of the paper)
requires one small product in every load step. The fixing nodes are eliminated together
with c, so that the term ρ R*R*ᵀ, which couples them, causes no fill-in elsewhere.
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
from mortarbench.problems.fem.elasticity import gram_schmidt
from mortarbench.problems.fem.elimination import scatter_symmetric
from mortarbench.problems.fem.fixing import TIE
from mortarbench.problems.fem.kernels import congruence
from mortarbench.problems.fem.mesh import Nodes
from mortarbench.problems.fem.multifrontal import Multifrontal, multifrontal

NO_NODES: Nodes = np.zeros(0, dtype=np.int64)


class Interface(NamedTuple):
    """Components with entries in constraint rows, and positions of all nodes."""

    components: Nodes  #: (c,) indices of the components, ascending
    points: NDArray[np.float64]  #: (N, dim) positions of the nodes of K


class GeneralisedInverse(Protocol):
    """A symmetric K⁺ (n, n) with K K⁺ K = K on the components that are not fixed."""

    @property
    def seconds(self) -> float:
        """Wall-clock time in s of the factorisation, which serves all load steps."""

    @property
    def kernel(self) -> NDArray[np.float64]:
        """Orthonormal basis R (n, r) of ker K; no columns if K is nonsingular."""

    def __call__(self, b: Vector) -> Vector:
        """Apply K⁺ to one vector (n,) or to several (n, k)."""

    def congruence(self, B: Matrix) -> NDArray[np.float64]:
        """Return BK⁺Bᵀ (m, m) for sparse rows B (m, n), exactly symmetric."""

    def at_constraints(self, b: Vector) -> Vector:
        """Return K⁺b (n,), valid on the interface components.

        b : (n,) forces that are zero outside the interface components
        """


@dataclass(frozen=True, eq=False)
class CholeskyInverse:
    """K⁺ by CHOLMOD; BK⁺Bᵀ requires one solve per row of B, as in the paper."""

    factor: Factor
    free: Nodes  #: components that are not fixed; other rows and columns of K⁺ are zero
    kernel: NDArray[np.float64]
    seconds: float  #: time of the factorisation, s

    def __call__(self, b: Vector) -> Vector:
        """Apply K⁺ with one solve per column of b."""
        x = np.zeros_like(b)
        x[self.free] = self.factor.solve_A(b[self.free])
        return x

    def congruence(self, B: Matrix) -> NDArray[np.float64]:
        """Return BK⁺Bᵀ by a block solve for all rows of B."""
        F = B @ self(B.T.toarray())  # eq. (3)
        return np.asarray((F + F.T) / 2)

    def at_constraints(self, b: Vector) -> Vector:
        """Return K⁺b, valid on all components."""
        return self(b)


@dataclass(frozen=True, eq=False)
class CondensedInverse:
    """K⁺ by a multifrontal factor, with its block (K⁺)_cc on the interface."""

    factor: Multifrontal
    interface: Nodes  #: components c with entries in constraint rows, ascending
    compliance: NDArray[np.float64]  #: (K⁺)_cc, zero for prescribed components
    kernel: NDArray[np.float64]
    seconds: float  #: time of factorisation and condensation, s

    def __call__(self, b: Vector) -> Vector:
        """Apply K⁺ by a solve with the whole factor."""
        x = np.zeros_like(b)
        x[self.factor.order] = self.factor.solve(b[self.factor.order])
        return x

    def congruence(self, B: Matrix) -> NDArray[np.float64]:
        """Return BK⁺Bᵀ; raise ValueError if B has entries outside the interface."""
        B, number = csr_array(B), np.full(B.shape[1], -1, dtype=np.int32)
        number[self.interface] = np.arange(self.interface.size, dtype=np.int32)
        ptr, idx = index_arrays(B)
        F, within = congruence(ptr, idx, B.data, number, self.compliance)
        if not within:
            raise ValueError("rows have entries outside the condensed interface")
        return F

    def at_constraints(self, b: Vector) -> Vector:
        """Return (K⁺)_cc b_c on the interface, zero elsewhere."""
        u = np.zeros(b.size)
        u[self.interface] = self.compliance @ b[self.interface]
        return u


def regular_inverse(
    K: Matrix, free: Nodes, interface: Interface | None = None
) -> GeneralisedInverse:
    """Factorise K_ff for the components f in `free`; with `interface`, compute (K⁺)_cc.

    Raises
    ------
    numpy.linalg.LinAlgError, sksparse.cholmod.CholmodNotPositiveDefiniteError
        If K_ff is not positive definite. CHOLMOD's error is raised if `interface` is
        None.

    """
    return _inverse(csc_array(K), free, np.zeros((K.shape[0], 0)), interface)


def floating_inverse(
    K: Matrix,
    kernels: Sequence[NDArray[np.float64]],
    fixing: Sequence[Nodes],
    interface: Interface | None = None,
) -> GeneralisedInverse:
    """Factorise the stiffness of floating bodies that are numbered one after another.

    Parameters
    ----------
    K : (n, n) block diagonal matrix with one block per body
    kernels : for each body, an orthonormal basis (n_body, r_body) of its rigid modes
    fixing : for each body, the components of its fixing nodes, numbered within the
        body; no rigid mode may vanish on them, which requires at least two nodes in 2D
        and three in 3D if the modes include all rotations
    interface : components c for (K⁺)_cc; None to solve once per row of B instead

    """
    starred, fixed, start = [], [], 0
    for R, rows in zip(kernels, fixing, strict=True):
        Q = np.zeros_like(R)
        Q[rows] = np.linalg.qr(R[rows])[0]  # R*, orthonormal
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
    """Factorise K_ff of bodies whose supports may allow rigid motions.

    For each rigid motion that the supports allow, one further component is fixed. These
    components are selected by a QR factorisation of the motions with pivoting. Balanced
    loads cause no reactions at these components.

    Parameters
    ----------
    rigid : (n, r) rigid motions of all bodies, ignoring supports
    interface : components c for (K⁺)_cc; None to solve once per row of B instead

    """
    fixed = np.setdiff1d(np.arange(K.shape[0]), free)
    can_move = fixed.size and rigid.shape[1]
    kernel = rigid @ null_space(rigid[fixed]) if can_move else rigid
    if not kernel.shape[1]:
        return _inverse(csc_array(K), free, kernel, interface)
    kernel[fixed] = 0  # null_space returns zeros only up to rounding
    kernel = np.linalg.qr(kernel)[0]
    # pivoting selects components on which the motions are well conditioned; weights
    # decide between equal ones, instead of rounding errors
    weights = np.linspace(1, 1 - TIE, len(kernel))
    pins = qr(kernel.T * weights, mode="r", pivoting=True)[1][: kernel.shape[1]]
    kernel = gram_schmidt(kernel @ np.linalg.inv(kernel[pins]))  # a unique basis
    return _inverse(csc_array(K), np.setdiff1d(free, pins), kernel, interface)


def _inverse(
    K: csc_array,
    free: Nodes,
    kernel: NDArray[np.float64],
    interface: Interface | None,
    fixed: Nodes = NO_NODES,
) -> GeneralisedInverse:
    """Factorise K_ff, eliminating components of `interface` and `fixed` last."""
    start = perf_counter()
    if interface is None:
        K_ff = csc_matrix(K[free][:, free])
        factor = cholesky(K_ff, mode="supernodal", ordering_method="nesdis")
        return CholeskyInverse(factor, free, kernel, perf_counter() - start)
    c = interface.components
    last = np.concatenate([c, fixed])
    factor = multifrontal(K, free, interface.points, last)
    number = np.full(K.shape[0], -1, dtype=np.int32)
    number[c] = np.arange(c.size, dtype=np.int32)
    compliance = np.zeros((c.size, c.size))
    for components, U in factor.trailing() if c.size else ():
        if not components.size:
            continue  # LAPACK reports an empty matrix as an error, on standard output
        # (UᵀU)⁻¹ on the components eliminated last; skip components outside c
        lower, _ = lapack.dpotri(U.T, lower=1)
        scatter_symmetric(lower.T, number[components], compliance)
    return CondensedInverse(factor, c, compliance, kernel, perf_counter() - start)
