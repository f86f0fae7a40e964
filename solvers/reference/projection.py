"""Reference solve of QPs over convex sets of any kind, by their projections alone.

With M = [A; G; I] and C = {b} × {w ≤ h} × S, a QP is  min ½xᵀPx + qᵀx,  Mx ∈ C. A
point t of the range of M gives both w = Π(t) in C and multipliers λ = R(t − w) normal
to C at w, for R > 0 diagonal and the same within a set: what is left of the KKT
conditions is the normal map (Robinson 1992, Math. Oper. Res. 17),

    Px + q + MᵀR(t − Π(t)) = 0,      Mx = Π(t).                                    (1)

1. ADMM (Stellato et al. 2020, Math. Prog. Comp. 12) comes near to its zero from
   anywhere, with R as its penalty.
2. Newton's method ends there, with difference quotients of Π and residuals in extended
   precision: the error of the quotients, √ε, is a factor of convergence.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
from scipy.linalg import lu_factor, lu_solve

from mortarbench.harness import QP, Solution, Status, Vector

ROUNDS = 12  #: of both, with another penalty each
ADMM_STEPS = 400  #: per round
NEWTON_STEPS = 30
RELAXATION = 1.6
EQUALITIES = 1e3  #: penalty of rows of A, relative to others
RANGE = 10.0  #: largest factor between the penalties of two rounds
STEP = 2.0**-26  #: of difference quotients, relative to t
#: regularises dependent rows: it makes steps wrong by as much, the zero of (1) stays
SHIFT = 1e-15


def projected(qp: QP) -> Iterator[Solution]:
    """Yield points, each by more steps than the ones before."""
    n, m, p = qp.q.size, qp.b.size, qp.h.size
    P, rows = _dense(qp.P), np.vstack([_dense(qp.A), _dense(qp.G)])
    size = np.linalg.norm(rows, axis=1)
    size[size == 0] = 1
    M = np.vstack([rows / size[:, None], np.eye(n)])
    b, h = qp.b / size[:m], qp.h / size[m:]
    kinds = np.array([EQUALITIES] * m + [1.0] * (p + n))

    def project(t: Any) -> Any:
        x = t[m + p :]
        for one in qp.sets:
            x = one.project(x)
        return np.concatenate([b, np.minimum(t[m : m + p], h), x])

    rho = float(np.abs(P).max(initial=0)) or 1.0
    x, t, multipliers = np.zeros(n), np.zeros(m + p + n), np.zeros(m + p + n)
    for _ in range(ROUNDS):
        R = rho * kinds
        t = project(t) + multipliers / R
        K = lu_factor(P + M.T @ (R[:, None] * M))
        for _ in range(ADMM_STEPS):
            w = project(t)
            x = lu_solve(K, M.T @ (R * (2 * w - t)) - qp.q)
            t = t + RELAXATION * (M @ x - w)
        w = project(t)
        multipliers = R * (t - w)
        end = _newton(P, qp.q, M, R, project, x, t)
        force = R * (end - project(end))
        x_end = project(end)[m + p :].astype(float)
        y, z = np.split((force[: m + p] / size).astype(float), [m])
        yield Solution(
            status=Status.SOLVED, x=x_end, y=y, z=z,
            z_box=force[m + p :].astype(float),
        )  # fmt: skip
        missed = np.abs(M @ x - w).max() / max(np.abs(w).max(), np.abs(M @ x).max())
        forces = [P @ x, qp.q, M.T @ multipliers]
        left = np.abs(sum(forces)).max() / max(np.abs(f).max() for f in forces)
        rho *= float(np.clip(np.sqrt(missed / left), 1 / RANGE, RANGE))


@np.errstate(all="ignore")  # what is not finite ends it
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
    """Return difference quotients of Π at t, a column for each component."""
    D = np.empty((t.size, t.size))
    for j, at in enumerate(t):
        h = STEP * max(abs(at), float(np.abs(t).max()) or 1.0)
        there, here = t.copy(), t.copy()
        there[j], here[j] = at + h, at - h
        D[:, j] = (project(there) - project(here)) / (there[j] - here[j])
    return D


def _dense(M: Any) -> Any:
    return M.toarray() if hasattr(M, "toarray") else np.asarray(M)
