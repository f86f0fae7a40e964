"""Stiffness assembly against a library and against triplets, on general quadrilaterals.

The mesh is distorted smoothly, so that no two cells are congruent.
"""

import numpy as np
import pytest
from skfem import Basis, ElementQuad1, ElementVector, MeshQuad
from skfem.models.elasticity import lame_parameters, linear_elasticity

from mortarbench.problems.fem.elasticity import (
    Material,
    elasticity_matrix,
    sparsity,
    stiffness,
)
from mortarbench.problems.fem.mesh import rectangle
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
