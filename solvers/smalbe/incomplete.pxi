# Incomplete Cholesky factors of the free block of a sparse P.


# Fraction of each dropped entry that is added to the diagonal. With 1, a few pivots are
# small and CG is slow on irregular faces.
cdef double KEEP = 0.99

# Smallest pivot, relative to the diagonal entry. The relative rounding error of entries
# is 2⁻⁵², so larger pivots have about six correct digits or more.
cdef double LEAST_PIVOT = 1e-10

# First relative shift of the diagonal (Manteuffel 1980) if a pivot is too small although
# no dropped entries are added, and its growth until no pivot is too small
cdef double FIRST_SHIFT = 1e-3
cdef double SHIFT_GROWTH = 4.0

cdef enum:
    # Smallest distance of a diagonal from the main diagonal for which it is faster to
    # eliminate a run of columns at the same time than column by column.
    LEAST_OFFSET = 8


def sparsity(matrix):
    """Return the fields of `solvers.smalbe.preconditioner.Sparsity` for a symmetric P.

    matrix : P (n, n), n > 0, in SciPy's csr or csc format
    """
    cdef Py_ssize_t i, k, n = matrix.shape[0], below, away = 0, others = 0
    cdef double pairs = 0.0, least = INFINITY, most = 0.0, diagonal, size, total
    cdef double norm = 0.0, least_sum = INFINITY
    cdef list owners = [_integers(matrix.indptr), _integers(matrix.indices)]
    cdef const int *indptr = <const int *> cnp.PyArray_DATA(owners[0])
    cdef const int *indices = <const int *> cnp.PyArray_DATA(owners[1])
    cdef const double *data = read(matrix.data, owners)
    for i in range(n):
        below, diagonal, size, total = 0, 0.0, 0.0, 0.0
        for k in range(indptr[i], indptr[i + 1]):
            below += indices[k] > i
            away += indices[k] - i if indices[k] > i else 0
            size += fabs(data[k])
            total += data[k]
            if indices[k] == i:
                diagonal += data[k]
        if not 0 < diagonal < INFINITY:
            return INFINITY, 0.0, INFINITY, INFINITY, 0.0
        norm, least_sum = fmax(norm, size), fmin(least_sum, total / diagonal)
        least, most = fmin(least, diagonal), fmax(most, diagonal)
        pairs += below * (below - 1) // 2
        others += below
    levels = n * <double> others / (2 * away) if away else 0.0
    return pairs, levels, most / least, norm, least_sum


@cython.final
cdef class IncompleteFactor:
    """Incomplete Cholesky factorisation M ≈ P_FF on the free set F.

    L has the sparsity pattern of P. Dropped entries, multiplied by `keep`, which is
    KEEP or 0, are added to the diagonal (modified incomplete Cholesky, Gustafsson, BIT
    18, 1978, 142-156), which with `keep` = 1 would preserve the row sums of P. If a
    pivot is below LEAST_PIVOT times the diagonal entry, `keep` is set to 0. If this is
    not sufficient, the diagonal is multiplied by 1 + σ with increasing σ (Manteuffel,
    Math. Comp. 34, 1980, 473-497). M is therefore finite and positive definite for every
    symmetric P with a positive diagonal. Later faces use the final values.

    matrix : P in SciPy's csr or csc format, with sorted indices
    scale : factor s; `inverse` applies s M⁻¹
    keep : True to add dropped entries, times KEEP, to the diagonal
    """

    cdef incomplete F
    cdef Py_ssize_t n, most
    cdef const int *indptr
    cdef const int *indices
    cdef list owners
    cdef Room room
    # (n,) 1 for components that are free in the present factor, else 0
    cdef double *face
    cdef double *wanted  # (n,) mask of a trial face
    cdef int *queue  # (n,)
    cdef int *besides  # (idle,) components of the present factor that are not free
    cdef Py_ssize_t idle
    cdef bint is_ready
    cdef readonly double keep, shift
    cdef double scale
    cdef readonly long factorisations, solves

    def __init__(self, matrix, double scale=1.0, bint keep=True):
        cdef Py_ssize_t n = matrix.shape[0], i, k, m, entries = 0, pairs = 0, count, used
        cdef Py_ssize_t stored, reach = 0
        cdef int first, last
        cdef sparse P
        self.n, self.owners, self.keep, self.scale = n, [], KEEP if keep else 0.0, scale
        cdef int[::1] indptr = _integers(matrix.indptr)
        cdef int[::1] indices = _integers(matrix.indices)
        cdef const double *data = read(matrix.data, self.owners)
        cdef Py_ssize_t[::1] offset = np.zeros(MAX_DIAGONALS, dtype=np.intp)
        cdef signed char[::1] slot = np.empty(n, dtype=np.int8)
        self.indptr, self.indices = &indptr[0], &indices[0]
        # 1. Diagonals, if few are nonzero; a run of columns is eliminated at the same
        # time, so that it must not be longer than the second offset
        P.n, P.indptr, P.indices, P.data = n, self.indptr, self.indices, data
        count = find_diagonals(
            &P, min(indptr[n] // n, MAX_DIAGONALS), &offset[0], &slot[0]
        ) - 1
        m = 1 + (count > 0 and offset[1] == 1)
        self.most = RUN if count > 0 else n
        if m <= count:
            self.most = min(RUN, offset[m])
        if self.most < LEAST_OFFSET:
            count, self.most = 0, n
        count = max(count, 0)
        # 2. The number of entries below the diagonal and of pairs of them in a column.
        for i in range(0 if count else n):
            used = 0
            for k in range(indptr[i], indptr[i + 1]):
                used += indices[k] > i
            entries += used
            pairs += used * (used - 1) // 2
        # 3. Memory.
        if count:
            reach = offset[count]
        stored = count * (n + reach) if count else entries
        integers = np.zeros(5 * n + 1 + entries + pairs + MAX_DIAGONALS**2, dtype=np.int32)
        first_pairs = np.zeros(n, dtype=np.intp)
        below_diagonal = np.zeros((count + 1) * n if count else n + entries)
        self.room = Room(stored + 5 * n + reach)
        cdef int *start = <int *> cnp.PyArray_DATA(integers)
        cdef int *row = start + n + 1
        cdef int *target = row + entries
        cdef int *between = target + pairs
        cdef Py_ssize_t *pair = <Py_ssize_t *> cnp.PyArray_DATA(first_pairs)
        cdef double *diagonal = address(below_diagonal)
        cdef double *below = diagonal + n
        self.owners += [indptr, indices, offset, integers, first_pairs, below_diagonal]
        # 4. The matrix.
        if count:
            fill_diagonals(&P, &slot[0], diagonal)
        entries = 0
        for i in range(0 if count else n):
            for k in range(indptr[i], indptr[i + 1]):
                if indices[k] == i:
                    diagonal[i] += data[k]
                elif indices[k] > i:
                    row[entries], below[entries] = indices[k], data[k]
                    entries += 1
            start[i + 1] = <int> entries
        # 5. The entry that couples two later rows of a column, if it exists.
        for m in range(count):
            for k in range(count):
                between[m * MAX_DIAGONALS + k] = -1
                for i in range(count):
                    if offset[i + 1] == offset[k + 1] - offset[m + 1]:
                        between[m * MAX_DIAGONALS + k] = <int> i
        pairs = 0
        for i in range(0 if count else n):
            pair[i] = pairs
            for k in range(start[i], start[i + 1]):
                for m in range(k + 1, start[i + 1]):
                    first, last = start[row[k]], start[row[k] + 1]
                    while first < last and row[first] < row[m]:
                        first += 1
                    target[pairs] = -1
                    if first < last and row[first] == row[m]:
                        target[pairs] = first
                    pairs += 1
        self.F.n, self.F.count, self.F.width = n, count, n + reach
        self.F.offset, self.F.between = &offset[1], between
        self.F.start, self.F.row, self.F.target, self.F.pair = start, row, target, pair
        self.F.below, self.F.diagonal, self.F.L = below, diagonal, self.room.at
        self.F.from_ = between + MAX_DIAGONALS * MAX_DIAGONALS
        self.F.to, self.queue = self.F.from_ + n, self.F.from_ + 2 * n
        self.besides = self.F.from_ + 3 * n
        self.F.pivot = self.F.L + stored
        self.F.inverse = self.F.pivot + n + reach
        self.F.y, self.face = self.F.inverse + n, self.F.inverse + 2 * n
        self.wanted = self.F.inverse + 3 * n

    cdef int enter(self, const double *free, bint may_exceed=False) except -1:
        """Factorise on the face with the mask `free` (n,) of free components.

        The present factor M̃ is reused if it belongs to this face. With `may_exceed`,
        it is also reused if it belongs to a larger free set; M⁻¹ is then the block of
        M̃⁻¹ on the face, which is positive definite.
        """
        cdef Py_ssize_t first, i
        cdef bint inside = self.is_ready
        self.idle = 0
        for first in range(0, self.n, RUN):
            if same(self.face + first, free + first, min(RUN, self.n - first)):
                continue
            for i in range(first, min(first + RUN, self.n)):
                if self.face[i] < free[i]:
                    inside = False
                if self.face[i] > free[i]:
                    self.besides[self.idle] = <int> i
                    self.idle += 1
            if not inside:
                break
        if inside and (may_exceed or not self.idle):
            return 0
        self.idle = 0
        memcpy(self.face, free, self.n * sizeof(double))
        self.is_ready = True
        self.factorisations += 1
        find_runs(&self.F, free, self.most)
        while not factorise_incompletely(
            &self.F, free, self.keep, self.shift, LEAST_PIVOT
        ):
            if self.keep:
                self.keep = 0.0
            else:
                self.shift = fmax(FIRST_SHIFT, SHIFT_GROWTH * self.shift)
        return 0

    cdef void inverse(self, const double *v, double *z) noexcept:
        """z ← s M⁻¹ v for a v that is zero off the face."""
        cdef Py_ssize_t i
        solve_incompletely(&self.F, self.scale, v, z)
        self.solves += 1
        for i in range(self.idle):
            z[self.besides[i]] = 0.0

    cdef Py_ssize_t widen(self, double *free, Py_ssize_t count, long layers) noexcept:
        """Add to `free` all components within `layers` edges of `queue` (count,) in the
        graph of P, and append them to the queue; return its new length."""
        cdef Py_ssize_t first = 0, last = count, i, k
        cdef long layer
        for layer in range(layers):
            for i in range(first, last):
                for k in range(self.indptr[self.queue[i]], self.indptr[self.queue[i] + 1]):
                    if free[self.indices[k]] == 0:
                        free[self.indices[k]] = 1
                        self.queue[count] = self.indices[k]
                        count += 1
            first, last = last, count
            if first == last:
                break
        return count

    def solve(self, free, v):
        """Return s M⁻¹ v (n,) on the face with the mask `free` (n,), else zero."""
        result, face = np.empty(self.n), np.asarray(free, dtype=float)
        masked_v = _whole(np.where(free, v, 0.0))
        self.enter(address(face))
        self.inverse(address(masked_v), address(result))
        return result


cdef _integers(a):
    """Return an array of C ints; [0] for an empty array, which has no address."""
    return np.ascontiguousarray(a if len(a) else [0], dtype=np.int32)
