"""Random QPs with a sparse P, bounds, and a known KKT point."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array, diags_array, random_array

from mortarbench.harness import QP, Vector, no_rows

Array = NDArray[np.float64]


def edges(kind: str, n: int, rng: np.random.Generator) -> tuple[Array, Array, int]:
    """Draw the edges i, j of a grid, a line or a random graph, perhaps disconnected."""
    if kind == "grid":
        side = max(1, int(np.sqrt(n)))
        k = np.arange(side * side).reshape(side, side)
        i = np.concatenate([k[:, :-1].ravel(), k[:-1].ravel()])
        j = np.concatenate([k[:, 1:].ravel(), k[1:].ravel()])
        return i, j, side * side
    if kind == "line":
        return np.arange(n - 1), np.arange(1, n), n
    i, j = rng.integers(0, n, 2 * n), rng.integers(0, n, 2 * n)
    return i[i != j], j[i != j], n


def laplacian(kind: str, n: int, rng: np.random.Generator) -> csr_array:
    """Draw a weighted Laplacian plus a nonnegative diagonal.

    The weights differ by up to six orders of magnitude.
    """
    i, j, n = edges(kind, n, rng)
    w = 10 ** rng.uniform(-rng.uniform(0, 6), 0, i.size)
    graph = csr_array((w, (i, j)), shape=(n, n))
    graph = graph + graph.T
    ground = 10 ** rng.uniform(-6, 0) * (rng.random(n) < rng.choice([0.05, 1]))
    return csr_array(diags_array(graph.sum(axis=0) + ground + 1e-12) - graph)


def sparse_matrix(n: int, rng: np.random.Generator) -> csr_array:
    """Draw P: a Laplacian, AᵀA, the square of a second difference, or a diagonal.

    Of these matrices, 40 % are scaled symmetrically by factors from 1e-4 to 1e4, and
    30 % are permuted.
    """
    kind = rng.choice(["grid", "line", "graph", "gram", "square", "diagonal"])
    if kind == "gram":
        A = random_array((n + 5, n), density=min(1.0, 3 / n), rng=rng)
        A.data -= 0.5
        P = csr_array(A.T @ A) + 10 ** rng.uniform(-8, -1) * diags_array(np.ones(n))
    elif kind == "square":
        one = np.ones(n)
        D = diags_array([one, -2 * one, one], offsets=[-1, 0, 1], shape=(n, n))
        P = csr_array(D.T @ D)
    elif kind == "diagonal":
        P = csr_array(diags_array(10 ** rng.uniform(-4, 4, n)))
    else:
        P = laplacian(str(kind), n, rng)
    n = P.shape[0]
    if rng.random() < 0.4:
        S = diags_array(10 ** rng.uniform(-rng.uniform(0, 4), rng.uniform(0, 4), n))
        P = csr_array(S @ P @ S)
    if rng.random() < 0.3:
        order = rng.permutation(n)
        P = csr_array(csr_array(P)[order][:, order])
    return csr_array((P + P.T) / 2) * 10 ** rng.uniform(-6, 6)


def qp_with_minimum(seed: int, most: int = 400) -> tuple[QP, Vector]:
    """Draw a QP with free, one-sided, two-sided and fixed variables, and its minimiser.

    About 30 % of the active bounds are degenerate (z = 0).
    """
    rng = np.random.default_rng([36, seed])
    P = sparse_matrix(int(rng.integers(1, most)), rng)
    d, n = P.diagonal(), P.shape[0]
    x = 10 ** rng.uniform(-4, 4) * rng.standard_normal(n) / np.sqrt(d)
    size = np.abs(x) + np.abs(x * np.sqrt(d)).max() / np.sqrt(d)
    kind, room = rng.integers(0, 4, n), rng.exponential(size=(3, n))
    active = rng.random(n) < rng.choice([0, 0.2, 0.5, 0.9, 1])
    low = active & (rng.random(n) < 0.7)
    high = active & ~low
    lb = np.where((kind == 1) | (kind == 3), x - room[0] * size, -np.inf)
    ub = np.where(kind >= 2, x + room[1] * size, np.inf)
    fixed = (rng.random(n) < 0.1) & (rng.random() < 0.2)
    lb, ub = np.where(low | fixed, x, lb), np.where(high | fixed, x, ub)
    z = np.where(rng.random(n) < 0.3, 0, room[2]) * d * size * 10 ** rng.uniform(-3, 0)
    z = np.where(low, -z, np.where(high, z, 0))
    stored = P.asformat(rng.choice(["csr", "csc"]))
    return QP(
        P=stored, q=-(P @ x + z), A=no_rows(n), b=np.zeros(0), G=no_rows(n),
        h=np.zeros(0), lb=lb, ub=ub,
    ), x  # fmt: skip
