"""Figures of histories: selection of cases, curves and markers.

In the history `KNOWN`, the free and the chopped gradient are (3, 4), (2.4, 0.7),
(0.3, 0.4) and (0, 0), so that the relative projected gradient is (5, 2.5, 0.5, 0)/5.
The two outer iterations end after 4 and 7 products.
"""

import shutil
from dataclasses import replace

import numpy as np
import pytest

from mortarbench.harness import Record, Solution, Status, Verdict
from mortarbench.harness.results.journal import Journal
from mortarbench.reports import write_report
from mortarbench.reports.data.evidence import read_evidence
from mortarbench.reports.data.histories import MOST, chosen
from mortarbench.reports.figures import convergence
from mortarbench.reports.folder import compose
from mortarbench.reports.render.saving import ENDINGS, draw
from mortarbench.reports.render.writing import write_page
from tests.support.stored import save_solution

KNOWN = {
    "step": ["c", "p", "e", "c"], "outer": [1, 1, 2, 2], "products": [2, 4, 6, 7],
    "free_gradient": [3, 2.4, 0.3, 0], "chopped_gradient": [4, 0.7, 0.4, 0],
    "infeasibility": [1, 0.0, 1e-3, 1e-7], "active": [9, 4, 6, 6],
}  # fmt: skip
MARKERS = {"e": "^", "f": "x", "p": "o"}


@pytest.fixture
def folder(tmp_path):
    """Return a function that writes a result folder from records with histories.

    measured : (solver, history, changes to the record)
    """

    def make(*measured):
        out = tmp_path / "out"
        shutil.rmtree(out, ignore_errors=True)
        out.mkdir()
        with Journal(out, "test") as journal:
            for i, (solver, history, changes) in enumerate(measured):
                journal.append(_record(out, i, solver, history, changes))
        return out

    return make


def _record(out, i, solver, history, changes):
    one = np.array([float(i)])
    columns = {name: np.array(column) for name, column in history.items()}
    point = Solution(
        status=Status.SOLVED, x=one, y=one, z=one, z_box=one, history=columns
    )
    size = changes.get("size", 10)
    defaults = dict(
        run_id=f"run-{i}", case=f"beam-ring/size={size}/dual", family="beam-ring",
        params={"size": size}, form="dual", sizes={"variables": size}, solver=solver,
        options={"history": True}, tol=1e-6, repeat=0, block=0,
        status=Verdict.VERIFIED, claimed="solved", iterations=7, total_seconds=0.003,
        prepare_seconds=0.001, solve_seconds=0.002, environment="abc",
        primal=1e-9, dual=2e-9, complementarity=3e-10, gap=4e-11,
        vectors=save_solution(out, point), started="2026-11-21T10:00:00+00:00",
    )  # fmt: skip
    given = {name: value for name, value in changes.items() if name != "size"}
    return Record(**(defaults | given))


def comparison(folder):
    (only,) = chosen(read_evidence(folder))
    return only


def convergence_figure(c):
    return draw(convergence.convergence_figure(c))


def section(folder):
    return convergence_of(compose(read_evidence(folder)))


def convergence_of(page):
    return next((s for s in page.sections if s.name == "convergence"), None)


def curves(axes, marker="None"):
    """Return the points of all lines with a given marker.

    The markers of each step type form a separate line.
    """
    return [
        line.get_xydata().tolist()
        for line in axes.lines
        if line.get_marker().capitalize() == marker.capitalize()
        and line.get_transform() == axes.transData
    ]


def test_the_projected_gradient_is_drawn_relative_to_its_first_value(folder):
    figure = convergence_figure(comparison(folder(("a", KNOWN, {}))))
    gradient, infeasibility, _ = figure.axes

    (curve,) = curves(gradient)
    assert curve == pytest.approx(np.array([[2, 1], [4, 0.5], [6, 0.1]]))
    (curve,) = curves(infeasibility)
    assert curve == [[2, 1], [6, 1e-3], [7, 1e-7]]  # a zero has no logarithm
    assert gradient.get_yscale() == infeasibility.get_yscale() == "log"
    assert figure.axes[-1].get_xlabel() == "products with $P$"


def test_values_far_below_the_tolerance_do_not_extend_the_axis(folder):
    tiny = KNOWN | {"free_gradient": [3, 1, 1e-20, 0], "chopped_gradient": [4, 0, 0, 0]}
    low, high = (
        convergence_figure(comparison(folder(("a", tiny, {})))).axes[0].get_ylim()
    )

    assert low == pytest.approx(1e-11)  # the tolerance is 1e-6
    assert high > 1


def test_steps_are_marked_by_type_on_the_upper_panel_except_cg(folder):
    gradient, infeasibility, _ = convergence_figure(
        comparison(folder(("a", KNOWN, {})))
    ).axes

    assert curves(gradient, "^") == [[[6, pytest.approx(0.1)]]]
    assert curves(gradient, "o") == [[[4, pytest.approx(0.5)]]]
    assert sum(len(points) for points in curves(gradient, "x")) == 0
    assert all(not curves(infeasibility, m) for m in MARKERS.values())


def test_overlapping_markers_are_omitted(folder):
    n = 5000
    many = {
        "step": ["e"] * n, "free_gradient": np.geomspace(1, 1e-6, n),
        "chopped_gradient": np.zeros(n), "products": np.arange(1, n + 1),
    }  # fmt: skip
    axes = convergence_figure(comparison(folder(("a", many, {})))).axes[0]

    (curve,), (marks,) = curves(axes), curves(axes, "^")
    assert len(curve) == n
    assert 20 < len(marks) < 200
    assert marks[0] == curve[0]


def test_ticks_show_where_outer_iterations_end(folder):
    *_, strip = convergence_figure(comparison(folder(("a", KNOWN, {})))).axes
    (ticks,) = strip.collections

    assert [segment[0][0] for segment in ticks.get_segments()] == [4, 7]


def test_a_single_outer_iteration_has_no_ticks(folder):
    figure = convergence_figure(
        comparison(folder(("a", KNOWN | {"outer": [1, 1, 1, 1]}, {})))
    )

    assert len(figure.axes) == 2


def test_the_active_set_is_drawn_as_steps_over_products(folder):
    figure = draw(convergence.active_set_figure(comparison(folder(("a", KNOWN, {})))))
    (line,) = figure.axes[0].lines

    assert line.get_xydata().tolist() == [[2, 9], [4, 4], [6, 6], [7, 6]]
    assert line.get_drawstyle() == "steps-post"


def test_slipping_rows_are_drawn_below_the_active_set(folder):
    rough = KNOWN | {"outer": [1] * 4, "two_sided": [0, 1, 3, 2]}
    figure = convergence.active_set_figure(comparison(folder(("a", rough, {}))))
    above, below = figure.panels

    assert below.marks[0].y == (0, 1, 3, 2)
    assert (above.y.label, below.y.label) == ("active bounds", "active, two-sided")


def test_iterations_are_the_axis_unless_all_solvers_count_products(folder):
    bare = {name: KNOWN[name] for name in ("free_gradient", "chopped_gradient")}
    out = folder(("a", KNOWN, {}), ("b", bare, {}))
    gradient, *_, last = convergence_figure(comparison(out)).axes

    assert [[x for x, _ in curve] for curve in curves(gradient)] == [[1, 2, 3]] * 2
    assert last.get_xlabel() == "iterations"
    assert "over iterations" in section(out).pictures[0].caption


def test_each_solver_has_its_colour_and_an_unverified_one_its_verdict(folder):
    out = folder(
        ("a", KNOWN, {}), ("silent", {}, {}),
        ("stuck", KNOWN, {"status": Verdict.ITERATION_LIMIT}),
    )  # fmt: skip
    figure = convergence_figure(comparison(out))
    labels = [text.get_text() for text in figure.legends[0].get_texts()]
    colours = {line.get_color() for line in figure.axes[0].lines[:2]}

    assert labels[:2] == ["a", "stuck (iteration limit)"]
    assert labels[2:] == ["expansion", "proportioning"]
    assert len(colours) == 2


def test_runs_of_very_different_length_have_a_logarithmic_axis(folder):
    def scale(longest):
        longer = KNOWN | {"products": [2, 40, 60, longest]}
        out = folder(("a", KNOWN, {}), ("b", longer, {}))
        return convergence_figure(comparison(out)).axes[0].get_xscale()

    assert scale(70) == "linear"  # 70 is ten times 7
    assert scale(71) == "log"


def test_invalid_histories_are_left_out(folder, blank):
    strange = {
        "step": [1, 2, 3, 4], "products": ["a"] * 4, "outer": ["x", "y", "z", "z"],
        "free_gradient": [np.nan, np.inf, 2, 1], "chopped_gradient": [0, 0, 0, 0],
        "infeasibility": [0, 0, 0, 0], "active": [np.nan, 1, 2, 3],
    }  # fmt: skip
    out = folder(("a", strange, {}))
    (gradient,) = convergence_figure(comparison(out)).axes

    assert curves(gradient) == [[[3, 1], [4, 0.5]]]
    with blank():
        write_report(out, ["html", "md"])


@pytest.mark.parametrize(
    ("history", "names"),
    [
        ({"active": [3, 2]}, ["active-set-1"]),
        ({"infeasibility": [1, 0.1]}, ["convergence-1"]),
        ({"free_gradient": [1.0], "chopped_gradient": [0.0]}, ["convergence-1"]),
        ({"free_gradient": [1.0, 0.1]}, []),
        ({"cost": [1.0, 0.1]}, []),
        ({"free_gradient": [0.0], "chopped_gradient": [0.0]}, []),
        ({"active": []}, []),
        ({"active": [np.nan]}, []),
    ],
)
def test_figures_need_only_their_columns(folder, history, names):
    found = section(folder(("a", history, {})))

    assert [p.name for p in found.pictures if found] == names if names else not found


def test_the_largest_case_of_each_form_is_drawn(folder):
    def case(form, size, step, tol):
        return {
            "case": f"beam-ring/size={size}/step={step}/{form}", "form": form,
            "sizes": {"variables": size}, "params": {"size": size, "step": step},
            "tol": tol,
        }  # fmt: skip

    out = folder(
        ("a", KNOWN, case("dual", 10, 9, 1e-8)),
        ("a", KNOWN, case("dual", 20, 1, 1e-8)),
        ("a", KNOWN, case("dual", 20, 5, 1e-6)),
        ("a", KNOWN, case("dual", 20, 5, 1e-8)),
        ("a", {}, case("dual", 30, 5, 1e-8)),
        ("a", KNOWN, case("primal", 5, 5, 1e-8)),
    )
    drawn = [
        (c.runs[0].outcome.case, c.runs[0].outcome.tol)
        for c in chosen(read_evidence(out))
    ]
    assert drawn == [
        ("beam-ring/size=20/step=5/dual", 1e-8),
        ("beam-ring/size=5/step=5/primal", 1e-8),
    ]


def test_the_number_of_drawn_cases_is_limited(folder):
    out = folder(
        *(
            ("a", KNOWN, {"form": f"f{i}", "case": f"beam-ring/f{i}", "size": i})
            for i in range(1, MOST + 3)
        )
    )
    found = section(out)

    assert len(found.pictures) == 2 * MOST
    assert f"the {MOST} largest" in found.prose[0]
    assert "f1 " not in " ".join(p.caption for p in found.pictures)


def test_the_first_stored_history_of_the_repeats_is_used(folder):
    later = KNOWN | {"active": [9, 9, 9, 9]}
    out = folder(
        ("a", {}, {"repeat": 0, "run_id": "r0"}),
        ("a", KNOWN, {"repeat": 1, "run_id": "r1"}),
        ("a", later, {"repeat": 2, "run_id": "r2"}),
    )
    (run,) = comparison(out).runs

    assert run.record.run_id == "r1"
    assert "r1." in section(out).pictures[0].caption


def test_a_report_without_histories_has_no_such_section(folder, blank):
    out = folder(("a", {}, {}), ("b", {}, {"vectors": None}))

    assert section(out) is None
    with blank():
        names = {f.name for f in write_report(out, ["html", "md", "tex"])}
    assert not any("convergence" in name or "active" in name for name in names)


def test_a_missing_history_is_reported(folder):
    out = folder(("a", KNOWN, {}), ("b", KNOWN, {}))
    first, *_ = sorted((out / "vectors").iterdir())
    first.unlink()
    found = section(out)

    assert [len(c.runs) for c in chosen(read_evidence(out))] == [1]
    assert f"vectors/{first.name}" in found.prose[1]
    assert len(found.pictures) == 2


@pytest.mark.parametrize(
    "endings", [(".svg",), pytest.param(ENDINGS, marks=pytest.mark.slow)]
)
def test_figures_in_page_and_files_are_reproducible(folder, monkeypatch, endings):
    monkeypatch.setattr("mortarbench.reports.render.saving.ENDINGS", endings)
    out = folder(("a", KNOWN, {}), ("_b$x^2", KNOWN, {}))

    def written(target):
        page = compose(read_evidence(out))
        shown = replace(page, sections=(convergence_of(page),))
        return {
            f.name: f.read_bytes() for f in write_page(shown, target, ["html", "md"])
        }

    files, again = written(out / "one"), written(out / "two")

    assert files == again
    for ending in endings:
        assert {f"convergence-1{ending}", f"active-set-1{ending}"} <= files.keys()
    assert b'id="convergence-1-' in files["index.html"]
    assert b"figures/active-set-1.png" in files["report.md"]
