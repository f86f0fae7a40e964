"""Tractions along contacts: positions of nodes and exact solutions."""

import numpy as np
import pytest

from mortarbench.problems import PROBLEMS
from mortarbench.reports.figures.maps import traction_maps
from mortarbench.reports.figures.tractions import (
    LOOKS,
    loaded_sides,
    places,
    traction_figure,
)
from mortarbench.solvers.baselines.projected_gradient import ProjectedGradient
from mortarbench.solvers.reference.solve import reference_solution


def solved(family, form="dual", **given):
    """Return the deformed state of the reference solution."""
    case = PROBLEMS[family].with_keys(**given).build(form, reference_solution)
    return case.fields(reference_solution(case.qp))


SHEARED = dict(n=8, m=8, load=0.1, friction="coulomb", mu=0.4, Q=0.6)


@pytest.mark.parametrize(
    ("family", "given"),
    [pytest.param("hertz-cylinder", SHEARED, marks=pytest.mark.slow),
     ("hertz-cylinder", {**SHEARED, "slave": "lower"}),
     ("half-plane", dict(n=60)),
     ("half-plane", dict(n=61, law="cattaneo", Q=0.7)),
     ("hertz-plane", dict(n=6, load=0.1))],
)  # fmt: skip
def test_the_nodes_lie_along_the_exact_curves(family, given):
    """Edges are left out, because exact tractions have vertical tangents there."""
    fields = solved(family, **given)
    (side,) = fields.contacts
    at, half = places(fields, side), side.exact[side.exact[:, 1] > 0, 0].max()
    inside = abs(at) < 0.9 * half
    for column, values in enumerate((side.pressure, side.shear), 1):
        if values is None:
            continue
        exact = np.interp(at, side.exact[:, 0], side.exact[:, column])
        off = np.linalg.norm((values - exact)[inside])
        assert off < 0.05 * np.linalg.norm(side.pressure[inside])


def test_markers_show_stick_and_slip_above_the_exact_line():
    fields = solved("hertz-cylinder", **SHEARED)
    (side,) = fields.contacts
    figure = traction_figure(fields)

    legend = [text.get_text() for text in figure.legends[0].get_texts()]
    assert legend == ["exact", "open", "stick", "slip"]
    for axes in figure.axes:
        drawn = {line.get_label(): line for line in axes.lines}
        assert drawn["exact"].get_linestyle() == "-"
        for state in ("stick", "slip"):
            assert drawn[state].get_color() == LOOKS[state][0]
            assert len(drawn[state].get_xdata()) == (side.friction == state).sum()
    labels = [axes.get_ylabel() for axes in figure.axes]
    assert labels == ["pressure in MPa", "shear in MPa"]


def test_without_friction_there_is_one_panel_and_without_load_no_side_is_drawn():
    fields = solved("hertz-plane", n=4)
    assert len(traction_figure(fields).axes) == 1
    (side,) = fields.contacts
    side.pressure[:] = 0
    assert loaded_sides(fields) == []


def test_nodes_that_slide_without_contact_have_shear_and_no_pressure():
    fields = solved(
        "beam-ring", "dual-bounds", Nr=4, Nh=2, steps=1, friction="tresca", bound=1e8
    )
    (side,) = fields.contacts
    apart = side.friction == "sliding without contact"

    assert abs(side.shear[apart]).max() > 1e7
    assert abs(side.pressure[apart]).max() < 1e-6 * side.pressure.max()


def point_contact(**given):
    """Return the deformed state of half-spaces, solved by the projected gradient."""
    family = PROBLEMS["half-space"].with_keys(**given)
    case = family.build("dual", reference_solution)
    return case.fields(ProjectedGradient().prepare(case.qp, 1e-8)())


def test_maps_show_pressure_shear_and_the_direction_of_slip():
    fields = point_contact(n=41, law="mindlin", nu=0.0, Q=0.6)
    (side,) = fields.contacts
    pressure, shear, state = traction_maps(fields).panels

    for panel, values in ((pressure, side.pressure), (shear, side.shear)):
        raster = panel.marks[0]
        shown = raster.values[np.isfinite(raster.values)]
        assert sorted(shown) == pytest.approx(sorted(values))
        assert raster.values == pytest.approx(raster.values[::-1], nan_ok=True)
    raster, contact, stick, arrows = state.marks
    names = np.array(raster.scale.names)
    kinds = names[raster.values[np.isfinite(raster.values)].astype(int)]
    assert (kinds == "stick").sum() == (side.friction == "stick").sum()
    assert (kinds == "slip").sum() == (side.friction == "slip").sum()
    # slipping cells are symmetric about the middle, and the upper body slips along +x
    assert (arrows.vectors[:, 0] > 0).all()
    assert abs(arrows.vectors[:, 1]).max() < 1e-9 * arrows.vectors.max()
    middles = arrows.feet + arrows.vectors / 2
    radii = np.linalg.norm(middles, axis=1)
    c, a = (np.linalg.norm(path.points, axis=1)[0] for path in (stick, contact))
    assert c / a == pytest.approx(0.4 ** (1 / 3), abs=3e-3)
    assert ((radii > 0.93 * c) & (radii < 1.02 * a)).all()
    assert middles.mean(axis=0) == pytest.approx([0, 0], abs=1e-9 * a)


def test_a_map_leaves_out_cells_without_contact():
    fields = point_contact(n=20)
    (panel,) = traction_maps(fields).panels
    (side,) = fields.contacts

    raster = panel.marks[0].values
    assert np.isnan(raster[0, 0])
    assert np.isfinite(raster).sum() == (side.pressure > 0).sum()
    assert panel.title == "pressure"
    side.pressure[:] = 0
    assert traction_maps(fields) is None
