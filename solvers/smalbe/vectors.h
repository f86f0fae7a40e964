/* The loops over vectors of MPRGP (`solvers/smalbe/kernels.py` has them in NumPy).

   Compiled twice, for processors with AVX2 and FMA and for all others; which one runs is
   decided when the module is loaded. Selections are written as expressions, so that the
   compiler can do four components at once. */

#include <math.h>
#include <string.h>

#if defined(__x86_64__) && defined(__gnu_linux__) && !defined(__clang__)
#define TWICE __attribute__((target_clones("arch=haswell", "default")))
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

/* p = z - γp. */
TWICE static void turn(in z, double gamma, out p, Py_ssize_t n)
{
    for (Py_ssize_t i = 0; i < n; i++)
        p[i] = z[i] - gamma * p[i];
}

/* S = S + s vvᵀ (k, k). */
TWICE static void add_gram(double s, in v, out S, Py_ssize_t k)
{
    for (Py_ssize_t i = 0; i < k; i++)
        for (Py_ssize_t j = 0; j < k; j++)
            S[i * k + j] += s * v[i] * v[j];
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
