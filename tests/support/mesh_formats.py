"""Conversion of .msh meshes to other formats: .inp as text, .med by meshio."""

import meshio
import numpy as np

TYPES = {"tetra": "C3D4", "wedge": "C3D6", "hexahedron": "C3D8", "triangle": "S3",
         "quad": "S4", "line": "T2D2"}  # fmt: skip


def named_cells(path):
    """Return the contents of a .msh file.

    Returns
    -------
    points, blocks of cells, and the (block, rows) pairs of each named group
    """
    mesh = meshio.gmsh.read(path)
    dims = {"line": 1, "triangle": 2, "quad": 2}
    names = {(int(tag), int(dim)): name for name, (tag, dim) in mesh.field_data.items()}
    sets = {}
    tags = mesh.cell_data["gmsh:physical"]
    for k, (block, tag) in enumerate(zip(mesh.cells, tags, strict=True)):
        for number in np.unique(tag):
            name = names[int(number), dims.get(block.type, 3)]
            sets.setdefault(name, []).append((k, np.flatnonzero(tag == number)))
    return mesh.points, [(b.type, b.data) for b in mesh.cells], sets


def listed(ids):
    """Return lines of data with at most eight numbers each."""
    parts = [ids[i : i + 8] for i in range(0, len(ids), 8)]
    return "\n".join(", ".join(map(str, part)) for part in parts)


def write_inp(source, path, sides="elements", types=TYPES):
    """Write a file in the style of CalculiX preprocessors, with gaps in the numbering.

    sides : "elements" for sets of facet elements, otherwise sets of nodes
    """
    points, blocks, sets = named_cells(source)
    number = 7 + 3 * np.arange(len(points))
    text = "*HEADING\n a mesh\n** a comment\n*NODE\n" + "".join(
        f"{i}, {', '.join(map(repr, x))}\n"
        for i, x in zip(number.tolist(), points.tolist(), strict=True)
    )
    first, ids = 100, []
    for k, (kind, cells) in enumerate(blocks):
        ids.append(first + 2 * np.arange(len(cells)))
        first += 2 * len(cells) + 5
        is_side = not types[kind].startswith("C")
        if is_side and sides == "nodes":
            continue
        text += f"*ELEMENT, TYPE={types[kind]}, ELSET=block{k}\n"
        for i, cell in zip(ids[-1].tolist(), number[cells].tolist(), strict=True):
            # data lines of elements may be continued
            text += f"{i}, {', '.join(map(str, cell[:3]))},\n"
            text += f"{', '.join(map(str, cell[3:]))}\n" if cell[3:] else ""
    for name, parts in sets.items():
        is_side = not types[blocks[parts[0][0]][0]].startswith("C")
        if is_side and sides == "nodes":
            nodes = np.unique(np.concatenate([blocks[k][1][r].ravel()
                                              for k, r in parts]))  # fmt: skip
            text += f"*NSET, NSET={name}\n{listed(number[nodes].tolist())}\n"
        else:
            of = np.concatenate([ids[k][rows] for k, rows in parts])
            text += f"*ELSET, ELSET={name}\n{listed(of.tolist())}\n"
    path.write_text(text + "*STEP\n*STATIC\n*END STEP\n")


def write_med(source, path):
    """Write a MED file with meshio; cells with the same names form a family."""
    points, blocks, sets = named_cells(source)
    kinds = list(dict.fromkeys(kind for kind, _ in blocks))
    of_kind = {kind: [k for k, (other, _) in enumerate(blocks) if other == kind]
               for kind in kinds}  # fmt: skip
    names = [[[] for _ in cells] for _, cells in blocks]
    for name, parts in sets.items():
        for k, rows in parts:
            for row in rows:
                names[k][row].append(name)
    families = {}
    tags = [
        np.array([-families.setdefault(tuple(n), len(families) + 1) if n else 0
                  for k in of_kind[kind] for n in names[k]])
        for kind in kinds
    ]  # fmt: skip
    mesh = meshio.Mesh(
        points,
        [(kind, np.concatenate([blocks[k][1] for k in of_kind[kind]]))
         for kind in kinds],
        cell_data={"cell_tags": tags},
    )  # fmt: skip
    mesh.cell_tags = {-number: list(n) for n, number in families.items()}
    mesh.point_tags = {}
    meshio.med.write(path, mesh)


#: two instances of a part with a surface, one of them moved and turned
INSTANCES = """\
*PART, NAME=square
*NODE
1, 0, 0
2, 1, 0
3, 2, 0
4, 0, 2
5, 1, 2
6, 2, 2
*ELEMENT, TYPE=CPS4, ELSET=cells
1, 1, 2, 5, 4
2, 2, 3, 6, 5
*NSET, NSET=low
1, 2, 3
*ELSET, ELSET=all, GENERATE
1, 2, 1
*SURFACE, NAME=high
all, S3
*SURFACE, NAME=bottom
cells, S1
*END PART
*ASSEMBLY, NAME=a
*INSTANCE, NAME=lower, PART=square
*END INSTANCE
*INSTANCE, NAME=upper, PART=square
2.0, 4.0
2.0, 4.0, 0.0, 2.0, 4.0, 1.0, 180.0
*END INSTANCE
*NSET, NSET=axis, INSTANCE=lower
1, 4
*NSET, NSET=axis, INSTANCE=upper
3, 6
*SURFACE, NAME=foot
upper.cells, S3
*SURFACE, NAME=table
lower.all, S3
*SURFACE, NAME=top
upper.cells, S1
*SURFACE, NAME=base
lower.cells, S1
*END ASSEMBLY
"""
