# Sparse rows G, such as those for the rigid motions of subdomains, and the factor of GGᵀ.


@cython.final
cdef class Coarse:
    """Products and solves with sparse rows G (k, n), which run without Python.

    source : a `solvers.smalbe.rows.SparseRows`
    """

    cdef Py_ssize_t n, k
    cdef Py_ssize_t places  # number of components with a bound
    cdef object source
    cdef const long long *bounded  # (places,) these components
    cdef CompressedRows rows  # G
    cdef CompressedRows by_components  # Gᵀ
    cdef CompressedRows of_bounded  # G_bᵀ
    cdef CompressedRows original  # transpose of the original, unnormalised rows
    cdef CompressedRows matrix  # GGᵀ
    cdef BorderedFactor factor  # L
    cdef bint has_border
    cdef object owner
    cdef Room room
    cdef double *t  # (k,)
    cdef double *y  # (k,)
    cdef double *missed  # (m,)
    cdef double *active  # (places,) 1 for active bounds of a face, else 0

    def __init__(self, source):
        cdef const long long[::1] bounded = np.ascontiguousarray(
            source.bounded, dtype=np.int64
        )
        self.source, self.owner = source, bounded
        self.n, self.k = source.unit.shape
        self.places = bounded.shape[0]
        self.bounded = &bounded[0] if self.places else NULL
        self.by_components, self.rows = source.unit, CompressedRows(source.scaled)
        self.of_bounded = source.of_bounded
        self.original = CompressedRows(csr_array(source.G.T))
        self.matrix, self.factor = CompressedRows(source.matrix), source.factor
        self.has_border = source.has_border
        self.room = Room(2 * self.k + self.original.k + self.places)
        self.t, self.y = self.room.at, self.room.at + self.k
        self.missed = self.y + self.k
        self.active = self.missed + self.original.k

    cdef BorderedFactor in_face(self, double shift):
        """Return the factor of G_F G_Fᵀ + shift·GGᵀ; F: all components not `active`."""
        if self.has_border:
            active = view(self.active, self.places)
            return self.factor.shifted_without(shift, self.of_bounded, active)
        free = np.ones(self.n, dtype=bool)
        free[self.source.bounded] = view(self.active, self.places) == 0
        return self.source.factorised(free, shift)

    cdef double error(self, const double *nu) noexcept:
        """Return ‖Gν‖ with the original, unnormalised rows."""
        memset(self.missed, 0, self.original.k * sizeof(double))
        self.original.add_transposed(nu, self.missed)
        return sqrt(dot(self.missed, self.missed, self.original.k))

    cdef void enter(self, const double *free) noexcept:
        """Set `active` from the mask `free` (n,) of the face."""
        cdef Py_ssize_t i
        for i in range(self.places):
            self.active[i] = 1 - free[self.bounded[i]]
