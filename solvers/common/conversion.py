"""Conversion of the matrices and multipliers of QPs to the forms of solver libraries.

Most libraries accept constraints in one of two forms with a matrix R. `two_sided`
returns the form low ≤ Rx ≤ high. `to_cone` returns the form Rx + s = r with the slack s
in a product of cones. Without discs and cones, the second form consists of equations
Rx = r followed by inequalities Rx ≤ r. The multipliers of the rows of R are converted
to multipliers of the QP.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array, csc_matrix, csr_array, eye_array, vstack

from mortarbench.harness import QP, Matrix, Solution, Vector, needs_matrices, too_large
from mortarbench.harness.sets.box import Box
from mortarbench.harness.sets.cones import Cones
from mortarbench.harness.sets.convex import ConvexSet, admissible
from mortarbench.harness.sets.discs import Discs

#: absolute tolerance for solvers that require residual ≤ absolute + relative·size; the
#: value is so small that only the relative tolerance matters
NEGLIGIBLE = 1e-14
#: types of sets that have a conic form
CONIC_SETS: tuple[type, ...] = (Box, Discs, Cones)
#: A claimed solution counts as diverged if ‖x‖∞ exceeds this value: the terms of its
#: residuals may then be so large that the relative residuals are small.
DIVERGED = 1e12
#: ‖q‖∞ after scaling, for solvers that divide residuals by max(1, size). With sizes of
#: about 1e4, the 1 has no effect, and the stopping criteria of these solvers are
#: relative, like the residuals of the harness.
OBJECTIVE_SIZE = 1e4


def needs_dense(qp: QP, copies: float) -> str | None:
    """Return a reason to decline `qp` if P is an operator or too large, or None.

    copies : largest number of dense matrices, each as large as P, that the solver
        stores at the same time
    """
    return needs_matrices(qp) or too_large(qp.q.size, copies)


def csc(M: Matrix) -> csc_matrix:
    """Return a writable csc_matrix copy with sorted indices and no duplicates.

    A csc_array is unsuitable: OSQP warns about this type, and qpsolvers treats a
    csc_array as dense.
    """
    copy = csc_matrix(M, dtype=np.float64, copy=True)
    copy.sum_duplicates()
    return copy


def dense(M: Matrix) -> Vector:
    """Return a dense copy of a dense or sparse matrix."""
    return np.array(M.toarray() if hasattr(M, "toarray") else M, dtype=np.float64)


def resolve_backend(backend: str, qp: QP) -> str:
    """Return `backend`, or the storage of P ("dense" or "sparse") instead of "auto"."""
    if backend != "auto":
        return backend
    return "dense" if isinstance(qp.P, np.ndarray) else "sparse"


def has_bound(qp: QP) -> NDArray[np.bool_]:
    """Return the mask (n,) of variables with at least one finite bound."""
    return np.isfinite(qp.lb) | np.isfinite(qp.ub)


def two_sided(qp: QP) -> tuple[csc_matrix, Vector, Vector]:
    """Return the rows R of A, G and bounds, with low and high in low ≤ Rx ≤ high."""
    box = has_bound(qp)
    rows = vstack([csc(qp.A), csc(qp.G), eye_array(qp.q.size, format="csr")[box]])
    low = np.concatenate([qp.b, np.full(qp.h.size, -np.inf), qp.lb[box]])
    return csc(rows), low, np.concatenate([qp.b, qp.h, qp.ub[box]])


def from_two_sided(qp: QP, v: Vector) -> dict[str, Any]:
    """Convert multipliers v of `two_sided` rows (v ≥ 0 at `high`) to y, z and z_box."""
    m, p = qp.b.size, qp.h.size
    z_box = np.zeros(qp.q.size)
    z_box[has_bound(qp)] = v[m + p :]
    return {
        "y": np.array(v[:m]),
        "z": np.array(v[m : m + p]),
        "z_box": on_present_bounds(qp, z_box),
    }


def to_two_sided(qp: QP, s: Solution) -> Vector:
    """Return the multipliers of `two_sided` rows; this inverts `from_two_sided`."""
    return np.concatenate([s.y, s.z, s.z_box[has_bound(qp)]])


@dataclass(frozen=True, eq=False)
class ConicForm:
    """Constraints of a QP in the form  Rx + s = r  with s in a product of cones.

    The components of s are, in this order:

    - zeros (rows of A, and variables that a disc or cone fixes at 0),
    - nonnegative numbers (rows of G, x ≤ ub, −x ≤ −lb, and −x_N ≤ 0 for cones of slope
      0),
    - blocks (t, w) with ‖w‖ ≤ t: (radius, x_I) for a disc of variables I, and
      (slope·x_N, x_T) for a cone with normal component x_N and tangential part x_T.

    At a solution, the vector v of multipliers of the rows is in the dual cone, and
    Px + q + Rᵀv = 0.
    """

    qp: QP
    rows: csc_matrix  #: R
    rhs: Vector  #: r
    equalities: int  #: number of rows with s = 0
    inequalities: int  #: number of rows with s ≥ 0
    cones: NDArray[np.int64]  #: number of rows of each second-order cone

    @property
    def linear(self) -> int:
        """Number of rows that do not belong to second-order cones."""
        return self.equalities + self.inequalities

    @property
    def heads(self) -> NDArray[np.int64]:
        """Index of the first row (the component t) of each second-order cone."""
        heads: NDArray[np.int64] = self.linear + np.cumsum(self.cones) - self.cones
        return heads

    @property
    def tails(self) -> NDArray[np.int64]:
        """Ascending indices of the other rows (the components w) of these cones."""
        return np.setdiff1d(np.arange(self.linear, self.rhs.size), self.heads)

    def multipliers(self, v: Vector) -> dict[str, Any]:
        """Convert the multipliers v of the rows to y, z and z_box."""
        m, p, first = self.qp.b.size, self.qp.h.size, self.equalities
        is_row_of_set = np.ones(v.size, dtype=bool)
        is_row_of_set[:m] = is_row_of_set[first : first + p] = False
        z_box = self.rows.T @ np.where(is_row_of_set, v, 0.0)
        return {
            "y": np.array(v[:m]),
            "z": np.array(v[first : first + p]),
            "z_box": on_present_bounds(self.qp, z_box),
        }

    def point(self, s: Solution) -> tuple[Vector, Vector, Vector]:
        """Return x, multipliers v in the dual cone, and a slack in the cones.

        s : point of the QP with multipliers y, z and z_box
        """
        qp, first, last = self.qp, self.equalities, self.linear
        # A row of a bound, disc or cone has at most one entry, ±1 or −slope. The
        # product of the entry and the multiplier is a component of z_box, so R z_box is
        # the multiplier times the square of the entry. The head row of a disc has no
        # entries.
        v = self.rows @ s.z_box
        squares = np.ravel(self.rows.multiply(self.rows).sum(axis=1))[self.heads]
        apex = np.divide(v[self.heads], squares, where=squares > 0, out=0 * squares)
        v[: qp.b.size] = s.y
        v[first : first + qp.h.size] = s.z
        v[first:last] = np.maximum(v[first:last], 0.0)
        v[self.heads] = np.maximum(apex, self._lengths(v))
        slack = self.rhs - self.rows @ s.x
        slack[:last] = np.maximum(slack[:last], 0.0)
        slack[self.heads] = np.maximum(slack[self.heads], self._lengths(slack))
        return s.x.copy(), v, slack

    def _lengths(self, v: Vector) -> Vector:
        """Return ‖w‖ of the components (t, w) of v in each second-order cone."""
        owner = np.repeat(np.arange(self.cones.size), self.cones - 1)
        lengths: Vector = np.sqrt(
            np.bincount(owner, v[self.tails] ** 2, self.cones.size)
        )
        return lengths


def to_cone(qp: QP) -> ConicForm:
    """Return the constraints of a QP in conic form.

    A disc of radius 0 becomes equality rows: as a second-order cone, it would have no
    interior, and interior-point methods would fail. A cone of slope 0 becomes the rows
    x_T = 0 and x_N ≥ 0.
    """
    up, low = np.isfinite(qp.ub), np.isfinite(qp.lb)
    eye = eye_array(qp.q.size, format="csr")
    blocks = [_conic_blocks(one) for one in qp.sets[1:]]
    fixed = _joined([one.tail[one.is_flat] for one in blocks])
    normal = _joined([one.head[one.is_flat] for one in blocks if one.has_head])
    sizes = _joined([np.full((~b.is_flat).sum(), 1 + b.tail.shape[1]) for b in blocks])
    cones = [one.rows(qp.q.size) for one in blocks]
    rows = [csc(qp.A), eye[fixed], csc(qp.G), eye[up], -eye[low], -eye[normal]]
    rhs = [qp.b, np.zeros(fixed.size), qp.h, qp.ub[up], -qp.lb[low]]
    return ConicForm(
        qp=qp,
        rows=csc(vstack(rows + [R for R, _ in cones])),
        rhs=np.concatenate([*rhs, np.zeros(normal.size), *(r for _, r in cones)]),
        equalities=qp.b.size + fixed.size,
        inequalities=qp.h.size + int(up.sum() + low.sum()) + normal.size,
        cones=sizes,
    )


class _ConicBlocks(NamedTuple):
    """k constraints ‖x[tail[i]]‖ ≤ side[i] + slope[i]·x[head[i]]."""

    #: (k, d) indices of the variables on the left-hand side of each constraint
    tail: NDArray[np.int64]
    side: Vector  #: (k,) radii of discs; zero for cones
    head: NDArray[np.int64]  #: (k,) index of the normal component of each cone
    slope: Vector  #: (k,) slopes of cones; zero for discs
    has_head: bool  #: False for discs, whose `head` is unused

    @property
    def is_flat(self) -> NDArray[np.bool_]:
        """Mask (k,) of the constraints whose right-hand side is zero for every x."""
        flat: NDArray[np.bool_] = (self.side == 0) & (self.slope == 0)
        return flat

    def rows(self, n: int) -> tuple[csr_array, Vector]:
        """Return R and r with r − Rx = (side + slope·x_head, x_tail).

        Flat blocks are omitted.
        """
        tail, side, head, slope = (part[~self.is_flat] for part in self[:4])
        k, d = tail.shape
        first = np.arange(k) * (d + 1)
        place = np.concatenate([first, (first[:, None] + np.arange(1, d + 1)).ravel()])
        column = np.concatenate([head, tail.ravel()])
        values = np.concatenate([-slope, -np.ones(tail.size)])
        rhs = np.zeros(k * (d + 1))
        rhs[first] = side
        R = coo_array((values, (place, column)), shape=(rhs.size, n)).tocsr()
        R.eliminate_zeros()
        return R, rhs


def _conic_blocks(one: ConvexSet) -> _ConicBlocks:
    if isinstance(one, Discs):
        none = np.zeros(one.radius.size)
        return _ConicBlocks(one.index, one.radius, one.index[:, 0], none, False)
    if isinstance(one, Cones):
        none, head, tail = np.zeros(one.slope.size), one.index[:, 0], one.index[:, 1:]
        return _ConicBlocks(tail, none, head, one.slope, True)
    raise TypeError(f"{type(one).__name__} has no conic form; expected Discs or Cones")


def _joined(parts: Sequence[NDArray[Any]]) -> NDArray[np.int64]:
    """Flatten and concatenate integer arrays."""
    return np.concatenate([np.empty(0, np.int64), *(part.ravel() for part in parts)])


def same_cones(one: QP, other: QP) -> bool:
    """Return True if neither QP has discs or cones, or if the conic rows are equal."""
    if len(one.sets) == len(other.sets) == 1:
        return True
    R, S = to_cone(one), to_cone(other)
    return bool(
        (R.equalities, R.inequalities) == (S.equalities, S.inequalities)
        and np.array_equal(R.cones, S.cones)
        and (R.rows != S.rows).nnz == 0
    )


def objective_factor(qp: QP, size: float = OBJECTIVE_SIZE) -> float:
    """Return the factor that scales the objective to ‖q‖∞ = `size`; 1 if q = 0."""
    return float(size / (np.abs(qp.q).max(initial=0.0) or size))


def on_present_bounds(qp: QP, z_box: Vector) -> Vector:
    """Return z_box (n,) with the multipliers of absent bounds set to zero.

    Solvers may return rounding errors for these multipliers. If this function sets a
    larger value to zero, the harness measures this value as a residual of stationarity.
    """
    return admissible(qp.sets, z_box)


def check_choice(name: str, value: Any, allowed: tuple[Any, ...]) -> None:
    """Raise ValueError unless the value of the option `name` is among `allowed`."""
    if value not in allowed:
        choices = ", ".join(map(repr, allowed[:-1]))
        raise ValueError(f"{name} = {value!r}; expected {choices} or {allowed[-1]!r}")


def check_positive(**options: float) -> None:
    """Raise ValueError unless all options are positive and finite."""
    for name, value in options.items():
        if not 0 < value < np.inf:
            raise ValueError(f"{name} = {value}; expected a finite positive number")
