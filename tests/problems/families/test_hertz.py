"""Pressures between cylinders against Hertz."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import quad

from harness import InputError, kkt_residuals
from problems.families.hertz import HertzCylinder, HertzPlane
from problems.models.hertz import two_cylinders
from problems.models.line_contact import LineContact
from solvers.adapters.clarabel_ import Clarabel
from solvers.reference.solve import reference_solution
from solvers.smalbe.solver import SMALBE

PLANE, CYLINDER = HertzPlane(), HertzCylinder()
SOLVERS = {"dual": SMALBE(), "primal": Clarabel()}
TOL = 1e-11
BENCHMARK = LineContact(P=1e7, R=8e-3, E_star=200e9 / 0.91)
PAIRINGS = [("mortar", "dual"), ("mortar", "standard"), ("nts", "dual")]


def solved(family, form="dual", **given):
    """The case and its verified solution."""
    case = family.build(form, {**family.defaults, **given}, reference_solution)
    s = SOLVERS[form].prepare(case.qp, TOL)()
    assert kkt_residuals(case.qp, s).worst <= 10 * TOL
    return case, s


def result(family, form="dual", **given):
    case, s = solved(family, form, **given)
    return case.quantities(s)


def test_the_exact_solution_has_the_digits_of_the_literature():
    assert BENCHMARK.a == pytest.approx(0.68078e-3, rel=1e-5)
    assert BENCHMARK.p0 == pytest.approx(9.3514e9, rel=1e-5)


def test_the_exact_pressure_carries_the_force_and_its_second_moment_is_Pa2_over_4():
    def moment(k):
        x = 2 * BENCHMARK.a
        return quad(lambda x: x**k * BENCHMARK.pressure(x), -x, x, epsabs=0)[0]

    assert moment(0) == pytest.approx(1e7, rel=1e-6)
    assert moment(2) == pytest.approx(1e7 * BENCHMARK.a**2 / 4, rel=1e-6)


@pytest.mark.parametrize("form", ["primal", "dual"])
@pytest.mark.parametrize("plane", ["strain", "stress"])
def test_a_cylinder_on_a_rigid_plane_is_in_hertz_contact(form, plane):
    got = result(PLANE, form, plane=plane)

    assert abs(got["p_max_error"]) <= 0.01
    assert got["pressure_l2_error"] <= 0.05
    assert abs(got["half_width_error"]) <= 0.01
    assert abs(got["force_error"]) <= 1e-9
    assert got["contact_force"] == pytest.approx([0, 1e7], abs=1e-2)


def test_the_force_error_tells_by_how_much_the_forces_miss_the_load():
    case, s = solved(PLANE)
    too_much = replace(s, x=1.01 * s.x)

    assert case.quantities(too_much)["force_error"] == pytest.approx(0.01)


def test_the_peak_pressure_of_the_benchmark_in_pascal():
    assert result(PLANE)["p_max"] == pytest.approx(9.3514e9, rel=0.01)
    assert result(PLANE)["half_width"] == pytest.approx(0.68078e-3, rel=0.01)


@pytest.mark.parametrize("family", [PLANE, CYLINDER], ids=["plane", "cylinder"])
def test_the_pressure_converges(family):
    """Faster than with order one: it has an infinite slope at ±a."""
    errors = [
        result(family, n=n, **({"m": n} if family is CYLINDER else {}))[
            "pressure_l2_error"
        ]
        for n in (5, 10, 20)
    ]

    assert np.divide(errors[:-1], errors[1:]).min() > 2


def test_the_pressure_is_symmetric_and_none_pulls():
    _, s = solved(PLANE)
    force = s.x[2:]

    assert force == pytest.approx(force[::-1], abs=1e-8 * force.max())
    assert force.min() >= 0
    assert abs(s.x[:2]).max() <= 1e-8 * force.max()  # the supports on the axis


@pytest.mark.parametrize(("contact", "basis"), PAIRINGS[:2])
@pytest.mark.parametrize("slave", ["lower", "upper"])
def test_two_cylinders_are_in_hertz_contact_by_mortar(contact, basis, slave):
    got = result(CYLINDER, contact=contact, basis=basis, slave=slave, m=10)

    assert abs(got["p_max_error"]) <= 0.01
    assert got["pressure_l2_error"] <= 0.05
    assert abs(got["half_width_error"]) <= 0.01
    assert abs(got["force_error"]) <= 1e-9


@pytest.mark.parametrize(("contact", "basis"), PAIRINGS)
def test_unequal_cylinders_are_in_hertz_contact(contact, basis):
    """R = 8 : 16 mm, E = 1 : 10."""
    got = result(CYLINDER, contact=contact, basis=basis, radius=2.0, ratio=10.0)

    assert abs(got["p_max_error"]) <= 0.01
    assert got["pressure_l2_error"] <= 0.05
    assert abs(got["half_width_error"]) <= 0.01


def test_the_theory_of_two_cylinders_adds_curvatures_and_compliances():
    """Equal ones press like one on a plane; a soft or small partner gives in more."""
    theory = [
        two_cylinders({**CYLINDER.defaults, "load": 10.0, **given})[1]
        for given in ({}, {"ratio": 1e9, "radius": 1e9}, {"radius": 3.0, "ratio": 0.5})
    ]

    assert theory[0].a == pytest.approx(BENCHMARK.a)
    assert theory[1].p0 == pytest.approx(BENCHMARK.p0)
    assert (theory[2].R, theory[2].E_star) == pytest.approx((6e-3, 200e9 / 0.91 / 3))


def test_refinement_removes_the_pressure_error_of_mortar_but_not_of_node_to_segment():
    """On meshes that do not match; as in the patch test."""
    errors = {
        contact: [
            result(CYLINDER, n=n, m=m, contact=contact)["pressure_l2_error"]
            for n, m in ((10, 8), (40, 32))
        ]
        for contact in ("mortar", "nts")
    }

    assert errors["mortar"][1] < 0.2 * errors["mortar"][0]
    assert errors["nts"][1] > 0.8 * errors["nts"][0]


def test_the_difference_from_hertz_falls_with_the_load():
    """It is O(a²/R²), and a² is proportional to P; finite size adds a constant."""
    errors = np.array([
        result(CYLINDER, n=20, m=20, load=load)["half_width_error"]
        for load in (10.0, 1.0, 0.1)
    ])  # fmt: skip

    assert np.divide(*np.diff(errors)) == pytest.approx(10, rel=0.15)


@pytest.mark.parametrize("n", [20, 40])
def test_what_is_left_on_fine_meshes_is_finite_size(n):
    got = result(PLANE, n=n)

    assert got["pressure_l2_error"] <= 0.01
    assert abs(got["p_max_error"]) <= 1.5e-3
    assert abs(got["half_width_error"]) <= 1e-3


@pytest.mark.parametrize(
    ("family", "bad", "told"),
    [
        (PLANE, {"n": 0}, "hertz-plane: n=0 must be at least 1"),
        (PLANE, {"load": -1.0}, "hertz-plane: load=-1.0 must be positive"),
        (CYLINDER, {"m": 0}, "hertz-cylinder: m=0 must be at least 1"),
        (CYLINDER, {"radius": 0.0}, "hertz-cylinder: radius=0.0 must be positive"),
        (CYLINDER, {"contact": "glue"}, "contact='glue' is unknown"),
    ],
)
def test_values_out_of_range_are_refused(family, bad, told):
    with pytest.raises(InputError) as e:
        family.check({**family.defaults, **bad})

    assert told in str(e.value)
