"""The cantilever at finite strain: elastica, convergence, rejected keys."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.optimize import brentq

import mortarbench as mb
from mortarbench.harness import InputError, no_rows
from mortarbench.problems.contact.bodies import factorise_clamped
from mortarbench.problems.contact.rows import ContactRows
from mortarbench.problems.duality.newton_case import newton_path
from mortarbench.problems.families.cantilever import beam, elastica


@pytest.mark.parametrize(
    ("load", "deflection", "shortening"),
    [(1, 0.30172077, 0.05643324), (10, 0.81060902, 0.55499560)],
)
def test_the_elastica_has_published_digits(load, deflection, shortening):
    assert elastica(load) == pytest.approx((deflection, shortening), abs=6e-9)


@pytest.mark.parametrize("load", [0.01, 3.0, 80.0])
def test_the_elastica_solves_its_differential_equation(load):
    """EIθ″ = −P cos θ is solved by a Runge-Kutta method; θ′(0) is chosen so that
    θ′(L) = 0."""

    def along(moment):
        return solve_ivp(
            lambda s, y: [y[1], -load * np.cos(y[0]), np.sin(y[0]), np.cos(y[0])],
            (0, 1), [0, moment, 0, 0], rtol=1e-10, atol=1e-12,
        ).y[:, -1]  # fmt: skip

    moment = brentq(lambda m: along(m)[1], 0, min(1.001 * load, np.sqrt(2 * load)))
    _, _, down, forwards = along(moment)

    assert elastica(load) == pytest.approx((down, 1 - forwards), rel=1e-6)


def emitted(name):
    case = mb.build(name)
    return case, mb.solve(case, "smalbe" if "dual" in name else "clarabel", tol=1e-9)


@pytest.mark.parametrize(
    ("load", "ny"), [pytest.param(1, 8, marks=pytest.mark.slow), (10, 4)]
)
def test_the_tip_of_a_slender_beam_agrees_with_the_elastica(load, ny):
    _, answer = emitted(f"cantilever/load={load}/ny={ny}/dual")

    assert answer.verdict == "verified"
    values = answer.quantities
    assert abs(values["deflection_error"]) < 0.01
    assert abs(values["shortening_error"]) < 0.01
    assert values["clipped_in_step"] == 0
    assert values["load_parts"] == 1
    assert values["residual"] < 1e-8


@pytest.mark.parametrize("material", ["neo-hooke", "svk"])
def test_newton_converges_quadratically(material):
    """In the energy norm, each relative error is at most 30 times the square of its
    predecessor.

    This holds in the last four iterations, where the step length is 1.
    """
    bodies = beam(4.0, 2.0, (16, 4), 0.3)
    path = newton_path(bodies, no_contact(bodies), None, material=material)

    iterations = path.iterations(1)

    end, K = iterations[-1].answer.x, iterations[-1].primal.P
    errors = [np.sqrt((at.u - end) @ (K @ (at.u - end))) for at in iterations]
    errors = np.array(errors) / np.sqrt(end @ (K @ end))
    assert errors[-1] < 1e-6
    assert (errors[-4:] < 30 * errors[-5:-1] ** 2).all()
    assert [at.length for at in iterations[-4:]] == [1, 1, 1, 1]


def test_deflections_converge_with_the_square_of_the_size_of_cells():
    ends = [
        emitted(f"cantilever/slenderness=8/load=3/ny={n}/nx={12 * n}/dual")[1]
        .quantities["deflection"]
        for n in (2, 4, 8)
    ]  # fmt: skip

    coarse, fine = np.diff(ends)

    assert 1.8 < np.log2(coarse / fine) < 2.2


def test_nearly_incompressible_beams_do_not_lock():
    """Full integration would increase the stiffness by the fraction ν²/(1 − 2ν)/ny²."""
    _, answer = emitted("cantilever/nu=0.49/ny=3/slenderness=10/load=1/dual")

    assert abs(answer.quantities["deflection_error"]) < 0.06


def test_every_iteration_is_a_convex_qp_in_the_total_displacement():
    """Hessians are positive definite, and each QP is linearised at the end of the
    preceding line search."""
    bodies = beam(6.0, 5.0, (24, 2), 0.3)
    path = newton_path(bodies, no_contact(bodies), None, material="neo-hooke")

    iterations = path.iterations(1)

    assert len(iterations) > 3
    for at, following in zip(iterations, iterations[1:] + iterations[-1:], strict=True):
        P = at.primal.P.toarray()
        assert (P == P.T).all()
        assert np.linalg.eigvalsh(P)[0] > 0
        step = at.length * (at.answer.x - at.u)
        assert following is at or np.allclose(following.u, at.u + step, atol=1e-14)


def test_all_forms_define_the_same_iteration():
    name = "cantilever/slenderness=4/ny=2/load=2/newton=2"
    primal, dual = (emitted(f"{name}/{form}") for form in ("primal", "dual"))

    u, v = (
        case.family_case.recover(answer.solution) for case, answer in (primal, dual)
    )

    assert np.abs(u - v).max() < 1e-6 * np.abs(u).max()
    assert primal[1].quantities["newton"] == 2
    with pytest.raises(
        InputError, match=r"newton=99: step 1 has \d+ Newton iterations"
    ):
        mb.build("cantilever/slenderness=4/ny=2/load=2/newton=99/primal")


def test_for_small_loads_finite_and_linear_displacements_differ_by_their_square():
    differences = []
    for load in (0.02, 0.01):
        bodies = beam(6.0, load, (12, 2), 0.3)
        path = newton_path(bodies, no_contact(bodies), None, material="neo-hooke")
        linear = factorise_clamped(bodies)(bodies.f)
        differences.append(np.abs(path.iteration(1).answer.x - linear).max())

    assert np.log2(differences[0] / differences[1]) == pytest.approx(2, abs=0.01)


def no_contact(bodies):
    n, none = bodies.mesh.dofs, np.zeros(0, dtype=np.int64)
    rows = ContactRows(
        no_rows(n), np.zeros(0), no_rows(n), none, np.zeros(0), none, np.zeros(0), none
    )
    return lambda u: rows
