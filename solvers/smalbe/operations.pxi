# The operations that SMALBE is written in: sums over processes, products with F, and
# orthonormal rows. Each runs on numbers of this process alone, without Python, or on
# those of several, which Python asks one another for.


# --- numbers ------------------------------------------------------------------------
#
# A memoryview takes as long as a pass over a thousand numbers: small problems would spend
# more on these than on their products. Arrays are read and written by their addresses,
# with the lengths that their owner knows, and stay referred to for as long.


@cython.final
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
    """Return the address of an array's components, row by row.

    Raises ValueError where they are not doubles, or have gaps.
    """
    cdef Py_buffer buffer
    cdef bint has_doubles
    PyObject_GetBuffer(a, &buffer, PyBUF_C_CONTIGUOUS | PyBUF_FORMAT)
    has_doubles = buffer.format[0] == b"d"[0]
    PyBuffer_Release(&buffer)
    if not has_doubles:
        raise ValueError(f"an array of {a.dtype}; expected float64")
    return <double *> buffer.buf


def _whole(a):
    return np.ascontiguousarray(a, dtype=float)


cdef const double *read(a, list held) except NULL:
    """Return the address of an array's components, or of a copy; `held` keeps it."""
    cdef const double *at
    try:
        at = numbers(a)
    except ValueError:  # other numbers, or with gaps
        a = _whole(a)
        at = numbers(a)
    held.append(a)
    return at


cdef copied(const double *v, Py_ssize_t n):
    """Return a new array (n,) of these numbers."""
    array = np.empty(n)
    memcpy(numbers(array), v, n * sizeof(double))
    return array


cdef seen(const double *v, Py_ssize_t n):
    """Return an array (n,) on these very numbers, for as long as a call takes."""
    return np.asarray(<double[:n]> <double *> v) if n else np.empty(0)


cdef int take(result, Py_ssize_t n, double *y, str what) except -1:
    """Copy the components of an array that Python returned, of which there must be n."""
    found = _whole(result)
    if found.size != n:
        raise ValueError(f"{what} has {found.size} components; expected {n}")
    memcpy(y, numbers(found), n * sizeof(double))
    return 0


# --- sums ---------------------------------------------------------------------------


@cython.final
cdef class Reduction:
    """Sums over the processes that share a vector; of one process, what it has.

    ranks : a `harness.distributed.vectors.Ranks`, None for one process
    as_slice : array (n,), ranks → the vector whose slice that is
    """

    cdef object ranks, as_slice

    def __init__(self, ranks=None, as_slice=None):
        self.ranks, self.as_slice = ranks, as_slice

    cdef vector(self, array):
        """Return an array as the vector that operators expect."""
        return array if self.ranks is None else self.as_slice(array, self.ranks)

    cdef inline int add(
        self, double *terms, Py_ssize_t k, double *least=NULL
    ) except -1:
        """Replace terms (k,) by their sums, and `least` by the least, over all processes.
        """
        return 0 if self.ranks is None else self.gather(terms, k, least)

    cdef int gather(self, double *terms, Py_ssize_t k, double *least) except -1:
        # in the order of the ranks: the same bits on all of them, and in every run
        cdef Py_ssize_t i, p, width = k + (1 if least else 0)
        cdef const double *of_rank
        own = np.empty(width)
        if k:
            memcpy(numbers(own), terms, k * sizeof(double))
        if least:
            numbers(own)[k] = least[0]
        everyones = self.ranks.gather_all(own)
        of_rank = numbers(everyones)
        for i in range(k):
            terms[i] = 0.0
        for p in range(len(everyones)):
            for i in range(k):
                terms[i] += of_rank[p * width + i]
            if least:
                least[0] = fmin(least[0], of_rank[p * width + k])
        return 0

    cdef inline double total(self, double term) except? -1:
        self.add(&term, 1)
        return term

    cdef inline double least(self, double number) except? -1:
        self.add(NULL, 0, &number)
        return number

    cdef inline bint any(self, bint here) except -1:
        return self.total(here) > 0


# --- products -----------------------------------------------------------------------


cdef enum:
    # Unknowns from which on a dense P comes from memory, where BLAS is as fast: its
    # triangle takes 1.4 MB then, as much as the caches of one core.
    BY_BLAS = 600


@cython.final
cdef class Product:
    """v → Pv, counted.

    over : the processes that share its vectors; one unless given
    """

    cdef Py_ssize_t n
    cdef public long count
    cdef readonly Reduction over
    cdef object matrix
    cdef const double *dense
    cdef sparse rows  # its data is NULL where P is not sparse
    cdef object held

    def __cinit__(self, P, Py_ssize_t n, Reduction over=None):
        self.n, self.matrix = n, P
        self.over = over or Reduction()
        if isinstance(P, np.ndarray) and n:
            whole = P if P.flags.c_contiguous else P.T
            self.held = _whole(whole)
            self.dense = numbers(self.held)
        elif issparse(P) and P.nnz and P.nnz < 2**31:
            M = P if P.format in ("csr", "csc") else csr_array(P)  # P is symmetric
            self.hold_rows(M.data, M.indptr, M.indices)

    cdef int hold_rows(self, values, starts, columns) except -1:
        """Take a sparse P by rows; by diagonals where these take no more room."""
        cdef const double[::1] data = _whole(values)
        cdef const int[::1] indptr = np.ascontiguousarray(starts, dtype=np.int32)
        cdef const int[::1] indices = np.ascontiguousarray(columns, dtype=np.int32)
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
        return self.over.vector(result)

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
        else:  # a copy, which the operator may keep
            take(self.matrix @ self.over.vector(copied(v, self.n)), self.n, y, "P @ v")
            if s != 1:
                scale(s, y, self.n)
        return 0


# --- rows ---------------------------------------------------------------------------


@cython.final
cdef class Rows:
    """Orthonormal rows C (r, n): an array, or L⁻¹G with a sparse factor L of GGᵀ.

    rows : a `solvers.smalbe.rows.Rows`
    over : the processes that share vectors (n,)
    """

    cdef Py_ssize_t n, r, m
    cdef bint exist  # on any process; without them there is nothing to meet
    cdef double e_size, x_tilde_size
    cdef const double *C  # NULL where they are a factor's
    cdef const double *GC
    cdef const double *x_tilde
    cdef readonly object given
    cdef list held
    cdef Reduction over
    cdef Reduction over_rows  # the processes that share vectors (r,), if these do

    def __init__(self, rows, Reduction over):
        self.given, self.over, self.held = rows, over, []
        self.x_tilde = read(rows.x_tilde, self.held)
        self.n, self.e_size, self.over_rows = len(rows.x_tilde), rows.e_size, over
        self.x_tilde_size = sqrt(over.total(dot(self.x_tilde, self.x_tilde, self.n)))
        if isinstance(rows.C, np.ndarray):
            self.r, self.m = len(rows.C), len(rows.GC)
            self.C, self.GC = read(rows.C, self.held), read(rows.GC, self.held)
            self.exist = self.r > 0
        else:
            none = rows.no_multipliers
            self.r, self.exist = np.asarray(none).size, len(rows.C) > 0
            if getattr(none, "ranks", None) is None:
                self.over_rows = Reduction()  # every process has all of (r,)

    cdef int times(self, const double *v, double *Cv) except -1:
        """Cv ← C v."""
        if self.C:
            rows_times(self.C, v, Cv, self.r, self.n)
        elif self.exist:
            take(self.given.C @ seen(v, self.n), self.r, Cv, "C @ v")
        return 0

    cdef int combine(
        self, double s, const double *a, const double *v, double *y
    ) except -1:
        """y ← v + s Cᵀa; y may be v."""
        if self.C:
            combination(s, self.C, a, v, y, self.r, self.n)
        elif self.exist:
            found = self.given.combined(1.0, seen(v, self.n), s, seen(a, self.r))
            take(found, self.n, y, "v + Cᵀa")
        elif y != v:
            memcpy(y, v, self.n * sizeof(double))
        return 0

    cdef int add(self, double s, const double *a, double *y) except -1:
        """y ← y + s Cᵀa."""
        cdef Py_ssize_t i
        if not self.C:
            return self.combine(s, a, y, y)
        for i in range(self.r):
            add(s * a[i], self.C + i * self.n, y, self.n)
        return 0

    cdef int project(self, double *v, double *Cv) except -1:
        """v ← v − CᵀCv; Cv is kept."""
        self.times(v, Cv)
        self.combine(-1.0, Cv, v, v)
        return 0

    cdef double size(self, const double *a) except? -1:
        """Return ‖a‖ of a (r,), which is ‖Cᵀa‖."""
        return sqrt(self.over_rows.total(dot(a, a, self.r)))

    cdef bint are_met(
        self, const double *nu, const double *Cnu, double tol, double least
    ) except -1:
        """Return whether ‖Cν‖ ≤ tol‖x̃‖ and ‖Gν‖ ≤ tol‖e‖.

        For e = 0, or x̃ no more than rounding of ν, ‖Cν‖ ≤ tol·max(‖ν‖, `least`).
        """
        cdef double error = self.size(Cnu), square = 0.0, part
        cdef Py_ssize_t i
        part = sqrt(self.over.total(dot(nu, nu, self.n)))
        if self.e_size == 0 or self.x_tilde_size <= NO_SHIFT * part:
            return error <= tol * fmax(part, least)
        if error > tol * self.x_tilde_size:
            return False
        if not self.C:
            missed = self.given.error(seen(nu, self.n))
            return np.linalg.norm(missed) <= tol * self.e_size
        for i in range(self.m):  # Gν = GCᵀ Cν
            part = dot(self.GC + i * self.r, Cnu, self.r)
            square += part * part
        return sqrt(square) <= tol * self.e_size

    def met(self, nu, double tol, double least):
        """Return whether ν (n,) meets the rows, see `are_met`."""
        cdef Room Cnu = Room(self.r)
        self.times(numbers(nu), Cnu.at)
        return self.are_met(numbers(nu), Cnu.at, tol, least)


# x̃ of this size relative to ν is rounding of e = 0: some hundred times 2⁻⁵³.
# `test_a_right_hand_side_of_rounding_is_none` fails without it.
cdef double NO_SHIFT = 1e-13
