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


def multipliers(Py_ssize_t m, triangle, rows_kept, sizes, shares):
    """Return y (m,) with Gᵀy = Cᵀa, from the QR factorisation of the normalised rows.

    triangle, rows_kept, sizes, shares : R (r, r), the indices of independent rows (r,),
        the norms of all rows (m,), and a (r,)
    """
    cdef Py_ssize_t i, j, r = len(triangle)
    cdef double s
    result = np.zeros(m)
    cdef double *y = address(result)
    cdef const double *R = address(triangle)
    cdef const double *size = address(sizes)
    cdef const double *a = address(shares)
    cdef const int[::1] kept = rows_kept
    for i in range(r - 1, -1, -1):  # Rz = a, y = z/size
        s = a[i]
        for j in range(i + 1, r):
            s -= R[i * r + j] * y[kept[j]] * size[kept[j]]
        y[kept[i]] = s / (R[i * r + i] * size[kept[i]])
    return result


cdef enum:
    # largest number of QR steps per eigenvalue; convergence is cubic, and two steps
    # usually suffice
    QR_STEPS = 30


cdef void diagonalise(double *diagonal, double *off, double *S, int k) noexcept nogil:
    """Compute the eigenpairs of a symmetric tridiagonal matrix (k, k), sorted.

    The algorithm takes QR steps with Wilkinson's shift (Golub and Van Loan, Matrix
    Computations, 4th ed., Algorithm 8.3.3). For k = 6, LAPACK's `dstev` takes 1.3 µs,
    which is twice as long as this function, and as long as four products with 73
    unknowns.

    diagonal : (k,) receives the eigenvalues
    off : (k − 1,) off-diagonal entries, overwritten
    S : (k, k) receives the eigenvectors by rows
    """
    cdef int first, last, i, j, step
    cdef double x, z, c, s, r, a, b, d, half, top, most = 0.0
    memset(S, 0, k * k * sizeof(double))
    for i in range(k):
        S[i * k + i] = 1.0
        most = fmax(most, fabs(diagonal[i]))
        most = fmax(most, fabs(off[i]) if i + 1 < k else 0.0)
    if not 0 < most < INFINITY:
        return
    for i in range(k):  # scale, so that squares neither overflow nor underflow
        diagonal[i] /= most
    for i in range(k - 1):
        off[i] /= most
    for last in range(k - 1, 0, -1):
        for step in range(QR_STEPS):
            first = last
            while first > 0 and fabs(off[first - 1]) > 2.0 ** -52 * (
                fabs(diagonal[first - 1]) + fabs(diagonal[first])
            ):
                first -= 1
            if first == last:
                break
            half, z = (diagonal[last - 1] - diagonal[last]) / 2, off[last - 1]
            r = sqrt(half * half + z * z)
            x = diagonal[first] - diagonal[last] + z * z / (half + (r if half > 0 else -r))
            z = off[first]
            for i in range(first, last):  # chase the entry outside the three diagonals
                r = sqrt(x * x + z * z)
                c, s = (x / r, z / r) if r > 0 else (1.0, 0.0)
                if i > first:
                    off[i - 1] = r
                a, b, d = diagonal[i], off[i], diagonal[i + 1]
                top = c * (c * a + s * b) + s * (c * b + s * d)
                diagonal[i], diagonal[i + 1] = top, a + d - top
                x = off[i] = c * (c * b + s * d) - s * (c * a + s * b)
                if i + 1 < last:
                    z = s * off[i + 1]
                    off[i + 1] *= c
                for j in range(k):
                    a = S[i * k + j]
                    S[i * k + j] = c * a + s * S[(i + 1) * k + j]
                    S[(i + 1) * k + j] = c * S[(i + 1) * k + j] - s * a
    for last in range(k - 1, 0, -1):
        i = last
        for j in range(last):
            i = j if diagonal[j] > diagonal[i] else i
        if i != last:
            diagonal[i], diagonal[last] = diagonal[last], diagonal[i]
            for j in range(k):
                a = S[i * k + j]
                S[i * k + j], S[last * k + j] = S[last * k + j], a
    for i in range(k):
        diagonal[i] *= most


def eigenpairs(diagonal, off):
    """Return ascending eigenvalues (k,) and eigenvectors (k, k), as rows, of a matrix.

    diagonal, off : (k,) and (k − 1,) entries of a symmetric tridiagonal matrix
    """
    k = len(diagonal)
    values, rest = np.array(diagonal, dtype=float), np.array([*off, 0.0])
    vectors = matrix(k, k)
    diagonalise(address(values), address(rest), address(vectors), k)
    return values, vectors


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
    cdef int kept = 0
    steps = min(steps, n - len(C.source.C))
    cdef Room room = Room((steps + 2) * n + C.r + (steps + 3) * steps)
    cdef double *basis = room.at
    cdef double *v = basis + steps * n
    cdef double *Fv = v + n
    cdef double *Cv = Fv + n
    cdef double *diagonal = Cv + C.r
    cdef double *off = diagonal + steps
    cdef double *share = off + steps
    cdef double *S = share + steps  # (kept, kept) by rows
    cdef double *value
    cdef double *residual
    cdef double *vector
    cdef double beta, largest = 0.0, at_start
    memcpy(v, address(start), n * sizeof(double))
    C.project(v, Cv)
    beta = sqrt(dot(v, v, n))
    for k in range(steps if beta else 0):
        copy_scaled(1 / beta, v, basis + k * n, n)
        if C.exist:
            memcpy(Fv, basis + k * n, n * sizeof(double))
            C.project(Fv, Cv)
            F.apply(Fv, v)
            C.project(v, Cv)
        else:
            F.apply(basis + k * n, v)
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
    diagonalise(diagonal, off, S, kept)
    values, residuals = empty(kept), empty(kept)
    value, residual = address(values), address(residuals)
    for i in range(kept):  # descending values
        k = kept - 1 - i
        value[i] = diagonal[k]
        residual[i] = beta * fabs(S[k * kept + kept - 1])
    vectors = matrix(kept if residual[0] <= RITZ_RESIDUAL * value[0] else 0, n)
    vector = address(vectors)
    for i in range(len(vectors)):
        k = kept - 1 - i
        add_combination(1.0, basis, S + k * kept, vector + i * n, kept, n)
    return values, residuals, vectors, at_start


# Largest ratio of the residual of the first Ritz pair to its value at which the pair
# counts as converged. After twelve steps, the relative residual is at most 1e-12 on
# duals of contact problems, and 1e-2 on a Laplacian. With 1 or 1e-14,
# `test_compiled_steps_and_textbook_steps_are_the_same` fails.
cdef double RITZ_RESIDUAL = 1e-3


# 𝒫F𝒫 counts as zero if its norm is at most this factor, which is several hundred times
# 2⁻⁵³, times the mean eigenvalue of F.
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
