"""Certificates of solver answers, and of bodies that only contact supports."""

from dataclasses import replace
from fractions import Fraction

import numpy as np
import pytest

from mortarbench.harness import Solution, Status, certify
from mortarbench.harness.files.store import write_point
from mortarbench.harness.mechanics import Real, cancelling
from mortarbench.harness.names import parse
from mortarbench.harness.processes import cases
from mortarbench.harness.processes.cases import Cases
from mortarbench.harness.verify import admissible as module
from mortarbench.harness.verify.admissible import admissible
from mortarbench.harness.verify.kkt import kkt_residuals
from mortarbench.harness.verify.verdicts import results_of
from mortarbench.problems import PROBLEMS
from mortarbench.solvers import SOLVERS
from mortarbench.solvers.reference.solve import reference_solution
from tests.support.supported_by_contact import disc_between_plates

pytestmark = pytest.mark.together


@pytest.mark.parametrize(
    "name",
    [
        "hertz-cylinder/dual",  # forces of supports dominate the scale of the gradient
        "hertz-cylinder/slave=lower/dual",
        "beam-ring/Nr=8/Nh=4/step=1/dual",
        "obstacle/n=10/dual-bounds",
    ],
)
def test_smalbe_at_tol_1e_8_reaches_six_digits_in_energy_norm(name):
    case = parse(name, PROBLEMS).build(reference_solution)
    s = SOLVERS["smalbe"].prepare(case.qp, 1e-8)()
    assert certify(case.mechanics, case.mechanics.to_primal(s)).bound <= 1e-6


def test_equal_points_are_certified_once_and_others_again(tmp_path, monkeypatch):
    calls = []

    def counted(case, s):
        calls.append(s)
        return results_of(case, s)

    monkeypatch.setattr(cases, "results_of", counted)
    name = parse("beam-ring/Nr=4/Nh=3/step=1/dual", PROBLEMS)
    of = {"family": "beam-ring", "params": dict(name.params), "form": name.form}
    at = {
        "describe": {**of, "name": str(name)},
        "point": str(tmp_path / "s.npz"),
        "fields": None,
        "keep": 1,
    }
    made = Cases(PROBLEMS, reference_solution)
    qp = name.build(reference_solution).qp
    s = SOLVERS["clarabel"].prepare(qp, 1e-8)()

    def bounds(point):
        write_point(tmp_path / "s.npz", point)
        return made.answer(dict(at))["fields"]

    first, again = bounds(s), bounds(s)
    other = bounds(replace(s, x=s.x * (1 + 1e-3)))

    assert len(calls) == 2
    assert first["certify_seconds"] > 0
    assert again == first
    assert other["energy_bound"] > 10 * first["energy_bound"]


@pytest.mark.parametrize("form", ["primal", "dual"])
@pytest.mark.parametrize("tilt", [0.0, 0.5])
@pytest.mark.parametrize("contact", ["nts", "mortar"])
def test_a_disc_between_plates_is_certified_to_six_digits(form, tilt, contact):
    """Contact resists neither sliding nor, with node-to-segment rows, rolling of the
    disc.
    """
    case = disc_between_plates(
        8, form=form, tilt=tilt, contact=contact, disc_is_slave=contact == "nts"
    )
    s = SOLVERS["piqp"].prepare(case.qp, 1e-10)()
    assert kkt_residuals(case.qp, s).worst < 1e-9
    found = certify(case.mechanics, case.mechanics.to_primal(s))
    assert found.bound <= 1e-6
    assert found.seminorm


@pytest.mark.parametrize("solver", ["smalbe", "piqp"])
@pytest.mark.parametrize(
    ("contact", "basis"), [("nts", "dual"), ("mortar", "dual"), ("mortar", "standard")]
)
def test_a_free_plate_on_a_disc_rests_on_no_row_at_the_end_of_the_arc(
    contact, basis, solver
):
    """Rows near the contact balance the load, so that distant rows have no force."""
    form = "dual" if solver == "smalbe" else "primal"
    case = disc_between_plates(9, form=form, contact=contact, basis=basis)
    s = SOLVERS[solver].prepare(case.qp, 1e-8)()
    at = case.mechanics.to_primal(s)
    far = case.mechanics.primal.h > 0.05  # rows with a large initial gap

    assert s.status is Status.SOLVED
    assert certify(case.mechanics, at).bound <= 1e-6
    assert far.sum() >= 4
    assert at.z[far].max() <= 1e-8 * at.z.max()


def test_contact_rows_vanish_only_on_sliding():
    """Each of two bodies has three rigid motions, of which only sliding is free.

    If the disc is the master of node-to-segment rows, it is a polygon, and its rows
    resist all motions.
    """
    for tilt in (0.0, 0.5, 1.0):
        motions = disc_between_plates(tilt=tilt).mechanics.motions
        assert (motions.constrained.shape[1], motions.free.shape[1]) == (4, 2)
    motions = disc_between_plates(disc_is_slave=False).mechanics.motions
    assert (motions.constrained.shape[1], motions.free.shape[1]) == (6, 0)


def test_products_of_a_stored_matrix_with_rigid_motions_are_exact():
    mechanics = disc_between_plates().mechanics
    K, R = mechanics.primal.P.toarray(), mechanics.inverse.kernel[:, :1]
    found = cancelling(mechanics.primal.P.tocsr(), R.astype(Real))[:, 0]
    for i in range(60, 90):
        terms = [Fraction(a) * Fraction(b) for a, b in zip(K[i], R[:, 0], strict=True)]
        exact = sum(terms)
        error = abs(
            Fraction(float(found[i]))
            + Fraction(float(found[i] - float(found[i])))
            - exact
        )
        assert error <= Fraction(1, 2**80) * sum(map(abs, terms))


def test_a_single_motion_that_only_contact_stops_leaves_a_seminorm():
    case = parse("hertz-cylinder/n=2/m=2/primal", PROBLEMS).build(reference_solution)
    mechanics = case.mechanics
    x, z, none = *map(np.zeros_like, (case.qp.q, case.qp.h)), np.zeros(0)
    s = Solution(status=Status.SOLVED, x=x, y=none, z=z, z_box=x)

    assert mechanics.motions.all.shape[1] == 1
    assert certify(mechanics, s).seminorm


def test_motions_that_change_no_gap_are_removed():
    mechanics = disc_between_plates().mechanics
    free = mechanics.motions.free
    none = np.zeros(mechanics.exact.c.size, dtype=bool)
    found = admissible(mechanics, free @ np.array([1e-3, 2e-3], dtype=Real), none)

    assert np.abs(free.T @ found).max() <= 1e-18


def test_iterations_for_many_rows_agree_with_a_factorisation(monkeypatch):
    """Only contact supports the disc; the nodes move by about a millimetre."""
    mechanics = disc_between_plates().mechanics
    rng = np.random.default_rng(161803)
    u = 1e-3 * rng.standard_normal(mechanics.exact.f.size).astype(Real)
    none = np.zeros(mechanics.exact.c.size, dtype=bool)
    by_factor = admissible(mechanics, u, none)
    monkeypatch.setattr(module, "MAX_DENSE_ROWS", 2)
    by_iterations = admissible(mechanics, u, none)

    far = mechanics.norm(by_factor - u)
    assert far > 0
    assert mechanics.norm(by_iterations - by_factor) <= 1e-4 * far
    assert (mechanics.exact.B @ by_iterations <= mechanics.exact.c).all()
