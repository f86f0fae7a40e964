"""Reports explain their contents, and print only significant digits."""

import re

import pytest

from mortarbench.harness import Record, Verdict
from mortarbench.harness.results.journal import Journal
from mortarbench.reports import write_report
from mortarbench.reports.data.evidence import Evidence, arrange
from mortarbench.reports.data.size_series import size_series
from mortarbench.reports.document.formatting import (
    TIMED,
    exponent,
    power,
    seconds,
    significant,
)
from mortarbench.reports.document.layout import Cell, Table
from mortarbench.reports.figures.scaling import scaling_figure
from mortarbench.reports.folder import compose
from mortarbench.reports.render.latex import latex
from mortarbench.reports.render.markdown import markdown
from mortarbench.reports.render.saving import draw
from mortarbench.reports.statistics.intervals import PowerLaw, median_interval
from mortarbench.text import outcome

ELASTIC = {
    "dofs": 20, "equality_rows": 4, "contact_rows": 10, "active": 5,
    "energy": -12345.678901234, "tip": [0.25, -0.5],
    "max_von_mises": {"beam": 798608592.4, "ring": 127410816.1},
}  # fmt: skip


@pytest.fixture
def measured():
    """Return a factory of records of beam-ring, by default verified."""

    def make(solver="a", repeat=0, *, form="dual", physical="beam-ring", **changes):
        defaults = dict(
            run_id=f"{solver}-{form}-{physical}-{changes.get('tol', 1e-8)}-{repeat}",
            case=f"{physical}/{form}", family="beam-ring", params={"step": 10},
            form=form, sizes={"variables": 14, "equalities": 3, "inequalities": 0,
                              "bounds": 10},
            solver=solver, options={}, tol=1e-8, repeat=repeat, block=repeat,
            status=Verdict.VERIFIED, claimed="solved", iterations=7,
            prepare_seconds=0.001, solve_seconds=0.002, total_seconds=0.003,
            primal=1e-9, dual=2e-9, complementarity=3e-10, gap=4e-11,
            quantities=ELASTIC, environment="abc",
        )  # fmt: skip
        return Record(**(defaults | changes))

    return make


@pytest.fixture
def page(tmp_path):
    def make(records, **more):
        return compose(Evidence(directory=tmp_path, records=arrange(records), **more))

    return make


def section(page, name):
    (found,) = (s for s in page.sections if s.name == name)
    return found


def rows(table):
    return [dict(zip(table.columns, row, strict=True)) for row in table.rows]


def grown(measured, sizes=(10, 20, 40), **changes):
    return [
        measured(
            physical=f"beam-ring/n={n}", params={"n": n}, total_seconds=1e-6 * n,
            quantities=ELASTIC | {"dofs": n * n, "contact_rows": n}, **changes,
        )
        for n in sizes
    ]  # fmt: skip


def test_the_definition_of_times_is_stated_with_all_times(measured, page):
    assert "dualisation are not included" in TIMED
    made = page(grown(measured))
    assert TIMED in section(made, "times").tables[0].legend
    assert TIMED in section(made, "scaling").tables[0].legend
    assert TIMED in section(made, "scaling").pictures[0].caption
    assert any(TIMED in point for point in section(made, "definitions").points)


def test_exponents_refer_to_both_sizes(measured, page):
    records = [
        r.replace(quantities=r.quantities | {"equality_rows": 0})
        for r in grown(measured)
    ]
    times, counts = section(page(records), "scaling").tables
    against_n, against_m = rows(times)[-2:]
    assert (against_n["n"].text, against_n["a"].value) == (
        "p against n [95 %]", pytest.approx(0.5),
    )  # fmt: skip
    assert (against_m["n"].text, against_m["a"].value) == (
        "p against m [95 %]", pytest.approx(1.0),
    )  # fmt: skip
    for table in (times, counts):
        assert "n: displacement components" in table.legend
        assert "m: size of the dual" in table.legend


def test_all_parameters_and_sizes_of_the_qp_are_listed(measured, page):
    shared = {"steps": 10, "plane": "strain"}
    records = [
        measured(physical=f"beam-ring/step={k}", params={"step": k} | shared)
        for k in (1, 10)
    ]
    (table,) = section(page(records), "cases").tables
    assert "steps = 10, plane = strain" in table.legend
    first = rows(table)[0]
    assert {k: cell.text for k, cell in first.items()} == {
        "case": "beam-ring/step=1/dual", "form": "dual", "step": "1",
        "variables": "14", "equalities": "3", "inequalities": "0", "bounds": "10",
    }  # fmt: skip


def energies(measured, *values, **changes):
    return [
        measured(f"s{i}", quantities=ELASTIC | {"energy": e}, **changes)
        for i, e in enumerate(values)
    ]


@pytest.mark.parametrize(
    ("others", "text"),
    [
        ([-333734.443434567 * (1 + 2e-6)], "-333734"),  # five digits agree
        ([-333734.443434567 * (1 + 2e-4)], "-3.337e5"),  # without insignificant zeros
        ([-333734.443434567], "-333734.443435"),  # at most twelve digits
        ([], "-333734.443"),  # digits of a single answer follow from its tolerance 1e-8
    ],
)
def test_energies_have_one_more_digit_than_answers_agree_on(
    measured, page, others, text
):
    made = page(energies(measured, -333734.443434567, *others))
    assert rows(section(made, "energies").tables[0])[0]["energy"].text == text
    assert rows(section(made, "physics").tables[1])[0]["energy in J/m"].text == text


def test_a_stress_has_three_digits_and_caveats(measured, page):
    table = section(page([measured()]), "physics").tables[1]
    assert rows(table)[0]["max von Mises beam in Pa"].text == "7.99e8"
    assert "singular under the point load" in table.legend
    assert "tip displacement and energy also depend on the mesh" in table.legend


def test_a_component_has_the_decimals_of_its_vector(measured, page):
    forces = ([4e-7, -999999.7], [-6e-3, -999999.8])
    tips = ([0.00123456789, 1.0], [0.00123456789, 1.00002])
    records = [
        measured(f"s{i}", quantities=ELASTIC | {"contact_force": f, "tip": u})
        for i, (f, u) in enumerate(zip(forces, tips, strict=True))
    ]
    (row,) = rows(section(page(records), "physics").tables[1])
    assert row["contact force x in N/m"].text == "0"
    assert row["contact force y in N/m"].text == "-999999.7"
    assert row["tip x in m"].text == "0.001235"  # the vector of length 1 has 7 digits
    assert row["tip y in m"].text == "1.0000"


def test_physical_results_are_of_the_answer_with_smallest_residual(measured, page):
    records = [
        measured("tight", dual=9e-9, quantities=ELASTIC | {"tip": [1.0, 1.0]}),
        measured("best", tol=1e-6, dual=3e-9, quantities=ELASTIC | {"tip": [2.0, 2.0]}),
        measured("liar", dual=0.0, primal=0.0, gap=0.0, complementarity=0.0,
                 status=Verdict.WRONG),
    ]  # fmt: skip
    (row,) = rows(section(page(records), "physics").tables[1])
    assert row["tip x in m"].value == 2.0
    assert row["answer of"].text == "best on dual, 3.0e-9 at tol 1e-6"


def test_active_rows_on_which_answers_differ_are_a_range(measured, page):
    records = [
        measured("a", quantities=ELASTIC | {"active": 5}),
        measured("b", dual=1e-9, quantities=ELASTIC | {"active": 6}),
        measured("c", quantities=ELASTIC | {"active": 9}, status=Verdict.WRONG),
    ]
    table = section(page(records), "physics").tables[1]
    assert rows(table)[0]["active"].text == "5–6"
    assert "λ_i > 1e-6 max λ" in table.legend


def test_only_elastic_bodies_have_units(measured, page):
    found = {"dofs": 9, "energy": 4.25, "force": {"left": [1.0, 2.0]}, "x": [0.0] * 99}
    made = page([measured(quantities=found, family="obstacle")])
    table = section(made, "physics").tables[1]
    assert table.columns == (
        "physical case", "energy", "force left x", "force left y", "x", "answer of",
    )  # fmt: skip
    assert rows(table)[0]["x"].text == "99 values"
    assert rows(section(made, "energies").tables[0])[0]["energy"].after == ""
    assert "point load" not in table.legend
    assert not any("SI" in text for text in section(made, "physics").prose)


def test_each_symbol_has_one_meaning(measured, page):
    times = {"fast": (1, 2, 3), "tied": (2, 3, 4), "bad": (1, 2, 3)}
    records = [
        measured(s, i, total_seconds=t / 1000,
                 status=Verdict.INACCURATE if s == "bad" else Verdict.VERIFIED)
        for s, ts in times.items() for i, t in enumerate(ts)
    ]  # fmt: skip
    made = page(records)
    assert rows(section(made, "times").tables[0])[0]["tied"].symbol == "≈"
    verdicts = rows(section(made, "verdicts").tables[0])[0]
    assert verdicts["bad"].symbol not in ("", "≈")


@pytest.mark.parametrize(("load", "said"), [(0.51, True), (0.5, False), (None, False)])
def test_a_busy_machine_is_flagged_in_the_summary(measured, page, load, said):
    made = page([measured()], environment={"now": {"load": load}})
    text = " ".join(section(made, "summary").prose)
    assert ("the machine was not idle" in text) is said


def test_unequal_numbers_of_repeats_are_mentioned(measured, page):
    three = [measured("a", i) for i in range(3)]
    ten = [measured("b", i) for i in range(10)]
    declined = [measured("c", status=Verdict.DECLINED)]
    equal = " ".join(section(page(three + declined), "summary").prose)
    assert "unequal" not in equal
    assert "3 to 10" in " ".join(section(page(three + ten), "summary").prose)


def test_declined_cases_do_not_count_as_measurements(measured, page):
    records = [
        *(measured("a", i) for i in range(3)),
        measured("shy", status=Verdict.DECLINED, total_seconds=None),
    ]
    made = section(page(records, suite={"repeats": 3}), "summary")
    assert made.prose[0].startswith(
        "3 measurements of the 6 that the suite requests on these cases (3 were "
        "declined by a solver): 2 solvers"
    )
    shy = rows(made.tables[0])[1]
    assert (shy["measurements"].text, shy["declined"].text) == ("0", "1")
    unfinished = section(page(records[:2], suite={"repeats": 3}), "summary")
    assert "2 measurements of the 3" in unfinished.prose[0]
    assert "(1 is still missing)" in unfinished.prose[0]
    assert section(page(records[:1]), "summary").prose[0].startswith("1 measurement: ")


def test_the_energy_bound_is_explained_only_where_there_is_one(measured, page):
    without = section(page([measured()]), "errors").prose[0]
    bounded = section(page([measured(energy_bound=1e-6)]), "errors").prose[0]
    assert "nergy bound" not in without
    assert "Energy bound" in bounded


def test_without_points_there_is_no_table_of_residuals(measured, page):
    none = dict.fromkeys(("primal", "dual", "complementarity", "gap"))
    lost = measured(status=Verdict.CRASHED, claimed=None, **none)
    found = section(page([lost]), "errors")

    assert found.tables == ()
    assert "no residuals" in found.prose[0]


def test_a_residual_above_a_tenth_is_marked_at_any_tolerance(measured, page):
    found = section(page([measured(tol=0.05, dual=0.2, gap=0.05)]), "errors")
    (row,) = rows(found.tables[0])
    assert (row["dual"].kind, row["gap"].kind) == ("over", "")


IN_SPACE = ELASTIC | {"nodes": 5, "dofs": 15, "contact_force": [-32.0943911, 0.0, 0.0]}


def test_bodies_in_3d_have_forces_in_newtons_and_others_per_metre(measured, page):
    for quantities, per in ((IN_SPACE, ""), (IN_SPACE | {"dofs": 10}, "/m")):
        made = [measured(quantities=quantities), measured("b", quantities=quantities)]
        composed = page(made)
        (heads,) = (t.columns for t in section(composed, "physics").tables[1:])
        (energies,) = map(rows, section(composed, "energies").tables)
        told = dict(re.split(" {2,}", r) for r in outcome(made[0], {}).splitlines())

        assert {f"contact force x in N{per}", f"energy in J{per}"} <= set(heads)
        assert energies[0]["energy"].after == f"J{per}"
        assert told["contact force"] == f"(-32.0943911, 0, 0) N{per}"
        assert told["energy"].endswith(f" J{per}")


@pytest.mark.usefixtures("blank_figures")
def test_a_missing_picture_of_bodies_in_3d_is_reported(measured, tmp_path):
    with Journal(tmp_path, "test") as journal:
        journal.append(measured(fields="0123456789abcdef", quantities=IN_SPACE))
    write_report(tmp_path, ["md"])
    text = (tmp_path / "report/report.md").read_text("utf-8")

    assert "no verified answer has bodies to draw" not in text
    assert "No picture of" in text  # the folder lacks the fields


@pytest.mark.parametrize("damaged", [False, True])
@pytest.mark.usefixtures("blank_figures")
def test_a_report_needs_only_the_journal(measured, tmp_path, damaged):
    with Journal(tmp_path, "test") as journal:
        journal.append(measured(fields="0123456789abcdef"))
    if damaged:
        (tmp_path / "vectors").mkdir()
        (tmp_path / "vectors/0123456789abcdef.npz").write_bytes(
            b"PK\x03\x04 and no more"
        )
    write_report(tmp_path, ["html", "md", "tex", "csv"])
    text = (tmp_path / "report/report.md").read_text("utf-8")
    (why,) = re.findall(r"^No picture of .*$", text, flags=re.MULTILINE)
    assert "vectors/0123456789abcdef.npz" in why
    assert not (tmp_path / "report/figures/deformed.png").exists()


def test_the_ends_of_time_intervals_are_distinguishable():
    narrow = median_interval([0.1196, 0.1199, 0.1201])
    assert seconds(narrow) == "119.9 ms [119.6, 120.1]"
    nearly = median_interval([0.11998, 0.12, 0.12001])
    assert seconds(nearly) == "120.00 ms [119.98, 120.01]"
    assert exponent(PowerLaw(1.5, 1.4999, 1.5001, 1, 4)) == "1.5000 [1.4999, 1.5001]"


def test_the_text_states_assumptions_and_coverage_of_intervals(measured, page):
    three = section(page([measured("a", i) for i in range(3)]), "times")
    text = " ".join(three.prose)
    assert "independent and identically distributed" in text
    assert "with 3 repeats, one interval in 4 misses the true median" in text
    assert "75 %" in text
    seven = section(page([measured("a", i) for i in range(7)]), "times")
    assert "weak" not in " ".join(seven.prose)


def test_numbers_are_formatted_in_the_usual_way():
    assert [power(v) for v in (1.4, 0.25, 3.2e-9, 14.0)] == (
        ["1.4", "0.25", "3.2e-9", "1.4e1"]
    )
    assert significant(140000.0, 2) == "1.4e5"
    assert significant(-1.67787364123456e7, 12) == "-16778736.4123"


def test_the_last_rows_of_a_table_are_ruled_off_once(measured, page):
    times, _ = section(page(grown(measured)), "scaling").tables
    body = latex((times,)).split(r"\midrule")
    assert len(body) == 3  # headings, sizes, the two exponents
    assert body[2].count("p against") == 2


def test_words_are_left_aligned_in_every_format(measured, page):
    text = markdown(page([measured()], environment={"machine": {"cpu": "x"}}))
    assert "| key | value |\n| :-- | :-- |" in text
    words = Table(
        caption="", columns=("n", "who"), rows=((Cell(), Cell(kind="words")),),
        text_columns=0,
    )  # fmt: skip
    assert [words.wordy(i) for i in range(2)] == [False, True]


@pytest.mark.usefixtures("blank_figures")
def test_a_wide_table_scrolls_with_a_fixed_first_column(measured, tmp_path):
    with Journal(tmp_path, "test") as journal:
        journal.append(measured())
    write_report(tmp_path, ["html"])
    text = (tmp_path / "report/index.html").read_text("utf-8")
    tables = text.count('<div class="scroll"')
    assert tables > 5
    hint = '<p class="hint" hidden>more columns: scroll sideways →</p>'
    assert len(re.findall(rf'{hint}\s*<div class="scroll"', text)) == tables
    assert re.search(r"\.wide td:first-child \{ position: sticky; left: 0;", text)


def test_every_refuted_claim_is_listed_with_its_evidence(measured, page):
    records = [
        measured("sound"),
        measured("hasty", status=Verdict.INACCURATE, gap=3e-6, message="Optimal"),
        measured("blind", status=Verdict.INFEASIBLE_CLAIM, claimed="infeasible",
                 primal=None, dual=None, complementarity=None, gap=None),
        measured("modest", status=Verdict.ITERATION_LIMIT, claimed="iteration_limit"),
    ]  # fmt: skip
    _, refuted = section(page(records), "verdicts").tables
    listed = {row["solver"].text: row for row in rows(refuted)}
    assert listed.keys() == {"hasty", "blind"}
    assert listed["hasty"]["evidence"].text == "gap 3.0e-6 > 1.0e-7"
    assert listed["hasty"]["message of the solver"].text == "Optimal"
    assert listed["blind"]["evidence"].text == "no point"
    assert len(section(page(records[:1]), "verdicts").tables) == 1


def test_the_objective_of_an_unverified_answer_is_compared_with_the_others(
    measured, page
):
    """The planted optimum is −2; other objectives are relative to the larger value."""
    wrong = {"status": Verdict.WRONG, "gap": 3e-3}
    late = {"status": Verdict.ITERATION_LIMIT, "claimed": "iteration_limit"}
    records = [
        measured("sound", objective=-2.0),
        measured("rough", objective=-2.1, gap=9e-8),  # verified, but less accurate
        measured("high", objective=-1.998, message="row 3 violated", **wrong),
        measured("low", objective=-2.5, **wrong),
        measured("near", objective=-2.0 - 1e-8, **wrong),
        measured("late", objective=1.0, gap=0.1, **late),
    ]
    found = section(page(records), "verdicts")
    text = {row["solver"].text: row["evidence"].text for row in rows(found.tables[1])}
    gap = "gap 3.0e-3 > 1.0e-7"

    assert text == {
        "high": f"{gap}; the objective is 1.0e-3 above that of the other solvers",
        "low": f"{gap}; the objective is 0.20 below that of the other solvers",
        "near": gap,
    }
    (point,) = found.points
    assert point.startswith("late reached the iteration limit on ")
    assert "the objective is 1.5 above that of the other solvers" in point


def test_identical_failures_are_one_line(measured, page):
    lost = {"status": Verdict.CRASHED, "claimed": None, "message": "SIGSEGV"}
    blind = {"status": Verdict.WRONG, "message": "NaN in z"}
    nothing = dict.fromkeys(("primal", "dual", "complementarity", "gap"))
    records = [
        measured(solver, physical=f"beam-ring/n={n}", **end, **nothing)
        for solver, end in (("fragile", lost), ("blind", blind))
        for n in range(52)
    ]
    found = section(page([measured(), *records]), "verdicts")

    assert [point.partition("tol 1e-8: ")[2] for point in found.points] == [
        "SIGSEGV (the same in 52 answers)."
    ]
    (row,) = rows(found.tables[1])
    assert row["case"].after == "the same in 52 answers"
    assert row["message of the solver"].text == "NaN in z"
    assert len(row["evidence"].title.split(", ")) == 52


def test_a_scaling_figure_grows_with_its_legend(measured, tmp_path):
    """With thirty solvers, the axes have at least 80 % of the height with three."""

    def height(count):
        names = [f"solver-{i}" for i in range(count)]
        records = [r for name in names for r in grown(measured, solver=name)]
        evidence = Evidence(directory=tmp_path, records=arrange(records))
        (series,) = size_series(evidence)
        figure = draw(scaling_figure(series, evidence.solvers))
        figure.draw_without_rendering()
        return figure.axes[0].get_position().height * figure.get_figheight()

    assert height(30) >= 0.8 * height(3)


def test_refuted_claims_are_listed_with_the_common_accuracy(measured, page):
    """At tolerance 1e-4 and accuracy 1e-6, a residual of 5e-5 exceeds 1e-5."""
    record = measured(
        tol=1e-4, accuracy=1e-6, gap=5e-5, status=Verdict.INACCURATE, primal=0.0
    )
    tables = [table for part in page([record]).sections for table in part.tables]
    (row,) = (r for table in tables for r in rows(table) if "evidence" in r)

    assert row["evidence"].text == "gap 5.0e-5 > 1.0e-5"


def test_a_suite_of_cold_solves_and_sequences_is_complete(measured, page):
    cold = [measured(physical="beam-ring/n=1")]
    steps = [
        measured("a (sequence)", physical=f"beam-ring/n={n}", mode="sequence")
        for n in (2, 3)
    ]
    text = markdown(page([*cold, *steps]))

    assert "3 measurements" in text
    assert "not made yet" not in text
