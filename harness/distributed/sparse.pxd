cdef class LinearMap:
    cdef readonly tuple shape
    cdef Py_ssize_t n, k

    cdef int apply(self, const double *x, double *y, Py_ssize_t columns) except -1
    cdef int expect(self, Py_ssize_t got, Py_ssize_t expected) except -1


cdef class CompressedRows(LinearMap):
    cdef tuple arrays
    cdef const double *data
    cdef const int *indices
    cdef const int *indptr

    cdef void times(self, const double *x, double *y) noexcept
    cdef void add_transposed(self, const double *x, double *y) noexcept
    cdef void combine(
        self, double s, const double *v, double t, const double *x, double *y
    ) noexcept
    cdef void weigh_difference(
        self, const double *v, const double *x, const double *weights, double *y
    ) noexcept


cdef class BorderedFactor(LinearMap):
    cdef Py_ssize_t inner, border
    cdef double scale
    cdef object columns, schur
    cdef tuple arrays
    cdef const int *order
    cdef const int *indptr
    cdef const int *indices
    cdef const double *data
    cdef const double *L
    cdef double *u

    cdef void reduce(self, const double *t, double *u) noexcept
    cdef void extend(self, double *u, double *y) noexcept
    cdef void solve_border(self, double *r, bint transposed) noexcept
    cdef void forward_to(self, const double *t, double *a) noexcept
    cdef void backward_to(self, const double *a, double *y) noexcept
    cdef void solve_to(self, const double *t, double *y) noexcept
    cdef void scale_inner(self, double *u, double s) noexcept
