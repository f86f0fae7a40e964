"""Reader of Abaqus and CalculiX input files (.inp) without parts and instances.

The keywords *NODE, *ELEMENT, *NSET, *ELSET and *SURFACE define the mesh. Any other
keyword is an error if it would change the mesh, and is skipped otherwise. meshio's
reader is not used, because it drops *SURFACE, all but the last *NODE block and plane
strain elements, assigns the sets that *ELEMENT defines to the wrong block of cells, and
opens any file named by *INCLUDE.

Reference: G. Dhondt, CalculiX CrunchiX USER'S MANUAL, sections on *ELEMENT and *DLOAD
(numbers of element faces).
"""

from __future__ import annotations

import re
from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from mortarbench.harness import InputError
from mortarbench.harness.errors import shortened, unknown
from mortarbench.harness.files.datafile import content, parsing
from mortarbench.harness.mechanics import KINDS
from mortarbench.problems.fem.mesh import Nodes
from mortarbench.problems.fem.mesh_files.named import (
    CORNERS,
    DIMENSION,
    FileMesh,
    Words,
)

#: bound on the memory of the parser and on the total size of all sets, as a multiple of
#: the file size
_PARSER_FACTOR = 32
_WORDS = Words(
    body="element set",
    boundary="surface, element set or node set",
    point="node set",
    naming="*ELEMENT, ELSET=NAME or *ELSET, ELSET=NAME",
    linear="C3D4, C3D6, C3D8, or CPE3, CPE4 in the plane; choose linear (first order) "
    "elements in the program that wrote the file, in gmsh -order 1",
)
#: mapping from the letters of an element type, which precede its number of nodes, to
#: its dimension
_FAMILIES = {
    "C3D": 3,
    "DC3D": 3,
    "CPE": 2,
    "CPS": 2,
    "CPEG": 2,
    "S": 2,
    "STRI": 2,
    "M": 2,
    "M3D": 2,
    "SFM3D": 2,
    "R3D": 2,
    "T2D": 1,
    "T3D": 1,
    "R2D": 1,
}
_TYPE = re.compile(r"([A-Z]+(?:[23]D)?)(\d+)[A-Z]*\d?")
#: corners of the faces S1, S2, … of the cells of each kind, counted from 0
_FACES: Mapping[str, Sequence[Sequence[int]]] = {
    "triangle": ((0, 1), (1, 2), (2, 0)),
    "quad": ((0, 1), (1, 2), (2, 3), (3, 0)),
    "tetra": ((0, 1, 2), (0, 3, 1), (1, 3, 2), (2, 3, 0)),
    "wedge": ((0, 1, 2), (3, 4, 5), (0, 1, 4, 3), (1, 2, 5, 4), (2, 0, 3, 5)),
    "hexahedron": (
        (0, 1, 2, 3), (4, 7, 6, 5), (0, 4, 5, 1), (1, 5, 6, 2), (2, 6, 7, 3),
        (3, 7, 4, 0),
    ),
}  # fmt: skip
_FLAT = "expected a file of *NODE, *ELEMENT, *NSET, *ELSET and *SURFACE alone"
#: mapping from a rejected keyword, which would change the mesh, to the remedy in the
#: message
_REFUSED = {
    "INCLUDE": "other files are not opened; expected all data in this file",
    "PART": f"{_FLAT}: in Abaqus/CAE, Model, Edit Attributes, Do not use parts and "
    "assemblies in input files",
    "INSTANCE": _FLAT,
    "SYSTEM": _FLAT,
    "NGEN": _FLAT,
    "NFILL": _FLAT,
    "NCOPY": _FLAT,
    "NMAP": _FLAT,
    "ELGEN": _FLAT,
    "ELCOPY": _FLAT,
}


class _Section(NamedTuple):
    """A keyword with its parameters and data lines."""

    keyword: str
    params: Mapping[str, str]
    lines: list[str]

    @property
    def fields(self) -> list[str]:
        """All non-empty fields of the data lines."""
        fields = (field.strip() for line in self.lines for field in line.split(","))
        return [field for field in fields if field]


class _Sets:
    """Named sets of node or element numbers; names are case-insensitive."""

    def __init__(self, numbers: Nodes, limit: int) -> None:
        self.numbers = numbers  #: (k,) all node or element numbers in the file, sorted
        self._limit = limit  #: number of members that may still be added
        self._members: dict[str, tuple[str, Nodes]] = {}

    def extend(self, name: str, members: Nodes) -> None:
        """Add members to the set `name`; create the set if it does not exist."""
        name, before = self._members.get(name.upper(), (name, _NONE))
        members = np.unique(np.append(before, members))
        self._limit -= members.size
        if self._limit < 0:  # nested sets could grow exponentially
            raise InputError(
                "the sets have too many members in total; expected fewer or smaller "
                "sets"
            )
        self._members[name.upper()] = name, members

    def resolve(self, fields: Iterable[str], where: str) -> Nodes:
        """Return the members listed as numbers or as names of other sets."""
        fields, numbers = list(fields), np.zeros(0, dtype=np.int64)
        names = [field for field in fields if not field.isdecimal()]
        if len(names) < len(fields):
            numbers = np.array([int(v) for v in fields if v.isdecimal()])
        if (bad := ~np.isin(numbers, self.numbers)).any():
            raise InputError(
                f"{where} contains {numbers[bad][0]}, which is not in the file; "
                "expected numbers of nodes or elements in the file"
            )
        for name in names:
            if name.upper() not in self._members:
                raise unknown("set", name, self.by_name(), where=where)
        others = [self._members[name.upper()][1] for name in names]
        return np.concatenate([numbers, *others])

    def generate(self, section: _Section) -> Nodes:
        """Return the members of the ranges "first, last[, step]" of a section."""
        parts = [_NONE]
        for line in section.lines:
            first, last, *step = (int(v) for v in line.split(",") if v.strip())
            k = self.numbers[(self.numbers >= first) & (self.numbers <= last)]
            parts.append(k[(k - first) % (step[0] if step else 1) == 0])
        return np.concatenate(parts)

    def read(self, sections: Sequence[_Section], keyword: str) -> None:
        """Add the sets defined by sections with `keyword`."""
        for section in sections:
            if section.keyword == keyword:
                name = _name(section, keyword)
                is_range = "GENERATE" in section.params
                self.extend(
                    name,
                    self.generate(section)
                    if is_range
                    else self.resolve(section.fields, f"set {shortened(name)!r}"),
                )

    def by_name(self) -> dict[str, Nodes]:
        """Return the sorted members of all sets by name."""
        return dict(self._members.values())


class _Elements(NamedTuple):
    """All elements of a file, with one table of cells for each kind of cell."""

    #: table of corners for each kind, as indices into the nodes
    cells: Mapping[str, Nodes]
    number: Nodes  #: (k,) element numbers, sorted
    kind: NDArray[np.str_]  #: (k,) kind of each element
    row: Nodes  #: (k,) row of each element in the table of its kind

    def rows(self, members: Nodes) -> dict[str, Nodes]:
        """Return the rows of element numbers `members` in the tables, by kind."""
        at = np.searchsorted(self.number, members)
        kinds = self.kind[at]
        return {str(k): np.sort(self.row[at[kinds == k]]) for k in np.unique(kinds)}


_NONE = np.zeros(0, dtype=np.int64)


def read_inp(path: Path) -> FileMesh:
    """Read the nodes, elements, sets and surfaces of an .inp file.

    The facets of a surface of elements become a named set of cells.

    Raises
    ------
    InputError
        If the file is damaged, refers to other files, has keywords that generate nodes
        or elements, or contains elements other than linear solids, shells and trusses.

    """
    text = content(path, "an .inp file", copies=_PARSER_FACTOR)
    limit = _PARSER_FACTOR * len(text)
    with parsing(path, "not an .inp file of Abaqus or CalculiX, or damaged", limit):
        try:
            return _mesh(path, list(_sections(text.decode("latin-1"))), limit)
        except InputError as e:
            raise InputError(f"{path}: {e}") from None


def _sections(text: str) -> Iterator[_Section]:
    """Split a file at its keywords and drop comments."""
    section, is_continued = _Section("", {}, []), False
    for line in text.split("\n"):
        if line.startswith("**") or not line.strip():
            continue
        if not line.startswith("*") and not is_continued:
            section.lines.append(line)
            continue
        pairs = line.split(",")
        if not is_continued:
            yield section
            keyword = pairs.pop(0)[1:].strip().upper()
            section = _Section(keyword, {}, [])
        params = {
            key.strip().upper(): value.strip().strip('"')
            for key, _, value in (pair.partition("=") for pair in pairs)
        }
        section = section._replace(params={**section.params, **params})
        is_continued = line.rstrip().endswith(",")
    yield section


def _mesh(path: Path, sections: Sequence[_Section], limit: int) -> FileMesh:
    """Return the mesh that the sections of a file define."""
    for section in sections:
        keyword = "INCLUDE" if "INPUT" in section.params else section.keyword
        if keyword in _REFUSED:
            raise InputError(f"*{section.keyword}: {_REFUSED[keyword]}")
    number, points, node_sets = _nodes(sections, limit)
    elements, element_sets = _elements(sections, number, limit)
    node_sets.read(sections, "NSET")
    element_sets.read(sections, "ELSET")
    kinds = list(elements.cells)
    tables: dict[str, list[Nodes]] = {k: [elements.cells[k]] for k in kinds}
    chosen: dict[tuple[int, str], dict[str, Nodes]] = defaultdict(dict)
    for name, members in element_sets.by_name().items():
        for kind, rows in elements.rows(members).items():
            chosen[DIMENSION[kind], name][kind] = rows
    for name, facets in _surfaces(sections, elements, element_sets, node_sets).items():
        for kind, corners in facets.items():
            before = sum(map(len, tables.setdefault(kind, [])))
            tables[kind].append(np.concatenate(corners))
            rows = before + np.arange(len(tables[kind][-1]))
            chosen[DIMENSION[kind], name][kind] = rows
    cell_sets: dict[int, dict[str, list[Nodes]]] = defaultdict(dict)
    for (dim, name), rows_by_kind in chosen.items():
        cell_sets[dim][name] = [rows_by_kind.get(kind, _NONE) for kind in tables]
    return FileMesh(
        path=path,
        points=points,
        blocks=[(kind, np.concatenate(parts)) for kind, parts in tables.items()],
        cell_sets=cell_sets,
        node_sets={
            name: np.searchsorted(number, members)
            for name, members in node_sets.by_name().items()
        },
        vocabulary={2: _WORDS, 3: _WORDS},
    )


def _nodes(
    sections: Sequence[_Section], limit: int
) -> tuple[Nodes, NDArray[np.float64], _Sets]:
    """Return the sorted numbers of all nodes, their coordinates, and their sets."""
    tables, names = [], []
    for section in sections:
        if section.keyword == "NODE" and section.lines:
            columns = sum(1 for field in section.lines[0].split(",") if field.strip())
            table = np.array([float(field) for field in section.fields])
            tables.append(table.reshape(-1, columns))
            names.append(section.params.get("NSET", ""))
    if not tables:
        raise InputError("no nodes; expected *NODE and *ELEMENT")
    nodes = np.concatenate(tables)
    number = nodes[:, 0].astype(np.int64)
    order = np.argsort(number)
    sets = _Sets(_distinct(number, "node"), limit)
    for table, name in zip(tables, names, strict=True):
        if name:
            sets.extend(name, table[:, 0].astype(np.int64))
    return number[order], nodes[order, 1:], sets


def _elements(
    sections: Sequence[_Section], nodes: Nodes, limit: int
) -> tuple[_Elements, _Sets]:
    """Return all elements, and the element sets that *ELEMENT defines."""
    tables: dict[str, list[Nodes]] = {}
    named = []
    for section in sections:
        if section.keyword != "ELEMENT":
            continue
        kind = _kind(section.params.get("TYPE", ""))
        table = np.array([int(field) for field in section.fields], dtype=np.int64)
        table = table.reshape(-1, 1 + CORNERS[kind])
        tables.setdefault(kind, []).append(table)
        if name := section.params.get("ELSET", ""):
            named.append((name, table[:, 0]))
    if not tables:
        raise InputError("no elements; expected *NODE and *ELEMENT")
    cells, numbers = {}, {}
    for kind, parts in tables.items():
        table = np.concatenate(parts)
        corners = table[:, 1:]
        if (bad := ~np.isin(corners, nodes)).any():
            raise InputError(
                f"element {table[bad.any(axis=1), 0][0]} refers to node "
                f"{corners[bad][0]}, which is not in the file; define it under *NODE"
            )
        cells[kind], numbers[kind] = np.searchsorted(nodes, corners), table[:, 0]
    number = np.concatenate(list(numbers.values()))
    order = np.argsort(number)
    sets = _Sets(_distinct(number, "element"), limit)
    for name, members in named:
        sets.extend(name, members)
    sizes = [n.size for n in numbers.values()]
    return _Elements(
        cells=cells,
        number=number[order],
        kind=np.repeat(list(cells), sizes)[order],
        row=np.concatenate([np.arange(size) for size in sizes])[order],
    ), sets


def _kind(name: str) -> str:
    """Return meshio's name for the cells of an element type."""
    match = _TYPE.fullmatch(name.upper())
    dim = _FAMILIES.get(match[1], -1) if match else -1
    kind = KINDS.get((dim, int(match[2]) if match else 0))
    if kind is None:
        raise InputError(
            f"elements of type {shortened(name)}; expected elements of first order: "
            f"{_WORDS.linear}"
        )
    return kind


def _surfaces(
    sections: Sequence[_Section],
    elements: _Elements,
    element_sets: _Sets,
    node_sets: _Sets,
) -> dict[str, dict[str, list[Nodes]]]:
    """Return the facets of surfaces of elements, by name of the surface and kind.

    Surfaces of nodes are added to `node_sets` instead.
    """
    surfaces: dict[str, dict[str, list[Nodes]]] = {}
    for section in sections:
        if section.keyword != "SURFACE":
            continue
        name = _name(section, "NAME")
        where = f"surface {shortened(name)!r}"
        if section.params.get("TYPE", "ELEMENT").upper() == "NODE":
            sets = [line.partition(",")[0].strip() for line in section.lines]
            node_sets.extend(name, node_sets.resolve(sets, where))
            continue
        facets = surfaces.setdefault(name, {})
        for line in section.lines:
            of, _, label = (field.strip(" ,\r") for field in line.partition(","))
            members = element_sets.resolve([of], where)
            for kind, rows in elements.rows(members).items():
                faces = {
                    f"S{i}": face for i, face in enumerate(_FACES.get(kind, ()), 1)
                }
                if label.upper() not in faces:
                    raise unknown(f"face of a {kind}", label, faces, where=where)
                face = list(faces[label.upper()])
                facet = KINDS[DIMENSION[kind] - 1, len(face)]
                corners = elements.cells[kind][rows][:, face]
                facets.setdefault(facet, []).append(corners)
    return surfaces


def _name(section: _Section, key: str) -> str:
    if not section.params.get(key, ""):
        raise InputError(f"*{section.keyword} without a name; expected {key}=NAME")
    return section.params[key]


def _distinct(numbers: Nodes, what: str) -> Nodes:
    """Check that no number occurs twice, and return the sorted numbers."""
    distinct, counts = np.unique(numbers, return_counts=True)
    if (counts > 1).any():
        raise InputError(
            f"{what} {distinct[counts.argmax()]} is defined {counts.max()} times; "
            "expected every number once"
        )
    return distinct
