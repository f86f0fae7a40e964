"""A proven bound of the error of an answer, whoever gave it and whatever they claim.

Let û be admissible (u = 0 where prescribed, Bû ≤ c) and λ̂ ≥ 0, and let u_λ be the
equilibrium under it,  K u_λ = f − Bᵀλ̂.  With the solution u* and its multipliers λ*,

    ½‖û − u*‖² + ½‖u_λ − u*‖² + λ̂ᵀ(c − Bu*) + λ*ᵀ(c − Bû) = J(û) − D(λ̂)
                                                = ½‖û − u_λ‖² + λ̂ᵀ(c − Bû)     (1)

in the energy norm ‖·‖_K, where J is the primal and D the dual objective: an identity of
Prager and Synge (1947) with the complementarity of contact. All terms on the left are
nonnegative, so that the right, which needs no solution, bounds both errors:

    ‖û − u*‖² + ‖u_λ − u*‖² ≤ 2g,      g = J(û) − D(λ̂)                           (2)

(Subtracting J and D would lose everything below 1e-8: they agree to as many digits as
the answer.) A point u that is neither of the two lies near their midpoint M, since (2)
says that  ‖u* − M‖² ≤ g − ¼‖û − u_λ‖²,  hence

    ‖u − u*‖ ≤ ‖u − M‖ + √(g − ¼‖û − u_λ‖²)                                      (3)

where no more than √(2g) is left of the right-hand side if u is û or u_λ.

Where contact alone holds a body, λ̂ has to balance its load as well, Rᵀ(f − Bᵀλ̂) = 0 for
its rigid motions R, or D(λ̂) = −∞; ‖·‖_K is a seminorm then, and of the rigid motion
itself nothing is said.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from harness.admissible import admissible, balanced
from harness.mechanics import Extended, Mechanics, Real
from harness.solution import Solution


class UncertifiableError(Exception):
    """Why there is no certificate: no admissible pair was found."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Certificate:
    """An admissible pair near an answer, and what it proves; see the module.

    All norms are ‖·‖_K, without dimensions.
    """

    u: Extended  #: û (n,)
    multipliers: Extended  #: λ̂ (m,)
    equilibrium: Extended  #: u_λ (n,)
    norm: float  #: ‖û‖
    distance: float  #: ‖û − u_λ‖, what the solve for u_λ left undone included
    work: float  #: λ̂ᵀ(c − Bû) ≥ 0
    claimed: float  #: bound (3) of the answer itself
    moved: float  #: ‖u − û‖, from the answer to the admissible point
    seminorm: bool  #: whether some body can move rigidly: nothing bounds that

    @property
    def gap(self) -> float:
        """G = J(û) − D(λ̂)."""
        return 0.5 * self.distance**2 + self.work

    @property
    def pair(self) -> float:
        """√(2g): bound (2) of both errors together."""
        return float(np.sqrt(2 * self.gap))

    @property
    def bound(self) -> float:
        """Relative error in the energy norm of û, of u_λ and of the answer itself."""
        return self._relative(max(self.pair, self.claimed))

    @property
    def parts(self) -> dict[str, float]:
        """What the bound is made of, relative to ‖û‖; see `harness.judge.certified`."""
        lengths = {
            "pair": self.pair,
            "distance": self.distance,
            "work": float(np.sqrt(2 * max(self.work, 0.0))),
            "answer": self.claimed,
            "moved": self.moved,
        }
        relative = {name: self._relative(value) for name, value in lengths.items()}
        return relative | {"seminorm": float(self.seminorm)}

    def _relative(self, length: float) -> float:
        if not length:
            return 0.0
        return length / self.norm if self.norm else np.inf


@np.errstate(all="ignore")  # a point may hold 1e300; what is not finite is refused
def certify(mechanics: Mechanics, s: Solution) -> Certificate:
    """Bound the error of `s`, a point of ``mechanics.primal`` with its multipliers.

    The pair is the answer's own, mended as little as possible. Where most of g is work,
    as with an interior point, whose multipliers and gaps are all positive, a pair with
    the complementarity that the answer suggests proves more; the better one counts.

    Raises
    ------
    UncertifiableError
        When the answer holds NaN or inf, or no admissible pair is found near it.

    """
    if not (np.isfinite(s.x).all() and np.isfinite(s.z).all()):
        raise UncertifiableError("the answer holds NaN or inf")
    best = min(_certificates(mechanics, s), key=lambda c: c.bound, default=None)
    if best is None:
        raise UncertifiableError(
            "no admissible pair near the answer: it penetrates beyond repair, or its "
            "multipliers balance no load"
        )
    return best


def _certificates(mechanics: Mechanics, s: Solution) -> Iterator[Certificate]:
    """Yield what the answer's own pair proves and, if that is mostly work, another."""
    exact, claimed = mechanics.exact, s.x.astype(Real)
    u = claimed.copy()
    u[exact.held] = 0
    multipliers = np.maximum(s.z.astype(Real), 0)
    own = proof(mechanics, claimed, u, multipliers, np.zeros(s.z.size, dtype=bool))
    if own is not None:
        yield own
        if own.work <= 0.05 * own.distance**2:
            return
    closed = multipliers * exact.loose > exact.c - exact.B @ u
    tidied = np.where(closed, multipliers, 0)
    if (other := proof(mechanics, claimed, u, tidied, closed)) is not None:
        yield other


def proof(
    mechanics: Mechanics, claimed: Extended, u: Extended, multipliers: Extended,
    closed: Any,
) -> Certificate | None:  # fmt: skip
    """Evaluate (2) and (3) for the pair that mending u and λ yields; None if none."""
    exact = mechanics.exact
    lam = balanced(mechanics, multipliers)
    feasible = admissible(mechanics, u, closed)
    if lam is None or feasible is None:
        return None
    at_rest, left = equilibrium(mechanics, exact.f - exact.B.T @ lam)
    apart = mechanics.norm(feasible - at_rest)
    work = float(lam @ (exact.c - exact.B @ feasible)) + _unbalanced(
        mechanics, lam, feasible - at_rest
    )
    gap = 0.5 * (apart + left) ** 2 + work
    rest = max(gap - 0.25 * max(apart - left, 0.0) ** 2, 0.0)
    middle = mechanics.norm(claimed - (feasible + at_rest) / 2) + left / 2
    found = Certificate(
        u=feasible, multipliers=lam, equilibrium=at_rest, norm=mechanics.norm(feasible),
        distance=apart + left, work=work, claimed=middle + float(np.sqrt(rest)),
        moved=mechanics.norm(claimed - feasible),
        seminorm=mechanics.inverse.kernel.shape[1] > 0,
    )  # fmt: skip
    return found if np.isfinite(found.pair) else None


def equilibrium(mechanics: Mechanics, force: Extended) -> tuple[Extended, float]:
    """Solve  K u = force  on the free components, zero on the others.

    Returns u and the energy norm of what one refinement left undone, √(rᵀK⁺r) with the
    residual r, in extended precision.
    """
    K, held, solve = mechanics.exact.K, mechanics.exact.held, mechanics.inverse
    R = solve.kernel
    u = np.zeros(force.size, dtype=Real)
    for _ in range(3):
        r = force - K @ u
        r[held] = 0
        r = r - R @ (R.T @ r)
        step = solve(r.astype(np.float64))
        left = float(np.sqrt(abs(r @ step)))
        u = u + step
    return u - step, left


def _unbalanced(mechanics: Mechanics, lam: Extended, apart: Extended) -> float:
    """Charge what rounding left of Rᵀ(f − Bᵀλ̂) with twice the rigid part of û − u_λ."""
    R, exact = mechanics.inverse.kernel, mechanics.exact
    return 2 * float(np.abs(R.T @ (exact.f - exact.B.T @ lam)) @ np.abs(R.T @ apart))
