"""Certificates: no error exceeds its bound, for several types of wrong answers."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cache
from typing import Any

import numpy as np
import pytest

from mortarbench.harness import (
    QP,
    Mechanics,
    Solution,
    Solver,
    Status,
    UncertifiableError,
    certify,
)
from mortarbench.harness.crossval.references import ReferencePoint, reference_point
from mortarbench.harness.files.store import write_point
from mortarbench.harness.mechanics import Extended, Real
from mortarbench.harness.names import parse
from mortarbench.harness.processes import cases
from mortarbench.harness.processes.cases import Cases
from mortarbench.harness.verify.certificate import Certificate
from mortarbench.harness.verify.verdicts import certified, has_point
from mortarbench.problems import PROBLEMS
from mortarbench.solvers import SOLVERS
from mortarbench.solvers.reference.solve import reference_solution

pytestmark = pytest.mark.together
CASES = (
    "beam-ring/Nr=3/Nh=2/step=10",
    "beam-ring/Nr=3/Nh=2/step=2/contact=mortar",
    "beam-ring/Nr=2/Nh=3/step=6/contact=mortar/basis=standard",
    "contact-patch",
    "hertz-plane/n=3",
    "hertz-cylinder/n=3/m=2",
    "obstacle/dim=1/n=16",
    "obstacle/n=8",
    "cube-wall/n=2",
    "hertz-sphere/n=1",
)
#: cases with few contact rows
QUICK = (CASES[0], *CASES[2:4], *CASES[6:9])
PERTURBATIONS = 10_000
ROUNDED = 1 + 1e-12  #: the bound often equals the error up to rounding


@dataclass(frozen=True, eq=False)
class Known:
    """A small problem, and its solution up to rounding."""

    mechanics: Mechanics
    exact: ReferencePoint

    def solution(self) -> Solution:
        """Return the solution of the primal QP in the form of a solver."""
        u, z = (v.astype(np.float64) for v in (self.exact.u, self.exact.multipliers))
        primal = self.mechanics.primal
        y = -primal.A @ (primal.P @ u + primal.q + primal.G.T @ z)
        return Solution(status=Status.SOLVED, x=u, y=y, z=z, z_box=0 * u)

    def error(self, u: Extended) -> float:
        """Return ‖u − u*‖_K."""
        return self.mechanics.norm(u - self.exact.u)

    @property
    def slack(self) -> float:
        """Bound on ‖u − u*‖_K of the reference."""
        return self.exact.bound * self.exact.norm


@cache
def known(name: str) -> Known:
    case = parse(f"{name}/primal", PROBLEMS).build(reference_solution)
    assert case.mechanics is not None
    point = reference_point(case.mechanics, reference_solution)
    return Known(case.mechanics, point)


def holds(problem: Known, s: Solution, found: Certificate) -> bool:
    """Return True if all errors are within the bounds of the certificate."""
    slack = problem.slack
    of_u, of_equilibrium = map(problem.error, (found.u, found.equilibrium))
    of_answer = problem.error(s.x.astype(Real))
    return bool(
        np.hypot(of_u, of_equilibrium) <= ROUNDED * found.pair + 2 * slack
        and max(of_u, of_equilibrium, of_answer)
        <= ROUNDED * min(found.error, found.bound * problem.exact.norm) + slack
        and (found.multipliers >= 0).all()
        and (problem.mechanics.exact.B @ found.u <= problem.mechanics.exact.c).all()
    )  # fmt: skip


def _noise(s: Solution, size: float, rng: np.random.Generator) -> Solution:
    """Add noise of the same size to all components."""
    x = s.x + size * np.abs(s.x).max() * rng.standard_normal(s.x.size)
    z = s.z + size * s.z.max() * rng.standard_normal(s.z.size)
    return replace(s, x=x, z=z)


def _wrong_active_set(s: Solution, size: float, rng: np.random.Generator) -> Solution:
    """Replace the multipliers of some rows by those of random rows."""
    z = s.z.copy()
    swapped = rng.random(z.size) < max(size, 1.5 / z.size)
    z[swapped] = rng.permutation(z)[swapped]
    return replace(s, z=z)


def _scaled(s: Solution, size: float, rng: np.random.Generator) -> Solution:
    """Scale point and multipliers by factors that may be far from 1."""
    a, b = 1 + 3 * size * rng.standard_normal(2)
    return replace(s, x=a * s.x, z=b * s.z)


def _truncated(s: Solution, size: float, rng: np.random.Generator) -> Solution:
    """Set small values to zero, and round the other values to a few digits."""
    x = np.where(np.abs(s.x) < size * np.abs(s.x).max(), 0, s.x)
    z = np.where(s.z < size * s.z.max(), 0, s.z)
    digits = rng.integers(1, 6)
    unit = 10.0 ** np.floor(np.log10(np.abs(s.x).max()))
    return replace(s, x=np.round(x / unit, digits) * unit, z=z)


def _infeasible(s: Solution, size: float, rng: np.random.Generator) -> Solution:
    """Add penetration, motion of supports and tensile contact forces."""
    x = s.x * (1 + 10 * size) + size * np.abs(s.x).max() * rng.random(s.x.size)
    return replace(s, x=x, z=s.z - size * s.z.max() * rng.random(s.z.size))


def marked(*quick: str) -> list[Any]:
    """Return all cases; those that are not quick are marked as slow."""
    return [
        pytest.param(name, marks=[pytest.mark.slow] * (name not in quick))
        for name in CASES
    ]


KINDS: tuple[Callable[[Solution, float, np.random.Generator], Solution], ...] = (
    _noise, _wrong_active_set, _scaled, _truncated, _infeasible,
)  # fmt: skip


def violations(name: str, count: int) -> list[str]:
    """Disturb the solution at random; return a message for each violated bound."""
    problem, told = known(name), []
    rng = np.random.default_rng(sum(map(ord, name)))
    for i in range(count):
        kind, size = KINDS[i % len(KINDS)], 10 ** rng.uniform(-10, 0.5)
        s = kind(problem.solution(), size, rng)
        try:
            found = certify(problem.mechanics, s)
        except UncertifiableError:
            told.append(f"{kind.__name__} {size:.1e}: no certificate")
            continue
        if not holds(problem, s, found):
            told.append(f"{kind.__name__} {size:.1e}: bound {found.bound:.3e}")
    return told


@pytest.mark.parametrize("name", marked(*QUICK[1:]))
def test_no_disturbed_solution_exceeds_its_bound(name):
    assert violations(name, 20) == []


@pytest.mark.slow
@pytest.mark.parametrize("name", CASES)
def test_none_of_ten_thousand_errors_exceeds_its_bound(name):
    assert violations(name, PERTURBATIONS // len(CASES)) == []


@pytest.mark.parametrize("name", marked(*QUICK))
def test_the_bound_of_the_solution_is_that_of_rounding(name):
    problem = known(name)
    assert problem.exact.bound < 1e-8
    assert certify(problem.mechanics, problem.solution()).bound < 1e-7


def beyond(solver: Solver, qp: QP) -> bool:
    """Return True if a dense active-set solver would take many minutes."""
    return solver in (SOLVERS["highs"], SOLVERS["daqp"]) and qp.P.shape[0] > 3000


def effectivities(name: str, form: str, labels: Sequence[str]) -> list[float]:
    """Return bound/error of the pairs from answers of solvers at tol 1e-3 to 1e-8."""
    problem, found = known(name), []
    case = parse(f"{name}/{form}", PROBLEMS).build(reference_solution)
    assert case.mechanics is not None
    for solver in (SOLVERS[label] for label in labels):
        if solver.declines(case.qp) is not None or beyond(solver, case.qp):
            continue
        for tol in (1e-3, 1e-4, 1e-5, 1e-6, 1e-7, 1e-8):
            s = solver.prepare(case.qp, tol)()
            if not has_point(s):
                continue
            s = case.mechanics.to_primal(s)
            c = certify(case.mechanics, s)
            assert holds(problem, s, c)
            true = np.hypot(problem.error(c.u), problem.error(c.equilibrium))
            # for smaller errors, the reference is too inaccurate
            if true > 10 * problem.slack:
                found.append(c.pair / true)
    return found


def forms_of(names: Sequence[str]) -> list[tuple[str, str]]:
    return [(n, form) for n in names for form in PROBLEMS[n.partition("/")[0]].forms]


@pytest.mark.parametrize(
    "names",
    [
        (CASES[0], CASES[7]),
        pytest.param((CASES[0], CASES[3], CASES[7]), marks=pytest.mark.slow),
    ],
)
def test_bounds_of_solver_answers_are_sharp(names):
    cases = forms_of(names)
    labels = ("smalbe", "clarabel", "piqp")
    found = [e for case in cases for e in effectivities(*case, labels)]
    assert len(found) > 70
    assert np.median(found) <= 3
    assert min(found) >= 1 / ROUNDED


@pytest.mark.parametrize(
    "names",
    [
        ("cube-wall/n=2",),
        pytest.param(("cube-wall/n=3", "hertz-sphere/n=1"), marks=pytest.mark.slow),
    ],
)
def test_bounds_in_3d_are_sharp(names):
    labels = ("smalbe", "clarabel", "piqp", "osqp")
    cases = forms_of(names)
    found = [e for case in cases for e in effectivities(*case, labels)]
    assert len(found) > 50
    assert np.median(found) <= 2
    assert min(found) >= 1 / ROUNDED


@pytest.mark.slow
@pytest.mark.parametrize("name", CASES)
def test_bounds_of_all_solvers_are_sharp(name):
    fleet = ("smalbe", "osqp", "clarabel", "proxqp", "piqp", "scs", "highs", "daqp")
    found = [e for case in forms_of((name,)) for e in effectivities(*case, fleet)]
    assert np.median(found) <= 3
    assert min(found) >= 1 / ROUNDED


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


@pytest.mark.parametrize("name", marked("contact-patch", "obstacle/n=8"))
@pytest.mark.parametrize("size", [1e160, 1e300])
def test_answers_that_overflow_have_no_certificate_or_a_valid_one(name, size):
    problem = known(name)
    s = problem.solution()
    for far in (replace(s, x=size * (1 + s.x)), replace(s, z=size * (1 + s.z))):
        try:
            found = certify(problem.mechanics, far)
        except UncertifiableError:
            continue
        assert found.bound >= 1
        assert np.isfinite(found.error)


@pytest.mark.parametrize("name", marked(*QUICK))
def test_a_huge_error_is_relative_to_the_solution(name):
    """The answer −10u* has the relative error 11, since errors are relative to ‖u*‖."""
    problem = known(name)
    s = problem.solution()
    found = certify(problem.mechanics, replace(s, x=-10 * s.x, z=0 * s.z))
    assert found.bound * problem.exact.norm >= problem.error(-10 * s.x.astype(Real))


def test_equal_points_are_certified_once_and_others_again(tmp_path, monkeypatch):
    calls = []

    def counted(case, s):
        calls.append(s)
        return certified(case, s)

    monkeypatch.setattr(cases, "certified", counted)
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
        return made.answer(dict(at))["bounds"]

    first, again = bounds(s), bounds(s)
    other = bounds(replace(s, x=s.x * (1 + 1e-3)))

    assert len(calls) == 2
    assert first.pop("certify_seconds") > 0
    assert again == first
    assert other["energy_bound"] > 10 * first["energy_bound"]
