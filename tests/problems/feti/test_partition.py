"""Parts of any mesh are connected by edges, lie within one body and have
similar sizes.
"""

import numpy as np
import pytest
from scipy.sparse.csgraph import connected_components

from mortarbench.harness import InputError
from mortarbench.problems.fem.mesh import half_disc, join, rectangle
from mortarbench.problems.feti import partition
from mortarbench.problems.feti.partition import graph_partition, neighbours
from tests.support.hexahedra import bricks


def disc_and_block():
    disc = half_disc((0.0, 0.0), np.linspace(0, np.pi, 25), np.linspace(1, 0.1, 10))
    return join((disc, rectangle((-1.0, -1.0), (2.0, 0.5), (20, 5))))


@pytest.mark.parametrize("parts", [2, 3, 7, 30, 100])
def test_parts_are_connected_of_one_body_and_about_equal(parts):
    mesh, body = disc_and_block()
    label = graph_partition(mesh.points, mesh.cells, body, parts)
    sizes = np.bincount(label)

    assert sizes.size == parts
    assert sizes.min() >= 1
    assert sizes.max() <= 1.6 * len(body) / parts + 3
    for s in range(parts):
        assert np.unique(body[label == s]).size == 1
        graph = neighbours(mesh.points, mesh.cells[label == s])
        assert connected_components(graph)[0] == 1
    assert (np.diff([body[label == s][0] for s in range(parts)]) >= 0).all()
    assert np.array_equal(label, graph_partition(mesh.points, mesh.cells, body, parts))


def test_cells_that_share_an_edge_are_neighbours():
    """The mesh is a 2 × 2 grid and a triangle that shares only a node with the grid."""
    cells = np.array([[0, 1, 4, 3], [1, 2, 5, 4], [3, 4, 7, 6], [4, 5, 8, 7],
                      [8, 9, 10, 10]])  # fmt: skip
    points = np.random.default_rng(314159).standard_normal((11, 2))
    graph = neighbours(points, cells).toarray() > 0
    pairs = {tuple(pair) for pair in np.argwhere(graph).tolist() if pair[0] < pair[1]}

    assert pairs == {(0, 1), (0, 2), (1, 3), (2, 3)}


def test_a_separate_piece_joins_the_part_with_the_longest_common_boundary():
    strip = rectangle((0.0, 0.0), (6.0, 1.0), (6, 1))
    graph = neighbours(strip.points, strip.cells)
    label = partition._reconnect(graph, np.array([0, 0, 1, 1, 1, 0]))

    assert label.tolist() == [0, 0, 1, 1, 1, 1]


def test_cells_connected_only_at_a_node_are_not_a_body():
    cells = np.array([[0, 1, 4, 3], [4, 5, 8, 7], [9, 10, 12, 11], [11, 12, 14, 13]])
    with pytest.raises(InputError, match="are not all connected by edges"):
        graph_partition(np.eye(15)[:, :2], cells, np.array([0, 0, 1, 1]), 2)


@pytest.mark.parametrize("parts", [1, 200])
def test_too_few_and_too_many_parts_are_refused(parts):
    mesh, body = disc_and_block()
    with pytest.raises(
        InputError, match=rf"parts={parts} for 2 bodies .* expected 2 to"
    ):
        graph_partition(mesh.points, mesh.cells, body, parts)


def test_parts_of_long_and_thin_cells_are_compact():
    """On a square of 8 × 128 cells, parts with the fewest shared edges would be 16
    times as long as wide."""
    mesh, body = rectangle((0.0, 0.0), (1.0, 1.0), (8, 128)), np.zeros(1024, dtype=int)
    label = graph_partition(mesh.points, mesh.cells, body, 16)
    corners = mesh.points[mesh.cells]
    boxes = [np.ptp(corners[label == s].reshape(-1, 2), axis=0) for s in range(16)]

    assert np.median([max(box) / min(box) for box in boxes]) <= 4


def test_hexahedra_that_share_a_face_of_positive_area_are_neighbours():
    """For cells of 1 × 2 × 4, the weight of a face of area A is 100 A^⅓ d^−⅔, with the
    distance d of the centres."""
    mesh = bricks((2, 2, 2), (2.0, 4.0, 8.0))
    graph = neighbours(mesh.points, mesh.cells).toarray()

    assert (np.count_nonzero(graph, axis=1) == 3).all()
    for d, step in ((1.0, 4), (2.0, 2), (4.0, 1)):
        weight = 100 * (8 / d) ** (1 / 3) / d ** (2 / 3)
        found = graph[np.arange(8), np.arange(8) ^ step]
        assert found == pytest.approx(weight, abs=0.5)


@pytest.mark.parametrize("parts", [2, 5, 8])
def test_parts_of_hexahedra_are_connected_by_faces(parts):
    mesh = bricks((6, 4, 4), (1.5, 1.0, 1.0))
    points, cells = mesh.points, mesh.cells
    label = graph_partition(points, cells, np.zeros(len(cells), dtype=np.int64), parts)
    sizes = np.bincount(label)

    assert sizes.size == parts
    assert sizes.max() <= 1.6 * len(cells) / parts + 3
    for s in range(parts):
        assert connected_components(neighbours(points, cells[label == s]))[0] == 1
