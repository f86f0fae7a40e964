"""Sections on times: dualisation, null arms, canaries and time to accuracy."""

import re

import pytest

from mortarbench.harness import Record, Verdict
from mortarbench.reports.data.evidence import Evidence, arrange
from mortarbench.reports.folder import compose


@pytest.fixture
def record():
    def make(solver="a", repeat=0, **changes):
        defaults = dict(
            run_id=f"{solver}-{changes.get('form', 'dual')}-{changes.get('tol')}-"
            f"{repeat}",
            case=f"box/{changes.get('form', 'dual')}", family="box", params={},
            form="dual", sizes={}, solver=solver, options={}, tol=1e-6,
            repeat=repeat, block=repeat, status=Verdict.VERIFIED, claimed="solved",
            total_seconds=0.01, primal=1e-9, dual=1e-9, complementarity=1e-9,
            gap=1e-9, started=f"2026-11-21T06:00:{repeat:02d}.000+00:00",
        )  # fmt: skip
        return Record(**(defaults | changes))

    return make


@pytest.fixture
def section(tmp_path):
    def find(records, name):
        page = compose(Evidence(directory=tmp_path, records=arrange(records)))
        return next((s for s in page.sections if s.name == name), None)

    return find


def rows(table):
    return [dict(zip(table.columns, row, strict=True)) for row in table.rows]


def test_old_journals_have_no_sections_on_precision(record, section):
    old = [record(repeat=i) for i in range(3)]
    assert section(old, "precision") is None
    assert section(old, "accuracy") is None
    assert len(section(old, "times").tables) == 1


def test_only_dual_forms_include_dualisation(record, section):
    primal = [record(form="primal", repeat=i, total_seconds=0.05) for i in range(3)]
    dual = [record(repeat=i, dualise_seconds=0.04) for i in range(3)]
    _, charged = section(primal + dual, "times").tables
    (row,) = rows(charged)
    assert row["case"].text == "box/dual"
    assert row["dualisation"].value == pytest.approx(0.04)
    assert row["dualisation"].text.endswith("[1 run]")
    assert row["a"].value == pytest.approx(0.05)


def test_an_unverified_answer_has_no_total_with_dualising(record, section):
    wrong = record("b", status=Verdict.WRONG, dualise_seconds=0.04)
    _, charged = section([record(dualise_seconds=0.04), wrong], "times").tables
    assert rows(charged)[0]["b"].value is None


@pytest.mark.parametrize(("factor", "held"), [(1.0, "yes"), (1.5, "no")])
def test_a_null_arm_is_paired_with_its_solver(record, section, factor, held):
    noise = [0.98, 1.02, 1.0, 1.01, 0.99]
    plain = [record(repeat=i, total_seconds=0.01) for i in range(5)]
    null = [
        record("a (A/A)", i, arm="null", total_seconds=0.01 * factor * e)
        for i, e in enumerate(noise)
    ]
    found = section(plain + null, "precision")
    (row,) = rows(found.tables[0])
    assert row["contains 1"].text == held
    assert row["ratio"].value == pytest.approx(factor, rel=0.01)
    assert row["blocks"].value == 5
    assert re.search(r"here [01] of 1 interval", found.prose[0])


def test_a_null_arm_does_not_win(record, section):
    records = [record(), record("b", total_seconds=0.02)]
    null = record("a (A/A)", arm="null", total_seconds=0.009, dualise_seconds=0.1)
    records = [r.replace(dualise_seconds=0.1) for r in records]
    for table in section([*records, null], "times").tables:
        (row,) = rows(table)
        assert [row[s].kind for s in ("a", "b", "a (A/A)")] == ["best", "", ""]


def test_null_arms_of_sequences_are_paired_with_sequences(record, section):
    records = [
        record(f"a{arm} (sequence)", i, arm="null" if arm else "", mode="sequence")
        for arm in ("", " (A/A)")
        for i in range(3)
    ]
    assert rows(section(records, "precision").tables[0])[0]["solver"].text == (
        "a (sequence)"
    )


def test_time_to_accuracy_is_the_time_of_the_fastest_verified_answer(record, section):
    sweep = [
        record(tol=1e-2, accuracy=1e-6, total_seconds=0.001, status=Verdict.WRONG),
        record(tol=1e-4, accuracy=1e-6, total_seconds=0.002),
        record(tol=1e-6, accuracy=1e-6, total_seconds=0.003),
        record("b", tol=1e-6, accuracy=1e-6, status=Verdict.WRONG),
        record("c", tol=1e-6, accuracy=1e-6, status=Verdict.DECLINED, claimed=None),
    ]
    found = section(sweep, "accuracy")
    (row,) = rows(found.tables[0])
    assert row["a"].value == pytest.approx(0.002)
    assert row["a"].after == "tol 1e-4"
    assert row["b"].text == "not reached"
    assert row["c"].text == "declined"
    assert [p.name for p in found.pictures] == ["sweep"]


def test_a_sweep_of_zero_residuals_can_be_drawn(record, section):
    exact = record(accuracy=1e-6, primal=0.0, dual=0.0, complementarity=0.0, gap=0.0)
    assert section([exact], "accuracy").pictures
