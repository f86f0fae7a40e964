# cython: language_level=3, boundscheck=False, wraparound=False, cdivision=True
"""Compiled loops of the stiffness assembly, and of the congruence with its inverse.

Bilinear quadrilaterals couple each node to few others, so the sparsity pattern is
found node by node, and each cell adds its 64 entries straight into the CSC arrays: no
triplets, no sorting. Compiled when the package is installed; `kernels.pyi` has the
types.
"""

from libc.math cimport sqrt

import numpy as np


def node_pattern(const int[:, ::1] cells, int nodes):
    """Find the nodes that share a cell with each node, ascending, as CSR (ptr, idx).

    cells : (E, 4) node numbers below `nodes`
    """
    cdef Py_ssize_t e, a, b, i, j, k, t, first, end = 0
    starts = np.zeros(nodes + 1, dtype=np.int32)
    starts[1:] = np.bincount(np.ravel(cells), minlength=nodes).cumsum()
    cdef int[::1] start = starts
    cdef int[::1] filled = starts[:nodes].copy()
    cdef int[::1] touching = np.empty(start[nodes], dtype=np.int32)
    for e in range(cells.shape[0]):
        for i in range(4):
            a = cells[e, i]
            touching[filled[a]] = e
            filled[a] += 1

    pointers = np.zeros(nodes + 1, dtype=np.int32)
    neighbours = np.empty(4 * start[nodes], dtype=np.int32)
    cdef int[::1] ptr = pointers, idx = neighbours
    cdef int[::1] seen = np.full(nodes, -1, dtype=np.int32)
    for a in range(nodes):
        first = end
        for t in range(start[a], start[a + 1]):
            for j in range(4):
                b = cells[touching[t], j]
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
    return pointers, neighbours[:end].copy()


def dof_pattern(const int[::1] ptr, const int[::1] idx):
    """Expand a node pattern to the displacement components 2i and 2i + 1."""
    cdef Py_ssize_t a, c, t, at = 0, nodes = ptr.shape[0] - 1
    pointers = np.empty(2 * nodes + 1, dtype=np.int32)
    rows = np.empty(4 * idx.shape[0], dtype=np.int32)
    cdef int[::1] indptr = pointers, indices = rows
    for a in range(nodes):
        for c in range(2):
            indptr[2 * a + c] = at
            for t in range(ptr[a], ptr[a + 1]):
                indices[at] = 2 * idx[t]
                indices[at + 1] = 2 * idx[t] + 1
                at += 2
    indptr[2 * nodes] = at
    return pointers, rows


def slots(const int[:, ::1] cells, const int[::1] ptr, const int[::1] idx):
    """Place of node b among the neighbours of node a, for a, b of a cell: (E, 4, 4)."""
    cdef Py_ssize_t e, i, j, t
    cdef int a, b
    places = np.empty((cells.shape[0], 4, 4), dtype=np.int32)
    cdef int[:, :, ::1] place = places
    for e in range(cells.shape[0]):
        for i in range(4):
            a = cells[e, i]
            for j in range(4):
                b = cells[e, j]
                t = ptr[a]
                while idx[t] != b:
                    t += 1
                place[e, i, j] = t - ptr[a]
    return places


cdef extern from *:
    """
    #if defined(__x86_64__) && defined(__gnu_linux__)
    /* compiled twice, chosen when loaded; without FMA the digits are the same */
    __attribute__((target_clones("avx2", "default")))
    #endif
    static void cell_stiffness(double *, double *, double *, double *);
    """


cdef void cell_stiffness "cell_stiffness"(
    double *x, double *y, double *d, double *Ke
) noexcept nogil:
    """Integrate ∫ BᵀDB of one cell, 2×2 Gauss.

    x, y (4,) of the corners, d (3, 3): D; Ke (2, 2, 4, 4) by components, then by nodes
    """
    cdef double g = 1 / sqrt(3.0)
    cdef double[4] dx, dy
    cdef Py_ssize_t q, i, j
    cdef double xi, eta, a, b, c, f, x_xi, y_xi, x_eta, y_eta, det, weight
    cdef double sx0, sx1, sx2, sy0, sy1, sy2
    cdef double d00 = d[0], d01 = d[1], d02 = d[2], d11 = d[4], d12 = d[5], d22 = d[8]
    cdef double[16] xx, xy, yx, yy
    for i in range(16):
        xx[i] = xy[i] = yx[i] = yy[i] = 0.0
    for q in range(4):
        xi = g if q == 1 or q == 2 else -g
        eta = g if q >= 2 else -g
        # ∂x/∂ξ and so on; the shape functions are ¼(1 ± ξ)(1 ± η)
        a, b = (1 - eta) / 4, (1 + eta) / 4
        c, f = (1 - xi) / 4, (1 + xi) / 4
        x_xi = a * (x[1] - x[0]) + b * (x[2] - x[3])
        y_xi = a * (y[1] - y[0]) + b * (y[2] - y[3])
        x_eta = c * (x[3] - x[0]) + f * (x[2] - x[1])
        y_eta = c * (y[3] - y[0]) + f * (y[2] - y[1])
        det = x_xi * y_eta - x_eta * y_xi
        dx[0], dx[1] = -a * y_eta + c * y_xi, a * y_eta + f * y_xi
        dx[2], dx[3] = b * y_eta - f * y_xi, -b * y_eta - c * y_xi
        dy[0], dy[1] = a * x_eta - c * x_xi, -a * x_eta - f * x_xi
        dy[2], dy[3] = -b * x_eta + f * x_xi, b * x_eta + c * x_xi
        weight = 1 / det  # both gradients lack their factor 1/det
        for i in range(4):
            sx0 = (d00 * dx[i] + d02 * dy[i]) * weight
            sx1 = (d01 * dx[i] + d12 * dy[i]) * weight
            sx2 = (d02 * dx[i] + d22 * dy[i]) * weight
            sy0 = (d01 * dy[i] + d02 * dx[i]) * weight
            sy1 = (d11 * dy[i] + d12 * dx[i]) * weight
            sy2 = (d12 * dy[i] + d22 * dx[i]) * weight
            for j in range(4):
                xx[4 * i + j] += sx0 * dx[j] + sx2 * dy[j]
                xy[4 * i + j] += sx1 * dy[j] + sx2 * dx[j]
                yx[4 * i + j] += sy0 * dx[j] + sy2 * dy[j]
                yy[4 * i + j] += sy1 * dy[j] + sy2 * dx[j]
    for i in range(16):
        Ke[i], Ke[16 + i], Ke[32 + i], Ke[48 + i] = xx[i], xy[i], yx[i], yy[i]


def add_stiffness(
    const double[:, ::1] points,
    const int[:, ::1] cells,
    const double[:, :, ::1] D,
    const int[::1] material,
    const int[::1] ptr,
    const int[:, :, ::1] slot,
):
    """Sum ∫ BᵀDB over the cells, 2×2 Gauss, into the values of the dof pattern.

    points (N, 2), cells (E, 4), D (materials, 3, 3), material (E,) of each cell.
    """
    values = np.zeros(4 * ptr[ptr.shape[0] - 1])
    cdef double[::1] data = values
    cdef double[64] Ke
    cdef double[4] x, y
    cdef Py_ssize_t e, i, j, node, row, at
    for e in range(cells.shape[0]):
        for i in range(4):
            x[i], y[i] = points[cells[e, i], 0], points[cells[e, i], 1]
        cell_stiffness(x, y, <double *> &D[material[e], 0, 0], Ke)
        for i in range(4):
            node = cells[e, i]
            row = 2 * (ptr[node + 1] - ptr[node])  # entries per component
            for j in range(4):
                at = 4 * ptr[node] + 2 * slot[e, i, j]
                data[at] += Ke[4 * i + j]
                data[at + 1] += Ke[16 + 4 * i + j]
                data[at + row] += Ke[32 + 4 * i + j]
                data[at + row + 1] += Ke[48 + 4 * i + j]
    return values


def congruence(
    const int[::1] ptr,
    const int[::1] idx,
    const double[::1] data,
    const int[::1] number,
    const double[:, ::1] C,
):
    """Multiply BCBᵀ (m, m), exactly symmetric, for sparse rows B (m, n) in CSR.

    Column j of B belongs to row number[j] of the symmetric C (c, c); also returned:
    whether every entry of B has one (number[j] ≥ 0).
    """
    cdef Py_ssize_t i, j, k, t, m = ptr.shape[0] - 1, c = C.shape[0]
    cdef double total
    product = np.empty((m, m))
    cdef double[:, ::1] F = product
    cdef double[::1] row = np.empty(c)
    for i in range(m):
        row[:] = 0
        for t in range(ptr[i], ptr[i + 1]):
            if number[idx[t]] < 0:
                return product, False
            for k in range(c):
                row[k] += data[t] * C[number[idx[t]], k]
        for j in range(i + 1):
            total = 0.0
            for t in range(ptr[j], ptr[j + 1]):
                total += row[number[idx[t]]] * data[t]
            F[i, j] = F[j, i] = total
    return product, True
