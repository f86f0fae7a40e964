# The stopping test of `solvers.common.stopping`, for bounds and equality rows.


cdef double ratio(double error, double size, double rounding=0.0) noexcept:
    """Return (|error| − rounding)⁺/size, where 0/0 = 0; inf if it is not a number."""
    error = fabs(error) - rounding
    if error <= 0:
        return 0.0
    return error / size if error / size < INFINITY else INFINITY


cdef double worst_ratio(
    const double *sums, double *most, double gap, double tol, double *scales
) noexcept:
    """Return the larger of the relative errors of stationarity and of the gap.

    scales : lower bounds of the scales of forces and energies; receives the scales

    sums, most : results of `terms_of_test`; on return, most[2] is the size of all
        scaled variables
    tol : the tolerance, 0 if P has no known diagonal
    """
    cdef double rounding = 8 * 2.0 ** -52, size = most[2], force = most[1], energy
    if force <= 1e-12 * size:
        force = size if tol > 0 else 1.0
    energy = fmax(fmax(fabs(sums[0]), fabs(sums[1])), tol * force * force)
    energy = energy if energy else force * size
    scales[0] = force = fmax(force, scales[0])
    scales[1] = energy = fmax(energy, scales[1])
    most[2] = fmax(size, tol * force)
    return fmax(
        ratio(most[0], force, fmin(rounding * size, tol * force)),
        ratio(gap, energy, fmin(rounding * sums[2], tol * energy)),
    )


cdef bint scales(double *d, Py_ssize_t n) noexcept:
    """d ← D⁻¹ᐟ² with D from the diagonal d of P; return False if d was zero."""
    cdef Py_ssize_t i
    cdef double usual
    cdef double[2] total
    total[0] = total[1] = 0.0
    for i in range(n):
        total[0] += d[i] if d[i] > 0 else 0.0
        total[1] += d[i] > 0
    usual = total[0] / total[1] if total[1] > 0 else 1.0
    for i in range(n):
        d[i] = 1 / sqrt(d[i] if d[i] > 1e-12 * usual else usual)
    return total[1] > 0


def relative_residuals(qp, s, double tol, Px, diagonal, G):
    """Return the errors of a point within its bounds; inf if one is not finite.

    The first is the larger of the errors of stationarity and of the gap, the second the
    largest error of the rows. The scales of forces and energies follow.

    s : a `Solution` without multipliers of inequality rows
    tol : see `solvers.common.stopping.relative_residual`
    diagonal : diagonal of P (n,), empty for an operator without a known diagonal
    G : the equality rows (m, n), an array or a sparse array
    """
    cdef Py_ssize_t i, j, n = len(qp.q), m = len(s.y)
    cdef int k
    cdef list owners = []
    cdef double[4] sums
    cdef double[3] most
    cdef double[2] sizes
    cdef double worst = 0.0, gradient, least
    cdef Room room = Room(2 * n + 3 * m)
    cdef double *w = room.at
    cdef double *r = w + n
    cdef double *missed = r + n
    cdef double *size = missed + m
    cdef double *terms = size + m
    cdef const double *x = read(s.x, owners)
    cdef const double *y = read(s.y, owners)
    cdef const double *z = read(s.z_box, owners)
    cdef const double *q = read(qp.q, owners)
    cdef const double *e = read(qp.b, owners)
    cdef const double *Fx = read(Px, owners)
    cdef const double *lb = read(qp.sets[0].lower, owners)
    cdef const double *ub = read(qp.sets[0].upper, owners)
    cdef const double *row
    cdef CompressedRows by_components  # Gᵀ
    if len(diagonal):
        memcpy(w, read(diagonal, owners), n * sizeof(double))
    if not scales(w, n):
        tol = 0.0
    # 1. Gᵀy, Gx, Σ|Gᵢⱼ|wⱼ and Σ|Gᵢⱼxⱼ|
    if isinstance(G, np.ndarray):
        row = read(G, owners)
        for i in range(m):
            missed[i] = dot(row, x, n)
            for j in range(n):
                size[i] += fabs(row[j]) * w[j]
                terms[i] += fabs(row[j] * x[j])
            add(y[i], row, r, n)
            row += n
    else:
        by_components = CompressedRows(csr_array(G.T))
        for i in range(n):
            for j in range(by_components.indptr[i], by_components.indptr[i + 1]):
                k = by_components.indices[j]
                missed[k] += by_components.data[j] * x[i]
                size[k] += fabs(by_components.data[j]) * w[i]
                terms[k] += fabs(by_components.data[j] * x[i])
                r[i] += by_components.data[j] * y[k]
    # 2. Stationarity and the gap
    sums[:] = [0.0, 0.0, 0.0, 0.0]
    most[:] = [0.0, 0.0, 0.0]
    sizes[:] = [0.0, 0.0]
    for i in range(n):
        r[i] += Fx[i] + q[i] + z[i]
        if z[i] != 0:
            sums[3] += (ub[i] if z[i] > 0 else lb[i]) * z[i]
    terms_of_test(x, Fx, q, r, w, n, sums, most)
    for i in range(m):
        sums[3] += e[i] * y[i]
    gradient = worst_ratio(sums, most, sums[0] + sums[1] + sums[3], tol, sizes)
    # 3. The rows
    for i in range(m):
        least = (1e-3 if e[i] else 0.1) * most[2] * size[i]
        worst = fmax(worst, ratio(missed[i] - e[i], fabs(e[i]) + fmax(terms[i], least)))
    return gradient, worst, sizes[0], sizes[1]
