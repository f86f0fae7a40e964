# The set that x stays in, and all that MPRGP asks about it. The loop knows no bounds: a
# further set (discs of friction) adds its part to each operation of this section.


cdef struct Line:
    double cg  # α that minimises the cost at x − αp; inf without curvature
    double feasible  # the largest feasible α; may be inf where it is not below
    double slope  # gᵀp
    double curvature  # pᵀHp


cdef struct Parts:
    double phi_square  # ‖φ‖² of the free gradient φ, g off the boundary
    double beta_square  # ‖β‖² of the chopped gradient β, what leads inside on it
    double reduced_square  # φ̃ᵀφ, φ̃ the φ that no step of length 1/τ takes beyond it
    double phi_Hp  # φᵀHp after a step along p


@cython.final
cdef class Box:
    """l ≤ x ≤ u, of vectors that several processes may share.

    Every operation is one pass over its vectors, together with the sums that the step
    needs of them, over all processes: a CG step would otherwise read each vector several
    times.
    """

    cdef Py_ssize_t n
    cdef const double *lower
    cdef const double *upper
    cdef const double *upper_if_any  # NULL where all are inf
    cdef Reduction over

    @staticmethod
    cdef Box of(const double *lower, const double *upper, Py_ssize_t n, Reduction over):
        cdef Box made = Box.__new__(Box)
        cdef Py_ssize_t i
        made.n, made.over, made.lower, made.upper = n, over, lower, upper
        for i in range(n):
            if upper[i] < INFINITY:
                made.upper_if_any = upper
                break
        return made

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
        """Find how far to go along x − αp."""
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
        """Hp ← s F p, and its `lengths`, in one go through memory."""
        sparse_lengths(F, s, x, g, p, Hp, self.lower, self.upper_if_any, &line.cg)

    cdef void next_product_and_lengths(
        self, const sparse *F, double s, double gamma, const double *x, const double *g,
        double *p, double *Hp, Line *line
    ) noexcept:
        """p ← φ − γp, Hp ← s F p, and its `lengths`, in one go through memory."""
        sparse_turn(F, s, gamma, x, g, p, Hp, self.lower, self.upper_if_any, &line.cg)

    cdef int split(self, const double *x, const double *g, double tau, double *phi,
                   double *free, Parts *parts) except -1:
        """Split g by the face on which x lies: φ and `free`, 1 off the boundary, else 0.
        """
        split(x, g, self.lower, self.upper, tau, phi, free, self.n, &parts.phi_square)
        return self.over.add(&parts.phi_square, 3)

    cdef int advance(self, double alpha, double *x, double *g, const double *p,
                     const double *Hp, double tau, double *phi, double *free,
                     Parts *parts) except -1:
        """x ← x − αp, g ← g − αHp, and `split`.

        What comes nearer to the boundary than rounding can tell is on it: a step as far
        as it is feasible must not stop short of the face.

        phi, free : NULL where they are not stored
        """
        advance(alpha, x, g, p, Hp, self.lower, self.upper_if_any, tau, phi, free,
                self.n, &parts.phi_square)
        return self.over.add(&parts.phi_square, 4)

    cdef void chop(self, const double *x, const double *g, double *beta) noexcept:
        """β, what of g leads inside on the boundary."""
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

        piece : −1 and 1 at the lower and the upper bound, 0 between; may be NULL
        """
        tilted(x, g, tau, self.lower, self.upper, s, piece, self.n)

    cdef void minimise_part(
        self, Py_ssize_t first, Py_ssize_t size, const double *x, const double *g_part,
        double tau, double *s, double *piece
    ) noexcept:
        """Do so for some neighbouring components; g_part and piece are theirs alone."""
        tilted(x + first, g_part, tau, self.lower + first, self.upper + first, s + first,
               piece, size)

    cdef void leave(self, double alpha, double beta, bint release, double *x, double *g,
                    const double *p, const double *Hp, double *x0, double *g0,
                    double *free, Box face, double *z, double *z_g) noexcept:
        """Go to the boundary, x ← x − αp; what was there is in x₀, g₀ and `free`.

        face : becomes the set of the step that follows, which keeps what is on the
            boundary there, unless it may `release` it
        z : x − βp from the new x, outside of the set, and its gradient
        """
        leave(alpha, beta, release, x, g, p, Hp, self.lower, self.upper, x0, g0, free,
              <double *> face.lower, <double *> face.upper, z, z_g, self.n)

    cdef double minimise_near(
        self, const double *z, const double *z_g, double tau, const double *x,
        const double *g, double *s
    ) except? -1:
        """Find s from x to where `minimise` leads from z; returns gᵀs."""
        return self.over.total(tilted_within(
            z, z_g, tau, x, g, self.lower, self.upper, s, self.n
        ))

    cdef double within(self, const double *z, const double *x, const double *g,
                       bint release, double *s) except? -1:
        """s ← z + s − x, on the boundary where that is nearer than rounding; gᵀs.

        Zero where the set leaves no choice, unless that is a `release`.
        """
        return self.over.total(within(
            z, x, g, self.lower, self.upper, release, s, self.n
        ))

    cdef double inward_energy(self, const double *x, const double *g,
                              const double *diagonal, double norm,
                              double noise) except? -1:
        """Sum (norm gᵢ)²/Dᵢ over components where g leads inside by more than noise."""
        return self.over.total(inward_energy(
            x, g, self.lower, self.upper, diagonal, norm, noise, self.n
        ))
