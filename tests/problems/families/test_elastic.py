"""Elastic families of plug-ins, compared with built-in families."""

from dataclasses import replace

import numpy as np
import pytest

from mortarbench.harness import InputError
from mortarbench.problems import PROBLEMS
from mortarbench.problems.elastic import FrictionLaw, one_step
from mortarbench.problems.families.patch import model
from mortarbench.solvers.reference.solve import reference_solution
from mortarbench.solvers.smalbe.solver import SMALBE
from tests.support.refusals import refused

PATCH = PROBLEMS["contact-patch"]
STRETCHED = dict(lower=3, upper=2, ratio=3.0)


@pytest.mark.parametrize(
    ("law", "keys", "form"),
    [
        pytest.param(law, keys, form, marks=[pytest.mark.slow] * (i % 2 != j))
        for i, (law, keys) in enumerate([
            (FrictionLaw("tresca", bound=1e5), dict(friction="tresca", bound=1e5)),
            (FrictionLaw("coulomb", mu=0.1), dict(friction="coulomb", mu=0.1)),
            (None, {}),
        ])
        for j, form in enumerate(["primal", "dual"])
    ],
)  # fmt: skip
def test_a_case_of_one_step_equals_the_case_of_the_family(form, law, keys):
    configured = PATCH.with_keys(**(STRETCHED | keys))
    case = configured.build(form, reference_solution)
    own = one_step(model(configured), form, friction=law, reference=reference_solution)

    for name in ("P", "q", "G", "h", "A", "b"):
        first, second = (getattr(c.qp, name) for c in (case, own))
        assert abs(first - second).max() == 0 if first.shape[0] else True
    np.testing.assert_array_equal(case.qp.lb, own.qp.lb)
    np.testing.assert_array_equal(case.qp.ub, own.qp.ub)
    s = reference_solution(own.qp)
    values = own.quantities(s)
    assert ("slip" in values) == (law is not None)
    assert values["energy"] == case.quantities(s)["energy"]


@pytest.mark.parametrize(
    ("law", "message"),
    [(dict(kind="oily"), "friction 'oily' is unknown; expected 'none' or 'tresca'"),
     (dict(kind="tresca", bound=-1.0), "bound = -1; expected a traction of 0"),
     (dict(kind="coulomb", mu=float("nan")), "mu = nan; expected a number"),
     (dict(kind="coulomb", mu=0.3), "expected the argument `reference`")],
)  # fmt: skip
def test_invalid_laws_are_refused_in_one_line(law, message):
    with refused(message):
        one_step(model(PATCH.with_keys()), "dual", friction=FrictionLaw(**law))


def test_friction_can_balance_a_tangential_load():
    """Without friction, the tangential load on the upper block is not balanced."""
    bodies = model(PATCH.with_keys(**STRETCHED))
    upper = bodies.body_of_node == 1
    free = ~np.isin(bodies.fixed, 2 * np.flatnonzero(upper))
    push = np.zeros(bodies.f.size)
    push[2 * np.flatnonzero(upper)] = 0.01 / upper.sum()
    pushed = replace(bodies, fixed=bodies.fixed[free], f=bodies.f + push)

    with pytest.raises(InputError, match="upper"):
        one_step(pushed, "dual")
    law = FrictionLaw("tresca", bound=1e5)
    case = one_step(pushed, "dual", friction=law)
    values = case.quantities(reference_solution(case.qp))
    assert values["contact_force"][0] == pytest.approx(0.01e6, rel=1e-6)


@pytest.mark.parametrize("glue", ["orthonormal", "redundant"])
def test_decomposed_bodies_have_the_solution_of_undecomposed_ones(glue):
    bodies = model(PATCH.with_keys(**(STRETCHED | {"lower": 5, "upper": 4})))
    law = FrictionLaw("tresca", bound=1e5)
    whole = one_step(bodies, "dual", friction=law)
    parts = one_step(bodies, "dual", friction=law, parts=5, glue=glue)
    assert parts.qp.A.shape[0] == 3 * 5

    exact = whole.quantities(reference_solution(whole.qp))
    values = parts.quantities(SMALBE().prepare(parts.qp, 1e-9)())
    for name in ("energy", "multiplier_sum", "dissipation"):
        assert values[name] == pytest.approx(exact[name], rel=1e-6)


@pytest.mark.parametrize(
    ("form", "keys", "message"),
    [("primal", {"parts": 5}, "parts with form primal is not built"),
     ("dual", {"parts": 1}, "parts=1 for 2 bodies"),
     ("dual", {"parts": 5, "glue": "tape"}, "glue 'tape'; expected")],
)  # fmt: skip
def test_impossible_decompositions_are_refused(form, keys, message):
    with pytest.raises(InputError, match=message):
        one_step(model(PATCH.with_keys()), form, **keys)
