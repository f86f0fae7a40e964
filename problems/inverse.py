"""Generalised inverse of a floating body's stiffness by Cholesky with fixing nodes.

Brzobohatý, Dostál, Kozubek, Kovář, Markopoulos (2011), the paper's reference [8]: a
few fixing nodes spread over each body keep the factorisation well conditioned. With
R* the rows of the rigid modes at these nodes (orthonormalised, zero elsewhere) and
ρ > 0,

    K_ρ = K + ρ R*R*ᵀ    is positive definite, and    K K_ρ⁻¹ K = K,

so K⁺ = K_ρ⁻¹ is a symmetric generalised inverse, one sparse Cholesky factor away. It is
not the Moore-Penrose inverse; on loads that balance (Rᵀf = 0) the two give solutions
that differ by a rigid motion only.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import block_array, csc_array, csc_matrix, csr_array
from sksparse.cholmod import Factor, cholesky

from harness import Matrix, Vector
from problems.mesh import Nodes, dofs_of

FIXING_NODES = 4  #: per body; fewer condition worse, more fill the factor


@dataclass(frozen=True, eq=False)
class GeneralisedInverse:
    """A symmetric generalised inverse K⁺ = K_ρ⁻¹ of a semidefinite K (n, n)."""

    factor: Factor  #: L Lᵀ = Π K_ρ Πᵀ with CHOLMOD's permutation Π
    kernel: NDArray[np.float64]  #: R (n, r), orthonormal columns; r = 0 for regular K

    def __call__(self, b: Vector) -> Vector:
        """Apply K⁺ to one vector (n,) or to several (n, k)."""
        return np.asarray(self.factor.solve_A(b))

    def half(self, B: Matrix) -> NDArray[np.float64]:
        """Return W = L⁻¹ΠBᵀ (n, m), so that WᵀW = BK⁺Bᵀ, symmetric to the last bit."""
        columns = B.T.toarray() if hasattr(B, "toarray") else np.asarray(B).T
        permuted = self.factor.apply_P(columns)
        return np.asarray(self.factor.solve_L(permuted, use_LDLt_decomposition=False))


def regular_inverse(K: Matrix) -> GeneralisedInverse:
    """Factorise a positive definite K; its generalised inverse is the inverse."""
    return GeneralisedInverse(cholesky(csc_matrix(K)), np.zeros((K.shape[0], 0)))


def floating_inverse(
    K: Matrix, kernels: Sequence[NDArray[np.float64]], fixing: Sequence[Nodes]
) -> GeneralisedInverse:
    """Factorise the stiffness of floating bodies numbered one after another.

    Parameters
    ----------
    K : (n, n) block diagonal over the bodies
    kernels : per body, an orthonormal basis (2N_body, r_body) of its rigid modes
    fixing : per body, the numbers (within it) of nodes that no rigid motion leaves all
        at rest: at least two that are apart

    """
    R = block_array([[csr_array(k) if i == j else None for j in range(len(kernels))]
                     for i, k in enumerate(kernels)])  # fmt: skip
    starred = []
    for k, nodes in zip(kernels, fixing, strict=True):
        rows = dofs_of(nodes)
        Q = np.zeros_like(k)
        Q[rows] = np.linalg.qr(k[rows])[0]
        starred.append(csr_array(Q))
    blocks = [[s if i == j else None for j in range(len(starred))]
              for i, s in enumerate(starred)]  # fmt: skip
    R_star = csc_array(block_array(blocks))
    rho = K.diagonal().max()
    K_rho = K + rho * (R_star @ R_star.T)
    # R is dense per body; the QP's G = RᵀBᵀ needs it whole
    return GeneralisedInverse(cholesky(csc_matrix(K_rho)), R.toarray())


def fixing_nodes(points: NDArray[np.float64], parts: int = FIXING_NODES) -> Nodes:
    """Choose `parts` (a power of two) nodes (N, 2) spread over one body.

    Recursive bisection across the longest principal axis; of each part, the node
    nearest to its centroid.
    """
    groups = [np.arange(len(points))]
    while len(groups) < parts:
        groups = [half for group in groups for half in _halves(points, group)]
    chosen = []
    for group in groups:
        offset = points[group] - points[group].mean(axis=0)
        chosen.append(group[np.linalg.norm(offset, axis=1).argmin()])
    return np.array(chosen, dtype=np.int64)


def _halves(points: NDArray[np.float64], group: Nodes) -> tuple[Nodes, Nodes]:
    offset = points[group] - points[group].mean(axis=0)
    axis = np.linalg.svd(offset, full_matrices=False)[2][0]
    order = group[np.argsort(offset @ axis, kind="stable")]
    return order[: len(order) // 2], order[len(order) // 2 :]
