"""Reader of MED files (.med, in HDF5) of Salome, gmsh and code_aster.

The reader uses these groups and datasets::

    ENS_MAA/MESH[/STEP]/NOE/COO         x of all nodes, then y, then z
    ENS_MAA/MESH[/STEP]/MAI/TYPE/NOD    first corners of all cells, second corners, …
    …/FAM                               family of each node or cell; 0: no family
    FAS/MESH/(NOEUD|ELEME)/FAMILY       attribute NUM, GRO/NOM: groups of the family

meshio's reader is not used, because it fails if cells of some kind have no families
(such as edges in Salome's files), reads results in addition to the mesh, and follows
links to other files.

Reference: EDF, CEA, Open Cascade, MED-file 4.1, https://docs.salome-platform.org.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mortarbench.harness import InputError
from mortarbench.problems.fem.mesh import Nodes
from mortarbench.problems.fem.mesh_files.hdf5 import opened_hdf5
from mortarbench.problems.fem.mesh_files.named import DIMENSION, FileMesh, Words

_KINDS = {
    "PO1": "vertex",
    "SE2": "line",
    "TR3": "triangle",
    "QU4": "quad",
    "TE4": "tetra",
    "PE6": "wedge",
    "HE8": "hexahedron",
    "PY5": "pyramid",
    "SE3": "line3",
    "TR6": "triangle6",
    "TR7": "triangle7",
    "QU8": "quad8",
    "QU9": "quad9",
    "T10": "tetra10",
    "P15": "wedge15",
    "H20": "hexahedron20",
    "H27": "hexahedron27",
}
_LINEAR = "in Salome, Modification, Convert to/from quadratic; in gmsh, -order 1"
_WORDS = {
    2: Words(
        "group of faces",
        "group of edges",
        "group of nodes",
        "a group of its faces",
        _LINEAR,
    ),
    3: Words(
        "group of volumes",
        "group of faces",
        "group of nodes or edges",
        "a group of its volumes",
        _LINEAR,
    ),
}
#: bound on the memory of the tables derived from an array, as a multiple of its size
_PARSER_FACTOR = 8


def read_med(path: Path) -> FileMesh:
    """Read the nodes, cells and groups of the mesh in a .med file.

    Raises
    ------
    InputError
        If the file is damaged or too large, contains several meshes or time steps, or
        refers to other files.

    """
    with opened_hdf5(path, "a .med file", _PARSER_FACTOR) as nodes:
        return _mesh(path, nodes)


def _mesh(path: Path, nodes: Mapping[str, Any]) -> FileMesh:
    names = [k.split("/")[1] for k in nodes if k.count("/") == 1 and k[:7] == "ENS_MAA"]
    grids = [k[: -len("/NOE/COO")] for k in nodes if k.endswith("/NOE/COO")]
    if len(names) != 1 or len(grids) != 1:
        raise InputError(
            f"{path}: {len(names)} meshes with {len(grids)} time steps; expected one "
            "mesh with one step"
        )
    (name,), (grid,) = names, grids
    coordinates = np.asarray(nodes[f"{grid}/NOE/COO"][()], dtype=float)
    dim = int(nodes[f"ENS_MAA/{name}"].attrs["ESP"])
    cells, families = dict[str, Nodes](), dict[str, Nodes]()
    for key in [k for k in nodes if k.startswith(f"{grid}/MAI/") and k[-4:] == "/NOD"]:
        numbers = np.asarray(nodes[key][()], dtype=np.int64)
        kind = _KINDS.get(key.split("/")[-2], key.split("/")[-2])
        count = int(nodes[key].attrs["NBR"])
        # transpose, because NOD stores all first corners, then all second corners, …
        cells[kind] = numbers.reshape(-1, count).T - 1
        families[kind] = _families(nodes, key[:-3], count)
    cell_sets: dict[int, dict[str, dict[str, Nodes]]] = {}
    for group, ids in _groups(nodes, f"FAS/{name}/ELEME/").items():
        for kind, family in families.items():
            if (rows := np.flatnonzero(np.isin(family, ids))).size:
                sets = cell_sets.setdefault(DIMENSION.get(kind, -1), {})
                sets.setdefault(group, {})[kind] = rows
    at = _families(nodes, f"{grid}/NOE/", coordinates.size // dim)
    return FileMesh(
        path=path,
        points=coordinates.reshape(dim, -1).T,
        cells=cells,
        cell_sets=cell_sets,
        node_sets={
            group: np.flatnonzero(np.isin(at, ids))
            for group, ids in _groups(nodes, f"FAS/{name}/NOEUD/").items()
        },
        vocabulary=_WORDS,
    )


def _families(nodes: Mapping[str, Any], place: str, count: int) -> NDArray[np.int64]:
    """Return the family (count,) of each node or cell; 0 if there are no families."""
    if f"{place}FAM" not in nodes:
        return np.zeros(count, dtype=np.int64)
    return np.asarray(nodes[f"{place}FAM"][()], dtype=np.int64).reshape(count)


def _groups(nodes: Mapping[str, Any], place: str) -> dict[str, list[int]]:
    """Return the family numbers of each group, by name."""
    groups: dict[str, list[int]] = {}
    for key in nodes:
        if key.startswith(place) and key.endswith("/GRO/NOM"):
            family = int(nodes[key[: -len("/GRO/NOM")]].attrs["NUM"])
            for letters in np.asarray(nodes[key][()]):
                text = bytes(np.asarray(letters, dtype=np.uint8)).decode()
                groups.setdefault(text.split("\0")[0].strip(), []).append(family)
    return groups
