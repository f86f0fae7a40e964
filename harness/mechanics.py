"""The elastic problem behind a QP of any form: what a certificate of errors needs.

A family that gives it with its case (`harness.plugin.Case`) has every answer certified,
whatever form of the problem the solver was handed; see `harness.certificate`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array

from harness.qp import QP, Matrix, Vector
from harness.solution import Solution

#: extended where the machine has it (x86: 64-bit mantissa), so that residuals near the
#: rounding of doubles are known to some digits
Real = np.longdouble
Extended = NDArray[np.longdouble]


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


class Grid(NamedTuple):
    """The mesh behind the unknowns, which are numbered node by node."""

    points: NDArray[np.float64]  #: (N, d)
    cells: NDArray[np.int64]  #: (E, 2) segments or (E, 4) quadrilaterals, in turn
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
    scale: float = 1.0  #: energy = scale·objective of `primal` + constant, as `Case`
    constant: float = 0.0
    grid: Grid | None = None  #: to compare meshes, see `harness.discretisation`

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

    def norm(self, v: Extended) -> float:
        """Return the energy norm ‖v‖_K; a seminorm where bodies can move rigidly.

        There, the motion is taken out first: KR = 0 but for the rounding of K, which a
        motion that is large beside the deformation would show.
        """
        R = self.inverse.kernel
        v = v - R @ (R.T @ v)
        return float(np.sqrt(max(v @ (self.exact.K @ v), Real(0))))
