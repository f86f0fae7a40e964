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

Errors are relative to ‖u*‖, of which the pair gives a lower bound, ‖û‖ − √(2g) or a
like one. That differs from ‖û‖ only for answers that are as far off as they are large.

Where contact alone holds a body, λ̂ has to balance its load as well, Rᵀ(f − Bᵀλ̂) = 0 for
its rigid motions R, or D(λ̂) = −∞; ‖·‖ is a seminorm then, that of v − RRᵀv, and of the
rigid motion itself nothing is said. KR is zero but for the rounding of K only, which
counts where bodies move far, as a stiff one on a soft one. u* is the solution for the
stored K; û and u_λ get the same rigid part, and γ = Rᵀ(û − u*). With what is left of
balance,  ρ = Rᵀ(f − Bᵀλ̂ − K u_λ),  (1) becomes

    ‖û − u*‖² + ‖u_λ − u*‖² + 2λ̂ᵀ(c − Bu*) + 2λ*ᵀ(c − Bû)
        = 2g − 2γᵀρ − 2γᵀ(KR)ᵀ(û − u* + u_λ − u*) − 2γᵀ(RᵀKR)γ                   (4)

where γ is bounded by what contact allows, and the products by |ρ|, RᵀKR and ‖KRγ‖ in
the norm of K⁺. Motions that contact does not feel (BR = 0 up to rounding) or that λ̂
does not press on are left aside, with what rounding makes of K and f along them.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from harness.mechanics import Exact, Extended, Mechanics, Real
from harness.qp import Vector
from harness.solution import Solution
from harness.verify.active_set_refinement import (
    CLOSED,
    at_bounds,
    equilibrium,
    exchanged,
    suggested,
    unconstrained_guess,
)
from harness.verify.admissible import (
    UncertifiableError,
    admissible,
    balanced,
    held_and_loose,
    relative,
)
from harness.verify.substructured import Alone, moved_together, neighbour, residual

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
    off: Vector | Extended  #: û − u_λ (n,); of substructures torn, Tû − u_λ (N,)
    norm: float  #: ‖û‖
    distance: float  #: ‖û − u_λ‖, what the solve for u_λ left undone included
    work: float  #: λ̂ᵀ(c − Bû) + Σ(g|v̂| − λ̂_t v̂) ≥ 0
    sliding: float  #: the second term alone
    rounding: float  #: charged for KR ≠ 0 and an imperfect balance, in (4)
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
        return float(np.sqrt(2 * self.gap))

    @property
    def bound(self) -> float:
        """Largest relative error of û, of u_λ and of the answer, in the energy norm.

        Infinite where the solution may be zero for all that is known.
        """
        return self._relative(self.error)

    @property
    def error(self) -> float:
        """Largest error of û, of u_λ and of the answer itself."""
        return max(self.pair, self.claimed)

    @property
    def parts(self) -> dict[str, float]:
        """What the bound is made of, as relative; see `harness.verify.verdicts`."""
        lengths = {
            "pair": self.pair,
            "distance": self.distance,
            "work": float(np.sqrt(2 * max(self.work, 0.0))),
            "answer": self.claimed,
            "moved": self.moved,
            "friction": float(np.sqrt(2 * max(self.sliding, 0.0))),
        }
        relative = {name: self._relative(value) for name, value in lengths.items()}
        return relative | {"seminorm": float(self.seminorm)}

    def _relative(self, length: float) -> float:
        if not length:
            return 0.0
        return length / self.least if self.least > 0 else np.inf


@np.errstate(all="ignore")  # a point may hold 1e300; what is not finite is refused
def certify(mechanics: Mechanics, s: Solution) -> Certificate:
    """Bound the error of `s`, as ``mechanics.back`` gives it.

    The pair is the answer's own, mended as little as possible. Where most of g is work,
    as with an interior point, whose multipliers and gaps are all positive, a pair with
    the complementarity that the answer suggests proves more, and if contact alone holds
    a body, the solution for the rows that it suggests are closed: only where the answer
    has been proved near, or that would speak of another one. The best one counts.

    Raises
    ------
    UncertifiableError
        When the answer holds NaN or inf, or no admissible pair is found near it.

    """
    if not (np.isfinite(s.x).all() and np.isfinite(s.z).all()):
        raise UncertifiableError("the answer holds NaN or inf")
    tried = list(_certificates(mechanics, s))
    found = [c for c in tried if isinstance(c, Certificate)]
    if not found:
        raise UncertifiableError(f"no admissible pair near the answer: {tried[0]}")
    best = min(found, key=lambda c: c.error)
    if best.least >= best.error or mechanics.tear is not None:
        return best
    return replace(best, least=max(best.least, _least_norm(mechanics)))


def _least_norm(mechanics: Mechanics) -> float:
    """Bound ‖u*‖ from below by a pair that owes nothing to an answer."""
    u, lam, states = exchanged(mechanics, unconstrained_guess(mechanics))
    try:
        return proof(mechanics, u, u, lam, states == CLOSED).least
    except UncertifiableError:
        return 0.0


def _certificates(mechanics: Mechanics, s: Solution) -> Iterator[Certificate | str]:
    """Yield what the answer's own pair proves and, if that is mostly work, others."""
    exact, u = mechanics.exact, s.x.astype(Real)
    u[exact.held] = 0
    multipliers = mechanics.multipliers(s).astype(Real)
    multipliers = np.clip(multipliers, exact.lower, exact.upper)
    states = suggested(exact, u, multipliers)
    tidied = at_bounds(exact, states, multipliers), states == CLOSED
    pairs = [(multipliers, np.zeros(multipliers.size, dtype=bool)), tidied]
    if mechanics.tear is not None:
        pairs.reverse()  # of large problems what mostly is enough comes first
    proven = np.inf
    for pair in pairs:
        found = _proved(mechanics, s.x, u, *pair)
        yield found
        if is_sharp(found):
            return
        proven = min(proven, found.bound if isinstance(found, Certificate) else np.inf)
    exchangeable = mechanics.tear is None and mechanics.kernel.shape[1] > 0
    if exchangeable and GOOD < proven <= NEAR:
        v, mu, states = exchanged(mechanics, states, EXCHANGES)
        yield _proved(mechanics, s.x, v, mu, states == CLOSED)


def _proved(mechanics: Mechanics, *pair: Any) -> Certificate | str:
    """Evaluate the proof, or say why there is none."""
    prove = proof if mechanics.tear is None else _substructured_proof
    try:
        return prove(mechanics, *pair)
    except UncertifiableError as e:
        return str(e)


def is_sharp(found: Certificate | str) -> bool:
    """Whether another pair would not prove much more."""
    return isinstance(found, Certificate) and (
        found.work <= NEARLY * found.distance**2 or found.bound <= GOOD
    )


def proof(
    mechanics: Mechanics, claimed: Vector | Extended, u: Extended,
    multipliers: Extended, closed: Any,
) -> Certificate:  # fmt: skip
    """Evaluate (4) and (3) for the pair that mending u and λ yields.

    Raises
    ------
    UncertifiableError
        When they cannot be mended.

    """
    exact, motions = mechanics.exact, mechanics.motions
    feasible = admissible(mechanics, u, closed)
    if feasible is None:
        raise UncertifiableError("the answer penetrates beyond repair")
    gaps = -exact.motion(feasible)
    lam = balanced(mechanics, multipliers, feasible)
    alpha = motions.felt.T @ feasible
    force = exact.f - exact.B.T @ lam - motions.KR @ alpha
    deformed, left = equilibrium(mechanics, force)
    at_rest = deformed + motions.felt @ alpha
    apart = mechanics.norm(feasible - at_rest)
    works = exact.friction_work(feasible) + lam * gaps
    total = apart + left
    square = total * total + 2 * float(works.sum())
    unbalanced = motions.felt.T @ force - motions.KR.T @ deformed
    held, _ = held_and_loose(motions.G, relative(exact.interior(lam)))
    rounding = _rounding(
        mechanics, _reach(mechanics, held, lam, gaps, square), unbalanced, left, square
    )
    middle = (feasible + at_rest) * Real(0.5)
    return _certificate(
        exact, mechanics.kernel.shape[1] > 0,
        u=feasible, multipliers=lam, off=feasible - at_rest,
        norms=[mechanics.norm(v) for v in (feasible, at_rest, middle)],
        apart=apart, left=left, works=works, rounding=rounding,
        from_middle=_length(mechanics, claimed - middle, held),
        moved=mechanics.norm(claimed - feasible),
    )  # fmt: skip


def _certificate(
    exact: Exact, seminorm: bool, *, u: Extended, multipliers: Extended,
    off: Vector | Extended, norms: list[float], apart: float, left: float,
    works: Extended, rounding: float, from_middle: float, moved: float,
) -> Certificate:  # fmt: skip
    """Put the terms of (2) and (3) together.

    Parameters
    ----------
    norms : of û, of u_λ and of M
    apart, left : ‖û − u_λ‖ as computed, and what the solve for u_λ left undone
    works : (m,) that make up `work`
    from_middle : from the answer to M

    Raises
    ------
    UncertifiableError
        When the answer is too large for arithmetic.

    """
    total, nearest = apart + left, apart - left
    work = float(works.sum())
    gap = 0.5 * (total * total + 2 * work + rounding)
    around = np.sqrt(max(gap - 0.25 * max(nearest, 0.0) * nearest, 0.0)) + left / 2
    pair = np.sqrt(2 * gap)
    found = Certificate(
        u=u, multipliers=multipliers, off=off, norm=norms[0],
        distance=total, work=work, sliding=float(works[~exact.contact].sum()),
        rounding=rounding, claimed=from_middle + float(around),
        least=float(max(norms[0] - pair, norms[1] - left - pair, norms[2] - around)),
        moved=moved, seminorm=seminorm,
    )  # fmt: skip
    if not np.isfinite(found.error):
        raise UncertifiableError("the answer is too large for arithmetic")
    return found


def _substructured_proof(
    mechanics: Mechanics, claimed: Vector | Extended, u: Extended,
    multipliers: Extended, closed: Any,
) -> Certificate:  # fmt: skip
    """Evaluate (1) and (3) with the u_λ of `harness.verify.substructured`.

    Raises
    ------
    UncertifiableError
        When u or λ cannot be mended.

    """
    exact = mechanics.exact
    feasible = admissible(mechanics, u, closed)
    if feasible is None:
        raise UncertifiableError("the answer penetrates beyond repair")
    lam = balanced(mechanics, multipliers, feasible)
    rho, square = residual(mechanics, feasible, lam)
    near = neighbour(
        mechanics.substructures, exact.held, rho.astype(np.float64),
        moved_together(mechanics), Alone(),
    )  # fmt: skip
    force = mechanics.substructures.spread.T @ near.Kd
    moved = mechanics.still(claimed - feasible).astype(np.float64)
    return torn_certificate(
        exact, mechanics.kernel.shape[1] > 0, u=feasible, multipliers=lam, off=near.d,
        works=exact.friction_work(feasible) - lam * exact.motion(feasible),
        energies=Energies(
            square, float(mechanics.still(feasible) @ force), float(near.d @ near.Kd),
            float(moved @ (mechanics.primal.P @ moved)), float(moved @ force),
            near.left,
        ),
    )  # fmt: skip


class Energies(NamedTuple):
    """Products in K_T of û, of d = Tû − u_λ, and of u − û from û to the answer."""

    u_u: float
    u_d: float
    d_d: float
    moved_moved: float
    moved_d: float
    left: float  #: of what is left of d, with itself


def torn_certificate(
    exact: Exact, seminorm: bool, *, u: Extended, multipliers: Extended, off: Vector,
    works: Extended, energies: Energies,
) -> Certificate:  # fmt: skip
    """Put the terms of (1) and (3) together, of u_λ = Tû − d."""
    e = energies

    def length(square: float) -> float:
        return float(np.sqrt(max(square, 0.0)))

    return _certificate(
        exact, seminorm, u=u, multipliers=multipliers, off=off, works=works,
        norms=[
            length(e.u_u), length(e.u_u - 2 * e.u_d + e.d_d),
            length(e.u_u - e.u_d + 0.25 * e.d_d),
        ],
        apart=length(e.d_d), left=length(e.left), rounding=0.0,
        from_middle=length(e.moved_moved + e.moved_d + 0.25 * e.d_d),
        moved=length(e.moved_moved),
    )  # fmt: skip


def _length(mechanics: Mechanics, v: Extended, held: NDArray[np.float64]) -> float:
    """Return ‖v‖, or √(vᵀKv) with the motions that are held where it is larger."""
    R = mechanics.motions.felt @ held
    deformed = mechanics.still(v)
    whole = deformed + R @ (R.T @ v)
    squares = [x @ (mechanics.stiffness @ x) for x in (deformed, whole)]
    return float(np.sqrt(max(*squares, Real(0))))


def _rounding(
    mechanics: Mechanics, reach: _Reach, unbalanced: Extended, left: float,
    square: float,
) -> float:  # fmt: skip
    """Charge what rounding left of KR = 0 and of the balance: what (4) adds to 2g.

    unbalanced : (p,)  Rᵀ(f − Bᵀλ̂ − Ku_λ)
    square : 2g without it
    """
    motions, turn = mechanics.motions, reach.held
    strain = np.sqrt(np.maximum(np.diag(turn.T @ motions.strain @ turn), 0))
    curvature = np.abs(turn.T @ motions.curvature @ turn)
    force = np.abs(turn.T @ unbalanced).astype(np.float64) + strain * left

    def charged(square: float) -> float:
        gamma = reach.within(square)
        bent = np.sqrt(8 * square) * (gamma @ strain)
        return float(2 * (gamma @ force) + bent + 2 * (gamma @ curvature @ gamma))

    charge = 0.0
    for _ in range(200):
        if (least := charged(square + charge)) <= charge:
            return charge
        charge = 1.01 * least
    return np.inf


class _Reach(NamedTuple):
    """How far the rigid motions of û and u* can be apart, by the errors of the pair."""

    held: NDArray[np.float64]  #: (p, h) of the motions that λ̂ holds
    gaps: Vector  #: (h,) without errors
    error: Vector  #: (h,) per ‖û − u*‖
    square: Vector  #: (h,) per sum of the squares of both errors

    def within(self, square: float) -> Vector:
        """Bound the motions where the squares of both errors have this sum."""
        return np.asarray(
            self.gaps + self.error * np.sqrt(square) + self.square * square
        )


def _reach(
    mechanics: Mechanics, held: NDArray[np.float64], lam: Extended, gaps: Extended,
    square: float,
) -> _Reach:  # fmt: skip
    """Bound the rigid part γ of û − u* by what contact allows.

    Rows of u* are not violated, −Gγ ≤ c − Bû + φ‖û − u*‖, and those that λ̂ presses are
    nearly closed,  Gγ ≤ φ‖û − u*‖ + square/2λ̂,  since λ̂ᵀ(c − Bu*) ≤ square/2. Rows of
    friction are bounded likewise on both sides, by square/2 over what λ̂ lacks to either
    bound: (g − λ̂) v* ≤ square/2 where v* > 0, and (g + λ̂)(−v*) where not. Nonnegative
    combinations of these inequalities that yield ±γₖ bound it; any will do, and what
    seems cheap at `square` is preferred. Motions that λ̂ does not hold are left aside as
    those that contact does not feel: what rounding makes of K along them is not part of
    the problem.
    """
    if not held.shape[1]:
        return _Reach(held, *np.zeros((3, 0)))
    exact, tiny = mechanics.exact, np.finfo(float).tiny
    G, phi = mechanics.motions.G.astype(np.float64), mechanics.compliance
    down, up = lam > exact.lower, lam < exact.upper
    below = np.maximum((lam - exact.lower)[down].astype(np.float64), tiny)
    above = np.maximum((exact.upper - lam)[up].astype(np.float64), tiny)
    open_by = np.maximum(np.where(exact.contact, 0, -gaps)[down], 0)
    parts = np.stack([
        np.append(np.maximum(gaps, 0)[up], open_by).astype(np.float64),
        np.append(phi[up], phi[down]),
        np.append(0.5 / above, 0.5 / below),
    ])  # fmt: skip
    cost = np.array([1.0, np.sqrt(square), square]) @ parts + np.finfo(float).tiny
    columns = (np.vstack([-G[up], G[down]]) / cost[:, None]).T
    size = np.abs(columns).max()
    found = np.zeros((3, held.shape[1]))
    for k, motion in enumerate(held.T):
        for target in (motion, -motion):
            y = _combination(columns / size, target)
            found[:, k] = np.maximum(found[:, k], parts @ (y / size / cost))
    # what the combinations miss of ±γₖ is at most MISSED of the largest
    return _Reach(held, *(v + 2 * MISSED * v.sum() for v in found))


def _combination(columns: NDArray[np.float64], target: Vector) -> Vector:
    """Find y ≥ 0 with  columns·y = target  (p,); infinite where none is found."""
    from scipy.optimize import nnls  # late: it takes long, and workers need none

    try:
        y, left = nnls(columns, target)
    except RuntimeError:  # it has an iteration limit
        left = np.inf
    return y if left <= MISSED else np.full(columns.shape[1], np.inf)
