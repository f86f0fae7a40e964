"""Spheres in contact: Hertz's digits, scaling, equilibrium of the far field."""

from functools import cache

import numpy as np
import pytest

from mortarbench.harness import InputError, certify
from mortarbench.problems.families.half_space.point_contact import PointContact
from mortarbench.problems.families.hertz_sphere import (
    point_force_stress,
    tangential_force_stress,
)
from mortarbench.solvers import SOLVERS
from tests.support.cases import built

pytestmark = pytest.mark.together


@cache
def solved(keys, solver="smalbe", tol=1e-11):
    case = built(f"hertz-sphere/{keys}")
    s = SOLVERS[solver].prepare(case.qp, tol)()
    return case, s, case.quantities(s)


@pytest.mark.parametrize(
    ("n", "limit"), [(3, 2e-2), pytest.param(8, 5e-3, marks=pytest.mark.slow)]
)
def test_radius_pressure_and_approach_are_those_of_hertz(n, limit):
    """The data are R = 8, E = 200, ν = 0.3 and P = 10, with n cells per contact
    radius."""
    case, s, found = solved(f"n={n}/dual")

    assert found["contact_radius"] == pytest.approx(0.648715, rel=limit)
    assert found["p_max"] == pytest.approx(11.345743, rel=5e-3)
    assert found["approach"] == pytest.approx(0.0526040, rel=1e-2)
    assert found["contact_force"] == pytest.approx([0, 0, 10], abs=1e-9)
    assert found["multiplier_sum"] == pytest.approx(10, abs=1e-9)
    assert abs(found["force_error"]) < 1e-10
    (pair,) = found["contacts"].values()
    assert pair["force"] == {"sphere": found["contact_force"]}
    assert pair["pressed_area"] == pytest.approx(np.pi * 0.648715**2, rel=0.1)
    assert certify(case.mechanics, case.mechanics.to_primal(s)).bound < 1e-6
    # the edge of the contact is within a cell of its radius
    (side,) = case.fields(s).contacts
    r = np.linalg.norm(case.fields(s).points[side.nodes, :2], axis=1)
    touching = side.pressure > 1e-6 * side.pressure.max()
    assert r[touching].max() == pytest.approx(0.648715, abs=1.5 * 0.648715 / n)


@pytest.mark.parametrize(
    "keys",
    [
        pytest.param("", marks=pytest.mark.slow),
        "n=3/",
        pytest.param("against=sphere/", marks=pytest.mark.slow),
        "n=2/against=sphere/Q=0.5/",
    ],
)
@pytest.mark.parametrize("tol", [1e-6, pytest.param(1e-8, marks=pytest.mark.slow)])
def test_contact_forces_balance_the_load_more_accurately_than_the_tolerance(keys, tol):
    """Without projections at the end of a solve, the error of the balance was up to
    3.2e-9.
    """
    *_, found = solved(f"{keys}dual", tol=tol)

    assert abs(found["force_error"]) < 1e-9


#: two spheres of the verification of MOOSE, with a/R = 0.05
MOOSE = "against=sphere/R=2/E=1.40625e7/nu=0.25/load=10000"


#: a, p₀ and the approach of the spheres of MOOSE, and of two spheres with the default
#: keys. In the latter case, the effective modulus and radius are half of those of the
#: sphere on a plane, so that a and p₀ are equal to those of that problem
OF_MOOSE, OF_TWO = (0.1, 15000 / np.pi / 0.01, 0.01), (0.648715, 11.345743, 0.105208)


@pytest.mark.parametrize(
    ("keys", "exact", "limit"),
    [
        pytest.param("n=8/against=sphere", OF_TWO, 0.01, marks=pytest.mark.slow),
        pytest.param(f"n=8/{MOOSE}", OF_MOOSE, 0.01, marks=pytest.mark.slow),
        ("n=3/against=sphere", OF_TWO, 0.03),
        pytest.param(
            f"n=4/{MOOSE}/basis=standard", OF_MOOSE, 0.03, marks=pytest.mark.slow
        ),
        (f"n=3/{MOOSE}/contact=nts", OF_MOOSE, 0.03),
    ],
)
def test_two_spheres_with_non_matching_meshes_agree_with_hertz(keys, exact, limit):
    values = solved(f"{keys}/dual")[2]
    a, p0, approach = exact
    P = p0 * 2 / 3 * np.pi * a**2

    assert values["contact_radius"] == pytest.approx(a, rel=limit)
    assert values["p_max"] == pytest.approx(p0, rel=limit)
    assert values["approach"] == pytest.approx(approach, rel=limit)
    assert values["contact_force"] == [0, 0, pytest.approx(-P, rel=1e-5)]
    assert abs(values["force_error"]) < 1e-9
    force = values["contacts"]["upper on lower"]["force"]
    assert force["lower"] == values["contact_force"]
    assert force["upper"] == [0, 0, -force["lower"][2]]


def test_the_support_of_the_lower_sphere_along_z_has_no_reaction():
    case, s, _ = solved("n=3/against=sphere/dual")
    primal, point = case.mechanics.primal, case.mechanics.to_primal(s)
    points = case.fields(s).points
    on_axis = (points[:, :2] == 0).all(axis=1)
    (node,) = np.flatnonzero(on_axis & (points[:, 2] == points[:, 2].min()))
    reaction = (primal.P @ point.x + primal.q)[3 * node + 2]

    assert 3 * node + 2 in primal.A.nonzero()[1]
    assert abs(point.x[3 * node + 2]) <= 1e-12
    assert abs(reaction) <= 1e-10


def test_formulae_have_the_digits_of_two_larger_spheres():
    """For R = 50, E = 2e4, ν = 0.3 and an approach of 4, a = 10, which exceeds the
    limit of a/R of the family."""
    modulus = 2e4 / (1 - 0.3**2) / 2
    exact = PointContact(4 / 3 * modulus * 10**3 / 25, 25, modulus)

    assert exact.a == pytest.approx(10, rel=1e-12)
    assert exact.approach == pytest.approx(4, rel=1e-12)
    assert exact.p0 == pytest.approx(2798.329, abs=5e-4)
    keys = f"against=sphere/R=50/E=2e4/nu=0.3/load={exact.P}/dual"
    with pytest.raises(InputError, match="the contact radius 10 is more than R/8 = 6"):
        built(f"hertz-sphere/{keys}")


@pytest.mark.parametrize(
    ("keys", "solver"),
    [
        ("n=2/primal", "piqp"),
        ("n=2/dual", "clarabel"),
        ("n=2/feti=4/dual", "smalbe"),
        ("n=1/against=sphere/primal", "piqp"),
        ("n=1/against=sphere/feti=4/dual", "smalbe"),
    ],
)
def test_every_form_has_the_same_contact(keys, solver):
    form = keys.replace("/feti=4", "").replace("primal", "dual")
    expected, found = solved(form)[2], solved(keys, solver)[2]

    for name in ("contact_radius", "p_max", "approach", "energy", "active"):
        assert found[name] == pytest.approx(expected[name], rel=1e-7)


def test_errors_fall_with_the_cells():
    errors = [
        [abs(solved(f"n={n}/dual")[2][f"{name}_error"]) for name in
         ("contact_radius", "approach")]
        for n in (2, 4)
    ]  # fmt: skip
    assert (np.diff(errors, axis=0) < 0).all()


def test_units_do_not_matter():
    """With lengths in mm instead of m and E in MPa, forces in N are unchanged."""
    one, other = solved("n=3/dual")[2], solved("n=3/R=8000/E=200e-6/dual")[2]

    assert other["contact_force"] == pytest.approx(one["contact_force"], rel=1e-9)
    assert other["contact_radius"] == pytest.approx(1e3 * one["contact_radius"])
    assert other["p_max"] == pytest.approx(1e-6 * one["p_max"])


@pytest.mark.parametrize(
    ("stress", "force"),
    [(point_force_stress, [0, 0, 1]), (tangential_force_stress, [1, 0, 0])],
)
def test_far_fields_are_in_equilibrium_with_a_point_force(stress, force):
    nu, rng, step = 0.27, np.random.default_rng(8), 1e-5
    x = rng.uniform(0.5, 2, (50, 3)) * rng.choice([-1, 1], (50, 3))
    x[:, 2] = abs(x[:, 2])
    divergence = sum(
        stress(x + step * axis, nu)[:, k] - stress(x - step * axis, nu)[:, k]
        for k, axis in enumerate(np.eye(3))
    ) / (2 * step)  # fmt: skip
    assert abs(divergence).max() <= 1e-8
    sigma = stress(x, nu)
    np.testing.assert_allclose(sigma, sigma.transpose(0, 2, 1), atol=1e-16)
    # the free surface has no tractions; tractions on a half sphere balance the force
    flat = stress(x * [1, 1, 0], nu)
    assert abs(flat[:, 2]).max() <= 1e-15
    z, weights = np.polynomial.legendre.leggauss(20)
    z, weights = (z + 1) / 2, weights / 2
    around = 2 * np.pi * np.arange(16) / 16
    normal = np.stack(
        [np.outer(np.sqrt(1 - z**2), np.cos(around)),
         np.outer(np.sqrt(1 - z**2), np.sin(around)),
         np.outer(z, np.ones(16))], axis=-1,
    ).reshape(-1, 3)  # fmt: skip
    traction = np.einsum("kij,kj->ki", stress(normal, nu), normal)
    total = np.repeat(weights * 2 * np.pi / 16, 16) @ traction
    assert total == pytest.approx([-f for f in force], abs=1e-12)
    # compatibility: Beltrami's equation (1 + ν)∇²σ + ∇∇tr σ = 0
    h, axes = 1e-3, np.eye(3)
    at = x[:5] / np.linalg.norm(x[:5], axis=1, keepdims=True)
    laplacian = sum(
        stress(at + h * e, nu) - 2 * stress(at, nu) + stress(at - h * e, nu)
        for e in axes
    ) / h**2  # fmt: skip
    trace = lambda p: np.trace(stress(p, nu), axis1=1, axis2=2)  # noqa: E731
    hessian = np.stack([[
        (trace(at + h * (e + f)) - trace(at + h * (e - f))
         - trace(at - h * (e - f)) + trace(at - h * (e + f))) / (4 * h**2)
        for e in axes] for f in axes]).transpose(2, 0, 1)  # fmt: skip
    assert abs((1 + nu) * laplacian + hessian).max() <= 2e-4


def test_a_tangential_force_leaves_the_middle_sticking():
    """The problem of Cattaneo and Mindlin has two cells per contact radius."""
    values = solved(f"n=2/{MOOSE}/Q=0.5/dual")[2]
    pressed = solved(f"n=2/{MOOSE}/dual")[2]
    force = 0.5 * 0.3 * 10_000

    assert values["tangential_force"] == pytest.approx(force, rel=1e-6)
    assert values["contact_force"] == pytest.approx([force, 0, -10_000], rel=1e-6)
    assert values["c_over_a"] == pytest.approx(0.5 ** (1 / 3), rel=0.05)
    assert values["c_over_a_moment"] == pytest.approx(0.5 ** (1 / 3), rel=0.05)
    assert values["friction_residual"] <= 1e-9
    # because both bodies have the same material, Q does not change the pressure
    for name in ("contact_radius", "p_max", "approach"):
        assert values[name] == pytest.approx(pressed[name], rel=1e-3)
