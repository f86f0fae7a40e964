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
from libc.stdlib cimport free, realloc
from libc.string cimport memcpy, memset
from scipy.linalg.cython_blas cimport dgemm, dspmv, dtrsv

import numpy as np
from scipy.linalg import eigh, lapack, qr, solve_triangular


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
        cdef const double[::1] entries = np.ascontiguousarray(M.data, dtype=np.float64)
        cdef const int[::1] column = np.ascontiguousarray(M.indices, dtype=np.int32)
        cdef const int[::1] begin = np.ascontiguousarray(M.indptr, dtype=np.int32)
        self.shape, (self.n, self.k) = M.shape, M.shape
        self.arrays = entries, column, begin
        self.data = &entries[0] if entries.shape[0] else NULL
        self.indices = &column[0] if column.shape[0] else NULL
        self.indptr = &begin[0]

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
        cdef Py_ssize_t i
        cdef int j, l
        cdef double m
        self.expect(weights.shape[0], self.n)
        self.expect(place.shape[0], self.k)
        total = np.zeros((size, size))
        cdef double[:, ::1] block = total
        for i in range(self.n):
            if weights[i] == 0:
                continue
            for j in range(self.indptr[i], self.indptr[i + 1]):
                m = weights[i] * self.data[j]
                for l in range(self.indptr[i], self.indptr[i + 1]):
                    block[place[self.indices[j]], place[self.indices[l]]] += (
                        m * self.data[l]
                    )
        return total


cdef class Block(LinearMap):
    """The map X ↦ MX of matrices X (n, w), stored by rows as vectors.

    Each of the w columns belongs to one member of a class of congruent subdomains.

    M : array (r, n) or a square object with `@`; for w = 1, a symmetric array may be
        replaced by its upper triangle (n (n + 1)/2,), stored by columns
    n, members : n and w

    Raises
    ------
    ValueError
        If the shape of M does not match n and w.

    """

    cdef object M
    cdef const double *entries  # NULL if M is not an array
    cdef int rows, size, members
    cdef bint is_triangle

    def __init__(self, M, n, members):
        cdef const double[::1] entries
        self.rows = self.size = n
        self.members = members
        if isinstance(M, np.ndarray):
            self.is_triangle = M.ndim == 1
            expected = (n * (n + 1) // 2,) if self.is_triangle else (len(M), n)
            if M.shape != expected or (self.is_triangle and members != 1):
                raise ValueError(
                    f"a block {M.shape} cannot multiply a ({n}, {members}) array"
                )
            if not self.is_triangle:
                self.rows = len(M)
            M = np.ascontiguousarray(M, dtype=np.float64)
            if M.size:
                entries = M.reshape(-1)
                self.entries = &entries[0]
        self.M = M
        self.n, self.k = self.rows * self.members, self.size * self.members
        self.shape = self.n, self.k

    cdef int apply(self, const double *x, double *y, Py_ssize_t columns) except -1:
        cdef int c, w = <int> (self.members * columns), step = <int> columns
        cdef double one = 1.0, zero = 0.0
        if not self.k:
            memset(y, 0, self.n * columns * sizeof(double))
        elif not self.n:
            return 0
        elif not self.entries:
            X = np.asarray(<double[:self.size, :w]> <double *> x)
            Y = np.asarray(<double[:self.rows, :w]> y)
            Y[:] = self.M @ X
        elif self.is_triangle:
            for c in range(step):
                dspmv(b"U", &self.size, &one, <double *> self.entries, <double *> x + c,
                      &step, &zero, y + c, &step)
        else:  # BLAS reads matrices by columns, and computes (MX)ᵀ = XᵀMᵀ
            dgemm(b"N", b"N", &w, &self.rows, &self.size, &one, <double *> x, &w,
                  <double *> self.entries, &self.size, &zero, y, &w)
        return 0


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
PIVOT_TOLERANCE = 1e-3


cdef class BorderedFactor(LinearMap):
    """Cholesky factor of a sparse A (n, n), with a dense block for the last rows.

    These last rows are called the *border*.

    ::

        A = LLᵀ,   L = ⎡√s L_aa     ⎤   with the rows of A in the order `order`.
                       ⎣√s L_ba  L_bb⎦

    If A changes only on the border, it suffices to factorise the new Schur complement
    L_bbL_bbᵀ. As a linear map, an object of this class is x ↦ A⁻¹x.

    order : (n,) permutation of the rows, with the border last
    columns : first n − b columns (n, n − b) of L/√s in CSC format, each with its
        diagonal entry first
    L_bb : (b, b) lower triangular; the upper triangle is not used
    scale : s
    """

    def __init__(self, order, columns, L_bb, scale=1.0):
        cdef const int[::1] rows = np.ascontiguousarray(order, dtype=np.int32)
        cdef const int[::1] begin = np.ascontiguousarray(columns.indptr, dtype=np.int32)
        cdef const int[::1] index = np.ascontiguousarray(columns.indices, dtype=np.int32)
        cdef const double[::1] entries = np.ascontiguousarray(columns.data)
        cdef const double[::1, :] corner = np.asfortranarray(L_bb, dtype=np.float64)
        cdef double[::1] u = np.empty(rows.shape[0])
        self.n = self.k = rows.shape[0]
        self.shape, self.scale, self.columns = (self.n, self.n), scale, columns
        self.border, self.inner = corner.shape[0], self.n - corner.shape[0]
        self.expect(begin.shape[0] - 1, self.inner)
        self.arrays = rows, begin, index, entries, corner, u
        self.indptr = &begin[0]
        if self.n:
            self.order, self.u = &rows[0], &u[0]
        if self.inner:
            self.indices, self.data = &index[0], &entries[0]
        if self.border:
            self.L = &corner[0, 0]

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
            dtrsv(b"L", b"T" if transposed else b"N", b"N", &b, <double *> self.L, &b, r,
                  &one)

    # solves with the scaled factor

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
        first = self.columns.data[self.columns.indptr[: self.inner]]
        last = np.diag(self.arrays[4])
        return min(sqrt(self.scale) * first.min(initial=np.inf), last.min(initial=np.inf))

    def shifted_without(self, double shift, CompressedRows columns, removed):
        """Return the factor of (1 + shift)A − Σᵢ wᵢmᵢmᵢᵀ, for a factor with scale 1.

        In exact arithmetic, the difference must be at least shift·A. The computed
        pivots satisfy the resulting lower bounds despite rounding.

        columns : matrix whose rows are the mᵢ (n,), with entries on the border only
        removed : weights wᵢ, each 0 or 1
        """
        order, corner = np.asarray(self.arrays[0]), np.tril(self.arrays[4])
        place = np.empty(self.n, dtype=np.int32)
        place[order] = np.arange(-self.inner, self.border, dtype=np.int32)
        L = np.zeros((0, 0))
        if self.border:
            if self.schur is None:
                self.schur = corner @ corner.T
            M = (1 + shift) * self.schur
            M -= columns.outer_products(removed, place, self.border)
            L, failed = lapack.dpotrf(M, lower=1)
            least = (1 - PIVOT_TOLERANCE) * shift * np.diag(corner) ** 2
            if failed or not (np.diag(L) ** 2 >= least).all():
                L = raised(M, corner, shift)
        return BorderedFactor(order, self.columns, L, 1 + shift)


def raised(M, L_0, shift):
    """Factorise a Schur complement M ≥ shift·L₀L₀ᵀ despite rounding.

    Since M is a difference of matrices whose norms are similar to that of L₀L₀ᵀ, the
    computed M may have negative eigenvalues. Therefore, eigenvalues of L₀⁻¹ML₀⁻ᵀ = QλQᵀ
    below `shift` are set to `shift`, and L follows from

        LLᵀ = L₀ Q λ Qᵀ L₀ᵀ   by a QR factorisation of √λ QᵀL₀ᵀ,

    which contains no difference of matrices and therefore preserves the lower bound.
    """
    half = solve_triangular(L_0, M, lower=True)
    inner = solve_triangular(L_0, half.T, lower=True)
    size, Q = eigh((inner + inner.T) / 2)
    root = L_0 @ (Q * np.sqrt(np.maximum(size, shift)))
    (R,) = qr(root.T, mode="r")
    return R.T * np.where(np.diag(R) < 0, -1.0, 1.0)
