# Upper bound on the KKT residuals of the original QP, computed without a product with
# P. Scales and errors are defined as in `harness.verify.kkt`, by
# `harness/verify/scales.h`.


def residual_bound(qp, s, Px, diagonal, G, Reduction over):
    """Return an upper bound on the worst of `harness.kkt_residuals`, without products.

    The bound uses the smallest energy scale that `kkt_residuals` may use, and
    attributes no part of a residual to rounding. A small bound therefore implies small
    residuals. The result is inf if the bound cannot be evaluated.

    s : a `Solution` without multipliers of inequality rows
    diagonal : diagonal of P (n,), empty for an operator without a known diagonal
    G : the equality rows, an array or an operator
    over : processes that share vectors (n,)
    """
    cdef Py_ssize_t i, n = len(diagonal), m = len(s.y)
    cdef bint is_dense = isinstance(G, np.ndarray)
    cdef CompressedRows by_components = None  # Gᵀ
    cdef list owners = []
    cdef double sums[3]
    cdef double most[2]
    cdef double least, energy, worst, size_of_all
    if not over.any(n > 0):
        return INFINITY
    cdef Room room = Room(3 * n + 3 * m)
    cdef double *forces = room.at
    cdef double *size = forces + n
    cdef double *own_size = size + n
    cdef double *missed = own_size + n
    cdef double *own = missed + m
    cdef double *known = own + m
    cdef const double *q = read(qp.q, owners)
    cdef const double *d = read(diagonal, owners)
    cdef const double *x = read(s.x, owners)
    cdef const double *y = read(s.y, owners)
    cdef const double *z = read(s.z_box, owners)
    cdef const double *Fx = read(Px, owners)
    box = qp.sets[0]
    cdef const double *lb = read(box.lower, owners)
    cdef const double *ub = read(box.upper, owners)
    cdef const double *e = read(qp.b, owners)
    # 1. The forces Gᵀy + z, and the energy.
    if is_dense:
        memcpy(forces, z, n * sizeof(double))
        add_combination(1.0, read(G, owners), y, forces, m, n)
    elif issparse(G):
        by_components = transposed_rows(G)
        by_components.combine(1.0, z, 1.0, y, forces)
    else:
        copy_result(G.T @ s.y, n, forces, "Gᵀy")
        add(1.0, z, forces, n)
    least = terms_of_energy(q, d, x, z, Fx, lb, ub, forces, size, n, sums, most)
    over.add(sums, 3)
    least = over.least(least)
    most[0], most[1] = -over.least(-most[0]), -over.least(-most[1])
    for i in range(m):
        sums[2] += e[i] * y[i]
    energy = scales.energy_scale(sums[0], sums[1], sums[2])
    if least < 0 or not energy > 0:
        return INFINITY
    # 2. Complementarity, the gap, and stationarity.
    worst = fmax(most[0], fabs(sums[0] + sums[1] + sums[2])) / energy
    size_of_all = most[1]
    if least < INFINITY:
        size_of_all = fmax(size_of_all, sqrt(energy * least))
    worst = -over.least(-worst_of_forces(
        energy, size_of_all, q, d, x, Fx, lb, ub, size, forces, n, worst
    ))
    if not m:
        return worst if isfinite(worst) else INFINITY
    # 3. The rows.
    sizes_of_variables(energy, q, d, x, Fx, size, own_size, n)
    if is_dense:
        terms_of_rows(read(G, owners), e, x, own_size, size, m, n, missed, own, known)
    elif by_components is not None:
        terms_of_sparse_rows(by_components, e, x, own_size, size, missed, own, known)
    else:
        copy_result(G @ s.x - qp.b, m, missed, "Gx − e")
        size_of_rows = abs(G)
        own_x, known_x = over.vector(view(own_size, n)), over.vector(view(size, n))
        copy_result(size_of_rows @ own_x, m, own, "own terms")
        copy_result(size_of_rows @ known_x, m, known, "known terms")
    for i in range(m):
        if not isfinite(missed[i]):
            return INFINITY
        worst = fmax(worst, scales.ratio(
            missed[i], scales.row_scale(fabs(e[i]), known[i], own[i])
        ))
    return worst if isfinite(worst) else INFINITY


cdef void terms_of_sparse_rows(
    CompressedRows G, const double *e, const double *x, const double *own_size,
    const double *size, double *missed, double *own, double *known
) noexcept:
    """Compute `terms_of_rows` from sparse Gᵀ (n, m); `own` and `known` are zeros."""
    cdef Py_ssize_t i
    cdef int j
    for i in range(G.k):
        missed[i] = -e[i]
    for i in range(G.n):
        for j in range(G.indptr[i], G.indptr[i + 1]):
            missed[G.indices[j]] += G.data[j] * x[i]
            own[G.indices[j]] += fabs(G.data[j]) * own_size[i]
            known[G.indices[j]] += fabs(G.data[j]) * size[i]
