"""Blocks of structured grids, compared with torn undivided meshes; shape factors."""

import numpy as np
import pytest

from mortarbench.problems.duality.decomposed import longitudinal_share
from mortarbench.problems.fem.elasticity import Material, elasticity_matrix, stiffness
from mortarbench.problems.fem.mesh import half_ring, join, rectangle
from mortarbench.problems.feti.structured import lines, shape_factors, spacings
from tests.support.glued import decompose, structured_bodies

pytestmark = pytest.mark.together

GRIDS = (
    rectangle((0.0, 0.5), (2.0, 0.25), (13, 5)),
    half_ring((1.0, 0.0), (0.3, 0.49), (11, 7)),
    rectangle((0.0, 0.0), (1.0, 1.0), (2, 2)),
)


@pytest.fixture(scope="module", params=[1, 3, 4, 20])
def torn(request):
    """Return the size of blocks of three grids, and the torn meshes of the grids."""
    mesh, body = join(GRIDS)
    label = structured_bodies([grid.divisions for grid in GRIDS], request.param)
    whole = decompose(mesh.points, mesh.cells, label, body)
    return request.param, whole


def stiffest_saw_tooth(D, r):
    """Return the largest stiffness of alternating displacements ±a on a half plane of
    cells.

    r : depth of the cells, whose edge has length 1

    With the blocks A, B of one layer of cells for displacements of alternating sign,
    the stiffness is the fixed point of S = A − B(A + S)⁻¹B, which adds one layer at a
    time.
    """
    K = stiffness(rectangle((0, 0), (1, r), (1, 1)), D[None], np.zeros(1, int))
    sign = np.kron([[1, 0], [-1, 0], [0, 1], [0, -1]], np.eye(2))
    layer = sign.T @ K.toarray() @ sign
    top, across, base = layer[:2, :2], layer[:2, 2:], layer[2:, 2:]
    S = top
    for _ in range(200):
        S = top - across @ np.linalg.solve(base + S, across.T)
    return np.linalg.eigvalsh(S).max()


@pytest.mark.parametrize("r", [0.25, 0.8, 1.25, 4.0])
@pytest.mark.parametrize("nu", [0.0, 0.3])
def test_the_factor_is_the_stiffness_of_a_saw_tooth_relative_to_squares(nu, r):
    D = elasticity_matrix(Material(E=3.0, nu=nu), "strain")
    exact = stiffest_saw_tooth(D, r) / stiffest_saw_tooth(D, 1.0)
    along_row = shape_factors(
        np.array([[2.0, 2.0 * r]]), np.array([[True, False]]),
        longitudinal_share(D[None]),
    )  # fmt: skip

    assert along_row == pytest.approx([exact], rel=1e-9)


def test_the_factor_is_averaged_at_crosspoints_and_one_without_interfaces():
    along = np.array([[True, True], [True, False], [False, True], [False, False]])
    both, row, column, none = shape_factors(np.array([[1.0, 2.0]] * 4), along, 0.5)

    assert both == pytest.approx((row + column) / 2)
    assert row > 1 > column
    assert none == 1


def every_node(grid):
    """Return the rows and the columns of all nodes."""
    return np.divmod(np.arange(len(grid.points)), grid.grid.shape[1])


def test_spacings_are_those_of_the_cells_around():
    grid = GRIDS[0]
    assert spacings(grid.grid, every_node(grid)) == pytest.approx(
        np.tile([2 / 13, 0.05], (84, 1))
    )


def test_sides_of_grids_count_as_lines_on_request(torn):
    most, whole = torn
    inner, all_ = (
        np.concatenate(
            [lines(grid.divisions, most, every_node(grid), ends=ends) for grid in GRIDS]
        )
        for ends in (False, True)
    )
    on_side = np.zeros((whole.nodes, 2), dtype=bool)
    start = np.cumsum([0] + [len(grid.points) for grid in GRIDS])
    for first, grid in zip(start, GRIDS, strict=False):
        bottom, right, top, left = grid.boundaries.values()
        on_side[first + np.append(bottom, top), 0] = True
        on_side[first + np.append(left, right), 1] = True

    assert np.array_equal(inner.sum(axis=1) > 0, np.bincount(whole.node) > 1)
    assert np.array_equal(all_, inner | on_side)
