"""Deformed states for ParaView: one .vtu file, or a .pvd series of them."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from xml.sax.saxutils import quoteattr

import meshio
import numpy as np
from numpy.typing import NDArray

from harness import Fields, InputError, Vector
from harness.files.durable import replacing

IN_CONTACT = 1e-6  #: a node is in contact where its force exceeds this · the largest


def write_vtu(fields: Fields, path: Path) -> None:
    """Write a deformed state, SI units; points and vectors get a third component 0.

    Point data: displacement (m), contact_force (N/m, on slave nodes, else 0),
    in_contact (0 or 1) and the nodal fields; cell data: body. Triangles come before
    quadrilaterals. *Warp By Vector* in ParaView takes vectors of three components only.

    Raises
    ------
    InputError
        When the file cannot be written.

    """
    forces = np.zeros_like(fields.displacement, dtype=float)
    if fields.contact_nodes is not None and fields.contact_forces is not None:
        forces[fields.contact_nodes] = fields.contact_forces
    sizes = np.linalg.norm(forces, axis=1)
    touching = sizes > IN_CONTACT * sizes.max(initial=0.0)
    cells, bodies = np.asarray(fields.cells), np.asarray(fields.bodies).astype(np.int32)
    triangle = cells[:, 2] == cells[:, 3]
    blocks = [
        (kind, which, corners)
        for kind, which, corners in (("triangle", triangle, 3), ("quad", ~triangle, 4))
        if which.any()
    ]
    mesh = meshio.Mesh(
        _padded(fields.points),
        [(kind, cells[which, :corners]) for kind, which, corners in blocks],
        point_data={
            "displacement": _padded(fields.displacement),
            "contact_force": _padded(forces),
            "in_contact": touching.astype(np.int32),
            **fields.nodal,
        },
        cell_data={"body": [bodies[which] for _, which, _ in blocks]},
    )
    try:
        mesh.write(path, file_format="vtu")
    except OSError as e:
        raise InputError(f"{path}: cannot be written: {e.strerror}") from None


def write_series(states: Iterable[tuple[float, Fields]], path: Path) -> list[Path]:
    """Write states and their times as path.pvd and, next to it, one .vtu for each.

    Returns the files written, the .pvd first; ParaView opens that one.

    Raises
    ------
    InputError
        When a file cannot be written.

    """
    written, lines = [], []
    for i, (time, fields) in enumerate(states):
        vtu = path.with_name(f"{path.stem}_{i:04d}.vtu")
        write_vtu(fields, vtu)
        written.append(vtu)
        lines.append(f'    <DataSet timestep="{time!r}" file={quoteattr(vtu.name)}/>')
    text = "\n".join([
        '<?xml version="1.0"?>', '<VTKFile type="Collection" version="0.1">',
        "  <Collection>", *lines, "  </Collection>", "</VTKFile>", "",
    ])  # fmt: skip
    try:
        with replacing(path) as file:
            file.write(text.encode())
    except OSError as e:
        raise InputError(f"{path}: cannot be written: {e.strerror}") from None
    return [path, *written]


def _padded(vectors: NDArray[np.float64] | Vector) -> NDArray[np.float64]:
    """Append a third component 0 to (N, 2)."""
    return np.column_stack([vectors, np.zeros(len(vectors))])
