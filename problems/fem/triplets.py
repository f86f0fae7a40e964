"""The stiffness by triplets: the vectorised way of the paper's library [6].

All element matrices at once, then one sort into a sparse matrix. Ours is compared with
it; see `problems.fem.elasticity.stiffness`.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array, csc_array

from mortarbench.problems.fem.elasticity import (
    GAUSS,
    cell_dofs,
    shape_gradients,
    strain_matrix,
)
from mortarbench.problems.fem.mesh import Mesh


def stiffness_by_triplets(mesh: Mesh, D: NDArray[np.float64]) -> csc_array:
    """Assemble K (2N, 2N) of one material D (3, 3), Pa, by 2×2 Gauss quadrature."""
    corners = mesh.points[mesh.cells]
    K_e = np.zeros((len(mesh.cells), 8, 8))
    for point in GAUSS:
        gradients, det = shape_gradients(corners, point)
        B = strain_matrix(gradients)
        K_e += np.swapaxes(B, 1, 2) @ (D @ B) * det[:, None, None]
    dof = cell_dofs(mesh)
    i, j = np.repeat(dof, 8, axis=1), np.tile(dof, 8)
    shape = (mesh.dofs, mesh.dofs)
    return csc_array(coo_array((K_e.ravel(), (i.ravel(), j.ravel())), shape=shape))
