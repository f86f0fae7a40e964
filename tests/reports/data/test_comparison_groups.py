"""Sections on means, ranks, profiles, ratios, growth and claims, from records."""

import re

import numpy as np
import pytest

from mortarbench.harness import Verdict
from mortarbench.harness.results.journal import Journal
from mortarbench.harness.running.pairs import paired_ratio, ratio_of, unpaired_ratio
from mortarbench.reports import write_report
from mortarbench.reports.data.aggregation import ranking_of
from mortarbench.reports.data.comparison_groups import comparison_groups
from mortarbench.reports.data.evidence import Evidence, arrange, read_evidence
from mortarbench.reports.export.csv_tables import comparison_tables, csv_tables
from mortarbench.reports.figures.profiles import (
    ROW,
    pairwise_figure,
    profile_figure,
    rows_of,
)
from mortarbench.reports.figures.style import look
from mortarbench.reports.folder import compose
from mortarbench.reports.render.markdown import markdown
from mortarbench.reports.render.saving import draw
from tests.support.box_records import box_record

LIMIT = 20.0


@pytest.fixture
def record():
    return box_record


@pytest.fixture
def evidence(tmp_path):
    def make(records, **suite):
        given = {"time_limit": LIMIT} | suite
        return Evidence(directory=tmp_path, records=arrange(records), suite=given)

    return make


def section(page, name):
    return next((s for s in page.sections if s.name == name), None)


def rows(table):
    return {
        row[0].text: dict(zip(table.columns, row, strict=True)) for row in table.rows
    }


def some_records(record, solvers, cases=6):
    """Return records in which solver k takes k + 1 times as long as the first one."""
    return [
        record(f"s{k:02d}", case, (k + 1) * 0.01 * (case + 1))
        for k in range(solvers)
        for case in range(cases)
    ]


# ---- groups that are compared


OVER_CASES = ("means", "ranking", "profiles")
#: end of the sentence in all sections except the first; the first states the reasons
ELSEWHERE = "of cases, for the reasons given under “Means over cases”."


def over_cases(page):
    """Return the sections over cases, and assert that none is missing."""
    found = {s.name: s for s in page.sections}
    return [found[name] for name in OVER_CASES]


@pytest.mark.parametrize(
    ("solvers", "cases", "said"),
    [(3, 5, "dual, tol 1e-6: 5 cases."), (1, 6, "dual, tol 1e-6: 1 solver.")],
)
def test_fewer_than_six_cases_or_two_solvers_are_not_compared(
    record, evidence, solvers, cases, said
):
    page = compose(evidence(some_records(record, solvers, cases=cases)))
    texts = []
    for section in over_cases(page):
        assert (section.tables, section.pictures) == ((), ())
        (text,) = section.prose
        texts.append(text)
        assert "--pool-forms" not in text
    assert texts[0].startswith(
        f"Nothing is compared here: {said} A comparison needs at least 6 cases of"
    )
    assert set(texts[1:]) == {f"Nothing is compared here: 1 group {ELSEWHERE}"}


def of_two_forms(record, primal):
    """Return records of dual and primal cases on which b takes three times as long."""
    return [
        record(s, case, seconds, form=form)
        for s, seconds in (("a", 0.1), ("b", 0.3))
        for form, count in (("dual", 3), ("primal", primal))
        for case in range(count)
    ]


def test_forms_with_few_cases_are_named_with_the_pooling_option(record, evidence):
    sections = over_cases(compose(evidence(of_two_forms(record, 3))))
    ((text,), *others) = (section.prose for section in sections)
    assert "dual, tol 1e-6: 3 cases; primal, tol 1e-6: 3 cases." in text
    assert '"mortarbench report DIR --pool-forms"' in text
    assert set(others) == {(f"Nothing is compared here: 2 groups {ELSEWHERE}",)}


def test_forms_that_are_not_compared_are_named(record, evidence):
    for section in over_cases(compose(evidence(of_two_forms(record, 6)))):
        assert len(section.tables) == 1
        is_first = section.name == "means"
        named = "dual, tol 1e-6: 3 cases." if is_first else f"1 group {ELSEWHERE}"
        assert section.prose[-1].startswith(f"Not compared here: {named}")


def test_pooled_forms_are_cases_of_one_group(record, evidence):
    """If the times on all cases of all forms are equal, the mean equals them."""
    page = compose(evidence(of_two_forms(record, 3)), pool_forms=True)
    for section in over_cases(page):
        assert len(section.tables) == 1
    table = over_cases(page)[0].tables[0]
    assert "all forms, tol 1e-6: 6 cases" in table.caption
    assert "Pooled forms: dual 3 cases, primal 3 cases." in table.legend
    assert [row[3].value for row in table.rows] == pytest.approx([0.1, 0.3])
    assert not any("--pool-forms" in text for s in page.sections for text in s.prose)


def test_declined_forms_count_as_unsolved_if_forms_are_pooled(record, evidence):
    records = [
        r for r in of_two_forms(record, 3) if (r.solver, r.form) != ("b", "dual")
    ]
    records += [
        record("b", case, None, form="dual", status=Verdict.DECLINED, claimed=None)
        for case in range(3)
    ]
    (found,) = comparison_groups(evidence(records), pool_forms=True)
    assert found.solved.sum(axis=0).tolist() == [6, 3]
    assert dict(found.forms) == {"dual": 3, "primal": 3}


def test_missing_sections_are_named_with_their_requirements(record, evidence):
    page = compose(evidence(some_records(record, 2)))
    (absent,) = (s for s in page.sections if s.name == "absent")
    shown = {s.title for s in page.sections}
    missing = {point.partition(":")[0] for point in absent.points}
    assert "Ratios within blocks" in missing
    assert not shown & missing
    assert {s.name for s in page.sections[-2:]} == {"environment", "definitions"}


def test_forms_tolerances_and_modes_are_compared_separately(record, evidence):
    records = [
        record(s, case, form=form, tol=tol)
        for s in "ab"
        for case in range(6)
        for form in ("primal", "dual")
        for tol in (1e-3, 1e-6)
    ]
    records += [record(f"{s} (sequence)", 9 + case, mode="sequence")
                for s in "ab" for case in range(6)]  # fmt: skip
    titles = {c.title for c in comparison_groups(evidence(records))}
    assert titles == {
        "primal, tol 1e-3", "primal, tol 1e-6", "dual, tol 1e-3", "dual, tol 1e-6",
        "dual, sequence, tol 1e-6",
    }  # fmt: skip


def test_times_are_medians_of_answers_that_every_repeat_verified(record, evidence):
    records = [
        record("a", case, seconds, repeat)
        for case in range(6)
        for repeat, seconds in enumerate((0.3, 0.1, 0.2))
    ]
    records += [
        record("b", case, 0.1, repeat,
               status=Verdict.WRONG if (case, repeat) == (3, 1) else Verdict.VERIFIED,
               claimed="failed" if (case, repeat) == (5, 2) else "solved")
        for case in range(6)
        for repeat in range(3)
    ]  # fmt: skip
    (found,) = comparison_groups(evidence(records))
    assert found.times[:, 0] == pytest.approx(0.2)
    assert np.isinf(found.times[:, 1]).tolist() == [False] * 3 + [True] + [False] * 2
    assert np.isinf(found.claimed[:, 1]).tolist() == [False] * 5 + [True]


def test_null_arms_are_not_compared(record, evidence):
    null = [record("a (A/A)", case, 1e-4, arm="null") for case in range(6)]
    (found,) = comparison_groups(evidence([*some_records(record, 2), *null]))
    assert found.solvers == ("s00", "s01")


def test_a_solver_that_declines_all_cases_is_not_compared(record, evidence):
    def declined(solver, case):
        return record(solver, case, None, status=Verdict.DECLINED, claimed=None)

    records = some_records(record, 2)
    records += [declined("never", case) for case in range(6)]
    records += [declined("some", case) for case in range(2)]
    records += [record("some", case) for case in range(2, 6)]
    (found,) = comparison_groups(evidence(records))
    assert found.solvers == ("s00", "s01", "some")
    assert np.isinf(found.times[:2, 2]).all()
    assert found.notes == ("Solvers that declined all cases: never.",)


def test_cases_with_missing_measurements_are_left_out(record, evidence):
    records = some_records(record, 2, cases=8) + [
        record("late", case) for case in range(6)
    ]
    records += [record("rare", case) for case in range(2)]
    (found,) = comparison_groups(evidence(records))
    assert len(found.cases) == 6
    assert found.solvers == ("late", "s00", "s01")
    assert found.notes == (
        "Left out because they were measured on less than half of the cases: rare.",
        "Left out because they were not measured with all solvers: 2 cases.",
    )


def test_the_fastest_verified_answer_of_a_sweep_is_used(record, evidence):
    records = [
        record(s, case, seconds * (2 if s == "b" else 1), tol=tol, accuracy=1e-6,
               status=status)
        for s in "ab"
        for case in range(6)
        for tol, seconds, status in (
            (1e-3, 0.01, Verdict.WRONG),
            (1e-5, 0.02, Verdict.VERIFIED),
            (1e-7, 0.03, Verdict.VERIFIED),
        )
    ]  # fmt: skip
    (found,) = comparison_groups(evidence(records))
    assert found.title == "dual, accuracy 1e-6"
    assert found.times == pytest.approx(np.full((6, 2), 0.02) * [1, 2])


def test_a_time_limit_is_censored_and_a_refuted_answer_is_not(record, evidence):
    ends = {
        0: dict(seconds=None, status=Verdict.TIME_LIMIT, claimed=None),
        1: dict(seconds=7.0, status=Verdict.TIME_LIMIT, claimed="time_limit"),
        2: dict(seconds=0.1, status=Verdict.WRONG),
        3: dict(seconds=0.1, status=Verdict.ITERATION_LIMIT, claimed="iteration_limit"),
    }
    records = some_records(record, 1)
    records += [record("b", case, **ends.get(case, {})) for case in range(6)]
    (found,) = comparison_groups(evidence(records))
    np.testing.assert_array_equal(
        found.stopped[:, 0], [LIMIT, 7.0, np.nan, np.nan, np.nan, np.nan]
    )
    assert np.isnan(found.stopped[:, 1]).all()
    cell = rows(section(compose(evidence(records)), "means").tables[0])["b"]
    assert cell["mean up to the limit"].after == "2 out of time, 2 never"


def test_one_time_limit_makes_a_cell_late(record, evidence):
    late = dict(status=Verdict.TIME_LIMIT, claimed=None, seconds=None)
    records = some_records(record, 2)
    records += [record("z", case, repeat=i) for case in range(6) for i in range(2)]
    records += [record("z", 2, repeat=2, **late)]
    (found,) = comparison_groups(evidence(records))
    assert np.isinf(found.times[2, 2])
    assert not np.isnan(found.stopped[2, 2])


# ---- tables and sentences


def test_a_planted_ratio_is_in_the_table_of_means(record, evidence):
    found = rows(section(compose(evidence(some_records(record, 3))), "means").tables[0])
    assert found["s00"]["mean"].kind == "best"
    assert found["s02"]["both solved, to the leader"].text == "3.00 [3.00, 3.00]"
    assert found["s02"]["both solved, to the leader"].after == "n = 6"
    assert [found[s]["tier"].value for s in found] == [1, 2, 3]
    assert found["s01"]["P(best)"].text == "0"


def test_a_ratio_needs_enough_cases_that_both_solved(record, evidence):
    some = [
        record(
            "some", case, 1.0, status=Verdict.WRONG if case > 4 else Verdict.VERIFIED
        )
        for case in range(8)
    ]
    page = compose(evidence([*some_records(record, 2, cases=8), *some]))
    cells = rows(section(page, "means").tables[0])
    assert cells["s01"]["both solved, to the leader"].after == "n = 8"
    assert cells["some"]["both solved, to the leader"].value is None


def test_a_solver_that_solves_nothing_has_no_mean(record, evidence):
    bad = [record("bad", case, status=Verdict.WRONG) for case in range(6)]
    page = compose(evidence([*some_records(record, 2), *bad]))
    cells = rows(section(page, "means").tables[0])["bad"]
    assert cells["mean"].text == cells["mean up to the limit"].text == "none solved"
    shares = rows(section(page, "profiles").tables[0])["bad"]
    assert shares["at all"].value == 0


def test_the_rank_of_a_solver_with_false_claims_depends_on_the_convention(
    record, evidence
):
    liar = [record("liar", case, 1e-4, status=Verdict.WRONG) for case in range(6)]
    found = section(compose(evidence([*some_records(record, 2), *liar])), "ranking")
    cells = rows(found.tables[0])
    assert cells["liar"]["rank"].value == 3
    assert cells["liar"]["claimed"].text == "1"
    assert cells["liar"]["claimed"].kind == "over"
    assert cells["liar"]["all"].text == "1–3"
    assert cells["liar"]["reading"].text == "depends on the convention"
    assert (
        "reverse the order of 2 pairs, of which 2 differ significantly"
        in found.points[0]
    )


def test_equal_solvers_are_ties(record, evidence):
    rng = np.random.default_rng(31)
    records = [
        record(s, case, 0.01 * (case + 1) * rng.lognormal(0, 0.1))
        for s in "abcd"
        for case in range(12)
    ]
    found = section(compose(evidence(records)), "ranking")
    assert (
        "4 solvers in 1 tier; 0 of 6 pairs significantly different" in found.points[0]
    )
    cells = rows(found.tables[0]).values()
    assert {row["rank interval"].text for row in cells} == {"1–4"}
    assert all("not significant" in row["reading"].text for row in cells)


def test_ranks_that_no_convention_changes_are_reported(record, evidence):
    found = section(compose(evidence(some_records(record, 2))), "ranking")
    assert found.points[0].endswith(
        "1 of 1 pair significantly different; no convention reverses the order of a "
        "pair."
    )
    assert {row["reading"].text for row in rows(found.tables[0]).values()} == {
        "same under all conventions"
    }


def test_no_mean_is_printed_without_its_interval(record, evidence):
    table = section(compose(evidence(some_records(record, 4))), "means").tables[0]
    for name in ("mean", "mean up to the limit"):
        assert all("[" in row[name].text for row in rows(table).values())


def test_the_sections_render(record, evidence):
    text = markdown(compose(evidence(some_records(record, 7))))
    for title in (
        "Means over cases",
        "Dependence of the ranking on conventions",
        "Profiles",
    ):
        assert f"## {title}" in text


# ---- figures


@pytest.mark.parametrize("count", [2, 7, 20, pytest.param(50, marks=pytest.mark.slow)])
def test_solvers_are_distinguishable_in_every_row_of_profiles(record, evidence, count):
    records = [
        record(f"s{k:02d}", case, (1 + (k % 6) + k / 100) * 0.01 * (case + 1))
        for k in range(count)  # solvers of equal colour are neighbours
        for case in range(6)
    ]
    found = evidence(records)
    (one,) = map(ranking_of, comparison_groups(found))
    groups = rows_of(one, found.solvers)
    shown = [i for row in groups for i in row]
    assert sorted(shown) == sorted(int(i) for i in one.order[:16])
    for row in groups:
        colours = {look(i).colour for i in row}
        assert len(colours) == len(row) <= ROW
    figure = draw(profile_figure(one, found.solvers))
    named = [
        text.get_text()
        for part in figure.subfigs
        for legend in part.legends
        for text in legend.get_texts()
    ]
    assert sorted(named) == sorted(one.group.solvers[i] for i in shown)


def test_pairwise_panels_compare_the_leader_with_the_next_solvers(record, evidence):
    found = evidence(some_records(record, 5))
    (one,) = map(ranking_of, comparison_groups(found))
    figure = draw(pairwise_figure(one, found.solvers))
    drawn = [axes for axes in figure.axes if axes.axison]
    assert len(drawn) == 4
    for axes in drawn:
        ends = [float(line.get_ydata()[-1]) for line in axes.lines]
        starts = [float(line.get_ydata()[0]) for line in axes.lines]
        assert ends == [1, 1]
        assert starts == [0, 1]  # the leader is faster than the rival on every case


@pytest.mark.parametrize(
    ("solvers", "cases", "bands"), [(2, 6, 2), (3, 6, 0), (3, 20, 3)]
)
def test_bands_are_drawn_if_they_do_not_overlap_too_much(
    record, evidence, solvers, cases, bands
):
    found = evidence(some_records(record, solvers, cases=cases))
    (one,) = map(ranking_of, comparison_groups(found))
    for axes in draw(profile_figure(one, found.solvers)).subfigs[0].axes:
        assert len(axes.collections) == bands
    if solvers > 2:
        assert len(draw(pairwise_figure(one, found.solvers)).axes[0].collections) == 2


def test_two_solvers_need_no_pictures_of_pairs(record, evidence):
    found = section(compose(evidence(some_records(record, 2))), "profiles")
    assert [p.name for p in found.pictures] == ["profiles-1"]


# ---- ratios within blocks


def test_a_slowdown_of_a_block_cancels_in_ratios(record, evidence):
    slow = [1.0, 10.0, 3.0, 1.5]
    records = [
        record(s, 0, factor * load, repeat)
        for s, factor in (("a", 0.01), ("b", 0.02))
        for repeat, load in enumerate(slow)
    ]
    (row,) = section(compose(evidence(records)), "ratios").tables[0].rows
    assert [cell.text for cell in row[2:]] == ["1", "2.00 [2.00, 2.00]"]


def test_ratios_whose_interval_contains_one_are_ties(record, evidence):
    noise = [1.1, 0.9, 1.05, 0.97]
    records = [record("a", 0, 0.01, i) for i in range(4)]
    records += [record("b", 0, 0.0101 * e, i) for i, e in enumerate(noise)]
    records += [record("c", 0, 0.001, i, status=Verdict.WRONG) for i in range(4)]
    (row,) = section(compose(evidence(records)), "ratios").tables[0].rows
    assert [cell.kind for cell in row[2:]] == ["best", "tied", ""]
    assert row[-1].value is None


def test_single_runs_have_no_ratios(record, evidence):
    assert section(compose(evidence(some_records(record, 2))), "ratios") is None


# ---- growth


def test_growth_is_detected_and_not_predicted_beyond_the_sizes(record, evidence):
    def sized(solver, power, cases):
        return [
            record(solver, c, 1e-6 * (c + 1) ** 1.5,
                   iterations=round(100 * (c + 1) ** power))
            for c in cases
        ]  # fmt: skip

    records = sized("flat", 0.0, range(6)) + sized("grows", 0.5, range(6))
    records += sized("short", 0.5, range(4)) + sized("few", 0.5, range(3))
    found = rows(section(compose(evidence(records)), "growth").tables[0])
    at = "time at n = 600"
    assert found["flat"]["iterations"].text == "flat"
    assert found["flat"]["per decade [95 %]"].text == "+0 % [+0, +0]"
    assert found["grows"]["iterations"].text == "grow"
    assert found["short"]["iterations"].text == "grow"
    assert found["few"]["iterations"].text == "too few sizes"
    assert found["flat"][at].value == pytest.approx(1e-6 * 6**1.5)
    assert found["short"][at].text == "no prediction"
    assert found["few"][at].value is None


def test_three_sizes_have_no_section_on_growth(record, evidence):
    page = compose(evidence(some_records(record, 2, cases=3)))
    assert section(page, "scaling") is not None
    assert section(page, "growth") is None


def test_each_step_type_has_its_own_exponent(record, evidence):
    def counts(n):
        return {
            "outer": 3,
            "expansion": 2 * n,
            "P_products": 40,
            "cg": round(9 * n**0.5),
        }

    sizes = (1, 4, 16, 64)
    records = [record("s", c - 1, 1.0, counts=counts(c)) for c in sizes]
    records += [record("silent", c - 1, 1.0) for c in sizes]
    (table,) = section(compose(evidence(records)), "steps").tables
    found = rows(table)
    assert list(found) == ["P_products", "cg", "expansion", "outer"]
    exponents = [row["p [95 %]"].value for row in found.values()]
    assert exponents == pytest.approx([0, 0.5, 1, 0], abs=1e-9)
    grown = [row["growth"].text for row in found.values()]
    assert grown == ["flat", "grow", "grow", "flat"]
    assert found["cg"]["n = 6400"].value == 72


def test_decompositions_of_one_mesh_have_a_separate_table(record, evidence):
    records = [
        record("s", cells, 1.0, counts={"P_products": 10 + cells}).replace(
            case=f"toy/Nr=3/feti={cells}/dual", params={"Nr": 3, "feti": cells},
            quantities={"dofs": 100, "subdomains": 64 // cells},
        )
        for cells in (8, 4, 16)
    ]  # fmt: skip
    (table,) = section(compose(evidence(records)), "steps").tables
    assert "toy/Nr=3/dual" in table.caption
    found = rows(table)
    assert list(found) == ["4", "8", "16"]
    assert [row["P_products"].value for row in found.values()] == [14, 18, 26]
    assert [row["subdomains"].value for row in found.values()] == [16, 8, 4]


def test_without_counts_there_is_no_section_on_steps(record, evidence):
    page = compose(evidence(some_records(record, 2, cases=3)))
    assert section(page, "steps") is None


# ---- claims


def test_claims_and_verdicts_are_counted_in_one_table(record, evidence):
    ends = [
        dict(),
        dict(status=Verdict.WRONG),
        dict(status=Verdict.VERIFIED, claimed="failed"),
        dict(status=Verdict.TIME_LIMIT, claimed=None),
        dict(status=Verdict.DECLINED, claimed=None),
    ]
    records = [record("a", case, **end) for case, end in enumerate(ends)]
    (table,) = section(compose(evidence(records)), "tally").tables
    row = rows(table)["a"]
    assert [cell.value for cell in row.values()] == [None, 1, 1, 1, 1, 0.5]
    assert row["claimed, refuted"].kind == "over"


def test_one_refuted_repeat_refutes_the_claim(record, evidence):
    records = [record("a", 0, repeat=i) for i in range(3)]
    records[1] = records[1].replace(status=Verdict.INACCURATE)
    (table,) = section(compose(evidence(records)), "tally").tables
    assert [c.value for c in rows(table)["a"].values()][1:] == [0, 1, 0, 0, 0.0]


# ---- complete reports


def test_hostile_names_are_escaped_and_pages_are_reproducible(record, tmp_path, blank):
    names = (
        "<script>x</script>",
        r"\input{a}$^_#&%",
        "| a |\n## b",
        "_$x^2",
        "ü漢",
    )
    for folder in (tmp_path / "one", tmp_path / "two"):
        with Journal(folder, "test") as journal:
            for k, name in enumerate(names):
                for case in range(6):
                    journal.append(record(name, case, 0.01 * (k + 1), form=names[0]))
        (folder / "suite.toml").write_text('name = "hostile"')
    with blank():
        written = write_report(tmp_path / "one", ["html", "md", "tex", "csv"])
    one = {p.name: p.read_bytes() for p in written}
    again = write_report(tmp_path / "two", ["csv"])
    assert all(one[p.name] == p.read_bytes() for p in again)
    pages = [compose(read_evidence(tmp_path / name)) for name in ("one", "two")]
    first, second = (
        [(p.name, p.figure) for s in page.sections for p in s.pictures]
        for page in pages
    )
    assert first == second
    assert markdown(pages[1]).encode() == one["report.md"]
    assert {"means.tex", "ranking.tex", "contests.csv", "profiles-1.svg",
            "pairwise-1.svg"} <= set(one)  # fmt: skip
    assert b"<script>x" not in one["index.html"] + one["report.md"]
    for name in ("means.tex", "ranking.tex", "profiles.tex", "tally.tex"):
        for line in one[name].decode().splitlines()[1:]:
            bare = re.sub(r"\\[\\{}$&#%_]", "", line)
            assert bare.count("{") == bare.count("}"), line
            assert not re.search(r"[#%]|\\input|U\+03", bare), line


def test_a_lone_surrogate_in_a_name_is_accepted(record, evidence):
    records = [record(s, case) for s in ("a\ud800", "b") for case in range(6)]
    (found,) = comparison_groups(evidence(records))
    assert set(found.solvers) == {"a\ud800", "b"}
    assert ranking_of(found).draws.shape[1] == 2
    assert set(comparison_tables(evidence(records))["contests"]["solver"]) == {
        r"a\ud800", "b",
    }  # fmt: skip


def test_the_table_contests_contains_the_ratios_of_profiles(record, evidence):
    records = some_records(record, 2)
    records[0] = records[0].replace(status=Verdict.WRONG)
    sheet = csv_tables(evidence(records))["contests"]
    by_cell = sheet.set_index(["case", "solver"])
    assert set(by_cell["ratio"]) == {1.0, 2.0, np.inf}
    wrong = by_cell.loc["box/n=0/dual", "s00"]
    assert (wrong["seconds"], wrong["ratio"]) == (np.inf, np.inf)
    assert by_cell.loc["box/n=0/dual", "s01"]["ratio"] == 1
    assert set(sheet["contest"]) == {"dual, tol 1e-6"}


def test_the_table_means_contains_every_convention(record, evidence):
    sheet = csv_tables(evidence(some_records(record, 3)))["means"]
    assert len(sheet) == 3 * 19  # 18 combinations and the common cases
    usual = sheet[(sheet["shift"] == 1) & (sheet["penalty"] == 3)
                  & (sheet["gate"] == "verified") & ~sheet["common"]]  # fmt: skip
    assert usual["rank"].tolist() == [1, 2, 3]
    assert usual["tier"].tolist() == [1, 2, 3]
    assert (usual["ratio_low"] <= usual["ratio"]).all()


# sessions


def of_two_sessions(record, factor, scatter=0.002, cases=8):
    """Return records of a and b in one session and of c in another one.

    factor : time of b and of c, relative to the time of a
    """
    rng = np.random.default_rng(577215)
    return [
        record(
            s, k, 1e-3 * 2.0**k * time * rng.lognormal(0, scatter), i,
            session="late" if s == "c" else "early",
        )
        for s, time in (("a", 1.0), ("b", factor), ("c", factor))
        for k in range(cases)
        for i in range(3)
    ]  # fmt: skip


def test_sessions_are_ranked_by_unpaired_intervals_on_every_case(evidence, record):
    for factor, told in ((1.1, True), (1.0015, False)):
        (group,) = comparison_groups(evidence(of_two_sessions(record, factor)))
        faster = ranking_of(group).faster
        assert group.solvers == ("a", "b", "c")
        assert group.apart.tolist() == [
            [False, False, True], [False, False, True], [True, True, False],
        ]  # fmt: skip
        assert faster[0, 2] == told
        assert not faster[2, 0]
    together = [r.replace(session="") for r in of_two_sessions(record, 1.0015)]
    (group,) = comparison_groups(evidence(together))
    assert group.apart.size == 0


def test_solvers_of_another_session_are_named_and_marked(evidence, record):
    said = markdown(compose(evidence(of_two_sessions(record, 1.1))))

    assert (
        "is significant only if the unpaired interval excludes 1 on every case: c"
        in (" ".join(said.split()))
    )
    assert "n = 8, other session" in said
    assert said.count("unpaired") >= 8


def test_sequences_of_two_sessions_are_not_paired():
    a, b = {("s", 0): 1.0, ("s", 1): 1.1}, {("s", 0): 2.0, ("s t", 1): 2.2}

    assert paired_ratio(a, b) is None
    assert not ratio_of(a, b).paired


def test_an_unpaired_interval_is_welchs():
    """The interval equals scipy's, for samples of different scatter and size."""
    from scipy.stats import ttest_ind

    rng = np.random.default_rng(16180)
    a, b = rng.lognormal(0.2, 0.1, 5), rng.lognormal(0, 0.3, 9)
    expected = ttest_ind(np.log(a), np.log(b), equal_var=False).confidence_interval(0.9)
    found = unpaired_ratio(a, b, 0.9)

    assert np.log([found.low, found.high]) == pytest.approx(
        [expected.low, expected.high]
    )
    assert found.value == pytest.approx(np.exp(np.log(a).mean() - np.log(b).mean()))
    assert unpaired_ratio(a[:1], b) is None
    assert unpaired_ratio([1.0, 1.0], [2.0, 2.0]) == (0.5, 0.5, 0.5, 2, False)
