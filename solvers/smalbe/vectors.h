/* Loops over vectors, and products with sparse matrices.

   Each function is compiled for AVX-512, for AVX2 with FMA, and for all other processors.
   Conditions are written as expressions, so that the compiler can vectorise them. */

#include <math.h>
#include <string.h>

#if defined(__x86_64__) && defined(__gnu_linux__) && !defined(__clang__) && __GNUC__ >= 12
#define CLONED __attribute__((target_clones("arch=x86-64-v4", "arch=x86-64-v3", "default")))
#else
#define CLONED
#endif

#define INLINE static inline __attribute__((always_inline))
#define STEP_ROUNDING (4 * 2.220446049250313e-16) /* relative error of a few operations */
#define LARGER(a, b) ((a) > (b) ? (a) : (b))
#define SMALLER(a, b) ((a) < (b) ? (a) : (b))

typedef const double *restrict in;
typedef double *restrict out;

enum {
    BLOCK = 256, /* components that stay in the cache from one loop to the next */
    MAX_DIAGONALS = 16
};

/* A sparse symmetric matrix F (n, n). If `count` is zero, F is stored by rows,
   otherwise by its upper diagonals with offsets 0, o₁, o₂, …: column i of
   `diagonals` (count, n) contains F[i, i + o]. */
typedef struct {
    Py_ssize_t n, count;
    const int *indptr, *indices;
    const Py_ssize_t *offset;
    const double *data, *diagonals;
} sparse;

/* y = s F v. Diagonals are multiplied in blocks of rows, and both triangles of F are
   products with the stored half. */
CLONED static void sparse_product(const sparse *F, double s, in v, out y)
{
    const int *restrict indptr = F->indptr, *restrict indices = F->indices;
    Py_ssize_t n = F->n;
    for (Py_ssize_t i = 0; i < n && !F->count; i++) {
        double sum = 0;
        for (int k = indptr[i]; k < indptr[i + 1]; k++)
            sum += F->data[k] * v[indices[k]];
        y[i] = s * sum;
    }
    for (Py_ssize_t first = 0; first < n && F->count; first += BLOCK) {
        Py_ssize_t last = SMALLER(first + BLOCK, n);
        for (Py_ssize_t i = first; i < last; i++)
            y[i] = s * F->diagonals[i] * v[i];
        for (Py_ssize_t d = 1; d < F->count; d++) {
            Py_ssize_t o = F->offset[d];
            in upper = F->diagonals + d * n;
            for (Py_ssize_t i = first; i < SMALLER(last, SMALLER(o, n - o)); i++)
                y[i] += s * upper[i] * v[i + o];
            for (Py_ssize_t i = LARGER(first, o); i < SMALLER(last, n - o); i++)
                y[i] += s * (upper[i] * v[i + o] + upper[i - o] * v[i - o]);
            for (Py_ssize_t i = LARGER(first, LARGER(o, n - o)); i < last; i++)
                y[i] += s * upper[i - o] * v[i - o];
        }
    }
}

/* Write the offsets of the nonzero diagonals of F and return their number, or 0 if
   there are more than `most` diagonals. slot (n,) is workspace. */
static Py_ssize_t find_diagonals(const sparse *F, Py_ssize_t most, Py_ssize_t *offset,
                                 signed char *slot)
{
    Py_ssize_t count = 1;
    memset(slot, 0, F->n);
    offset[0] = 0, slot[0] = 1;
    for (Py_ssize_t i = 0; i < F->n; i++)
        for (int k = F->indptr[i]; k < F->indptr[i + 1]; k++) {
            Py_ssize_t o = F->indices[k] - i;
            if (o <= 0 || slot[o])
                continue;
            if (count >= most)
                return 0;
            offset[count++] = o;
            slot[o] = 1;
        }
    for (Py_ssize_t c = 2; c < count; c++) /* in ascending order */
        for (Py_ssize_t d = c; d > 1 && offset[d] < offset[d - 1]; d--) {
            Py_ssize_t o = offset[d];
            offset[d] = offset[d - 1], offset[d - 1] = o;
        }
    for (Py_ssize_t c = 0; c < count; c++)
        slot[offset[c]] = (signed char) c;
    return count;
}

/* Fill diagonals (count, n), initially zero; `find_diagonals` has written the slots. */
static void fill_diagonals(const sparse *F, const signed char *slot, double *diagonals)
{
    for (Py_ssize_t i = 0; i < F->n; i++)
        for (int k = F->indptr[i]; k < F->indptr[i + 1]; k++)
            if (F->indices[k] >= i)
                diagonals[slot[F->indices[k] - i] * F->n + i] += F->data[k];
}

CLONED static double dot(const double *a, const double *b, Py_ssize_t n)
{
    double total = 0;
    for (Py_ssize_t i = 0; i < n; i++)
        total += a[i] * b[i];
    return total;
}

/* b = b + s a. */
CLONED static void add(double s, in a, out b, Py_ssize_t n)
{
    for (Py_ssize_t i = 0; i < n; i++)
        b[i] += s * a[i];
}

CLONED static void scale(double s, double *a, Py_ssize_t n)
{
    for (Py_ssize_t i = 0; i < n; i++)
        a[i] *= s;
}

/* b = s a. */
CLONED static void copy_scaled(double s, in a, out b, Py_ssize_t n)
{
    for (Py_ssize_t i = 0; i < n; i++)
        b[i] = s * a[i];
}

/* t = free a; t may be a. */
CLONED static void masked(in free, const double *a, double *t, Py_ssize_t n)
{
    for (Py_ssize_t i = 0; i < n; i++)
        t[i] = free[i] * a[i];
}

/* Return 1 if a and b have the same components, else 0. */
CLONED static int same(in a, in b, Py_ssize_t n)
{
    for (Py_ssize_t i = 0; i < n; i += BLOCK) {
        Py_ssize_t last = SMALLER(i + BLOCK, n), differ = 0;
        for (Py_ssize_t j = i; j < last; j++)
            differ |= a[j] != b[j];
        if (differ)
            return 0;
    }
    return 1;
}

/* p = z - γp. */
CLONED static void update_direction(in z, double gamma, out p, Py_ssize_t n)
{
    for (Py_ssize_t i = 0; i < n; i++)
        p[i] = z[i] - gamma * p[i];
}

/* c = U v for U (k, n) stored by rows, with one pass over v for four rows. */
CLONED static void rows_times(in U, in v, out c, Py_ssize_t k, Py_ssize_t n)
{
    Py_ssize_t i = 0;
    for (; i + 4 <= k; i += 4) {
        in u = U + i * n;
        double c0 = 0, c1 = 0, c2 = 0, c3 = 0;
        for (Py_ssize_t j = 0; j < n; j++) {
            c0 += u[j] * v[j], c1 += u[n + j] * v[j];
            c2 += u[2 * n + j] * v[j], c3 += u[3 * n + j] * v[j];
        }
        c[i] = c0, c[i + 1] = c1, c[i + 2] = c2, c[i + 3] = c3;
    }
    for (; i < k; i++) {
        double sum = 0;
        for (Py_ssize_t j = 0; j < n; j++)
            sum += U[i * n + j] * v[j];
        c[i] = sum;
    }
}

/* S = S + s uuᵀ, lower triangle (k, k), with uⱼ = U[n j]. */
CLONED static void add_outer(double s, in U, Py_ssize_t n, out S, Py_ssize_t k)
{
    double u[k];
    for (Py_ssize_t i = 0; i < k; i++) {
        u[i] = U[n * i];
        for (Py_ssize_t j = 0; j <= i; j++)
            S[i * k + j] += s * u[i] * u[j];
    }
}

/* y = y + s Uᵀc for U (k, n) stored by rows, with one pass over y for four rows. */
CLONED static void add_combination(double s, in U, in c, out y, Py_ssize_t k, Py_ssize_t n)
{
    Py_ssize_t i = 0;
    for (; i + 4 <= k; i += 4) {
        in u = U + i * n;
        double c0 = s * c[i], c1 = s * c[i + 1], c2 = s * c[i + 2], c3 = s * c[i + 3];
        for (Py_ssize_t j = 0; j < n; j++)
            y[j] += c0 * u[j] + c1 * u[n + j] + c2 * u[2 * n + j] + c3 * u[3 * n + j];
    }
    for (; i < k; i++)
        for (Py_ssize_t j = 0; j < n; j++)
            y[j] += s * c[i] * U[i * n + j];
}

/* Return the α at which x - αp reaches its first bound, at most `least`. A block
   without such a bound is detected without a division. */
CLONED static double first_bound(in x, in p, in lower, in upper, double least, Py_ssize_t n)
{
    for (Py_ssize_t i = 0; i < n; i += BLOCK) {
        Py_ssize_t last = SMALLER(i + BLOCK, n), nearer = 0;
        for (Py_ssize_t j = i; j < last; j++) {
            double room = p[j] > 0 ? x[j] - lower[j] : upper[j] - x[j];
            nearer |= room < least * fabs(p[j]);
        }
        for (Py_ssize_t j = i; j < last && nearer; j++) {
            double room = p[j] > 0 ? x[j] - lower[j] : upper[j] - x[j];
            if (p[j] != 0 && room < least * fabs(p[j]))
                least = room > 0 ? room / fabs(p[j]) : 0;
        }
    }
    return least;
}

/* Compute φ and `free` of one component, and add to sums ‖φ‖², ‖β‖², φ̃ᵀφ. */
INLINE void split_one(double x, double g, double lower, double upper, double tau,
                      double *phi, double *free, double *sums)
{
    double down = x - lower, up = x - upper;
    double inside = (down > 0) & (up < 0) ? 1.0 : 0.0;
    double f = inside > 0 ? g : 0.0;
    int leads = ((g < 0) & (up < 0)) | ((g > 0) & (down > 0));
    double b = leads ? g - f : 0.0;
    double cut = f > tau * up ? f : tau * up;
    cut = cut < tau * down ? cut : tau * down;
    cut = inside > 0 ? cut : 0.0;
    *free = inside;
    *phi = f;
    sums[0] += f * f;
    sums[1] += b * b;
    sums[2] += cut * f;
}

/* Compute φ and `free` (1 for free components, else 0); sums = ‖φ‖², ‖β‖², φ̃ᵀφ with
   ᾱ = 1/τ. */
CLONED static void split(in x, in g, in lower, in upper, double tau, out phi, out free,
                         Py_ssize_t n, out sums)
{
    double t[3] = {0};
    for (Py_ssize_t i = 0; i < n; i++)
        split_one(x[i], g[i], lower[i], upper[i], tau, phi + i, free + i, t);
    memcpy(sums, t, sizeof t);
}

/* x = x - αp and g = g - αHp, with components within rounding of a bound set to this
   bound, then `split`. */
CLONED static void advance(double alpha, out x, out g, in p, in Hp, in lower, in upper,
                           double tau, out phi, out free, Py_ssize_t n, out sums)
{
    double t[3] = {0};
    for (Py_ssize_t i = 0; i < n; i++) {
        double step = alpha * p[i], to = x[i] - step;
        double noise = STEP_ROUNDING * (fabs(x[i]) + fabs(step));
        int down = (to - lower[i] <= noise) & (step >= 0);
        int up = (upper[i] - to <= noise) & (step <= 0);
        to = up ? upper[i] : to;
        x[i] = down ? lower[i] : to;
        g[i] -= alpha * Hp[i];
        split_one(x[i], g[i], lower[i], upper[i], tau, phi + i, free + i, t);
    }
    memcpy(sums, t, sizeof t);
}

/* y = P(x - αp) with the projection P onto the bounds. */
CLONED static void projected(const double *x, double alpha, const double *p, in lower,
                            in upper, double *y, Py_ssize_t n)
{
    for (Py_ssize_t i = 0; i < n; i++) {
        double to = x[i] - alpha * p[i];
        to = to < lower[i] ? lower[i] : to;
        y[i] = to > upper[i] ? upper[i] : to;
    }
}

/* y = g, but 0 where -g points out of the box at a bound. */
CLONED static void projected_gradient(in x, in g, in lower, in upper, out y, Py_ssize_t n)
{
    for (Py_ssize_t i = 0; i < n; i++) {
        int leaves = ((x[i] <= lower[i]) & (g[i] > 0)) | ((x[i] >= upper[i]) & (g[i] < 0));
        y[i] = leaves ? 0.0 : g[i];
    }
}

/* s = argmin gᵀs + τ/2‖s‖² over the box. piece receives -1 for components at the
   lower bound, 1 at the upper bound, else 0. */
CLONED static void model_minimiser(in x, in g, double tau, in lower, in upper, out s,
                                  out piece, Py_ssize_t n)
{
    double length = 1 / tau;
    for (Py_ssize_t i = 0; i < n; i++) {
        double target = x[i] - length * g[i];
        double low = target <= lower[i] ? 1.0 : 0.0;
        double high = target >= upper[i] ? 1.0 - low : 0.0;
        target = target >= upper[i] ? upper[i] : target;
        target = low > 0 ? lower[i] : target;
        piece[i] = high - low;
        s[i] = target - x[i];
    }
}

/* Add terms of the stopping test (`solvers/common/stopping.py`) at a point with the
   residual r, where w = D⁻¹ᐟ²: xᵀPx, qᵀx and Σ(xᵢ/wᵢ)² to `sums`; `most` becomes at least
   as large as the components of w|r|, w max(|Px|, |q|) and |x|/w. */
CLONED static void
terms_of_test(in x, in Px, in q, in r, in w, Py_ssize_t n, out sums, out most)
{
    double xPx = 0, qx = 0, square = 0;
    double error = most[0], force = most[1], size = most[2];
    for (Py_ssize_t i = 0; i < n; i++) {
        double residual = w[i] * fabs(r[i]), length = fabs(x[i]) / w[i];
        double larger = w[i] * LARGER(fabs(Px[i]), fabs(q[i]));
        xPx += x[i] * Px[i];
        qx += q[i] * x[i];
        square += length * length;
        error = LARGER(residual, error);
        force = LARGER(larger, force);
        size = LARGER(length, size);
    }
    sums[0] += xPx, sums[1] += qx, sums[2] += square;
    most[0] = error, most[1] = force, most[2] = size;
}

/* y = (LLᵀ)⁻¹y for L (k, k), stored by rows with the reciprocals of its diagonal. */
CLONED static void solve_cholesky(in L, out y, Py_ssize_t k)
{
    for (Py_ssize_t i = 0; i < k; i++) {
        double sum = y[i];
        for (Py_ssize_t j = 0; j < i; j++)
            sum -= L[i * k + j] * y[j];
        y[i] = sum * L[i * k + i];
    }
    for (Py_ssize_t i = k - 1; i >= 0; i--) {
        y[i] *= L[i * k + i];
        for (Py_ssize_t j = 0; j < i; j++)
            y[j] -= y[i] * L[i * k + j];
    }
}
