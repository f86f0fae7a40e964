"""Contact of half planes, compared with Hertz, Cattaneo and Mindlin."""

from itertools import pairwise

import numpy as np
import pytest
from scipy.integrate import quad

from mortarbench.harness.verify.kkt import kkt_residuals
from mortarbench.problems.families.half_plane import (
    EXACT,
    MU,
    Elements,
    HalfPlane,
    displacement,
    self_energy,
)
from mortarbench.problems.families.line_contact import TangentialContact
from mortarbench.solvers.reference.solve import reference_solution
from mortarbench.solvers.smalbe.solver import SMALBE

FAMILY = HalfPlane()
TOL = 1e-9


def result(solver=None, **keys):
    case = FAMILY.with_keys(**keys).build("dual", reference_solution)
    s = (solver or SMALBE()).prepare(case.qp, TOL)()
    assert kkt_residuals(case.qp, s).worst <= 10 * TOL
    return case.quantities(s)


def tangential(Q):
    return TangentialContact(EXACT, MU, Q)


@pytest.mark.parametrize(("Q", "c"), [(0.25, 0.866025), (0.5, 0.707107), (0.75, 0.5)])
def test_the_stick_zone_has_the_published_half_width(Q, c):
    assert tangential(Q).c / EXACT.a == pytest.approx(c, abs=5e-7)
    assert tangential(Q).traction(np.zeros(1)) == pytest.approx(
        MU * EXACT.p0 * (1 - tangential(Q).c / EXACT.a)
    )


@pytest.mark.parametrize("Q", [0.1, 0.4])
def test_the_exact_traction_adds_up_to_its_force_and_keeps_to_coulomb_s_law(Q):
    exact, a = tangential(Q), EXACT.a
    edges = [-a, -exact.c, exact.c, a]

    def moment(k):
        def f(t):
            return float(exact.traction(np.array([t]))[0]) * t**k

        pieces = pairwise(edges)
        return sum(quad(f, *piece, epsabs=0, epsrel=1e-8)[0] for piece in pieces)

    x = np.linspace(-a, a, 401)
    assert moment(0) == pytest.approx(Q * MU * EXACT.P, rel=1e-8)
    pressure = EXACT.P * a**2 / 4
    assert exact.stick_half_width(moment(2), pressure) == pytest.approx(exact.c, 1e-6)
    excess = np.abs(exact.traction(x)) - MU * EXACT.pressure(x)
    assert excess.max() <= 1e-12 * EXACT.p0
    c4 = (exact.c / a) ** 4
    assert moment(2) == pytest.approx(MU * EXACT.P * a**2 / 4 * (1 - c4), rel=1e-8)


def test_the_kernel_displaces_as_the_integral_of_the_logarithm():
    """Entries of F are integrals of −ln|x − t|; F is symmetric, and positive definite
    on an interval shorter than 4."""
    elements = Elements(8, 1.5)
    F, h = elements.F, elements.h

    for i, j in ((0, 0), (0, 1), (2, 7)):
        x, s = elements.middle[[i, j]]
        direct, _ = quad(
            lambda t, x=x: -np.log(abs(x - t)) / h, s - h / 2, s + h / 2, points=[x]
        )
        assert F[i, j] == pytest.approx(direct, rel=1e-9)
    assert (F == F.T).all()
    assert np.linalg.eigvalsh(F)[0] > 0.5


def test_exact_energies_are_those_of_integrals():
    """The energy is compared with ½qᵀFq on a fine grid; under Hertz's pressure,
    u = const − x²."""
    elements = Elements(1200, 1.0)
    share = np.diff(EXACT.force(EXACT.a * elements.ends)) / EXACT.P
    traction = tangential(0.5).traction(EXACT.a * elements.middle)
    q = traction * EXACT.a * elements.h / (MU * EXACT.P)

    inside = np.abs(elements.middle) < 0.9
    u = (elements.F @ share + elements.middle**2)[inside]
    assert u == pytest.approx(displacement(((1.0, 1.0),)), abs=1e-4)
    assert 0.5 * q @ elements.F @ q == pytest.approx(
        self_energy(tangential(0.5).semicircles), rel=1e-4
    )


@pytest.mark.parametrize("Q", [0.3, 0.6, 0.9])
def test_400_elements_have_the_shear_traction_of_cattaneo_and_mindlin(Q):
    got = result(n=400, law="cattaneo", Q=Q)

    assert got["shear_l2_error"] < 2.5e-3
    assert abs(got["shear_centre_error"]) < 1e-4
    assert abs(got["stick_half_width_error"]) < 1e-3
    assert abs(got["energy_error"]) < 1e-4
    assert got["stick"] + got["slip"] == 400
    assert got["stick"] / 400 == pytest.approx(np.sqrt(1 - Q), abs=5e-3)


@pytest.mark.parametrize(
    ("keys", "error"),
    [(dict(law="hertz"), "pressure_l2_error"),
     (dict(law="cattaneo", Q=0.3), "shear_l2_error"),
     (dict(law="cattaneo", Q=0.9), "shear_l2_error")],
    ids=str,
)  # fmt: skip
def test_tractions_converge_about_linearly_and_energies_quadratically(keys, error):
    """Rates are averages over four halvings, because the positions of c and a within
    their elements differ between grids."""
    coarse, fine = (result(n=n, **keys) for n in (50, 800))

    assert np.log2(coarse[error] / fine[error]) / 4 > 0.8
    assert np.log2(abs(coarse["energy_error"] / fine["energy_error"])) / 4 > 1.5


def test_400_elements_have_hertz_s_pressure():
    got = result(n=400)

    assert got["pressure_l2_error"] < 2.5e-3
    assert abs(got["p_max_error"]) < 1e-4
    assert abs(got["half_width_error"]) < 1e-4
    assert abs(got["approach_error"]) < 1e-4
    assert got["active"] == pytest.approx(400 / 1.5, abs=2)


def test_dissipation_is_the_work_of_the_force_less_the_stored_energy():
    Q = np.linspace(0, 0.8, 201)
    unit = MU * EXACT.P * 2 * MU * EXACT.P / (np.pi * EXACT.E_star)
    work = np.trapezoid(Q, [displacement(tangential(q).semicircles) for q in Q])
    stored = self_energy(tangential(0.8).semicircles)
    got = result(n=200, law="cattaneo", Q=0.8)["dissipation"]

    assert got == pytest.approx((work - stored) * unit, rel=2e-3)
