"""Stiffness assembly against a library and against triplets, on general quadrilaterals.

No two cells are congruent: the mesh is distorted smoothly. Compilation is done before.
"""

import numpy as np
import pytest
from scipy.sparse import coo_array, csc_array
from skfem import Basis, ElementQuad1, ElementVector, MeshQuad
from skfem.models.elasticity import lame_parameters, linear_elasticity

from problems.elasticity import (
    GAUSS,
    Material,
    cell_dofs,
    elasticity_matrix,
    shape_gradients,
    sparsity,
    stiffness,
    strain_matrix,
)
from problems.mesh import rectangle

STEEL = Material(E=200e9, nu=0.3)
D = elasticity_matrix(STEEL, "strain")


def distorted_beam(Nr):
    mesh = rectangle((0, 0.5), (2, 0.25), (8 * Nr, Nr))
    x, y = mesh.points.T
    mesh.points[:, 1] += 0.02 * np.sin(7 * x) * np.cos(5 * y)
    return mesh


def by_triplets(mesh):
    """The straightforward way: all element matrices, then COO to CSC."""
    corners, Ke = mesh.points[mesh.cells], 0.0
    for point in GAUSS:
        gradients, det = shape_gradients(corners, point)
        B = strain_matrix(gradients)
        Ke = Ke + np.swapaxes(B, 1, 2) @ (D @ B) * det[:, None, None]
    dof = cell_dofs(mesh)
    i, j = np.repeat(dof, 8, axis=1), np.tile(dof, 8)
    shape = (mesh.dofs, mesh.dofs)
    return csc_array(coo_array((Ke.ravel(), (i.ravel(), j.ravel())), shape=shape))


@pytest.mark.parametrize("Nr", [30, 120])
def test_assembly(race, Nr):
    mesh = distorted_beam(Nr)
    pattern = sparsity(mesh)
    quads = MeshQuad(mesh.points.T.copy(), mesh.cells.T.copy())
    form = linear_elasticity(*lame_parameters(STEEL.E, STEEL.nu))

    def library():
        return form.assemble(Basis(quads, ElementVector(ElementQuad1()), intorder=2))

    medians = race(
        first_time=lambda: stiffness(mesh, D),
        pattern_reused=lambda: stiffness(mesh, D, pattern=pattern),
        triplets=lambda: by_triplets(mesh),
        scikit_fem=library,
    )

    K, expected = stiffness(mesh, D), library()
    assert abs(K - expected).max() <= 1e-13 * abs(expected).max()
    assert set(medians) == {"first_time", "pattern_reused", "triplets", "scikit_fem"}
