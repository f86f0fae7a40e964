"""Node-to-segment rows, compared with hand-computed geometry."""

import numpy as np
import pytest

from mortarbench.harness import InputError
from mortarbench.problems.contact import surface as contact
from mortarbench.problems.contact.node_to_facet import (
    geometric_stiffness,
    node_to_facet,
)
from mortarbench.problems.contact.rows import rows_along
from mortarbench.problems.contact.surface import divided, surface

#: master below the slave; its chain runs from right to left, so that the body is below
MASTER = np.array([[4.0, 0.0], [2.0, 0.0], [0.0, 0.0]])


ROOF = np.array([[2.0, 0.0], [1.0, 1.0], [0.0, 0.0]])  # convex, apex on top


def rows(slave, master, u=None):
    points = np.concatenate([slave, master])
    n = len(slave)
    u = np.zeros(points.size) if u is None else u
    chains = np.arange(n), np.arange(n, len(points))
    return node_to_facet(points, u, *chains)


def closest_points(x, chain):
    return contact.closest_points(x, divided(surface(chain, "master")))


def test_a_node_above_a_segment_may_descend_by_its_gap():
    B, c, *_ = rows(np.array([[1.0, 0.25]]), MASTER)

    assert c == pytest.approx([0.25])
    # −n at the slave, +½n at both ends of the second segment, n = (0, 1)
    assert B.toarray() == pytest.approx(np.array([[0, -1, 0, 0, 0, 0.5, 0, 0.5]]))


def test_a_penetrated_node_has_a_negative_gap():
    _, c, *_ = rows(np.array([[3.0, -0.1]]), MASTER)

    assert c == pytest.approx([-0.1])


@pytest.mark.parametrize("gap", [0.5, 0.0])
def test_at_a_vertex_the_normal_is_averaged_and_the_vertex_carries_the_force(gap):
    B, c, *_ = rows(np.array([[1.0, 1.0 + gap]]), ROOF)

    assert c == pytest.approx([gap], abs=1e-15)
    assert B.toarray() == pytest.approx(
        np.array([[0, -1, 0, 0, 0, 1, 0, 0]]), abs=1e-15
    )


@pytest.mark.parametrize("aside", [-1e-10, 1e-10])
def test_a_node_next_to_a_vertex_is_on_it(aside):
    at = closest_points(np.array([[1.0 + aside, 1.0 - abs(aside)]]), ROOF)

    assert at.N[0, 1] in (0, 1)
    assert at.normal == pytest.approx(np.array([[0, 1]]))


def test_beyond_the_end_of_the_chain_the_last_node_is_the_closest_point():
    at = closest_points(np.array([[-3.0, 1.0], [5.0, 1.0]]), MASTER)

    assert at.facet.tolist() == [1, 0]
    assert at.N[:, 1].tolist() == [1, 0]
    assert at.normal == pytest.approx(np.array([[0, 1], [0, 1]]))


def test_the_constraint_is_on_the_total_displacement():
    """For a flat master, a displacement u changes neither B nor c."""
    slave = np.array([[1.0, 0.25], [3.0, 0.5]])
    u = np.zeros((5, 2))
    u[:2, 1] = [-0.2, 0.3]
    B, c, *_ = rows(slave, MASTER)
    B_moved, c_moved, *_ = rows(slave, MASTER, u.ravel())

    assert B_moved.toarray() == pytest.approx(B.toarray())
    assert c_moved == pytest.approx(c)


def test_the_linearised_gap_is_exact_to_first_order():
    """A small random displacement du changes the true gap by −B du + O(|du|²)."""
    rng = np.random.default_rng(20110228)
    master = np.column_stack([np.linspace(4, 0, 5), [0.0, 0.05, 0.1, 0.05, 0.0]])
    slave = np.array([[0.7, 0.075 + 1e-9], [2.6, 0.07 + 1e-9]])  # nearly touching
    foot = closest_points(slave, master)
    ends = master[np.column_stack([foot.facet, foot.facet + 1])]
    start = np.einsum("sa,sax->sx", foot.N, ends)
    slave = start + 1e-9 * foot.normal
    B, c, *_ = rows(slave, master)
    direction = rng.standard_normal(14)
    errors = []
    for size in (1e-2, 1e-3):
        du = size * direction
        _, c_new, *_ = rows(slave, master, du)
        B_new, *_ = rows(slave, master, du)
        true_gap = c_new - B_new @ du
        errors.append(abs(true_gap - (c - B @ du)).max())

    assert errors[1] < errors[0] / 50


@pytest.mark.parametrize("fixed", [None, np.array([0, 2])])
def test_the_geometric_stiffness_is_the_derivative_of_the_forces(fixed):
    """Central differences of Bᵀλ, at nodes above the segment 1 and below 2 (of 4)."""
    rng = np.random.default_rng(4)
    master = np.column_stack([[4.0, 2.5, 2, 1, 0], [0.0, 0.1, 0.1, -0.2, 0.0]])
    points = np.concatenate([[[2.3, 0.3], [1.4, -0.2]], master])
    u, force = 0.02 * rng.standard_normal(14), np.array([3.0, 2.0])
    sides, step = (np.arange(2), np.arange(2, 7)), 1e-6

    def forces(u):
        B, *_ = node_to_facet(points, u, *sides, fixed_segments=fixed)
        return B.T @ force

    blocks, dofs = geometric_stiffness(points, u, *sides, force, fixed)
    K = np.zeros((14, 14))
    for block, at in zip(blocks, dofs, strict=True):
        K[np.ix_(at, at)] += block
    moved = (
        (forces(u + step * e) - forces(u - step * e)) / (2 * step) for e in np.eye(14)
    )

    assert K == pytest.approx(K.T, abs=1e-12)
    assert K == pytest.approx(np.array([*moved]), abs=1e-6 * np.abs(K).max())


def test_a_node_on_an_end_of_the_master_has_the_normal_of_the_last_segment():
    B, c, *_ = rows(ROOF[2:], ROOF)

    n = np.array([-1, 1]) / np.sqrt(2)
    assert c == pytest.approx([0], abs=1e-15)
    assert B.toarray() == pytest.approx(np.array([[*-n, 0, 0, 0, 0, *n]]))


def test_a_master_of_one_segment_has_an_inside_and_two_ends():
    at = closest_points(np.array([[3.0, 1.0], [-1.0, 0.0], [9.0, 0.5]]), MASTER[::2])

    assert at.facet.tolist() == [0, 0, 0]
    assert at.N[:, 1].tolist() == [0.25, 1, 0]
    assert at.normal == pytest.approx(np.array([[0, 1]] * 3))


def test_segments_of_zero_length_have_no_effect():
    """Each node of the roof is duplicated, and the entries of both copies are added."""
    slave = np.array([[0.2, 0.5], [0.6, 1.1], [1.0, 1.2], [1.0, 1.2], [2.5, 0.0]])
    once = rows(slave, ROOF)
    twice = rows(slave, np.repeat(ROOF, 2, axis=0))

    place = twice.B.toarray()[:, 10:].reshape(5, 3, 2, 2).sum(axis=2)
    assert twice.c == pytest.approx(once.c)
    assert place.reshape(5, 6) == pytest.approx(once.B.toarray()[:, 10:])


def test_a_master_that_folds_back_onto_itself_has_finite_rows():
    needle = np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 0.0]])
    B, c, *_ = rows(np.array([[1.0, 0.0], [1.5, 0.0], [0.5, 0.1]]), needle)

    assert np.isfinite(c).all()
    on_slaves = B.toarray()[:, :6].reshape(3, 3, 2).sum(axis=1)
    assert np.linalg.norm(on_slaves, axis=1) == pytest.approx(1)


@pytest.mark.parametrize(
    ("master", "message"),
    [(MASTER[:1], "master: 1 node"), (MASTER[[0, 0]], "master: 2 node"),
     (MASTER * np.nan, "master: node 1 is at")],
)  # fmt: skip
def test_a_master_without_segments_or_with_nan_coordinates_is_refused(master, message):
    with pytest.raises(InputError, match=message):
        rows(np.array([[1.0, 0.25]]), master)


def test_a_slave_node_at_infinity_is_refused():
    with pytest.raises(InputError, match=r"slave: node 0 is at \[inf, 0.25\]"):
        rows(np.array([[np.inf, 0.25]]), MASTER)


def test_a_node_that_is_also_on_the_master_has_one_entry_per_component():
    """In self-contact, the closest point of a node on the master is the node itself."""
    points = np.concatenate([MASTER, [[1.0, 0.25]]])
    B, c, *_ = node_to_facet(points, np.zeros(8), np.array([1, 3]), np.arange(3))

    assert B.has_canonical_format
    assert B.toarray() == pytest.approx(
        np.array([[0] * 8, [0, 0, 0, 0.5, 0, 0.5, 0, -1]])
    )
    assert c == pytest.approx([0, 0.25])


def test_a_surface_has_orthonormal_frames_and_areas_that_add_up_to_its_length():
    theta = np.linspace(0, np.pi, 13)
    arc = surface(np.column_stack([np.cos(theta), np.sin(theta)]), "slave")

    assert arc.tangents.shape == (13, 1, 2)
    np.testing.assert_allclose(np.linalg.norm(arc.tangents[:, 0], axis=1), 1)
    assert (np.einsum("vx,vx->v", arc.tangents[:, 0], arc.node_normal) == 0).all()
    turn = np.linalg.det(np.stack([arc.node_normal, arc.tangents[:, 0]], axis=1))
    np.testing.assert_allclose(turn, 1)  # anticlockwise
    edges = arc.x[arc.facets[:, 1]] - arc.x[arc.facets[:, 0]]
    assert arc.areas.sum() == pytest.approx(np.linalg.norm(edges, axis=1).sum())


def test_rows_along_directions_in_space_weight_displacements_of_nodes():
    node = np.array([[0, 2], [1, 3]])
    weight = np.array([[-1.0, 1.0], [-1.0, 0.5]])
    direction = np.array([[0.0, 0, 1], [0.6, 0.8, 0]])
    u = np.arange(12) ** 2.0

    B = rows_along(node, weight, direction, 12)

    v = u.reshape(-1, 3)
    expected = [v[2, 2] - v[0, 2], direction[1] @ (0.5 * v[3] - v[1])]
    np.testing.assert_allclose(B @ u, expected, rtol=1e-15)
