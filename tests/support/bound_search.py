"""Search for answers whose error exceeds the bound that subdomains prove.

No assembled K is stored, so that all rounding of K is sampled. Errors are relative to
the reference point of the undivided problem. Every second trial disturbs the answer
with the largest ratio of error to bound so far.
"""

from dataclasses import replace

import numpy as np

from mortarbench.harness import Solution, Status
from mortarbench.harness.crossval.references import reference_point
from mortarbench.harness.mechanics import Real
from mortarbench.harness.names import parse
from mortarbench.harness.verify.admissible import UncertifiableError
from mortarbench.harness.verify.certificate import certify_pair
from mortarbench.problems import PROBLEMS
from mortarbench.solvers.reference.solve import reference_solution
from tests.support.decomposed_bodies import mechanics_of, parts_of
from tests.support.disturbed import DISTURBANCES
from tests.support.supported_by_contact import disc_between_plates, disc_in_parts

#: variants of a disc between plates: name → arguments of `disc_between_plates`
DISCS = {
    "sliding disc": {}, "disc under rollers": {"rollers": True},
    "tilted disc": {"tilt": 0.5}, "soft disc": {"E": (70e9, 70e3, 70e9)},
}  # fmt: skip
ROUNDED = 1 + 1e-9  #: allowed ratio of error to bound; local solves are rounded


def problem_and_build(name):
    """Return the decomposed problem, and a function that builds the undivided one."""
    if name in DISCS:
        keys = DISCS[name]
        return disc_in_parts(**keys), lambda: disc_between_plates(**keys)
    case = parse(name, PROBLEMS)
    return parts_of(name), lambda: case.build(reference_solution)


def drifted(s, size, rng, rigid):
    """Move each body rigidly, by the order of size·‖x‖ to 10⁶·size·‖x‖."""
    far = 10 ** rng.uniform(0, 6) * size * np.linalg.norm(s.x)
    return replace(s, x=s.x + rigid @ (far * rng.standard_normal(rigid.shape[1])))


def pressed(s, size, rng, rigid):
    """Add a force on one row, which violates equilibrium."""
    z = s.z.copy()
    if z.size:
        z[rng.integers(z.size)] += size * np.abs(z).max() * rng.standard_normal()
    return replace(s, z=z)


def jumped(s, size, rng, rigid):
    """Disturb a range of nodes, as if a subdomain had lost its data."""
    x, (begin, end) = s.x.copy(), sorted(rng.integers(s.x.size, size=2))
    x[begin:end] += size * np.abs(s.x).max() * rng.choice([-1, 1])
    return replace(s, x=x)


def disturbed(s, rng, rigid):
    """Apply one random disturbance to an answer."""
    size, kind = 10 ** rng.uniform(-9, 0.3), rng.integers(len(DISTURBANCES) + 3)
    if kind < len(DISTURBANCES):
        return DISTURBANCES[kind](s, size, rng)
    return (drifted, pressed, jumped)[kind - len(DISTURBANCES)](s, size, rng, rigid)


class BoundSearch:
    """Comparison of certified bounds with true errors, for answers to one problem."""

    def __init__(self, name):
        problem, build = problem_and_build(name)
        self.name, self.mechanics = name, build().mechanics.whole
        self.truth = reference_point(self.mechanics, reference_solution)
        self.own = mechanics_of(problem)

    def errors(self, found, claimed):
        """Return the errors of û, answer and pair, and True if û is admissible."""
        m, parts, truth = self.mechanics, self.own.parts, self.truth
        motion, contact = m.exact.motion(found.u), m.exact.contact
        inside = (motion[contact] <= 0).all() and not found.u[m.exact.fixed].any()
        of_u, of_answer = (m.norm(v - truth.u) for v in (found.u, claimed.astype(Real)))
        off = m.without_rigid_motion(found.u - truth.u)
        jump = parts.spread.astype(Real) @ off - found.off
        torn = np.sqrt(max(float(jump @ parts.product(jump)), 0))
        return of_u, of_answer, float(np.hypot(of_u, torn)), bool(inside)

    def tried(self, s):
        """Certify an answer; return a fault or "", and the ratio of error to bound."""
        slack = self.truth.bound * self.truth.norm
        try:
            found = certify_pair(self.own, s.x, s.z)
        except UncertifiableError as e:
            return f"none: {e}", 0.0
        of_u, of_answer, of_pair, inside = self.errors(found, s.x)
        within = min(found.error, found.bound * self.truth.norm)
        holds = (
            inside and of_pair <= ROUNDED * found.pair + 2 * slack
            and max(of_u, of_answer) <= ROUNDED * within + slack
        )  # fmt: skip
        fault = "" if holds else f"bound {found.error:.3e} < {of_answer:.3e}, {of_pair}"
        return fault, max(of_answer, of_pair) / found.error

    def result(self, count):
        """Certify `count` answers; return faults and ratios of bound to error."""
        rng = np.random.default_rng(sum(map(ord, self.name)))
        start = Solution(
            status=Status.SOLVED, x=self.truth.u.astype(float), y=np.zeros(0),
            z=self.truth.multipliers.astype(float), z_box=np.zeros(0),
        )  # fmt: skip
        nearest, best, faults, sharp = start, 0.0, [], []
        for i in range(count):
            s = disturbed(nearest if i % 2 else start, rng, self.mechanics.rigid)
            fault, ratio = self.tried(s)
            if fault:
                faults.append(fault)
            elif ratio:
                sharp.append(1 / ratio)
            size = np.abs(s.x).max() / np.abs(start.x).max()
            if best < ratio and size < 10:
                nearest, best = s, ratio
        return faults, sharp
