"""Admissible pairs near an answer: no penetration, and forces in equilibrium.

Moving each slave node separately does not always remove every penetration, because end
nodes of an arc may be prescribed and a mortar row couples several nodes. Corrections
are therefore computed simultaneously for a set of rows.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve
from scipy.sparse import csc_array, csc_matrix, csr_array, diags_array, eye_array
from scipy.sparse.linalg import LinearOperator, cg, splu

from mortarbench.harness.mechanics import (
    MOTION_ROUNDING,
    AdmissibleForces,
    DecomposedMechanics,
    Exact,
    Extended,
    Mechanics,
    Real,
    constrained_first,
)
from mortarbench.harness.qp import Vector
from mortarbench.harness.sets.blocks import norms

MAX_ROUNDS = 20  #: largest number of corrections in `_feasible_near`
#: Largest number of rows for which F_VV is assembled. Systems with more rows are solved
#: by CG.
MAX_DENSE_ROWS = 2000
#: A combination of rigid motions counts as floating if its singular value in √W G is at
#: most this fraction of the largest singular value (`supported_and_floating`).
SUPPORT_THRESHOLD = 1e-5
#: Largest load along a motion that counts as rounding: for floating motions, relative
#: to the sum of the absolute terms of the equilibrium equation; for free motions,
#: relative to the sum of the absolute loads times the largest entry of the motion.
LOAD_ROUNDING = 1e-12
_EPS = Real(np.finfo(Real).eps)


class UncertifiableError(Exception):
    """Failure to bound the error of an answer; the message is the reason."""


def admissible(
    bodies: Mechanics | DecomposedMechanics, u: Extended, closed: NDArray[np.bool_]
) -> Extended | None:
    """Return û near u with Bû ≤ c and equality on the rows `closed`; None on failure.

    û is the point nearest to u that satisfies a set V of rows with equality. The
    inequalities hold for contact rows only. V initially consists of the closed and the
    violated rows and is extended until Bû ≤ c. If this fails and c ≥ 0, û = θu with θ ≤
    1, without equality on the closed rows. Free motions are first removed from u.
    """
    free = bodies.motions.free
    if free.shape[1]:
        u = u - free @ (free.T @ u)
    if isinstance(bodies, Mechanics):
        nearest = partial(_nearest_in_energy, bodies)
    else:
        nearest = partial(_nearest_at_rows, bodies.exact, bodies.motions.constrained)
    return _feasible_near(bodies.exact, u, closed, nearest)


def _feasible_near(
    exact: Exact,
    u: Extended,
    closed: NDArray[np.bool_],
    nearest: Callable[[NDArray[np.bool_]], Callable[[Vector], Extended]],
) -> Extended | None:
    """Move u into the feasible set, with equality on the rows V.

    The target of a correction is a few units in the last place inside the feasible set,
    so that rounding of Bu cannot hide a violation. If MAX_ROUNDS corrections do not
    suffice or overflow, the result is that of `_shrunk`. Friction rows belong to V only
    if they are closed, that is, if they stick.

    nearest : returns, for rows V, the map from violations t (v,) to a
        correction δ (n,) with B_V δ = −t
    """
    B, c, contact = exact.B, exact.c, exact.contact
    at = np.unique(B.indices)
    magnitude = abs(B[:, at])
    enforced = np.zeros_like(closed)
    moved, step = u, None
    for _ in range(MAX_ROUNDS):
        gap = c - B @ moved
        near = np.abs(moved[at])
        # the largest displacement bounds the terms of the correction
        reach = magnitude @ (16 * near + 4 * near.max(initial=Real(0)))
        margin = _EPS * (reach + 16 * np.abs(c))
        required = enforced | closed | (contact & (gap < 0))
        if not required.any():
            return u
        if (required != enforced).any():
            enforced = required
            step = nearest(enforced)
        elif (gap[contact | enforced] >= 0).all() and (
            gap[enforced] <= 4 * margin[enforced]
        ).all():
            return moved
        assert step is not None
        moved = moved + step((margin - gap)[enforced].astype(np.float64))
        if not np.isfinite(moved).all():
            return _shrunk(exact, u)
    gap = (c - B @ moved)[contact]
    return moved if (gap >= 0).all() else _shrunk(exact, u)


def _shrunk(exact: Exact, u: Extended) -> Extended | None:
    """Return θu with θ ≤ 1 such that Bθu ≤ c despite rounding; None if c ≱ 0."""
    B, c = exact.B[exact.contact], exact.c[exact.contact]
    if (c < 0).any():
        return None
    reach = B @ u
    beyond = reach > c
    theta = min((c[beyond] / reach[beyond]).min(initial=Real(1)), Real(1))
    for _ in range(8):  # rounding may leave Bθu > c: reduce θ again
        if not (B @ (theta * u) > c).any():
            return np.asarray(theta * u)
        theta = theta * (1 - 8 * _EPS)
    return np.zeros_like(u)


def _nearest_in_energy(
    mechanics: Mechanics, rows: NDArray[np.bool_]
) -> Callable[[Vector], Extended]:
    """Return the map from t (v,) to the δ of least energy norm with B_V δ = −t.

    δ = −K⁺B_Vᵀμ + Rα with F_VV μ = t + B_V Rα, where F_VV = B_V K⁺B_Vᵀ is the
    compliance of the rows.
    """
    B_V = mechanics.rows[np.flatnonzero(rows)]
    inverse, solve = mechanics.inverse, closing(mechanics, rows)
    constrained = mechanics.motions.constrained

    def step(t: Vector) -> Extended:
        mu, alpha = solve(t, np.zeros(constrained.shape[1]))
        return np.asarray(constrained @ alpha - inverse(B_V.T @ mu))

    return step


def _nearest_at_rows(
    exact: Exact, R: Any, rows: NDArray[np.bool_]
) -> Callable[[Vector], Extended]:
    """Return the map from t (v,) to δ + Rα with B_V(δ + Rα) = −t and least δ.

    δ moves only components on which the rows depend. Its norm is induced by
    diag(1/softness), which is infinite at prescribed components. The rigid motion Rα (R
    of shape (n, p)) does not contribute to this norm.
    """
    B_V = exact.B[np.flatnonzero(rows)].astype(np.float64)
    moved = csr_array((B_V * exact.softness).T)
    S = csc_array(B_V @ moved)
    shift = 1e-13 * S.diagonal().max() + np.finfo(float).tiny
    factor = splu(csc_matrix(S + shift * eye_array(S.shape[0])))
    G = (B_V @ R).toarray().astype(np.float64)
    SG = factor.solve(G) if G.size else G
    stiff = np.linalg.pinv(G.T @ SG, hermitian=True)

    def step(t: Vector) -> Extended:
        alpha = -(stiff @ (SG.T @ t))
        return np.asarray(R @ alpha - moved @ factor.solve(t + G @ alpha))

    return step


def closing(
    mechanics: Mechanics, rows: NDArray[np.bool_]
) -> Callable[[Vector, Vector], tuple[Vector, Vector]]:
    """Return a solver for multipliers μ and rigid motions α that close the rows V.

    ::

        F_VV μ − G_V α = t,    G_Vᵀμ = e,        F_VV = B_V K⁺B_Vᵀ,  G_V = B_V R

    The arguments of the solver are the violations t (v,) and the loads e (p,) along the
    motions R that change gaps or slip. α is zero along motions that do not change the
    rows V. F_VV may be singular along the range of G_V, since K⁺ may be zero at
    components that prevent rigid motions in its factorisation. F_VV is therefore
    replaced by F_VV + ρUUᵀ, where U spans the range of G_V. Rows are scaled to similar
    compliance, since the stiffnesses of bodies may differ by orders of magnitude.
    """
    if not rows.any():
        return lambda t, e: (t, 0 * e)
    exact, motions = mechanics.exact, mechanics.motions
    V = np.flatnonzero(rows)
    compliance = exact.compliance[V].astype(np.float64)
    scale = 1 / np.sqrt(np.where(compliance > 0, compliance, 1.0))
    B_V = csr_array(diags_array(scale) @ mechanics.rows[V])
    R = motions.constrained.toarray().astype(np.float64)
    turn, p = constrained_first(B_V, R)
    U, T = np.linalg.qr((B_V @ R) @ turn[:, :p])
    F = _compliance(mechanics, B_V, U)
    FU = np.stack([F(g) for g in U.T], axis=1) if p else U
    S = np.linalg.pinv(U.T @ FU, hermitian=True)

    def solve(t: Vector, e: Vector) -> tuple[Vector, Vector]:
        along = np.linalg.solve(T.T, turn[:, :p].T @ e)  # prescribed Uᵀμ
        Ft = F(scale * t)
        beta = S @ (along - U.T @ Ft)
        return scale * (Ft + FU @ beta), turn[:, :p] @ np.linalg.solve(T, beta)

    return solve


def _compliance(
    mechanics: Mechanics, B_V: Any, U: NDArray[np.float64]
) -> Callable[[Vector], Vector]:
    """Return a solver for F_VV + ρUUᵀ.

    Up to MAX_DENSE_ROWS rows, the solver is a Cholesky factorisation. The matrix may be
    singular up to rounding, so its diagonal is shifted by 1e-13 of its largest entry;
    the next round of `_feasible_near` corrects the resulting error. Larger systems are
    solved by CG with the lumped preconditioner of FETI, B_V K B_Vᵀ ≈ F_VV⁻¹.
    """
    v, inverse = B_V.shape[0], mechanics.inverse
    if v <= MAX_DENSE_ROWS:
        F = inverse.congruence(B_V)
        F += F.diagonal().mean() * (U @ U.T) if U.size else 0
        F[np.diag_indices(v)] += 1e-13 * F.diagonal().max() + np.finfo(float).tiny
        factor = cho_factor(F, lower=True)
        return lambda t: np.asarray(cho_solve(factor, t))
    rho = inverse.congruence(B_V[:MAX_DENSE_ROWS]).diagonal().mean() if U.size else 0.0

    def product(mu: Vector) -> Vector:
        mu = mu.ravel()
        return np.asarray(B_V @ inverse(B_V.T @ mu) + rho * (U @ (U.T @ mu)))

    F = LinearOperator((v, v), product)
    lumped = csc_array(B_V @ mechanics.primal.P @ B_V.T)
    M = LinearOperator((v, v), lambda t: np.asarray(lumped @ t.ravel()))
    return lambda t: np.asarray(cg(F, t, rtol=1e-8, maxiter=300, M=M)[0])


def balanced(
    bodies: Mechanics | DecomposedMechanics, multipliers: Extended, u: Extended
) -> Extended:
    """Return the λ̂ ∈ Λ nearest to `multipliers` in equilibrium with the load.

    The equations Rᵀ(f − Bᵀλ̂ − Ku) = 0 hold for the rigid motions R that change gaps or
    tangential displacements. λ̂ minimises ½Σ(λ̂ᵢ − λᵢ)²/wᵢ. The weight wᵢ is the
    relative distance of λᵢ from the boundary of Λ (for contact, wᵢ is proportional to
    λᵢ), since corrections at open gaps or slipping nodes would do work. Along motions
    that λ does not support (`supported_and_floating`), the load must vanish up to
    rounding. If this attempt fails, all rows are corrected in two further attempts, the
    last with equal weights.

    Raises
    ------
    UncertifiableError
        If contact cannot balance the load along a rigid motion: the motion does not
        change any gap or slip, or only tensile contact forces, or friction above its
        bound, could balance the load.

    """
    exact, motions = bodies.exact, bodies.motions
    if not motions.all.shape[1]:
        return multipliers
    free, f, size = motions.free, exact.f, np.abs(exact.f)
    if free.shape[1]:
        largest = abs(free).max(axis=0).toarray().ravel()
        along, terms = free.T @ f, abs(free).T @ size
        rounding = MOTION_ROUNDING * terms + LOAD_ROUNDING * size.sum() * largest
        if (np.abs(along) > rounding).any():
            pushed = bodies.rigid.T @ (free @ along)
            raise UncertifiableError(_unbalanced(pushed, bodies.names))
    if not motions.G.shape[1]:
        return multipliers
    equations = _Equilibrium(
        motions.G,
        np.asarray((abs(exact.B) @ motions.largest).toarray()),
        motions.constrained.T @ f,
        motions.largest.T @ size,
        motions.KR.T @ u,
    )
    w = relative(exact.forces.interior(multipliers))
    for weights in (w, w + 1e-6, np.ones_like(w)):
        lam = _balanced(exact.forces, equations, multipliers, weights)
        if lam is not None:
            return lam
    raise UncertifiableError(
        "only tensile contact forces could balance the load, which moves some body "
        "away from its contacts, and no support holds the body"
        if exact.contact.all()
        else "only tensile contact forces or friction above its bound could "
        "balance the load, which moves some body away from its contacts or along "
        "them, and no support holds the body"
    )


def _unbalanced(pushed: Extended, names: tuple[str, ...]) -> str:
    """Return the error message for a load that neither contact nor supports balance.

    pushed : (r,) load along each rigid motion, ordered by body
    """
    most = int(np.abs(pushed).argmax()) if pushed.size else 0
    body, where = "some body", "along a rigid motion"
    if names and pushed.size == 3 * len(names):
        body = f"body {names[most // 3]}"
        where = ("along x", "along y", "in rotation")[most % 3]
    return (
        f"nothing balances the load of {body} {where}: "
        "contact does not resist this motion, and no support prevents it"
    )


def relative(multipliers: Extended) -> Extended:
    """Divide multipliers by the largest one; return ones if none is > 0."""
    largest = multipliers.max(initial=Real(0))
    return multipliers / largest if largest > 0 else np.ones_like(multipliers)


def supported_and_floating(
    G: Extended, w: Extended
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Split the space of rigid motions (p,) into supported and floating motions.

    Rows resist a motion ν through the change Gν (m,) of their gaps, with weights w (m,)
    ≤ 1. A motion of unit norm is floating if ‖√w Gν‖ is at most SUPPORT_THRESHOLD times
    the maximum of this value over all motions of unit norm. Returns orthonormal bases
    (p, h) of supported and (p, p − h) of floating motions.
    """
    weighted = (np.sqrt(w)[:, None] * G).astype(np.float64)
    _, sizes, turn = np.linalg.svd(weighted, full_matrices=len(G) < G.shape[1])
    h = int((sizes > SUPPORT_THRESHOLD * sizes.max(initial=0.0)).sum())
    return turn[:h].T, turn[h:].T


class _Equilibrium(NamedTuple):
    """Equations Gᵀλ = load − bent, with the magnitudes of their terms."""

    G: Extended  #: (m, p)  BR
    G_terms: Extended  #: (m, p) sums of the absolute terms of G
    load: Extended  #: (p,)  Rᵀf
    load_terms: Extended  #: (p,) sums of the absolute terms of `load`
    bent: Extended  #: (p,) (KR)ᵀu, nonzero only because of rounding

    def terms(self, lam: Extended) -> Extended:
        """Return the sums (p,) of the absolute terms of each equation."""
        return np.asarray(self.load_terms + self.G_terms.T @ np.abs(lam))


def _balanced(
    forces: AdmissibleForces,
    equations: _Equilibrium,
    multipliers: Extended,
    w: Extended,
) -> Extended | None:
    """Solve the equations by correcting only rows with w > 0; return None on failure.

    λ̂ is the projection of λ + WGν onto Λ, with W = diag(w); ν minimises a convex
    function with one variable per motion.
    """
    G, load = equations.G, equations.load
    supported, floating = supported_and_floating(G, w)
    weighted = ((np.sqrt(w)[:, None] * G) @ supported).astype(np.float64)
    _, sizes, turn = np.linalg.svd(weighted, full_matrices=False)
    basis = supported @ (turn.T / sizes)  # such that GᵀWG = I in this basis
    lam = _newton(
        forces,
        multipliers,
        w,
        G @ basis,
        np.asarray(basis.T @ (load - equations.bent), dtype=Real),
        lambda lam: np.abs(basis).T @ equations.terms(lam),
    )
    if lam is None:
        return None
    missing = np.abs(floating.T @ (load - G.T @ lam))
    total = np.abs(floating).T @ equations.terms(lam)
    return lam if (missing <= LOAD_ROUNDING * total).all() else None


def _newton(
    forces: AdmissibleForces,
    multipliers: Extended,
    w: Extended,
    G: Extended,
    load: Extended,
    terms: Callable[[Extended], Extended],
) -> Extended | None:
    """Solve the equilibrium equations, scaled to GᵀWG = I; return None on failure.

    Damped Newton's method is applied to the dual function of the minimisation in
    `balanced`. Rows with w = 0 keep their multipliers.
    """
    on = w > 0

    def shifted(nu: Extended) -> tuple[Extended, Extended, Any]:
        free = multipliers + w * (G @ nu)
        lam = np.where(on, forces.project(free), multipliers)
        inner = (lam[on] / w[on]) @ (free[on] - 0.5 * lam[on])
        return free, lam, inner + multipliers[~on] @ (G[~on] @ nu) - load @ nu

    nu = np.zeros(load.size, dtype=Real)
    free, lam, value = shifted(nu)
    for _ in range(100):
        missing = load - G.T @ lam
        if (np.abs(missing) <= 64 * _EPS * terms(lam)).all():
            return np.asarray(lam)
        hessian = _curvature(forces, free, w, G).astype(np.float64)
        # The Hessian is singular if all rows that depend on a motion are at a bound.
        # The shift is relative, because GᵀWG = I.
        hessian += 1e-8 * np.eye(load.size)
        step = np.linalg.solve(hessian, missing.astype(np.float64))
        for _ in range(60):
            free, lam, trial = shifted(nu + step)
            if trial <= value - 1e-4 * (missing @ step) + 4 * _EPS * abs(value):
                break
            step = step / 2
        nu, value = nu + step, trial
    return None


def _curvature(
    forces: AdmissibleForces, free: Extended, w: Extended, G: Extended
) -> Extended:
    """Return GᵀWΠ'(λ)G (p, p) at a trial point λ (m,), with the projection Π onto Λ.

    Π' is the identity inside Λ, 0 at contact rows with λ ≤ 0, and (g/‖λ‖)(I − nnᵀ) with
    n = λ/‖λ‖ outside a disc of radius g.
    """
    discs = forces.discs
    at, size = free[discs.index], norms(free[discs.index])
    outside = size > discs.radius
    inside = np.asarray(free > 0)
    inside[discs.index] = ~outside[:, None]
    total = G[inside].T @ (w[inside, None] * G[inside])
    normal = at[outside] / size[outside, None]
    rows = G[discs.index[outside]]  # (k, d, p)
    across = rows - normal[..., None] * (normal[:, None] @ rows)
    share = w[discs.index[outside, 0]] * discs.radius[outside] / size[outside]
    return np.asarray(total + np.einsum("k,kdp,kdq->pq", share, across, across))
