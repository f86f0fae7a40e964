"""Points of figures in files and on the page, compared with the data."""

import json
import pickle

import numpy as np
import pytest

from mortarbench.harness import Record, Verdict
from mortarbench.reports.document.figure import (
    Area,
    Axis,
    ColourBar,
    Figure,
    Intervals,
    Key,
    Legend,
    Look,
    Panel,
    Row,
    Rule,
    Segments,
    Series,
    Text,
    categories,
    fitted,
    in_rows,
)
from mortarbench.reports.document.layout import Cell, Table, named
from mortarbench.reports.figures.style import COLOURS, legible, look
from mortarbench.reports.render.embedded import cell, rows_of, script, spans, table
from mortarbench.reports.render.plots import MOST, panels, plain
from mortarbench.reports.render.saving import draw

SOLVERS = {"a $b": 0, "b": 1, "b2": 2}
LOG = Axis(log=True)
TIMES = Series(
    x=(1, 10, 100), y=(3, 2, 1), look=look(1), solver="b",
    intervals=Intervals(low=(2.5, 1.5, 0.5), high=(4, 3, 2)),
    runs=(("r0", "r1"), ("r2",), ("r3",)),
)  # fmt: skip


def record(run_id, solver="b"):
    return Record(
        run_id=run_id, case="c", family="f", params={}, form="", sizes={},
        solver=solver, options={}, tol=1e-6, repeat=0, block=0,
        status=Verdict.VERIFIED,
    )  # fmt: skip


def figure(*marks, **panel):
    given = {"x": Axis(), "y": Axis(), **panel}
    return Figure(rows=(Row(panels=(Panel(marks=marks, **given),)),), height=3)


def shown(*marks, **panel):
    """Describe a figure of one panel for the page."""
    (one,) = panels(figure(*marks, **panel), SOLVERS)
    return one


def drawn(*marks, **panel):
    """Draw a figure of one panel with matplotlib."""
    (axes,) = draw(figure(*marks, **panel)).axes
    return axes


def test_a_line_has_look_axes_solver_and_runs():
    size = Axis(label="size $n$", log=True, low=1, high=100)
    panel = shown(TIMES, x=size, y=Axis(label="time in s"))
    trace, *_ = panel["traces"]

    assert (trace["x"], trace["y"]) == ([1, 10, 100], [3, 2, 1])
    assert trace["runs"] == (("r0", "r1"), ("r2",), ("r3",))
    assert (trace["colour"], trace["marker"]) == ("#d55e00", "s")
    assert (trace["s"], trace["step"], trace["hollow"]) == (1, False, False)
    assert len(trace["dash"].split()) == 2
    assert panel["x"] == {
        "label": "size n", "log": True, "limits": [1, 100], "ticks": None,
        "numbered": True,
    }  # fmt: skip
    assert panel["y"]["log"] is False


@pytest.mark.parametrize("log", [False, True])
def test_files_and_the_page_show_the_same_points_error_bars_and_ends_of_axes(log):
    axis = LOG if log else Axis()
    axes, panel = drawn(TIMES, x=axis, y=axis), shown(TIMES, x=axis, y=axis)
    (line,) = (one for one in axes.lines if one.get_marker() == "s")
    trace, bars, *caps = panel["traces"]

    np.testing.assert_allclose(line.get_xydata().T, (trace["x"], trace["y"]))
    (segments,) = axes.collections
    ends = np.reshape(segments.get_segments(), (-1, 4))
    np.testing.assert_allclose(ends, bars["ends"])
    assert bars["ends"] == [[1, 2.5, 1, 4], [10, 1.5, 10, 3], [100, 0.5, 100, 2]]
    assert [cap["y"] for cap in caps] == [[2.5, 1.5, 0.5], [4, 3, 2]]
    assert all(part["s"] == 1 for part in (bars, *caps))
    assert all(part["runs"] == TIMES.runs for part in (bars, *caps))
    for direction in "xy":
        limits = getattr(axes, f"get_{direction}lim")()
        assert limits == pytest.approx(panel[direction]["limits"])
        assert getattr(axes, f"get_{direction}scale")() == ("log" if log else "linear")
        assert panel[direction]["log"] is log


def test_horizontal_error_bars_are_horizontal():
    series = Series(
        x=(1,), y=(5,), look=look(0),
        intervals=Intervals(low=(0.5,), high=(3,), along="x"),
    )  # fmt: skip
    _, bars, left, right = shown(series)["traces"]

    assert bars["ends"] == [[0.5, 5, 3, 5]]
    assert (left["x"], right["x"], left["y"], left["marker"]) == ([0.5], [3], [5], "|")
    (segments,) = drawn(series).collections
    np.testing.assert_allclose(segments.get_segments(), [[(0.5, 5), (3, 5)]])


def test_axes_contain_all_points_and_error_bars_with_a_margin():
    """The margin is 5 % of the range of the points.

    A logarithmic axis spans at least a decade; for points from 0.5 to 4, it spans one
    decade with the points in its middle.
    """
    (panel,) = fitted(figure(TIMES, x=LOG, y=LOG)).panels

    assert panel.x.low == pytest.approx(100**-0.05)
    assert panel.x.high == pytest.approx(100**1.05)
    assert panel.y.low == pytest.approx(2**0.5 / 10**0.5)
    assert panel.y.high == pytest.approx(2**0.5 * 10**0.5)
    (panel,) = fitted(figure(TIMES)).panels
    assert (panel.x.low, panel.x.high) == pytest.approx((1 - 4.95, 100 + 4.95))


@pytest.mark.parametrize("log", [False, True])
@pytest.mark.parametrize("values", [(), (3.0,), (0.0, 0.0), (np.nan, np.inf), (-1.0,)])
def test_axes_of_any_points_have_two_ends(values, log):
    series = Series(x=values, y=values, look=look(0))
    (panel,) = fitted(figure(series, x=Axis(log=log), y=Axis(log=log))).panels

    assert panel.x.low < panel.x.high
    assert np.isfinite([panel.x.low, panel.x.high]).all()
    assert panel.x.low > 0 or not log
    drawn(series, x=Axis(log=log), y=Axis(log=log))


def test_axes_with_the_same_name_share_their_ends():
    shared, own = Axis(shared="n"), Axis()
    near, far = (Series(x=(0, at), y=(0, at), look=look(0)) for at in (1, 9))
    both = [Panel(x=shared, y=own, marks=(one,)) for one in (near, far)]
    left, right = panels(Figure(rows=in_rows(both, 2), height=3), SOLVERS)

    assert left["x"]["limits"] == right["x"]["limits"] == [-0.45, 9.45]
    assert left["y"]["limits"] == [-0.05, 1.05]
    assert left["share"] == right["share"]
    assert left["columns"] == 2


def test_an_axis_of_categories_has_their_names_from_top_to_bottom():
    names = categories(["first", "second"])
    series = Series(x=(1, 2), y=(0, -1), look=look(0))

    assert shown(series, y=names)["y"]["ticks"] == [[0, "first"], [-1, "second"]]
    axes = drawn(series, y=names)
    assert [t.get_text() for t in axes.get_yticklabels()] == ["first", "second"]
    assert list(axes.get_yticks()) == [0, -1]
    assert axes.get_ylim() == (-1.6, 0.6)


def test_a_legend_key_refers_to_its_solver():
    keys = tuple(Key(label=legible(s), look=look(i), solver=s)
                 for s, i in SOLVERS.items())  # fmt: skip
    bound = Key(label="bound", look=Look(colour="#000000"))
    whole = Figure(
        rows=figure(TIMES).rows, height=3, legend=Legend(keys=(*keys, bound))
    )
    (panel,) = panels(whole, SOLVERS)

    assert [(k["label"], k["s"]) for k in panel["common"]["keys"]] == [
        ("a $b", 0), ("b", 1), ("b2", 2), ("bound", -1),
    ]  # fmt: skip
    (legend,) = draw(whole).legends
    assert [t.get_text() for t in legend.get_texts()] == [
        k.label for k in (*keys, bound)
    ]


def test_legends_of_rows_are_keys_of_the_whole_figure():
    rows = tuple(
        Row(
            panels=figure(TIMES).panels,
            legend=Legend(keys=(Key(label=name, look=look(0), solver=name),)),
        )
        for name in ("b", "b2")
    )
    first, _ = panels(Figure(rows=rows, height=3), SOLVERS)

    assert [key["label"] for key in first["common"]["keys"]] == ["b", "b2"]


def test_a_legend_within_axes_is_that_of_their_panel_only():
    legend = Legend(keys=(Key(label="b", look=look(0)),), title="of b")
    panel = shown(TIMES, legend=legend)

    assert panel["own"]["title"] == "of b"
    assert [k["label"] for k in panel["own"]["keys"]] == ["b"]
    assert panel["common"]["keys"] == []


def test_the_colours_of_a_bar_are_keys_on_the_page():
    bar = ColourBar(label="load step", colours=COLOURS[:2])
    own = shown(TIMES, bar=bar)["own"]

    assert own["title"] == "load step"
    assert [(k["label"], k["colour"]) for k in own["keys"]] == [
        ("1", COLOURS[0]), ("2", COLOURS[1]),
    ]  # fmt: skip


def test_the_outline_of_a_stepped_band_encloses_its_area():
    """The band from 1 to 2 until x = 1 and from 0 to 3 until x = 2 has area 1 + 3."""
    band = Area(
        x=(0, 1, 2), low=(1, 0, 0), high=(2, 3, 3), colour="#112233", opacity=0.25,
        step=True, solver="b2",
    )  # fmt: skip
    (trace,) = shown(band)["traces"]
    x, y = np.reshape(trace["outlines"][0], (-1, 2)).T

    assert abs(x @ np.roll(y, 1) - y @ np.roll(x, 1)) / 2 == 4
    assert (trace["s"], trace["opacity"], trace["colour"]) == (2, 0.25, "#112233")
    (polygon,) = drawn(band).collections
    u, v = polygon.get_paths()[0].vertices.T
    assert abs(u @ np.roll(v, 1) - v @ np.roll(u, 1)) / 2 == pytest.approx(4)


def test_segments_rules_and_texts_have_their_positions():
    strokes = Segments(ends=((1, 0, 1, 2),), colour="#112233", runs=(("r1",),))
    rule = Rule(axis="y", at=10.0, look=Look(colour="#112233", dash=(4, 2), width=0.5))
    text = Text(
        text="$n^2$", place=(1, 10), inside=(True, False), align=("right", "top")
    )
    panel = shown(strokes, rules=(rule,), texts=(text,))

    assert panel["traces"][0]["ends"] == [[1, 0, 1, 2]]
    assert panel["traces"][0]["runs"] == (("r1",),)
    assert [(r["axis"], r["at"], r["dash"]) for r in panel["rules"]] == [
        ("y", 10, "2 1")
    ]
    assert panel["texts"] == [
        {"text": "n²", "place": [1, 10], "inside": [True, False],
         "align": ["right", "top"]},
    ]  # fmt: skip
    axes = drawn(strokes, rules=(rule,), texts=(text,))
    assert [list(one.get_ydata()) for one in axes.lines] == [[10, 10]]
    assert axes.get_ylim()[1] > 10  # the axis contains the rule


def test_a_long_line_keeps_its_ends_and_its_extremes_on_the_page_and_all_in_files():
    y = np.sin(np.arange(50_000.0))
    y[31_415], y[27_182] = 7.0, -7.0
    line = Series(x=tuple(range(50_000)), y=tuple(y), look=look(0), runs=(("r1",),))
    (trace,) = shown(line)["traces"]

    assert len(trace["x"]) <= MOST + 2
    assert (trace["x"][0], trace["x"][-1]) == (0, 49_999)
    assert (max(trace["y"]), min(trace["y"])) == (7, -7)
    assert len(drawn(line).lines[0].get_xdata()) == 50_000


def test_a_line_with_runs_per_point_keeps_all_points():
    n = MOST + 100
    runs = tuple((f"r{i}",) for i in range(n))
    line = Series(x=tuple(range(n)), y=(1.0,) * n, look=look(0), runs=runs)
    (trace,) = shown(line)["traces"]

    assert len(trace["x"]) == len(trace["runs"]) == n


def test_figures_can_be_compared_and_pickled():
    one = figure(TIMES, x=LOG, y=categories(["a"]))

    assert pickle.loads(pickle.dumps(one)) == one
    assert hash(one) == hash(figure(TIMES, x=LOG, y=categories(["a"])))
    assert one != figure(TIMES, x=Axis(), y=categories(["a"]))


@pytest.mark.parametrize(
    "broken",
    [
        {"y": (1.0,)},
        {"runs": (("r0",), ("r1",))},
        {"intervals": Intervals(low=(1,), high=(2,))},
    ],
)
def test_points_of_inconsistent_length_are_refused(broken):
    with pytest.raises(ValueError, match=r"differ in length|lists of runs"):
        Series(**{"x": (1, 2, 3), "y": (1, 2, 3), "look": look(0), **broken})


def test_formulas_are_shown_as_text():
    assert plain(r"degrees of freedom $n$") == "degrees of freedom n"
    assert plain(r"$\|g^P\|\,/\,\|g^P_0\|$") == "‖gᴾ‖ / ‖gᴾ₀‖"
    assert plain("$n^{3/2}$") == "n³ᐟ²"
    assert plain(legible("$x_1$ and _y")) == "$x_1$ and _y"


def test_json_of_the_page_cannot_end_the_script():
    text = script({"a": "</script><!-- \u2028 & \ud800", "b": float("nan")})
    assert not set("<>&") & set(text)
    assert text.isascii()
    assert json.loads(text) == {"a": "</script><!-- \u2028 & \\ud800", "b": None}


def test_measurements_behind_a_cell_are_packed_as_ranges():
    rows = rows_of([record(f"r{i}") for i in range(9)])
    assert spans(["r2", "r3", "r4", "r8", "r0", "gone"], rows) == [2, 3, 8, 1, 0, 1]
    assert cell(Cell(text="7", value=7.0, title="run r2, r3"), rows) == [
        "7", 7.0, "", "", "", "", [2, 2],
    ]  # fmt: skip
    assert cell(Cell(text="case"), rows) == "case"


def test_only_run_ids_at_the_end_of_a_title_count():
    assert named("run a, b") == ["a", "b"]
    assert named("ended · run a") == ["a"]
    assert named("not run") == []
    assert named("overrun a") == []


def test_table_data_contain_solver_and_text_columns():
    made = Table(caption="", columns=("case",), rows=((Cell(text="x"),),), solver="b")
    assert table(made, {}) == {
        "columns": ["case"], "words": 1, "solver": "b", "rows": [["x"]],
    }  # fmt: skip
