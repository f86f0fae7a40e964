"""Reader of gmsh's .msh files with physical names."""

from __future__ import annotations

import os
from contextlib import redirect_stderr
from io import StringIO
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mortarbench.harness import InputError
from mortarbench.harness.files.datafile import check_size, opened, parsing
from mortarbench.problems.fem.mesh import Nodes
from mortarbench.problems.fem.mesh_files.named import (
    DIMENSION,
    FileMesh,
    Words,
)

#: memory required by meshio's parser, as a multiple of the size of the file
_PARSER_FACTOR = 32
_LINEAR = "Mesh.ElementOrder = 1 in the .geo file, or gmsh -{} -order 1"
_NAMING = 'Physical {}("NAME") in the .geo file'
_WORDS = {
    2: Words(
        "physical surface",
        "physical curve",
        "physical point",
        _NAMING.format("Surface"),
        _LINEAR.format(2),
    ),
    3: Words(
        "physical volume",
        "physical surface",
        "physical point or curve",
        _NAMING.format("Volume"),
        _LINEAR.format(3),
    ),
}
_SAVED = "only physical groups: Mesh.SaveAll = 0"


def read_msh_sets(path: Path) -> FileMesh:
    """Read the cells and physical groups of a .msh file, format 2.2 or 4.1.

    Raises
    ------
    InputError
        If the file cannot be read, contains node numbers below 1, or does not have a
        tag for every cell.

    """
    mesh = _read(path)
    blocks = [(block.type, np.asarray(block.data)) for block in mesh.cells]
    tags = mesh.cell_data.get("gmsh:physical", [np.zeros(len(n)) for _, n in blocks])
    cell_sets: dict[int, dict[str, list[Nodes]]] = {}
    for k, ((kind, _), tag) in enumerate(zip(blocks, tags, strict=True)):
        dim = DIMENSION.get(kind, -1)
        names = {
            int(number): name
            for name, (number, dimension) in mesh.field_data.items()
            if dimension == dim
        }
        for number in np.unique(tag):
            if (name := names.get(int(number))) is not None:
                rows = cell_sets.setdefault(dim, {}).setdefault(
                    name, [np.zeros(0, dtype=np.int64) for _ in blocks]
                )
                rows[k] = np.flatnonzero(tag == number)
    # in a file with named groups, cells with tag 0 show that the file was saved with
    # Mesh.SaveAll = 1; without this option, gmsh omits entities without a physical
    # group if any group exists
    is_all = mesh.field_data and any((tag == 0).any() for tag in tags)
    more = f"; or, if they belong to no body, save {_SAVED}" if is_all else ""
    return FileMesh(
        path=path,
        points=np.asarray(mesh.points, dtype=float),
        blocks=blocks,
        cell_sets=cell_sets,
        node_sets={},
        vocabulary={
            dim: words._replace(naming=words.naming + more)
            for dim, words in _WORDS.items()
        },
    )


def _read(path: Path) -> Any:
    if path.suffix.lower() == ".geo":
        raise InputError(
            f"{path}: a drawing, not a mesh; generate a mesh first: "
            f"gmsh -2 {path.name} writes {path.with_suffix('.msh').name}"
        )
    with opened(path, "a .msh file") as file:
        size = os.fstat(file.fileno()).st_size
    check_size(f"{path}: its content", _PARSER_FACTOR * size)
    with parsing(path, "not a .msh file of format 2.2 or 4.1", _PARSER_FACTOR * size):
        with redirect_stderr(StringIO()):  # meshio warns about sections that it skips
            mesh = _parse(path)
        cells = [np.asarray(block.data) for block in mesh.cells]
        tags = mesh.cell_data.get("gmsh:physical", [])
        numbers = _numbers(path.read_bytes())
        tagged = [len(tag) for tag in tags] == [len(nodes) for nodes in cells]
    # node numbers start at 1; meshio would interpret −1 as an index from the end
    if numbers is not None and (numbers < 1).any():
        raise InputError(f"{path}: cells with node numbers below 1; expected 1 or more")
    if tags and not tagged:
        raise InputError(f"{path}: not every cell has a tag; expected a tag for each")
    return mesh


def _parse(path: Path) -> Any:
    """Parse a file with meshio, admitting entities without a physical group.

    With Mesh.SaveAll = 1, gmsh also writes the cells of such entities. In format 2.2,
    these cells have tag 0. In format 4.1, these cells have no tag, and meshio fails; in
    this case, tag 0 is inserted into a copy of the text.
    """
    import meshio  # imported here, because workers and other families do not need it

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
        # the number of physical tags follows the tag of the entity and the position of
        # a point (3 numbers) or the bounding box of other entities (6 numbers)
        at = 4 if i < points else 7
        if fields[at] == b"0":
            fields[at : at + 1] = [b"1", b"0"]
    text = b"\n".join([b"", *(b" ".join(fields) for fields in lines), b""])
    with TemporaryDirectory() as folder:
        copy = Path(folder) / path.name
        copy.write_bytes(head + start + text + end + rest)
        return meshio.gmsh.read(copy)


def _numbers(data: bytes) -> NDArray[np.int64] | None:
    """Return the node numbers in the cells of a text file; None for a binary file."""
    head, _, rest = data.partition(b"$Elements")
    version, kind, _ = head.split(b"$MeshFormat")[1].split(maxsplit=3)[:3]
    if kind != b"0":
        return None
    # skip the end of the section's title and the line with the counts
    lines = rest.partition(b"$EndElements")[0].split(b"\n")[2:]
    numbers: list[int] = []
    remaining = 0  # number of remaining cells of the current block, in format 4
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
