"""What the page draws is what the figure shows: curves, axes, runs and solvers."""

import json

import numpy as np
import pytest
from matplotlib import colormaps
from matplotlib.figure import Figure

from harness import Record, Verdict
from reports.document.layout import Cell, Table, named
from reports.figures.provenance import behind
from reports.figures.style import legible, look
from reports.render.artists import MOST
from reports.render.embedded import cell, rows_of, script, spans, table
from reports.render.mathtext import plain
from reports.render.plots import read_back

LABELS = {"a $b": legible("a $b"), "b": "b", "b2": "b2"}


def record(run_id, solver="b"):
    return Record(
        run_id=run_id, case="c", family="f", params={}, form="", sizes={},
        solver=solver, options={}, tol=1e-6, repeat=0, block=0,
        status=Verdict.VERIFIED,
    )  # fmt: skip


@pytest.fixture
def axes():
    return Figure().subplots()


def read(axes):
    (panel,) = read_back(axes.get_figure(), LABELS)
    return panel


def test_a_line_is_read_back_with_its_look_its_axes_and_its_runs(axes):
    (line,) = axes.plot([1, 10, 100], [3, 2, 1], **look(1))
    axes.set(xscale="log", xlabel="size $n$", ylabel="time in s", xlim=(1, 100))
    behind(line, [[record("r0"), record("r1")], [record("r2")], [record("r3")]])
    panel = read(axes)
    (trace,) = panel["traces"]
    assert (trace["x"], trace["y"]) == ([1, 10, 100], [3, 2, 1])
    assert trace["runs"] == [["r0", "r1"], ["r2"], ["r3"]]
    assert (trace["colour"], trace["marker"]) == ("#d55e00", "s")
    assert (trace["s"], trace["step"], trace["hollow"]) == (1, False, False)
    assert len(trace["dash"].split()) == 2
    assert panel["x"] == {
        "label": "size n", "log": True, "limits": [1, 100], "ticks": None,
        "numbered": True,
    }  # fmt: skip
    assert panel["y"]["log"] is False


def test_a_line_without_runs_belongs_to_whom_its_label_names(axes):
    axes.plot([1, 2], [1, 2], label=legible("a $b") + ",  p = 1.0")
    axes.plot([1, 2], [1, 2], label="b2")
    axes.plot([1, 2], [1, 2], label="bound")
    assert [t["s"] for t in read(axes)["traces"]] == [0, 2, -1]


def test_a_line_without_a_label_belongs_to_the_key_that_looks_like_it(axes):
    handles = [axes.plot([1, 2], [i, i + 1], **look(i))[0] for i in range(3)]
    axes.get_figure().legend(handles, list(LABELS.values()))
    panel = read(axes)
    assert [t["s"] for t in panel["traces"]] == [0, 1, 2]
    assert [k["label"] for k in panel["common"]["keys"]] == ["a $b", "b", "b2"]


def test_bands_and_error_bars_belong_to_the_line_of_their_colour(axes):
    for i, label in enumerate(LABELS.values()):
        axes.plot([1, 2], [1, 2], label=label, **look(i))
        axes.fill_between([1, 2], [0, 1], [2, 3], color=look(i)["color"], alpha=0.1)
        axes.errorbar([1], [1], yerr=[1], fmt="none", color=look(i)["color"], capsize=2)
    assert sorted(t["s"] for t in read(axes)["traces"]) == sorted([0, 1, 2] * 5)


def test_legends_of_parts_of_a_figure_are_keys_of_the_whole():
    figure = Figure()
    for part, label in zip(figure.subfigures(2, 1), ("b", "b2"), strict=True):
        lines = part.subplots().plot([1, 2], [1, 2], **look(1))
        part.legend(lines, [label])
    first, _ = read_back(figure, LABELS)
    assert [key["label"] for key in first["common"]["keys"]] == ["b", "b2"]


def test_a_legend_within_axes_is_that_of_their_panel_only():
    figure = Figure()
    for axes, label in zip(figure.subplots(1, 2), ("b", "bound"), strict=True):
        axes.plot([1, 2], [1, 2], label=label, **look(0))
        axes.legend(title=f"of {label}")
    panels = read_back(figure, LABELS)
    assert [p["own"]["title"] for p in panels] == ["of b", "of bound"]
    assert [[k["label"] for k in p["own"]["keys"]] for p in panels] == [
        ["b"],
        ["bound"],
    ]
    assert [p["traces"][0]["s"] for p in panels] == [1, -1]


def test_numbers_under_an_axis_are_left_out_where_the_figure_leaves_them_out():
    figure = Figure()
    for axes in figure.subplots(2, 1, sharex=True):
        axes.plot([1, 2], [1, 2])
    panels = read_back(figure, LABELS)
    assert [p["x"]["numbered"] for p in panels] == [False, True]
    assert panels[0]["share"] == panels[1]["share"]


def test_bars_bands_and_rules_are_read_back(axes):
    axes.errorbar([1, 2], [1, 2], yerr=[0.5, 0.5], fmt="o", capsize=2)
    axes.fill_between([0, 1], [0, 0], [1, 2], alpha=0.25)
    axes.axhline(10.0)
    axes.axvline(0.5)
    axes.bar([3], [4], width=1)
    panel = read(axes)
    kinds = [t["kind"] for t in panel["traces"]]
    assert sorted(kinds) == ["area"] * 2 + ["line"] * 3 + ["segments"]
    (bars,) = (t for t in panel["traces"] if t["kind"] == "segments")
    assert bars["ends"] == [[1, 0.5, 1, 1.5], [2, 1.5, 2, 2.5]]
    areas = [t for t in panel["traces"] if t["kind"] == "area"]
    corners = next(t["outlines"][0] for t in areas if t["opacity"] == 1)
    assert set(zip(corners[::2], corners[1::2], strict=True)) == {
        (2.5, 0), (3.5, 0), (3.5, 4), (2.5, 4),
    }  # fmt: skip
    assert [(r["axis"], r["at"]) for r in panel["rules"]] == [("y", 10), ("x", 0.5)]


def test_ticks_that_have_names_keep_them(axes):
    axes.plot([1, 2], [0, 1])
    axes.set_yticks([0, 1], ["first", "second"])
    assert read(axes)["y"]["ticks"] == [[0, "first"], [1, "second"]]


def test_a_long_line_keeps_its_ends_and_its_extremes(axes):
    y = np.sin(np.arange(50_000.0))
    y[31_415], y[27_182] = 7.0, -7.0
    axes.plot(y)
    (trace,) = read(axes)["traces"]
    assert len(trace["x"]) <= MOST + 2
    assert (trace["x"][0], trace["x"][-1]) == (0, 49_999)
    assert (max(trace["y"]), min(trace["y"])) == (7, -7)


@pytest.mark.parametrize("what", ["mesh", "picture", "cloud", "equal"])
def test_a_figure_with_more_than_curves_is_left_as_it_is(axes, what):
    match what:
        case "mesh":
            axes.pcolormesh(np.eye(3))
        case "picture":
            axes.imshow(np.eye(3), cmap=colormaps["viridis"], aspect="auto")
        case "cloud":
            axes.scatter([1, 2], [1, 2])
        case "equal":
            axes.set_aspect("equal")
    assert read_back(axes.get_figure(), LABELS) is None


def test_formulas_read_as_text():
    assert plain(r"degrees of freedom $n$") == "degrees of freedom n"
    assert plain(r"$\|g^P\|\,/\,\|g^P_0\|$") == "‖gᴾ‖ / ‖gᴾ₀‖"
    assert plain("$n^{3/2}$") == "n³ᐟ²"
    assert plain(legible("$x_1$ and _y")) == "$x_1$ and _y"


def test_json_of_the_page_ends_no_script():
    text = script({"a": "</script><!-- \u2028 & \ud800", "b": float("nan")})
    assert not set("<>&") & set(text)
    assert text.isascii()
    assert json.loads(text) == {"a": "</script><!-- \u2028 & \ud800", "b": None}


def test_measurements_behind_a_cell_are_packed_as_stretches():
    rows = rows_of([record(f"r{i}") for i in range(9)])
    assert spans(["r2", "r3", "r4", "r8", "r0", "gone"], rows) == [2, 3, 8, 1, 0, 1]
    assert cell(Cell(text="7", value=7.0, title="run r2, r3"), rows) == [
        "7", 7.0, "", "", "", "", [2, 2],
    ]  # fmt: skip
    assert cell(Cell(text="case"), rows) == "case"


def test_only_what_a_cell_says_last_names_its_measurements():
    assert named("run a, b") == ["a", "b"]
    assert named("ended · run a") == ["a"]
    assert named("not run") == []
    assert named("overrun a") == []


def test_a_table_tells_its_solver_and_its_columns_of_words():
    made = Table(caption="", columns=("case",), rows=((Cell(text="x"),),), solver="b")
    assert table(made, {}) == {
        "columns": ["case"], "words": 1, "solver": "b", "rows": [["x"]],
    }  # fmt: skip
