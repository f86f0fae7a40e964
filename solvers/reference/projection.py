"""Reference solve of QPs over arbitrary convex sets, by projections only.

With M = [A; G; I] and C = {b} × {w ≤ h} × S, a QP is  min ½xᵀPx + qᵀx,  Mx ∈ C. A
point t of the space of Mx gives both w = Π(t) in C and multipliers λ = R(t − w) normal
to C at w, if R > 0 is diagonal and constant within each set. The remaining KKT
conditions are a zero of the normal map (Robinson 1992, Math. Oper. Res. 17),

    Px + q + MᵀR(t − Π(t)) = 0,      Mx = Π(t).                                    (1)

1. ADMM (Stellato et al. 2020, Math. Prog. Comp. 12), with penalty R, comes near this
   zero from any start. Anderson's acceleration with a safeguard (Zhang, O'Donoghue and
   Boyd 2020, SIAM J. Optim. 30) is needed for a singular P.
2. Newton's method converges to it, with Π' by difference quotients and residuals in
   extended precision. The error of the quotients, √ε, only limits the rate: it is the
   factor by which each step reduces the residual.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
from scipy.linalg import lu_factor, lu_solve

from mortarbench.harness import QP, Solution, Status, Vector

ROUNDS = 12  #: rounds of ADMM and Newton's method, each with another penalty
ADMM_STEPS = 400  #: ADMM steps in the first round; each further round adds as many
NEWTON_STEPS = 30  #: largest number of Newton steps per round
MEMORY = 10  #: iterates that an acceleration combines, and between two of them
#: shift of the normal equations of an acceleration, relative to their trace
GRAM_SHIFT = 1e-10
RELAXATION = 1.6  #: over-relaxation of ADMM, the default of OSQP
EQUALITY_PENALTY = 1e3  #: penalty of rows of A relative to the others, as in OSQP
MAX_PENALTY_CHANGE = 10.0  #: largest factor between the penalties of two rounds
DIFFERENCE_STEP = 2.0**-26  #: √ε, step of difference quotients relative to t
#: diagonal shift, relative, of the Newton matrix: it regularises dependent rows and
#: perturbs the steps, but not the zero of (1)
SHIFT = 1e-15


def projection_iterates(qp: QP) -> Iterator[Solution]:
    """Yield the point of each round; later ones took more steps."""
    n, m, p = qp.q.size, qp.b.size, qp.h.size
    P, rows = _dense(qp.P), np.vstack([_dense(qp.A), _dense(qp.G)])
    size = np.linalg.norm(rows, axis=1)
    size[size == 0] = 1
    M = np.vstack([rows / size[:, None], np.eye(n)])
    b, h = qp.b / size[:m], qp.h / size[m:]
    relative_penalty = np.array([EQUALITY_PENALTY] * m + [1.0] * (p + n))

    def project(t: Any) -> Any:
        x = t[m + p :]
        for one in qp.sets:
            x = one.project(x)
        return np.concatenate([b, np.minimum(t[m : m + p], h), x])

    rho = float(np.abs(P).max(initial=0)) or 1.0
    x, t, multipliers = np.zeros(n), np.zeros(m + p + n), np.zeros(m + p + n)
    for number in range(1, ROUNDS + 1):
        R = rho * relative_penalty
        t = project(t) + multipliers / R
        K = lu_factor(P + M.T @ (R[:, None] * M))

        def primal_point(t: Vector, R: Vector = R, K: Any = K) -> Vector:
            x: Vector = lu_solve(K, M.T @ (R * (2 * project(t) - t)) - qp.q)
            return x

        t = _fixed_point(
            lambda t: t + RELAXATION * (M @ primal_point(t) - project(t)),
            t,
            ADMM_STEPS * number,
        )
        x, w = primal_point(t), project(t)
        multipliers = R * (t - w)
        end = _newton(P, qp.q, M, R, project, x, t)
        force = R * (end - project(end))
        x_end = project(end)[m + p :].astype(float)
        y, z = np.split((force[: m + p] / size).astype(float), [m])
        yield Solution(
            status=Status.SOLVED, x=x_end, y=y, z=z,
            z_box=force[m + p :].astype(float),
        )  # fmt: skip
        # balance the relative residuals: √(primal/dual), as OSQP updates its ρ
        primal = np.abs(M @ x - w).max() / max(np.abs(w).max(), np.abs(M @ x).max())
        forces = [P @ x, qp.q, M.T @ multipliers]
        dual = np.abs(sum(forces)).max() / max(np.abs(f).max() for f in forces)
        change = float(np.sqrt(primal / dual))
        rho *= min(max(change, 1 / MAX_PENALTY_CHANGE), MAX_PENALTY_CHANGE)


def _fixed_point(step: Callable[[Vector], Vector], t: Vector, count: int) -> Vector:
    """Iterate t ← step(t), accelerated every `MEMORY` of `count` iterations.

    An accelerated point is used if its residual is not larger: ‖step(t) − t‖ decreases
    along the iterates without acceleration, since the step is averaged.
    """
    images, changes = list[Vector](), list[Vector]()
    for _ in range(count // MEMORY):
        images.clear()
        changes.clear()
        for _ in range(MEMORY):
            image = step(t)
            images.append(image)
            changes.append(image - t)
            t = image
        F, G = (np.diff(np.array(rows), axis=0).T for rows in (changes, images))
        gram = F.T @ F
        gram[np.diag_indices_from(gram)] += GRAM_SHIFT * np.trace(gram)
        try:
            weights = np.linalg.solve(gram, F.T @ changes[-1])
        except np.linalg.LinAlgError:  # the changes are zero
            return t
        candidate = t - G @ weights
        image = step(candidate)
        if np.linalg.norm(image - candidate) <= np.linalg.norm(changes[-1]):
            t = image
    return t


@np.errstate(all="ignore")  # a residual that is not finite ends the loop
def _newton(
    P: Any, q: Vector, M: Any, R: Vector, project: Any, x: Vector, t: Vector
) -> Any:
    """Return the t with the least residual of (1) among the iterates from x and t."""
    n, r = x.size, t.size
    x, t = x.astype(np.longdouble), t.astype(np.longdouble)
    P_x, M_x = P.astype(np.longdouble), M.astype(np.longdouble)
    best, least = t, np.inf
    for _ in range(NEWTON_STEPS):
        w = project(t)
        F = np.concatenate([P_x @ x + q + M_x.T @ (R * (t - w)), M_x @ x - w])
        scale = np.append(np.full(n, np.abs(P @ x).max() + np.abs(q).max()),
                          np.full(r, np.abs(w).max()))  # fmt: skip
        size = float(np.abs(F / np.where(scale > 0, scale, 1)).max())
        if not size < least:
            break
        best, least = t, size
        D = _derivative(project, t.astype(float))
        J = np.block([[P, M.T @ (R[:, None] * (np.eye(r) - D))], [M, -D]])
        J += SHIFT * np.diag(np.repeat([np.abs(P).max(initial=0.0), -1.0], [n, r]))
        try:
            step = np.linalg.solve(J, F.astype(float))
        except np.linalg.LinAlgError:  # a pivot is zero
            break
        x, t = x - step[:n], t - step[n:]
    return best


def _derivative(project: Any, t: Vector) -> Any:
    """Return the central difference quotients of Π at t, one column per component."""
    D = np.empty((t.size, t.size))
    for j, at in enumerate(t):
        h = DIFFERENCE_STEP * max(abs(at), float(np.abs(t).max()) or 1.0)
        there, here = t.copy(), t.copy()
        there[j], here[j] = at + h, at - h
        D[:, j] = (project(there) - project(here)) / (there[j] - here[j])
    return D


def _dense(M: Any) -> Any:
    return M.toarray() if hasattr(M, "toarray") else np.asarray(M)
