"""Extreme eigenvalues of F on the null space of its equations, with error bounds.

With P the orthogonal projector onto ker G ∩ range B, the condition numbers are those of

    P F P                 in the inner product  xᵀy,
    P M P F               in the inner product  xᵀF y,

the latter with a preconditioner M ≈ F⁻¹; both on the range of P. Both are self-adjoint
there, so that one Lanczos process serves both (Parlett 1998, Chapter 13). Each vector
is orthogonalised against the last two, as the recurrence says, then against all, so
that nothing is found twice; and it is projected anew, as what rounding leaves of a
kernel grows from step to step.

Of a Ritz value θ with residual r an eigenvalue is no farther than ‖r‖, and ‖r‖ is what
the last row of the tridiagonal matrix says.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import eigh_tridiagonal
from scipy.sparse import coo_array, csc_matrix, csr_array, vstack
from scipy.sparse.csgraph import connected_components
from sksparse.cholmod import cholesky

from harness import Vector
from problems.feti.operators import dual_operator, made
from problems.feti.torn import Torn

Product = Callable[[Vector], Vector]

EXHAUSTED = 1e-10  #: length of a new vector, of the largest Ritz value: none is left
#: cosine of rows, and eigenvalue of the matrix of their products, taken for zero
PARALLEL = 1e-10
CHECKED = 5  #: steps from one look at the Ritz values to the next
_CHUNK = 64  #: vectors that memory is taken for at once


class Spectrum(NamedTuple):
    """The extreme eigenvalues of an operator, without zeros."""

    smallest: float
    largest: float
    smallest_error: float  #: an eigenvalue is within this of `smallest`
    largest_error: float
    steps: int  #: products with F

    @property
    def condition(self) -> float:
        """The condition number κ."""
        return self.largest / self.smallest

    @property
    def condition_error(self) -> float:
        """By how much κ may be wrong, to first order in the errors."""
        relative = self.smallest_error / self.smallest
        return self.condition * (relative + self.largest_error / self.largest)

    def within(self, tol: float) -> bool:
        """Say whether both errors are at most `tol`, relative."""
        return (
            self.smallest_error <= tol * self.smallest
            and self.largest_error <= tol * self.largest
        )


def projector(G: csr_array) -> Product:
    """Make x ↦ x − Gᵀ(GGᵀ)⁻¹Gx for rows G (r, n) of full rank; r may be 0."""
    if not G.shape[0]:
        return lambda x: x
    factor, GT = cholesky(csc_matrix(G @ G.T)), csr_array(G.T)
    return lambda x: np.asarray(x - GT @ factor(G @ x))


def dependencies(B: csr_array) -> csr_array:
    """Return an orthonormal basis of ker Bᵀ, a row each, (k, m).

    Rows of B that depend on one another are few and meet at a crosspoint: each set of
    rows that are not orthogonal to one another is looked at on its own.
    """
    gram = coo_array(B @ B.T)
    coupled = np.abs(gram.data) > PARALLEL * gram.data.max(initial=0.0)
    i, j, data = gram.row[coupled], gram.col[coupled], gram.data[coupled]
    _, label = connected_components(
        coo_array((data, (i, j)), shape=gram.shape), directed=False
    )
    order, sizes = np.argsort(label, kind="stable"), np.bincount(label)
    first = np.cumsum(sizes) - sizes
    place = np.empty_like(order)  # of each row within its set
    place[order] = np.arange(order.size) - first[label[order]]
    found = [csr_array((0, B.shape[0]))]
    for size in np.unique(sizes[sizes > 1]):
        sets = np.flatnonzero(sizes == size)
        number = np.full(sizes.size, -1)
        number[sets] = np.arange(sets.size)
        of, here = number[label[i]], sizes[label[i]] == size
        local = np.zeros((sets.size, size, size))
        local[of[here], place[i[here]], place[j[here]]] = data[here]
        values, vectors = np.linalg.eigh(local)
        block, column = np.nonzero(values < PARALLEL * values[:, -1:])
        members = order[first[sets[block], None] + np.arange(size)]
        ends = np.arange(block.size + 1) * size
        rows = (vectors[block, :, column].ravel(), members.ravel(), ends)
        found.append(csr_array(rows, shape=(block.size, B.shape[0])))
    return csr_array(vstack(found))


def spectrum(
    F: Product, G: csr_array, M: Product | None = None, tol: float = 1e-5
) -> Spectrum:
    """Find the extreme eigenvalues of PFP, or of PMPF, on the range of P.

    Parameters
    ----------
    F : symmetric, positive definite on ker G
    G : (r, n) rows of full rank: the equations, and the `dependencies` of B
    M : preconditioner, symmetric positive semidefinite
    tol : error bound of both eigenvalues, relative

    """
    P, n = projector(G), G.shape[1]
    #: x ↦ Wx of the inner product, and Wx ↦ (operator) x
    metric: Product = (lambda x: P(F(x))) if M is not None else (lambda x: x)
    image: Product = (lambda y: P(M(y))) if M is not None else (lambda y: P(F(y)))
    v = P(np.sin(1.0 + np.arange(n) ** 2))
    V = np.empty((_CHUNK, n))
    WV = V if M is None else np.empty_like(V)
    alpha, beta = list[float](), list[float]()
    Wv = metric(v)
    length = float(np.sqrt(v @ Wv))
    for k in range(n):
        if k == len(V):
            V = np.concatenate([V, np.empty((_CHUNK, n))])
            WV = V if M is None else np.concatenate([WV, np.empty((_CHUNK, n))])
        V[k], WV[k] = v / length, Wv / length
        v = image(WV[k])
        alpha.append(float(v @ WV[k]))
        v -= alpha[-1] * V[k] + (beta[-1] * V[k - 1] if k else 0.0)
        v = P(v - (WV[: k + 1] @ v) @ V[: k + 1])
        Wv = metric(v)
        length = float(np.sqrt(max(float(v @ Wv), 0.0)))
        over = length <= EXHAUSTED * max(alpha)
        if over or k % CHECKED == CHECKED - 1 or k == n - 1:
            found = _extreme(np.array(alpha), np.array(beta), length)
            if over or found.within(tol):
                break
        beta.append(length)
    return found


def spectra_of_equations(
    torn: Torn,
    preconditioners: Sequence[tuple[str, str] | None] = (None,),
    tol: float = 1e-5,
) -> list[Spectrum]:
    """Find the spectra for the rows of supports and gluing, as if no contact was there.

    Parameters
    ----------
    torn : its supports hold every body
    preconditioners : kind and scaling of each, see `problems.feti.operators`, or none
    tol : as of `spectrum`

    """
    B_E = torn.B[: torn.equalities]
    F = made(dual_operator(B_E, torn.domains, torn.equalities).arrays)
    G = vstack([(B_E @ torn.domains.kernel).T, dependencies(B_E)], format="csr")
    inverses = [p and F.preconditioner(*p) for p in preconditioners]
    return [spectrum(F, G, M, tol) for M in inverses]


def _extreme(alpha: Vector, beta: Vector, length: float) -> Spectrum:
    """Bound the extreme Ritz values, the next vector being of this length."""
    theta, s = eigh_tridiagonal(alpha, beta)
    rounding = np.finfo(float).eps * alpha.size * np.abs(theta).max()
    residual: NDArray[np.float64] = length * np.abs(s[-1]) + rounding
    return Spectrum(
        float(theta[0]), float(theta[-1]), float(residual[0]), float(residual[-1]),
        alpha.size,
    )  # fmt: skip
