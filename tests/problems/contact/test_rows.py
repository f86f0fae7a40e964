"""Contact rows of several pairs, and of slave nodes beyond the border of the master."""

import numpy as np
import pytest

from mortarbench.problems.contact.node_to_facet import node_to_facet
from mortarbench.problems.contact.rows import (
    handed_over,
    joined,
    rows_along,
    without_fixed,
)
from mortarbench.problems.fem.mesh import box, nodal_lengths

MASTER = np.array([[2.0, 0.0], [1.5, 0.0], [0.7, 0.0], [0.0, 0.0]])


def over(slave, gap=0.1):
    """Return rows of slave nodes at x = `slave` above the MASTER, and the nodes."""
    nodes = np.column_stack([slave, np.full(len(slave), gap)])
    points, s = np.concatenate([nodes, MASTER]), len(slave)
    rows = node_to_facet(
        points, np.zeros(points.size), np.arange(s), s + np.arange(4), tangential=True
    )
    return rows, points


@pytest.mark.parametrize("first", [-1.5, -1.48, -1.45, -1.3, -1.0, -0.55, 1.7, 30.0])
def test_rows_end_where_the_master_ends(first):
    """Rows act between opposite points, and their shares sum to the covered length.

    A node up to a tenth of a segment beyond the end counts as opposite the master.
    """
    rows, points = over(first + 0.5 * np.arange(6))
    forces, slips = (
        M.toarray().reshape(rows.c.size, len(points), 2) for M in (rows.B, rows.T)
    )
    x = points[:6, 0]
    start = min(x[(x > -0.0501) & (x < 0)], default=max(x[0], 0.0))
    end = max(x[(x > 2) & (x < 2.0501)], default=min(x[-1], 2.0))

    assert rows.c == pytest.approx(0.1)
    assert forces[..., 1] @ points[:, 0] == pytest.approx(0, abs=1e-14)
    assert forces.sum(axis=1) == pytest.approx(0, abs=1e-14)
    assert forces[..., 0] == pytest.approx(0, abs=1e-14)
    assert np.abs(slips[..., 0]) == pytest.approx(np.abs(forces[..., 1]))
    assert rows.share.sum() == pytest.approx(max(end - start, 0.0))
    beyond = np.maximum(-x, x - 2)[rows.place]
    assert beyond.max(initial=0.0) <= 0.9 * 0.5


def test_uniform_pressure_has_the_forces_of_the_covered_part():
    """With λ_j = p·share_j, the forces on the slave are p∫N_j over the covered part."""
    rows, points = over(np.array([-0.9, -0.4, 0.1, 0.5, 1.2, 1.9, 2.3, 3.0]))
    force = (rows.B.T @ rows.of_rows(rows.share)).reshape(-1, 2)[:8, 1]
    x, ends = points[:8, 0], (0.0, 2.0)
    exact = np.zeros(8)
    for k in range(7):
        a, b = np.clip(x[k : k + 2], *ends)
        for node, other in ((k, k + 1), (k + 1, k)):
            # integral of the linear function that is 1 at `node` and 0 at `other`
            mean = ((a + b) / 2 - x[other]) / (x[node] - x[other])
            exact[node] += (b - a) * mean

    assert force == pytest.approx(-exact, abs=1e-14)
    assert rows.share.sum() == pytest.approx(2.0)


@pytest.mark.parametrize("shift", [(0.0, 0.0), (0.25, 0.0), (0.2, -0.5), (-0.6, 1.1)])
def test_faces_have_rows_only_where_the_master_is(shift):
    """Shares sum to the common area of two plane sides, and rows have no moment."""
    below = box((0.0, 0.0, -1.0), (2.0, 1.5, 1.0), (5, 4, 1))
    above = box((*shift, 0.05), (1.6, 1.2, 1.0), (4, 3, 1))
    points = np.vstack([above.points, below.points])
    master = below.boundaries["top"] + len(above.points)
    rows = node_to_facet(
        points, np.zeros(points.size), above.boundaries["bottom"], master
    )
    common = [
        min(s + a, b) - max(s, 0)
        for s, a, b in zip(shift, (1.6, 1.2), (2.0, 1.5), strict=True)
    ]
    forces = rows.B.toarray().reshape(rows.c.size, -1, 3)

    assert rows.c == pytest.approx(0.05)
    assert rows.share.sum() == pytest.approx(np.prod(common))
    assert forces.sum(axis=1) == pytest.approx(0, abs=1e-14)
    assert forces[..., 2] @ points[:, :2] == pytest.approx(0, abs=1e-14)
    assert forces[..., :2] == pytest.approx(0, abs=1e-14)


def test_equal_rows_of_a_common_node_become_one_and_divide_its_force():
    """The node at x = 0.9 ends both chains of slave nodes."""
    x = np.array([0.1, 0.5, 0.9, 1.7])
    points = np.concatenate([np.column_stack([x, 0 * x]), MASTER])
    master, sides = 4 + np.arange(4), (np.array([0, 1, 2]), np.array([2, 3]))
    parts = [node_to_facet(points, np.zeros(16), side, master) for side in sides]
    rows = joined(parts, sides, 2.0)
    forces = rows.at_places(np.array([1.0, 2.0, 6.0, 4.0]), 5)

    assert rows.B.shape[0] == 4
    assert rows.at.tolist() == [0, 1, 2, 2, 3]
    # the node has 0.2 m of the first and 0.4 m of the second chain
    assert forces == pytest.approx([1, 2, 2, 4, 4])
    assert rows.of_rows(rows.share) == pytest.approx(nodal_lengths(points[:4]))
    # with a gap in one of the pairs, both rows remain
    far = parts[1]._replace(c=parts[1].c + 0.01)
    assert joined([parts[0], far], sides, 2.0).B.shape[0] == 5


def test_a_row_needs_a_free_component():
    normal = np.array([[0.6, 0.8], [1.0, 1e-17], [0.0, 1.0]])
    rows, _ = over(np.array([0.2, 0.4, 0.6]))
    rows = rows._replace(
        B=rows_along(np.arange(3)[:, None], np.ones((3, 1)), normal, 14)
    )
    kept = without_fixed(rows, np.array([0, 2, 4, 5]))

    assert kept.place.tolist() == [0]
    assert kept.B.toarray()[0, :2] == pytest.approx([0.6, 0.8])
    assert kept.row.tolist() == [0]


def test_values_are_handed_over_to_neighbours():
    chain = np.array([[0, 1], [1, 2], [2, 3]])
    E = handed_over(chain, np.array([True, False, True, False]))

    assert (E @ [1.0, 10.0, 100.0, 1000.0]).tolist() == [6, 0, 1105, 0]
