# cython: language_level=3, boundscheck=False, wraparound=False, cdivision=True
"""Linear maps that compiled code applies to vectors without calling Python.

A `LinearMap` is a sparse matrix, the inverse of a factorised matrix, the identity, or a
composition, sum or direct sum of other maps. Operators of decomposed bodies, and the
rows of their coarse problem, are implemented as linear maps. For short vectors, a
product takes less time than the overhead of a library call. Products that are combined
with a linear combination save another pass over the vectors. The module is compiled
when the package is installed. `sparse.pyi` declares its types for Python, and
`sparse.pxd` declares them for compiled callers.
"""

from libc.math cimport sqrt
from libc.stdlib cimport calloc, free, realloc
from libc.string cimport memcpy, memset
from scipy.linalg.cython_blas cimport dsyrk, dtrsv
from scipy.linalg.cython_lapack cimport dpotrf

import numpy as np
from scipy.linalg import blas, eigh, qr
from scipy.sparse import csc_array


cdef class LinearMap:
    """A linear map x ↦ Ax with A (n, k), for vectors x (k,) and matrices x (k, w)."""

    cdef int apply(self, const double *x, double *y, Py_ssize_t columns) except -1:
        """y ← Ax for x (k, columns) and y (n, columns), stored by rows."""
        raise NotImplementedError

    def __call__(self, x):
        """Return Ax."""
        x = np.ascontiguousarray(x, dtype=np.float64)
        self.expect(x.shape[0], self.k)
        product = np.zeros((self.n, *x.shape[1:]))
        cdef const double[::1] from_ = x.reshape(-1)
        cdef double[::1] to = product.reshape(-1)
        if to.shape[0] and from_.shape[0]:
            self.apply(&from_[0], &to[0], to.shape[0] // self.n)
        return product

    def __matmul__(self, x):
        return self(x)

    cdef int expect(self, Py_ssize_t got, Py_ssize_t expected) except -1:
        if got != expected:
            raise ValueError(f"vector of {got} components; expected {expected}")
        return 0


cdef class CompressedRows(LinearMap):
    """A matrix M (n, k) in CSR format."""

    def __init__(self, M):
        if M.format != "csr":
            raise ValueError(f"{M.format} matrix; expected one by rows")
        self.hold(M.shape, M.data, M.indices, M.indptr)

    @staticmethod
    def of_transpose(M):
        """Return Mᵀ (k, n) of M (n, k) in CSC format, without a copy of its arrays."""
        cdef CompressedRows new = CompressedRows.__new__(CompressedRows)
        if M.format != "csc":
            raise ValueError(f"{M.format} matrix; expected one by columns")
        new.hold((M.shape[1], M.shape[0]), M.data, M.indices, M.indptr)
        return new

    @staticmethod
    def of_array(const double[:, ::1] M):
        """Return the matrix M, without the zero entries of the array."""
        cdef CompressedRows new = CompressedRows.__new__(CompressedRows)
        cdef Py_ssize_t i, j, count = 0, n = M.shape[0], k = M.shape[1]
        entries, columns = np.empty(n * k), np.empty(n * k, dtype=np.int32)
        begin = np.zeros(n + 1, dtype=np.int32)
        cdef double[::1] data = entries
        cdef int[::1] indices = columns
        cdef int[::1] indptr = begin
        for i in range(n):
            for j in range(k):
                if M[i, j] != 0:
                    data[count], indices[count] = M[i, j], <int> j
                    count += 1
            indptr[i + 1] = <int> count
        new.hold((n, k), entries[:count], columns[:count], begin)
        return new

    cdef int hold(self, tuple shape, data, indices, indptr) except -1:
        cdef const double[::1] entries = np.ascontiguousarray(data, dtype=np.float64)
        cdef const int[::1] column = np.ascontiguousarray(indices, dtype=np.int32)
        cdef const int[::1] begin = np.ascontiguousarray(indptr, dtype=np.int32)
        self.shape, (self.n, self.k) = shape, shape
        self.expect(begin.shape[0], self.n + 1)
        self.arrays = entries, column, begin
        self.data = &entries[0] if entries.shape[0] else NULL
        self.indices = &column[0] if column.shape[0] else NULL
        self.indptr = &begin[0]
        return 0

    def rows(self, chosen):
        """Return the matrix (b, k) of the rows with numbers `chosen` (b,)."""
        cdef const long long[::1] at = np.ascontiguousarray(chosen, dtype=np.int64)
        cdef Py_ssize_t i, count = 0
        cdef int j
        cdef CompressedRows new = CompressedRows.__new__(CompressedRows)
        for i in range(at.shape[0]):
            count += self.indptr[at[i] + 1] - self.indptr[at[i]]
        entries, columns = np.empty(count), np.empty(count, dtype=np.int32)
        begin = np.zeros(at.shape[0] + 1, dtype=np.int32)
        cdef double[::1] data = entries
        cdef int[::1] indices = columns
        cdef int[::1] indptr = begin
        count = 0
        for i in range(at.shape[0]):
            for j in range(self.indptr[at[i]], self.indptr[at[i] + 1]):
                data[count], indices[count] = self.data[j], self.indices[j]
                count += 1
            indptr[i + 1] = <int> count
        new.hold((at.shape[0], self.k), entries, columns, begin)
        return new

    def unit_columns(self):
        """Return M with columns scaled to norm 1, and the original norms (k,).

        Columns of norm zero are not scaled.
        """
        cdef Py_ssize_t j, count = self.indptr[self.n]
        cdef CompressedRows new = CompressedRows.__new__(CompressedRows)
        sizes, entries = np.zeros(self.k), np.empty(count)
        cdef double[::1] size = sizes
        cdef double[::1] data = entries
        for j in range(count):
            size[self.indices[j]] += self.data[j] * self.data[j]
        for j in range(self.k):
            size[j] = sqrt(size[j])
        for j in range(count):
            data[j] = 1 / (size[self.indices[j]] or 1.0) * self.data[j]
        new.hold(self.shape, entries, self.arrays[1], self.arrays[2])
        return new, sizes

    def transposed(self):
        """Return Mᵀ (k, n) in CSR format."""
        cdef Py_ssize_t i, count = self.indptr[self.n]
        cdef int j, at
        cdef CompressedRows new = CompressedRows.__new__(CompressedRows)
        begin = np.zeros(self.k + 1, dtype=np.int32)
        entries, columns = np.empty(count), np.empty(count, dtype=np.int32)
        next_place = np.empty(self.k + 1, dtype=np.int32)
        cdef int[::1] indptr = begin
        cdef int[::1] place = next_place
        cdef int[::1] indices = columns
        cdef double[::1] data = entries
        for j in range(count):
            indptr[self.indices[j] + 1] += 1
        np.cumsum(begin, out=begin)
        next_place[:] = begin
        for i in range(self.n):
            for j in range(self.indptr[i], self.indptr[i + 1]):
                at = place[self.indices[j]]
                indices[at], data[at] = <int> i, self.data[j]
                place[self.indices[j]] += 1
        new.hold((self.k, self.n), entries, columns, begin)
        return new

    @property
    def touched(self):
        """Mask (k,) of the columns that have entries."""
        cdef Py_ssize_t j
        mask = np.zeros(self.k, dtype=bool)
        cdef unsigned char[::1] has_entry = mask.view(np.uint8)
        for j in range(self.indptr[self.n]):
            has_entry[self.indices[j]] = 1
        return mask

    @property
    def by_columns(self):
        """Mᵀ (k, n) in CSC format, with the same arrays as M."""
        data, indices, indptr = map(np.asarray, self.arrays)
        return csc_array((data, indices, indptr), shape=(self.k, self.n))

    cdef int apply(self, const double *x, double *y, Py_ssize_t columns) except -1:
        cdef Py_ssize_t i, c
        cdef const double *x_j
        cdef int j
        if columns == 1:
            self.times(x, y)
            return 0
        memset(y, 0, self.n * columns * sizeof(double))
        for i in range(self.n):
            for j in range(self.indptr[i], self.indptr[i + 1]):
                x_j = x + self.indices[j] * columns
                for c in range(columns):
                    y[i * columns + c] += self.data[j] * x_j[c]
        return 0

    cdef void times(self, const double *x, double *y) noexcept:
        """y ← Mx."""
        cdef Py_ssize_t i, j, last
        cdef double y_i, z_i
        cdef const double *data = self.data
        cdef const int *indices = self.indices
        cdef const int *indptr = self.indptr
        j = indptr[0]
        for i in range(self.n):
            # two partial sums, since each addition to the same sum waits for the
            # previous addition
            y_i = z_i = 0
            last = indptr[i + 1]
            while j + 1 < last:
                y_i += data[j] * x[indices[j]]
                z_i += data[j + 1] * x[indices[j + 1]]
                j += 2
            if j < last:
                y_i += data[j] * x[indices[j]]
                j += 1
            y[i] = y_i + z_i

    cdef void add_transposed(self, const double *x, double *y) noexcept:
        """y ← y + Mᵀx."""
        cdef Py_ssize_t i
        cdef int j
        for i in range(self.n):
            for j in range(self.indptr[i], self.indptr[i + 1]):
                y[self.indices[j]] += self.data[j] * x[i]

    cdef void combine(
        self, double s, const double *v, double t, const double *x, double *y
    ) noexcept:
        """y ← sv + tMx; y and v may be the same array."""
        cdef Py_ssize_t i, j
        cdef double y_i
        cdef const double *data = self.data
        cdef const int *indices = self.indices
        cdef const int *indptr = self.indptr
        j = indptr[0]
        for i in range(self.n):
            y_i = 0
            while j < indptr[i + 1]:
                y_i += data[j] * x[indices[j]]
                j += 1
            y[i] = s * v[i] + t * y_i

    cdef void weigh_difference(
        self, const double *v, const double *x, const double *weights, double *y
    ) noexcept:
        """y ← diag(weights)(v − Mx)."""
        cdef Py_ssize_t i, j
        cdef double y_i
        cdef const double *data = self.data
        cdef const int *indices = self.indices
        cdef const int *indptr = self.indptr
        j = indptr[0]
        for i in range(self.n):
            y_i = 0
            while j < indptr[i + 1]:
                y_i += data[j] * x[indices[j]]
                j += 1
            y[i] = weights[i] * (v[i] - y_i)

    def combined(self, double s, const double[::1] v, double t, const double[::1] x):
        """Return sv + tMx (n,) for v (n,) and x (k,)."""
        self.expect(v.shape[0], self.n)
        self.expect(x.shape[0], self.k)
        product = np.empty(self.n)
        cdef double[::1] y = product
        if self.n:
            self.combine(s, &v[0], t, &x[0] if self.k else NULL, &y[0])
        return product

    def transposed_times(self, const double[::1] x):
        """Return Mᵀx (k,) for x (n,)."""
        self.expect(x.shape[0], self.n)
        product = np.zeros(self.k)
        cdef double[::1] y = product
        if self.n and self.k:
            self.add_transposed(&x[0], &y[0])
        return product

    def outer_products(self, const double[::1] weights, const int[::1] place, int size):
        """Return Σᵢ wᵢmᵢmᵢᵀ (size, size), where mᵢ are the rows of M as columns.

        weights : (n,) wᵢ
        place : (k,) new numbers of the columns, from 0 to `size` − 1 for columns that
            have entries
        """
        self.expect(weights.shape[0], self.n)
        self.expect(place.shape[0], self.k)
        total = np.zeros((size, size))
        cdef double[:, ::1] block = total
        if size and self.n:
            add_outer_products(self, 1.0, &weights[0], &place[0], &block[0, 0], size)
        return total


cdef void add_outer_products(
    CompressedRows M, double s, const double *weights, const int *place, double *block,
    Py_ssize_t size,
) noexcept:
    """block ← block + s Σᵢ wᵢmᵢmᵢᵀ, see `CompressedRows.outer_products`."""
    cdef Py_ssize_t i
    cdef int j, l
    cdef double *row
    cdef double m
    for i in range(M.n):
        if weights[i] == 0:
            continue
        for j in range(M.indptr[i], M.indptr[i + 1]):
            row = block + place[M.indices[j]] * size
            m = s * weights[i] * M.data[j]
            for l in range(M.indptr[i], M.indptr[i + 1]):
                row[place[M.indices[l]]] += m * M.data[l]


cdef class Composition(LinearMap):
    """The composition x ↦ A₁A₂…Aᵣx of maps; Aᵣ is applied first."""

    cdef tuple maps
    cdef double *between[2]
    cdef Py_ssize_t room

    def __init__(self, *maps):
        cdef LinearMap map_
        self.maps = maps
        for left, right in zip(maps, maps[1:]):
            self.expect(right.shape[0], left.shape[1])
        self.n, self.k = maps[0].shape[0], maps[len(maps) - 1].shape[1]
        self.shape = self.n, self.k

    def __dealloc__(self):
        free(self.between[0])
        free(self.between[1])

    cdef int apply(self, const double *x, double *y, Py_ssize_t columns) except -1:
        cdef Py_ssize_t i, last = len(self.maps) - 1, room = 0
        cdef LinearMap map_
        for map_ in self.maps:
            room = max(room, map_.n * columns)
        if room > self.room:
            for i in range(2):
                self.between[i] = resized(self.between[i], room)
            self.room = room
        for i in range(last, -1, -1):
            map_ = self.maps[i]
            map_.apply(x, y if i == 0 else self.between[i % 2], columns)
            x = self.between[i % 2]
        return 0


cdef class Identity(LinearMap):
    """The map x ↦ x of vectors (n,)."""

    def __init__(self, n):
        self.n = self.k = n
        self.shape = n, n

    cdef int apply(self, const double *x, double *y, Py_ssize_t columns) except -1:
        memcpy(y, x, self.n * columns * sizeof(double))
        return 0


cdef class DirectSum(LinearMap):
    """The block diagonal map diag(A₁, …, Aᵣ) of maps Aᵢ."""

    cdef tuple maps

    def __init__(self, *maps):
        self.maps = maps
        self.n, self.k = (sum(map_.shape[i] for map_ in maps) for i in (0, 1))
        self.shape = self.n, self.k

    cdef int apply(self, const double *x, double *y, Py_ssize_t columns) except -1:
        cdef LinearMap map_
        for map_ in self.maps:
            map_.apply(x, y, columns)
            x += map_.k * columns
            y += map_.n * columns
        return 0


cdef double *resized(double *held, Py_ssize_t size) except NULL:
    held = <double *> realloc(held, max(size, 1) * sizeof(double))
    if not held:
        raise MemoryError(f"cannot allocate {size} numbers")
    return held


# --- factors ------------------------------------------------------------------------


# Largest relative amount by which a squared pivot may be below its lower bound, since
# both values are rounded.
cdef double PIVOT_TOLERANCE = 1e-3


cdef bint factorised_above(
    double *M, Py_ssize_t k, double share, const double *L_0
) noexcept:
    """Factorise M (k, k) in place; return False if a pivot is below its lower bound."""
    cdef int n = k, info = 0
    cdef Py_ssize_t i
    cdef double pivot, least
    dpotrf(b"L", &n, M, &n, &info)
    if info:
        return False
    for i in range(k):
        pivot, least = M[i * k + i], L_0[i * k + i]
        if not pivot * pivot >= (1 - PIVOT_TOLERANCE) * share * least * least:
            return False
    return True


cdef class BorderedFactor(LinearMap):
    """Cholesky factor of a sparse A (n, n), with a dense block for the last rows.

    These last rows are called the *border*.

    ::

        A = LLᵀ,   L = ⎡L_aa     ⎤     with the rows of A in the order `order`.
                       ⎣L_ba  L_bb⎦

    If A changes only on the border, it suffices to factorise the new Schur complement
    L_bbL_bbᵀ. As a linear map, an object of this class is x ↦ A⁻¹x.

    order : (n,) permutation of the rows, with the border last
    columns : first n − b columns of L (n, n − b) in CSC format, each with its diagonal
        entry first
    L_bb : (b, b) lower triangular; the upper triangle is not used
    """

    def __init__(self, order, columns, L_bb):
        self.hold(order, columns.indptr, columns.indices, columns.data,
                  np.asfortranarray(L_bb, dtype=np.float64))

    cdef int hold(self, order, indptr, indices, data, L_bb) except -1:
        cdef const int[::1] rows = np.ascontiguousarray(order, dtype=np.int32)
        cdef const int[::1] begin = np.ascontiguousarray(indptr, dtype=np.int32)
        cdef const int[::1] index = np.ascontiguousarray(indices, dtype=np.int32)
        cdef const double[::1] entries = np.ascontiguousarray(data, dtype=np.float64)
        cdef const double[::1, :] corner = L_bb
        cdef Py_ssize_t i, j, b = corner.shape[0]
        cdef int size = b
        cdef double one = 1.0, zero = 0.0
        cdef int[::1] place = np.empty(rows.shape[0], dtype=np.int32)
        self.n = self.k = rows.shape[0]
        self.shape, self.inner, self.scale = (self.n, self.n), self.n - b, 1.0
        self.expect(begin.shape[0] - 1, self.inner)
        for i in range(self.n):
            place[rows[i]] = <int> (i - self.inner)
        self.arrays = rows, place, begin, index, entries
        if self.n:
            self.order, self.place = &rows[0], &place[0]
        self.indptr = &begin[0]
        self.indices = &index[0] if index.shape[0] else NULL
        self.data = &entries[0] if entries.shape[0] else NULL
        self.reserve(b)
        self.schur = <double *> calloc(max(b * b, 1), sizeof(double))
        if not self.schur:
            raise MemoryError
        for j in range(b):
            for i in range(j, b):
                self.L[j * b + i] = corner[i, j]
        if b:  # dsyrk computes the lower triangle of L_bbL_bbᵀ, which is then mirrored
            dsyrk(b"L", b"N", &size, &size, &one, self.L, &size, &zero, self.schur,
                  &size)
        for j in range(b):
            for i in range(j):
                self.schur[j * b + i] = self.schur[i * b + j]
        return 0

    def __dealloc__(self):
        free(self.L)
        free(self.schur)
        free(self.u)

    cdef int reserve(self, Py_ssize_t border) except -1:
        self.border = border
        self.L = <double *> calloc(max(border * border, 1), sizeof(double))
        self.u = <double *> calloc(max(self.n, 1), sizeof(double))
        if not self.L or not self.u:
            raise MemoryError
        return 0

    @staticmethod
    def of_array(A, border):
        """Factorise an array A (n, n) with few nonzeros.

        In each step, the remaining row with the fewest nonzeros is eliminated (minimum
        degree). Rows of the border are eliminated last.

        border : (b,) numbers of the rows of the border

        Raises
        ------
        numpy.linalg.LinAlgError
            If A is not positive definite.

        """
        cdef BorderedFactor new = BorderedFactor.__new__(BorderedFactor)
        cdef const long long[::1] last = np.ascontiguousarray(border, dtype=np.int64)
        cdef Py_ssize_t n = len(A), i, j, l, m, p, step, count = 0
        cdef Py_ssize_t inner = n - last.shape[0]
        cdef double[:, ::1] M = np.array(A, dtype=np.float64, order="C")
        cdef double root, share
        cdef int size, info = 0
        order, begin = np.empty(n, dtype=np.int32), np.zeros(inner + 1, dtype=np.int32)
        indices, data = np.empty(inner * n, dtype=np.int32), np.empty(inner * n)
        corner = np.empty((n - inner, n - inner), order="F")
        cdef int[:, ::1] work = np.zeros((5, n), dtype=np.int32)
        cdef int[::1] degree = work[0]
        cdef int[::1] neighbour = work[1]
        cdef int[::1] is_done = work[2]
        cdef int[::1] place = work[3]
        cdef int[::1] is_last = work[4]
        cdef int[::1] row = order
        cdef int[::1] indptr = begin
        cdef int[::1] index = indices
        cdef double[::1] value = data
        cdef double[::1, :] L_bb = corner
        for i in range(n - inner):
            is_last[last[i]] = 1
            row[inner + i] = <int> last[i]
        for i in range(n):
            for j in range(n):
                degree[i] += M[i, j] != 0
        for step in range(inner):
            p = -1
            for i in range(n):
                if not is_done[i] and not is_last[i] and (
                    p < 0 or degree[i] < degree[p]
                ):
                    p = i
            if not M[p, p] > 0:
                raise np.linalg.LinAlgError("not positive definite")
            row[step], is_done[p], root, m = <int> p, 1, sqrt(M[p, p]), 0
            index[count], value[count] = <int> p, root
            for i in range(n):
                if not is_done[i] and M[p, i] != 0:
                    neighbour[m] = <int> i
                    m += 1
                    index[count + m], value[count + m] = <int> i, M[p, i] / root
                    degree[i] -= 1
            for j in range(m):
                share = value[count + 1 + j]
                for l in range(m):
                    i = neighbour[l]
                    if M[neighbour[j], i] == 0:
                        degree[i] += 1
                    M[neighbour[j], i] -= share * value[count + 1 + l]
            count += m + 1
            indptr[step + 1] = <int> count
        for i in range(n):
            place[row[i]] = <int> i
        for j in range(count):
            index[j] = place[index[j]]
        for j in range(n - inner):
            for i in range(n - inner):
                L_bb[i, j] = M[row[inner + i], row[inner + j]]
        size = <int> (n - inner)
        if size:
            dpotrf(b"L", &size, &L_bb[0, 0], &size, &info)
        if info:
            raise np.linalg.LinAlgError("not positive definite")
        new.hold(order, begin, indices[:count], data[:count], corner)
        return new

    # forward and backward substitution, with a factor that is not yet scaled

    cdef void reduce(self, const double *t, double *u) noexcept:
        """u ← (L_aa⁻¹t_a, t_b − L_baL_aa⁻¹t_a), in the order of L, before scaling."""
        cdef Py_ssize_t i, j
        cdef int l
        cdef double u_j
        for i in range(self.n):
            u[i] = t[self.order[i]]
        for j in range(self.inner):
            l = self.indptr[j]
            u_j = u[j] = u[j] / self.data[l]
            for l in range(l + 1, self.indptr[j + 1]):
                u[self.indices[l]] -= self.data[l] * u_j

    cdef void extend(self, double *u, double *y) noexcept:
        """y ← solution of L_aaᵀy_a + L_baᵀy_b = u_a with y_b = u_b; overwrites u."""
        cdef Py_ssize_t i, j
        cdef int l
        cdef double u_j
        for j in range(self.inner - 1, -1, -1):
            u_j = u[j]
            for l in range(self.indptr[j] + 1, self.indptr[j + 1]):
                u_j -= self.data[l] * u[self.indices[l]]
            u[j] = u_j / self.data[self.indptr[j]]
        for i in range(self.n):
            y[self.order[i]] = u[i]

    cdef void solve_border(self, double *r, bint transposed) noexcept:
        """r ← L_bb⁻¹r, or L_bb⁻ᵀr if `transposed`."""
        cdef int b = self.border, one = 1
        if b:
            dtrsv(b"L", b"T" if transposed else b"N", b"N", &b, self.L, &b, r, &one)

    # solves with the scaled factor, whose L_aa and L_ba are multiplied by √scale

    cdef void forward_to(self, const double *t, double *a) noexcept:
        """a ← L⁻¹t."""
        self.reduce(t, a)
        self.scale_inner(a, 1 / sqrt(self.scale))
        self.solve_border(a + self.inner, False)

    cdef void backward_to(self, const double *a, double *y) noexcept:
        """y ← L⁻ᵀa."""
        memcpy(self.u, a, self.n * sizeof(double))
        self.scale_inner(self.u, 1 / sqrt(self.scale))
        self.solve_border(self.u + self.inner, True)
        self.extend(self.u, y)

    cdef void solve_to(self, const double *t, double *y) noexcept:
        """y ← A⁻¹t."""
        self.reduce(t, self.u)
        self.scale_inner(self.u, 1 / self.scale)
        self.solve_border(self.u + self.inner, False)
        self.solve_border(self.u + self.inner, True)
        self.extend(self.u, y)

    cdef void scale_inner(self, double *u, double s) noexcept:
        cdef Py_ssize_t i
        if s != 1:
            for i in range(self.inner):
                u[i] *= s

    cdef int apply(self, const double *x, double *y, Py_ssize_t columns) except -1:
        cdef Py_ssize_t i, c
        if columns == 1:
            self.solve_to(x, y)
            return 0
        cdef double *one = resized(NULL, self.n)
        for c in range(columns):
            for i in range(self.n):
                one[i] = x[i * columns + c]
            self.solve_to(one, one)
            for i in range(self.n):
                y[i * columns + c] = one[i]
        free(one)
        return 0

    def forward(self, const double[::1] t):
        """Return L⁻¹t (n,), in the order of L."""
        self.expect(t.shape[0], self.n)
        result = np.empty(self.n)
        cdef double[::1] a = result
        if self.n:
            self.forward_to(&t[0], &a[0])
        return result

    def backward(self, const double[::1] a):
        """Return L⁻ᵀa (n,) for a vector a in the order of L."""
        self.expect(a.shape[0], self.n)
        result = np.empty(self.n)
        cdef double[::1] y = result
        if self.n:
            self.backward_to(&a[0], &y[0])
        return result

    @property
    def least_pivot(self):
        """Smallest diagonal entry of L; inf for n = 0."""
        cdef Py_ssize_t i
        cdef double least = float("inf")
        for i in range(self.inner):
            least = min(least, sqrt(self.scale) * self.data[self.indptr[i]])
        for i in range(self.border):
            least = min(least, self.L[i * self.border + i])
        return least

    @property
    def entries(self):
        """Number of stored entries of L."""
        return self.indptr[self.inner] + self.border * (self.border + 1) // 2

    # changes of the border

    cdef BorderedFactor less(self, double shift, const double *block):
        """Return the factor of (1 + shift)A minus a block (b, b) on the border."""
        cdef BorderedFactor new = BorderedFactor.__new__(BorderedFactor)
        cdef Py_ssize_t i, b = self.border
        new.n, new.k, new.shape = self.n, self.k, self.shape
        new.inner, new.scale, new.arrays = self.inner, 1 + shift, self.arrays
        new.order, new.place, new.indptr = self.order, self.place, self.indptr
        new.indices, new.data = self.indices, self.data
        new.whole = self
        new.reserve(b)
        for i in range(b * b):
            new.L[i] = (1 + shift) * self.schur[i] - block[i]
        if b and not factorised_above(new.L, b, shift, self.L):
            for i in range(b * b):
                new.L[i] = (1 + shift) * self.schur[i] - block[i]
            new.raise_border(shift)
        return new

    cdef int raise_border(self, double shift) except -1:
        """Factorise the Schur complement M stored in `L`, despite rounding.

        In exact arithmetic, M ≥ shift·L₀L₀ᵀ with the factor L₀ of `whole`. Since M is a
        difference of matrices whose norms are similar to that of L₀L₀ᵀ, the computed M
        may have negative eigenvalues. Therefore, eigenvalues of L₀⁻¹ML₀⁻ᵀ = QλQᵀ below
        `shift` are set to `shift`, and L follows from

            LLᵀ = L₀ Q λ Qᵀ L₀ᵀ   by a QR factorisation of √λ QᵀL₀ᵀ,

        which contains no difference of matrices and therefore preserves the lower
        bound.
        """
        cdef Py_ssize_t i, j, b = self.border
        M, L_0 = np.empty((b, b), order="F"), np.zeros((b, b), order="F")
        cdef double[::1, :] at = M
        cdef double[::1, :] lower = L_0
        for j in range(b):
            for i in range(b):
                at[i, j] = self.L[j * b + i]
            for i in range(j, b):
                lower[i, j] = self.whole.L[j * b + i]
        inner = blas.dtrsm(1.0, L_0, blas.dtrsm(1.0, L_0, M, lower=1).T, lower=1)
        size, Q = eigh((inner + inner.T) / 2)
        half = blas.dtrmm(1.0, L_0, Q * np.sqrt(np.maximum(size, shift)), lower=1)
        (R,) = qr(half.T, mode="r", overwrite_a=True)
        cdef const double[::1, :] L = np.asfortranarray(
            R.T * np.where(np.diag(R) < 0, -1.0, 1.0)
        )
        for j in range(b):
            for i in range(j, b):
                self.L[j * b + i] = L[i, j]
        return 0

    cdef BorderedFactor without(
        self, double shift, CompressedRows columns, const double *removed
    ):
        """Return the factor of (1 + shift)A − Σᵢ wᵢmᵢmᵢᵀ, see `shifted_without`."""
        cdef Py_ssize_t b = self.border
        cdef double *block = <double *> calloc(max(b * b, 1), sizeof(double))
        if not block:
            raise MemoryError
        add_outer_products(columns, 1.0, removed, self.place, block, b)
        try:
            return self.less(shift, block)
        finally:
            free(block)

    def shifted_without(
        self, double shift, CompressedRows columns, const double[::1] removed
    ):
        """Return the factor of (1 + shift)A − Σᵢ wᵢmᵢmᵢᵀ.

        In exact arithmetic, the difference must be at least shift·A. The computed
        pivots satisfy the resulting lower bounds despite rounding.

        columns : matrix whose rows are the mᵢ (n,), with entries on the border only
        removed : weights wᵢ, each 0 or 1
        """
        columns.expect(removed.shape[0], columns.n)
        return self.without(shift, columns, &removed[0] if columns.n else NULL)
