"""Mortar contact between faces: exact clipping, patch test and equilibrium."""

from fractions import Fraction

import numpy as np
import pytest
from numpy.testing import assert_allclose

from mortarbench.harness import InputError
from mortarbench.problems.contact.face_mortar import (
    clip,
    face_mortar,
    moments,
    overlaps,
)
from mortarbench.problems.contact.surface import Reach, current_surface, divided


def exact_overlap(subject, window):
    """Return the area of the overlap of two triangles in rational arithmetic."""
    polygon = [[Fraction(float(v)) for v in corner] for corner in subject]
    window = [[Fraction(float(v)) for v in corner] for corner in window]
    for k in range(3):
        (ax, ay), (bx, by) = window[k], window[(k + 1) % 3]

        def side(q, ax=ax, ay=ay, bx=bx, by=by):
            return (bx - ax) * (q[1] - ay) - (by - ay) * (q[0] - ax)

        result = []
        for i, q in enumerate(polygon):
            r = polygon[(i + 1) % len(polygon)]
            d, e = side(q), side(r)
            if d >= 0:
                result.append(q)
            if (d >= 0) != (e >= 0):
                t = d / (d - e)
                result.append([a + t * (b - a) for a, b in zip(q, r, strict=True)])
        polygon = result
    twice = sum(
        q[0] * r[1] - q[1] * r[0]
        for q, r in zip(polygon, polygon[1:] + polygon[:1], strict=True)
    )
    return float(twice / 2)


def anticlockwise(triangles):
    a, b = triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]
    flip = a[:, 0] * b[:, 1] < a[:, 1] * b[:, 0]
    triangles[flip] = triangles[flip][:, ::-1]
    return triangles


def test_areas_of_overlaps_are_those_of_exact_clipping(rng):
    count = 400
    first = anticlockwise(rng.random((count, 3, 2)))
    other = anticlockwise(rng.random((count, 3, 2)))
    # include triangles with common corners or edges, and equal triangles
    other[:50, 0] = first[:50, 0]
    other[50:100, :2] = first[50:100, 1::-1]
    other[100:150] = first[100:150]
    other = anticlockwise(other)

    areas = moments(*clip(first, other))[:, 0, 0]

    exact = [exact_overlap(a, b) for a, b in zip(first, other, strict=True)]
    assert_allclose(areas, exact, atol=1e-15)
    assert (np.array(exact)[150:] > 0).sum() > 100


def folded(points, faces):
    """Return True if a triangle between an edge of a face and its mean is reversed."""
    x = points[faces, :2]
    a, b = x - x.mean(axis=1, keepdims=True), np.roll(x, -1, axis=1) - x
    return (a[..., 0] * b[..., 1] < a[..., 1] * b[..., 0]).any()


def grid(counts, z, *, kind, up, distort=0.0, rng=None):
    """Return points and faces of a unit square at height z, anticlockwise from outside.

    kind : "quad", "triangle" or "mixed"
    up : True if the outward normal is +z
    distort : largest displacement of inner nodes, drawn by rng, relative to the cell
        size; draws with a folded face, which meshes of bodies do not have, are repeated
    """
    nx, ny = counts
    x, y = np.meshgrid(np.linspace(0, 1, nx + 1), np.linspace(0, 1, ny + 1))
    points = np.stack([x.ravel(), y.ravel(), np.full(x.size, z)], axis=-1)
    i = np.arange(x.size).reshape(x.shape)
    a, b, c, d = i[:-1, :-1], i[:-1, 1:], i[1:, 1:], i[1:, :-1]
    quads = np.stack([v.ravel() for v in (a, b, c, d)], axis=-1)
    halves = np.concatenate([quads[:, [0, 1, 2, 2]], quads[:, [0, 2, 3, 3]]])
    faces = {
        "quad": quads, "triangle": halves,
        "mixed": np.concatenate([quads[::2], halves[1 : len(quads) : 2],
                                 halves[len(quads) + 1 :: 2]]),
    }[kind]  # fmt: skip
    regular, inner = points, i[1:-1, 1:-1].ravel()
    while distort and (points is regular or folded(points, faces)):
        points = regular.copy()
        points[inner, :2] += rng.uniform(-distort, distort, (len(inner), 2)) / counts
    if up:
        return points, faces
    turned = faces[:, ::-1].copy()
    repeated = faces[:, -1] == faces[:, -2]
    if faces.shape[1] == 4:  # the repeated corner stays last
        turned[repeated] = faces[repeated][:, [2, 1, 0, 0]]
    return points, turned


def stacked(lower, upper, *, gap=0.0):
    """Return points, slave faces (top of the lower body) and master faces."""
    (p, slave), (q, master) = lower, upper
    return np.concatenate([p, q + np.array([0, 0, gap])]), slave, master + len(p)


KINDS = [
    ("quad", "quad", 0.0), ("quad", "quad", 0.2), ("triangle", "triangle", 0.2),
    ("quad", "triangle", 0.35), ("mixed", "quad", 0.2), ("triangle", "mixed", 0.35),
]  # fmt: skip


def nodal_areas(points, faces):
    """Return ∫N at all nodes; on a quadrilateral, N is linear on the four triangles
    around the mean of its corners."""
    total = np.zeros(len(points))
    for face in faces:
        corners = list(dict.fromkeys(face))
        x = points[corners]
        if len(corners) == 3:
            size = np.linalg.norm(np.cross(x[1] - x[0], x[2] - x[0])) / 2
            total[corners] += size / 3
            continue
        mean = x.mean(axis=0)
        for k in range(4):
            one, other = corners[k], corners[(k + 1) % 4]
            size = (
                np.linalg.norm(np.cross(points[one] - mean, points[other] - mean)) / 2
            )
            total[[one, other]] += size / 3
            total[corners] += size / 12
    return total


@pytest.mark.parametrize("basis", ["dual", "standard"])
@pytest.mark.parametrize(("one", "other", "distort"), KINDS)
def test_a_constant_pressure_gives_the_exact_nodal_forces(
    one, other, distort, basis, rng
):
    points, slave, master = stacked(
        grid((4, 4), 0.0, kind=one, up=True, distort=distort, rng=rng),
        grid((5, 3), 0.0, kind=other, up=False, distort=distort, rng=rng),
    )
    rows = face_mortar(points, np.zeros(points.size), slave, master, basis=basis)

    force = (rows.B.T @ rows.share).reshape(-1, 3)  # λ_j = p·∫N_j with p = 1

    expected = np.zeros_like(points)
    expected[:, 2] += nodal_areas(points, slave)
    expected[:, 2] -= nodal_areas(points, master)
    assert_allclose(force, expected, atol=1e-14)
    assert rows.share.sum() == pytest.approx(1, abs=1e-14)
    assert_allclose(rows.c, 0, atol=1e-15)


@pytest.mark.parametrize("basis", ["dual", "standard"])
def test_rows_have_neither_a_resultant_nor_a_moment_on_curved_sides(basis, rng):
    points, slave, master = stacked(
        grid((5, 4), 0.0, kind="quad", up=True, distort=0.2, rng=rng),
        grid((4, 6), 0.0, kind="mixed", up=False, distort=0.2, rng=rng),
    )
    points[:, 2] = 0.15 * np.sin(3 * points[:, 0]) * points[:, 1]
    points[np.unique(master), 2] += 0.05
    u = 0.01 * rng.standard_normal(points.size)

    rows = face_mortar(points, u, slave, master, basis=basis)

    x = points + u.reshape(-1, 3)
    for row in rows.B.toarray():
        force = row.reshape(-1, 3)
        assert_allclose(force.sum(axis=0), 0, atol=1e-14)
        assert_allclose(np.cross(x, force).sum(axis=0), 0, atol=1e-13)


def test_the_gap_of_parallel_sides_is_their_distance(rng):
    points, slave, master = stacked(
        grid((3, 4), 0.0, kind="quad", up=True, distort=0.2, rng=rng),
        grid((5, 2), 0.0, kind="triangle", up=False, distort=0.2, rng=rng), gap=0.3,
    )  # fmt: skip
    rows = face_mortar(points, np.zeros(points.size), slave, master)
    assert_allclose(rows.c, 0.3, atol=1e-14)
    # moving the master down by 0.1 leaves a gap of 0.2; c is for the total displacement
    u = np.zeros_like(points)
    u[np.unique(master), 2] = -0.1
    moved = face_mortar(points, u.ravel(), slave, master)
    assert_allclose(moved.c - moved.B @ u.ravel(), 0.2, atol=1e-14)
    assert_allclose(moved.c, 0.3, atol=1e-14)


def test_the_dual_basis_makes_D_diagonal(rng):
    points, slave, master = stacked(
        grid((4, 4), 0.0, kind="quad", up=True, distort=0.2, rng=rng),
        grid((5, 3), 0.0, kind="quad", up=False, distort=0.2, rng=rng),
    )
    rows = face_mortar(points, np.zeros(points.size), slave, master, basis="dual")
    own = rows.B.toarray().reshape(len(rows.c), -1, 3)[:, : len(rows.c), 2]
    assert_allclose(own, np.eye(len(rows.c)), atol=1e-13)


def test_tangential_rows_follow_the_motion_of_parallel_sides():
    points, slave, master = stacked(
        grid((3, 3), 0.0, kind="quad", up=True),
        grid((4, 2), 0.0, kind="quad", up=False),
    )
    rows = face_mortar(points, np.zeros(points.size), slave, master, tangential=True)
    assert rows.row.tolist() == np.repeat(np.arange(16), 2).tolist()
    u = np.zeros_like(points)
    motion = np.array([0.3, -0.4, 0.0])
    u[np.unique(slave)] = motion
    slip = (rows.T @ u.ravel()).reshape(-1, 2)
    assert_allclose(np.linalg.norm(slip, axis=1), 0.5, atol=1e-14)
    assert_allclose(rows.B @ u.ravel(), 0, atol=1e-14)


def test_only_covered_nodes_have_rows_and_half_covered_faces_pass_the_patch_test():
    points, slave, master = stacked(
        grid((4, 4), 0.0, kind="quad", up=True),
        grid((3, 3), 0.0, kind="quad", up=False),
    )
    upper = np.unique(master)
    # the edge of the master cuts slave faces
    points[upper, 0] = 0.30 + 0.4 * points[upper, 0]
    for basis in ("dual", "standard"):
        rows = face_mortar(points, np.zeros(points.size), slave, master, basis=basis)
        assert 0 < len(rows.c) < 25
        force = (rows.B.T @ rows.share).reshape(-1, 3)
        assert_allclose(
            force[upper, 2], -nodal_areas(points, master)[upper], atol=1e-13
        )
        assert force.sum() == pytest.approx(0, abs=1e-13)


def test_the_overlaps_cover_the_common_part_exactly_once(rng):
    points, slave, master = stacked(
        grid((20, 20), 0.0, kind="quad", up=True, distort=0.2, rng=rng),
        grid((17, 23), 0.0, kind="triangle", up=False, distort=0.2, rng=rng),
    )
    parts = [
        divided(current_surface(points, np.zeros(points.size), f, "side"))
        for f in (slave, master)
    ]
    at = overlaps(*parts, Reach())
    assert at.area.sum() == pytest.approx(1, abs=1e-12)
    assert (at.area > -1e-12).all()


def test_faces_are_searched_independently_of_each_other():
    """The slave side is steep, so that its faces require different numbers of search
    steps."""
    points, slave, master = stacked(
        grid((8, 8), 0.0, kind="quad", up=True),
        grid((6, 6), 0.0, kind="triangle", up=False),
        gap=0.02,
    )
    upper = np.unique(slave)
    points[upper, 2] += 0.8 * points[upper, 0] ** 3
    u = np.zeros(points.size)
    other = divided(current_surface(points, u, master, "master"))

    def found(faces):
        own = divided(current_surface(points, u, faces, "slave"))
        return overlaps(own, other, Reach()).area.sum()

    alone = [found(slave[[k]]) for k in range(len(slave))]
    assert found(slave) == pytest.approx(sum(alone), rel=1e-12)
    assert np.count_nonzero(alone) > len(slave) / 2


def test_a_face_without_area_is_refused():
    points = np.array(
        [[0.0, 0, 0], [1, 0, 0], [2, 0, 0], [0, 0, 1], [1, 0, 1], [0, 1, 1]]
    )
    faces = np.array([[0, 1, 2, 2]]), np.array([[3, 5, 4, 4]])
    with pytest.raises(
        InputError, match=r"contact slave: the face around .*has no area"
    ):
        face_mortar(points, np.zeros(18), *faces)
