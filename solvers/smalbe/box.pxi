# The feasible set and every operation on it that MPRGP uses. The loop itself contains no
# bounds, so that another set (discs of friction) only has to extend these operations.


cdef struct Line:
    double cg  # α that minimises the cost at x − αp; inf without curvature
    double feasible  # the largest feasible α; may be inf where it is not below
    double slope  # gᵀp
    double curvature  # pᵀHp


cdef struct Parts:
    double phi_square  # ‖φ‖², φ the free gradient: g off the boundary
    double beta_square  # ‖β‖², β the chopped gradient: the inward part of g on it
    double reduced_square  # φ̃ᵀφ, φ̃ = φ reduced so that x − φ̃/τ stays feasible
    double phi_Hp  # φᵀHp after a step along p


@cython.final
cdef class Box:
    """The box l ≤ x ≤ u for vectors that may be distributed over processes.

    Each operation passes over its vectors once and accumulates all sums that the step
    needs: separate operations would read each vector several times per CG step.
    """

    cdef Py_ssize_t n
    cdef const double *lower
    cdef const double *upper
    cdef const double *upper_if_any  # NULL where all are inf
    cdef Reduction over

    @staticmethod
    cdef Box of(const double *lower, const double *upper, Py_ssize_t n, Reduction over):
        cdef Box new = Box.__new__(Box)
        cdef Py_ssize_t i
        new.n, new.over, new.lower, new.upper = n, over, lower, upper
        for i in range(n):
            if upper[i] < INFINITY:
                new.upper_if_any = upper
                break
        return new

    cdef bint has_bound(self, Py_ssize_t i) noexcept:
        return self.lower[i] > -INFINITY or self.upper[i] < INFINITY

    cdef void project(
        self, const double *x, double alpha, const double *p, double *y
    ) noexcept:
        """y ← P(x − αp)."""
        cdef Py_ssize_t i
        for i in range(self.n):
            y[i] = fmin(fmax(x[i] - alpha * p[i], self.lower[i]), self.upper[i])

    cdef int lengths(self, const double *x, const double *g, const double *p,
                     const double *Hp, Line *line) except -1:
        """Compute the step lengths along x − αp."""
        if self.over.ranks is None:
            lengths(x, g, p, Hp, self.lower, self.upper_if_any, self.n, &line.cg)
            return 0
        line.slope, line.curvature = dot(g, p, self.n), dot(p, Hp, self.n)
        line.feasible = first_bound(x, p, self.lower, self.upper_if_any, self.n)
        self.over.add(&line.slope, 2, &line.feasible)
        line.cg = line.slope / line.curvature if line.curvature > 0 else INFINITY
        return 0

    cdef void product_and_lengths(
        self, const sparse *F, double s, const double *x, const double *g, double *p,
        double *Hp, Line *line
    ) noexcept:
        """Hp ← s F p, and the `lengths` along p, in one pass over memory."""
        sparse_lengths(F, s, x, g, p, Hp, self.lower, self.upper_if_any, &line.cg)

    cdef void next_product_and_lengths(
        self, const sparse *F, double s, double gamma, const double *x, const double *g,
        double *p, double *Hp, Line *line
    ) noexcept:
        """p ← φ − γp, Hp ← s F p, and the `lengths` along p, in one pass over memory."""
        sparse_update_direction(F, s, gamma, x, g, p, Hp, self.lower, self.upper_if_any, &line.cg)

    cdef int split(self, const double *x, const double *g, double tau, double *phi,
                   double *free, Parts *parts) except -1:
        """Compute φ and `free` (1 off the boundary, else 0) for the face of x."""
        split(x, g, self.lower, self.upper, tau, phi, free, self.n, &parts.phi_square)
        return self.over.add(&parts.phi_square, 3)

    cdef int advance(self, double alpha, double *x, double *g, const double *p,
                     const double *Hp, double tau, double *phi, double *free,
                     Parts *parts) except -1:
        """x ← x − αp, g ← g − αHp, and `split`.

        Components within rounding of their bound are set to it: otherwise a step of
        the largest feasible length could stop just short of the face.

        phi, free : NULL if they are not stored
        """
        advance(alpha, x, g, p, Hp, self.lower, self.upper_if_any, tau, phi, free,
                self.n, &parts.phi_square)
        return self.over.add(&parts.phi_square, 4)

    cdef void chop(self, const double *x, const double *g, double *beta) noexcept:
        """beta ← β, the part of g on the boundary that points into the box."""
        cdef Py_ssize_t i
        for i in range(self.n):
            beta[i] = 0.0
            if not self.lower[i] < x[i] < self.upper[i] and (
                (g[i] < 0 and x[i] < self.upper[i])
                or (g[i] > 0 and x[i] > self.lower[i])
            ):
                beta[i] = g[i]

    cdef void project_free(
        self, const double *x, const double *g, double tau, double *y
    ) noexcept:
        """y ← P(x − φ/τ), which is x − φ̃/τ."""
        projected(x, g, tau, self.lower, self.upper, y, self.n)

    cdef void minimise(self, const double *x, const double *g, double tau, double *s,
                       double *piece) noexcept:
        """s ← argmin gᵀs + τ/2‖s‖², x + s in the set.

        piece : −1 at the lower bound, 1 at the upper, 0 between; may be NULL
        """
        model_minimiser(x, g, tau, self.lower, self.upper, s, piece, self.n)

    cdef void minimise_part(
        self, Py_ssize_t first, Py_ssize_t size, const double *x, const double *g_part,
        double tau, double *s, double *piece
    ) noexcept:
        """Apply `minimise` to a range of components; g_part and piece are of that size."""
        model_minimiser(x + first, g_part, tau, self.lower + first, self.upper + first, s + first,
               piece, size)

    cdef void leave_box(self, double alpha, double beta, bint release, double *x, double *g,
                    const double *p, const double *Hp, double *x0, double *g0,
                    double *free, Box face, double *z, double *z_g) noexcept:
        """Step to the boundary, x ← x − αp; save the state before in x₀, g₀ and `free`.

        face : receives the set of the next step; it fixes the components that are on
            the boundary, unless `release`
        z, z_g : receive x − βp from the new x, outside of the set, and its gradient
        """
        leave_box(alpha, beta, release, x, g, p, Hp, self.lower, self.upper, x0, g0, free,
              <double *> face.lower, <double *> face.upper, z, z_g, self.n)

    cdef double minimise_near(
        self, const double *z, const double *z_g, double tau, const double *x,
        const double *g, double *s
    ) except? -1:
        """s ← z + argmin of `minimise` at z, minus x; returns gᵀs."""
        return self.over.total(model_minimiser_within(
            z, z_g, tau, x, g, self.lower, self.upper, s, self.n
        ))

    cdef double within(self, const double *z, const double *x, const double *g,
                       bint release, double *s) except? -1:
        """s ← z + s − x, rounded to the boundary where within rounding; returns gᵀs.

        s is zero on components that the set fixes, unless `release`.
        """
        return self.over.total(within(
            z, x, g, self.lower, self.upper, release, s, self.n
        ))

    cdef double inward_energy(self, const double *x, const double *g,
                              const double *diagonal, double norm,
                              double noise) except? -1:
        """Return Σ (norm gᵢ)²/Dᵢ over components whose descent direction is feasible.

        noise : components with a smaller gradient are left out
        """
        return self.over.total(inward_energy(
            x, g, self.lower, self.upper, diagonal, norm, noise, self.n
        ))
