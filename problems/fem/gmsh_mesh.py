"""Reader of bodies from gmsh's .msh files with physical names."""

from __future__ import annotations

import os
from collections.abc import Mapping
from contextlib import redirect_stderr
from io import StringIO
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from mortarbench.harness import InputError
from mortarbench.harness.files.datafile import check_size, opened, parsing
from mortarbench.harness.mechanics import KINDS, boundary_facets, cell_blocks
from mortarbench.problems.fem.elements import ELEMENTS, cross
from mortarbench.problems.fem.mesh import REPEATED, Nodes, is_triangle

#: memory of meshio's parser, as a multiple of the size of the file
_PARSER_FACTOR = 32
#: largest deviation from a plane z = const, relative to the extent
FLATNESS_TOLERANCE = 1e-9
#: dimension of each supported kind of cell
DIMENSION = {kind: dim for (dim, _), kind in KINDS.items()}
#: larger coordinates are refused: products of them overflow
MAX_COORDINATE = 1e100
CORNERS = {kind: corners for (_, corners), kind in KINDS.items() if kind in DIMENSION}
#: corners in the order of the mirrored cell, by kind
_MIRRORED = {
    "tetra": [1, 0, 2, 3], "wedge": [3, 4, 5, 0, 1, 2],
    "hexahedron": [4, 5, 6, 7, 0, 1, 2, 3],
}  # fmt: skip
#: name of bodies by dimension, and of their boundaries
BODY, BOUNDARY = {2: "surface", 3: "volume"}, {2: "curve", 3: "surface"}
_SAVED = "only physical groups: Mesh.SaveAll = 0"


class NamedMesh(NamedTuple):
    """A mesh with named parts, in the plane or in space."""

    points: NDArray[np.float64]  #: (N, dim)
    cells: Nodes  #: (E, c) as of a `problems.fem.mesh.Mesh`
    surfaces: Mapping[str, Nodes]  #: cell numbers of each body, in space a volume
    #: edges (k, 2) of each physical curve, with the body on their left; in space, faces
    #: (k, 4) of each physical surface, anticlockwise from outside
    curves: Mapping[str, Nodes]
    spots: Mapping[str, Nodes]  #: nodes of each physical point, in space also curve

    @property
    def dim(self) -> int:
        """Dimension of the bodies."""
        return int(self.points.shape[1])


def read_msh(path: Path) -> NamedMesh:
    """Read the physical groups of a .msh file, format 2.2 or 4.1.

    Bodies are physical volumes of tetrahedra, wedges or hexahedra if the file has such
    cells, else physical surfaces.

    Nodes and cells are numbered body by body, on which generalised inverses rely.
    Within a body, they keep the order of the file, where kinds of cells are in blocks.
    Nodes without cells (such as centres of arcs) are left out.

    Raises
    ------
    InputError
        When the file cannot be read, has surfaces that are not plane but no volumes,
        or contains cells that are not of first order, pyramids, cells without a name,
        bodies that share nodes, or a body of several disconnected parts.

    """
    mesh = _read(path)
    for block in mesh.cells:
        if block.type not in DIMENSION:
            raise InputError(f"{path}: cells of type {block.type}; {_remedy(block)}")
    points = np.asarray(mesh.points, dtype=float)
    dim = _dimension(mesh)
    extent = np.ptp(points, axis=0).max(initial=0.0)
    is_flat = points.shape[1] < 3 or (
        np.ptp(points[:, 2]) <= FLATNESS_TOLERANCE * extent
    )
    if dim == 2 and not is_flat:
        raise InputError(
            f"{path}: not plane, and without cells in space; expected all nodes at the "
            "same z, or volumes meshed by gmsh -3"
        )
    parts = _named(path, mesh, dim)
    if not parts:
        raise InputError(
            f"{path}: no named {BODY[dim]} with cells; expected {_group(dim)}"
        )
    used = _unique_in_order([np.unique(part) for part in parts.values()])
    renumbered = np.full(len(points), -1)
    renumbered[used] = np.arange(used.size)
    points = points[used, :dim]
    cells = renumbered[np.concatenate(list(parts.values()))]
    cells = (_counter_clockwise if dim == 2 else _right_handed)(path, points, cells)
    ends = np.cumsum([0] + [len(part) for part in parts.values()])
    surfaces = {name: np.arange(ends[i], ends[i + 1]) for i, name in enumerate(parts)}
    _check_apart(path, len(points), cells, surfaces, dim)
    directed = {
        tuple(sorted(set(facet))): facet
        for facet in boundary_facets(cells, dim).tolist()
    }
    return NamedMesh(
        points, cells, surfaces,
        curves={
            name: _directed(path, name, renumbered[facets], directed, dim)
            for name, facets in _named(path, mesh, dim - 1).items()
        },
        spots={
            name: np.unique(renumbered[nodes]) if below else renumbered[nodes].ravel()
            for below in range(dim - 1)
            for name, nodes in _named(path, mesh, below).items()
            if (renumbered[nodes] >= 0).all()
        },
    )  # fmt: skip


def refine(mesh: NamedMesh) -> NamedMesh:
    """Refine a plane mesh: bisect every edge, and divide each cell into four.

    New nodes lie on the straight edges, so that bodies keep their shape. A triangle is
    divided into four similar ones, a quadrilateral about the mean of its corners. Nodes
    remain numbered body by body.
    """
    cells, corners = mesh.cells, mesh.cells.T
    is_quad = ~is_triangle(cells)
    edges = np.stack([cells, np.roll(cells, -1, axis=1)], axis=-1)  # (E, 4, 2)
    ends, middle = np.unique(
        np.sort(edges.reshape(-1, 2), axis=1), axis=0, return_inverse=True
    )
    n = len(mesh.points)
    # the degenerate edge of a triangle has no midpoint but its repeated corner
    is_edge = ends[:, 0] != ends[:, 1]
    number = np.where(is_edge, n + np.cumsum(is_edge) - 1, ends[:, 0])
    m = number[middle].reshape(-1, 4).T
    centre = n + is_edge.sum() + np.cumsum(is_quad) - 1
    points = np.concatenate([
        mesh.points,
        mesh.points[ends[is_edge]].mean(axis=1),
        mesh.points[cells[is_quad]].mean(axis=1),
    ])  # fmt: skip
    children = np.stack([
        np.stack([corners[k], m[k], np.where(is_quad, centre, m[k - 1]), m[k - 1]])
        for k in range(4)
    ], axis=-1)  # fmt: skip
    # a triangle repeats its third corner: one of the two children there is the triangle
    # at this corner, the other the triangle of the midpoints
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
        points[used], renumbered[fine.reshape(-1, 4)],
        {k: (4 * v[:, None] + np.arange(4)).ravel() for k, v in mesh.surfaces.items()},
        {name: cut(curve) for name, curve in mesh.curves.items()},
        {name: renumbered[spot] for name, spot in mesh.spots.items()},
    )  # fmt: skip


def _dimension(mesh: Any) -> int:
    """Return the dimension of the bodies of a file: 3 if it has cells in space."""
    return max([2, *(DIMENSION[block.type] for block in mesh.cells)])


def _remedy(block: Any) -> str:
    """Return the expectation of the message about unsupported cells."""
    orders = [d for kind, d in DIMENSION.items() if block.type.startswith(kind)]
    if dim := max(orders, default=0):
        return (
            "expected cells of first order: Mesh.ElementOrder = 1 in the .geo file, or "
            f"gmsh -{max(dim, 2)} -order 1"
        )
    if block.type.startswith("pyramid"):
        return "expected no pyramids: volumes of tetrahedra alone, gmsh -3"
    return f"expected {', '.join(DIMENSION)}, as meshio calls them"


def _read(path: Path) -> Any:
    if path.suffix.lower() == ".geo":
        raise InputError(
            f"{path}: a drawing, not a mesh; mesh it first: gmsh -2 {path.name} writes "
            f"{path.with_suffix('.msh').name}"
        )
    with opened(path, "a .msh file") as file:
        size = os.fstat(file.fileno()).st_size
    check_size(f"{path}: what it says", _PARSER_FACTOR * size)
    with parsing(path, "not a .msh file of format 2.2 or 4.1", _PARSER_FACTOR * size):
        with redirect_stderr(StringIO()):  # meshio warns about sections that it skips
            mesh = _parse(path)
        points = np.asarray(mesh.points, dtype=float)
        cells = [np.asarray(block.data) for block in mesh.cells]
        tags = mesh.cell_data.get("gmsh:physical", [])
        numbers = _numbers(path.read_bytes())
        tagged = [len(tag) for tag in tags] == [len(nodes) for nodes in cells]
    if (
        points.ndim != 2
        or points.shape[1] < 2
        or not (abs(points) < MAX_COORDINATE).all()
    ):
        raise InputError(
            f"{path}: coordinates are missing or not below {MAX_COORDINATE:g} in "
            "magnitude; expected nodes with finite coordinates"
        )
    # node numbers start at 1; meshio would take −1 as an index from the end
    if numbers is not None and (numbers < 1).any():
        raise InputError(f"{path}: cells with node numbers below 1; expected 1 or more")
    for block, nodes in zip(mesh.cells, cells, strict=True):
        corners = CORNERS.get(block.type, nodes.shape[-1])
        if nodes.ndim != 2 or nodes.shape[1] != corners:
            raise InputError(
                f"{path}: {block.type} cells with {nodes.shape[-1]} nodes; expected "
                f"{corners}"
            )
        # meshio numbers nodes that the file does not define as −1
        if nodes.size and not 0 <= nodes.min() <= nodes.max() < len(points):
            raise InputError(
                f"{path}: cells with nodes that are not in the file; expected nodes "
                "of its section $Nodes"
            )
    if tags and not tagged:
        raise InputError(f"{path}: not every cell has a tag; expected one for each")
    return mesh


def _parse(path: Path) -> Any:
    """Parse a file by meshio, also with entities that are in no physical group.

    With Mesh.SaveAll = 1, gmsh also writes the cells of such entities. Format 2.2 marks
    them with tag 0; format 4.1 has no tag, on which meshio fails. If so, tag 0 is
    inserted into a copy of the text.
    """
    import meshio  # imported here: workers and other families do not need it

    try:
        return meshio.gmsh.read(path)  # meshio.read would print errors and exit
    except ValueError as e:
        if "gmsh:physical" not in str(e):
            raise
    head, start, rest = path.read_bytes().partition(b"$Entities")
    if head.split(b"$MeshFormat")[1].split(maxsplit=2)[1] != b"0":
        raise InputError(
            f"{path}: cells without a physical name in a binary file; expected {_SAVED}"
        )
    entities, end, rest = rest.partition(b"$EndEntities")
    lines = [line.split() for line in entities.split(b"\n") if line.split()]
    points = int(lines[0][0])
    for i, fields in enumerate(lines[1:]):
        # after tag and position or box: the number of physical tags
        at = 4 if i < points else 7
        if fields[at] == b"0":
            fields[at : at + 1] = [b"1", b"0"]
    text = b"\n".join([b"", *(b" ".join(fields) for fields in lines), b""])
    with TemporaryDirectory() as folder:
        copy = Path(folder) / path.name
        copy.write_bytes(head + start + text + end + rest)
        return meshio.gmsh.read(copy)


def _numbers(data: bytes) -> NDArray[np.int64] | None:
    """Return the node numbers in the cells of a text file; None for a binary one."""
    head, _, rest = data.partition(b"$Elements")
    version, kind, _ = head.split(b"$MeshFormat")[1].split(maxsplit=3)[:3]
    if kind != b"0":
        return None
    lines = rest.partition(b"$EndElements")[0].split(b"\n")[2:]  # without the count
    numbers: list[int] = []
    remaining = 0  # cells of the current block, in format 4
    for fields in (list(map(int, line.split())) for line in lines):
        if not fields:
            continue
        if version.startswith(b"2"):
            numbers += fields[3 + fields[2] :]
        elif remaining == 0:
            remaining = fields[3]
        else:
            numbers += fields[1:]
            remaining -= 1
    return np.array(numbers, dtype=np.int64)


def _named(path: Path, mesh: Any, dim: int) -> dict[str, Nodes]:
    """Return the cells of one dimension by physical names, in the file's order.

    Triangles have four columns, as quadrilaterals, and all cells of a mixture in space
    have eight.
    """
    is_mixed = len({b.type for b in mesh.cells if DIMENSION[b.type] == 3}) > 1
    names = {
        int(tag): name
        for name, (tag, dimension) in mesh.field_data.items()
        if dimension == dim
    }
    cells: dict[str, list[Nodes]] = {}
    tags = mesh.cell_data.get("gmsh:physical", [np.zeros(len(b)) for b in mesh.cells])
    nameless: list[int] = []  # physical tags of cells
    for block, tag in zip(mesh.cells, tags, strict=True):
        if DIMENSION[block.type] != dim:
            continue
        for number in np.unique(tag):
            if int(number) in names:
                part = np.asarray(block.data, dtype=np.int64)[tag == number]
                if block.type == "triangle":
                    part = part[:, [0, 1, 2, 2]]
                elif is_mixed and block.type in REPEATED:
                    part = part[:, REPEATED[block.type]]
                cells.setdefault(names[int(number)], []).append(part)
            elif dim == _dimension(mesh):
                nameless += tag[tag == number].tolist()
    if nameless:
        # gmsh omits entities in no physical group, unless there are no groups at all
        is_all = 0 in nameless and mesh.field_data
        more = f"; or, if they are of no body, save {_SAVED}" if is_all else ""
        raise InputError(
            f"{path}: {len(nameless)} cells without a name; expected each in a named "
            f"{BODY[dim]}: {_group(dim)}{more}"
        )
    return {name: np.concatenate(parts) for name, parts in cells.items()}


def _group(dim: int) -> str:
    """Return the line of a .geo file that names a body."""
    return f'Physical {BODY[dim].capitalize()}("NAME") in the .geo file'


def _unique_in_order(parts: list[Nodes]) -> Nodes:
    """Return the distinct nodes of all parts, in the order of first occurrence."""
    nodes = np.concatenate(parts)
    return nodes[np.sort(np.unique(nodes, return_index=True)[1])]


def _counter_clockwise(path: Path, points: NDArray[np.float64], cells: Nodes) -> Nodes:
    """Reorder clockwise cells; raise InputError for flat and non-convex ones."""
    x, triangle = points[cells], is_triangle(cells)[:, None]
    twice_area = cross(
        x[:, 2] - x[:, 0], x[:, 3] - x[:, 1]
    )  # cross product of both diagonals
    reversed_ = np.where(triangle, cells[:, [1, 0, 2, 3]], cells[:, [0, 3, 2, 1]])
    cells = np.where(twice_area[:, None] < 0, reversed_, cells)
    if (flat := twice_area == 0).any():
        x, y = points[cells[flat.argmax()]].mean(axis=0)
        raise InputError(
            f"{path}: the cell around ({x:.6g}, {y:.6g}) has no area; expected "
            "distinct corners, in their order around it"
        )
    edges = np.roll(points[cells], -1, axis=1) - points[cells]
    # at every corner of a convex cell, the boundary bends to the left
    corners = cross(np.roll(edges, 1, axis=1), edges)
    if (bad := ((corners <= 0) & ~triangle).any(axis=1)).any():
        x, y = points[cells[bad.argmax()]].mean(axis=0)
        raise InputError(
            f"{path}: the cell around ({x:.6g}, {y:.6g}) is not convex; "
            "expected corners below 180°"
        )
    return cells


def _right_handed(path: Path, points: NDArray[np.float64], cells: Nodes) -> Nodes:
    """Reorder mirrored cells; raise InputError for cells without volume at a point."""
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
    path: Path, nodes: int, cells: Nodes, surfaces: Mapping[str, Nodes], dim: int
) -> None:
    """Raise InputError for bodies that share nodes, or consist of several parts."""
    owner = np.full(nodes, -1)
    names = list(surfaces)
    for i, name in enumerate(names):
        of_body = np.unique(cells[surfaces[name]])
        if (shared := owner[of_body] >= 0).any():
            other = names[owner[of_body[shared.argmax()]]]
            raise InputError(
                f"{path}: bodies {other!r} and {name!r} share nodes; expected nodes of "
                "its own for each body"
            )
        owner[of_body] = i
    start, end = cells[:, :-1].ravel(), cells[:, 1:].ravel()
    graph = coo_array((np.ones(start.size), (start, end)), shape=(nodes, nodes))
    _, part = connected_components(graph, directed=False)
    for i, name in enumerate(names):
        if (count := np.unique(part[owner == i]).size) > 1:
            raise InputError(
                f"{path}: body {name!r} falls into {count} parts; expected a physical "
                f"{BODY[dim]} for each"
            )


def _directed(
    path: Path, name: str, facets: Nodes, boundary: Mapping[Any, list[int]], dim: int
) -> Nodes:
    """Return the facets of a boundary, directed so that the body is on the left."""
    where, facet = f"{BOUNDARY[dim]} {name!r}", "an edge" if dim == 2 else "a face"
    if (facets < 0).any():
        raise InputError(
            f"{path}: {where} has {facet} that bounds no body in the file: gmsh leaves "
            f"out {BODY[dim]}s without a physical name; expected {_group(dim)}"
        )
    names = [tuple(sorted(set(facet))) for facet in facets.tolist()]
    if not all(name in boundary for name in names):
        raise InputError(
            f"{path}: {where} has {facet} that bounds no body, or lies within one; "
            f"expected {facet.split()[1]}s of cells on the boundary"
        )
    return np.array([boundary[name] for name in names], dtype=np.int64)
