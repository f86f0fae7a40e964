"""String, journal bearing and torsion: published optima, closed forms, symmetries."""

import numpy as np
import pytest

from mortarbench.harness.verify.kkt import kkt_residuals
from mortarbench.problems.families.variational import JournalBearing, String, Torsion
from mortarbench.solvers.adapters.clarabel_ import Clarabel
from mortarbench.solvers.reference.solve import reference_solution
from mortarbench.solvers.smalbe.solver import SMALBE

TOL = 1e-9


def solved(family, solver=None, **keys):
    case = family.with_keys(**keys).build("primal", reference_solution)
    s = (solver or SMALBE()).prepare(case.qp, TOL)()
    assert kkt_residuals(case.qp, s).worst <= 10 * TOL
    return case, s


@pytest.mark.parametrize(
    ("points", "optimum"),
    [(4, -0.22474), (10, -0.17896), (23, -0.18005), (32, -0.18030), (75, -0.18055)],
)
def test_the_journal_bearing_has_its_published_optimum(points, optimum):
    """The optima are those of JNLBRNG1 of CUTEst, whose sizes include the boundary
    points."""
    case, s = solved(JournalBearing(), n=points - 2)

    assert case.quantities(s)["energy"] == pytest.approx(optimum, abs=6e-6)


def test_the_film_is_symmetric_and_has_pressure_where_it_narrows():
    """v(ξ, η) = v(ξ, 2b − η) ≥ 0; the coefficient −ε sin ξ of v in the cost is negative
    for ξ < π only, which makes v positive there."""
    n = 31
    _, s = solved(JournalBearing(), n=n, eccentricity=0.6)
    v = s.x.reshape(n, n)

    assert v[::-1] == pytest.approx(v, abs=1e-6)
    assert (v[:, : n // 2 - 1] > 0).all()
    assert (v[:, -n // 4 :] == 0).all()


def test_an_elastic_bar_has_saint_venant_s_stiffness():
    """For c < 2.96 no bound is active, and the energy is −½c² Σ 64/(π⁶i²k²(i² + k²))
    over odd i and k."""
    odd = np.arange(1, 200, 2.0)
    i, k = np.meshgrid(odd, odd)
    volume = (64 / (np.pi**6 * i**2 * k**2 * (i**2 + k**2))).sum()
    errors = []
    for n in (15, 31, 63):
        case, s = solved(Torsion(), n=n, twist=2.5)
        got = case.quantities(s)
        errors.append(got["energy"] / (-0.5 * 2.5**2 * volume) - 1)

        assert got["active"] == 0
    assert np.log2(np.divide(errors[:-1], errors[1:])) == pytest.approx(2, abs=0.05)


@pytest.mark.parametrize("twist", [1e4, 1e8])
def test_the_stress_function_of_a_plastic_bar_is_the_distance_to_the_boundary(twist):
    """v is the distance from the boundary: |∇v| = 1 except at the ridges, and the
    integral of v is ⅙."""
    n = 31
    case, s = solved(Torsion(), n=n, twist=twist)
    h, roof = 1 / (n + 1), case.qp.ub
    volume = roof.sum() * h**2

    assert s.x == pytest.approx(roof, rel=1e-12)
    assert volume == pytest.approx(1 / 6, rel=2 / n**2)
    assert case.quantities(s)["energy"] + twist * volume == pytest.approx(
        0.5, rel=2 / n
    )


def test_a_bar_twisted_in_reverse_has_the_mirrored_solution():
    """If c changes sign, v changes sign, and the opposite bound is active."""
    case, s = solved(Torsion(), n=20)
    qp = case.qp
    back = SMALBE().prepare(type(qp)(
        P=qp.P, q=-qp.q, A=qp.A, b=qp.b, G=qp.G, h=qp.h, lb=qp.lb, ub=qp.ub
    ), TOL)()  # fmt: skip

    assert back.x == pytest.approx(-s.x, abs=1e-8)


def test_the_string_bends_by_its_load_or_lies_on_the_obstacle():
    """Second differences are 30h² off the obstacle, and at most 30h² on the
    obstacle."""
    n = 100
    case, s = solved(String(), n=n)
    bend = np.diff(s.x, 2) * (n - 1) ** 2
    free = s.x[1:-1] > case.qp.lb[1:-1]

    assert s.x[[0, -1]].tolist() == [0, 0]
    assert bend[free] == pytest.approx(30, rel=1e-5)
    assert (bend[~free] <= 30 + 1e-6).all()
    assert 10 < np.count_nonzero(~free) < 80


@pytest.mark.parametrize(
    ("family", "keys"),
    [
        (String(), {"n": 60}), (Torsion(), {"n": 14}),
        (JournalBearing(), {"n": 14, "eccentricity": 0.9}),
    ],
    ids=["string", "torsion", "journal bearing"],
)  # fmt: skip
def test_another_method_has_the_same_solution(family, keys):
    case, s = solved(family, **keys)
    _, other = solved(family, Clarabel(), **keys)

    assert s.x == pytest.approx(other.x, abs=1e-5 * np.abs(other.x).max())
    assert case.qp.objective(s.x) == pytest.approx(case.qp.objective(other.x), rel=1e-7)
