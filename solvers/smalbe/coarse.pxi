# Products with sparse rows G, such as the rows for the rigid motions of subdomains, and
# solves with the factor L of GGᵀ. On one process, these operations run without Python.


cdef class Coarse:
    """Operations, called through Python, with rows G (k, n) shared by several ranks.

    Vectors (k,) have a component for each row with entries in the columns of this
    process. L⁻¹ maps vectors (k,) to vectors (r,).

    source : a `solvers.smalbe.rows.SparseRows`
    """

    cdef Py_ssize_t n, k, r
    cdef Py_ssize_t places  # number of local components with a bound
    cdef object source
    cdef const long long *bounded  # (places,) these components
    cdef list owners
    cdef Room room
    cdef double *t  # (k,)
    cdef double *y  # (k,)
    cdef double *active  # (places,) 1 for active bounds of a face, else 0

    def __init__(self, source):
        cdef const long long[::1] bounded = np.ascontiguousarray(
            source.bounded, dtype=np.int64
        )
        self.source, self.owners = source, [bounded]
        self.k, self.n = source.unit.shape
        self.r = np.asarray(source.no_multipliers).size
        self.places = bounded.shape[0]
        self.bounded = &bounded[0] if self.places else NULL
        self.room = Room(2 * self.k + self.places)
        self.t, self.y = self.room.at, self.room.at + self.k
        self.active = self.y + self.k

    cdef int times(self, const double *v, double *t) except -1:
        """t ← Gv."""
        return copy_result(self.source.unit @ view(v, self.n), self.k, t, "Gv")

    cdef int combine(
        self, double s, const double *v, double c, const double *y, double *out
    ) except -1:
        """out ← sv + cGᵀy; out may be v."""
        total = self.source.combined_rows(s, view(v, self.n), c, view(y, self.k))
        return copy_result(total, self.n, out, "v + Gᵀy")

    cdef int weigh_difference(
        self, const double *v, const double *y, const double *weights, double *out
    ) except -1:
        """out ← weights·(v − Gᵀy), componentwise."""
        difference = self.source.weighted_difference(
            view(v, self.n), view(y, self.k), view(weights, self.n)
        )
        return copy_result(difference, self.n, out, "v − Gᵀy")

    cdef int times_bounded(self, const double *s_b, double *t) except -1:
        """t ← G_b s_b with the columns G_b of the components with a bound."""
        part = self.source.of_bounded @ view(s_b, self.places)
        return copy_result(part, self.k, t, "G_b s_b")

    cdef int combine_bounded(
        self, const double *g_b, const double *y, double *out
    ) except -1:
        """out ← g_b + G_bᵀy."""
        total = view(g_b, self.places) + np.asarray(self.source.of_bounded.T @ view(y, self.k))
        return copy_result(total, self.places, out, "g + Gᵀy")

    cdef int product(self, const double *y, double *t) except -1:
        """t ← GGᵀy."""
        return copy_result(self.source.gram.product(view(y, self.k)), self.k, t, "GGᵀy")

    cdef int forward(self, const double *t, double *a) except -1:
        """a ← L⁻¹t."""
        return copy_result(self.source.gram.forward(view(t, self.k)), self.r, a, "L⁻¹t")

    cdef int backward(self, const double *a, double *y) except -1:
        """y ← L⁻ᵀa."""
        return copy_result(self.source.gram.backward(view(a, self.r)), self.k, y, "L⁻ᵀa")

    cdef in_face(self, double shift):
        """Return the factor of G_F G_Fᵀ + shift·GGᵀ; F: all components not `active`."""
        free = np.ones(self.n, dtype=bool)
        free[self.source.bounded] = view(self.active, self.places) == 0
        return self.source.gram.in_face(free, shift)

    cdef int solve(self, factor, const double *t, double *y) except -1:
        """y ← the solution for the right-hand side t; `factor` comes from `in_face`."""
        return copy_result(factor(view(t, self.k)), self.k, y, "solution")

    cdef double error(self, const double *nu) except? -1:
        """Return ‖Gν‖ with the original, unnormalised rows."""
        return np.linalg.norm(self.source.error(view(nu, self.n)))

    cdef void enter(self, const double *free) noexcept:
        """Set `active` from the mask `free` (n,) of the face."""
        cdef Py_ssize_t i
        for i in range(self.places):
            self.active[i] = 1 - free[self.bounded[i]]


@cython.final
cdef class LocalCoarse(Coarse):
    """Variant of `Coarse` for one process; products and solves run without Python."""

    cdef CompressedRows rows  # G
    cdef CompressedRows by_components  # Gᵀ
    cdef CompressedRows of_bounded  # G_bᵀ
    cdef CompressedRows original  # transpose of the original, unnormalised rows
    cdef CompressedRows matrix  # GGᵀ
    cdef BorderedFactor factor
    cdef bint has_border
    cdef Room missed

    def __init__(self, source):
        super().__init__(source)
        gram = source.gram
        self.by_components = source.unit.transposed
        self.rows = self.by_components.transposed()
        self.of_bounded = source.of_bounded.transposed
        self.original = transposed_rows(source.G)
        self.matrix, self.factor = symmetric_rows(gram.matrix), gram.factor
        self.has_border, self.missed = gram.has_border, Room(self.original.k)

    cdef int times(self, const double *v, double *t) except -1:
        self.rows.times(v, t)
        return 0

    cdef int combine(
        self, double s, const double *v, double c, const double *y, double *out
    ) except -1:
        self.by_components.combine(s, v, c, y, out)
        return 0

    cdef int weigh_difference(
        self, const double *v, const double *y, const double *weights, double *out
    ) except -1:
        self.by_components.weigh_difference(v, y, weights, out)
        return 0

    cdef int times_bounded(self, const double *s_b, double *t) except -1:
        memset(t, 0, self.k * sizeof(double))
        self.of_bounded.add_transposed(s_b, t)
        return 0

    cdef int combine_bounded(
        self, const double *g_b, const double *y, double *out
    ) except -1:
        self.of_bounded.combine(1.0, g_b, 1.0, y, out)
        return 0

    cdef int product(self, const double *y, double *t) except -1:
        self.matrix.times(y, t)
        return 0

    cdef int forward(self, const double *t, double *a) except -1:
        self.factor.forward_to(t, a)
        return 0

    cdef int backward(self, const double *a, double *y) except -1:
        self.factor.backward_to(a, y)
        return 0

    cdef in_face(self, double shift):
        if not self.has_border:
            return Coarse.in_face(self, shift)
        return self.factor.without(shift, self.of_bounded, self.active)

    cdef int solve(self, factor, const double *t, double *y) except -1:
        cdef BorderedFactor of_face = factor
        of_face.solve_to(t, y)
        return 0

    cdef double error(self, const double *nu) except? -1:
        memset(self.missed.at, 0, self.original.k * sizeof(double))
        self.original.add_transposed(nu, self.missed.at)
        return sqrt(dot(self.missed.at, self.missed.at, self.original.k))


cdef CompressedRows transposed_rows(G):
    """Return the transpose of a sparse matrix."""
    return CompressedRows.of_transpose(G if G.format == "csc" else csc_array(G))


cdef CompressedRows symmetric_rows(M):
    """Return a symmetric matrix M, dense or in CSC format, as compressed rows."""
    return (CompressedRows.of_transpose if issparse(M) else CompressedRows.of_array)(M)
