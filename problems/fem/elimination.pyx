# cython: language_level=3, boundscheck=False, wraparound=False, cdivision=True
# cython: initializedcheck=False
"""Compiled loops of the multifrontal method, with dense work in BLAS and LAPACK.

See `problems.fem.multifrontal`. The rows of U = Lᵀ of a front are stored one after
another. LAPACK, which stores matrices by columns, reads them as the columns of L.
"""

from libc.stdint cimport int64_t
from libc.string cimport memmove, memset
from scipy.linalg.cython_blas cimport dgemv, dsyrk, dtrsm, dtrsv
from scipy.linalg.cython_lapack cimport dpotrf

import numpy as np


def eliminate(
    const int[::1] indptr,
    const int[::1] indices,
    const double[::1] data,
    const int64_t[::1] order,
    const int[::1] position,
    const int[::1] start,
    const int[::1] first,
    const int[::1] border,
    const int[::1] children,
    const int64_t[::1] offset,
    double[::1] rows,
):
    """Compute the rows of U front by front; return False if a pivot is not positive.

    indptr, indices, data : K in CSC; order, position : elimination order and its
    inverse; start, first, border, children : see `Fronts`; offset, rows : see
    `Multifrontal`; `rows` is overwritten and must be zero initially.
    """
    cdef Py_ssize_t s, p, q, t, i, child, m, top = 0, depth = 0
    cdef int low, pivots, rest, size, info = 0
    cdef double one = 1.0, minus = -1.0
    # row of each position in the current front
    cdef int[::1] place = np.zeros(order.shape[0], dtype=np.int32)
    cdef int[::1] to = np.empty(np.diff(first).max(), dtype=np.int32)
    cdef int[::1] stack = np.empty(children.shape[0], dtype=np.int32)
    # stack of the Schur complements of fronts whose parents are not yet assembled
    cdef double[::1] store = np.empty(peak_storage(first, children))
    cdef double *U
    cdef double *S
    for s in range(children.shape[0]):
        low, pivots, rest = start[s], start[s + 1] - start[s], first[s + 1] - first[s]
        size = pivots + rest
        # S lies on the stack above the complements of the children, because these
        # complements are added to S
        U, S = &rows[0] + offset[s], &store[0] + top
        for i in range(pivots):
            place[low + i] = i
        for i in range(rest):
            place[border[first[s] + i]] = pivots + i
            memset(S + i * rest + i, 0, (rest - i) * sizeof(double))
        for p in range(low, low + pivots):
            for t in range(indptr[order[p]], indptr[order[p] + 1]):
                q = position[indices[t]]
                if q >= p:
                    U[(p - low) * size + place[q]] = data[t]
        for i in range(children[s]):
            depth -= 1
            child = stack[depth]
            m = first[child + 1] - first[child]
            for t in range(m):
                to[t] = place[border[first[child] + t]]
            top -= m * m
            add(&store[top], &to[0], m, pivots, rest, U, S)
        if pivots:
            dpotrf(b"L", &pivots, U, &size, &info)
            # not (… > 0) also catches NaN, which dpotrf may not report
            if info or not U[(pivots - 1) * (<Py_ssize_t> size + 1)] > 0:
                return False
        if pivots and rest:
            dtrsm(b"R", b"L", b"T", b"N", &rest, &pivots, &one, U, &size, U + pivots,
                  &size)
            dsyrk(b"L", b"N", &rest, &pivots, &minus, U + pivots, &size, &one, S, &rest)
        if children[s]:  # S replaces the complements of the children on the stack
            for i in range(rest):
                t = i * rest + i
                memmove(&store[top + t], S + t, (rest - i) * sizeof(double))
        stack[depth] = s
        depth += 1
        top += <Py_ssize_t> rest * rest
    return True


def peak_storage(const int[::1] first, const int[::1] children):
    """Return the largest number of doubles on the stack of `eliminate`."""
    cdef Py_ssize_t s, i, depth = 0
    cdef int64_t size, top = 0, most = 0
    cdef int64_t[::1] stack = np.empty(children.shape[0], dtype=np.int64)
    for s in range(children.shape[0]):
        size = first[s + 1] - first[s]
        size *= size
        most = max(most, top + size)
        for i in range(children[s]):
            depth -= 1
            top -= stack[depth]
        stack[depth] = size
        depth += 1
        top += size
    return most


cdef void add(
    const double *below, const int *to, Py_ssize_t m, Py_ssize_t pivots,
    Py_ssize_t rest,
    double *U, double *S,
) noexcept nogil:
    """Add the upper triangle of the Schur complement of a child to its parent front.

    below : (m, m) complement of the child; to : (m,) rows in the parent front;
    U : (pivots, pivots + rest) and S : (rest, rest) of the parent front
    """
    cdef Py_ssize_t i, j
    cdef double *row
    for i in range(m):
        if to[i] < pivots:
            row = U + to[i] * (pivots + rest)
        else:
            row = S + (to[i] - pivots) * rest - pivots
        for j in range(i, m):
            row[to[j]] += below[i * m + j]


def substitute(
    const int[::1] start,
    const int[::1] first,
    const int[::1] border,
    const int64_t[::1] offset,
    const double[::1] rows,
    double[:, ::1] x,
):
    """Solve UᵀU x = b in place; the right-hand sides are the rows of x."""
    cdef Py_ssize_t s, t, k, i, fronts = start.shape[0] - 1
    cdef int pivots, rest, size, unit = 1
    cdef double one = 1.0, minus = -1.0, zero = 0.0
    cdef double[::1] further = np.empty(np.diff(first).max())
    cdef double *v = &further[0]
    cdef double *U
    cdef double *xs
    for t in range(2 * fronts):
        # forward substitution up the tree, then backward substitution down the tree
        s = min(t, 2 * fronts - 1 - t)
        pivots, rest = start[s + 1] - start[s], first[s + 1] - first[s]
        size = pivots + rest
        if not pivots:
            continue
        U = <double *> &rows[0] + offset[s]
        for k in range(x.shape[0]):
            xs = &x[k, start[s]]
            if t < fronts:
                dtrsv(b"L", b"N", b"N", &pivots, U, &size, xs, &unit)
                dgemv(b"N", &rest, &pivots, &minus, U + pivots, &size, xs, &unit, &zero,
                      v, &unit)
                for i in range(rest):
                    x[k, border[first[s] + i]] += v[i]
            else:
                for i in range(rest):
                    v[i] = x[k, border[first[s] + i]]
                dgemv(b"T", &rest, &pivots, &minus, U + pivots, &size, v, &unit, &one,
                      xs, &unit)
                dtrsv(b"L", b"T", b"N", &pivots, U, &size, xs, &unit)


def scatter_symmetric(
    const double[:, :] upper, const int[::1] at, double[:, ::1] to
):
    """Copy a symmetric matrix, given by its upper triangle, into the matrix `to`.

    Row and column i are copied to row and column at[i], or skipped if at[i] < 0.
    """
    cdef Py_ssize_t i, j
    for i in range(at.shape[0]):
        if at[i] < 0:
            continue
        for j in range(i, at.shape[0]):
            if at[j] >= 0:
                to[at[i], at[j]] = upper[i, j]
                to[at[j], at[i]] = upper[i, j]
