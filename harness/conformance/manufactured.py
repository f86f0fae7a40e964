"""Manufactured QPs for tests of solvers; most solutions are known by construction."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from scipy.sparse import csc_array, diags_array, eye_array, kron

from mortarbench.harness.qp import QP, Matrix, Vector
from mortarbench.harness.sets.cones import Cones
from mortarbench.harness.sets.discs import Discs
from mortarbench.harness.solution import Solution, Status

#: Arguments of each shape. "m" and "p" are the numbers of equality and inequality rows.
#: "lower" and "upper" are False if there are no lower or upper bounds. "some" means
#: bounds on half of the variables only, "redundant" means linearly dependent equality
#: rows, and "fixed" means equal bounds on some variables. "rank" is the rank of P.
SHAPES: Mapping[str, Mapping[str, Any]] = {
    "bounds": dict(upper=False),
    "box": dict(),
    "free": dict(m=4, p=6, lower=False, upper=False),
    "equalities": dict(m=5, lower=False, upper=False),
    "inequalities": dict(p=8, lower=False, upper=False),
    "some bounds": dict(m=3, some=True, upper=False),
    "everything": dict(m=5, p=8, some=True),
    "singular": dict(m=3, p=4, rank=12),
    "redundant": dict(m=4, redundant=True, upper=False),
    "fixed": dict(m=2, p=3, fixed=True),
    "unconstrained": dict(lower=False, upper=False),
}


def manufactured(
    shape: str, *, seed: int = 271828, dense: bool = False, n: int = 20
) -> tuple[QP, Solution]:
    """Return a random QP with a known KKT point.

    The point and its multipliers are drawn at random, the active set is fixed, and q
    follows from stationarity. The entries of the matrices are of order one. Some
    constraints of every type in the shape are active. The minimiser is unique for every
    shape except "singular".

    shape : a key of `SHAPES`

    >>> qp, point = manufactured("equalities")
    >>> bool(np.allclose(qp.P @ point.x + qp.q + qp.A.T @ point.y, 0))
    True
    """
    rng, kind = np.random.default_rng(seed), SHAPES[shape]
    m, p, rank = (kind.get(k, v) for k, v in (("m", 0), ("p", 0), ("rank", n)))
    lower, upper = kind.get("lower", True), kind.get("upper", True)
    M = rng.standard_normal((n, rank))
    P = M @ M.T / rank + (0.1 * np.eye(n) if rank == n else 0.0)
    A, G = rng.standard_normal((m, n)), rng.standard_normal((p, n))
    if kind.get("redundant"):
        A[-1] = A[:-1].sum(axis=0)
    x, y = rng.standard_normal(n), rng.standard_normal(m)
    # multipliers of active rows are at least 0.5, so that complementarity is strict
    z = np.where(np.arange(p) % 2 == 0, 0.5 + rng.exponential(size=p), 0.0)
    # of every four variables, one is at its lower bound and one is at its upper bound,
    # if these bounds exist; no other bounds are active
    at_lb = lower & (np.arange(n) % 4 == 0)
    at_ub = upper & (np.arange(n) % 4 == 1)
    bounded = np.arange(n) % 4 < 2 if kind.get("some") else np.full(n, True)
    z_box = (0.5 + rng.exponential(size=n)) * (at_ub * 1.0 - at_lb)
    lb = np.where(lower & bounded, np.where(at_lb, x, x - 1), -np.inf)
    ub = np.where(upper & bounded, np.where(at_ub, x, x + 1), np.inf)
    if kind.get("fixed"):
        ub = np.where(at_lb, lb, ub)
    s = Solution(status=Status.SOLVED, x=x, y=y, z=z, z_box=z_box)
    return _planted(P, A, G, s, np.asarray if dense else csc_array, lb=lb, ub=ub), s


def _planted(
    P: Matrix,
    A: Matrix,
    G: Matrix,
    s: Solution,
    store: Callable[[Matrix], Matrix] = csc_array,
    **bounds: Any,
) -> QP:
    """Return the QP with the KKT point `s`: q follows from stationarity.

    Inequality rows with the multiplier zero have the slack 1.

    bounds : arguments `lb`, `ub` and `sets` of the QP
    """
    return QP(
        P=store(P),
        q=-(P @ s.x + A.T @ s.y + G.T @ s.z + s.z_box),
        A=store(A),
        b=A @ s.x,
        G=store(G),
        h=G @ s.x + (s.z == 0),
        **bounds,
    )


#: Numbers of discs, of cones, and of rows of each type (A and G), by shape.
SET_SHAPES: Mapping[str, tuple[int, int, int]] = {
    "discs": (6, 0, 0),
    "discs and rows": (6, 0, 2),
    "cones": (0, 6, 0),
    "cones and rows": (0, 6, 2),
    "discs and cones": (3, 3, 2),
}


def manufactured_over_sets(shape: str, *, seed: int = 271828) -> tuple[QP, Solution]:
    """Return a random QP over discs and cones, with its solution.

    Each block has two tangential components; a cone also has a normal component. Radii
    and nonzero normal components are between 0.1 and 10. Two of three successive discs
    are active. Of three successive cones, one has the point on its boundary (slip), one
    at its apex (open), and one in its interior (stick). Multipliers of active blocks
    have a distance of at least 0.35 from the relative boundary of the normal cone, so
    that complementarity is strict. The eigenvalues of P exceed 0.1. Two further
    variables have lower bounds, one of which is active.

    shape : a key of `SET_SHAPES`

    >>> qp, point = manufactured_over_sets("cones")
    >>> bool(np.allclose(qp.P @ point.x + qp.q + point.z_box, 0))
    True

    """
    discs, cones, rows = SET_SHAPES[shape]
    rng = np.random.default_rng(seed)
    n = 2 * discs + 3 * cones + 2
    on_discs, on_cones, alone = np.split(
        rng.permutation(n), np.cumsum([2 * discs, 3 * cones])
    )
    x, z_box = rng.standard_normal(n), np.zeros(n)
    angles, sizes = 2 * np.pi * rng.random(n), 10.0 ** rng.uniform(-1, 1, n)
    forces: Vector = 0.5 + rng.exponential(size=n)
    slopes: Vector = rng.uniform(0.1, 1, cones)
    along = np.column_stack([np.cos(angles), np.sin(angles)])
    for i, block in enumerate(on_discs.reshape(discs, 2)):
        x[block] = sizes[i] * along[i] * (0.5 if i % 3 == 2 else 1)
        z_box[block] = forces[i] * along[i] * (i % 3 != 2)
    for i, block in enumerate(on_cones.reshape(cones, 3), start=discs):
        slope, normal, tangents = slopes[i - discs], block[0], block[1:]
        x[normal] = sizes[i] * (i % 3 != 1)
        x[tangents] = slope * x[normal] * along[i] * (0.5 if i % 3 == 2 else 1)
        z_box[tangents] = forces[i] * along[i] * (i % 3 != 2)
        z_box[normal] = -slope * forces[i] * (i % 3 != 2) - 0.5 * (i % 3 == 1)
    lb = np.full(n, -np.inf)
    lb[alone] = x[alone] - [0, 1]
    z_box[alone[0]] = -0.5
    M, A = rng.standard_normal((n, n)), rng.standard_normal((rows, n))
    G, y = rng.standard_normal((rows, n)), rng.standard_normal(rows)
    z = np.where(np.arange(rows) == 0, 0.7, 0.0)
    sets = (
        Discs(on_discs.reshape(discs, 2), sizes[:discs]),
        Cones(on_cones.reshape(cones, 3), slopes),
    )
    s = Solution(status=Status.SOLVED, x=x, y=y, z=z, z_box=z_box)
    P = M @ M.T / n + 0.1 * np.eye(n)
    return _planted(P, A, G, s, lb=lb, ub=np.full(n, np.inf), sets=sets), s


def one_of_each() -> tuple[QP, dict[str, Vector]]:
    """Return a QP with an active constraint of each type, and its solution by name.

    The QP separates into four problems min ½x² + qx with the constraints x₀ ≤ 1 and
    x₁ ≥ −1 (bounds), 2x₂ ≤ 2 (inequality row) and 2x₃ = 2 (equality row). The
    multipliers can be computed by hand.
    """
    inf = np.inf
    qp = QP.from_arrays(
        csc_array(np.eye(4)),
        [-3, 4, -5, -9],
        G=csc_array([[0, 0, 2, 0]]),
        h=2,
        A=csc_array([[0, 0, 0, 2]]),
        b=2,
        lb=[-inf, -1, -inf, -inf],
        ub=[1, inf, inf, inf],
    )
    vectors = dict(x=[1.0, -1, 1, 1], y=[4.0], z=[2.0], z_box=[2.0, -3, 0, 0])
    return qp, {name: np.array(v) for name, v in vectors.items()}


def membrane(k: int) -> QP:
    """Return the QP of a membrane with k × k nodes and fixed rim above a paraboloid.

    The QP has bounds only. Its solution is not known in closed form, but the KKT
    residuals suffice to verify an answer.
    """
    second = diags_array(
        [-np.ones(k - 1), 2 * np.ones(k), -np.ones(k - 1)], offsets=[-1, 0, 1]
    )
    eye = eye_array(k)
    x, y = np.meshgrid(*2 * [np.arange(1, k + 1) / (k + 1)])
    return QP.from_arrays(
        csc_array(kron(second, eye) + kron(eye, second)),
        np.full(k * k, 8 / (k + 1) ** 2),
        lb=(-0.1 - 0.3 * ((x - 0.5) ** 2 + (y - 0.5) ** 2)).ravel(),
    )


def infeasible() -> QP:
    """Return a QP with the contradictory rows x₀ − x₁ ≤ −1 and x₁ − x₀ ≤ −1."""
    rows = np.eye(2, 20) - np.eye(2, 20)[::-1]
    return QP.from_arrays(csc_array(np.eye(20)), np.ones(20), csc_array(rows), [-1, -1])


def unbounded() -> QP:
    """Return a QP that decreases linearly in x₀, a variable without upper bound."""
    P = csc_array(np.diag([0.0] + [1.0] * 19))
    return QP.from_arrays(P, -np.ones(20), lb=-1)
