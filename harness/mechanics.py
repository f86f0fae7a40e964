"""The elastic problem behind a QP of any form: what a certificate of errors needs.

A family that gives it with its case (`harness.plugin.Case`) has every answer certified,
whatever form of the problem the solver was handed; see `harness.verify.certificate`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csc_array, csr_array, eye_array

from harness.qp import QP, Matrix, Vector
from harness.solution import Solution

#: extended where the machine has it (x86: 64-bit mantissa), so that residuals near the
#: rounding of doubles are known to some digits
Real = np.longdouble
Extended = NDArray[np.longdouble]
#: up to which part of its terms what a rigid motion does to the gaps, or a load along
#: it, is taken for the rounding of coordinates, normals and tractions
UNFELT = 1e-10
_CHUNK = 500  #: rows of B whose compliance is formed at once


class Inverse(Protocol):
    """A symmetric K⁺ that is zero on the prescribed components and inverts K beyond.

    Where the supports leave rigid motions R of some body,  K K⁺ b = b  for Rᵀb = 0.
    """

    @property
    def kernel(self) -> NDArray[np.float64]:
        """Orthonormal basis R (n, r) of the rigid motions left; often r = 0."""

    def __call__(self, b: Vector) -> Vector:
        """Apply K⁺ to a vector (n,)."""

    def congruence(self, B: Matrix) -> NDArray[np.float64]:
        """Return BK⁺Bᵀ (m, m) for sparse rows B (m, n)."""


class Exact(NamedTuple):
    """The data of the primal QP in extended precision."""

    K: Any  #: (n, n) sparse
    f: Extended  #: (n,)
    B: Any  #: (m, n) sparse contact rows
    c: Extended  #: (m,)
    held: NDArray[np.int64]  #: prescribed components
    loose: Extended  #: (m,) estimate of the compliance of each row, B_i diag(K)⁻¹B_iᵀ


class RigidMotions(NamedTuple):
    """The rigid motions that the supports leave, split by whether contact feels them.

    Columns are orthonormal in extended precision. K·felt would be zero without
    rounding; what there is instead matters where bodies move far, see
    `harness.verify.certificate`.
    """

    felt: Any  #: (n, p) sparse; contact rows open or close
    free: Any  #: (n, q) sparse; no gap changes but for rounding
    G: Extended  #: (m, p)  B·felt
    largest: Any  #: (n, p) sparse: where felt is not zero, its largest entry
    KR: Extended  #: (n, p)  K·felt
    curvature: NDArray[np.float64]  #: (p, p)  feltᵀK·felt
    strain: NDArray[np.float64]  #: (p, p)  (K·felt)ᵀK⁺(K·felt)


class Grid(NamedTuple):
    """The mesh behind the unknowns, which are numbered node by node."""

    points: NDArray[np.float64]  #: (N, d)
    #: (E, 2) segments, or (E, 4) corners in turn; a triangle repeats its last one
    cells: NDArray[np.int64]
    bodies: NDArray[np.int64]  #: (E,) body of each cell
    lift: Vector  #: (n,) physical unknown − u, where boundary values are not zero


@dataclass(frozen=True, eq=False, kw_only=True)
class Mechanics:
    """Elastic bodies in contact, without dimensions, and the way back to them.

    ::

        min ½uᵀKu − fᵀu    subject to   u = 0 on the prescribed components,  B u ≤ c
    """

    #: P = K, q = −f, A has one unit entry per prescribed component, b = 0, G = B, h = c
    primal: QP
    back: Callable[[Solution], Solution]  #: of the emitted QP → of `primal`
    factorise: Callable[[], Inverse]  #: called once, if at all
    mesh_size: float  #: of the contact side, in the lengths of `primal`
    #: rigid motions of single bodies (n, r), supports or not: to balance forces with
    rigid: NDArray[np.float64]
    names: tuple[str, ...] = ()  #: of the bodies; the columns of `rigid` are in turn
    scale: float = 1.0  #: energy = scale·objective of `primal` + constant, as `Case`
    constant: float = 0.0
    grid: Grid | None = (
        None  #: to compare meshes, see `harness.crossval.discretisation`
    )

    @cached_property
    def inverse(self) -> Inverse:
        """K⁺, factorised at the first use."""
        return self.factorise()

    @cached_property
    def exact(self) -> Exact:
        """The data in extended precision."""
        K, B = csr_array(self.primal.P), csr_array(self.primal.G)
        held = np.unique(csr_array(self.primal.A).indices).astype(np.int64)
        softness = 1 / np.where(K.diagonal() > 0, K.diagonal(), np.inf)
        softness[held] = 0
        return Exact(
            K=K.astype(Real), f=-self.primal.q.astype(Real), B=B.astype(Real),
            c=self.primal.h.astype(Real), held=held,
            loose=(B.multiply(B) @ softness).astype(Real),
        )  # fmt: skip

    def energy(self, u: Extended) -> float:
        """Return the potential energy of `u` (n,), SI, summed in extended precision."""
        objective = 0.5 * (u @ (self.exact.K @ u)) - self.exact.f @ u
        return float(self.scale * objective + self.constant)

    @cached_property
    def kernel(self) -> Any:
        """All rigid motions that the supports leave (n, r), sparse, in extended."""
        return _orthonormal(self.inverse.kernel)

    @cached_property
    def motions(self) -> RigidMotions:
        """These motions, split by whether contact feels them."""
        exact, B, R = self.exact, csr_array(self.primal.G), self.inverse.kernel
        turn, p = felt_first(B, R)
        turned = self.kernel if p == R.shape[1] else _orthonormal(R @ turn)
        felt = turned[:, :p]
        KR = _cancelling(csr_array(self.primal.P), np.asarray(felt.toarray()))
        KR[exact.held] = 0
        bent = [self.relaxed(column) for column in KR.T]
        strain = np.array([[float(k @ b) for b in bent] for k in KR.T])
        return RigidMotions(
            felt=felt, free=turned[:, p:], G=np.asarray((exact.B @ felt).toarray()),
            largest=_largest(felt), KR=KR,
            curvature=np.asarray(felt.T @ KR, dtype=np.float64),
            strain=strain.reshape(p, p),
        )  # fmt: skip

    @cached_property
    def compliance(self) -> Vector:
        """√(B_i P K⁺P B_iᵀ) of each row (m,), with P = I − RRᵀ.

        A displacement v without rigid motion changes the gap of row i by no more than
        this times ‖v‖_K.
        """
        B, R = csr_array(self.primal.G), self.inverse.kernel
        squares = np.zeros(B.shape[0])
        moved = np.stack([self.inverse(r) for r in R.T], axis=1) if R.size else R
        G, G_moved, RKR = B @ R, B @ moved, R.T @ moved
        for i in range(0, B.shape[0], _CHUNK):
            rows = slice(i, i + _CHUNK)
            F = np.diag(self.inverse.congruence(B[rows]))
            rigid = (G[rows] * (G[rows] @ RKR - 2 * G_moved[rows])).sum(axis=1)
            squares[rows] = np.maximum(F + rigid, 0) + 1e-12 * F
        return np.sqrt(squares)

    def still(self, v: Extended) -> Extended:
        """Take the rigid motions out of `v` (n,):  v − R Rᵀv."""
        if not self.kernel.shape[1]:  # sparse matrices take long over nothing
            return v
        return np.asarray(v - self.kernel @ (self.kernel.T @ v))

    def relaxed(self, force: Extended) -> Extended:
        """Apply  P K⁺P,  P = I − RRᵀ,  to a force (n,)."""
        bent = self.inverse(self.still(force).astype(np.float64))
        return self.still(bent.astype(Real))

    def norm(self, v: Extended) -> float:
        """Return the energy norm ‖v‖_K; a seminorm where bodies can move rigidly.

        There, the motion is taken out first: KR = 0 but for the rounding of K, which a
        motion that is large beside the deformation would show.
        """
        v = self.still(v)
        return float(np.sqrt(max(v @ (self.exact.K @ v), Real(0))))


def _orthonormal(R: NDArray[np.float64]) -> Any:
    """Orthonormalise columns (n, r) that are so to double precision; sparse."""
    found = csr_array(R.astype(Real))
    return csr_array(found + found @ (0.5 * (eye_array(R.shape[1]) - found.T @ found)))


def _largest(R: Any) -> Any:
    """Replace the entries of each column by the largest of their sizes."""
    found = csc_array(abs(R))
    sizes = found.max(axis=0).toarray().ravel() if found.nnz else np.zeros(R.shape[1])
    found.data = np.repeat(sizes, np.diff(found.indptr))
    return found


def _cancelling(K: csr_array, R: Extended) -> Extended:
    """Return KR (n, r) to twice the digits of doubles, though its terms cancel.

    The leading parts of both have so few bits that their products add up exactly.
    """
    leading = csr_array(K.copy())
    sizes = np.repeat(abs(K).max(axis=1).toarray().ravel(), np.diff(K.indptr))
    leading.data = _leading(K.data, sizes, 26)
    top = _leading(R, np.abs(R).max(initial=Real(0)), 24)
    rest = (K - leading).astype(Real)
    leading = leading.astype(Real)
    return np.asarray(leading @ top + (leading @ (R - top) + rest @ R))


def _leading(v: Any, size: Any, bits: int) -> Any:
    """Round to multiples of 2^−bits of `size`, itself rounded up to a power of two."""
    unit = np.exp2(np.ceil(np.log2(np.where(size > 0, size, 1))) - bits)
    return np.round(v / unit) * unit


def felt_first(B: Matrix, R: NDArray[np.float64]) -> tuple[NDArray[np.float64], int]:
    """Turn the basis R such that its first p columns are felt by B, the others not."""
    r = R.shape[1]
    length = np.sqrt(np.asarray(B.multiply(B).sum(axis=1)).ravel())
    per = 1 / np.where(length > 0, length, np.inf)
    G, terms = per[:, None] * (B @ R), per[:, None] * (abs(B) @ np.abs(R))
    _, sizes, turn = np.linalg.svd(G, full_matrices=len(per) < r)
    felt = int((sizes > UNFELT * terms.max(initial=0.0)).sum())
    return turn.T, felt
