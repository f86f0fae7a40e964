/* The loops over vectors of MPRGP (`solvers/smalbe/kernels.py` has them in NumPy).

   Compiled twice, for processors with AVX2 and FMA and for all others; which one runs is
   decided when the module is loaded. Selections are written as expressions, so that the
   compiler can do four components at once. */

#include <math.h>
#include <string.h>

#if defined(__x86_64__) && defined(__gnu_linux__) && !defined(__clang__) && __GNUC__ >= 12
#define TWICE __attribute__((target_clones("arch=x86-64-v3", "default")))
#else
#define TWICE
#endif

#define ROUNDING (4 * 2.220446049250313e-16) /* relative error of a few operations */

typedef const double *restrict in;
typedef double *restrict out;

/* y = s F v by the rows of F (n, n). */
TWICE static void sparse_product(const int *restrict indptr, const int *restrict indices,
                                 in data, double s, in v, out y, Py_ssize_t n)
{
    for (Py_ssize_t i = 0; i < n; i++) {
        double total = 0;
        for (int k = indptr[i]; k < indptr[i + 1]; k++)
            total += data[k] * v[indices[k]];
        y[i] = s * total;
    }
}

/* Four components at once; what the compiler makes of the loops below on its own is not
   as fast where several sums are taken in one pass. */
typedef double __attribute__((vector_size(32), aligned(8), may_alias)) four;
#define FOUR(a) (*(const four *) (a))
#define EACH(s) ((four){(s), (s), (s), (s)})

static inline __attribute__((always_inline)) double total(four t)
{
    return (t[0] + t[1]) + (t[2] + t[3]);
}

/* y = s F v for symmetric F (n, n), of which the lower triangle is read, four rows in
   one pass over v and y. */
TWICE static void symmetric_product(in F, double s, in v, out y, Py_ssize_t n)
{
    Py_ssize_t i = 0;
    for (; i + 4 <= n; i += 4) {
        in f0 = F + i * n, f1 = f0 + n, f2 = f1 + n, f3 = f2 + n;
        double v0 = s * v[i], v1 = s * v[i + 1], v2 = s * v[i + 2], v3 = s * v[i + 3];
        four w0 = EACH(v0), w1 = EACH(v1), w2 = EACH(v2), w3 = EACH(v3);
        four t0 = EACH(0), t1 = EACH(0), t2 = EACH(0), t3 = EACH(0);
        for (Py_ssize_t j = 0; j < i; j += 4) {
            four w = FOUR(v + j), to = FOUR(y + j);
            to += FOUR(f0 + j) * w0, t0 += FOUR(f0 + j) * w;
            to += FOUR(f1 + j) * w1, t1 += FOUR(f1 + j) * w;
            to += FOUR(f2 + j) * w2, t2 += FOUR(f2 + j) * w;
            to += FOUR(f3 + j) * w3, t3 += FOUR(f3 + j) * w;
            *(four *) (y + j) = to;
        }
        y[i] = s * total(t0) + f0[i] * v0 + f1[i] * v1 + f2[i] * v2 + f3[i] * v3;
        y[i + 1] = s * total(t1) + f1[i] * v0 + f1[i + 1] * v1 + f2[i + 1] * v2
                   + f3[i + 1] * v3;
        y[i + 2] = s * total(t2) + f2[i] * v0 + f2[i + 1] * v1 + f2[i + 2] * v2
                   + f3[i + 2] * v3;
        y[i + 3] = s * total(t3) + f3[i] * v0 + f3[i + 1] * v1 + f3[i + 2] * v2
                   + f3[i + 3] * v3;
    }
    for (; i < n; i++) {
        in f = F + i * n;
        double at = s * v[i], rest = 0;
        for (Py_ssize_t j = 0; j < i; j++) {
            y[j] += f[j] * at;
            rest += f[j] * v[j];
        }
        y[i] = s * rest + f[i] * at;
    }
}

TWICE static double dot(const double *a, const double *b, Py_ssize_t n)
{
    double total = 0;
    for (Py_ssize_t i = 0; i < n; i++)
        total += a[i] * b[i];
    return total;
}

/* b = b + s a. */
TWICE static void add(double s, in a, out b, Py_ssize_t n)
{
    for (Py_ssize_t i = 0; i < n; i++)
        b[i] += s * a[i];
}

TWICE static void scale(double s, double *a, Py_ssize_t n)
{
    for (Py_ssize_t i = 0; i < n; i++)
        a[i] *= s;
}

/* c = U v for U (k, n) by rows, four of which share a pass over v. */
TWICE static void rows_times(in U, in v, out c, Py_ssize_t k, Py_ssize_t n)
{
    Py_ssize_t i = 0, whole = n & ~(Py_ssize_t) 3;
    for (; i + 4 <= k; i += 4) {
        in u0 = U + i * n, u1 = u0 + n, u2 = u1 + n, u3 = u2 + n;
        four t0 = EACH(0), t1 = EACH(0), t2 = EACH(0), t3 = EACH(0);
        for (Py_ssize_t j = 0; j < whole; j += 4) {
            four w = FOUR(v + j);
            t0 += FOUR(u0 + j) * w;
            t1 += FOUR(u1 + j) * w;
            t2 += FOUR(u2 + j) * w;
            t3 += FOUR(u3 + j) * w;
        }
        double c0 = total(t0), c1 = total(t1), c2 = total(t2), c3 = total(t3);
        for (Py_ssize_t j = whole; j < n; j++) {
            c0 += u0[j] * v[j];
            c1 += u1[j] * v[j];
            c2 += u2[j] * v[j];
            c3 += u3[j] * v[j];
        }
        c[i] = c0, c[i + 1] = c1, c[i + 2] = c2, c[i + 3] = c3;
    }
    for (; i + 2 <= k; i += 2) {
        in u0 = U + i * n, u1 = u0 + n;
        four t0 = EACH(0), t1 = EACH(0);
        for (Py_ssize_t j = 0; j < whole; j += 4) {
            t0 += FOUR(u0 + j) * FOUR(v + j);
            t1 += FOUR(u1 + j) * FOUR(v + j);
        }
        double c0 = total(t0), c1 = total(t1);
        for (Py_ssize_t j = whole; j < n; j++) {
            c0 += u0[j] * v[j];
            c1 += u1[j] * v[j];
        }
        c[i] = c0, c[i + 1] = c1;
    }
    if (i < k) {
        double rest = 0;
        for (Py_ssize_t j = 0; j < n; j++)
            rest += U[i * n + j] * v[j];
        c[i] = rest;
    }
}

/* y = y + s Uᵀc for U (k, n) by rows, four of which share a pass over y. */
TWICE static void add_combination(double s, in U, in c, out y, Py_ssize_t k,
                                  Py_ssize_t n)
{
    Py_ssize_t i = 0, whole = n & ~(Py_ssize_t) 3;
    for (; i + 4 <= k; i += 4) {
        in u0 = U + i * n, u1 = u0 + n, u2 = u1 + n, u3 = u2 + n;
        double c0 = s * c[i], c1 = s * c[i + 1], c2 = s * c[i + 2], c3 = s * c[i + 3];
        four w0 = EACH(c0), w1 = EACH(c1), w2 = EACH(c2), w3 = EACH(c3);
        for (Py_ssize_t j = 0; j < whole; j += 4)
            *(four *) (y + j) += FOUR(u0 + j) * w0 + FOUR(u1 + j) * w1
                                 + FOUR(u2 + j) * w2 + FOUR(u3 + j) * w3;
        for (Py_ssize_t j = whole; j < n; j++)
            y[j] += c0 * u0[j] + c1 * u1[j] + c2 * u2[j] + c3 * u3[j];
    }
    for (; i + 2 <= k; i += 2) {
        in u0 = U + i * n, u1 = u0 + n;
        double c0 = s * c[i], c1 = s * c[i + 1];
        for (Py_ssize_t j = 0; j < n; j++)
            y[j] += c0 * u0[j] + c1 * u1[j];
    }
    if (i < k) {
        double c0 = s * c[i];
        for (Py_ssize_t j = 0; j < n; j++)
            y[j] += c0 * U[i * n + j];
    }
}

#define BLOCK 256 /* components that stay in the cache from one loop to the next */
typedef long long __attribute__((may_alias)) ordered; /* as doubles ≥ 0 are */

/* α of x - αp: told = the minimising, the largest feasible, gᵀp, pᵀHp. */
TWICE static void lengths(in x, in g, in p, in Hp, in lower, in upper, Py_ssize_t n,
                          out told)
{
    double curvature = 0, slope = 0, room[BLOCK], feasible = INFINITY;
    ordered least = *(ordered *) &feasible;
    for (Py_ssize_t first = 0; first < n; first += BLOCK) {
        Py_ssize_t size = n - first < BLOCK ? n - first : BLOCK;
        for (Py_ssize_t j = 0; j < size; j++) {
            Py_ssize_t i = first + j;
            double bound = p[i] > 0 ? lower[i] : upper[i];
            double to = (x[i] - bound) / p[i];
            to = to > 0 ? to : 0;
            room[j] = p[i] != 0 ? to : INFINITY;
            curvature += p[i] * Hp[i];
            slope += g[i] * p[i];
        }
        for (Py_ssize_t j = 0; j < size; j++) {
            ordered to = *(ordered *) (room + j);
            least = to < least ? to : least;
        }
    }
    memcpy(&feasible, &least, sizeof feasible);
    told[0] = curvature > 0 ? slope / curvature : INFINITY;
    told[1] = feasible;
    told[2] = slope;
    told[3] = curvature;
}

static inline __attribute__((always_inline)) void
move_block(double alpha, out x, out g, in p, in Hp, in lower, in upper, Py_ssize_t n)
{
    for (Py_ssize_t i = 0; i < n; i++) {
        double step = alpha * p[i], to = x[i] - step;
        double noise = ROUNDING * (fabs(x[i]) + fabs(step));
        int down = (to - lower[i] <= noise) & (step >= 0);
        int up = (upper[i] - to <= noise) & (step <= 0);
        to = up ? upper[i] : to;
        x[i] = down ? lower[i] : to;
        g[i] -= alpha * Hp[i];
    }
}

/* Adds to told, which begins as zeros. */
static inline __attribute__((always_inline)) void
split_block(in x, in g, in lower, in upper, double tau, out phi, out free, Py_ssize_t n,
            out told)
{
    double phi_square = 0, beta_square = 0, reduced = 0;
    for (Py_ssize_t i = 0; i < n; i++) {
        double down = x[i] - lower[i], up = x[i] - upper[i];
        double inside = (down > 0) & (up < 0) ? 1.0 : 0.0;
        double f = inside > 0 ? g[i] : 0.0;
        int leads = ((g[i] < 0) & (up < 0)) | ((g[i] > 0) & (down > 0));
        double b = leads ? g[i] - f : 0.0;
        double cut = f > tau * up ? f : tau * up;
        cut = cut < tau * down ? cut : tau * down;
        cut = inside > 0 ? cut : 0.0;
        free[i] = inside;
        phi[i] = f;
        phi_square += f * f;
        beta_square += b * b;
        reduced += cut * f;
    }
    told[0] += phi_square;
    told[1] += beta_square;
    told[2] += reduced;
}

/* x = x - αp and g = g - αHp; what is nearer to a bound than rounding is on it. */
TWICE static void move(double alpha, out x, out g, in p, in Hp, in lower, in upper,
                       Py_ssize_t n)
{
    move_block(alpha, x, g, p, Hp, lower, upper, n);
}

/* φ, free components (1, others 0); told = ‖φ‖², ‖β‖², φ̃ᵀφ with ᾱ = 1/τ. */
TWICE static void split(in x, in g, in lower, in upper, double tau, out phi, out free,
                        Py_ssize_t n, out told)
{
    told[0] = told[1] = told[2] = 0;
    split_block(x, g, lower, upper, tau, phi, free, n, told);
}

/* What `move` and `split` do, in one go through memory; told[3] = φᵀHp. */
TWICE static void advance(double alpha, out x, out g, in p, in Hp, in lower, in upper,
                          double tau, out phi, out free, Py_ssize_t n, out told)
{
    told[0] = told[1] = told[2] = told[3] = 0;
    for (Py_ssize_t i = 0; i < n; i += BLOCK) {
        Py_ssize_t size = n - i < BLOCK ? n - i : BLOCK;
        double phi_Hp = 0;
        move_block(alpha, x + i, g + i, p + i, Hp + i, lower + i, upper + i, size);
        split_block(x + i, g + i, lower + i, upper + i, tau, phi + i, free + i, size,
                    told);
        for (Py_ssize_t j = i; j < i + size; j++)
            phi_Hp += phi[j] * Hp[j];
        told[3] += phi_Hp;
    }
}

/* s = x + s - from, where x + s is in the box up to rounding, and on bounds that it
   reaches. */
TWICE static void within(in x, in from, in lower, in upper, out s, Py_ssize_t n)
{
    for (Py_ssize_t i = 0; i < n; i++) {
        double to = x[i] + s[i], noise = ROUNDING * (fabs(x[i]) + fabs(s[i]));
        int down = to - lower[i] <= noise, up = upper[i] - to <= noise;
        to = up ? upper[i] : to;
        s[i] = (down ? lower[i] : to) - from[i];
    }
}

/* p = z - γp. */
TWICE static void turn(in z, double gamma, out p, Py_ssize_t n)
{
    for (Py_ssize_t i = 0; i < n; i++)
        p[i] = z[i] - gamma * p[i];
}

/* S = S + s vvᵀ (k, k), k a multiple of four. */
TWICE static void add_gram(double s, in v, out S, Py_ssize_t k)
{
    for (Py_ssize_t i = 0; i < k; i++) {
        four at = EACH(s * v[i]);
        for (Py_ssize_t j = 0; j < k; j += 4)
            *(four *) (S + i * k + j) += at * FOUR(v + j);
    }
}

/* The components where held (1, others 0) is not that piece differs from zero: how many,
   and which; held changes there. */
TWICE static Py_ssize_t changed(in piece, out held, Py_ssize_t n, int *restrict where)
{
    Py_ssize_t count = 0;
    for (Py_ssize_t i = 0; i < n; i++) {
        double now = piece[i] != 0 ? 1.0 : 0.0;
        where[count] = (int) i;
        count += held[i] != now;
        held[i] = now;
    }
    return count;
}

/* S = RᵀR (k, k) with rows of `stride` numbers, a multiple of four: R in the upper
   triangle, 1/Rᵢᵢ in place of Rᵢᵢ; 0 where S is not positive definite. */
TWICE static int cholesky(double *S, Py_ssize_t k, Py_ssize_t stride)
{
    for (Py_ssize_t i = 0; i < k; i++) {
        double *r = S + i * stride;
        if (!(r[i] > 0))
            return 0;
        double inverse = 1 / sqrt(r[i]);
        r[i] = inverse;
        for (Py_ssize_t j = i + 1; j < k; j++)
            r[j] *= inverse;
        for (Py_ssize_t j = i + 1; j < k; j++) {
            four s = EACH(r[j]);
            for (Py_ssize_t l = j & ~(Py_ssize_t) 3; l < k; l += 4)
                *(four *) (S + j * stride + l) -= s * FOUR(r + l);
        }
    }
    return 1;
}

/* y = S⁻¹y with its `cholesky`. */
TWICE static void solve(const double *R, double *y, Py_ssize_t k, Py_ssize_t stride)
{
    for (Py_ssize_t i = 0; i < k; i++) {
        const double *r = R + i * stride;
        y[i] *= r[i];
        for (Py_ssize_t j = i + 1; j < k; j++)
            y[j] -= r[j] * y[i];
    }
    for (Py_ssize_t i = k - 1; i >= 0; i--) {
        const double *r = R + i * stride;
        for (Py_ssize_t j = i + 1; j < k; j++)
            y[i] -= r[j] * y[j];
        y[i] *= r[i];
    }
}

/* Minimise gᵀs + τ/2‖s‖² over the box; piece: -1 at the lower bound, 1 at the upper. */
TWICE static void tilted(in x, in g, double tau, in lower, in upper, out s, out piece,
                         Py_ssize_t n)
{
    for (Py_ssize_t i = 0; i < n; i++) {
        double target = x[i] - g[i] / tau;
        double low = target <= lower[i] ? 1.0 : 0.0;
        double high = target >= upper[i] ? 1.0 - low : 0.0;
        target = target >= upper[i] ? upper[i] : target;
        target = low > 0 ? lower[i] : target;
        piece[i] = high - low;
        s[i] = target - x[i];
    }
}
