"""Opening of reports: fastest combination of solver and form, with dualisation."""

import re
from functools import partial

import numpy as np
import pytest

from mortarbench.cli.main import main
from mortarbench.harness import Verdict
from mortarbench.harness.results.journal import Journal
from mortarbench.registries import Registries
from mortarbench.reports import answer, write_report
from mortarbench.reports.data.evidence import Evidence, arrange
from mortarbench.reports.data.fastest import Finding
from mortarbench.reports.data.ways import compare_ways
from mortarbench.reports.folder import compose
from tests.support.box_records import box_record

DUALISING = 1e-3  #: time of dualisation on the smallest problem, s


@pytest.fixture
def record():
    return partial(box_record, environment="abc")


@pytest.fixture
def evidence(tmp_path):
    def make(records, **suite):
        return Evidence(directory=tmp_path, records=arrange(records), suite=suite)

    return make


def problems(record, count=8, repeats=1, scatter=0.02, seed=1, **ways):
    """Return records of the combinations "solver_form" on problems of growing size.

    ways : time of each combination on the smallest problem without dualisation, s
    """
    rng = np.random.default_rng(seed)
    for way, seconds in ways.items():
        solver, form = way.split("_")
        for k in range(count):
            for i in range(repeats):
                size = 2.0**k
                yield record(
                    solver, k, size * seconds * rng.lognormal(0, scatter), i, form=form,
                    dualise_seconds=DUALISING * size if form == "dual" else None,
                )  # fmt: skip


def four_ways(record, **more):
    """Return records of four combinations of solver and form.

    The times with dualisation are 1.5 ms (a on dual), 1.8 ms (b on dual), 3 ms (b on
    primal) and 6 ms (a on primal).
    """
    ways = dict(a_dual=5e-4, b_dual=8e-4, b_primal=3e-3, a_primal=6e-3)
    return list(problems(record, **(ways | more)))


def first_sentence(made):
    return compose(made).sections[0].statements[0].claims[0]


def ratio_after(words, text):
    found = re.search(rf"{words} (\S+) \[(\S+), (\S+)\]", text)
    return tuple(map(float, found.groups()))


def test_the_first_sentence_contains_the_planted_winner_and_ratios(record, evidence):
    claim = first_sentence(evidence(four_ways(record)))
    assert claim.startswith(
        "From the mesh to a verified answer, including dualisation: a on the dual form "
        "was the fastest over 8 problems at tol 1e-6; the next, b on the dual form, "
        "took "
    )
    for words, ratio in (("form, took", 1.8 / 1.5), ("primal form, b, took", 2.0)):
        value, low, high = ratio_after(words, claim)
        assert low < ratio < high
        assert value == pytest.approx(ratio, rel=0.03)
        assert high / low < 1.2


def test_dualisation_may_make_the_primal_form_the_fastest(record, evidence):
    """Without dualisation, a on dual is five times as fast as b on primal."""
    records = list(problems(record, a_dual=2e-4, b_primal=1e-3, c_dual=4e-4))
    claim = first_sentence(evidence(records))
    assert "dualisation: b on the primal form was the fastest" in claim
    assert ratio_after("form, took", claim)[0] == pytest.approx(1.2, rel=0.03)


def test_comparisons_of_solvers_by_form_follow_with_a_title(record, evidence):
    page = compose(evidence(four_ways(record)))
    first, second = page.sections[:2]
    assert [s.subject for s in first.statements] == ["all forms"]
    assert second.title == "Solver times for each form"
    assert "dualisation are not included" in second.prose[0]
    dual, primal = second.statements
    assert (dual.subject, primal.subject) == ("dual", "primal")
    assert dual.claims[0].startswith("a was the fastest over 8 cases")
    assert ratio_after("next, b, took", dual.claims[0])[0] == pytest.approx(
        1.6, rel=0.03
    )
    assert primal.claims[0].startswith("b was the fastest over 8 cases")


def test_each_point_of_the_first_figure_has_its_measurements_and_its_solver(
    record, evidence
):
    made = evidence(four_ways(record))
    (picture,) = compose(made).sections[0].pictures
    (panel,) = picture.figure.panels
    names = [name for _, name in panel.y.ticks]
    assert names == ["a, dual", "b, dual", "b, primal", "a, primal"]
    owners = {r.run_id: r.solver for r in made.records}
    for series in panel.marks:
        assert {owners[run] for runs in series.runs for run in runs} == {series.solver}
    assert "all forms, tol 1e-6, 8 problems of box" in panel.title


def test_equal_combinations_tie_with_interval_and_advice(record, evidence):
    records = list(problems(record, a_dual=1e-3, b_primal=2e-3, c_primal=9e-3))
    made = evidence(records)
    claim = first_sentence(made)
    (found,) = compare_ways(made).comparisons
    assert found.finding is Finding.TIE
    assert "dualisation: a tie over 8 problems" in claim
    assert "do not differ significantly" in claim
    value, low, high = ratio_after("form took", claim)
    assert low <= 1 <= value <= high
    assert "more repeats may separate them (--repeats 9)" in claim
    assert ratio_after("c on the primal form, took", claim)[0] > 4


@pytest.mark.parametrize("seeds", [8, pytest.param(25, marks=pytest.mark.slow)])
def test_intervals_of_ties_contain_one(record, evidence, seeds):
    """Intervals of combinations that are called slower do not contain 1."""
    rng = np.random.default_rng(3)
    for count in (6, 7, 9):
        for seed in range(seeds):
            ways = {
                f"{s}_{form}": 1e-3 * (1 + (form == "primal")) * rng.uniform(1, 1.5)
                for s in "abc" for form in ("dual", "primal")
            }  # fmt: skip
            records = problems(record, count, scatter=0.2, seed=seed, **ways)
            (found,) = compare_ways(evidence(list(records))).comparisons
            for c in found.competitors[1:]:
                assert c.slower is (c.ratio.low > 1)


def test_more_repeats_are_not_advised_if_the_order_depends_on_the_case(
    record, evidence
):
    records = [
        r for k in range(8) for solver, turn in (("a", 1), ("b", -1))
        for i in range(4)
        for r in [record(solver, k, 0.01 * 3.0 ** (turn * (-1) ** k / 2) * (1 + i / 99),
                         i, form="primal")]
    ]  # fmt: skip
    statements = compose(evidence(records)).sections[0].statements
    assert (
        "which is faster depends on the case, and more repeats will not change this"
        in (statements[0].claims[0])
    )


def test_few_problems_are_compared_within_blocks(record, evidence):
    records = four_ways(record, count=2, repeats=4)
    claim = first_sentence(evidence(records))
    assert "a on the dual form was the fastest on each of 2 problems" in claim
    assert ratio_after("took at least", claim)[0] == pytest.approx(1.2, rel=0.05)
    (picture,) = compose(evidence(records)).sections[0].pictures
    assert "Dualisation is measured once per build" in picture.caption


def test_different_winners_are_counted_by_problem(record, evidence):
    def measured(k, **ways):
        return [
            r.replace(
                case=f"box/n={k}/{r.form}", params={"n": k}, run_id=f"{r.run_id} {k}"
            )
            for r in problems(record, 1, 4, **ways)
        ]

    records = [
        *measured(0, a_dual=1e-3, b_primal=9e-3, b_dual=7e-3),
        *measured(1, a_dual=9e-3, b_primal=3e-3, b_dual=2e-3),
    ]
    assert first_sentence(evidence(records)).endswith(
        "no combination was the fastest on each of 2 problems at tol 1e-6: a on the "
        "dual form on 1, a tie of b on the dual form and b on the primal form on 1; "
        "more repeats may decide ties (--repeats 12); a on the dual form had the "
        "smallest mean time."
    )


def test_single_repeats_of_few_problems_name_no_winner(record, evidence):
    claim = first_sentence(evidence(four_ways(record, count=2)))
    assert "a on the dual form had the smallest mean time over 2 problems" in claim
    assert "(next: b on the dual form, about 1.2 times as long; " in claim
    assert "the best on the primal form, b, about 2.0 times as long)" in claim
    assert "an interval needs at least two blocks of repeats (--repeats 9)" in claim


def test_a_form_that_no_solver_solves_completely_is_named(record, evidence):
    records = [
        r.replace(status=Verdict.WRONG)
        if r.form == "primal" and r.params["n"] == 3
        else r
        for r in four_ways(record)
    ]
    claim = first_sentence(evidence(records))
    assert claim.endswith("; no solver was verified on every case in the primal form.")


def test_problems_without_time_of_dualisation_are_left_out(record, evidence):
    """Records of older versions lack the time of dualisation."""
    known = four_ways(record, count=9)
    old = [r.replace(dualise_seconds=None) if r.params["n"] == 0 else r for r in known]
    page = compose(evidence(old))
    assert "over 8 problems" in page.sections[0].statements[0].claims[0]
    assert page.sections[0].prose == (
        "The forms are not compared on 1 problem, because the records lack the time of "
        "dualisation.",
    )
    oldest = [r.replace(dualise_seconds=None) for r in known]
    page = compose(evidence(oldest))
    assert [s.subject for s in page.sections[0].statements] == ["dual", "primal"]
    assert "not compared on 9 problems" in page.sections[0].prose[0]


def test_a_single_dual_form_includes_dualisation(record, evidence):
    records = list(problems(record, a_dual=1e-4, b_dual=1e-3))
    claim = first_sentence(evidence(records))
    assert ratio_after("form, took", claim)[0] == pytest.approx(2 / 1.1, rel=0.03)


def test_a_single_primal_form_is_compared_by_solver(record, evidence):
    made = evidence(list(problems(record, a_primal=1e-4, b_primal=1e-3)))
    assert compare_ways(made).comparisons == ()
    assert first_sentence(made).startswith("a was the fastest over 8 cases")


def test_a_single_combination_is_not_compared(record, evidence):
    made = evidence(list(problems(record, a_dual=1e-4)))
    assert compare_ways(made).comparisons == ()


def test_tolerances_are_compared_separately_tightest_first(record, evidence):
    loose = [
        r.replace(tol=1e-3, run_id=f"{r.run_id} loose")
        for r in problems(record, a_dual=4e-3, b_dual=3e-3, b_primal=1e-3, a_primal=9.0)
    ]
    (statement,) = compose(evidence(four_ways(record) + loose)).sections[0].statements
    tight, other = statement.claims
    assert "a on the dual form was the fastest over 8 problems at tol 1e-6" in tight
    assert "b on the primal form was the fastest over 8 problems at tol 1e-3" in other


@pytest.mark.usefixtures("blank_figures")
def test_the_command_report_prints_only_the_first_sentence(record, tmp_path, capsys):
    with Journal(tmp_path, "test") as journal:
        for r in four_ways(record):
            journal.append(r)
    assert main(Registries(), ["report", str(tmp_path), "--format", "md"]) == 0
    printed = capsys.readouterr().out.splitlines()
    assert printed[0] == answer(tmp_path)[0]
    assert sum(line.startswith("all forms: ") for line in printed) == 1


@pytest.mark.usefixtures("blank_figures")
def test_the_first_sentence_is_the_same_in_the_report_and_in_plain_text(
    record, tmp_path
):
    with Journal(tmp_path, "test") as journal:
        for r in four_ways(record):
            journal.append(r)
    told = answer(tmp_path)[0].removeprefix("all forms: ")
    assert told.startswith("From the mesh to a verified answer")
    write_report(tmp_path, ["md", "html"])
    text = (tmp_path / "report/report.md").read_text("utf-8")
    assert told.replace("[", r"\[").replace("]", r"\]") in text
    first = text.index("From the mesh")
    assert text.index("Solver times for each form") > first
    page = (tmp_path / "report/index.html").read_text("utf-8")
    shown = re.sub(r"<[^>]+>|\n", "", page[page.index('<dl class="answer">') :])
    assert shown.startswith(f"all forms{told}")
