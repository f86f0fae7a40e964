"""Duals of torn bodies, compared with the solutions of undecomposed bodies."""

from dataclasses import replace

import numpy as np
import pytest

from mortarbench.harness.mechanics import NO_FRICTION
from mortarbench.harness.verify.kkt import kkt_residuals
from mortarbench.problems.contact.bodies import factorise_floating
from mortarbench.problems.contact.friction import FrictionLaw, friction_of
from mortarbench.problems.contact.linearise import linearisation
from mortarbench.problems.duality.dualisation import dualise
from mortarbench.problems.duality.feti_dual import feti_dual
from mortarbench.problems.duality.monolithic import primal_qp
from mortarbench.problems.families.beam_ring import model
from mortarbench.problems.feti.tearing import blocks
from mortarbench.solvers.reference.solve import reference_solution
from tests.support.decomposed_bodies import decompose_by_labels, labelled

GLUING = ("orthonormal", "redundant")
BODIES = model(2, 2, 4, "strain")


def posed(law):
    laws = (FrictionLaw("tresca", bound=law),) if law else ()
    at_rest = np.zeros(BODIES.mesh.dofs)
    rows = linearisation(BODIES, "mortar", "dual", laws)(at_rest)
    primal = primal_qp(BODIES, rows)
    if not law:
        return primal, NO_FRICTION
    return primal, friction_of(BODIES, rows, laws, at_rest, np.zeros(25))


def dual_of(primal, friction, rows):
    beam = blocks((16, 2), 2)
    label = np.append(beam, beam.max() + 1 + blocks((24, 4), 2))
    pair = decompose_by_labels(BODIES, labelled(BODIES, label), primal, friction, rows)
    return pair, feti_dual(pair, primal, friction)


def assembled(qp):
    return replace(qp, P=qp.P @ np.eye(qp.q.size), A=qp.A.toarray())


@pytest.mark.parametrize(
    ("rows", "law"),
    [
        pytest.param(
            rows, law, id=f"{rows}-{'tresca' if law else 'smooth'}",
            marks=[pytest.mark.slow] * ((rows == "orthonormal") == (law > 0)),
        )
        for rows in GLUING for law in (0.0, 3e8)
    ],
)  # fmt: skip
def test_the_solution_is_that_of_the_undecomposed_body(rows, law):
    primal, friction = posed(law)
    _, torn_apart = dual_of(primal, friction, rows)
    whole = dualise(primal, factorise_floating(BODIES), friction=friction)
    s = reference_solution(assembled(torn_apart.qp))
    found, expected = (
        torn_apart.recover(s), whole.recover(reference_solution(whole.qp)),
    )  # fmt: skip

    assert found.x == pytest.approx(expected.x, abs=1e-10 * abs(expected.x).max())
    assert found.y == pytest.approx(expected.y, abs=1e-9 * abs(expected.y).max())
    assert found.z == pytest.approx(expected.z, abs=1e-9 * abs(expected.z).max())
    assert torn_apart.interface_displacement(s) == pytest.approx(found.x)
    if not law:
        assert kkt_residuals(primal, found).worst < 1e-9
    else:
        sliding = abs(found.z[primal.h.size :]) > friction.bound * (1 - 1e-6)
        assert sliding.any()
        assert not sliding.all()


@pytest.mark.parametrize("law", [0.0, 3e8], ids=["smooth", "tresca"])
def test_the_objective_and_its_constant_are_the_energy(law):
    primal, friction = posed(law)
    _, new = dual_of(primal, friction, "orthonormal")
    s = reference_solution(assembled(new.qp))
    u = new.recover(s).x
    work = friction.bound @ abs(friction.T @ u - friction.start) if law else 0.0

    energy = new.sign * new.qp.objective(s.x) + new.constant
    assert energy == pytest.approx(primal.objective(u) + work, rel=1e-10)


def test_bounds_of_friction_are_scaled_like_its_rows():
    primal, friction = posed(3e8)
    pair, new = dual_of(primal, friction, "orthonormal")
    k, E = friction.bound.size, pair.torn.rows.equalities
    scale = pair.torn.problem.contact_scale

    assert (new.qp.lb[:E] == -np.inf).all()
    assert (new.qp.lb[E:-k] == 0).all()
    assert new.qp.ub[-k:] * scale[-k:] == pytest.approx(friction.bound)
    assert (new.qp.lb[-k:] == -new.qp.ub[-k:]).all()
