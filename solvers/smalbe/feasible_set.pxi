# The feasible set and all its operations that MPRGP uses. The loop of MPRGP does not
# depend on the type of the set.


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
    double phi_Hp  # φᵀHp after a step along p


@cython.final
cdef class FeasibleSet:
    """The box l ≤ x ≤ u, and discs over variables without bounds.

    Each operation passes over the vectors once and computes all sums that a step needs,
    because separate operations would read each vector several times per CG step. Either
    all variables of a disc are free, or all of them are active (discs.h).
    """

    cdef Py_ssize_t n
    cdef const double *lower
    cdef const double *upper
    cdef const double *upper_if_any  # NULL if all upper bounds are inf
    cdef discs D  # the count may be zero
    cdef bint has_discs
    cdef object arrays  # keeps the memory that D points to

    @staticmethod
    cdef FeasibleSet of(const double *lower, const double *upper, Py_ssize_t n):
        cdef FeasibleSet new = FeasibleSet.__new__(FeasibleSet)
        cdef Py_ssize_t i
        new.n, new.lower, new.upper = n, lower, upper
        for i in range(n):
            if upper[i] < INFINITY:
                new.upper_if_any = upper
                break
        return new

    cdef int add_discs(self, sets, const double *shift) except -1:
        """Add discs ‖x_I + shift_I‖ ≤ r.

        sets : at least one `harness.sets.discs.Discs`
        shift : (n,), NULL for zero
        """
        cdef const int[::1] start, index
        cdef const double[::1] radius
        cdef double[::1] slack
        cdef Py_ssize_t[::1] ranges
        cdef Py_ssize_t i
        cdef double square
        sizes = np.concatenate([
            np.full(len(one.radius), one.index.shape[1]) for one in sets
        ])
        starts = np.concatenate([[0], np.cumsum(sizes)])
        start = starts.astype(np.int32)
        indices = np.concatenate([one.index.ravel() for one in sets])
        index = indices.astype(np.int32)
        radius = np.concatenate([np.asarray(one.radius) for one in sets])
        slack = np.empty(len(sizes))
        is_off = np.ones(self.n + 2, dtype=bool)
        is_off[indices + 1] = is_off[0] = is_off[self.n + 1] = False
        ranges = np.flatnonzero(np.diff(is_off)).astype(np.intp)
        self.arrays = start, index, radius, slack, ranges
        self.has_discs = True
        self.D.count, self.D.ranges = len(sizes), ranges.size // 2
        self.D.start, self.D.index, self.D.radius = &start[0], &index[0], &radius[0]
        self.D.slack, self.D.centre = &slack[0], shift
        self.D.dim = sizes[0] if len(sizes) and (sizes == sizes[0]).all() else 0
        if ranges.size:
            self.D.range = &ranges[0]
        for i in range(self.D.count):
            square = 0.0
            if shift:
                for k in index[start[i]:start[i + 1]]:
                    square += shift[k] * shift[k]
            slack[i] = DISC_ROUNDING * (radius[i] + sqrt(square))
        return 0

    cdef bint has_bound(self, Py_ssize_t i) noexcept:
        return self.lower[i] > -INFINITY or self.upper[i] < INFINITY

    cdef void project(
        self, const double *x, double alpha, const double *p, double *y
    ) noexcept:
        """y ← Π(x − αp), with the projection Π onto the set."""
        cdef Py_ssize_t i
        for i in range(self.n):
            y[i] = fmin(fmax(x[i] - alpha * p[i], self.lower[i]), self.upper[i])
        if self.D.count:
            project_discs(&self.D, y)

    cdef void lengths(self, const double *x, const double *g, const double *p,
                      const double *Hp, Line *line) noexcept:
        """Compute the step lengths along x − αp."""
        if not self.has_discs:
            lengths(x, g, p, Hp, self.lower, self.upper_if_any, self.n, &line.cg)
            return
        line.slope, line.curvature = dot(g, p, self.n), dot(p, Hp, self.n)
        line.feasible = self.feasible_length(x, p)
        line.cg = line.slope / line.curvature if line.curvature > 0 else INFINITY

    cdef double feasible_length(self, const double *x, const double *p) noexcept:
        """Return the largest α for which x − αp is in the set."""
        cdef double least = INFINITY
        cdef Py_ssize_t i, o, size
        if not self.has_discs:
            return first_bound(x, p, self.lower, self.upper_if_any, self.n)
        for i in range(self.D.ranges):
            o, size = self.D.range[2 * i], self.D.range[2 * i + 1] - self.D.range[2 * i]
            least = fmin(least, first_bound(x + o, p + o, self.lower + o,
                                            self.upper + o, size))
        return first_disc(&self.D, x, p, least)

    cdef void split(self, const double *x, const double *g, double tau, double *phi,
                    double *free, Parts *parts) noexcept:
        """Compute φ and `free` (1 off the boundary, else 0) for the face of x."""
        cdef Py_ssize_t i, o, size
        cdef double sums[3]
        if self.has_discs:
            parts.phi_square = parts.beta_square = parts.reduced_square = 0.0
            for i in range(self.D.ranges):
                o, size = self.D.range[2 * i], self.D.range[2 * i + 1] - self.D.range[2 * i]
                split(x + o, g + o, self.lower + o, self.upper + o, tau, phi + o,
                      free + o, size, sums)
                parts.phi_square += sums[0]
                parts.beta_square += sums[1]
                parts.reduced_square += sums[2]
            split_discs(&self.D, x, g, tau, phi, free, &parts.phi_square)
            return
        split(x, g, self.lower, self.upper, tau, phi, free, self.n, &parts.phi_square)

    cdef void advance(self, double alpha, double *x, double *g, const double *p,
                      const double *Hp, double tau, double *phi, double *free,
                      Parts *parts) noexcept:
        """x ← x − αp, g ← g − αHp, and `split`.

        Components within rounding of a bound are set to the bound. Otherwise, rounding
        could prevent a step of the largest feasible length from reaching the face.

        phi, free : NULL if they are not stored
        """
        cdef Py_ssize_t i, o, size
        cdef double sums[4]
        if self.has_discs:
            parts.phi_square = parts.beta_square = parts.reduced_square = 0.0
            parts.phi_Hp = 0.0
            for i in range(self.D.ranges):
                o, size = self.D.range[2 * i], self.D.range[2 * i + 1] - self.D.range[2 * i]
                advance(alpha, x + o, g + o, p + o, Hp + o, self.lower + o,
                        self.upper + o, tau, phi + o if phi else NULL,
                        free + o if free else NULL, size, sums)
                parts.phi_square += sums[0]
                parts.beta_square += sums[1]
                parts.reduced_square += sums[2]
                parts.phi_Hp += sums[3]
            advance_discs(&self.D, alpha, x, g, p, Hp, tau, phi, free, &parts.phi_square)
            return
        advance(alpha, x, g, p, Hp, self.lower, self.upper_if_any, tau, phi, free,
                self.n, &parts.phi_square)

    cdef void chop(self, const double *x, const double *g, double *beta) noexcept:
        """beta ← β, the part of g on the boundary with a feasible direction −β."""
        cdef Py_ssize_t i
        for i in range(self.n):
            beta[i] = 0.0
            if not self.lower[i] < x[i] < self.upper[i] and (
                (g[i] < 0 and x[i] < self.upper[i])
                or (g[i] > 0 and x[i] > self.lower[i])
            ):
                beta[i] = g[i]
        if self.D.count:
            chop_discs(&self.D, x, g, beta)

    cdef void project_gradient(
        self, const double *x, const double *g, double *gP
    ) noexcept:
        """gP ← φ + β."""
        cdef Py_ssize_t i
        for i in range(self.n):
            gP[i] = g[i]
            if x[i] <= self.lower[i] and g[i] > 0:
                gP[i] = 0.0
            if x[i] >= self.upper[i] and g[i] < 0:
                gP[i] = 0.0
        if self.D.count:
            project_gradient_on_discs(&self.D, x, gP)

    cdef bint marks(self, const double *x, double *free) noexcept:
        """free ← 1 off the boundary, else 0; return True if any entry changed."""
        cdef Py_ssize_t i, j, first, last
        cdef double inside
        cdef bint changed = False
        for i in range(self.D.ranges if self.has_discs else 1):
            first, last = 0, self.n
            if self.has_discs:
                first, last = self.D.range[2 * i], self.D.range[2 * i + 1]
            for j in range(first, last):
                if self.has_bound(j):
                    inside = self.lower[j] < x[j] < self.upper[j]
                    changed = changed or free[j] != inside
                    free[j] = inside
        return mark_discs(&self.D, x, free) or changed

    cdef void follow(
        self, const double *x, const double *g, const double *v, double *w
    ) noexcept:
        """w ← T(w + κv), where T projects onto the tangents of the boundary at x.

        Bounds that x attains remain active. A disc also remains active if −g points
        outwards from its boundary at x. The multiplier κ of this disc adds curvature to
        the cost along the boundary (discs.h).

        v : NULL for zero
        """
        cdef Py_ssize_t i
        for i in range(self.n):
            if not self.lower[i] < x[i] < self.upper[i]:
                w[i] = 0.0
        tangential_discs(&self.D, x, g, v, w)

    cdef void project_free(
        self, const double *x, const double *g, double tau, double *y
    ) noexcept:
        """y ← Π(x − φ/τ), which equals x − φ̃/τ."""
        cdef Py_ssize_t i
        projected(x, g, tau, self.lower, self.upper, y, self.n)
        if self.D.count:
            self.step_on_discs(x, g, tau, True, y)
            for i in range(self.D.start[self.D.count]):
                y[self.D.index[i]] += x[self.D.index[i]]

    cdef void step_on_discs(
        self, const double *x, const double *g, double tau, bint free_only, double *s
    ) noexcept:
        """s ← Π(x − g/τ) − x on discs."""
        cdef double sums[2]
        cdef Py_ssize_t i
        step_on_discs(&self.D, x, g, 1 / tau, free_only, s, sums)
        for i in range(self.D.start[self.D.count]):
            s[self.D.index[i]] *= -1

    cdef double step_back(self, const double *x, const double *g, double tau, double *s,
                          double *square) noexcept:
        """s ← x − Π(x − g/τ), square ← ‖s‖²; return gᵀs."""
        cdef double sums[2]
        cdef Py_ssize_t i, j, first, last
        sums[:] = [0.0, 0.0]
        for i in range(self.D.ranges if self.has_discs else 1):
            first, last = 0, self.n
            if self.has_discs:
                first, last = self.D.range[2 * i], self.D.range[2 * i + 1]
            for j in range(first, last):
                s[j] = x[j] - fmin(fmax(x[j] - g[j] / tau, self.lower[j]), self.upper[j])
                sums[0] += g[j] * s[j]
                sums[1] += s[j] * s[j]
        if self.D.count:
            step_on_discs(&self.D, x, g, 1 / tau, False, s, sums)
        square[0] = sums[1]
        return sums[0]

    cdef void minimise(self, const double *x, const double *g, double tau, double *s,
                       double *piece) noexcept:
        """s ← argmin of gᵀs + τ/2‖s‖² over all s with x + s in the set.

        piece : receives −1 for components at the lower bound, 1 at the upper bound,
            else 0; may be NULL
        """
        model_minimiser(x, g, tau, self.lower, self.upper, s, piece, self.n)
        if self.D.count:
            self.step_on_discs(x, g, tau, False, s)

    cdef void minimise_part(
        self, Py_ssize_t first, Py_ssize_t size, const double *x, const double *g_part,
        double tau, double *s, double *piece
    ) noexcept:
        """Apply `minimise` to a range of components; g_part and piece have its size."""
        model_minimiser(x + first, g_part, tau, self.lower + first, self.upper + first, s + first,
               piece, size)

    cdef void leave_box(self, double alpha, double beta, bint release, double *x, double *g,
                    const double *p, const double *Hp, double *x0, double *g0,
                    double *free, FeasibleSet face, double *z, double *z_g) noexcept:
        """Step to the boundary, x ← x − αp; save the old state in x₀, g₀, `free`.

        face : receives the set for the next step, in which components on the boundary
            are fixed unless `release` is true
        z, z_g : receive the point x − βp outside the set, with the new x, and the
            gradient at this point
        """
        leave_box(alpha, beta, release, x, g, p, Hp, self.lower, self.upper, x0, g0, free,
              <double *> face.lower, <double *> face.upper, z, z_g, self.n)

    cdef double minimise_near(
        self, const double *z, const double *z_g, double tau, const double *x,
        const double *g, double *s
    ) noexcept:
        """s ← z + r − x, where r is the result of `minimise` at z; return gᵀs."""
        return model_minimiser_within(
            z, z_g, tau, x, g, self.lower, self.upper, s, self.n
        )

    cdef double within(self, const double *z, const double *x, const double *g,
                       bint release, double *s) noexcept:
        """s ← z + s − x, with x + s set to a bound within rounding of it; return gᵀs.

        s is zero for components that the set fixes, unless `release` is true.
        """
        return within(z, x, g, self.lower, self.upper, release, s, self.n)
