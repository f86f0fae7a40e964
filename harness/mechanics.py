"""Elastic contact problems from which QPs are derived, for error certificates.

If a family attaches its `Mechanics` to a case (`harness.plugin.Case`), error bounds in
the energy norm can be computed for the answers, whatever the form of the QP; see
`harness.verify.certificate`.
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
from mortarbench.harness.sets.cones import Cones
from mortarbench.harness.sets.discs import Discs
from mortarbench.harness.solution import Solution

#: Extended precision if the machine has it (x86: 64-bit mantissa), so that a residual
#: as small as the rounding errors of double precision still has correct digits.
Real = np.longdouble
Extended = NDArray[np.longdouble]
#: Largest change of the gaps by a rigid motion, and largest work of the loads along a
#: rigid motion, that count as rounding (of coordinates, normals and tractions). The
#: work is relative to the sum of the absolute values of its terms, and the change of
#: the gaps to the largest such sum (`constrained_first`).
MOTION_ROUNDING = 1e-10


class Inverse(Protocol):
    """A symmetric generalised inverse K⁺ of the stiffness K (n, n).

    Rows and columns of K⁺ at prescribed components are zero. On the other components f,
    K⁺ is the inverse of K_ff if the supports prevent all rigid motions. Otherwise,
    K K⁺ b = b on f for all b with Rᵀb = 0, where the columns of R are the rigid motions
    that the supports allow.
    """

    @property
    def kernel(self) -> NDArray[np.float64]:
        """Orthonormal basis R (n, r) of the rigid motions that the supports allow."""

    def __call__(self, b: Vector) -> Vector:
        """Apply K⁺ to a vector (n,)."""

    def congruence(self, B: Matrix) -> NDArray[np.float64]:
        """Return BK⁺Bᵀ (m, m) for sparse rows B (m, n)."""


class Substructures(Protocol):
    """The stiffness as a sum over floating subdomains:  K = Tᵀ PDP T.

    D is the block diagonal matrix (N, N) of the stiffness matrices of the subdomains.
    The vector v (N,) contains the displacements of all subdomains. A component on an
    interface occurs in v once for each adjacent subdomain, in the axes of that
    subdomain. The columns of R are the rigid motions of the subdomains. In exact
    arithmetic, DR = 0. The projection P = I − RRᵀ removes the rounding errors in DR, so
    that the kernel of PDP is exactly the span of R.
    """

    @property
    def spread(self) -> csr_array:
        """T (N, n), which copies a displacement u into the subdomains."""

    @property
    def kernel(self) -> csr_array:
        """Orthonormal rigid motions R (N, r); each column moves a single subdomain."""

    @property
    def weight(self) -> Vector:
        """Relative stiffness (N,) of each copy, equal for all components of a node."""

    def diagonal(self, at: NDArray[np.int64]) -> Vector:
        """Return the diagonal entries (k,) of K at the global components `at` (k,)."""

    def product(self, v: NDArray[Any]) -> NDArray[Any]:
        """Return PDPv for a vector v (N,), in the precision of v."""

    def squared_product(self, v: Vector) -> Vector:
        """Return (D∘D)v (N,), where D∘D contains the squares of the entries of D."""

    def solve(self, b: Vector) -> Vector:
        """Return PD⁺Pb for forces b (N,), where D⁺ is a generalised inverse of D."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Friction:
    """Friction with a given bound g on the tangential force, as in Tresca's law.

    ::

        friction work:  Σ gᵢ‖Tᵢu − sᵢ‖,   multipliers:  ‖λᵢ‖ ≤ gᵢ

    T u is the tangential displacement of the slave side relative to the master side.
    The slip is measured from s. For a single static load, s = 0; for slip increments, s
    is T u of the previous load step. A contact row i with friction has d consecutive
    rows Tᵢ of equal bound, one for each tangential direction, where d = 1 in 2D
    and d = 2 in 3D. A problem without friction has zero rows.

    The law of friction requires g = cohesion + mu·λ_n, where λ_n is the multiplier of
    the contact row. Tresca's law has mu = 0, and Coulomb's law has cohesion = 0.
    """

    T: csr_array  #: (k, n) tangential rows, d consecutive rows per contact row
    bound: Vector  #: (k,) bound g ≥ 0 on the tangential force
    start: Vector  #: (k,) s, the value of T u from which slip is measured, a length
    row: NDArray[np.int64]  #: (k,) contact row of each friction row
    cohesion: Vector  #: (k,) part of the bound that does not depend on λ_n, a force
    mu: Vector  #: (k,) coefficient of friction

    @property
    def tangents(self) -> int:
        """Number d of tangential directions, i.e. of friction rows per contact row."""
        return int(np.bincount(self.row).max(initial=1))

    @property
    def vectors(self) -> NDArray[np.int64]:
        """Numbers (k/d, d) of the friction rows that form each tangential vector."""
        return np.arange(self.row.size).reshape(-1, self.tangents)

    def discs(self, first: int) -> Discs:
        """Return the discs of the multipliers λ_t, which begin at variable `first`."""
        return friction_discs(self.bound, self.tangents, first)

    def slip(self, u: NDArray[Any]) -> NDArray[Any]:
        """Return the slip Tᵢu − sᵢ (k/d, d) for a displacement u (n,)."""
        return np.asarray((self.T @ u - self.start)[self.vectors])

    def work(self, u: NDArray[Any]) -> float:
        """Return the friction work Σ gᵢ‖Tᵢu − sᵢ‖ for a displacement u (n,)."""
        radius = self.bound[self.vectors[:, 0]]
        return float(radius @ norms(self.slip(u)))

    def demanded(self, normal: Vector) -> Vector:
        """Return the bound cohesion + mu·max(λ_n, 0) (k,) that the law requires.

        normal : (m,) multipliers λ_n of the contact rows
        """
        return np.asarray(self.cohesion + self.mu * np.maximum(normal[self.row], 0.0))

    def residual(self, normal: Vector) -> float:
        """Return the relative distance of the bound g from the required bound.

        The distance is ‖g − demanded‖₂/‖g‖₂, or ‖demanded‖₂ if g = 0.

        normal : (m,) multipliers λ_n of the contact rows
        """
        off = float(np.linalg.norm(self.bound - self.demanded(normal)))
        return off / (float(np.linalg.norm(self.bound)) or 1.0)

    def __getitem__(self, selected: NDArray[Any]) -> Friction:
        """Return the friction of the selected rows, given by indices or a mask."""
        return replace(self, **{k: v[selected] for k, v in vars(self).items()})


def friction_discs(bound: Vector, tangents: int, first: int) -> Discs:
    """Return the discs ‖λᵢ‖ ≤ gᵢ of the multipliers of friction rows.

    Parameters
    ----------
    bound : (k,) bound g of each row, equal for the d rows of a tangential vector
    tangents : number d of tangential directions
    first : number of the variable that is the first of these multipliers

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
    """Return matrix B (m + k, n) and right-hand side c (m + k,) of all rows.

    The m contact rows precede the k friction rows.
    """
    B = csr_array(primal.G)
    if not friction.bound.size:
        return B, primal.h
    return csr_array(vstack([B, friction.T])), np.append(primal.h, friction.start)


def with_friction(primal: QP, friction: Friction) -> QP:
    """Return the problem with friction as a QP with auxiliary variables.

    Friction rows with g = 0 are omitted. In 2D, a variable t ≥ |Tu − s| is added
    for each row:

    ::

        min ½uᵀKu − fᵀu + gᵀt   subject to   B_D u = 0,  B u ≤ c,
                                              Tu − t ≤ s,  −Tu − t ≤ −s

    In 3D, the two components of the slip w = Tu − s and a variable t ≥ ‖w‖ are added
    for each tangential vector, where (t, w) lies in a second-order cone:

    ::

        min ½uᵀKu − fᵀu + gᵀt   subject to   B_D u = 0,  B u ≤ c,
                                              Tu − w = s,  ‖wᵢ‖ ≤ tᵢ

    The unknown is (u, t) in 2D and (u, t, w) in 3D. If no row has g > 0,
    `primal` is returned unchanged. `friction_multipliers` returns the multipliers of
    the friction rows.
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
    """Return the multipliers of supports, contact and friction rows from a solution.

    s : solution of the QP returned by `with_friction`

    The multipliers λ_t (k,) of friction rows are zero where g = 0. In 2D, the
    nonzero entries are differences of the multipliers of Tu − t ≤ s and −Tu − t ≤ −s.
    In 3D, they are the multipliers of Tu − w = s.
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
    """Set Λ of admissible multipliers: λᵢ ≥ 0 for contact, ‖λᵢ‖ ≤ gᵢ for friction."""

    rows: int  #: number m of rows of contact and friction
    discs: Discs  #: discs of the friction rows, which are the last rows

    @cached_property
    def contact(self) -> NDArray[np.bool_]:
        """Mask (m,) of the contact rows."""
        return np.arange(self.rows) < self.rows - self.discs.index.size

    def project(self, multipliers: Extended) -> Extended:
        """Return the nearest admissible multipliers (m,)."""
        nearest = self.discs.project(multipliers)
        return np.where(self.contact, np.maximum(nearest, 0), nearest)

    def room(self, multipliers: Extended) -> Extended:
        """Return g − ‖λ‖ of each friction vector, with rounding errors set to zero.

        The norm of a projected multiplier equals g only up to rounding in extended
        precision, about 1e-19. If this error counted as work, it could dominate a
        certificate, which contains the square root of the work.
        """
        radius = self.discs.radius
        room = radius - norms(multipliers[self.discs.index])
        rounding = 8 * np.finfo(Real).eps * radius
        return np.where(np.abs(room) > rounding, room, 0)

    def interior(self, multipliers: Extended) -> Extended:
        """Return the distance (m,) from the boundary of Λ.

        The distance is λᵢ for contact rows, and g − ‖λ‖ for friction rows.
        """
        distance = multipliers.copy()
        distance[self.discs.index] = self.room(multipliers)[:, None]
        return distance

    def chords(self, multipliers: Extended) -> tuple[Extended, Extended]:
        """Return lower and upper bounds (m,) on each λᵢ, with all others fixed."""
        lower, upper = np.zeros_like(multipliers), np.full_like(multipliers, np.inf)
        squares = multipliers[self.discs.index] ** 2
        others = squares.sum(axis=1, keepdims=True) - squares
        room = self.discs.radius[:, None] ** 2 - others
        upper[self.discs.index] = np.sqrt(np.maximum(room, 0))
        lower[self.discs.index] = -upper[self.discs.index]
        return lower, upper


class Exact(NamedTuple):
    """Data of the contact problem except K, in extended precision.

    Contact rows precede friction rows. Λ is the set of admissible multipliers. At a
    solution, v = Bu − c is normal to Λ at λ, that is, λ ∈ Λ and λᵀv = σ(v), where σ is
    the support function of Λ. If v ≤ 0 on all contact rows, σ(v) is the sum Σ gᵢ‖vᵢ‖
    over friction vectors; otherwise, σ(v) is infinite.
    """

    f: Extended  #: (n,) load vector
    B: Any  #: (m, n) sparse rows of contact and friction
    c: Extended  #: (m,) right-hand side: initial gaps, then the `start` of friction
    forces: AdmissibleForces  #: set Λ of admissible multipliers
    fixed: NDArray[np.int64]  #: numbers of the prescribed components
    softness: Vector  #: (n,) 1/Kᵢᵢ, zero at prescribed components

    @property
    def compliance(self) -> Extended:
        """Estimate (m,) B_i diag(K)⁻¹ B_iᵀ of the compliance of each row B_i."""
        return np.asarray(self.B.multiply(self.B) @ self.softness)

    @property
    def contact(self) -> NDArray[np.bool_]:
        """Mask (m,) of the contact rows."""
        return self.forces.contact

    def motion(self, u: Extended) -> Extended:
        """Return v = Bu − c (m,), the penetration or the slip in each row."""
        return np.asarray(self.B @ u - self.c)

    def missing_work(
        self, multipliers: Extended, motion: Extended
    ) -> tuple[Extended, Extended]:
        """Return the nonnegative terms of σ(v) − λᵀv, which vanishes at a solution.

        The first array contains the terms −λᵢvᵢ of contact rows. The second array
        contains the terms g‖v‖ − λᵀv of friction vectors, which are evaluated without
        cancellation as

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


def contact_data(
    f: Extended,
    rows: tuple[Any, NDArray[Any]],
    discs: Discs,
    fixed: NDArray[np.int64],
    diagonal: Vector,
) -> Exact:
    """Return the data of a contact problem.

    Parameters
    ----------
    f : (n,) load
    rows : B (m, n) and c (m,) of contact, followed by friction with positive bounds
    discs : discs of the multipliers of friction
    fixed : prescribed components
    diagonal : (n,) diagonal of K, at least at the components that occur in rows

    """
    B, c = (v.astype(Real) for v in rows)
    softness = 1 / np.where(diagonal > 0, diagonal, np.inf)
    softness[fixed] = 0
    return Exact(
        f=f,
        B=B,
        c=c,
        forces=AdmissibleForces(c.size, discs),
        fixed=fixed,
        softness=softness,
    )


class RigidMotions(NamedTuple):
    """Rigid motions R that the supports allow: constrained motions, then free motions.

    Constrained motions change contact gaps or slip; free motions change them only by
    rounding. Columns are orthonormal in extended precision. K·constrained is zero
    except for rounding errors, which are relevant if bodies move far; see
    `harness.verify.certificate`.
    """

    all: Any  #: R (n, r), sparse
    G: Extended  #: (m, p) product B·constrained
    #: (n, p) `constrained` with each nonzero replaced by the largest absolute value of
    #: its column
    largest: Any
    #: (n, p) product K·constrained, zero on prescribed components; zero if unknown
    KR: Any

    @property
    def constrained(self) -> Any:
        """Motions that change gaps or slip, (n, p)."""
        return self.all[:, : self.G.shape[1]]

    @property
    def free(self) -> Any:
        """Motions that do not change gaps or slip, (n, r − p)."""
        return self.all[:, self.G.shape[1] :]

    def along(self, v: Extended) -> Extended:
        """Return the coefficients Rᵀv (r,)."""
        # products with empty sparse matrices are slow
        return np.asarray(self.all.T @ v) if self.all.shape[1] else v[:0]

    def without(self, v: Extended) -> Extended:
        """Return v − RRᵀv (n,)."""
        return np.asarray(v - self.all @ self.along(v)) if self.all.shape[1] else v


def rigid_motions(exact: Exact, R: csr_array, K: Matrix | None) -> RigidMotions:
    """Split the span of R (n, r), orthonormal to double precision, by the rows of B.

    K : (n, n) stored stiffness matrix; None if it is not assembled
    """
    at = np.unique(exact.B.indices)
    B = exact.B[:, at].astype(np.float64)
    turn, p = constrained_first(B, R[at].toarray())
    R = _orthonormal(R if p == R.shape[1] else csr_array(R @ csr_array(turn)))
    constrained = R[:, :p]
    if K is None:
        KR: Any = csr_array(constrained.shape, dtype=Real)
    else:
        KR = np.zeros(constrained.shape, dtype=Real)
        KR = cancelling(csr_array(K), constrained.toarray()) if p else KR
        KR[exact.fixed] = 0
    return RigidMotions(
        all=R,
        G=np.asarray((exact.B @ constrained).toarray()),
        largest=_largest(constrained),
        KR=KR,
    )


#: Names of first-order cells in meshio, by dimension and number of corners.
KINDS = {
    (0, 1): "vertex",
    (1, 2): "line",
    (2, 3): "triangle",
    (2, 4): "quad",
    (3, 4): "tetra",
    (3, 6): "wedge",
    (3, 8): "hexahedron",
}


#: Corners of each facet, by type of cell (triangles are stored as quadrilaterals). In
#: 2D, the cell is on the left of the edge. In 3D, the corners are in anticlockwise
#: order when seen from outside, and a triangular facet repeats its last corner.
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
    """The cells of one type in a table of cells."""

    kind: str  #: name of the cell type in meshio
    nodes: NDArray[np.int64]  #: (k, corners) node numbers
    cells: NDArray[np.int64]  #: (k,) rows of these cells in the table


def cell_blocks(table: NDArray[np.int64], dim: int) -> tuple[CellBlock, ...]:
    """Split a table of cells (E, c) by type; types with fewer corners come first.

    In a mixed table, a cell with fewer than c corners repeats some of its corners: a
    triangle among quadrilaterals is (a, b, c, c), a wedge among hexahedra is (a, b, c,
    c, d, e, f, f), and a tetrahedron is (a, b, c, c, d, d, d, d).

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
    """Return the node numbers (k, m) of the facets that belong to a single cell.

    Facets are oriented as in `FACETS`. In 2D, facets are edges, which are sorted
    by the lower, then by the higher node number.
    """
    facets, names, _ = cell_facets(cells, dim)
    key, count = np.zeros(len(names), dtype=np.int64), cells.max(initial=0) + 1
    for lowest in names.T:
        key = key * count + lowest
    order = np.argsort(key)
    differs = np.diff(key[order], prepend=-1, append=-1) != 0
    return np.asarray(facets[order[differs[1:] & differs[:-1]]])


def cell_facets(cells: NDArray[np.int64], dim: int) -> tuple[NDArray[np.int64], ...]:
    """Return facets (k, m) of all cells, their keys (k, dim) and cell numbers (k,).

    The key of a facet consists of its `dim` lowest node numbers, so that two adjacent
    cells have the same key for their common facet. Degenerate facets between repeated
    corners are omitted. In 3D, a triangle repeats its last corner.
    """
    facet = np.array(FACETS[KINDS[dim, cells.shape[1]]])
    facets = cells[:, facet].reshape(-1, facet.shape[1])
    cell = np.repeat(np.arange(len(cells)), len(facet))
    names, last = np.sort(facets, axis=1), np.iinfo(facets.dtype).max
    repeated = names[:, 1:] == names[:, :-1]
    if repeated.any():
        names[:, 1:][repeated] = last  # the next sort places these numbers last
        names.sort(axis=1)
        is_facet = names[:, dim - 1] < last
        facets, names, cell = facets[is_facet], names[is_facet], cell[is_facet]
    names = names[:, :dim]
    if dim > 2:
        repeats = facets == np.roll(facets, -1, axis=1)
        at = np.where(repeats.any(axis=1), repeats.argmax(axis=1), 2)
        turned = (at[:, None] + np.arange(-2, 2)) % 4
        facets = np.take_along_axis(facets, turned, axis=1)
    return facets, names, cell


class Grid(NamedTuple):
    """The mesh on which u is defined; components of the same node are consecutive."""

    points: NDArray[np.float64]  #: (N, d) positions of the nodes
    #: node numbers: (E, 2) for segments; (E, 4) for quadrilaterals, with corners in
    #: cyclic order, where a triangle repeats its last node; (E, 8) for hexahedra
    cells: NDArray[np.int64]
    bodies: NDArray[np.int64]  #: (E,) body number of each cell


@dataclass(frozen=True, eq=False, kw_only=True)
class Mechanics:
    """Non-dimensional elastic contact problem, and the map to its displacement u.

    ::

        min ½uᵀKu − fᵀu    subject to   u = w on the prescribed components,  B u ≤ c

    With `friction`, the friction work is added to the objective. The unknown of all
    other members is u − w, with w = 0 on the components that are not prescribed. It is
    zero on the prescribed components, its load is f − Kw, and its gaps are c − Bw.
    """

    #: P = K, q = −f, G = B, h = c, b = w; each row of A has a single entry 1, at a
    #: prescribed component
    primal: QP
    #: maps a solution of the emitted QP to x = u − w, the multipliers y of the
    #: supports, and the multipliers z of the contact and friction rows
    to_primal: Callable[[Solution], Solution]
    factorise: Callable[
        [], Inverse
    ]  #: factorises K and returns K⁺; called on first access to `inverse`
    #: (n, r) rigid motions of each body, regardless of supports, for messages on loads
    #: that are not in equilibrium
    rigid: NDArray[np.float64]
    #: names of the bodies, in the order of their columns in `rigid`
    names: tuple[str, ...] = ()
    #: mesh of u, from which the size of each body follows; None if u is not a
    #: displacement of bodies
    grid: Grid | None = None
    friction: Friction = NO_FRICTION
    #: returns the decomposed bodies, for certificates without factorising K
    subdomains: Callable[[], DecomposedMechanics] | None = None

    @cached_property
    def rows(self) -> csr_array:
        """Rows B (m, n) of contact, followed by rows of friction with g > 0."""
        return contact_rows(self.primal, self._active_friction)[0]

    @cached_property
    def program(self) -> QP:
        """The problem as a QP, see `with_friction`; `primal` if frictionless."""
        return with_friction(self.primal, self.friction)

    def multipliers(self, s: Solution) -> Vector:
        """Return the multipliers λ (m,) of `rows` from a result of `to_primal`."""
        contact = self.primal.h.size
        return np.append(s.z[:contact], s.z[contact:][self.friction.bound > 0])

    @cached_property
    def _active_friction(self) -> Friction:
        """The friction rows with a positive bound."""
        return self.friction[self.friction.bound > 0]

    @cached_property
    def inverse(self) -> Inverse:
        """Generalised inverse K⁺; K is factorised on first access."""
        return self.factorise()

    @cached_property
    def exact(self) -> Exact:
        """The data of the problem except K, in extended precision."""
        B, c = contact_rows(self.primal, self._active_friction)
        f, c = -self.primal.q.astype(Real), c.astype(Real)
        if self.lift.any():
            f = f - self.stiffness @ self.lift
            c = c - B.astype(Real) @ self.lift
        return contact_data(
            f,
            (B, c),
            self._active_friction.discs(self.primal.h.size),
            np.unique(csr_array(self.primal.A).indices).astype(np.int64),
            self.primal.P.diagonal(),
        )

    @cached_property
    def lift(self) -> Extended:
        """Prescribed displacements w (n,), zero on all other components."""
        return np.asarray(self.primal.A.T @ self.primal.b).astype(Real)

    @cached_property
    def stiffness(self) -> Any:
        """Sparse stiffness K (n, n) in extended precision."""
        return csr_array(self.primal.P).astype(Real)

    @cached_property
    def whole(self) -> Mechanics:
        """The same problem, with certificates from the assembled K."""
        return self if self.subdomains is None else replace(self, subdomains=None)

    @cached_property
    def motions(self) -> RigidMotions:
        """Rigid motions that the supports allow, as constrained and free motions."""
        return rigid_motions(self.exact, csr_array(self.inverse.kernel), self.primal.P)

    @property
    def stored(self) -> csr_array:
        """The stiffness K (n, n)."""
        return csr_array(self.primal.P)

    def apply_inverse(self, force: Extended) -> Extended:
        """Apply PK⁺P to a force (n,), where P = I − RRᵀ and R is `motions.all`."""
        u = self.inverse(self.motions.without(force).astype(np.float64))
        return self.motions.without(u.astype(Real))

    def norm(self, v: Extended) -> float:
        """Return the energy norm ‖v‖_K, which is a seminorm if bodies can move rigidly.

        The rigid part of v is subtracted first. KR = 0 holds only up to rounding
        errors, which would dominate if the rigid part were much larger than the
        deformation.
        """
        v = self.motions.without(v)
        return float(np.sqrt(max(v @ (self.stiffness @ v), Real(0))))


@dataclass(frozen=True, eq=False, kw_only=True)
class DecomposedMechanics:
    """Elastic contact problem of decomposed bodies, for certificates.

    The stiffness is K = Tᵀ PDP T (`Substructures`) up to rounding.
    """

    parts: Substructures
    exact: Exact  #: data of the problem except K
    kernel: csr_array  #: (n, r) orthonormal rigid motions that the supports allow
    #: (n, k) orthonormal rigid motions, regardless of supports, of the bodies that can
    #: move rigidly
    rigid: csr_array
    names: tuple[str, ...]  #: names of these bodies
    #: (n, n) assembled K, whose rounding affects the error if an answer moves bodies
    #: together with their supports; None if it is not assembled
    stored: csr_array | None = None

    @cached_property
    def motions(self) -> RigidMotions:
        """Rigid motions that the supports allow, as constrained and free motions."""
        return rigid_motions(self.exact, self.kernel, None)


def _orthonormal(R: csr_array) -> Any:
    """Orthonormalise the columns of R (n, r) in extended precision, as a sparse matrix.

    On entry, R is orthonormal to double precision. The step R + R(I − RᵀR)/2 squares
    the error of RᵀR = I.
    """
    Q = R.astype(Real)
    return csr_array(Q + Q @ (0.5 * (eye_array(R.shape[1]) - Q.T @ Q)))


def _largest(R: Any) -> Any:
    """Replace the nonzeros of each column by the column's largest absolute value."""
    columns = csc_array(abs(R))
    empty = np.zeros(R.shape[1])
    sizes = columns.max(axis=0).toarray().ravel() if columns.nnz else empty
    columns.data = np.repeat(sizes, np.diff(columns.indptr))
    return columns


def in_precision(M: Any, dtype: Any) -> Any:
    """Return a sparse matrix with entries of another type, and the same indices."""
    arrays = M.data.astype(dtype, copy=False), M.indices, M.indptr
    return type(M)(arrays, shape=M.shape)


def cancelling(K: csr_array, R: Extended) -> Extended:
    """Return KR (n, r) with about twice the digits of doubles, despite cancellation.

    K and R are split into leading parts and remainders. The leading part of K has 26
    bits relative to the largest entry of the row, and the leading part of R has 24 bits
    relative to the largest entry of R. In extended precision (64 bits), products of
    leading parts and the sum of these products over a row of K are exact.
    """
    leading = csr_array(K.copy())
    sizes = np.repeat(abs(K).max(axis=1).toarray().ravel(), np.diff(K.indptr))
    leading.data = _leading(K.data, sizes, 26)
    top = _leading(R, np.abs(R).max(initial=Real(0)), 24)
    rest = (K - leading).astype(Real)
    leading = leading.astype(Real)
    return np.asarray(leading @ top + (leading @ (R - top) + rest @ R))


def _leading(v: Any, size: Any, bits: int) -> Any:
    """Round v to multiples of 2^−bits·s; s is `size`, rounded up to a power of 2."""
    unit = np.exp2(np.ceil(np.log2(np.where(size > 0, size, 1))) - bits)
    return np.round(v / unit) * unit


def constrained_first(
    B: Matrix, R: NDArray[np.float64]
) -> tuple[NDArray[np.float64], int]:
    """Return an orthogonal V (r, r) and the number p of nonzero columns of BRV.

    The nonzero columns come first. Each row of B is first divided by its length. A
    column of BRV counts as zero if its length is at most `MOTION_ROUNDING` times the
    largest entry of |B||R|.

    B : (m, n) rows of contact and friction
    R : (n, r) rigid motions
    """
    r = R.shape[1]
    length = np.sqrt(np.asarray(B.multiply(B).sum(axis=1)).ravel())
    per = 1 / np.where(length > 0, length, np.inf)
    G, terms = per[:, None] * (B @ R), per[:, None] * (abs(B) @ np.abs(R))
    _, sizes, Vt = np.linalg.svd(G, full_matrices=len(per) < r)
    constrained = int((sizes > MOTION_ROUNDING * terms.max(initial=0.0)).sum())
    return Vt.T, constrained
