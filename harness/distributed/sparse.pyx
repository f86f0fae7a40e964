# cython: language_level=3, boundscheck=False, wraparound=False
"""Products with a sparse matrix by rows, together with the sum that they are part of.

On ranks, vectors are short and products many: what a library does around a product, and
a pass for the sum, would cost as much as the product. Compiled when the package is
installed; `sparse.pyi` has the types.
"""

import numpy as np


cdef class SparseRows:
    """A matrix M (n, k) by rows (CSR)."""

    cdef readonly tuple shape
    cdef Py_ssize_t n, k
    cdef const double[::1] data
    cdef const int[::1] indices
    cdef const int[::1] indptr

    def __init__(self, M):
        self.shape = M.shape
        self.n, self.k = M.shape
        self.data = np.ascontiguousarray(M.data, dtype=np.float64)
        self.indices = np.ascontiguousarray(M.indices, dtype=np.int32)
        self.indptr = np.ascontiguousarray(M.indptr, dtype=np.int32)
        if self.indptr.shape[0] != self.n + 1 or M.format != "csr":
            raise ValueError(f"{M.format} matrix; expected one by rows")

    def __matmul__(self, const double[::1] x):
        """Return Mx (n,) of x (k,)."""
        self._expect(x.shape[0], self.k)
        found = np.empty(self.n)
        cdef double[::1] y = found
        cdef Py_ssize_t i
        for i in range(self.n):
            y[i] = self._row(i, x)
        return found

    def combined(self, double s, const double[::1] v, double t, const double[::1] x):
        """Return sv + tMx (n,) of v (n,) and x (k,)."""
        self._expect(v.shape[0], self.n)
        self._expect(x.shape[0], self.k)
        found = np.empty(self.n)
        cdef double[::1] y = found
        cdef Py_ssize_t i
        for i in range(self.n):
            y[i] = s * v[i] + t * self._row(i, x)
        return found

    def weighted_difference(
        self, const double[::1] v, const double[::1] x, const double[::1] weights
    ):
        """Return v − Mx (n,) of v (n,) and x (k,), each entry times its weight (n,)."""
        self._expect(v.shape[0], self.n)
        self._expect(x.shape[0], self.k)
        self._expect(weights.shape[0], self.n)
        found = np.empty(self.n)
        cdef double[::1] y = found
        cdef Py_ssize_t i
        for i in range(self.n):
            y[i] = weights[i] * (v[i] - self._row(i, x))
        return found

    def transposed_times(self, const double[::1] x):
        """Return Mᵀx (k,) of x (n,)."""
        self._expect(x.shape[0], self.n)
        found = np.zeros(self.k)
        cdef double[::1] y = found
        cdef double x_i
        cdef Py_ssize_t i
        cdef int j
        for i in range(self.n):
            x_i = x[i]
            for j in range(self.indptr[i], self.indptr[i + 1]):
                y[self.indices[j]] += self.data[j] * x_i
        return found

    cdef inline double _row(self, Py_ssize_t i, const double[::1] x) noexcept:
        cdef double y_i = 0
        cdef int j
        for j in range(self.indptr[i], self.indptr[i + 1]):
            y_i += self.data[j] * x[self.indices[j]]
        return y_i

    cdef int _expect(self, Py_ssize_t got, Py_ssize_t expected) except -1:
        if got != expected:
            raise ValueError(f"vector of {got} components; expected {expected}")
        return 0
