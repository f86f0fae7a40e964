"""Multipliers that minimise the KKT residuals at a given primal point.

At x, with g = Px + q, the multipliers minimise

    Σᵢ wᵢ²(g + Aᵀy + Gᵀz + z_box)ᵢ²  +  Σⱼ (zⱼsⱼ/E)²    over y, z ≥ 0 and z_box,

where sⱼ is the slack of a row or bound, E is the scale of energy of
`harness.verify.kkt`, and 1/wᵢ is the scale of the stationarity residual. The sign of
z_box must be admissible for the bound. The second sum measures complementarity. It
makes a threshold between active and inactive rows unnecessary, because the slack of a
nearly active row limits the multiplier of the row.

Let f be the multiplier of a disc or cone for which stationarity would hold exactly, and
Π the projection onto this set. The multiplier z = (v − Π(v))/τ with v = x + τf is used
instead. This z is normal to the set at Π(v). As τ increases, the remainder f − z
decreases and the complementarity residual increases. The multipliers of rows are first
computed under the assumption that discs and cones can balance any force. They are then
corrected by Newton's method for f − z, with the derivative of Π.

Multipliers with small residuals prove that a point is optimal, no matter how the
multipliers were computed. Several weights w are therefore tried, and the multipliers
with the smallest `kkt_residuals` are returned.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import qr, solve_triangular
from scipy.sparse import csr_array

from mortarbench.harness.errors import InputError
from mortarbench.harness.qp import QP, Matrix, Vector
from mortarbench.harness.sets.convex import ConvexSet
from mortarbench.harness.solution import Solution, Status
from mortarbench.harness.verify.kkt import energy_at, kkt_residuals
from mortarbench.harness.verify.optimum import EPS

#: A row is omitted if a multiplier that changes the stationarity residual by ε would
#: change the complementarity residual by more than this multiple of ε. Because of the
#: large slack of this row, its multiplier cannot reduce both residuals.
MAX_COMPLEMENTARITY_RATIO = 100.0
#: Largest number of Newton steps; the first half is damped
#: (`_Linearisation.is_careful`). With
#: 8, a residual of 6e-7 remains for rows whose variables are all in balls
#: (`test_multipliers_over_balls_are_computed_also_with_common_rows`).
NEWTON_STEPS = 16
STEP = 2.0**-26  #: relative step of difference quotients of Π
#: A column counts as linearly dependent if its norm after elimination is at most this
#: fraction of the largest norm.
RANK_TOLERANCE = 1e-12
#: Largest number of entries of the dense least-squares matrix (256 MiB).
MAX_ENTRIES = 2**25


class _Scales(NamedTuple):
    """Weights of the two sums in the module docstring."""

    w: Vector  #: (n,) 1/(scale of stationarity); 0 at fixed variables
    E: float  #: scale E of energy, which divides the complementarity residual

    def reach(self) -> float:
        """Return the parameter τ = E/S² of the natural map, where S = 1/min wᵢ.

        If τf equals the distance of x from the boundary of a set, the natural map
        divides the error equally between stationarity and complementarity.
        """
        return float(self.E * self.w.min(initial=np.inf) ** 2)


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
        If the least-squares problem would have more than `MAX_ENTRIES` entries, or if
        its iteration does not converge.
    """
    given = {"y": (y, qp.b), "z": (z, qp.h), "z_box": (z_box, qp.q)}
    unknown = {name for name, (v, like) in given.items() if v is None and like.size}
    s = Solution(
        status=Status.SOLVED,
        x=x,
        y=np.zeros(qp.b.size) if y is None else y,
        z=np.zeros(qp.h.size) if z is None else z,
        z_box=np.zeros(qp.q.size) if z_box is None else z_box,
    )
    if not unknown or not all(np.isfinite(v).all() for v in (x, s.y, s.z, s.z_box)):
        return s
    Px = qp.P @ x
    g = Px + qp.q + qp.A.T @ s.y + qp.G.T @ s.z + s.z_box
    scale = max(float(np.abs(v).max()) for v in (Px, qp.q, g))
    E, size = energy_at(qp, s), np.full(x.size, scale if scale > 0 else 1.0)
    found, others = [s], qp.sets[1:] if "z_box" in unknown else ()
    block = np.zeros(x.size, dtype=bool)
    for one in others:
        block[one.block] = True
    steps = NEWTON_STEPS if others and unknown & {"y", "z"} else 1
    for _ in range(
        2
    ):  # weights from the largest force, then from the forces of each component
        scales = _Scales(1 / size, E)
        linearised = _Linearisation(qp.sets[1:], block, x, scales.reach())
        for k in range(steps):
            found.append(_fitted(qp, s, g, scales, unknown, linearised))
            rows = qp.A.T @ (found[-1].y - s.y) + qp.G.T @ (found[-1].z - s.z)
            force, last = -g - rows, linearised.force
            linearised = replace(linearised, force=force, is_careful=2 * k < steps)
            if last is not None and np.abs(force - last).max() <= EPS * scale:
                break
        if others:
            linearised = replace(linearised, is_shared=True)
            found.append(_fitted(qp, s, g, scales, unknown, linearised))
        forces = qp.A.T @ found[-1].y + qp.G.T @ found[-1].z + found[-1].z_box
        own = np.maximum.reduce([np.abs(Px), np.abs(qp.q), np.abs(forces)])
        size = np.where(own > 0, own, size)
    return min(found, key=lambda one: _worst(qp, one))


def _worst(qp: QP, s: Solution) -> float:
    worst = kkt_residuals(qp, s).worst
    return np.inf if np.isnan(worst) else worst


@dataclass(frozen=True, eq=False)
class _Linearisation:
    """Linearised projections onto discs and cones at x + τ·force."""

    sets: Sequence[ConvexSet]
    #: (n,) mask of the variables of the sets; all False if z_box is prescribed
    block: NDArray[np.bool_]
    x: Vector  #: (n,) point x
    tau: float  #: step τ of the natural map
    force: Vector | None = None  #: (n,) force f; None if the sets balance any force
    #: True for damped steps, which apply the derivative also to the residual. Damped
    #: steps converge more slowly than Newton's method, but from more distant points
    is_careful: bool = True
    #: True to assign to the sets only the part of a force that the natural map yields
    is_shared: bool = False

    def normal_part(self, force: Vector, *, shared: bool = True) -> Vector:
        """Return the part (n,) of a force (n,) that is normal to the sets near x.

        shared : if True, use the natural map, which excludes a part of the force if x
            is not on the boundary; if False, return the part of the force that is
            normal to the set at some point of the set
        """
        total = np.zeros(self.x.size)
        if self.block.any():
            moved = self.x + self.tau * force
            for one in self.sets:
                natural = (moved - one.project(moved)) / self.tau
                total += natural if shared else one.admissible(force)
        return total

    def rest(self, g: Vector) -> Vector:
        """Return the part of g (n,) that the linearised sets do not balance."""
        if not self.block.any() or self.force is None:
            return np.where(self.block, 0.0, g)
        balanced = self.normal_part(self.force)
        if self.is_careful:
            return np.asarray(self.derivative((g + balanced)[:, None]).ravel())
        change = self.derivative((self.force + g)[:, None]).ravel()
        return np.where(self.block, balanced - self.force + change, g)

    def derivative(self, forces: Any) -> Any:
        """Apply the derivative of f ↦ f − z at f = `force` to `forces` (n, k)."""
        if self.force is None:
            return np.where(self.block[:, None], 0.0, forces)
        left, at = forces.copy(), self.x + self.tau * self.force
        for j, along in enumerate(forces.T):
            size = np.abs(along[self.block]).max(initial=0.0)
            if size > 0:
                # x + τf may be zero, for instance at the apex of all cones: use 1
                h = STEP * (float(np.abs(at[self.block]).max()) or 1.0) / size
                for one in self.sets:
                    ends = one.project(at + h * along), one.project(at - h * along)
                    left[one.block, j] = ((ends[0] - ends[1]) / (2 * h))[one.block]
        return left


def _fitted(
    qp: QP,
    s: Solution,
    g: Vector,
    scales: _Scales,
    unknown: set[str],
    linearised: _Linearisation,
) -> Solution:
    """Minimise both sums over the unknown multipliers, with all others as in `s`.

    g : (n,) Px + q + Aᵀy + Gᵀz + z_box with the multipliers of `s`
    """
    lower, upper = s.x - qp.lb, qp.ub - s.x
    is_fixed = (qp.lb == qp.ub) & ("z_box" in unknown)
    scales = scales._replace(w=np.where(is_fixed, 0.0, scales.w))
    y, z = s.y, s.z
    if unknown & {"y", "z"}:
        rows = _near(np.abs(qp.h - qp.G @ s.x), _norms(qp.G, scales.w), scales.E)
        rows = rows if "z" in unknown else rows[:0]
        below, above = (
            _near(np.abs(slack), scales.w, scales.E) if "z_box" in unknown else rows[:0]
            for slack in (lower, upper)
        )
        n, k, m = s.x.size, rows.size + below.size + above.size, qp.b.size
        if (n + k) * (k + m) > MAX_ENTRIES:
            raise InputError(
                f"multipliers of {k} nearly active rows and bounds and {m} equality "
                "rows are too many to compute; expected y, z and z_box in addition to x"
            )
        columns = np.zeros((n, k))
        columns[:, : rows.size] = _dense(qp.G[rows].T)
        columns[below, rows.size + np.arange(below.size)] = -1
        columns[above, rows.size + below.size + np.arange(above.size)] = 1
        slack = np.concatenate([(qp.h - qp.G @ s.x)[rows], lower[below], upper[above]])
        free = _dense(qp.A.T) if "y" in unknown else np.zeros((n, 0))
        if linearised.block.any():
            free, columns = linearised.derivative(free), linearised.derivative(columns)
        found, pull = _least_squares(free, columns, slack, linearised.rest(g), scales)
        if "y" in unknown:
            y = found
        if "z" in unknown:
            z = np.zeros(qp.h.size)
            z[rows] = pull[: rows.size]
    r = g + qp.A.T @ (y - s.y) + qp.G.T @ (z - s.z)
    z_box = s.z_box
    if "z_box" in unknown:  # fit each component separately
        balanced = _share(np.maximum(r, 0), lower, scales)
        z_box = _share(np.maximum(-r, 0), upper, scales) - balanced
        z_box[is_fixed] = -r[is_fixed]
        z_box += linearised.normal_part(-r, shared=linearised.is_shared)
    return Solution(status=s.status, x=s.x, y=y, z=z, z_box=z_box)


def _least_squares(
    free: Any, columns: Any, slack: Vector, g: Vector, scales: _Scales
) -> tuple[Vector, Vector]:
    """Minimise ‖w(g + free·y + columns·ζ)‖² + ‖slack·ζ/E‖² over y and ζ ≥ 0.

    y is eliminated with an orthonormal basis of the range of w·free. Linearly dependent
    columns of `free` receive the multiplier zero.
    """
    # imported here, since scipy.optimize loads slowly and workers do not need it
    from scipy.optimize import nnls

    w = scales.w[:, None]
    Q, R, pivots = qr(w * free, mode="economic", pivoting=True)
    size = np.abs(np.diag(R))
    rank = int((size > RANK_TOLERANCE * size[:1].sum()).sum())
    Q, R = Q[:, :rank], R[:rank, :rank]
    norms = np.linalg.norm(w * columns, axis=0)
    norms[norms == 0] = 1  # the sets balance the whole column
    C, target = w * columns / norms, -scales.w * g
    price = np.divide(
        np.abs(slack), scales.E * norms, out=np.zeros(slack.size), where=slack != 0
    )
    zeta = np.zeros(slack.size)
    if slack.size:  # without columns, scipy's nnls (1.17.1) would crash Python
        reduced = C - Q @ (Q.T @ C)
        reduced -= Q @ (Q.T @ reduced)  # repeat to remove rounding in the range of Q
        stacked = np.vstack([reduced, np.diag(price)])
        rhs = np.concatenate([target - Q @ (Q.T @ target), np.zeros(slack.size)])
        try:
            zeta, _ = nnls(stacked, rhs, maxiter=100 * slack.size + 100)
        except RuntimeError:
            raise InputError(
                "multipliers: the least-squares iteration did not converge; expected "
                "y, z and z_box in addition to x"
            ) from None
    y = np.zeros(free.shape[1])
    y[pivots[:rank]] = solve_triangular(R, Q.T @ (target - C @ zeta))
    return y, zeta / norms


def _near(slack: Vector, norms: Vector, E: float) -> NDArray[np.int64]:
    """Return the rows or bounds whose slack is small enough for a multiplier.

    See `MAX_COMPLEMENTARITY_RATIO`.

    norms : norms ‖w·aⱼ‖ of the rows aⱼ, weighted by w
    """
    return np.flatnonzero(
        (norms > 0) & (slack <= MAX_COMPLEMENTARITY_RATIO * E * norms)
    )


def _share(force: Vector, slack: Vector, scales: _Scales) -> Vector:
    """Return the ζ (n,) that minimises w²(force − ζ)² + (slack·ζ/E)² componentwise."""
    price = np.divide(
        slack, scales.E * scales.w, out=np.zeros(slack.size), where=slack != 0
    )
    return np.where(np.isfinite(slack), force / (1 + price**2), 0.0)


def _norms(M: Matrix, w: Vector) -> Vector:
    """Return the Euclidean norms ‖w·aⱼ‖ (m,) of the rows aⱼ of M (m, n)."""
    return np.asarray(np.sqrt(csr_array(M).power(2) @ w**2))


def _dense(M: Matrix) -> Any:
    return M.toarray() if hasattr(M, "toarray") else M
