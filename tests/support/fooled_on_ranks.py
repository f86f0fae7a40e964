"""Search for answers whose error exceeds the bound that ranks prove.

Errors are relative to the reference point of the undivided problem, which the first
rank builds. Every second trial disturbs the answer with the largest ratio of error to
bound so far. The search also returns the reasons for which ranks and one process refuse
loads without equilibrium. See programs_on_ranks.py.
"""

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from mortarbench.harness import Solution, Status, certify
from mortarbench.harness.mechanics import Real
from mortarbench.harness.names import parse
from mortarbench.harness.verify.admissible import UncertifiableError
from mortarbench.harness.verify.over_ranks import certify_over_ranks
from mortarbench.harness.verify.references import reference_point
from mortarbench.problems import PROBLEMS
from mortarbench.problems.feti.distributed_dual import distributed_qp, dual_on
from mortarbench.solvers.reference.solve import reference_solution
from tests.support.decomposed_bodies import parts_of
from tests.support.disturbed import DISTURBANCES
from tests.support.supported_by_contact import disc_between_plates, disc_in_parts

#: variants of a disc between plates: name → arguments of `disc_between_plates`
DISCS = {
    "sliding disc": {}, "disc under rollers": {"rollers": True},
    "tilted disc": {"tilt": 0.5}, "soft disc": {"E": (70e9, 70e3, 70e9)},
}  # fmt: skip
ROUNDED = 1 + 1e-9  #: allowed ratio of error to bound; local solves are rounded


class KnownSolution(NamedTuple):
    """Solution of the undivided problem up to rounding, on every rank."""

    u: np.ndarray  #: (n,) displacement, extended precision
    multipliers: np.ndarray  #: (m,) multipliers of contact and friction rows
    norm: float  #: energy norm ‖u‖
    slack: float  #: bound on ‖error of u‖
    rigid: np.ndarray  #: (n, 3 bodies) rigid motions of single bodies


def problem_and_build(name):
    """Return the decomposed problem, and a function that builds the undivided one."""
    if name in DISCS:
        keys = DISCS[name]
        return disc_in_parts(**keys), lambda: disc_between_plates(**keys)
    case = parse(name, PROBLEMS)
    return parts_of(name), lambda: case.build(reference_solution)


def known_solution(build, ranks):
    """Solve the undivided problem on rank 0; only rank 0 returns the mechanics."""
    mechanics, solution = None, None
    if ranks.rank == 0:
        mechanics = build().mechanics.whole
        point = reference_point(mechanics, reference_solution)
        solution = KnownSolution(
            point.u, point.multipliers, point.norm, point.bound * point.norm,
            mechanics.rigid,
        )  # fmt: skip
    return mechanics, ranks.comm.bcast(solution)


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
    """Disturb a range of nodes, as if a rank had lost its data."""
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

    def __init__(self, name, ranks):
        problem, build = problem_and_build(name)
        self.ranks, self.name = ranks, name
        self.mechanics, self.truth = known_solution(build, ranks)
        self.own = problem_of(problem, ranks)

    def errors(self, found, claimed):
        """Return the errors of û, answer and pair, and True if û is admissible."""
        own, truth = self.own, self.truth
        parts = self.ranks.comm.gather((own.components, found.u))
        still = None
        if parts is not None:
            u = np.empty(truth.u.size, dtype=Real)
            for components, part in parts:
                u[components] = part
            m = self.mechanics
            motion, contact = m.exact.motion(u), m.exact.contact
            inside = (motion[contact] <= 0).all() and not u[m.exact.fixed].any()
            lengths = [m.norm(v - truth.u) for v in (u, claimed.astype(Real))]
            still = *lengths, bool(inside), m.without_rigid_motion(u - truth.u)
        of_u, of_answer, inside, off = self.ranks.comm.bcast(still)
        jump = own.parts.spread.astype(Real) @ off[own.components] - found.off
        torn = own.reduction.total(float(jump @ own.parts.product(jump)))[0]
        return of_u, of_answer, float(np.hypot(of_u, np.sqrt(max(torn, 0)))), inside

    def tried(self, s):
        """Certify an answer; return a fault or "", and the ratio of error to bound."""
        slack = self.truth.slack
        try:
            found = certify_over_ranks(self.own, s.x[self.own.components], s.z)
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
        refused = 0
        for i in range(count):
            s = disturbed(nearest if i % 2 else start, rng, self.truth.rigid)
            fault, ratio = self.tried(s)
            refused += fault.startswith("none")
            if fault:
                faults.append(fault)
            elif ratio:
                sharp.append(1 / ratio)
            size = np.abs(s.x).max() / np.abs(start.x).max()
            if best < ratio and size < 10:
                nearest, best = s, ratio
        return {"faults": faults, "refused": refused, "sharp": sharp}


def problem_of(problem, ranks):
    """Emit a problem; return the local bodies of this rank."""
    share = distributed_qp(dual_on(problem, ranks), None)
    qp = share.share().qp
    nothing = Solution(
        status=Status.FAILED, x=0 * qp.q, y=0 * qp.b, z=qp.h, z_box=0 * qp.q
    )
    return share.answer(nothing).certifiable[0]


def refused(ranks, sign, **keys):
    """Return the reasons for which ranks and, on rank 0, one process refuse a load."""
    problem = disc_in_parts(**keys)
    own = problem_of(replace(problem, load=lambda at: sign * problem.load(at)), ranks)
    m = disc_between_plates(**keys).mechanics
    m = replace(m, primal=replace(m.primal, q=sign * m.primal.q))
    zero = Solution(
        status=Status.FAILED, x=0 * m.primal.q, y=0 * m.primal.b, z=0 * m.primal.h,
        z_box=0 * m.primal.q,
    )  # fmt: skip
    nothing = np.zeros(own.components.size)
    return (
        why(lambda: certify_over_ranks(own, nothing, zero.z)),
        why(lambda: certify(m, zero)) if ranks.rank == 0 else None,
    )


def why(certificate):
    """Return the bound that a certificate proves, or the reason for its absence."""
    try:
        return f"bound {certificate().bound}"
    except UncertifiableError as e:
        return str(e)


def results(ranks, count, *names):
    """Search in problems; return faults and refusals."""
    return {
        "searches": {n: BoundSearch(n, ranks).result(count) for n in names},
        "refusals": [refused(ranks, 1, push=0.1), refused(ranks, -1)],
    }
