# MPRGP, independent of the type of the feasible set.


# Rounding of a sum of up to 8·10⁵ terms, √k·2⁻⁵³, relative to their absolute values. With
# zero, `test_a_solve_stalled_by_rounding_ends` takes 4000 products instead of 1000.
cdef double NOISE = 1e-13

# Smallest accepted ratio of gᵀp to φᵀz, which are equal in exact arithmetic, because g is
# orthogonal to all earlier directions. A smaller ratio shows that rounding has
# reintroduced components of g along them. Without this limit,
# `test_rounding_along_previous_directions_is_removed` fails.
cdef double MIN_SLOPE_RATIO = 0.5
# For a semidefinite F, CG is *spent* on a face if φᵀz exceeds its smallest value by this
# factor. Such directions are rounding errors near the kernel of F, along which x would
# grow without limit (`test_a_semidefinite_dual_ends_at_its_rounding_errors`).
cdef double MAX_GROWTH = 1e6

cdef enum:
    # Largest number of CG directions stored for a face. Two passes over 200 directions
    # read as many numbers as a product with the triangle of a dense F of 800 unknowns.
    MAX_DIRECTIONS = 200
    # Number of steps before the first check for stagnation, ten times the number for a
    # preconditioned dual. Without it, `test_a_solve_stalled_by_rounding_ends` fails.
    FIRST_CHECK = 500
    MODEL = 0
    SPECTRAL = 1
    OWN = 2
    # Number of previous costs with which the nonmonotone line search compares
    MEMORY = 20
    FIRST_NEWTON = 100  # number of steps before the first Newton step, unless √n is larger


# Fraction of the linear decrease that a spectral step must achieve (Armijo condition)
cdef double SUFFICIENT_DECREASE = 1e-4


# Smallest penalty of the model in a structural preconditioner if there are discs, with
# which its inverse is nearly the projector onto the kernel of the rows. With ρ = 1, the
# default with discs, a contact patch in subdomains takes 7692 products instead of 575.
cdef double MIN_PROJECTING = 1e4

# Factor of Γ² for spectral steps, which act on φ and β at the same time
cdef double SPECTRAL_GAMMA = 0.1

cdef double change_along(const Line *line, double alpha) noexcept:
    """Return f(x − αp) − f(x)."""
    return -alpha * line.slope + 0.5 * alpha**2 * line.curvature


cdef double *enlarged(double *array, Py_ssize_t size) except NULL:
    """Reallocate an array to `size` numbers, preserving its contents."""
    array = <double *> realloc(array, max(size, 1) * sizeof(double))
    if not array:
        raise MemoryError
    return array


@cython.final
cdef class Directions:
    """The latest conjugate directions of CG on a face, scaled to pᵢᵀHpⱼ = δᵢⱼ.

    Rounding destroys the conjugacy to earlier directions after a few dozen steps; a new
    right-hand side (a multiplier step) or preconditioner destroys it immediately.
    Explicit conjugation costs two passes over all directions per step (Farhat, Crivelli
    and Roux, Comput. Methods Appl. Mech. Engrg. 117, 1994, 195-209).

    free : (n,) mask of the face, 1 for components off the boundary, else 0
    """

    cdef Py_ssize_t n, count, most, oldest, room
    cdef double *p  # (room, n)
    cdef double *Hp
    cdef double *share
    cdef double *free

    def __cinit__(self, Py_ssize_t n, Py_ssize_t most):
        self.n, self.most = n, most
        self.share = <double *> calloc(most + 1 + n, sizeof(double))
        if not self.share:
            raise MemoryError
        self.free = self.share + most + 1

    def __dealloc__(self):
        release_memory(self.p)
        release_memory(self.Hp)
        release_memory(self.share)

    cdef void begin(self, const double *free) noexcept:
        """Discard all directions; new directions belong to the face `free`."""
        self.count = self.oldest = 0
        if self.n and self.most:
            memcpy(self.free, free, self.n * sizeof(double))

    cdef bint is_on(self, const double *free) noexcept:
        """Return True if the directions belong to the face `free`."""
        return same(self.free, free, self.n)

    cdef int add(self, const double *p, const double *Hp, double curvature) except -1:
        """Store p with curvature = pᵀHp; replaces the oldest direction if full."""
        cdef Py_ssize_t at = self.count
        if not self.most:
            return 0
        if at == self.most:
            at, self.oldest = self.oldest, (self.oldest + 1) % self.most
        elif at == self.room:
            self.room = min(max(16, 2 * self.room), self.most)
            self.p = enlarged(self.p, self.room * self.n)
            self.Hp = enlarged(self.Hp, self.room * self.n)
        copy_scaled(1 / sqrt(curvature), p, self.p + at * self.n, self.n)
        copy_scaled(1 / sqrt(curvature), Hp, self.Hp + at * self.n, self.n)
        self.count = min(self.count + 1, self.most)
        return 0

    cdef double conjugate(self, const double *phi, double *p) noexcept:
        """Make p conjugate to all directions; return φᵀp of the old p, else 0."""
        if not self.count:
            return 0.0
        rows_times(self.Hp, p, self.share, self.count, self.n)
        self.share[self.count] = dot(phi, p, self.n)
        add_combination(-1.0, self.p, self.share, p, self.count, self.n)
        return self.share[self.count]

    cdef void minimise(self, const double *g, double *s, double *Hs) noexcept:
        """Compute s and Hs such that x − s minimises the cost along all directions."""
        rows_times(self.p, g, self.share, self.count, self.n)
        memset(s, 0, self.n * sizeof(double))
        memset(Hs, 0, self.n * sizeof(double))
        add_combination(1.0, self.p, self.share, s, self.count, self.n)
        add_combination(1.0, self.Hp, self.share, Hs, self.count, self.n)


cdef class MPRGP:
    """Modified proportioning with reduced gradient projections.

    The method minimises ½xᵀHx − bᵀx over a set (Dostál 2009, the paper's reference [3],
    Chapter 5; Dostál and Schöberl 2005), with H = 𝒫F𝒫/‖𝒫F𝒫‖ + ρQ and g = Hx − b. The free
    gradient φ equals g for components off the boundary, the chopped gradient β is the
    part of g on the boundary for which −β is a feasible direction, and g^P = φ + β is
    the projected gradient. Each step is one of the following:

    * c, conjugate gradient: minimise along p on the face if the step is feasible; p is
      conjugate to all stored `Directions` of the face, not only to the last direction
    * b, beyond: take a CG step on the face without its bounds, to prepare an expansion
    * e, expansion: expand the active set by one of the rules of
      `solvers.smalbe.options`, or by the rule of a subclass
    * f, fallback: take a safe expansion step after an expansion with too small a
      decrease; after a rule of a subclass, this is the standard expansion of the book
    * p, proportioning: release components, by the model, along −β or by a spectral step
    * n, Newton: minimise on the tangents of discs, as described below

    A proportioning step is taken if  ‖β‖² > Γ² φ̃ᵀφ,  with the reduced free gradient
    φ̃, defined by x − φ̃/τ = Π(x − φ/τ) with the projection Π onto the set.

    Over discs, *spectral steps* x ← x + t(Π(x − αg) − x) (Birgin, Martínez and Raydan,
    SIAM J. Optim. 10, 2000, Algorithm 2.2) replace expansions and proportioning. CG
    begins on a face only if a step of length α along −φ stays in the set. On a face that
    no longer changes, *Newton steps* x ← Π(x − d) follow, where CG solves T(H + κ)Td = Tg
    with the projector T onto the tangents and the curvature κ times the multiplier.

    Every step decreases the cost, except spectral steps. docs/smalbe.md states the
    guarantees.
    """

    cdef Product F
    cdef Py_ssize_t n
    cdef Rows rows
    cdef const double *lower  # bounds of x, infinite for variables of discs
    cdef const double *upper
    cdef FeasibleSet set
    cdef FeasibleSet face_set  # feasible set of the step that follows a half step
    cdef double inverse_norm, rho
    cdef double alpha, Gamma_square, eta
    cdef int expansion
    cdef Room room  # memory of all vectors
    cdef double *rhs  # b of the inner problem
    cdef double *x
    cdef double *g
    cdef double *p
    cdef double *Hp
    cdef double *phi
    cdef double *free
    cdef double *z
    cdef double *s
    cdef double *Hs
    cdef double *t
    cdef double *x2
    cdef double *g2
    cdef double *x0
    cdef double *g0
    cdef double *Cv
    cdef double *Cw
    cdef double *Cx  # valid if `knows_Cx`, see `violation`
    cdef bint knows_Cx
    cdef Line line  # line of the last product
    cdef Parts parts  # of the gradient at x
    cdef double size  # see `cost`
    cdef double expected_slope  # φᵀz, equal to gᵀp in exact arithmetic
    cdef double phi_square_at_drift  # ‖φ‖² at the last `minimise_along_directions`
    cdef double phi_square_at_refresh  # ‖φ‖² at the last `refresh` on this face
    cdef bint is_semidefinite  # True if F has a kernel
    cdef double least_slope  # smallest φᵀz on this face, see `is_spent`
    cdef Model B  # model of H; ᾱ = 1/τ is the length of gradient projection steps
    # model inverted on the face; None without preconditioning
    cdef Model preconditioner
    cdef object M  # product v → Mv with a structural preconditioner, or None
    cdef LinearMap M_map  # M as a compiled linear map, or None
    cdef ApproximateInverse inverse  # M of a dense P, or None
    cdef bint uses_M  # false for the first CG step on a face with `inverse`
    cdef double M_scale  # ‖𝒫F𝒫‖, because M approximates F⁻¹ rather than H⁻¹
    cdef object counts  # counts of applications of M
    # step rule of a subclass (`solvers.smalbe.extension`), or None
    cdef object step_rule
    cdef IncompleteFactor factor  # factor of the free block of a sparse P, or None
    cdef long layers  # number of layers of neighbours released by `step_by_factor`
    cdef Directions directions
    cdef Directions tangents  # directions of CG for a Newton step
    cdef double *marked  # (n,) mask `free` of an earlier face
    cdef long patience  # number of steps before the next Newton step
    cdef double spectral_length  # α of the last step; 0 before the first one
    cdef double cost_now  # cost relative to the cost at the start of the run
    cdef double costs[MEMORY]  # last values of `cost_now`
    cdef long n_costs

    cdef int make_room(self) except -1:
        """Allocate the vectors."""
        cdef Py_ssize_t n = self.n, r = self.rows.r
        self.room = Room(17 * n + 3 * r)
        cdef double *at = self.room.at
        self.x, self.g, self.p, self.Hp = at, at + n, at + 2 * n, at + 3 * n
        at += 4 * n
        self.phi, self.free, self.z, self.s = at, at + n, at + 2 * n, at + 3 * n
        at += 4 * n
        self.Hs, self.t, self.x2, self.g2 = at, at + n, at + 2 * n, at + 3 * n
        at += 4 * n
        self.face_set = FeasibleSet.of(at, at + n, n)
        self.rhs, self.g0, self.marked = at + 2 * n, at + 3 * n, at + 4 * n
        self.x0 = self.z  # z is recomputed after each expansion
        at += 5 * n
        self.Cv, self.Cw, self.Cx = at, at + r, at + 2 * r
        return 0

    # the algorithm

    cdef bint minimise(self, long most, bytearray trace, note) except -1:
        """Run MPRGP from x and g; return True if `stops` ended the run.

        The run returns False after `most` steps, if no step is possible or CG is spent
        and a recomputed gradient is no better (`refresh`), or if the run *stagnates*:
        since the previous check, the smallest ‖g^P‖ was not halved and the cost
        decreased by no more than the rounding of its terms. Checks are made after
        `FIRST_CHECK` steps, and then each time after twice as many.

        trace : receives the letters of the steps
        note : function called with the letter, x and g after each step, or None
        """
        cdef long inside = 0  # number of CG steps on this face
        cdef long check = FIRST_CHECK
        cdef double least = INFINITY, before = INFINITY, cost = INFINITY  # at the last check
        cdef double now
        cdef int letter
        cdef bint has_expanded = False, begun = True
        cdef double chopped = INFINITY, last  # ‖β‖² at the last two proportionings
        cdef double began
        self.cost_now, self.n_costs = 0.0, 0
        self.record_cost(0.0)
        # Step 0. The face of x, the minimiser along the stored directions on this face, and
        # the first direction of conjugate gradients.
        self.split()
        self.minimise_along_directions()
        began, self.phi_square_at_drift = self.parts.phi_square, INFINITY
        self.phi_square_at_refresh = INFINITY
        self.layers = 0
        self.first_direction()
        self.expected_slope = self.directions.conjugate(self.phi, self.p)
        while True:
            PyErr_CheckSignals()  # so that Ctrl-C ends the loop
            # Step 5. Return if the projected gradient is small, or on stagnation.
            if self.stops():
                return 1
            if len(trace) >= most:
                return 0
            least = fmin(least, self.parts.phi_square + self.parts.beta_square)
            if len(trace) >= check:
                now = self.cost(self.x, self.g)
                if not cost - now > NOISE * self.size and 4 * least > before:
                    return 0
                before, least, cost = fmin(least, before), INFINITY, now
                check = 2 * len(trace)
            if self.expansion == SPECTRAL and not inside and self.is_settled():
                # Newton step; φ, `free` and p are recomputed after it.
                begun = False
                if self.step_by_newton(most, trace):
                    self.record_step(b"n", trace, note)
                continue
            if self.parts.beta_square > self.Gamma_square * self.parts.reduced_square:
                # Step 4. Proportioning, because releasing components promises a larger
                # decrease than a step on the face.
                last, chopped = chopped, self.parts.beta_square
                # If the last step by the model did not halve ‖β‖², the next is along −β
                # (`test_a_poor_model_is_replaced`).
                letter = self.proportion(2 * chopped <= last or self.B.basis is None)
            elif not inside and self.spectral_step_leaves(begun):
                letter = b"e" if self.step_spectrally() else 0
            else:
                # Step 1. The trial step of conjugate gradients, with α_cg and the largest
                # feasible length α_f.
                self.lengths_along(self.p, self.Hp)
                if isinf(fmin(self.line.cg, self.line.feasible)) or self.is_spent():
                    if not self.is_semidefinite or not self.refresh():
                        return 0
                    inside = 0
                    continue
                if self.line.cg <= self.line.feasible:
                    # Step 2. Conjugate gradient step, and the next direction.
                    self.minimise_along_p()
                    self.record_step(b"c", trace, note)
                    inside += 1
                    continue
                # Step 3. Expansion: the CG step would leave the set.
                letter = self.expand(not has_expanded, max(inside, 1), began, trace)
                self.layers //= 2
                has_expanded = True
            if not letter:
                return 0
            # Restart CG on the new face with the preconditioned free gradient. After
            # a spectral step, restart only if CG begins on this face.
            inside, began = 0, self.parts.phi_square
            self.phi_square_at_drift = self.phi_square_at_refresh = INFINITY
            begun = self.expansion != SPECTRAL
            if begun:
                self.directions.begin(self.free)
                self.first_direction()
            self.record_step(letter, trace, note)

    cdef bint stops(self) except -1:
        """Return True if x is accurate enough."""
        raise NotImplementedError

    cdef bint is_spent(self) noexcept:
        """Return True if the CG direction of `line` consists of rounding errors."""
        cdef double slope = fabs(self.line.slope)  # φᵀz, apart from rounding
        if not self.is_semidefinite or self.line.cg > self.line.feasible:
            return False
        self.least_slope = fmin(self.least_slope, slope)
        return slope > MAX_GROWTH * self.least_slope

    cdef int refresh(self) except -1:
        """Recompute the gradient from x and restart CG.

        The function takes one product. It returns 0, without a restart, if ‖φ‖ has not
        been halved since the last call.
        """
        self.gradient(self.x, self.g)
        self.split()
        self.knows_Cx = False
        if 4 * self.parts.phi_square > self.phi_square_at_refresh:
            return 0
        self.phi_square_at_refresh = self.parts.phi_square
        self.directions.begin(self.free)
        self.first_direction()
        return 1

    cdef int record_step(self, int letter, bytearray trace, note) except -1:
        trace.append(letter)
        if note is not None:
            note(chr(letter), copied(self.x, self.n), copied(self.g, self.n))
        return 0

    # Step 0. The face

    cdef void split(self) noexcept:
        """Compute φ, `free` and `parts` at x."""
        self.set.split(self.x, self.g, self.B.tau, self.phi, self.free, &self.parts)

    cdef void minimise_along_directions(self) noexcept:
        """Minimise along the stored directions of this face, as far as feasible."""
        if not self.directions.most:
            return
        if self.directions.count and self.directions.is_on(self.free):
            self.directions.minimise(self.g, self.s, self.Hs)
            self.set.lengths(self.x, self.g, self.s, self.Hs, &self.line)
            if self.line.slope > 0:
                self.to(fmin(self.line.cg, self.line.feasible), self.s, self.Hs)
        if not self.directions.is_on(self.free):
            self.directions.begin(self.free)

    cdef bint is_preconditioned(self) noexcept:
        if self.M is not None or self.factor is not None:
            return True
        # B = τI would only change the lengths of directions
        return self.preconditioner is not None and self.preconditioner.basis is not None

    cdef int first_direction(self) except -1:
        """Prepare the preconditioner for the face and set p to z."""
        self.least_slope = INFINITY
        self.uses_M = self.M is not None and self.inverse is None
        if self.factor is not None:
            self.factor.enter(self.free, True)
        elif self.is_preconditioned():
            self.preconditioner.enter(self.free)
        memcpy(self.p, self.preconditioned_gradient(), self.n * sizeof(double))
        return 0

    cdef const double *preconditioned_gradient(self) except NULL:
        """Return z, the preconditioned φ on the face.

        With P = B_FF⁻¹ of the model alone, z = Pφ. With a matrix M that approximates
        F⁻¹ without ρQ, z = P(τ²‖𝒫F𝒫‖ M − τI)Pφ + Pφ (`solvers.smalbe.preconditioner`), or
        z = Mφ for an `ApproximateInverse` without rows. With discs, P belongs to the
        penalty MIN_PROJECTING, and (φ − Pφ)/ρ is added off its range.
        """
        cdef Py_ssize_t i, n = self.n
        cdef double *rest = self.t
        cdef double *Mz = self.s
        cdef double weight = 1 / self.rho, tau
        if not self.is_preconditioned():
            return self.phi
        if self.factor is not None:
            self.factor.inverse(self.phi, self.z)
            return self.z
        if self.uses_M:
            self.counts["preconditioner_applies"] += 1
        if self.uses_M and self.inverse is not None and not self.rows.exist:
            approximate_inverse(self.inverse.G, self.phi, self.z, n)
            return self.z
        tau = self.preconditioner.tau
        self.preconditioner.inverse(self.free, self.phi, self.z)
        if self.uses_M:
            if self.inverse is not None:
                approximate_inverse(self.inverse.G, self.z, Mz, n)
            elif self.M_map is not None:
                self.M_map.apply(self.z, Mz, 1)
            else:
                copy_result(self.M(view(self.z, n)), n, Mz, "M @ v")
            for i in range(n):
                rest[i] = self.free[i] * tau * (tau * self.M_scale * Mz[i] - self.z[i])
            if self.rows.exist and self.penalty_of_M() > self.rho:
                scale(1 - weight, self.z, n)
                add(weight, self.phi, self.z, n)
            self.preconditioner.inverse(self.free, rest, Mz)
            add(1.0, Mz, self.z, n)
        return self.z

    cdef double penalty_of_M(self) noexcept:
        """Return the penalty of the model in a structural preconditioner."""
        return fmax(self.rho, MIN_PROJECTING) if self.set.has_discs else self.rho

    # Step 4. Proportioning

    cdef int proportion(self, bint by_model) except -1:
        """Take a step that releases components; return its letter, or 0 without a step.

        The step does not go beyond the opposite boundary.
        """
        cdef double *beta = self.s
        cdef double length
        if self.expansion == SPECTRAL:
            return b"p" if self.step_spectrally() else 0
        if by_model and self.factor is not None:
            return b"p" if step_by_factor(self) else 0
        if by_model:
            return b"p" if self.step_by_model() else 0
        self.set.project_gradient(self.x, self.g, beta)
        add(-1.0, self.phi, beta, self.n)
        self.lengths_along(beta, self.Hs)
        length = fmin(self.line.cg, self.line.feasible)
        if isinf(length):
            return 0
        self.to(length, beta, self.Hs)
        return b"p"

    cdef int step_by_model(self) except -1:
        """Minimise the model over the set, then the cost along that step.

        The function returns 0 if the step is zero or the cost is unbounded along it. If
        the product shows that B ≥ H is violated (the minimising length is below 1), τ is
        increased.
        """
        cdef double length
        if self.set.has_discs:  # any other length would leave a curved boundary
            length = self.searched_projection(self.B.tau, 0.0)
        else:
            self.B.step(self.x, self.g, self.set, self.s)
            length = self.searched(self.s, self.Hs)
        if length == 0 or isinf(length):
            return 0
        if self.line.cg < 1:
            self.B = self.B.raised(self.s, self.Hs)
        self.to(length, self.s, self.Hs)
        return 1

    cdef double searched(self, double *s, double *Hs) except? -1:
        """Return the α that minimises the cost along x + αs, at most max(1, α_f).

        The length is 0 for s = 0, and inf if the cost is unbounded. The function takes
        one product, replaces s by −s, and stores the `lengths` of x − αs in `line`.
        """
        if not dot(s, s, self.n):
            return 0
        scale(-1.0, s, self.n)
        self.lengths_along(s, Hs)
        return fmin(self.line.cg, fmax(1.0, self.line.feasible))

    # Steps 3 and 4. Spectral steps

    cdef int record_cost(self, double change) noexcept:
        self.cost_now += change
        self.costs[self.n_costs % MEMORY] = self.cost_now
        self.n_costs += 1
        return 0

    cdef bint spectral_step_leaves(self, bint begun) except -1:
        """Return True if x − αp is not in the set for the length α of spectral steps.

        begun : false if CG does not yet have a first direction on this face
        """
        cdef bint is_tested = self.expansion == SPECTRAL and self.spectral_length > 0
        if not begun:
            self.directions.begin(self.free)
            self.first_direction()
        return is_tested and (
            self.set.feasible_length(self.x, self.p, self.spectral_length)
            < self.spectral_length
        )

    cdef int step_spectrally(self) except -1:
        """Take a spectral step, with one product; return 0 if the step is zero."""
        cdef Py_ssize_t i
        cdef double length, most = self.cost_now
        cdef double tau = 1 / self.spectral_length if self.spectral_length else self.B.tau
        for i in range(min(self.n_costs, MEMORY)):
            most = fmax(most, self.costs[i])
        length = self.searched_projection(tau, most - self.cost_now)
        if not length:
            return 0
        self.record_cost(change_along(&self.line, length))
        self.to(length, self.s, self.Hs)
        return 1

    cdef bint is_settled(self) noexcept:
        """Return True if the face has settled and a Newton step is due."""
        cdef bint is_unchanged = same(self.free, self.marked, self.n)
        memcpy(self.marked, self.free, self.n * sizeof(double))
        self.patience -= 1
        return is_unchanged and self.patience <= 0

    cdef bint step_by_newton(self, long most, bytearray trace) except -1:
        """Step to the minimiser on tangents of the boundary, projected onto the set.

        If this step does not decrease the cost, x is unchanged and the result is False.
        If the step does not halve the projected gradient, the next Newton step is taken
        only after as many other steps as this step took products.

        most : largest number of letters in `trace`, which receives one letter per CG
            step
        """
        cdef Py_ssize_t i, n = self.n
        cdef double before = self.parts.phi_square + self.parts.beta_square
        cdef double enough, square, curvature, length
        cdef long steps = 0
        cdef double *d = self.x2
        cdef const double *z
        memset(self.phi, 0, n * sizeof(double))
        for i in range(n):
            self.free[i] = 1.0
        self.set.follow(self.x, self.phi, NULL, self.free)
        if self.is_preconditioned():
            self.preconditioner.enter(self.free)
        self.tangents.begin(self.free)
        memset(d, 0, n * sizeof(double))
        memcpy(self.phi, self.g, n * sizeof(double))
        self.set.follow(self.x, self.g, NULL, self.phi)
        square = dot(self.phi, self.phi, n)
        enough = self.eta**4 * square  # CG to the relative accuracy η²
        while square > enough and len(trace) < most and steps < n:
            z = self.preconditioned_gradient()
            memcpy(self.p, z, n * sizeof(double))
            self.set.follow(self.x, self.g, NULL, self.p)
            self.tangents.conjugate(self.phi, self.p)
            self.H(self.p, self.Hp)
            self.set.follow(self.x, self.g, self.p, self.Hp)
            curvature = dot(self.p, self.Hp, n)
            if curvature <= 0:
                break
            length = dot(self.phi, self.p, n) / curvature
            add(length, self.p, d, n)
            add(-length, self.Hp, self.phi, n)
            self.tangents.add(self.p, self.Hp, curvature)
            square = dot(self.phi, self.phi, n)
            trace.append(c"n")
            steps += 1
        self.patience = max(steps, 2)  # without CG steps, another step must come next
        self.set.project(self.x, 1.0, d, self.s)
        for i in range(n):
            self.s[i] = self.x[i] - self.s[i]
        self.H(self.s, self.Hs)
        self.line.slope = dot(self.g, self.s, n)
        self.line.curvature = dot(self.s, self.Hs, n)
        if change_along(&self.line, 1.0) >= 0:
            self.split()
            return False
        self.record_cost(change_along(&self.line, 1.0))
        self.to(1.0, self.s, self.Hs)
        if 4 * (self.parts.phi_square + self.parts.beta_square) < before:
            self.patience = 0
        return True

    cdef double searched_projection(self, double tau, double rise) except? -1:
        """Return the length of the step along −s = Π(x − g/τ) − x, or 0 if s = 0.

        The length is 1 if the cost then falls sufficiently below the present one plus
        `rise`, otherwise the minimising length. The function takes one product, and also
        stores the length α of the next spectral step.
        """
        cdef double square
        cdef Line *line = &self.line
        self.set.minimise(self.x, self.g, tau, self.s)
        scale(-1.0, self.s, self.n)
        square = dot(self.s, self.s, self.n)
        if not square:
            return 0
        line.slope = dot(self.g, self.s, self.n)
        self.H(self.s, self.Hs)
        line.curvature = dot(self.s, self.Hs, self.n)
        # gᵀs ≥ τ‖s‖² for projections. At the end of a run, rounding of large normal
        # components of g may violate this inequality, and the step would be rejected.
        line.slope = fmax(line.slope, tau * square)
        if line.curvature > NOISE * line.slope:
            self.spectral_length = square / line.curvature
        if change_along(line, 1.0) > rise - SUFFICIENT_DECREASE * line.slope:
            return line.slope / line.curvature
        return 1.0

    # Step 1. The trial step

    cdef int H(self, const double *v, double *out) except -1:
        """out ← Hv = 𝒫F𝒫v/‖𝒫F𝒫‖ + ρQv; one product."""
        cdef Py_ssize_t i
        if not self.rows.exist:
            self.F.apply(v, out, self.inverse_norm)
            return 0
        self.rows.times(v, self.Cv)
        self.rows.combine(-1.0, self.Cv, v, self.t)
        self.F.apply(self.t, out, self.inverse_norm)
        self.rows.times(out, self.Cw)
        for i in range(self.rows.r):
            self.Cw[i] = self.rho * self.Cv[i] - self.Cw[i]
        self.rows.combine(1.0, self.Cw, out, out)
        return 0

    cdef int gradient(self, const double *x, double *g) except -1:
        """g ← Hx − b; one product."""
        self.H(x, g)
        add(-1.0, self.rhs, g, self.n)
        return 0

    cdef int lengths_along(self, double *p, double *Hp) except -1:
        """Hp ← H p, and `line` ← the `lengths` of x − αp; one product."""
        self.H(p, Hp)
        self.set.lengths(self.x, self.g, p, Hp, &self.line)
        return 0

    # Step 2. The conjugate gradient step

    cdef int minimise_along_p(self) except -1:
        """Take the CG step along `line` and compute the next direction.

        If rounding has reintroduced components of the gradient along earlier
        directions, the cost is again minimised along all of them, without a product,
        provided that ‖φ‖ has been halved since the last such minimisation.
        """
        cdef double length = self.line.cg, curvature = self.line.curvature
        cdef const double *z
        cdef bint knows_Cx = self.knows_Cx
        cdef bint drifts = self.directions.count and (
            self.line.slope < MIN_SLOPE_RATIO * self.expected_slope
            and 4 * self.parts.phi_square < self.phi_square_at_drift
        )
        self.record_cost(change_along(&self.line, length))
        if self.expansion == SPECTRAL:
            self.spectral_length = dot(self.p, self.p, self.n) / curvature
        if drifts and self.line.slope <= 0:
            length = 0.0
        else:
            self.directions.add(self.p, self.Hp, curvature)
        self.to(length, self.p, self.Hp)
        if drifts:
            self.minimise_along_directions()
            self.phi_square_at_drift = self.parts.phi_square
            self.first_direction()
            self.expected_slope = self.directions.conjugate(self.phi, self.p)
            return 0
        # `Cv` contains Cp, which the product Hp has stored
        add(-length, self.Cv, self.Cx, self.rows.r)
        self.knows_Cx = knows_Cx
        if self.inverse is not None and not self.uses_M and self.inverse.is_accurate:
            self.uses_M = self.inverse.enter(self.free)
        z = self.preconditioned_gradient()
        if self.directions.count:  # p is one of the stored directions
            memcpy(self.p, z, self.n * sizeof(double))
            self.expected_slope = self.directions.conjugate(self.phi, self.p)
            return 0
        update_direction(z, dot(z, self.Hp, self.n) / curvature, self.p, self.n)
        return 0

    cdef void to(self, double alpha, const double *p, const double *Hp) noexcept:
        """x ← x − αp; update the gradient, `parts` and the face without a product."""
        self.set.advance(alpha, self.x, self.g, p, Hp, self.B.tau, self.phi, self.free,
                         &self.parts)
        self.knows_Cx = False

    # Step 3. Expansion

    cdef int expand(
        self, bint is_first, long most, double enough, bytearray trace
    ) except -1:
        """Expand the active set; return the letter of the step, or 0 without a step.

        is_first : True for the first expansion of the run
        most, enough : see `minimise_beyond`
        """
        cdef Py_ssize_t n = self.n
        cdef double required  # twice the decrease of the cost that x2 must attain
        self.knows_Cx = False
        if self.expansion == MODEL:
            return self.expand_by_model(is_first, most, enough, trace)
        if self.expansion == SPECTRAL:
            return b"e" if self.expand_spectrally() else 0
        self.trial_of_rule(self.x2)
        # 2 φ̃ᵀφ/(2‖H‖), because B = τI with τ = ‖H‖/`alpha` here
        required = self.parts.reduced_square / (self.alpha * self.B.tau)
        self.gradient(self.x2, self.g2)
        if self.cost(self.x2, self.g2) <= self.cost(self.x, self.g) - required:
            memcpy(self.x, self.x2, n * sizeof(double))
            memcpy(self.g, self.g2, n * sizeof(double))
            self.split()
            return b"e"
        self.to(self.line.feasible, self.p, self.Hp)
        # Π(x − alpha_bar * phi)
        self.set.project(self.x, 1 / self.B.tau, self.phi, self.x2)
        memcpy(self.x, self.x2, n * sizeof(double))
        self.gradient(self.x, self.g)
        self.split()
        return b"f"

    cdef int expand_spectrally(self) except -1:
        """Step to the boundary, and store the length of the next spectral step."""
        if self.line.curvature > NOISE * self.line.slope:
            self.spectral_length = (
                dot(self.p, self.p, self.n) / self.line.curvature
            )
        self.record_cost(change_along(&self.line, self.line.feasible))
        self.to(self.line.feasible, self.p, self.Hp)
        return 1

    cdef int trial_of_rule(self, double *y) except -1:
        """y ← Π(x_trial − x̃) with the trial point x_trial of a subclass's step rule.

        The rule receives x = x̃ + ν, and the gradient and lengths of the augmented
        Lagrangian of the original QP, without the factor 1/‖𝒫F𝒫‖ of H.
        """
        cdef Py_ssize_t i, n = self.n
        cdef const double *shift = self.rows.x_tilde
        cdef double size = 1 / self.inverse_norm
        arrays = np.empty((5, n))
        cdef double *x = address(arrays)
        for i in range(n):
            x[i] = shift[i] + self.x[i]
            x[n + i] = size * self.g[i]
            x[2 * n + i] = size * self.p[i]
            x[3 * n + i] = shift[i] + self.lower[i]
            x[4 * n + i] = shift[i] + self.upper[i]
        trial = self.step_rule(Step(
            *arrays, self.line.cg * self.inverse_norm,
            self.line.feasible * self.inverse_norm, self.inverse_norm / self.B.tau,
        ))  # fmt: skip
        copy_result(trial, n, y, "the trial point of the step rule")
        for i in range(n):
            if not isfinite(y[i]):
                raise ValueError("the step rule returned a point that is not finite")
        add(-1.0, shift, y, n)
        self.set.project(y, 0.0, y, y)
        return 0

    cdef int expand_by_model(
        self, bint is_first, long most, double enough, bytearray trace
    ) except -1:
        """Project the infeasible CG point z onto the set in the metric of the model.

        The CG point is z = x − α_cg p. In a flat spectrum, CG continues from z on the
        face without its bounds. If B ≥ H, f(z + r) ≤ f(z) + g(z)ᵀr + ½rᵀBr. The point
        z + r minimises the right-hand side over the set, where the tail of B is divided
        by the relaxation factor ᾱ‖H‖ of gradient projection. Components that the half
        step (the step to the boundary) moves to the boundary stay there, except in the
        first expansion with a model that has directions, because the earlier active set
        is only a guess. From the half step, the method moves along the line through
        z + r: at least to z + r if the cost there is below the cost at x, otherwise to
        the minimiser along the line. If B = τI and the decrease is less than φ̃ᵀφ/2τ,
        that of gradient projection for τ ≥ ‖H‖, such a step from x is taken instead.
        """
        cdef Py_ssize_t i, n = self.n
        cdef double *s = self.s
        cdef double *Hs = self.Hs
        cdef double *z = self.x2
        cdef double *z_g = self.g2
        cdef double *low = <double *> self.face_set.lower
        cdef double *high = <double *> self.face_set.upper
        cdef double cg = self.line.cg, feasible = self.line.feasible, tau = self.B.tau
        cdef double beyond = cg - feasible if isfinite(cg) else 0.0, length, r, noise
        # change of the cost from x
        cdef double change = change_along(&self.line, feasible)
        cdef double least = self.parts.reduced_square / (2 * tau)
        cdef bint is_flat = self.B.basis is None, release = is_first and not is_flat
        memcpy(self.x0, self.x, n * sizeof(double))
        memcpy(self.g0, self.g, n * sizeof(double))
        memcpy(self.marked, self.free, n * sizeof(double))
        self.to(feasible, self.p, self.Hp)
        for i in range(n):
            low[i] = self.set.lower[i] if release or self.free[i] else self.x[i]
            high[i] = self.set.upper[i] if release or self.free[i] else self.x[i]
            z[i] = self.x[i] - beyond * self.p[i]
            z_g[i] = self.g[i] - beyond * self.Hp[i]
        if beyond and is_flat:
            self.minimise_beyond(most, enough, trace)
        self.B.tau = tau / self.alpha
        self.B.step(z, z_g, self.face_set, s)
        self.B.tau = tau
        for i in range(n):  # from x to z + s; to a bound within rounding of it
            r, noise = z[i] + s[i], STEP_ROUNDING * (fabs(z[i]) + fabs(s[i]))
            r = high[i] if high[i] - r <= noise else r
            s[i] = (low[i] if r - low[i] <= noise else r) - self.x[i]
        if dot(self.g, s, n) >= 0:
            memcpy(z, self.x, n * sizeof(double))
            memcpy(z_g, self.g, n * sizeof(double))
            self.B.step(self.x, self.g, self.face_set, s)
        length = self.searched(s, Hs)
        if isinf(length):
            return 0
        if length:
            if change_along(&self.line, 1.0) + change < 0:
                length = fmax(length, 1.0)
            change += change_along(&self.line, length)
            for i in range(n):  # the rest r of the step beyond z, and Hr
                z[i] = self.x[i] - s[i] - z[i]
                z_g[i] = self.g[i] - Hs[i] - z_g[i]
            self.B = self.B.raised(z, z_g)
            self.to(length, s, Hs)
        else:
            self.split()
        if is_flat and -change < least:
            return self.project_gradient(tau)
        return b"e"

    cdef int minimise_beyond(self, long most, double enough, bytearray trace) except -1:
        """Continue CG from z on the face `marked` without its bounds.

        enough : ‖φ‖² at which CG stops, the value of ‖φ‖² when the face was entered
        most : largest number of steps: the number of CG steps on this face, but at
            least 1
        """
        cdef Py_ssize_t n = self.n
        cdef long step
        cdef double curvature = dot(self.p, self.Hp, n), length = 0.0
        cdef double *z = self.phi
        for step in range(most + 1):
            add(-length, self.p, self.x2, n)
            add(-length, self.Hp, self.g2, n)
            masked(self.marked, self.g2, self.phi, n)
            if step == most or dot(self.phi, self.phi, n) <= enough:
                break
            if self.factor is not None:
                z = self.t
                self.factor.inverse(self.phi, z)
            update_direction(z, dot(z, self.Hp, n) / curvature, self.p, n)
            self.H(self.p, self.Hp)
            trace.append(c'b')
            curvature = dot(self.p, self.Hp, n)
            if curvature <= 0:
                break
            length = dot(self.phi, self.p, n) / curvature
        return 0

    cdef int project_gradient(self, double tau) except -1:
        """Take a gradient projection step from the point before the expansion."""
        cdef Py_ssize_t n = self.n
        cdef double length
        memcpy(self.x, self.x0, n * sizeof(double))
        memcpy(self.g, self.g0, n * sizeof(double))
        self.split()
        self.set.minimise(self.x, self.phi, tau, self.s)
        length = self.searched(self.s, self.Hs)
        if length == 0 or isinf(length):
            return 0
        self.B = self.B.raised(self.s, self.Hs)
        self.to(length, self.s, self.Hs)
        return b"f"

    # Step 5. Sums of the stopping tests

    cdef double cost(self, const double *x, const double *g) noexcept:
        """Return xᵀHx − 2bᵀx, twice the cost, from the gradient; `size` ← Σ|terms|."""
        cdef double term, sum_ = 0.0
        cdef Py_ssize_t i
        self.size = 0.0
        for i in range(self.n):
            term = x[i] * (g[i] - self.rhs[i])
            sum_ += term
            self.size += fabs(term)
        return sum_

    cdef double violation(self) except? -1:
        """Return ‖Cx‖ at the iterate; CG steps update Cx without a product."""
        if not self.knows_Cx:
            self.rows.times(self.x, self.Cx)
            self.knows_Cx = True
        return self.rows.size(self.Cx)
