# cython: language_level=3, boundscheck=False, wraparound=False, cdivision=True
"""Products of sparse matrices of doubles with vectors of extended precision.

Entries are converted one by one. Converting the whole stiffness matrix to extended
precision would more than double its memory and take longer than the product. The module
is compiled when the package is installed; `products.pyi` declares its types.
"""

import numpy as np

ctypedef fused index:
    int
    long long

ctypedef fused real:
    double
    long double

cdef enum:
    MODES = 6  # rigid motions of a body in 3D


def times_columns(
    const double[::1] data, const index[::1] indices, const index[::1] indptr,
    const long double[::1] x, Py_ssize_t rows,
):
    """Return Mx (rows,) for double M in CSC format and x in extended precision."""
    product = np.zeros(rows, dtype=np.longdouble)
    cdef long double[::1] y = product
    cdef long double x_j
    cdef Py_ssize_t j, k
    for j in range(indptr.shape[0] - 1):
        x_j = x[j]
        for k in range(indptr[j], indptr[j + 1]):
            y[indices[k]] += data[k] * x_j
    return product


def times_rows(
    const double[::1] data, const index[::1] indices, const index[::1] indptr,
    const long double[::1] x,
):
    """Return Mx for double M in CSR format and x in extended precision."""
    product = np.empty(indptr.shape[0] - 1, dtype=np.longdouble)
    cdef long double[::1] y = product
    cdef long double y_i
    cdef Py_ssize_t i, k
    for i in range(indptr.shape[0] - 1):
        y_i = 0
        for k in range(indptr[i], indptr[i + 1]):
            y_i += data[k] * x[indices[k]]
        y[i] = y_i
    return product


def projected_products(
    const double[::1] data, const index[::1] indices, const index[::1] indptr,
    const double[:, ::1] R, const long long[::1] starts,
    const real[::1] v, real[::1] found,
):
    """Write PMP v_s to `found` (N,) for each slice v_s (n,) of v (N,).

    P = I − RRᵀ; M (n, n) in CSC format and orthonormal R (n, r), r ≤ 6, are doubles.
    Slices of v and `found` begin at `starts`. If a slice of v is zero, the slice of
    `found` is not changed.
    """
    cdef Py_ssize_t n = indptr.shape[0] - 1, s, first, i, j, k
    part = np.empty(n, dtype=np.double if real is double else np.longdouble)
    cdef real[::1] own = part
    cdef real own_j
    cdef bint acts
    if R.shape[1] > MODES:
        raise ValueError(f"{R.shape[1]} columns of R; expected at most {MODES}")
    for s in range(starts.shape[0]):
        first, acts = starts[s], False
        for i in range(n):
            own[i] = v[first + i]
            acts = acts or own[i] != 0
        if not acts:
            continue
        project(R, &own[0])
        for i in range(n):
            found[first + i] = 0
        for j in range(n):
            own_j = own[j]
            for k in range(indptr[j], indptr[j + 1]):
                found[first + indices[k]] += data[k] * own_j
        project(R, &found[first])


cdef void project(const double[:, ::1] R, real *v) noexcept nogil:
    """Apply P = I − RRᵀ to v (n,)."""
    cdef real[MODES] along
    cdef Py_ssize_t i, l, r = R.shape[1]
    cdef real v_i
    cdef real left
    for l in range(r):
        along[l] = 0
    for i in range(R.shape[0]):
        v_i = v[i]
        for l in range(r):
            along[l] += R[i, l] * v_i
    for i in range(R.shape[0]):
        left = v[i]
        for l in range(r):
            left -= R[i, l] * along[l]
        v[i] = left
