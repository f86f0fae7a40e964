"""Compiled loops of the stiffness assembly, and of the congruence with its inverse.

Bilinear quadrilaterals couple each node to few others, so the sparsity pattern is
found node by node, and each cell adds its 64 entries straight into the CSC arrays: no
triplets, no sorting. Compiled by numba at the first call and cached on disk.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

Ints = NDArray[np.int32]
Floats = NDArray[np.float64]


@njit(cache=True)
def node_pattern(cells: Ints, nodes: int) -> tuple[Ints, Ints]:
    """Find the nodes that share a cell with each node, ascending, as CSR (ptr, idx)."""
    count = np.zeros(nodes + 1, dtype=np.int32)
    for cell in cells:
        for a in cell:
            count[a + 1] += 1
    start = np.cumsum(count).astype(np.int32)
    touching = np.empty(start[-1], dtype=np.int32)
    filled = start[:-1].copy()
    for e in range(len(cells)):
        for a in cells[e]:
            touching[filled[a]] = e
            filled[a] += 1

    ptr = np.zeros(nodes + 1, dtype=np.int32)
    idx = np.empty(4 * start[-1], dtype=np.int32)
    seen = np.full(nodes, -1, dtype=np.int32)
    end = 0
    for a in range(nodes):
        first = end
        for t in range(start[a], start[a + 1]):
            for b in cells[touching[t]]:
                if seen[b] == a:
                    continue
                seen[b] = a
                k = end  # insertion sort: a handful of neighbours
                while k > first and idx[k - 1] > b:
                    idx[k] = idx[k - 1]
                    k -= 1
                idx[k] = b
                end += 1
        ptr[a + 1] = end
    return ptr, idx[:end].copy()


@njit(cache=True)
def dof_pattern(ptr: Ints, idx: Ints) -> tuple[Ints, Ints]:
    """Expand a node pattern to the displacement components 2i and 2i + 1."""
    nodes = len(ptr) - 1
    indptr = np.empty(2 * nodes + 1, dtype=np.int32)
    indices = np.empty(4 * len(idx), dtype=np.int32)
    at = 0
    for a in range(nodes):
        for c in range(2):
            indptr[2 * a + c] = at
            for t in range(ptr[a], ptr[a + 1]):
                indices[at] = 2 * idx[t]
                indices[at + 1] = 2 * idx[t] + 1
                at += 2
    indptr[2 * nodes] = at
    return indptr, indices


@njit(cache=True)
def slots(cells: Ints, ptr: Ints, idx: Ints) -> Ints:
    """Place of node b among the neighbours of node a, for a, b of a cell: (E, 4, 4)."""
    result = np.empty((len(cells), 4, 4), dtype=np.int32)
    for e in range(len(cells)):
        for i in range(4):
            a = cells[e, i]
            for j in range(4):
                b = cells[e, j]
                t = ptr[a]
                while idx[t] != b:
                    t += 1
                result[e, i, j] = t - ptr[a]
    return result


@njit(cache=True)
def add_stiffness(
    points: Floats, cells: Ints, D: Floats, material: Ints, ptr: Ints, slot: Ints
) -> Floats:
    """Sum ∫ BᵀDB over the cells, 2×2 Gauss, into the values of the dof pattern.

    points (N, 2), cells (E, 4), D (materials, 3, 3), material (E,) of each cell.
    """
    data = np.zeros(4 * ptr[-1])
    g = 1 / np.sqrt(3.0)
    Ke = np.empty((8, 8))
    dx, dy = np.empty(4), np.empty(4)
    for e in range(len(cells)):
        d = D[material[e]]
        x0, y0 = points[cells[e, 0]]
        x1, y1 = points[cells[e, 1]]
        x2, y2 = points[cells[e, 2]]
        x3, y3 = points[cells[e, 3]]
        Ke[:] = 0.0
        for q in range(4):
            xi = g if q == 1 or q == 2 else -g
            eta = g if q >= 2 else -g
            # ∂x/∂ξ and so on; the shape functions are ¼(1 ± ξ)(1 ± η)
            a, b = (1 - eta) / 4, (1 + eta) / 4
            c, f = (1 - xi) / 4, (1 + xi) / 4
            x_xi = a * (x1 - x0) + b * (x2 - x3)
            y_xi = a * (y1 - y0) + b * (y2 - y3)
            x_eta = c * (x3 - x0) + f * (x2 - x1)
            y_eta = c * (y3 - y0) + f * (y2 - y1)
            det = x_xi * y_eta - x_eta * y_xi
            dx[0], dx[1] = -a * y_eta + c * y_xi, a * y_eta + f * y_xi
            dx[2], dx[3] = b * y_eta - f * y_xi, -b * y_eta - c * y_xi
            dy[0], dy[1] = a * x_eta - c * x_xi, -a * x_eta - f * x_xi
            dy[2], dy[3] = -b * x_eta + f * x_xi, b * x_eta + c * x_xi
            weight = 1 / det  # both gradients lack their factor 1/det
            for i in range(4):
                sx0 = (d[0, 0] * dx[i] + d[0, 2] * dy[i]) * weight
                sx1 = (d[0, 1] * dx[i] + d[1, 2] * dy[i]) * weight
                sx2 = (d[0, 2] * dx[i] + d[2, 2] * dy[i]) * weight
                sy0 = (d[0, 1] * dy[i] + d[0, 2] * dx[i]) * weight
                sy1 = (d[1, 1] * dy[i] + d[1, 2] * dx[i]) * weight
                sy2 = (d[1, 2] * dy[i] + d[2, 2] * dx[i]) * weight
                for j in range(4):
                    Ke[2 * i, 2 * j] += sx0 * dx[j] + sx2 * dy[j]
                    Ke[2 * i, 2 * j + 1] += sx1 * dy[j] + sx2 * dx[j]
                    Ke[2 * i + 1, 2 * j] += sy0 * dx[j] + sy2 * dy[j]
                    Ke[2 * i + 1, 2 * j + 1] += sy1 * dy[j] + sy2 * dx[j]
        for i in range(4):
            node = cells[e, i]
            row = 2 * (ptr[node + 1] - ptr[node])  # entries per component
            for j in range(4):
                at = 4 * ptr[node] + 2 * slot[e, i, j]
                data[at] += Ke[2 * i, 2 * j]
                data[at + 1] += Ke[2 * i, 2 * j + 1]
                data[at + row] += Ke[2 * i + 1, 2 * j]
                data[at + row + 1] += Ke[2 * i + 1, 2 * j + 1]
    return data


@njit(cache=True)
def congruence(
    ptr: Ints, idx: Ints, data: Floats, number: Ints, C: Floats
) -> tuple[Floats, bool]:
    """Multiply BCBᵀ (m, m), exactly symmetric, for sparse rows B (m, n) in CSR.

    Column j of B belongs to row number[j] of the symmetric C (c, c); also returned:
    whether every entry of B has one (number[j] ≥ 0).
    """
    m = len(ptr) - 1
    F, row = np.empty((m, m)), np.empty(len(C))
    for i in range(m):
        row[:] = 0
        for t in range(ptr[i], ptr[i + 1]):
            if number[idx[t]] < 0:
                return F, False
            row += data[t] * C[number[idx[t]]]
        for j in range(i + 1):
            total = 0.0
            for t in range(ptr[j], ptr[j + 1]):
                total += row[number[idx[t]]] * data[t]
            F[i, j] = F[j, i] = total
    return F, True
