# The outer loop, and the recovery of x and its multipliers.


# Largest penalty to which the safeguards of the outer loop increase ρ. The rounding error
# 2⁻⁵³ρ‖ν‖ of ρQν is then 1e-6·‖ν‖; a larger one would dominate the gradient
# (`test_rows_that_contradict_each_other_by_rounding_end_the_solve`).
cdef double MAX_RHO = 1e10
# Smallest τ of a model, relative to the norm. With zero, an F of low rank leads to τ = 0,
# so that no step is possible (`test_earlier_failures_do_not_recur`).
cdef double MIN_TAIL = 1e-4
# Value of ‖g^P‖ in units of tol‖b‖ below which the inner run ends even if the KKT
# residual exceeds the tolerance
cdef double LEAST_TESTED = 1e-2


@cython.final
cdef class SMALBE(MPRGP):
    """Semimonotonic augmented Lagrangians: the outer loop over MPRGP.

    The method minimises ½νᵀHν − bᵀν over a set, subject to Cν = 0, with H = 𝒫F𝒫/‖𝒫F𝒫‖ +
    ρQ, Q = CᵀC, 𝒫 = I − Q and orthonormal rows C (Dostál 2009, the paper's reference
    [3], Algorithm 6.1).

    problem : a `solvers.smalbe.projected.Projected`
    options : a `solvers.smalbe.options.Options`
    M : product v → Mv with a structural preconditioner, or None
    preconditioned : True if M or the model preconditions CG on the face
    step_rule : a `solvers.smalbe.extension.StepRule` that replaces the expansion, or
        None
    """

    cdef double norm, tail, b_size
    cdef bint plain, preconditioned
    cdef Py_ssize_t n_directions  # number of rows of C and Ritz vectors in the model
    cdef list owners  # references to the arrays that pointers refer to
    cdef Basis basis  # rows of C and Ritz vectors; None without any
    # (n_directions,) eigenvalues of the rows of `basis`, minus the tail
    cdef Room above
    cdef const double *b
    cdef const double *q
    cdef const double *diagonal  # NULL for an operator without a diagonal
    cdef double M_now, tol, small_gradient, coarse_gradient
    # (5n,) D⁻¹ᐟ² and workspace of the stopping test
    cdef Room tested
    cdef double force, energy  # lower bounds of the scales of `residual`
    cdef double aim  # largest accepted result of `residual`
    cdef double least_gradient, entry_gradient
    cdef bint solved  # True if `is_solved` ended the last inner run
    cdef double *scaled_q  # q/‖𝒫F𝒫‖
    cdef double next_tested  # ‖g^P‖ at or below which KKT residuals are evaluated next

    def __init__(self, problem, options, bint preconditioned, M=None, step_rule=None):
        cdef const double *lower
        cdef const double *upper
        spectrum, bounds = problem.spectrum, problem.bounds
        self.F, self.M, self.counts = problem.F, M, problem.counts
        self.is_semidefinite = problem.semidefinite
        self.M_map = M if isinstance(M, LinearMap) else None
        self.inverse = M if isinstance(M, ApproximateInverse) else None
        self.n = self.F.n
        self.norm = self.M_scale = spectrum.norm
        self.inverse_norm = 1 / self.norm
        self.owners, self.rows = [], problem.C
        self.b, self.q = read(problem.b, self.owners), read(problem.q, self.owners)
        lower, upper = read(bounds[0], self.owners), read(bounds[1], self.owners)
        self.lower, self.upper = lower, upper
        self.set = FeasibleSet.of(lower, upper, self.n)
        if problem.discs:
            self.set.add_discs(problem.discs, self.rows.x_tilde)
        if len(problem.diagonal):
            self.diagonal = read(problem.diagonal, self.owners)
        self.alpha, self.Gamma_square, self.eta = options.alpha, options.Gamma**2, options.eta
        if options.expansion == "spectral":
            self.Gamma_square *= SPECTRAL_GAMMA
        self.expansion = SPECTRAL if options.expansion == "spectral" else MODEL
        self.step_rule = step_rule
        if step_rule is not None:
            self.expansion = OWN
        self.plain = self.expansion != MODEL
        self.spectral_length = 0.0
        self.preconditioned = preconditioned
        self.factor, self.tail = problem.factor, 1.0
        self.tested = Room(5 * self.n)
        self.scaled_q = self.tested.at + 4 * self.n
        copy_scaled(self.inverse_norm, self.q, self.scaled_q, self.n)
        if len(problem.diagonal):
            memcpy(self.tested.at, self.diagonal, self.n * sizeof(double))
            scale(self.inverse_norm, self.tested.at, self.n)
        scales(self.tested.at, self.n)
        kept = MAX_DIRECTIONS if options.recycle and not self.F.is_sparse else 0
        if problem.discs and M is None:  # CG then takes few steps on a face
            kept = 0
        self.directions = Directions(self.n, kept)
        self.patience = <long>fmax(FIRST_NEWTON, sqrt(self.n))
        self.tangents = Directions(
            self.n, MAX_DIRECTIONS if self.expansion == SPECTRAL else 0
        )
        self.choose_directions(spectrum.ritz)
        self.make_room()

    # the model

    cdef int choose_directions(self, ritz) except -1:
        """Choose the directions of the models and the tail, the value of τ.

        The tail estimates the norm of 𝒫F𝒫 on the complement of the selected directions.
        It is the second to last Ritz value plus its residual, or the last one if the
        process ended because β = 0, or the first one whose residual exceeds its value.
        If it is too small, MPRGP increases τ to the curvature of its products. In a flat
        spectrum, where not even the first pair converges, only the norm is used, because
        other Ritz vectors would slow down CG; also with sparse rows, which usually come
        from many subdomains with a flat spectrum.
        """
        cdef Py_ssize_t i, n_directions, kept = 0, n = self.n, r = self.rows.r
        cdef const double *value = NULL
        cdef const double *residual = NULL
        cdef DenseBasis basis
        cdef list owners = []
        if ritz is not None:
            value, residual = read(ritz.values, owners), read(ritz.residuals, owners)
            n_directions = len(ritz.values)
            kept = max(n_directions - (1 if residual[n_directions - 1] <= 1e-10 * value[0] else 2), 0)
            for i in range(kept):
                if residual[i] > value[i]:
                    kept = i
                    break
            if residual[0] > RITZ_RESIDUAL * value[0]:
                kept = 0
            self.tail = fmax((value[kept] + residual[kept]) / self.norm, MIN_TAIL)
        self.n_directions = r if self.rows.coarse is not None else kept + r
        self.above = Room(self.n_directions)
        for i in range(self.n_directions):
            self.above.at[i] = -self.tail
            if i >= r:
                self.above.at[i] += (value[i - r] + residual[i - r]) / self.norm
        if self.rows.coarse is not None:
            self.basis = FactoredBasis.of(self.rows)
        elif self.n_directions:
            basis = DenseBasis.zeros(self.n_directions, n)
            memcpy(basis.U, self.rows.C, r * n * sizeof(double))
            if kept:
                memcpy(basis.U + r * n, read(ritz.vectors, owners), kept * n * sizeof(double))
            for i in range(r, r + kept):  # vectors of an earlier QP have other rows C
                rows_times(basis.U, basis.U + i * n, basis.c, i, n)
                if dot(basis.c, basis.c, i) <= 1e-24:  # rounding
                    continue
                add_combination(-1.0, basis.U, basis.c, basis.U + i * n, i, n)
                scale(1 / (sqrt(dot(basis.U + i * n, basis.U + i * n, n)) or 1.0),
                      basis.U + i * n, n)
            # share one copy, so that it stays in the cache
            self.basis, self.rows.C = basis, basis.U
            self.rows.owners.append(basis)
        return 0

    cdef Model model(self, double rho, double tail, bint has_ritz):
        """Return the model tail·I + (ρ − tail)Q of H, with the Ritz pairs or without."""
        cdef Py_ssize_t i
        cdef Room w = Room(self.n_directions)
        if self.basis is None:
            return Model.of_norm(tail, self.n)
        for i in range(self.n_directions):
            w.at[i] = rho - tail if i < self.rows.r else has_ritz * self.above.at[i]
        return Model.of(self.basis, w.at, 0.0, tail)

    cdef int choose_models(self) except -1:
        """Choose the model B and the preconditioner for the present ρ."""
        if self.plain:  # no model, only ‖H‖
            self.B = Model.of_norm(
                fmax(1.0, self.rho if self.rows.exist else 0.0) / self.alpha, self.n
            )
        else:
            self.B = self.model(self.rho, self.tail, True)
        self.preconditioner = None
        if self.M is not None and self.inverse is None:
            self.preconditioner = self.model(self.penalty_of_M(), 1.0, False)
        elif self.preconditioned:
            self.preconditioner = self.model(self.rho, self.tail, True)
        return 0

    def precondition(self, free, v, double rho):
        """Return v (n,) preconditioned on the face with the mask `free` (n,)."""
        cdef Py_ssize_t n = self.n
        cdef list owners = []
        is_free = np.asarray(free, dtype=float)
        memcpy(self.free, address(is_free), n * sizeof(double))
        masked(self.free, read(v, owners), self.phi, n)
        self.rho = rho
        self.choose_models()
        self.first_direction()
        return copied(self.p, n)

    def face_and_gradients(self, x, g):
        """Return vectors (n,): the mask of free components (1, else 0), φ and β."""
        cdef list owners = []
        cdef Parts parts
        free, phi, beta = np.empty(self.n), np.empty(self.n), np.empty(self.n)
        self.set.split(read(x, owners), read(g, owners), self.B.tau, address(phi),
                       address(free), &parts)
        self.set.project_gradient(read(x, owners), read(g, owners), address(beta))
        return free, phi, beta - phi

    # the start

    def begin(self, x, mu, double rho):
        """Return ν near Π(x) − x̃ (n,), where Π projects onto the set, and the gradient.

        The gradient includes Cᵀμ. The call takes one product, or none for x = 0, where
        Hν = ρQν. Infinite components of x start at their bound, or at x̃ if it is
        infinite. A start x ≠ 0 also moves towards Cν = 0 on its face.
        """
        cdef Py_ssize_t i, n = self.n
        cdef list owners = []
        cdef Parts parts
        start, gradient = empty(n), zeros(n)
        cdef bint moved = False
        cdef double *nu = address(start)
        cdef double *g = address(gradient)
        if rho != self.rho:
            self.directions.begin(self.free)  # H has changed
        self.rho = rho
        cdef const double *start_x = read(x, owners)
        self.set.project(start_x, 1.0, self.rows.x_tilde, nu)
        for i in range(n):
            if isinf(nu[i]):
                nu[i] = fmin(fmax(0.0, self.lower[i]), self.upper[i])
            moved = moved or nu[i] + self.rows.x_tilde[i] != 0
        if moved:
            if dot(start_x, start_x, n):
                self.set.split(nu, nu, 1.0, self.phi, self.free, &parts)
                self.move_onto_rows(nu, self.free, self.s)
            self.H(nu, g)
        else:  # 𝒫F𝒫ν = 0
            self.rows.times(nu, self.Cv)
            self.rows.combine(rho, self.Cv, g, g)
        add(-1.0, self.b, g, n)
        self.rows.combine(1.0, read(mu, owners), g, g)
        return start, gradient

    # the algorithm

    def solve(
        self, options, double tol, at, infeasible, watch=None, double aim=0.0
    ):
        """Continue the outer loop from the iterate `at`.

        For k = 0, 1, …:

        1. Run MPRGP on ½νᵀHν − (b − Cᵀμ)ᵀν until ‖g^P‖ < min(M‖Cν‖, η‖b‖).
        2. If the Lagrangian L(ν, μ) = ½νᵀHν − bᵀν + μᵀCν grew by less than ρ/2·‖Cν‖²
           since the previous outer iteration: M ← βM.
        3. μ ← μ + ρCν. The gradient changes by ρQν, without a product. H is unchanged,
           so the directions of CG remain conjugate on an unchanged face.

        until the relative KKT residual of the QP is at most tol (`is_solved`).

        4. Apply safeguards. If two consecutive outer iterations did not halve ‖Cν‖,
           then ρ ← 10ρ, but at most MAX_RHO, or M ← M/10 if ‖Cν‖ is already small
           enough. CᵀCν is tested as a certificate of infeasibility.

        The return values are ν, g, μ, M, ρ, the outer iterations as tuples in the order
        of `OuterIteration`, and the status (`Status.FAILED` for diverged iterates).

        at : an `Iterate`
        infeasible : ν → True if ν proves that there is no feasible point
        watch : function of k and the right-hand side that returns an observer of outer
            iteration k, called after each step with its letter, x and g, or None
        aim : largest estimate of the relative KKT residual that ends the loop; 0 for tol
        """
        cdef Py_ssize_t i, n = self.n, r = self.rows.r
        cdef double before = -INFINITY, lagrangian, error
        cdef long left = options.max_steps
        cdef bint stopped, enough, solved, stalled
        # Step 0. Choose η, β, M, ρ and μ: `options` and `at`
        memcpy(self.x, address(at.nu), n * sizeof(double))
        memcpy(self.g, address(at.g), n * sizeof(double))
        if at.rho != self.rho or not at.outer:
            self.directions.begin(self.free)
        self.rho, self.M_now, self.tol, self.knows_Cx = at.rho, at.M, tol, False
        multipliers = copied(address(at.mu), r)
        cdef double *mu = address(multipliers)
        self.b_size = sqrt(dot(self.b, self.b, n))
        if not self.b_size:
            self.b_size = sqrt(dot(self.g, self.g, n))
        self.small_gradient = tol * self.b_size
        self.coarse_gradient = self.eta * self.b_size
        self.next_tested = INFINITY
        self.aim, self.least_gradient = aim or tol, self.small_gradient
        if aim:
            self.least_gradient = LEAST_TESTED * self.entry_gradient
        elif not self.rows.exist and self.diagonal:
            self.least_gradient *= LEAST_TESTED
        done, errors = [], [o.infeasibility for o in at.outer[-2:]]
        for o in at.outer:
            left -= len(o.trace) + 1
        status = Status.ITERATION_LIMIT
        while True:
            # Step 1. The inner problem.
            trace, M = bytearray(), self.M_now
            memcpy(self.rhs, self.b, n * sizeof(double))
            self.rows.add(-1.0, mu, self.rhs)
            self.choose_models()
            note = watch and watch(len(at.outer) + len(done), copied(self.rhs, n))
            stopped = self.minimise(max(left, 0), trace, note)
            left -= len(trace) + 1
            solved = stopped and self.solved
            # The Lagrangian, which must grow by ρ/2·‖Cν‖².
            self.rows.times(self.x, self.Cv)
            error = self.rows.size(self.Cv)
            lagrangian = self.lagrangian(mu)
            enough = lagrangian >= before + 0.5 * self.rho * error * error
            before = lagrangian
            done.append((trace.decode(), M, self.rho, error, lagrangian))
            # Stop, or apply the safeguards that may end the loop.
            if solved:
                status = Status.SOLVED
                break
            errors = [*errors, error][len(errors) > 2:]
            stalled = len(errors) == 3 and errors[2] > errors[1] / 2 > errors[0] / 4
            if (not stopped or stalled) and infeasible(copied(self.x, n)):
                status = Status.INFEASIBLE
                break
            if not stopped or left < 0:
                break
            # Step 2. Update the multipliers, and the gradient with them.
            self.rows.add(self.rho, self.Cv, self.g)
            for i in range(r):
                mu[i] += self.rho * self.Cv[i]
            # Step 3. Update M, or ρ if ‖Cν‖ stalls.
            if not enough:
                self.M_now *= options.beta
            if stalled and self.rows.are_met(self.x, self.Cv, tol, self.b_size):
                self.M_now /= 10
            elif stalled:
                if self.rho >= MAX_RHO:
                    break
                self.change_penalty(fmin(10 * self.rho, MAX_RHO))
            # Step 4. k ← k + 1
        if self.factor is not None:
            self.counts["factorisations"] = self.factor.factorisations
            self.counts["preconditioner_applies"] = self.factor.solves
        if status is not Status.INFEASIBLE and not dot(self.x, self.x, n) < INFINITY:
            status = Status.FAILED
        nu, g = copied(self.x, n), copied(self.g, n)
        return nu, g, multipliers, self.M_now, self.rho, done, status

    cdef bint stops(self) except -1:
        """Return True if the inner run may end."""
        cdef double size = sqrt(self.parts.phi_square + self.parts.beta_square)
        self.solved = size <= self.next_tested and self.is_solved(size)
        if self.solved or not self.rows.exist or size >= self.coarse_gradient:
            return self.solved
        # ‖g^P‖ < min(M‖Cν‖, η‖b‖)
        return size < self.M_now * self.violation()

    cdef bint is_solved(self, double size) except -1:
        """Return True if the relative KKT residual is within tol.

        The evaluation is repeated only when ‖g^P‖ (the argument `size`) has decreased
        enough, on the assumption that the residual is proportional to it.
        """
        cdef double residual = self.residual()
        if residual <= self.aim or size <= self.least_gradient:
            self.rows.times(self.x, self.Cv)
            return self.rows.are_met(self.x, self.Cv, self.tol, self.b_size)
        self.next_tested = fmax(
            size * fmin(fmax(2 * self.aim / residual, 0.03), 1.0), self.least_gradient
        )
        return False

    cdef double residual(self) noexcept:
        """Return the relative KKT residual, apart from the rows (stopping.pxi).

        With the multipliers of bounds, discs and rows, r = ‖𝒫F𝒫‖g^P and the gap is xᵀr.
        With rows, the component of Px along them is unknown. Until the scales are known,
        they then consist of q alone, and the result is an upper bound.
        """
        cdef Py_ssize_t i, n = self.n
        cdef double *w = self.tested.at
        cdef double *r = w + n
        cdef double *Px = r + n
        cdef double *x = Px + n
        cdef double[3] sums
        cdef double[3] most
        cdef double[2] scales
        cdef double gap = 0.0
        scales[:] = [self.force, self.energy]
        sums[:] = [0.0, 0.0, 0.0]
        most[:] = [0.0, 0.0, 0.0]
        self.set.project_gradient(self.x, self.g, r)
        for i in range(n):
            x[i] = self.rows.x_tilde[i] + self.x[i]
            Px[i] = 0.0 if self.rows.exist else self.g[i] + self.b[i]
            gap += x[i] * r[i]
        terms_of_test(x, Px, self.scaled_q, r, w, n, sums, most)
        return worst_ratio(sums, most, gap, self.tol, scales)

    def estimate(self, at, double force, double energy):
        """Return the estimate of the residual at an iterate.

        force, energy : scales at this iterate, used from now on
        """
        memcpy(self.x, address(at.nu), self.n * sizeof(double))
        memcpy(self.g, address(at.g), self.n * sizeof(double))
        self.force = force / sqrt(self.norm)
        self.energy = energy / self.norm
        residual = self.residual()
        self.entry_gradient = sqrt(dot(self.tested.at + self.n, self.tested.at + self.n, self.n))
        return residual

    cdef double lagrangian(self, const double *mu) noexcept:
        """Return L(ν, μ), computed from the gradient; `Cv` must contain Cν."""
        cdef double sum_ = 0.0
        cdef Py_ssize_t i
        for i in range(self.n):
            sum_ += 0.5 * self.x[i] * (self.g[i] - self.b[i])
        return sum_ + 0.5 * dot(mu, self.Cv, self.rows.r)

    cdef int change_penalty(self, double rho) except -1:
        """Change ρ and update the gradient, without a product."""
        self.rows.times(self.x, self.Cv)
        self.rows.add(rho - self.rho, self.Cv, self.g)
        self.rho = rho
        self.directions.begin(self.free)  # H has changed
        return 0

    cdef int move_onto_rows(self, double *nu, const double *free, double *v) except -1:
        """Move ν towards Cν = 0 on the face with the mask `free`; v (n,) is workspace.

        Projections onto {Cν = 0} and onto the free components alternate (von Neumann)
        as long as a pair reduces ‖Cν‖ by a fifth.
        """
        cdef double error, before = INFINITY
        self.rows.times(nu, self.Cv)
        error = self.rows.size(self.Cv)
        while 0 < 1.25 * error < before:
            memset(v, 0, self.n * sizeof(double))
            self.rows.add(1.0, self.Cv, v)
            masked(free, v, v, self.n)
            self.set.project(nu, 1.0, v, nu)
            self.rows.times(nu, self.Cv)
            before, error = error, self.rows.size(self.Cv)
        return 0

    # recovery

    def point(self, nu, mu, double rho, lb, ub):
        """Return x, multipliers a (r,) of Cx = Cx̃, z_box and Fx; one product.

        First, ν moves towards Cν = 0 on its face. For a = ‖𝒫F𝒫‖(μ + ρCν) − C(Fx − d),
        the residual Fx − d + Cᵀa equals the gradient of the projected problem up to
        rounding and terms of the order of ‖Cν‖, which a least-squares correction of a on
        the free components removes.
        """
        cdef Py_ssize_t i, j, k, n = self.n, r = self.rows.r
        cdef bint any_left = False
        cdef list owners = []
        cdef Parts parts
        restored_x, multipliers, boxes, product = empty(n), zeros(r), zeros(n), empty(n)
        cdef double *v = self.x
        cdef const double *at_mu = read(mu, owners)
        cdef const double *least = read(lb, owners)
        cdef const double *most = read(ub, owners)
        cdef double *a = address(multipliers)
        cdef double *x = address(restored_x)
        cdef double *z_box = address(boxes)
        cdef double *Fx = address(product)
        cdef double *rest = self.s
        cdef double *free = self.x2
        cdef double *da = self.Cv
        cdef double square, push
        memcpy(v, read(nu, owners), n * sizeof(double))
        self.set.split(v, v, 1.0, self.t, free, &parts)
        self.rows.times(v, da)
        for i in range(r):
            a[i] = self.norm * (at_mu[i] + rho * da[i])
        self.move_onto_rows(v, free, rest)
        for i in range(n):  # x̃ + ν may differ from a bound in the last bit
            x[i] = fmin(fmax(self.rows.x_tilde[i] + v[i], least[i]), most[i])
            if v[i] >= self.upper[i]:
                x[i] = most[i]
            if v[i] <= self.lower[i]:
                x[i] = least[i]
        for i in range(self.set.n_discs):
            square = 0.0
            for k in range(self.set.start[i], self.set.start[i + 1]):
                square += x[self.set.index[k]] ** 2
            if square > self.set.radius[i] ** 2:
                for k in range(self.set.start[i], self.set.start[i + 1]):
                    x[self.set.index[k]] *= self.set.radius[i] / sqrt(square)
        self.F.apply(x, Fx)
        for i in range(n):
            rest[i] = Fx[i] + self.q[i]
            any_left = any_left or rest[i] != 0
        if not any_left:  # x is the unconstrained minimiser
            return restored_x, zeros(r), boxes, product
        self.rows.times(rest, da)
        for i in range(r):
            a[i] -= da[i]
        self.rows.add(1.0, a, rest)
        if r:
            memcpy(self.t, rest, n * sizeof(double))
            self.rows.fit(free, self.t, da)
            self.rows.add(1.0, da, rest)
            for i in range(r):
                a[i] += da[i]
        for i in range(n):
            if v[i] <= self.lower[i]:
                z_box[i] = -fmax(rest[i], 0.0)
            if v[i] >= self.upper[i]:
                z_box[i] -= fmin(rest[i], 0.0)
        for i in range(self.set.n_discs):  # outward normal part of −rest
            square = push = 0.0
            for k in range(self.set.start[i], self.set.start[i + 1]):
                j = self.set.index[k]
                square += x[j] * x[j]
                push += x[j] * rest[j]
            for k in range(self.set.start[i], self.set.start[i + 1]):
                j = self.set.index[k]
                if free[j] == 0:  # every vector is normal to a disc of radius zero
                    z_box[j] = -fmin(push, 0.0) / square * x[j] if square else -rest[j]
        return restored_x, multipliers, boxes, product
