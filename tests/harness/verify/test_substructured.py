"""Certificates from subdomains: bounds hold, and no undecomposed K is factorised.

Bodies are cut into boxes. Errors are relative to the reference solution of the whole
problem, which is accurate up to rounding.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.sparse import block_diag

from mortarbench.harness import Mechanics, Solution, Status, UncertifiableError, certify
from mortarbench.harness.crossval.references import ReferencePoint, reference_point
from mortarbench.harness.mechanics import DecomposedMechanics, Extended, Real
from mortarbench.harness.names import parse
from mortarbench.harness.sets.convex import hull
from mortarbench.harness.verify.certificate import Certificate, certify_pair
from mortarbench.harness.verify.substructured import Subdomains, neighbour
from mortarbench.problems import PROBLEMS
from mortarbench.problems.contact.bodies import Bodies
from mortarbench.problems.families import hertz, patch
from mortarbench.problems.feti.substructures import LocalProblems
from mortarbench.solvers import SOLVERS
from mortarbench.solvers.reference.solve import reference_solution
from mortarbench.solvers.smalbe.solver import SMALBE
from tests.support.bound_search import BoundSearch
from tests.support.decomposed_bodies import labelled, mechanics_of, parts_by
from tests.support.disturbed import DISTURBANCES
from tests.support.supported_by_contact import disc_between_plates, disc_in_parts

pytestmark = pytest.mark.together
CASES = (
    "beam-ring/Nr=3/Nh=2/step=10",
    "beam-ring/Nr=2/Nh=3/step=6/contact=mortar/basis=standard",
    "beam-ring/Nr=3/Nh=2/steps=2/friction=tresca/bound=5e7",
    "contact-patch/ratio=0.1",  # only contact supports the upper block
    "contact-patch/ratio=0.1/friction=coulomb/mu=0.2",
    "hertz-cylinder/n=3/m=2",
)
PERTURBATIONS = 6000
ROUNDED = 1 + 1e-9  #: local solves are in double precision
NOISE = 1e-7  #: smallest relative error for which effectivities are measured


def bodies_of(name: str) -> Bodies:
    family: Any = parse(f"{name}/primal", PROBLEMS).family
    if name.startswith("beam-ring"):
        return family.bodies().assembled
    if name.startswith("contact-patch"):
        return patch.model(family)
    return hertz.two_cylinders(family)[0].assembled


def boxes(bodies: Bodies, parts: tuple[int, int]) -> Any:
    """Label the cells of each body by the boxes that contain their centres."""
    centres = bodies.mesh.points[bodies.mesh.cells].mean(axis=1)
    label = np.zeros(len(centres), dtype=np.int64)
    for b in range(len(bodies.names)):
        own = bodies.body == b
        low, high = centres[own].min(axis=0), centres[own].max(axis=0)
        cell = ((centres[own] - low) / (high - low + 1e-9) * parts).astype(np.int64)
        label[own] = b * np.prod(parts) + cell @ [1, parts[0]]
    return np.unique(label, return_inverse=True)[1]


@dataclass(frozen=True, eq=False)
class Known:
    """A small problem with subdomains, and its solution up to rounding."""

    mechanics: Mechanics
    exact: ReferencePoint
    own: DecomposedMechanics

    def solution(self) -> Solution:
        """Return the solution in the form of `Mechanics.to_primal`."""
        m, primal = self.mechanics, self.mechanics.primal
        u, lam = (v.astype(np.float64) for v in (self.exact.u, self.exact.multipliers))
        y = -primal.A @ (primal.P @ u + primal.q + m.rows.T @ lam)
        contact, z = primal.h.size, np.zeros(primal.h.size + m.friction.bound.size)
        z[:contact] = lam[:contact]
        z[contact:][m.friction.bound > 0] = lam[contact:]
        return Solution(status=Status.SOLVED, x=u, y=y, z=z, z_box=0 * u)

    def pair_error(self, c: Certificate) -> float:
        """Return √(‖û − u*‖² + ‖u_λ − Tu*‖²); u_λ is a displacement of subdomains."""
        parts = self.own.parts
        jump = parts.spread.astype(Real) @ (c.u - self.exact.u) - c.off
        torn = float(np.sqrt(jump @ parts.product(jump)))
        return float(np.hypot(self.error(c.u), torn))

    def error(self, u: Extended) -> float:
        """Return ‖u − u*‖_K."""
        return self.mechanics.whole.norm(u - self.exact.u)


@cache
def known(name: str, parts: tuple[int, int] = (3, 2)) -> Known:
    case = parse(f"{name}/primal", PROBLEMS).build(reference_solution)
    whole, bodies = case.mechanics, bodies_of(name)
    assert whole is not None
    layout = labelled(bodies, boxes(bodies, parts))

    def never() -> Any:
        raise AssertionError("certificates of subdomains need no factor of the whole")

    own = mechanics_of(parts_by(bodies, layout, whole.primal, whole.friction))
    mechanics = replace(
        whole,
        factorise=never,
        subdomains=lambda: own,
    )
    vars(mechanics)["whole"] = whole
    return Known(mechanics, reference_point(whole, reference_solution), own)


def holds(problem: Known, s: Solution, found: Certificate) -> bool:
    """Return True if all errors are within the bounds of the certificate."""
    exact, slack = problem.mechanics.exact, problem.exact.bound * problem.exact.norm
    worst = max(problem.error(found.u), problem.error(s.x.astype(Real)))
    within = min(found.error, found.bound * problem.exact.norm)
    motion, lam = exact.motion(found.u), found.multipliers
    lower, upper = hull(exact.forces.sets, lam.size)
    return bool(
        problem.pair_error(found) <= ROUNDED * found.pair + 2 * slack
        and worst <= ROUNDED * within + slack
        and (lam >= lower).all() and (lam <= upper).all()
        and (motion[exact.contact] <= 0).all()
        and (found.u[exact.fixed] == 0).all()
    )  # fmt: skip


def violations(name: str, count: int) -> tuple[list[str], list[float]]:
    """Disturb the solution at random; return messages on violated bounds,
    and ratios.
    """
    problem, told, sharp = known(name), list[str](), list[float]()
    rng = np.random.default_rng(sum(map(ord, name)))
    for i in range(count):
        kind, size = DISTURBANCES[i % len(DISTURBANCES)], 10 ** rng.uniform(-9, 0.3)
        s = kind(problem.solution(), size, rng)
        try:
            found = certify(problem.mechanics, s)
        except UncertifiableError as e:
            told.append(f"{kind.__name__} {size:.1e}: {e}")
            continue
        if not holds(problem, s, found):
            told.append(f"{kind.__name__} {size:.1e}: bound {found.bound:.3e}")
        error = max(problem.error(s.x.astype(Real)), problem.pair_error(found))
        if NOISE * problem.exact.norm < error < 0.1 * problem.exact.norm:
            sharp.append(found.error / error)
    return told, sharp


@pytest.mark.parametrize(
    ("name", "count"),
    [
        *((CASES[i], 20) for i in (1, 2, 4)),
        *(pytest.param(CASES[i], 20, marks=pytest.mark.slow) for i in (0, 3)),
        *(pytest.param(name, 50, marks=pytest.mark.slow) for name in CASES),
    ],
)
def test_no_error_exceeds_its_bound_and_bounds_are_sharp(name: str, count: int) -> None:
    told, sharp = violations(name, count)
    assert told == []
    assert len(sharp) > count / 5
    assert np.median(sharp) <= 2


@pytest.mark.slow
@pytest.mark.parametrize("name", CASES)
def test_none_of_a_thousand_errors_exceeds_its_bound(name: str) -> None:
    told, sharp = violations(name, PERTURBATIONS // len(CASES))
    assert told == []
    assert np.median(sharp) <= 2


@pytest.mark.parametrize("name", CASES)
def test_the_bound_of_the_solution_is_that_of_rounding(name: str) -> None:
    assert certify(known(name).mechanics, known(name).solution()).bound < 1e-7


@pytest.mark.parametrize(
    "name",
    [CASES[0], CASES[3], *(
        pytest.param(CASES[i], marks=pytest.mark.slow) for i in (1, 2, 4, 5)
    )],
)  # fmt: skip
def test_bounds_are_about_those_of_the_whole(name: str) -> None:
    problem, found = known(name), []
    case = parse(f"{name}/dual", PROBLEMS).build(reference_solution)
    assert case.mechanics is not None
    for tol in (1e-3, 1e-4, 1e-5, 1e-6):
        for label in ("clarabel", "piqp"):
            s = case.mechanics.to_primal(SOLVERS[label].prepare(case.qp, tol)())
            one, other = (certify(m, s) for m in (case.mechanics, problem.mechanics))
            assert holds(problem, s, other)
            if one.bound > NOISE:
                found.append(other.bound / one.bound)
    assert np.median(found) <= 2.5


#: cases with answers at the level of rounding, where K and TᵀK_T T differ noticeably
ACCURATE = ("plate/Sy=2", "plate/Sx=8/Sy=1/n=4", "plate/Sx=8/Sy=2/n=2")
MORE_ACCURATE = (
    "plate", "plate/Sx=2/Sy=2/n=8", "plate/Sx=4/Sy=4/n=2", "plate/Sx=12/Sy=1/n=2",
    "plate/Sx=6/Sy=1/n=6", "plate/Sx=3/Sy=5/n=3",
    "plate/Sy=2/glue=redundant", "membranes/n=4", "obstacle/n=8/feti=4",
    "beam-ring/Nr=3/Nh=2/steps=1/feti=3", "contact-patch/feti=2",
)  # fmt: skip


def excess_of_rounding(name: str, tols: tuple[float, ...]) -> list[float]:
    """Solve at given tolerances; return the largest error/bound of each answer."""
    case = parse(f"{name}/dual", PROBLEMS).build(reference_solution)
    assert case.mechanics is not None
    whole, ratios = case.mechanics.whole, list[float]()
    exact = reference_point(whole, reference_solution)
    for tol in tols:
        s = case.mechanics.to_primal(SMALBE().prepare(case.qp, tol)())
        found = certify(case.mechanics, s)
        points = found.u, s.x.astype(Real)
        error = max(whole.norm(v - exact.u) for v in points) / exact.norm
        ratios.append((error - exact.bound) / found.bound)
    return ratios


@pytest.mark.parametrize("name", ACCURATE)
def test_a_bound_at_the_level_of_rounding_is_valid(name: str) -> None:
    assert max(excess_of_rounding(name, (1e-12, 1e-14))) <= 1


@pytest.mark.slow
@pytest.mark.parametrize("name", ACCURATE + MORE_ACCURATE)
def test_no_bound_at_the_level_of_rounding_is_exceeded(name: str) -> None:
    tols = tuple(10.0**-k for k in np.arange(10, 14.5, 0.5))
    assert max(excess_of_rounding(name, tols)) <= 1


def test_forces_of_subdomains_balance_and_add_up_to_the_residual() -> None:
    problem = known(CASES[0])
    mechanics, parts = problem.mechanics, problem.own.parts
    rng, exact = np.random.default_rng(5), problem.exact
    u = exact.u + 1e-3 * np.abs(exact.u).max() * rng.standard_normal(exact.u.size)
    u[mechanics.exact.fixed] = 0
    split = Subdomains(problem.own)
    near = neighbour(split, split.residual(u).rho + split.pulled(exact.multipliers))
    held = mechanics.exact.fixed
    b = parts.product(near.d)
    whole = mechanics.stiffness @ u - mechanics.exact.f
    whole = whole + mechanics.exact.B.T @ exact.multipliers
    free = np.setdiff1d(np.arange(u.size), held)
    size = float(np.abs(whole).max())
    assert_allclose(
        (parts.spread.T @ b - whole)[free].astype(float), 0, atol=1e-11 * size
    )
    assert np.abs(parts.kernel.T @ b).max() < 1e-11 * size
    assert near.left**2 < 1e-18 * (near.d @ b)


@pytest.mark.parametrize("name", [CASES[0], "contact-patch/ratio=0.1"])
def test_subdomains_that_moved_apart_are_moved_back_together(name: str) -> None:
    problem, rng = known(name), np.random.default_rng(8)
    mechanics, parts = problem.mechanics, problem.own.parts
    split = Subdomains(problem.own)
    u = rng.standard_normal(mechanics.exact.f.size).astype(Real)
    u[mechanics.exact.fixed] = 0
    apart = parts.kernel @ rng.standard_normal(parts.kernel.shape[1])
    together = split.averaged(split.spread(u) + 100 * apart)
    # only contact supports a body of the patch
    left = split.motions.without(together - u)

    assert np.abs(left).max() < 1e-9


def test_local_problems_are_those_of_the_decomposed_bodies() -> None:
    parts = known(CASES[0]).own.parts
    assert isinstance(parts, LocalProblems)
    domains = parts.torn.domains
    K = block_diag([domains.template(k).K for k in domains.class_of])
    rng = np.random.default_rng(6)
    v = rng.standard_normal(K.shape[0])
    b = v - parts.kernel @ (parts.kernel.T @ v)
    assert_allclose(parts.product(v.astype(Real)).astype(float), K @ v, rtol=1e-9)
    assert_allclose(K @ parts.solve(b), b, atol=1e-9 * np.abs(b).max())
    assert abs(K @ parts.kernel).max() < 1e-12 * abs(K).max()
    squares = K.multiply(K) @ v**2
    assert_allclose(parts.squared_product(v**2), squares, rtol=1e-12)


def test_local_solves_ignore_and_exclude_rigid_motions() -> None:
    parts = known(CASES[0]).own.parts
    rng = np.random.default_rng(7)
    b, alpha = (rng.standard_normal(size) for size in parts.kernel.shape)
    d = parts.solve(b)
    size = np.abs(d).max()
    assert np.abs(parts.kernel.T @ d).max() < 1e-12 * size
    pushed = parts.solve(b + parts.kernel @ (1e3 * alpha))
    assert_allclose(pushed, d, atol=1e-9 * size)


def test_an_unbalanced_load_has_no_certificate() -> None:
    problem = known("contact-patch/ratio=0.1")
    own, s = problem.own, problem.solution()
    lifted = replace(own, exact=own.exact._replace(f=-own.exact.f))
    with pytest.raises(UncertifiableError, match="tensile"):
        certify_pair(lifted, s.x, problem.mechanics.multipliers(s))


@pytest.mark.parametrize("size", [1e160, 1e300])
def test_answers_that_overflow_have_no_bound_below_one(size: float) -> None:
    problem = known(CASES[0])
    s = problem.solution()
    for far in (replace(s, x=size * (1 + s.x)), replace(s, z=size * (1 + s.z))):
        try:
            found = certify(problem.mechanics, far)
        except UncertifiableError:
            continue
        assert found.bound >= 1


SEARCHED = (
    "beam-ring/Nr=4/Nh=3/steps=1/feti=4/dual", "membranes/S=3/n=2/dual",
    "contact-patch/ratio=0.1/feti=3/dual",
    "contact-patch/ratio=0.1/friction=coulomb/mu=0.2/feti=3/dual",
    "hertz-cylinder/n=1/m=1/feti=9/friction=coulomb/mu=0.3/Q=0.5/dual",
    "greco/n=4/dim=3/depth=2/feti=2/dual",
    "sliding disc", "disc under rollers", "tilted disc", "soft disc",
)  # fmt: skip


@pytest.mark.parametrize(
    ("name", "count"),
    [
        (SEARCHED[1], 8), (SEARCHED[7], 8),
        *(pytest.param(name, 60, marks=pytest.mark.slow) for name in SEARCHED),
    ],
)  # fmt: skip
def test_a_search_finds_no_answer_whose_error_exceeds_its_bound(
    name: str, count: int
) -> None:
    faults, sharp = BoundSearch(name).result(count)

    assert faults == []
    assert len(sharp) == count
    assert np.median(sharp) < 2


@pytest.mark.parametrize(
    ("sign", "push", "reason"),
    [
        (1, 0.1, "nothing balances the load of body upper along x"),
        (-1, 0.0, "only tensile contact forces"),
    ],
)
def test_an_unbalanced_load_is_refused_as_for_undivided_bodies(
    sign: int, push: float, reason: str
) -> None:
    parts = disc_in_parts(push=push)
    parts = replace(parts, load=sign * parts.load)
    whole = disc_between_plates(push=push).mechanics
    assert whole is not None
    whole = replace(whole, primal=replace(whole.primal, q=sign * whole.primal.q))
    u, z = 0 * whole.primal.q, 0 * whole.primal.h
    reasons = []
    for bodies in (whole, mechanics_of(parts)):
        with pytest.raises(UncertifiableError, match=reason) as refusal:
            certify_pair(bodies, u, z)
        reasons.append(str(refusal.value))

    assert reasons[0] == reasons[1]


def test_eliminated_supports_are_certified_in_floating_subdomains() -> None:
    """The undivided body has the u_λ that is the nearest to û."""
    name = "plate/Sx=1/Sy=4/n=2/supports=eliminated/dual"
    mechanics = parse(name, PROBLEMS).build(reference_solution).mechanics
    assert mechanics is not None
    point = reference_point(mechanics, reference_solution)
    u, none = 1.01 * point.u.astype(np.float64), np.zeros(0)
    s = Solution(status=Status.SOLVED, x=u, y=none, z=none, z_box=0 * u)
    divided, undivided = (certify(m, s).bound for m in (mechanics, mechanics.whole))

    assert 0.999 * undivided <= divided <= 2 * undivided < 1
