"""Boxes of hexahedra, for tests."""

import numpy as np

from mortarbench.problems.fem.elements import HEXAHEDRON
from mortarbench.problems.fem.mesh import Mesh


def bricks(divisions: tuple[int, ...], size: tuple[float, ...]) -> Mesh:
    """Divide a box into equal cells, x numbered slowest."""
    nodes = np.add(divisions, 1)
    i = np.arange(np.prod(nodes)).reshape(nodes)
    ends = [slice(None, -1), slice(1, None)]
    at = (HEXAHEDRON.corners + 1) // 2
    cells = [i[ends[x], ends[y], ends[z]].ravel() for x, y, z in at]
    points = np.array(list(np.ndindex(i.shape))) * np.divide(size, divisions)
    return Mesh(points, np.stack(cells, axis=-1), {})
