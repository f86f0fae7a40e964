/* Loops over vectors for MPRGP.

   Each function is compiled twice, for processors with AVX2 and FMA and for all
   others; the loader selects the version. Conditions are written as conditional
   expressions, so that the compiler can process four components at the same time. */

#include <limits.h>
#include <math.h>
#include <string.h>

#if defined(__x86_64__) && defined(__gnu_linux__) && !defined(__clang__) && __GNUC__ >= 12
#define TWICE __attribute__((target_clones("arch=x86-64-v3", "default")))
#else
#define TWICE
#endif

#define INLINE static inline __attribute__((always_inline))
#define ROUNDING (4 * 2.220446049250313e-16) /* relative error of a few operations */

typedef const double *restrict in;
typedef double *restrict out;

/* Four components that are processed at the same time. Loops use this type
   explicitly, because the vectoriser of the compiler produces slower code for loops
   that accumulate several sums in one pass. */
typedef double __attribute__((vector_size(32), aligned(8), may_alias)) four;
#define FOUR(a) (*(const four *) (a))
#define EACH(s) ((four){(s), (s), (s), (s)})

INLINE double total(four t)
{
    return (t[0] + t[1]) + (t[2] + t[3]);
}

#define BLOCK 256 /* components that stay in the cache from one loop to the next */

/* A sparse symmetric matrix F (n, n). If `count` is zero, F is stored by rows,
   otherwise by its upper diagonals with offsets 0, o₁, o₂, …: column i of
   `diagonals` (count, n) contains F[i, i + o]. */
typedef struct {
    Py_ssize_t n, count;
    const int *indptr, *indices;
    const Py_ssize_t *offset;
    const double *data, *diagonals;
} sparse;

enum { MAX_DIAGONALS = 16 };

/* y = s (f₁w₁ + f₂w₂ + …), componentwise. */
INLINE void
sum_of_terms(const double *const *f, const double *const *w, Py_ssize_t terms, double s,
             out y, Py_ssize_t n)
{
    Py_ssize_t i = 0;
    for (; i + 16 <= n; i += 16) {
        four a = EACH(0), b = a, c = a, d = a;
        for (Py_ssize_t t = 0; t < terms; t++) {
            in g = f[t] + i, u = w[t] + i;
            a += FOUR(g) * FOUR(u);
            b += FOUR(g + 4) * FOUR(u + 4);
            c += FOUR(g + 8) * FOUR(u + 8);
            d += FOUR(g + 12) * FOUR(u + 12);
        }
        *(four *) (y + i) = EACH(s) * a;
        *(four *) (y + i + 4) = EACH(s) * b;
        *(four *) (y + i + 8) = EACH(s) * c;
        *(four *) (y + i + 12) = EACH(s) * d;
    }
    for (; i < n; i++) {
        double sum = 0;
        for (Py_ssize_t t = 0; t < terms; t++)
            sum += f[t][i] * w[t][i];
        y[i] = s * sum;
    }
}

/* y = s F v for the rows from `first` to `last` of a matrix F stored by diagonals; y
   begins at row `first`. */
INLINE void
rows_by_diagonals(const sparse *F, Py_ssize_t first, Py_ssize_t last, double s, in v,
                  out y)
{
    const double *f[2 * MAX_DIAGONALS], *w[2 * MAX_DIAGONALS];
    Py_ssize_t from[2 * MAX_DIAGONALS], to[2 * MAX_DIAGONALS];
    Py_ssize_t terms = 0, size = last - first, missing = 0;
    for (Py_ssize_t d = 1 - F->count; d < F->count; d++) {
        Py_ssize_t o = F->offset[d < 0 ? -d : d], shift = d < 0 ? -o : o;
        const double *whole = F->diagonals + (d < 0 ? -d : d) * F->n;
        Py_ssize_t least = shift < 0 ? o : 0, most = shift < 0 ? F->n : F->n - o;
        from[terms] = least > first ? least - first : 0;
        to[terms] = most < last ? most - first : size;
        if (from[terms] >= to[terms])
            continue;
        missing |= from[terms] | (size - to[terms]);
        f[terms] = whole + first + (shift < 0 ? shift : 0);
        w[terms++] = v + first + shift;
    }
    if (missing) { /* near the first or last row */
        memset(y, 0, size * sizeof(double));
        for (Py_ssize_t t = 0; t < terms; t++)
            for (Py_ssize_t j = from[t]; j < to[t]; j++)
                y[j] += s * f[t][j] * w[t][j];
        return;
    }
    switch (terms) { /* with a constant number of terms the inner loop unrolls */
    case 3: sum_of_terms(f, w, 3, s, y, size); break;
    case 5: sum_of_terms(f, w, 5, s, y, size); break;
    case 9: sum_of_terms(f, w, 9, s, y, size); break;
    default: sum_of_terms(f, w, terms, s, y, size);
    }
}

/* y = s F v for the rows from `first` to `last`; y begins at row `first`. */
INLINE void
some_rows(const sparse *F, Py_ssize_t first, Py_ssize_t last, double s, in v, out y)
{
    if (F->count) {
        rows_by_diagonals(F, first, last, s, v, y);
        return;
    }
    const int *restrict indptr = F->indptr, *restrict indices = F->indices;
    in data = F->data;
    for (Py_ssize_t i = first; i < last; i++) {
        double sum = 0;
        for (int k = indptr[i]; k < indptr[i + 1]; k++)
            sum += data[k] * v[indices[k]];
        y[i - first] = s * sum;
    }
}

/* y = s F v. */
TWICE static void sparse_product(const sparse *F, double s, in v, out y)
{
    for (Py_ssize_t i = 0; i < F->n; i += BLOCK)
        some_rows(F, i, i + BLOCK < F->n ? i + BLOCK : F->n, s, v, y + i);
}

/* p = φ − γp, where φ = g for free components and zero for others; return φᵀp. */
TWICE static double update_free_direction(in g, in free, double gamma, out p, Py_ssize_t n)
{
    double slope = 0;
    for (Py_ssize_t i = 0; i < n; i++) {
        double f = free[i] * g[i];
        p[i] = f - gamma * p[i];
        slope += f * p[i];
    }
    return slope;
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
            slot[o] = 1;
            offset[count++] = o;
        }
    for (Py_ssize_t c = 1; c < count; c++) /* in ascending order */
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

/* y = s F v for a symmetric F (n, n). The lower triangle of F is read, with four
   rows in each pass over v and y. */
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

/* b = s a. */
TWICE static void copy_scaled(double s, in a, out b, Py_ssize_t n)
{
    for (Py_ssize_t i = 0; i < n; i++)
        b[i] = s * a[i];
}

/* z = s z for free components, and zero for others; return zᵀv. */
TWICE static double scale_free(double s, in free, in v, out z, Py_ssize_t n)
{
    double along = 0;
    for (Py_ssize_t i = 0; i < n; i++) {
        z[i] *= s * free[i];
        along += z[i] * v[i];
    }
    return along;
}

/* Return 1 if a and b have the same components, else 0. */
TWICE static int same(in a, in b, Py_ssize_t n)
{
    for (Py_ssize_t i = 0; i < n; i += BLOCK) {
        Py_ssize_t last = i + BLOCK < n ? i + BLOCK : n, differ = 0;
        for (Py_ssize_t j = i; j < last; j++)
            differ |= a[j] != b[j];
        if (differ)
            return 0;
    }
    return 1;
}

/* c = Uv for `rows` rows U in one pass over v. If there are few rows, each row has
   two partial sums, because additions to a single sum would wait for each other. */
INLINE void some_rows_times(in U, in v, out c, Py_ssize_t rows, Py_ssize_t n)
{
    four t[8], s[8];
    Py_ssize_t j = 0;
    for (Py_ssize_t i = 0; i < rows; i++)
        t[i] = s[i] = EACH(0);
    if (rows < 8)
        for (; j + 8 <= n; j += 8)
            for (Py_ssize_t i = 0; i < rows; i++) {
                t[i] += FOUR(U + i * n + j) * FOUR(v + j);
                s[i] += FOUR(U + i * n + j + 4) * FOUR(v + j + 4);
            }
    for (; j + 4 <= n; j += 4)
        for (Py_ssize_t i = 0; i < rows; i++)
            t[i] += FOUR(U + i * n + j) * FOUR(v + j);
    for (Py_ssize_t i = 0; i < rows; i++) {
        c[i] = total(t[i] + s[i]);
        for (Py_ssize_t l = j; l < n; l++)
            c[i] += U[i * n + l] * v[l];
    }
}

/* c = U v for U (k, n) stored by rows. */
TWICE static void rows_times(in U, in v, out c, Py_ssize_t k, Py_ssize_t n)
{
    Py_ssize_t i = 0;
    for (; i + 8 <= k; i += 8)
        some_rows_times(U + i * n, v, c + i, 8, n);
    U += i * n, c += i;
    switch (k - i) { /* with a constant number of rows the inner loop unrolls */
    case 1: some_rows_times(U, v, c, 1, n); break;
    case 2: some_rows_times(U, v, c, 2, n); break;
    case 3: some_rows_times(U, v, c, 3, n); break;
    case 4: some_rows_times(U, v, c, 4, n); break;
    case 5: some_rows_times(U, v, c, 5, n); break;
    case 6: some_rows_times(U, v, c, 6, n); break;
    case 7: some_rows_times(U, v, c, 7, n); break;
    }
}

/* y = v + c₀u₀ + c₁u₁ + … for `rows` rows u of U, in one pass over v; v may be y. */
INLINE void
add_rows(in U, const double *c, const double *v, double *y, Py_ssize_t rows, Py_ssize_t n)
{
    Py_ssize_t j = 0;
    for (; j + 4 <= n; j += 4) {
        four sum = EACH(0);
        for (Py_ssize_t i = 0; i < rows; i++)
            sum += FOUR(U + i * n + j) * EACH(c[i]);
        *(four *) (y + j) = FOUR(v + j) + sum;
    }
    for (; j < n; j++) {
        double sum = 0;
        for (Py_ssize_t i = 0; i < rows; i++)
            sum += c[i] * U[i * n + j];
        y[j] = v[j] + sum;
    }
}

/* y = v + s Uᵀc for U (k, n) stored by rows, with one pass over v for up to eight
   rows; v may be y. The last rows are processed first, because they are in the L1
   cache after `rows_times`. */
TWICE static void combination(double s, in U, in c, const double *v, double *y,
                              Py_ssize_t k, Py_ssize_t n)
{
    double sc[8];
    if (!k && v != y)
        memcpy(y, v, n * sizeof(double));
    for (Py_ssize_t last = k, rows; last; last -= rows, v = y) {
        rows = last < 8 ? last : 8;
        in V = U + (last - rows) * n;
        for (Py_ssize_t j = 0; j < rows; j++)
            sc[j] = s * c[last - rows + j];
        switch (rows) { /* with a constant number of rows the inner loop unrolls */
        case 1: add_rows(V, sc, v, y, 1, n); break;
        case 2: add_rows(V, sc, v, y, 2, n); break;
        case 3: add_rows(V, sc, v, y, 3, n); break;
        case 4: add_rows(V, sc, v, y, 4, n); break;
        case 5: add_rows(V, sc, v, y, 5, n); break;
        case 6: add_rows(V, sc, v, y, 6, n); break;
        case 7: add_rows(V, sc, v, y, 7, n); break;
        default: add_rows(V, sc, v, y, 8, n);
        }
    }
}

/* y = y + s Uᵀc. */
static inline void
add_combination(double s, in U, in c, double *y, Py_ssize_t k, Py_ssize_t n)
{
    combination(s, U, c, y, y, k, n);
}

typedef long long __attribute__((may_alias)) ordered; /* nonnegative doubles have the
same order as these integers */
typedef long long __attribute__((vector_size(32))) mask;

#define CHOSEN(m, a, b) ((four) (((m) & (mask) (a)) | (~(m) & (mask) (b))))
#define ABSOLUTE(a) \
    ((four) ((mask) (a) & (mask){LLONG_MAX, LLONG_MAX, LLONG_MAX, LLONG_MAX}))

/* Return the α at which x - αp reaches the first bound within a block, or `least` if
   `least` is smaller. Unless result is NULL, add pᵀHp to result[3] and gᵀp to
   result[2].

   Most blocks reach no bound before α = `least`. The test of this condition needs no
   division, so divisions are necessary only in the few remaining blocks. */
INLINE double lengths_block(in x, in g, in p, in Hp, in lower, in upper, Py_ssize_t n,
                            double least, out result)
{
    four zero = EACH(0), curvature = zero, slope = zero, most = EACH(least);
    mask nearer = (mask) zero;
    Py_ssize_t whole = n & ~(Py_ssize_t) 3;
    for (Py_ssize_t j = 0; j < whole; j += 4) {
        four q = FOUR(p + j), to = FOUR(x + j);
        four room = to - FOUR(lower + j);
        if (upper) {
            room = CHOSEN(q > zero, room, FOUR(upper + j) - to);
            nearer |= room < most * ABSOLUTE(q);
        } else {
            nearer |= (room < most * q) & (q > zero);
        }
        if (result) {
            curvature += q * FOUR(Hp + j);
            slope += q * FOUR(g + j);
        }
    }
    if (result) {
        result[3] += total(curvature);
        result[2] += total(slope);
        for (Py_ssize_t j = whole; j < n; j++) {
            result[3] += p[j] * Hp[j];
            result[2] += g[j] * p[j];
        }
    }
    Py_ssize_t from = nearer[0] | nearer[1] | nearer[2] | nearer[3] ? 0 : whole;
    double room[BLOCK];
    ordered first = *(ordered *) &least;
    for (Py_ssize_t j = from; j < n; j++) {
        double bound = p[j] > 0 ? lower[j] : upper ? upper[j] : INFINITY;
        double to = (x[j] - bound) / p[j];
        to = to > 0 ? to : 0;
        room[j] = p[j] != 0 ? to : INFINITY;
    }
    for (Py_ssize_t j = from; j < n; j++) {
        ordered to = *(ordered *) (room + j);
        first = to < first ? to : first;
    }
    memcpy(&least, &first, sizeof least);
    return least;
}

INLINE double first_of_blocks(in x, in p, in lower, in upper, double least, Py_ssize_t n)
{
    for (Py_ssize_t i = 0; i < n; i += BLOCK) {
        Py_ssize_t size = n - i < BLOCK ? n - i : BLOCK;
        if (upper)
            least = lengths_block(x + i, NULL, p + i, NULL, lower + i, upper + i, size,
                                  least, NULL);
        else
            least = lengths_block(x + i, NULL, p + i, NULL, lower + i, NULL, size, least,
                                  NULL);
    }
    return least;
}

/* Return the α at which x - αp reaches its first bound, or inf if it reaches no bound.

   upper : NULL if no component has an upper bound */
TWICE static double first_bound(in x, in p, in lower, in upper, Py_ssize_t n)
{
    return first_of_blocks(x, p, lower, upper, INFINITY, n);
}

/* result = α_cg, α_f, gᵀp, pᵀHp of x - αp; inf instead of α_f if α_f ≥ α_cg.

   upper : NULL if no component has an upper bound */
TWICE static void lengths(in x, in g, in p, in Hp, in lower, in upper, Py_ssize_t n,
                          out result)
{
    double slope = 0, curvature = 0, feasible;
    for (Py_ssize_t i = 0; i < n; i++) {
        slope += g[i] * p[i];
        curvature += p[i] * Hp[i];
    }
    result[0] = curvature > 0 ? slope / curvature : INFINITY;
    feasible = first_of_blocks(x, p, lower, upper, result[0], n);
    result[1] = feasible < result[0] ? feasible : INFINITY;
    result[2] = slope;
    result[3] = curvature;
}

/* Return x - step, or a bound if x - step is within rounding of this bound. */
INLINE double moved(double x, double step, double lower, double upper)
{
    double to = x - step, noise = ROUNDING * (fabs(x) + fabs(step));
    int down = (to - lower <= noise) & (step >= 0);
    int up = (upper - to <= noise) & (step <= 0);
    to = up ? upper : to;
    return down ? lower : to;
}

INLINE void
move_block(double alpha, out x, out g, in p, in Hp, in lower, in upper, Py_ssize_t n)
{
    for (Py_ssize_t i = 0; i < n; i++) {
        x[i] = moved(x[i], alpha * p[i], lower[i], upper[i]);
        g[i] -= alpha * Hp[i];
    }
}

/* `split` for a block; add the sums to result. */
INLINE void
split_block(in x, in g, in lower, in upper, double tau, out phi, out free, Py_ssize_t n,
            out result)
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
    result[0] += phi_square;
    result[1] += beta_square;
    result[2] += reduced;
}

/* x = x - αp and g = g - αHp; components within rounding of a bound are set to this
   bound. x₀, g₀ and `free` (1 on the face, else 0) receive the previous state.
   box_lower and box_upper receive the box for the next step, in which components at
   bounds are fixed unless `release` is true. z and z_g receive x - βp and the
   gradient at this point. */
TWICE static void leave_box(double alpha, double beta, int release, out x, out g, in p, in Hp,
                        in lower, in upper, out x0, out g0, out free, out box_lower,
                        out box_upper, out z, out z_g, Py_ssize_t n)
{
    for (Py_ssize_t i = 0; i < n; i++) {
        double low = lower[i], high = upper[i], was = x[i], push = g[i];
        double to = moved(was, alpha * p[i], low, high), now = push - alpha * Hp[i];
        int is_active = ((to <= low) | (to >= high)) & !release;
        x0[i] = was;
        g0[i] = push;
        free[i] = (was > low) & (was < high) ? 1.0 : 0.0;
        x[i] = to;
        g[i] = now;
        box_lower[i] = is_active ? to : low;
        box_upper[i] = is_active ? to : high;
        z[i] = to - beta * p[i];
        z_g[i] = now - beta * Hp[i];
    }
}

/* Compute φ and `free` (1 for free components, else 0); result = ‖φ‖², ‖β‖², φ̃ᵀφ
   with ᾱ = 1/τ. */
TWICE static void split(in x, in g, in lower, in upper, double tau, out phi, out free,
                        Py_ssize_t n, out result)
{
    result[0] = result[1] = result[2] = 0;
    split_block(x, g, lower, upper, tau, phi, free, n, result);
}

INLINE void advance_by(double alpha, out x, out g, in p, in Hp, in lower, in upper,
                       double tau, out phi, out free, Py_ssize_t n, out result)
{
    four zero = EACH(0), phi_square = zero, beta_square = zero, reduced = zero;
    four phi_Hp = zero, length = EACH(alpha), rounding = EACH(ROUNDING), t = EACH(tau);
    Py_ssize_t whole = n & ~(Py_ssize_t) 3;
    for (Py_ssize_t i = 0; i < whole; i += 4) {
        four at = FOUR(x + i), low = FOUR(lower + i), step = length * FOUR(p + i);
        four noise = rounding * (ABSOLUTE(at) + ABSOLUTE(step));
        four to = at - step, push = FOUR(g + i) - length * FOUR(Hp + i);
        mask at_lower = (to - low <= noise) & (step >= zero), inside, leads;
        if (upper)
            to = CHOSEN((FOUR(upper + i) - to <= noise) & (step <= zero),
                        FOUR(upper + i), to);
        to = CHOSEN(at_lower, low, to);
        inside = to > low;
        leads = (push < zero) | inside;
        if (upper) {
            mask below = to < FOUR(upper + i);
            leads = ((push < zero) & below) | ((push > zero) & inside);
            inside &= below;
        }
        four f = (four) ((mask) push & inside);
        four b = (four) ((mask) push & leads & ~inside);
        four cut = f, most = t * (to - low);
        if (upper) {
            four least = t * (to - FOUR(upper + i));
            cut = CHOSEN(f > least, f, least);
        }
        cut = CHOSEN(cut < most, cut, most);
        *(four *) (x + i) = to;
        *(four *) (g + i) = push;
        if (phi) {
            *(four *) (phi + i) = f;
            *(four *) (free + i) = (four) ((mask) EACH(1) & inside);
        }
        phi_square += f * f;
        beta_square += b * b;
        reduced += cut * f;
        phi_Hp += f * FOUR(Hp + i);
    }
    result[0] = total(phi_square);
    result[1] = total(beta_square);
    result[2] = total(reduced);
    result[3] = total(phi_Hp);
    for (Py_ssize_t i = whole; i < n; i++) {
        double above = upper ? upper[i] : INFINITY, f, inside;
        move_block(alpha, x + i, g + i, p + i, Hp + i, lower + i, &above, 1);
        split_block(x + i, g + i, lower + i, &above, tau, &f, &inside, 1, result);
        result[3] += f * Hp[i];
        if (phi)
            phi[i] = f, free[i] = inside;
    }
}

/* x = x - αp and g = g - αHp, with components within rounding of a bound set to this
   bound, then `split`, in one pass over memory; result[3] = φᵀHp.

   upper : NULL if no component has an upper bound
   phi, free : NULL if not needed */
TWICE static void advance(double alpha, out x, out g, in p, in Hp, in lower, in upper,
                          double tau, out phi, out free, Py_ssize_t n, out result)
{
    if (upper && phi)
        advance_by(alpha, x, g, p, Hp, lower, upper, tau, phi, free, n, result);
    else if (phi)
        advance_by(alpha, x, g, p, Hp, lower, NULL, tau, phi, free, n, result);
    else if (upper)
        advance_by(alpha, x, g, p, Hp, lower, upper, tau, NULL, NULL, n, result);
    else
        advance_by(alpha, x, g, p, Hp, lower, NULL, tau, NULL, NULL, n, result);
}

INLINE double within_block(in x, in from, in g, in lower, in upper, int release, out s,
                           Py_ssize_t n)
{
    double slope = 0;
    for (Py_ssize_t i = 0; i < n; i++) {
        double to = x[i] + s[i], noise = ROUNDING * (fabs(x[i]) + fabs(s[i]));
        int down = to - lower[i] <= noise, up = upper[i] - to <= noise;
        int is_active = (lower[i] == upper[i]) & !release;
        to = up ? upper[i] : to;
        to = (down ? lower[i] : to) - from[i];
        s[i] = is_active ? 0.0 : to;
        slope += g[i] * s[i];
    }
    return slope;
}

/* s = x + s - from, with x + s set to a bound within rounding of it. Unless
   `release` is true, s is zero for components that the box fixes. Return gᵀs. */
TWICE static double within(in x, in from, in g, in lower, in upper, int release, out s,
                           Py_ssize_t n)
{
    return within_block(x, from, g, lower, upper, release, s, n);
}

/* z = r with r = x - s - z; result = ‖r‖², rᵀHr with Hr = g - Hs - z_g. */
TWICE static void rest_of_step(in x, in g, in s, in Hs, in z_g, out z, Py_ssize_t n,
                               out result)
{
    double square = 0, curvature = 0;
    for (Py_ssize_t i = 0; i < n; i++) {
        double r = x[i] - s[i] - z[i];
        square += r * r;
        curvature += r * (g[i] - Hs[i] - z_g[i]);
        z[i] = r;
    }
    result[0] = square;
    result[1] = curvature;
}

/* p = z - γp; return zᵀp. */
TWICE static double update_direction(in z, double gamma, out p, Py_ssize_t n)
{
    double slope = 0;
    for (Py_ssize_t i = 0; i < n; i++) {
        p[i] = z[i] - gamma * p[i];
        slope += z[i] * p[i];
    }
    return slope;
}

/* x = x - αp and g = g - αHp on a face without bounds; result = ‖φ‖², φᵀHp. */
TWICE static void advance_freely(double alpha, out x, out g, in p, in Hp, in free,
                                 Py_ssize_t n, out result)
{
    double phi_square = 0, phi_Hp = 0;
    for (Py_ssize_t i = 0; i < n; i++) {
        double f;
        x[i] -= alpha * p[i];
        g[i] -= alpha * Hp[i];
        f = free[i] * g[i];
        phi_square += f * f;
        phi_Hp += f * Hp[i];
    }
    result[0] = phi_square;
    result[1] = phi_Hp;
}

/* columns = Uᵀ, stored with `stride` numbers per row; entries from k on are
   unchanged. */
TWICE static void transposed(in U, out columns, Py_ssize_t k, Py_ssize_t n,
                             Py_ssize_t stride)
{
    for (Py_ssize_t i = 0; i < n; i++)
        for (Py_ssize_t j = 0; j < k; j++)
            columns[i * stride + j] = U[j * n + i];
}

/* S = S + Σ sᵢ vᵢvᵢᵀ over four rows vᵢ of V (n, k), where k is a multiple of four.
   Only the upper triangle of S (k, k) is valid. */
TWICE static void add_gram(in s, in V, const int *restrict row, out S, Py_ssize_t k)
{
    in v0 = V + row[0] * k, v1 = V + row[1] * k, v2 = V + row[2] * k;
    in v3 = V + row[3] * k;
    for (Py_ssize_t i = 0; i < k; i += 2) { /* two rows of S use the same vectors */
        four a0 = EACH(s[0] * v0[i]), a1 = EACH(s[1] * v1[i]), a2 = EACH(s[2] * v2[i]);
        four a3 = EACH(s[3] * v3[i]), b0 = EACH(s[0] * v0[i + 1]);
        four b1 = EACH(s[1] * v1[i + 1]), b2 = EACH(s[2] * v2[i + 1]);
        four b3 = EACH(s[3] * v3[i + 1]);
        for (Py_ssize_t j = i & ~(Py_ssize_t) 3; j < k; j += 4) {
            four w0 = FOUR(v0 + j), w1 = FOUR(v1 + j), w2 = FOUR(v2 + j), w3 = FOUR(v3 + j);
            *(four *) (S + i * k + j) += a0 * w0 + a1 * w1 + a2 * w2 + a3 * w3;
            *(four *) (S + (i + 1) * k + j) += b0 * w0 + b1 * w1 + b2 * w2 + b3 * w3;
        }
    }
}

/* Write to `where` the components for which is_active (1 or 0) differs from piece ≠
   0, and update is_active; return the number of these components. */
TWICE static Py_ssize_t changed(in piece, out is_active, Py_ssize_t n, int *restrict where)
{
    Py_ssize_t count = 0;
    four zero = EACH(0);
    for (Py_ssize_t i = 0; i < n; i += 8) {
        if (i + 8 <= n) { /* few blocks contain a difference */
            mask other = ((FOUR(piece + i) != zero) ^ (FOUR(is_active + i) != zero))
                         | ((FOUR(piece + i + 4) != zero) ^ (FOUR(is_active + i + 4) != zero));
            if (!(other[0] | other[1] | other[2] | other[3]))
                continue;
        }
        for (Py_ssize_t j = i; j < n && j < i + 8; j++) {
            double now = piece[j] != 0 ? 1.0 : 0.0;
            where[count] = (int) j;
            count += is_active[j] != now;
            is_active[j] = now;
        }
    }
    return count;
}

/* S = τI + W¹ᐟ²GW¹ᐟ² (k, k), upper triangle, in arrays (stride, stride), where
   `stride` is a multiple of four. From column k on, `root` and G contain zeros. */
TWICE static void scaled(in root, in G, double tau, out S, Py_ssize_t k,
                         Py_ssize_t stride)
{
    for (Py_ssize_t i = 0; i < k; i++) {
        for (Py_ssize_t j = i & ~(Py_ssize_t) 3; j < stride; j += 4)
            *(four *) (S + i * stride + j)
                = EACH(root[i]) * FOUR(root + j) * FOUR(G + i * stride + j);
        S[i * stride + i] += tau;
    }
}

/* S = RᵀD⁻¹R (k, k) with the diagonal D of R, by Gaussian elimination in an array (stride,
   stride), with `stride` a multiple of four and zeros from column k on. R replaces S;
   `inverse` receives 1/Dᵢᵢ, and zeros beyond k. Returns 0 if S is not positive
   definite. */
TWICE static int eliminated(double *S, double *inverse, Py_ssize_t k, Py_ssize_t stride)
{
    for (Py_ssize_t i = 0; i < k; i++) {
        double *r = S + i * stride;
        if (!(r[i] > 0))
            return 0;
        inverse[i] = 1 / r[i];
        for (Py_ssize_t j = i & ~(Py_ssize_t) 3; j < i; j++)
            r[j] = 0; /* this entry is not part of R and would grow from face to face */
        for (Py_ssize_t j = i + 1; j < k; j++) {
            four s = EACH(r[j] * inverse[i]);
            for (Py_ssize_t l = j & ~(Py_ssize_t) 3; l < stride; l += 4)
                *(four *) (S + j * stride + l) -= s * FOUR(r + l);
        }
    }
    for (Py_ssize_t i = k; i < stride; i++) {
        memset(S + i * stride, 0, stride * sizeof(double));
        inverse[i] = 0;
    }
    return 1;
}

/* y = S⁻¹y with the factors of S from `eliminated`, four components at the same
   time. y has `stride` components; components from k on become zero. */
TWICE static void solve(const double *R, const double *inverse, double *y,
                        Py_ssize_t stride)
{
    for (Py_ssize_t i = 0; i < stride; i += 4) { /* Rᵀa = y */
        const double *r0 = R + i * stride, *r1 = r0 + stride, *r2 = r1 + stride;
        const double *r3 = r2 + stride, *d = inverse + i;
        double a0 = y[i] * d[0];
        double a1 = (y[i + 1] - r0[i + 1] * a0) * d[1];
        double a2 = (y[i + 2] - r0[i + 2] * a0 - r1[i + 2] * a1) * d[2];
        double a3 = (y[i + 3] - r0[i + 3] * a0 - r1[i + 3] * a1 - r2[i + 3] * a2) * d[3];
        for (Py_ssize_t j = i + 4; j < stride; j += 4)
            *(four *) (y + j) -= FOUR(r0 + j) * EACH(a0) + FOUR(r1 + j) * EACH(a1)
                                 + FOUR(r2 + j) * EACH(a2) + FOUR(r3 + j) * EACH(a3);
        *(four *) (y + i) = (four){a0, a1, a2, a3};
    }
    for (Py_ssize_t i = stride - 4; i >= 0; i -= 4) { /* D⁻¹Ry = a */
        const double *r0 = R + i * stride, *r1 = r0 + stride, *r2 = r1 + stride;
        const double *r3 = r2 + stride, *d = inverse + i;
        four t0 = EACH(0), t1 = t0, t2 = t0, t3 = t0;
        for (Py_ssize_t j = i + 4; j < stride; j += 4) {
            t0 += FOUR(r0 + j) * FOUR(y + j);
            t1 += FOUR(r1 + j) * FOUR(y + j);
            t2 += FOUR(r2 + j) * FOUR(y + j);
            t3 += FOUR(r3 + j) * FOUR(y + j);
        }
        double a3 = y[i + 3] - total(t3) * d[3];
        double a2 = y[i + 2] - (total(t2) + r2[i + 3] * a3) * d[2];
        double a1 = y[i + 1] - (total(t1) + r1[i + 2] * a2 + r1[i + 3] * a3) * d[1];
        double a0 = total(t0) + r0[i + 1] * a1 + r0[i + 2] * a2 + r0[i + 3] * a3;
        *(four *) (y + i) = (four){y[i] - a0 * d[0], a1, a2, a3};
    }
}

INLINE void model_minimiser_block(in x, in g, double tau, in lower, in upper, out s, out piece,
                         Py_ssize_t n)
{
    double length = 1 / tau;
    for (Py_ssize_t i = 0; i < n; i++) {
        double target = x[i] - length * g[i];
        double low = target <= lower[i] ? 1.0 : 0.0;
        double high = target >= upper[i] ? 1.0 - low : 0.0;
        target = target >= upper[i] ? upper[i] : target;
        target = low > 0 ? lower[i] : target;
        if (piece)
            piece[i] = high - low;
        s[i] = target - x[i];
    }
}

/* s = argmin gᵀs + τ/2‖s‖² over the box. piece receives -1 for components at the
   lower bound, 1 at the upper bound, else 0; NULL if not needed. */
TWICE static void model_minimiser(in x, in g, double tau, in lower, in upper, out s, out piece,
                         Py_ssize_t n)
{
    if (piece)
        model_minimiser_block(x, g, tau, lower, upper, s, piece, n);
    else
        model_minimiser_block(x, g, tau, lower, upper, s, NULL, n);
}

/* `model_minimiser` from x, then `within`, in one pass over memory. Return gᵀs with
   the gradient g at `from`. */
TWICE static double model_minimiser_within(in x, in x_g, double tau, in from, in g, in lower,
                                  in upper, out s, Py_ssize_t n)
{
    double slope = 0;
    for (Py_ssize_t i = 0; i < n; i += BLOCK) {
        Py_ssize_t size = n - i < BLOCK ? n - i : BLOCK;
        model_minimiser_block(x + i, x_g + i, tau, lower + i, upper + i, s + i, NULL, size);
        slope += within_block(x + i, from + i, g + i, lower + i, upper + i, 0, s + i,
                              size);
    }
    return slope;
}

/* y = P(x - φ/τ) with the free gradient φ at x. */
TWICE static void projected(in x, in g, double tau, in lower, in upper, out y,
                            Py_ssize_t n)
{
    for (Py_ssize_t i = 0; i < n; i++) {
        int inside = (x[i] > lower[i]) & (x[i] < upper[i]);
        double target = x[i] - (inside ? g[i] : 0) / tau;
        target = target < lower[i] ? lower[i] : target;
        y[i] = target > upper[i] ? upper[i] : target;
    }
}

/* s = -s; return 1 if s ≠ 0, else 0. */
TWICE static int negate(out s, Py_ssize_t n)
{
    Py_ssize_t any = 0;
    for (Py_ssize_t i = 0; i < n; i++) {
        any |= s[i] != 0;
        s[i] = -s[i];
    }
    return any != 0;
}

#define LARGER(a, b) ((a) > (b) ? (a) : (b))
#define SMALLER(a, b) ((a) < (b) ? (a) : (b))

/* x = shift + ν, clipped to [lb, ub]. If a component of ν is at its bound, x is set
   to lb or ub, because the sum may differ from the bound in the last bit. `free` is
   1 for components off the bounds, else 0. */
TWICE static void restored(in nu, in shift, in lower, in upper, in lb, in ub, out x,
                           out free, Py_ssize_t n)
{
    for (Py_ssize_t i = 0; i < n; i++) {
        int down = nu[i] <= lower[i], up = nu[i] >= upper[i];
        double to = up ? ub[i] : shift[i] + nu[i];
        to = down ? lb[i] : to;
        to = LARGER(to, lb[i]);
        x[i] = SMALLER(to, ub[i]);
        free[i] = down | up ? 0.0 : 1.0;
    }
}

/* z = multipliers of the active bounds of ν, from the gradient g without these. */
TWICE static void bound_multipliers(in nu, in lower, in upper, in g, out z, Py_ssize_t n)
{
    for (Py_ssize_t i = 0; i < n; i++) {
        double push = LARGER(g[i], 0), pull = SMALLER(g[i], 0);
        z[i] = (nu[i] <= lower[i] ? -push : 0) - (nu[i] >= upper[i] ? pull : 0);
    }
}

/* t = free a. */
TWICE static void masked(in free, in a, out t, Py_ssize_t n)
{
    for (Py_ssize_t i = 0; i < n; i++)
        t[i] = free[i] * a[i];
}

/* Add terms of the stopping test (`solvers/common/stopping.py`) at a point with the
   residual r, where w = D⁻¹ᐟ²: xᵀPx, qᵀx and Σ(xᵢ/wᵢ)² to `sums`; `most` becomes at least
   as large as the components of w|r|, w max(|Px|, |q|) and |x|/w. */
TWICE static void
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
