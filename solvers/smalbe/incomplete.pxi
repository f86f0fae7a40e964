# Incomplete Cholesky factors of the free block of a sparse P.


# Fraction of each dropped entry that is added to the diagonal. With 1, a few pivots are
# small and CG is slow on irregular faces: torsion with n = 50 takes 45 products instead
# of 32. With 0, journal bearings take twice as many products.
cdef double KEEP = 0.95

# Smallest pivot, relative to the diagonal entry. The relative rounding error of entries
# is 2⁻⁵², so larger pivots have about six correct digits or more.
cdef double LEAST_PIVOT = 1e-10

# If a pivot is too small although no dropped entries are added to the diagonal, the
# diagonal is shifted (Manteuffel 1980). The first relative shift is FIRST_SHIFT, and it
# is multiplied by SHIFT_GROWTH until no pivot is too small. The pivots of a diagonally
# dominant matrix are large enough.
cdef double FIRST_SHIFT = 1e-3
cdef double SHIFT_GROWTH = 4.0

cdef enum:
    # Smallest distance of a diagonal from the main diagonal for which it is faster to
    # eliminate a run of columns at the same time than column by column.
    LEAST_OFFSET = 8


cdef inline bint is_later(Py_ssize_t i, Py_ssize_t j, Py_ssize_t half) noexcept nogil:
    """Return True if i comes after j in the order 0, …, half − 1, n − 1, …, half."""
    return i > j if j < half else half <= i < j


cdef inline Py_ssize_t distance(Py_ssize_t i, Py_ssize_t j) noexcept nogil:
    return i - j if i > j else j - i


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
    18, 1978, 142-156; see also Benzi's survey, J. Comput. Phys. 182, 2002, 418-477).
    For a tridiagonal matrix, no entry is dropped, and M = P_FF. If a pivot is below
    LEAST_PIVOT times the diagonal entry, `keep` is set to 0. If this is not sufficient,
    the diagonal is multiplied by 1 + σ with increasing σ (Manteuffel, Math. Comp. 34,
    1980, 473-497). M is therefore finite and positive definite for every symmetric P
    with a positive diagonal. The final values of `keep` and σ are used for all later
    faces.

    With `keep` = 1, the row sums of P would be preserved. Therefore P should map the
    vector of ones to zero in the interior of a domain.

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
    cdef Room values
    cdef int *integers
    cdef Py_ssize_t *first_pairs
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
        cdef Py_ssize_t n = matrix.shape[0], i, k, m, entries = 0, pairs = 0, near, used
        cdef Py_ssize_t offset[16]  # MAX_DIAGONALS
        cdef Py_ssize_t count = 0, half, reach = 0, far, column, other, stored
        cdef int first, last
        cdef bint by_bands
        self.n, self.owners, self.keep = n, [], KEEP if keep else 0.0
        cdef int[::1] indptr = _integers(matrix.indptr)
        cdef int[::1] indices = _integers(matrix.indices)
        self.indptr, self.indices = &indptr[0], &indices[0]
        cdef const double *data = read(matrix.data, self.owners)
        # 1. The order of elimination, and the distances of entries from the diagonal.
        for i in range(n):
            for k in range(indptr[i], indptr[i + 1]):
                far = distance(indices[k], i)
                reach = far if far > reach else reach
                m = 0
                while m < count and offset[m] != far:
                    m += 1
                if far and m == count:
                    if count == MAX_DIAGONALS:
                        count = n + 1  # too many diagonals
                    else:
                        offset[count] = far
                        count += 1
        half = n // 2 if n >= 4 * reach and n > 1 else n
        # 2. The total number of entries in later rows, and of pairs of these entries,
        # over all columns.
        for i in range(n):
            used = 0
            for k in range(indptr[i], indptr[i + 1]):
                used += is_later(indices[k], i, half)
            entries += used
            pairs += used * (used - 1) // 2
        offsets = np.array(sorted([offset[m] for m in range(count)]) if count <= n else [])
        near = 1 if len(offsets) and offsets[0] == 1 else 0
        count = len(offsets)
        if count * n > 2 * entries + n or count > near and offsets[near] < LEAST_OFFSET:
            count = 0
        by_bands = count > 0
        self.most = n
        if by_bands:
            self.most = min(RUN, offsets[near] if count > near else n)
            pairs, stored = 0, count * (n + reach)
        else:
            stored = entries
        cdef Py_ssize_t[::1] at_offset = np.array(offsets if by_bands else [0], dtype=np.intp)
        # 3. Memory.
        self.integers = <int *> calloc(
            5 * n + 3 + (0 if by_bands else entries) + pairs
            + MAX_DIAGONALS * MAX_DIAGONALS, sizeof(int)
        )
        self.first_pairs = <Py_ssize_t *> calloc(n + 1, sizeof(Py_ssize_t))
        if not self.integers or not self.first_pairs:
            raise MemoryError
        cdef int *start = self.integers
        cdef int *row = start + n + 1
        cdef int *target = row + (0 if by_bands else entries)
        cdef int *between = target + pairs
        self.F.from_ = between + MAX_DIAGONALS * MAX_DIAGONALS
        self.F.to, self.queue = self.F.from_ + n, self.F.from_ + 2 * n
        self.besides = self.F.from_ + 3 * n
        self.values, self.room = Room(n + stored), Room(stored + 5 * n + reach)
        cdef double *diagonal = self.values.at
        cdef double *below = diagonal + n
        # 4. The matrix.
        entries = 0
        for i in range(n):
            for k in range(indptr[i], indptr[i + 1]):
                if indices[k] == i:
                    diagonal[i] = data[k]
                elif is_later(indices[k], i, half):
                    if by_bands:
                        m = 0
                        while at_offset[m] != distance(indices[k], i):
                            m += 1
                        m = m * (n + reach) + i
                    else:
                        m, row[entries] = entries, indices[k]
                        entries += 1
                    below[m] = data[k]
            start[i + 1] = <int> entries
        # 5. The entry that couples two later rows of a column, if it exists. This entry
        # is stored in the column of the row that is eliminated first.
        for m in range(count):
            for k in range(count):
                between[m * MAX_DIAGONALS + k] = -1
                for i in range(count):
                    if at_offset[i] == distance(at_offset[m], at_offset[k]):
                        between[m * MAX_DIAGONALS + k] = <int> i
        pairs = 0
        for i in range(0 if by_bands else n):
            self.first_pairs[i] = pairs
            for k in range(start[i], start[i + 1]):
                for m in range(k + 1, start[i + 1]):
                    column, other = row[k], row[m]
                    if not is_later(other, column, half):
                        column, other = other, column
                    first, last = start[column], start[column + 1]
                    while first < last and row[first] < other:
                        first += 1
                    target[pairs] = -1
                    if first < last and row[first] == other:
                        target[pairs] = first
                    pairs += 1
        self.owners += [indptr, indices, at_offset]
        self.F.n, self.F.half, self.F.reach, self.F.count = n, half, reach, count
        self.F.width, self.F.offset, self.F.between = n + reach, &at_offset[0], between
        self.F.start, self.F.row, self.F.target = start, row, target
        self.F.pair, self.F.below, self.F.diagonal = self.first_pairs, below, diagonal
        self.scale = scale
        self.F.L = self.F.bands = self.room.at
        self.F.pivot = self.F.L + stored
        self.F.inverse = self.F.pivot + n + reach
        self.F.y, self.face = self.F.inverse + n, self.F.inverse + 2 * n
        self.wanted = self.F.inverse + 3 * n

    def __dealloc__(self):
        release_memory(self.integers)
        release_memory(self.first_pairs)

    cdef int enter(self, const double *free, bint may_exceed=False) except -1:
        """Factorise on the face with the mask `free` (n,) of free components.

        The present factor M̃ is reused if it belongs to this face. With `may_exceed`,
        it is also reused if it belongs to a larger free set; M⁻¹ is then the block of
        M̃⁻¹ on the face, which is positive definite.
        """
        cdef Py_ssize_t i
        cdef bint inside = self.is_ready
        self.idle = 0
        for i in range(self.n if inside else 0):
            if self.face[i] != free[i]:
                if free[i] != 0:
                    inside = False
                    break
                self.besides[self.idle] = <int> i
                self.idle += 1
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
