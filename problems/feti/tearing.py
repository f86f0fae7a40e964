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


def compact_blocks(points: NDArray[np.float64], most: int) -> NDArray[np.int64]:
    """Label the cells of a structured mesh by blocks of compact shape.

    Blocks are cut in two until they fulfil a limit. With equal numbers of cells along
    all directions, as in `blocks`, a block would have the aspect ratio of its cells,
    and the bending modes of slender subdomains would dominate the condition number of
    the dual: that of PFP (see `problems.feti.spectrum`) is 439 with 4 × 4 × 4 cells of
    1 : 1 : 4 in beam-ring/Nr=4/Nh=2/depth=4. The limits are those of `_cut_middle` in
    2D, and of `_cut_evenly` in 3D.

    Parameters
    ----------
    points : (…, dim) points of the nodes, with one axis per direction, the fastest last
    most : number of cells along a side of a block of cubes, or of squares

    Returns
    -------
    block (E,) of each cell; blocks of boxes are numbered in the order of their first
    cells, and plane blocks such that halves of a cut are numbered one after the other

    """
    cells = [n - 1 for n in points.shape[:-1]]
    axes = range(len(cells))
    edges = [np.linalg.norm(np.diff(points, axis=a), axis=-1) for a in axes]
    cut = _cut_middle if len(cells) == 2 else _cut_evenly
    finished, pending = list[tuple[slice, ...]](), [tuple(slice(0, n) for n in cells)]
    while pending:
        block = pending.pop()
        nodes = [slice(part.start, part.stop + 1) for part in block]
        means = [
            edges[a][(*nodes[:a], block[a], *nodes[a + 1 :])].mean(
                axis=tuple(k for k in axes if k != a)
            )
            for a in axes
        ]
        if (place := cut(means, most)) is None:
            finished.append(block)
            continue
        a, at = place[0], block[place[0]].start + place[1]
        for part in (slice(at, block[a].stop), slice(block[a].start, at)):
            pending.append((*block[:a], part, *block[a + 1 :]))
    if len(cells) == 3:
        finished.sort(key=lambda block: [part.start for part in block])
    label = np.empty(cells, dtype=np.int64)
    for number, block in enumerate(finished):
        label[block] = number
    return label.ravel()


def _cut_middle(lengths: Sequence[Vector], most: int) -> tuple[int, int] | None:
    """Return the direction and the place of a cut of a plane block, or None.

    A block of more than most² cells is cut across its longer side (or across the other
    side if the longer one consists of a single cell), at the grid line nearest to its
    middle (the first one if two are equally near up to rounding).

    lengths : mean lengths of the cells along each direction
    """
    size = [0.0 if part.size == 1 else part.sum() for part in lengths]
    if lengths[0].size * lengths[1].size <= most**2 or not any(size):
        return None
    k = int(size[1] > size[0] * (1 + CONGRUENCE_TOL))
    ends = np.cumsum(lengths[k])
    off = np.abs(ends[:-1] - ends[-1] / 2)
    return k, 1 + int(np.argmax(off <= off.min() + CONGRUENCE_TOL * ends[-1]))


def _cut_evenly(lengths: Sequence[Vector], most: int) -> tuple[int, int] | None:
    """Return the direction and the place of a cut of a box, or None.

    Let hₐ be the mean edge length of a block along direction a. The block may have
    most · min h / hₐ cells along a, rounded, and at least 1. A larger block is cut
    across the longest of the sides that exceed their limits. Let p be the least number
    of equal parts within the limit of this side; the cut is placed after ⌊p/2⌋ of these
    parts, rounded up to a whole cell. Boxes of cubic cells are cut as in `blocks`.

    lengths : mean lengths of the cells along each direction
    """
    count = np.array([part.size for part in lengths])
    h = np.array([part.mean() for part in lengths])
    # fractions that rounding moved just below ½ count as ½, so that congruent blocks
    # are cut equally
    side = np.floor(most * h.min() / h + 0.5 + CONGRUENCE_TOL).clip(1, most)
    parts = np.ceil(count / side).astype(int)
    if (parts == 1).all():
        return None
    length = np.where(parts > 1, count * h, 0.0)
    a = int(np.argmax(length >= length.max() * (1 - CONGRUENCE_TOL)))
    return a, -(-int(count[a]) * int(parts[a] // 2) // int(parts[a]))


def joined_labels(labels: Sequence[NDArray[np.int64]]) -> NDArray[np.int64]:
    """Join the labels of the cells of several bodies, numbered body by body."""
    first = np.cumsum([0, *(int(label.max()) + 1 for label in labels)])
    return np.concatenate([k + one for k, one in zip(first, labels, strict=False)])


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
