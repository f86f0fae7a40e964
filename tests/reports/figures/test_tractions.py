"""Tractions along contacts: positions of nodes and exact solutions."""

import numpy as np
import pytest

from mortarbench.problems import PROBLEMS
from mortarbench.reports.figures.tractions import LOOKS, places, traction_figure
from mortarbench.solvers.reference.solve import reference_solution


def solved(family, form="dual", **given):
    """Return the deformed state of the reference solution."""
    family = PROBLEMS[family]
    case = family.build(form, family.complete(given), reference_solution)
    return case.fields(reference_solution(case.qp))


SHEARED = dict(n=8, m=8, load=0.1, friction="coulomb", mu=0.4, Q=0.6)


@pytest.mark.parametrize(
    ("family", "given"),
    [("hertz-cylinder", SHEARED),
     ("hertz-cylinder", {**SHEARED, "slave": "lower", "Q": 0.2, "peak": 0.6}),
     ("half-plane", dict(n=60)),
     ("half-plane", dict(n=61, law="cattaneo", Q=0.2, peak=0.7)),
     ("hertz-plane", dict(n=6, load=0.1))],
)  # fmt: skip
def test_the_nodes_lie_along_the_exact_curves(family, given):
    """Exact tractions have vertical tangents at the edges, which are left out."""
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


def test_marks_tell_stick_and_slip_and_lie_over_the_exact_line():
    fields = solved("hertz-cylinder", **SHEARED)
    figure = traction_figure(fields)
    (side,) = fields.contacts
    pressure, shear = figure.panels

    assert [key.label for key in figure.legend.keys] == [
        "open", "stick", "slip", "exact"
    ]  # fmt: skip
    for panel in (pressure, shear):
        line, *nodes = panel.marks
        assert line.look.dash is not None
        counts = {m.look: len(m.x) for m in nodes}
        for state in ("stick", "slip"):
            assert counts[LOOKS[state]] == (side.friction == state).sum()
    assert (pressure.y.label, shear.y.label) == ("pressure in MPa", "shear in MPa")


def test_without_friction_there_is_one_panel_and_without_load_no_figure():
    fields = solved("hertz-plane", n=4)
    assert len(traction_figure(fields).panels) == 1
    (side,) = fields.contacts
    side.pressure[:] = 0
    assert traction_figure(fields) is None


def test_nodes_that_slide_without_contact_have_shear_and_no_pressure():
    fields = solved(
        "beam-ring", "dual-bounds", Nr=4, Nh=2, steps=1, friction="tresca", bound=1e8
    )
    (side,) = fields.contacts
    apart = side.friction == "sliding without contact"

    assert abs(side.shear[apart]).max() > 1e7
    assert abs(side.pressure[apart]).max() < 1e-6 * side.pressure.max()
