"""Readers of mesh files, selected by file name extension."""

from __future__ import annotations

from pathlib import Path

from mortarbench.harness import InputError
from mortarbench.problems.fem.mesh_files.gmsh import read_msh_sets
from mortarbench.problems.fem.mesh_files.inp import read_inp
from mortarbench.problems.fem.mesh_files.med import read_med
from mortarbench.problems.fem.mesh_files.named import (
    FileMesh,
    NamedMesh,
    checked_mesh,
    named_mesh,
)

_READERS = {
    ".msh": read_msh_sets,
    ".inp": read_inp,
    ".med": read_med,
}


def read_mesh_file(path: Path) -> FileMesh:
    """Read the cells and sets of a .msh, .inp or .med file.

    Raises
    ------
    InputError
        If the file is damaged, too large or of another format, or contains pyramids or
        cells of higher order.

    """
    if (reader := _READERS.get(path.suffix.lower())) is None:
        raise InputError(
            f"{path}: a mesh of unknown format {path.suffix!r}; expected .msh (gmsh), "
            ".inp (Abaqus, CalculiX) or .med (Salome)"
        )
    return checked_mesh(reader(path))


def read_msh(path: Path) -> NamedMesh:
    """Read the bodies and boundaries of a mesh file by name, see `named_mesh`.

    The file is a .msh file of gmsh with physical groups (format 2.2 or 4.1), an .inp
    file of Abaqus or CalculiX, or a .med file.

    Raises
    ------
    InputError
        If the file or its mesh is invalid, see `read_mesh_file` and `named_mesh`.

    """
    return named_mesh(read_mesh_file(path))
