"""Partition of meshes into subdomains, and classes of congruent subdomains.

Each cell is labelled with the number of its subdomain, which is a block of a structured
mesh or a part from graph partitioning. A node on the boundary of several subdomains has
a copy in each of these subdomains (tearing).

Subdomains that are images of one another under rigid motions form a class. Their cells
have the same node numbers, their materials are equal and their points are congruent.
The rotations are fitted by least squares (Kabsch 1976, Acta Cryst. A32).
"""

from __future__ import annotations

from collections.abc import Hashable, Iterable, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from mortarbench.harness import Vector
from mortarbench.problems.fem.mesh import Nodes

#: largest difference between coordinates of corresponding points of congruent
#: subdomains after the rigid motion, relative to the radius of the subdomains
CONGRUENCE_TOL = 1e-11


class SubdomainMesh(NamedTuple):
    """Mesh of one subdomain, with nodes 0 … n_k − 1."""

    points: NDArray[np.float64]  #: (n_k, dim) positions of the nodes
    cells: Nodes  #: (E_k, corners) nodes of each cell
    material: NDArray[np.int64]  #: (E_k,) material of each cell


def blocks(
    divisions: tuple[int, ...], most: int | tuple[int, ...]
) -> NDArray[np.int64]:
    """Label the cells of a structured mesh by blocks of at most `most` cells per side.

    The numbers of cells of the blocks along a direction differ by at most one.

    Parameters
    ----------
    divisions : cells along each direction; the first direction varies fastest
    most : largest number H/h of cells along a side, for all directions or for each

    Returns
    -------
    block of each cell, (Π divisions,); blocks are numbered in the same order as cells

    """
    label = np.zeros(1, dtype=np.int64)
    sides = np.broadcast_to(most, len(divisions))
    for cells, side in zip(divisions[::-1], sides[::-1], strict=True):
        count = -(-cells // int(side))
        along = np.arange(cells) * count // cells
        label = (label[:, None] * count + along).ravel()
    return label


Block = tuple[slice, slice]  #: ranges of rows and columns of cells
#: lengths of cell sides, first along columns, then along rows; each length is the
#: product of two factors, one for the row and one for the column of the cell
Sides = tuple[tuple[Vector, Vector], tuple[Vector, Vector]]


def compact_blocks(sides: Sides, most: int) -> list[Block]:
    """Cut a graded structured mesh into blocks that have aspect ratios near one.

    A block of more than most² cells is cut across its longer side (or across the other
    side if the longer one consists of a single cell), at the grid line nearest to its
    middle (the first one if two are equally near up to rounding). With equal numbers of
    cells along both sides, as in `blocks`, a block would have the aspect ratio of its
    cells, and the bending modes of long subdomains would dominate the condition number
    of the dual.

    Parameters
    ----------
    sides : side lengths of the cells
    most : number H/h of cells along a side of a square block

    """
    (deep, deep_of), (wide_of, wide) = sides
    finished, pending = list[Block](), [(slice(0, deep.size), slice(0, wide.size))]
    while pending:
        rows, columns = pending.pop()
        lengths = (
            deep[rows] * deep_of[columns].mean(),
            wide[columns] * wide_of[rows].mean(),
        )
        size = [0.0 if part.size == 1 else part.sum() for part in lengths]
        if lengths[0].size * lengths[1].size <= most**2 or not any(size):
            finished.append((rows, columns))
            continue
        k = int(size[1] > size[0] * (1 + CONGRUENCE_TOL))
        ends = np.cumsum(lengths[k])
        off = np.abs(ends[:-1] - ends[-1] / 2)
        nearest = int(np.argmax(off <= off.min() + CONGRUENCE_TOL * ends[-1]))
        cut = (rows, columns)[k]
        at = cut.start + nearest + 1
        for part in (slice(at, cut.stop), slice(cut.start, at)):
            pending.append((part, columns) if k == 0 else (rows, part))
    return finished


def compact_boxes(points: NDArray[np.float64], most: int) -> NDArray[np.int64]:
    """Label the cells of a structured mesh in 3D by blocks of compact shape.

    Let hₐ be the mean edge length of a block along direction a. The block may have
    most · min h / hₐ cells along a, rounded, and at least 1. A larger block is cut
    in two across the longest of the sides that exceed their limits. Let p be the least
    number of equal parts within the limit of this side; the cut is placed after ⌊p/2⌋
    of these parts, rounded up to a whole cell. Boxes of cubic cells are cut as in
    `blocks`. With equal numbers of cells along all directions, slender cells would
    result in slender subdomains: the condition number of PFP (see
    `problems.feti.spectrum`) is 439 with 4 × 4 × 4 cells of 1 : 1 : 4 in
    beam-ring/Nr=4/Nh=2/depth=4.

    Parameters
    ----------
    points : (…, dim) points of the nodes, with one axis per direction, the fastest last
    most : largest number of cells along a side

    Returns
    -------
    block (E,) of each cell; blocks are numbered in the order of their first cells

    """
    cells = [n - 1 for n in points.shape[:-1]]
    edges = [
        np.linalg.norm(np.diff(points, axis=a), axis=-1) for a in range(len(cells))
    ]
    finished, pending = list[tuple[slice, ...]](), [tuple(slice(0, n) for n in cells)]
    while pending:
        block = pending.pop()
        count = np.array([part.stop - part.start for part in block])
        nodes = [slice(part.start, part.stop + 1) for part in block]
        h = np.array(
            [
                edge[(*nodes[:a], block[a], *nodes[a + 1 :])].mean()
                for a, edge in enumerate(edges)
            ]
        )
        # fractions that rounding moved just below ½ count as ½, so that congruent
        # blocks are cut equally
        side = np.floor(most * h.min() / h + 0.5 + CONGRUENCE_TOL).clip(1, most)
        parts = np.ceil(count / side).astype(int)
        if (parts == 1).all():
            finished.append(block)
            continue
        length = np.where(parts > 1, count * h, 0.0)
        a = int(np.argmax(length >= length.max() * (1 - CONGRUENCE_TOL)))
        at = block[a].start - (-int(count[a]) * (parts[a] // 2) // parts[a])
        for part in (slice(block[a].start, at), slice(at, block[a].stop)):
            pending.append((*block[:a], part, *block[a + 1 :]))
    label = np.empty(cells, dtype=np.int64)
    for number, block in enumerate(sorted(finished, key=_first_cell)):
        label[block] = number
    return label.ravel()


def _first_cell(block: Sequence[slice]) -> list[int]:
    return [part.start for part in block]


def joined_labels(labels: Sequence[NDArray[np.int64]]) -> NDArray[np.int64]:
    """Join the labels of the cells of several bodies, numbered body by body."""
    first = np.cumsum([0, *(int(label.max()) + 1 for label in labels)])
    return np.concatenate([k + one for k, one in zip(first, labels, strict=False)])


def label_blocks(cut: Sequence[Block]) -> NDArray[np.int64]:
    """Return the block of each cell, row by row."""
    shape = [max(block[k].stop for block in cut) for k in (0, 1)]
    label = np.empty(shape, dtype=np.int64)
    for b, block in enumerate(cut):
        label[block] = b
    return label.ravel()


def classify(
    keys: Iterable[Hashable], points: Sequence[NDArray[np.float64]]
) -> tuple[list[int], NDArray[np.int64], NDArray[np.float64]]:
    """Group S subdomains into classes that are congruent under rigid motions.

    Parameters
    ----------
    keys : key of the cells and materials of each subdomain, equal within a class
    points : (n_s, dim) points of each subdomain; n_s is equal for equal keys

    Returns
    -------
    first subdomain of each class; class (S,) of each subdomain; rotation (S, dim, dim)
    of each subdomain relative to the first subdomain of its class

    """
    alike: dict[Hashable, list[int]] = {}
    for s, key in enumerate(keys):
        alike.setdefault(key, []).append(s)
    S, dim = len(points), points[0].shape[1]
    first, class_of = list[int](), np.empty(S, dtype=np.int64)
    rotation = np.empty((S, dim, dim))
    for group in alike.values():
        remaining = np.array(group)
        spread = np.array([spread_of(points[s]) for s in group])
        # this necessary condition avoids most comparisons: the norms ‖x − x̄‖ of two
        # images differ by at most √size times the largest difference of coordinates
        off = 2 * CONGRUENCE_TOL * np.sqrt(points[group[0]].size)
        while remaining.size:
            near = np.flatnonzero(np.abs(spread - spread[0]) <= off * spread[0])
            is_image, rotations = congruent(
                np.stack([points[s] for s in remaining[near]])
            )
            members = remaining[near[is_image]]
            class_of[members], rotation[members] = len(first), rotations[is_image]
            first.append(int(remaining[0]))
            others = np.delete(np.arange(remaining.size), near[is_image])
            remaining, spread = remaining[others], spread[others]
    return first, class_of, rotation


def spread_of(points: NDArray[np.float64]) -> float:
    """Return ‖x − x̄‖, which is invariant under rigid motions."""
    return float(np.linalg.norm(points - points.mean(axis=0)))


def congruent(
    points: NDArray[np.float64],
) -> tuple[NDArray[np.bool_], NDArray[np.float64]]:
    """Find the images of the first of g point sets under rigid motions.

    points : (g, n, dim) point sets

    Returns
    -------
    mask (g,) of the images, and rotations Q (g, dim, dim); for images,
    x − x̄ = Q (x₁ − x̄₁) up to rounding, where x₁ is the first point set

    """
    x = points - points.mean(axis=1, keepdims=True)
    near = CONGRUENCE_TOL * np.linalg.norm(x[0], axis=1).max()
    U, _, Vt = np.linalg.svd(np.einsum("gni,nj->gij", x, x[0]))
    U[:, :, -1] *= np.linalg.det(U @ Vt)[:, None]  # det Q = 1 excludes reflections
    Q = U @ Vt
    translated = (
        np.abs(x - x[0]).max(axis=(1, 2)) <= near
    )  # translations only: Q = I without rounding, so that B stays sparse
    Q[translated] = np.eye(x.shape[2])
    is_image = np.abs(x - np.einsum("gij,nj->gni", Q, x[0])).max(axis=(1, 2)) <= near
    return is_image, Q
