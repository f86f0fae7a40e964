"""Node-to-face contact, compared with plane contact, brute force and rigid motions."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

from mortarbench.problems.contact.node_to_facet import node_to_facet
from mortarbench.problems.contact.surface import (
    closest_in_simplices,
    closest_points,
    divided,
    faceted_surface,
)


def test_closest_points_of_triangles_are_those_of_a_fine_search(rng):
    triangle = rng.standard_normal((60, 3, 3))
    x = 2 * rng.standard_normal((60, 3))
    at = np.einsum("pv,pvx->px", closest_in_simplices(x, triangle), triangle)
    distance = np.linalg.norm(x - at, axis=1)
    a, b = np.meshgrid(*[np.linspace(0, 1, 101)] * 2)
    inside = a + b <= 1
    grid = np.stack([a, b, 1 - a - b])[:, inside]
    for one, corners, d in zip(x, triangle, distance, strict=True):
        nearest = np.linalg.norm(one - grid.T @ corners, axis=1).min()
        size = np.ptp(corners, axis=0).max()
        assert d <= nearest + 1e-12
        assert nearest <= d + 0.02 * size


def extruded(chain, layers, width):
    """Return points (v·layers, 3) and faces of a chain (v, 2) in x and z, extruded
    along y."""
    v = len(chain)
    y = np.linspace(0, width, layers)
    points = np.array([[x, depth, z] for depth in y for x, z in chain])
    a = np.arange(v - 1)[None] + v * np.arange(layers - 1)[:, None]
    # the body is on the left of the chain, and below a chain that runs to −x
    faces = np.stack([a, a + 1, a + v + 1, a + v], axis=-1).reshape(-1, 4)
    return points, faces[:, ::-1]


@pytest.mark.parametrize("tangential", [False, True])
def test_rows_of_extruded_sides_are_those_of_the_plane(tangential, rng):
    t = np.linspace(0, 1, 7)
    lower = np.stack([1 - t, 0.1 * np.sin(3 * (1 - t))], axis=-1)  # its body below
    s = np.linspace(0.05, 0.97, 9)
    upper = np.stack([s, 0.12 * np.sin(3 * s) + 0.02], axis=-1)  # its body above
    flat = np.concatenate([upper, lower])
    u = 0.003 * rng.standard_normal(flat.shape)
    plane = node_to_facet(
        flat, u.ravel(), np.arange(9), 9 + np.arange(7), tangential=tangential
    )

    layers = 4
    parts = [extruded(chain + shift, layers, 0.5)
             for chain, shift in ((upper, u[:9]), (lower, u[9:]))]  # fmt: skip
    points = np.concatenate([part[0] for part in parts])
    rows = node_to_facet(
        points, np.zeros(points.size), parts[0][1], parts[1][1] + 9 * layers,
        tangential=tangential,
    )  # fmt: skip

    # every layer has the displacement of the plane problem
    motion = rng.standard_normal(flat.shape)
    in_space = np.zeros_like(points)
    in_space[:, [0, 2]] = np.concatenate(
        [np.tile(motion[:9], (layers, 1)), np.tile(motion[9:], (layers, 1))]
    )
    expected = plane.B @ motion.ravel()
    assert_allclose(rows.B @ in_space.ravel(), np.tile(expected, layers), atol=1e-13)
    gap = plane.c - plane.B @ u.ravel()
    assert_allclose(rows.c, np.tile(gap, layers), atol=1e-13)
    if tangential:
        slip = (rows.T @ in_space.ravel()).reshape(-1, 2)
        assert_allclose(
            np.linalg.norm(slip, axis=1),
            np.tile(np.abs(plane.T @ motion.ravel()), layers), atol=1e-13,
        )  # fmt: skip
    total = rows.share.reshape(layers, -1).sum(axis=0) / 0.5
    assert_allclose(total, plane.share, atol=1e-3)  # areas per width are lengths


def test_the_closest_face_is_that_of_an_exhaustive_search(rng):
    n = 9
    a, b = np.meshgrid(np.linspace(0, 1, n), np.linspace(0, 1, n))
    height = 0.2 * np.sin(5 * a) * np.cos(4 * b)
    points = np.stack([a.ravel(), b.ravel(), height.ravel()], axis=-1)
    i = np.arange(n * n).reshape(n, n)
    corners = (i[:-1, :-1], i[:-1, 1:], i[1:, 1:], i[1:, :-1])
    table = np.stack([c.ravel() for c in corners], axis=-1)
    faces = divided(faceted_surface(points, table, "master"))
    x = rng.uniform([-0.5, -0.5, -1], [1.5, 1.5, 2], (200, 3))
    closest = closest_points(x, faces)
    at = np.einsum("sc,scx->sx", closest.N, points[table[closest.facet]])
    for one, foot in zip(x, at, strict=True):
        every = closest_in_simplices(
            np.broadcast_to(one, (len(faces.facet), 3)), faces.vertices
        )
        distance = np.linalg.norm(
            np.einsum("tv,tvx->tx", every, faces.vertices) - one, axis=1
        )
        assert np.linalg.norm(foot - one) == pytest.approx(distance.min(), abs=1e-14)


def test_rows_have_no_resultant_and_no_moment_inside_of_flat_faces():
    points, faces = extruded(np.array([[1.0, 0.0], [0.5, 0.0], [0.0, 0.0]]), 3, 1.0)
    above = np.array([[0.3, 0.2, 0.1], [0.8, 0.2, 0.2], [0.6, 0.9, 0.3]])
    slave = len(points) + np.array([[0, 2, 1, 1]])
    every = np.concatenate([points, above])
    rows = node_to_facet(every, np.zeros(every.size), slave, faces)
    assert_allclose(rows.c, [0.1, 0.2, 0.3])
    for row in rows.B.toarray():
        force = row.reshape(-1, 3)
        assert_allclose(force.sum(axis=0), 0, atol=1e-15)
        assert_allclose(np.cross(every, force).sum(axis=0), 0, atol=1e-15)
