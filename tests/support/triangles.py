"""Meshes of triangles, from meshes of quadrilaterals."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from mortarbench.problems.contact.bodies import Bodies, assemble
from mortarbench.problems.fem.mesh import Mesh


def halved(mesh: Mesh) -> Mesh:
    """Divide every quadrilateral into two triangles, along alternating diagonals."""
    a, b, c, d = mesh.cells.T
    even = np.arange(len(mesh.cells)) % 2 == 0
    first = np.where(even, [a, b, c, c], [a, b, d, d])
    second = np.where(even, [a, c, d, d], [b, c, d, d])
    cells = np.stack([first.T, second.T], axis=1).reshape(-1, 4)
    return Mesh(mesh.points, cells, mesh.boundaries)


def of_triangles(bodies: Bodies, which: NDArray[np.bool_]) -> Bodies:
    """Assemble the bodies again, with triangles in the bodies selected by `which`."""
    parts, owner = [], []
    for b in range(len(bodies.names)):
        cells = bodies.mesh.cells[bodies.body == b]
        if which[b]:
            cells = halved(Mesh(bodies.mesh.points, cells, {})).cells
        parts.append(cells)
        owner.append(np.full(len(cells), b))
    return assemble(
        Mesh(bodies.mesh.points, np.concatenate(parts), bodies.mesh.boundaries),
        np.concatenate(owner), names=bodies.names, materials=bodies.materials,
        plane=bodies.plane, units=(bodies.length, bodies.force),
        fixed=bodies.fixed, load=bodies.f * bodies.force,
        pairs=bodies.pairs,
    )  # fmt: skip
