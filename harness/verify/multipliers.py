"""Multipliers that minimise the KKT residuals at a given primal point.

At x, with g = Px + q, the linear program

    minimise t  over t, y, z ≥ 0 and z_box, subject to
        wᵢ|g + Aᵀy + Gᵀz + z_box|ᵢ ≤ t  and  zⱼsⱼ/ℰ ≤ t

minimises the largest of the dual and complementarity residuals, where sⱼ is the slack
of a row or limit, 1/wᵢ is the unit of the stationarity residual and ℰ that of energies
(`harness.verify.kkt`). On a bound, disc or cone, z_box is a nonnegative combination of
outward normals at x. The second condition makes a threshold between active and inactive
rows unnecessary, because the slack of a nearly active row limits its multiplier.
Dependent rows do no harm: the simplex method returns a basic solution.

Multipliers with small residuals prove that a point is optimal, no matter how the
multipliers were computed.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from scipy.sparse import csc_array, csr_array, diags_array, eye_array, hstack, vstack

from mortarbench.harness.errors import InputError
from mortarbench.harness.qp import QP, Vector
from mortarbench.harness.sets.blocks import Blocks
from mortarbench.harness.sets.cones import Cones
from mortarbench.harness.sets.convex import hull
from mortarbench.harness.solution import Solution, Status
from mortarbench.harness.verify.kkt import units_at

#: A multiplier is omitted if a change of it that changes the stationarity residual by ε
#: would change the complementarity residual by more than this multiple of ε. Because of
#: its slack, this multiplier cannot reduce both residuals.
MAX_COMPLEMENTARITY_RATIO = 100.0
#: Largest number of nearly active rows, bounds and sets, and of equality rows. A linear
#: program of this size takes a minute.
MAX_COLUMNS = 2 * 10**4
ACCURACY = 1e-10  #: tolerance of the linear program, the smallest that HiGHS accepts
#: Factor of all residuals in the linear program. Its tolerance is absolute, so that
#: residuals are accurate to 1e-13. Without the factor, it accepted forces of 8e-11 of
#: the largest one beside a disc that is larger than the others by 2²⁷.
MAGNIFICATION = 1e3
#: Largest number of linear programs for cones. At an apex, normals of 16 directions
#: leave a residual of up to 2 %. Each further round adds the direction of the missing
#: force, which squares the residual without rows, and divides it by 4 to 30 with rows.
ROUNDS = 10


@np.errstate(all="ignore")  # entries of a point may be as large as 1e300
def with_multipliers(
    qp: QP,
    x: Vector,
    y: Vector | None = None,
    z: Vector | None = None,
    z_box: Vector | None = None,
) -> Solution:
    """Return a solution; multipliers that are None are fitted to the KKT conditions.

    If x or another argument contains NaN or inf, these multipliers are zero instead.

    Raises
    ------
    InputError
        If there are more than `MAX_COLUMNS` equality rows and nearly active rows,
        bounds and sets, or if the linear program cannot be solved.

    """
    s = Solution(
        status=Status.SOLVED,
        x=x,
        y=np.zeros(qp.b.size) if y is None else y,
        z=np.zeros(qp.h.size) if z is None else z,
        z_box=np.zeros(qp.q.size) if z_box is None else z_box,
    )
    if not all(np.isfinite(v).all() for v in (x, s.y, s.z, s.z_box)):
        return s
    g = qp.P @ x + qp.q + qp.A.T @ s.y + qp.G.T @ s.z + s.z_box
    w, energy = units_at(qp, x)
    free = csc_array(qp.A.T if y is None else (x.size, 0))
    sides = [(csc_array((x.size, 0)), np.zeros(0))]
    if z is None:
        sides = [(csc_array(qp.G.T), qp.h - qp.G @ x)]
    rows = sides[0][1].size
    if z_box is None:
        lower, upper = hull(qp.sets, x.size)
        w = np.where(lower == upper, 0.0, w)  # any force balances a fixed variable
        sides += _normals(qp, x)
    cones = [one for one in qp.sets[1:] if isinstance(one, Cones) and z_box is None]
    for done in range(ROUNDS):
        columns = csc_array(hstack([normals for normals, _ in sides]))
        slack = np.abs(np.concatenate([slack for _, slack in sides]))
        norms = np.sqrt(columns.power(2).T @ w**2)
        near = np.flatnonzero(
            (norms > 0) & (slack <= MAX_COMPLEMENTARITY_RATIO * energy * norms)
        )
        try:
            dy, found = _least_residuals(
                free, columns[:, near], slack[near] / energy, g, w
            )
        except InputError:
            if not done:
                raise
            break  # nearly equal directions
        pull = np.zeros(slack.size)
        pull[near] = found
        normal = columns[:, rows:] @ pull[rows:]
        balance = normal + g + free @ dy + columns[:, :rows] @ pull[:rows]
        if not cones or float(np.max(w * np.abs(balance))) <= ACCURACY:
            break
        # the normals towards the force that is missing
        sides += [one.normals(x, normal - balance) for one in cones]
    normal -= np.where(w > 0, 0.0, balance)
    return replace(
        s,
        y=s.y + dy if y is None else s.y,
        z=s.z + pull[:rows] if z is None else s.z,
        z_box=s.z_box + normal if z_box is None else s.z_box,
    )


def _normals(qp: QP, x: Vector) -> Iterator[tuple[csc_array, Vector]]:
    """Yield outward normals (n, k) of bounds, discs and cones, and slacks (k,)."""
    for sign, side in ((-1.0, x - qp.lb), (1.0, qp.ub - x)):
        at = np.flatnonzero(np.isfinite(side))
        yield sign * csc_array(eye_array(x.size))[:, at], side[at]
    for one in qp.sets[1:]:
        if isinstance(one, Blocks):
            yield one.normals(x)


def _least_residuals(
    free: csc_array, columns: csc_array, price: Vector, g: Vector, w: Vector
) -> tuple[Vector, Vector]:
    """Minimise max(w|g + free·y + columns·ζ|, price·ζ) over y (m,) and ζ ≥ 0 (k,)."""
    # imported here, since scipy.optimize loads slowly and workers do not need it
    from scipy.optimize import linprog

    m, k, used = free.shape[1], price.size, np.flatnonzero(w)
    if m + k > MAX_COLUMNS:
        raise InputError(
            f"multipliers of {k} nearly active rows, bounds and sets and {m} equality "
            "rows are too many to compute; expected y, z and z_box in addition to x"
        )
    K = diags_array(w[used]) @ csr_array(hstack([free, columns]))[used]
    size = (
        np.asarray(abs(K).max(axis=0).todense()).ravel()
        if used.size
        else np.ones(m + k)
    )
    size = np.where(size > 0, size, 1.0)  # unit of each multiplier
    K, target = K @ diags_array(1 / size), MAGNIFICATION * w[used] * g[used]
    priced = np.flatnonzero(price)
    prices = csr_array(
        (price[priced] / size[m + priced], (np.arange(priced.size), m + priced)),
        shape=(priced.size, m + k),
    )
    rows = vstack([K, -K, prices])
    bounds = np.full((m + k + 1, 2), [0, np.inf])
    bounds[:m, 0] = -np.inf
    solved = linprog(
        np.append(np.zeros(m + k), 1.0),
        A_ub=csr_array(hstack([rows, np.full((rows.shape[0], 1), -1.0)])),
        b_ub=np.concatenate([-target, target, np.zeros(priced.size)]),
        bounds=bounds,
        method="highs-ds",
        options=dict(
            primal_feasibility_tolerance=ACCURACY, dual_feasibility_tolerance=ACCURACY
        ),
    )
    if solved.x is None:
        raise InputError(
            "multipliers: the linear program could not be solved; expected y, z and "
            "z_box in addition to x"
        )
    both = solved.x[:-1] / (MAGNIFICATION * size)
    return both[:m], np.maximum(both[m:], 0.0)
