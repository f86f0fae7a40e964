"""Reader of Abaqus and CalculiX input files (.inp).

The keywords *NODE, *ELEMENT, *NSET, *ELSET, *SURFACE, *PART and *INSTANCE define the
mesh. Any other keyword is an error if it would change the mesh, and is skipped
otherwise. meshio's reader is not used, because it drops *SURFACE, all but the last
*NODE block and plane strain elements, assigns the sets that *ELEMENT defines to the
wrong block of cells, and opens any file named by *INCLUDE.

An instance repeats the nodes, elements, sets and surfaces of its part, whose names are
INSTANCE.NAME outside the instance. All its elements form the element set INSTANCE.

References: G. Dhondt, CalculiX CrunchiX USER'S MANUAL, sections on *ELEMENT and *DLOAD
(numbers of element faces); Dassault Systèmes, Abaqus Keywords Guide, *INSTANCE.
"""

from __future__ import annotations

import re
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

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
    **dict.fromkeys(("C3D", "DC3D"), 3),
    **dict.fromkeys(("CPE", "CPS", "CPEG", "S", "STRI", "M", "M3D", "SFM3D", "R3D"), 2),
    **dict.fromkeys(("T2D", "T3D", "R2D"), 1),
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
#: mapping from a rejected keyword, which would change the mesh, to the remedy in the
#: message
_REFUSED = {
    "INCLUDE": "other files are not opened; expected all data in this file",
    **dict.fromkeys(
        ("SYSTEM", "NGEN", "NFILL", "NCOPY", "NMAP", "ELGEN", "ELCOPY"),
        "it generates or moves nodes or elements; expected *NODE and *ELEMENT with all "
        "of them",
    ),
}
#: numbers of nodes and elements of instance k = 1, 2, … are increased by k times this
#: value, which exceeds the numbers that Abaqus accepts
_STRIDE = 10**9


class _Scope(NamedTuple):
    """The whole model, or an instance of a part."""

    number: int = 0  #: 0 for the model; instances count from 1
    prefix: str = ""  #: prefix of names that the scope defines
    #: motion of points (k, 3) from the part to the instance
    move: Callable[[NDArray[np.float64]], NDArray[np.float64]] = lambda points: points

    @property
    def offset(self) -> int:
        """Increase of numbers."""
        return self.number * _STRIDE


class _Section(NamedTuple):
    """A keyword with its parameters and data lines."""

    line: int  #: number of the line of the keyword, from 1
    keyword: str
    params: Mapping[str, str]
    lines: list[tuple[int, list[str]]]  #: line numbers and fields
    scope: _Scope = _Scope()

    def name(self, key: str) -> str:
        """Return the name that the parameter `key` defines."""
        if not self.params.get(key, ""):
            raise InputError(
                f"line {self.line}: *{self.keyword} without a name; expected {key}=NAME"
            )
        return self.scope.prefix + self.params[key]


_EXPONENT = str.maketrans("dD", "ee")  #: letters before exponents in Fortran


def _numbers(
    line: int, fields: Sequence[str], kind: Callable[[str], float] = float
) -> list[Any]:
    """Return numbers, whose exponents may be written with D as in Fortran."""
    numbers = []
    for field in fields:
        try:
            numbers.append(kind(field.translate(_EXPONENT)))
        except ValueError:
            what = "an integer" if kind is int else "a number"
            raise InputError(
                f"line {line}: {shortened(field)!r}; expected {what}"
            ) from None
    return numbers


class _Sets:
    """Named sets of node or element numbers; names are case-insensitive."""

    def __init__(self, numbers: Nodes, scopes: Sequence[_Scope], limit: int) -> None:
        self.numbers = numbers  #: (k,) all node or element numbers in the file, sorted
        self._scopes = {scope.prefix.upper(): scope for scope in scopes}
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

    def scope_of(self, section: _Section) -> _Scope:
        """Return the scope of the members of a section, which may name an instance."""
        if not (name := section.params.get("INSTANCE", "")):
            return section.scope
        if (scope := self._scopes.get(f"{name.upper()}.")) is None:
            known = (scope.prefix[:-1] for scope in self._scopes.values())
            raise unknown("instance", name, known, where=f"line {section.line}")
        return scope

    def resolve(self, fields: Iterable[str], where: str, section: _Section) -> Nodes:
        """Return the members listed as numbers or as names of other sets.

        Outside instances, INSTANCE.5 is a number of that instance.
        """
        scope, numbers, others = self.scope_of(section), list[int](), [_NONE]
        where = f"line {section.line}: {where}"
        for field in fields:
            prefix, _, number = field.rpartition(".")
            within = self._scopes.get(f"{prefix.upper()}.") if prefix else scope
            names = [f"{scope.prefix}{field}".upper(), field.upper()]
            if number.isdecimal() and within is not None:
                numbers.append(int(number) + within.offset)
            elif found := [name for name in names if name in self._members]:
                others.append(self._members[found[0]][1])
            else:
                raise unknown("set", field, self.by_name(), where)
        members = np.array(numbers, dtype=np.int64)
        if (bad := ~np.isin(members, self.numbers)).any():
            raise InputError(
                f"{where} contains {members[bad][0] % _STRIDE}, which is not in the "
                "file; expected numbers of nodes or elements in the file"
            )
        return np.concatenate([members, *others])

    def members(self, section: _Section, where: str) -> Nodes:
        """Return the members that the data lines of a section list."""
        if "GENERATE" not in section.params:
            fields = (field for _, line in section.lines for field in line if field)
            return self.resolve(fields, where, section)
        parts, offset = [_NONE], self.scope_of(section).offset
        for line, fields_of_line in section.lines:
            values = _numbers(line, list(filter(None, fields_of_line)), int)
            if len(values) not in (2, 3) or min(values[2:], default=1) < 1:
                raise InputError(f"line {line}: {where}; expected first, last, step")
            first, last = (value + offset for value in values[:2])
            k = self.numbers[(self.numbers >= first) & (self.numbers <= last)]
            parts.append(k[(k - first) % (*values, 1)[2] == 0])
        return np.concatenate(parts)

    def read(self, sections: Sequence[_Section], keyword: str) -> None:
        """Add the sets defined by sections with `keyword`."""
        for section in sections:
            if section.keyword == keyword and not (
                keyword == "NSET" and "ELSET" in section.params
            ):
                name = section.name(keyword)
                members = self.members(section, f"set {shortened(name)!r}")
                self.extend(name, members)

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
    """Read the nodes, elements, sets, surfaces and instances of an .inp file.

    The facets of a surface of elements become a named set of cells.

    Raises
    ------
    InputError
        If the file is damaged, refers to other files, has keywords that generate nodes
        or elements, or contains elements other than linear solids, shells and trusses.
        The message states the line, where possible.

    """
    text = content(path, "an .inp file", copies=_PARSER_FACTOR)
    limit = _PARSER_FACTOR * len(text)
    with parsing(path, "not an .inp file of Abaqus or CalculiX, or damaged", limit):
        try:
            return _mesh(path, _instances(_sections(text.decode("latin-1"))), limit)
        except InputError as e:
            raise InputError(f"{path}: {e}") from None


def _sections(text: str) -> Iterator[_Section]:
    """Split a file at its keywords and drop comments."""
    section, is_continued = _Section(0, "", {}, []), False
    for number, line in enumerate(text.split("\n"), 1):
        if line.startswith("**") or not line.strip():
            continue
        if not line.startswith("*") and not is_continued:
            section.lines.append((number, [f.strip() for f in line.split(",")]))
            continue
        pairs = line.split(",")
        if not is_continued:
            yield section
            keyword = " ".join(pairs.pop(0)[1:].upper().split())
            section = _Section(number, keyword, {}, [])
        params = {
            key.strip().upper(): value.strip().strip('"')
            for key, _, value in (pair.partition("=") for pair in pairs)
        }
        section = section._replace(params={**section.params, **params})
        is_continued = line.rstrip().endswith(",")
    yield section


def _instances(sections: Iterable[_Section]) -> list[_Section]:
    """Replace each instance by the sections of its part, in the scope of the instance.

    Raises
    ------
    InputError
        If a keyword would change the mesh, or a part is unknown.

    """
    model, parts, count = list[_Section](), dict[str, list[_Section]](), 0
    target, scope = model, _Scope()
    for section in sections:
        keyword = "INCLUDE" if "INPUT" in section.params else section.keyword
        is_rotated = keyword == "NODE" and section.params.get("SYSTEM", "R") != "R"
        if keyword in _REFUSED or is_rotated:
            raise InputError(
                f"line {section.line}: *{section.keyword}: "
                f"{_REFUSED['SYSTEM' if is_rotated else keyword]}"
            )
        if keyword == "PART":
            target = parts[section.name("NAME").upper()] = []
        elif keyword == "INSTANCE":
            count += 1
            part = section.params.get("PART", "")
            if part.upper() not in parts:
                raise unknown("part", part, parts, where=f"line {section.line}")
            prefix = f"{section.name('NAME')}."
            scope, target = _Scope(count, prefix, _motion(section)), model
            model += [one._replace(scope=scope) for one in parts[part.upper()]]
        elif keyword in ("END PART", "END INSTANCE"):
            target, scope = model, _Scope()
        else:
            target.append(section._replace(scope=scope))
    if parts and not count:
        raise InputError("*PART without *INSTANCE; expected an instance of each part")
    return model


def _motion(
    section: _Section,
) -> Callable[[NDArray[np.float64]], NDArray[np.float64]]:
    """Return the motion of an instance: a translation, then a rotation.

    The second data line contains two points of the axis, and the angle in degrees.
    """
    numbers = [
        _numbers(line, list(filter(None, fields))) for line, fields in section.lines
    ]
    if [len(row) for row in numbers] not in ([], [2], [3], [2, 7], [3, 7]):
        raise InputError(
            f"line {section.line}: *INSTANCE; expected a line with a translation, and "
            "a line with two points of an axis and an angle"
        )
    shift, turn = numbers + [[0.0] * 3, [0.0] * 7][len(numbers) :]
    return partial(_moved, shift, turn)


def _moved(
    shift: list[float], turn: list[float], points: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Translate points (k, 3), then rotate them about an axis (Rodrigues' formula)."""
    points = points + (*shift, 0.0)[:3]
    start, axis = np.array(turn[:3]), np.subtract(turn[3:6], turn[:3])
    if not (size := float(np.linalg.norm(axis))) or not turn[6]:
        return np.asarray(points)
    k, x, angle = axis / size, points - start, np.deg2rad(turn[6])
    along = np.outer(x @ k, k)
    across = (x - along) * np.cos(angle) + np.cross(k, x) * np.sin(angle)
    return np.asarray(start + along + across)


def _mesh(path: Path, sections: Sequence[_Section], limit: int) -> FileMesh:
    """Return the mesh that the sections of a file define."""
    scopes = list(
        {section.scope.number: section.scope for section in sections}.values()
    )
    number, points, node_sets = _nodes(sections, scopes, limit)
    elements, element_sets = _elements(sections, number, scopes, limit)
    element_sets.read(sections, "ELSET")
    for scope in scopes:
        if scope.number:
            members = elements.number[elements.number // _STRIDE == scope.number]
            element_sets.extend(scope.prefix[:-1], members)
    corners = {
        kind: number[elements.cells[kind]] for kind in elements.cells
    }  # numbers of the nodes
    for section in sections:
        if section.keyword == "NSET" and "ELSET" in section.params:
            rows = elements.rows(
                element_sets.resolve(
                    [section.params["ELSET"]],
                    f"set {shortened(section.name('NSET'))!r}",
                    section,
                )
            )
            nodes = [corners[kind][k].ravel() for kind, k in rows.items()]
            node_sets.extend(section.name("NSET"), np.concatenate([_NONE, *nodes]))
    node_sets.read(sections, "NSET")
    tables = {kind: [cells] for kind, cells in elements.cells.items()}
    sets: dict[int, dict[str, dict[str, Nodes]]] = defaultdict(
        lambda: defaultdict(dict)
    )
    for name, members in element_sets.by_name().items():
        for kind, rows_of_kind in elements.rows(members).items():
            sets[DIMENSION[kind]][name][kind] = rows_of_kind
    for name, facets in _surfaces(sections, elements, element_sets, node_sets).items():
        for kind, parts in facets.items():
            before = sum(map(len, tables.setdefault(kind, [])))
            tables[kind].append(np.concatenate(parts))
            rows_of_kind = before + np.arange(len(tables[kind][-1]))
            sets[DIMENSION[kind]][name][kind] = rows_of_kind
    return FileMesh(
        path=path,
        points=points,
        cells={kind: np.concatenate(parts) for kind, parts in tables.items()},
        cell_sets=sets,
        node_sets={
            name: np.searchsorted(number, members)
            for name, members in node_sets.by_name().items()
        },
        vocabulary={2: _WORDS, 3: _WORDS},
    )


def _nodes(
    sections: Sequence[_Section], scopes: Sequence[_Scope], limit: int
) -> tuple[Nodes, NDArray[np.float64], _Sets]:
    """Return the sorted numbers of all nodes, their coordinates, and their sets.

    Missing coordinates are zero.
    """
    numbers, tables, named = [_NONE], [np.zeros((0, 3))], []
    for section in sections:
        if section.keyword != "NODE":
            continue
        number, table = list[int](), list[list[float]]()
        for line, fields in section.lines:
            number += _numbers(line, fields[:1], int)
            x = _numbers(line, [field or "0" for field in fields[1:4]])
            table.append(x + [0.0] * (3 - len(x)))
        at = np.array(number, dtype=np.int64) + section.scope.offset
        numbers.append(at)
        tables.append(section.scope.move(np.reshape(table, (-1, 3))))
        if section.params.get("NSET", ""):
            named.append((section.name("NSET"), at))
    number_ = np.concatenate(numbers)
    if not number_.size:
        raise InputError("no nodes; expected *NODE and *ELEMENT")
    order = np.argsort(number_)
    sets = _Sets(_distinct(number_, "node"), scopes, limit)
    for name, at in named:
        sets.extend(name, at)
    return number_[order], np.concatenate(tables)[order], sets


def _elements(
    sections: Sequence[_Section],
    nodes: Nodes,
    scopes: Sequence[_Scope],
    limit: int,
) -> tuple[_Elements, _Sets]:
    """Return all elements, and the element sets that *ELEMENT defines."""
    tables: dict[str, list[Nodes]] = {}
    named, flat = [], []
    for section in sections:
        if section.keyword != "ELEMENT":
            continue
        kind = _kind(section.params.get("TYPE", ""), section.line)
        table = _table(section, kind)
        if (bad := ~np.isin(table[:, 1:], nodes)).any():
            k, corner = np.argwhere(bad)[0]
            raise InputError(
                f"element {table[k, 0] % _STRIDE} refers to node "
                f"{table[k, 1 + corner] % _STRIDE}, which is not in the file; define "
                "it under *NODE"
            )
        tables.setdefault(kind, []).append(table)
        flat += [(section, table)] if DIMENSION[kind] < 3 else []
        if section.params.get("ELSET", ""):
            named.append((section.name("ELSET"), table[:, 0]))
    if not tables:
        raise InputError("no elements; expected *NODE and *ELEMENT")
    whole = {kind: np.concatenate(parts) for kind, parts in tables.items()}
    number = np.concatenate([table[:, 0] for table in whole.values()])
    order = np.argsort(number)
    sets = _Sets(_distinct(number, "element"), scopes, limit)
    for name, members in named:
        sets.extend(name, members)
    of_solids = [v[:, 1:].ravel() for k, v in whole.items() if DIMENSION[k] == 3]
    for section, table in flat if of_solids else ():
        if not np.isin(table[:, 1:], np.concatenate(of_solids)).all():
            raise InputError(
                f"line {section.line}: elements of type {section.params['TYPE']} "
                "(shells, membranes or trusses) apart from the solids; expected such "
                "elements on faces of solids only"
            )
    sizes = [len(table) for table in whole.values()]
    return _Elements(
        cells={k: np.searchsorted(nodes, table[:, 1:]) for k, table in whole.items()},
        number=number[order],
        kind=np.repeat(list(whole), sizes)[order],
        row=np.concatenate([np.arange(size) for size in sizes])[order],
    ), sets


def _table(section: _Section, kind: str) -> Nodes:
    """Return the numbers (k, 1 + corners) of elements and of their nodes.

    The data of an element continue on the next line after a comma.
    """
    width, rows, row = 1 + CORNERS[kind], list[list[int]](), list[int]()
    for line, fields in section.lines:
        row += _numbers(line, list(filter(None, fields)), int)
        if len(row) < width and not fields[-1]:
            continue
        if len(row) != width:
            raise InputError(
                f"line {line}: an element with {len(row) - 1} nodes; "
                f"{section.params['TYPE']} has {width - 1}"
            )
        rows.append(row)
        row = []
    if row:
        raise InputError(f"line {section.line}: the last element has too few nodes")
    return np.array(rows, dtype=np.int64).reshape(-1, width) + section.scope.offset


def _kind(name: str, line: int) -> str:
    """Return meshio's name for the cells of an element type."""
    upper = name.upper()
    match = _TYPE.fullmatch(upper)
    dim = _FAMILIES.get(match[1], -1) if match else -1
    kind = KINDS.get((dim, int(match[2]) if match else 0))
    if kind is None:
        raise InputError(
            f"line {line}: elements of type {shortened(name)}; expected elements of "
            f"first order: {_WORDS.linear}"
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
        name = section.name("NAME")
        where = f"surface {shortened(name)!r}"
        is_nodal = section.params.get("TYPE", "ELEMENT").upper() == "NODE"
        of_set = node_sets if is_nodal else element_sets
        for line, (of, *labels) in section.lines:
            members = of_set.resolve([of], where, section)
            if is_nodal:
                node_sets.extend(name, members)
                continue
            facets, label = surfaces.setdefault(name, {}), (*labels, "")[0]
            for kind, rows in elements.rows(members).items():
                faces = {
                    f"S{i}": face for i, face in enumerate(_FACES.get(kind, ()), 1)
                }
                if label.upper() not in faces:
                    raise unknown(
                        f"face of a {kind}", label, faces, f"line {line}: {where}"
                    )
                face = list(faces[label.upper()])
                facet = KINDS[DIMENSION[kind] - 1, len(face)]
                corners = elements.cells[kind][rows][:, face]
                facets.setdefault(facet, []).append(corners)
    return surfaces


def _distinct(numbers: Nodes, what: str) -> Nodes:
    """Check that no number occurs twice, and return the sorted numbers."""
    distinct, counts = np.unique(numbers, return_counts=True)
    if (counts > 1).any():
        raise InputError(
            f"{what} {distinct[counts.argmax()] % _STRIDE} is defined "
            f"{counts.max()} times; expected every number once"
        )
    return distinct
