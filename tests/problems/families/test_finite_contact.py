"""Families with kinematics=finite: exact states, all forms, rejected keys."""

import json
from functools import cache

import numpy as np
import pytest

from mortarbench import problems
from mortarbench.harness import InputError, certify
from mortarbench.harness.names import parse
from mortarbench.harness.verify.kkt import kkt_residuals
from mortarbench.problems.families.beam_ring import BeamRing
from mortarbench.problems.families.hertz import HertzPlane
from mortarbench.problems.families.patch import (
    E_UPPER,
    NU,
    ContactPatch,
    state_under_pressure,
)
from mortarbench.problems.fem.elasticity import Material
from mortarbench.problems.fem.hyperelastic import hyperelastic
from mortarbench.solvers.adapters.clarabel_ import Clarabel
from mortarbench.solvers.adapters.osqp_ import OSQP
from mortarbench.solvers.adapters.piqp_ import PIQP
from mortarbench.solvers.reference.solve import reference_solution
from mortarbench.solvers.smalbe.solver import SMALBE

pytestmark = pytest.mark.together

RING = {"Nr": 2, "Nh": 2, "steps": 2, "contact_stiffness": "geometric"}
CASES = {
    "beam-ring": (BeamRing(), RING),
    "contact-patch": (ContactPatch(), {"lower": 3, "upper": 2, "stretch": 0.7}),
    "hertz-plane": (HertzPlane(), {"n": 2}),
}
FORMS = [(name, form) for name, (f, _) in CASES.items() for form in f.forms]


@cache
def built(name, form="dual", **keys):
    family, own = CASES[name]
    configured = family.with_keys(**{**own, "kinematics": "finite", **keys})
    return configured.build(form, reference_solution)


def quantities(name, form="dual", **keys):
    case = built(name, form, **keys)
    return case.quantities(reference_solution(case.qp))


@pytest.mark.parametrize(
    ("stretch", "lateral", "nominal", "cauchy"),
    [
        (0.8, 1.0948760560, -0.2686315279, -0.2453533680),
        (0.6, 1.2144261693, -0.7146352056, -0.5884550446),
    ],
)
@pytest.mark.parametrize(
    "slave", [pytest.param("lower", marks=pytest.mark.slow), "upper"]
)
def test_pressed_blocks_are_homogeneous(stretch, lateral, nominal, cauchy, slave):
    """Neo-Hookean blocks between frictionless plates have the digits of an independent
    code."""
    got = quantities("contact-patch", stretch=stretch, slave=slave)

    np.testing.assert_allclose(got["stretches"], [lateral, stretch], atol=1e-9)
    assert got["nominal_stress"] / 10e6 == pytest.approx(nominal, abs=2e-10)
    assert got["cauchy_stress"] / 10e6 == pytest.approx(cauchy, abs=2e-10)
    assert got["position_error"] <= 1e-9
    assert got["stress_error"] <= 1e-9
    if stretch == 0.8:
        assert got["strain_energy"] / 10e6 == pytest.approx(0.0250180138, abs=2e-10)


@pytest.mark.parametrize("stretch", [pytest.param(0.9, marks=pytest.mark.slow), 0.65])
def test_pressed_blocks_of_st_venant_kirchhoff_are_homogeneous(stretch):
    """The exact state is λ₁² = 1 + ν/(1 − ν)(1 − λ₂²), P₂₂ = λ₂E/(1 − ν²)·½(λ₂² −
    1)."""
    got = quantities("contact-patch", stretch=stretch, material="svk")
    strain = (stretch**2 - 1) / 2

    assert got["stretches"] == pytest.approx(
        [np.sqrt(1 - 2 * NU / (1 - NU) * strain), stretch], abs=1e-9
    )
    assert got["nominal_stress"] == pytest.approx(
        stretch * E_UPPER / (1 - NU**2) * strain, rel=1e-9
    )


def test_the_pressure_of_the_family_is_a_nominal_stress():
    got = quantities("contact-patch", stretch=1.0)
    exact = state_under_pressure(hyperelastic("neo-hooke", Material(E_UPPER, NU)), 1e6)

    assert got["nominal_stress"] == pytest.approx(-1e6, rel=1e-9)
    assert got["stretches"] == pytest.approx([exact.lateral, exact.stretch], abs=1e-9)


@pytest.mark.parametrize("name", CASES)
def test_all_forms_are_of_one_qp(name):
    family, _ = CASES[name]
    cases = [built(name, form) for form in family.forms]
    energy, points = [], []
    for case in cases:
        s = reference_solution(case.qp)
        energy.append(case.scale * case.qp.objective(s.x) + case.constant)
        points.append(case.recover(s))
        assert (case.mechanics.primal.P != cases[0].qp.P).nnz == 0

    np.testing.assert_allclose(energy, energy[0], rtol=1e-9)
    for point in points:
        np.testing.assert_allclose(point, points[0], atol=1e-9 * abs(point).max())


@pytest.mark.parametrize("name", CASES)
def test_the_model_of_the_last_iteration_has_the_energy_of_the_potential(name):
    case = built(name)
    s = reference_solution(case.qp)
    model = case.scale * case.qp.objective(s.x) + case.constant
    got = case.quantities(s)

    assert got["energy"] == pytest.approx(model, rel=1e-9)
    assert got["residual"] <= 1e-8
    assert got["penetration"] <= 1e-10
    json.dumps(got, allow_nan=False)


@pytest.mark.parametrize(("name", "form"), FORMS)
def test_answers_are_certified(name, form):
    case = built(name, form)
    s = reference_solution(case.qp)

    assert certify(case.mechanics, case.mechanics.to_primal(s)).bound <= 1e-7


@pytest.mark.parametrize("name", ["beam-ring", "contact-patch", "hertz-plane"])
def test_every_iteration_is_verified_by_smalbe_and_three_generic_solvers(name):
    steps = [1, 2] if name == "beam-ring" else [None]
    for step in steps:
        at = {} if step is None else {"step": step}
        count = quantities(name, **at)["newton_iterations"]
        assert count >= 3
        for newton in range(1, count + 1):
            qp = built(name, newton=newton, **at).qp
            for solver in (SMALBE(), Clarabel(), OSQP(), PIQP()):
                s = solver.prepare(qp, 1e-8)()
                assert kkt_residuals(qp, s).worst <= 1e-7, (solver, step, newton)


def test_the_contact_force_of_hertz_is_the_load():
    got = quantities("hertz-plane")

    assert got["contact_force"][1] == pytest.approx(10e6, rel=1e-9)
    assert got["force_error"] == pytest.approx(0, abs=1e-9)


def test_fields_of_bodies_under_pressure_contain_cauchy_stresses():
    case = built("contact-patch", stretch=0.8)
    drawn = case.fields(reference_solution(case.qp))

    np.testing.assert_allclose(drawn.nodal["syy"] / 10e6, -0.2453533680, atol=1e-9)
    np.testing.assert_allclose(drawn.nodal["sxx"] / 10e6, 0, atol=1e-9)
    assert drawn.displacement[:, 1].min() == pytest.approx(-0.2, abs=1e-9)


def test_names_contain_the_keys_of_finite_strain_only_if_they_are_set():
    case = parse("beam-ring/Nr=2/Nh=2/steps=1/dual", problems.PROBLEMS)
    finite = parse(
        "beam-ring/Nr=2/Nh=2/steps=1/kinematics=finite/newton=2/dual",
        problems.PROBLEMS,
    )

    assert case.name == "beam-ring/Nr=2/Nh=2/steps=1/dual"
    assert finite.name.endswith("steps=1/kinematics=finite/newton=2/dual")


def test_a_softening_material_is_refused_at_the_softening_stretch():
    """The pressure on this material is largest at the stretch 1/√3."""
    with pytest.raises(InputError, match=r"material=svk softens from 0\.5774 on"):
        built("contact-patch", stretch=0.5, material="svk")
