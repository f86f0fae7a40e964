"""Boxes of hexahedra, and division of hexahedra into other cells, for tests."""

import numpy as np

from mortarbench.problems.fem.elements import HEXAHEDRON
from mortarbench.problems.fem.mesh import REPEATED, Mesh

#: Kuhn's six tetrahedra of a hexahedron around the diagonal from corner 0 to corner 6
TETRAHEDRA = np.array([
    [0, 1, 2, 6], [0, 2, 3, 6], [0, 3, 7, 6], [0, 7, 4, 6], [0, 4, 5, 6], [0, 5, 1, 6],
])  # fmt: skip
WEDGES = np.array([[0, 1, 2, 4, 5, 6], [0, 2, 3, 4, 6, 7]])


def bricks(divisions: tuple[int, ...], size: tuple[float, ...]) -> Mesh:
    """Divide a box into equal cells; numbers increase slowest along x."""
    nodes = np.add(divisions, 1)
    i = np.arange(np.prod(nodes)).reshape(nodes)
    ends = [slice(None, -1), slice(1, None)]
    at = (HEXAHEDRON.corners + 1) // 2
    cells = [i[ends[x], ends[y], ends[z]].ravel() for x, y, z in at]
    points = np.array(list(np.ndindex(i.shape))) * np.divide(size, divisions)
    return Mesh(points, np.stack(cells, axis=-1), {})


def bent(mesh: Mesh, amplitude: float = 0.05) -> Mesh:
    """Distort a unit cube smoothly without moving its faces."""
    bump = amplitude * np.prod(np.sin(np.pi * mesh.points), axis=1)
    points = mesh.points + bump[:, None] * [1, 0.7, -0.4]
    return Mesh(points, mesh.cells, mesh.boundaries)


def divided(mesh: Mesh, corners: np.ndarray) -> Mesh:
    """Divide each hexahedron into cells with the given corners (k, c)."""
    cells = mesh.cells[:, corners].reshape(-1, corners.shape[1])
    return Mesh(mesh.points, cells, mesh.boundaries)


def degenerate(mesh: Mesh) -> Mesh:
    """Return the mesh with all cells as hexahedra with repeated corners."""
    corners = REPEATED[mesh.element.kind]
    return Mesh(mesh.points, mesh.cells[:, corners], mesh.boundaries)
