"""Node-to-segment rows against geometry done by hand."""

import numpy as np
import pytest

from problems.contact import closest_points, node_to_segment

#: a master below the slave: body under the chain means the chain runs right to left
MASTER = np.array([[4.0, 0.0], [2.0, 0.0], [0.0, 0.0]])


def rows(slave, master, u=None):
    points = np.concatenate([slave, master])
    n = len(slave)
    u = np.zeros(points.size) if u is None else u
    return node_to_segment(points, u, np.arange(n), np.arange(n, len(points)))


def test_a_node_above_a_segment_may_descend_by_its_gap():
    B, c = rows(np.array([[1.0, 0.25]]), MASTER)

    assert c == pytest.approx([0.25])
    # −n at the slave, +½n at both ends of the second segment, n = (0, 1)
    assert B.toarray() == pytest.approx(np.array([[0, -1, 0, 0, 0, 0.5, 0, 0.5]]))


def test_a_penetrated_node_has_a_negative_gap():
    _, c = rows(np.array([[3.0, -0.1]]), MASTER)

    assert c == pytest.approx([-0.1])


def test_at_a_vertex_the_normal_is_averaged_and_the_vertex_carries_the_force():
    roof = np.array([[2.0, 0.0], [1.0, 1.0], [0.0, 0.0]])  # convex, apex on top
    B, c = rows(np.array([[1.0, 1.5]]), roof)

    assert c == pytest.approx([0.5])
    assert B.toarray() == pytest.approx(
        np.array([[0, -1, 0, 0, 0, 1, 0, 0]]), abs=1e-15
    )


def test_beyond_the_end_of_the_chain_the_last_node_is_the_closest_point():
    at = closest_points(np.array([[-3.0, 1.0], [5.0, 1.0]]), MASTER)

    assert at.segment.tolist() == [1, 0]
    assert at.xi.tolist() == [1, 0]
    assert at.normal == pytest.approx(np.array([[0, 1], [0, 1]]))


def test_the_constraint_is_on_the_total_displacement():
    """Moving everything by u changes the gap by exactly −B u for flat masters."""
    slave = np.array([[1.0, 0.25], [3.0, 0.5]])
    u = np.zeros((5, 2))
    u[:2, 1] = [-0.2, 0.3]
    B, c = rows(slave, MASTER)
    B_moved, c_moved = rows(slave, MASTER, u.ravel())

    assert B_moved.toarray() == pytest.approx(B.toarray())
    assert c_moved == pytest.approx(c)


@pytest.mark.parametrize("seed", [271828, 314159, 161803])
def test_rows_are_blind_to_translations_and_forces_balance_in_moment(seed):
    """The forces Bᵀλ of one row sum to zero; where the closest point is inside a
    segment they also have no moment about any point of the current configuration."""
    rng = np.random.default_rng(seed)
    master = np.column_stack([np.linspace(4, 0, 9), 0.1 * rng.standard_normal(9)])
    slave = np.column_stack([rng.uniform(0.3, 3.7, 12), rng.uniform(0.3, 0.6, 12)])
    u = 0.05 * rng.standard_normal(42)
    B, _ = rows(slave, master, u)
    x = np.concatenate([slave, master]) + u.reshape(-1, 2)
    at = closest_points(x[:12], x[12:])
    inside = (at.xi > 0) & (at.xi < 1)

    forces = B.toarray().reshape(12, -1, 2)
    moment = np.einsum("rn,n->r", forces[..., 1], x[:, 0])
    moment -= np.einsum("rn,n->r", forces[..., 0], x[:, 1])
    assert forces.sum(axis=1) == pytest.approx(0, abs=1e-14)
    assert inside.sum() >= 4
    assert moment[inside] == pytest.approx(0, abs=1e-13)


def test_the_linearised_gap_is_exact_to_first_order():
    """Small random motions change the true gap by −B du up to O(|du|²)."""
    rng = np.random.default_rng(20110228)
    master = np.column_stack([np.linspace(4, 0, 5), [0.0, 0.05, 0.1, 0.05, 0.0]])
    slave = np.array([[0.7, 0.075 + 1e-9], [2.6, 0.07 + 1e-9]])  # nearly touching
    foot = closest_points(slave, master)
    N = np.column_stack([1 - foot.xi, foot.xi])
    start = np.einsum(
        "sa,sax->sx", N, master[np.column_stack([foot.segment, foot.segment + 1])]
    )
    slave = start + 1e-9 * foot.normal
    B, c = rows(slave, master)
    direction = rng.standard_normal(14)
    errors = []
    for size in (1e-2, 1e-3):
        du = size * direction
        _, c_new = rows(slave, master, du)
        B_new, _ = rows(slave, master, du)
        true_gap = c_new - B_new @ du
        errors.append(abs(true_gap - (c - B @ du)).max())

    assert errors[1] < errors[0] / 50
