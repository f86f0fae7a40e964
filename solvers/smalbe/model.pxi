# Quadratic model of H. The model is minimised over the set without products with H.


cdef enum:
    # Limits of Newton's method and of its line search. The search keeps a distance of
    # 5 % from the ends of its interval, so that 60 steps reduce the interval to at most
    # 5 %. If Newton's method does not end, the step is computed with the model norm·I,
    # where norm is the largest eigenvalue of B. Without the line search,
    # `test_friction_takes_fewer_products_than_published_rules` fails.
    NEWTON_STEPS = 100
    SEARCH_STEPS = 60


@cython.final
cdef class Model:
    """B = τI + Uᵀ diag(w) U with the first k rows U (k, n) of an orthonormal basis.

    The rows of U are the directions in which H is large, with eigenvalues w + τ, and τ
    bounds H on the complement of these directions. If B ≥ H, then f(x + s) ≤ f(x) + gᵀs
    + ½sᵀBs, and the minimiser of the right-hand side over the set is a gradient
    projection step in the metric of B. Without U, this step is the ordinary step x ←
    Π(x − g/τ), whose length is determined by ‖H‖. With U, the remaining spectrum
    determines the length. Each step takes a product with H, which shows whether B ≥ H
    along the step; if not, τ is increased.
    """

    cdef double tau
    cdef Py_ssize_t n, k
    cdef Basis basis  # None for B = τI
    cdef Room room
    cdef double *w  # (k,)
    cdef double *root  # √w, padded with zeros to a row of `DenseBasis.gram`

    @staticmethod
    cdef Model of_norm(double norm, Py_ssize_t n):
        """Return B = norm·I."""
        cdef Model B = Model.__new__(Model)
        B.tau, B.n = norm, n
        return B

    cdef Model with_tail(self, double tau):
        """Return a model with a new τ and unchanged w + τ; drop rows with w ≤ 0."""
        if self.basis is None:
            return Model.of_norm(tau, self.n)
        return self.basis.model(self.k, self.w, self.tau - tau, tau)

    cdef int step(self, const double *x, const double *g, FeasibleSet box, double *s) except -1:
        """s ← argmin of gᵀs + ½sᵀBs over all s with x + s in the set.

        For a multiplier y, s(y) minimises (g + Uᵀy)ᵀs + τ/2‖s‖² over the set. The
        solution has the multiplier y = WUs, which maximises the dual function. This
        function of k variables is concave and piecewise quadratic, with the gradient
        Us(y) − W⁻¹y. Newton's method with a line search ends on the quadratic piece
        that contains the maximum.
        """
        cdef Basis U = self.basis
        cdef Py_ssize_t i, newton, search, k = self.k
        cdef double *y
        cdef double *dy
        cdef double *there
        cdef double begun, now, low, high, at_low, at_high, t, share
        if U is None:
            box.minimise(x, g, self.tau, s, NULL)
            return 0
        y, dy, there = U.y, U.dy, U.y_there
        U.begin(self, x, g, box, s)
        for newton in range(NEWTON_STEPS):
            U.newton(self)
            for i in range(k):
                there[i] = y[i] + dy[i]
            begun = dot(U.slope, dy, k)
            U.minimise_lagrangian(self, x, g, box, s)
            if same(U.piece, U.piece_there, U.places):
                U.finish(self, x, g, box, s)  # the Newton step is exact within a piece
                return 0
            U.find_slope(self, s)
            now = dot(U.slope_there, dy, k)
            low, high, at_low, at_high, t = 0.0, 1.0, begun, now, 1.0
            for search in range(SEARCH_STEPS):
                if fabs(now) <= 0.1 * begun or (now > 0 and t == 1) or at_low <= at_high:
                    break
                # regula falsi, kept away from the ends
                share = at_low / (at_low - at_high)
                t = low + (high - low) * fmin(fmax(share, 0.05), 0.95)
                for i in range(k):
                    there[i] = y[i] + t * dy[i]
                U.minimise_lagrangian(self, x, g, box, s)
                U.find_slope(self, s)
                now = dot(U.slope_there, dy, k)
                if now > 0:
                    low, at_low = t, now
                else:
                    high, at_high = t, now
            memcpy(y, there, k * sizeof(double))
            memcpy(U.slope, U.slope_there, k * sizeof(double))
            memcpy(U.piece, U.piece_there, U.places * sizeof(double))
        return Model.of_norm(self.tau + U.largest(self), self.n).step(x, g, box, s)

    cdef Model raised(self, const double *s, double square, double sHs):
        """Return the model with τ increased until sᵀBs ≥ sᵀHs, but at most tenfold.

        w + τ is unchanged.

        square : ‖s‖²
        """
        cdef double missing = sHs - self.tau * square, rest = square, tau
        if self.basis is not None:
            self.basis.leave_out(self, s, &missing, &rest)
        if missing <= 0:
            return self
        tau = self.tau + missing / rest if rest > 0 else INFINITY
        return self.with_tail(fmin(tau, 10 * self.tau))

    cdef int enter(self, const double *free) except -1:
        """Prepare `inverse` for the face whose free components have `free` = 1."""
        if self.basis is not None:
            self.basis.enter(self, free)
        return 0

    cdef double inverse(self, const double *free, const double *v, const double *along,
                        double *z) except? -1:
        """z ← B_FF⁻¹v for a v that is zero off the face F; returns zᵀ`along`."""
        if self.basis is not None:
            return self.basis.inverse(self, free, v, along, z)
        copy_scaled(1 / self.tau, v, z, self.n)
        return dot(z, along, self.n)


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
    cdef double *piece
    cdef double *piece_there

    cdef int make_room(self, Py_ssize_t stride) except -1:
        """Allocate the vectors of multipliers, of `stride` numbers each."""
        self.dual = Room(5 * stride + 2 * self.places)
        self.y, self.dy = self.dual.at, self.dual.at + stride
        self.y_there, self.slope = self.dy + stride, self.dy + 2 * stride
        self.slope_there = self.slope + stride
        self.piece = self.slope_there + stride
        self.piece_there = self.piece + self.places
        return 0

    cdef Model model(self, Py_ssize_t k, const double *w, double shift, double tau):
        """Return a model of the rows i < k with a weight w[i] + shift > 0."""
        raise NotImplementedError

    cdef int begin(self, Model B, const double *x, const double *g, FeasibleSet box,
                   double *s) except -1:
        """Compute s, `piece` and `slope` for y = 0."""
        raise NotImplementedError

    cdef int newton(self, Model B) except -1:
        """Compute the Newton step dy from `slope` and `piece`."""
        raise NotImplementedError

    cdef int minimise_lagrangian(self, Model B, const double *x, const double *g, FeasibleSet box,
                  double *s) except -1:
        """Compute s(y) and its piece at y = `y_there` for components with bounds."""
        raise NotImplementedError

    cdef int find_slope(self, Model B, const double *s) except -1:
        """Compute Us(y) − W⁻¹y at y = `y_there`, after `minimise_lagrangian`."""
        raise NotImplementedError

    cdef int finish(self, Model B, const double *x, const double *g, FeasibleSet box,
                    double *s) except -1:
        """Compute s(y) at y = `y_there` for the components without bounds."""
        raise NotImplementedError

    cdef double largest(self, Model B) except? -1:
        """Return the largest w."""
        raise NotImplementedError

    cdef int leave_out(self, Model B, const double *s, double *sBs,
                       double *square) except -1:
        """Subtract Σ wᵢ(uᵢᵀs)² from sᵀBs, and ‖Us‖² from ‖s‖²."""
        raise NotImplementedError

    cdef int enter(self, Model B, const double *free) except -1:
        raise NotImplementedError

    cdef double inverse(self, Model B, const double *free, const double *v,
                        const double *along, double *z) except? -1:
        raise NotImplementedError


@cython.final
cdef class DenseBasis(Basis):
    """Rows U (k, n) as an array, with U_F U_Fᵀ for the components F of the last face.

    Only the `size` components from index `first` on can have bounds. All other
    components are free on every face.
    """

    cdef Py_ssize_t stride, first, size, flips
    cdef bint is_split
    cdef Room room
    cdef int *where  # (size + 3,)
    cdef double *U
    cdef double *bounded  # (k, size) columns of U for these components
    cdef double *columns  # `bounded`, stored by columns (size, stride)
    cdef double *others  # U_f U_fᵀ of all other components f, stored like `gram`
    cdef double *gram  # (k, k) upper triangle
    cdef double *active
    cdef double *core  # τI + W¹ᐟ² U_F U_Fᵀ W¹ᐟ², factorised
    cdef double *pivots  # reciprocal pivots of `core`
    cdef double *c
    cdef double *fixed
    cdef double *t  # (n,)

    @staticmethod
    cdef DenseBasis zeros(Py_ssize_t k, Py_ssize_t n, Py_ssize_t first, Py_ssize_t size):
        cdef DenseBasis new = DenseBasis.__new__(DenseBasis)
        cdef Py_ssize_t stride = (k + 3) & ~3
        new.k, new.n, new.stride, new.first, new.size = k, n, stride, first, size
        new.places, new.flips = size, size + 1
        new.room = Room(
            (k + 1) * n + k * size + stride * (3 * stride + size + 3) + 2 * size + 2
        )
        new.U = new.room.at
        new.bounded = new.U + k * n
        new.columns = new.bounded + k * size
        new.others = new.columns + stride * size
        new.gram = new.others + stride * stride
        new.core = new.gram + stride * stride
        new.pivots = new.core + stride * stride
        new.c, new.fixed = new.pivots + stride, new.pivots + 2 * stride
        new.t = new.fixed + stride
        new.active = new.t + n
        new.where = <int *> (new.active + size)
        new.make_room(stride)
        return new

    cdef Model model(self, Py_ssize_t k, const double *w, double shift, double tau):
        # omitted rows are usually the last rows; the basis is then used without a copy
        cdef Model B = Model.__new__(Model)
        cdef Py_ssize_t i, kept = 0, last = -1, n = self.n
        cdef DenseBasis chosen = self
        for i in range(k):
            if w[i] + shift > 0:
                kept, last = kept + 1, i
        if not kept:
            return Model.of_norm(tau, self.n)
        if last >= kept:
            chosen, kept = DenseBasis.zeros(kept, n, self.first, self.size), 0
            for i in range(k):
                if w[i] + shift > 0:
                    memcpy(chosen.U + kept * n, self.U + i * n, n * sizeof(double))
                    kept += 1
        B.room = Room(kept + chosen.stride)
        B.w, B.root = B.room.at, B.room.at + kept
        B.basis, B.tau, B.n, B.k, kept = chosen, tau, n, kept, 0
        for i in range(k):
            if w[i] + shift > 0:
                B.w[kept] = w[i] + shift
                B.root[kept] = sqrt(B.w[kept])
                kept += 1
        return B

    cdef void split(self) noexcept:
        """Copy columns of components that may have bounds, unless already copied."""
        cdef Py_ssize_t i, j, stride = self.stride
        if self.is_split:
            return
        self.is_split = True
        for j in range(self.k):
            memcpy(self.bounded + j * self.size, self.U + j * self.n + self.first,
                   self.size * sizeof(double))
        transposed(self.bounded, self.columns, self.k, self.size, stride)
        if self.size == self.n:
            return
        for j in range(self.k):
            self.others[j * stride + j] = 1.0
        for i in range(self.size):
            self.where[i], self.active[i] = i, 1.0
        self.change(self.size, self.others)
        for i in range(self.k):
            for j in range(i):
                self.others[i * stride + j] = self.others[j * stride + i]

    cdef void change(self, Py_ssize_t count, double *gram) noexcept:
        """Subtract the components in `where` that became active; add all others."""
        cdef Py_ssize_t c, q
        cdef double sign[4]
        for c in range(0, count, 4):
            for q in range(4):
                sign[q] = 0.0
                if c + q < count:
                    sign[q] = 1 - 2 * self.active[self.where[c + q]]
                else:
                    self.where[c + q] = 0
            add_gram(sign, self.columns, self.where + c, gram, self.stride)

    cdef void face(self, const double *piece) noexcept:
        """Update `gram` for the face on which `piece` (size,) is zero.

        Because the rows are orthonormal, gram is I minus the sum over active
        components. To limit rounding errors, gram is recomputed after as many changes
        as there are components. The sum is then taken over the active or the free
        components, whichever are fewer.
        """
        cdef Py_ssize_t i, count, stride = self.stride
        cdef bint sums_active
        self.split()
        if self.flips > self.size:
            self.flips = count = 0
            for i in range(self.size):
                count += piece[i] != 0
            sums_active = 2 * count > self.size
            memcpy(self.gram, self.others, stride * stride * sizeof(double))
            if not sums_active:
                memset(self.gram, 0, stride * stride * sizeof(double))
                for i in range(self.k):
                    self.gram[i * stride + i] = 1.0
            for i in range(self.size):
                self.active[i] = sums_active
        count = changed(piece, self.active, self.size, self.where)
        self.flips += count
        self.change(count, self.gram)

    cdef int factor(self, Model B, const double *piece) except -1:
        """Factorise τI + W¹ᐟ² U_FU_Fᵀ W¹ᐟ², F: components with `piece` zero.

        This matrix is bounded below by τI for every W.
        """
        self.face(piece)
        scaled(B.root, self.gram, B.tau, self.core, B.k, self.stride)
        if not eliminated(self.core, self.pivots, B.k, self.stride):
            raise ArithmeticError("the core of a model is not positive definite")
        return 0

    cdef int begin(self, Model B, const double *x, const double *g, FeasibleSet box,
                   double *s) except -1:
        cdef Py_ssize_t i, n = self.n, k = B.k
        self.split()
        memset(self.y, 0, self.stride * sizeof(double))
        memset(self.y_there, 0, self.stride * sizeof(double))
        box.minimise(x, g, B.tau, s, NULL)
        box.minimise_part(self.first, self.size, x, g + self.first, B.tau, s, self.piece)
        rows_times(self.U, s, self.slope, k, n)
        if self.size < n:
            rows_times(self.bounded, s + self.first, self.fixed, k, self.size)
            for i in range(k):
                self.fixed[i] = self.slope[i] - self.fixed[i]
        return 0

    cdef int newton(self, Model B) except -1:
        cdef Py_ssize_t i
        self.factor(B, self.piece)
        for i in range(B.k):
            self.dy[i] = B.root[i] * self.slope[i]
        solve(self.core, self.pivots, self.dy, self.stride)
        for i in range(B.k):
            self.dy[i] *= B.root[i] * B.tau
        return 0

    cdef int minimise_lagrangian(self, Model B, const double *x, const double *g, FeasibleSet box,
                  double *s) except -1:
        cdef Py_ssize_t o = self.first
        combination(1.0, self.bounded, self.y_there, g + o, self.t, B.k, self.size)
        box.minimise_part(o, self.size, x, self.t, B.tau, s, self.piece_there)
        return 0

    cdef int find_slope(self, Model B, const double *s) except -1:
        # for components without bounds, s = −(g + Uᵀy)/τ; `fixed` is the contribution
        # of these components to −Ug/τ
        cdef Py_ssize_t i
        rows_times(self.bounded, s + self.first, self.slope_there, B.k, self.size)
        for i in range(B.k):
            self.slope_there[i] -= self.y_there[i] / B.w[i]
        if self.size < self.n:
            rows_times(self.others, self.y_there, self.c, B.k, self.stride)
            for i in range(B.k):
                self.slope_there[i] += self.fixed[i] - self.c[i] / B.tau
        return 0

    cdef int finish(self, Model B, const double *x, const double *g, FeasibleSet box,
                    double *s) except -1:
        if self.size < self.n:
            combination(1.0, self.U, self.y_there, g, self.t, B.k, self.n)
            box.minimise(x, self.t, B.tau, s, NULL)
        return 0

    cdef double largest(self, Model B) except? -1:
        cdef Py_ssize_t i
        cdef double most = 0.0
        for i in range(B.k):
            most = fmax(most, B.w[i])
        return most

    cdef int leave_out(self, Model B, const double *s, double *sBs,
                       double *square) except -1:
        cdef Py_ssize_t i
        rows_times(self.U, s, self.c, B.k, self.n)
        for i in range(B.k):
            square[0] -= self.c[i] * self.c[i]
            sBs[0] -= B.w[i] * self.c[i] * self.c[i]
        return 0

    cdef int enter(self, Model B, const double *free) except -1:
        cdef Py_ssize_t i
        for i in range(self.size):
            self.piece[i] = 1 - free[self.first + i]
        return self.factor(B, self.piece)

    cdef double inverse(self, Model B, const double *free, const double *v,
                        const double *along, double *z) except? -1:
        # B_FF⁻¹ = (I − U_FᵀW¹ᐟ²(τI + W¹ᐟ²U_FU_FᵀW¹ᐟ²)⁻¹W¹ᐟ²U_F)/τ (Sherman, Morrison
        # and Woodbury)
        cdef Py_ssize_t i
        rows_times(self.U, v, self.c, B.k, self.n)
        for i in range(B.k):
            self.c[i] *= B.root[i]
        solve(self.core, self.pivots, self.c, self.stride)
        for i in range(B.k):
            self.c[i] *= B.root[i]
        combination(-1.0, self.U, self.c, v, z, B.k, self.n)
        return scale_free(1 / B.tau, free, along, z, self.n)


@cython.final
cdef class FactoredBasis(Basis):
    """Rows C = L⁻¹G with a sparse G and with the weight w of the penalty.

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
        cdef Py_ssize_t p
        new.rows, new.coarse, new.n = rows, rows.coarse, rows.n
        new.k, new.places = rows.coarse.k, rows.coarse.places
        p = new.places
        new.make_room(new.k)
        new.room = Room(6 * p + new.k + new.n)
        new.x_b, new.g_b = new.room.at, new.room.at + p
        new.low_b, new.high_b = new.g_b + p, new.g_b + 2 * p
        new.gradient_b, new.s_b = new.high_b + p, new.high_b + 2 * p
        new.Gg = new.s_b + p
        new.weights = new.Gg + new.k
        return new

    cdef Model model(self, Py_ssize_t k, const double *w, double shift, double tau):
        cdef Model B
        if w[0] + shift <= 0:
            return Model.of_norm(tau, self.n)
        B = Model.__new__(Model)
        B.basis, B.tau, B.n, B.k, B.room = self, tau, self.n, self.k, Room(1)
        B.w, B.w[0] = B.room.at, w[0] + shift
        return B

    cdef int begin(self, Model B, const double *x, const double *g, FeasibleSet box,
                   double *s) except -1:
        cdef Py_ssize_t i, j
        for i in range(self.places):
            j = self.coarse.bounded[i]
            self.x_b[i], self.g_b[i] = x[j], g[j]
            self.low_b[i], self.high_b[i] = box.lower[j], box.upper[j]
        self.coarse.times(g, self.Gg)
        memset(self.y_there, 0, self.k * sizeof(double))
        self.minimise_lagrangian(B, x, g, box, s)
        self.find_slope(B, s)
        memset(self.y, 0, self.k * sizeof(double))
        memcpy(self.slope, self.slope_there, self.k * sizeof(double))
        memcpy(self.piece, self.piece_there, self.places * sizeof(double))
        return 0

    cdef int newton(self, Model B) except -1:
        cdef Py_ssize_t i
        for i in range(self.places):
            self.coarse.active[i] = self.piece[i] != 0
        self.coarse.in_face(B.tau / B.w[0]).solve_to(self.slope, self.dy)
        scale(B.tau, self.dy, self.k)
        return 0

    cdef int minimise_lagrangian(self, Model B, const double *x, const double *g, FeasibleSet box,
                  double *s) except -1:
        self.coarse.combine_bounded(self.g_b, self.y_there, self.gradient_b)
        model_minimiser(self.x_b, self.gradient_b, B.tau, self.low_b, self.high_b,
                        self.s_b, self.piece_there, self.places)
        return 0

    cdef int find_slope(self, Model B, const double *s) except -1:
        cdef Py_ssize_t i
        cdef double *GGy = self.coarse.t
        for i in range(self.places):
            self.gradient_b[i] = self.gradient_b[i] / B.tau + self.s_b[i]
        self.coarse.times_bounded(self.gradient_b, self.slope_there)
        self.coarse.product(self.y_there, GGy)
        for i in range(self.k):
            self.slope_there[i] -= self.Gg[i] / B.tau + (1 / B.tau + 1 / B.w[0]) * GGy[i]
        return 0

    cdef int finish(self, Model B, const double *x, const double *g, FeasibleSet box,
                    double *s) except -1:
        cdef Py_ssize_t i
        self.coarse.combine(-1 / B.tau, g, -1 / B.tau, self.y_there, s)
        for i in range(self.places):
            s[self.coarse.bounded[i]] = self.s_b[i]
        return 0

    cdef double largest(self, Model B) except? -1:
        return B.w[0]

    cdef int leave_out(self, Model B, const double *s, double *sBs,
                       double *square) except -1:
        cdef Room Cs = Room(self.rows.r)
        cdef double part
        self.rows.times(s, Cs.at)
        part = self.rows.size(Cs.at) ** 2
        square[0] -= part
        sBs[0] -= B.w[0] * part
        return 0

    cdef int enter(self, Model B, const double *free) except -1:
        self.coarse.enter(free)
        self.factor = self.coarse.in_face(B.tau / B.w[0])
        copy_scaled(1 / B.tau, free, self.weights, self.n)
        return 0

    cdef double inverse(self, Model B, const double *free, const double *v,
                        const double *along, double *z) except? -1:
        self.coarse.times(v, self.coarse.t)
        self.factor.solve_to(self.coarse.t, self.coarse.y)
        self.coarse.weigh_difference(v, self.coarse.y, self.weights, z)
        return dot(z, along, self.n)
