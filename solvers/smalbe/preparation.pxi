# What is done once: rows, the upper end of the spectrum, and the normalised problem.


def orthonormal(G, e):
    """Orthonormalise the rows of Gx = e, G (m, n), by a pivoted QR factorisation.

    Returns the fields of `DenseRows` but the last, and the factorisation that
    multipliers need: R (r, r), the rows kept (r,), their sizes (m,).
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
        rows_times(A, given + i * n, GC + i * r, r, n)
    return (
        (G, unit[:r], products, sqrt(square), least_pivot, x_tildes,
         mismatch <= 1e-8 * (most_x + most_e)),
        (triangle, pivots[:r], sizes),
    )


# Pivots of normalised rows below this are rounding: some hundred times 2⁻⁵³. With zero
# `test_a_repeated_row_must_ask_for_the_same` fails, with 1e-9
# `test_nearly_parallel_rows_are_independent`.
cdef double RANK = 1e-13


def multipliers(Py_ssize_t m, triangle, rows_kept, sizes, shares):
    """Return y (m,) with Gᵀy = Cᵀa (r,), from the QR factorisation of unit rows.

    triangle, rows_kept, sizes, shares : R (r, r), the rows kept (r,), their sizes (m,), a
    """
    cdef Py_ssize_t i, j, r = len(triangle)
    cdef double s
    result = np.zeros(m)
    cdef double *y = numbers(result)
    cdef const double *R = numbers(triangle)
    cdef const double *size = numbers(sizes)
    cdef const double *a = numbers(shares)
    cdef const int[::1] kept = rows_kept
    for i in range(r - 1, -1, -1):  # Rz = a, y = z/size
        s = a[i]
        for j in range(i + 1, r):
            s -= R[i * r + j] * y[kept[j]] * size[kept[j]]
        y[kept[i]] = s / (R[i * r + i] * size[kept[i]])
    return result


# Ratio of Ritz values of one size, seen after FEW steps: with κ = 10, CG halves its error
# in every step, and five more products would cost more than they save.
cdef double FLAT = 10.0

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


def lanczos(Product F, Rows C, start, int steps):
    """Find upper Ritz pairs of 𝒫F𝒫 from start (n,): the fields of `Ritz`.

    One product for each of the steps, of which there are no more than 𝒫 has a range;
    fully reorthogonalised. What three terms leave is of the size of the next vector, so
    that one pass over all vectors makes it orthogonal to them to rounding. The residual
    of the pair (θ, Vᵀs) is |β sₖ| with the last off-diagonal entry β. The process ends
    after FEW steps where all Ritz values are of one size: conjugate gradients need few
    steps there, and no model. Without vectors where the first pair is not found: then
    no model holds any.

    C : rows that span what 𝒫 leaves out
    """
    cdef Py_ssize_t i, k, n = F.n
    cdef int kept = 0, info = 0
    cdef Reduction over = F.over
    steps = min(steps, <long> over.total(n) - len(C.given.C))
    cdef Room room = Room((steps + 2) * n + C.r + (steps + 5) * steps)
    cdef double *basis = room.at
    cdef double *v = basis + steps * n
    cdef double *Fv = v + n
    cdef double *Cv = Fv + n
    cdef double *diagonal = Cv + C.r
    cdef double *off = diagonal + steps
    cdef double *share = off + steps
    cdef double *space = share + steps  # (2 steps,)
    cdef double *S = space + 2 * steps  # (kept, kept) by columns
    cdef double *value
    cdef double *residual
    cdef double *vector
    cdef double beta, largest = 0.0, at_start
    memcpy(v, numbers(start), n * sizeof(double))
    C.project(v, Cv)
    beta = sqrt(over.total(dot(v, v, n)))
    for k in range(steps if beta else 0):
        copy_scaled(1 / beta, v, basis + k * n, n)
        memcpy(Fv, basis + k * n, n * sizeof(double))
        C.project(Fv, Cv)
        F.apply(Fv, v)
        C.project(v, Cv)
        diagonal[k] = over.total(dot(basis + k * n, v, n))
        largest = fmax(largest, fabs(diagonal[k]))
        add(-diagonal[k], basis + k * n, v, n)
        if k:
            add(-beta, basis + (k - 1) * n, v, n)
        rows_times(basis, v, share, k + 1, n)
        over.add(share, k + 1)
        add_combination(-1.0, basis, share, v, k + 1, n)
        beta = sqrt(over.total(dot(v, v, n)))
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


# Residual over value of the first Ritz pair where the spectrum decays: after twelve steps
# it is 1e-12 and less on duals of contact, and 1e-2 on a Laplacian. With 1 or 1e-14,
# `test_compiled_and_written_steps_are_the_same` fails.
cdef double FOUND = 1e-3


def homogenised(Product F, Rows C, q, lb, ub, double norm):
    """Return b (n,) and the bounds of ν = x − x̃; one product, unless x̃ = 0."""
    cdef Py_ssize_t i, n = F.n
    cdef list held = []
    cdef Reduction over = F.over
    cdef Room room = Room(C.r)
    found = np.zeros((3, n))
    cdef const double *shift = C.x_tilde
    cdef const double *cost = read(q, held)
    cdef const double *low = read(lb, held)
    cdef const double *high = read(ub, held)
    cdef double *b = numbers(found)
    cdef double square[2]
    cdef bint moved = False
    square[:] = [0.0, 0.0]
    for i in range(n):
        b[n + i], b[2 * n + i] = low[i] - shift[i], high[i] - shift[i]
        moved = moved or shift[i] != 0
    if over.any(moved):
        F.apply(shift, b)
    for i in range(n):
        b[i] = -cost[i] - b[i]
        square[0] += b[i] * b[i]
    C.project(b, room.at)
    square[1] = dot(b, b, n)
    over.add(square, 2)
    if square[1] <= 1e-28 * square[0]:
        memset(b, 0, n * sizeof(double))  # nothing but rounding errors is left of d
    scale(1 / norm, b, n)
    bounds = over.vector(found[1]), over.vector(found[2])
    return over.vector(found[0]), bounds
