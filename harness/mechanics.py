"""The elastic problem behind a QP of any form: what a certificate of errors needs.

A family that gives it with its case (`harness.plugin.Case`) has every answer certified,
whatever form of the problem the solver was handed; see `harness.verify.certificate`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import block_array, csc_array, csr_array, eye_array, vstack

from mortarbench.harness.qp import QP, Matrix, Vector, no_rows
from mortarbench.harness.solution import Solution

#: extended where the machine has it (x86: 64-bit mantissa), so that residuals near the
#: rounding of doubles are known to some digits
Real = np.longdouble
Extended = NDArray[np.longdouble]
#: up to which part of its terms what a rigid motion does to the gaps, or a load along
#: it, is taken for the rounding of coordinates, normals and tractions
MOTION_ROUNDING = 1e-10


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


class Substructures(Protocol):
    """The stiffness as a sum over subdomains that float:  K = Tᵀ diag(K_1 … K_S) T.

    Torn unknowns v (N,) have a copy of each component in every subdomain around it, in
    axes of that subdomain. The rigid motions R_s of a subdomain are exactly the kernel
    of what is meant by K_s, that is of P_s K_s P_s with P_s = I − R_sR_sᵀ: what
    rounding left of K_s R_s is no part of the problem.
    """

    @property
    def spread(self) -> csr_array:
        """T (N, n): copies a displacement u of the whole into the subdomains."""

    @property
    def kernel(self) -> csr_array:
        """Orthonormal rigid motions R (N, r), each of one subdomain."""

    @property
    def weight(self) -> Vector:
        """Relative stiffness (N,) of the copies, one for all components of a node."""

    def diagonal(self, at: NDArray[np.int64]) -> Vector:
        """Return the diagonal of K at components `at` (k,) of the whole."""

    def product(self, v: NDArray[Any]) -> NDArray[Any]:
        """Apply PKP to v (N,), in its precision."""

    def squared_product(self, v: Vector) -> Vector:
        """Apply K∘K, the squares of the entries of K, to v (N,)."""

    def solve(self, b: Vector) -> Vector:
        """Apply PK⁺P to forces (N,)."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Friction:
    """Friction with a given bound, as Tresca's law has it; none without rows.

    ::

        Σ gᵢ|Tᵢu − sᵢ|  joins the energy;  its multipliers are  |λᵢ| ≤ gᵢ

    T u is the tangential motion of the slave against the master, and s is where it
    began: zero for one static load, and T u of the step before for slip increments. A
    contact row may have several rows, one for each tangential direction, in turn.

    The law of the row says what the bound should be, g = cohesion + mu·λ_n with the
    multiplier λ_n of its contact row: Tresca's has no mu, Coulomb's no cohesion.
    """

    T: csr_array  #: (k, n) tangential rows
    bound: Vector  #: (k,) g ≥ 0, a force
    start: Vector  #: (k,) s, a length
    row: NDArray[np.int64]  #: (k,) the contact row of each
    cohesion: Vector  #: (k,) a force
    mu: Vector  #: (k,) coefficient of friction
    unsettled: float = 0.0  #: `residual` at the solution with this bound, where known

    def demanded(self, normal: Vector) -> Vector:
        """Return cohesion + mu·λ_n (k,), never negative, for normal forces (m,)."""
        return np.asarray(self.cohesion + self.mu * np.maximum(normal[self.row], 0.0))

    def residual(self, normal: Vector) -> float:
        """Return ‖g − (cohesion + mu·λ_n)‖/‖g‖, absolute where g vanishes."""
        off = float(np.linalg.norm(self.bound - self.demanded(normal)))
        return off / (float(np.linalg.norm(self.bound)) or 1.0)

    def __getitem__(self, kept: NDArray[Any]) -> Friction:
        """Keep some of the rows."""
        rows = {k: v[kept] for k, v in vars(self).items() if k != "unsettled"}
        return replace(self, **rows)


_NOTHING = np.zeros(0)
NO_FRICTION = Friction(
    T=no_rows(0), bound=_NOTHING, start=_NOTHING, row=np.zeros(0, dtype=np.int64),
    cohesion=_NOTHING, mu=_NOTHING,
)  # fmt: skip


def contact_rows(primal: QP, friction: Friction) -> tuple[csr_array, Vector]:
    """Stack the rows of contact and friction:  B (m + k, n)  and  c (m + k,)."""
    B = csr_array(primal.G)
    if not friction.bound.size:
        return B, primal.h
    return csr_array(vstack([B, friction.T])), np.append(primal.h, friction.start)


def with_friction(primal: QP, friction: Friction) -> QP:
    """Emit the problem with friction as a QP: of each |·| one more variable.

    ::

        min ½uᵀKu − fᵀu + gᵀt   subject to   B_D u = 0,  B u ≤ c,
                                              Tu − t ≤ s,  −Tu − t ≤ −s

    of the rows with g > 0; the point is (u, t), and λ_t is the difference of the
    multipliers of the last two rows. Without such rows it is `primal` itself.
    """
    moving = friction[friction.bound > 0]
    k, n = moving.T.shape
    if not k:
        return primal
    one = eye_array(k)
    return QP(
        P=csc_array(block_array([[primal.P, None], [None, csc_array((k, k))]])),
        q=np.append(primal.q, moving.bound),
        A=csr_array(block_array([[primal.A, csr_array((primal.b.size, k))]])),
        b=primal.b,
        G=csr_array(block_array([
            [primal.G, None], [moving.T, -one], [-moving.T, -one],
        ])),
        h=np.concatenate([primal.h, moving.start, -moving.start]),
        lb=np.full(n + k, -np.inf), ub=np.full(n + k, np.inf),
    )  # fmt: skip


class Exact(NamedTuple):
    """The data of the contact problem but K, in extended precision.

    The rows are those of the contact and, below them, those of the friction. With
    v = Bu − c all have one law: the multiplier is between its bounds, v = 0 where it is
    strictly between them, v ≤ 0 at the lower and v ≥ 0 at the upper one.
    """

    f: Extended  #: (n,)
    B: Any  #: (m, n) sparse, contact and friction
    c: Extended  #: (m,)
    lower: Extended  #: (m,) 0 of contact, −g of friction
    upper: Extended  #: (m,) ∞ of contact, g of friction
    fixed: NDArray[np.int64]  #: prescribed components
    compliance: (
        Extended  #: (m,) estimate of the compliance of each row, B_i diag(K)⁻¹B_iᵀ
    )

    @property
    def contact(self) -> NDArray[np.bool_]:
        """Which rows are of the contact, (m,)."""
        return np.asarray(np.isinf(self.upper))

    def motion(self, u: Extended) -> Extended:
        """Return v = Bu − c (m,): penetration, and slip of the friction rows."""
        return np.asarray(self.B @ u - self.c)

    def friction_work(self, u: Extended) -> Extended:
        """Return g|v| (m,); zero of contact rows, whose v must not be positive."""
        bound = np.where(self.contact, 0, self.upper)
        return np.asarray(bound * np.abs(self.motion(u)))

    def interior(self, multipliers: Extended) -> Extended:
        """Return the distance (m,) of multipliers from their bounds; λ of contact."""
        return np.asarray(
            np.minimum(multipliers - self.lower, self.upper - multipliers)
        )


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
    KR: Extended  #: (n, p)  K·felt on the components that no support holds


#: meshio's names of cells of first order, by their dimension and number of corners
KINDS = {
    (0, 1): "vertex",
    (1, 2): "line",
    (2, 3): "triangle",
    (2, 4): "quad",
    (3, 4): "tetra",
    (3, 6): "wedge",
    (3, 8): "hexahedron",
}


class CellBlock(NamedTuple):
    """The cells of one kind."""

    kind: str  #: as meshio calls it
    nodes: NDArray[np.int64]  #: (k, corners)
    cells: NDArray[np.int64]  #: (k,) rows of the table that they are


def cell_blocks(table: NDArray[np.int64], dim: int) -> tuple[CellBlock, ...]:
    """Sort a table of cells (E, c) by kinds, those with the fewest corners first.

    Where kinds are mixed, a cell with fewer corners than the table has columns repeats
    its last one: a triangle among quadrilaterals is (a, b, c, c).

    dim : of the cells, which is that of the points of bodies
    """
    differs = np.ones(table.shape, dtype=bool)
    differs[:, 1:] = table[:, 1:] != table[:, :-1]
    corners = table.shape[1] - np.argmax(differs[:, ::-1], axis=1)
    blocks = []
    for count in np.unique(corners):
        cells = np.flatnonzero(corners == count)
        blocks.append(
            CellBlock(KINDS[dim, int(count)], table[cells, : int(count)], cells)
        )
    return tuple(blocks)


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

    and with friction, what its rows add to the energy.
    """

    #: P = K, q = −f, A has one unit entry per prescribed component, b = 0, G = B, h = c
    primal: QP
    #: of the emitted QP → x = u, y of the supports, z of contact and friction rows
    to_primal: Callable[[Solution], Solution]
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
    friction: Friction = NO_FRICTION
    #: bounds the error of a displacement (n,) with multipliers (m,) of `rows` by
    #: subdomains, as a `Certificate`; no factor of the whole K is needed then
    in_parts: Callable[[Vector, Vector], Any] | None = None

    @cached_property
    def rows(self) -> csr_array:
        """All rows B (m, n): of the contact, then of the friction."""
        return contact_rows(self.primal, self._carrying)[0]

    @cached_property
    def program(self) -> QP:
        """The problem as a QP, see `with_friction`; `primal` without friction."""
        return with_friction(self.primal, self.friction)

    def multipliers(self, s: Solution) -> Vector:
        """Return λ (m,) of `rows` from a solution that `to_primal` gives."""
        contact = self.primal.h.size
        return np.append(s.z[:contact], s.z[contact:][self.friction.bound > 0])

    @cached_property
    def _carrying(self) -> Friction:
        """The friction that there is: rows of bound zero neither carry nor cost."""
        return self.friction[self.friction.bound > 0]

    @cached_property
    def inverse(self) -> Inverse:
        """K⁺, factorised at the first use."""
        return self.factorise()

    @cached_property
    def exact(self) -> Exact:
        """The data in extended precision."""
        diagonal, B = self.primal.P.diagonal(), self.rows
        c = contact_rows(self.primal, self._carrying)[1]
        bound, contact = self._carrying.bound.astype(Real), self.primal.h.size
        fixed = np.unique(csr_array(self.primal.A).indices).astype(np.int64)
        softness = 1 / np.where(diagonal > 0, diagonal, np.inf)
        softness[fixed] = 0
        return Exact(
            f=-self.primal.q.astype(Real), B=B.astype(Real),
            c=c.astype(Real), fixed=fixed,
            lower=np.append(np.zeros(contact, dtype=Real), -bound),
            upper=np.append(np.full(contact, np.inf, dtype=Real), bound),
            compliance=(B.multiply(B) @ softness).astype(Real),
        )  # fmt: skip

    @cached_property
    def stiffness(self) -> Any:
        """K (n, n), sparse, in extended precision."""
        return csr_array(self.primal.P).astype(Real)

    @cached_property
    def whole(self) -> Mechanics:
        """The same without subdomains: for what needs K⁺, or u_λ without jumps."""
        return self if self.in_parts is None else replace(self, in_parts=None)

    def energy(self, u: Extended) -> float:
        """Return the potential energy of `u` (n,), SI, summed in extended precision.

        The work of friction is a part of it.
        """
        objective = 0.5 * (u @ (self.stiffness @ u)) - self.exact.f @ u
        objective = objective + self.exact.friction_work(u).sum()
        return float(self.scale * objective + self.constant)

    @cached_property
    def kernel(self) -> Any:
        """All rigid motions that the supports leave (n, r), sparse, in extended."""
        return _orthonormal(self.inverse.kernel)

    @cached_property
    def motions(self) -> RigidMotions:
        """These motions, split by whether contact feels them."""
        exact, B, R = self.exact, self.rows, self.inverse.kernel
        turn, p = felt_first(B, R)
        turned = self.kernel if p == R.shape[1] else _orthonormal(R @ turn)
        felt = turned[:, :p]
        KR = np.zeros(felt.shape, dtype=Real)
        if p:
            KR = cancelling(csr_array(self.primal.P), np.asarray(felt.toarray()))
            KR[exact.fixed] = 0
        return RigidMotions(
            felt=felt, free=turned[:, p:], G=np.asarray((exact.B @ felt).toarray()),
            largest=_largest(felt), KR=KR,
        )  # fmt: skip

    def without_rigid_motion(self, v: Extended) -> Extended:
        """Take the rigid motions out of `v` (n,):  v − R Rᵀv."""
        if not self.kernel.shape[1]:  # sparse matrices take long over nothing
            return v
        return np.asarray(v - self.kernel @ (self.kernel.T @ v))

    def apply_inverse(self, force: Extended) -> Extended:
        """Apply  P K⁺P,  P = I − RRᵀ,  to a force (n,)."""
        bent = self.inverse(self.without_rigid_motion(force).astype(np.float64))
        return self.without_rigid_motion(bent.astype(Real))

    def norm(self, v: Extended) -> float:
        """Return the energy norm ‖v‖_K; a seminorm where bodies can move rigidly.

        There, the motion is taken out first: KR = 0 but for the rounding of K, which a
        motion that is large beside the deformation would show.
        """
        v = self.without_rigid_motion(v)
        return float(np.sqrt(max(v @ (self.stiffness @ v), Real(0))))


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


def cancelling(K: csr_array, R: Extended) -> Extended:
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
    felt = int((sizes > MOTION_ROUNDING * terms.max(initial=0.0)).sum())
    return turn.T, felt
