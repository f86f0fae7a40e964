"""A sphere on a rigid plane: Hertz's digits, scaling, equilibrium of the far field."""

from functools import cache

import numpy as np
import pytest

from mortarbench.harness import InputError, certify
from mortarbench.harness.names import parse
from mortarbench.problems import PROBLEMS
from mortarbench.problems.models.solids.hertz_sphere import point_force_stress
from mortarbench.solvers import SOLVERS
from mortarbench.solvers.reference.solve import reference_solution


@cache
def solved(keys, solver="smalbe"):
    case = parse(f"hertz-sphere/{keys}", PROBLEMS).build(reference_solution)
    s = SOLVERS[solver].prepare(case.qp, 1e-11)()
    return case, s, case.quantities(s)


def test_radius_pressure_and_approach_are_those_of_hertz():
    """R = 8, E = 200, ν = 0.3, P = 10 with eight cells per contact radius."""
    case, s, found = solved("dual")

    assert found["contact_radius"] == pytest.approx(0.648715, rel=5e-3)
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
    assert r[touching].max() == pytest.approx(0.648715, abs=1.5 * 0.648715 / 8)


@pytest.mark.parametrize(
    ("keys", "solver"),
    [("n=3/primal", "piqp"), ("n=3/dual", "clarabel"), ("n=3/feti=4/dual", "smalbe")],
)
def test_every_form_has_the_same_contact(keys, solver):
    expected, found = solved("n=3/dual")[2], solved(keys, solver)[2]

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
    """Lengths in mm instead of m, and E in MPa: forces in N are the same."""
    one, other = solved("n=3/dual")[2], solved("n=3/R=8000/E=200e-6/dual")[2]

    assert other["contact_force"] == pytest.approx(one["contact_force"], rel=1e-9)
    assert other["contact_radius"] == pytest.approx(1e3 * one["contact_radius"])
    assert other["p_max"] == pytest.approx(1e-6 * one["p_max"])


def test_the_far_field_is_in_equilibrium_with_the_force():
    nu, rng, step = 0.27, np.random.default_rng(8), 1e-5
    x = rng.uniform(0.5, 2, (50, 3))
    divergence = sum(
        point_force_stress(x + step * axis, nu)[:, k]
        - point_force_stress(x - step * axis, nu)[:, k]
        for k, axis in enumerate(np.eye(3))
    ) / (2 * step)  # fmt: skip
    assert abs(divergence).max() <= 1e-8
    sigma = point_force_stress(x, nu)
    np.testing.assert_allclose(sigma, sigma.transpose(0, 2, 1), atol=1e-16)
    # no tractions on the free surface, and a total of −1 on every half sphere
    flat = point_force_stress(x * [1, 1, 0], nu)
    assert abs(flat[:, 2]).max() <= 1e-15
    z, weights = np.polynomial.legendre.leggauss(20)
    z, weights = (z + 1) / 2, weights / 2
    around = 2 * np.pi * np.arange(16) / 16
    normal = np.stack(
        [np.outer(np.sqrt(1 - z**2), np.cos(around)),
         np.outer(np.sqrt(1 - z**2), np.sin(around)),
         np.outer(z, np.ones(16))], axis=-1,
    ).reshape(-1, 3)  # fmt: skip
    traction = np.einsum("kij,kj->ki", point_force_stress(normal, nu), normal)
    total = np.repeat(weights * 2 * np.pi / 16, 16) @ traction
    assert total == pytest.approx([0, 0, -1], abs=1e-12)


@pytest.mark.parametrize(
    ("keys", "message"),
    [
        ("load=100/dual", "the contact radius 1.398 is more than R/8 = 1"),
        ("nu=0.5/dual", "nu=0.5 must be between -1 and 0.5"),
        ("against=sphere/dual", "against='sphere' is unknown, expected 'plane'"),
        ("dual-bounds", "dual-bounds"),
        ("n=0/dual", "n=0 must be at least 1"),
    ],
)
def test_what_has_no_meaning_is_refused(keys, message):
    with pytest.raises(InputError, match=message):
        parse(f"hertz-sphere/{keys}", PROBLEMS).build(reference_solution)
