"""Proven bound on the error of an answer, without trust in the solver.

Let û be admissible (û = 0 where prescribed, Bû ≤ c), λ̂ ≥ 0, and u_λ the displacement
in equilibrium with λ̂,  K u_λ = f − Bᵀλ̂.  With the solution u* and its multipliers λ*,

    ½‖û − u*‖² + ½‖u_λ − u*‖² + λ̂ᵀ(c − Bu*) + λ*ᵀ(c − Bû) = J(û) − D(λ̂)
                                                = ½‖û − u_λ‖² + λ̂ᵀ(c − Bû)     (1)

in the energy norm ‖·‖_K, where J is the primal and D the dual objective. This is the
identity of Prager and Synge (1947) with the complementarity terms of contact. All terms
on the left are nonnegative, so the right-hand side, which does not contain the
solution, bounds both errors:

    ‖û − u*‖² + ‖u_λ − u*‖² ≤ 2g,      g = J(û) − D(λ̂)                           (2)

Friction with bounds g_t adds the work Σ g_t‖v‖ of the slip v to the energy, and its
multipliers satisfy ‖λ̂_t‖ ≤ g_t. The left-hand side of (1) then has the further terms
Σ(g_t‖v*‖ − λ̂_tᵀv*) and Σ(g_t‖v̂‖ − λ_t*ᵀv̂), which are nonnegative. The right-hand
side has the further term Σ(g_t‖v̂‖ − λ̂_tᵀv̂), the work of friction at its bound minus
the work of λ̂_t. For Coulomb's law, g_t is fixed: the certificate holds for the last
Tresca problem of the fixed-point iteration.

The gap g is not evaluated as J − D. If the error is below 1e-8, J and D agree in all
digits, and their difference consists of rounding errors. The midpoint M of û and u_λ
satisfies  ‖u* − M‖² ≤ g − ¼‖û − u_λ‖²  by (2). Hence, for any other point u,

    ‖u − u*‖ ≤ ‖u − M‖ + √(g − ¼‖û − u_λ‖²)                                      (3)

where the right-hand side is at most √(2g) if u is û or u_λ.

Errors are relative to ‖u*‖, which is bounded from below by ‖M‖ minus the root in (3).
This bound differs much from ‖û‖ only if the error is comparable with the solution.

If only contact supports a body, λ̂ must also balance its load, Rᵀ(f − Bᵀλ̂) = 0 for its
rigid motions R; otherwise D(λ̂) = −∞. For such a body, ‖v‖ is a seminorm, the energy
norm of v − RRᵀv, and the error of the rigid motion itself is not bounded. Motions that
do not change any gap or slip (BR = 0 up to rounding) or that λ̂ does not support are
disregarded. The rounding of K and f along these motions is also disregarded.

The bounds are evaluated for the stored K = TᵀK_T T + E, where T maps displacements to
their copies in one or more subdomains, K_T contains the stiffness matrices of the
subdomains, and E is rounding (`harness.verify.substructured`). Let the error e = û − u*
= e' + Rγ consist of a deformation and a rigid motion, let ρ = Kû − f + Bᵀλ̂ and u_λ =
Tû − d with any d. By (R2) of docs/certificates.md, (1) becomes

    ‖Te‖² + ‖Te − d‖² + 2λ̂ᵀ(c − Bu*) + 2λ*ᵀ(c − Bû)
        = ‖d‖² + 2λ̂ᵀ(c − Bû) + 2eᵀ(ρ − TᵀK_T d) − 2eᵀEe                          (4)

where the last two terms are rounding. Inequality (R3) of docs/certificates.md bounds
these terms by ‖e'‖ and γ, and (R4) bounds γ by the contact conditions.

If P is not a stored stiffness matrix, as for half-spaces, a proven lower bound μ > 0 on
its eigenvalues is used. Let S be the product of the sets, x̂ ∈ S, z normal to S at x̂,
and r = Px̂ + q + z. The solution x* of a QP over S without rows satisfies (Px* + q)ᵀ(x̂
− x*) ≥ 0, and zᵀ(x* − x̂) ≤ 0 holds as z is normal. The two inequalities imply ‖x̂ −
x*‖²_P ≤ rᵀ(x̂ − x*) ≤ ‖r‖‖x̂ − x*‖_P/√μ,  hence

    ‖x̂ − x*‖_P ≤ ‖r‖/√μ                                                          (5)
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mortarbench.harness.mechanics import (
    DecomposedMechanics,
    Exact,
    Extended,
    Mechanics,
    Real,
)
from mortarbench.harness.qp import QP, Vector
from mortarbench.harness.sets.blocks import norms
from mortarbench.harness.solution import Solution
from mortarbench.harness.verify.admissible import (
    UncertifiableError,
    admissible,
    balanced,
    relative,
    supported_and_floating,
)
from mortarbench.harness.verify.kkt import largest_eigenvalue
from mortarbench.harness.verify.substructured import (
    Neighbour,
    Rounding,
    Split,
    Subdomains,
    length,
    neighbour,
)

__all__ = ["Certificate", "UncertifiableError", "certify", "certify_pair", "proof"]

#: Largest residual with which a combination of rows of G counts as equal to a supported
#: motion (`_reach`).
COMBINATION_RESIDUAL = 1e-9
#: Rounding of a product with P by FFT, relative to ‖P‖‖x‖: the error of the FFT grows
#: like the logarithm of the size, and is below 30·2⁻⁵³ for 2²⁰ entries (Higham 2002,
#: Theorem 24.2, with errors of the weights of 2⁻⁵³).
PRODUCT_ROUNDING = 2.0**-46
#: Safety factor, since power iteration underestimates ‖P‖.
POWER_ITERATION_FACTOR = 2.0
#: A certificate is sharp if its `work` is at most this fraction of its squared
#: `distance` d: without work, the bound √(d² + 2·work) would decrease by less than 5 %.
SHARP_WORK = 0.05
#: Largest bound of a sharp certificate: the active rows that an answer suggests may be
#: wrong if its error is large. Without this limit, a bound of 0.64 became 1.8.
MAX_SHARP_BOUND = 1e-2
SHARP_BOUND = 1e-7  #: largest relative bound for which no further pair is tried


@dataclass(frozen=True, eq=False, kw_only=True)
class Certificate:
    """An admissible pair (û, λ̂), and the bounds that it proves for an answer.

    All norms are energy norms of non-dimensional displacements. Relations (1) to (5)
    are stated in the docstring of the module.
    """

    u: Extended  #: û (n,)
    multipliers: Extended  #: λ̂ (m,): multipliers of contact, then of friction rows
    off: Extended  #: û − u_λ (n,); with subdomains, Tû − u_λ (N,)
    norm: float  #: ‖û‖
    distance: float  #: ‖û − u_λ‖, including the error of the solve for u_λ
    work: float  #: λ̂ᵀ(c − Bû) + Σ(g_t‖v̂‖ − λ̂_tᵀv̂) ≥ 0
    sliding: float  #: second term of `work`, which is due to friction
    #: bound on the rounding terms of (4), from KR ≠ 0 and inexact equilibrium
    rounding: float
    stretch: float  #: upper bound on ‖v‖_K/‖Tv‖, where ‖Tv‖ is the energy norm in K_T
    claimed: float  #: bound (3) on the error of the answer
    least: float  #: lower bound on ‖u*‖
    moved: float  #: ‖u − û‖, distance of the answer from û
    seminorm: bool  #: True if bodies can move rigidly; see module docstring

    @property
    def equilibrium(self) -> Extended:
        """Displacement u_λ (n,); defined only for undivided bodies."""
        return np.asarray(self.u - self.off)

    @property
    def gap(self) -> float:
        """The duality gap  g = J(û) − D(λ̂)."""
        return 0.5 * self.distance * self.distance + self.work + 0.5 * self.rounding

    @property
    def pair(self) -> float:
        """√(2g), bound (2) on the errors of û and u_λ together."""
        return _root(2 * self.gap)

    @property
    def bound(self) -> float:
        """Bound on the relative errors of û, u_λ and the answer, in the energy norm.

        If the solution is not proven to be nonzero, the bound is infinite, or 0 if
        `error` is 0.
        """
        return _ratio(self.error, self.least)

    @property
    def error(self) -> float:
        """Bound on the energy norms of the errors of û, of u_λ and of the answer."""
        return max(self.pair * self.stretch, self.claimed)

    @property
    def parts(self) -> dict[str, float]:
        """Relative components of the bound; see `harness.verify.verdicts.certified`."""
        lengths = {
            "pair": self.pair,
            "distance": self.distance,
            "work": _root(2 * self.work),
            "answer": self.claimed,
            "moved": self.moved,
            "friction": _root(2 * self.sliding),
        }
        relative = {name: _ratio(v, self.least) for name, v in lengths.items()}
        return relative | {"seminorm": float(self.seminorm)}


class EigenvalueCertificate(NamedTuple):
    """Bound (5) on the error of an answer, in the norm ‖·‖_P."""

    x: Vector  #: x̂ (n,), in the sets
    z: Vector  #: (n,) vector that is normal to the sets at x̂
    distance: float  #: ‖r‖/√μ, bound on ‖x̂ − x*‖_P, including the rounding of r
    moved: float  #: upper bound on ‖x − x̂‖_P, distance of the answer from x̂
    norm: float  #: lower bound on ‖x̂‖_P, reduced by rounding errors

    @property
    def error(self) -> float:
        """Bound on the error ‖x − x*‖_P of the answer."""
        return self.moved + self.distance

    @property
    def bound(self) -> float:
        """Bound relative to ‖x*‖_P; infinite if x* is not proven to be nonzero."""
        return _ratio(self.error, self.norm - self.distance)

    @property
    def parts(self) -> dict[str, float]:
        """Relative components of the bound; see `harness.verify.verdicts.certified`."""
        least = self.norm - self.distance
        return {
            "distance": _ratio(self.distance, least),
            "answer": self.bound,
            "moved": _ratio(self.moved, least),
        }


def _ratio(length: float, least: float) -> float:
    """Return length/least; 0 if `length` is 0, inf if `least` is not positive."""
    if not length:
        return 0.0
    return length / least if least > 0 else np.inf


@np.errstate(all="ignore")  # a point may contain 1e300, and its energy may overflow
def certify_by_eigenvalue(qp: QP, s: Solution, least: float) -> EigenvalueCertificate:
    """Bound the error of x over convex sets by (5), from an eigenvalue of P.

    The point x̂ = Π(t) is the projection of t = x − (Px + q)/L onto the sets, and z =
    L(t − x̂) is normal at x̂ for any L > 0. Multipliers are not used. If
    rounding leaves ‖x̂_I‖ = (1 + δ)r on a disc I of radius r, then x̂ and z are exact
    for the radius (1 + δ)r. The larger disc moves x* by at most δ(‖q‖ + 2‖P‖‖x‖)/√μ.
    The rounding term of the residual covers this distance (docs/certificates.md).

    least : μ > 0, a proven lower bound on the eigenvalues of P

    Raises
    ------
    UncertifiableError
        If the answer contains NaN or inf or is too large, or the QP has rows.

    """
    if not np.isfinite(s.x).all():
        raise UncertifiableError("the answer contains NaN or inf")
    if qp.b.size + qp.h.size:
        raise UncertifiableError(
            "the QP has rows; expected only bounds, discs and cones"
        )
    L = largest_eigenvalue(qp)
    step = near = s.x - (qp.P @ s.x + qp.q) / L
    for one in qp.sets:
        near = one.project(near)
    z, P_near, move = L * (step - near), qp.P @ near, s.x - near
    largest = POWER_ITERATION_FACTOR * L
    size = largest * np.linalg.norm(near) + np.linalg.norm(qp.q) + np.linalg.norm(z)
    r = np.linalg.norm(P_near + qp.q + z) + PRODUCT_ROUNDING * size
    moved = move @ (qp.P @ move) + PRODUCT_ROUNDING * largest * (move @ move)
    norm = near @ P_near - PRODUCT_ROUNDING * largest * (near @ near)
    certificate = EigenvalueCertificate(
        x=near,
        z=z,
        distance=float(r / np.sqrt(least)),
        moved=_root(float(moved)),
        norm=_root(float(norm)),
    )
    if not np.isfinite(certificate.error):
        raise UncertifiableError("the answer is too large: its energy overflows")
    return certificate


def certify(mechanics: Mechanics, s: Solution) -> Certificate:
    """Bound the error of `s`, a solution returned by ``mechanics.to_primal``.

    If the bodies are decomposed, the certificate is evaluated by subdomains.

    Raises
    ------
    UncertifiableError
        See `certify_pair`.

    """
    bodies = mechanics if mechanics.subdomains is None else mechanics.subdomains()
    return certify_pair(bodies, s.x, mechanics.multipliers(s))


@np.errstate(all="ignore")  # a point may contain 1e300, and its energy may overflow
def certify_pair(
    bodies: Mechanics | DecomposedMechanics, claimed: Vector, multipliers: Vector
) -> Certificate:
    """Bound the error of a displacement; multipliers suggest admissible forces.

    Up to three pairs (û, λ̂) are tried, and the certificate with the smallest `error` is
    returned:

    1. a pair with the active rows that the answer suggests;
    2. if the first pair yields no sharp certificate: the pair of the answer, changed as
       little as admissibility requires;
    3. if no other pair proves a bound: the pair near zero, which does not depend on the
       answer.

    claimed : (n,) displacement of the answer
    multipliers : (m,) multipliers of contact, then of friction with positive bounds

    Raises
    ------
    UncertifiableError
        If the answer contains NaN or inf, or if no pair proves a bound.

    """
    if not (np.isfinite(claimed).all() and np.isfinite(multipliers).all()):
        raise UncertifiableError("the answer contains NaN or inf")
    split = Split(bodies) if isinstance(bodies, Mechanics) else Subdomains(bodies)
    outcomes = list(_certificates(split, claimed, multipliers))
    certificates = [c for c in outcomes if isinstance(c, Certificate)]
    if not certificates:
        raise UncertifiableError(f"no admissible pair near the answer: {outcomes[0]}")
    return min(certificates, key=lambda c: c.error)


def _certificates(
    split: Split, claimed: Vector, multipliers: Vector
) -> Iterator[Certificate | str]:
    """Yield certificates of pairs, or reasons for their absence, until one is sharp."""
    exact, u = split.exact, split.free(claimed.astype(Real))
    lam = exact.forces.project(multipliers.astype(Real))
    none, is_proven = np.zeros(lam.size, dtype=bool), False
    for forces, closed in suggested(exact, u, lam), (lam, none):
        outcome = _proved(split, claimed, u, forces, closed)
        yield outcome
        if is_sharp(outcome):
            return
        is_proven |= isinstance(outcome, Certificate)
    if not is_proven:
        yield _proved(split, claimed, 0 * split.exact.f, 0 * lam, none)


def suggested(
    exact: Exact, u: Extended, multipliers: Extended
) -> tuple[Extended, NDArray[np.bool_]]:
    """Return multipliers (m,) near λ, and the mask (m,) of rows that should be closed.

    A closed row holds with equality: a contact that touches, or friction that sticks.
    As in a primal-dual active set method, rows with λ + v/D inside the set Λ of
    admissible multipliers are closed, where v = Bu − c and D is the compliance of the
    row. The multipliers of all other rows are projections of λ + v/D onto Λ.
    """
    discs, softness, v = exact.forces.discs, exact.compliance, exact.motion(u)
    closed = multipliers * softness > -v
    soft = softness[discs.index].mean(axis=1, keepdims=True)
    push = multipliers[discs.index] * soft + v[discs.index]
    size, radius = norms(push)[:, None], discs.radius[:, None]
    closed[discs.index] = size < radius * soft
    nearest = np.where(closed, multipliers, 0)
    # if λD + v is zero, λ itself is the limit
    slips = ~closed[discs.index] & (size > 0)
    limits = push / np.where(size > 0, size, 1) * radius
    nearest[discs.index] = np.where(slips, limits, multipliers[discs.index])
    return nearest, closed


def _proved(split: Split, *pair: Any) -> Certificate | str:
    """Return the certificate of a pair, or the reason why it has no certificate."""
    try:
        return proof(split, *pair)
    except UncertifiableError as e:
        return str(e)


def is_sharp(outcome: Certificate | str) -> bool:
    """Return True if the bound is small, or another pair could hardly improve it."""
    if not isinstance(outcome, Certificate):
        return False
    without_work = outcome.work <= SHARP_WORK * outcome.distance**2
    return outcome.bound <= (MAX_SHARP_BOUND if without_work else SHARP_BOUND)


def proof(
    split: Split,
    claimed: Vector | Extended,
    u: Extended,
    multipliers: Extended,
    closed: Any,
) -> Certificate:
    """Evaluate bounds (4) and (3) for an admissible pair near u and λ.

    claimed : (n,) displacement of the answer
    closed : (m,) mask of the rows that û should satisfy with equality

    Raises
    ------
    UncertifiableError
        If no admissible pair is found, or if the answer is so large that its energy
        overflows, or that the rounding of the stiffness outweighs the contact forces.

    """
    feasible = admissible(split.bodies, u, closed)
    if feasible is None:
        raise UncertifiableError(
            "no displacement without penetration was found near the answer"
        )
    lam = balanced(split.bodies, multipliers, feasible)
    return _evaluated(split, claimed, feasible, lam)


def _equilibrium(
    split: Split, u: Extended, lam: Extended
) -> tuple[Neighbour, float, float, float]:
    """Return u_λ as a neighbour of û, with vᵀK_T v, vᵀK_T d and θ for v = T(û − RRᵀû).

    The residual and v are not kept, because they may be large.
    """
    rho, v, square, theta = split.residual(u)
    rho += split.pulled(lam)
    near = neighbour(split, rho)
    return near, square, float(v @ near.Kd), theta


def _evaluated(
    split: Split, claimed: Vector | Extended, u: Extended, lam: Extended
) -> Certificate:
    """Evaluate (4) and (3) for the admissible pair û (n,) and λ̂ (m,)."""
    exact, motions = split.exact, split.motions
    motion = exact.motion(u)
    pressing, sliding = (w.sum() for w in exact.missing_work(lam, motion))
    work = float(pressing + sliding)
    near, u_u, u_d, theta = _equilibrium(split, u, lam)
    drift = motions.without(claimed - u)
    moved = split.spread(drift)
    moved_moved = float(moved @ split.product(moved))
    d_d, moved_d = (float(v @ near.Kd) for v in (near.d, moved))
    weights = relative(exact.forces.interior(lam))
    supported, _ = supported_and_floating(motions.G, weights)
    p, noise = motions.G.shape[1], split.noise(u)

    def along(alpha: Extended) -> Vector:
        """Return the magnitudes (h,) of Rα along the supported motions."""
        return np.asarray(np.abs(supported.T @ alpha[:p]), dtype=np.float64)

    off = None
    # If û is small, its θ may differ from the θ of the error, and may be the ratio of
    # two rounding errors if û is a rigid motion.
    if abs(u_u) < 4 * d_d:
        v = split.spread(motions.without(u))
        of_equilibrium = split.residual(split.averaged(v - near.d)).theta
        theta = max(theta * min(1.0, abs(u_u) / d_d), of_equilibrium)
        off = split.excess(drift)
    computed, left = _root(d_d), near.left + length(split, noise)
    total, nearest = computed + left, max(computed - left, 0.0)
    square = total * total + 2 * work
    known = split.rounding(supported)
    reach = _reach(split, supported, lam, -motion, square)
    scattered = np.abs(supported.T) @ split.scattered(noise)
    pull = along(near.unbalanced) + scattered.astype(np.float64)
    rounding = _charge(reach, known, pull, theta, square)
    if np.isinf(rounding) and np.isfinite(square):
        raise UncertifiableError(
            "the error of the answer is too large: along its rigid motions, the "
            "rounding of the stiffness outweighs the contact forces"
        )
    gap = 0.5 * (square + rounding)
    around = _root(gap - 0.25 * nearest * nearest) + left / 2
    from_middle = _root(moved_moved + moved_d + 0.25 * d_d)
    gamma = reach.within(2 * gap) + along(motions.along(claimed - u))
    size = from_middle + around  # bound on ‖e'‖ in K_T
    in_K = _root(size * size + known.work(size, gamma, theta))
    # the energy in K_T of bodies that move together with their supports is zero
    if off is not None:
        turned = float(gamma @ along(motions.along(off[0])))
        pull_off = _root(2 * gap) * length(split, off[0]) + turned
        in_K = float(np.hypot(in_K, _root(off[1] + 2 * pull_off)))
    stretch = _root(1 + theta)
    # ‖M‖ − around ≥ ‖û‖ − √(2g) and ≥ ‖u_λ‖ − √(2g), up to the residual of the solve
    least = (_root(u_u - u_d + 0.25 * d_d) - around) / stretch
    certificate = Certificate(
        u=u,
        multipliers=lam,
        off=near.d,
        norm=_root(u_u),
        distance=total,
        work=work,
        sliding=float(sliding),
        rounding=rounding,
        claimed=in_K,
        stretch=stretch,
        least=least,
        moved=_root(moved_moved),
        seminorm=near.unbalanced.size > 0,
    )
    if not np.isfinite(certificate.error):
        raise UncertifiableError("the answer is too large: its energy overflows")
    if (undivided := split.undivided) is not None and undivided.lift.any():
        # errors are relative to u* + w, and ‖u* + w‖ ≥ ‖û + w‖ − ‖û − u*‖
        whole = undivided.norm(u + undivided.lift)
        return replace(certificate, least=whole - certificate.error, norm=whole)
    return certificate


def _root(square: float) -> float:
    return float(np.sqrt(max(square, 0.0)))


def _charge(
    reach: _Reach, known: Rounding, pull: Vector, theta: float, square: float
) -> float:
    """Bound the rounding terms (R3) of (4) by a fixed-point iteration.

    The rounding terms depend on the bounds on the errors, which depend on the rounding
    terms. Each iterate is increased by 1 %, so that the iteration ends above the fixed
    point. If it does not converge, the result is inf.

    pull : (h,) bounds on |Rᵀ(ρ − TᵀK_T d)| along the supported motions
    square : 2g without the rounding terms
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
    """Bounds on the rigid part of û − u*, as functions of the errors of û and u_λ."""

    gaps: Vector  #: (h,) constant terms, due to open gaps
    error: Vector  #: (h,) coefficients of ‖û − u*‖
    square: Vector  #: (h,) coefficients of ‖û − u*‖² + ‖u_λ − u*‖²

    def within(self, square: float) -> Vector:
        """Return the bounds (h,), if `square` bounds the sum of the squared errors."""
        return np.asarray(
            self.gaps + self.error * np.sqrt(square) + self.square * square
        )


def _reach(
    split: Split,
    supported: NDArray[np.float64],
    lam: Extended,
    gaps: Extended,
    square: float,
) -> _Reach:
    """Bound the rigid part γ of û − u* by the contact conditions (R4).

    A combination of the inequalities (R4) of docs/certificates.md with coefficients y ≥
    0 yields a bound if its left-hand side equals ±γₖ. A combination with a small bound
    is sought for the squared error `square`, with the compliance of row i approximated
    by Bᵢdiag(K)⁻¹Bᵢᵀ; the dual norm ‖Σ±yᵢBᵢ‖ of the result is then evaluated. Motions
    that λ̂ does not support, and motions that change neither gaps nor slip, are
    disregarded, because the rounding of K along these motions is not part of the
    problem.
    """
    if not supported.shape[1]:
        return _Reach(*np.zeros((3, 0)))
    tiny = np.finfo(float).tiny
    exact, motions = split.exact, split.motions.G.astype(np.float64)
    phi = np.sqrt(exact.compliance.astype(np.float64))
    lower, upper = exact.forces.chords(lam)
    down, up = lam > lower, lam < upper
    below = np.maximum((lam - lower)[down].astype(np.float64), tiny)
    above = np.maximum((upper - lam)[up].astype(np.float64), tiny)
    open_by = np.maximum(np.where(exact.contact, 0, -gaps)[down], 0)
    opened = np.append(np.maximum(gaps, 0)[up], open_by).astype(np.float64)
    soft, pressed = np.append(phi[up], phi[down]), 0.5 / np.append(above, below)
    cost = opened + np.sqrt(square) * soft + square * pressed + tiny
    columns = (np.vstack([-motions[up], motions[down]]) / cost[:, None]).T
    size = np.abs(columns).max(initial=0.0)
    if not size > 0:  # the costs overflow or are NaN: the error of the answer is huge
        return _Reach(*np.full((3, supported.shape[1]), np.inf))
    bounds = np.zeros((3, supported.shape[1]))
    for k, motion in enumerate(supported.T):
        for target in (motion, -motion):
            y = _combination(columns / size, target) / size / cost
            forces = np.zeros_like(lam)
            forces[up] = y[: up.sum()]
            forces[down] -= y[up.sum() :]
            bound = opened @ y, length(split, split.pulled(forces)), (pressed * y).max()
            bounds[:, k] = np.maximum(bounds[:, k], bound)
    # each combination equals ±γₖ up to COMBINATION_RESIDUAL·‖γ‖, and ‖γ‖ is at most the
    # sum of the bounds on |γₖ|
    return _Reach(*(v + 2 * COMBINATION_RESIDUAL * v.sum() for v in bounds))


def _combination(columns: NDArray[np.float64], target: Vector) -> Vector:
    """Return y ≥ 0 with columns·y ≈ target (p,), up to `COMBINATION_RESIDUAL`.

    If no such y is found, all entries of the result are inf.
    """
    # imported here, since scipy.optimize loads slowly and workers do not need it
    from scipy.optimize import nnls

    try:
        y, left = nnls(columns, target)
    except RuntimeError:  # nnls exceeded its iteration limit
        left = np.inf
    return y if left <= COMBINATION_RESIDUAL else np.full(columns.shape[1], np.inf)
