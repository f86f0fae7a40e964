# cython: language_level=3, boundscheck=False, wraparound=False, cdivision=True
"""Products of stored matrices with vectors in extended precision.

Entries are extended one by one: a copy of a stiffness in extended precision would take
more than twice its memory, and longer than the product. Compiled when the package is
installed; `products.pyi` has the types.
"""

import numpy as np

ctypedef fused index:
    int
    long long


def times_columns(
    const double[::1] data, const index[::1] indices, const index[::1] indptr,
    const long double[::1] x, Py_ssize_t rows,
):
    """Return Mx (rows,) for M by columns (CSC), its entries doubles, x extended."""
    product = np.zeros(rows, dtype=np.longdouble)
    cdef long double[::1] y = product
    cdef long double x_j
    cdef Py_ssize_t j, k
    for j in range(indptr.shape[0] - 1):
        x_j = x[j]
        for k in range(indptr[j], indptr[j + 1]):
            y[indices[k]] += data[k] * x_j
    return product
