# Preparation: orthonormal rows, the upper end of the spectrum, the normalised problem.


def orthonormal(G, e):
    """Orthonormalise the rows of G (m, n) in Gx = e by a pivoted QR factorisation.

    The result consists of two tuples. The first contains the fields of `DenseRows`
    except `multipliers`. The second contains the data for the function `multipliers`: R
    (r, r), the indices of the independent rows (r,), and the norms of all rows (m,).
    """
    cdef Py_ssize_t i, j, m = G.shape[0], n = G.shape[1], w = min(m, n)
    cdef int rows = m, columns = n, info = 0, most = 64 * (m + n), r = 0
    cdef double mismatch = 0.0, most_x = 0.0, most_e = 0.0, square = 0.0, z, error
    cdef double least_pivot = 1.0
    sizes, x_tildes, unit = np.ones(m), np.zeros(n), np.empty((m, n))
    pivots = np.zeros(m, dtype=np.int32)
    cdef double *size = address(sizes)
    cdef double *x_tilde = address(x_tildes)
    cdef double *A = address(unit)  # A (m, n) by rows is (n, m) by columns
    cdef const double *given = address(G)
    cdef const double *right = address(e)
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
    R, GC = address(triangle), address(products)
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


# Pivots of normalised rows below this value, which is several hundred times 2⁻⁵³, count
# as rounding errors. With zero, `test_repeated_rows_need_equal_right_hand_sides` fails; with
# 1e-9, `test_nearly_parallel_rows_are_independent` fails.
cdef double RANK = 1e-13


def lanczos(Product F, Rows C, start, int steps):
    """Compute upper Ritz pairs of 𝒫F𝒫 from `start` (n,); return the fields of `Ritz`.

    The Lanczos process with full reorthogonalisation takes one product per step, and at
    most rank(𝒫) steps. After the three-term recurrence, the norm of the vector is
    already close to the next β, so one pass of reorthogonalisation suffices. The
    residual of the pair (θ, Vᵀs) is |β sₖ| with the last off-diagonal entry β. If the first pair has not converged, no vectors are
    returned, because no model would use them.

    C : rows that span the kernel of 𝒫
    """
    cdef Py_ssize_t i, k, n = F.n
    cdef int kept = 0, info = 0
    steps = min(steps, n - len(C.source.C))
    cdef Room room = Room((steps + 1) * n + C.r + (steps + 4) * steps)
    cdef double *basis = room.at
    cdef double *v = basis + steps * n
    cdef double *Cv = v + n
    cdef double *diagonal = Cv + C.r
    cdef double *off = diagonal + steps
    cdef double *share = off + steps
    cdef double *S = share + 2 * steps  # (kept, kept) by rows
    cdef double *value
    cdef double *residual
    cdef double *vector
    cdef double beta, largest = 0.0, at_start
    memcpy(v, address(start), n * sizeof(double))
    C.project(v, Cv)
    beta = sqrt(dot(v, v, n))
    for k in range(steps if beta else 0):
        copy_scaled(1 / beta, v, basis + k * n, n)
        F.apply(basis + k * n, v)
        C.project(v, Cv)
        diagonal[k] = dot(basis + k * n, v, n)
        largest = fmax(largest, fabs(diagonal[k]))
        add(-diagonal[k], basis + k * n, v, n)
        if k:
            add(-beta, basis + (k - 1) * n, v, n)
        rows_times(basis, v, share, k + 1, n)
        add_combination(-1.0, basis, share, v, k + 1, n)
        beta = sqrt(dot(v, v, n))
        off[k] = beta
        kept = k + 1
        if beta <= 1e-12 * largest:
            break
    if not kept:
        return zeros(1), zeros(1), np.zeros((1, n)), 0.0
    at_start = diagonal[0]
    beta = off[kept - 1]
    dstev(b"V", &kept, diagonal, off, S, &kept, share, &info)
    values, residuals = empty(kept), empty(kept)
    value, residual = address(values), address(residuals)
    for i in range(kept):  # descending values
        k = kept - 1 - i
        value[i] = diagonal[k]
        residual[i] = beta * fabs(S[k * kept + kept - 1])
    vectors = np.zeros((kept if residual[0] <= RITZ_RESIDUAL * value[0] else 0, n))
    vector = address(vectors)
    for i in range(len(vectors)):
        k = kept - 1 - i
        add_combination(1.0, basis, S + k * kept, vector + i * n, kept, n)
    return values, residuals, vectors, at_start


# Largest ratio of the residual of the first Ritz pair to its value at which the pair
# counts as converged. After twelve steps, it is at most 1e-12 on duals of contact
# problems, and 1e-2 on a Laplacian.
cdef double RITZ_RESIDUAL = 1e-3


# 𝒫F𝒫 counts as zero if its norm is at most this factor times the mean eigenvalue of F.
cdef double NORM_ROUNDING = 1e-13


def homogenised(Product F, Rows C, q, lb, ub, diagonal, double norm):
    """Return b (n,), the bounds of ν = x − x̃, and the norm; one product if x̃ ≠ 0.

    diagonal : diagonal of F (n,), empty if unknown
    norm : estimate of ‖𝒫F𝒫‖; if it is zero up to rounding, the mean eigenvalue of F is
        used and returned instead
    """
    cdef Py_ssize_t i, n = F.n, known = len(diagonal)
    cdef list owners = []
    cdef Room room = Room(C.r)
    result, lower, upper = zeros(n), empty(n), empty(n)
    cdef const double *shift = C.x_tilde
    cdef const double *cost = read(q, owners)
    cdef const double *low = read(lb, owners)
    cdef const double *high = read(ub, owners)
    cdef const double *d = read(diagonal, owners)
    cdef double *b = address(result)
    cdef double *l = address(lower)
    cdef double *u = address(upper)
    # ‖d − Fx̃‖², ‖𝒫(d − Fx̃)‖², trace of F, number of terms in the trace
    cdef double sums[4]
    cdef double mean
    cdef bint moved = False
    sums[0] = sums[2] = 0.0
    for i in range(n):
        l[i], u[i] = low[i] - shift[i], high[i] - shift[i]
        moved |= shift[i] != 0
    if moved:
        F.apply(shift, b)
    for i in range(n):
        b[i] = -cost[i] - b[i]
        sums[0] += b[i] * b[i]
    C.project(b, room.at)
    for i in range(known):
        sums[2] += d[i]
    sums[1], sums[3] = dot(b, b, n), known
    if sums[1] <= 1e-28 * sums[0]:
        memset(b, 0, n * sizeof(double))  # d − Fx̃ is in the range of Cᵀ up to rounding
    mean = sums[2] / fmax(sums[3], 1.0)
    if not norm > NORM_ROUNDING * mean:
        norm = mean or 1.0
    scale(1 / norm, b, n)
    return result, (lower, upper), norm
