"""QPs on discs and cones: friction of half-spaces, and planted KKT points."""

from functools import cache

import numpy as np

from mortarbench.harness import QP, Cones, Discs

MU = 0.3  #: coefficient of friction
SIZES = {88: 12, 376: 24, 820: 36, 1468: 48}  #: cells per side of that many discs


@cache
def compliance(n, nu):
    """Return F_t (2k, 2k) of n² cells of two half-spaces, R = a = E = 1 (Cerruti)."""
    h, x, y = _cells(n)
    X, Y = x[:, None] - x, y[:, None] - y
    I0, Ixx, Iyy, Ixy = (np.zeros_like(X) for _ in range(4))
    for sx in (1, -1):
        for sy in (1, -1):
            a, b = X + sx * h / 2, Y + sy * h / 2
            r = np.hypot(a, b)
            log_x, log_y = _log(a, b, r), _log(b, a, r)
            I0 += sx * sy * (a * log_y + b * log_x)
            Ixx += sx * sy * b * log_x
            Iyy += sx * sy * a * log_y
            Ixy -= sx * sy * r
    F = np.empty((x.size, 2, x.size, 2))
    F[:, 0, :, 0], F[:, 1, :, 1] = (1 - nu) * I0 + nu * Ixx, (1 - nu) * I0 + nu * Iyy
    F[:, 0, :, 1] = F[:, 1, :, 0] = nu * Ixy
    F = F.reshape(2 * x.size, -1) * (2 * (1 + nu)) / (np.pi * h * h)
    F.flags.writeable = False
    return (F + F.T) / 2


def mindlin(discs, nu, Q):
    """Return the problem of Cattaneo and Mindlin, Q relative to μP."""
    F, (h, x, y) = compliance(SIZES[discs], nu), _cells(SIZES[discs])
    load = 2 / (3 * (1 - nu**2))  # 4E*/3, E* = E/2(1 − ν²)
    pressure = 1.5 * load / np.pi * np.sqrt(1 - x**2 - y**2)
    stuck = 1 - (1 - Q) ** (2 / 3)
    shift = 0.75 * MU * load * (2 - nu) * (1 + nu) * stuck  # δ
    q = np.zeros(2 * x.size)
    q[::2] = -shift
    index = np.arange(2 * x.size).reshape(-1, 2)
    return QP.from_arrays(F, q, sets=(Discs(index, MU * h * h * pressure),))


def natural_map(qp, s):
    """Return ‖x − Π(x − g/L)‖·L/‖q‖, L = ‖P‖."""
    v = np.ones(qp.q.size)
    for _ in range(50):
        v = qp.P @ (v / np.linalg.norm(v))
    L, g = np.linalg.norm(v), qp.P @ s.x + qp.q
    nearest = s.x - g / L
    for one in qp.sets:
        nearest = one.project(nearest)
    return np.linalg.norm(s.x - nearest) * L / np.linalg.norm(qp.q)


def qp_on_discs(seed, *, rows=0, dim=2, spread=0.0, touching=False):
    """Return a QP on discs, beside bounds, and its solution.

    rows : number of equality rows
    spread : radii differ by up to 10**spread
    touching : include discs with x on the boundary without a multiplier
    """
    rng = np.random.default_rng(seed)
    k, others = int(rng.integers(2, 12)), int(rng.integers(0, 6))
    n = dim * k + others
    order = rng.permutation(n)
    index, rest = order[: dim * k].reshape(k, dim), order[dim * k :]
    radius = 10.0 ** rng.uniform(0, spread, k)
    kind = rng.integers(0, 4 if touching else 3, k)  # inside, slip, zero, touching
    radius[kind == 2] = 0
    d = rng.standard_normal((k, dim))
    d /= np.linalg.norm(d, axis=1)[:, None]
    x, z = rng.standard_normal(n), np.zeros(n)
    share = np.where(kind == 0, rng.uniform(0, 0.9, k), 1)
    x[index] = (share * radius)[:, None] * d
    scale = np.abs(x).max()
    z[index] = (np.isin(kind, (1, 2)) * rng.uniform(0.1, 1, k) * scale)[:, None] * d
    lb, ub = np.full(n, -np.inf), np.full(n, np.inf)
    at_bound = rest[: others // 2]
    lb[at_bound], z[at_bound] = x[at_bound], -rng.uniform(0.1, 1, at_bound.size) * scale
    qp = _with_solution(rng, x, z, rows)
    return QP.from_arrays(**qp, lb=lb, ub=ub, sets=(Discs(index, radius),)), x


def qp_on_cones(seed, dim=3):
    """Return a QP on cones, beside free variables, and its solution."""
    rng = np.random.default_rng(seed)
    k, others = int(rng.integers(2, 12)), int(rng.integers(0, 6))
    index = rng.permutation(dim * k + others)[: dim * k].reshape(k, dim)
    slope, kind = rng.uniform(0.1, 1, k), rng.integers(0, 3, k)  # inside, slip, apex
    d = rng.standard_normal((k, dim - 1))
    d /= np.linalg.norm(d, axis=1)[:, None]
    normal, pull = rng.uniform(0.1, 1, k), rng.uniform(0.1, 1, k)
    x, z = rng.standard_normal(dim * k + others), np.zeros(dim * k + others)
    share = np.select([kind == 0, kind == 1], [rng.uniform(0, 0.9, k), 1])
    x[index[:, 0]] = np.where(kind < 2, normal, 0)
    x[index[:, 1:]] = (share * slope * normal)[:, None] * d
    z[index[:, 0]] = -np.select([kind == 1, kind == 2], [slope * pull, pull])
    z[index[:, 1:]] = np.select([kind == 1, kind == 2], [pull, pull])[:, None] * d
    z[index[kind == 2, 1:]] *= 0.5
    return QP.from_arrays(
        **_with_solution(rng, x, z, 0), sets=(Cones(index, slope),)
    ), x


def _with_solution(rng, x, z, rows):
    W = rng.standard_normal((x.size, x.size))
    P = W @ W.T / x.size + 0.1 * np.eye(x.size)
    A = rng.standard_normal((rows, x.size))
    arrays = {"P": P, "q": -P @ x - z - A.T @ rng.standard_normal(rows)}
    return arrays | ({"A": A, "b": A @ x} if rows else {})


def _cells(n):
    """Return the side, and the centres of cells in contact."""
    h = 2 / 0.9 / n
    at = (np.arange(n) + 0.5 - n / 2) * h
    x, y = (c.ravel() for c in np.meshgrid(at, at, indexing="ij"))
    inside = x**2 + y**2 < 1
    return h, x[inside], y[inside]


def _log(a, b, r):
    """Return ln(a + r) without cancellation, r² = a² + b²."""
    flat = np.where(a < 0, b**2 / np.where(a < 0, r - a, 1), a + r)
    return np.log(flat)
