/* Loops over the discs ‖x_I + c_I‖ ≤ r of the feasible set of MPRGP; vectors.h contains
   the loops over bounds.

   A disc is active if the distance of x to its boundary is at most `slack`. Active
   discs are not part of the face: the free gradient φ is zero for their variables. The
   chopped gradient β on an active disc is the gradient g, but if nᵀg < 0 with the
   outward normal n, the normal component of g is subtracted. On a disc of radius zero,
   φ = β = 0.

   Each loop is compiled for discs with d = 2, with d = 3 and with any number d of
   variables, because with a constant d the variables of a disc stay in registers.
   Square roots are computed only on the boundary. */

typedef struct {
    Py_ssize_t count, ranges;
    int dim; /* number of variables of each disc; 0 if not constant */
    const int *start; /* (count + 1,) first entry of each disc in `index` */
    const int *index; /* variables of the discs */
    const double *radius;
    const double *slack; /* rounding error of ‖x_I + c_I‖ */
    const double *centre; /* (n,) c, NULL if c = 0; the centre is −c */
    const Py_ssize_t *range; /* (2 ranges,) intervals [a, b) of variables without a disc */
} discs;

#define FIRST(D, i, d) ((d) ? (d) * (i) : (D)->start[i])
#define LAST(D, i, d) ((d) ? (d) * ((i) + 1) : (D)->start[(i) + 1])
#define FOR_VARIABLES(D, i, d, j)                                                       \
    for (Py_ssize_t k_ = FIRST(D, i, d), to_ = LAST(D, i, d), j; k_ < to_               \
         && ((j = (D)->index[k_]), 1); k_++)
#define WITH_DIMENSION(D, loop, ...)                                                    \
    ((D)->dim == 2 ? loop(D, 2, __VA_ARGS__)                                            \
     : (D)->dim == 3 ? loop(D, 3, __VA_ARGS__) : loop(D, 0, __VA_ARGS__))

INLINE double about_centre(const discs *D, const double *x, Py_ssize_t j)
{
    return D->centre ? x[j] + D->centre[j] : x[j];
}

INLINE double square_of_disc(const discs *D, int d, Py_ssize_t i, const double *x)
{
    double square = 0;
    FOR_VARIABLES(D, i, d, j) {
        double u = about_centre(D, x, j);
        square += u * u;
    }
    return square;
}

INLINE int is_inside(const discs *D, Py_ssize_t i, double square)
{
    double r = D->radius[i] - D->slack[i];
    return r > 0 && square < r * r;
}

/* Scale the variables of a disc in x by `factor` about the centre of the disc. */
INLINE void scale_disc(const discs *D, int d, Py_ssize_t i, double factor, double *x)
{
    FOR_VARIABLES(D, i, d, j) {
        double c = D->centre ? D->centre[j] : 0;
        x[j] = factor * (x[j] + c) - c;
    }
}

/* Return the factor about the centre that projects x − g·length onto the disc. */
INLINE double projected_factor(const discs *D, int d, Py_ssize_t i, const double *x,
                               const double *g, double length)
{
    double square = 0, r = D->radius[i];
    FOR_VARIABLES(D, i, d, j) {
        double u = about_centre(D, x, j) - length * g[j];
        square += u * u;
    }
    return square > r * r ? r / sqrt(square) : 1;
}

/* Return nᵀg/‖x + c‖ for x on the boundary if nᵀg < 0, else 0; `square` = ‖x + c‖². */
INLINE double held_share(const discs *D, int d, Py_ssize_t i, const double *x,
                         const double *g, double square)
{
    double push = 0;
    FOR_VARIABLES(D, i, d, j)
        push += about_centre(D, x, j) * g[j];
    return push < 0 ? push / square : 0;
}

/* Write φ and `free` of a disc, if not NULL, and add ‖φ‖², ‖β‖² and φ̃ᵀφ to result, and
   φᵀHp to result[3] unless Hp is NULL. */
INLINE void face_of_disc(const discs *D, int d, Py_ssize_t i, const double *x,
                         const double *g, const double *Hp, double tau, double square,
                         double *phi, double *free, double *result)
{
    if (is_inside(D, i, square)) {
        double factor = projected_factor(D, d, i, x, g, 1 / tau);
        FOR_VARIABLES(D, i, d, j) {
            double u = about_centre(D, x, j);
            double cut = factor < 1 ? tau * u - factor * (tau * u - g[j]) : g[j];
            result[0] += g[j] * g[j];
            result[2] += cut * g[j];
            if (Hp)
                result[3] += g[j] * Hp[j];
            if (phi)
                phi[j] = g[j], free[j] = 1;
        }
        return;
    }
    int is_point = D->radius[i] == 0; /* ‖x + c‖ is a rounding error */
    double inward = is_point ? 0 : held_share(D, d, i, x, g, square);
    FOR_VARIABLES(D, i, d, j) {
        double b = is_point ? 0 : g[j] - inward * about_centre(D, x, j);
        result[1] += b * b; /* a difference of squares would suffer from cancellation */
        if (phi)
            phi[j] = 0, free[j] = 0;
    }
}

INLINE void project_each(const discs *D, int d, double *y)
{
    for (Py_ssize_t i = 0; i < D->count; i++) {
        double square = square_of_disc(D, d, i, y), r = D->radius[i];
        if (square > r * r)
            scale_disc(D, d, i, r / sqrt(square), y);
    }
}

/* y = Π(y) with the projection Π onto the discs. */
static void project_discs(const discs *D, double *y)
{
    WITH_DIMENSION(D, project_each, y);
}

/* Return the α at which x − αp leaves the disc, or `least` if that is smaller;
   square = ‖x + c‖². */
INLINE double first_of_disc(const discs *D, int d, Py_ssize_t i, const double *x,
                            const double *p, double square, double least)
{
    double a = 0, b = 0, c = square, r = D->radius[i];
    FOR_VARIABLES(D, i, d, j) {
        a += p[j] * p[j];
        b += about_centre(D, x, j) * p[j];
    }
    /* a α² − 2bα + c − r² ≤ 0 in the disc: convex, and true at α = 0 */
    if (a == 0 || (least < INFINITY && (a * least - 2 * b) * least + c < r * r))
        return least;
    c = (sqrt(c) - r) * (sqrt(c) + r); /* without cancellation */
    c = c < 0 ? c : 0;
    double root = sqrt(b * b - a * c);
    double to = b >= 0 ? (b + root) / a : -c / (root - b);
    return to < least ? to : least;
}

INLINE double first_of_each(const discs *D, int d, const double *x, const double *p,
                            double least)
{
    for (Py_ssize_t i = 0; i < D->count; i++)
        least = first_of_disc(D, d, i, x, p, square_of_disc(D, d, i, x), least);
    return least;
}

/* Return the smallest α at which x − αp leaves a disc, at most `least`. */
static double first_disc(const discs *D, const double *x, const double *p, double least)
{
    return WITH_DIMENSION(D, first_of_each, x, p, least);
}

INLINE void split_each(const discs *D, int d, const double *x, const double *g,
                       double tau, double *phi, double *free, double *result)
{
    double sums[4] = {0};
    for (Py_ssize_t i = 0; i < D->count; i++)
        face_of_disc(D, d, i, x, g, NULL, tau, square_of_disc(D, d, i, x), phi, free,
                     sums);
    for (int k = 0; k < 3; k++)
        result[k] += sums[k];
}

/* Write φ and `free` on discs; add ‖φ‖², ‖β‖² and φ̃ᵀφ to result. */
static void split_discs(const discs *D, const double *x, const double *g, double tau,
                        double *phi, double *free, double *result)
{
    WITH_DIMENSION(D, split_each, x, g, tau, phi, free, result);
}

INLINE void advance_each(const discs *D, int d, double alpha, double *x, double *g,
                         const double *p, const double *Hp, double tau, double *phi,
                         double *free, double *result)
{
    double sums[4] = {0};
    for (Py_ssize_t i = 0; i < D->count; i++) {
        double r = D->radius[i], near = r - 4 * D->slack[i], square = 0;
        FOR_VARIABLES(D, i, d, j) {
            x[j] -= alpha * p[j];
            g[j] -= alpha * Hp[j];
        }
        square = square_of_disc(D, d, i, x);
        if ((near < 0 || square > near * near) && square > 0) {
            scale_disc(D, d, i, r / sqrt(square), x);
            square = r * r;
        }
        face_of_disc(D, d, i, x, g, Hp, tau, square, phi, free, sums);
    }
    for (int k = 0; k < 4; k++)
        result[k] += sums[k];
}

/* On discs, compute x = x − αp, g = g − αHp and the sums of `advance`; x is moved to
   the boundary if it is within rounding of the boundary.

   phi, free : NULL if not needed */
static void advance_discs(const discs *D, double alpha, double *x, double *g,
                          const double *p, const double *Hp, double tau, double *phi,
                          double *free, double *result)
{
    if (phi)
        WITH_DIMENSION(D, advance_each, alpha, x, g, p, Hp, tau, phi, free, result);
    else
        WITH_DIMENSION(D, advance_each, alpha, x, g, p, Hp, tau, NULL, NULL, result);
}

/* g = φ + β on discs. */
static void project_gradient_on_discs(const discs *D, const double *x, double *g)
{
    for (Py_ssize_t i = 0; i < D->count; i++) {
        double square = square_of_disc(D, 0, i, x);
        if (is_inside(D, i, square))
            continue;
        int is_point = D->radius[i] == 0;
        double inward = is_point ? 0 : held_share(D, 0, i, x, g, square);
        FOR_VARIABLES(D, i, 0, j)
            g[j] = is_point ? 0 : g[j] - inward * about_centre(D, x, j);
    }
}

/* beta = β on discs. */
static void chop_discs(const discs *D, const double *x, const double *g, double *beta)
{
    for (Py_ssize_t i = 0; i < D->count; i++) {
        double square = square_of_disc(D, 0, i, x);
        int is_chopped = !is_inside(D, i, square) && D->radius[i] > 0;
        double inward = is_chopped ? held_share(D, 0, i, x, g, square) : 0;
        FOR_VARIABLES(D, i, 0, j)
            beta[j] = is_chopped ? g[j] - inward * about_centre(D, x, j) : 0;
    }
}

INLINE void step_on_each(const discs *D, int d, const double *x, const double *g,
                         double length, int free_only, double *s, double *result)
{
    double slope = 0, square = 0;
    for (Py_ssize_t i = 0; i < D->count; i++) {
        double factor = projected_factor(D, d, i, x, g, length);
        int moves = !free_only || is_inside(D, i, square_of_disc(D, d, i, x));
        FOR_VARIABLES(D, i, d, j) {
            double u = about_centre(D, x, j), v = length * g[j];
            double t = factor < 1 ? u - factor * (u - v) : v;
            s[j] = moves ? t : 0;
            slope += g[j] * s[j];
            square += s[j] * s[j];
        }
    }
    result[0] += slope;
    result[1] += square;
}

/* s = x − Π(x − g·length) on discs, zero on active discs if `free_only`; add gᵀs and
   ‖s‖² to result. */
static void step_on_discs(const discs *D, const double *x, const double *g,
                          double length, int free_only, double *s, double *result)
{
    if (free_only)
        WITH_DIMENSION(D, step_on_each, x, g, length, 1, s, result);
    else
        WITH_DIMENSION(D, step_on_each, x, g, length, 0, s, result);
}

INLINE int mark_each(const discs *D, int d, const double *x, double *free)
{
    int changed = 0;
    for (Py_ssize_t i = 0; i < D->count; i++) {
        double inside = is_inside(D, i, square_of_disc(D, d, i, x));
        FOR_VARIABLES(D, i, d, j)
            if (free[j] != inside) { /* few: memory is written only where needed */
                changed = 1;
                free[j] = inside;
            }
    }
    return changed;
}

/* free = 1 on discs with x off the boundary, else 0; return 1 if any entry changed. */
static int mark_discs(const discs *D, const double *x, double *free)
{
    return WITH_DIMENSION(D, mark_each, x, free);
}

/* w = T(w + κv) on discs with x on the boundary and nᵀg < 0. T removes the component
   along the normal n. κ = −nᵀg/‖x + c‖ is the multiplier of ½(‖x + c‖² − r²) ≤ 0, which
   adds the curvature of the boundary to the curvature of the cost. On discs of radius
   zero, w = 0.

   v : NULL for zero */
static void tangential_discs(const discs *D, const double *x, const double *g,
                             const double *v, double *w)
{
    for (Py_ssize_t i = 0; i < D->count; i++) {
        double square = square_of_disc(D, 0, i, x), along = 0;
        int is_point = D->radius[i] == 0;
        if (is_inside(D, i, square))
            continue;
        double share = is_point ? 0 : held_share(D, 0, i, x, g, square);
        if (share < 0)
            FOR_VARIABLES(D, i, 0, j)
                along += about_centre(D, x, j) * w[j] / square;
        FOR_VARIABLES(D, i, 0, j) {
            double bend = share < 0 && v ? share * v[j] : 0;
            w[j] = is_point ? 0 : w[j] - along * about_centre(D, x, j) - bend;
        }
    }
}
