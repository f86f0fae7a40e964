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

Errors are relative to ‖u*‖, of which the pair gives a lower bound, ‖û‖ − √(2g) or a
like one. That differs from ‖û‖ only for answers that are as far off as they are large.

Where contact alone holds a body, λ̂ has to balance its load as well, Rᵀ(f − Bᵀλ̂) = 0 for
its rigid motions R, or D(λ̂) = −∞; ‖·‖_K is a seminorm then, and of the rigid motion
itself nothing is said.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from harness.admissible import admissible, balanced
from harness.exchange import equilibrium, exchanged, unconstrained_guess
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
    least: float  #: lower bound of ‖u*‖
    moved: float  #: ‖u − û‖, from the answer to the admissible point
    seminorm: bool  #: whether some body can move rigidly: nothing bounds that

    @property
    def gap(self) -> float:
        """The duality gap  g = J(û) − D(λ̂)."""
        return 0.5 * self.distance * self.distance + self.work

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
        """What the bound is made of, as relative; see `harness.judge.certified`."""
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
        return length / self.least if self.least > 0 else np.inf


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
    best = min(_certificates(mechanics, s), key=lambda c: c.error, default=None)
    if best is None:
        raise UncertifiableError(
            "no admissible pair near the answer: it penetrates beyond repair, or its "
            "multipliers balance no load"
        )
    if best.least >= best.error:
        return best
    return replace(best, least=max(best.least, _least_norm(mechanics)))


def _least_norm(mechanics: Mechanics) -> float:
    """Bound ‖u*‖ from below by a pair that owes nothing to an answer."""
    u, lam, active = exchanged(mechanics, unconstrained_guess(mechanics))
    found = proof(mechanics, u, u, lam, active)
    return 0.0 if found is None else found.least


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
    total, nearest = apart + left, apart - left
    middle = (feasible + at_rest) * Real(0.5)
    gap = 0.5 * total * total + work
    around = np.sqrt(max(gap - 0.25 * max(nearest, 0.0) * nearest, 0.0)) + left / 2
    norms = [mechanics.norm(v) for v in (feasible, at_rest, middle)]
    pair = np.sqrt(2 * gap)
    found = Certificate(
        u=feasible, multipliers=lam, equilibrium=at_rest, norm=norms[0],
        distance=total, work=work,
        claimed=mechanics.norm(claimed - middle) + float(around),
        least=float(max(norms[0] - pair, norms[1] - left - pair, norms[2] - around)),
        moved=mechanics.norm(claimed - feasible),
        seminorm=mechanics.inverse.kernel.shape[1] > 0,
    )  # fmt: skip
    return found if np.isfinite(found.error) else None


def _unbalanced(mechanics: Mechanics, lam: Extended, apart: Extended) -> float:
    """Charge what rounding left of Rᵀ(f − Bᵀλ̂) with twice the rigid part of û − u_λ."""
    R, exact = mechanics.inverse.kernel, mechanics.exact
    return 2 * float(np.abs(R.T @ (exact.f - exact.B.T @ lam)) @ np.abs(R.T @ apart))
