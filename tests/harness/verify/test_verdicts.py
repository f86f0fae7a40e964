"""Records of answers: verdict, quantities and error bounds."""

import re
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.sparse import csr_array

from mortarbench.harness import QP, Case, Solution, Status, Verdict
from mortarbench.harness.names import CaseId
from mortarbench.harness.registry import SolverSpec
from mortarbench.harness.verify.certificate import UncertifiableError
from mortarbench.harness.verify.verdicts import (
    certified,
    evaluated,
    judged,
    judgement,
    new_record,
    results_of,
)

#: min ½(x₁² + x₂²) − x₁ − x₂, x₁ + x₂ = 1, x₁ ≤ ¼, x ≥ 0: (¼, ¾), y = ¼, z = ½
QP_ = QP(
    P=csr_array(np.eye(2)), q=-np.ones(2), A=csr_array([[1.0, 1.0]]), b=np.ones(1),
    G=csr_array([[1.0, 0.0]]), h=np.array([0.25]),
    lb=np.zeros(2), ub=np.full(2, np.inf),
)  # fmt: skip
POINT = Solution(
    status=Status.SOLVED, x=np.array([0.25, 0.75]), y=np.array([0.25]),
    z=np.array([0.5]), z_box=np.zeros(2),
)  # fmt: skip


def record(tol=1e-8, options=None, *, case="f/p", solver="s", spec=None, **changes):
    family = SimpleNamespace(params={"n": 1})
    name = CaseId(family=family, name=case, form="p")
    spec = SolverSpec(name=solver, label=solver, **spec or {})
    return new_record(
        name, spec, options=options or {}, tol=tol,
        **dict(repeat=0, environment="e") | changes,
    )  # fmt: skip


def case(quantities=lambda s: {"first": s.x[0]}, mechanics=None):
    return Case(
        qp=QP_, recover=lambda s: s.x, quantities=quantities, mechanics=mechanics
    )


def fault(_):
    raise ZeroDivisionError("two\nlines")


class Broken:
    to_primal = staticmethod(fault)


def test_the_name_of_a_measurement_depends_only_on_what_is_measured():
    names = [
        record().run_id,
        record(tol=1e-6).run_id,
        record(repeat=1).run_id,
        record(options={"a": 1, "b": 2}).run_id,
        record(mode="sequence").run_id,
        record(accuracy=1e-3).run_id,
        record(mode="sequence", accuracy=1e-3).run_id,
        record(spec={"ranks": 2}).run_id,
    ]
    assert len(set(names)) == len(names)
    assert all(re.fullmatch("[0-9a-f]{12}", name) for name in names)
    assert record(options={"b": 2, "a": 1}).run_id == names[3]
    assert record(block=7, environment="other").run_id == names[0]
    assert (record().block, record(block=7).block) == (0, 7)


def test_a_declined_measurement_has_no_residuals():
    answer = Solution.without_point(QP_, Status.DECLINED, "bounds only")
    got = judged(record(), QP_, answer)

    assert (got.status, got.claimed) == (Verdict.DECLINED, "declined")
    assert (got.message, got.objective) == ("bounds only", None)


def test_a_solution_is_verified_and_has_its_objective():
    got = judged(record(), QP_, POINT)

    assert got.status is Verdict.VERIFIED
    assert got.objective == pytest.approx((1 / 16 + 9 / 16) / 2 - 1)


@pytest.mark.parametrize(
    ("y", "note"),
    [(0.25, ""), (-0.25, "with −y all residuals vanish: check the sign of y")],
)
def test_only_a_refuted_claim_has_a_note_on_its_reason(y, note):
    assert judgement(QP_, replace(POINT, y=np.array([y])), 1e-8)[1] == note


@pytest.mark.parametrize(
    ("tol", "accuracy", "is_right"),
    [(1e-8, None, False), (1e-2, None, True), (1e-8, 1e-2, True), (1e-2, 1e-8, False)],
)
def test_the_accuracy_of_a_suite_overrides_the_tolerance(tol, accuracy, is_right):
    near = replace(POINT, x=POINT.x + np.array([-1e-3, 1e-3]))
    got = judged(record(tol, accuracy=accuracy), QP_, near)

    assert (got.status is Verdict.VERIFIED) == is_right


@pytest.mark.parametrize("name", ["x", "y", "z", "z_box"])
@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_a_point_that_is_not_finite_has_no_results(name, value):
    vector = getattr(POINT, name).copy()
    vector[0] = value
    broken = replace(POINT, **{name: vector})

    for faulty in (case(fault), case(mechanics=Broken)):
        assert results_of(faulty, broken) == ({}, [])


def quantities_of(case, s):
    fields, (note, _) = results_of(case, s)
    return fields["quantities"], note


def test_quantities_are_plain_numbers():
    quantities, note = quantities_of(case(), POINT)

    assert (quantities, note) == ({"first": 0.25}, "")
    assert type(quantities["first"]) is float


def test_a_point_that_overflows_its_quantities_causes_no_warning():
    large = replace(POINT, x=np.full(2, 1e200))
    found = quantities_of(case(lambda s: {"value": QP_.objective(s.x)}), large)

    assert found == ({"value": np.inf}, "")


def test_failing_quantities_add_a_one_line_note():
    message = "ZeroDivisionError: two lines"

    assert quantities_of(case(fault), POINT) == ({}, f"no quantities: {message}")
    assert certified(case(mechanics=Broken), POINT) == (
        {}, f"no energy_bound: {message}",
    )  # fmt: skip


def test_without_mechanics_there_is_no_bound_and_no_note():
    assert certified(case(), POINT) == ({}, "")


@pytest.mark.parametrize("is_bounded", [True, False])
def test_the_time_of_certification_is_recorded_with_or_without_a_bound(
    monkeypatch, is_bounded
):
    """The clock advances by 2 s at its second reading."""

    def certify(mechanics, point):
        if is_bounded:
            return SimpleNamespace(bound=0.5, parts={"pair": 0.5})
        raise UncertifiableError("no admissible pair")

    looks = iter([10.0, 12.0])
    monkeypatch.setattr("mortarbench.harness.verify.verdicts.certify", certify)
    monkeypatch.setattr(
        "mortarbench.harness.verify.verdicts.perf_counter", lambda: next(looks)
    )
    fields, note = certified(
        case(mechanics=SimpleNamespace(to_primal=lambda s: s)), POINT
    )

    assert fields.pop("certify_seconds") == 2.0
    if is_bounded:
        assert (fields, note) == (
            {"energy_bound": 0.5, "certificate": {"pair": 0.5}}, "",
        )  # fmt: skip
    else:
        assert (fields, note) == ({}, "no energy_bound: no admissible pair")


def test_an_answer_is_judged_completely():
    """The ranks judge their answers by this function."""
    fields, notes = evaluated(case(lambda s: {"first": np.float64(0.25)}), POINT, 1e-8)

    assert fields["status"] is Verdict.VERIFIED
    assert fields["objective"] == pytest.approx((1 / 16 + 9 / 16) / 2 - 1)
    assert fields["quantities"] == {"first": 0.25}
    assert fields["recover_seconds"] >= 0
    assert not any(notes)


def test_quantities_that_fail_do_not_discard_the_judgement():
    fields, notes = evaluated(case(fault), POINT, 1e-8)

    assert (fields["status"], fields["quantities"]) == (Verdict.VERIFIED, {})
    assert "no quantities: ZeroDivisionError: two lines" in notes
