"""Time of stiffness assembly, compared with scikit-fem and assembly by triplets.

The comparison with triplets is made in two dimensions. Meshes of quadrilaterals and
hexahedra are distorted smoothly, so that no two cells are congruent.
"""

import numpy as np
import pytest
from skfem import (
    Basis,
    ElementHex1,
    ElementQuad1,
    ElementVector,
    MeshHex,
    MeshQuad,
)
from skfem.models.elasticity import lame_parameters, linear_elasticity

from mortarbench.problems.fem.elasticity import (
    Material,
    elasticity_matrix,
    sparsity,
    stiffness,
)
from mortarbench.problems.fem.elements import HEXAHEDRON
from mortarbench.problems.fem.mesh import box, rectangle
from mortarbench.problems.fem.triplets import stiffness_by_triplets

STEEL = Material(E=200e9, nu=0.3)
D = elasticity_matrix(STEEL, "strain")


def distorted_beam(Nr):
    mesh = rectangle((0, 0.5), (2, 0.25), (8 * Nr, Nr))
    x, y = mesh.points.T
    mesh.points[:, 1] += 0.02 * np.sin(7 * x) * np.cos(5 * y)
    return mesh


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
        triplets=lambda: stiffness_by_triplets(mesh, D),
        scikit_fem=library,
    )

    K, expected = stiffness(mesh, D), library()
    assert abs(K - expected).max() <= 1e-13 * abs(expected).max()
    assert set(medians) == {"first_time", "pattern_reused", "triplets", "scikit_fem"}


@pytest.mark.parametrize("n", [12, 20])
def test_assembly_of_hexahedra(race, n):
    mesh = box((0.0, 0.0, 0.0), (1.0, 1.0, 1.0), (n, n, n))
    x, y, z = mesh.points.T
    mesh.points[:, 2] += 0.05 * np.sin(3 * x) * np.cos(2 * y) * np.sin(4 * z)
    pattern, D = sparsity(mesh), elasticity_matrix(STEEL, None)
    element = ElementVector(ElementHex1())
    corners = (HEXAHEDRON.corners + 1) // 2
    place = [int(abs(corners - x).sum(axis=1).argmin()) for x in ElementHex1.doflocs]
    grid = MeshHex(mesh.points.T.copy(), mesh.cells[:, place].T.copy())
    form = linear_elasticity(*lame_parameters(STEEL.E, STEEL.nu))

    def library():
        return form.assemble(Basis(grid, element, intorder=3))

    medians = race(
        first_time=lambda: stiffness(mesh, D),
        pattern_reused=lambda: stiffness(mesh, D, pattern=pattern),
        scikit_fem=library,
        rounds=5,
    )

    K, expected = stiffness(mesh, D), library()
    assert abs(K - expected).max() <= 1e-13 * abs(expected).max()
    assert set(medians) == {"first_time", "pattern_reused", "scikit_fem"}
