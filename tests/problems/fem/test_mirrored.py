"""Invariance of cases under reflection and change of units."""

from functools import cache

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.sparse import diags_array

from mortarbench.problems.contact.bodies import (
    ContactPair,
    assemble,
    factorise_clamped,
)
from mortarbench.problems.contact.linearise import linearisation
from mortarbench.problems.contact.results import quantities
from mortarbench.problems.contact.stepping import load_steps
from mortarbench.problems.duality.case_forms import contact_case
from mortarbench.problems.duality.monolithic import load_path as monolithic_path
from mortarbench.problems.duality.monolithic import recovered
from mortarbench.problems.families.beam_ring import model
from mortarbench.solvers.reference.solve import reference_solution
from mortarbench.solvers.smalbe.solver import SMALBE

pytestmark = pytest.mark.together

METHODS = [("nts", "dual"), ("mortar", "dual"), ("mortar", "standard")]
STEPS = 3
every_method = pytest.mark.parametrize(("contact", "basis"), METHODS)


def again(bodies, *, units=None, mesh=None, pairs=None, load=None):
    """Assemble the bodies again, with some arguments replaced."""
    return assemble(
        mesh or bodies.mesh, bodies.body, names=bodies.names,
        materials=bodies.materials, plane=bodies.plane,
        units=units or (bodies.length, bodies.force), fixed=bodies.fixed,
        load=bodies.f * bodies.force if load is None else load,
        pairs=pairs or bodies.pairs,
    )  # fmt: skip


@cache
def mirrored(bodies, about):
    """Return the bodies reflected about the line x = `about`, m.

    Reflection reverses orientations; hence cells and chains are reversed.
    """
    mesh, flip = bodies.mesh, sign(bodies)
    points = mesh.points * [-1, 1] + [2 * about, 0]
    sides = {name: chain[::-1] for name, chain in mesh.boundaries.items()}
    return again(
        bodies, mesh=type(mesh)(points, mesh.cells[:, ::-1], sides),
        load=flip * bodies.f * bodies.force,
        pairs=tuple(
            ContactPair(*(side[::-1] for side in p.sides)) for p in bodies.pairs
        ),
    )  # fmt: skip


def sign(bodies):
    return np.tile([-1.0, 1.0], len(bodies.mesh.points))


@cache
def load_path(bodies, contact, basis, relin=1):
    linearise = linearisation(bodies, contact, basis)
    return monolithic_path(
        bodies, load_steps(STEPS, relin, bodies.f, bodies.fixed),
        lambda _: linearise, lambda _: factorise_clamped(bodies), reference_solution,
    )  # fmt: skip


def displacement(path, k):
    return recovered(path.problem(k)).x


@cache
def results(bodies, contact, basis, form):
    """Solve the QP of the last step in `form`; return u in m, and SI quantities."""
    last = load_path(bodies, contact, basis).problem(STEPS).problem
    primal, rows = last.primal, last.rows
    case = contact_case(
        bodies, primal, rows, form,
        quantities=lambda s: quantities(bodies, primal, s, rows),
    )  # fmt: skip
    s = SMALBE().prepare(case.qp, 1e-12)()
    values = dict(case.quantities(s))
    (push, values["up"]), stress = (
        values.pop("contact_force"),
        values.pop("max_von_mises"),
    )
    (pair,) = values.pop("contacts").values()
    values |= stress | {
        "pressure": pair["largest_pressure"],
        "sideways": abs(push),
        "objective": case.scale * case.qp.objective(s.x) + case.constant,
    }
    return case.recover(s), values


@pytest.fixture(scope="module", params=["strain", "stress"])
def bodies(request):
    return model(4, 3, 4, request.param)


def kinked(bodies):
    """Return a displacement that bends the beam into a V whose tip is the closest point
    to several nodes."""
    u = np.zeros((len(bodies.mesh.points), 2))
    beam = bodies.body_of_node == 0
    u[beam, 1] = 2 * abs(bodies.mesh.points[beam, 0] - 1.0625)
    return u.ravel()


@every_method
@pytest.mark.parametrize("about", [1.0, -3.7])
@pytest.mark.parametrize("state", ["loaded", "kinked"])
def test_contact_rows_are_mirrored(bodies, contact, basis, about, state):
    """Closest points are inside segments after sliding, or at the tip of a V."""
    there, flip = mirrored(bodies, about), sign(bodies)
    loaded = displacement(load_path(bodies, contact, basis), 1) * bodies.length
    u = loaded if state == "loaded" else kinked(bodies)
    here, other = (
        linearisation(b, contact, basis)(v) for b, v in ((bodies, u), (there, flip * u))
    )

    assert here.B.shape == other.B.shape
    assert abs(here.B @ diags_array(flip) - other.B[::-1]).max() <= 1e-11
    assert here.c == pytest.approx(other.c[::-1], abs=1e-12)


@every_method
@pytest.mark.parametrize("relin", [pytest.param(1, marks=pytest.mark.slow), 2])
def test_the_mirrored_path_is_the_mirror_of_the_path(bodies, contact, basis, relin):
    there = mirrored(bodies, 1.0)
    here, other = (load_path(b, contact, basis, relin) for b in (bodies, there))

    for k in range(1, STEPS + 1):
        u, v = displacement(here, k), displacement(other, k)
        assert_allclose(v, sign(bodies) * u, rtol=0, atol=1e-10 * abs(u).max())


@every_method
@pytest.mark.parametrize("form", ["dual", "dual-bounds"])
def test_energies_and_forces_are_those_of_the_mirror(bodies, contact, basis, form):
    (u, here), (v, other) = (
        results(b, contact, basis, form) for b in (bodies, mirrored(bodies, 1.0))
    )

    assert_allclose(v, sign(bodies) * u, rtol=0, atol=1e-8 * abs(u).max())
    assert other == pytest.approx(here, rel=1e-8)
    assert here["energy"] == pytest.approx(here["objective"], rel=1e-9)
    assert here["up"] > bodies.force  # the ring supports the beam


#: units of length and of force per thickness: SI; mm, N/mm; m, GN/m; in, lbf/in
UNITS = [(1.0, 1.0), (1e-3, 1e3), (1.0, 1e9), (0.0254, 4.4482216 / 0.0254)]


@cache
def measured(units=None):
    """Return the bodies of a small benchmark, optionally with other units."""
    return again(measured(), units=units) if units else model(4, 3, 4, "strain")


@every_method
@pytest.mark.parametrize("form", ["dual", "dual-bounds"])
@pytest.mark.parametrize(
    "units",
    [pytest.param(u, marks=[pytest.mark.slow] * (u not in UNITS[1:3])) for u in UNITS],
    ids=str,
)
def test_units_of_the_qp_change_no_physical_result(contact, basis, form, units):
    bodies, other = measured(), measured(units)
    (u, here), (v, there) = (results(b, contact, basis, form) for b in (bodies, other))

    factor = (bodies.force / bodies.length) / (units[1] / units[0])
    assert abs(other.K - factor * bodies.K).max() <= 1e-14 * abs(other.K).max()
    assert_allclose(v, u, rtol=0, atol=1e-9 * abs(u).max())
    assert there == pytest.approx(here, rel=1e-8)
