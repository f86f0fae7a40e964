"""Reader of gmsh's .msh files, formats 2 and 4.1, as text or binary data.

In format 4.1, cells belong to entities of the drawing, and an entity may belong to
several physical groups. In format 2, a cell has one physical group; gmsh repeats a cell
for each further group.

Reference: C. Geuzaine, J.-F. Remacle, Gmsh Reference Manual, MSH file formats.
"""

from __future__ import annotations

from collections import defaultdict
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mortarbench.harness import InputError
from mortarbench.harness.files.datafile import content, parsing
from mortarbench.problems.fem.mesh import Nodes
from mortarbench.problems.fem.mesh_files.named import (
    DIMENSION,
    FileMesh,
    Words,
)

#: memory required by the parser, as a multiple of the size of the file
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
#: names and numbers of nodes of gmsh's element types
_TYPES = {
    1: ("line", 2), 2: ("triangle", 3), 3: ("quad", 4), 4: ("tetra", 4),
    5: ("hexahedron", 8), 6: ("wedge", 6), 7: ("pyramid", 5), 8: ("line3", 3),
    9: ("triangle6", 6), 10: ("quad9", 9), 11: ("tetra10", 10),
    12: ("hexahedron27", 27), 13: ("wedge18", 18), 14: ("pyramid14", 14),
    15: ("vertex", 1), 16: ("quad8", 8), 17: ("hexahedron20", 20), 18: ("wedge15", 15),
    19: ("pyramid13", 13),
}  # fmt: skip
#: types of numbers in binary files: integer, number of items, floating-point number
_BYTES = {"i": "<i4", "n": "<u8", "d": "<f8"}


def read_msh_sets(path: Path) -> FileMesh:
    """Read the cells and physical groups of a .msh file, format 2 or 4.1.

    Raises
    ------
    InputError
        If the file cannot be read, has a mesh in partitions, or contains cells with
        nodes that are not in the file.

    """
    data = content(path, "a .msh file", copies=_PARSER_FACTOR)
    room = _PARSER_FACTOR * len(data)
    with parsing(path, "not a .msh file of format 2.2 or 4.1, or damaged", room):
        version, is_binary, size = _section(data, "MeshFormat").split()[:3]
        if version != b"4.1" and not version.startswith(b"2"):
            raise InputError(
                f"{path}: format {version[:9].decode(errors='replace')}; expected 2.2 "
                "or 4.1: Mesh.MshFileVersion = 4.1 in the .geo file"
            )
        if b"$PartitionedEntities" in data:
            raise InputError(f"{path}: a mesh in partitions; expected a whole mesh")
        numbers = _Numbers(data, is_binary == b"1")
        if numbers.is_binary and size != b"8":
            raise InputError(f"{path}: numbers of {size!r} bytes; expected 8")
        return _file_mesh(
            path, data, *(_format_4 if version == b"4.1" else _format_2)(numbers)
        )


def _section(data: bytes, name: str) -> bytes:
    """Return the content of a section; empty if the file has no such section."""
    start = data.find(b"$" + name.encode())
    end = data.find(b"$End" + name.encode(), start)
    return data[data.index(b"\n", start) + 1 : end] if 0 <= start < end else b""


class _Numbers:
    """Numbers of a section, in the order of the file.

    Raises
    ------
    ValueError
        If the section ends before a number that is requested.

    """

    def __init__(self, data: bytes, is_binary: bool) -> None:
        self.is_binary = is_binary
        self._data, self._at = data, 0
        self.values: Any = b""  #: bytes, or numbers of a text file

    def open(self, name: str) -> bool:
        """Go to the start of a section; return False if it is missing or empty."""
        self._at, self.values = 0, _section(self._data, name)
        if not self.is_binary:
            words = self.values.split()
            self.values = np.array(words).astype(float) if words else np.zeros(0)
        return len(self.values) > 0

    def count(self) -> int:
        """Return the number of items of a section, which is text in format 2."""
        if not self.is_binary:
            return int(self.table(1, "i")[0])
        self._at = self.values.index(b"\n") + 1
        return int(self.values[: self._at])

    def table(self, rows: Any, *columns: str) -> Any:
        """Return the columns (rows, width) or (rows,) of a table of numbers.

        columns : types ("i", "n", "d") of the numbers, with their width if not 1
        """
        types = [(c[0], int(c[1:] or 1)) for c in columns]
        if self.is_binary:
            fields = [(f"{k}", _BYTES[t], (w,)) for k, (t, w) in enumerate(types)]
            items = np.frombuffer(self.values, fields, int(rows), self._at)
            self._at += items.nbytes
            parts = [items[name] for name, *_ in fields]
        else:
            width, rows = sum(w for _, w in types), int(rows)
            items = self.values[self._at : self._at + rows * width]
            self._at += rows * width
            ends = np.cumsum([w for _, w in types])[:-1]
            parts = np.split(items.reshape(rows, width), ends, axis=1)
        tables = [
            part if t == "d" else _integers(part)
            for part, (t, _) in zip(parts, types, strict=True)
        ]
        flat = [t[:, 0] if t.shape[1] == 1 else t for t in tables]
        return flat[0] if len(flat) == 1 else flat


def _integers(values: NDArray[Any]) -> Nodes:
    numbers = values.astype(np.int64)
    if (numbers != values).any():
        raise ValueError("not an integer")
    return numbers


#: numbers (N,) and points (N, 3) of nodes; for each block of cells, the name of their
#: type, their nodes (k, corners), and the numbers of their physical groups
_Content = tuple[Nodes, NDArray[np.float64], list[tuple[str, Nodes, list[int]]]]


def _format_2(numbers: _Numbers) -> _Content:
    """Read the nodes and cells of a file of format 2."""
    numbers.open("Nodes")
    node, points = numbers.table(numbers.count(), "i", "d3")
    numbers.open("Elements")
    left, cells = numbers.count(), defaultdict[tuple[str, int], list[Any]](list)
    if not numbers.is_binary:
        values, at = _integers(numbers.values).tolist(), 1
        while at < len(values):
            name, corners = _TYPES[values[at + 1]]
            first = at + 3 + values[at + 2]
            group = values[at + 3] if first > at + 3 else 0
            cells[name, group].append(values[first : first + corners])
            at, left = first + corners, left - 1
        if left or at > len(values):
            raise ValueError("a wrong number of cells")
    while left > 0:
        kind, count, tags = numbers.table(1, "i3")[0].tolist()
        name, corners = _TYPES[kind]
        table = numbers.table(count, f"i{1 + tags + corners}").reshape(count, -1)
        groups = table[:, 1] if tags else np.zeros(count, dtype=np.int64)
        for group in np.unique(groups).tolist():
            cells[name, group].extend(table[groups == group, 1 + tags :].tolist())
        left -= count
    blocks = [
        (name, np.array(of, dtype=np.int64), [group])
        for (name, group), of in cells.items()
    ]
    return node, points, blocks


def _format_4(numbers: _Numbers) -> _Content:
    """Read the nodes, cells and entities of a file of format 4.1."""
    groups: dict[tuple[int, int], list[int]] = {}
    if numbers.open("Entities"):
        for dim, count in enumerate(numbers.table(1, "n4")[0].tolist()):
            for _ in range(count):
                tag, _, physical = numbers.table(1, "i", "d6" if dim else "d3", "n")
                groups[dim, int(tag[0])] = numbers.table(physical[0], "i").tolist()
                if dim:  # the entities that bound it
                    numbers.table(numbers.table(1, "n")[0], "i")
    numbers.open("Nodes")
    node, points = [], []
    for _ in range(numbers.table(1, "n4")[0, 0]):
        (dim, _, parametric), count = (v[0] for v in numbers.table(1, "i3", "n"))
        node.append(numbers.table(count, "n"))
        width = 3 + (dim if parametric else 0)
        points.append(numbers.table(count, f"d{width}")[:, :3])
    numbers.open("Elements")
    blocks = []
    for _ in range(numbers.table(1, "n4")[0, 0]):
        (dim, tag, kind), count = (v[0] for v in numbers.table(1, "i3", "n"))
        name, corners = _TYPES[int(kind)]
        cells = numbers.table(count, f"n{1 + corners}")[:, 1:]
        blocks.append((name, cells, groups.get((int(dim), int(tag)), [])))
    return np.concatenate(node), np.concatenate(points), blocks


def _file_mesh(
    path: Path,
    data: bytes,
    node: Nodes,
    points: NDArray[np.float64],
    blocks: list[tuple[str, Nodes, list[int]]],
) -> FileMesh:
    """Name the sets of cells, and number the nodes from 0."""
    names = {}
    for line in _section(data, "PhysicalNames").splitlines()[1:]:
        *tag, name = line.decode(errors="replace").split(maxsplit=2)
        names[int(tag[0]), int(tag[1])] = name.strip().strip('"')
    tables = defaultdict[str, list[Nodes]](list)
    sets: Any = defaultdict(lambda: defaultdict(lambda: defaultdict(list)))
    for kind, cells, groups in blocks:
        dim, first = DIMENSION.get(kind, -1), sum(map(len, tables[kind]))
        tables[kind].append(cells)
        # a negative number denotes a group of reversed orientation
        for number in {abs(number) for number in groups}:
            if (dim, number) in names:
                rows = first + np.arange(len(cells))
                sets[dim][names[dim, number]][kind].append(rows)
    return FileMesh(
        path=path,
        points=points,
        cells={
            kind: _positions(path, node, np.concatenate(parts))
            for kind, parts in tables.items()
        },
        cell_sets={
            dim: {
                name: {kind: np.concatenate(rows) for kind, rows in of.items()}
                for name, of in named.items()
            }
            for dim, named in sets.items()
        },
        node_sets={},
        vocabulary=_WORDS,
    )


def _positions(path: Path, node: Nodes, cells: Nodes) -> Nodes:
    """Return the indices of node numbers (k, corners) in the list `node` (N,)."""
    order = np.argsort(node, kind="stable")
    if (twice := np.diff(node[order]) == 0).any():
        raise InputError(
            f"{path}: node {node[order][1:][twice][0]} is defined twice; expected "
            "every number once"
        )
    at = np.minimum(np.searchsorted(node[order], cells), node.size - 1)
    if (node[order][at] != cells).any():
        raise InputError(
            f"{path}: cells refer to nodes that are not in the file; define these "
            "nodes or remove the cells"
        )
    return order[at]
