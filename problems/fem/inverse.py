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
F = BK⁺Bᵀ = B_c (K⁺)_cc B_cᵀ  for every load step by one small product.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from time import perf_counter
from typing import Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import lapack, null_space, qr
from scipy.sparse import block_diag, csc_array, csc_matrix, csr_array
from sksparse.cholmod import Factor, analyze

from harness import Matrix, Vector
from problems.fem.mesh import Nodes, dofs_of


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


@dataclass(frozen=True, eq=False)
class Factorised:
    """K⁺ through a Cholesky factor; BK⁺Bᵀ by one solve per row, the paper's way."""

    factor: Factor
    order: Nodes  #: components in the order of the factor; K⁺ is zero on the others
    kernel: NDArray[np.float64]
    seconds: float  #: to factorise, and to condense where that was asked for

    def __call__(self, b: Vector) -> Vector:
        """Solve."""
        x = np.zeros_like(b)
        x[self.order] = self.factor.solve_A(b[self.order])
        return x

    def congruence(self, B: Matrix) -> NDArray[np.float64]:
        """Solve for all rows of B in one block."""
        F = B @ self(B.T.toarray())
        return np.asarray((F + F.T) / 2)


@dataclass(frozen=True, eq=False)
class Condensed:
    """K⁺ with its block on the components that constraints can touch."""

    whole: Factorised
    interface: Nodes  #: (c,) components
    compliance: NDArray[np.float64]  #: (K⁺)_cc, zero where a component is prescribed

    @property
    def kernel(self) -> NDArray[np.float64]:
        """Orthonormal basis R (n, r) of ker K."""
        return self.whole.kernel

    @property
    def seconds(self) -> float:
        """What factorising and condensing took."""
        return self.whole.seconds

    def __call__(self, b: Vector) -> Vector:
        """Solve with the whole factor."""
        return self.whole(b)

    def congruence(self, B: Matrix) -> NDArray[np.float64]:
        """Return BK⁺Bᵀ; ValueError where B touches other components."""
        B_c = csr_array(B)[:, self.interface]
        if B_c.count_nonzero() != B.count_nonzero():
            raise ValueError("rows touch components outside the condensed interface")
        F = B_c @ (B_c @ self.compliance).T
        return np.asarray((F + F.T) / 2)


def regular_inverse(
    K: Matrix, free: Nodes, interface: Nodes | None = None
) -> GeneralisedInverse:
    """Factorise K_ff, condensed onto the free part of `interface` where it is given.

    Raises
    ------
    sksparse.cholmod.CholmodNotPositiveDefiniteError
        When K_ff is singular.

    """
    return _inverse(csc_array(K), free, np.zeros((K.shape[0], 0)), interface)


def floating_inverse(
    K: Matrix,
    kernels: Sequence[NDArray[np.float64]],
    fixing: Sequence[Nodes],
    interface: Nodes | None = None,
) -> GeneralisedInverse:
    """Factorise the stiffness of floating bodies numbered one after another.

    Parameters
    ----------
    K : (n, n) block diagonal over the bodies
    kernels : per body, an orthonormal basis (2N_body, r_body) of its rigid modes
    fixing : per body, the numbers (within it) of nodes that no rigid motion leaves all
        at rest: at least two that are apart
    interface : components to condense onto

    """
    starred = []
    for R, nodes in zip(kernels, fixing, strict=True):
        rows = dofs_of(nodes)
        Q = np.zeros_like(R)
        Q[rows] = np.linalg.qr(R[rows])[0]
        starred.append(csr_array(Q))
    R_star = csc_array(block_diag(starred))
    rho = K.diagonal().max()
    K_rho = csc_array(K + rho * (R_star @ R_star.T))
    whole = np.asarray(block_diag([csr_array(R) for R in kernels]).toarray())
    return _inverse(K_rho, np.arange(K.shape[0]), whole, interface)


def supported_inverse(
    K: Matrix, free: Nodes, rigid: NDArray[np.float64], interface: Nodes | None = None
) -> GeneralisedInverse:
    """Factorise K_ff where the supports may leave rigid motions of some body.

    As many further components are held as there are such motions, those that a pivoted
    QR factorisation of the motions finds to fix them best: on loads that balance these,
    they feel no force.

    Parameters
    ----------
    rigid : (n, r) rigid motions of all bodies, supports or not
    interface : components to condense onto

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
    K: csc_array, free: Nodes, kernel: NDArray[np.float64], interface: Nodes | None
) -> GeneralisedInverse:
    start = perf_counter()
    touched = np.zeros(0, np.int64) if interface is None else np.unique(interface)
    held = ~np.isin(touched, free)
    last = touched[~held]
    first = np.setdiff1d(free, last, assume_unique=True)
    inner = csc_matrix(K[first][:, first])
    fill_reducing = analyze(inner, mode="supernodal", ordering_method="nesdis").P()
    order = np.concatenate([first[fill_reducing], last])
    ordered = csc_matrix(K[order][:, order])
    factor = analyze(ordered, mode="supernodal", ordering_method="natural")
    factor.cholesky_inplace(ordered)
    if interface is None:
        return Factorised(factor, order, kernel, perf_counter() - start)
    L = factor.L()[len(first) :, len(first) :].toarray()
    lower, _ = lapack.dpotri(L, lower=1, overwrite_c=1)
    compliance = np.zeros((touched.size, touched.size))
    compliance[np.ix_(~held, ~held)] = np.tril(lower) + np.tril(lower, -1).T
    whole = Factorised(factor, order, kernel, perf_counter() - start)
    return Condensed(whole, touched, compliance)
