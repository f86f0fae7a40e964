# Quadratic model of H. The model is minimised over the set without products with H.


cdef enum:
    # Limits of Newton's method and of its line search, which keeps a distance of 5 % from
    # the ends of its interval. If Newton's method does not end, the step is computed with
    # the model norm·I, where norm is the largest eigenvalue of B.
    NEWTON_STEPS = 100
    SEARCH_STEPS = 60


@cython.final
cdef class Model:
    """B = τI + Uᵀ diag(w) U with an orthonormal basis U (k, n).

    The rows of U are the directions in which H is large, with eigenvalues w + τ, and τ
    bounds H on their complement. If B ≥ H, then f(x + s) ≤ f(x) + gᵀs + ½sᵀBs, and the
    minimiser of the right-hand side over the set is a gradient projection step in the
    metric of B. Without U, this is the ordinary step x ← Π(x − g/τ). Each step takes a
    product with H, which shows whether B ≥ H along the step; if not, τ is increased.
    """

    cdef double tau
    cdef Py_ssize_t n, k
    cdef Basis basis  # None for B = τI
    cdef Room room
    cdef double *w  # (k,) nonnegative

    @staticmethod
    cdef Model of_norm(double norm, Py_ssize_t n):
        """Return B = norm·I."""
        cdef Model B = Model.__new__(Model)
        B.tau, B.n = norm, n
        return B

    @staticmethod
    cdef Model of(Basis basis, const double *w, double shift, double tau):
        """Return the model with the weights w + shift; negative weights become zero."""
        cdef Model B = Model.of_norm(tau, basis.n)
        cdef Py_ssize_t i
        B.basis, B.k, B.room = basis, basis.k, Room(basis.k)
        B.w = B.room.at
        for i in range(B.k):
            B.w[i] = fmax(w[i] + shift, 0.0)
        return B if B.largest() > 0 else Model.of_norm(tau, basis.n)

    cdef double largest(self) noexcept:
        cdef Py_ssize_t i
        cdef double most = 0.0
        for i in range(self.k):
            most = fmax(most, self.w[i])
        return most

    cdef int step(self, const double *x, const double *g, FeasibleSet box, double *s) except -1:
        """s ← argmin of gᵀs + ½sᵀBs over all s with x + s in the set.

        For a multiplier y, s(y) minimises (g + Uᵀy)ᵀs + τ/2‖s‖² over the set. The
        solution has the y = WUs that maximises the dual function, which is concave and
        piecewise quadratic with the gradient Us(y) − W⁻¹y. Newton's method with a line
        search ends on the piece that contains the maximum.
        """
        cdef Basis U = self.basis
        cdef Py_ssize_t i, newton, search, k = self.k
        cdef double begun, now, low, high, at_low, at_high, t, share
        if U is None:
            box.minimise(x, g, self.tau, s)
            return 0
        U.begin(x, g, box)
        memset(U.y_there, 0, k * sizeof(double))
        U.minimise_lagrangian(self, x, g, box, s)
        U.find_slope(self, s)
        for newton in range(NEWTON_STEPS):
            U.accept()
            U.newton(self)
            for i in range(k):
                U.y_there[i] = U.y[i] + U.dy[i]
            begun = dot(U.slope, U.dy, k)
            U.minimise_lagrangian(self, x, g, box, s)
            if same(U.piece, U.piece_there, U.places):
                U.finish(self, g, s)  # the Newton step is exact within a piece
                return 0
            U.find_slope(self, s)
            now = dot(U.slope_there, U.dy, k)
            low, high, at_low, at_high, t = 0.0, 1.0, begun, now, 1.0
            for search in range(SEARCH_STEPS):
                if fabs(now) <= 0.1 * begun or (now > 0 and t == 1) or at_low <= at_high:
                    break
                # regula falsi, kept away from the ends
                share = at_low / (at_low - at_high)
                t = low + (high - low) * fmin(fmax(share, 0.05), 0.95)
                for i in range(k):
                    U.y_there[i] = U.y[i] + t * U.dy[i]
                U.minimise_lagrangian(self, x, g, box, s)
                U.find_slope(self, s)
                now = dot(U.slope_there, U.dy, k)
                if now > 0:
                    low, at_low = t, now
                else:
                    high, at_high = t, now
        return Model.of_norm(self.tau + self.largest(), self.n).step(x, g, box, s)

    cdef Model raised(self, const double *s, const double *Hs):
        """Return the model with τ increased until sᵀBs ≥ sᵀHs, but at most tenfold.

        w + τ is unchanged, except for rows whose weight becomes zero.
        """
        cdef double rest = dot(s, s, self.n), tau
        cdef double missing = dot(s, Hs, self.n) - self.tau * rest
        cdef Room Us = Room(self.k)
        cdef Py_ssize_t i
        if self.basis is not None:
            self.basis.times(s, Us.at)
            for i in range(self.k):
                if self.w[i] > 0:  # other rows belong to the complement
                    rest -= Us.at[i] * Us.at[i]
                missing -= self.w[i] * Us.at[i] * Us.at[i]
        if missing <= 0:
            return self
        tau = self.tau + missing / rest if rest > 0 else INFINITY
        tau = fmin(tau, 10 * self.tau)
        if self.basis is None:
            return Model.of_norm(tau, self.n)
        return Model.of(self.basis, self.w, self.tau - tau, tau)

    cdef int enter(self, const double *free) except -1:
        """Prepare `inverse` for the face whose free components have `free` = 1."""
        if self.basis is not None:
            self.basis.enter(self, free)
        return 0

    cdef int inverse(self, const double *free, const double *v, double *z) except -1:
        """z ← B_FF⁻¹v for a v that is zero off the face F."""
        if self.basis is not None:
            return self.basis.inverse(self, free, v, z)
        copy_scaled(1 / self.tau, v, z, self.n)
        return 0


cdef class Basis:
    """Orthonormal rows U (k, n) of models, and the workspace for their multipliers.

    `slope`, `piece` and `y` belong to the iterate of Newton's method. Variables with
    the suffix `_there` belong to the trial point.
    """

    cdef Py_ssize_t n, k
    cdef Py_ssize_t places  # number of components that can be at a bound
    cdef Room dual
    cdef double *y
    cdef double *dy
    cdef double *y_there
    cdef double *slope
    cdef double *slope_there
    cdef double *piece  # (places,) −1 at the lower bound, 1 at the upper, else 0
    cdef double *piece_there

    cdef int make_room(self, Py_ssize_t n, Py_ssize_t k, Py_ssize_t places) except -1:
        self.n, self.k, self.places = n, k, places
        self.dual = Room(5 * k + 2 * places)
        self.y, self.dy = self.dual.at, self.dual.at + k
        self.y_there, self.slope = self.dy + k, self.dy + 2 * k
        self.slope_there, self.piece = self.slope + k, self.slope + 2 * k
        self.piece_there = self.piece + places
        return 0

    cdef void accept(self) noexcept:
        """Make the trial point the iterate."""
        memcpy(self.y, self.y_there, self.k * sizeof(double))
        memcpy(self.slope, self.slope_there, self.k * sizeof(double))
        memcpy(self.piece, self.piece_there, self.places * sizeof(double))

    cdef int begin(self, const double *x, const double *g, FeasibleSet box) except -1:
        """Prepare a step from x with the gradient g."""
        return 0

    cdef int newton(self, Model B) except -1:
        """Compute the Newton step dy from `slope` and `piece`."""
        raise NotImplementedError

    cdef int minimise_lagrangian(self, Model B, const double *x, const double *g,
                                 FeasibleSet box, double *s) except -1:
        """Compute s(y) and its piece at y = `y_there` for components with bounds."""
        raise NotImplementedError

    cdef int find_slope(self, Model B, const double *s) except -1:
        """Compute Us(y) − W⁻¹y at y = `y_there`, after `minimise_lagrangian`."""
        raise NotImplementedError

    cdef int finish(self, Model B, const double *g, double *s) except -1:
        """Compute s(y) at y = `y_there` for the components without bounds."""
        return 0

    cdef int times(self, const double *s, double *c) except -1:
        """c ← Us."""
        raise NotImplementedError

    cdef int enter(self, Model B, const double *free) except -1:
        raise NotImplementedError

    cdef int inverse(self, Model B, const double *free, const double *v,
                     double *z) except -1:
        raise NotImplementedError


@cython.final
cdef class DenseBasis(Basis):
    """Rows U (k, n) as an array, with U_F U_Fᵀ for the components F of the last face."""

    cdef Py_ssize_t flips
    cdef Room room
    cdef double *U
    cdef double *gram  # (k, k), lower triangle, as in `core`
    cdef double *active  # (n,) 1 for components off the last face, else 0
    cdef double *core  # factor of τI + W¹ᐟ² U_F U_Fᵀ W¹ᐟ², see `solve_cholesky`
    cdef double *c
    cdef double *t  # (n,)
    cdef double *row  # (n,)

    @staticmethod
    cdef DenseBasis zeros(Py_ssize_t k, Py_ssize_t n):
        cdef DenseBasis new = DenseBasis.__new__(DenseBasis)
        new.make_room(n, k, n)
        new.flips = n + 1
        new.room = Room((k + 3) * n + k * (2 * k + 1))
        new.U = new.room.at
        new.gram, new.core = new.U + k * n, new.U + k * n + k * k
        new.c, new.t = new.core + k * k, new.core + k * k + k
        new.active, new.row = new.t + n, new.t + 2 * n
        return new

    cdef int factor(self, Model B, const double *piece) except -1:
        """Factorise τI + W¹ᐟ² U_FU_Fᵀ W¹ᐟ², F: components with `piece` zero.

        To limit rounding errors, `gram` is recomputed after as many changes as there
        are components. The factorised matrix is bounded below by τI.
        """
        cdef Py_ssize_t i, j
        cdef int k = self.k, n = self.n, info = 0
        if self.flips > n:
            self.flips = 0
            for i in range(n):
                self.active[i] = piece[i] != 0
                self.t[i] = 1 - self.active[i]
            for i in range(k):
                masked(self.t, self.U + i * n, self.row, n)
                rows_times(self.U, self.row, self.gram + i * k, i + 1, n)
        for i in range(n):
            if self.active[i] != (piece[i] != 0):
                add_outer(2 * self.active[i] - 1, self.U + i, n, self.gram, k)
                self.active[i], self.flips = piece[i] != 0, self.flips + 1
        for i in range(k):
            for j in range(i + 1):
                self.core[i * k + j] = sqrt(B.w[i] * B.w[j]) * self.gram[i * k + j]
            self.core[i * k + i] += B.tau
        dpotrf(b"U", &k, self.core, &k, &info)
        if info:
            raise ArithmeticError("the core of a model is not positive definite")
        for i in range(k):
            self.core[i * k + i] = 1 / self.core[i * k + i]
        return 0

    cdef void solve(self, Model B, double *y) noexcept:
        """y ← W¹ᐟ²(τI + W¹ᐟ² U_FU_Fᵀ W¹ᐟ²)⁻¹W¹ᐟ² y."""
        cdef Py_ssize_t i
        for i in range(self.k):
            y[i] *= sqrt(B.w[i])
        solve_cholesky(self.core, y, self.k)
        for i in range(self.k):
            y[i] *= sqrt(B.w[i])

    cdef int newton(self, Model B) except -1:
        self.factor(B, self.piece)
        copy_scaled(B.tau, self.slope, self.dy, self.k)
        self.solve(B, self.dy)
        return 0

    cdef int minimise_lagrangian(self, Model B, const double *x, const double *g,
                                 FeasibleSet box, double *s) except -1:
        memcpy(self.t, g, self.n * sizeof(double))
        add_combination(1.0, self.U, self.y_there, self.t, self.k, self.n)
        model_minimiser(
            x, self.t, B.tau, box.lower, box.upper, s, self.piece_there, self.n
        )
        return 0

    cdef int find_slope(self, Model B, const double *s) except -1:
        cdef Py_ssize_t i
        rows_times(self.U, s, self.slope_there, self.k, self.n)
        for i in range(self.k):  # y = 0 without a weight
            if B.w[i] > 0:
                self.slope_there[i] -= self.y_there[i] / B.w[i]
        return 0

    cdef int times(self, const double *s, double *c) except -1:
        rows_times(self.U, s, c, self.k, self.n)
        return 0

    cdef int enter(self, Model B, const double *free) except -1:
        cdef Py_ssize_t i
        for i in range(self.n):
            self.piece[i] = 1 - free[i]
        return self.factor(B, self.piece)

    cdef int inverse(self, Model B, const double *free, const double *v,
                     double *z) except -1:
        # B_FF⁻¹ = (I − U_FᵀW¹ᐟ²(τI + W¹ᐟ²U_FU_FᵀW¹ᐟ²)⁻¹W¹ᐟ²U_F)/τ (Sherman, Morrison
        # and Woodbury)
        rows_times(self.U, v, self.c, self.k, self.n)
        self.solve(B, self.c)
        copy_scaled(1 / B.tau, v, z, self.n)
        add_combination(-1 / B.tau, self.U, self.c, z, self.k, self.n)
        masked(free, z, z, self.n)
        return 0


@cython.final
cdef class FactoredBasis(Basis):
    """Rows C = L⁻¹G with a sparse G and with one weight w of the penalty.

    B = τI + w Gᵀ(GGᵀ)⁻¹G with multipliers y = w(GGᵀ)⁻¹Gs. The gradient of the dual
    function is Gs(y) − GGᵀy/w. Components without bounds have s = −(g + Gᵀy)/τ. For
    each y, only the components b with bounds are therefore evaluated:

        Gs = G_b(s_b + (g_b + G_bᵀy)/τ) − (Gg + GGᵀy)/τ
    """

    cdef Rows rows
    cdef Coarse coarse
    cdef BorderedFactor factor  # factor for the face
    cdef Room room
    cdef double *x_b  # (places,)
    cdef double *g_b
    cdef double *low_b
    cdef double *high_b
    cdef double *gradient_b
    cdef double *s_b
    cdef double *Gg  # (k,)
    cdef double *weights  # (n,)

    @staticmethod
    cdef FactoredBasis of(Rows rows):
        cdef FactoredBasis new = FactoredBasis.__new__(FactoredBasis)
        cdef Py_ssize_t p = rows.coarse.places
        new.rows, new.coarse = rows, rows.coarse
        new.make_room(rows.n, rows.coarse.k, p)
        new.room = Room(6 * p + new.k + new.n)
        new.x_b, new.g_b = new.room.at, new.room.at + p
        new.low_b, new.high_b = new.g_b + p, new.g_b + 2 * p
        new.gradient_b, new.s_b = new.high_b + p, new.high_b + 2 * p
        new.Gg = new.s_b + p
        new.weights = new.Gg + new.k
        return new

    cdef int begin(self, const double *x, const double *g, FeasibleSet box) except -1:
        cdef Py_ssize_t i, j
        for i in range(self.places):
            j = self.coarse.bounded[i]
            self.x_b[i], self.g_b[i] = x[j], g[j]
            self.low_b[i], self.high_b[i] = box.lower[j], box.upper[j]
        self.coarse.rows.times(g, self.Gg)
        return 0

    cdef int newton(self, Model B) except -1:
        cdef Py_ssize_t i
        for i in range(self.places):
            self.coarse.active[i] = self.piece[i] != 0
        self.coarse.in_face(B.tau / B.w[0]).solve_to(self.slope, self.dy)
        scale(B.tau, self.dy, self.k)
        return 0

    cdef int minimise_lagrangian(self, Model B, const double *x, const double *g,
                                 FeasibleSet box, double *s) except -1:
        self.coarse.of_bounded.combine(
            1.0, self.g_b, 1.0, self.y_there, self.gradient_b
        )
        model_minimiser(self.x_b, self.gradient_b, B.tau, self.low_b, self.high_b,
                        self.s_b, self.piece_there, self.places)
        return 0

    cdef int find_slope(self, Model B, const double *s) except -1:
        cdef Py_ssize_t i
        cdef double *GGy = self.coarse.t
        for i in range(self.places):
            self.gradient_b[i] = self.gradient_b[i] / B.tau + self.s_b[i]
        memset(self.slope_there, 0, self.k * sizeof(double))
        self.coarse.of_bounded.add_transposed(self.gradient_b, self.slope_there)
        self.coarse.matrix.times(self.y_there, GGy)
        for i in range(self.k):
            self.slope_there[i] -= self.Gg[i] / B.tau + (1 / B.tau + 1 / B.w[0]) * GGy[i]
        return 0

    cdef int finish(self, Model B, const double *g, double *s) except -1:
        cdef Py_ssize_t i
        self.coarse.by_components.combine(-1 / B.tau, g, -1 / B.tau, self.y_there, s)
        for i in range(self.places):
            s[self.coarse.bounded[i]] = self.s_b[i]
        return 0

    cdef int times(self, const double *s, double *c) except -1:
        return self.rows.times(s, c)

    cdef int enter(self, Model B, const double *free) except -1:
        self.coarse.enter(free)
        self.factor = self.coarse.in_face(B.tau / B.w[0])
        copy_scaled(1 / B.tau, free, self.weights, self.n)
        return 0

    cdef int inverse(self, Model B, const double *free, const double *v,
                     double *z) except -1:
        self.coarse.rows.times(v, self.coarse.t)
        self.factor.solve_to(self.coarse.t, self.coarse.y)
        self.coarse.by_components.weigh_difference(v, self.coarse.y, self.weights, z)
        return 0
