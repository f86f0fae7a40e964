"""Certificates with friction: no error exceeds its bound for disturbed answers.

The disturbances imitate a wrong solver: noise, rows that stick instead of slipping or
being open, slip in the opposite direction, and forces above the bound of friction.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cache

import numpy as np
import pytest

from mortarbench.harness import (
    Case,
    Mechanics,
    Solution,
    Status,
    certify,
)
from mortarbench.harness.crossval.references import ReferencePoint, reference_point
from mortarbench.harness.mechanics import AdmissibleForces, Extended, Real
from mortarbench.harness.names import parse
from mortarbench.harness.verify import certificate
from mortarbench.harness.verify.active_set_refinement import CLOSED, LOWER, UPPER
from mortarbench.harness.verify.certificate import Certificate
from mortarbench.harness.verify.kkt import kkt_residuals
from mortarbench.problems import PROBLEMS
from mortarbench.problems.contact.friction import FrictionLaw
from mortarbench.solvers import SOLVERS
from mortarbench.solvers.reference.solve import reference_solution
from tests.support.incline import block_on_incline

pytestmark = pytest.mark.together
INCLINE = "a block that friction alone holds"
#: problem with friction → the same problem without friction
CASES = {
    "beam-ring/Nr=3/Nh=2/steps=2/friction=tresca/bound=5e7": (
        "beam-ring/Nr=3/Nh=2/steps=2"
    ),
    "beam-ring/Nr=2/Nh=3/steps=1/friction=coulomb/mu=0.3": (
        "beam-ring/Nr=2/Nh=3/steps=1"
    ),
    "beam-ring/Nr=3/Nh=2/steps=1/contact=mortar/friction=coulomb/mu=0.6": (
        "beam-ring/Nr=3/Nh=2/steps=1/contact=mortar"
    ),
    "contact-patch/ratio=0.1/friction=coulomb/mu=0.2": "contact-patch/ratio=0.1",
    "contact-patch/ratio=0.1/contact=nts/friction=tresca/bound=1.5e5": (
        "contact-patch/ratio=0.1/contact=nts"
    ),
}
#: three-dimensional bodies: stiff and soft, floating, on a rigid plane, and decomposed
IN_SPACE = (
    "contact-patch/dim=3/lower=2/upper=1/ratio=0.1/friction=tresca/bound=1e5",
    "contact-patch/dim=3/lower=2/upper=1/ratio=1e-3/friction=tresca/bound=1e5",
    "contact-patch/dim=3/lower=2/upper=2/ratio=1e3/friction=coulomb/mu=0.1",
    "contact-patch/dim=3/lower=2/upper=2/ratio=0.1/friction=coulomb/mu=0.2/distort=0.2",
    "greco/n=3/dim=3/depth=2",
    "contact-patch/dim=3/lower=2/upper=1/ratio=0.1/friction=coulomb/mu=0.2/feti=1",
    "greco/n=4/dim=3/feti=2",
)
PERTURBATIONS = 10_000
ROUNDED = 1 + 1e-12  #: the bound often equals the error up to rounding
NOISE = 1e-7  #: smallest relative error for which effectivities are measured


@dataclass(frozen=True, eq=False)
class Known:
    """A small problem, and its solution up to rounding."""

    mechanics: Mechanics
    exact: ReferencePoint

    def solution(self) -> Solution:
        """Return the solution in the form of `Mechanics.to_primal`."""
        mechanics, primal = self.mechanics, self.mechanics.primal
        u, lam = (v.astype(np.float64) for v in (self.exact.u, self.exact.multipliers))
        y = -primal.A @ (primal.P @ u + primal.q + mechanics.rows.T @ lam)
        z, m = np.zeros(primal.h.size + mechanics.friction.bound.size), primal.h.size
        z[:m], z[m:][mechanics.friction.bound > 0] = lam[:m], lam[m:]
        return Solution(status=Status.SOLVED, x=u, y=y, z=z, z_box=0 * u)

    def error(self, u: Extended) -> float:
        """Return ‖u − u*‖_K."""
        return self.mechanics.norm(u - self.exact.u)


def build(name: str, form: str = "primal") -> Case:
    if name == INCLINE:
        return block_on_incline(0.35, FrictionLaw("coulomb", mu=0.3), form=form)
    form = "dual" if "/feti=" in name else form
    return parse(f"{name}/{form}", PROBLEMS).build(reference_solution)


@cache
def known(name: str) -> Known:
    mechanics = build(name).mechanics
    assert mechanics is not None
    return Known(mechanics, reference_point(mechanics, reference_solution))


def holds(problem: Known, s: Solution, found: Certificate) -> bool:
    """Return True if all errors are within the bounds of the certificate."""
    exact, slack = problem.mechanics.exact, problem.exact.bound * problem.exact.norm
    of_u, of_equilibrium = problem.error(found.u), 0.0
    if found.off.shape == found.u.shape:  # with subdomains, u_λ has jumps
        of_equilibrium = problem.error(found.equilibrium)
    of_answer = problem.error(s.x.astype(Real))
    return bool(
        np.hypot(of_u, of_equilibrium) <= ROUNDED * found.pair + 2 * slack
        and max(of_u, of_equilibrium, of_answer)
        <= ROUNDED * min(found.error, found.bound * problem.exact.norm) + slack
        and is_admissible(exact.forces, found.multipliers)
        and (exact.motion(found.u)[exact.contact] <= 0).all()
    )


def is_admissible(forces: AdmissibleForces, multipliers: Extended) -> bool:
    """Return True if multipliers are in Λ, up to rounding of norms on circles."""
    size = np.sqrt((multipliers[forces.discs.index] ** 2).sum(axis=1))
    pressing = (multipliers[forces.contact] >= 0).all()
    rounding = 8 * np.finfo(Real).eps
    return bool(pressing and (size <= forces.discs.radius * (1 + rounding)).all())


def _noise(s: Solution, size: float, rng: np.random.Generator, m: int) -> Solution:
    """Add noise of the same size to all components; friction forces leave
    their bounds.
    """
    del m
    x = s.x + size * np.abs(s.x).max() * rng.standard_normal(s.x.size)
    # drawn per row, so that both problems are disturbed by the same numbers
    z = s.z + size * np.abs(s.z).max() * rng.standard_normal(s.z.size)
    return replace(s, x=x, z=z)


def _wrong_states(
    s: Solution, size: float, rng: np.random.Generator, m: int
) -> Solution:
    """Exchange forces between rows of one type: stick and slip, closed and open."""
    z = s.z.copy()
    for rows in (slice(0, m), slice(m, None)):
        part = z[rows]
        swapped = rng.random(part.size) < max(size, 1.5 / max(part.size, 1))
        part[swapped] = rng.permutation(part)[swapped]
    return replace(s, z=z)


def _turned(s: Solution, size: float, rng: np.random.Generator, m: int) -> Solution:
    """Reverse some friction forces, set others to zero, and disturb u slightly."""
    z = s.z.copy()
    z[m:] *= rng.choice([-1.0, 0.0, 1.0, 1.0, 1.0, 1.0], z.size - m)
    x = s.x + size * np.abs(s.x).max() * rng.standard_normal(s.x.size)
    return replace(s, x=x, z=z)


def _scaled(s: Solution, size: float, rng: np.random.Generator, m: int) -> Solution:
    """Scale point and multipliers by factors that may be far from 1."""
    del m
    a, b = 1 + 3 * size * rng.standard_normal(2)
    return replace(s, x=a * s.x, z=b * s.z)


def _rounded(s: Solution, size: float, rng: np.random.Generator, m: int) -> Solution:
    """Set small values to zero, and round the other values to a few digits."""
    del m
    x = np.where(np.abs(s.x) < size * np.abs(s.x).max(), 0, s.x)
    z = np.where(np.abs(s.z) < size * np.abs(s.z).max(), 0, s.z)
    unit = 10.0 ** np.floor(np.log10(np.abs(s.x).max()))
    return replace(s, x=np.round(x / unit, rng.integers(1, 6)) * unit, z=z)


KINDS: tuple[Callable[..., Solution], ...] = (
    _noise, _wrong_states, _turned, _scaled, _rounded,
)  # fmt: skip


def attacked(name: str, count: int) -> tuple[list[str], list[float]]:
    """Disturb the solution at random; return messages on violated bounds, and ratios.

    The ratios are bound/error of each pair or, for subdomains, of each answer. Errors
    at the level of rounding are excluded.
    """
    problem, told, effectivities = known(name), [], []
    s, m = problem.solution(), problem.mechanics.primal.h.size
    for i in range(count):
        rng = np.random.default_rng([577, i])
        kind, size = KINDS[i % len(KINDS)], 10 ** rng.uniform(-10, 0.5)
        disturbed = kind(s, size, rng, m)
        found = certify(problem.mechanics, disturbed)
        if not holds(problem, disturbed, found):
            told.append(f"{kind.__name__} {size:.1e}: bound {found.bound:.3e}")
        true, stated = problem.error(disturbed.x.astype(Real)), found.error
        if found.off.shape == found.u.shape:
            true = np.hypot(*map(problem.error, (found.u, found.equilibrium)))
            stated = found.pair
        if true > NOISE * problem.exact.norm:
            effectivities.append(stated / true)
    return told, effectivities


def sharp(cases: Sequence[str], count: int) -> None:
    """Test bounds; compare their sharpness with that of cases without friction."""
    rough, smooth = [], []
    for name in cases:
        told, found = attacked(name, count)
        assert told == []
        rough += found
        smooth += attacked(CASES[name], count)[1]
    assert len(rough) > count * len(cases) / 3
    assert np.median(rough) <= 1.5 * np.median(smooth)


@pytest.mark.parametrize(
    "names",
    [
        [name for name in CASES if name.startswith("contact-patch")],
        pytest.param(list(CASES), marks=pytest.mark.slow),
    ],
)
def test_no_disturbed_solution_with_friction_exceeds_its_bound(names):
    sharp(names, 10)


def test_no_disturbed_solution_of_a_body_held_by_friction_exceeds_its_bound():
    assert attacked(INCLINE, 20)[0] == []


@pytest.mark.parametrize(
    "name",
    [IN_SPACE[0], *(pytest.param(IN_SPACE[i], marks=pytest.mark.slow) for i in (4, 5))],
)
def test_no_disturbed_solution_in_3d_exceeds_its_bound(name):
    faults, effectivities = attacked(name, 15)

    assert faults == []
    assert np.median(effectivities) <= 2


@pytest.mark.slow
def test_none_of_ten_thousand_errors_in_3d_exceeds_its_bound():
    sharp = []
    for name in IN_SPACE:
        faults, effectivities = attacked(name, PERTURBATIONS // len(IN_SPACE) + 1)
        assert faults == [], name
        sharp += effectivities

    assert len(sharp) > PERTURBATIONS / 3
    assert np.median(sharp) <= 2


@pytest.mark.parametrize("count", [2, pytest.param(4, marks=pytest.mark.slow)])
def test_friction_vectors_in_3d_stick_and_slip_obliquely(count):
    found = set()
    for name in IN_SPACE[:count]:
        exact = known(name).exact
        forces = known(name).mechanics.exact.forces
        closed = exact.states[forces.discs.index] == CLOSED
        assert (closed.all(axis=1) == closed.any(axis=1)).all()
        across = np.abs(exact.multipliers[forces.discs.index]).min(axis=1)
        oblique = across > 0.1 * forces.discs.radius
        found |= set(zip(closed[:, 0].tolist(), oblique.tolist(), strict=True))

    assert {stick for stick, _ in found} == {True, False}
    assert (False, True) in found


@pytest.mark.slow
def test_none_of_ten_thousand_errors_exceeds_its_bound():
    sharp(list(CASES), PERTURBATIONS // len(CASES))
    assert attacked(INCLINE, PERTURBATIONS // len(CASES))[0] == []


def test_the_cases_contain_sticking_slipping_and_open_rows():
    found = set()
    for name in CASES:
        problem = known(name)
        contact = problem.mechanics.exact.contact
        closed = problem.exact.states == CLOSED
        found |= {("contact", bool(c)) for c in closed[contact]}
        found |= {("friction", int(v)) for v in problem.exact.states[~contact]}

    assert found == {
        ("contact", True), ("contact", False),
        ("friction", LOWER), ("friction", CLOSED), ("friction", UPPER),
    }  # fmt: skip


@pytest.mark.parametrize("name", [*CASES, INCLINE])
def test_the_bound_of_the_solution_is_that_of_rounding(name):
    problem = known(name)
    mechanics, s = problem.mechanics, problem.solution()

    assert problem.exact.bound < 1e-7
    assert certify(mechanics, s).bound < 2e-7
    force, slip = s.z[mechanics.primal.h.size :], mechanics.friction.T @ s.x
    assert (abs(force) <= mechanics.friction.bound * (1 + 1e-12)).all()
    work = mechanics.friction.bound * abs(slip - mechanics.friction.start)
    assert work.sum() >= 0


@pytest.mark.parametrize(
    "name",
    [
        next(iter(CASES)),
        *(pytest.param(name, marks=pytest.mark.slow) for name in list(CASES)[1:3]),
    ],
)
def test_errors_of_solver_answers_are_bounded_in_every_form(name):
    problem, found = known(name), []
    for form in ("primal", "dual", "dual-bounds"):
        case = build(name, form)
        for label in ("smalbe", "clarabel", "osqp"):
            solver = SOLVERS[label]
            if solver.declines(case.qp) is not None:
                continue
            for tol in (1e-3, 1e-6):
                s = solver.prepare(case.qp, tol)()
                assert kkt_residuals(case.qp, s).worst <= 100 * tol
                back = case.mechanics.to_primal(s)
                c = certify(case.mechanics, back)
                assert holds(problem, back, c)
                found.append(c.bound)
    assert max(found) < 0.3


@pytest.mark.parametrize("far", [-1.0, 1.0])
def test_a_body_may_have_slid_by_its_displacement_in_either_direction(far, monkeypatch):
    """Bounds on rigid motions of a sticking block include its displacement."""
    problem, seen = known(INCLINE), []
    mechanics, reach = problem.mechanics, certificate._reach

    def recorded(split, held, *others):
        seen.append((held, reach(split, held, *others)))
        return seen[-1][1]

    monkeypatch.setattr(certificate, "_reach", recorded)
    s = problem.solution()
    along = np.where(np.arange(s.x.size) % 2 == 0, far * np.abs(s.x).max(), 0)
    of_block = mechanics.kernel @ (mechanics.kernel.T @ along)
    certify(mechanics, replace(s, x=s.x + of_block.astype(np.float64)))
    held, allowed = seen[0]  # of the first pair, in which the block has slid
    off = np.abs(held.T @ (mechanics.motions.constrained.T @ of_block))

    assert off.max() > 0
    assert (off <= allowed.gaps * (1 + 1e-6)).all()


def test_work_of_friction_has_its_own_part():
    """With a zero force on a slipping row, work of friction is missing; the bound
    includes this work.
    """
    problem = known("beam-ring/Nr=3/Nh=2/steps=2/friction=tresca/bound=5e7")
    mechanics, s = problem.mechanics, problem.solution()
    slip = mechanics.friction.T @ s.x - mechanics.friction.start
    m, row = (
        mechanics.primal.h.size,
        int((mechanics.friction.bound * abs(slip)).argmax()),
    )
    z = s.z.copy()
    z[m + row] = 0.0
    c = certify(mechanics, replace(s, z=z))

    assert 0 < c.sliding <= mechanics.friction.bound[row] * abs(slip[row]) * (1 + 1e-9)
    assert c.parts["friction"] <= c.parts["work"] * (1 + 1e-12)
