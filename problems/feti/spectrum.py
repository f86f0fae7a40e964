"""Extreme eigenvalues of F on the null space of the equalities, with error bounds.

Let G = RᵀBᵀ be the matrix of the equalities of the dual, and P the orthogonal projector
onto ker G ∩ range B. The spectra are those of

    P F P                 in the inner product  xᵀy,
    P M P F               in the inner product  xᵀF y,

without and with a preconditioner M ≈ F⁻¹. Both operators are self-adjoint on the range
of P, and the same Lanczos process applies to both (Parlett 1998, Chapter 13). Each new
vector is orthogonalised against its two predecessors, as in the recurrence, then
against all previous vectors, which excludes spurious copies of eigenvalues. Each new
vector is also projected by P, because components in ker P due to rounding would grow.

The interval of radius ‖r‖ around a Ritz value θ with residual r contains an eigenvalue.
The norm ‖r‖ is computed from the last component of the eigenvector of the tridiagonal
matrix for θ.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from scipy.linalg import eigh_tridiagonal
from scipy.sparse import csc_matrix, csr_array
from sksparse.cholmod import cholesky

from mortarbench.harness import QP, Vector
from mortarbench.harness.operators import preconditioned
from mortarbench.problems.feti.operators import block_pseudoinverse, decouple_contact

Product = Callable[[Vector], Vector]

#: norm of a new vector, relative to the largest diagonal entry of the tridiagonal
#: matrix, at which the Krylov space counts as invariant and the Lanczos process ends
BREAKDOWN = 1e-10
CHECK_INTERVAL = 5  #: number of Lanczos steps between evaluations of the Ritz values


class Spectrum(NamedTuple):
    """The extreme eigenvalues of an operator on the range of P."""

    smallest: float
    largest: float
    smallest_error: float  #: bound on the distance from `smallest` to an eigenvalue
    largest_error: float  #: bound on the distance from `largest` to an eigenvalue
    steps: int  #: number of Lanczos steps

    @property
    def condition(self) -> float:
        """The condition number κ."""
        return self.largest / self.smallest

    @property
    def condition_error(self) -> float:
        """First-order bound on the error of κ, from the errors of both eigenvalues."""
        relative = self.smallest_error / self.smallest
        return self.condition * (relative + self.largest_error / self.largest)

    def within(self, tol: float) -> bool:
        """Return True if both relative errors are at most `tol`."""
        return (
            self.smallest_error <= tol * self.smallest
            and self.largest_error <= tol * self.largest
        )


def spectrum(
    F: Product,
    P: Product,
    n: int,
    M: Product | None = None,
    tol: float = 1e-5,
) -> Spectrum:
    """Compute the extreme eigenvalues of PFP, or of PMPF, on the range of P.

    Parameters
    ----------
    F : symmetric, positive definite on the range of P
    P : orthogonal projector of vectors (n,)
    M : preconditioner, symmetric positive semidefinite
    tol : bound on the relative error of both extreme eigenvalues

    """
    # the inner product is xᵀWy; `metric` maps x to Wx, and `image` maps Wx to the image
    # of x under the operator
    metric: Product = (lambda x: P(F(x))) if M is not None else (lambda x: x)
    image: Product = (lambda y: P(M(y))) if M is not None else (lambda y: P(F(y)))
    v = P(
        np.sin(1.0 + np.arange(n) ** 2)
    )  # arbitrary vector, rarely orthogonal to eigenvectors
    V, WV = list[Vector](), list[Vector]()
    alpha, beta = list[float](), list[float]()
    Wv = metric(v)
    length = float(np.sqrt(v @ Wv))
    for k in range(n):
        V.append(v / length)
        WV.append(Wv / length)
        v = image(WV[k])
        alpha.append(float(v @ WV[k]))
        v -= alpha[-1] * V[k] + (beta[-1] * V[k - 1] if k else 0.0)
        v = P(v - (np.array(WV) @ v) @ np.array(V))
        Wv = metric(v)
        length = float(np.sqrt(max(float(v @ Wv), 0.0)))
        over = length <= BREAKDOWN * max(alpha)
        if over or k % CHECK_INTERVAL == CHECK_INTERVAL - 1 or k == n - 1:
            result = ritz_bounds(np.array(alpha), np.array(beta), length)
            if over or result.within(tol):
                break
        beta.append(length)
    return result


def spectra(
    qp: QP,
    B: csr_array,
    preconditioners: Sequence[tuple[str, str] | None] = (None,),
    tol: float = 1e-5,
) -> list[Spectrum]:
    """Compute the extreme eigenvalues of PFP, or of PMPF for each preconditioner M.

    Parameters
    ----------
    qp : dual of a problem without contact; the supports must exclude rigid motions of
        every body
    B : (m, N) rows of supports and gluing, which may be linearly dependent
    preconditioners : kind and scaling of each, see `problems.feti.operators`; None
        selects PFP without a preconditioner
    tol : bound on the relative error of both extreme eigenvalues

    """
    project, F = projector(B, csr_array(qp.A)), preconditioned(qp.P)
    assert F is not None
    inverses = [p and F.preconditioner(*p) for p in preconditioners]
    n = qp.q.size
    return [spectrum(qp.P.dot, project, n, M, tol) for M in inverses]


def projector(B: csr_array, G: csr_array) -> Product:
    """Return the orthogonal projector P, see the module docstring.

    B : (m, N) rows, which may be linearly dependent (redundant gluing)
    G : RᵀBᵀ (r, m) of full rank r, which may be 0
    """
    gram = csr_array(B @ B.T)
    inverse = block_pseudoinverse(decouple_contact(gram, B.shape[0]))
    if not G.shape[0]:
        return lambda x: gram @ (inverse @ x)
    factor = cholesky(csc_matrix(G @ G.T))

    def project(x: Vector) -> Vector:
        y = gram @ (inverse @ x)
        return np.asarray(y - G.T @ factor(G @ y))

    return project


def ritz_bounds(alpha: Vector, beta: Vector, length: float) -> Spectrum:
    """Return the extreme Ritz values with error bounds.

    alpha : (k,) diagonal of the tridiagonal matrix
    beta : (k − 1,) off-diagonal
    length : norm of the next Lanczos vector before normalisation
    """
    last = alpha.size - 1
    (smallest, s), (largest, t) = (
        eigh_tridiagonal(alpha, beta, select="i", select_range=(i, i))
        for i in (0, last)
    )
    rounding = float(np.finfo(float).eps) * alpha.size * float(largest[0])
    return Spectrum(
        float(smallest[0]),
        float(largest[0]),
        length * abs(float(s[-1, 0])) + rounding,
        length * abs(float(t[-1, 0])) + rounding,
        alpha.size,
    )
