"""A proven bound of the error of an answer, whoever gave it and whatever they claim.

Let û be admissible (u = 0 where prescribed, Bû ≤ c) and λ̂ ≥ 0, and let u_λ be the
equilibrium under it,  K u_λ = f − Bᵀλ̂.  With the solution u* and its multipliers λ*,

    ½‖û − u*‖² + ½‖u_λ − u*‖² + λ̂ᵀ(c − Bu*) + λ*ᵀ(c − Bû) = J(û) − D(λ̂)
                                                = ½‖û − u_λ‖² + λ̂ᵀ(c − Bû)     (1)

in the energy norm ‖·‖_K, where J is the primal and D the dual objective: an identity of
Prager and Synge (1947) with the complementarity of contact. All terms on the left are
nonnegative, so that the right, which needs no solution, bounds both errors:

    ‖û − u*‖² + ‖u_λ − u*‖² ≤ 2g,      g = J(û) − D(λ̂)                           (2)

Friction with a bound, Σ g|v| with the slip v = Tu − s, has multipliers |λ̂_t| ≤ g and
adds to (1) its own terms, none of them negative either: Σ(g|v*| − λ̂_t v*) and
Σ(g|v̂| − λ_t* v̂) on the left, and on the right Σ(g|v̂| − λ̂_t v̂), the work that friction
would do less if it were as λ̂_t says. Of Coulomb's law the bounds g are given here: what
is proven is about the last problem of its fixed point.

(Subtracting J and D would lose everything below 1e-8: they agree to as many digits as
the answer.) A point u that is neither of the two lies near their midpoint M, since (2)
says that  ‖u* − M‖² ≤ g − ¼‖û − u_λ‖²,  hence

    ‖u − u*‖ ≤ ‖u − M‖ + √(g − ¼‖û − u_λ‖²)                                      (3)

where no more than √(2g) is left of the right-hand side if u is û or u_λ.

Errors are relative to ‖u*‖, of which (3) gives a lower bound, ‖M‖ less the root. That
differs from ‖û‖ only for answers that are as far off as they are large.

Where contact alone holds a body, λ̂ has to balance its load as well, Rᵀ(f − Bᵀλ̂) = 0 for
its rigid motions R, or D(λ̂) = −∞; ‖·‖ is a seminorm then, that of v − RRᵀv, and of the
rigid motion itself nothing is said. Motions that contact does not feel (BR = 0 up to
rounding) or that λ̂ does not press on are left aside, with what rounding makes of K and
f along them.

All of this is evaluated for the stored K = TᵀK_T T + E, with subdomains or as one, see
`harness.verify.substructured`. With e = û − u* = e' + Rγ, ρ = Kû − f + Bᵀλ̂, any d, and
u_λ = Tû − d, (1) becomes, (R2) of docs/certificates.md,

    ‖Te‖² + ‖Te − d‖² + 2λ̂ᵀ(c − Bu*) + 2λ*ᵀ(c − Bû)
        = ‖d‖² + 2λ̂ᵀ(c − Bû) + 2eᵀ(ρ − TᵀK_T d) − 2eᵀEe                          (4)

where the last two terms are rounding: (R3) bounds them by ‖e'‖ and γ, and (R4) bounds γ
by what contact allows.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mortarbench.harness.mechanics import Exact, Extended, Mechanics, Real
from mortarbench.harness.qp import Vector
from mortarbench.harness.solution import Solution
from mortarbench.harness.verify.active_set_refinement import (
    CLOSED,
    at_bounds,
    exchanged,
    suggested,
    unconstrained_guess,
)
from mortarbench.harness.verify.admissible import (
    UncertifiableError,
    admissible,
    balanced,
    relative,
    supported_and_floating,
)
from mortarbench.harness.verify.substructured import (
    Rounding,
    Split,
    Undivided,
    length,
    neighbour,
    without_rigid_motion,
)

__all__ = ["Certificate", "UncertifiableError", "certify", "proof"]

MISSED = 1e-9  #: what a combination of rows may miss of the motion that it bounds
NEARLY = 0.05  #: of the distance squared: work that another pair would not lessen
GOOD = 1e-7  #: bound from which on it is not worth the time to find one
NEAR = 1e-3  #: bound up to which the closed rows of an answer may stand for it
EXCHANGES = 5  #: rounds of exchange to find one


@dataclass(frozen=True, eq=False, kw_only=True)
class Certificate:
    """An admissible pair near an answer, and what it proves; see the module.

    All norms are ‖·‖_K, without dimensions.
    """

    u: Extended  #: û (n,)
    multipliers: Extended  #: λ̂ (m,), of the contact, then of the friction
    off: Extended  #: û − u_λ (n,); of substructures torn, Tû − u_λ (N,)
    norm: float  #: ‖û‖
    distance: float  #: ‖û − u_λ‖, what the solve for u_λ left undone included
    work: float  #: λ̂ᵀ(c − Bû) + Σ(g|v̂| − λ̂_t v̂) ≥ 0
    sliding: float  #: the second term alone
    rounding: float  #: charged for KR ≠ 0 and an imperfect balance, in (4)
    stretch: float  #: at least ‖·‖_K over the norm of the torn K, ‖T·‖
    claimed: float  #: bound (3) of the answer itself
    least: float  #: lower bound of ‖u*‖
    moved: float  #: ‖u − û‖, from the answer to the admissible point
    seminorm: bool  #: whether some body can move rigidly: nothing bounds that

    @property
    def equilibrium(self) -> Extended:
        """u_λ (n,) of bodies in one piece."""
        return np.asarray(self.u - self.off)

    @property
    def gap(self) -> float:
        """The duality gap  g = J(û) − D(λ̂)."""
        return 0.5 * self.distance * self.distance + self.work + 0.5 * self.rounding

    @property
    def pair(self) -> float:
        """√(2g): bound (2) of both errors together."""
        return _root(2 * self.gap)

    @property
    def bound(self) -> float:
        """Largest relative error of û, of u_λ and of the answer, in the energy norm.

        Infinite where the solution may be zero for all that is known.
        """
        return self._relative(self.error)

    @property
    def error(self) -> float:
        """Largest error of û, of u_λ and of the answer itself."""
        return max(self.pair * self.stretch, self.claimed)

    @property
    def parts(self) -> dict[str, float]:
        """What the bound is made of, as relative; see `harness.verify.verdicts`."""
        lengths = {
            "pair": self.pair,
            "distance": self.distance,
            "work": _root(2 * self.work),
            "answer": self.claimed,
            "moved": self.moved,
            "friction": _root(2 * self.sliding),
        }
        relative = {name: self._relative(value) for name, value in lengths.items()}
        return relative | {"seminorm": float(self.seminorm)}

    def _relative(self, length: float) -> float:
        if not length:
            return 0.0
        return length / self.least if self.least > 0 else np.inf


@np.errstate(all="ignore")  # a point may hold 1e300; what is not finite is refused
def certify(mechanics: Mechanics, s: Solution) -> Certificate:
    """Bound the error of `s`, as ``mechanics.to_primal`` gives it.

    The pair is the answer's own, mended as little as possible. Where most of g is work,
    as with an interior point, whose multipliers and gaps are all positive, a pair with
    the complementarity that the answer suggests proves more, and if contact alone holds
    a body, the solution for the rows that it suggests are closed: only where the answer
    has been proved near, or that would speak of another one. The best one counts. If
    none of them proves anything, as for answers that are very far off, the pair near
    zero is left, which does not depend on the answer.

    Raises
    ------
    UncertifiableError
        When the answer holds NaN or inf, or no admissible pair is found near it.

    """
    if not (np.isfinite(s.x).all() and np.isfinite(s.z).all()):
        raise UncertifiableError("the answer holds NaN or inf")
    if mechanics.in_parts is not None:
        found: Certificate = mechanics.in_parts(s.x, mechanics.multipliers(s))
        return found
    split = Undivided(mechanics)
    best = sharpest(_certificates(split, s), lambda: _at_rest(split, s))
    if best.least >= best.error:
        return best
    return replace(best, least=max(best.least, _least_norm(split)))


def sharpest(
    tried: Iterator[Certificate | str], at_rest: Callable[[], Certificate | str]
) -> Certificate:
    """Return the certificate with the smallest bound.

    Parameters
    ----------
    tried : certificates by pairs near the answer, or reasons why there is none
    at_rest : evaluates the pair near zero, where no other one proves anything

    Raises
    ------
    UncertifiableError
        When none of these pairs proves anything, with the first reason.

    """
    proven = list(tried)
    found = [c for c in proven if isinstance(c, Certificate)]
    if found:
        return min(found, key=lambda c: c.error)
    last = at_rest()
    if isinstance(last, Certificate):
        return last
    raise UncertifiableError(f"no admissible pair near the answer: {proven[0]}")


def _least_norm(split: Undivided) -> float:
    """Bound ‖u*‖ from below by a pair that owes nothing to an answer."""
    mechanics = split.mechanics
    u, lam, states = exchanged(mechanics, unconstrained_guess(mechanics))
    try:
        return proof(split, u, u, lam, states == CLOSED).least
    except UncertifiableError:
        return 0.0


def _certificates(split: Undivided, s: Solution) -> Iterator[Certificate | str]:
    """Yield what the answer's own pair proves and, if that is mostly work, others."""
    mechanics = split.mechanics
    exact, u = mechanics.exact, s.x.astype(Real)
    u[exact.fixed] = 0
    multipliers = mechanics.multipliers(s).astype(Real)
    multipliers = np.clip(multipliers, exact.lower, exact.upper)
    states = suggested(exact, u, multipliers)
    tidied = at_bounds(exact, states, multipliers), states == CLOSED
    pairs = [(multipliers, np.zeros(multipliers.size, dtype=bool)), tidied]
    proven = np.inf
    for pair in pairs:
        found = _proved(split, s.x, u, *pair)
        yield found
        if is_sharp(found):
            return
        proven = min(proven, found.bound if isinstance(found, Certificate) else np.inf)
    exchangeable = mechanics.kernel.shape[1] > 0
    if exchangeable and GOOD < proven <= NEAR:
        v, mu, states = exchanged(mechanics, states, EXCHANGES)
        yield _proved(split, s.x, v, mu, states == CLOSED)


def _at_rest(split: Undivided, s: Solution) -> Certificate | str:
    """Evaluate the proof for the pair near u = 0, λ = 0."""
    exact = split.mechanics.exact
    u, lam = np.zeros(exact.f.size, dtype=Real), np.zeros(exact.c.size, dtype=Real)
    return _proved(split, s.x, u, lam, np.zeros(lam.size, dtype=bool))


def _proved(split: Undivided, *pair: Any) -> Certificate | str:
    """Evaluate the proof, or say why there is none."""
    try:
        return proof(split, *pair)
    except UncertifiableError as e:
        return str(e)


def is_sharp(found: Certificate | str) -> bool:
    """Whether another pair would not prove much more."""
    return isinstance(found, Certificate) and (
        found.work <= NEARLY * found.distance**2 or found.bound <= GOOD
    )


def proof(
    split: Undivided, claimed: Vector | Extended, u: Extended,
    multipliers: Extended, closed: Any,
) -> Certificate:  # fmt: skip
    """Evaluate (4) and (3) for the pair that mending u and λ yields.

    Raises
    ------
    UncertifiableError
        When they cannot be mended.

    """
    mechanics = split.mechanics
    feasible = admissible(mechanics, u, closed)
    if feasible is None:
        raise UncertifiableError("the answer penetrates beyond repair")
    lam = balanced(mechanics, multipliers, feasible)
    return proven(
        split, mechanics.exact, mechanics.motions.G, claimed=claimed, u=feasible,
        at_rows=feasible, multipliers=lam,
    )  # fmt: skip


def proven(
    split: Split, exact: Exact, G: Extended, *, claimed: Vector | Extended,
    u: Extended, at_rows: Extended, multipliers: Extended,
) -> Certificate:  # fmt: skip
    """Evaluate (4) and (3) for an admissible pair, wherever its parts are.

    Parameters
    ----------
    exact : the rows, on the components of `at_rows`
    G : (m, p) what the motions do to the rows that contact feels
    u, at_rows : û (n,), and at the components (w,) of the rows

    Raises
    ------
    UncertifiableError
        When the answer is too large for arithmetic.

    """
    lam, motion = multipliers, exact.motion(at_rows)
    works = exact.friction_work(at_rows) - lam * motion
    work = float(works.sum())
    at_u = split.residual(u)
    near = neighbour(split, at_u.rho + split.pulled(lam))
    drift = without_rigid_motion(split, claimed - u)
    moved = split.spread(drift)
    K_moved = split.product(moved)
    u_u, u_d, d_d, moved_moved, moved_d = split.total(*(
        float(a @ b) for a, b in (
            (at_u.v, at_u.Kv), (at_u.v, near.Kd), (near.d, near.Kd),
            (moved, K_moved), (moved, near.Kd),
        )
    ))  # fmt: skip
    supported, _ = supported_and_floating(G, relative(exact.interior(lam)))
    p, noise = G.shape[1], split.noise(u)
    theta, off = at_u.theta, None
    if u_u < 4 * d_d:  # û may be zero, for which θ = 0, and far from the answer
        theta = max(theta, split.residual(split.averaged(at_u.v - near.d)).theta)
        off = split.excess(drift)
    apart, left = _root(d_d), near.left + length(split, noise)
    total, nearest = apart + left, max(apart - left, 0.0)
    square = total * total + 2 * work
    known = split.rounding(supported)
    reach = _reach(split, exact, G, supported, lam, -motion, square)
    unbalanced = np.abs(supported.T @ near.unbalanced[:p])
    scattered = np.abs(supported.T) @ split.scattered(noise)[:p]
    pull = (unbalanced + scattered).astype(np.float64)
    rounding = _charge(reach, known, pull, theta, square)
    if np.isinf(rounding) and np.isfinite(square):
        raise UncertifiableError(
            "the answer is too far off: along rigid motions that large, rounding of "
            "the stiffness outweighs all that contact holds"
        )
    gap = 0.5 * (square + rounding)
    around = _root(gap - 0.25 * nearest * nearest) + left / 2
    from_middle = _root(moved_moved + moved_d + 0.25 * d_d)
    further = np.abs(supported.T @ split.along(claimed - u)[:p]).astype(np.float64)
    gamma = reach.within(2 * gap) + further
    in_K = known.stored(from_middle + around, gamma, theta)
    if off is not None:  # K_T does not feel bodies that move with their supports
        turned = np.abs(supported.T @ split.along(off[0])[:p]).astype(np.float64)
        pull_off = _root(2 * gap) * length(split, off[0]) + gamma @ turned
        in_K = float(np.hypot(in_K, _root(off[1] + 2 * pull_off)))
    stretch = _root(1 + theta)
    # ‖M‖ − around: never below ‖û‖ − √(2g) or ‖u_λ‖ − √(2g), but for what was left
    least = _root(u_u - u_d + 0.25 * d_d) - around
    found = Certificate(
        u=u, multipliers=lam, off=near.d, norm=_root(u_u), distance=total, work=work,
        sliding=float(works[~exact.contact].sum()), rounding=rounding, claimed=in_K,
        stretch=stretch, least=least / stretch, moved=_root(moved_moved),
        seminorm=near.unbalanced.size > 0,
    )  # fmt: skip
    if not np.isfinite(found.error):
        raise UncertifiableError("the answer is too large for arithmetic")
    return found


def _root(square: float) -> float:
    return float(np.sqrt(max(square, 0.0)))


def _charge(
    reach: _Reach, known: Rounding, pull: Vector, theta: float, square: float
) -> float:
    """Charge the rounding terms (R3) of (4): q at its smallest fixed point.

    pull : (h,) sizes of Rᵀ(ρ − TᵀK_T d) along the motions that are held
    square : 2g without it
    """

    def charged(square: float) -> float:
        gamma = reach.within(square)
        bent = known.work(_root(square), gamma, theta)
        return float(2 * (gamma @ pull) + 2 * bent)

    charge = 0.0
    for _ in range(200):
        if (least := charged(square + charge)) <= charge:
            return charge
        charge = 1.01 * least
    return np.inf


class _Reach(NamedTuple):
    """How far the rigid motions of û and u* can be apart, by the errors of the pair."""

    gaps: Vector  #: (h,) without errors
    error: Vector  #: (h,) per ‖û − u*‖
    square: Vector  #: (h,) per sum of the squares of both errors

    def within(self, square: float) -> Vector:
        """Bound the motions where the squares of both errors have this sum."""
        return np.asarray(
            self.gaps + self.error * np.sqrt(square) + self.square * square
        )


def _reach(
    split: Split, exact: Exact, G: Extended, supported: NDArray[np.float64],
    lam: Extended, gaps: Extended, square: float,
) -> _Reach:  # fmt: skip
    """Bound the rigid part γ of û − u* by what contact allows.

    Any nonnegative combination y of the inequalities (R4) that yields ±γₖ bounds it.
    One that seems cheap at `square` is taken, where Bᵢdiag(K)⁻¹Bᵢᵀ stands for the
    compliance of a row; then ‖Σ±yᵢBᵢ‖ is measured in the dual norm. Motions that λ̂ does
    not hold are left aside as those that contact does not feel: what rounding makes of
    K along them is not part of the problem.
    """
    if not supported.shape[1]:
        return _Reach(*np.zeros((3, 0)))
    tiny = np.finfo(float).tiny
    phi, motions = np.sqrt(exact.compliance.astype(np.float64)), G.astype(np.float64)
    down, up = lam > exact.lower, lam < exact.upper
    below = np.maximum((lam - exact.lower)[down].astype(np.float64), tiny)
    above = np.maximum((exact.upper - lam)[up].astype(np.float64), tiny)
    open_by = np.maximum(np.where(exact.contact, 0, -gaps)[down], 0)
    opened = np.append(np.maximum(gaps, 0)[up], open_by).astype(np.float64)
    soft, pressed = np.append(phi[up], phi[down]), 0.5 / np.append(above, below)
    cost = opened + np.sqrt(square) * soft + square * pressed + tiny
    columns = (np.vstack([-motions[up], motions[down]]) / cost[:, None]).T
    size = np.abs(columns).max()
    found = np.zeros((3, supported.shape[1]))
    for k, motion in enumerate(supported.T):
        for target in (motion, -motion):
            y = _combination(columns / size, target) / size / cost
            forces = np.zeros_like(lam)
            forces[up] = y[: up.sum()]
            forces[down] -= y[up.sum() :]
            bound = (
                opened @ y,
                length(split, split.pulled(forces)),
                (pressed * y).max(initial=0.0),
            )
            found[:, k] = np.maximum(found[:, k], bound)
    # what the combinations miss of ±γₖ is at most MISSED of the largest
    return _Reach(*(v + 2 * MISSED * v.sum() for v in found))


def _combination(columns: NDArray[np.float64], target: Vector) -> Vector:
    """Find y ≥ 0 with  columns·y = target  (p,); infinite where none is found."""
    from scipy.optimize import nnls  # late: it takes long, and workers need none

    try:
        y, left = nnls(columns, target)
    except RuntimeError:  # it has an iteration limit
        left = np.inf
    return y if left <= MISSED else np.full(columns.shape[1], np.inf)
