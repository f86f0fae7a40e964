"""Assembly of the stiffness by triplets, vectorised as in library [6] of the paper.

All element matrices are computed at once, and their entries are summed into a sparse
matrix. This method is the baseline against which benchmarks and experiments compare
`problems.fem.elasticity.stiffness`.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array, csc_array

from mortarbench.problems.fem.elasticity import (
    cell_dofs,
    shape_gradients,
    strain_matrix,
)
from mortarbench.problems.fem.mesh import Mesh


def stiffness_by_triplets(mesh: Mesh, D: NDArray[np.float64]) -> csc_array:
    """Assemble K (n, n) of one material D (v, v), Pa, by Gauss quadrature."""
    corners, dof = mesh.points[mesh.cells], cell_dofs(mesh)
    E, size = dof.shape
    K_e = np.zeros((E, size, size))
    for point in mesh.element.points:
        gradients, det = shape_gradients(corners, point)
        B = strain_matrix(gradients)
        K_e += np.swapaxes(B, 1, 2) @ (D @ B) * det[:, None, None]
    i, j = np.repeat(dof, size, axis=1), np.tile(dof, size)
    shape = (mesh.dofs, mesh.dofs)
    return csc_array(coo_array((K_e.ravel(), (i.ravel(), j.ravel())), shape=shape))
