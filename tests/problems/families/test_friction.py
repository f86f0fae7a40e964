"""Friction: limits, digits of other codes, and the friction laws themselves."""

from functools import cache

import numpy as np
import pytest
from scipy.sparse import vstack

from mortarbench.harness import InputError
from mortarbench.harness.names import parse
from mortarbench.harness.verify.kkt import kkt_residuals
from mortarbench.problems import PROBLEMS
from mortarbench.problems.contact.balance import check_balance
from mortarbench.problems.contact.friction import FrictionLaw
from mortarbench.problems.contact.linearise import linearisation
from mortarbench.problems.families.patch import model
from mortarbench.solvers.reference.solve import reference_solution
from tests.support import cases
from tests.support.incline import WEIGHT, block_on_incline, incline

pytestmark = pytest.mark.together

solved = cache(cases.solved)
SMALL = "beam-ring/Nr=3/Nh=2/steps=1"


# mu, tip_y in m, vertical force on the beam in 10⁸ N/m, sticking rows (8 are active)
DIGITS = [
    (0.1, -0.295871, 1.79947, 1),
    (0.3, -0.29546, 1.7963, 1),
    (0.6, -0.29495, 1.7938, 2),
]


@pytest.mark.slow
@pytest.mark.parametrize(("mu", "tip", "force", "stick"), DIGITS)
def test_coulomb_on_the_benchmark_has_the_digits_of_another_code(mu, tip, force, stick):
    _, _, values = solved(
        f"beam-ring/steps=1/relin=8/friction=coulomb/mu={mu}/dual-bounds"
    )

    assert values["tip"][1] == pytest.approx(tip, abs=6e-6)
    assert values["contact_force"][1] / 1e8 == pytest.approx(force, abs=6e-5)
    assert (values["stick"], values["slip"], values["open"]) == (stick, 8 - stick, 53)
    assert values["friction_residual"] <= 1e-10


@pytest.mark.slow
def test_an_unreachable_bound_lets_open_rows_carry_shear():
    """The expected tip deflection is that of the other code in the limit of infinite
    bounds, with all rows of the arc."""
    _, _, values = solved("beam-ring/steps=1/relin=8/friction=tresca/bound=1e15/dual")

    assert values["tip"][1] == pytest.approx(-0.24493, abs=6e-6)
    assert values["slip"] == 0
    assert values["stick"] == values["active"]
    assert values["sliding_without_contact"] > 0
    assert values["open"] < values["contact_rows"] - values["active"]


def test_shear_without_contact_is_counted_separately():
    """Every row of the arc is open, sticks, slips, or slides without contact."""
    case, s, values = solved("beam-ring/steps=1/friction=tresca/bound=1e6/dual")
    friction, rows = case.mechanics.friction, values["contact_rows"]
    states = ("open", "stick", "slip", "sliding_without_contact")
    assert sum(values[name] for name in states) == friction.bound.size

    z = case.mechanics.to_primal(s).z
    shear, pressed = np.abs(z[rows:]), z[:rows] > 1e-6 * z[:rows].max()
    apart = ~pressed[friction.row] & (shear > 1e-6 * np.abs(z).max())
    assert values["sliding_without_contact"] == apart.sum() > 0
    share = shear[apart].sum() / shear.sum()
    assert values["shear_without_contact"] == pytest.approx(share)
    assert 0 < share < 1

    (side,) = case.fields(s).contacts
    drawn = [name.replace("_", " ") for name in states]
    counts = [(side.friction == name).sum() for name in drawn]
    assert counts == [values[name] for name in states]


def test_coulombs_law_permits_no_shear_without_contact():
    _, _, values = solved("beam-ring/steps=1/friction=coulomb/mu=0.3/dual")
    assert values["sliding_without_contact"] == 0
    assert values["shear_without_contact"] == 0


@pytest.mark.parametrize("form", ["primal", "dual", "dual-bounds"])
@pytest.mark.parametrize(
    ("law", "contact"),
    [("tresca/bound=0", "mortar"), ("coulomb/mu=0", "nts"),
     pytest.param("tresca/bound=0", "nts", marks=pytest.mark.slow),
     pytest.param("coulomb/mu=0", "mortar", marks=pytest.mark.slow)],
)  # fmt: skip
def test_a_bound_of_zero_yields_the_frictionless_problem(law, contact, form):
    name = f"{SMALL}/contact={contact}"
    _, _, rough = solved(f"{name}/friction={law}/{form}")
    _, _, smooth = solved(f"{name}/{form}")

    for key in ("tip", "energy", "contact_force", "multiplier_sum", "active"):
        assert rough[key] == pytest.approx(smooth[key], rel=1e-7)
    assert (rough["dissipation"], rough["stick"]) == (0.0, 0)


@pytest.mark.parametrize(
    ("law", "contact"),
    [("tresca/bound=5e7", "nts"), ("tresca/bound=5e7/loading=static", "mortar"),
     ("coulomb/mu=0.3", "mortar"),
     *(pytest.param(*row, marks=pytest.mark.slow)
       for row in [("tresca/bound=5e7", "mortar"), ("coulomb/mu=0.3", "nts"),
                   ("tresca/bound=5e7/loading=static", "nts")])],
)  # fmt: skip
def test_every_form_is_the_same_problem(law, contact):
    name = f"{SMALL}/contact={contact}/friction={law}"
    forms = {
        form: solved(f"{name}/{form}") for form in ("primal", "dual", "dual-bounds")
    }
    case, s, primal = forms["primal"]

    for other, t, values in forms.values():
        assert kkt_residuals(other.qp, t).worst < 1e-7
        energy = other.scale * other.qp.objective(t.x) + other.constant
        assert energy == pytest.approx(
            values["energy"] + values["dissipation"], rel=1e-9
        )
        for key in ("energy", "tip", "dissipation", "stick", "slip", "open"):
            assert values[key] == pytest.approx(primal[key], rel=1e-6)
        u, v = other.recover(t), case.recover(s)
        assert u == pytest.approx(v, abs=1e-8 * abs(v).max())


@pytest.mark.parametrize("law", ["tresca/bound=5e7", "coulomb/mu=0.3"])
def test_friction_opposes_the_slip_and_only_at_its_bound(law):
    case, s, values = solved(f"{SMALL}/friction={law}/dual")
    friction, back = case.mechanics.friction, case.mechanics.to_primal(s)
    force = back.z[case.mechanics.primal.h.size :]
    slip = friction.T @ back.x - friction.start
    slips = abs(slip) > 1e-9 * abs(slip).max()

    assert (abs(force) <= friction.bound * (1 + 1e-9)).all()
    assert force[slips] == pytest.approx(np.sign(slip)[slips] * friction.bound[slips])
    work = (friction.bound * abs(slip)).sum() * case.scale
    assert abs(work) == pytest.approx(values["dissipation"], rel=1e-6)


@pytest.mark.parametrize("basis", ["dual", "standard"])
@pytest.mark.parametrize("contact", ["nts", "mortar"])
def test_a_bound_is_the_traction_times_the_share_of_the_node(contact, basis):
    case = parse(
        f"contact-patch/contact={contact}/basis={basis}/friction=tresca/bound=2e5"
        "/primal",
        PROBLEMS,
    ).build(reference_solution)
    share = np.array([1, 2, 2, 2, 1]) / 8  # shares of a side of 1 m with four cells

    assert case.mechanics.friction.bound * 1e6 == pytest.approx(2e5 * share)


@pytest.mark.parametrize("contact", ["nts", "mortar"])
def test_tangential_rows_vanish_on_common_motions_of_both_sides(contact):
    bodies = model(PROBLEMS["contact-patch"])
    law = (FrictionLaw("tresca", bound=1.0),)
    rows = linearisation(bodies, contact, "dual", law)(np.zeros(bodies.mesh.dofs))
    along = np.tile([1.0, 0.0], len(bodies.mesh.points))
    slave = np.zeros_like(along)
    slave[2 * bodies.pairs[0].slave] = 1.0

    assert abs(rows.T @ along).max() < 1e-14
    assert abs(rows.T @ slave) == pytest.approx(1.0)
    assert abs(rows.B @ slave).max() < 1e-14


@pytest.mark.parametrize("law", ["tresca/bound=1e6", "coulomb/mu=0.5"])
@pytest.mark.parametrize("basis", ["dual", "standard"])
def test_friction_makes_no_difference_to_a_uniform_pressure_on_one_material(basis, law):
    name = f"contact-patch/basis={basis}/friction={law}/dual"

    assert solved(name)[2]["stress_error"] <= 1e-10
    assert solved(name)[2]["slip"] == 0


COULOMB = FrictionLaw("coulomb", mu=0.3)


def test_a_block_on_an_incline_slips_at_its_limit():
    """NAFEMS benchmark CGS-4: F/G = (tan α + mu)/(1 − mu tan α), tan α = 0.1,
    mu = 0.3."""
    limit = 0.412371
    case = block_on_incline(limit - 4e-4, COULOMB)
    values = case.quantities(reference_solution(case.qp))
    across, onto = values["contact_force"]

    assert values["stick"] > 0
    assert across / -onto == pytest.approx(0.3, abs=1e-3)
    message = (
        r"load step 1: no equilibrium was found.* friction cannot hold the load; exp"
    )
    with pytest.raises(InputError, match=message):
        block_on_incline(limit + 4e-4, COULOMB)


@pytest.mark.parametrize("share", [0.99, 1.01])
def test_a_bound_of_tresca_below_the_load_along_the_side_is_refused(share):
    """On a block of 1 m length, friction balances at most the bound times 1 m."""
    across = (0.2 - 0.1) / np.hypot(1, 0.1) * WEIGHT
    law = FrictionLaw("tresca", bound=share * across)
    if share > 1:
        built = block_on_incline(0.2, law)
        got = built.quantities(reference_solution(built.qp))["contact_force"]
        assert abs(got[0]) == pytest.approx(across, rel=1e-6)
        return
    message = (
        r"friction cannot hold the load: 0\.\d\d% of the load remains unbalanced within"
    )
    with pytest.raises(InputError, match=message):
        block_on_incline(0.2, law)


def test_friction_may_balance_loads():
    """The balance is checked as for the family `bodies`; without friction, the block
    slides."""
    bodies = incline(0.3)
    rows = linearisation(bodies, "nts", "dual", (COULOMB,))(np.zeros(bodies.mesh.dofs))

    check_balance(bodies, vstack([rows.B, rows.T, -rows.T]))
    with pytest.raises(InputError, match="'block': nothing balances its load in x"):
        check_balance(bodies, rows.B)


@pytest.mark.parametrize("push", [0.2, -0.1])
def test_below_the_limit_forces_do_not_depend_on_the_law(push):
    """The contact forces are statically determinate."""
    normal = (1 + 0.1 * push) / np.hypot(1, 0.1) * WEIGHT
    for law in (COULOMB, FrictionLaw("tresca", bound=0.5 * WEIGHT)):
        case = block_on_incline(push, law)
        values = case.quantities(reference_solution(case.qp))

        assert values["multiplier_sum"] == pytest.approx(normal, rel=1e-9)
        assert values["contact_force"][0] == pytest.approx(
            (push - 0.1) / np.hypot(1, 0.1) * WEIGHT, rel=1e-7
        )


def test_quasi_static_slip_starts_from_the_previous_step():
    """The load grows in two equal steps; with loading=static, the first step has no
    effect on the second."""
    name = f"{SMALL.replace('steps=1', 'steps=2')}/friction=tresca/bound=5e7"
    first, _, _ = solved(f"{name}/step=1/primal")
    path, s, _ = solved(f"{name}/primal")
    static, _, _ = solved(f"{name}/loading=static/primal")
    before = reference_solution(first.qp).x[: first.mechanics.primal.q.size]
    friction = path.mechanics.friction

    assert friction.start == pytest.approx(friction.T @ before, abs=1e-9)
    assert abs(friction.start).max() > 1e-3
    assert (static.mechanics.friction.start == 0).all()
    assert kkt_residuals(path.qp, s).worst < 1e-9
