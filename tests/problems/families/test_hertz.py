"""Pressures and shear tractions between cylinders, compared with exact solutions."""

from dataclasses import replace
from functools import cache, partial

import numpy as np
import pytest
from scipy.integrate import quad

from mortarbench.harness.names import parse
from mortarbench.harness.verify.kkt import kkt_residuals
from mortarbench.problems import PROBLEMS
from mortarbench.problems.families.hertz import (
    HertzCylinder,
    HertzPlane,
    two_cylinders,
)
from mortarbench.problems.families.line_contact import LineContact
from mortarbench.solvers.adapters.clarabel_ import Clarabel
from mortarbench.solvers.reference.solve import reference_solution
from mortarbench.solvers.smalbe.solver import SMALBE

pytestmark = pytest.mark.together

PLANE, CYLINDER = HertzPlane(), HertzCylinder()
SOLVERS = {"dual": SMALBE(), "primal": Clarabel()}
TOL = 1e-11
BENCHMARK = LineContact(P=1e7, R=8e-3, E_star=200e9 / 0.91)
PAIRINGS = [("mortar", "dual"), ("mortar", "standard"), ("nts", "dual")]


@cache
def solved(family, form="dual", **keys):
    """Return the case and its verified solution."""
    case = family.with_keys(**keys).build(form, reference_solution)
    s = SOLVERS[form].prepare(case.qp, TOL / 2)()
    assert kkt_residuals(case.qp, s).worst <= 10 * TOL
    return case, s


@cache
def result(family, form="dual", **keys):
    case, s = solved(family, form, **keys)
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


def test_the_force_error_is_the_difference_of_forces_and_load():
    case, s = solved(PLANE)
    too_much = replace(s, x=1.01 * s.x)

    assert case.quantities(too_much)["force_error"] == pytest.approx(0.01)


def test_the_peak_pressure_of_the_benchmark_in_pascal():
    assert result(PLANE)["p_max"] == pytest.approx(9.3514e9, rel=0.01)
    assert result(PLANE)["half_width"] == pytest.approx(0.68078e-3, rel=0.01)


@pytest.mark.parametrize("family", [PLANE, CYLINDER], ids=["plane", "cylinder"])
def test_the_pressure_converges(family):
    """The order is above one, although the slope of the pressure is infinite at ±a."""
    errors = [
        result(family, n=n, **({"m": n} if family is CYLINDER else {}))[
            "pressure_l2_error"
        ]
        for n in (5, 10, 20)
    ]

    assert np.divide(errors[:-1], errors[1:]).min() > 2


def test_the_pressure_is_symmetric_and_nonnegative():
    _, s = solved(PLANE)
    force = s.x[2:]

    assert force == pytest.approx(force[::-1], abs=1e-8 * force.max())
    assert force.min() >= 0
    assert abs(s.x[:2]).max() <= 1e-8 * force.max()  # reactions on the axis


@pytest.mark.parametrize(("contact", "basis"), PAIRINGS[:2])
@pytest.mark.parametrize("slave", ["lower", "upper"])
def test_two_cylinders_are_in_hertz_contact_by_mortar(contact, basis, slave):
    got = result(CYLINDER, contact=contact, basis=basis, slave=slave, m=10)

    assert abs(got["p_max_error"]) <= 0.01
    assert got["pressure_l2_error"] <= 0.05
    assert abs(got["half_width_error"]) <= 0.01
    assert abs(got["force_error"]) <= 1e-9


@pytest.mark.parametrize(("contact", "basis"), PAIRINGS)
def test_cylinders_of_unequal_materials_are_in_hertz_contact(contact, basis):
    """The ratio of the moduli is 10."""
    got = result(CYLINDER, contact=contact, basis=basis, ratio=10.0)

    assert abs(got["p_max_error"]) <= 0.01
    assert got["pressure_l2_error"] <= 0.05
    assert abs(got["half_width_error"]) <= 0.01


def test_the_theory_of_two_cylinders_adds_curvatures_and_compliances():
    """The bodies are two equal cylinders, and a cylinder on one of half the modulus."""
    equal, softer = (
        two_cylinders(CYLINDER.with_keys(load=10.0, **keys))[1]
        for keys in ({}, {"ratio": 0.5})
    )

    assert equal.a == pytest.approx(BENCHMARK.a)
    assert (softer.R, softer.E_star) == pytest.approx((4e-3, 200e9 / 0.91 / 3))


@pytest.mark.slow
def test_refinement_reduces_the_pressure_error_of_mortar_but_not_of_node_to_segment():
    """As in the patch test, the meshes do not match."""
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
    """The error is O(a²/R²) with a² ∝ P, plus a constant due to the finite size of the
    bodies."""
    errors = np.array([
        result(CYLINDER, n=20, m=20, load=load)["half_width_error"]
        for load in (10.0, 1.0, 0.1)
    ])  # fmt: skip

    assert np.divide(*np.diff(errors)) == pytest.approx(10, rel=0.15)


@pytest.mark.parametrize("n", [20, 40])
def test_errors_on_fine_meshes_are_those_of_finite_bodies(n):
    got = result(PLANE, n=n)

    assert got["pressure_l2_error"] <= 0.01
    assert abs(got["p_max_error"]) <= 1.5e-3
    assert abs(got["half_width_error"]) <= 1e-3


sheared_result = partial(result, CYLINDER, n=20, m=20, friction="coulomb", mu=0.3)


@pytest.mark.parametrize(
    ("Q", "contact"),
    [
        pytest.param(0.5, "nts", marks=pytest.mark.slow),
        (0.9, "mortar"),
        pytest.param(0.25, "mortar", marks=pytest.mark.slow),
        pytest.param(0.75, "mortar", marks=pytest.mark.slow),
    ],
)
def test_slip_starts_at_the_edge_as_in_cattaneo_and_mindlin(Q, contact):
    """There are 20 cells per a, a/R = 0.027, and c is computed from the second moment
    of the traction."""
    got = sheared_result(Q=Q, contact=contact)

    assert abs(got["stick_half_width_error"]) < 0.01
    assert abs(got["shear_centre_error"]) < 0.01
    assert abs(got["tangential_force_error"]) < 1e-3
    assert got["shear_l2_error"] < 0.1
    assert got["stick"] == pytest.approx(2 * 20 * np.sqrt(1 - Q), abs=2)
    assert got["stick"] + got["slip"] == 41
    assert abs(got["half_width_error"]) < 2e-3
    assert got["friction_residual"] < 1e-8


@pytest.mark.slow
def test_slip_from_the_undeformed_state_has_the_same_tractions():
    got = sheared_result(n=6, m=6, Q=0.5, loading="static")

    assert abs(got["stick_half_width_error"]) < 0.03
    assert got["slip"] == pytest.approx(12 * 0.29, abs=1.1)


def test_the_tangential_force_rotates_no_body():
    """The loads on each body have no moment and the resultant ±Q, and reactions at the
    supports are negligible."""
    keys = dict(n=4, m=4, friction="coulomb", mu=0.5, Q=0.5)
    configured = CYLINDER.with_keys(**keys)
    stated = configured.problem()
    first, last = stated.stages[0].load, stated.stages[-1].load
    bodies = stated.bodies.assembled
    (x, y), upper = bodies.mesh.points.T, bodies.body_of_node == 0
    load = (last - first).reshape(-1, 2) / (0.5 * 0.5)  # unit of Q is μP
    case = configured.build("dual", reference_solution)

    for body, Q in ((upper, 1.0), (~upper, -1.0)):
        assert load[body].sum(axis=0) == pytest.approx([Q, 0], abs=1e-12)
        turning = x[body] @ load[body, 1] - y[body] @ load[body, 0]
        assert turning == pytest.approx(0, abs=1e-12)
    assert abs(reference_solution(case.qp).x[:3]).max() < 1e-3  # turned contact normals


@pytest.mark.parametrize(
    "keys",
    [
        dict(),
        dict(contact="nts"),
        pytest.param(dict(slave="lower"), marks=pytest.mark.slow),
    ],
)
def test_slip_starts_from_the_symmetric_position_of_the_cylinders(keys):
    """Without friction, the cylinders could roll on each other under P."""
    keys |= dict(n=5, m=4, friction="coulomb", mu=0.4, Q=0.6)
    case = CYLINDER.with_keys(**keys).build("dual", reference_solution)
    friction = case.mechanics.friction
    begins = friction.start[friction.bound > 0]

    assert abs(begins.mean()) < 1e-3 * np.ptp(begins)


def test_friction_holds_equal_cylinders_together_without_a_force():
    """Equal cylinders deform symmetrically; hence nothing slips, and the pressure is
    that without friction."""
    keys = dict(n=10, m=10, load=0.1, friction="coulomb", mu=0.3)
    got, smooth = result(CYLINDER, **keys), result(CYLINDER, n=10, m=10, load=0.1)

    assert got["p_max"] == pytest.approx(smooth["p_max"], rel=2e-3)
    assert got["dissipation"] < 1e-5 * abs(got["energy"])


@pytest.mark.parametrize("ratio", [1e-5, 1e-6, 1e-9, 1e-10, 1e-12])
def test_cells_keep_their_area_if_the_contact_is_wider_than_the_cylinder(ratio):
    """If the uniformly meshed arc left the half disc, K would be indefinite."""
    bodies, exact = two_cylinders(HertzCylinder(n=3, m=2, ratio=ratio))
    assert exact.a > 4 * 0.008
    mesh = bodies.mesh
    x, y = np.moveaxis(mesh.points[mesh.cells], -1, 0)
    area = 0.5 * (x * np.roll(y, -1, axis=1) - np.roll(x, -1, axis=1) * y).sum(axis=1)
    half_discs = np.pi * 0.008**2

    assert area.min() > 0
    assert 0.7 * half_discs < area.sum() < half_discs


def test_a_cylinder_on_a_very_soft_one_is_solved():
    case = parse("hertz-cylinder/n=3/m=2/ratio=1e-9/dual", PROBLEMS)
    built = case.build(reference_solution)
    answer = SMALBE().prepare(built.qp, 1e-8)()

    assert kkt_residuals(built.qp, answer).worst < 1e-7
