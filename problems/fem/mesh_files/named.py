"""Bodies and boundaries from the named sets of a mesh file."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from mortarbench.harness import InputError
from mortarbench.harness.mechanics import KINDS, boundary_facets, cell_blocks
from mortarbench.problems.fem.elements import ELEMENTS, cross
from mortarbench.problems.fem.mesh import REPEATED, Nodes, is_triangle

#: largest deviation of a plane mesh from z = const, relative to its extent
FLATNESS_TOLERANCE = 1e-9
#: dimension of each supported kind of cell
DIMENSION = {kind: dim for (dim, _), kind in KINDS.items()}
#: bound on the magnitude of coordinates; products of larger ones could overflow
MAX_COORDINATE = 1e100
CORNERS = {kind: corners for (_, corners), kind in KINDS.items()}
#: permutation of the corners that mirrors a cell, by kind of cell
_MIRRORED = {
    "tetra": [1, 0, 2, 3], "wedge": [3, 4, 5, 0, 1, 2],
    "hexahedron": [4, 5, 6, 7, 0, 1, 2, 3],
}  # fmt: skip


class Words(NamedTuple):
    """Terms of a file format for bodies and boundaries, used in error messages."""

    body: str = "body"
    boundary: str = "boundary"
    point: str = "point"
    naming: str = "a name for every body"  #: instruction for naming a body
    linear: str = "linear cells"  #: instruction for obtaining cells of first order


class FileMesh(NamedTuple):
    """Content of a mesh file: cells of any dimension, and sets of cells and nodes."""

    path: Path
    points: NDArray[np.float64]  #: (N, 2) or (N, 3) positions of the nodes
    #: cells by kind, with meshio's names; node numbers start at 0
    blocks: Sequence[tuple[str, NDArray[Any]]]
    #: sets of cells by dimension and name; for each block, a set lists the rows of its
    #: cells
    cell_sets: Mapping[int, Mapping[str, Sequence[Nodes]]]
    node_sets: Mapping[str, Nodes]
    #: mapping from the dimension of the bodies to the terms
    vocabulary: Mapping[int, Words]

    @property
    def dim(self) -> int:
        """Dimension of the bodies: 3 if there are solid cells, otherwise 2."""
        return max([2, *(_dimension(kind) for kind, _ in self.blocks)])

    @property
    def words(self) -> Words:
        """Terms of the format for bodies of this dimension."""
        return self.vocabulary[self.dim]

    @property
    def body_names(self) -> tuple[str, ...]:
        """Names of the sets of cells that may be bodies."""
        return tuple(self.cell_sets.get(self.dim, {}))

    def cells(self, dim: int, rows: Sequence[Nodes]) -> Nodes:
        """Return selected cells of dimension `dim` as a single array (E, c).

        Triangles are stored as degenerate quadrilaterals, c = 4. If the file contains
        solid cells of several kinds, tetrahedra and wedges are stored as degenerate
        hexahedra, c = 8.

        rows : for each block, the rows of the selected cells
        """
        is_mixed = len({kind for kind, _ in self.blocks if DIMENSION[kind] == 3}) > 1
        parts: list[Nodes] = []
        for (kind, nodes), selected in zip(self.blocks, rows, strict=True):
            if DIMENSION[kind] != dim or not len(selected):
                continue
            part = np.asarray(nodes, dtype=np.int64)[selected]
            if kind == "triangle":
                part = part[:, [0, 1, 2, 2]]
            elif is_mixed and kind in REPEATED:
                part = part[:, REPEATED[kind]]
            parts.append(part)
        return np.concatenate(parts)


class NamedMesh(NamedTuple):
    """A mesh with named bodies and boundaries, in 2D or 3D."""

    points: NDArray[np.float64]  #: (N, dim) positions of the nodes
    cells: Nodes  #: (E, c), as in `problems.fem.mesh.Mesh`
    surfaces: Mapping[str, Nodes]  #: numbers of the cells of each body
    #: edges (k, 2) of each named curve, with the body on their left; in 3D, faces
    #: (k, 4) of each named surface, anticlockwise from outside
    curves: Mapping[str, Nodes]
    #: nodes of each named point or set of nodes and, in 3D, of each named curve
    spots: Mapping[str, Nodes]
    words: Words = Words()

    @property
    def dim(self) -> int:
        """Dimension of the bodies."""
        return int(self.points.shape[1])


def check_numbers(file: FileMesh) -> None:
    """Raise InputError for invalid coordinates, kinds of cells or node numbers."""
    path, points = file.path, file.points
    if (
        points.ndim != 2
        or points.shape[1] not in (2, 3)
        or not (abs(points) < MAX_COORDINATE).all()
    ):
        raise InputError(
            f"{path}: coordinates are missing or not below {MAX_COORDINATE:g} in "
            "magnitude; expected nodes with finite coordinates"
        )
    for kind, nodes in file.blocks:
        if kind not in DIMENSION:
            remedy = _remedy(kind, file.words)
            raise InputError(f"{path}: cells of type {kind}; {remedy}")
        if nodes.ndim != 2 or nodes.shape[1] != CORNERS[kind]:
            raise InputError(
                f"{path}: {kind} cells with {nodes.shape[-1]} nodes; expected "
                f"{CORNERS[kind]}"
            )
        # meshio assigns −1 to nodes that the file does not define
        if nodes.size and not 0 <= nodes.min() <= nodes.max() < len(points):
            raise InputError(
                f"{path}: cells refer to nodes that are not in the file; define these "
                "nodes or remove the cells"
            )


def named_mesh(file: FileMesh, bodies: Collection[str] = ()) -> NamedMesh:
    """Select bodies and boundaries by name.

    Sets of cells may overlap. The sets in `bodies` become bodies first. Then each other
    set becomes a body, which consists of the cells of the set that belong to no body
    yet; sets without such cells are skipped. Boundaries are sets of facets, and sets of
    nodes that contain all corners of a facet on the boundary of the bodies.

    Nodes and cells are numbered body by body, as generalised inverses require. Within a
    body, they keep the order of the file, where cells are grouped by kind. Nodes
    without cells (such as centres of arcs) are dropped.

    Raises
    ------
    InputError
        If the file contains no volumes and its nodes are not all at the same z, or if
        it contains no bodies, cells without a name, flat, folded or non-convex cells,
        bodies that share cells or nodes, a body of several disconnected parts, or named
        facets that are not on the boundary of the bodies.

    """
    path, points, dim, words = file.path, file.points, file.dim, file.words
    extent = np.ptp(points, axis=0).max(initial=0.0)
    is_flat = points.shape[1] < 3 or (
        np.ptp(points[:, 2]) <= FLATNESS_TOLERANCE * extent
    )
    if dim == 2 and not is_flat:
        raise InputError(
            f"{path}: the nodes are not all at the same z, and there are no volume "
            "cells; expected a plane mesh, or tetrahedra, wedges or hexahedra"
        )
    parts = {name: file.cells(dim, rows) for name, rows in _bodies(file, bodies)}
    if not parts:
        raise InputError(f"{path}: no {words.body} with cells; expected {words.naming}")
    used = _unique_in_order([np.unique(part) for part in parts.values()])
    renumbered = np.full(len(points), -1)
    renumbered[used] = np.arange(used.size)
    points = points[used, :dim]
    cells = renumbered[np.concatenate(list(parts.values()))]
    cells = (_counter_clockwise if dim == 2 else _right_handed)(path, points, cells)
    ends = np.cumsum([0] + [len(part) for part in parts.values()])
    surfaces = {name: np.arange(ends[i], ends[i + 1]) for i, name in enumerate(parts)}
    _check_apart(path, len(points), cells, surfaces, words)
    outer = boundary_facets(cells, dim)
    directed = {tuple(sorted(set(facet))): facet for facet in outer.tolist()}
    node_sets = {
        name: nodes[nodes >= 0]
        for name, numbers in file.node_sets.items()
        for nodes in [np.unique(renumbered[numbers])]
    }
    covered = {
        name: outer[np.isin(outer, nodes).all(axis=1)]
        for name, nodes in node_sets.items()
    }
    facets = {
        name: _directed(
            path, name, renumbered[file.cells(dim - 1, rows)], directed, words
        )
        for name, rows in file.cell_sets.get(dim - 1, {}).items()
    }
    spots = {
        name: nodes
        for below in range(dim - 1)
        for name, rows in file.cell_sets.get(below, {}).items()
        for nodes in [renumbered[file.cells(below, rows)]]
        if (nodes >= 0).all()
    }
    return NamedMesh(
        points,
        cells,
        surfaces,
        curves={name: at for name, at in covered.items() if len(at)} | facets,
        spots={name: nodes for name, nodes in node_sets.items() if nodes.size}
        | {name: np.unique(nodes) for name, nodes in spots.items()},
        words=words,
    )


def refine(mesh: NamedMesh) -> NamedMesh:
    """Refine a plane mesh: bisect every edge, and divide each cell into four.

    The shape of bodies is unchanged, because new nodes on edges are midpoints. A
    triangle is divided into four similar triangles, and a quadrilateral into four
    quadrilaterals that meet at the mean of its corners. Nodes remain numbered body by
    body.
    """
    cells, corners = mesh.cells, mesh.cells.T
    is_quad = ~is_triangle(cells)
    edges = np.stack([cells, np.roll(cells, -1, axis=1)], axis=-1)  # (E, 4, 2)
    ends, middle = np.unique(
        np.sort(edges.reshape(-1, 2), axis=1), axis=0, return_inverse=True
    )
    n = len(mesh.points)
    # the midpoint of the degenerate edge of a triangle is its repeated corner
    is_edge = ends[:, 0] != ends[:, 1]
    number = np.where(is_edge, n + np.cumsum(is_edge) - 1, ends[:, 0])
    m = number[middle].reshape(-1, 4).T
    centre = n + is_edge.sum() + np.cumsum(is_quad) - 1
    points = np.concatenate(
        [
            mesh.points,
            mesh.points[ends[is_edge]].mean(axis=1),
            mesh.points[cells[is_quad]].mean(axis=1),
        ]
    )
    children = np.stack(
        [
            np.stack([corners[k], m[k], np.where(is_quad, centre, m[k - 1]), m[k - 1]])
            for k in range(4)
        ],
        axis=-1,
    )
    # a triangle repeats its third corner: one of the two children at this corner is
    # replaced by the triangle of the midpoints
    children[:, ~is_quad, 2] = np.stack([corners[2], m[3], m[1], m[1]])[:, ~is_quad]
    children[:, ~is_quad, 3] = m[[0, 1, 3, 3]][:, ~is_quad]
    fine = np.ascontiguousarray(children.transpose(1, 2, 0))  # (E, 4 children, 4)
    of_edge = {(a, b): k for (a, b), k in zip(ends.tolist(), number, strict=True)}
    used = _unique_in_order([np.unique(fine[part]) for part in mesh.surfaces.values()])
    renumbered = np.empty(len(points), dtype=np.int64)
    renumbered[used] = np.arange(used.size)

    def cut(curve: Nodes) -> Nodes:
        a, b = curve.T
        at = np.array([of_edge[min(e), max(e)] for e in curve.tolist()], dtype=np.int64)
        return np.asarray(renumbered[np.stack([a, at, at, b], axis=-1).reshape(-1, 2)])

    return NamedMesh(
        points[used],
        renumbered[fine.reshape(-1, 4)],
        {k: (4 * v[:, None] + np.arange(4)).ravel() for k, v in mesh.surfaces.items()},
        {name: cut(curve) for name, curve in mesh.curves.items()},
        {name: renumbered[spot] for name, spot in mesh.spots.items()},
        mesh.words,
    )


def _bodies(
    file: FileMesh, chosen: Collection[str]
) -> list[tuple[str, Sequence[Nodes]]]:
    """Return the name of each body and its rows in each block, in file order."""
    path, dim, words = file.path, file.dim, file.words
    sets = file.cell_sets.get(dim, {})
    owner = [np.full(len(nodes), -1) for _, nodes in file.blocks]
    bodies: dict[str, Sequence[Nodes]] = {}
    for name in sorted(sets, key=lambda name: name not in chosen):
        free = [rows[at[rows] < 0] for at, rows in zip(owner, sets[name], strict=True)]
        count = sum(rows.size for rows in sets[name]) - sum(rows.size for rows in free)
        if name in chosen and count:
            raise InputError(
                f"{path}: {words.body} {name!r} shares {count} cells with another "
                "body; expected bodies without common cells"
            )
        if any(rows.size for rows in free):
            for at, rows in zip(owner, free, strict=True):
                at[rows] = len(bodies)
            bodies[name] = free
    nameless = sum(
        int((at < 0).sum())
        for (kind, _), at in zip(file.blocks, owner, strict=True)
        if DIMENSION[kind] == dim
    )
    if nameless:
        raise InputError(
            f"{path}: {nameless} cells without a name; expected a name for each: "
            f"{words.naming}"
        )
    return [(name, bodies[name]) for name in sets if name in bodies]


def _dimension(kind: str) -> int:
    """Return the dimension of a kind of cells.

    The dimension of unsupported kinds is 3 for solids and 0 for all others.
    """
    spatial = ("pyramid", "tetra", "wedge", "hexahedron")
    return DIMENSION.get(kind, 3 if kind.startswith(spatial) else 0)


def _remedy(kind: str, words: Words) -> str:
    """Return the part of an error message that states which cells are expected."""
    if kind.startswith("pyramid"):
        return "expected no pyramids: volumes of tetrahedra alone"
    if any(kind.startswith(known) for known in DIMENSION):
        return f"expected cells of first order: {words.linear}"
    return f"expected {', '.join(DIMENSION)}, as meshio calls them"


def _unique_in_order(parts: list[Nodes]) -> Nodes:
    """Return the distinct nodes of all arrays, in the order of first occurrence."""
    nodes = np.concatenate(parts)
    return nodes[np.sort(np.unique(nodes, return_index=True)[1])]


def _counter_clockwise(path: Path, points: NDArray[np.float64], cells: Nodes) -> Nodes:
    """Reorder clockwise cells; raise InputError for flat and non-convex cells."""
    x, triangle = points[cells], is_triangle(cells)[:, None]
    # twice the area of a quadrilateral is the cross product of its diagonals
    twice_area = cross(x[:, 2] - x[:, 0], x[:, 3] - x[:, 1])
    reversed_ = np.where(triangle, cells[:, [1, 0, 2, 3]], cells[:, [0, 3, 2, 1]])
    cells = np.where(twice_area[:, None] < 0, reversed_, cells)
    if (flat := twice_area == 0).any():
        x, y = points[cells[flat.argmax()]].mean(axis=0)
        raise InputError(
            f"{path}: the cell around ({x:.6g}, {y:.6g}) has no area; expected "
            "distinct corners, in their order around the cell"
        )
    edges = np.roll(points[cells], -1, axis=1) - points[cells]
    # the boundary of a convex cell turns left at every corner
    corners = cross(np.roll(edges, 1, axis=1), edges)
    if (bad := ((corners <= 0) & ~triangle).any(axis=1)).any():
        x, y = points[cells[bad.argmax()]].mean(axis=0)
        raise InputError(
            f"{path}: the cell around ({x:.6g}, {y:.6g}) is not convex; "
            "expected interior angles below 180°"
        )
    return cells


def _right_handed(path: Path, points: NDArray[np.float64], cells: Nodes) -> Nodes:
    """Reorder mirrored cells; raise InputError if a Jacobian is not positive."""
    cells = cells.copy()
    for block in cell_blocks(cells, 3):
        element = ELEMENTS[3, block.nodes.shape[1]]
        slopes = np.stack([element.gradients(xi) for xi in element.points])
        J = np.einsum("qar,eax->eqrx", slopes, points[block.nodes])
        det = np.linalg.det(J)
        mirrored = (det < 0).all(axis=1)
        if (bad := ~mirrored & (det <= 0).any(axis=1)).any():
            x, y, z = points[block.nodes[bad.argmax()]].mean(axis=0)
            raise InputError(
                f"{path}: the {block.kind} around ({x:.6g}, {y:.6g}, {z:.6g}) has no "
                "volume or folds over; expected distinct corners, in gmsh's order"
            )
        nodes = block.nodes[mirrored][:, _MIRRORED[block.kind]]
        if cells.shape[1] != nodes.shape[1]:
            nodes = nodes[:, REPEATED[block.kind]]
        cells[block.cells[mirrored]] = nodes
    return cells


def _check_apart(
    path: Path, nodes: int, cells: Nodes, surfaces: Mapping[str, Nodes], words: Words
) -> None:
    """Raise InputError for bodies that share nodes or are disconnected."""
    owner = np.full(nodes, -1)
    names = list(surfaces)
    for i, name in enumerate(names):
        of_body = np.unique(cells[surfaces[name]])
        if (shared := owner[of_body] >= 0).any():
            other = names[owner[of_body[shared.argmax()]]]
            raise InputError(
                f"{path}: bodies {other!r} and {name!r} share nodes; expected separate "
                "nodes for each body"
            )
        owner[of_body] = i
    start, end = cells[:, :-1].ravel(), cells[:, 1:].ravel()
    graph = coo_array((np.ones(start.size), (start, end)), shape=(nodes, nodes))
    _, part = connected_components(graph, directed=False)
    for i, name in enumerate(names):
        if (count := np.unique(part[owner == i]).size) > 1:
            raise InputError(
                f"{path}: body {name!r} consists of {count} disconnected parts; "
                f"expected one {words.body} for each part"
            )


def _directed(
    path: Path,
    name: str,
    facets: Nodes,
    boundary: Mapping[Any, list[int]],
    words: Words,
) -> Nodes:
    """Return `facets` with their corners in the order that they have in `boundary`.

    boundary : facets on the boundary of the bodies, by sorted corners

    Raises
    ------
    InputError
        If a facet is not on the boundary of the bodies.

    """
    where = f"{words.boundary} {name!r}"
    facet = "an edge" if facets.shape[1] == 2 else "a face"
    if (facets < 0).any():
        raise InputError(
            f"{path}: {where} has {facet} that bounds no body in the file; expected "
            f"every body to have a name: {words.naming}"
        )
    names = [tuple(sorted(set(facet))) for facet in facets.tolist()]
    if not all(name in boundary for name in names):
        raise InputError(
            f"{path}: {where} has {facet} that bounds no body, or lies within one; "
            f"expected {facet.split()[1]}s of cells on the boundary"
        )
    return np.array([boundary[name] for name in names], dtype=np.int64)
