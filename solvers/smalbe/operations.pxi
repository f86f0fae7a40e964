# The basic operations of SMALBE: products with F, and products with orthonormal rows.


# --- numbers ------------------------------------------------------------------------
# For small problems, creating memoryviews and arrays through Python would take more time
# than the products. Arrays are therefore created and accessed through NumPy's C
# interface; the caller passes the lengths and keeps a reference to each array.


@cython.final
cdef class Room:
    """Zero-initialised array of doubles, freed with this object."""

    cdef double *at

    def __cinit__(self, Py_ssize_t size):
        self.at = <double *> calloc(max(size, 1), sizeof(double))
        if not self.at:
            raise MemoryError(f"cannot allocate {size} numbers")

    def __dealloc__(self):
        release_memory(self.at)


cdef double *address(a) except NULL:
    """Return the address of the first component of a C-contiguous array of doubles.

    Raises ValueError if `a` is not an array, has another type, or is not contiguous.
    """
    if cnp.PyArray_Check(a):
        if (
            cnp.PyArray_TYPE(a) == cnp.NPY_DOUBLE and cnp.PyArray_IS_C_CONTIGUOUS(a)
            and cnp.PyArray_ISNOTSWAPPED(a)
        ):
            return <double *> cnp.PyArray_DATA(a)
        raise ValueError(f"an array of {a.dtype}; expected float64, contiguous")
    raise ValueError(f"a {type(a).__name__}; expected an array")


cdef empty(Py_ssize_t n):
    """Return a new array (n,) of doubles."""
    cdef cnp.npy_intp size = n
    return cnp.PyArray_EMPTY(1, &size, cnp.NPY_DOUBLE, 0)


cdef zeros(Py_ssize_t n):
    """Return a new array (n,) of zeros."""
    cdef cnp.npy_intp size = n
    return cnp.PyArray_ZEROS(1, &size, cnp.NPY_DOUBLE, 0)


def _whole(a):
    return np.ascontiguousarray(a, dtype=float)


cdef const double *read(a, list owners) except NULL:
    """Return the address of an array, or of a contiguous copy; `owners` keeps a reference.
    """
    cdef const double *at
    try:
        at = address(a)
    except ValueError:  # another type, or not contiguous
        a = _whole(a)
        at = address(a)
    owners.append(a)
    return at


cdef copied(const double *v, Py_ssize_t n):
    """Return a new array (n,) with a copy of v."""
    array = empty(n)
    memcpy(address(array), v, n * sizeof(double))
    return array


cdef view(const double *v, Py_ssize_t n):
    """Return an array (n,) that shares the memory of v; valid only while v is valid."""
    cdef cnp.npy_intp size = n
    return cnp.PyArray_SimpleNewFromData(1, &size, cnp.NPY_DOUBLE, <void *> v)


cdef int copy_result(
    result, Py_ssize_t n, double *y, str what, double s=1.0
) except -1:
    """y ← s·result for an array from Python; raise ValueError unless its size is n."""
    array = _whole(result)
    if array.size != n:
        raise ValueError(f"{what} has {array.size} components; expected {n}")
    copy_scaled(s, address(array), y, n)
    return 0


# --- products -----------------------------------------------------------------------


@cython.final
cdef class Product:
    """The operator v ↦ Pv with a counter of its products."""

    cdef readonly Py_ssize_t n
    cdef public long count
    cdef bint is_sparse
    cdef object matrix
    cdef const double *dense
    cdef sparse rows  # `data` is NULL unless P is sparse
    cdef LinearMap map  # P as a compiled linear map, or None
    cdef object owners

    def __cinit__(self, P, Py_ssize_t n):
        self.n, self.matrix = n, P
        if isinstance(P, np.ndarray) and n:
            whole = P if P.flags.c_contiguous else P.T
            self.owners = _whole(whole)
            self.dense = address(self.owners)
            return
        self.is_sparse = issparse(P)
        if self.is_sparse and P.nnz and P.nnz < 2**31:
            M = P if P.format in ("csr", "csc") else csr_array(P)  # P is symmetric
            self.hold_rows(M.data, M.indptr, M.indices)
        elif not issparse(P):
            self.map = linear_map(P)

    cdef int hold_rows(self, values, starts, columns) except -1:
        """Store a sparse P by rows, or by diagonals if these take no more memory."""
        cdef const double[::1] data = _whole(values)
        cdef const int[::1] indptr = np.ascontiguousarray(starts, dtype=np.int32)
        cdef const int[::1] indices = np.ascontiguousarray(columns, dtype=np.int32)
        cdef Py_ssize_t most = min(data.shape[0] // self.n, MAX_DIAGONALS), count
        cdef double[:, ::1] diagonals
        cdef Py_ssize_t[::1] offset = np.zeros(max(most, 1), dtype=np.intp)
        cdef signed char[::1] slot = np.empty(self.n, dtype=np.int8)
        self.rows.n, self.rows.data = self.n, &data[0]
        self.rows.indptr, self.rows.indices = &indptr[0], &indices[0]
        self.owners = (data, indptr, indices)
        count = find_diagonals(&self.rows, most, &offset[0], &slot[0])
        if count:
            diagonals = np.zeros((count, self.n))
            fill_diagonals(&self.rows, &slot[0], &diagonals[0, 0])
            self.rows.offset, self.rows.diagonals = &offset[0], &diagonals[0, 0]
            self.rows.count, self.rows.indptr, self.rows.indices = count, NULL, NULL
            self.owners = (data, diagonals, offset)
        return 0

    def __call__(self, v):
        """Return Pv for v (n,)."""
        result, vector = empty(self.n), _whole(v)
        self.apply(address(vector), address(result))
        return result

    cdef int apply(self, const double *v, double *y, double s=1.0) except -1:
        """y ← s Pv."""
        self.count += 1
        cdef int n = self.n, one = 1
        cdef double zero = 0.0
        if self.dense:
            dsymv(b"L", &n, &s, <double *> self.dense, &n, <double *> v, &one, &zero,
                  y, &one)
        elif self.rows.data:
            sparse_product(&self.rows, s, v, y)
        elif self.map is not None:
            self.map.apply(v, y, 1)
            if s != 1:
                scale(s, y, self.n)
        else:  # a copy, because an operator may change its argument or keep a reference
            copy_result(self.matrix @ copied(v, self.n), self.n, y, "P @ v", s)
        return 0


# --- rows ---------------------------------------------------------------------------


@cython.final
cdef class Rows:
    """Orthonormal rows C (r, n): an array, or L⁻¹G with a sparse factor L of GGᵀ.

    rows : a `solvers.smalbe.rows.Rows`, kept as `source`
    """

    cdef readonly Py_ssize_t n
    cdef Py_ssize_t r, m
    cdef bint exist  # true if r > 0
    cdef double e_size, x_tilde_size
    cdef const double *C  # NULL for C = L⁻¹G
    cdef const double *GC
    cdef const double *x_tilde
    cdef Coarse coarse  # used for C = L⁻¹G, otherwise None
    cdef readonly object source
    cdef list owners

    def __init__(self, rows):
        self.source, self.owners = rows, []
        self.x_tilde = read(rows.x_tilde, self.owners)
        self.n, self.e_size, self.r = len(rows.x_tilde), rows.e_size, len(rows.C)
        self.exist = self.r > 0
        self.x_tilde_size = sqrt(dot(self.x_tilde, self.x_tilde, self.n))
        if isinstance(rows.C, np.ndarray):
            self.C, self.GC = read(rows.C, self.owners), read(rows.GC, self.owners)
            self.m = len(rows.GC)
        else:
            self.coarse = Coarse(rows)

    cdef int times(self, const double *v, double *Cv) except -1:
        """Cv ← C v."""
        if self.C:
            rows_times(self.C, v, Cv, self.r, self.n)
        elif self.exist:
            self.coarse.rows.times(v, self.coarse.t)
            self.coarse.factor.forward_to(self.coarse.t, Cv)
        return 0

    cdef int combine(
        self, double s, const double *a, const double *v, double *y
    ) except -1:
        """y ← v + s Cᵀa; y may be v."""
        if y != v:
            memcpy(y, v, self.n * sizeof(double))
        if self.C:
            add_combination(s, self.C, a, y, self.r, self.n)
        elif self.exist:
            self.coarse.factor.backward_to(a, self.coarse.y)
            self.coarse.by_components.combine(1.0, y, s, self.coarse.y, y)
        return 0

    cdef int add(self, double s, const double *a, double *y) except -1:
        """y ← y + s Cᵀa."""
        return self.combine(s, a, y, y)

    cdef int project(self, double *v, double *Cv) except -1:
        """v ← v − CᵀCv; Cv receives the product with the old v."""
        self.times(v, Cv)
        self.combine(-1.0, Cv, v, v)
        return 0

    cdef double size(self, const double *a) noexcept:
        """Return ‖a‖ = ‖Cᵀa‖ for a (r,)."""
        return sqrt(dot(a, a, self.r))

    cdef bint are_met(
        self, const double *nu, const double *Cnu, double tol, double least
    ) except -1:
        """Return True if ‖Cν‖ ≤ tol‖x̃‖ and ‖Gν‖ ≤ tol‖e‖.

        If e = 0, or if x̃ is zero up to rounding errors relative to ν, the test is ‖Cν‖
        ≤ tol·max(‖ν‖, `least`).
        """
        cdef double error = self.size(Cnu), square = 0.0, part
        cdef Py_ssize_t i
        part = sqrt(dot(nu, nu, self.n))
        if self.e_size == 0 or self.x_tilde_size <= SHIFT_ROUNDING * part:
            return error <= tol * fmax(part, least)
        if error > tol * self.x_tilde_size:
            return False
        if not self.C:
            return self.coarse.error(nu) <= tol * self.e_size
        for i in range(self.m):  # Gν = GCᵀ Cν
            part = dot(self.GC + i * self.r, Cnu, self.r)
            square += part * part
        return sqrt(square) <= tol * self.e_size

    def met(self, nu, double tol, double least):
        """Return True if ν (n,) satisfies the rows to `tol`, by the test `are_met`."""
        cdef Room Cnu = Room(self.r)
        self.times(address(nu), Cnu.at)
        return self.are_met(address(nu), Cnu.at, tol, least)

    cdef int fit(self, const double *free, double *r, double *a) except -1:
        """a ← the result of `fitted`.

        Normal equations double the number of lost digits, so that dense rows are fitted
        twice, the second time to the residual.

        free : (n,) 1 for free components, else 0
        r : (n,) argument of `fitted`, overwritten
        """
        cdef Py_ssize_t i, j
        cdef int order = self.r, one = 1, info = 0
        cdef Room room
        cdef double *S
        cdef double *t
        if not self.exist:
            return 0
        masked(free, r, r, self.n)
        if self.coarse is not None:
            self.coarse.rows.times(r, self.coarse.t)
            self.coarse.enter(free)
            self.coarse.in_face(FREE_RANK).solve_to(self.coarse.t, self.coarse.y)
            scale(-1.0, self.coarse.y, self.r)
            self.coarse.matrix.times(self.coarse.y, self.coarse.t)
            self.coarse.factor.forward_to(self.coarse.t, a)
            return 0
        room = Room((self.r + 1) * (self.r + self.n))
        S, t = room.at, room.at + self.r * self.r
        for i in range(self.r):
            masked(free, self.C + i * self.n, t, self.n)
            rows_times(self.C, t, S + i * self.r, i + 1, self.n)
            S[i * self.r + i] += FREE_RANK
        dpotrf(b"U", &order, S, &order, &info)
        memset(a, 0, self.r * sizeof(double))
        for i in range(2):
            rows_times(self.C, r, t, self.r, self.n)
            dpotrs(b"U", &order, &one, S, &order, t, &order, &info)
            add(-1.0, t, a, self.r)
            add_combination(-1.0, self.C, t, r, self.r, self.n)
            masked(free, r, r, self.n)
        return 0

    def fitted(self, free, r):
        """Return the minimiser a (r,) of ‖(r + Cᵀa)_F‖ for the free components F."""
        rest, multipliers = np.array(r, dtype=float), np.empty(self.r)
        is_free = np.array(free, dtype=float)
        self.fit(address(is_free), address(rest), address(multipliers))
        return multipliers


# If ‖x̃‖/‖ν‖ is at most this value, e counts as zero, and x̃ as its rounding error
# (`test_a_right_hand_side_of_rounding_size_counts_as_zero`).
cdef double SHIFT_ROUNDING = 1e-13
# Shift of G_F G_Fᵀ, relative to GGᵀ, for multipliers fitted on a face with free
# components F. Eigenvalues of G_F G_Fᵀ relative to GGᵀ below this value count as zero.
cdef double FREE_RANK = 1e-10
