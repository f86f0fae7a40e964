@cython.final
cdef class ApproximateInverse:
    """M = GᵀG ≈ F_FF⁻¹ on a face, with a sparse triangular G (Kolotilina, Yeremin 1993).

    With the Cholesky factor F_FF = LLᵀ, G minimises ‖I − GL‖ over its sparsity pattern
    and the scaling diag(GF_FFGᵀ) = I. The pattern of row i consists of i and the
    NEIGHBOURS free components after i with the largest |Fᵢⱼ|/√Fⱼⱼ. A row is kept as long as
    its neighbours are free.
    """

    cdef Py_ssize_t n
    cdef Product product
    cdef const double *F  # (n, n), owned by `product`
    cdef Room room
    cdef double *inverse_diagonal  # (n,) 1/Fᵢᵢ, 0 unless Fᵢᵢ is positive
    cdef double *weight  # (n,) the same, 0 for active components
    cdef double *work
    cdef sparse_row *G
    cdef bint is_accurate

    def __cinit__(self, Product F):
        cdef Py_ssize_t i, n = F.n
        if n and not F.dense:
            raise ValueError("preconditioner 'sparse' needs a dense P")
        self.is_accurate = True
        self.n, self.product, self.F, self.room = n, F, F.dense, Room(3 * n)
        self.inverse_diagonal, self.weight = self.room.at, self.room.at + n
        self.work = self.room.at + 2 * n
        self.G = <sparse_row *> calloc(max(n, 1), sizeof(sparse_row))
        if not self.G:
            raise MemoryError
        for i in range(n):
            if F.dense[i * n + i] > 0:
                self.inverse_diagonal[i] = 1 / F.dense[i * n + i]
            else:
                self.is_accurate = False

    def __dealloc__(self):
        release_memory(self.G)

    cdef bint enter(self, const double *free) noexcept:
        """Compute the rows of a face that are not yet known; return True if M is accurate.

        M is accurate if ‖GF_FFGᵀ − I‖ ≤ ½‖I‖ in the Frobenius norm, and was so on all
        earlier faces. The square of the ratio is 0.00 to 0.11 for contact problems, and
        0.4 to 9.5 for random matrices with decaying spectra, on which M would be slow.
        """
        cdef int i, k
        cdef bint is_known = True
        masked(free, self.inverse_diagonal, self.weight, self.n)
        for i in range(self.n):
            for k in range(self.G[i].count):
                if self.weight[self.G[i].column[k]] == 0:
                    self.G[i].count = 0
            if self.weight[i] > 0 and not self.G[i].count:
                find_row(self.F, self.weight, self.n, i, self.work, self.G + i)
                is_known = False
        if self.is_accurate and not is_known:
            self.is_accurate = 0.25 >= coupling(
                self.F, self.weight, self.n, self.G, self.work
            )
        return self.is_accurate

    def times(self, free, v):
        """Return Mv on the face with the mask `free` (n,), and whether M is accurate."""
        cdef list owners = []
        result, on_face = empty(self.n), np.asarray(free, dtype=float)
        cdef bint is_accurate = self.enter(address(on_face))
        approximate_inverse(self.G, read(v, owners), address(result), self.n)
        return result, is_accurate
