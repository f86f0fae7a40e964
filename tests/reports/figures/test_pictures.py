"""Pictures of two rectangles, compared with the fields that they show."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from matplotlib.collections import TriMesh
from matplotlib.quiver import Quiver

from mortarbench.harness import ContactSide, Fields, InputError
from mortarbench.reports.figures.deformed import (
    FRICTION,
    automatic_scale,
    deformed_figure,
    edges,
    outlines,
    triangles,
)
from mortarbench.reports.figures.drawing import draw_fields
from mortarbench.reports.figures.fields import Label, Strokes, Vectors
from mortarbench.reports.figures.style import look, save
from mortarbench.reports.figures.tractions import loaded_sides

LOWER, UPPER = 3, 6  # columns of cells


def rectangle(columns, width, height, bottom):
    """Return one row of cells: (2·columns + 2, 2) points and (columns, 4) cells."""
    x = np.linspace(0, width, columns + 1)
    points = [
        np.column_stack([x, np.full_like(x, y)]) for y in (bottom, bottom + height)
    ]
    i = np.arange(columns)
    cells = np.column_stack([i, i + 1, i + columns + 2, i + columns + 1])
    return np.vstack(points), cells


@pytest.fixture
def bodies():
    low, low_cells = rectangle(LOWER, 2.0, 0.4, 0.0)
    up, up_cells = rectangle(UPPER, 2.0, 0.3, 0.45)
    points = np.vstack([low, up])
    stress = np.linspace(0, 4e9, len(points))
    stress[-1] = 1e12  # a corner singularity
    return Fields(
        points=points,
        cells=np.vstack([low_cells, up_cells + len(low)]),
        bodies=np.repeat([0, 1], [LOWER, UPPER]),
        displacement=np.column_stack([0 * points[:, 0], -0.05 * points[:, 0]]),
        nodal={"von_mises": stress},
        contact_nodes=np.arange(LOWER + 1, 2 * LOWER + 2),
        contact_forces=np.array([[0, 0], [0, -1e6], [1e6, -2e6], [0, 0]]),
    )


def unloaded(fields):
    return Fields(
        **{k: v for k, v in vars(fields).items() if not k.startswith("contact")}
    )


def artists(axes, kind):
    return [a for a in axes.get_children() if isinstance(a, kind)]


def test_the_outline_of_a_strip_is_one_closed_loop_through_its_boundary():
    _, cells = rectangle(2, 1.0, 1.0, 0.0)
    (loop,) = outlines(cells)
    assert loop[0] == loop[-1]
    start = list(loop).index(0)
    assert list(np.roll(loop[:-1], -start)) == [0, 1, 2, 5, 4, 3]  # counter-clockwise


def test_every_body_and_every_hole_has_a_separate_loop(bodies):
    assert sorted(len(loop) - 1 for loop in outlines(bodies.cells)) == [8, 14]
    i = np.arange(6)  # an annulus of six cells
    annulus = np.column_stack([i, (i + 1) % 6, (i + 1) % 6 + 6, i + 6])
    assert sorted(len(loop) - 1 for loop in outlines(annulus)) == [6, 6]


def test_cells_that_meet_in_one_node_only_keep_their_sides():
    cells = np.array([[0, 1, 2, 3], [2, 4, 5, 6]])
    sides = {frozenset(pair) for loop in outlines(cells) for pair in pairwise(loop)}
    assert len(sides) == 8


def test_bodies_are_drawn_at_their_displaced_positions(bodies):
    axes = draw_fields(deformed_figure(bodies)).axes[0]
    moved = bodies.points + bodies.displacement
    for mesh, nodes in zip(artists(axes, TriMesh), (8, 14), strict=True):
        drawn = mesh._triangulation
        used = np.unique(drawn.triangles)
        assert len(used) == nodes
        np.testing.assert_allclose(np.column_stack([drawn.x, drawn.y]), moved)
    corners = {tuple(np.round(p, 12)) for p in moved}
    outline = [line for line in axes.lines if line.get_linestyle() == "-"]
    assert {tuple(np.round(p, 12)) for line in outline for p in line.get_xydata()} == (
        corners
    )
    assert axes.get_aspect() == 1


def test_two_triangles_cover_each_quadrilateral(bodies):
    meshes = artists(draw_fields(deformed_figure(bodies)).axes[0], TriMesh)
    # The shear by −0.05 x preserves areas and moves the centre (1, y) to (1, y − 0.05).
    for mesh, area, middle in zip(meshes, (0.8, 0.6), (0.15, 0.55), strict=True):
        t = mesh._triangulation
        corners = np.column_stack([t.x, t.y])[t.triangles]
        sides = corners[:, 1:] - corners[:, :1]
        areas = np.linalg.det(sides) / 2
        centre = areas @ corners.mean(axis=1) / areas.sum()
        assert (areas > 0).all()
        assert areas.sum() == pytest.approx(area)
        np.testing.assert_allclose(centre, [1, middle])


def test_all_bodies_share_one_scale_despite_a_singularity(bodies):
    calm = bodies.nodal["von_mises"].copy()
    many = np.concatenate([calm, np.full(600, 2e9)])  # one node in 600 is singular
    points = np.vstack([bodies.points, np.zeros((600, 2))])
    fields = Fields(
        points=points, cells=bodies.cells, bodies=bodies.bodies,
        displacement=np.zeros_like(points), nodal={"von_mises": many},
    )  # fmt: skip
    meshes = artists(draw_fields(deformed_figure(fields)).axes[0], TriMesh)
    limits = {mesh.get_clim() for mesh in meshes}
    assert len(limits) == 1
    low, high = limits.pop()
    assert low == 0
    assert 1e9 < high <= 4e9  # Pa, although the singularity has 1000 GPa
    assert meshes[0].get_array().max() == 1000e9  # only the colour is clipped


def test_arrows_end_at_loaded_nodes_in_the_direction_of_the_force(bodies):
    overview, zoom = draw_fields(deformed_figure(bodies)).axes[:2]
    assert not artists(overview, Quiver)
    (arrows,) = artists(zoom, Quiver)
    moved = bodies.points + bodies.displacement
    drawn = np.column_stack([arrows.U, arrows.V])
    tips = moved[bodies.contact_nodes[1:3]]
    np.testing.assert_allclose(arrows.XY + drawn, tips)
    assert arrows.pivot == "tail"
    forces = bodies.contact_forces[1:3]
    np.testing.assert_allclose(drawn / drawn[0, 1], forces / forces[0, 1])
    assert "2.24 MN/m" in zoom.get_title(loc="left")
    (x0, x1), (y0, y1) = zoom.get_xlim(), zoom.get_ylim()
    tails = arrows.XY
    assert ((x0 < tails[:, 0]) & (tails[:, 0] < x1)).all()
    assert ((y0 < tails[:, 1]) & (tails[:, 1] < y1)).all()


def side(name, nodes, forces):
    """Return a contact side with the given nodal forces."""
    forces = np.array(forces, dtype=float)
    ones = np.ones(len(forces))
    return ContactSide(
        name=name, nodes=np.array(nodes), length=ones, force=forces, pressure=ones,
        gap=0 * ones,
    )  # fmt: skip


def test_each_loaded_contact_has_an_enlargement_with_its_forces(bodies):
    pairs = (
        side("up on low", [4, 5], [[0, 0], [0, -3e6]]),
        side("idle", [8, 9], [[0, 0], [0, 0]]),
        side("low on floor", [0, 1], [[0, 5e3], [0, 4e3]]),
    )
    figure = deformed_figure(replace(bodies, contacts=pairs))
    titles = [panel.title for panel in figure.panels]
    arrows = [p.marks[-1] for p in figure.panels[1:]]

    assert titles[0].startswith("(a) ")
    assert titles[1].startswith("(b) up on low: contact forces")
    assert titles[1].endswith("on the slave nodes, largest 3 MN/m")
    assert titles[2].startswith("(c) low on floor: contact forces")
    assert len(figure.panels) == len(figure.heights) == 3
    assert [len(a.feet) for a in arrows] == [1, 2]
    framed = [m.text for m in figure.panels[0].marks if isinstance(m, Label)]
    assert framed == ["(b)", "(c)"]
    for panel, pair in zip(figure.panels[1:], (pairs[0], pairs[2]), strict=True):
        loaded = pair.nodes[np.abs(pair.force[:, 1]) > 0]
        tips = (bodies.points + bodies.displacement)[loaded]
        assert (tips >= panel.low).all()
        assert (tips <= panel.high).all()


def test_forces_of_sticking_and_slipping_nodes_differ_in_colour(bodies):
    pair = side("up on low", [4, 5, 0, 1], [[1, -3], [0, -2], [1, -1], [0, 0]])
    states = np.array(["slip", "stick", "slip", "open"])
    rough = replace(pair, shear=pair.gap, friction=states)
    _, zoom = deformed_figure(replace(bodies, contacts=(rough,))).panels
    slip, stick = zoom.marks[-2:]

    assert zoom.title.endswith("\nstick: blue (1), slip: red (2)")
    assert (len(stick.feet), len(slip.feet)) == (1, 2)
    assert stick.colour != slip.colour


@pytest.mark.parametrize(
    ("state", "key"),
    [
        ("sliding without contact", "sliding without contact: orange (2)"),
        ("open", "open: grey (2)"),  # in older results, open nodes may have forces
    ],
)
def test_nodes_with_shear_only_do_not_change_the_enlargement(bodies, state, key):
    pair = side("up on low", [4, 5, 0, 1], [[1, -3], [1, -2], [1, 0], [1, 0]])
    states = np.array(["slip", "stick", state, state])
    rough = replace(pair, shear=pair.gap, friction=states)
    closed = replace(
        pair, nodes=pair.nodes[:2], force=pair.force[:2], gap=pair.gap[:2],
        pressure=pair.pressure[:2], length=pair.length[:2], shear=pair.gap[:2],
        friction=states[:2],
    )  # fmt: skip
    one, other = (
        deformed_figure(replace(bodies, contacts=(side,))).panels[1]
        for side in (rough, closed)
    )
    assert (one.low, one.high) == (other.low, other.high)
    assert one.title.endswith(f"slip: red (1), {key}")
    wide = [m.width for m in one.marks if isinstance(m, Vectors) and m.cased]
    thin = [m.width for m in one.marks if isinstance(m, Vectors) and not m.cased]
    assert len(wide) == 2
    assert all(width < min(wide) for width in thin)


def test_sliding_without_contact_is_coloured_up_to_half_edges(
    bodies,
):
    """Two of four nodes slide without contact; both panels show this."""
    pair = side("up on low", [4, 5, 0, 1], [[0, -3], [0, -2], [1, 0], [0, 0]])
    states = np.array(["slip", "stick"] + 2 * ["sliding without contact"])
    rough = replace(pair, shear=pair.gap, friction=states)
    whole, zoom = deformed_figure(replace(bodies, contacts=(rough,)), 1).panels
    there = bodies.points + bodies.displacement
    a, b, c = there[[5, 0, 1]]
    expected = [(b, (b + c) / 2), (b, (a + b) / 2), (c, (b + c) / 2)]

    for panel in (whole, zoom):
        (band,) = [m for m in panel.marks if isinstance(m, Strokes) and m.width > 1]
        assert band.colour == FRICTION["sliding without contact"][0]
        np.testing.assert_allclose(band.ends, expected)
    assert "orange (2)" in zoom.title


@pytest.mark.parametrize("factor", [1e-7, 3e-4, 1e-2, 1.0])
def test_displacements_too_small_to_see_are_drawn_larger_by_a_round_factor(
    bodies, factor
):
    small = replace(bodies, displacement=factor * bodies.displacement)
    span = np.ptp(bodies.points, axis=0).max()
    scale = automatic_scale(small)
    part = scale * np.abs(small.displacement).max() / span
    assert part >= 0.01
    if scale != 1:
        assert 0.02 <= part <= 0.05
        assert f"{scale:e}"[0] in "125"
        assert f"{scale:.0e}" == f"{scale:e}".replace(".000000", "")
    assert f"displacement × {scale:g};" in deformed_figure(small).panels[0].title


@pytest.mark.parametrize(("parts", "numbered"), [(3, True), (9, True), (None, False)])
def test_subdomains_are_outlined_and_numbered_in_their_own_cells(
    bodies, parts, numbered
):
    number = None if parts is None else np.arange(LOWER + UPPER) * parts // 9
    (panel, *_) = deformed_figure(replace(bodies, subdomains=number)).panels
    labels = [m for m in panel.marks if isinstance(m, Label) and m.text.isdigit()]
    assert {int(m.text) for m in labels} == (set(range(parts)) if numbered else set())
    points = bodies.points + bodies.displacement
    for label in labels:
        own = points[bodies.cells[number == int(label.text)]].reshape(-1, 2)
        assert (own.min(axis=0) < label.place).all()
        assert (label.place < own.max(axis=0)).all()


def test_bodies_that_do_not_move_are_drawn_as_they_are(bodies):
    still = replace(bodies, displacement=np.zeros_like(bodies.displacement))
    assert automatic_scale(still) == 1
    assert automatic_scale(bodies) == 1


def test_enlarged_contacts_are_not_magnified(bodies):
    """Bodies in contact would overlap if displacements were magnified."""
    one, four = (deformed_figure(bodies, scale).panels[1] for scale in (1.0, 4.0))

    (field, *_) = (m for m in deformed_figure(bodies, 4.0).panels[0].marks)
    np.testing.assert_allclose(field.points, bodies.points + 4 * bodies.displacement)
    assert (one.low, one.high) == (four.low, four.high)
    np.testing.assert_array_equal(one.marks[-1].feet, four.marks[-1].feet)
    assert one.title.startswith("(b) contact forces")
    assert four.title.startswith("(b) displacement × 1: contact forces")


@pytest.mark.parametrize(
    ("size", "unit", "name"),
    [(1.0, 1.0, "m"), (0.05, 1e-3, "mm"), (5e-5, 1e-6, "µm"), (1e-9, 1e-6, "µm")],
)
def test_axes_use_a_unit_that_fits_their_size(bodies, size, unit, name):
    small = replace(
        bodies, points=size * bodies.points / 2, displacement=0 * bodies.displacement
    )
    (panel, *_) = deformed_figure(small).panels

    assert panel.unit == unit
    assert panel.xlabel == f"$x$ in {name}"


def test_triangles_are_drawn_once_without_degenerate_edges():
    cells = np.array([[0, 1, 2, 2], [0, 2, 3, 3], [3, 2, 4, 5]])

    assert sorted(map(sorted, triangles(cells).tolist())) == [
        [0, 1, 2], [0, 2, 3], [2, 3, 4], [3, 4, 5],
    ]  # fmt: skip
    assert len(edges(cells)) == 8
    (loop,) = outlines(cells)
    assert sorted(loop[:-1]) == [0, 1, 2, 3, 4, 5]


def test_without_contact_forces_there_is_one_panel(bodies):
    figure = draw_fields(deformed_figure(unloaded(bodies)))
    assert len(figure.axes) == 2  # bodies and colour bar
    assert "displacement × 1" in figure.axes[0].get_title(loc="left")


def test_without_stress_bodies_have_a_uniform_colour(bodies):
    fields = Fields(**{**vars(unloaded(bodies)), "nodal": {}})
    figure = draw_fields(deformed_figure(fields))
    assert len(figure.axes) == 1
    assert len(artists(figure.axes[0], TriMesh)) == 2


@pytest.mark.parametrize(
    ("ending", "start"),
    [("png", b"\x89PNG"), ("pdf", b"%PDF"), ("svg", b"<?xml")],
)
def test_pictures_have_reproducible_bytes(bodies, tmp_path, ending, start):
    first, second = tmp_path / f"a.{ending}", tmp_path / f"b.{ending}"
    save(draw_fields(deformed_figure(unloaded(bodies))), first)
    save(draw_fields(deformed_figure(unloaded(bodies))), second)
    assert first.read_bytes().startswith(start)
    assert first.read_bytes() == second.read_bytes()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda b: {"displacement": b.displacement * np.nan}, "NaN"),
        (lambda b: {"points": 0 * b.points}, "bodies have no width or no height"),
    ],
)
def test_bodies_that_cannot_be_drawn_are_refused(bodies, change, message):
    with pytest.raises(InputError, match=message):
        deformed_figure(replace(bodies, **change(bodies)))


def test_an_unknown_picture_format_is_refused(bodies, tmp_path):
    with pytest.raises(InputError, match=r"'\.gif'.*known: \.pdf, \.png, \.svg$"):
        save(draw_fields(deformed_figure(bodies)), tmp_path / "a.gif")


def test_bodies_in_3d_have_no_tractions_along_a_line(bodies):
    def lifted(values):
        return np.column_stack([values, np.arange(float(len(values)))])

    space = replace(
        bodies, points=lifted(bodies.points), displacement=lifted(bodies.displacement)
    )
    loaded = (side("up on low", [4, 5], [[0, 0], [0, -3e6]]),)
    assert loaded_sides(replace(bodies, contacts=loaded)) == [*loaded]
    assert loaded_sides(replace(space, contacts=loaded)) == []


def test_numbers_of_very_many_subdomains_are_left_out(bodies):
    many = replace(
        bodies, cells=np.repeat(bodies.cells, 20, axis=0),
        bodies=np.repeat(bodies.bodies, 20), subdomains=np.arange(9 * 20),
    )  # fmt: skip
    (panel, *_) = deformed_figure(many).panels
    assert not [m for m in panel.marks if isinstance(m, Label) and m.text.isdigit()]


def test_fifty_solvers_look_different_from_each_other():
    names = [f"solver {i}" for i in range(50)]
    looks = {(of["color"], of["marker"]) for of in (look(names, n) for n in names)}

    assert len(looks) == 50
