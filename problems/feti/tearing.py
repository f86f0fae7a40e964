"""A mesh cut into subdomains that share no node.

Which cells form a subdomain is a label of each cell: blocks of a structured mesh, or
whatever a library of graph partitioning says. Cells of one subdomain keep their nodes;
a node on the boundary of several subdomains gets a copy in each.

Subdomains that are images of one another by a rigid motion are of one kind. They are
found by their cells (numbered alike), their materials and their points; the rotation of
each is the best one in the sense of least squares (Kabsch 1976).
"""

from __future__ import annotations

from collections.abc import Hashable, Iterable, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from mortarbench.harness import Vector
from mortarbench.problems.fem.mesh import Nodes

CONGRUENCE_TOL = 1e-11  #: distance of the points of equal subdomains, of their diameter


class SubdomainMesh(NamedTuple):
    """One subdomain on its own, with nodes 0 … n_k − 1."""

    points: NDArray[np.float64]  #: (n_k, dim)
    cells: Nodes  #: (E_k, corners)
    material: NDArray[np.int64]  #: (E_k,)


def blocks(
    divisions: tuple[int, ...], most: int | tuple[int, ...]
) -> NDArray[np.int64]:
    """Label the cells of a structured mesh by blocks of at most `most` cells a side.

    The blocks along a direction are as equal as whole numbers allow.

    Parameters
    ----------
    divisions : cells along each direction, the one that is numbered fastest first
    most : H/h; of each direction, where these differ

    Returns
    -------
    (Π divisions,) block of each cell, numbered as cells are

    """
    label = np.zeros(1, dtype=np.int64)
    sides = np.broadcast_to(most, len(divisions))
    for cells, side in zip(divisions[::-1], sides[::-1], strict=True):
        count = -(-cells // int(side))
        along = np.arange(cells) * count // cells
        label = (label[:, None] * count + along).ravel()
    return label


Block = tuple[slice, slice]  #: rows and columns of cells
#: sides of the cells of rows and columns, along columns and along rows: each as two
#: factors, one of each row and one of each column
Sides = tuple[tuple[Vector, Vector], tuple[Vector, Vector]]


def compact_blocks(sides: Sides, most: int) -> list[Block]:
    """Cut a graded structured mesh into blocks of cells about as long as wide.

    A block of more than most² cells is cut across where it is longer, at half of its
    length, and nearer to its beginning where two lines are as near to that but for
    rounding. Blocks as long as `blocks` are in cells would be as long and thin as
    these, and bending of long subdomains is what conditions their dual worst.

    Parameters
    ----------
    sides : of the cells, of ny rows and nx columns
    most : H/h of a square

    """
    (deep, deep_of), (wide_of, wide) = sides
    found, left = list[Block](), [(slice(0, deep.size), slice(0, wide.size))]
    while left:
        rows, columns = left.pop()
        lengths = (
            deep[rows] * deep_of[columns].mean(), wide[columns] * wide_of[rows].mean(),
        )  # fmt: skip
        size = [0.0 if part.size == 1 else part.sum() for part in lengths]
        if lengths[0].size * lengths[1].size <= most**2 or not any(size):
            found.append((rows, columns))
            continue
        k = int(size[1] > size[0] * (1 + CONGRUENCE_TOL))
        ends = np.cumsum(lengths[k])
        off = np.abs(ends[:-1] - ends[-1] / 2)
        nearest = int(np.argmax(off <= off.min() + CONGRUENCE_TOL * ends[-1]))
        cut = (rows, columns)[k]
        at = cut.start + nearest + 1
        for part in (slice(at, cut.stop), slice(cut.start, at)):
            left.append((part, columns) if k == 0 else (rows, part))
    return found


def label_blocks(found: Sequence[Block]) -> NDArray[np.int64]:
    """Label cells, row by row, by the blocks that cover them."""
    shape = [max(block[k].stop for block in found) for k in (0, 1)]
    label = np.empty(shape, dtype=np.int64)
    for b, block in enumerate(found):
        label[block] = b
    return label.ravel()


def classify(
    keys: Iterable[Hashable], points: Sequence[NDArray[np.float64]]
) -> tuple[list[int], NDArray[np.int64], NDArray[np.float64]]:
    """Find which of S subdomains are images of one another by a rigid motion.

    Parameters
    ----------
    keys : what is the same of all subdomains of one kind: cells and materials
    points : (n_s, dim) of each; of those with one key equally many

    Returns
    -------
    first subdomain of each kind, kind (S,) of each subdomain, and rotations
    (S, dim, dim) of it against the first one

    """
    alike: dict[Hashable, list[int]] = {}
    for s, key in enumerate(keys):
        alike.setdefault(key, []).append(s)
    S, dim = len(points), points[0].shape[1]
    first, kind = list[int](), np.empty(S, dtype=np.int64)
    rotation = np.empty((S, dim, dim))
    for group in alike.values():
        left = np.array(group)
        spread = np.array([spread_of(points[s]) for s in group])
        # of images, ‖x − x̄‖ differs by no more than their points do
        off = 2 * CONGRUENCE_TOL * np.sqrt(points[group[0]].size)
        while left.size:
            near = np.flatnonzero(np.abs(spread - spread[0]) <= off * spread[0])
            same, turn = congruent(np.stack([points[s] for s in left[near]]))
            found = left[near[same]]
            kind[found], rotation[found] = len(first), turn[same]
            first.append(int(left[0]))
            others = np.delete(np.arange(left.size), near[same])
            left, spread = left[others], spread[others]
    return first, kind, rotation


def spread_of(points: NDArray[np.float64]) -> float:
    """Return ‖x − x̄‖, which is the same of images."""
    return float(np.linalg.norm(points - points.mean(axis=0)))


def congruent(
    points: NDArray[np.float64],
) -> tuple[NDArray[np.bool_], NDArray[np.float64]]:
    """Say which of equally many points (g, n, dim) are images of the first, and how.

    Returns
    -------
    (g,) whether, and (g, dim, dim) the rotations: x − x̄ = Q (x₁ − x̄₁)

    """
    x = points - points.mean(axis=1, keepdims=True)
    near = CONGRUENCE_TOL * np.linalg.norm(x[0], axis=1).max()
    U, _, Vt = np.linalg.svd(np.einsum("gni,nj->gij", x, x[0]))
    U[:, :, -1] *= np.linalg.det(U @ Vt)[:, None]  # no reflections
    Q = U @ Vt
    moved = np.abs(x - x[0]).max(axis=(1, 2)) <= near  # without turning
    Q[moved] = np.eye(x.shape[2])
    turned = np.abs(x - np.einsum("gij,nj->gni", Q, x[0])).max(axis=(1, 2)) <= near
    return turned, Q
