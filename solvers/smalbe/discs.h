/* Loops over discs ‖x_I + c_I‖ ≤ r of the set of MPRGP, beside those of vectors.h.

   A disc is active if x is within `slack` of its boundary. Active discs are no part of
   the face, the free gradient φ is zero there. With the outward normal n, the chopped
   gradient β is the gradient, without its normal component if that points inwards
   (nᵀg < 0 holds x on the boundary). A disc of radius zero has φ = β = 0. */

typedef struct {
    Py_ssize_t count, ranges;
    const int *start; /* (count + 1,) of each disc in `index` */
    const int *index; /* its variables */
    const double *radius;
    const double *slack; /* rounding of ‖x_I + c_I‖ */
    const double *centre; /* (n,) −c; NULL for zero */
    const Py_ssize_t *range; /* (2 ranges,) first and last variable without a disc */
} discs;

INLINE double about_centre(const discs *D, const double *x, int j)
{
    return D->centre ? x[j] + D->centre[j] : x[j];
}

INLINE double size_of_disc(const discs *D, Py_ssize_t i, const double *x)
{
    double square = 0;
    for (int k = D->start[i]; k < D->start[i + 1]; k++) {
        double u = about_centre(D, x, D->index[k]);
        square += u * u;
    }
    return sqrt(square);
}

/* Scale a disc of x by `factor` about its centre. */
INLINE void scale_disc(const discs *D, Py_ssize_t i, double factor, double *x)
{
    for (int k = D->start[i]; k < D->start[i + 1]; k++) {
        int j = D->index[k];
        double c = D->centre ? D->centre[j] : 0;
        x[j] = factor * (x[j] + c) - c;
    }
}

/* Factor about the centre that projects x − v on the disc, v = length·g. */
INLINE double projected_factor(const discs *D, Py_ssize_t i, const double *x,
                               const double *g, double length)
{
    double square = 0, r = D->radius[i];
    for (int k = D->start[i]; k < D->start[i + 1]; k++) {
        int j = D->index[k];
        double u = about_centre(D, x, j) - length * g[j];
        square += u * u;
    }
    return square > r * r ? r / sqrt(square) : 1;
}

/* y = Π(y). */
static void project_discs(const discs *D, double *y)
{
    for (Py_ssize_t i = 0; i < D->count; i++) {
        double size = size_of_disc(D, i, y), r = D->radius[i];
        if (size > r)
            scale_disc(D, i, r / size, y);
    }
}

/* Return the α at which x − αp leaves the first disc, `least` if none is left before. */
static double first_disc(const discs *D, const double *x, const double *p, double least)
{
    for (Py_ssize_t i = 0; i < D->count; i++) {
        double a = 0, b = 0, c = 0, r = D->radius[i];
        for (int k = D->start[i]; k < D->start[i + 1]; k++) {
            int j = D->index[k];
            double u = about_centre(D, x, j);
            a += p[j] * p[j];
            b += u * p[j];
            c += u * u;
        }
        if (a == 0)
            continue;
        c = (sqrt(c) - r) * (sqrt(c) + r); /* without cancellation */
        c = c < 0 ? c : 0;
        /* a α² − 2bα + c ≤ 0 in the disc: convex, and it holds at α = 0 */
        if (least < INFINITY && (a * least - 2 * b) * least + c <= 0)
            continue;
        double root = sqrt(b * b - a * c);
        double to = b >= 0 ? (b + root) / a : -c / (root - b);
        least = to < least ? to : least;
    }
    return least;
}

/* Add ‖φ‖², ‖β‖² and φ̃ᵀφ of one disc to result, and φᵀHp to result[3] if Hp is given;
   returns 1 where it is free. */
INLINE double face_of_disc(const discs *D, Py_ssize_t i, const double *x,
                           const double *g, const double *Hp, double tau, double *phi,
                           double *free, double *result)
{
    double size = size_of_disc(D, i, x), r = D->radius[i], push = 0, square = 0;
    int is_free = size < r - D->slack[i];
    for (int k = D->start[i]; k < D->start[i + 1]; k++) {
        int j = D->index[k];
        push += about_centre(D, x, j) * g[j];
        square += g[j] * g[j];
        phi[j] = is_free ? g[j] : 0;
        free[j] = is_free;
    }
    if (is_free) {
        double factor = projected_factor(D, i, x, g, 1 / tau), cut = 0, along = 0;
        for (int k = D->start[i]; k < D->start[i + 1]; k++) {
            int j = D->index[k];
            double u = about_centre(D, x, j);
            cut += (factor < 1 ? tau * u - factor * (tau * u - g[j]) : g[j]) * g[j];
            along += Hp ? g[j] * Hp[j] : 0;
        }
        result[0] += square;
        result[2] += cut;
        if (Hp)
            result[3] += along;
    } else if (r > 0) {
        double inward = push < 0 ? push / size : 0;
        for (int k = D->start[i]; k < D->start[i + 1]; k++) {
            int j = D->index[k]; /* the difference of squares would cancel */
            double b = g[j] - inward * about_centre(D, x, j) / size;
            result[1] += b * b;
        }
    }
    return is_free;
}

/* φ and `free` on discs; adds ‖φ‖², ‖β‖² and φ̃ᵀφ to result. */
static void split_discs(const discs *D, const double *x, const double *g, double tau,
                        double *phi, double *free, double *result)
{
    for (Py_ssize_t i = 0; i < D->count; i++)
        face_of_disc(D, i, x, g, NULL, tau, phi, free, result);
}

/* x = x − αp, set to the boundary within rounding of it, g = g − αHp and the sums of
   `advance`, on discs. */
static void advance_discs(const discs *D, double alpha, double *x, double *g,
                          const double *p, const double *Hp, double tau, double *phi,
                          double *free, double *result)
{
    for (Py_ssize_t i = 0; i < D->count; i++) {
        double r = D->radius[i];
        for (int k = D->start[i]; k < D->start[i + 1]; k++) {
            int j = D->index[k];
            x[j] -= alpha * p[j];
            g[j] -= alpha * Hp[j];
        }
        double size = size_of_disc(D, i, x);
        if (size > r - 4 * D->slack[i] && size != r && size > 0)
            scale_disc(D, i, r / size, x);
        face_of_disc(D, i, x, g, Hp, tau, phi, free, result);
    }
}

/* beta = β on discs. */
static void chop_discs(const discs *D, const double *x, const double *g, double *beta)
{
    for (Py_ssize_t i = 0; i < D->count; i++) {
        double size = size_of_disc(D, i, x), r = D->radius[i], push = 0;
        int is_chopped = size >= r - D->slack[i] && r > 0;
        for (int k = D->start[i]; k < D->start[i + 1]; k++)
            push += about_centre(D, x, D->index[k]) * g[D->index[k]];
        double inward = push < 0 ? push / size : 0;
        for (int k = D->start[i]; k < D->start[i + 1]; k++) {
            int j = D->index[k];
            beta[j] = is_chopped ? g[j] - inward * about_centre(D, x, j) / size : 0;
        }
    }
}

/* s = Π(x − g/τ) − x on discs; zero on active ones if `free_only`. */
static void step_on_discs(const discs *D, const double *x, const double *g, double tau,
                          int free_only, double *s)
{
    for (Py_ssize_t i = 0; i < D->count; i++) {
        double factor = projected_factor(D, i, x, g, 1 / tau);
        int moves = !free_only || size_of_disc(D, i, x) < D->radius[i] - D->slack[i];
        for (int k = D->start[i]; k < D->start[i + 1]; k++) {
            int j = D->index[k];
            double u = about_centre(D, x, j), v = u - g[j] / tau;
            s[j] = moves ? (factor < 1 ? factor * v - u : -g[j] / tau) : 0;
        }
    }
}

/* Return Σ (norm gᵢ)²/Dᵢᵢ over the projected gradient on discs, see `inward_energy`. */
static double inward_energy_of_discs(const discs *D, const double *x, const double *g,
                                     const double *diagonal, double norm, double noise)
{
    double total = 0;
    for (Py_ssize_t i = 0; i < D->count; i++) {
        double size = size_of_disc(D, i, x), r = D->radius[i], push = 0;
        int is_free = size < r - D->slack[i];
        for (int k = D->start[i]; k < D->start[i + 1]; k++)
            push += about_centre(D, x, D->index[k]) * g[D->index[k]];
        double inward = !is_free && push < 0 ? push / size : 0;
        for (int k = D->start[i]; k < D->start[i + 1] && r > 0; k++) {
            int j = D->index[k];
            double b = g[j];
            if (inward < 0)
                b -= inward * about_centre(D, x, j) / size;
            if (diagonal[j] > 0 && fabs(norm * b) > noise)
                total += norm * b * norm * b / diagonal[j];
        }
    }
    return total;
}
