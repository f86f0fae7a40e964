"""Pictures of solids: orthographic projection, hidden faces, colours."""

import numpy as np
import pytest

from mortarbench.harness import ContactSide, Fields
from mortarbench.harness.mechanics import boundary_facets
from mortarbench.problems.fem.mesh import Mesh, box, join
from mortarbench.reports.figures.deformed import deformed_figure
from mortarbench.reports.figures.drawing import draw_fields
from mortarbench.reports.figures.fields import ColourScale, Faces, Label, Path, Vectors
from mortarbench.reports.figures.projection import (
    camera_above,
    camera_seeing,
    camera_towards,
    crease_edges,
    face_normals,
    visible_faces,
)
from tests.support.hexahedra import TETRAHEDRA, WEDGES, degenerate, divided

CUBE = box((0.0, 0.0, 0.0), (1.0, 1.0, 1.0), (2, 2, 2))
SCALE = ColourScale(colours="viridis", low=0, high=1)


def state(mesh, contacts=(), bodies=None):
    stress = mesh.points @ [1e6, 0, 2e6]
    return Fields(
        points=mesh.points, cells=mesh.cells, displacement=0.001 * mesh.points,
        bodies=np.zeros(len(mesh.cells), dtype=int) if bodies is None else bodies,
        nodal={"von_mises": stress}, contacts=contacts,
    )  # fmt: skip


@pytest.mark.parametrize("normal", [*np.eye(3), *-np.eye(3), [1, -1, -1], [0, 0, 0]])
def test_the_camera_sees_a_side_and_three_sides_of_a_box(normal):
    normal = np.array(normal) / max(np.linalg.norm(normal), 1)
    camera = camera_seeing(normal)

    axes = np.array(camera)
    np.testing.assert_allclose(axes @ axes.T, np.eye(3), atol=1e-15)
    assert np.linalg.det(axes) == pytest.approx(1)
    if normal.any():
        assert normal @ camera.towards > 0.3
    assert (abs(camera.towards) > 0.3).all()
    assert camera.up[2] > 0.5


def test_projection_keeps_lengths_across_the_view():
    camera = camera_towards(np.array([0.0, 0.0, -2.0]))
    x = np.random.default_rng(1).standard_normal((20, 3))
    flat = camera.project(x)

    assert np.linalg.norm(flat, axis=1) == pytest.approx(np.hypot(x[:, 0], x[:, 1]))


def test_faces_towards_the_camera_are_drawn_with_their_values_back_to_front():
    facets = boundary_facets(CUBE.cells, 3)
    camera = camera_towards(np.array([0.6, -0.5, 0.7]))
    faces = visible_faces(
        camera, CUBE.points, facets, CUBE.points[:, 2], SCALE, mesh=True
    )
    outlines = np.isnan(faces.values)

    assert (face_normals(CUBE.points, facets) @ camera.towards > 0).sum() == 12
    tiles = (~outlines).sum() / 12  # per visible face; 24 in all
    # the total length of the pieces of outlines is the length of all face edges
    pieces = faces.corners[outlines]
    assert len(pieces) == 12 * 4 * np.sqrt(tiles)
    assert (pieces[:, 0] == pieces[:, 3]).all()
    assert (pieces[:, 1] == pieces[:, 2]).all()
    edges = camera.project(0.5 * np.eye(3))
    length = np.linalg.norm(pieces[:, 1] - pieces[:, 0], axis=1).sum()
    assert length == pytest.approx(16 * np.linalg.norm(edges, axis=1).sum())
    # the silhouette of a cube is covered once
    x, y = np.moveaxis(faces.corners[~outlines], -1, 0)
    area = (x * np.roll(y, -1, axis=1) - y * np.roll(x, -1, axis=1)).sum(axis=1) / 2
    assert (area > 0).all()
    assert area.sum() == pytest.approx(camera.towards @ [1, -1, 1])
    # the value is 1 on the top and smaller elsewhere
    assert np.nanmax(faces.values) == pytest.approx(1)
    tops = (faces.values[~outlines] > 1 - 1e-9).sum()
    assert tops == 4 * tiles


def test_a_large_face_is_not_drawn_over_a_small_body_on_it():
    """The centre of the table is nearer to the camera than the back of the block."""
    table, block = box((-9, -1, -1), (20, 9, 1), (1, 1, 1)), box((0, 5, 0), (1, 1, 1),
                                                                 (1, 1, 1))  # fmt: skip
    mesh, _ = join((table, block))
    camera = camera_above(np.array([0.0, 0.0, -1.0]))
    values = np.repeat([0.25, 0.75], 8)
    facets = boundary_facets(mesh.cells, 3)
    drawn = visible_faces(camera, mesh.points, facets, values, SCALE, mesh=False)
    front = camera.project(np.array([0.5, 5.0, 0.6]))  # on the front of the block
    middles = drawn.corners.mean(axis=1)
    around = np.abs(middles - front).max(axis=1) < 0.15

    assert drawn.values[around][-1] == pytest.approx(0.75)


@pytest.mark.parametrize("normal", [*np.eye(3), *-np.eye(3)])
def test_a_camera_above_looks_down_at_vertical_sides(normal):
    camera = camera_above(normal)

    assert camera.towards[2] > 0.3
    assert normal[2] or normal @ camera.towards > 0.3


def test_friction_is_drawn_as_arrows_by_state_along_the_tractions():
    top = np.flatnonzero(CUBE.points[:, 2] == 1)
    force = np.zeros((9, 3))
    force[:3] = [[0, 2, 0], [1, 0, 0], [0, 0, 0]]
    area = np.full(9, 0.25)
    side = ContactSide(
        name="cube on wall", nodes=top, length=area, force=force, pressure=area,
        gap=0 * area, friction=np.array(["slip", "stick", "stick", *["open"] * 6]),
        friction_force=force,
    )  # fmt: skip
    panel = deformed_figure(state(CUBE, (side,))).panels[1]
    slip, stick = sorted(
        (m for m in panel.marks if isinstance(m, Vectors)), key=lambda m: m.colour
    )[::-1]

    assert panel.title.splitlines()[1:] == [
        "arrows: friction on the slave, at most 8 Pa",
        "stick: blue (2), slip: red (1), open: grey (6)",
    ]
    assert slip.colour != stick.colour
    np.testing.assert_allclose(slip.feet, CUBE.points[top[:1], :2])
    np.testing.assert_allclose(slip.vectors[0] / stick.vectors[0, 0], [0, 2])
    assert stick.vectors[0, 1] == 0 < stick.vectors[0, 0]


def test_a_body_behind_another_is_drawn_first():
    far, near = (box((0.0, y, 0.0), (1.0, 1.0, 1.0), (1, 1, 1)) for y in (2.0, 0.0))
    mesh, _ = join((far, near))
    camera = camera_towards(np.array([0.1, -1.0, 0.1]))
    values = np.repeat([0.25, 0.75], 8)
    facets = boundary_facets(mesh.cells, 3)
    drawn = visible_faces(camera, mesh.points, facets, values, SCALE, mesh=False).values

    assert (np.diff(drawn) >= -1e-12).all()
    assert drawn[[0, -1]] == pytest.approx([0.25, 0.75])


def test_creases_of_a_cube_are_its_edges_towards_the_camera():
    camera = camera_towards(np.array([0.6, -0.5, 0.7]))
    for mesh in (CUBE, divided(CUBE, TETRAHEDRA), degenerate(divided(CUBE, WEDGES))):
        facets = boundary_facets(mesh.cells, 3)
        edges = crease_edges(camera, mesh.points, facets, np.radians(40))
        assert len(edges) == 9 * 2  # three of the twelve edges are behind


@pytest.mark.parametrize("corners", [None, TETRAHEDRA, WEDGES])
def test_a_figure_shows_the_bodies_and_the_pressure_on_their_contact(corners):
    mesh = CUBE if corners is None else divided(CUBE, corners)
    nodes = np.unique(CUBE.boundaries["bottom"])
    pressure = np.where(mesh.points[nodes, 0] == 0.5, 3e3, 0.0)
    side = ContactSide(
        name="cube on rigid", nodes=nodes, length=np.full(9, 1 / 9),
        force=np.zeros((9, 3)), pressure=pressure, gap=np.zeros(9),
    )  # fmt: skip
    figure = deformed_figure(state(mesh, (side,)), 50.0)
    bodies, contact = figure.panels

    assert "displacement × 50" in bodies.title
    assert "cube on rigid" in contact.title
    assert [panel.scale.label for panel in figure.panels] == [
        "von Mises stress in MPa", "contact pressure in kPa"
    ]  # fmt: skip
    (drawn,) = (mark for mark in contact.marks if isinstance(mark, Faces))
    assert np.nanmax(drawn.values) <= 3e3
    assert np.nanmax(drawn.values) > 2.5e3
    names = [mark.text for mark in bodies.marks if isinstance(mark, Label)]
    assert names == ["$x$", "$y$", "$z$"]
    assert sum(isinstance(mark, Path) for mark in bodies.marks) == 18
    # seen from below: the contact faces the camera
    (surface,) = (mark for mark in bodies.marks if isinstance(mark, Faces))
    assert np.nanmin(surface.values) < 0.1e6
    draw_fields(figure).canvas.draw()


def test_bodies_without_contact_have_one_panel():
    figure = deformed_figure(state(CUBE))

    assert len(figure.panels) == 1


def test_faces_between_cells_of_different_kinds_are_inside():
    """The mesh consists of two wedges and an adjacent hexahedron."""
    pair = box((0.0, 0.0, 0.0), (2.0, 1.0, 1.0), (2, 1, 1))
    first = Mesh(pair.points, pair.cells[:1], {})
    cells = np.vstack([degenerate(divided(first, WEDGES)).cells, pair.cells[1:]])
    faces = boundary_facets(cells, 3)

    assert (faces[:, 2] == faces[:, 3]).sum() == 4
    assert len(faces) == 4 + 3 + 5
    area = np.linalg.norm(face_normals(pair.points, faces), axis=1).sum() / 2
    assert area == pytest.approx(10)
