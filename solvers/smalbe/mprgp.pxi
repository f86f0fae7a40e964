# MPRGP over the operations of this folder: it knows neither bounds nor processes.


# Rounding of a cost, relative to the sum of its absolute terms: errors of k terms grow
# like √k·2⁻⁵³, so that this covers 8·10⁵ of them. With zero,
# `test_a_solve_that_rounding_stops_ends` takes 4000 products for 1000.
cdef double NOISE = 1e-13

# Least slope along a direction of CG, relative to that of z, of which it is the part
# conjugate to those before. In exact arithmetic both are the same, as the gradient is
# orthogonal to all directions taken. Below, the gradient has drifted: more is to be gained
# along these. Without it `test_rounding_along_directions_that_were_taken_is_taken_out`
# fails.
cdef double DRIFT = 0.5

cdef enum:
    # Directions of CG that are kept on a face: two passes over them are 400 vectors, what
    # a product with a dense F of 800 unknowns reads. With 3 of them
    # `test_conjugate_to_all_directions_cg_ends_after_as_many_steps_as_unknowns` fails.
    KEPT = 200
    # Proportionings by the model that did not halve ‖β‖², before one along −β. Without a
    # limit `test_a_model_that_leaves_the_chopped_gradient_gives_way` fails.
    MOST_IDLE = 2
    # Steps of a run after which its progress is looked at first, ten times what a
    # preconditioned dual takes. `test_a_solve_that_rounding_stops_ends` fails without it.
    FIRST_LOOK = 500
    # CG steps on a face before a factor is brought to it that has components besides. A
    # factor costs as much as two or three steps; with 2, as with a factor for every face,
    # bearings and torsion with n = 100 to 300 take up to a quarter more time.
    SETTLED = 5
    # Least number of CG steps that may be taken beyond the boundary with a factor, which
    # needs few to say where a face ends: with 1, torsion with n = 300 takes 293 products
    # for 186, and a bearing with n = 600 318 for 274.
    BEYOND = 8
    STD = 0
    PROJCG = 1
    MIXED = 2
    MODEL = 3


cdef double change_along(const Line *line, double alpha) noexcept:
    """Return f(x − αp) − f(x)."""
    return -alpha * line.slope + 0.5 * alpha**2 * line.curvature


cdef double *enlarged(double *held, Py_ssize_t size) except NULL:
    """Make room for so many numbers, and keep those that are there."""
    held = <double *> realloc(held, max(size, 1) * sizeof(double))
    if not held:
        raise MemoryError
    return held


@cython.final
cdef class Directions:
    """The last conjugate directions that CG took on a face, scaled to pᵢᵀHpⱼ = δᵢⱼ.

    In exact arithmetic CG is conjugate to all k of them through the last. Rounding
    undoes that after some dozens of steps, and a new right-hand side on the same face
    (a multiplier step's) at once. With all of them at hand neither does, for two passes
    over k vectors a step (Farhat, Crivelli and Roux, Comput. Methods Appl. Mech. Engrg.
    117, 1994, 195-209).

    free : the face, 1 where a component is off the boundary (n,)
    """

    cdef Py_ssize_t n, count, most, oldest, room
    cdef Reduction over
    cdef double *p  # (room, n)
    cdef double *Hp
    cdef double *share
    cdef double *free

    def __cinit__(self, Py_ssize_t n, Py_ssize_t most, Reduction over):
        self.n, self.most, self.over = n, most, over
        self.share = <double *> calloc(most + 1 + n, sizeof(double))
        if not self.share:
            raise MemoryError
        self.free = self.share + most + 1

    def __dealloc__(self):
        give_back(self.p)
        give_back(self.Hp)
        give_back(self.share)

    cdef void begin(self, const double *free) noexcept:
        """Forget all, on another face."""
        self.count = self.oldest = 0
        if self.n and self.most:
            memcpy(self.free, free, self.n * sizeof(double))

    cdef bint is_on(self, const double *free) except -1:
        """Return whether they are directions on that face."""
        return not self.over.any(not same(self.free, free, self.n))

    cdef int add(self, const double *p, const double *Hp, double curvature) except -1:
        """Add one with pᵀHp, in place of the oldest where there are too many."""
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

    cdef double conjugate(self, const double *phi, double *p) except? -1:
        """Take from p its part along them; returns φᵀp before that, 0 without any."""
        if not self.count:
            return 0.0
        rows_times(self.Hp, p, self.share, self.count, self.n)
        self.share[self.count] = dot(phi, p, self.n)
        self.over.add(self.share, self.count + 1)
        add_combination(-1.0, self.p, self.share, p, self.count, self.n)
        return self.share[self.count]

    cdef int minimise(self, const double *g, double *s, double *Hs) except -1:
        """Find s and Hs, for which x − s minimises the cost along all of them."""
        rows_times(self.p, g, self.share, self.count, self.n)
        self.over.add(self.share, self.count)
        memset(s, 0, self.n * sizeof(double))
        memset(Hs, 0, self.n * sizeof(double))
        add_combination(1.0, self.p, self.share, s, self.count, self.n)
        add_combination(1.0, self.Hp, self.share, Hs, self.count, self.n)
        return 0


cdef class MPRGP:
    """Modified proportioning with reduced gradient projections.

    Minimises ½xᵀHx − bᵀx over a set (Dostál 2009, the paper's reference [3], Chapter 5;
    Dostál and Schöberl 2005), H = 𝒫F𝒫/‖𝒫F𝒫‖ + ρQ. With the gradient g = Hx − b, the
    free gradient φ (g where x is off the boundary), the chopped gradient β (the part of
    g on the boundary that leads inside) and the projected gradient g^P = φ + β, each
    step is one of

    * c, conjugate gradient: minimise along p on the face, if that stays feasible; p is
      made conjugate to all `Directions` taken on the face, not to the last alone
    * b, beyond: conjugate gradients on the face as if it had no boundary, for the
      expansion
    * e, expansion of the active set, by one of the expansions of
      `solvers.smalbe.options`
    * f, fallback: an expansion that gained too little, done anew in the safe way
    * p, proportioning: free components, by the model or along −β

    Proportioning when  ‖β‖² > Γ² φ̃ᵀφ,  with the reduced free gradient φ̃ that no step
    of length ᾱ = 1/τ takes beyond the boundary.

    Every step but projcg's lessens the cost, and by the model τI as much as the rate of
    the book needs. Expansion never frees a component that the half step left on the
    boundary, but for the first expansion by a model of directions: from one
    proportioning to the next the active set only grows. docs/smalbe.md: what follows.
    """

    cdef Product F
    cdef Py_ssize_t n
    cdef Rows rows
    cdef Box set
    cdef Box face_set  # of the step that follows a half step
    cdef Reduction over
    cdef double inverse_norm, rho
    cdef double alpha, Gamma_square
    cdef bint reduced, proportions_by_model
    cdef int expansion
    cdef bint in_two  # whether CG steps go through memory twice: φ, `free` not stored
    cdef Room room  # of all that is written
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
    cdef double *Cx  # where it is known, see `violation`
    cdef bint knows_Cx
    cdef Line line  # along which the last product was
    cdef Parts parts  # of the gradient at x
    cdef double sums[2]
    cdef double z_Hp
    cdef double expected_slope  # φᵀz, of which p is the part conjugate to `directions`
    cdef double at_drift  # ‖φ‖² when rounding along them was taken out last
    cdef Model B  # of H; ᾱ = 1/τ is the length of gradient projection steps
    cdef Model preconditioner  # inverted in the face; None for none
    cdef object M  # v → Mv of a structural preconditioner; None for none
    cdef double M_scale  # ‖𝒫F𝒫‖, for M is one of F
    cdef object counts  # of its products
    cdef IncompleteFactor factor  # of the free part of a sparse P; None for none
    cdef long layers  # of neighbours that a proportioning lets go as well
    cdef Directions directions

    cdef int make_room(self) except -1:
        """Make room for the vectors."""
        cdef Py_ssize_t n = self.n, r = self.rows.r
        self.room = Room(16 * n + 3 * r)
        cdef double *at = self.room.at
        self.x, self.g, self.p, self.Hp = at, at + n, at + 2 * n, at + 3 * n
        at += 4 * n
        self.phi, self.free, self.z, self.s = at, at + n, at + 2 * n, at + 3 * n
        at += 4 * n
        self.Hs, self.t, self.x2, self.g2 = at, at + n, at + 2 * n, at + 3 * n
        at += 4 * n
        self.face_set = Box.of(at, at + n, n, self.over)
        self.rhs, self.g0 = at + 2 * n, at + 3 * n
        self.x0 = self.z  # which is found anew after each expansion
        at += 4 * n
        self.Cv, self.Cw, self.Cx = at, at + r, at + 2 * r
        return 0

    # the algorithm

    cdef bint minimise(self, long most, bytearray trace, note) except -1:
        """Run MPRGP from x and g; return whether it stopped by `stops`.

        Else it took `most` steps, no step leads on, or it *stagnates*: over as many
        steps as it took before these (at least `FIRST_LOOK`), the least ‖g^P‖ was not
        halved and the cost fell by no more than the rounding of its terms. Rounding then
        leaves no direction that is conjugate to those before and along which the cost
        falls.

        trace : the letters of the steps are added to it
        note : called with letter, x and g after each step; None for nobody
        """
        cdef long idle = 0, inside = 0  # CG steps in this face
        cdef long look = FIRST_LOOK
        cdef double least = INFINITY, before = INFINITY, cost = INFINITY  # at last look
        cdef int letter
        cdef bint has_expanded = False
        cdef double chopped = INFINITY  # ‖β‖² at the last proportioning
        cdef double weight, began, gamma = 0.0  # of p ← φ − γp, where that is put off
        self.in_two = self.F.rows.data != NULL and not self.rows.exist and (
            not self.is_preconditioned()
        )
        # 1. The face of x, the minimum along the directions that are known on it, and
        #    the first direction of conjugate gradients.
        self.split()
        self.minimise_along_directions()
        began, self.at_drift = self.parts.phi_square, INFINITY
        self.layers = 0
        self.first_direction()
        self.expected_slope = self.directions.conjugate(self.phi, self.p)
        while True:
            PyErr_CheckSignals()  # an interrupt ends it
            # 2. Stop where the projected gradient is small, or rounding is all there is.
            if self.stops():
                return 1
            if len(trace) >= most:
                return 0
            least = fmin(least, self.parts.phi_square + self.parts.beta_square)
            if len(trace) >= look:
                self.terms_of_cost()
                if not cost - self.sums[0] > NOISE * self.sums[1] and 4 * least > before:
                    return 0
                before, least, cost = fmin(least, before), INFINITY, self.sums[0]
                look = 2 * len(trace)
            weight = self.parts.reduced_square if self.reduced else self.parts.phi_square
            if self.parts.beta_square > self.Gamma_square * weight:
                # 3. Proportioning: more is to be gained on the boundary than inside.
                idle = idle + 1 if self.parts.beta_square > chopped / 2 else 0
                chopped = self.parts.beta_square
                letter = self.proportion(
                    self.proportions_by_model
                    and (idle < MOST_IDLE or self.B.basis is None)
                )
            else:
                # 4. The trial step of conjugate gradients: α_cg, and α_f, as far as
                #    it is feasible.
                if self.in_two:
                    self.lengths_of_next(gamma)
                else:
                    self.lengths_along(self.p, self.Hp)
                if isinf(fmin(self.line.cg, self.line.feasible)):
                    return 0
                if self.line.cg <= self.line.feasible:
                    # 5. Conjugate gradient step, and the next direction.
                    gamma = self.minimise_along_p()
                    self.tell(b"c", trace, note)
                    inside += 1
                    if inside == SETTLED and self.factor is not None:
                        self.settle()
                    continue
                # 6. Expansion: the face has a boundary in the way.
                letter = self.expand(
                    not has_expanded,
                    max(inside, 1 if self.factor is None else BEYOND), began, trace
                )
                self.layers = 0
                has_expanded = True
            if not letter:
                return 0
            # 7. On the new face, begin anew with the preconditioned free gradient.
            self.directions.begin(self.free)
            inside, began, gamma = 0, self.parts.phi_square, 0.0
            self.at_drift = INFINITY
            self.first_direction()
            self.tell(letter, trace, note)

    cdef int settle(self) except -1:
        """Begin CG anew on this face if the factor has components besides."""
        if self.factor.idle:
            self.factor.enter(self.free)
            memcpy(self.p, self.preconditioned_gradient(), self.n * sizeof(double))
        return 0

    cdef bint stops(self) except -1:
        """Return whether the present point is precise enough."""
        raise NotImplementedError

    cdef int tell(self, int letter, bytearray trace, note) except -1:
        trace.append(letter)
        if note is not None:
            note(chr(letter), self.over.vector(copied(self.x, self.n)),
                 self.over.vector(copied(self.g, self.n)))
        return 0

    # 1. The face

    cdef int split(self) except -1:
        """Split the gradient at x by the face on which x lies."""
        return self.set.split(
            self.x, self.g, self.B.tau, self.phi, self.free, &self.parts
        )

    cdef int minimise_along_directions(self) except -1:
        """Minimise along the directions known on this face, as far as is feasible."""
        if not self.directions.most:
            return 0
        if self.directions.count and self.directions.is_on(self.free):
            self.directions.minimise(self.g, self.s, self.Hs)
            self.set.lengths(self.x, self.g, self.s, self.Hs, &self.line)
            if self.line.slope > 0:
                self.to(fmin(self.line.cg, self.line.feasible), self.s, self.Hs)
        if not self.directions.is_on(self.free):
            self.directions.begin(self.free)
        return 0

    cdef bint is_preconditioned(self) noexcept:
        if self.M is not None or self.factor is not None:
            return True
        # B = τI would only change the lengths of directions
        return self.preconditioner is not None and self.preconditioner.basis is not None

    cdef int first_direction(self) except -1:
        """Prepare the preconditioner for the face, and let p be the direction z."""
        if self.in_two:
            memset(self.p, 0, self.n * sizeof(double))  # φ is added with the product
            return 0
        if self.factor is not None:
            self.factor.enter(self.free, True)
        elif self.is_preconditioned():
            self.preconditioner.enter(self.free)
        memcpy(self.p, self.preconditioned_gradient(), self.n * sizeof(double))
        return 0

    cdef const double *preconditioned_gradient(self) except NULL:
        """Return z, φ preconditioned in the face; this process' zᵀHp is kept.

        With P = B_FF⁻¹ of the model alone, z = Pφ; with a structural M, which does not
        know of ρQ, z = P(‖𝒫F𝒫‖ M − I)Pφ + Pφ (`solvers.smalbe.preconditioner`).
        """
        cdef Py_ssize_t i, n = self.n
        cdef double *rest = self.t
        cdef double *again = self.s
        if not self.is_preconditioned():
            return self.phi
        if self.factor is not None:
            self.z_Hp = self.factor.inverse(self.phi, self.Hp, self.z)
            return self.z
        self.z_Hp = self.preconditioner.inverse(self.free, self.phi, self.Hp, self.z)
        if self.M is not None:
            self.counts["preconditioner_applies"] += 1
            take(self.M(self.over.vector(seen(self.z, n))), n, again, "M @ v")
            for i in range(n):
                rest[i] = self.free[i] * (self.M_scale * again[i] - self.z[i])
            self.z_Hp += self.preconditioner.inverse(self.free, rest, self.Hp, again)
            add(1.0, again, self.z, n)
        return self.z

    # 3. Proportioning

    cdef int proportion(self, bint by_model) except -1:
        """Take a step that frees components; 0 where none leads on.

        It ends at the opposite boundary at the latest.
        """
        cdef double *beta = self.s
        cdef double length
        if by_model and self.factor is not None:
            return b"p" if step_by_factor(self) else 0
        if by_model:
            return b"p" if self.step_by_model() else 0
        self.set.chop(self.x, self.g, beta)
        self.lengths_along(beta, self.Hs)
        length = fmin(self.line.cg, self.line.feasible)
        if isinf(length):
            return 0
        self.to(length, beta, self.Hs)
        return b"p"

    cdef int step_by_model(self) except -1:
        """Minimise the model over the set, then the cost along that step.

        0 where there is nothing to gain, or the cost falls without end. Above H, the
        model makes the minimising length at least 1. Where the product shows that it is
        not above, it is raised; the line search lessens the cost anyway.
        """
        cdef double length
        self.B.step(self.x, self.g, self.set, self.s)
        length = self.searched(self.s, self.Hs)
        if length == 0 or isinf(length):
            return 0
        if self.line.cg < 1:
            self.raise_model(self.s, self.Hs)
        self.to(length, self.s, self.Hs)
        return 1

    cdef double searched(self, double *s, double *Hs) except? -1:
        """Find the length along s of the least cost, in the set where 1 is not beyond.

        0 for s = 0, inf where the cost falls without end. It turns s round, so that
        x − αs is where it leads, and leaves its `lengths` in `line`; one product.
        """
        if not self.over.any(turn_round(s, self.n)):
            return 0
        self.lengths_along(s, Hs)
        return fmin(self.line.cg, fmax(1.0, self.line.feasible))

    cdef int raise_model(self, const double *s, const double *Hs) except -1:
        """Raise the model to what a product shows."""
        cdef double sums[2]
        sums[0], sums[1] = dot(s, s, self.n), dot(s, Hs, self.n)
        self.over.add(sums, 2)
        self.B = self.B.raised(s, sums[0], sums[1])
        return 0

    # 4. The trial step

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
        """Hp ← H p, and the `lengths` of x − αp, which are kept in `line`; one product."""
        if self.rows.exist or not self.F.rows.data:
            self.H(p, Hp)
            self.set.lengths(self.x, self.g, p, Hp, &self.line)
            return 0
        self.F.count += 1
        self.set.product_and_lengths(
            &self.F.rows, self.inverse_norm, self.x, self.g, p, Hp, &self.line
        )
        return 0

    cdef int lengths_of_next(self, double gamma) except -1:
        """p ← φ − γp, and the `lengths_along` it; one product."""
        self.F.count += 1
        self.set.next_product_and_lengths(
            &self.F.rows, self.inverse_norm, gamma, self.x, self.g, self.p, self.Hp,
            &self.line,
        )
        return 0

    # 5. The conjugate gradient step

    cdef double minimise_along_p(self) except? -1:
        """Take the CG step along `line`, and find the next direction.

        Where rounding has brought the gradient back along directions that were taken,
        minimise along all of them again, without a product; but only where ‖φ‖ has been
        halved since the last time, or rounding is all that is left of it.

        Return γ of p ← φ − γp where that is put off, 0 else.
        """
        cdef double length = self.line.cg, curvature = self.line.curvature, z_Hp
        cdef const double *z
        cdef bint knows_Cx = self.knows_Cx
        cdef bint drifts = self.directions.count and (
            self.line.slope < DRIFT * self.expected_slope
            and 4 * self.parts.phi_square < self.at_drift
        )
        if drifts and self.line.slope <= 0:
            length = 0.0
        elif not self.in_two:
            self.directions.add(self.p, self.Hp, curvature)
        self.to(length, self.p, self.Hp)
        if drifts:
            self.minimise_along_directions()
            self.at_drift = self.parts.phi_square
            self.first_direction()
            self.expected_slope = self.directions.conjugate(self.phi, self.p)
            return 0
        add(-length, self.Cv, self.Cx, self.rows.r)  # Cp, of the product Hp
        self.knows_Cx = knows_Cx
        z_Hp = self.parts.phi_Hp
        if self.in_two:
            return z_Hp / curvature
        z = self.preconditioned_gradient()
        if self.directions.count:  # p is one of them
            memcpy(self.p, z, self.n * sizeof(double))
            self.expected_slope = self.directions.conjugate(self.phi, self.p)
            return 0
        if z != self.phi:
            z_Hp = self.over.total(self.z_Hp)
        turn(z, z_Hp / curvature, self.p, self.n)
        return 0

    cdef int to(self, double alpha, const double *p, const double *Hp) except -1:
        """x ← x − αp, and its face; the gradient follows without a product."""
        cdef bint stored = not self.in_two
        self.set.advance(alpha, self.x, self.g, p, Hp, self.B.tau,
                         self.phi if stored else NULL, self.free if stored else NULL,
                         &self.parts)
        self.knows_Cx = False
        return 0

    # 6. Expansion

    cdef int expand(
        self, bint is_first, long most, double enough, bytearray trace
    ) except -1:
        """Expand the active set; returns the letter of the step, 0 where none leads on.

        is_first : of the run; most, enough : see `minimise_beyond`
        """
        cdef Py_ssize_t n = self.n
        cdef double cg = self.line.cg
        self.knows_Cx = False
        if self.expansion in (PROJCG, MIXED) and isfinite(cg):
            self.set.project(self.x, cg, self.p, self.x2)
            self.gradient(self.x2, self.g2)
            if self.expansion == PROJCG or (
                self.cost(self.x2, self.g2) <= self.cost(self.x, self.g)
            ):
                memcpy(self.x, self.x2, n * sizeof(double))
                memcpy(self.g, self.g2, n * sizeof(double))
                self.split()
                return b"e"
        if self.expansion == MODEL:
            return self.expand_by_model(is_first, most, enough, trace)
        self.to(self.line.feasible, self.p, self.Hp)
        self.set.project_free(self.x, self.g, self.B.tau, self.x2)
        memcpy(self.x, self.x2, n * sizeof(double))
        self.gradient(self.x, self.g)
        self.split()
        return b"f" if self.expansion == MIXED else b"e"

    cdef int expand_by_model(
        self, bint is_first, long most, double enough, bytearray trace
    ) except -1:
        """Project z, where CG leads beyond the set, on it in the metric of the model.

        z is x − α_cg p, and in a flat spectrum, where active sets change least in a
        step, what CG makes of it on the face without a boundary. The cost is known at z
        and beyond it bounded by the model where that is above H,

            f(z + r) ≤ f(z) + g(z)ᵀr + ½rᵀBr,

        and z + r is where the right side is least, with the tail of B divided by the
        relaxation, as gradient projection steps are longer than 1/‖H‖. What the half
        step left on the boundary stays there, unless this is the first expansion, before
        which the active set is a guess, and the model knows more than a norm. From the
        half step it goes all the way to z + r if the cost ends below that at x, else as
        far as that lessens the cost. Where B = τI and that is less than φ̃ᵀφ/2τ, by which
        gradient projection from x lessens the cost where τ ≥ ‖H‖, this is what is done.
        """
        cdef Py_ssize_t n = self.n
        cdef double *s = self.s
        cdef double *Hs = self.Hs
        cdef double *z = self.x2
        cdef double *z_g = self.g2
        cdef double cg = self.line.cg, feasible = self.line.feasible, tau = self.B.tau
        cdef double beyond = cg - feasible if isfinite(cg) else 0.0, length, slope
        cdef double change = change_along(&self.line, feasible)  # of the cost, from x
        cdef double least = self.parts.reduced_square / (2 * tau)
        cdef bint is_flat = self.B.basis is None, release = is_first and not is_flat
        self.set.leave(feasible, beyond, release, self.x, self.g, self.p, self.Hp,
                       self.x0, self.g0, self.free, self.face_set, z, z_g)
        if beyond and is_flat:
            self.minimise_beyond(most, enough, trace)
        if is_flat:
            slope = self.face_set.minimise_near(
                z, z_g, tau / self.alpha, self.x, self.g, s
            )
        else:
            self.B.tau = tau / self.alpha
            self.B.step(z, z_g, self.face_set, s)
            self.B.tau = tau
            slope = self.face_set.within(z, self.x, self.g, release, s)
        if slope >= 0:
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
            rest_of_step(self.x, self.g, s, Hs, z_g, z, n, self.sums)
            self.over.add(self.sums, 2)
            self.B = self.B.raised(z, self.sums[0], self.sums[1])
            self.to(length, s, Hs)
        else:
            self.split()
        if is_flat and -change < least:
            return self.project_gradient(tau)
        return b"e"

    cdef int minimise_beyond(self, long most, double enough, bytearray trace) except -1:
        """Go on with CG from z on the face as if it had no boundary.

        Until ‖φ‖² is what it was when the face was entered, `enough`, and for at most as
        many steps as were taken inside (one, if there were none; BEYOND, if CG is
        preconditioned by a factor and took fewer).
        """
        cdef Py_ssize_t n = self.n
        cdef long step
        cdef double curvature = self.over.total(dot(self.p, self.Hp, n)), slope
        advance_freely(0.0, self.x2, self.g2, self.p, self.Hp, self.free, n, self.sums)
        self.over.add(self.sums, 2)
        for step in range(most):
            if self.sums[0] <= enough:
                break
            if self.factor is not None:
                masked(self.free, self.g2, self.phi, n)
                self.sums[1] = self.factor.inverse(self.phi, self.Hp, self.t)
            self.turn_beyond(self.sums[1] / curvature)
            slope, curvature = self.sums[0], self.sums[1]
            trace.append(c'b')
            if curvature <= 0:
                break
            advance_freely(slope / curvature, self.x2, self.g2, self.p, self.Hp,
                           self.free, n, self.sums)
            self.over.add(self.sums, 2)
        return 0

    cdef int turn_beyond(self, double gamma) except -1:
        """p ← φ − γp at z, Hp ← H p; `sums` are φᵀp and pᵀHp; one product."""
        if self.factor is not None:
            turn(self.t, gamma, self.p, self.n)
            self.H(self.p, self.Hp)
            self.sums[0] = dot(self.phi, self.p, self.n)
            self.sums[1] = dot(self.p, self.Hp, self.n)
            return 0
        if self.rows.exist or not self.F.rows.data:
            self.sums[0] = turn_freely(self.g2, self.free, gamma, self.p, self.n)
            self.H(self.p, self.Hp)
            self.sums[1] = dot(self.p, self.Hp, self.n)
            return self.over.add(self.sums, 2)
        self.F.count += 1
        sparse_turn_freely(&self.F.rows, self.inverse_norm, self.g2, self.free, gamma,
                           self.p, self.Hp, self.sums)
        return 0

    cdef int project_gradient(self, double tau) except -1:
        """Take the step of plain gradient projection from where the expansion began."""
        cdef Py_ssize_t n = self.n
        cdef double length
        memcpy(self.x, self.x0, n * sizeof(double))
        memcpy(self.g, self.g0, n * sizeof(double))
        self.set.project_free(self.x, self.g, tau, self.s)
        add(-1.0, self.x, self.s, n)
        length = self.searched(self.s, self.Hs)
        if length == 0 or isinf(length):
            return 0
        self.raise_model(self.s, self.Hs)
        self.to(length, self.s, self.Hs)
        return b"f"

    # 2. Sums that say when to stop

    cdef double cost(self, const double *x, const double *g) except? -1:
        """Return xᵀHx − 2bᵀx, twice the cost, from the gradient."""
        cdef double sum_ = 0.0
        cdef Py_ssize_t i
        for i in range(self.n):
            sum_ += x[i] * (g[i] - self.rhs[i])
        return self.over.total(sum_)

    cdef int terms_of_cost(self) except -1:
        """Find `sums`, twice the cost at x, and the sum of its absolute terms."""
        cdef double term, sum_ = 0.0, size = 0.0
        cdef Py_ssize_t i
        for i in range(self.n):
            term = self.x[i] * (self.g[i] - self.rhs[i])
            sum_ += term
            size += fabs(term)
        self.sums[0], self.sums[1] = sum_, size
        return self.over.add(self.sums, 2)

    cdef double violation(self) except? -1:
        """Find ‖Cx‖ at the iterate; CG steps have brought Cx along."""
        if not self.knows_Cx:
            self.rows.times(self.x, self.Cx)
            self.knows_Cx = True
        return self.rows.size(self.Cx)
