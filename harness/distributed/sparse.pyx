# cython: language_level=3, boundscheck=False, wraparound=False
"""Products with a sparse matrix in CSR format, fused with a linear combination.

On ranks, vectors are short and products many: the overhead of a library call, and
another pass over the vectors for the combination, would cost as much as the product.
Compiled when the package is installed; `sparse.pyi` has the types.
"""

import numpy as np


cdef class CompressedRows:
    """A matrix M (n, k) in CSR format."""

    cdef readonly tuple shape
    cdef object matrix  # keeps the arrays alive that the pointers below refer to
    cdef Py_ssize_t n, k
    cdef const double *data
    cdef const int *indices
    cdef const int *indptr

    def __init__(self, M):
        cdef const double[::1] data = np.ascontiguousarray(M.data, dtype=np.float64)
        cdef const int[::1] indices = np.ascontiguousarray(M.indices, dtype=np.int32)
        cdef const int[::1] indptr = np.ascontiguousarray(M.indptr, dtype=np.int32)
        self.shape, (self.n, self.k) = M.shape, M.shape
        if M.format != "csr" or indptr.shape[0] != self.n + 1:
            raise ValueError(f"{M.format} matrix; expected one by rows")
        self.matrix = data, indices, indptr
        self.data = &data[0] if data.shape[0] else NULL
        self.indices = &indices[0] if indices.shape[0] else NULL
        self.indptr = &indptr[0]

    def __matmul__(self, const double[::1] x):
        """Return Mx (n,) of x (k,)."""
        self._expect(x.shape[0], self.k)
        product = np.empty(self.n)
        cdef double[::1] y = product
        if self.n and self.k:
            _times(self.n, self.data, self.indices, self.indptr, &x[0], &y[0])
        else:
            y[:] = 0
        return product

    def combined(self, double s, const double[::1] v, double t, const double[::1] x):
        """Return sv + tMx (n,) of v (n,) and x (k,)."""
        self._expect(v.shape[0], self.n)
        product = self @ x
        cdef double[::1] y = product
        cdef Py_ssize_t i
        for i in range(self.n):
            y[i] = s * v[i] + t * y[i]
        return product

    def weighted_difference(
        self, const double[::1] v, const double[::1] x, const double[::1] weights
    ):
        """Return diag(weights)(v − Mx) (n,) of v (n,), x (k,) and weights (n,)."""
        self._expect(v.shape[0], self.n)
        self._expect(weights.shape[0], self.n)
        product = self @ x
        cdef double[::1] y = product
        cdef Py_ssize_t i
        for i in range(self.n):
            y[i] = weights[i] * (v[i] - y[i])
        return product

    def transposed_times(self, const double[::1] x):
        """Return Mᵀx (k,) of x (n,)."""
        self._expect(x.shape[0], self.n)
        product = np.zeros(self.k)
        cdef double[::1] y = product
        if self.n and self.k:
            _transposed_times(
                self.n, self.data, self.indices, self.indptr, &x[0], &y[0]
            )
        return product

    cdef int _expect(self, Py_ssize_t got, Py_ssize_t expected) except -1:
        if got != expected:
            raise ValueError(f"vector of {got} components; expected {expected}")
        return 0


cdef void _times(
    Py_ssize_t n, const double *data, const int *indices, const int *indptr,
    const double *x, double *y,
) noexcept nogil:
    cdef Py_ssize_t i
    cdef int j
    cdef double y_i
    for i in range(n):
        y_i = 0
        for j in range(indptr[i], indptr[i + 1]):
            y_i += data[j] * x[indices[j]]
        y[i] = y_i


cdef void _transposed_times(
    Py_ssize_t n, const double *data, const int *indices, const int *indptr,
    const double *x, double *y,
) noexcept nogil:
    cdef Py_ssize_t i
    cdef int j
    for i in range(n):
        for j in range(indptr[i], indptr[i + 1]):
            y[indices[j]] += data[j] * x[i]
