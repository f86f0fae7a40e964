# cython: language_level=3, boundscheck=False, wraparound=False, cdivision=True
# cython: initializedcheck=False
"""Exact minimisation of a proximal augmented Lagrangian over a box, by faces.

The class `Faces` updates the Cholesky factor of the Hessian on the free components. A
row is appended for a component that becomes free. If a component reaches a bound, its
row is removed, and the rows below are factorised again.
`solvers.smalbe.direct` uses this class.
"""

from cpython.exc cimport PyErr_CheckSignals
from libc.math cimport fabs, fmax, fmin, sqrt
from libc.string cimport memcpy
from scipy.linalg.cython_blas cimport dgemm, dsymv, dsyrk, dtrsm, dtrsv
from scipy.linalg.cython_lapack cimport dpotrf

import numpy as np

cdef double ROUNDING = 8 * 2.0 ** -52  # rounding of a sum, relative to the absolute terms
# initial `share` of `minimise`: components whose gradient, divided by √Pᵢᵢ, is at least
# this fraction of the largest such value are released together
cdef double RELEASE_SHARE = 0.9
# diagonal entries below this factor times their mean count as zero
cdef double FLAT = 1e-12

def _whole(a):
    return np.ascontiguousarray(a, dtype=float)


cdef class Faces:
    """½xᵀPx + qᵀx + aᵀCν + ρ/2 ‖Cν‖² + δ/2 ‖x − x_k‖²_D over l ≤ x ≤ u, ν = x − x̃.

    P (n, n) is positive semidefinite, and C has the shape (r, n). D is the diagonal of
    P, in which the mean entry replaces entries near zero. The multipliers a and the
    proximal centre x_k are initially zero. L (k, k) is the factor of P + ρCᵀC + δD in
    the order in which components became free. L is stored by rows, which LAPACK reads
    as the columns of Lᵀ; the rows of `among` are the columns of C in the same order. A
    component whose distance to a bound is within the rounding of qᵢ/Dᵢ is set to the
    bound.
    """

    cdef Py_ssize_t n, k
    cdef int r
    cdef readonly long products, solves, joined, left
    cdef readonly double rho
    cdef double delta, share
    cdef const double[:, ::1] P, C
    cdef double[:, ::1] L, among
    cdef const double[::1] q, x_tilde, lower, upper
    cdef readonly object diagonal
    cdef double[::1] d, D, mu, off, centre, near, noise, size, x, g, y, gy, step
    cdef signed char[::1] free, wanted, face
    cdef int[::1] order, place

    def __init__(self, P, q, C, x_tilde, bounds, double rho, double delta):
        """Set x to the projection of zero onto the box and factorise on its face.

        rho is relative to ‖P‖ (Frobenius). Raises ArithmeticError if P is not positive
        semidefinite.
        """
        cdef Py_ssize_t i, n = q.size
        cdef double square = 0.0, mean = 0.0
        self.n, self.r, self.delta = n, len(C), delta
        self.L, self.among = np.empty((n, n)), np.empty((n, max(self.r, 1)))
        self.P, self.q, self.C, self.x_tilde, self.lower, self.upper = map(
            _whole, (P, q, C, x_tilde, *bounds)
        )
        self.mu, self.off = np.zeros((2, self.r))
        self.diagonal = np.empty(n)
        self.d = self.diagonal
        cdef double[:, ::1] room = np.zeros((10, n))
        self.D, self.centre, self.near, self.noise = room[0], room[1], room[2], room[3]
        self.size, self.x, self.g, self.y = room[4], room[5], room[6], room[7]
        self.gy, self.step = room[8], room[9]
        self.free, self.wanted, self.face = np.zeros((3, n), dtype=np.int8)
        self.order, self.place = np.full((2, n), -1, dtype=np.int32)
        for i in range(n):
            self.d[i] = self.P[i, i]
            if self.d[i] < 0:
                raise ArithmeticError("P is not positive semidefinite")
            mean += self.d[i] / n
        for i in range(n * n):
            square += (&self.P[0, 0])[i] * (&self.P[0, 0])[i]
        self.rho = rho * (sqrt(square) or 1.0)
        for i in range(n):
            self.D[i] = self.d[i] if self.d[i] > FLAT * mean else mean or 1.0
            self.size[i] = sqrt(self.d[i] + delta * self.D[i])
            self.near[i] = ROUNDING * fabs(self.q[i]) / self.D[i]
            self.x[i] = fmin(fmax(0.0, self.lower[i]), self.upper[i])
            self.wanted[i] = self.lower[i] < self.x[i] < self.upper[i]
        self.enter()

    def at(self, const double[::1] a):
        """Return x, Px and z_box (n,) for multipliers a.

        A component of z_box is the component of −(Px + q + Cᵀa) if x is at a bound and
        this value has the admissible sign, otherwise 0.
        """
        cdef Py_ssize_t i, m, n = self.n
        cdef double total
        x, Px, z_box = np.array(self.x), np.zeros(n), np.zeros(n)
        cdef double[::1] product = Px, z = z_box
        self.add_product(self.x, product)
        for i in range(n):
            if self.free[i]:
                continue
            total = product[i] + self.q[i]
            for m in range(self.r):
                total += self.C[m, i] * a[m]
            if self.x[i] <= self.lower[i]:
                z[i] = -fmax(total, 0.0)
            if self.x[i] >= self.upper[i]:
                z[i] -= fmin(total, 0.0)
        return x, Px, z_box

    @property
    def a(self):
        """Multipliers (r,) of Cν = 0."""
        return np.array(self.mu)

    # the factor

    cdef int enter(self) except -1:
        """Update the factor for the face with the free components `wanted`."""
        cdef Py_ssize_t i, j, first = self.k, kept, base, unchanged, a, b
        cdef int gone = 0, n = self.n, r = max(self.r, 1), s, t, info = 0
        cdef double one = 1.0, minus = -1.0
        for j in range(self.k):
            if not self.wanted[self.order[j]]:
                gone += 1
                first = min(first, j)
        kept = base = first
        for j in range(first, self.k):
            i = self.order[j]
            if self.wanted[i]:
                memcpy(&self.L[kept, 0], &self.L[j, 0], base * sizeof(double))
                self.put(kept, i)
                kept += 1
            else:
                self.place[i] = -1
        self.k = kept
        self.left += gone
        unchanged = self.k
        for i in range(self.n):
            self.free[i] = self.wanted[i]
            if self.wanted[i] and self.place[i] < 0:
                self.put(self.k, i)
                self.k += 1
        self.joined += self.k - unchanged
        if self.k == base:
            return 0
        for a in range(base, self.k):
            for b in range(0 if a >= unchanged else base, a + 1):
                self.L[a, b] = self.P[self.order[a], self.order[b]]
            self.L[a, a] += self.delta * self.D[self.order[a]]
        s, t = self.k - unchanged, base
        if s and t:
            dgemm(b"T", b"N", &t, &s, &r, &self.rho, &self.among[0, 0], &r,
                  &self.among[unchanged, 0], &r, &one, &self.L[unchanged, 0], &n)
            dtrsm(b"L", b"U", b"T", b"N", &t, &s, &one, &self.L[0, 0], &n,
                  &self.L[unchanged, 0], &n)
        s = self.k - base
        dsyrk(b"U", b"T", &s, &r, &self.rho, &self.among[base, 0], &r, &one,
              &self.L[base, base], &n)
        if t:
            dsyrk(b"U", b"T", &s, &t, &minus, &self.L[base, 0], &n, &one,
                  &self.L[base, base], &n)
        dpotrf(b"U", &s, &self.L[base, base], &n, &info)
        if info:
            raise ArithmeticError("a face is not positive definite")
        return 0

    cdef void put(self, Py_ssize_t j, Py_ssize_t i):
        """Assign row j of the factor to component i."""
        cdef Py_ssize_t m
        self.order[j], self.place[i], self.among[j, 0] = i, j, 0.0
        for m in range(self.r):
            self.among[j, m] = self.C[m, i]

    cdef void solve(self):
        """Replace the first k components of `step` by (LLᵀ)⁻¹ step."""
        cdef int n = self.n, k = self.k, one = 1
        self.solves += 1
        if k:
            dtrsv(b"U", b"T", b"N", &k, &self.L[0, 0], &n, &self.step[0], &one)
            dtrsv(b"U", b"N", b"N", &k, &self.L[0, 0], &n, &self.step[0], &one)

    # the method

    cdef void gradient(self, const double[::1] x, double[::1] g):
        """g ← gradient at x, `off` ← Cν; take one product."""
        cdef Py_ssize_t i, m, n = self.n
        cdef double weight
        for i in range(n):
            g[i] = self.q[i] + self.delta * self.D[i] * (x[i] - self.centre[i])
        for m in range(self.r):
            self.off[m] = 0.0
            for i in range(n):
                self.off[m] += self.C[m, i] * (x[i] - self.x_tilde[i])
            weight = self.mu[m] + self.rho * self.off[m]
            for i in range(n):
                g[i] += weight * self.C[m, i]
        self.add_product(x, g)

    cdef void add_product(self, const double[::1] x, double[::1] g):
        """g ← g + Px."""
        cdef int n = self.n, one = 1
        cdef double unit = 1.0
        self.products += 1
        dsymv(b"U", &n, &unit, <double *> &self.P[0, 0], &n, <double *> &x[0], &one,
              &unit, &g[0], &one)

    def update(self):
        """a ← a + ρCν and x_k ← x; return ‖Cν‖."""
        cdef Py_ssize_t i, m
        cdef double square = 0.0
        for m in range(self.r):
            self.off[m] = 0.0
            for i in range(self.n):
                self.off[m] += self.C[m, i] * (self.x[i] - self.x_tilde[i])
            self.mu[m] += self.rho * self.off[m]
            square += self.off[m] * self.off[m]
        self.centre[:] = self.x
        return sqrt(square)

    def penalise(self, double rho):
        """Change ρ and factorise again."""
        self.rho, self.k = rho, 0
        self.wanted[:] = self.free
        np.asarray(self.place)[:] = -1
        self.enter()

    def minimise(self, long most):
        """Minimise from x; return False after `most` solves with factors of faces.

        1. Set x to the minimiser on its face, where the face is reduced until no
           component leaves the box.
        2. If no component at a bound has a feasible descent direction, x is the
           minimiser.
        3. Release the components whose gradient, divided by √Pᵢᵢ, is at least `share`
           times the largest such value, and repeat step 1. Halve `share` if no
           component left the face, otherwise reset it to RELEASE_SHARE. If the cost has
           decreased, go to 2.
        4. Otherwise release only the component with the largest of these values. Step
           to the minimiser on the new face, or to the first bound; in the latter case,
           fix the component that reached the bound, and repeat the step. Go to 2.

        Steps 3 and 4 decrease the cost, and each of them ends at the minimiser on a
        face. Therefore no face occurs twice, and the method is finite.
        """
        cdef long left
        self.share = RELEASE_SHARE
        self.wanted[:] = self.free
        self.gradient(self.x, self.g)
        self.shrink(self.x, self.g)
        while self.solves < most:
            PyErr_CheckSignals()
            self.face[:] = self.free
            if not self.release(self.share):
                return True
            self.y[:], self.gy[:] = self.x, self.g
            left = self.left
            self.shrink(self.y, self.gy)
            self.share = RELEASE_SHARE if self.left > left else self.share / 2
            if not self.lowered():
                self.release(1.0)
                self.y[:], self.gy[:] = self.x, self.g
                self.advance(self.y, self.gy)
                if not self.lowered():  # the decrease is within rounding
                    self.wanted[:] = self.face
                    self.enter()
                    return True
            self.x[:], self.g[:] = self.y, self.gy
        return False

    cdef int shrink(self, double[::1] x, double[::1] g) except -1:
        """Minimise on the face `wanted`; fix components that leave the box, and repeat
        until no component does.
        """
        cdef Py_ssize_t i, j
        cdef bint leaves = True
        while leaves:
            leaves = False
            self.enter()
            for j in range(self.k):
                self.step[j] = g[self.order[j]]
            self.solve()
            for j in range(self.k):
                i = self.order[j]
                x[i] -= self.step[j]
                if x[i] - self.lower[i] <= self.near[i]:
                    x[i], self.wanted[i], leaves = self.lower[i], False, True
                elif self.upper[i] - x[i] <= self.near[i]:
                    x[i], self.wanted[i], leaves = self.upper[i], False, True
            self.gradient(x, g)
        return 0

    cdef int advance(self, double[::1] x, double[::1] g) except -1:
        """Step to the minimiser on the face `wanted`; fix components at bounds."""
        cdef Py_ssize_t i, j
        cdef double length = 0.0, s, bound
        while length < 1:
            self.enter()
            for j in range(self.k):
                self.step[j] = g[self.order[j]]
            self.solve()
            length = 1.0
            for j in range(self.k):
                i, s = self.order[j], self.step[j]
                if s:
                    bound = self.lower[i] if s > 0 else self.upper[i]
                    length = fmin(length, fmax((x[i] - bound) / s, 0.0))
            for j in range(self.k):
                i, s = self.order[j], self.step[j]
                bound = self.lower[i] if s > 0 else self.upper[i]
                if length < 1 and s and (x[i] - bound) / s <= length:
                    x[i], self.wanted[i] = bound, False
                else:
                    x[i] -= length * s
            self.gradient(x, g)
        return 0

    cdef bint release(self, double share):
        """Add the components to be released to `wanted`; return True if there are any.

        A component at a bound is released if it has a feasible descent direction and if
        its gradient, divided by √Pᵢᵢ, is at least `share` times the largest of these
        quotients. The gradient must also exceed its rounding error, for which Σ|Pᵢⱼxⱼ|
        is bounded by √Pᵢᵢ Σ√Pⱼⱼ|xⱼ|.
        """
        cdef Py_ssize_t i, m
        cdef double most = 0.0, total = 0.0, inward, terms, force
        self.wanted[:] = self.face
        for i in range(self.n):
            total += self.size[i] * fabs(self.x[i])
        for i in range(self.n):
            terms = self.size[i] * total + fabs(self.q[i])
            for m in range(self.r):
                force = fabs(self.mu[m]) + self.rho * fabs(self.off[m])
                terms += fabs(self.C[m, i]) * force
            self.noise[i], inward = ROUNDING * terms, 0.0
            if not self.face[i] and self.lower[i] < self.upper[i]:
                inward = -self.g[i] if self.x[i] <= self.lower[i] else self.g[i]
                if inward <= self.noise[i]:
                    inward = 0.0
            self.step[i] = inward / self.size[i]
            most = fmax(most, self.step[i])
        for i in range(self.n if most else 0):
            if self.step[i] >= share * most:
                self.wanted[i] = True
                if share == 1:
                    break
        return most > 0

    cdef bint lowered(self):
        """Return True if the cost decreases from x to y by more than rounding errors.

        The change of a quadratic cost is ½(g_x + g_y)ᵀ(y − x).
        """
        cdef Py_ssize_t i
        cdef double change = 0.0, step
        for i in range(self.n):
            step = self.y[i] - self.x[i]
            change += (self.g[i] + self.gy[i]) * step + self.noise[i] * fabs(step)
        return change < 0
