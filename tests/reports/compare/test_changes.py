"""Changes between two result folders: planted changes are reported, and no others."""

import json
import re

import numpy as np
import pandas as pd
import pytest

from mortarbench.harness import InputError, Record, Verdict
from mortarbench.harness.results.folder import times_compare
from mortarbench.harness.results.journal import Journal
from mortarbench.harness.results.merge import merge
from mortarbench.reporting import report
from mortarbench.reports import write_comparison
from mortarbench.reports.compare.changes import (
    Mean,
    compare,
    mean_of,
    mean_ratio,
    relative_ratio,
    side,
)
from mortarbench.reports.compare.conclusions import change_word, verdict_lines
from mortarbench.reports.compare.page import compose
from mortarbench.reports.data.environment import by_environment
from mortarbench.reports.data.evidence import Evidence, arrange, read_evidence
from mortarbench.reports.render.markdown import markdown

SOLVERS = ("one", "two", "three")


def record(solver="one", case=0, repeat=0, **changes):
    defaults = dict(
        run_id=f"{solver}-{case}-{repeat}", case=f"box/n={case}/dual", family="box",
        params={"n": case}, form="dual", sizes={"variables": 10 + case}, solver=solver,
        options={"max_iter": 100}, tol=1e-6, repeat=repeat, block=repeat,
        status=Verdict.VERIFIED, claimed="solved", iterations=7, total_seconds=0.01,
        primal=1e-9, dual=2e-9, complementarity=3e-10, gap=4e-11, objective=-0.5,
        quantities={"energy": -1234.5}, qp="abc", environment="e1",
        started="2026-11-21T10:00:00+00:00",
    )  # fmt: skip
    return Record(**(defaults | changes))


def suite(seed, cases=12, repeats=5, scatter=0.05, **slower):
    """Return a run of all solvers with scattered times, some of them slower."""
    rng = np.random.default_rng(seed)
    return [
        record(
            solver, case, repeat,
            total_seconds=0.001 * (1 + case) * slower.get(solver, 1.0)
            * float(np.exp(rng.normal(0, scatter))),
        )
        for solver in SOLVERS
        for case in range(cases)
        for repeat in range(repeats)
    ]  # fmt: skip


@pytest.fixture
def changed(tmp_path):
    """Return a function that compares two lists of records."""

    def make(before, after, **more):
        one, two = (
            Evidence(directory=tmp_path / n, records=arrange(r), **more)
            for n, r in (("a", before), ("b", after))
        )
        return compare(one, two)

    return make


def only(c):
    (pair,) = c.pairs
    return pair


# definitions


# times


def test_a_planted_regression_is_found_in_the_right_solver(changed):
    c = changed(suite(1), suite(2, two=1.2))
    means = {s: mean_ratio(c.of(s)) for s in SOLVERS}

    assert [side(means[s]) for s in SOLVERS] == [0, 1, 0]
    assert means["two"].value == pytest.approx(1.2, rel=0.03)
    assert means["two"].low < 1.2 < means["two"].high
    slower = [p for p in c.pairs if p.change > 0]
    assert sum(p.after.solver == "two" for p in slower) >= 11
    assert sum(p.after.solver != "two" for p in slower) <= 2
    assert any(re.search("two on box/n=.* times as long", n) for n in verdict_lines(c))
    relative = {s: relative_ratio(c, s) for s in SOLVERS}
    assert relative["two"].low < 1.2 < relative["two"].high
    assert relative["one"].value == pytest.approx(1.2**-0.5, rel=0.05)  # of two others


def test_in_reverse_order_a_regression_is_an_improvement(changed):
    one, two = suite(1), suite(2, two=1.2)
    there, back = changed(one, two), changed(two, one)

    assert [p.change for p in there.pairs] == [-p.change for p in back.pairs]
    for a, b in zip(there.pairs, back.pairs, strict=True):
        assert a.ratio.value * b.ratio.value == pytest.approx(1)


@pytest.mark.parametrize(
    "repeats", [3, *(pytest.param(n, marks=pytest.mark.slow) for n in (5, 10))]
)
def test_two_runs_of_the_same_code_differ_in_one_cell_of_twenty(changed, repeats):
    """Of 600 cells, 5 % (30 ± 16 at three standard deviations) may show a change."""
    named = cells = 0
    for seed in range(0, 20, 2):
        first = suite(seed, cases=20, repeats=repeats)
        c = changed(first, suite(seed + 1, cases=20, repeats=repeats))
        named += sum(p.change != 0 for p in c.pairs)
        cells += len(c.pairs)

    assert cells == 600
    assert 14 <= named <= 46


@pytest.mark.parametrize(
    "cells", [4, *(pytest.param(n, marks=pytest.mark.slow) for n in (8, 30))]
)
def test_the_interval_over_cells_has_its_nominal_coverage(cells):
    """Of 400 intervals, 20 should miss the true value; 7 to 33 are within
    three standard deviations, and up to 40 are accepted.
    """
    rng = np.random.default_rng(cells)
    missed = sum(
        side(mean_of(rng.normal(0, 0.1, cells), [f"{i}-{n}" for n in range(cells)]))
        != 0
        for i in range(400)
    )
    assert 7 <= missed <= 40


@pytest.mark.parametrize(
    ("low", "high", "word"),
    [(1.1, 9.0, "slower"), (0.1, 0.9, "faster"), (0.9, 1.2, "no change seen"),
     (0.68, 1.49, "no change seen"), (0.9, 1.6, "not resolved"),
     (0.6, 1.1, "not resolved"), (0.145, 4.437, "not resolved"),
     (0.0, np.inf, "not resolved")],
)  # fmt: skip
def test_a_wide_interval_is_not_reported_as_unchanged(low, high, word):
    assert change_word(Mean(1.0, low, high, 3)) == word


def test_unresolved_cells_are_counted_separately(changed):
    """The times of one of two unchanged cells are scaled by 0.1 and by 10."""
    times = {0: (1.0, 1.0), 1: (0.1, 10.0)}
    before = [record(case=k, repeat=i) for k in times for i in range(2)]
    after = [
        r.replace(total_seconds=r.total_seconds * times[r.params["n"]][r.repeat])
        for r in before
    ]
    said = "\n".join(verdict_lines(changed(before, after)))

    assert "0 slower, 0 faster, 1 no change seen, 1 not resolved" in said


@pytest.mark.usefixtures("blank_figures")
def test_comparing_a_folder_with_itself_is_reported(tmp_path):
    with Journal(tmp_path / "a", "j") as journal:
        for r in suite(1, cases=2, repeats=2):
            journal.append(r)
    said, written = write_comparison(tmp_path / "a", tmp_path / "a", ["md"])

    (page,) = (path for path in written if path.name == "report.md")
    assert "the same folder" in said[0]
    assert said[0] in page.read_text()


def test_folders_without_common_cells_get_one_sentence(changed):
    c = changed([record("one")], [record("two", case=k) for k in range(2)])

    (line,) = verdict_lines(c)
    assert line.startswith("No cell (a solver on a case at a tolerance) is in both")
    assert "1 cell before, 2 after" in line


def test_single_repeats_do_not_show_changes_of_cells(changed):
    c = changed(suite(1, repeats=1), suite(2, repeats=1, two=1.2))

    assert all(p.ratio is None and p.change == 0 for p in c.pairs)
    assert side(mean_ratio(c.of("two"))) == 1  # twelve cells suffice


def test_repeats_of_two_sessions_are_unpaired_samples(changed):
    before = [record(repeat=i) for i in range(3)]
    after = [record(repeat=i, total_seconds=0.02) for i in range(1, 5)]
    pair = only(changed(before, after))

    assert pair.ratio.pairs == 3
    assert not pair.ratio.paired
    assert pair.ratio.value == pytest.approx(2)


def test_times_of_unverified_answers_are_not_compared(changed):
    before = [record(repeat=i) for i in range(3)]
    after = [r.replace(status=Verdict.WRONG, total_seconds=1e-6) for r in before]
    c = changed(before, after)

    assert only(c).ratio is None
    assert mean_ratio(c.pairs) is None
    assert "✗ wrong" in markdown(compose(c))


def test_sequences_are_compared_with_sequences(tmp_path):
    def folder(name, seconds):
        out = tmp_path / name
        with Journal(out, "j") as journal:
            for mode, factor in (("cold", 1), ("sequence", seconds)):
                for i in range(3):
                    journal.append(
                        record(repeat=i, run_id=f"{mode}{i}", mode=mode,
                               total_seconds=0.01 * factor)
                    )  # fmt: skip
        return out

    folder("a", 1.0)
    folder("b", 3.0)
    write_comparison(tmp_path / "a", tmp_path / "b", ["csv"])
    frame = pd.read_csv(tmp_path / "b/report/against-a/tables/changes.csv")

    assert dict(zip(frame.solver, frame.ratio.round(6), strict=True)) == {
        "one": 1.0, "one (sequence)": 3.0,
    }  # fmt: skip


def test_a_solver_is_not_compared_with_its_null_arm(changed):
    def run(seed, **slower):
        first = [r for r in suite(seed, **slower) if r.solver != "three"]
        twin = [
            r.replace(solver="one (A/A)", run_id=f"null-{r.run_id}", arm="null")
            for r in first
            if r.solver == "one"
        ]
        return first + twin

    c = changed(run(1), run(2, one=1.5))
    assert relative_ratio(c, "one").value == pytest.approx(1.5, rel=0.05)


# conditions


@pytest.fixture
def folders(tmp_path):
    """Return a function that writes two result folders and returns their paths."""

    def make(one, two, before=None, after=None):
        for name, environment, records in (("a", one, before), ("b", two, after)):
            out = tmp_path / name
            digest = environment["digest"]
            with Journal(out, "j") as journal:
                for r in records or suite(1, cases=4, repeats=3):
                    journal.append(r.replace(environment=digest))
            (out / "environment.json").write_text(json.dumps(environment))
        return tmp_path / "a", tmp_path / "b"

    return make


HERE = {
    "digest": "e1", "machine": {"cpu": "fast"}, "threads": {}, "cholmod": {},
    "versions": {"osqp": "1.0"}, "source": {"commit": "aaa"}, "now": {"load": 0.1},
}  # fmt: skip


def test_times_of_another_version_on_the_same_machine_are_compared(folders):
    other = HERE | {"digest": "e2", "versions": {"osqp": "1.1"}}
    after = suite(2, cases=4, repeats=3, two=1.5)
    said, _ = write_comparison(*folders(HERE, other, after=after), ["csv"])

    assert said[0] == (
        "The machine is the same, but the environments differ in versions.osqp. A "
        "change below may be due to this or to another difference between the two runs."
    )
    assert any("two: 1.5" in line and "slower" in line for line in said)


@pytest.mark.usefixtures("blank_figures")
def test_times_of_another_machine_are_not_compared(folders):
    other = HERE | {"digest": "e2", "machine": {"cpu": "slow"}}
    after = suite(2, cases=4, repeats=3, one=9.0, two=9.0, three=9.0)
    a, b = folders(HERE, other, after=after)
    said, _ = write_comparison(a, b, ["md", "csv"])

    assert said[0].startswith("Environments differ (machine.cpu)")
    assert "Times are compared for 0 of 12 cells" in said[0]
    assert said[1].startswith("Times: no cell")
    assert not any("slower" in line for line in said)
    frame = pd.read_csv(b / "report/against-a/tables/changes.csv")
    assert frame.ratio.isna().all()
    assert "~~" in (b / "report/against-a/report.md").read_text()  # struck out


@pytest.mark.usefixtures("blank_figures")
def test_equal_environments_are_reported_with_one_machine(folders):
    busy = HERE | {"now": {"load": 3.0}}
    a, b = folders(HERE, busy)
    said, _ = write_comparison(a, b, ["md"])

    _, dateline, *_ = (b / "report/against-a/report.md").read_text().split("\n\n")
    assert dateline == "before: 2026-11-21, after: 2026-11-21 · fast"

    assert said[0] == "The environments are the same: machine, versions and code."


def test_unknown_environments_do_not_count_as_equal(changed):
    before = [record(repeat=i) for i in range(3)]
    other = changed(before, [r.replace(environment="e2") for r in before])

    assert only(changed(before, before)).ratio is not None
    assert only(other).ratio is None
    assert verdict_lines(other)[0].startswith("Environments differ")


def test_cells_are_compared_only_on_the_same_cluster_node(folders):
    """Half of the cells moved to a slower node, and only these cells have no ratio."""
    after = [
        r.replace(environment="n2", total_seconds=9.0) if r.params["n"] >= 2 else r
        for r in suite(2, cases=4, repeats=3)
    ]
    a, b = folders(HERE, HERE)
    (b / "journal/j.jsonl").unlink()
    with Journal(b, "j") as journal:
        for r in after:
            journal.append(r)
    (b / "environments").mkdir()
    node = HERE | {"digest": "n2", "machine": {"cpu": "slow"}}
    (b / "environments/n2.json").write_text(json.dumps(node))
    said, _ = write_comparison(a, b, ["csv"])
    frame = pd.read_csv(b / "report/against-a/tables/changes.csv")

    assert "Times are compared for 6 of 12 cells" in said[0]
    assert set(frame.case[frame.ratio.isna()]) == {"box/n=2/dual", "box/n=3/dual"}


def test_options_that_differ_under_one_label_are_listed(changed):
    before = [record(repeat=i) for i in range(3)]
    after = [r.replace(options={"max_iter": 200}) for r in before]
    page = markdown(compose(changed(before, after)))

    assert re.search(r"\| one\.max\\_iter \| 100 \| 200 \|", page)


def test_another_qp_under_the_same_name_is_flagged(changed):
    before = [record(repeat=i) for i in range(3)]
    bits = changed(before, [r.replace(qp="xyz") for r in before])
    sizes = changed(
        before, [r.replace(qp="xyz", sizes={"variables": 99}) for r in before]
    )

    for c in (bits, sizes):
        assert "The QPs of 1 cell are not bitwise identical" in markdown(compose(c))
    assert only(bits).ratio is not None
    assert only(sizes).ratio is None
    assert "another QP" not in markdown(compose(changed(before, before)))
    old = [
        r.replace(qp=None) for r in before
    ]  # a journal of an older version, without digests
    assert only(changed(old, before)).same_qp


# verdicts, iterations, answers


def test_worse_verdicts_are_listed_first(changed):
    before = suite(1, cases=2, repeats=3)
    after = [
        r.replace(status=Verdict.INACCURATE) if r.run_id == "two-1-2" else r
        for r in suite(2, cases=2, repeats=3, three=3.0)
    ]
    c = changed(before, after)
    named = [line for line in verdict_lines(c) if line.startswith("  two on")]

    assert named == ["  two on box/n=1/dual at 1e-6: verified before, inaccurate after"]
    assert [p.turn for p in c.pairs if p.turn] == [1]
    assert [p.turn for p in changed(after, before).pairs if p.turn] == [-1]
    points = compose(c).sections[0].points
    assert points[0].startswith("two on")
    assert "three on" in points[1]


@pytest.mark.parametrize(
    ("before", "after", "changed_"),
    [((7, 7, 7), (7, 7, 7), False), ((7, 7, 7), (8, 8, 8), True),
     ((7, 9, 8), (9, 11, 10), False), ((7, 9, 8), (10, 11, 10), True),
     ((7, 7, 7), (None, None, None), False)],
)  # fmt: skip
def test_iterations_count_as_changed_if_ranges_do_not_overlap(
    changed, before, after, changed_
):
    one, two = (
        [record(repeat=i, iterations=n) for i, n in enumerate(counts)]
        for counts in (before, after)
    )
    assert only(changed(one, two)).other_iterations is changed_


@pytest.mark.parametrize(
    ("energy", "status", "other"),
    [
        (-1234.5 * (1 + 1e-6), Verdict.VERIFIED, False),  # within 4 · 10 · tol
        (-1234.5 * (1 + 1e-4), Verdict.VERIFIED, True),
        (-1000.0, Verdict.WRONG, False),  # refuted answers are not compared
    ],
)
def test_verified_answers_that_differ_are_named(changed, energy, status, other):
    after = record(quantities={"energy": energy}, status=status)
    c = changed([record()], [after])

    assert only(c).other_answer is other
    assert any("different answers" in line for line in verdict_lines(c)) is other


def test_objectives_are_compared_if_there_is_no_energy(changed):
    one = record(quantities={}, objective=-0.5)
    assert only(changed([one], [one.replace(objective=-0.6)])).other_answer
    zero = one.replace(objective=1e-25)
    assert not only(changed([zero], [zero.replace(objective=3e-25)])).other_answer


def test_cells_in_one_folder_only_are_listed_separately(changed):
    c = changed([record(), record("gone")], [record(), record("new"), record(case=1)])
    page = markdown(compose(c))

    assert [p.after.solver for p in c.pairs] == ["one"]
    assert [o.solver for o in c.only_before] == ["gone"]
    assert sorted((o.solver, o.case) for o in c.only_after) == [
        ("new", "box/n=0/dual"), ("one", "box/n=1/dual"),
    ]  # fmt: skip
    assert "1 cell before, 2 after" in page


# files


def test_all_formats_are_written_with_reproducible_bytes(folders):
    a, b = folders(HERE, HERE)
    formats = ["html", "md", "tex", "csv", "parquet"]
    _, written = write_comparison(a, b, formats)
    bytes_ = {path: path.read_bytes() for path in written}
    _, again = write_comparison(a, b, formats)

    assert written[0] == b / "report/against-a/index.html"
    assert {p.suffix for p in written} == {
        ".html", ".md", ".tex", ".csv", ".parquet", ".pdf", ".svg", ".png",
    }  # fmt: skip
    assert {path: path.read_bytes() for path in again} == bytes_
    assert not (a / "report").exists()
    target = b / "report/against-a/tables"
    one = pd.read_csv(target / "changes.csv")
    two = pd.read_parquet(target / "changes.parquet")
    assert len(one) == len(two) == 12
    np.testing.assert_allclose(one.ratio, two.ratio, rtol=1e-12)


def test_verdicts_are_recomputed_at_the_factor(folders):
    before = [record(repeat=i, dual=5e-7) for i in range(3)]
    after = [record(repeat=i, dual=5e-6) for i in range(3)]
    a, b = folders(HERE, HERE, before, after)

    assert "Verdicts: 0 worse" in " ".join(write_comparison(a, b, ["csv"])[0])
    for one, two, found in ((a, b, "1 worse, 0"), (b, a, "0 worse, 1"), (b, b, "0 w")):
        said, _ = write_comparison(one, two, ["csv"], 1.0)
        assert f"Verdicts at 1 × tolerance: {found}" in " ".join(said)


def test_a_missing_folder_is_refused(folders, tmp_path):
    a, _ = folders(HERE, HERE)
    with pytest.raises(InputError, match="no such folder"):
        write_comparison(a, tmp_path / "none", ["csv"])
    with pytest.raises(InputError, match="no such folder"):
        write_comparison(tmp_path / "none", a, ["csv"])


def test_a_common_change_is_attributed_to_the_machine(changed):
    c = changed(suite(1), suite(2, one=1.1, two=1.1, three=1.1))
    (table,) = compose(c).sections[0].tables
    rows = {row[0].text: row for row in table.rows}

    assert rows["all"][3].text == "slower"
    assert any(
        line.startswith("The times of all solvers changed alike")
        for line in verdict_lines(c)
    )
    assert all(side(relative_ratio(c, s)) == 0 for s in SOLVERS)


def test_a_change_of_one_solver_is_not_attributed_to_the_machine(changed):
    c = changed(suite(1), suite(2, two=1.5))
    assert not any("changed alike" in line for line in verdict_lines(c))


def test_a_busy_machine_causes_a_warning(folders):
    busy = HERE | {"now": {"load": 3.0}}
    said, _ = write_comparison(*folders(HERE, busy), ["csv"])
    assert said[1].startswith("Warning: the machine was not idle")
    assert "3.00 after" in said[1]


# campaigns


def test_an_additional_plug_in_keeps_times_comparable(folders):
    """Times stay comparable with an additional plug-in, but not if one has changed."""
    admm, other = (
        HERE | {"digest": d, "plugins": {"admm.py": sha}}
        for d, sha in (("e2", "aaa"), ("e3", "bbb"))
    )
    assert times_compare(HERE | {"plugins": {}}, admm)
    assert not times_compare(admm, other)
    assert not times_compare(HERE | {"machine": {"cpu": "slow"}}, admm)
    assert not times_compare(HERE | {"versions": {"osqp": "1.1"}}, admm)


def test_folders_with_and_without_a_plug_in_merge_into_one_comparison(
    folders, tmp_path
):
    with_it = HERE | {"digest": "e2", "plugins": {"admm.py": "aaa"}}
    before = suite(1, cases=2, repeats=3)
    after = [r.replace(session="s2") for r in suite(2, cases=2, repeats=3)]
    a, b = folders(HERE | {"plugins": {}}, with_it, before=before, after=after)
    merge([a, b], tmp_path / "both")
    found = read_evidence(tmp_path / "both")
    assert set(found.solvers) == set(SOLVERS)
    assert by_environment(found) == (found,)
    assert {len(o.records) for o in found.flat} == {6}

    slow = with_it | {"machine": {"cpu": "slow"}}
    (b / "environment.json").write_text(json.dumps(slow))
    merge([a, b], tmp_path / "apart")
    assert len(by_environment(read_evidence(tmp_path / "apart"))) == 2


def from_file(path, **changes):
    return record(
        case=0, family="file", params={"path": path}, form="primal",
        run_id=f"{path}-{changes.get('repeat', 0)}", qp="d1g35t", **changes,
    ).replace(case=f"file:{path}")  # fmt: skip


def test_a_qp_in_two_files_is_one_case(folders, changed):
    c = changed([from_file("a/x.npz")], [from_file("b/y.npz")])
    assert len(c.pairs) == 1
    assert c.only_before == c.only_after == ()
    a, _ = folders(HERE, HERE, before=[from_file("a/x.npz"), from_file("b/y.npz")])
    (outcome,) = read_evidence(a).flat
    assert outcome.case == "file:a/x.npz"
    assert len(outcome.records) == 2
    other = changed([from_file("a/x.npz")], [from_file("b/y.npz").replace(qp="0th3r")])
    assert other.pairs == ()


def test_a_worse_verdict_fails_even_if_times_cannot_be_compared(folders):
    slow = HERE | {"digest": "e2", "machine": {"cpu": "slow"}}
    worse = [
        r.replace(status=Verdict.WRONG) if r.solver == "two" else r
        for r in suite(2, cases=4, repeats=3)
    ]
    a, b = folders(HERE, slow, after=worse)
    found = report(a, b, formats=["csv"], fail_on=["worse", "slower"])
    assert found.failed_on == ("worse",)
    assert len(found.changes[0]["worse"]) == 4
    assert any(line.startswith("fail-on slower: ") for line in found.said)
    assert any("two on box/n=1/dual" in line for line in found.said)


def test_fail_on_names_solvers_without_verified_answers(folders):
    """One of the two solvers is wrong on all cases of the later folder."""
    pair = [r for r in suite(2, cases=4, repeats=3) if r.solver in ("one", "two")]
    spoilt = [r.replace(status=Verdict.WRONG) if r.solver == "two" else r for r in pair]
    a, b = folders(HERE, HERE, before=pair, after=spoilt)
    with pytest.raises(InputError) as refused:
        report(a, b, formats=["csv"], fail_on=["slower"])
    assert str(refused.value) == (
        f"fail-on slower: {a} and {b}: two has no verified answer in {b}: nothing to "
        "compare"
    )


def test_fail_on_slower_is_refused_if_times_cannot_be_judged(folders):
    slow = HERE | {"digest": "e2", "machine": {"cpu": "slow"}}
    a, b = folders(HERE, slow)
    with pytest.raises(InputError, match=r"fail-on slower: .* no cell was measured on"):
        report(a, b, formats=["csv"], fail_on=["worse", "slower"])
    assert report(a, b, formats=["csv"], fail_on=["worse"]).failed_on == ()
