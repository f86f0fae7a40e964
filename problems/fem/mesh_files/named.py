"""Bodies and boundaries from the named sets of a mesh file."""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from mortarbench.harness import InputError
from mortarbench.harness.mechanics import (
    KINDS,
    boundary_facets,
    cell_blocks,
)
from mortarbench.problems.fem.elements import ELEMENTS, cross
from mortarbench.problems.fem.mesh import (
    REPEATED,
    Nodes,
    adjacent_cells,
    is_triangle,
)

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


#: rows in the tables of cells of a `FileMesh`, by kind of cell
Rows = Mapping[str, Nodes]


class FileMesh(NamedTuple):
    """Content of a mesh file: cells of any dimension, and sets of cells and nodes."""

    path: Path
    points: NDArray[np.float64]  #: (N, 2) or (N, 3) positions of the nodes
    #: table of corners (k, corners) of the cells of each kind, by meshio's names; nodes
    #: are numbered from 0
    cells: Mapping[str, Nodes]
    #: sets of cells by dimension and name
    cell_sets: Mapping[int, Mapping[str, Rows]]
    node_sets: Mapping[str, Nodes]
    #: mapping from the dimension of the bodies to the terms
    vocabulary: Mapping[int, Words]

    @property
    def dim(self) -> int:
        """Dimension of the bodies: 3 if there are solid cells, otherwise 2."""
        return max([2, *map(_dimension, self.cells)])

    @property
    def words(self) -> Words:
        """Terms of the format for bodies of this dimension."""
        return self.vocabulary[self.dim]

    @property
    def body_names(self) -> tuple[str, ...]:
        """Names of the sets of cells that may be bodies."""
        return tuple(self.cell_sets.get(self.dim, {}))

    def set_of(self, body: str) -> str:
        """Return the name of the set of a body, where NAME.1 is a body of NAME."""
        stem, _, part = body.rpartition(".")
        is_part = part.isdecimal() and body not in self.body_names
        return stem if is_part and stem in self.body_names else body

    def table(self, dim: int, rows: Rows) -> Nodes:
        """Return selected cells of dimension `dim` as a single array (E, c).

        Triangles are stored as degenerate quadrilaterals, c = 4. If the file contains
        solid cells of several kinds, tetrahedra and wedges are stored as degenerate
        hexahedra, c = 8.
        """
        is_mixed = sum(DIMENSION[kind] == 3 for kind in self.cells) > 1
        parts: list[Nodes] = []
        for kind, nodes in self.cells.items():
            if DIMENSION[kind] != dim or not len(rows.get(kind, ())):
                continue
            part = np.asarray(nodes, dtype=np.int64)[rows[kind]]
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
    #: piece of each body; bodies of one piece have common nodes
    piece: Nodes
    words: Words = Words()

    @property
    def dim(self) -> int:
        """Dimension of the bodies."""
        return int(self.points.shape[1])


def checked_mesh(file: FileMesh) -> FileMesh:
    """Check kinds of cells and node numbers; return the mesh with every cell once.

    Cells with the same corners are one cell, which belongs to the sets of all of them.

    Raises
    ------
    InputError
        If a kind of cell is not supported, or a cell has nodes that are not in the
        file, or repeats a node.

    """
    path, points = file.path, file.points
    cells, new = {}, {}
    for kind, nodes in file.cells.items():
        if kind not in DIMENSION:
            remedy = _remedy(kind, file.words)
            raise InputError(f"{path}: cells of type {kind}; {remedy}")
        if nodes.ndim != 2 or nodes.shape[1] != CORNERS[kind]:
            raise InputError(
                f"{path}: {kind} cells with {nodes.shape[-1]} nodes; expected "
                f"{CORNERS[kind]}"
            )
        if nodes.size and not 0 <= nodes.min() <= nodes.max() < len(points):
            raise InputError(
                f"{path}: cells refer to nodes that are not in the file; define these "
                "nodes or remove the cells"
            )
        corners = np.sort(nodes, axis=1)
        if (bad := (np.diff(corners) == 0).any(axis=1)).any():
            where = place(points[nodes[bad.argmax()]])
            raise InputError(
                f"{path}: the {kind} around {where} repeats a node; expected distinct "
                "corners"
            )
        _, first, number = np.unique(
            corners, axis=0, return_index=True, return_inverse=True
        )
        order = np.argsort(first)
        cells[kind], new[kind] = nodes[first[order]], np.argsort(order)[number.ravel()]
    return file._replace(
        cells=cells,
        cell_sets={
            dim: {
                name: {kind: np.unique(new[kind][rows]) for kind, rows in of.items()}
                for name, of in sets.items()
            }
            for dim, sets in file.cell_sets.items()
        },
    )


def named_mesh(file: FileMesh, chosen: Collection[str] = ()) -> NamedMesh:
    """Select bodies and boundaries by name.

    Sets of cells may overlap. The sets in `chosen` become bodies first. Then each other
    set becomes a body, which consists of the cells of the set that belong to no body
    yet; sets without such cells are skipped. A set NAME whose cells are not connected
    by facets becomes the bodies NAME.1, NAME.2, … Boundaries are sets of facets, and
    sets of nodes that contain all corners of a facet on the boundary of the bodies.

    Bodies with common facets form a piece. Nodes are numbered piece by piece and cells
    body by body, as generalised inverses require. Within a body, they keep the order of
    the file, where cells are grouped by kind. Nodes without cells (such as centres of
    arcs) are dropped.

    Raises
    ------
    InputError
        If the file contains no volumes and its nodes are not all at the same z, or if
        it contains no bodies, cells without a name, flat, folded or non-convex cells,
        bodies that share nodes but no facets, or named facets that are not on the
        boundary of the bodies.

    """
    path, points, dim, words = file.path, file.points, file.dim, file.words
    sets = {name: file.table(dim, rows) for name, rows in _bodies(file, chosen)}
    if not sets:
        raise InputError(f"{path}: no {words.body} with cells; expected {words.naming}")
    cells = np.concatenate(list(sets.values()))
    at = points[np.unique(cells)]
    if not (abs(at) < MAX_COORDINATE).all():
        raise InputError(
            f"{path}: coordinates are missing or not below {MAX_COORDINATE:g} in "
            "magnitude; expected nodes with finite coordinates"
        )
    extent = np.ptp(at, axis=0)
    if dim == 2 and (extent[2:] > FLATNESS_TOLERANCE * extent.max()).any():
        raise InputError(
            f"{path}: the nodes are not all at the same z, and there are no volume "
            "cells; expected a plane mesh, or tetrahedra, wedges or hexahedra"
        )
    cells, surfaces, piece = _connected(
        path,
        points[:, :dim],
        oriented(path, points[:, :dim], cells),
        dim,
        {k: len(v) for k, v in sets.items()},
    )
    # piece by piece, and ascending within a body
    bodies = list(surfaces.values())
    order = np.argsort(piece, kind="stable")
    nodes = np.concatenate([np.unique(cells[bodies[b]]) for b in order])
    used = nodes[np.sort(np.unique(nodes, return_index=True)[1])]
    renumbered = np.full(len(points), -1)
    renumbered[used] = np.arange(used.size)
    points = points[used, :dim]
    cells = renumbered[cells]
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
            path, name, renumbered[file.table(dim - 1, rows)], directed, words
        )
        for name, rows in file.cell_sets.get(dim - 1, {}).items()
    }
    spots = {
        name: nodes
        for below in range(dim - 1)
        for name, rows in file.cell_sets.get(below, {}).items()
        for nodes in [renumbered[file.table(below, rows)]]
        if (nodes >= 0).all()
    }
    return NamedMesh(
        points,
        cells,
        surfaces,
        curves={name: at for name, at in covered.items() if len(at)} | facets,
        spots={name: nodes for name, nodes in node_sets.items() if nodes.size}
        | {name: np.unique(nodes) for name, nodes in spots.items()},
        piece=piece,
        words=words,
    )


def _bodies(file: FileMesh, chosen: Collection[str]) -> list[tuple[str, Rows]]:
    """Return the name and the cells of each body, in file order."""
    path, dim, words = file.path, file.dim, file.words
    sets = file.cell_sets.get(dim, {})
    owner = {
        kind: np.full(len(nodes), -1)
        for kind, nodes in file.cells.items()
        if DIMENSION[kind] == dim
    }
    bodies: dict[str, Rows] = {}
    for name in sorted(sets, key=lambda name: name not in chosen):
        free = {kind: rows[owner[kind][rows] < 0] for kind, rows in sets[name].items()}
        count = sum(rows.size - free[kind].size for kind, rows in sets[name].items())
        if name in chosen and count:
            raise InputError(
                f"{path}: {words.body} {name!r} shares {count} cells with another "
                "body; expected bodies without common cells"
            )
        if any(rows.size for rows in free.values()):
            for kind, rows in free.items():
                owner[kind][rows] = len(bodies)
            bodies[name] = free
    if nameless := sum(int((at < 0).sum()) for at in owner.values()):
        raise InputError(
            f"{path}: {nameless} cells without a name; expected a name for each: "
            f"{words.naming}"
        )
    return [(name, bodies[name]) for name in sets if name in bodies]


def _connected(
    path: Path,
    points: NDArray[np.float64],
    cells: Nodes,
    dim: int,
    sizes: Mapping[str, int],
) -> tuple[Nodes, dict[str, Nodes], Nodes]:
    """Split sets of cells into bodies whose cells are connected by common facets.

    cells : (E, c) cells, set by set
    sizes : number of cells of each set

    Returns
    -------
    cells, body by body; numbers of the cells of each body; piece (bodies,) of each body

    Raises
    ------
    InputError
        If more than two cells have a facet in common, or if bodies, or parts of a
        body, have common nodes without a chain of common facets: they could rotate
        about these nodes.

    """
    facet = "edge" if dim == 2 else "face"
    one, other, facets = adjacent_cells(cells, dim)
    again = (np.diff(np.sort(facets, axis=1), axis=0) == 0).all(axis=1)
    if again.any():
        raise InputError(
            f"{path}: more than two cells share the {facet} around "
            f"{place(points[facets[again.argmax()]])}; expected cells that do not "
            "overlap"
        )
    of_set = np.repeat(np.arange(len(sizes)), list(sizes.values()))
    inside = of_set[one] == of_set[other]
    body = _components(one[inside], other[inside], len(cells))
    order = np.lexsort((body, of_set))  # a body is in one set
    parts = np.split(order, np.flatnonzero(np.diff(body[order])) + 1)
    sets, surfaces, first = list(sizes), dict[str, Nodes](), 0
    of_part = [sets[of_set[part[0]]] for part in parts]
    several, seen = Counter(of_part), Counter[str]()
    for k, (name, part) in enumerate(zip(of_part, parts, strict=True)):
        seen[name] += 1
        full = f"{name}.{seen[name]}" if several[name] > 1 else name
        if full != name and full in sizes:
            raise InputError(
                f"{path}: {name!r} consists of {several[name]} separate parts, and "
                f"{full!r} is another set; expected another name for it"
            )
        surfaces[full] = first + np.arange(part.size)
        body[part], first = k, first + part.size
    piece = _components(body[one], body[other], len(parts))
    # pieces at the corners of cells: a node has a single one
    at_node = np.full(len(points), -1)
    at_node[cells] = piece[body][:, None]
    if (hinge := at_node[cells] != piece[body][:, None]).any():
        k, corner = np.argwhere(hinge)[0]
        around = np.unique(body[(cells == cells[k, corner]).any(axis=1)])
        pair = [list(surfaces)[b] for b in around]
        raise InputError(
            f"{path}: bodies {' and '.join(map(repr, pair))} share the node at "
            f"{place(points[cells[k, corner]][None])}, but no "
            f"{facet}; expected separate nodes for each body, or a common {facet}"
        )
    return cells[order], surfaces, piece


def _components(one: Nodes, other: Nodes, count: int) -> Nodes:
    """Return the connected component of each node of a graph, numbered in order."""
    graph = coo_array((np.ones(one.size), (one, other)), shape=(count, count))
    label = connected_components(graph, directed=False)[1]
    first = np.unique(label, return_index=True)[1]
    return np.asarray(np.argsort(np.argsort(first))[label])


def place(corners: NDArray[np.float64]) -> str:
    """Return the centre of points (k, dim) as text, for messages."""
    return "(" + ", ".join(f"{x:.6g}" for x in corners.mean(axis=0)) + ")"


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


def oriented(path: Path | str, points: NDArray[np.float64], cells: Nodes) -> Nodes:
    """Return cells (E, c), with the corners of mirrored cells in another order.

    path : start of messages

    Raises
    ------
    InputError
        If a cell is flat, folded or not convex.

    """
    orient = _counter_clockwise if points.shape[1] == 2 else _right_handed
    return orient(path, points, cells)


def _counter_clockwise(
    path: Path | str, points: NDArray[np.float64], cells: Nodes
) -> Nodes:
    """Reorder clockwise cells; raise InputError for flat and non-convex cells."""
    x, triangle = points[cells], is_triangle(cells)[:, None]
    # twice the area of a quadrilateral is the cross product of its diagonals
    twice_area = cross(x[:, 2] - x[:, 0], x[:, 3] - x[:, 1])
    reversed_ = np.where(triangle, cells[:, [1, 0, 2, 3]], cells[:, [0, 3, 2, 1]])
    cells = np.where(twice_area[:, None] < 0, reversed_, cells)
    if (flat := twice_area == 0).any():
        where = place(points[cells[flat.argmax()]])
        raise InputError(
            f"{path}: the cell around {where} has no area; expected "
            "distinct corners, in their order around the cell"
        )
    edges = np.roll(points[cells], -1, axis=1) - points[cells]
    # the boundary of a convex cell turns left at every corner
    corners = cross(np.roll(edges, 1, axis=1), edges)
    if (bad := ((corners <= 0) & ~triangle).any(axis=1)).any():
        where = place(points[cells[bad.argmax()]])
        raise InputError(
            f"{path}: the cell around {where} is not convex; "
            "expected interior angles below 180°"
        )
    return cells


def _right_handed(path: Path | str, points: NDArray[np.float64], cells: Nodes) -> Nodes:
    """Reorder mirrored cells; raise InputError if a Jacobian is not positive."""
    cells = cells.copy()
    for block in cell_blocks(cells, 3):
        element = ELEMENTS[3, block.nodes.shape[1]]
        slopes = np.stack([element.gradients(xi) for xi in element.points])
        J = np.einsum("qar,eax->eqrx", slopes, points[block.nodes])
        det = np.linalg.det(J)
        mirrored = (det < 0).all(axis=1)
        if (bad := ~mirrored & (det <= 0).any(axis=1)).any():
            where = place(points[block.nodes[bad.argmax()]])
            raise InputError(
                f"{path}: the {block.kind} around {where} has no "
                "volume or folds over; expected distinct corners, in gmsh's order"
            )
        nodes = block.nodes[mirrored][:, _MIRRORED[block.kind]]
        if cells.shape[1] != nodes.shape[1]:
            nodes = nodes[:, REPEATED[block.kind]]
        cells[block.cells[mirrored]] = nodes
    return cells


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
            f"{path}: {where} has {facet} that bounds no body in the file (shells and "
            f"beams are not bodies); expected every body to have a name: {words.naming}"
        )
    names = [tuple(sorted(set(facet))) for facet in facets.tolist()]
    if not all(name in boundary for name in names):
        raise InputError(
            f"{path}: {where} has {facet} that bounds no body, or lies within one; "
            f"expected {facet.split()[1]}s of cells on the boundary"
        )
    return np.array([boundary[name] for name in names], dtype=np.int64)
