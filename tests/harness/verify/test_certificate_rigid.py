"""Certificates for bodies that only contact supports, or that move rigidly."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cache, partial
from typing import Any

import numpy as np
import pytest

from mortarbench.harness import Case, Solution, Status, UncertifiableError, certify
from mortarbench.harness.crossval.references import reference_point
from mortarbench.harness.mechanics import (
    NO_FRICTION,
    AdmissibleForces,
    Extended,
    Mechanics,
    Real,
    cancelling,
)
from mortarbench.harness.names import parse
from mortarbench.harness.verify import certificate
from mortarbench.harness.verify.admissible import (
    _newton,
    admissible,
    balanced,
)
from mortarbench.harness.verify.certificate import Certificate, _charge, _Reach
from mortarbench.harness.verify.kkt import kkt_residuals
from mortarbench.harness.verify.substructured import Rounding, Undivided, length
from mortarbench.problems import PROBLEMS
from mortarbench.solvers import SOLVERS
from mortarbench.solvers.reference.solve import reference_solution
from tests.support.supported_by_contact import disc_between_plates, stored_solution

pytestmark = pytest.mark.together
ROUNDED = 1 + 1e-9


def named(name: str) -> Case:
    return parse(f"{name}/primal", PROBLEMS).build(reference_solution)


disc = partial(partial, disc_between_plates)
RATIOS = [
    f"contact-patch/lower=3/upper=2/ratio=1e{e}" for e in (-12, -9, -6, -3, 6, 12)
]
MAKERS: dict[str, Callable[[], Case]] = {
    **{name: partial(named, name) for name in (
        *RATIOS,
        "contact-patch/lower=3/upper=2/ratio=1e-9/slave=lower",
        "contact-patch/lower=3/upper=2/ratio=1e-6/slave=lower/contact=nts",
        "hertz-plane/n=3", "obstacle/n=8", "beam-ring/Nr=2/Nh=2/step=5",
        "beam-ring/Nr=2/Nh=2/step=3/contact=mortar",
    )},
    "disc that slides": disc(),
    "disc under rollers": disc(rollers=True),
    "tilted disc": disc(tilt=0.5),
    "disc as master": disc(disc_is_slave=False),
    "tilted disc as master": disc(disc_is_slave=False, tilt=0.5),
    "mortar disc that rolls": disc(contact="mortar", disc_is_slave=False),
    "tilted mortar disc": disc(contact="mortar", disc_is_slave=False, tilt=0.5),
    "soft disc": disc(E=(70e9, 70e3, 70e9)),
    "stiff disc": disc(E=(70e6, 70e14, 70e6)),
    "soft plate": disc(E=(70e3, 70e9, 70e12)),
}  # fmt: skip
#: cases in which contact stops no, one or several motions, for searches by default
QUICK = (
    RATIOS[0], RATIOS[-1], "obstacle/n=8", "beam-ring/Nr=2/Nh=2/step=5",
    "disc under rollers", "tilted mortar disc", "soft disc",
)  # fmt: skip
#: cases whose disturbed answers are certified by default
ATTACKED = (RATIOS[0], "obstacle/n=8", "disc under rollers", "soft disc")


def marked(*quick: str) -> list[Any]:
    """Return all names; those that are not quick are marked as slow."""
    return [
        pytest.param(name, marks=[pytest.mark.slow] * (name not in quick))
        for name in MAKERS
    ]


@cache
def known(name: str) -> tuple[Mechanics, Extended, Extended, float]:
    """Return the problem, its solution u and λ, and the norm of u."""
    mechanics = MAKERS[name]().mechanics
    assert mechanics is not None
    point = reference_point(mechanics, reference_solution)
    closed = point.multipliers > 1e-9 * point.multipliers.max()
    u, lam = stored_solution(mechanics, closed, point.u)
    return mechanics, u, lam, mechanics.norm(u)


def answer(u: Extended, lam: Extended) -> Solution:
    x, z, none = u.astype(np.float64), lam.astype(np.float64), np.zeros(0)
    return Solution(status=Status.SOLVED, x=x, y=none, z=z, z_box=0 * x)


def _noise(m, s, size, rng):
    return replace(
        s, x=s.x + size * np.abs(s.x).max() * rng.standard_normal(s.x.size),
        z=s.z + size * s.z.max() * rng.standard_normal(s.z.size),
    )  # fmt: skip


def _relative_noise(m, s, size, rng):
    x = s.x * (1 + size * rng.standard_normal(s.x.size))
    return replace(s, x=x, z=s.z * (1 + size * rng.standard_normal(s.z.size)))


def _scaled(m, s, size, rng):
    return replace(s, x=(1 + size) * s.x, z=(1 - size) * s.z)


def _moved_bodies(m, s, size, rng):
    """Move every body rigidly, as the supports allow."""
    R = m.inverse.kernel
    if not R.shape[1]:
        return _scaled(m, s, size, rng)
    far = size * np.linalg.norm(s.x) * rng.standard_normal(R.shape[1])
    return replace(s, x=s.x + R @ far)


def _shifted_multipliers(m, s, size, rng):
    """Move multipliers in the null space of Gᵀ, which preserves equilibrium."""
    d = rng.standard_normal(s.z.size) * (s.z + 0.1 * s.z.max() * (rng.random() < 0.5))
    G = m.primal.G @ m.inverse.kernel
    if G.shape[1]:
        d = d - G @ np.linalg.lstsq(G.T @ G, G.T @ d, rcond=1e-12)[0]
    return replace(s, z=s.z + size * d)


def _swapped_rows(m, s, size, rng):
    z = s.z.copy()
    i = rng.integers(z.size, size=2)
    z[i] = z[i[::-1]]
    return replace(s, z=z, x=s.x * (1 + size))


def _softest_modes(m, s, size, rng):
    """Add a displacement in the softest modes."""
    v = m.apply_inverse(m.apply_inverse(rng.standard_normal(s.x.size).astype(Real)))
    return replace(s, x=s.x + (size * m.norm(s.x) / m.norm(v) * v).astype(np.float64))


KINDS = (
    _noise, _relative_noise, _scaled, _moved_bodies, _shifted_multipliers,
    _swapped_rows, _softest_modes,
)  # fmt: skip


def attack(name: str, count: int) -> tuple[list[str], list[float]]:
    """Return messages on violated or missing bounds, and ratios of bound to error."""
    mechanics, u, lam, length = known(name)
    rng, told, sharp = np.random.default_rng(sum(map(ord, name))), [], []
    for i in range(count):
        kind, size = KINDS[i % len(KINDS)], 10 ** rng.uniform(-12, 0)
        s = kind(mechanics, answer(u, lam), size, rng)
        try:
            found = certify(mechanics, s)
        except UncertifiableError as e:
            told.append(f"{kind.__name__} {size:.0e}: {e}")
            continue
        errors = errors_of(mechanics, u, s, found)
        if max(errors) > ROUNDED * found.bound * length:
            told.append(
                f"{kind.__name__} {size:.0e}: {errors} > {found.bound * length}"
            )
        if found.bound > 1e-7:  # smaller bounds consist of rounding
            sharp.append(found.bound * length / max(errors))
    return told, sharp


def errors_of(
    mechanics: Mechanics, u: Extended, s: Solution, found: Certificate
) -> list[float]:
    points = (s.x.astype(Real), found.u, found.equilibrium)
    return [mechanics.norm(v - u) for v in points]


@pytest.mark.parametrize("name", marked(*ATTACKED))
def test_no_answer_is_further_from_the_solution_than_its_bound(name):
    told, _ = attack(name, 7)
    assert told == []


@pytest.mark.slow
def test_none_of_ten_thousand_errors_exceeds_its_sharp_bound():
    results = [attack(name, 10_000 // len(MAKERS) + 1) for name in MAKERS]
    assert [told for told, _ in results] == [[]] * len(MAKERS)
    assert np.median([e for _, sharp in results for e in sharp]) <= 2


@pytest.mark.parametrize("name", marked(*QUICK, *RATIOS, "disc as master"))
def test_the_stored_solution_is_certified_to_six_digits(name):
    mechanics, u, lam, _ = known(name)
    assert certify(mechanics, answer(u, lam)).bound <= 1e-6


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


def test_an_unbalanced_load_is_named():
    mechanics = disc_between_plates(push=0.1).mechanics
    s = answer(0 * mechanics.exact.f, np.ones_like(mechanics.exact.c))
    with pytest.raises(UncertifiableError, match="load of body upper along x"):
        certify(mechanics, s)


def test_a_load_that_requires_tensile_contact_has_another_message():
    mechanics = disc_between_plates().mechanics
    lifted = replace(mechanics, primal=replace(mechanics.primal, q=-mechanics.primal.q))
    s = answer(0 * lifted.exact.f, np.ones_like(lifted.exact.c))
    with pytest.raises(UncertifiableError, match="only tensile contact forces"):
        certify(lifted, s)


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
    from fractions import Fraction

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


def test_the_compliance_of_a_row_is_attained_by_a_deformation():
    """The bound |B_i v| ≤ φ_i‖v‖ is attained by v = K⁺B_iᵀ."""
    mechanics = disc_between_plates().mechanics
    split = Undivided(mechanics)
    for i in (0, 3):
        row = mechanics.exact.B[[i]].toarray()[0]
        v = mechanics.apply_inverse(row)
        attained = float(row @ v) / mechanics.norm(v)
        pressed = np.zeros_like(mechanics.exact.c)
        pressed[i] = 1
        compliance = length(split, split.pulled(pressed))
        assert attained == pytest.approx(compliance, rel=1e-9)


def test_the_bound_for_rounding_satisfies_its_inequality():
    """One motion: γ ≤ 2√s with s = 1 + charge, and charge ≥ 2γρ + 4√s γσ + 2γ²κ."""
    reach = _Reach(np.zeros(1), np.full(1, 2.0), np.zeros(1))

    def charge(rho: float, sigma: float, kappa: float) -> float:
        known = Rounding(np.full(1, sigma), np.full((1, 1), kappa))
        return _charge(reach, known, np.full(1, rho), 0.0, 1.0)

    for rho, sigma, kappa in ((1e-3, 0, 0), (0, 1e-3, 0), (0, 0, 1e-3)):
        s = 1 + charge(rho, sigma, kappa)
        gamma = 2 * np.sqrt(s)
        needed = 2 * gamma * rho + 4 * np.sqrt(s) * gamma * sigma + 2 * gamma**2 * kappa
        assert needed <= s - 1 <= 1.05 * needed
    assert charge(0, 0, 1.0) == np.inf  # rounding outweighs the contact forces


def test_an_initial_penetration_prevents_scaling():
    """If u = 0 penetrates (c < 0), scaling by θ < 1 does not make u admissible."""
    mechanics = named("obstacle/dim=1/n=16").mechanics
    primal = mechanics.primal
    blocked = replace(primal, h=np.full_like(primal.h, -1.0), G=0 * primal.G)
    u = np.ones(primal.q.size, dtype=Real)
    none = np.zeros(primal.h.size, dtype=bool)
    with np.errstate(all="ignore"):
        assert admissible(replace(mechanics, primal=blocked), u, none) is None


@pytest.mark.parametrize("name", ["disc that slides", "soft plate", RATIOS[0]])
def test_admissible_points_do_not_penetrate_in_exact_arithmetic(name):
    from fractions import Fraction

    mechanics, u, lam, _ = known(name)
    found = certify(mechanics, answer(u, lam)).u
    exact = [Fraction(float(v)) + Fraction(float(v - float(v))) for v in found]
    B = mechanics.primal.G.tocsr()
    for i, c in enumerate(mechanics.primal.h):
        row = slice(B.indptr[i], B.indptr[i + 1])
        reach = sum(
            Fraction(b) * exact[j]
            for j, b in zip(B.indices[row], B.data[row], strict=True)
        )
        assert reach <= Fraction(c)


@pytest.mark.parametrize("name", ["disc that slides", RATIOS[0], RATIOS[-1]])
def test_balanced_forces_balance_to_the_last_digits_of_their_terms(name):
    mechanics, u, lam, _ = known(name)
    rng, motions = np.random.default_rng(1), mechanics.motions
    for size in (1e-12, 1e-3):
        start = np.maximum(lam * (1 + size * rng.standard_normal(lam.size)), 0)
        found = balanced(mechanics, start, u)
        left = (
            motions.constrained.T @ mechanics.exact.f
            - motions.KR.T @ u
            - motions.G.T @ found
        )
        terms = motions.largest.T @ np.abs(mechanics.exact.f)
        assert (found >= 0).all()
        assert (np.abs(left) <= 1e-16 * terms.max()).all()


def test_balance_is_required_only_up_to_rounding():
    """Sums with cancellation are accurate only up to the rounding of their terms."""
    G, load = np.array([[1.0], [-1.0]], dtype=Real), np.array([1e-21], dtype=Real)
    lam = np.ones(2, dtype=Real)
    forces = AdmissibleForces(2, NO_FRICTION.discs(2))
    found = _newton(forces, lam, lam, G, load, lambda lam: np.abs(G).T @ lam)
    assert found is not None
    assert (found == lam).all()


@pytest.mark.parametrize(
    ("name", "count"),
    [
        ("stiff disc", 3),
        pytest.param("stiff disc", 40, marks=pytest.mark.slow),
        pytest.param("disc under rollers", 40, marks=pytest.mark.slow),
    ],
)
def test_forces_on_the_wrong_rows_are_balanced_by_all(name, count):
    """Contact forces on wrong rows do not prevent a certificate."""
    mechanics, u, lam, _ = known(name)
    rng = np.random.default_rng(sum(map(ord, name)))
    s = answer(u, lam)
    for _ in range(count):
        assert certify(mechanics, _swapped_rows(mechanics, s, 1e-6, rng)).bound > 0


def pair(**fields: object) -> Certificate:
    """Return a certificate with given values; all other errors are zero."""
    none: dict[str, object] = dict.fromkeys(
        ("norm", "distance", "work", "sliding", "rounding", "claimed", "moved"), 0.0
    )
    empty = {name: np.zeros(0) for name in ("u", "multipliers", "off")}
    return Certificate(
        **empty, **none | {"stretch": 1.0, "least": 1.0, "seminorm": False} | fields
    )  # fmt: skip


def test_the_certificate_with_the_smallest_error_is_returned(monkeypatch):
    """The pair near zero is tried only if no pair near the answer yields a bound."""
    mechanics, u, lam, _ = known("beam-ring/Nr=2/Nh=2/step=5")
    s, large = answer(u, lam), {"work": 1.0, "least": 1e3}
    one, best, last = (pair(claimed=c, **large) for c in (3.0, 2.0, 9.0))

    def found(*outcomes):
        tried = iter(outcomes)
        monkeypatch.setattr(certificate, "_proved", lambda *args: next(tried))
        return certify(mechanics, s)

    assert found(one, best) is best
    assert found("first", one) is one
    assert found("first", "second", last) is last
    with pytest.raises(UncertifiableError, match=r"near the answer: first$"):
        found("first", "second", "third")


@pytest.mark.parametrize(
    ("name", "size", "reason"),
    [
        ("soft disc", 1.0, "is too large"), (RATIOS[0], 1.0, "is too large"),
        ("tilted disc", 1e6, "tensile contact"),
    ],
)  # fmt: skip
def test_an_answer_whose_own_pair_proves_nothing_has_a_sharp_bound(name, size, reason):
    mechanics, u, lam, length = known(name)
    far = _noise(mechanics, answer(u, lam), size, np.random.default_rng(0))
    with np.errstate(over="ignore"):  # as in `certify`
        *tried, _ = certificate._certificates(Undivided(mechanics), far.x, far.z)
    found = certify(mechanics, far)
    off, *others = errors_of(mechanics, u, far, found)

    assert all(reason in why for why in tried)
    assert off <= ROUNDED * found.error <= 1.01 * off
    assert max(others) <= found.pair < 100 * length


def test_parts_of_a_bound_are_lengths_relative_to_the_least_solution():
    """g = ½·3² + 5 + ½·7 = 13, the bound of the answer is 24, and ‖u*‖ ≥ 2."""
    found = pair(
        distance=3.0, work=5.0, rounding=7.0, sliding=2.0, claimed=24.0, moved=1.0,
        least=2.0, stretch=1.5, seminorm=True,
    )  # fmt: skip
    assert found.gap == 13.0
    assert found.pair == 26**0.5
    assert found.bound == 12.0
    assert replace(found, claimed=0.0).bound == 1.5 * 26**0.5 / 2
    assert found.parts == {
        "pair": 26**0.5 / 2, "distance": 1.5, "work": 10**0.5 / 2, "answer": 12.0,
        "moved": 0.5, "friction": 1.0, "seminorm": 1.0,
    }  # fmt: skip


def test_the_relative_error_for_a_zero_solution_is_zero_or_infinite():
    assert pair(least=0.0).bound == 0.0
    assert pair(least=0.0, claimed=1e-300).bound == np.inf
    assert pair(least=-1.0, claimed=1.0).bound == np.inf
    negative = pair(work=-1e-20, sliding=-1e-20).parts
    assert negative["pair"] == negative["work"] == negative["friction"] == 0.0


@pytest.mark.parametrize("value", [np.nan, np.inf])
@pytest.mark.parametrize("vector", ["x", "z"])
def test_one_nan_or_inf_in_a_point_prevents_certification(vector, value):
    mechanics, u, lam, _ = known("contact-patch/lower=3/upper=2/ratio=1e-3")
    s = answer(u, lam)
    getattr(s, vector)[1] = value
    with pytest.raises(UncertifiableError, match="the answer contains NaN or inf"):
        certify(mechanics, s)


def test_without_a_proof_the_solution_may_be_zero(monkeypatch):
    mechanics, *_ = known("contact-patch/lower=3/upper=2/ratio=1e-3")

    def refused(*args):
        raise UncertifiableError("no")

    assert certificate._least_norm(Undivided(mechanics)) > 0
    monkeypatch.setattr(certificate, "proof", refused)
    assert certificate._least_norm(Undivided(mechanics)) == 0.0


@pytest.mark.parametrize("name", ["disc under rollers", "tilted disc"])
@pytest.mark.parametrize("size", [1e-4, 1e-3])
def test_the_norm_of_the_solution_is_bounded_by_its_distance_from_the_midpoint(
    name, size
):
    """By (3), ‖u*‖ ≥ ‖M‖ − √(g − ¼‖û − u_λ‖²) for the midpoint M of û and u_λ."""
    mechanics, u, lam, norm = known(name)
    disturbed = _noise(mechanics, answer(u, lam), size, np.random.default_rng(0))
    found = certify(mechanics, disturbed)
    middle = mechanics.norm(found.u - found.off / 2)
    around = np.sqrt(found.gap - 0.25 * found.distance**2)
    assert found.least * found.stretch >= (middle - around) * (1 - 1e-12)
    assert found.least <= norm * ROUNDED


def test_an_inexact_solve_enlarges_the_ball_around_the_midpoint(monkeypatch):
    """The error of a solve also increases the distance of u_λ. No body
    moves rigidly.
    """
    mechanics, u, lam, norm = known("beam-ring/Nr=2/Nh=2/step=5")
    solved, left = certificate.neighbour, 1e-3 * norm
    monkeypatch.setattr(
        certificate, "neighbour", lambda *args: solved(*args)._replace(left=left)
    )
    s = _noise(mechanics, answer(u, lam), 1e-3, np.random.default_rng(0))
    found = certify(mechanics, s)
    apart, middle = mechanics.norm(found.off), found.u - found.off / 2
    around = np.sqrt(found.gap - 0.25 * (apart - left) ** 2) + left / 2

    assert found.distance == pytest.approx(apart + left, rel=1e-9)
    assert found.claimed == pytest.approx(mechanics.norm(s.x - middle) + around)
    assert found.least == pytest.approx(mechanics.norm(middle) - around)
    assert found.norm == pytest.approx(mechanics.norm(found.u), rel=1e-9)
    assert not found.seminorm


def test_displacements_without_subdomain_energy_add_to_the_error(monkeypatch):
    mechanics, u, lam, norm = known("beam-ring/Nr=2/Nh=2/step=5")
    s, force = answer(0 * u, lam), mechanics.exact.f / 10
    least = certify(mechanics, s).claimed
    monkeypatch.setattr(Undivided, "excess", lambda self, w: (force, 3 * norm**2))
    found = certify(mechanics, s)
    joined = 3 * norm**2 + 2 * found.pair * length(Undivided(mechanics), force)

    assert found.claimed**2 == pytest.approx(least**2 + joined)


def test_rounding_counts_as_far_as_the_answer_moves_rigidly(monkeypatch):
    """The pair is at the solution (γ = 0), and the answer is far from the solution."""
    mechanics = named("hertz-cylinder/n=2/m=2").mechanics
    point = reference_point(mechanics, reference_solution)
    R, far = mechanics.motions.constrained.toarray()[:, 0], 1e3 * np.abs(point.u).max()
    s = answer(point.u - far * R, point.multipliers)
    monkeypatch.setattr(certificate, "_reach", lambda *args: _Reach(*np.zeros((3, 1))))

    def claimed(strain):
        known = Rounding(np.array([strain]), np.zeros((1, 1)))
        monkeypatch.setattr(Undivided, "rounding", lambda *args: known)
        found = certify(mechanics, s)
        return found.claimed, abs(float(R @ (s.x - found.u)))

    strain = 0.1 * point.norm / float(far)
    (plain, moved), (strained, _) = claimed(0.0), claimed(strain)

    assert moved > 0.1 * far
    assert strained**2 == pytest.approx(plain**2 + 2 * plain * moved * strain)


def test_a_single_motion_that_only_contact_stops_leaves_a_seminorm():
    mechanics = named("hertz-cylinder/n=2/m=2").mechanics
    zero = np.zeros(mechanics.exact.f.size)
    s = answer(zero, np.zeros(mechanics.exact.c.size))

    assert mechanics.kernel.shape[1] == 1
    assert certify(mechanics, s).seminorm


@pytest.mark.parametrize(
    ("name", "bound", "count"),
    [
        ("tilted disc", 1e-4, 3),
        ("tilted disc", 1e-2, 2),  # the error is too large for an exchange
        ("tilted disc", 1e-8, 1),  # the bound is small enough
        ("beam-ring/Nr=2/Nh=2/step=5", 1e-4, 2),  # supports fix all bodies
    ],
)
def test_rows_are_exchanged_if_only_contact_supports_a_body(
    name, bound, count, monkeypatch
):
    """Certificates are replaced by certificates whose only error is work."""
    mechanics, u, lam, _ = known(name)
    monkeypatch.setattr(certificate, "_proved", lambda *args: pair(work=bound**2 / 2))
    split, s = Undivided(mechanics), answer(u, lam)
    assert len(list(certificate._certificates(split, s.x, s.z))) == count


@pytest.mark.parametrize("name", ["disc under rollers", "tilted disc", RATIOS[3]])
def test_motions_in_both_directions_are_bounded(name, monkeypatch):
    """Bounds do not depend on the sign of a rigid motion, which is arbitrary."""
    mechanics, u, lam, _ = known(name)
    reach, seen = certificate._reach, []

    def both(split, held, *others):
        seen.append([reach(split, h, *others) for h in (held, -held)])
        return seen[-1][0]

    monkeypatch.setattr(certificate, "_reach", both)
    s = _noise(mechanics, answer(u, lam), 1e-4, np.random.default_rng(0))
    certify(mechanics, s)
    assert seen
    for one, other in seen:
        for got, known_by_symmetry in zip(one, other, strict=True):
            assert got.size
            assert got == pytest.approx(known_by_symmetry, rel=1e-6)
