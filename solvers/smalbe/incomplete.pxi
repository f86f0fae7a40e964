# Incomplete Cholesky factors of the free part of a sparse P, and proportioning by them.


# Share of what a factor drops that goes to its diagonal. With all of it (1), a few pivots
# are small and CG slow where faces are irregular: torsion with n = 50 takes 45 products
# for 32. With none, bearings take twice as many.
cdef double KEEP = 0.95

# Least pivot, relative to the diagonal entry. Rounding of an entry is 2⁻⁵² of it, so that
# pivots above have six digits.
cdef double LEAST_PIVOT = 1e-10

# First shift of the diagonal where a pivot is too small with nothing added to it, and its
# growth until none is (Manteuffel 1980). A diagonally dominant matrix has good pivots.
cdef double FIRST_SHIFT = 1e-3
cdef double SHIFT_GROWTH = 4.0

cdef enum:
    # Least distance of a diagonal from the main one for which taking it off a run at once
    # is faster than going by columns.
    LEAST_OFFSET = 8


def scaled_by_diagonal(matrix, scale):
    """Return the entries of SPS, and what is known of its rows.

    That is the largest sum of absolute values of a row, and the least sums of rows of
    P and of SPS, where S² is the inverse of P's diagonal, relative to that.

    matrix : P in SciPy's csr format; scale : S (n,)
    """
    cdef list held = []
    cdef int[::1] indptr = _integers(matrix.indptr), indices = _integers(matrix.indices)
    cdef double told[3]
    entries = np.empty(len(matrix.data))
    scaled_matrix(&indptr[0], &indices[0], read(matrix.data, held), read(scale, held),
                  numbers(entries), len(scale), told)
    return entries, told[0], told[1], told[2]


@cython.final
cdef class IncompleteFactor:
    """M ≈ P_FF on the free set F, by an incomplete Cholesky factorisation.

    The pattern of L is that of P. Dropped entries are added to the diagonal times `keep`,
    KEEP or 0 (modified incomplete Cholesky, Gustafsson, BIT 18, 1978, 142-156); both are
    in Benzi's survey (J. Comput. Phys. 182, 2002, 418-477). On a tridiagonal matrix
    nothing is dropped, and M = P_FF. Where a pivot is below LEAST_PIVOT of the diagonal
    entry, `keep` becomes 0, and if that is not enough the diagonal is multiplied by
    1 + σ with a growing σ (Manteuffel, Math. Comp. 34, 1980, 473-497). So M is positive
    definite for every symmetric P with a positive diagonal, and never NaN. Both choices
    stay for all later faces.

    The factor is that of WPW with positive weights W: row sums are kept of that matrix,
    so W·1 should be a vector that P takes to zero in the inside of a domain.

    matrix : P in SciPy's csr or csc format, with sorted indices
    weights : W (n,)
    scale : S (n,); `inverse` is S M⁻¹ S
    keep : whether dropped entries go to the diagonal
    """

    cdef incomplete F
    cdef Py_ssize_t n, most
    cdef const int *indptr
    cdef const int *indices
    cdef list held
    cdef Room room
    cdef Room values
    cdef int *integers
    cdef double *face  # (n,) 1 where a component is free in the present factor
    cdef double *wanted  # (n,) a face that is being tried
    cdef int *queue  # (n,)
    cdef int *besides  # (idle,) components of the present factor that are not free
    cdef Py_ssize_t idle
    cdef bint is_ready
    cdef readonly double keep, shift
    cdef readonly long factorisations, solves

    def __init__(self, matrix, weights, scale, bint keep=True):
        cdef Py_ssize_t n = matrix.shape[0], i, k, m, entries = 0, pairs = 0, near, used
        cdef Py_ssize_t offset[16]  # MOST_DIAGONALS
        cdef Py_ssize_t count = 0
        cdef int first, last, middle, which
        self.n, self.held, self.keep = n, [], KEEP if keep else 0.0
        cdef int[::1] indptr = _integers(matrix.indptr)
        cdef int[::1] indices = _integers(matrix.indices)
        self.indptr, self.indices = &indptr[0], &indices[0]
        cdef const double *data = read(matrix.data, self.held)
        cdef const double *w = read(weights, self.held)
        # 1. The lower triangle by columns, as the upper one by rows of a symmetric P.
        for i in range(n):
            used = 0
            for k in range(indptr[i], indptr[i + 1]):
                used += indices[k] > i
            entries += used
            pairs += used * (used - 1) // 2
        self.integers = <int *> calloc(5 * n + 3 + 2 * entries + pairs, sizeof(int))
        if not self.integers:
            raise MemoryError
        cdef int *start = self.integers
        cdef int *row = start + n + 1
        cdef int *place = row + entries
        cdef int *target = place + entries
        self.F.from_ = target + pairs
        self.F.to, self.queue = self.F.from_ + n, self.F.from_ + 2 * n
        self.besides = self.F.from_ + 3 * n
        self.values = Room(2 * n + entries)
        cdef double *below = self.values.at
        cdef double *diagonal = below + entries
        entries = 0
        for i in range(n):
            for k in range(indptr[i], indptr[i + 1]):
                if indices[k] == i:
                    diagonal[i] = data[k] * w[i] * w[i]
                elif indices[k] > i:
                    row[entries], below[entries] = indices[k], data[k] * w[i] * w[indices[k]]
                    entries += 1
            start[i + 1] = <int> entries
        # 2. Its diagonals, if they are few and full.
        used = 0
        for i in range(n):
            for k in range(start[i], start[i + 1]):
                m = 0
                while m < count and offset[m] != row[k] - i:
                    m += 1
                if m == count:
                    if count == MOST_DIAGONALS:
                        count = -1
                        break
                    offset[count] = row[k] - i
                    count += 1
            if count < 0:
                break
        count = max(count, 0)
        offsets = np.array(sorted([offset[m] for m in range(count)]) or [0], dtype=np.intp)
        cdef Py_ssize_t[::1] distance = offsets
        near = 1 if count and distance[0] == 1 else 0
        if count * n > 2 * entries + n or count > near and distance[near] < LEAST_OFFSET:
            count = 0
        self.most = n
        if count:
            self.most = min(RUN, distance[near] if count > near else n)
        for i in range(n if count else 0):
            for k in range(start[i], start[i + 1]):
                m = 0
                while distance[m] != row[k] - i:
                    m += 1
                place[k] = <int> (m * n + i)
        # 3. Where the entries j > i of a column meet: the entry (j, i), if there is one.
        pairs = 0
        for i in range(n):
            for k in range(start[i], start[i + 1]):
                for m in range(k + 1, start[i + 1]):
                    which = row[m]
                    first, last = start[row[k]], start[row[k] + 1]
                    while first < last:
                        middle = (first + last) // 2
                        if row[middle] < which:
                            first = middle + 1
                        else:
                            last = middle
                    if first == start[row[k] + 1] or row[first] != which:
                        first = -1
                    target[pairs] = first
                    pairs += 1
        self.held += [indptr, indices, distance]
        self.room = Room(entries + (count + 5) * n)
        self.F.n, self.F.count, self.F.offset = n, count, &distance[0]
        self.F.start, self.F.row, self.F.place, self.F.target = start, row, place, target
        self.F.below, self.F.diagonal = below, diagonal
        self.F.scale, self.F.L = read(scale, self.held), self.room.at
        self.F.bands = self.F.L + entries
        self.F.pivot = self.F.bands + count * n
        self.F.inverse, self.F.y = self.F.pivot + n, self.F.pivot + 2 * n
        self.face, self.wanted = self.F.pivot + 3 * n, self.F.pivot + 4 * n

    def __dealloc__(self):
        give_back(self.integers)

    cdef int enter(self, const double *free, bint may_exceed=False) except -1:
        """Factorise on the face of the components where `free` (n,) is 1, unless the
        present factor M̃ is of this face, or contains it and `may_exceed` it.

        Then M⁻¹ is the part of M̃⁻¹ on the face, which is positive definite.
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
        while factorise_incompletely(
            &self.F, free, self.keep, self.shift, LEAST_PIVOT
        ) >= 0:
            if self.keep:
                self.keep = 0.0
            else:
                self.shift = fmax(FIRST_SHIFT, SHIFT_GROWTH * self.shift)
        return 0

    cdef double inverse(
        self, const double *v, const double *along, double *z
    ) noexcept:
        """z ← S M⁻¹ S v for v that vanishes off the face; returns zᵀ along."""
        cdef Py_ssize_t i
        cdef double sum_ = solve_incompletely(&self.F, v, along, z)
        self.solves += 1
        for i in range(self.idle):
            sum_ -= z[self.besides[i]] * along[self.besides[i]]
            z[self.besides[i]] = 0.0
        return sum_

    cdef Py_ssize_t widen(self, double *free, Py_ssize_t count, long layers) noexcept:
        """Add to `free` what is at most so many edges of P's graph from `queue` (count,);
        returns how many components these are."""
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
        """Return S M⁻¹ S v (n,) of the face where `free` (n,) is true, zero elsewhere."""
        result, face = np.empty(self.n), np.asarray(free, dtype=float)
        masked_v = _whole(np.where(free, v, 0.0))
        self.enter(numbers(face))
        self.inverse(numbers(masked_v), numbers(masked_v), numbers(result))
        return result


cdef _integers(a):
    """Return an array as one of C's int; one number where it has none, for an address."""
    return np.ascontiguousarray(a if len(a) else [0], dtype=np.int32)
