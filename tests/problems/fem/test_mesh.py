"""Plane meshes: areas, boundaries and joined bodies."""

from dataclasses import replace

import numpy as np
import pytest

from mortarbench.problems.families.beam_ring import model
from mortarbench.problems.fem.mesh import (
    half_disc,
    half_ring,
    join,
    nodal_lengths,
    prefixed,
    rectangle,
)


def signed_areas(mesh):
    x, y = np.moveaxis(mesh.points[mesh.cells], -1, 0)
    return 0.5 * (x * np.roll(y, -1, axis=1) - y * np.roll(x, -1, axis=1)).sum(axis=1)


def test_a_rectangle_is_covered_exactly_by_anticlockwise_cells():
    areas = signed_areas(rectangle((0, 0.5), (2, 0.25), (8, 3)))

    assert areas == pytest.approx(np.full(24, 2 * 0.25 / 24))


def test_the_area_of_a_half_ring_converges_with_second_order():
    exact = np.pi / 2 * (0.49**2 - 0.3**2)
    errors = [
        exact - signed_areas(half_ring((1, 0), (0.3, 0.49), (n, 4))).sum()
        for n in (12, 24, 48)
    ]

    assert min(errors) > 0  # chords lie inside the arc
    assert np.log2(np.divide(errors[:-1], errors[1:])) == pytest.approx(2, abs=0.02)


@pytest.mark.parametrize(
    "mesh",
    [
        rectangle((0, 0.5), (2, 0.25), (8, 3)),
        half_ring((1, 0), (0.3, 0.49), (24, 4)),
        half_disc((1, 3), np.linspace(-np.pi, 0, 9), np.array([2, 1.5, 0.5])),
    ],
    ids=["rectangle", "half ring", "half disc"],
)
def test_every_boundary_has_the_body_on_its_left(mesh):
    """Edge normals sum to zero, and ∮ x·n ds is twice the area (Gauss)."""
    flux, total = 0.0, np.zeros(2)
    for nodes in mesh.boundaries.values():
        x = mesh.points[nodes]
        edge = np.diff(x, axis=0)
        normal = np.column_stack([edge[:, 1], -edge[:, 0]])
        flux += ((x[1:] + x[:-1]) / 2 * normal).sum()
        total += normal.sum(axis=0)

    assert total == pytest.approx(0, abs=1e-14)
    assert flux == pytest.approx(2 * signed_areas(mesh).sum())


def test_boundaries_of_the_ring_have_the_named_positions():
    ring = half_ring((1, 0), (0.3, 0.49), (24, 4))
    x = {name: ring.points[nodes] for name, nodes in ring.boundaries.items()}

    assert np.hypot(*(x["outer"] - [1, 0]).T) == pytest.approx(0.49)
    assert np.hypot(*(x["inner"] - [1, 0]).T) == pytest.approx(0.3)
    assert x["left_foot"] == pytest.approx(
        np.column_stack([x["left_foot"][:, 0], 0 * x["left_foot"][:, 0]]), abs=1e-15
    )
    assert x["left_foot"][:, 0].max() < 1 < x["right_foot"][:, 0].min()


def test_joined_bodies_share_no_node():
    a, b = rectangle((0, 0), (1, 1), (2, 2)), half_ring((1, 0), (0.3, 0.49), (4, 2))
    both, body = join((a, b))

    first, second = (set(both.cells[body == i].ravel()) for i in (0, 1))
    assert first.isdisjoint(second)
    assert len(first) + len(second) == len(both.points)
    assert both.points[both.boundaries["outer"]] == pytest.approx(
        b.points[b.boundaries["outer"]]
    )


def test_a_half_disc_is_the_polygon_of_its_arc():
    angles = np.linspace(0, np.pi, 7)
    disc = half_disc((1, 3), angles, np.array([2, 1.5, 0.5]))
    arc, flat = (disc.points[disc.boundaries[name]] for name in ("arc", "flat"))

    assert signed_areas(disc).min() > 0
    assert signed_areas(disc).sum() == pytest.approx(6 * 2 * np.sin(np.pi / 6))
    assert arc == pytest.approx(
        np.column_stack([1 + 2 * np.cos(angles), 3 + 2 * np.sin(angles)])
    )
    assert flat == pytest.approx(np.column_stack([[-1, -0.5, 0.5, 1, 1.5, 2.5, 3],
                                                  np.full(7, 3)]))  # fmt: skip


def test_bodies_of_one_shape_keep_their_boundaries_apart_by_prefixes():
    block = rectangle((0, 0), (1, 1), (2, 3))
    both, _ = join((prefixed(block, "lower_"), prefixed(block, "upper_")))

    assert (both.boundaries["lower_top"] == block.boundaries["top"]).all()
    assert (both.boundaries["upper_top"] == block.boundaries["top"] + 12).all()


def test_nodal_lengths_integrate_linear_functions_along_a_chain():
    chain = np.array([[0, 0], [3, 4], [3, 5], [3, 5.5]])
    along = np.array([0, 5, 6, 6.5])

    assert nodal_lengths(chain) == pytest.approx([2.5, 3, 0.75, 0.25])
    assert nodal_lengths(chain) @ along == pytest.approx(6.5**2 / 2)


def test_bodies_whose_nodes_are_not_numbered_body_by_body_are_refused():
    """R stores the rigid modes of each body in a block of consecutive rows."""
    bodies = model(1, 1, 2, "strain")
    shuffle = np.random.default_rng(271828).permutation(len(bodies.mesh.points))
    mesh = replace(bodies.mesh, cells=shuffle[bodies.mesh.cells])

    with pytest.raises(ValueError, match="in the order of their bodies"):
        replace(bodies, shape=replace(bodies.shape, mesh=mesh))
