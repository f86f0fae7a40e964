# cython: language_level=3, boundscheck=False, wraparound=False, cdivision=True
# cython: initializedcheck=False
"""SMALBE compiled: preparation, MPRGP, outer loop and the way back, without Python.

The readable modules define what happens here, and are what tests compare with: the same
counts, and the same points up to rounding.

* `orthonormal`, `lanczos`: `solvers.smalbe.projected`, `solvers.smalbe.spectrum`
* `_Run.step_of_model`, `_Run.core`: `solvers.smalbe.model`
* `_Run.minimise`: `solvers.smalbe.mprgp`
* `smalbe`: `solvers.smalbe.outer_loop`
* `recover`: `solvers.smalbe.driver`

P is dense (then one triangle is read), sparse, or an operator, which is asked by Python.
A sparse P whose entries lie on few diagonals, as differences and finite elements on a
grid have them, is multiplied with by these: neighbouring rows at once, and half the
entries, for P is symmetric. A CG step goes through memory twice then: the direction, its
product and the lengths; the step and the new gradient, whose free part is not stored. Its
loops over vectors are in `vectors.h`.
"""

from cpython.buffer cimport (
    PyBUF_C_CONTIGUOUS, PyBUF_FORMAT, PyBuffer_Release, PyObject_GetBuffer,
)
from cpython.exc cimport PyErr_CheckSignals
from libc.math cimport INFINITY, fabs, fmax, fmin, isfinite, isinf, sqrt
from libc.stdlib cimport calloc, free as give_back, realloc
from libc.string cimport memcpy, memset
from scipy.linalg.cython_blas cimport dsymv
from scipy.linalg.cython_lapack cimport (
    dgeqp3, dorgqr, dpotrf, dpotrs, dstev,
)

import numpy as np
from scipy.sparse import csr_array, issparse

cdef extern from "vectors.h" nogil:
    ctypedef struct sparse:
        Py_ssize_t n, count
        const int *indptr
        const int *indices
        const Py_ssize_t *offset
        const double *data
        const double *diagonals
    int MOST_DIAGONALS
    Py_ssize_t find_diagonals(const sparse *F, Py_ssize_t most, Py_ssize_t *offset,
                              signed char *slot)
    void fill_diagonals(const sparse *F, const signed char *slot, double *diagonals)
    void sparse_product(const sparse *F, double s, const double *v, double *y)
    void sparse_lengths(const sparse *F, double s, const double *x, const double *g,
                        double *p, double *Hp, const double *lower,
                        const double *upper, double *told)
    void sparse_turn(const sparse *F, double s, double gamma, const double *x,
                     const double *g, double *p, double *Hp, const double *lower,
                     const double *upper, double *told)
    double turn_freely(const double *g, const double *free, double gamma, double *p,
                       Py_ssize_t n)
    void sparse_turn_freely(const sparse *F, double s, const double *g,
                            const double *free, double gamma, double *p, double *Hp,
                            double *told)
    double dot(const double *a, const double *b, Py_ssize_t n)
    void add(double s, const double *a, double *b, Py_ssize_t n)
    void scale(double s, double *a, Py_ssize_t n)
    void copy_scaled(double s, const double *a, double *b, Py_ssize_t n)
    double scale_free(double s, const double *free, const double *v, double *z,
                      Py_ssize_t n)
    bint same(const double *a, const double *b, Py_ssize_t n)
    void rows_times(const double *U, const double *v, double *c, Py_ssize_t k,
                    Py_ssize_t n)
    void combination(double s, const double *U, const double *c, const double *v,
                     double *y, Py_ssize_t k, Py_ssize_t n)
    void add_combination(double s, const double *U, const double *c, double *y,
                         Py_ssize_t k, Py_ssize_t n)
    void lengths(const double *x, const double *g, const double *p, const double *Hp,
                 const double *lower, const double *upper, Py_ssize_t n, double *told)
    void leave(double alpha, double beta, bint release, double *x, double *g,
               const double *p, const double *Hp, const double *lower,
               const double *upper, double *x0, double *g0, double *free,
               double *box_lower, double *box_upper, double *z, double *z_g,
               Py_ssize_t n)
    void split(const double *x, const double *g, const double *lower,
               const double *upper, double tau, double *phi, double *free,
               Py_ssize_t n, double *told)
    void advance(double alpha, double *x, double *g, const double *p, const double *Hp,
                 const double *lower, const double *upper, double tau, double *phi,
                 double *free, Py_ssize_t n, double *told)
    double within(const double *x, const double *origin, const double *g,
                  const double *lower, const double *upper, bint release, double *s,
                  Py_ssize_t n)
    double tilted_within(const double *x, const double *x_g, double tau,
                         const double *origin, const double *g, const double *lower,
                         const double *upper, double *s, Py_ssize_t n)
    void rest_of_step(const double *x, const double *g, const double *s,
                      const double *Hs, const double *z_g, double *z, Py_ssize_t n,
                      double *told)
    void projected(const double *x, const double *g, double tau, const double *lower,
                   const double *upper, double *y, Py_ssize_t n)
    bint turn_round(double *s, Py_ssize_t n)
    double turn(const double *z, double gamma, double *p, Py_ssize_t n)
    void advance_freely(double alpha, double *x, double *g, const double *p,
                        const double *Hp, const double *free, Py_ssize_t n,
                        double *told)
    void symmetric_product(const double *F, double s, const double *v, double *y,
                           Py_ssize_t n)
    void transposed(const double *U, double *columns, Py_ssize_t k, Py_ssize_t n,
                    Py_ssize_t stride)
    double inward_energy(const double *x, const double *g, const double *lower,
                         const double *upper, const double *diagonal, double norm,
                         double noise, Py_ssize_t n)
    void add_gram(const double *s, const double *V, const int *row, double *S,
                  Py_ssize_t k)
    void scaled(const double *root, const double *G, double tau, double *S,
                Py_ssize_t k, Py_ssize_t stride)
    int eliminated(double *S, double *inverse, Py_ssize_t k, Py_ssize_t stride)
    void solve(const double *R, const double *inverse, double *y, Py_ssize_t stride)
    Py_ssize_t changed(const double *piece, double *held, Py_ssize_t n, int *where)
    void tilted(const double *x, const double *g, double tau, const double *lower,
                const double *upper, double *s, double *piece, Py_ssize_t n)
    void restored(const double *nu, const double *shift, const double *lower,
                  const double *upper, const double *lb, const double *ub, double *x,
                  double *free, Py_ssize_t n)
    void held_by(const double *nu, const double *lower, const double *upper,
                 const double *g, double *z, Py_ssize_t n)
    void masked(const double *free, const double *a, double *t, Py_ssize_t n)
    double worst_residual(const double *q, const double *diagonal, const double *x,
                          const double *y, const double *z, const double *Fx,
                          const double *lb, const double *ub, const double *e,
                          const double *rows, Py_ssize_t m, Py_ssize_t n, double *room)


# --- numbers ------------------------------------------------------------------------
#
# A memoryview takes as long as a pass over a thousand numbers: small problems would spend
# more on these than on their products. Arrays are read and written by their addresses,
# with the lengths that `Solver` and its like know, and stay referred to for as long.


cdef class Room:
    """Numbers, zeros at first, that are there as long as this is."""

    cdef double *at

    def __cinit__(self, Py_ssize_t size):
        self.at = <double *> calloc(max(size, 1), sizeof(double))
        if not self.at:
            raise MemoryError(f"no room for {size} numbers")

    def __dealloc__(self):
        give_back(self.at)


cdef double *numbers(a) except NULL:
    """Return where an array has its components, row by row.

    Raises ValueError where it has no doubles, or they have gaps.
    """
    cdef Py_buffer told
    cdef bint has_doubles
    PyObject_GetBuffer(a, &told, PyBUF_C_CONTIGUOUS | PyBUF_FORMAT)
    has_doubles = told.format[0] == b"d"[0]
    PyBuffer_Release(&told)
    if not has_doubles:
        raise ValueError(f"an array of {a.dtype}; expected float64")
    return <double *> told.buf


def _whole(a):
    return np.ascontiguousarray(a, dtype=float)


cdef const double *read(a, list held) except NULL:
    """Return where an array has its components, or a copy of them; that is held."""
    cdef const double *at
    try:
        at = numbers(a)
    except ValueError:  # other numbers, or with gaps
        a = _whole(a)
        at = numbers(a)
    held.append(a)
    return at


cdef copied(const double *v, Py_ssize_t n):
    """Make an array of it."""
    told = np.empty(n)
    memcpy(numbers(told), v, n * sizeof(double))
    return told


# --- the matrix ---------------------------------------------------------------------


cdef enum:
    BY_BLAS = 600  # unknowns from which on a dense P comes from memory, not from caches


cdef class Product:
    """v → Pv, counted."""

    cdef Py_ssize_t n
    cdef public long count
    cdef object matrix
    cdef const double *dense
    cdef sparse rows  # its data is NULL where P is not sparse
    cdef object held

    def __cinit__(self, P, Py_ssize_t n):
        self.n, self.matrix = n, P
        if isinstance(P, np.ndarray) and n:
            whole = P if P.flags.c_contiguous else P.T
            self.held = _whole(whole)
            self.dense = numbers(self.held)
        elif issparse(P) and P.nnz and P.nnz < 2**31:
            M = P if P.format in ("csr", "csc") else csr_array(P)  # P is symmetric
            self.hold_rows(M.data, M.indptr, M.indices)

    cdef int hold_rows(self, told_data, told_indptr, told_indices) except -1:
        """Take a sparse P by rows; by diagonals where these take no more room."""
        cdef const double[::1] data = _whole(told_data)
        cdef const int[::1] indptr = np.ascontiguousarray(told_indptr, dtype=np.int32)
        cdef const int[::1] indices = np.ascontiguousarray(told_indices, dtype=np.int32)
        cdef Py_ssize_t most = min(data.shape[0] // self.n, MOST_DIAGONALS), count
        cdef double[:, ::1] diagonals
        cdef Py_ssize_t[::1] offset = np.zeros(max(most, 1), dtype=np.intp)
        cdef signed char[::1] slot = np.empty(self.n, dtype=np.int8)
        self.rows.n, self.rows.data = self.n, &data[0]
        self.rows.indptr, self.rows.indices = &indptr[0], &indices[0]
        self.held = (data, indptr, indices)
        count = find_diagonals(&self.rows, most, &offset[0], &slot[0])
        if count:
            diagonals = np.zeros((count, self.n))
            fill_diagonals(&self.rows, &slot[0], &diagonals[0, 0])
            self.rows.offset, self.rows.diagonals = &offset[0], &diagonals[0, 0]
            self.rows.count, self.rows.indptr, self.rows.indices = count, NULL, NULL
            self.held = (data, diagonals, offset)
        return 0

    def __call__(self, v):
        """Return Pv for v (n,)."""
        result, vector = np.empty(self.n), _whole(v)
        self.apply(numbers(vector), numbers(result))
        return result

    cdef int apply(self, const double *v, double *y, double s=1.0) except -1:
        """y ← s Pv."""
        self.count += 1
        cdef int n = self.n, one = 1
        cdef double zero = 0.0
        if self.dense and self.n < BY_BLAS:
            symmetric_product(self.dense, s, v, y, self.n)
        elif self.dense:
            dsymv(b"L", &n, &s, <double *> self.dense, &n, <double *> v, &one, &zero,
                  y, &one)
        elif self.rows.data:
            sparse_product(&self.rows, s, v, y)
        elif self.n:
            result = _whole(self.matrix @ copied(v, self.n))
            if result.size != self.n:
                raise ValueError(f"P @ v has {result.size} components; expected {self.n}")
            memcpy(y, numbers(result), self.n * sizeof(double))
            if s != 1:
                scale(s, y, self.n)
        return 0


cdef void without(
    const double *C, Py_ssize_t r, double *v, double *Cv, Py_ssize_t n
) noexcept nogil:
    """v ← v − CᵀCv with Cv (r,), which is kept."""
    rows_times(C, v, Cv, r, n)
    add_combination(-1.0, C, Cv, v, r, n)


# --- preparation --------------------------------------------------------------------


def orthonormal(G, e):
    """Find orthonormal rows and x̃ for Gx = e, G (m, n), as `orthonormal_rows` does.

    Returns the fields of `Rows` but the last, and the QR factorisation that multipliers
    need: R (r, r), the rows kept (r,), their sizes (m,).
    """
    cdef Py_ssize_t i, j, m = G.shape[0], n = G.shape[1], w = min(m, n)
    cdef int rows = m, columns = n, info = 0, most = 64 * (m + n), r = 0
    cdef double mismatch = 0.0, most_x = 0.0, most_e = 0.0, square = 0.0, z, error
    cdef double least_pivot = 1.0
    sizes, x_tildes, unit = np.ones(m), np.zeros(n), np.empty((m, n))
    pivots = np.zeros(m, dtype=np.int32)
    cdef double *size = numbers(sizes)
    cdef double *x_tilde = numbers(x_tildes)
    cdef double *A = numbers(unit)  # A (m, n) by rows is (n, m) by columns
    cdef const double *given = numbers(G)
    cdef const double *right = numbers(e)
    cdef int[::1] pivot = pivots
    cdef Room room = Room(w + most)
    cdef double *t = room.at
    cdef double *space = t + w
    cdef double *R
    cdef double *GC
    for i in range(m):
        size[i] = sqrt(dot(given + i * n, given + i * n, n)) or 1.0
        most_e = fmax(most_e, fabs(right[i]) / size[i])
        square += right[i] * right[i]
        for j in range(n):
            A[i * n + j] = given[i * n + j] / size[i]
    if w:
        dgeqp3(&columns, &rows, A, &columns, &pivot[0], t, space, &most, &info)
    for i in range(w):
        if fabs(A[i * n + i]) > RANK:
            r += 1
            least_pivot = fmin(least_pivot, fabs(A[i * n + i]))
    triangle, products = np.zeros((r, r)), np.empty((m, r))
    R, GC = numbers(triangle), numbers(products)
    for i in range(r):
        for j in range(i, r):
            R[i * r + j] = A[j * n + i]
    if r:
        dorgqr(&columns, &r, &r, A, &columns, t, space, &most, &info)
    for i in range(r):  # x̃ = Cᵀz with Rᵀz = e/size
        pivot[i] -= 1
        z = right[pivot[i]] / size[pivot[i]]
        for j in range(i):
            z -= R[j * r + i] * space[j]
        space[i] = z / R[i * r + i]
        add(space[i], A + i * n, x_tilde, n)
    for i in range(n):
        most_x = fmax(most_x, fabs(x_tilde[i]))
    for i in range(m):
        error = dot(given + i * n, x_tilde, n) - right[i]
        mismatch = fmax(mismatch, fabs(error) / size[i])
        for j in range(r):
            GC[i * r + j] = dot(given + i * n, A + j * n, n)
    return (
        (G, unit[:r], products, sqrt(square), least_pivot, x_tildes,
         mismatch <= 1e-8 * (most_x + most_e)),
        (triangle, pivots[:r], sizes),
    )


cdef double RANK = 1e-13  # pivots of the normalised rows below this are rounding errors


def multipliers(Py_ssize_t m, triangle, rows_kept, sizes, told_a):
    """Return y (m,) with Gᵀy = Cᵀa (r,), from the QR factorisation of unit rows.

    triangle, rows_kept, sizes, told_a : R (r, r), the rows kept (r,), their sizes (m,), a
    """
    cdef Py_ssize_t i, j, r = len(triangle)
    cdef double s
    result = np.zeros(m)
    cdef double *y = numbers(result)
    cdef const double *R = numbers(triangle)
    cdef const double *size = numbers(sizes)
    cdef const double *a = numbers(told_a)
    cdef const int[::1] kept = rows_kept
    for i in range(r - 1, -1, -1):  # Rz = a, y = z/size
        s = a[i]
        for j in range(i + 1, r):
            s -= R[i * r + j] * y[kept[j]] * size[kept[j]]
        y[kept[i]] = s / (R[i * r + i] * size[kept[i]])
    return result


cdef double FLAT = 10.0  # ratio of Ritz values of one size

cdef enum:
    FEW = 5


cdef bint is_flat(const double *diagonal, const double *off) noexcept nogil:
    """Whether all Ritz values of the first FEW steps are of one size.

    The diagonal holds Rayleigh quotients, which lie between the least and the largest.
    """
    cdef double theta[FEW]
    cdef double between[FEW]
    cdef double none, least = diagonal[0], largest = diagonal[0]
    cdef int order = FEW, one = 1, info = 0, i
    for i in range(1, FEW):
        least = diagonal[i] if diagonal[i] < least else least
        largest = diagonal[i] if diagonal[i] > largest else largest
    if least < largest / FLAT:
        return False
    memcpy(theta, diagonal, FEW * sizeof(double))
    memcpy(between, off, FEW * sizeof(double))
    dstev(b"N", &order, theta, between, &none, &one, &none, &info)
    return theta[0] >= theta[FEW - 1] / FLAT


def lanczos(Product F, C, start, int steps):
    """Find upper Ritz pairs of PFP from start (n,): the fields of `Ritz`.

    Without vectors where the first pair is not found: then no model holds any.

    C : (r, n)
    """
    cdef Py_ssize_t i, k, n = F.n, r = len(C)
    cdef int kept = 0, info = 0
    steps = min(steps, n - r)  # in the range of P
    cdef Room room = Room((steps + 2) * n + r + (steps + 5) * steps)
    cdef const double *rows = numbers(C)
    cdef double *basis = room.at
    cdef double *v = basis + steps * n
    cdef double *Fv = v + n
    cdef double *Cv = Fv + n
    cdef double *diagonal = Cv + r
    cdef double *off = diagonal + steps
    cdef double *share = off + steps
    cdef double *space = share + steps  # (2 steps,)
    cdef double *S = space + 2 * steps  # (kept, kept) by columns
    cdef double *value
    cdef double *residual
    cdef double *vector
    cdef double beta, largest = 0.0, at_start
    memcpy(v, numbers(start), n * sizeof(double))
    without(rows, r, v, Cv, n)
    beta = sqrt(dot(v, v, n))
    for k in range(steps if beta else 0):
        copy_scaled(1 / beta, v, basis + k * n, n)
        memcpy(Fv, basis + k * n, n * sizeof(double))
        without(rows, r, Fv, Cv, n)
        F.apply(Fv, v)
        without(rows, r, v, Cv, n)
        diagonal[k] = dot(basis + k * n, v, n)
        largest = fmax(largest, fabs(diagonal[k]))
        add(-diagonal[k], basis + k * n, v, n)
        if k:
            add(-beta, basis + (k - 1) * n, v, n)
        without(basis, k + 1, v, share, n)
        beta = sqrt(dot(v, v, n))
        off[k] = beta
        kept = k + 1
        if beta <= 1e-12 * largest:
            break
        if kept == FEW and is_flat(diagonal, off):
            break
    if not kept:
        return np.zeros(1), np.zeros(1), np.zeros((1, n)), 0.0
    at_start = diagonal[0]
    beta = off[kept - 1]
    dstev(b"V", &kept, diagonal, off, S, &kept, space, &info)
    values, residuals = np.empty(kept), np.empty(kept)
    value, residual = numbers(values), numbers(residuals)
    for i in range(kept):  # in descending order
        k = kept - 1 - i
        value[i] = diagonal[k]
        residual[i] = beta * fabs(S[k * kept + kept - 1])
    vectors = np.zeros((kept if residual[0] <= FOUND * value[0] else 0, n))
    vector = numbers(vectors)
    for i in range(len(vectors)):
        k = kept - 1 - i
        add_combination(1.0, basis, S + k * kept, vector + i * n, kept, n)
    return values, residuals, vectors, at_start


def homogenised(Product F, C, x_tilde, q, lb, ub, double norm):
    """Return b (n,) and the bounds of ν = x − x̃, as `_normalised` finds them."""
    cdef Py_ssize_t i, n = F.n, r = len(C)
    cdef list held = []
    cdef Room room = Room(r)
    found = np.zeros((3, n))
    cdef const double *rows = numbers(C)
    cdef const double *shift = numbers(x_tilde)
    cdef const double *cost = read(q, held)
    cdef const double *low = read(lb, held)
    cdef const double *high = read(ub, held)
    cdef double *b = numbers(found)
    cdef double square = 0.0
    cdef bint moved = False
    for i in range(n):
        b[n + i], b[2 * n + i] = low[i] - shift[i], high[i] - shift[i]
        moved = moved or shift[i] != 0
    if moved:
        F.apply(shift, b)
    for i in range(n):
        b[i] = -cost[i] - b[i]
        square += b[i] * b[i]
    without(rows, r, b, room.at, n)
    if dot(b, b, n) <= 1e-28 * square:
        memset(b, 0, n * sizeof(double))  # nothing but rounding errors is left of d
    scale(1 / norm, b, n)
    return found[0], (found[1], found[2])


# --- MPRGP and the outer loop -------------------------------------------------------

cdef double NOISE = 1e-13  # part of the terms of a cost that is taken for rounding
cdef double MOST_RHO = 1e10  # beyond which rounding in ρQν is all that is left
cdef double FOR_ENERGY = 1.25  # factor of the products that the energy may cost
cdef double NO_SHIFT = 1e-13  # x̃ of this size relative to ν is rounding of e = 0
cdef double FOUND = 1e-3  # residual over value of a Ritz pair where the spectrum decays
cdef double TAIL = 1e-4  # least τ of a model, relative to the norm
cdef double LEAST_M = 1e-10  # beyond which M‖Cν‖ is rounding

cdef enum:
    KEPT = 200  # directions of CG on a face
    NEWTON_STEPS = 100
    SEARCH_STEPS = 60
    MOST_IDLE = 2
    FIRST_LOOK = 500  # steps of a run after which its progress is looked at first
    STD = 0
    PROJCG = 1
    MIXED = 2
    MODEL = 3


cdef struct Until:
    double small
    double coarse
    double M


cdef class Basis:
    """Orthonormal rows U (k, n), and U_F U_Fᵀ of the face F for which it was asked last.

    Only components from `first` on, `size` of them, have bounds, and are looked at in a
    face; all others are free in each.
    """

    cdef Py_ssize_t n, k, stride, first, size, flips
    cdef bint is_split
    cdef Room room
    cdef int *where  # (size + 3,)
    cdef double *U
    cdef double *bounded  # (k, size) the columns of those with bounds
    cdef double *columns  # the same by columns (size, stride)
    cdef double *others  # U_f U_fᵀ of the others; as `gram` by rows of `stride` numbers
    cdef double *gram  # (k, k) upper triangle
    cdef double *held

    @staticmethod
    cdef Basis zeros(Py_ssize_t k, Py_ssize_t n, Py_ssize_t first, Py_ssize_t size):
        cdef Basis made = Basis.__new__(Basis)
        cdef Py_ssize_t stride = (k + 3) & ~3
        made.k, made.n, made.stride, made.first, made.size = k, n, stride, first, size
        made.flips = size + 1
        made.room = Room(k * n + k * size + stride * (2 * stride + size) + 2 * size + 2)
        made.U = made.room.at
        made.bounded = made.U + k * n
        made.columns = made.bounded + k * size
        made.others = made.columns + stride * size
        made.gram = made.others + stride * stride
        made.held = made.gram + stride * stride
        made.where = <int *> (made.held + size)
        return made

    cdef void split(self) noexcept:
        """Find what belongs to the components with bounds, and to the others."""
        cdef Py_ssize_t i, j, stride = self.stride
        if self.is_split:
            return
        self.is_split = True
        for j in range(self.k):
            memcpy(self.bounded + j * self.size, self.U + j * self.n + self.first,
                   self.size * sizeof(double))
        transposed(self.bounded, self.columns, self.k, self.size, stride)
        if self.size == self.n:
            return
        for j in range(self.k):
            self.others[j * stride + j] = 1.0
        for i in range(self.size):
            self.where[i], self.held[i] = i, 1.0
        self.change(self.size, self.others)
        for i in range(self.k):
            for j in range(i):
                self.others[i * stride + j] = self.others[j * stride + i]

    cdef void change(self, Py_ssize_t count, double *gram) noexcept:
        """Take the components in `where` that are held now from it, add the others."""
        cdef Py_ssize_t c, q
        cdef double sign[4]
        for c in range(0, count, 4):
            for q in range(4):
                sign[q] = 0.0
                if c + q < count:
                    sign[q] = 1 - 2 * self.held[self.where[c + q]]
                else:
                    self.where[c + q] = 0
            add_gram(sign, self.columns, self.where + c, gram, self.stride)

    cdef void enter(self, const double *piece) noexcept:
        """Have `gram` be that of the face where `piece` (size,) is zero.

        The rows are orthonormal, so that it is I less what is held; after as many
        changes as there are components it is summed up anew, by what is held or by
        what is not, whichever is less.
        """
        cdef Py_ssize_t i, count, stride = self.stride
        cdef bint is_held
        self.split()
        if self.flips > self.size:
            self.flips = count = 0
            for i in range(self.size):
                count += piece[i] != 0
            is_held = 2 * count > self.size
            memcpy(self.gram, self.others, stride * stride * sizeof(double))
            if not is_held:
                memset(self.gram, 0, stride * stride * sizeof(double))
                for i in range(self.k):
                    self.gram[i * stride + i] = 1.0
            for i in range(self.size):
                self.held[i] = is_held
        count = changed(piece, self.held, self.size, self.where)
        self.flips += count
        self.change(count, self.gram)


cdef class Model:
    """B = τI + Uᵀ diag(w) U with orthonormal rows U (k, n), the first of a basis."""

    cdef Py_ssize_t n, k
    cdef double tau
    cdef Basis basis  # None for k = 0
    cdef const double *U
    cdef Room room
    cdef double *w  # (k,)
    cdef double *root  # of w, and zeros, as many as a row of `basis.gram` is long

    @staticmethod
    cdef Model above_tail(Basis basis, Py_ssize_t found, const double *w, double shift,
                          double tau):
        """Add `shift` to w (found,), and leave out the rows where that is not positive.

        These are the last as a rule, and the basis serves as it is.
        """
        cdef Model B = Model.__new__(Model)
        cdef Py_ssize_t i, k = 0, last = -1, n = basis.n
        cdef Basis chosen = basis
        B.room = Room(found + basis.stride)
        B.w, B.root = B.room.at, B.room.at + found
        for i in range(found):
            B.w[k] = w[i] + shift
            if B.w[k] > 0:
                k, last = k + 1, i
        if last >= k:
            chosen, k = Basis.zeros(k, n, basis.first, basis.size), 0
            for i in range(found):
                if w[i] + shift > 0:
                    memcpy(chosen.U + k * n, basis.U + i * n, n * sizeof(double))
                    k += 1
        for i in range(k):
            B.root[i] = sqrt(B.w[i])
        B.basis, B.U, B.tau, B.k, B.n = chosen, chosen.U, tau, k, n
        return B

    @staticmethod
    cdef Model of_norm(double norm, Py_ssize_t n):
        cdef Model B = Model.__new__(Model)
        B.tau, B.n = norm, n
        return B

    cdef Model with_tail(self, double tau):
        """Change τ and leave w + τ as it is, where that is above τ."""
        if not self.k:
            return Model.of_norm(tau, self.n)
        return Model.above_tail(self.basis, self.k, self.w, self.tau - tau, tau)


cdef double *enlarged(double *held, Py_ssize_t size) except NULL:
    """Make room for so many numbers, and keep those that are there."""
    held = <double *> realloc(held, max(size, 1) * sizeof(double))
    if not held:
        raise MemoryError
    return held


cdef class Directions:
    """The last conjugate directions of CG on a face, as `solvers.smalbe.mprgp` has them.

    free : the face, 1 where a component is off its bounds (n,)
    """

    cdef Py_ssize_t n, count, most, oldest, room
    cdef double *p  # (room, n)
    cdef double *Hp
    cdef double *share
    cdef double *free

    def __cinit__(self, Py_ssize_t n, Py_ssize_t most):
        self.n, self.most = n, most
        self.share = <double *> calloc(max(most + n, 1), sizeof(double))
        if not self.share:
            raise MemoryError
        self.free = self.share + most

    def __dealloc__(self):
        give_back(self.p)
        give_back(self.Hp)
        give_back(self.share)

    cdef void begin(self, const double *free) noexcept:
        """Forget all, on another face."""
        self.count = self.oldest = 0
        if self.n and self.most:
            memcpy(self.free, free, self.n * sizeof(double))

    cdef bint is_on(self, const double *free) noexcept:
        """Whether they are directions on that face."""
        return same(self.free, free, self.n)

    cdef int add(self, const double *p, const double *Hp, double curvature) except -1:
        """Add one with pᵀHp, in place of the oldest where there are too many."""
        cdef Py_ssize_t at = self.count
        if not self.most:
            return 0
        if at == self.most:
            at, self.oldest = self.oldest, (self.oldest + 1) % self.most
        elif at == self.room:
            self.room = min(max(16, 2 * self.room), self.most)
            self.p = enlarged(self.p, self.room * self.n)
            self.Hp = enlarged(self.Hp, self.room * self.n)
        copy_scaled(1 / sqrt(curvature), p, self.p + at * self.n, self.n)
        copy_scaled(1 / sqrt(curvature), Hp, self.Hp + at * self.n, self.n)
        self.count = min(self.count + 1, self.most)
        return 0

    cdef void conjugate(self, double *p) noexcept:
        """Take from p its part along them."""
        if self.count:
            rows_times(self.Hp, p, self.share, self.count, self.n)
            add_combination(-1.0, self.p, self.share, p, self.count, self.n)

    cdef void minimise(self, const double *g, double *s, double *Hs) noexcept:
        """Find s and Hs, for which x − s minimises the cost along all of them."""
        rows_times(self.p, g, self.share, self.count, self.n)
        memset(s, 0, self.n * sizeof(double))
        memset(Hs, 0, self.n * sizeof(double))
        add_combination(1.0, self.p, self.share, s, self.count, self.n)
        add_combination(1.0, self.Hp, self.share, Hs, self.count, self.n)


cdef class Solver:
    """One projected problem, the rules of its solution, and room for the vectors.

    problem : a `Projected` with the `Product` F; options : an `Options`
    """

    cdef Product F
    cdef object problem
    cdef Py_ssize_t n, r, m
    cdef double inverse_norm, norm, e_size, x_tilde_size, alpha, Gamma_square, rho
    cdef bint reduced, plain, preconditioned, newton_proportions
    cdef bint in_two  # whether CG steps go through memory twice: φ, `free` not stored
    cdef int expansion
    cdef Py_ssize_t found  # directions of the model: C, then Ritz vectors
    cdef list held  # the arrays that are read
    cdef Basis basis  # these directions, None where there are none
    cdef Room room  # of all that is written
    cdef const double *C
    cdef const double *GC
    cdef const double *q
    cdef const double *diagonal  # NULL where an operator does not tell
    cdef const double *x_tilde
    cdef const double *b
    cdef Room above  # (found,) their eigenvalues above the tail
    cdef const double *lower
    cdef const double *upper
    cdef const double *upper_if_any  # NULL where all are inf
    cdef double *rhs
    cdef double *x
    cdef double *g
    cdef double *p
    cdef double *Hp
    cdef double *phi
    cdef double *free
    cdef double *z
    cdef double *s
    cdef double *Hs
    cdef double *t
    cdef double *x2
    cdef double *g2
    cdef double *box_lower
    cdef double *box_upper
    cdef double *piece
    cdef double *piece2
    cdef double *x0
    cdef double *g0
    cdef double *Cv
    cdef double *Cw
    cdef double *Cx  # where it is known, see `violation`
    cdef bint knows_Cx
    cdef double *y
    cdef double *dy
    cdef double *y2
    cdef double *slope
    cdef double *slope2
    cdef double *c
    cdef double *fixed
    cdef double *core
    cdef double *inverse  # of the pivots of the core
    cdef double told[4]
    cdef double tail, phi_square, beta_square, reduced_square, z_Hp
    cdef Model preconditioner, B, known
    cdef Directions directions
    cdef double known_rho
    cdef long most_products  # where the energy error may still cost something

    def __init__(self, problem, Product F, options, bint preconditioned):
        cdef Py_ssize_t i, k, n = F.n
        rows, spectrum, bounds = problem.rows, problem.spectrum, problem.bounds
        self.problem, self.F, self.n = problem, F, n
        self.r, self.m = rows.GC.shape[1], rows.GC.shape[0]
        self.norm, self.inverse_norm = spectrum.norm, 1 / spectrum.norm
        self.held = []
        self.C, self.GC = read(rows.C, self.held), read(rows.GC, self.held)
        self.x_tilde, self.b = read(rows.x_tilde, self.held), read(problem.b, self.held)
        self.q, self.lower = read(problem.q, self.held), read(bounds[0], self.held)
        self.upper = read(bounds[1], self.held)
        self.diagonal = read(problem.diagonal, self.held)
        if not len(problem.diagonal):
            self.diagonal = NULL
        for i in range(n):
            if self.upper[i] < INFINITY:
                self.upper_if_any = self.upper
                break
        self.e_size = rows.e_size
        self.x_tilde_size = sqrt(dot(self.x_tilde, self.x_tilde, n))
        self.alpha, self.Gamma_square = options.alpha, options.Gamma**2
        self.reduced = options.reduced
        self.expansion = ("std", "projcg", "mixed", "model").index(options.expansion)
        self.newton_proportions = options.proportioning == "model"
        self.plain = options.expansion != "model"
        self.preconditioned = preconditioned
        kept = KEPT if options.recycle and not issparse(F.matrix) else 0
        self.directions = Directions(self.n, kept)
        if spectrum.ritz is not None:
            values, residuals, vectors, _ = spectrum.ritz
            self.find_upper_end(_whole(values), _whole(residuals), _whole(vectors))
        k = (self.found + 3) & ~3
        self.room = Room(19 * n + 3 * self.r + (8 + k) * k)
        cdef double *at = self.room.at
        self.x, self.g, self.p, self.Hp = at, at + n, at + 2 * n, at + 3 * n
        at += 4 * n
        self.phi, self.free, self.z, self.s = at, at + n, at + 2 * n, at + 3 * n
        at += 4 * n
        self.Hs, self.t, self.x2, self.g2 = at, at + n, at + 2 * n, at + 3 * n
        at += 4 * n
        self.box_lower, self.box_upper, self.rhs = at, at + n, at + 2 * n
        self.piece, self.piece2 = at + 3 * n, at + 4 * n
        self.x0, self.g0 = at + 5 * n, at + 6 * n
        at += 7 * n
        self.y, self.dy, self.y2, self.slope = at, at + k, at + 2 * k, at + 3 * k
        self.slope2, self.c, self.inverse = at + 4 * k, at + 5 * k, at + 6 * k
        self.fixed, self.Cv = at + 7 * k, at + 8 * k
        self.Cw = self.Cv + self.r
        self.Cx = self.Cw + self.r
        self.core = self.Cx + self.r

    cdef int find_upper_end(self, values, residuals, vectors) except -1:
        """Choose what a model holds, as `Projected.upper_end` does."""
        cdef Py_ssize_t i, found = len(values), kept, n = self.n, first = 0, last = n
        cdef const double *value = numbers(values)
        cdef const double *residual = numbers(residuals)
        kept = max(found - (1 if residual[found - 1] <= 1e-10 * value[0] else 2), 0)
        for i in range(kept):
            if residual[i] > value[i]:
                kept = i
                break
        if residual[0] > FOUND * value[0]:
            kept = 0
        self.tail = fmax((value[kept] + residual[kept]) / self.norm, TAIL)
        self.found = kept + self.r
        self.above = Room(self.found)
        for i in range(self.found):
            self.above.at[i] = -self.tail
            if i >= self.r:
                self.above.at[i] += (value[i - self.r] + residual[i - self.r]) / self.norm
        if not self.found:
            return 0
        while first < n and not self.has_bound(first):
            first += 1
        while last > first and not self.has_bound(last - 1):
            last -= 1
        self.basis = Basis.zeros(self.found, n, first, last - first)
        memcpy(self.basis.U, self.C, self.r * n * sizeof(double))
        memcpy(self.basis.U + self.r * n, numbers(vectors), kept * n * sizeof(double))
        self.C = self.basis.U  # read once, not twice, from farther caches
        return 0

    cdef bint has_bound(self, Py_ssize_t i) noexcept:
        return self.lower[i] > -INFINITY or self.upper[i] < INFINITY

    # the operator

    cdef int H(self, const double *v, double *out) except -1:
        """out ← Hv = PFPv/‖PFP‖ + ρQv; one product."""
        cdef Py_ssize_t i, n = self.n
        cdef double *Pv = self.t
        if not self.r:
            self.F.apply(v, out, self.inverse_norm)
            return 0
        rows_times(self.C, v, self.Cv, self.r, n)
        combination(-1.0, self.C, self.Cv, v, Pv, self.r, n)
        self.F.apply(Pv, out, self.inverse_norm)
        rows_times(self.C, out, self.Cw, self.r, n)
        for i in range(self.r):
            self.Cw[i] = self.rho * self.Cv[i] - self.Cw[i]
        add_combination(1.0, self.C, self.Cw, out, self.r, n)
        return 0

    cdef int lengths_along(self, double *p, double *Hp) except -1:
        """Hp ← H p, and the `lengths` of x − αp, which are kept in `told`; one product."""
        if self.r or not self.F.rows.data:
            self.H(p, Hp)
            lengths(self.x, self.g, p, Hp, self.lower, self.upper_if_any, self.n,
                    self.told)
            return 0
        self.F.count += 1
        sparse_lengths(&self.F.rows, self.inverse_norm, self.x, self.g, p, Hp,
                       self.lower, self.upper_if_any, self.told)
        return 0

    cdef int lengths_of_next(self, double gamma) except -1:
        """p ← φ − γp, and the `lengths_along` it; one product."""
        self.F.count += 1
        sparse_turn(&self.F.rows, self.inverse_norm, gamma, self.x, self.g, self.p,
                    self.Hp, self.lower, self.upper_if_any, self.told)
        return 0

    cdef int turn_beyond(self, double gamma) except -1:
        """p ← φ − γp at z, Hp ← H p; φᵀp and pᵀHp are told; one product."""
        if self.r or not self.F.rows.data:
            self.told[0] = turn_freely(self.g2, self.free, gamma, self.p, self.n)
            self.H(self.p, self.Hp)
            self.told[1] = dot(self.p, self.Hp, self.n)
            return 0
        self.F.count += 1
        sparse_turn_freely(&self.F.rows, self.inverse_norm, self.g2, self.free, gamma,
                           self.p, self.Hp, self.told)
        return 0

    cdef double infeasibility(self, const double *x):
        """Find Cx, which is kept in `Cv`, and ‖Cx‖."""
        cdef Py_ssize_t i
        cdef double square = 0.0
        rows_times(self.C, x, self.Cv, self.r, self.n)
        for i in range(self.r):
            square += self.Cv[i] * self.Cv[i]
        return sqrt(square)

    cdef double violation(self):
        """Find ‖Cx‖ at the iterate; CG steps have brought Cx along."""
        if not self.knows_Cx:
            rows_times(self.C, self.x, self.Cx, self.r, self.n)
            self.knows_Cx = True
        return sqrt(dot(self.Cx, self.Cx, self.r))

    # the model

    cdef Model model(self, double rho):
        """Model H for that ρ by the Ritz pairs, as `Projected.model` does."""
        cdef Py_ssize_t i, k = self.found
        if not k:
            return Model.of_norm(self.tail, self.n)
        if self.known is None or self.known_rho != rho:
            for i in range(k):
                self.c[i] = self.above.at[i] + (rho if i < self.r else 0.0)
            self.known = Model.above_tail(self.basis, k, self.c, 0.0, self.tail)
            self.known_rho = rho
        return self.known

    cdef int factor(self, Model B, const double *piece) except -1:
        """Factorise τI + W¹ᐟ² U_FU_Fᵀ W¹ᐟ², where F is where `piece` is zero.

        piece : of the components that have bounds
        """
        B.basis.enter(piece)
        scaled(B.root, B.basis.gram, B.tau, self.core, B.k, B.basis.stride)
        if not eliminated(self.core, self.inverse, B.k, B.basis.stride):
            raise ArithmeticError("the core of a model is not positive definite")
        return 0

    cdef void tilt(self, Model B, const double *x, const double *g, const double *lower,
                   const double *upper, const double *y, double *s,
                   double *piece) noexcept:
        """Find s(y) and its piece, of the components with bounds."""
        cdef Basis U = B.basis
        cdef Py_ssize_t o = U.first
        combination(1.0, U.bounded, y, g + o, self.t, B.k, U.size)
        tilted(x + o, self.t, B.tau, lower + o, upper + o, s + o, piece, U.size)

    cdef void slope_at(self, Model B, const double *s, const double *y,
                       double *slope) noexcept:
        """Find the slope Us(y) − W⁻¹y.

        Components without bounds have s = −(g + Uᵀy)/τ; `fixed` is U times the first
        part of it.
        """
        cdef Basis U = B.basis
        cdef Py_ssize_t i
        rows_times(U.bounded, s + U.first, slope, B.k, U.size)
        for i in range(B.k):
            slope[i] -= y[i] / B.w[i]
        if U.size < U.n:
            rows_times(U.others, y, self.c, B.k, U.stride)
            for i in range(B.k):
                slope[i] += self.fixed[i] - self.c[i] / B.tau

    cdef int step_of_model(self, Model B, const double *x, const double *g,
                           const double *lower, const double *upper,
                           double *s) except -1:
        """s ← argmin gᵀs + ½sᵀBs subject to l ≤ x + s ≤ u, as `Model.step` does."""
        cdef Py_ssize_t i, newton, search, n = self.n, k = B.k
        cdef double *y = self.y
        cdef double *dy = self.dy
        cdef double *there = self.y2
        cdef double *slope = self.slope
        cdef double *slope_there = self.slope2
        cdef Basis U = B.basis
        cdef double *piece
        cdef double *piece_there
        cdef double begun, now, low, high, at_low, at_high, t, share
        if not k:
            tilted(x, g, B.tau, lower, upper, s, NULL, n)
            return 0
        U.split()
        piece, piece_there = self.piece + U.first, self.piece2 + U.first
        memset(y, 0, U.stride * sizeof(double))
        memset(there, 0, U.stride * sizeof(double))
        tilted(x, g, B.tau, lower, upper, s, self.piece, n)
        rows_times(U.U, s, slope, k, n)
        if U.size < n:
            rows_times(U.bounded, s + U.first, self.fixed, k, U.size)
            for i in range(k):
                self.fixed[i] = slope[i] - self.fixed[i]
        for newton in range(NEWTON_STEPS):
            self.factor(B, piece)
            for i in range(k):
                dy[i] = B.root[i] * slope[i]
            solve(self.core, self.inverse, dy, U.stride)
            for i in range(k):
                dy[i] *= B.root[i] * B.tau
                there[i] = y[i] + dy[i]
            begun = dot(slope, dy, k)
            self.tilt(B, x, g, lower, upper, there, s, piece_there)
            if same(piece, piece_there, U.size):  # where Newton's method is exact
                if U.size < n:
                    combination(1.0, U.U, there, g, self.t, k, n)
                    tilted(x, self.t, B.tau, lower, upper, s, NULL, n)
                return 0
            self.slope_at(B, s, there, slope_there)
            now = dot(slope_there, dy, k)
            low, high, at_low, at_high, t = 0.0, 1.0, begun, now, 1.0
            for search in range(SEARCH_STEPS):
                if fabs(now) <= 0.1 * begun or (now > 0 and t == 1) or at_low <= at_high:
                    break
                share = at_low / (at_low - at_high)  # regula falsi, kept off the ends
                t = low + (high - low) * fmin(fmax(share, 0.05), 0.95)
                for i in range(k):
                    there[i] = y[i] + t * dy[i]
                self.tilt(B, x, g, lower, upper, there, s, piece_there)
                self.slope_at(B, s, there, slope_there)
                now = dot(slope_there, dy, k)
                if now > 0:
                    low, at_low = t, now
                else:
                    high, at_high = t, now
            memcpy(y, there, k * sizeof(double))
            memcpy(slope, slope_there, k * sizeof(double))
            memcpy(piece, piece_there, U.size * sizeof(double))
        t = 0.0
        for i in range(k):
            t = fmax(t, B.w[i])
        return self.step_of_model(Model.of_norm(B.tau + t, n), x, g, lower, upper, s)

    cdef Model raised(self, Model B, const double *s, double square, double sHs):
        """Raise τ, at most tenfold, until sᵀBs reaches sᵀHs; leave w + τ as it is.

        square : ‖s‖²
        """
        cdef Py_ssize_t i
        cdef double rest = square, missing, tau
        missing = sHs - B.tau * square
        rows_times(B.U, s, self.c, B.k, self.n)
        for i in range(B.k):
            rest -= self.c[i] * self.c[i]
            missing -= B.w[i] * self.c[i] * self.c[i]
        if missing <= 0:
            return B
        tau = B.tau + missing / rest if rest > 0 else INFINITY
        return B.with_tail(fmin(fmax(tau, B.tau), 10 * B.tau))

    # the face

    cdef void split(self):
        """Split the gradient at x by the face on which x lies."""
        split(self.x, self.g, self.lower, self.upper, self.B.tau,
              self.phi, self.free, self.n, self.told)
        self.phi_square, self.beta_square = self.told[0], self.told[1]
        self.reduced_square = self.told[2]

    cdef int enter_face(self) except -1:
        """Have the preconditioner know the face."""
        cdef Py_ssize_t i
        if self.preconditioned and self.preconditioner.k:
            for i in range(self.n):
                self.piece[i] = 1 - self.free[i]
            self.factor(self.preconditioner,
                        self.piece + self.preconditioner.basis.first)
        return 0

    cdef const double *preconditioned_gradient(self) noexcept:
        """Return z = B_FF⁻¹φ, of which zᵀHp is kept; φ where there is no preconditioner.
        """
        cdef Py_ssize_t i, n = self.n
        cdef Model M = self.preconditioner
        cdef double *z = self.z
        if not self.preconditioned or not M.k:
            return self.phi  # directions have no length
        rows_times(M.U, self.phi, self.c, M.k, n)
        for i in range(M.k):
            self.c[i] *= M.root[i]
        solve(self.core, self.inverse, self.c, M.basis.stride)
        for i in range(M.k):
            self.c[i] *= M.root[i]
        combination(-1.0, M.U, self.c, self.phi, z, M.k, n)
        self.z_Hp = scale_free(1 / M.tau, self.free, self.Hp, z, n)
        return z

    # MPRGP

    cdef double cost(self, const double *x, const double *g):
        """Return xᵀHx − 2bᵀx, twice the cost, from the gradient."""
        cdef double total = 0.0
        cdef Py_ssize_t i
        for i in range(self.n):
            total += x[i] * (g[i] - self.rhs[i])
        return total

    cdef void terms_of_cost(self):
        """Tell twice the cost at x, and the sum of the absolute values of its terms."""
        cdef double term, total = 0.0, size = 0.0
        cdef Py_ssize_t i
        for i in range(self.n):
            term = self.x[i] * (self.g[i] - self.rhs[i])
            total += term
            size += fabs(term)
        self.told[0], self.told[1] = total, size

    cdef void to(self, double alpha, const double *p, const double *Hp):
        """x ← x − αp, and its face; the gradient follows without a product."""
        cdef bint stored = not self.in_two
        advance(alpha, self.x, self.g, p, Hp, self.lower, self.upper_if_any, self.B.tau,
                self.phi if stored else NULL, self.free if stored else NULL, self.n,
                self.told)
        self.phi_square, self.beta_square = self.told[0], self.told[1]
        self.reduced_square, self.knows_Cx = self.told[2], False

    cdef double searched(self, double *s, double *Hs) except? -1:
        """Find the length along s of the least cost, in the box where 1 is not beyond.

        0 for s = 0, inf where the cost falls without end. It turns s round, so that
        x − αs is where it leads, and leaves its `lengths` in `told`; one product.
        """
        if not turn_round(s, self.n):
            return 0
        self.lengths_along(s, Hs)
        return fmin(self.told[0], fmax(1.0, self.told[1]))

    cdef int step_by_model(self) except -1:
        """Minimise the model over the box, then the cost along that step.

        0 where there is nothing to gain, or the cost falls without end.
        """
        cdef Py_ssize_t n = self.n
        cdef double *s = self.s
        cdef double *Hs = self.Hs
        cdef double length
        self.step_of_model(self.B, self.x, self.g, self.lower,
                           self.upper, s)
        length = self.searched(s, Hs)
        if length == 0 or isinf(length):
            return 0
        if self.told[0] < 1:
            self.B = self.raised(self.B, s, dot(s, s, n), dot(s, Hs, n))
        self.to(length, s, Hs)
        return 1

    cdef int proportion(self, bint by_model) except -1:
        """Take a step that frees components; 0 where none leads on."""
        cdef Py_ssize_t i, n = self.n
        cdef double *beta = self.s
        if by_model:
            return self.step_by_model()
        for i in range(n):
            beta[i] = 0.0
            if not self.lower[i] < self.x[i] < self.upper[i] and (
                (self.g[i] < 0 and self.x[i] < self.upper[i])
                or (self.g[i] > 0 and self.x[i] > self.lower[i])
            ):
                beta[i] = self.g[i]
        self.lengths_along(beta, self.Hs)
        if isinf(fmin(self.told[0], self.told[1])):
            return 0
        self.to(fmin(self.told[0], self.told[1]), beta, self.Hs)
        return 1

    cdef int expand(self, double cg, double feasible, bint is_first, long most,
                    double enough, bytearray trace) except -1:
        """Expand the active set; returns the letter of the step, 0 where none leads on."""
        cdef Py_ssize_t i, n = self.n
        cdef double step
        self.knows_Cx = False
        if self.expansion in (PROJCG, MIXED) and isfinite(cg):
            for i in range(n):
                step = self.x[i] - cg * self.p[i]
                self.x2[i] = fmin(fmax(step, self.lower[i]), self.upper[i])
            self.gradient(self.x2, self.g2)
            if self.expansion == PROJCG or (
                self.cost(self.x2, self.g2) <= self.cost(self.x, self.g)
            ):
                memcpy(self.x, self.x2, n * sizeof(double))
                memcpy(self.g, self.g2, n * sizeof(double))
                self.split()
                return b"e"
        if self.expansion == MODEL:
            return self.expand_by_model(cg, feasible, is_first, most, enough, trace)
        self.to(feasible, self.p, self.Hp)
        projected(self.x, self.g, self.B.tau, self.lower, self.upper, self.x2, n)
        memcpy(self.x, self.x2, n * sizeof(double))  # the step cut φ to φ̃
        self.gradient(self.x, self.g)
        self.split()
        return b"f" if self.expansion == MIXED else b"e"

    cdef int expand_by_model(self, double cg, double feasible, bint is_first, long most,
                             double enough, bytearray trace) except -1:
        """Project z, where CG leads beyond the box, on it in the metric of the model."""
        cdef Py_ssize_t n = self.n
        cdef double *s = self.s
        cdef double *Hs = self.Hs
        cdef double *x2 = self.x2
        cdef double *lower = self.box_lower
        cdef double *upper = self.box_upper
        cdef double beyond = cg - feasible if isfinite(cg) else 0.0, length, tau = self.B.tau
        cdef double change = -feasible * self.told[2] + 0.5 * feasible**2 * self.told[3]
        cdef double least = self.reduced_square / (2 * tau), slope
        cdef bint is_flat = not self.B.k, release = is_first and not is_flat
        leave(feasible, beyond, release, self.x, self.g, self.p, self.Hp, self.lower,
              self.upper, self.x0, self.g0, self.free, lower, upper, x2, self.g2, n)
        if beyond and is_flat:
            self.minimise_beyond(most, enough, trace)
        if is_flat:
            slope = tilted_within(x2, self.g2, tau / self.alpha, self.x, self.g, lower,
                                  upper, s, n)
        else:
            self.B.tau = tau / self.alpha
            self.step_of_model(self.B, x2, self.g2, lower, upper, s)
            self.B.tau = tau
            slope = within(x2, self.x, self.g, lower, upper, release, s, n)
        if slope >= 0:
            memcpy(x2, self.x, n * sizeof(double))
            memcpy(self.g2, self.g, n * sizeof(double))
            self.step_of_model(self.B, self.x, self.g, lower, upper, s)
        length = self.searched(s, Hs)
        if isinf(length):
            return 0
        if length:
            if -self.told[2] + 0.5 * self.told[3] + change < 0:
                length = fmax(length, 1.0)
            change += -length * self.told[2] + 0.5 * length**2 * self.told[3]
            rest_of_step(self.x, self.g, s, Hs, self.g2, x2, n, self.told)
            self.B = self.raised(self.B, x2, self.told[0], self.told[1])
            self.to(length, s, Hs)
        else:
            self.split()
        if is_flat and -change < least:
            return self.project_gradient(tau)
        return b"e"

    cdef int minimise_beyond(self, long most, double enough, bytearray trace) except -1:
        """Go on with CG from z on the face as if it had no bounds."""
        cdef Py_ssize_t n = self.n
        cdef long step
        cdef double curvature = dot(self.p, self.Hp, n), slope
        advance_freely(0.0, self.x2, self.g2, self.p, self.Hp, self.free, n, self.told)
        for step in range(most):
            if self.told[0] <= enough:
                break
            self.turn_beyond(self.told[1] / curvature)
            slope, curvature = self.told[0], self.told[1]
            trace.append(c'b')
            if curvature <= 0:
                break
            advance_freely(slope / curvature, self.x2, self.g2, self.p, self.Hp,
                           self.free, n, self.told)
        return 0

    cdef int project_gradient(self, double tau) except -1:
        """Take the step of plain gradient projection from where the expansion began."""
        cdef Py_ssize_t n = self.n
        cdef double length
        memcpy(self.x, self.x0, n * sizeof(double))
        memcpy(self.g, self.g0, n * sizeof(double))
        projected(self.x, self.g, tau, self.lower, self.upper, self.s, n)
        add(-1.0, self.x, self.s, n)
        length = self.searched(self.s, self.Hs)
        if length == 0 or isinf(length):
            return 0
        self.B = self.raised(self.B, self.s, dot(self.s, self.s, n),
                             dot(self.s, self.Hs, n))
        self.to(length, self.s, self.Hs)
        return b"f"

    cdef int gradient(self, const double *x, double *g) except -1:
        """g ← Hx − b; one product."""
        self.H(x, g)
        add(-1.0, self.rhs, g, self.n)
        return 0

    cdef int minimise(self, Until until, double tol, double energy, double b_size,
                      long most, bytearray trace, note) except -1:
        """Run MPRGP from x and g; returns whether it stopped by the stopping test."""
        cdef long idle = 0, inside = 0  # CG steps in this face
        cdef long look = FIRST_LOOK
        cdef double least = INFINITY, before = INFINITY, cost = INFINITY  # at last look
        cdef int letter
        cdef bint by_model, has_expanded = False
        cdef double chopped = INFINITY
        cdef double weight, began, gamma = 0.0  # of p ← φ − γp, where that is put off
        self.in_two = self.F.rows.data != NULL and not self.r and not (
            self.preconditioned and self.preconditioner.k
        )
        self.split()
        self.minimise_along_directions()
        began = self.phi_square
        self.first_direction()
        self.directions.conjugate(self.p)
        while True:
            PyErr_CheckSignals()  # an interrupt ends it
            if self.precise(until, tol, energy, b_size):
                return 1
            if len(trace) >= most:
                return 0
            least = fmin(least, self.phi_square + self.beta_square)
            if len(trace) >= look:
                self.terms_of_cost()
                if not cost - self.told[0] > NOISE * self.told[1] and 4 * least > before:
                    return 0
                before, least, cost = fmin(least, before), INFINITY, self.told[0]
                look = 2 * len(trace)
            weight = self.reduced_square if self.reduced else self.phi_square
            if self.beta_square > self.Gamma_square * weight:
                idle = idle + 1 if self.beta_square > chopped / 2 else 0
                chopped = self.beta_square
                by_model = idle < MOST_IDLE or not self.B.k
                by_model = by_model and self.newton_proportions
                letter = b"p" if self.proportion(by_model) else 0
            else:
                if self.in_two:
                    self.lengths_of_next(gamma)
                else:
                    self.lengths_along(self.p, self.Hp)
                if isinf(fmin(self.told[0], self.told[1])):
                    return 0
                if self.told[0] <= self.told[1]:
                    gamma = self.minimise_along_p()
                    self.tell(b"c", trace, note)
                    inside += 1
                    continue
                letter = self.expand(
                    self.told[0], self.told[1], not has_expanded, max(inside, 1), began,
                    trace,
                )
                has_expanded = True
            if not letter:
                return 0
            self.directions.begin(self.free)
            inside, began, gamma = 0, self.phi_square, 0.0
            self.first_direction()
            self.tell(letter, trace, note)

    cdef int first_direction(self) except -1:
        """Have the preconditioner know the face, and p be its direction of descent."""
        if self.in_two:
            memset(self.p, 0, self.n * sizeof(double))  # φ is added with the product
            return 0
        self.enter_face()
        memcpy(self.p, self.preconditioned_gradient(), self.n * sizeof(double))
        return 0

    cdef int minimise_along_directions(self) except -1:
        """Minimise along the directions known on this face, as far as is feasible."""
        cdef double *s = self.s
        cdef double *Hs = self.Hs
        if not self.directions.most:
            return 0
        if self.directions.count and self.directions.is_on(self.free):
            self.directions.minimise(self.g, s, Hs)
            lengths(self.x, self.g, s, Hs, self.lower, self.upper, self.n, self.told)
            self.to(fmin(1.0, self.told[1]), s, Hs)
        if not self.directions.is_on(self.free):
            self.directions.begin(self.free)
        return 0

    cdef int tell(self, int letter, bytearray trace, note) except -1:
        trace.append(letter)
        if note is not None:
            note(chr(letter), copied(self.x, self.n), copied(self.g, self.n))
        return 0

    cdef double minimise_along_p(self) except? -1:
        """Take the CG step whose `lengths` are told, and find the next direction.

        Returns γ of p ← φ − γp where that is put off, 0 else.
        """
        cdef double length = self.told[0], curvature = self.told[3], z_Hp
        cdef const double *z
        cdef bint knows_Cx = self.knows_Cx
        if not self.in_two:
            self.directions.add(self.p, self.Hp, curvature)
        self.to(length, self.p, self.Hp)
        add(-length, self.Cv, self.Cx, self.r)  # Cp, of the product Hp
        self.knows_Cx = knows_Cx
        z_Hp = self.told[3]
        if self.in_two:
            return z_Hp / curvature
        z = self.preconditioned_gradient()
        if z != self.phi:
            z_Hp = self.z_Hp
        turn(z, z_Hp / curvature, self.p, self.n)
        self.directions.conjugate(self.p)
        return 0

    # when to stop

    cdef bint precise(self, Until until, double tol, double energy, double b_size):
        """Whether an inner run may end."""
        cdef double size = sqrt(self.phi_square + self.beta_square)
        if self.r and size < until.coarse:
            if size < until.M * self.violation():
                return True
        return size <= until.small and self.small(tol, energy, b_size)

    cdef bint small(self, double tol, double energy, double b_size):
        """Whether rows are met and the energy error is small or has cost its share."""
        if not self.met(tol, b_size):
            return False
        if not self.most_products:
            self.most_products = <long> (FOR_ENERGY * self.F.count)
        if not energy or self.F.count >= self.most_products:
            return True
        return self.energy_error() <= energy * tol

    cdef bint met(self, double tol, double b_size):
        """Whether the equality rows are met, as `Rows.met` says."""
        cdef double error = self.infeasibility(self.x), square = 0.0, part
        cdef Py_ssize_t i
        part = sqrt(dot(self.x, self.x, self.n))
        if self.e_size == 0 or self.x_tilde_size <= NO_SHIFT * part:
            return error <= tol * fmax(part, b_size)
        for i in range(self.m):
            part = dot(self.GC + i * self.r, self.Cv, self.r)
            square += part * part
        return error <= tol * self.x_tilde_size and sqrt(square) <= tol * self.e_size

    cdef double energy_error(self):
        """Estimate the relative energy error, as `Projected.energy_error` does."""
        cdef double energy = 0.0, most = 0.0, total
        cdef Py_ssize_t i
        if not self.diagonal:
            return 0.0
        for i in range(self.n):
            energy += self.q[i] * (self.x_tilde[i] + self.x[i])
            most = fabs(self.q[i]) if fabs(self.q[i]) > most else most
        total = inward_energy(self.x, self.g, self.lower, self.upper, self.diagonal,
                              self.norm, 1e3 * 2.0 ** -52 * most, self.n)
        return sqrt(total / fabs(energy)) if energy else 0.0

    # the outer loop

    def begin(self, x, mu, double rho):
        """Return ν (n,), moved into the bounds, and its gradient, as `first_iterate`."""
        cdef Py_ssize_t i, n = self.n
        start, gradient = np.empty(n), np.zeros(n)
        cdef bint moved = False
        cdef double *nu = numbers(start)
        cdef double *g = numbers(gradient)
        cdef const double *at = numbers(x)
        self.rho = rho
        for i in range(n):
            nu[i] = fmin(fmax(at[i] - self.x_tilde[i], self.lower[i]), self.upper[i])
            moved = moved or nu[i] + self.x_tilde[i] != 0
        if moved:
            self.H(nu, g)
        else:  # PFPν = 0
            self.infeasibility(nu)
            add_combination(rho, self.C, self.Cv, g, self.r, n)
        add(-1.0, self.b, g, n)
        add_combination(1.0, self.C, numbers(mu), g, self.r, n)
        return start, gradient

    def smalbe(self, options, double tol, at, infeasible, watch=None):
        """Run the outer loop on from `at`, as `solvers.smalbe.outer_loop.smalbe` does.

        Returns ν, g, μ, M, ρ, the outer iterations as tuples in the order of
        `OuterIteration`, and the status.

        infeasible : asked whether ν proves that
        watch : makes the observer of outer iteration k with that right-hand side, which
            is told the letter of each step, x and g
        """
        cdef Py_ssize_t i, n = self.n
        cdef double before = -INFINITY, lagrangian, error, M = at.M
        cdef long left = options.max_steps - len(at.steps) - len(at.outer)
        cdef double energy = options.energy
        cdef bint stopped, enough, solved, stalled
        cdef Until until
        memcpy(self.x, numbers(at.nu), n * sizeof(double))
        memcpy(self.g, numbers(at.g), n * sizeof(double))
        if at.rho != self.rho or not at.outer:
            self.directions.begin(self.free)
        self.rho, self.most_products, self.knows_Cx = at.rho, 0, False
        multipliers = np.array(at.mu)
        cdef double *mu = numbers(multipliers)
        cdef double b_size = sqrt(dot(self.b, self.b, n))
        b_size = b_size or sqrt(dot(self.g, self.g, n))
        until.small, until.coarse = tol * b_size, options.eta * b_size
        done, errors = [], [o.infeasibility for o in at.outer][max(len(at.outer) - 2, 0):]
        status = "iteration_limit"
        while True:
            trace, until.M = bytearray(), M
            memcpy(self.rhs, self.b, n * sizeof(double))
            for i in range(self.r):
                add(-mu[i], self.C + i * n, self.rhs, n)
            if self.plain:
                self.B = self.plain_model()
            if self.preconditioned or not self.plain:
                self.preconditioner = self.model(self.rho)
                if not self.plain:
                    self.B = self.preconditioner
            note = watch and watch(len(at.outer) + len(done), copied(self.rhs, n))
            stopped = self.minimise(
                until, tol, energy, b_size, max(left, 0), trace, note
            )
            left -= len(trace) + 1
            solved = sqrt(self.phi_square + self.beta_square) <= until.small
            solved = solved and self.small(tol, energy, b_size)
            error = self.infeasibility(self.x)
            lagrangian = 0.0
            for i in range(n):
                lagrangian += 0.5 * self.x[i] * (self.g[i] - self.b[i])
            for i in range(self.r):
                lagrangian += 0.5 * mu[i] * self.Cv[i]
            enough = lagrangian >= before + self.rho / 2 * error * error
            before = lagrangian
            done.append((trace.decode(), M, self.rho, error, lagrangian))
            for i in range(self.r):
                add(self.rho * self.Cv[i], self.C + i * n, self.g, n)
                mu[i] += self.rho * self.Cv[i]
            if not enough:
                M *= options.beta
                if options.rho_growth != 1:
                    self.change_penalty(options.rho_growth * self.rho)
            if solved:
                status = "solved"
                break
            errors = [*errors, error][len(errors) > 2:]
            stalled = len(errors) == 3 and errors[2] > errors[1] / 2 > errors[0] / 4
            if (not stopped or stalled) and infeasible(copied(self.x, n)):
                status = "infeasible"
                break
            if not stopped or left < 0:
                break
            if stalled and self.met(tol, b_size):
                if M < LEAST_M:
                    break
                M /= 10
            elif stalled:
                if self.rho >= MOST_RHO:
                    break
                self.change_penalty(fmin(10 * self.rho, MOST_RHO))
        return (copied(self.x, n), copied(self.g, n), multipliers, M, self.rho, done,
                status)

    cdef Model plain_model(self):
        """Model H by ‖H‖ alone, as `Projected.plain_model` does."""
        cdef double norm = fmax(1.0, self.rho if self.r else 0.0)
        return Model.of_norm(norm / self.alpha, self.n)

    cdef void change_penalty(self, double rho):
        """Change ρ; the gradient follows without a product."""
        cdef Py_ssize_t i
        self.infeasibility(self.x)
        for i in range(self.r):
            add((rho - self.rho) * self.Cv[i], self.C + i * self.n, self.g, self.n)
        self.rho = rho
        self.directions.begin(self.free)  # of another H

    # back to the problem as given

    def point(self, nu, mu, lb, ub):
        """Return x, a, z_box and Fx of the problem with the rows Cx = Cx̃; one product.

        As `solvers.smalbe.driver.recovered`; a (r,) belongs to those rows. None where
        they are too nearly dependent on the free components for normal equations.
        """
        cdef Py_ssize_t i, n = self.n, r = self.r
        cdef int order = r, one = 1, info = 0
        cdef bint any_left = False
        cdef list held = []
        result, multipliers = np.zeros((3, n)), np.zeros(r)
        cdef Room room = Room(r * r)
        cdef double *S = room.at
        cdef const double *v = numbers(nu)
        cdef const double *at_mu = numbers(mu)
        cdef double *a = numbers(multipliers)
        cdef double *x = numbers(result)
        cdef double *z_box = x + n
        cdef double *Fx = z_box + n
        cdef double *rest = self.s
        cdef double *free = self.piece
        cdef double *t = self.t
        cdef double *da = self.Cv
        restored(v, self.x_tilde, self.lower, self.upper, read(lb, held), read(ub, held),
                 x, free, n)
        self.F.apply(x, Fx)
        for i in range(n):
            rest[i] = Fx[i] + self.q[i]
            any_left = any_left or rest[i] != 0
        if not any_left:  # a minimum of the cost without any constraint
            return result[0], multipliers, result[1], result[2]
        if r:
            rows_times(self.C, rest, da, r, n)
            for i in range(r):
                a[i] = self.norm * at_mu[i] - da[i]
            add_combination(1.0, self.C, a, rest, r, n)
            for i in range(r):
                masked(free, self.C + i * n, t, n)
                rows_times(self.C, t, S + i * r, i + 1, n)
            masked(free, rest, t, n)
            rows_times(self.C, t, da, r, n)
            dpotrf(b"U", &order, S, &order, &info)
            for i in range(r):
                if info or S[i * r + i] < 1e-4:
                    return None
            dpotrs(b"U", &order, &one, S, &order, da, &order, &info)
            for i in range(r):
                a[i] -= da[i]
            add_combination(-1.0, self.C, da, rest, r, n)
        held_by(v, self.lower, self.upper, rest, z_box, n)
        return result[0], multipliers, result[1], result[2]


def residual_bound(
    cost, told_diagonal, at_x, at_y, at_z, told_Fx, lower, upper, right, told_rows
):
    """Bound the worst of `harness.kkt_residuals` from above, without products.

    cost, told_diagonal : q and the diagonal of P (n,), empty for an operator
    at_x, at_y, at_z, told_Fx : x, y, z_box of the point, and Px
    lower, upper, right, told_rows : lb, ub, and the rows Gx = e by e (m,) and G (m, n)

    With the least scale of energy that it may use, and nothing excused as rounding:
    where this is small, so are the residuals. inf where nothing can be said.
    """
    cdef Py_ssize_t n = len(at_x), m = len(at_y)
    cdef list held = []
    cdef Room room = Room(2 * n)
    if not len(told_diagonal) or not n:
        return INFINITY
    return worst_residual(
        read(cost, held), read(told_diagonal, held), read(at_x, held), read(at_y, held),
        read(at_z, held), read(told_Fx, held), read(lower, held), read(upper, held),
        read(right, held), read(told_rows, held), m, n, room.at,
    )
