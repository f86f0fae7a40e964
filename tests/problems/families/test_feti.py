"""Bodies in subdomains: the answer of bodies in one piece, in every gluing."""

from typing import Any

import numpy as np
import pytest

from harness import Case, InputError, kkt_residuals
from harness.verify.certificate import certify
from problems import PROBLEMS
from problems.models import beam_ring
from solvers.reference.solve import reference_solution
from solvers.smalbe.solver import SMALBE

TOL = 1e-8
GLUES = ("orthonormal", "chain", "redundant")
CASES: list[tuple[str, dict[str, Any]]] = [
    ("beam-ring", {"Nr": 4, "Nh": 3, "steps": 1, "feti": 2}),
    ("beam-ring", {"Nr": 3, "Nh": 2, "steps": 2, "contact": "mortar", "feti": 4}),
    ("contact-patch", {"ratio": 100.0, "feti": 2}),
    ("hertz-plane", {"n": 3, "feti": 5}),
    ("hertz-cylinder", {"n": 2, "m": 2, "feti": 7}),
]


def built(family: str, keys: dict[str, Any]) -> Case:
    params = PROBLEMS[family].complete(keys)
    PROBLEMS[family].check(params)
    return PROBLEMS[family].build("dual", params, reference_solution)


def in_one_piece(keys: dict[str, Any]) -> dict[str, Any]:
    return {k: v for k, v in keys.items() if k not in ("feti", "glue")}


@pytest.mark.parametrize(
    ("family", "keys", "glue"),
    [
        pytest.param(
            *case, glue,
            marks=[pytest.mark.slow] if i >= 3 and glue != "orthonormal" else [],
        )
        for i, case in enumerate(CASES) for glue in GLUES
    ],
)  # fmt: skip
def test_subdomains_have_the_displacement_of_bodies_in_one_piece(family, keys, glue):
    case, whole = (
        built(family, {**keys, "glue": glue}),
        built(family, in_one_piece(keys)),
    )
    s = SMALBE().prepare(case.qp, TOL)()
    assert kkt_residuals(case.qp, s).worst <= 10 * TOL
    exact = whole.mechanics.back(reference_solution(whole.qp))
    found = case.mechanics.back(s)
    K, off = whole.mechanics.primal.P, found.x - exact.x
    error = np.sqrt(off @ (K @ off)) / np.sqrt(exact.x @ (K @ exact.x))
    assert error <= 10 * TOL
    assert certify(case.mechanics, found).error <= 100 * TOL


def test_friction_acts_between_subdomains_as_between_bodies():
    keys = {"lower": 5, "upper": 4, "friction": "tresca", "bound": 2e5, "ratio": 9.0}
    whole = built("contact-patch", keys)
    case = built("contact-patch", {**keys, "feti": 2})
    exact = whole.quantities(reference_solution(whole.qp))
    found = case.quantities(SMALBE().prepare(case.qp, TOL)())
    for name in ("energy", "dissipation", "multiplier_sum"):
        assert found[name] == pytest.approx(exact[name], rel=1e-6)
    assert [found[k] for k in ("stick", "slip")] == [
        exact[k] for k in ("stick", "slip")
    ]


@pytest.mark.parametrize("family", sorted({family for family, _ in CASES} | {"greco"}))
def test_keys_that_do_not_fit_are_refused(family):
    check, complete = PROBLEMS[family].check, PROBLEMS[family].complete
    with pytest.raises(InputError, match="glue=chain is not used by feti=0"):
        check(complete({"glue": "chain"}))
    with pytest.raises(InputError, match="feti=-1 must be at least 0"):
        check(complete({"feti": -1}))
    with pytest.raises(InputError, match="glue='tape' is unknown"):
        check(complete({"feti": 2, "glue": "tape"}))


def test_other_forms_of_subdomains_are_refused():
    params = PROBLEMS["beam-ring"].complete({"Nr": 1, "Nh": 1, "steps": 1, "feti": 1})
    for form in ("primal", "dual-bounds"):
        with pytest.raises(InputError, match=f"feti with form {form} is not built"):
            PROBLEMS["beam-ring"].build(form, params, reference_solution)


def test_the_first_step_of_subdomains_makes_no_factor_of_the_whole(monkeypatch):
    def refused(*_: object) -> None:
        raise AssertionError("a factor of the whole")

    monkeypatch.setattr(beam_ring, "clamped", refused)
    monkeypatch.setattr(beam_ring, "floating", refused)
    case = built("beam-ring", {"Nr": 2, "Nh": 3, "steps": 2, "step": 1, "feti": 2})
    found = case.mechanics.back(SMALBE().prepare(case.qp, TOL)())
    assert certify(case.mechanics, found).error <= 100 * TOL
