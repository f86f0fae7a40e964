"""Mesh files in the format of gmsh, written without gmsh."""

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
