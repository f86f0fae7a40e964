"""Figures of reports: solver and measurements of every point."""

import pickle
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from mortarbench.harness import Verdict
from mortarbench.reports.compare.changes import compare
from mortarbench.reports.compare.figure import ratios_figure
from mortarbench.reports.data.evidence import Evidence, arrange
from mortarbench.reports.data.size_series import size_series
from mortarbench.reports.document.figure import (
    Axis,
    Figure,
    Panel,
    Row,
    Series,
    Text,
    fitted,
)
from mortarbench.reports.figures.scaling import scaling_figure
from mortarbench.reports.figures.style import GUIDE
from mortarbench.reports.figures.sweeps import (
    accuracy_figure,
    certified_figure,
    sweep_figure,
)
from mortarbench.reports.folder import compose
from mortarbench.reports.render.saving import draw, draw_svg
from tests.support.synthetic_results import records

pytestmark = pytest.mark.together

SOLVERS, CASES, REPEATS = 3, 60, 2
TOLS = (1e-2, 1e-4, 1e-6)


def evidence(given):
    return Evidence(directory=Path(), records=arrange(list(given)))


@pytest.fixture(scope="module")
def campaign():
    return evidence(records(SOLVERS, CASES, REPEATS))


def series(figure):
    return [
        mark
        for panel in figure.panels
        for mark in panel.marks
        if isinstance(mark, Series)
    ]


def told(figure):
    """Map every point (solver, x, y) with measurements to the run_ids
    behind the point.
    """
    return {
        (one.solver, x, y): runs
        for one in series(figure)
        for x, y, runs in zip(one.x, one.y, one.runs, strict=bool(one.runs))
    }


def swept():
    """Return records of all solvers and tolerances, with residual and error 2·tol."""
    first = {r.solver: r for r in reversed([*records(SOLVERS, 1, 1)])}
    return [
        r.replace(
            run_id=f"{solver} {tol}", tol=tol, accuracy=1e-3, energy_bound=2 * tol,
            primal=2 * tol, dual=0.0, complementarity=0.0, gap=0.0,
            status=Verdict.VERIFIED, claimed="solved",
        )
        for solver, r in first.items()
        for tol in TOLS
    ]  # fmt: skip


def test_every_mark_of_accuracy_names_the_measurements_of_its_cell(campaign):
    points = told(accuracy_figure(campaign))
    expected = {
        (o.solver, o.seconds("total").value, o.worst / o.tol): o.run_ids
        for o in campaign.flat
        if o.seconds("total")
    }

    assert len(points) == SOLVERS * CASES
    assert {key: list(runs) for key, runs in points.items()} == {
        key: list(runs) for key, runs in expected.items()
    }


def test_markers_are_filled_if_the_answer_is_verified(campaign):
    verified = {i for o in campaign.flat if o.verified for i in o.run_ids}
    for one in series(accuracy_figure(campaign)):
        filled = one.look.fill == ""
        assert all((i in verified) is filled for runs in one.runs for i in runs)


def test_times_and_iterations_over_size_name_the_measurements_of_their_size(campaign):
    grown = [
        r.replace(run_id=f"{solver} {n} {i}", solver=solver, case=f"box/n={n}/dual",
              family="box", form="dual", params={"n": n}, iterations=n,
              sizes={"variables": n}, quantities={"dofs": n}, total_seconds=1e-6 * n,
              status=Verdict.VERIFIED)
        for solver in ("a", "b")
        for n, r in zip((10, 20, 40, 80), records(1, 4, 1), strict=True)
        for i in range(3)
    ]  # fmt: skip
    found = evidence(grown)
    (one,) = size_series(found)
    times, counts = scaling_figure(one, found.solvers).panels
    for panel, values in ((times, 1e-6), (counts, 1)):
        curves = [m for m in panel.marks if m.solver]
        assert [m.solver for m in curves] == ["a", "b"]
        for curve in curves:
            assert curve.x == (10, 20, 40, 80)
            assert curve.y == pytest.approx([values * n for n in curve.x])
            assert curve.runs == tuple(
                tuple(f"{curve.solver} {n:g} {i}" for i in range(3)) for n in curve.x
            )


@pytest.mark.parametrize(
    "spread",
    [
        1.0, 1e6,
        *(pytest.param(s, marks=pytest.mark.slow) for s in (1 + 1e-9, 1.02, 1.5, 4.0)),
    ],
)  # fmt: skip
def test_guide_lines_do_not_squeeze_nearly_equal_times(spread):
    """For sizes from n to 100n, the guide of slope 3/2 rises by a factor of about 8."""
    grown = [
        r.replace(run_id=f"{n}", solver="a", case=f"box/n={n}/dual", family="box",
              form="dual", params={"n": n}, sizes={"variables": n},
              quantities={"dofs": n}, total_seconds=1e-3 * spread**i,
              status=Verdict.VERIFIED)
        for i, n, r in zip((0, 0.5, 1), (100, 1000, 10000), records(1, 3, 1),
                           strict=True)
    ]  # fmt: skip
    found = evidence(grown)
    (one,) = size_series(found)
    figure = scaling_figure(one, found.solvers)
    panel = figure.panels[0]
    guides = [m for m in panel.marks if isinstance(m, Series) and m.look == GUIDE]

    assert len(guides) == 2
    for guide in guides:
        assert panel.y.low < min(guide.y) < max(guide.y) < panel.y.high
        slope = np.diff(np.log(guide.y)) / np.diff(np.log(guide.x))
        assert slope == pytest.approx([1.0 if guide is guides[0] else 1.5])
    canvas = draw(figure)
    canvas.draw_without_rendering()
    assert canvas.axes[0].get_position().height >= 0.5


@pytest.mark.parametrize(
    "place",
    [
        (1e9, 1e-9),
        *(pytest.param(p, marks=pytest.mark.slow) for p in ((1.0, 1e9), (1e-9, 1.0))),
    ],
)
def test_a_text_beside_the_axes_does_not_change_their_limits(place):
    def room(*texts):
        axis = Axis(log=True, low=0.1, high=10.0)
        panel = Panel(x=axis, y=axis, texts=texts)
        canvas = draw(Figure(rows=(Row(panels=(panel,)),), height=2.0))
        canvas.draw_without_rendering()
        return canvas.axes[0].get_position().bounds

    assert room(Text(text="far away", place=place)) == room()


def test_extreme_answers_appear_in_the_figure_of_accuracy():
    answers = [
        r.replace(primal=worst, dual=0.0, complementarity=0.0, gap=0.0)
        for worst, r in zip((0.0, 1e-9, 1e290), records(1, 3, 1), strict=True)
    ]
    figure = accuracy_figure(evidence(answers))
    (panel,) = fitted(figure).panels

    assert panel.y.low < 1e-10
    assert panel.y.high > 1e290
    drawn = draw_svg(figure).text
    assert drawn.count("<use") >= len(answers)


@pytest.mark.parametrize("certified", [False, True])
def test_points_of_a_sweep_name_the_measurement_at_their_tolerance(certified):
    found = evidence(swept())
    row = {}
    for o in found.flat:
        row.setdefault(o.solver, []).append(o)
    if certified:
        figure = certified_figure([("c", row)], found.solvers)
    else:
        figure = sweep_figure([("c", row)], found.solvers)

    points = {(solver, y): runs for (solver, _, y), runs in told(figure).items()}
    assert points == {
        (solver, 2 * tol): (f"{solver} {tol}",) for solver in row for tol in TOLS
    }


def test_ratios_name_the_measurements_after():
    before = [*records(2, 8, 3)]
    after = [r.replace(run_id=f"after {r.run_id}") for r in before]
    made = compare(evidence(before), evidence(after))
    runs = [i for ids in told(ratios_figure(made)).values() for i in ids]

    assert runs
    assert set(runs) <= {r.run_id for r in after}


def test_all_figures_of_a_report_are_plain_data(campaign):
    again = compose(evidence(records(SOLVERS, CASES, REPEATS)))
    figures, same = (
        [p.figure for section in page.sections for p in section.pictures]
        for page in (compose(campaign), again)
    )

    assert len(figures) > 2
    assert all(isinstance(figure, Figure) for figure in figures)
    assert figures == same == pickle.loads(pickle.dumps(figures))


def test_all_marks_of_a_solver_carry_its_label(campaign):
    """A page hides the curves, bands and error bars of a solver by its label."""
    for section in compose(campaign).sections:
        for picture in section.pictures:
            for panel in picture.figure.panels:
                for mark in panel.marks:
                    guide = isinstance(mark, Series) and mark.look == GUIDE
                    assert guide or mark.solver in campaign.solvers


def test_composing_a_report_does_not_import_matplotlib():
    """The import takes a second and is needed only for drawing."""
    code = (
        "import sys; from mortarbench.reports import folder; "
        "from mortarbench.reports.paper import report; "
        "from mortarbench.reports.validation import report; "
        "sys.exit('matplotlib' in sys.modules)"
    )
    subprocess.run([sys.executable, "-c", code], check=True)
