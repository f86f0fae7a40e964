"""From what a solver returned to a record, by our own evaluation."""

import re
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.sparse import csr_array

from harness import QP, Case, Solution, Status, Verdict
from harness.names import CaseId
from harness.registry import SolverSpec
from harness.verify.certificate import UncertifiableError
from harness.verify.verdicts import certified, judged, new_record, quantities_of

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


def record(tol=1e-8, options=None, **changes):
    family = SimpleNamespace(name="f")
    name = CaseId(family=family, name="f/p", params={"n": 1}, form="p")
    spec = SolverSpec(name="s", label="s")
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
    back = staticmethod(fault)


def test_a_measurement_has_a_name_that_nothing_but_what_is_measured_changes():
    names = [
        record().run_id,
        record(tol=1e-6).run_id,
        record(repeat=1).run_id,
        record(options={"a": 1, "b": 2}).run_id,
        record(mode="sequence").run_id,
        record(accuracy=1e-3).run_id,
        record(mode="sequence", accuracy=1e-3).run_id,
    ]
    assert len(set(names)) == len(names)
    assert all(re.fullmatch("[0-9a-f]{12}", name) for name in names)
    assert record(options={"b": 2, "a": 1}).run_id == names[3]
    assert record(block=7, environment="other").run_id == names[0]
    assert (record().block, record(block=7).block) == (0, 7)


def test_what_was_declined_is_declined_and_has_no_residuals():
    answer = Solution.without_point(QP_, Status.DECLINED, "bounds only")
    got = judged(record(), QP_, answer)

    assert (got.verdict, got.claimed) == (Verdict.DECLINED, "declined")
    assert (got.message, got.objective) == ("bounds only", None)


def test_a_solution_is_verified_and_has_its_objective():
    got = judged(record(), QP_, POINT)

    assert got.verdict is Verdict.VERIFIED
    assert got.objective == pytest.approx((1 / 16 + 9 / 16) / 2 - 1)


@pytest.mark.parametrize(
    ("tol", "accuracy", "is_right"),
    [(1e-8, None, False), (1e-2, None, True), (1e-8, 1e-2, True), (1e-2, 1e-8, False)],
)
def test_the_accuracy_of_a_suite_goes_before_the_tolerance(tol, accuracy, is_right):
    near = replace(POINT, x=POINT.x + np.array([-1e-3, 1e-3]))
    got = judged(record(tol, accuracy=accuracy), QP_, near)

    assert (got.verdict is Verdict.VERIFIED) == is_right


@pytest.mark.parametrize("name", ["x", "y", "z", "z_box"])
@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_a_point_that_is_not_finite_means_nothing(name, value):
    vector = getattr(POINT, name).copy()
    vector[0] = value
    broken = replace(POINT, **{name: vector})

    assert quantities_of(case(fault), broken) == ({}, "")
    assert certified(case(mechanics=Broken), broken) == ({}, "")


def test_quantities_are_plain_numbers():
    quantities, note = quantities_of(case(), POINT)

    assert (quantities, note) == ({"first": 0.25}, "")
    assert type(quantities["first"]) is float


def test_a_point_too_large_for_its_quantities_warns_nobody():
    large = replace(POINT, x=np.full(2, 1e200))
    found = quantities_of(case(lambda s: {"value": QP_.objective(s.x)}), large)

    assert found == ({"value": np.inf}, "")


def test_what_a_family_cannot_compute_is_a_note_of_one_line():
    message = "ZeroDivisionError: two lines"

    assert quantities_of(case(fault), POINT) == ({}, f"no quantities: {message}")
    assert certified(case(mechanics=Broken), POINT) == (
        {}, f"no energy_bound: {message}",
    )  # fmt: skip


def test_without_mechanics_there_is_no_bound_and_nothing_to_note():
    assert certified(case(), POINT) == ({}, "")


@pytest.mark.parametrize("is_bounded", [True, False])
def test_what_certifying_takes_is_noted_whether_it_ends_in_a_bound_or_not(
    monkeypatch, is_bounded
):
    """By a clock that is 2 s later at its second look."""

    def certify(mechanics, point):
        if is_bounded:
            return SimpleNamespace(bound=0.5, parts={"pair": 0.5})
        raise UncertifiableError("no admissible pair")

    looks = iter([10.0, 12.0])
    monkeypatch.setattr("harness.verify.verdicts.certify", certify)
    monkeypatch.setattr("harness.verify.verdicts.perf_counter", lambda: next(looks))
    fields, note = certified(case(mechanics=SimpleNamespace(back=lambda s: s)), POINT)

    assert fields.pop("certify_seconds") == 2.0
    if is_bounded:
        assert (fields, note) == (
            {"energy_bound": 0.5, "certificate": {"pair": 0.5}}, "",
        )  # fmt: skip
    else:
        assert (fields, note) == ({}, "no energy_bound: no admissible pair")
