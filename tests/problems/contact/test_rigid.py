"""Contact with rigid bodies: gaps, normals, derivatives, three-dimensional surfaces."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mortarbench.harness import InputError
from mortarbench.problems.contact.rigid import (
    RigidCylinder,
    RigidPlane,
    RigidSphere,
    rigid_rows,
)
from mortarbench.problems.contact.rows import without_fixed
from mortarbench.problems.contact.surface import current_surface, tangents
from mortarbench.problems.fem.mesh import box, dofs_of, nodal_lengths, rectangle
from tests.support.hexahedra import TETRAHEDRA, divided

SLANTED = tuple(Rotation.from_rotvec([0.4, -1.1, 0.7]).apply([0, 0, 1]))
BODIES = {
    "plane": RigidPlane((0.2, -0.1, -0.3), SLANTED),
    "sphere": RigidSphere((0.4, 0.6, -2.0), 1.9),
    "cylinder": RigidCylinder((0.4, 0.6, -2.0), SLANTED, 1.7),
}
BLOCK = box((0.0, 0.0, 0.0), (1.0, 1.5, 0.5), (2, 3, 1))


def closest(body, x):
    """Return the point of the surface of a rigid body that is closest to x."""
    if isinstance(body, RigidPlane):
        n = np.array(body.normal)
        return x - n * ((x - body.point) @ n)
    foot = np.array(body.centre if isinstance(body, RigidSphere) else body.point)
    if isinstance(body, RigidCylinder):
        a = np.array(body.axis)
        foot = foot + a * ((x - foot) @ a)
    return foot + body.radius * (x - foot) / np.linalg.norm(x - foot)


@pytest.mark.parametrize("name", BODIES)
def test_gaps_are_signed_distances_and_normals_their_gradients(name):
    body, rng = BODIES[name], np.random.default_rng(31)
    x = rng.uniform(-3, 3, (200, 3))
    gap, normal = body.gap(x)

    for at, distance, n in zip(x, gap, normal, strict=True):
        foot = closest(body, at)
        assert abs(distance) == pytest.approx(np.linalg.norm(at - foot))
        assert at - foot == pytest.approx(distance * n, abs=1e-12)
    step = 1e-6
    for k, axis in enumerate(np.eye(3)):
        slope = (body.gap(x + step * axis)[0] - body.gap(x - step * axis)[0]) / (
            2 * step
        )
        assert slope == pytest.approx(normal[:, k], abs=1e-7)


@pytest.mark.parametrize("name", BODIES)
def test_rows_are_the_gap_to_first_order(name):
    """c − B(u + h) = g(x + h) + O(h²); for planes, only rounding errors remain."""
    body, rng = BODIES[name], np.random.default_rng(17)
    u, h = 0.1 * rng.standard_normal((2, BLOCK.dofs))
    side = BLOCK.boundaries["bottom"]
    nodes = np.unique(side)
    rows = rigid_rows(BLOCK.points, u, side, body)
    errors = []
    for part in (0.02, 0.01):
        x = (BLOCK.points.ravel() + u + part * h).reshape(-1, 3)[nodes]
        errors.append(abs(rows.c - rows.B @ (u + part * h) - body.gap(x)[0]).max())

    assert (rows.B @ rows.B.T - np.eye(nodes.size)).max() <= 1e-15
    assert rows.share.sum() == pytest.approx(1.5)
    if name == "plane":
        assert max(errors) <= 1e-14
    else:
        assert errors[0] / errors[1] == pytest.approx(4, rel=0.05)


def test_a_node_that_is_clamped_has_no_row():
    side, u = BLOCK.boundaries["bottom"], np.zeros(BLOCK.dofs)
    clamped = np.flatnonzero(BLOCK.points[:, 0] == 0)
    every = rigid_rows(BLOCK.points, u, side, BODIES["plane"], tangential=True)
    rows = without_fixed(every, dofs_of(clamped, 3))

    assert BLOCK.points[np.unique(side)[rows.place], 0].min() == 0.5
    assert (rows.B != every.B[rows.place]).nnz == 0
    assert rows.share == pytest.approx(every.share[rows.place])
    assert rows.row.tolist() == np.repeat(np.arange(rows.c.size), 2).tolist()


def test_tangents_in_space_are_orthonormal_and_right_handed():
    normal = np.random.default_rng(3).standard_normal((500, 3))
    normal[:6] = np.vstack([np.eye(3), -np.eye(3)])
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    frame = np.concatenate([tangents(normal), normal[:, None]], axis=1)

    identity = np.broadcast_to(np.eye(3), frame.shape)
    np.testing.assert_allclose(frame @ frame.transpose(0, 2, 1), identity, atol=1e-14)
    np.testing.assert_allclose(np.linalg.det(frame), 1, rtol=1e-13)


def test_slip_over_a_plane_is_the_motion_along_it():
    """The slip is u_x on the plane y = 0 in 2D, and (u_x, u_y) on the plane z = 0 in
    3D."""
    for mesh, ground in (
        (rectangle((0, 0), (1, 1), (3, 1)), RigidPlane((0.0, 0.0), (0.0, 1.0))),
        (BLOCK, RigidPlane((0.0, 0.0, 0.0), (0.0, 0.0, 1.0))),
    ):
        side, dim = mesh.boundaries["bottom"], mesh.dim
        rows = rigid_rows(
            mesh.points, np.zeros(mesh.dofs), side, ground, tangential=True
        )
        u = np.random.default_rng(5).standard_normal(mesh.dofs)
        nodes = side if dim == 2 else np.unique(side)
        moved = u.reshape(-1, dim)[nodes]
        assert rows.T @ u == pytest.approx(moved[:, :-1].ravel())
        assert rows.B @ u == pytest.approx(-moved[:, -1])
        assert rows.B.nnz == nodes.size
        assert rows.row.tolist() == np.repeat(np.arange(nodes.size), dim - 1).tolist()


def test_normals_and_areas_of_a_side_in_space_follow_its_rotation():
    turn = Rotation.from_rotvec([0.2, 0.5, -0.9]).as_matrix()
    for mesh in (BLOCK, divided(BLOCK, TETRAHEDRA)):
        facets = BLOCK.boundaries["top"]
        if mesh is not BLOCK:
            facets = np.concatenate([facets[:, [0, 1, 2, 2]], facets[:, [0, 2, 3, 3]]])
        u = (BLOCK.points @ turn.T - BLOCK.points).ravel()
        side = current_surface(BLOCK.points, u, facets, "slave")
        assert side.normal == pytest.approx(np.tile(turn[:, 2], (len(facets), 1)))
        assert side.node_normal == pytest.approx(np.tile(turn[:, 2], (12, 1)))
        assert side.areas.sum() == pytest.approx(1.5)
    # nodes on the edge between two sides have the mean of both normals
    corner = np.concatenate([BLOCK.boundaries["top"], BLOCK.boundaries["right"]])
    side = current_surface(BLOCK.points, np.zeros(BLOCK.dofs), corner, "slave")
    on_edge = (side.x[:, 0] == 1) & (side.x[:, 2] == 0.5)
    assert side.node_normal[on_edge] == pytest.approx(
        np.tile([np.sqrt(0.5), 0, np.sqrt(0.5)], (4, 1))
    )


def test_a_face_without_area_and_a_node_at_a_centre_are_refused():
    faces = np.array([[0, 1, 2, 2]])  # three nodes on a line
    with pytest.raises(InputError, match="contact slave: the face around"):
        current_surface(BLOCK.points, np.zeros(BLOCK.dofs), faces, "slave")
    ball = RigidSphere((0.5, 0.5, 0.0), 1.0)
    with pytest.raises(InputError, match="at the centre of a rigid sphere"):
        rigid_rows(BLOCK.points, np.zeros(BLOCK.dofs), BLOCK.boundaries["bottom"], ball)


def test_shares_of_a_chain_are_lengths():
    mesh = rectangle((0, 0), (1, 1), (3, 1))
    chain, disc = mesh.boundaries["bottom"], RigidSphere((0.5, -1.0), 0.9)
    rows = rigid_rows(mesh.points, np.zeros(mesh.dofs), chain, disc)

    assert rows.share == pytest.approx(nodal_lengths(mesh.points[chain]))
    assert rows.c == pytest.approx(np.hypot(mesh.points[chain, 0] - 0.5, 1) - 0.9)
