# cython: language_level=3, boundscheck=False, wraparound=False, cdivision=True
"""Compiled loops of the assembly, and of congruences BCBᵀ.

Cells couple each node to few other nodes. The sparsity pattern is therefore computed
node by node, and the entries of each cell are added directly to the CSC arrays, without
triplets and sorting. The integrals for all elements are in `cells.h`, and types are in
`kernels.pyi`.
"""

import numpy as np


def node_pattern(const int[:, ::1] cells, int nodes):
    """Return, for each node, the nodes that share a cell with it, as CSR (ptr, idx).

    The nodes are listed in ascending order and include the node itself.

    cells : (E, n) node numbers, less than `nodes`
    """
    cdef Py_ssize_t e, a, b, i, j, k, t, first, end = 0, n = cells.shape[1]
    starts = np.zeros(nodes + 1, dtype=np.int32)
    starts[1:] = np.bincount(np.ravel(cells), minlength=nodes).cumsum()
    cdef int[::1] start = starts
    cdef int[::1] filled = starts[:nodes].copy()
    cdef int[::1] touching = np.empty(start[nodes], dtype=np.int32)
    for e in range(cells.shape[0]):
        for i in range(n):
            a = cells[e, i]
            touching[filled[a]] = e
            filled[a] += 1

    pointers = np.zeros(nodes + 1, dtype=np.int32)
    neighbours = np.empty(n * start[nodes], dtype=np.int32)
    cdef int[::1] ptr = pointers, idx = neighbours
    cdef int[::1] seen = np.full(nodes, -1, dtype=np.int32)
    for a in range(nodes):
        first = end
        for t in range(start[a], start[a + 1]):
            for j in range(n):
                b = cells[touching[t], j]
                if seen[b] == a:
                    continue
                seen[b] = a
                k = end  # insertion sort, because nodes have few neighbours
                while k > first and idx[k - 1] > b:
                    idx[k] = idx[k - 1]
                    k -= 1
                idx[k] = b
                end += 1
        ptr[a + 1] = end
    return pointers, neighbours[:end].copy()


def dof_pattern(const int[::1] ptr, const int[::1] idx, int dim):
    """Expand a node pattern to the components dim·i, dim·i + 1, … of each node i."""
    cdef Py_ssize_t a, c, k, t, at = 0, nodes = ptr.shape[0] - 1
    pointers = np.empty(dim * nodes + 1, dtype=np.int32)
    rows = np.empty(dim * dim * idx.shape[0], dtype=np.int32)
    cdef int[::1] indptr = pointers, indices = rows
    for a in range(nodes):
        for c in range(dim):
            indptr[dim * a + c] = at
            for t in range(ptr[a], ptr[a + 1]):
                for k in range(dim):
                    indices[at] = dim * idx[t] + k
                    at += 1
    indptr[dim * nodes] = at
    return pointers, rows


def slots(const int[:, ::1] cells, const int[::1] ptr, const int[::1] idx):
    """Return positions of corner b in the list of neighbours of corner a of each cell.

    The result is (E, n, n), with a along the second and b along the third axis.

    ptr, idx : lists of neighbours, see `node_pattern`
    """
    cdef Py_ssize_t e, i, j, t, n = cells.shape[1]
    cdef int a, b
    places = np.empty((cells.shape[0], n, n), dtype=np.int32)
    cdef int[:, :, ::1] place = places
    for e in range(cells.shape[0]):
        for i in range(n):
            a = cells[e, i]
            for j in range(n):
                b = cells[e, j]
                t = ptr[a]
                while idx[t] != b:
                    t += 1
                place[e, i, j] = t - ptr[a]
    return places


cdef extern from "cells.h" nogil:
    ctypedef struct element:
        int points, pairs
        const double *gradients
        const double *weights
        const int *edges

    void sum_stiffness(
        int n, int dim, const element *elem, const double *points, Py_ssize_t E,
        const int *cells, const double *D, const int *material, const int *ptr,
        const int *slot, double *data
    )


def add_stiffness(
    elem,
    const double[:, ::1] points,
    const int[:, ::1] cells,
    const double[:, :, ::1] D,
    const int[::1] material,
    const int[::1] ptr,
    const int[:, :, ::1] slot,
):
    """Return the entries of Σ_e ∫ BᵀDB in the order of `dof_pattern`.

    elem : `Element`; points : (N, dim); cells : (E, n); D : (materials, v, v) in
    Voigt's notation; material : (E,) material of each cell; ptr, slot : see `Pattern`
    """
    cdef int n = cells.shape[1], dim = points.shape[1]
    cdef const double[:, :, ::1] gradients = elem.table
    cdef const double[::1] weights = elem.weights
    cdef const int[:, :, ::1] edges = elem.edges
    cdef element data
    values = np.zeros(dim * dim * ptr[ptr.shape[0] - 1])
    cdef double[::1] sums = values
    if gradients.shape[1] != dim or gradients.shape[2] != n or n > 8 or dim not in (2, 3):
        raise ValueError(f"cells of {n} nodes in {dim} dimensions do not fit the element")
    if cells.shape[0]:
        data.points, data.pairs = gradients.shape[0], edges.shape[1]
        data.gradients, data.weights = &gradients[0, 0, 0], &weights[0]
        data.edges = &edges[0, 0, 0]
        sum_stiffness(
            n, dim, &data, &points[0, 0], cells.shape[0], &cells[0, 0], &D[0, 0, 0],
            &material[0], &ptr[0], &slot[0, 0, 0], &sums[0],
        )
    return values


def congruence(
    const int[::1] ptr,
    const int[::1] idx,
    const double[::1] data,
    const int[::1] number,
    const double[:, ::1] C,
):
    """Return BCBᵀ (m, m), exactly symmetric, for sparse B (m, n) in CSR.

    Column j of B corresponds to row number[j] of the symmetric C (c, c). The second
    returned value is False if B has an entry in a column j with number[j] < 0.
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
