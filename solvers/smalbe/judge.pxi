# Upper bound on the KKT residuals of a QP with bounds only, computed without a product
# from the gradient of the scaled and normalised problem that MPRGP solves.


@cython.final
cdef class Judge:
    """Upper bound on the worst KKT residual of a QP at a point of its normalised form.

    With the scale d of the variables, x = y/d componentwise (exactly at a bound if y is
    at a bound), and the gradient g of the normalised form satisfies Px + q = ‖H‖ d g.
    The bound is computed from x and Px as in `residual_bound`.

    qp : the original QP
    scaled : the QP in y = d x
    root : d (n,); None if all components are 1
    diagonal : (n,) diagonal of the original P
    norm : ‖H‖, by which the scaled QP is divided
    """

    cdef Py_ssize_t n
    cdef double norm
    cdef const double *q
    cdef const double *lb
    cdef const double *ub
    cdef const double *low
    cdef const double *high
    cdef const double *root
    cdef const double *diagonal
    cdef double *x
    cdef double *Px
    cdef double *forces
    cdef double *size
    cdef double *z
    cdef Room room
    cdef list owners

    def __init__(self, qp, scaled, root, diagonal, double norm):
        cdef Py_ssize_t n = len(diagonal)
        self.n, self.norm, self.owners = n, norm, []
        box, scaled_box = qp.sets[0], scaled.sets[0]
        self.q, self.lb = read(qp.q, self.owners), read(box.lower, self.owners)
        self.ub = read(box.upper, self.owners)
        if root is not None:
            self.root = read(root, self.owners)
        self.low = read(scaled_box.lower, self.owners)
        self.high = read(scaled_box.upper, self.owners)
        self.diagonal, self.room = read(diagonal, self.owners), Room(5 * n)
        self.x = self.room.at
        self.Px, self.forces = self.x + n, self.x + 2 * n
        self.size, self.z = self.x + 3 * n, self.x + 4 * n

    cdef double residual(self, const double *y, const double *g) noexcept:
        """Return the bound at y (n,) with the gradient g (n,), or inf if unavailable."""
        cdef Py_ssize_t i, n = self.n
        cdef double sums[3]
        cdef double most[2]
        cdef double least, energy, worst, r, d, x, z
        for i in range(n):
            d = self.root[i] if self.root else 1.0
            r = self.norm * d * g[i]
            self.Px[i] = r - self.q[i]
            x = y[i] / d
            x = x if x > self.lb[i] else self.lb[i]
            x = x if x < self.ub[i] else self.ub[i]
            z = 0.0
            if y[i] >= self.high[i]:
                x, z = self.ub[i], -r if r < 0 else 0.0
            if y[i] <= self.low[i]:
                x = self.lb[i]
                z -= r if r > 0 else 0.0
            self.x[i], self.z[i] = x, z
        memcpy(self.forces, self.z, n * sizeof(double))
        least = terms_of_energy(self.q, self.diagonal, self.x, self.z, self.Px, self.lb,
                                self.ub, self.forces, self.size, n, sums, most)
        energy = scales.energy_scale(sums[0], sums[1], sums[2])
        if least < 0 or not energy > 0:
            return INFINITY
        worst = fmax(most[0], fabs(sums[0] + sums[1] + sums[2])) / energy
        worst = worst_of_forces(
            energy, fmax(most[1], sqrt(energy * least)), self.q, self.diagonal, self.x,
            self.Px, self.lb, self.ub, self.size, self.forces, n, worst
        )
        return worst if isfinite(worst) else INFINITY
