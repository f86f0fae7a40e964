"""GRECO's plate: published digits, and digits of an independent prototype."""

from functools import cache

import numpy as np
import pytest

from mortarbench.harness.verify.kkt import kkt_residuals
from mortarbench.problems.families.greco import PUBLISHED, Greco
from mortarbench.solvers.reference.solve import reference_solution
from mortarbench.solvers.smalbe.solver import SMALBE

pytestmark = pytest.mark.together

FAMILY = Greco()

#: cells per side → u_x at x = 0, 1.25, 5, 7.5 and 11.25 mm in 10⁻⁵ m, and normal force
#: at x = 38.75 mm in N/m
PROTOTYPE = {
    32: ([2.85944, 2.72168, 2.28500, 1.97963, 1.54056], 1.04823e5),
    128: ([2.86022, 2.72250, 2.28669, 1.98067, 1.54134], 2.62061e4),
}


@cache
def solved(n, form="dual-bounds", tol=1e-10, **keys):
    case = FAMILY.with_keys(n=n, **keys).build(form, reference_solution)
    s = SMALBE().prepare(case.qp, tol)()
    assert kkt_residuals(case.qp, s).worst <= 10 * tol
    return case, s


@pytest.mark.parametrize("n", [32, pytest.param(128, marks=pytest.mark.slow)])
def test_the_result_has_the_digits_of_the_prototype(n):
    case, s = solved(n)
    got = case.quantities(s)
    displacement, force = PROTOTYPE[n]

    assert got["displacement"] == pytest.approx(np.multiply(1e-5, displacement), 3e-6)
    assert got["normal_force"] == pytest.approx(force, rel=5e-6)
    assert got["published_error"] < 0.05
    assert got["friction_residual"] < 1e-6
    if n == 32:
        assert [got[k] for k in ("open", "slip", "stick")] == [3, 21, 8]
        assert got["tangential_sum"] == pytest.approx(1.4053764e6, rel=5e-8)
        assert got["normal_force"] == pytest.approx(1.04864e5, rel=5e-4)  # published


def test_the_plate_sticks_from_30_mm_on_and_slips_towards_plus_x():
    case, s = solved(32)
    u = case.recover(s)
    bottom = u[0 : 2 * 33 : 2]  # the first row of nodes

    assert abs(bottom[24:]).max() < 1e-12
    assert (bottom[:24] > 1e-9).all()
    assert bottom[0] == pytest.approx(PUBLISHED[0], rel=0.05)


def test_forces_are_in_equilibrium():
    """Contact forces and the reactions at the supports balance the load in x and y."""
    case, s = solved(8)
    got, reaction = case.quantities(s), case.mechanics.to_primal(s).y * 5e7 * 0.04
    fx, fy = got["contact_force"]

    assert 15e7 * 0.04 + fx - reaction[:9].sum() == pytest.approx(0, abs=1)
    assert -5e7 * 0.04 + fy - reaction[9] == pytest.approx(0, abs=1)
    assert fx < 0 < fy


def test_every_form_has_the_same_answer():
    energies = []
    for form in FAMILY.forms:
        case = FAMILY.with_keys(n=4).build(form, reference_solution)
        s = reference_solution(case.qp)
        got = case.quantities(s)
        objective = case.scale * case.qp.objective(s.x) + case.constant
        assert objective == pytest.approx(got["energy"] + got["dissipation"], rel=1e-9)
        energies.append(got["energy"])

    assert energies == pytest.approx(energies[:1] * 3, rel=1e-8)


def test_without_friction_there_is_no_tangential_force():
    got = solved(8, mu=0.0)[0].quantities(solved(8, mu=0.0)[1])

    assert got["tangential_sum"] == 0
    assert got["dissipation"] == 0


@pytest.mark.parametrize(
    ("n", "depth"), [(4, 2), pytest.param(8, 2, marks=pytest.mark.slow)]
)
@pytest.mark.parametrize(
    "form", [pytest.param("primal", marks=pytest.mark.slow), "dual", "dual-bounds"]
)
def test_every_layer_of_the_extruded_plate_is_the_plane_one(n, depth, form):
    points, states, u = [], [], []
    for keys in ({}, {"dim": 3, "depth": depth}):
        configured = FAMILY.with_keys(n=n, **keys)
        case = configured.build(form, reference_solution)
        s = reference_solution(case.qp)
        fields, values = case.fields(s), case.quantities(s)
        (side,) = fields.contacts
        points.append((fields.points, fields.points[side.nodes]))
        states.append((side.friction, values))
        u.append(fields.displacement)
    (plane, ground), (space, layers) = points
    # for each node of the 3D mesh, the node of the plane mesh with equal x and y
    below = np.array([np.abs(plane - x[:2]).sum(axis=1).argmin() for x in space])

    assert abs(u[1][:, :2] - u[0][below]).max() < 1e-8 * abs(u[0]).max()
    assert abs(u[1][:, 2]).max() < 1e-8 * abs(u[0]).max()
    for z in np.unique(layers[:, 2]):
        x = layers[layers[:, 2] == z]
        order = np.argsort(x[:, 0])[: len(ground)]  # the corner has no contact row
        layer = states[1][0][layers[:, 2] == z][order]
        assert layer.tolist() == states[0][0][np.argsort(ground[:, 0])].tolist()
    for name in ("normal_force", "tangential_sum", "published_error"):
        assert states[1][1][name] == pytest.approx(states[0][1][name], rel=1e-8)
