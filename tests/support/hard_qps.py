"""QPs with misleading residuals, each with an exact KKT point and its optimal value.

All numbers are dyadic and have few digits, so that the planted point satisfies the KKT
conditions of the stored QP without rounding errors.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import numpy as np

from mortarbench.harness.qp import QP, Vector
from mortarbench.harness.solution import Solution, Status


@dataclass(frozen=True, eq=False, kw_only=True)
class HardQP:
    """A QP with one of its KKT points and its optimal value."""

    qp: QP
    solution: Solution
    value: float


@dataclass(frozen=True, eq=False, kw_only=True)
class _Draft:
    """Planted data, which determine b, h and q."""

    P: Vector
    A: Vector
    G: Vector
    x: Vector
    y: Vector
    z: Vector
    slack: Vector  #: (p,) slack of G x ≤ h
    z_box: Vector
    lb: Vector
    ub: Vector

    @property
    def q(self) -> Vector:
        """Linear term for which the point is stationary."""
        rows = self.A.T @ self.y + self.G.T @ self.z
        return np.asarray(-(self.P @ self.x + rows + self.z_box))

    def widened(self, by: int, x: Vector) -> _Draft:
        """Append free variables with neither cost nor constraints."""
        rows = {k: np.pad(getattr(self, k), ((0, 0), (0, by))) for k in ("A", "G")}
        far = np.full(by, np.inf)
        return replace(
            self, P=np.pad(self.P, (0, by)), **rows, x=np.append(self.x, x),
            z_box=np.append(self.z_box, np.zeros(by)),
            lb=np.append(self.lb, -far), ub=np.append(self.ub, far),
        )  # fmt: skip

    def rows(self, A: Vector, y: Vector) -> _Draft:
        """Append equality rows."""
        return replace(self, A=np.vstack([self.A, A]), y=np.append(self.y, y))

    def inequalities(self, G: Vector, z: Vector, slack: Vector) -> _Draft:
        """Append inequality rows."""
        return replace(
            self, G=np.vstack([self.G, G]), z=np.append(self.z, z),
            slack=np.append(self.slack, slack),
        )  # fmt: skip

    def at(self, j: int, **values: float) -> _Draft:
        """Change component j of some vectors."""
        there = np.arange(self.x.size) == j % self.x.size
        return replace(
            self, **{k: np.where(there, v, getattr(self, k)) for k, v in values.items()}
        )


Kind = Callable[[_Draft, np.random.Generator], _Draft]


def _tiny_curvature(d: _Draft, rng: np.random.Generator) -> _Draft:
    """Multiply P by 2^-30."""
    return replace(d, P=d.P * 2.0**-30)


def _singular(d: _Draft, rng: np.random.Generator) -> _Draft:
    """Reduce the rank of P to at most half of its order."""
    M = rng.integers(-3, 4, (d.x.size, max(1, d.x.size // 2))).astype(float)
    return replace(d, P=M @ M.T)


def _parallel(d: _Draft, rng: np.random.Generator) -> _Draft:
    """Add a tight row that differs from another one by multiples of 2^-20."""
    old = d.G[0] if d.G.shape[0] else rng.integers(-3, 4, d.x.size)
    near = np.asarray(old + 2.0**-20 * rng.integers(-3, 4, d.x.size))
    return d.inequalities(near[None], rng.integers(0, 5, 1) / 4.0, np.zeros(1))


def _fixed(d: _Draft, rng: np.random.Generator) -> _Draft:
    """Give a variable equal bounds."""
    return d.at(0, lb=d.x[0], ub=d.x[0], z_box=rng.integers(-16, 17) / 4.0)


def _big_m(d: _Draft, rng: np.random.Generator) -> _Draft:
    """Activate a bound by a cost of 1e9; the bound is zero in half of the cases."""
    x = float(d.x[-1] * rng.integers(0, 2))
    return d.at(-1, x=x, lb=x, ub=np.inf, z_box=-1e9)


def _duplicates(d: _Draft, rng: np.random.Generator) -> _Draft:
    """Duplicate a free variable, so that only the sum of both is determined."""
    d = d.at(0, x=d.x[0] - 1, lb=-np.inf, ub=np.inf, z_box=0.0)
    wide = d.widened(1, np.ones(1))
    first = np.append(np.arange(d.x.size), 0)
    return replace(wide, P=d.P[np.ix_(first, first)], A=d.A[:, first], G=d.G[:, first])


def _free_direction(d: _Draft, rng: np.random.Generator) -> _Draft:
    """Add two variables without cost that occur only through their difference."""
    k, t = d.x.size, rng.integers(-8, 9) / 2.0
    link = np.zeros((2, k + 2))
    link[0, 0], link[:, k], link[:, k + 1] = 1, 1, -1
    return d.widened(2, np.array([t, t])).rows(link, np.array([1.0, -1.0]))


def _redundant(d: _Draft, rng: np.random.Generator) -> _Draft:
    """Add inactive rows, scaled by factors from 2^-40 to 2^40 (about 1e±12)."""
    size = 2.0 ** rng.integers(-40, 41, 2)
    rows = np.asarray(rng.integers(-3, 4, (2, d.x.size)) * size[:, None], dtype=float)
    return d.inequalities(rows, np.zeros(2), np.abs(rows @ d.x) + np.maximum(1.0, size))


def _no_cost(d: _Draft, rng: np.random.Generator) -> _Draft:
    """Set q to zero; one row keeps x away from the origin."""
    d = replace(d, y=0 * d.y, z=0 * d.z, z_box=0 * d.z_box)
    return d.rows((d.P @ d.x)[None], -np.ones(1))


def _cancelled(d: _Draft, rng: np.random.Generator) -> _Draft:
    """Shift the optimal value to 0, 2^-20 or 2^-36 by a fixed variable with a cost."""
    aim = float(rng.choice([0.0, 2.0**-20, 2.0**-36]))
    shift = aim - float(d.x @ d.P @ d.x / 2 + d.q @ d.x)
    return d.widened(1, np.ones(1)).at(-1, lb=1.0, ub=1.0, z_box=-shift)


def _far_bounds(d: _Draft, rng: np.random.Generator) -> _Draft:
    """Bound all unbounded variables by 1e12."""
    lb, ub = (np.where(np.isinf(v), np.sign(v) * 1e12, v) for v in (d.lb, d.ub))
    return replace(d, lb=lb, ub=ub)


def _columns(d: _Draft, rng: np.random.Generator) -> _Draft:
    """Change the units of variables by up to 2^±26, about 1e±8."""
    D = np.ldexp(1.0, rng.integers(-26, 27, d.x.size))
    return replace(
        d, P=D[:, None] * d.P * D, A=d.A * D, G=d.G * D, x=d.x / D,
        z_box=d.z_box * D, lb=d.lb / D, ub=d.ub / D,
    )  # fmt: skip


def _rows(d: _Draft, rng: np.random.Generator) -> _Draft:
    """Multiply rows by up to 2^±26."""
    E, H = (np.ldexp(1.0, rng.integers(-26, 27, v.size)) for v in (d.y, d.z))
    return replace(
        d, A=E[:, None] * d.A, y=d.y / E, G=H[:, None] * d.G, z=d.z / H,
        slack=H * d.slack,
    )  # fmt: skip


#: modifications by name, in the order of their application
KINDS: Mapping[str, Kind] = {
    "singular": _singular,
    "tiny curvature": _tiny_curvature,
    "parallel": _parallel,
    "fixed": _fixed,
    "big-M": _big_m,
    "duplicates": _duplicates,
    "free direction": _free_direction,
    "redundant": _redundant,
    "no cost": _no_cost,
    "cancelled": _cancelled,
    "far bounds": _far_bounds,
    "columns": _columns,
    "rows": _rows,
}


def hard(kinds: frozenset[str], seed: int) -> HardQP:
    """Return a QP with 2 to 9 variables and all modifications in `kinds`.

    kinds : keys of `KINDS`
    """
    rng = np.random.default_rng([seed, *(k in kinds for k in KINDS)])
    d = _plain(rng)
    for name, kind in KINDS.items():
        d = kind(d, rng) if name in kinds else d
    qp = QP(
        P=d.P, q=d.q, A=d.A, b=d.A @ d.x, G=d.G, h=d.G @ d.x + d.slack, lb=d.lb, ub=d.ub
    )
    s = Solution(status=Status.SOLVED, x=d.x, y=d.y, z=d.z, z_box=d.z_box)
    x = d.x.astype(np.longdouble)
    return HardQP(qp=qp, solution=s, value=float(x @ (qp.P @ x) / 2 + qp.q @ x))


def _plain(rng: np.random.Generator) -> _Draft:
    """Draw rows, bounds and active sets; entries are small integers and quarters."""
    n, m, p = (int(rng.integers(*span)) for span in ((2, 6), (0, 3), (0, 4)))
    M = rng.integers(-3, 4, (n, n)).astype(float)
    x = rng.integers(-16, 17, n) / 4.0
    tight = rng.random(p) < 0.5
    side = rng.integers(-1, 2, n)  # at lb, between, at ub
    far = [np.where(rng.random(n) < 0.5, np.inf, rng.integers(1, 9, n)) for _ in "lu"]
    return _Draft(
        P=M @ M.T + np.eye(n), x=x,
        A=rng.integers(-3, 4, (m, n)).astype(float), y=rng.integers(-16, 17, m) / 4.0,
        G=rng.integers(-3, 4, (p, n)).astype(float),
        z=np.where(tight, rng.integers(1, 17, p) / 4.0, 0.0),
        slack=np.where(tight, 0.0, rng.integers(1, 9, p) / 2.0),
        z_box=side * rng.integers(1, 17, n) / 4.0,
        lb=np.where(side < 0, x, x - far[0]), ub=np.where(side > 0, x, x + far[1]),
    )  # fmt: skip
