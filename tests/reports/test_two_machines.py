"""Folders of several machines, sessions and QPs: machines and QPs are never mixed."""

import json
from itertools import chain

import numpy as np
import pytest

from mortarbench.harness.record import Record
from mortarbench.harness.results.folder import keep_environment
from mortarbench.harness.results.merge import merge
from mortarbench.reports.compare.changes import compare, mean_ratio, relative_ratio
from mortarbench.reports.compare.overview import overview
from mortarbench.reports.compare.page import compose as comparison
from mortarbench.reports.compare.regressions import regressions
from mortarbench.reports.data.evidence import read_evidence
from mortarbench.reports.export.csv_tables import csv_tables
from mortarbench.reports.folder import answer, compose
from mortarbench.reports.render.markdown import markdown
from mortarbench.reports.statistics.intervals import median_interval
from tests.reports.data.test_crossover import measured as routes
from tests.reports.test_certified import sweep
from tests.support.box_records import box_record
from tests.support.manufactured_ranks import rank_records
from tests.support.synthetic_results import records as campaign

SLOWER = 1000.0
#: sections on the folder as a whole
COMMON = ("summary", "absent", "definitions")


def records(factor, environment, session):
    """Yield measurements for every section that contains times."""
    null = {"solver": "solver-a (A/A)", "arm": "null"}
    every = list(campaign(4, 20, 3))
    every += [
        r.replace(run_id=f"{r.run_id}null", **null)
        for r in every
        if r.solver == "solver-a"
    ]
    swept = [*sweep("a"), *sweep("b", seconds=lambda tol: 2e-3 * tol**-0.2)]
    judged = [
        r.replace(accuracy=1e-3, case="box/swept/dual", run_id=f"{r.run_id} judged")
        for r in swept
    ]
    for r in chain(every, rank_records(scatter=0.02), routes(), swept, judged):
        times = {
            name: factor * value
            for name in Record.__struct_fields__
            if name.endswith("_seconds")
            and isinstance(value := getattr(r, name), float)
        }
        yield r.replace(**times, environment=environment, session=session)


def write(folder, found, cpu="one", **environment):
    """Write a result folder; the environment is that of the first record."""
    found = list(found)
    (folder / "journal").mkdir(parents=True)
    lines = "".join(f"{r.to_json()}\n" for r in found)
    (folder / "journal/a.jsonl").write_text(lines)
    (folder / "suite.toml").write_text('name = "boxes"\nrepeats = 3\n')
    environment["machine"] = {"usable_cores": 4, "cpu": cpu}
    keep_environment(folder, found[0].environment, environment)
    stored = folder / "environments" / f"{found[0].environment}.json"
    (folder / "environment.json").write_text(stored.read_text())
    return folder


@pytest.fixture(scope="module")
def folders(tmp_path_factory):
    """Return the folders of two machines, and both merged."""
    where = tmp_path_factory.mktemp("machines")
    for name, factor in (("one", 1.0), ("two", SLOWER)):
        write(where / name, records(factor, f"e{name}", f"s{name}"), cpu=name)
    merge([where / "one", where / "two"], where / "both")
    return where


def contents(section):
    """Return numbers, texts and figures of a section, without notes on its place."""
    return (
        [s.claims for s in section.statements],
        [(t.columns, t.rows) for t in section.tables],
        [p.figure for p in section.pictures],
    )


# machines


def test_every_number_of_a_machine_is_the_number_of_its_own_folder(folders):
    """No time is divided by, ranked against or averaged with one of another machine."""
    both, one, two = (
        {s.name: s for s in compose(read_evidence(folders / name)).sections}
        for name in ("both", "one", "two")
    )
    timed = {
        "answer", "forms", "times", "ratios", "precision", "means", "ranking",
        "profiles", "accuracy", "scaling", "growth", "ranks", "crossover",
    }  # fmt: skip

    assert timed <= one.keys()
    assert set(both) == set(one) | {f"{name}-etwo" for name in two} - {
        f"{name}-etwo" for name in ("absent", "definitions")
    }
    for name in one.keys() - set(COMMON):
        assert contents(both[name]) == contents(one[name]), name
        there = both[f"{name}-etwo"]
        assert contents(there) == contents(two[name]), name
        assert there.title.endswith(" (other machine @etwo)")
        assert all(t.notes[0].endswith("machine @etwo.") for t in there.tables)
        assert all("other machine @etwo" in p.caption for p in there.pictures)
        assert all("other machine @etwo" in s.subject for s in there.statements)


def test_csv_tables_name_the_environment_of_every_row(folders):
    both, one, two = (
        csv_tables(read_evidence(folders / name)) for name in ("both", "one", "two")
    )

    assert both.keys() == one.keys() == two.keys()
    for name, frame in both.items():
        for digest, own in (("eone", one[name]), ("etwo", two[name])):
            mine = frame[frame.environment == digest]
            assert mine.to_csv(index=False) == own.to_csv(index=False)
    ratios = both["contests"].ratio
    assert ratios[np.isfinite(ratios)].max() < SLOWER / 10


def test_the_reader_is_told_about_the_other_machine(folders):
    said = markdown(compose(read_evidence(folders / "both")))
    lines = answer(folders / "both")

    assert "two environments" not in said
    assert "contains measurements from 2 environments" in said
    assert r"other machine \@etwo is two" in said
    assert "other machine @etwo" in lines[-1]
    assert "other machine @etwo" not in lines[0]


def test_another_version_on_the_same_machine_is_called_an_environment(tmp_path):
    a = write(tmp_path / "a", boxes("a"))
    b = write(tmp_path / "b", boxes("b", environment="e2"), versions={"osqp": "2"})
    merge([a, b], tmp_path / "c")
    titles = [s.title for s in compose(read_evidence(tmp_path / "c")).sections]

    assert "Times (other environment @e2)" in titles


def test_folders_of_two_machines_are_compared_without_ratios(folders):
    one, two, both = (read_evidence(folders / n) for n in ("one", "two", "both"))
    apart = compare(one, two)
    page = comparison(apart)
    (times,) = next(s for s in page.sections if s.name == "times").tables

    assert all(p.log is None for p in apart.pairs)
    assert {row[-1].text for row in times.rows} == {"other machine"}
    assert mean_ratio(apart.pairs) is None
    assert "machines" in regressions(apart).why_not
    together = compare(both, both)
    assert len(together.pairs) == 2 * len(apart.pairs)
    for solver in together.solvers:
        for ratio in (
            mean_ratio(together.of(solver)), relative_ratio(together, solver)
        ):  # fmt: skip
            assert ratio is None or ratio.value == pytest.approx(1.0)
    grown = compare(one, both)
    assert all(p.same_machine for p in grown.pairs)
    assert {o.first.environment for o in grown.only_after} == {"etwo"}
    (table,) = overview([apart, grown]).sections[1].tables
    machines = {row[3].text for row in table.rows}
    assert machines == {"first machine", "other machine 1"}


# sessions


def boxes(session, factor=1.0, **changes):
    rng = np.random.default_rng(sum(map(ord, session)))
    changes = {"environment": "e", "objective": -1.0, **changes}
    for solver, time in (("fast", 0.02), ("slow", 0.05)):
        for case in range(6):
            for repeat in range(3):
                seconds = factor * time * rng.lognormal(0, 0.1)
                yield box_record(
                    solver, case, seconds, repeat, session=session,
                    **(changes | {"qp": f"{case:016x}"}),
                )  # fmt: skip


def test_two_sessions_of_one_machine_are_pooled(tmp_path):
    a, b = list(boxes("aaaaaaaaaaaa")), list(boxes("bbbbbbbbbbbb", 1.3))
    merge([write(tmp_path / "a", a), write(tmp_path / "b", b)], tmp_path / "ab")
    evidence = read_evidence(tmp_path / "ab")
    page = compose(evidence)

    assert len(evidence.flat) == 2 * 6
    for o in evidence.flat:
        times = [
            r.total_seconds
            for r in (*a, *b)
            if (r.solver, r.case) == (o.solver, o.case)
        ]
        assert o.seconds("total") == median_interval(times)
        assert o.seconds("total").samples == 6
    (table,) = next(s for s in page.sections if s.name == "ratios").tables
    ids = {r.identity for r in (*a, *b)}
    named = {
        name
        for row in table.rows
        for cell in row
        if cell.title.startswith("run ")
        for name in cell.title.removeprefix("run ").split(", ")
    }
    assert named == ids
    assert len(ids) == 72
    assert "The repeats of 2 sessions" in markdown(page)
    assert "36 of the" not in markdown(page)


# QPs


def test_two_qps_never_share_a_row(tmp_path):
    """A default changed between two sessions: a solver is faster on the new QP."""
    old = boxes("aaaaaaaaaaaa")
    new = [
        r.replace(qp=f"beef{r.qp[4:-1]}9") if r.params["n"] == 3 else r
        for r in boxes("bbbbbbbbbbbb", 0.01)
    ]
    merge([write(tmp_path / "a", old), write(tmp_path / "b", new)], tmp_path / "ab")
    evidence = read_evidence(tmp_path / "ab")
    names = [case for case, _ in evidence.outcomes]
    page = compose(evidence)

    assert names.count("box/n=3/dual") == names.count("box/n=3/QP=beef00/dual") == 1
    assert len(names) == 7
    assert all(len({r.qp for r in o.records}) == 1 for o in evidence.flat)
    assert {len(o.records) for o in evidence.flat} == {3, 6}
    (times,) = next(s for s in page.sections if s.name == "times").tables
    assert [row[0].text for row in times.rows].count("box/n=3/QP=beef00/dual") == 1
    (scaling, *_) = next(s for s in page.sections if s.name == "scaling").tables
    assert [row[0].value for row in scaling.rows[:-2]] == [
        100.0 * (n + 1) for n in range(6)
    ]
    apart = compare(read_evidence(tmp_path / "a"), read_evidence(tmp_path / "b"))
    assert {p.after.case for p in apart.pairs if not p.same_qp} == {"box/n=3/dual"}


def test_a_changed_default_is_not_compared_with_the_old_one(tmp_path):
    """Canonical names omit defaults, but records contain them."""
    old = boxes("aaaaaaaaaaaa")
    new = [
        r.replace(qp=f"beef{r.qp[4:]}", params={**r.params, "depth": 2})
        for r in boxes("bbbbbbbbbbbb")
    ]
    a, b = (write(tmp_path / n, of) for n, of in (("a", old), ("b", new)))
    c = compare(read_evidence(a), read_evidence(b))

    assert len(c.pairs) == 12
    assert all(p.log is None for p in c.pairs)
    said = markdown(comparison(c))
    assert said.count("other QP") == 12
    assert "same QP" in regressions(c).why_not


def test_a_repeat_that_disagrees_with_the_environment_file_is_kept(tmp_path):
    """An environment that is not stored is not known to be the same machine."""
    mixed = [*boxes("aaaaaaaaaaaa")]
    mixed += [r.replace(environment="gone") for r in boxes("bbbbbbbbbbbb")]
    folder = write(tmp_path / "a", mixed)
    page = compose(read_evidence(folder))

    assert len(page.records) == len(mixed)
    assert "Times (other machine @gone)" in [s.title for s in page.sections]
    assert json.loads((folder / "environment.json").read_text())["digest"] == "e"
