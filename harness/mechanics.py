"""The elastic contact problem behind a QP, for certificates of errors.

If a family attaches it to its case (`harness.plugin.Case`), the error of every answer
is bounded in the energy norm, in any form of the QP; see `harness.verify.certificate`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import (
    block_array,
    csc_array,
    csr_array,
    eye_array,
    hstack,
    vstack,
)

from mortarbench.harness.qp import QP, Matrix, Vector, no_rows
from mortarbench.harness.sets.blocks import norms
from mortarbench.harness.sets.box import Box
from mortarbench.harness.sets.cones import Cones
from mortarbench.harness.sets.convex import ConvexSet
from mortarbench.harness.sets.discs import Discs
from mortarbench.harness.solution import Solution

#: Extended precision if the machine has it (x86: 64-bit mantissa), so that residuals of
#: the size of double rounding have some correct digits.
Real = np.longdouble
Extended = NDArray[np.longdouble]
#: Change of the gaps by a rigid motion, or load along it, that counts as rounding (of
#: coordinates, normals and tractions), relative to the sum of its absolute terms.
MOTION_ROUNDING = 1e-10


class Inverse(Protocol):
    """A symmetric K⁺, zero on prescribed components and the inverse of K on the others.

    If the supports allow rigid motions R,  K K⁺ b = b  holds for Rᵀb = 0.
    """

    @property
    def kernel(self) -> NDArray[np.float64]:
        """Orthonormal basis R (n, r) of the remaining rigid motions; often r = 0."""

    def __call__(self, b: Vector) -> Vector:
        """Apply K⁺ to a vector (n,)."""

    def congruence(self, B: Matrix) -> NDArray[np.float64]:
        """Return BK⁺Bᵀ (m, m) for sparse rows B (m, n)."""


class Substructures(Protocol):
    """The stiffness as a sum over floating subdomains:  K = Tᵀ diag(K_1 … K_S) T.

    The unknowns v (N,) of subdomains contain a copy of each component for every
    subdomain around it, in the axes of that subdomain. K_s stands for P_s K_s P_s with
    P_s = I − R_sR_sᵀ, so that its kernel is exactly the rigid motions R_s: the rounding
    in K_s R_s is not part of the problem.
    """

    @property
    def spread(self) -> csr_array:
        """T (N, n), which copies a displacement u into the subdomains."""

    @property
    def kernel(self) -> csr_array:
        """Orthonormal rigid motions R (N, r), each of a single subdomain."""

    @property
    def weight(self) -> Vector:
        """Relative stiffness (N,) of the copies, equal for all components of a node."""

    def diagonal(self, at: NDArray[np.int64]) -> Vector:
        """Return the diagonal of K at global components `at` (k,)."""

    def product(self, v: NDArray[Any]) -> NDArray[Any]:
        """Apply PKP to v (N,), in the precision of v."""

    def squared_product(self, v: Vector) -> Vector:
        """Apply K∘K, the squares of the entries of K, to v (N,)."""

    def solve(self, b: Vector) -> Vector:
        """Apply PK⁺P to forces (N,)."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Friction:
    """Friction with a given bound (Tresca); zero rows without friction.

    ::

        Σ gᵢ‖Tᵢu − sᵢ‖  is added to the energy;  its multipliers satisfy  ‖λᵢ‖ ≤ gᵢ

    T u is the tangential motion of the slave relative to the master, and s its initial
    value: zero for a single static load, and T u of the previous step for slip
    increments. A contact row i with friction has d consecutive rows Tᵢ of equal bound,
    one for each tangential direction. In the plane d = 1, and ‖·‖ is |·|; in space d =
    2.

    The law of friction requires g = cohesion + mu·λ_n, where λ_n is the multiplier of
    the contact row. mu = 0 for Tresca's law, and cohesion = 0 for Coulomb's law.
    """

    T: csr_array  #: (k, n) tangential rows, d consecutive ones per contact row
    bound: Vector  #: (k,) g ≥ 0, a force
    start: Vector  #: (k,) s, a length
    row: NDArray[np.int64]  #: (k,) contact row of each friction row
    cohesion: Vector  #: (k,) a force
    mu: Vector  #: (k,) coefficient of friction
    unsettled: float = 0.0  #: `residual` at the solution with this bound; 0 if unknown

    @property
    def tangents(self) -> int:
        """Number d of tangential directions, or friction rows per contact row."""
        return int(np.bincount(self.row).max(initial=1))

    @property
    def vectors(self) -> NDArray[np.int64]:
        """The friction rows (k/d, d) of each tangential vector."""
        return np.arange(self.row.size).reshape(-1, self.tangents)

    def discs(self, first: int) -> Discs:
        """Return the sets of the multipliers λ_t, which begin at variable `first`."""
        return friction_discs(self.bound, self.tangents, first)

    def slip(self, u: NDArray[Any]) -> NDArray[Any]:
        """Return Tᵢu − sᵢ (k/d, d) for u (n,)."""
        return np.asarray((self.T @ u - self.start)[self.vectors])

    def work(self, u: NDArray[Any]) -> float:
        """Return Σ gᵢ‖Tᵢu − sᵢ‖ for u (n,)."""
        radius = self.bound[self.vectors[:, 0]]
        return float(radius @ norms(self.slip(u)))

    def demanded(self, normal: Vector) -> Vector:
        """Return cohesion + mu·max(λ_n, 0) (k,) for normal forces (m,)."""
        return np.asarray(self.cohesion + self.mu * np.maximum(normal[self.row], 0.0))

    def residual(self, normal: Vector) -> float:
        """Return ‖g − demanded‖/‖g‖ for normal forces (m,); absolute if g = 0."""
        off = float(np.linalg.norm(self.bound - self.demanded(normal)))
        return off / (float(np.linalg.norm(self.bound)) or 1.0)

    def __getitem__(self, selected: NDArray[Any]) -> Friction:
        """Return the selected rows (an index array or a mask)."""
        rows = {k: v[selected] for k, v in vars(self).items() if k != "unsettled"}
        return replace(self, **rows)


def friction_discs(bound: Vector, tangents: int, first: int) -> Discs:
    """Return the sets ‖λᵢ‖ ≤ gᵢ of multipliers of friction rows.

    Parameters
    ----------
    bound : (k,) g of each row, equal for the d rows of a vector
    tangents : d
    first : number of the first of these multipliers

    """
    index = first + np.arange(bound.size).reshape(-1, tangents)
    return Discs(index, bound[::tangents])


_EMPTY = np.zeros(0)
NO_FRICTION = Friction(
    T=no_rows(0),
    bound=_EMPTY,
    start=_EMPTY,
    row=np.zeros(0, dtype=np.int64),
    cohesion=_EMPTY,
    mu=_EMPTY,
)


def contact_rows(primal: QP, friction: Friction) -> tuple[csr_array, Vector]:
    """Return the rows of contact, then of friction:  B (m + k, n)  and  c (m + k,)."""
    B = csr_array(primal.G)
    if not friction.bound.size:
        return B, primal.h
    return csr_array(vstack([B, friction.T])), np.append(primal.h, friction.start)


def with_friction(primal: QP, friction: Friction) -> QP:
    """Return the problem with friction as a QP, with further variables.

    For the friction rows with g > 0, in the plane one t per |·|,

    ::

        min ½uᵀKu − fᵀu + gᵀt   subject to   B_D u = 0,  B u ≤ c,
                                              Tu − t ≤ s,  −Tu − t ≤ −s

    and in space the slip w = Tu − s and one t per ‖·‖, over second-order cones,

    ::

        min ½uᵀKu − fᵀu + gᵀt   subject to   B_D u = 0,  B u ≤ c,
                                              Tu − w = s,  ‖wᵢ‖ ≤ tᵢ

    The unknown is (u, t) or (u, t, w). Without friction rows, `primal` itself is
    returned. See `friction_multipliers` for those of the friction rows.
    """
    moving = friction[friction.bound > 0]
    k, n = moving.T.shape
    if not k:
        return primal
    vectors = moving.vectors
    if vectors.shape[1] > 1:
        v = len(vectors)
        t = n + np.arange(v)
        return QP(
            P=csc_array(
                block_array([[primal.P, None], [None, csc_array((v + k, v + k))]])
            ),
            q=np.concatenate([primal.q, moving.bound[vectors[:, 0]], np.zeros(k)]),
            A=csr_array(block_array([
                [primal.A, csr_array((primal.b.size, v)), None],
                [moving.T, None, -eye_array(k)],
            ])),
            b=np.append(primal.b, moving.start),
            G=csr_array(hstack([primal.G, csr_array((primal.h.size, v + k))])),
            h=primal.h,
            sets=(Cones(np.column_stack([t, n + v + vectors]), np.ones(v)),),
        )  # fmt: skip
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


def friction_multipliers(
    s: Solution, primal: QP, friction: Friction
) -> tuple[Vector, Vector, Vector]:
    """Split a solution of `with_friction`: y of supports, z of contact, λ_t.

    λ_t (k,) is in the plane the difference of the multipliers of the two rows of each
    |·|, and in space the multiplier of Tu − w = s; zero where g = 0.
    """
    e, m, acts = primal.b.size, primal.h.size, friction.bound > 0
    tangential = np.zeros(acts.size)
    if friction.vectors.shape[1] > 1:
        tangential[acts] = s.y[e:]
    else:
        forwards, backwards = s.z[m:].reshape(2, -1)
        tangential[acts] = forwards - backwards
    return s.y[:e], s.z[:m], tangential


@dataclass(frozen=True, eq=False)
class AdmissibleForces:
    """Set Λ of admissible multipliers (m,): λ ≥ 0 of contact, ‖λᵢ‖ ≤ gᵢ of friction."""

    rows: int  #: m
    discs: Discs  #: discs of the friction rows, which are the last rows

    @cached_property
    def contact(self) -> NDArray[np.bool_]:
        """Mask (m,) of the contact rows."""
        return np.arange(self.rows) < self.rows - self.discs.index.size

    @property
    def sets(self) -> tuple[ConvexSet, ...]:
        """The same set for variables of a QP."""
        upper = np.full(self.rows, np.inf)
        return Box(np.where(self.contact, 0.0, -upper), upper), self.discs

    def project(self, multipliers: Extended) -> Extended:
        """Return the nearest admissible multipliers (m,)."""
        nearest = self.discs.project(multipliers)
        return np.where(self.contact, np.maximum(nearest, 0), nearest)

    def room(self, multipliers: Extended) -> Extended:
        """Return g − ‖λ‖ of each friction vector; rounding is set to zero.

        Projected multipliers are on their circle up to rounding in extended precision,
        about 1e-19. In the work, √1e-19 would dominate certificates.
        """
        radius = self.discs.radius
        room = radius - norms(multipliers[self.discs.index])
        rounding = 8 * np.finfo(Real).eps * radius
        return np.where(np.abs(room) > rounding, room, 0)

    def interior(self, multipliers: Extended) -> Extended:
        """Return the distance (m,) from the boundary: λ of contact, g − ‖λ‖."""
        distance = multipliers.copy()
        distance[self.discs.index] = self.room(multipliers)[:, None]
        return distance

    def chords(self, multipliers: Extended) -> tuple[Extended, Extended]:
        """Return the bounds (m,) of each λᵢ, with the other components fixed."""
        lower, upper = np.zeros_like(multipliers), np.full_like(multipliers, np.inf)
        squares = multipliers[self.discs.index] ** 2
        others = squares.sum(axis=1, keepdims=True) - squares
        room = self.discs.radius[:, None] ** 2 - others
        upper[self.discs.index] = np.sqrt(np.maximum(room, 0))
        lower[self.discs.index] = -upper[self.discs.index]
        return lower, upper


class Exact(NamedTuple):
    """The data of the contact problem except K, in extended precision.

    The rows are those of contact, then those of friction. At a solution, v = Bu − c is
    normal to Λ at λ: λ ∈ Λ and λᵀv = σ(v). The support function σ of Λ is Σ gᵢ‖vᵢ‖,
    summed over friction vectors, if v ≤ 0 on all contact rows, and infinite otherwise.
    """

    f: Extended  #: (n,)
    B: Any  #: (m, n) sparse, contact and friction
    c: Extended  #: (m,)
    forces: AdmissibleForces  #: Λ
    fixed: NDArray[np.int64]  #: prescribed components
    compliance: Extended  #: (m,) estimate for each row, B_i diag(K)⁻¹B_iᵀ

    @property
    def contact(self) -> NDArray[np.bool_]:
        """Mask (m,) of the contact rows."""
        return self.forces.contact

    def motion(self, u: Extended) -> Extended:
        """Return v = Bu − c (m,), the penetration or the slip of each row."""
        return np.asarray(self.B @ u - self.c)

    def friction_work(self, u: Extended) -> Extended:
        """Return gᵢ‖vᵢ‖ of each friction vector."""
        discs = self.forces.discs
        return np.asarray(discs.radius * norms(self.motion(u)[discs.index]))

    def missing_work(
        self, multipliers: Extended, motion: Extended
    ) -> tuple[Extended, Extended]:
        """Return σ(v) − λᵀv ≥ 0 of each contact row and each friction vector.

        For a friction vector, g‖v‖ − λᵀv is evaluated without cancellation as

            (g − ‖λ‖)‖v‖ + ‖ ‖λ‖v − ‖v‖λ ‖² / (2‖λ‖‖v‖).
        """
        discs, contact = self.forces.discs, self.contact
        lam, v = multipliers[discs.index], motion[discs.index]
        force, slip = norms(lam), norms(v)
        across = norms(force[:, None] * v - slip[:, None] * lam) ** 2
        product = 2 * force * slip
        angle = np.divide(
            across, product, out=np.zeros_like(product), where=product > 0
        )
        work = self.forces.room(multipliers) * slip + angle
        return -multipliers[contact] * motion[contact], work


class RigidMotions(NamedTuple):
    """Rigid motions that the supports allow, split into constrained and free ones.

    Constrained motions change contact gaps. Columns are orthonormal in extended
    precision. K·constrained is zero up to rounding, which matters if bodies move far;
    see `harness.verify.certificate`.
    """

    constrained: Any  #: (n, p) sparse; motions that open or close contact rows
    free: Any  #: (n, q) sparse; gaps change by rounding only
    G: Extended  #: (m, p)  B·constrained
    largest: (
        Any  #: (n, p) each column's largest |entry|, in the pattern of `constrained`
    )
    KR: Extended  #: (n, p)  K·constrained, zero on prescribed components


#: Meshio's names of first-order cells, by dimension and number of corners.
KINDS = {
    (0, 1): "vertex",
    (1, 2): "line",
    (2, 3): "triangle",
    (2, 4): "quad",
    (3, 4): "tetra",
    (3, 6): "wedge",
    (3, 8): "hexahedron",
}


#: Corners of the facets of each kind. In the plane the cell is on the left of an edge;
#: in space the corners are anticlockwise from outside, and triangles repeat the last
#: one.
FACETS = {
    "quad": ((0, 1), (1, 2), (2, 3), (3, 0)),
    "tetra": ((0, 2, 1, 1), (0, 1, 3, 3), (1, 2, 3, 3), (2, 0, 3, 3)),
    "wedge": (
        (0, 2, 1, 1), (3, 4, 5, 5), (0, 1, 4, 3), (1, 2, 5, 4), (2, 0, 3, 5),
    ),
    "hexahedron": (
        (0, 3, 2, 1), (4, 5, 6, 7), (0, 1, 5, 4), (1, 2, 6, 5), (2, 3, 7, 6),
        (3, 0, 4, 7),
    ),
}  # fmt: skip


class CellBlock(NamedTuple):
    """Cells of one kind."""

    kind: str  #: name of the kind in meshio
    nodes: NDArray[np.int64]  #: (k, corners)
    cells: NDArray[np.int64]  #: (k,) their rows in the table


def cell_blocks(table: NDArray[np.int64], dim: int) -> tuple[CellBlock, ...]:
    """Split a table of cells (E, c) by kind, those with the fewest corners first.

    In a mixed table, cells with fewer than c corners repeat some of them: a triangle
    among quadrilaterals is (a, b, c, c), a wedge among hexahedra (a, b, c, c, d, e, f,
    f) and a tetrahedron (a, b, c, c, d, d, d, d).

    dim : dimension of the cells

    Examples
    --------
    >>> import numpy as np
    >>> from mortarbench.harness.mechanics import cell_blocks
    >>> for block in cell_blocks(np.array([[0, 1, 2, 3], [1, 4, 2, 2]]), dim=2):
    ...     print(block.kind, block.nodes.tolist(), block.cells.tolist())
    triangle [[1, 4, 2]] [1]
    quad [[0, 1, 2, 3]] [0]

    """
    differs = np.ones(table.shape, dtype=bool)
    differs[:, 1:] = table[:, 1:] != table[:, :-1]
    corners, blocks = differs.sum(axis=1), []
    for count in np.unique(corners):
        cells = np.flatnonzero(corners == count)
        nodes = table[cells][differs[cells]].reshape(-1, count)
        blocks.append(CellBlock(KINDS[dim, int(count)], nodes, cells))
    return tuple(blocks)


def boundary_facets(cells: NDArray[np.int64], dim: int) -> NDArray[np.int64]:
    """Return the facets (k, m) that belong to one cell only, which is on their left.

    In the plane facets are edges, sorted by their lower node, then by the other one.
    """
    facets, names, _ = cell_facets(cells, dim)
    key, count = np.zeros(len(names), dtype=np.int64), cells.max(initial=0) + 1
    for lowest in names.T:
        key = key * count + lowest
    _, first, times = np.unique(key, return_index=True, return_counts=True)
    return np.asarray(facets[first[times == 1]])


def cell_facets(cells: NDArray[np.int64], dim: int) -> tuple[NDArray[np.int64], ...]:
    """Return the facets of all cells (k, m), their names (k, dim) and cells (k,).

    The dim lowest nodes of a facet are its name, which neighbouring cells share.
    Degenerate facets between repeated corners are left out; triangles in space repeat
    their last corner.
    """
    facet = np.array(FACETS[KINDS[dim, cells.shape[1]]])
    facets = cells[:, facet].reshape(-1, facet.shape[1])
    cell = np.repeat(np.arange(len(cells)), len(facet))
    names, last = np.sort(facets, axis=1), np.iinfo(facets.dtype).max
    names[:, 1:][names[:, 1:] == names[:, :-1]] = last  # distinct nodes come first
    names = np.sort(names, axis=1)[:, :dim]
    is_facet = names[:, -1] < last
    facets, names, cell = facets[is_facet], names[is_facet], cell[is_facet]
    if dim > 2:
        repeats = facets == np.roll(facets, -1, axis=1)
        at = np.where(repeats.any(axis=1), repeats.argmax(axis=1), 2)
        turned = (at[:, None] + np.arange(-2, 2)) % 4
        facets = np.take_along_axis(facets, turned, axis=1)
    return facets, names, cell


class Grid(NamedTuple):
    """The mesh of the unknowns, which are numbered node by node."""

    points: NDArray[np.float64]  #: (N, d)
    #: (E, 2) segments, or (E, 4) corners in order, of which a triangle repeats the
    #: last one; in space (E, 8) hexahedra
    cells: NDArray[np.int64]
    bodies: NDArray[np.int64]  #: (E,) body number of each cell
    lift: Vector  #: (n,) physical unknown − u, from nonzero boundary values


@dataclass(frozen=True, eq=False, kw_only=True)
class Mechanics:
    """Non-dimensional elastic contact problem, and the map of solutions to it.

    ::

        min ½uᵀKu − fᵀu    subject to   u = 0 on the prescribed components,  B u ≤ c

    `Friction` adds its terms to the energy.
    """

    #: P = K, q = −f, A has one unit entry per prescribed component, b = 0, G = B, h = c
    primal: QP
    #: maps a solution of the emitted QP to x = u, y of the supports, and z of the
    #: contact and friction rows
    to_primal: Callable[[Solution], Solution]
    factorise: Callable[[], Inverse]  #: returns K⁺; called at most once
    #: cell size of the contact side, in the unit of length of `primal`
    mesh_size: float
    #: (n, r) rigid motions of each body, regardless of supports, to measure the balance
    #: of forces
    rigid: NDArray[np.float64]
    names: tuple[
        str, ...
    ] = ()  #: names of the bodies, in the order of the columns of `rigid`
    scale: float = 1.0  #: energy = scale·objective of `primal` + constant, as `Case`
    constant: float = 0.0
    #: needed to compare meshes, see `harness.crossval.discretisation`
    grid: Grid | None = None
    friction: Friction = NO_FRICTION
    #: returns the `Certificate` of a displacement (n,) with multipliers (m,) of `rows`,
    #: computed by subdomains without a factor of the assembled K
    certify_by_subdomains: Callable[[Vector, Vector], Any] | None = None

    @cached_property
    def rows(self) -> csr_array:
        """All rows B (m, n): of contact, then of friction."""
        return contact_rows(self.primal, self._active_friction)[0]

    @cached_property
    def program(self) -> QP:
        """The problem as a QP, see `with_friction`; `primal` without friction."""
        return with_friction(self.primal, self.friction)

    def multipliers(self, s: Solution) -> Vector:
        """Return λ (m,) of `rows` from a solution returned by `to_primal`."""
        contact = self.primal.h.size
        return np.append(s.z[:contact], s.z[contact:][self.friction.bound > 0])

    @cached_property
    def _active_friction(self) -> Friction:
        """The friction rows with a positive bound."""
        return self.friction[self.friction.bound > 0]

    @cached_property
    def inverse(self) -> Inverse:
        """K⁺, factorised at the first access."""
        return self.factorise()

    @cached_property
    def exact(self) -> Exact:
        """The data in extended precision."""
        diagonal, B = self.primal.P.diagonal(), self.rows
        c = contact_rows(self.primal, self._active_friction)[1]
        fixed = np.unique(csr_array(self.primal.A).indices).astype(np.int64)
        softness = 1 / np.where(diagonal > 0, diagonal, np.inf)
        softness[fixed] = 0
        return Exact(
            f=-self.primal.q.astype(Real),
            B=B.astype(Real),
            c=c.astype(Real),
            fixed=fixed,
            forces=AdmissibleForces(
                c.size, self._active_friction.discs(self.primal.h.size)
            ),
            compliance=(B.multiply(B) @ softness).astype(Real),
        )

    @cached_property
    def stiffness(self) -> Any:
        """K (n, n), sparse, in extended precision."""
        return csr_array(self.primal.P).astype(Real)

    @cached_property
    def whole(self) -> Mechanics:
        """The same problem without subdomains, for K⁺ or a u_λ without jumps."""
        return (
            self
            if self.certify_by_subdomains is None
            else replace(self, certify_by_subdomains=None)
        )

    def energy(self, u: Extended) -> float:
        """Return the potential energy of `u` (n,) with the work of friction, SI.

        The energy is summed in extended precision.
        """
        objective = 0.5 * (u @ (self.stiffness @ u)) - self.exact.f @ u
        objective = objective + self.exact.friction_work(u).sum()
        return float(self.scale * objective + self.constant)

    @cached_property
    def kernel(self) -> Any:
        """Rigid motions (n, r) that the supports allow, in extended precision."""
        return _orthonormal(self.inverse.kernel)

    @cached_property
    def motions(self) -> RigidMotions:
        """The same motions, split into constrained and free ones."""
        exact, B, R = self.exact, self.rows, self.inverse.kernel
        turn, p = constrained_first(B, R)
        turned = self.kernel if p == R.shape[1] else _orthonormal(R @ turn)
        constrained = turned[:, :p]
        KR = np.zeros(constrained.shape, dtype=Real)
        if p:
            KR = cancelling(csr_array(self.primal.P), np.asarray(constrained.toarray()))
            KR[exact.fixed] = 0
        return RigidMotions(
            constrained=constrained,
            free=turned[:, p:],
            G=np.asarray((exact.B @ constrained).toarray()),
            largest=_largest(constrained),
            KR=KR,
        )

    def without_rigid_motion(self, v: Extended) -> Extended:
        """Return v − R Rᵀv (n,), without rigid motion."""
        if not self.kernel.shape[1]:  # products with empty sparse matrices are slow
            return v
        return np.asarray(v - self.kernel @ (self.kernel.T @ v))

    def apply_inverse(self, force: Extended) -> Extended:
        """Apply  P K⁺P,  P = I − RRᵀ,  to a force (n,)."""
        u = self.inverse(self.without_rigid_motion(force).astype(np.float64))
        return self.without_rigid_motion(u.astype(Real))

    def norm(self, v: Extended) -> float:
        """Return the energy norm ‖v‖_K, a seminorm if bodies can move rigidly.

        The rigid motion is subtracted first: KR = 0 holds up to rounding only, which
        would dominate the result for a motion much larger than the deformation.
        """
        v = self.without_rigid_motion(v)
        return float(np.sqrt(max(v @ (self.stiffness @ v), Real(0))))


def _orthonormal(R: NDArray[np.float64]) -> Any:
    """Orthonormalise columns (n, r) that are orthonormal to double precision; sparse.

    One step of R + R(I − RᵀR)/2 squares their error.
    """
    Q = csr_array(R.astype(Real))
    return csr_array(Q + Q @ (0.5 * (eye_array(R.shape[1]) - Q.T @ Q)))


def _largest(R: Any) -> Any:
    """Replace the entries of each column by the largest absolute value in it."""
    columns = csc_array(abs(R))
    empty = np.zeros(R.shape[1])
    sizes = columns.max(axis=0).toarray().ravel() if columns.nnz else empty
    columns.data = np.repeat(sizes, np.diff(columns.indptr))
    return columns


def cancelling(K: csr_array, R: Extended) -> Extended:
    """Return KR (n, r) to about twice the digits of doubles, in spite of cancellation.

    K and R are split into remainders and leading parts, which have 26 and 24 bits
    relative to the largest entry of a row of K and of R. In extended precision (64
    bits) the products of the leading parts are exact, and so are their sums over a row
    of K.
    """
    leading = csr_array(K.copy())
    sizes = np.repeat(abs(K).max(axis=1).toarray().ravel(), np.diff(K.indptr))
    leading.data = _leading(K.data, sizes, 26)
    top = _leading(R, np.abs(R).max(initial=Real(0)), 24)
    rest = (K - leading).astype(Real)
    leading = leading.astype(Real)
    return np.asarray(leading @ top + (leading @ (R - top) + rest @ R))


def _leading(v: Any, size: Any, bits: int) -> Any:
    """Round to multiples of 2^−bits·`size`, with size rounded up to a power of two."""
    unit = np.exp2(np.ceil(np.log2(np.where(size > 0, size, 1))) - bits)
    return np.round(v / unit) * unit


def constrained_first(
    B: Matrix, R: NDArray[np.float64]
) -> tuple[NDArray[np.float64], int]:
    """Return a rotation V (r, r) and p, the number of nonzero columns of BRV."""
    r = R.shape[1]
    length = np.sqrt(np.asarray(B.multiply(B).sum(axis=1)).ravel())
    per = 1 / np.where(length > 0, length, np.inf)
    G, terms = per[:, None] * (B @ R), per[:, None] * (abs(B) @ np.abs(R))
    _, sizes, Vt = np.linalg.svd(G, full_matrices=len(per) < r)
    constrained = int((sizes > MOTION_ROUNDING * terms.max(initial=0.0)).sum())
    return Vt.T, constrained
