"""Polygons that replace discs and friction cones, for solvers without these sets."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from scipy.sparse import coo_array, csr_array, vstack

from mortarbench.harness import QP, Box, Solution, Vector
from mortarbench.harness.errors import InputError, shown
from mortarbench.harness.sets.cones import Cones
from mortarbench.harness.sets.convex import ConvexSet
from mortarbench.harness.sets.discs import Discs

LEAST_SIDES, MOST_SIDES = 3, 10_000


@dataclass(frozen=True, eq=False)
class PolygonalQP:
    """Approximation of a QP in which polygons replace discs and sections of cones."""

    qp: QP  #: QP without discs and cones; G has one additional row per polygon side
    #: 1 − cos(π/k) for k sides; each polygon contains the concentric disc of radius
    #: (1 − error)·radius
    error: float
    #: Maps a point of `qp` to a point of the original QP. The resulting `z_box` is
    #: normal to the polygons rather than to the circles, so the residuals of the point
    #: in the original QP show the error of the approximation.
    recover: Callable[[Solution], Solution]


def polygonal(qp: QP, sides: int) -> PolygonalQP:
    """Replace discs and friction cones by inscribed regular polygons and pyramids.

    Every feasible point of the new QP is feasible for the original QP. With the normals
    n_j of the k sides, a disc is replaced by  n_jᵀx ≤ radius·cos(π/k),  and a cone
    by  n_jᵀx_T ≤ slope·cos(π/k)·x_N  with x_N ≥ 0.

    sides : k, the number of sides of each polygon

    Raises
    ------
    InputError
        If `sides` is not an integer from 3 to 10 000, or if a disc or the tangential
        part of a cone does not have exactly two variables.

    Examples
    --------
    >>> import mortarbench as mb
    >>> disc = mb.Discs([[0, 1]], [1.0])
    >>> qp = mb.QP.from_arrays([[1, 0], [0, 1]], [-2, 0], sets=(disc,))
    >>> other = mb.polygonal(qp, 8)
    >>> other.qp.sizes["inequalities"], round(other.error, 3)
    (8, 0.076)

    """
    if not isinstance(sides, int) or not LEAST_SIDES <= sides <= MOST_SIDES:
        raise InputError(
            f"sides = {shown(sides)}; expected an integer from {LEAST_SIDES} to "
            f"{MOST_SIDES}"
        )
    p, n, lower = qp.h.size, qp.q.size, qp.lb.copy()
    parts = [_sides(one, sides, n) for one in qp.sets[1:]]
    for one in qp.sets[1:]:
        if isinstance(one, Cones):
            lower[one.index[:, 0]] = 0.0
    rows = vstack([csr_array((0, n)), *(rows for rows, _ in parts)]).tocsr()
    flat = replace(
        qp,
        sets=(Box(lower, qp.ub),),
        G=vstack([csr_array(qp.G), rows]).tocsr(),
        h=np.concatenate([qp.h, *(h for _, h in parts)]),
    )

    def recover(s: Solution) -> Solution:
        return replace(s, z=s.z[:p], z_box=s.z_box + rows.T @ s.z[p:])

    return PolygonalQP(flat, float(1 - np.cos(np.pi / sides)), recover)


def _sides(one: ConvexSet, sides: int, n: int) -> tuple[csr_array, Vector]:
    """Return R and r such that Rx ≤ r describes all polygons of a set."""
    if isinstance(one, Discs):
        tangents, radius, slope = one.index, one.radius, 0 * one.radius
    elif isinstance(one, Cones):
        tangents, radius, slope = one.index[:, 1:], 0 * one.slope, one.slope
    else:
        raise InputError(
            f"{type(one).__name__} has no polygon; expected Discs or Cones"
        )
    k, d = tangents.shape
    if d != 2:
        raise InputError(
            f"{type(one).__name__} of {d} tangential variables; expected 2"
        )
    angle = (2 * np.arange(sides) + 1) * np.pi / sides
    row = np.arange(k * sides).reshape(k, sides)
    shrink, column = np.cos(np.pi / sides), np.broadcast_to
    entries = [
        (column(tangents[:, :1], row.shape), column(np.cos(angle), row.shape)),
        (column(tangents[:, 1:], row.shape), column(np.sin(angle), row.shape)),
        (
            column(one.index[:, :1], row.shape),
            column(-shrink * slope[:, None], row.shape),
        ),
    ]
    R = coo_array(
        (
            np.concatenate([values.ravel() for _, values in entries]),
            (np.tile(row.ravel(), 3), np.concatenate([c.ravel() for c, _ in entries])),
        ),
        shape=(row.size, n),
    ).tocsr()
    R.eliminate_zeros()
    return R, np.repeat(shrink * radius, sides)
