"""Deformed states for ParaView: a single .vtu file, or a .pvd series of .vtu files.

Every .vtu is accompanied by a CSV along each contact of the state.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from xml.sax.saxutils import quoteattr

import meshio
import numpy as np
from numpy.typing import NDArray

from mortarbench.harness import ContactSide, Fields, InputError, Vector
from mortarbench.harness.files.csvfile import csv_text
from mortarbench.harness.files.durable import replacing
from mortarbench.harness.plugin import SLIDING

#: a node is in contact if its force exceeds this fraction of the largest nodal force
#: or, with friction, if it sticks or slips
IN_CONTACT = 1e-6
#: friction states; VTU files store the index of a state
STATES = ("open", "stick", "slip", SLIDING)
#: States by increasing priority, for nodes on several contact sides.
_BY_WEIGHT = ("open", SLIDING, "stick", "slip")


def write_vtu(fields: Fields, path: Path) -> list[Path]:
    """Write a deformed state in SI units; return the .vtu and a CSV for each contact.

    The point data are displacement (m), contact_force (force of the contact on a slave
    node, N/m in 2D, N in 3D), in_contact (0 or 1), pressure (Pa), gap (m) and
    the nodal fields. Forces and pressures are zero except on slave nodes. Except on
    slave nodes that face a master, the gap is NaN, which ParaView leaves out. The cell
    data are the body and, for decomposed bodies, the subdomain; triangles come before
    quadrilaterals. Plane vectors get a zero third component, because *Warp By Vector*
    in ParaView needs three components.

    Raises
    ------
    InputError
        If a file cannot be written.

    """
    nodes = len(fields.points)
    forces = np.zeros_like(fields.displacement, dtype=float)
    if fields.contact_nodes is not None and fields.contact_forces is not None:
        forces[fields.contact_nodes] = fields.contact_forces
    sizes = np.linalg.norm(forces, axis=1)
    least = IN_CONTACT * float(sizes.max(initial=0.0))
    touching = np.zeros(nodes, dtype=bool) if fields.contacts else sizes > least
    for side in fields.contacts:
        touching[side.nodes] |= side.pressed(least)
    of_cells = {"body": fields.bodies}
    if fields.subdomains is not None:
        of_cells["subdomain"] = fields.subdomains
    blocks = fields.blocks
    mesh = meshio.Mesh(
        _in_space(fields.points),
        [(block.kind, block.nodes) for block in blocks],
        point_data={
            "displacement": _in_space(fields.displacement),
            "contact_force": _in_space(forces),
            "in_contact": touching.astype(np.int32),
            **_along_sides(fields.contacts, nodes),
            **fields.nodal,
        },
        cell_data={
            name: [np.asarray(v).astype(np.int32)[block.cells] for block in blocks]
            for name, v in of_cells.items()
        },
    )
    with _named(path):
        mesh.write(path, file_format="vtu")
    return [path, *(_write_side(fields, side, path) for side in fields.contacts)]


@contextmanager
def _named(path: Path) -> Iterator[None]:
    """Raise InputError with the name of the file if writing fails."""
    try:
        yield
    except OSError as e:
        raise InputError(f"{path}: cannot be written: {e.strerror}") from None


def _along_sides(sides: Sequence[ContactSide], nodes: int) -> dict[str, Vector]:
    """Return the nodal fields (N,) of all contact sides: pressure, gap, friction.

    At nodes of several sides, the pressure is the largest and the gap is the smallest.
    With friction, the fields include the shear traction and the index of the state in
    `STATES`.
    """
    if not sides:
        return {}
    pressure, gap, shear = np.zeros(nodes), np.full(nodes, np.nan), np.zeros(nodes)
    weight = np.zeros(nodes, dtype=np.int64)
    for side in sides:
        np.maximum.at(pressure, side.nodes, side.pressure)
        np.fmin.at(gap, side.nodes, side.gap)
        if side.friction is not None:
            assert side.shear is not None
            shear[side.nodes] += side.shear
            states = [str(s) or "open" for s in side.friction]
            np.maximum.at(weight, side.nodes, [_BY_WEIGHT.index(s) for s in states])
    nodal = {"pressure": pressure, "gap": gap}
    if any(side.friction is not None for side in sides):
        state = np.array([float(STATES.index(name)) for name in _BY_WEIGHT])[weight]
        nodal |= {"shear": shear, "friction": state}
    return nodal


def _write_side(fields: Fields, side: ContactSide, vtu: Path) -> Path:
    """Write a CSV of one contact, with a row per node of the slave side.

    In 2D, nodes are in the order of the side, and the first column is the arc length
    along the side; in 3D, node numbers are ascending.
    """
    # names of pairs come from users: keep letters, digits and underscores
    name = "-".join(re.findall(r"\w+", side.name)) or "contact"
    path = vtu.with_name(f"{vtu.stem}-{name}.csv")
    points = fields.points[side.nodes]
    u, axes = fields.displacement[side.nodes], "xyz"[: fields.dim]
    extent, unit = ("length_m", "N_per_m") if fields.dim < 3 else ("area_m2", "N")
    columns = {
        "along_m": _arc_length(points) if fields.dim < 3 else None,
        **{f"{axis}_m": points[:, k] for k, axis in enumerate(axes)},
        **{f"u{axis}_m": u[:, k] for k, axis in enumerate(axes)},
        extent: side.length,
        **{f"force_{axis}_{unit}": side.force[:, k] for k, axis in enumerate(axes)},
        "pressure_Pa": side.pressure,
        "gap_m": side.gap,
        "shear_Pa": side.shear,
        "friction": side.friction,
    }
    present = {head: v.tolist() for head, v in columns.items() if v is not None}
    rows = zip(*(map(_without_nan, v) for v in present.values()), strict=True)
    with _named(path), replacing(path) as file:
        file.write(csv_text([*present], rows).encode())
    return path


def _arc_length(points: NDArray[np.float64]) -> Vector:
    """Return the arc length (s,) from the first point of a chain to each point, m."""
    steps = np.linalg.norm(np.diff(points, axis=0), axis=1)
    return np.append(0.0, np.cumsum(steps))


def _without_nan(value: float | str) -> float | str | None:
    """Replace NaN by None."""
    return None if value != value else value


def write_series(states: Iterable[tuple[float, Fields]], path: Path) -> list[Path]:
    """Write states with their times as a .pvd file, and the .vtu files beside it.

    Return the files written; the first is the .pvd, to be opened in ParaView.

    Raises
    ------
    InputError
        If a file cannot be written.

    """
    written, lines = [], []
    for i, (time, fields) in enumerate(states):
        vtu = path.with_name(f"{path.stem}_{i:04d}.vtu")
        written.extend(write_vtu(fields, vtu))
        lines.append(f'    <DataSet timestep="{time!r}" file={quoteattr(vtu.name)}/>')
    text = "\n".join(
        [
            '<?xml version="1.0"?>',
            '<VTKFile type="Collection" version="0.1">',
            "  <Collection>",
            *lines,
            "  </Collection>",
            "</VTKFile>",
            "",
        ]
    )
    with _named(path), replacing(path) as file:
        file.write(text.encode())
    return [path, *written]


def _in_space(vectors: NDArray[np.float64]) -> NDArray[np.float64]:
    """Pad vectors (N, dim) with zeros to three components."""
    return np.pad(vectors, ((0, 0), (0, 3 - vectors.shape[1])))
