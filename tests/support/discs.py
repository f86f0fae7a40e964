"""QPs on discs and cones: friction of half-spaces, and planted KKT points."""

from dataclasses import replace

import numpy as np

import mortarbench as mb
from mortarbench.harness import QP, Cones, Discs
from mortarbench.harness.operators import assembled

SIZES = {88: 12, 820: 36}  #: number of discs → cells per side


def mindlin(discs, nu, Q):
    """Return the QP of the Cattaneo-Mindlin problem with an explicit P."""
    case = f"half-space/n={SIZES[discs]}/law=mindlin/nu={nu}/Q={Q}/dual"
    qp = mb.build(case).qp
    assert qp.sets[1].radius.size == discs
    return replace(qp, P=assembled(qp.P))


def natural_map(qp, s):
    """Return ‖x − Π(x − g/L)‖·L/‖q‖, where L estimates ‖P‖."""
    v = np.ones(qp.q.size)
    for _ in range(50):
        v = qp.P @ (v / np.linalg.norm(v))
    L, g = np.linalg.norm(v), qp.P @ s.x + qp.q
    nearest = s.x - g / L
    for one in qp.sets:
        nearest = one.project(nearest)
    return np.linalg.norm(s.x - nearest) * L / np.linalg.norm(qp.q)


def qp_on_discs(seed, *, rows=0, dim=2, spread=0.0, touching=False):
    """Return a QP with discs and bounds, and its solution.

    rows : number of equality rows
    spread : radii are between 1 and 10**spread, or zero
    touching : include discs with x on the boundary and a zero multiplier
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
    """Return a QP with cones and free variables, and its solution."""
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
