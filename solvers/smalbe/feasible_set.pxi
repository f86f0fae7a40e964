# The feasible set, on whose type the loop of MPRGP does not depend.


# Relative rounding of the distance from the centre of a disc, after sixteen operations.
# With zero, a disc whose variables a step moved to the boundary would count as free.
cdef double DISC_ROUNDING = 16 * 2.0 ** -52


cdef struct Line:
    double cg  # α that minimises the cost along x − αp; inf if pᵀHp ≤ 0
    double feasible  # largest feasible α; may be inf if this α is not below `cg`
    double slope  # gᵀp
    double curvature  # pᵀHp


cdef struct Parts:
    double phi_square  # ‖φ‖²; φ, the free gradient, is g off the boundary
    # ‖β‖²; β, the chopped gradient, is the part of g on the boundary for which −β is a
    # feasible direction
    double beta_square
    double reduced_square  # φ̃ᵀφ; φ̃ is φ, reduced such that x − φ̃/τ is feasible


@cython.final
cdef class FeasibleSet:
    """The box l ≤ x ≤ u, and discs ‖x_I + c_I‖ ≤ r over variables without bounds.

    A disc is active, with all its variables, if the distance of x to its boundary is at
    most `slack`. There, β = g, but if nᵀg < 0 with the outward normal n, the normal
    component is subtracted. On a disc of radius zero, φ = β = 0.
    """

    cdef Py_ssize_t n, n_discs
    # bounds; NaN for variables of discs, which no comparison in a loop over bounds
    # therefore counts as free or active
    cdef const double *lower
    cdef const double *upper
    cdef const int *start  # (n_discs + 1,) first entry of each disc in `index`
    cdef const int *index  # variables of the discs
    cdef const double *radius
    cdef double *slack  # (n_discs,) rounding error of ‖x_I + c_I‖
    cdef const double *shift  # (n,) c, zeros if there are no equality rows
    cdef bint has_discs
    cdef object arrays  # keeps the memory of the discs

    @staticmethod
    cdef FeasibleSet of(const double *lower, const double *upper, Py_ssize_t n):
        cdef FeasibleSet new = FeasibleSet.__new__(FeasibleSet)
        new.n, new.lower, new.upper = n, lower, upper
        return new

    cdef int add_discs(self, sets, const double *shift) except -1:
        """Add discs ‖x_I + shift_I‖ ≤ r.

        sets : at least one `harness.sets.discs.Discs`
        shift : (n,)
        """
        cdef Py_ssize_t i
        cdef list owners = []
        sizes = [np.full(len(one.radius), one.index.shape[1]) for one in sets]
        starts = _integers(np.cumsum(np.concatenate([[0], *sizes])))
        indices = _integers(np.concatenate([one.index.ravel() for one in sets]))
        lower, upper = copied(self.lower, self.n), copied(self.upper, self.n)
        for one in sets:
            lower[one.index] = upper[one.index] = np.nan
        self.n_discs, self.has_discs, self.shift = len(starts) - 1, True, shift
        slack = empty(self.n_discs)
        self.start = <const int *> cnp.PyArray_DATA(starts)
        self.index = <const int *> cnp.PyArray_DATA(indices)
        self.radius = read(np.concatenate([one.radius for one in sets]), owners)
        self.slack, self.lower, self.upper = address(slack), address(lower), address(upper)
        self.arrays = starts, indices, slack, lower, upper, owners
        origin = zeros(self.n)
        for i in range(self.n_discs):
            self.slack[i] = DISC_ROUNDING * (
                self.radius[i] + sqrt(self.square_of_disc(i, address(origin)))
            )
        return 0

    cdef void project(
        self, const double *x, double alpha, const double *p, double *y
    ) noexcept:
        """y ← Π(x − αp), with the projection Π onto the set."""
        cdef Py_ssize_t i
        cdef double square
        projected(x, alpha, p, self.lower, self.upper, y, self.n)
        for i in range(self.n_discs):
            square = self.square_of_disc(i, y)
            if square > self.radius[i] * self.radius[i]:
                self.scale_disc(i, self.radius[i] / sqrt(square), y)

    cdef void minimise(
        self, const double *x, const double *g, double tau, double *s
    ) noexcept:
        """s ← argmin of gᵀs + τ/2‖s‖² over all s with x + s in the set."""
        self.project(x, 1 / tau, g, s)
        add(-1.0, x, s, self.n)

    cdef void lengths(self, const double *x, const double *g, const double *p,
                      const double *Hp, Line *line) noexcept:
        """Compute the step lengths along x − αp."""
        line.slope, line.curvature = dot(g, p, self.n), dot(p, Hp, self.n)
        line.cg = line.slope / line.curvature if line.curvature > 0 else INFINITY
        line.feasible = self.feasible_length(x, p, line.cg)
        if line.feasible >= line.cg:
            line.feasible = INFINITY

    cdef double feasible_length(
        self, const double *x, const double *p, double least
    ) noexcept:
        """Return the largest α for which x − αp is in the set, at most `least`."""
        cdef Py_ssize_t i, j, k
        cdef double a, b, c, r, root
        least = first_bound(x, p, self.lower, self.upper, least, self.n)
        for i in range(self.n_discs):
            a, b, c, r = 0.0, 0.0, self.square_of_disc(i, x), self.radius[i]
            for k in range(self.start[i], self.start[i + 1]):
                j = self.index[k]
                a += p[j] * p[j]
                b += (x[j] + self.shift[j]) * p[j]
            # a α² − 2bα + c − r² ≤ 0 in the disc: convex, and true at α = 0
            if a == 0 or (least < INFINITY and (a * least - 2 * b) * least + c < r * r):
                continue
            c = fmin((sqrt(c) - r) * (sqrt(c) + r), 0.0)  # without cancellation
            root = sqrt(b * b - a * c)
            least = fmin(least, (b + root) / a if b >= 0 else -c / (root - b))
        return least

    cdef void split(self, const double *x, const double *g, double tau, double *phi,
                    double *free, Parts *parts) noexcept:
        """Compute φ and `free` (1 off the boundary, else 0) for the face of x."""
        split(x, g, self.lower, self.upper, tau, phi, free, self.n, &parts.phi_square)
        self.split_discs(x, g, tau, phi, free, parts)

    cdef void split_discs(self, const double *x, const double *g, double tau,
                          double *phi, double *free, Parts *parts) noexcept:
        """Write φ and `free` on discs, and add their `parts`."""
        cdef Py_ssize_t i, j, k
        cdef double square, factor, u, b, cut, inward, r
        for i in range(self.n_discs):
            square, r = self.square_of_disc(i, x), self.radius[i]
            if self.is_inside(i, square):
                factor = 0.0
                for k in range(self.start[i], self.start[i + 1]):
                    j = self.index[k]
                    u = x[j] + self.shift[j] - g[j] / tau
                    factor += u * u
                factor = r / sqrt(factor) if factor > r * r else 1.0
                for k in range(self.start[i], self.start[i + 1]):
                    j = self.index[k]
                    u = x[j] + self.shift[j]
                    cut = g[j]
                    if factor < 1:
                        cut = tau * u - factor * (tau * u - g[j])
                    parts.phi_square += g[j] * g[j]
                    parts.reduced_square += cut * g[j]
                    phi[j], free[j] = g[j], 1.0
                continue
            inward = self.inward_share(i, x, g, square)
            for k in range(self.start[i], self.start[i + 1]):
                j = self.index[k]
                # a difference of squares would suffer from cancellation
                b = g[j] - inward * (x[j] + self.shift[j]) if r > 0 else 0.0
                parts.beta_square += b * b
                phi[j] = free[j] = 0.0

    cdef void advance(self, double alpha, double *x, double *g, const double *p,
                      const double *Hp, double tau, double *phi, double *free,
                      Parts *parts) noexcept:
        """x ← x − αp, g ← g − αHp, and `split`.

        Components within rounding of the boundary are moved to the boundary. Otherwise,
        rounding could prevent a step of the largest feasible length from reaching it.
        """
        cdef Py_ssize_t i
        cdef double near, square
        advance(alpha, x, g, p, Hp, self.lower, self.upper, tau, phi, free, self.n,
                &parts.phi_square)
        for i in range(self.n_discs):
            square, near = self.square_of_disc(i, x), self.radius[i] - 4 * self.slack[i]
            if (near < 0 or square > near * near) and square > 0:
                self.scale_disc(i, self.radius[i] / sqrt(square), x)
        self.split_discs(x, g, tau, phi, free, parts)

    cdef void project_gradient(
        self, const double *x, const double *g, double *gP
    ) noexcept:
        """gP ← φ + β."""
        cdef Py_ssize_t i, j, k
        cdef double square, inward
        projected_gradient(x, g, self.lower, self.upper, gP, self.n)
        for i in range(self.n_discs):
            square = self.square_of_disc(i, x)
            if self.is_inside(i, square):
                continue
            inward = self.inward_share(i, x, g, square)
            for k in range(self.start[i], self.start[i + 1]):
                j = self.index[k]
                gP[j] -= inward * (x[j] + self.shift[j])
                if self.radius[i] == 0:
                    gP[j] = 0.0

    cdef void follow(
        self, const double *x, const double *g, const double *v, double *w
    ) noexcept:
        """w ← T(w + κv), where T projects onto the tangents of the boundary at x.

        Bounds that x attains remain active. A disc also remains active if −g points
        outwards from its boundary at x. The multiplier κ = −nᵀg/‖x + c‖ of the
        constraint ½(‖x + c‖² − r²) ≤ 0 adds the curvature of the boundary to the
        curvature of the cost. On discs of radius zero, w = 0.

        v : NULL for zero
        """
        cdef Py_ssize_t i, j, k
        cdef double square, share, along
        for i in range(self.n):
            if x[i] <= self.lower[i] or x[i] >= self.upper[i]:
                w[i] = 0.0
        for i in range(self.n_discs):
            square, along = self.square_of_disc(i, x), 0.0
            if self.is_inside(i, square):
                continue
            share = self.inward_share(i, x, g, square)
            if share < 0:
                for k in range(self.start[i], self.start[i + 1]):
                    j = self.index[k]
                    along += (x[j] + self.shift[j]) * w[j] / square
            for k in range(self.start[i], self.start[i + 1]):
                j = self.index[k]
                w[j] -= along * (x[j] + self.shift[j])
                if v:
                    w[j] -= share * v[j]
                if self.radius[i] == 0:
                    w[j] = 0.0

    # one disc

    cdef inline double square_of_disc(self, Py_ssize_t i, const double *x) noexcept:
        """Return ‖x + c‖² on disc i."""
        cdef Py_ssize_t k
        cdef double u, square = 0.0
        for k in range(self.start[i], self.start[i + 1]):
            u = x[self.index[k]] + self.shift[self.index[k]]
            square += u * u
        return square

    cdef inline bint is_inside(self, Py_ssize_t i, double square) noexcept:
        """Return True unless the disc is active; `square` = ‖x + c‖²."""
        cdef double r = self.radius[i] - self.slack[i]
        return r > 0 and square < r * r

    cdef inline void scale_disc(
        self, Py_ssize_t i, double factor, double *x
    ) noexcept:
        """Multiply x + c by `factor` on disc i."""
        cdef Py_ssize_t j, k
        for k in range(self.start[i], self.start[i + 1]):
            j = self.index[k]
            x[j] = factor * (x[j] + self.shift[j]) - self.shift[j]

    cdef inline double inward_share(
        self, Py_ssize_t i, const double *x, const double *g, double square
    ) noexcept:
        """Return nᵀg/‖x + c‖ for x on the boundary of disc i if nᵀg < 0, else 0."""
        cdef Py_ssize_t k
        cdef double push = 0.0
        for k in range(self.start[i], self.start[i + 1]):
            push += (x[self.index[k]] + self.shift[self.index[k]]) * g[self.index[k]]
        return push / square if push < 0 and self.radius[i] > 0 else 0.0
