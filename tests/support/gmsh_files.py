"""Mesh files in the format of gmsh, written without gmsh."""

import struct

import numpy as np


def msh22(points, quads, curves, spots, quad_type=3):
    """Return a file in the ASCII format 2.2, with points, lines and quadrilaterals.

    The element types of gmsh are 15 (point), 1 (line) and 3 (quadrilateral).
    """
    groups, rows, tag = [], [], 0
    for dimension, kind, named in (
        (0, 15, spots),
        (1, 1, curves),
        (2, quad_type, quads),
    ):
        for name, cells in named.items():
            tag += 1
            groups += [f'{dimension} {tag} "{name}"'] if name else []
            for cell in cells:
                nodes = " ".join(str(n + 1) for n in cell)
                rows.append(f"{len(rows) + 1} {kind} 2 {tag} {tag} {nodes}")
    return text22(points, groups, rows)


def text22(points, groups, rows):
    """Return the text of a file with physical names, nodes (N, 3) and cells."""
    nodes = [f"{i} {x!r} {y!r} {z!r}" for i, (x, y, z) in enumerate(points.tolist(), 1)]
    blocks = {"PhysicalNames": groups, "Nodes": nodes, "Elements": rows}
    text = "$MeshFormat\n2.2 0 8\n$EndMeshFormat\n"
    for name, lines in blocks.items():
        text += "\n".join([f"${name}", str(len(lines)), *lines, f"$End{name}", ""])
    return text


#: element types of gmsh for cells and faces, by the number of corners
_SOLIDS, _FACES = {4: 4, 6: 6, 8: 5}, {3: 2, 4: 3}


def solids22(points, bodies, faces):
    """Return the text of a gmsh file (ASCII, 2.2) of solids with boundary faces."""
    groups, rows, tag = [], [], 0
    for dimension, kinds, named in ((3, _SOLIDS, bodies), (2, _FACES, faces)):
        for name, cells in named.items():
            tag += 1
            groups.append(f'{dimension} {tag} "{name}"')
            for cell in cells:
                nodes = " ".join(str(n + 1) for n in dict.fromkeys(cell))
                kind = kinds[len(set(cell))]
                rows.append(f"{len(rows) + 1} {kind} 2 {tag} {tag} {nodes}")
    return text22(points, groups, rows)


def square(n=2, at=(0.0, 0.0)):
    x, y = np.meshgrid(np.arange(n + 1.0), np.arange(n + 1.0))
    points = np.column_stack([x.ravel() + at[0], y.ravel() + at[1], 0 * x.ravel()])
    i = np.arange((n + 1) ** 2).reshape(n + 1, n + 1)
    cells = np.stack([i[:-1, :-1], i[:-1, 1:], i[1:, 1:], i[1:, :-1]], axis=-1)
    return points, cells.reshape(-1, 4)


BLOCKS = """\
mesh = "blocks.msh"
steps = 1
plane = "stress"
[[bodies]]
name = "lower"
E = 1e9
nu = 0
[[bodies]]
name = "upper"
E = 1e9
nu = 0
[[supports]]
boundary = "base"
fix = ["y"]
[[supports]]
boundary = "axis"
fix = ["x"]
[[loads]]
boundary = "top"
traction = [0, -1e6]
[[contacts]]
slave = "foot"
master = "table"
"""


def stacked_mesh(gap=0.0, sag=0.0, **sides):
    """Return a mesh of two squares of side 2, one above the other.

    sag : depth of the middle of the upper square's lower side below its two ends
    sides : names and edges of further boundaries
    """
    (lower, cells), (upper, _) = square(), square(at=(0.0, 2.0 + gap))
    upper[1, 1] -= sag
    named = {
        "base": [[0, 1], [1, 2]], "table": [[6, 7], [7, 8]],
        "foot": [[9, 10], [10, 11]], "top": [[15, 16], [16, 17]],
        "axis": [[0, 3], [3, 6], [9, 12], [12, 15]],
    }  # fmt: skip
    bodies = {"lower": cells, "upper": cells + 9}
    curves = {name: np.array(edges) for name, edges in (named | sides).items()}
    return msh22(np.vstack([lower, upper]), bodies, curves, {})


def stacked_blocks(folder, gap=0.0, toml=BLOCKS, sag=0.0):
    """Write a `stacked_mesh` and its description; return the path of the description.

    Poisson's ratio is zero, so that squares pressed together are in uniaxial stress.
    """
    (folder / "blocks.msh").write_text(stacked_mesh(gap, sag))
    path = folder / "blocks.toml"
    path.write_text(toml)
    return path


def entities41(points, entities, binary=False):
    """Return a file in format 4.1, as text or binary data.

    entities : (dimension, element type, cells, names of the physical groups) of each
        entity; cells number the nodes from 0
    """
    order = np.argsort([dim for dim, *_ in entities], kind="stable")
    entities = [entities[k] for k in order]
    names = list(dict.fromkeys((e[0], name) for e in entities for name in e[3]))
    number = {name: i + 1 for i, name in enumerate(names)}
    parts = {"Entities": [], "Nodes": [], "Elements": []}

    def add(section, kind, *values):
        """Append numbers of one type: i, Q (size) or d."""
        if binary:
            data = struct.pack(f"<{len(values)}{kind}", *values)
        else:
            data = " ".join(f"{v!r}" for v in values).encode()
        parts[section].append(data)

    add("Entities", "Q", *(sum(e[0] == dim for e in entities) for dim in range(4)))
    for tag, (dim, _, _, groups) in enumerate(entities, 1):
        add("Entities", "i", tag)
        add("Entities", "d", *[0.0] * (6 if dim else 3))
        add("Entities", "Q", len(groups))
        if groups:
            add("Entities", "i", *(number[dim, name] for name in groups))
        if dim:
            add("Entities", "Q", 0)
    N, E = len(points), sum(len(e[2]) for e in entities)
    add("Nodes", "Q", 1, N, 1, N)
    add("Nodes", "i", entities[-1][0], len(entities), 0)
    add("Nodes", "Q", N)
    add("Nodes", "Q", *range(1, N + 1))
    add("Nodes", "d", *np.ravel(points).tolist())
    add("Elements", "Q", len(entities), E, 1, E)
    first = 1
    for tag, (dim, kind, cells, _) in enumerate(entities, 1):
        add("Elements", "i", dim, tag, kind)
        add("Elements", "Q", len(cells))
        for cell in cells:
            add("Elements", "Q", first, *(int(node) + 1 for node in cell))
            first += 1
    head = b"4.1 1 8\n" + struct.pack("<i", 1) if binary else b"4.1 0 8"
    groups = "\n".join(
        [str(len(names)), *(f'{dim} {number[dim, n]} "{n}"' for dim, n in names)]
    )
    sections = {"MeshFormat": head, "PhysicalNames": groups.encode()} | {
        name: (b"" if binary else b"\n").join(data) for name, data in parts.items()
    }
    return b"".join(
        b"$%s\n%s\n$End%s\n" % (name.encode(), data, name.encode())
        for name, data in sections.items()
    )


#: element types of gmsh by meshio's names of cells
TYPES = {"vertex": 15, "line": 1, "triangle": 2, "quad": 3, "tetra": 4,
         "hexahedron": 5, "wedge": 6}  # fmt: skip


def entities_of(blocks, sets):
    """Return an entity for each set of cells, see `entities41`.

    blocks, sets : see `tests.support.mesh_formats.named_cells`
    """
    dims = {"vertex": 0, "line": 1, "triangle": 2, "quad": 2}
    return [
        (dims.get(blocks[k][0], 3), TYPES[blocks[k][0]], blocks[k][1][rows], [name])
        for name, parts in sets.items()
        for k, rows in parts
    ]
