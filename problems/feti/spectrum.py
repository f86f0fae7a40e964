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
from scipy.sparse import csc_matrix
from sksparse.cholmod import cholesky

from mortarbench.harness import Vector
from mortarbench.harness.distributed.vectors import DistributedColumns
from mortarbench.problems.fem.mesh import Nodes
from mortarbench.problems.feti.distributed import RankOperator

Product = Callable[[Vector], Vector]

#: norm of a new vector, relative to the largest diagonal entry of the tridiagonal
#: matrix, at which the Krylov space counts as invariant and the Lanczos process ends
BREAKDOWN = 1e-10
CHECK_INTERVAL = 5  #: number of Lanczos steps between evaluations of the Ritz values
_CHUNK = 64  #: number of Lanczos vectors per allocation


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
    *,
    rows: Nodes | None = None,
    total: Product = np.asarray,
) -> Spectrum:
    """Compute the extreme eigenvalues of PFP, or of PMPF, on the range of P.

    Parameters
    ----------
    F : symmetric, positive definite on the range of P
    P : orthogonal projector of vectors (n,)
    M : preconditioner, symmetric positive semidefinite
    tol : bound on the relative error of both extreme eigenvalues
    rows : components on this rank; None for all n components
    total : function that returns, on each rank, the sum over all ranks of arrays (k,)

    """
    local = np.arange(n) if rows is None else rows

    def dot(x: Vector, y: Vector) -> float:
        return float(total(np.atleast_1d(x @ y))[0])

    # the inner product is xᵀWy; `metric` maps x to Wx, and `image` maps Wx to the image
    # of x under the operator
    metric: Product = (lambda x: P(F(x))) if M is not None else (lambda x: x)
    image: Product = (lambda y: P(M(y))) if M is not None else (lambda y: P(F(y)))
    v = P(np.sin(1.0 + local**2))  # arbitrary vector, rarely orthogonal to eigenvectors
    V = np.empty((_CHUNK, local.size))
    WV = V if M is None else np.empty_like(V)
    alpha, beta = list[float](), list[float]()
    Wv = metric(v)
    length = float(np.sqrt(dot(v, Wv)))
    for k in range(n):
        if k == len(V):
            more = np.empty((_CHUNK, local.size))
            V = np.concatenate([V, more])
            WV = V if M is None else np.concatenate([WV, more])
        V[k], WV[k] = v / length, Wv / length
        v = image(WV[k])
        alpha.append(dot(v, WV[k]))
        v -= alpha[-1] * V[k] + (beta[-1] * V[k - 1] if k else 0.0)
        v = P(v - total(WV[: k + 1] @ v) @ V[: k + 1])
        Wv = metric(v)
        length = float(np.sqrt(max(dot(v, Wv), 0.0)))
        over = length <= BREAKDOWN * max(alpha)
        if over or k % CHECK_INTERVAL == CHECK_INTERVAL - 1 or k == n - 1:
            result = ritz_bounds(np.array(alpha), np.array(beta), length)
            if over or result.within(tol):
                break
        beta.append(length)
    return result


def spectra_over_ranks(
    F: RankOperator,
    G: DistributedColumns,
    preconditioners: Sequence[tuple[str, str] | None] = (None,),
    tol: float = 1e-5,
) -> list[Spectrum]:
    """Compute the extreme eigenvalues of PFP, or of PMPF for each preconditioner M.

    F acts on the multipliers of supports and gluing. All ranks must call this function
    together; the results are equal on all ranks.

    Parameters
    ----------
    F, G : operator F and equality rows RᵀBᵀ of the dual of a problem without contact;
        the supports must exclude rigid motions of every body
    preconditioners : kind and scaling of each, see `problems.feti.operators`; None
        selects PFP without a preconditioner
    tol : bound on the relative error of both extreme eigenvalues

    """
    halo, ranks = F.halo, F.halo.ranks
    m = ranks.total(np.array([float(halo.owned.size)]))[0]
    project = projector(F, G)

    def plain(A: Product) -> Product:
        return lambda x: np.asarray(A(x))

    inverses = [p and plain(F.preconditioner(*p)) for p in preconditioners]
    return [
        spectrum(
            plain(F),
            project,
            int(m),
            M,
            tol,
            rows=halo.rows[halo.owned],
            total=ranks.total,
        )
        for M in inverses
    ]


def projector(F: RankOperator, G: DistributedColumns) -> Product:
    """Return the orthogonal projector P, see the module docstring.

    All ranks must call this function together.

    Parameters
    ----------
    F : operator with rows B, which may be linearly dependent (redundant gluing)
    G : RᵀBᵀ (r, m) of full rank r, which may be 0

    """
    within = F.onto_rows()
    if not G.part.shape[0]:
        return within
    factor = cholesky(csc_matrix(G.gram()))

    def project(x: Vector) -> Vector:
        y = within(x)
        return np.asarray(y - np.asarray(G.T @ factor(G @ y)))

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
