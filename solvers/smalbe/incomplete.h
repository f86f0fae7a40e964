/* Incomplete Cholesky factors of principal submatrices of a sparse symmetric matrix.

   M = (I + L) D (I + L)' in an order of elimination, where L has the pattern of P.
   Fill-in outside this pattern is dropped, and `keep` times each dropped entry is added
   to the diagonal entries of its row and column. For keep = 1, this preserves row sums
   (modified incomplete Cholesky, Gustafsson 1978); keep = 0 is the method of Meijerink
   and van der Vorst (1977). Benzi (2002) surveys these methods.

   The order is 0, 1, ..., half - 1, then n - 1, n - 2, ..., half (twisted
   factorisation). Within each of these two parts, a column depends on the previous
   column, with the latency of a division or several multiplications. The two parts are
   independent of each other, except within the distance `reach` of the end of the
   second part. Their columns are therefore eliminated alternately, in the time that one
   part takes.

   Only free components are included. If P has few diagonals, L is stored by
   diagonals. Only the entries next to the main diagonal then form a recurrence, and
   all other entries are subtracted for a few hundred rows at the same time. */

#ifndef INCOMPLETE_H
#define INCOMPLETE_H

enum {
    RUN = 256 /* largest number of components of a run, chosen to fit the L1 cache */
};

typedef struct {
    /* count: number of diagonals on one side of the main diagonal; 0 if L is stored
       by columns */
    Py_ssize_t n, half, reach, count;
    Py_ssize_t runs, first_of_second, first_of_tail;
    Py_ssize_t width;            /* stored length of a diagonal: n + reach */
    const int *start, *row;      /* (n + 1,), (nnz,) later rows of each column */
    const Py_ssize_t *pair;      /* (n,) the first pair of entries of each column */
    const int *target;           /* entry changed by each pair; -1 if it is dropped */
    const double *below, *diagonal; /* the matrix, stored like L */
    const Py_ssize_t *offset;    /* (count,) offsets of the diagonals, ascending */
    const int *between;          /* diagonal whose offset is the difference of two, or -1 */
    int *from, *to;              /* (runs,) intervals of free components, in the order of
                                    elimination: first part, second part, its tail */
    double *L, *bands;           /* the factor by columns, or by diagonals */
    double *pivot, *inverse, *y;
} incomplete;

/* Append the intervals of free components in [a, b), ascending or descending. */
static void
append_runs(incomplete *F, in free, Py_ssize_t a, Py_ssize_t b, int down, Py_ssize_t most)
{
    Py_ssize_t i = down ? b - 1 : a, step = down ? -1 : 1, size;
    while (i >= a && i < b) {
        while (i >= a && i < b && free[i] == 0)
            i += step;
        for (size = 0; i >= a && i < b && free[i] != 0 && size < most; size++)
            i += step;
        if (size) {
            F->from[F->runs] = (int) (down ? i + 1 : i - size);
            F->to[F->runs++] = (int) (down ? i + 1 + size : i);
        }
    }
}

/* Find the intervals of free components, none longer than `most`. */
static void find_runs(incomplete *F, in free, Py_ssize_t most)
{
    Py_ssize_t tail = F->half + F->reach < F->n ? F->half + F->reach : F->n;
    F->runs = 0;
    append_runs(F, free, 0, F->half, 0, most);
    F->first_of_second = F->runs;
    append_runs(F, free, tail, F->n, 1, most);
    F->first_of_tail = F->runs;
    append_runs(F, free, F->half, tail, 1, most);
}

/* Eliminate column j; return true if its pivot is large enough. */
INLINE int eliminate_column(const incomplete *F, Py_ssize_t j, double keep, double least)
{
    const int *restrict row = F->row, *restrict target = F->target;
    double *L = F->L, *pivot = F->pivot, p = pivot[j], inverse = 1 / p;
    int first = F->start[j], last = F->start[j + 1];
    Py_ssize_t t = F->pair[j];
    F->inverse[j] = inverse;
    for (int k = first; k < last; k++) { /* L[k] is known, except the factor 1/p */
        double l = L[k], dropped = 0;
        for (int m = k + 1; m < last; m++, t++) {
            double fill = l * L[m];
            if (target[t] >= 0) {
                L[target[t]] -= fill * inverse;
            } else {
                dropped += fill;
                pivot[row[m]] -= keep * fill * inverse;
            }
        }
        pivot[row[k]] -= (l * l + keep * dropped) * inverse;
    }
    for (int k = first; k < last; k++)
        L[k] *= inverse;
    return (p > least * F->diagonal[j]) & (p < INFINITY);
}

/* Eliminate column j of a matrix stored by diagonals. The number `count` of
   diagonals is a compile-time constant. Entries that are not in the pattern of P are
   zero. */
INLINE int eliminate_by_bands(const incomplete *F, Py_ssize_t j, Py_ssize_t count,
                              double keep, double least)
{
    Py_ssize_t n = F->width, half = F->half, sign = j < half ? 1 : -1;
    double *pivot = F->pivot, p = pivot[j], inverse = 1 / p;
    double l[MAX_DIAGONALS], taken[MAX_DIAGONALS];
    F->inverse[j] = inverse;
    for (Py_ssize_t c = 0; c < count; c++) {
        l[c] = F->bands[c * n + j];
        taken[c] = l[c] * l[c];
    }
#pragma GCC unroll 4
    for (Py_ssize_t c = 0; c < count; c++)
#pragma GCC unroll 4
        for (Py_ssize_t d = c + 1; d < count; d++) {
            double fill = l[c] * l[d];
            int e = F->between[c * MAX_DIAGONALS + d];
            /* the entry is stored in the column of the row that is eliminated first */
            if (e >= 0) {
                Py_ssize_t near = j + sign * F->offset[c], far = j + sign * F->offset[d];
                Py_ssize_t column = sign > 0 && near >= half ? far : near;
                F->bands[e * n + column] -= fill * inverse;
            } else {
                taken[c] += keep * fill;
                taken[d] += keep * fill;
            }
        }
    for (Py_ssize_t c = 0; c < count; c++) {
        pivot[j + sign * F->offset[c]] -= taken[c] * inverse;
        F->bands[c * n + j] = l[c] * inverse;
    }
    return (p > least * F->diagonal[j]) & (p < INFINITY);
}

INLINE int eliminate(const incomplete *F, Py_ssize_t j, Py_ssize_t count, double keep,
                     double least)
{
    return count ? eliminate_by_bands(F, j, count, keep, least)
                 : eliminate_column(F, j, keep, least);
}

/* Eliminate the columns of all runs, alternating between both parts. */
INLINE int eliminate_all(incomplete *F, Py_ssize_t count, double keep, double least)
{
    Py_ssize_t a = 0, b = F->first_of_second, i, j;
    int good = 1;
    i = a < F->first_of_second ? F->from[a] : 0;
    j = b < F->first_of_tail ? F->to[b] - 1 : 0;
    while (a < F->first_of_second && b < F->first_of_tail) {
        good &= eliminate(F, i, count, keep, least);
        good &= eliminate(F, j, count, keep, least);
        if (++i == F->to[a] && ++a < F->first_of_second)
            i = F->from[a];
        if (--j < F->from[b] && ++b < F->first_of_tail)
            j = F->to[b] - 1;
    }
    while (a < F->first_of_second) {
        good &= eliminate(F, i, count, keep, least);
        if (++i == F->to[a] && ++a < F->first_of_second)
            i = F->from[a];
    }
    if (b < F->first_of_tail)
        for (; j >= F->from[b]; j--)
            good &= eliminate(F, j, count, keep, least);
    for (b += b < F->first_of_tail; b < F->runs; b++)
        for (j = F->to[b] - 1; j >= F->from[b]; j--)
            good &= eliminate(F, j, count, keep, least);
    return good;
}

/* Factorise P_FF with its diagonal multiplied by 1 + shift; return true if all pivots are
   at least `least` times this diagonal. */
CLONED static int
factorise_incompletely(incomplete *F, in free, double keep, double shift, double least)
{
    const int *restrict start = F->start, *restrict row = F->row;
    Py_ssize_t n = F->width;
    memset(F->inverse, 0, F->n * sizeof(double));
    memset(F->y, 0, F->n * sizeof(double)); /* stays zero for components that are not
    free */
    memset(F->L, 0, (F->count ? F->count * n : start[F->n]) * sizeof(double));
    for (Py_ssize_t r = 0; r < F->runs; r++) {
        Py_ssize_t a = F->from[r], b = F->to[r], sign = a < F->half ? 1 : -1;
        for (Py_ssize_t j = a; j < b; j++)
            F->pivot[j] = (1 + shift) * F->diagonal[j];
        for (Py_ssize_t c = 0; c < F->count; c++) {
            Py_ssize_t o = sign * F->offset[c];
            Py_ssize_t first = o < 0 && a < -o ? -o : a;
            Py_ssize_t last = o > 0 && b > F->n - o ? F->n - o : b;
            for (Py_ssize_t j = first; j < last; j++)
                F->bands[c * n + j] = F->below[c * n + j] * free[j + o];
        }
        for (Py_ssize_t j = F->count ? b : a; j < b; j++)
            for (int k = start[j]; k < start[j + 1]; k++)
                F->L[k] = F->below[k] * free[row[k]];
    }
    switch (F->count) {
    case 0: return eliminate_all(F, 0, keep, least);
    case 1: return eliminate_all(F, 1, keep, least);
    case 2: return eliminate_all(F, 2, keep, least);
    case 4: return eliminate_all(F, 4, keep, least);
    default: return eliminate_all(F, F->count, keep, least);
    }
}

/* y = v on a run [a, b), minus the products with earlier columns of L. The
   recurrence with the entries next to the main diagonal is not included. */
INLINE void before_forward(const incomplete *F, Py_ssize_t a, Py_ssize_t b, in v)
{
    double *y = F->y;
    int second = a >= F->half;
    for (Py_ssize_t i = a; i < b; i++)
        y[i] = v[i];
    for (Py_ssize_t c = 0; c < F->count; c++) {
        Py_ssize_t o = F->offset[c], first, last;
        const double *band = F->bands + c * F->width;
        if (second) { /* columns of the first part, then columns of the second part */
            last = b < F->half + o ? b : F->half + o;
            for (Py_ssize_t i = a; i < last; i++)
                y[i] -= band[i - o] * y[i - o];
            last = b < F->n - o ? b : F->n - o;
            if (o > 1)
#pragma GCC ivdep /* a run is no longer than the offset */
                for (Py_ssize_t i = a; i < last; i++)
                    y[i] -= band[i + o] * y[i + o];
        } else if (o > 1) {
            first = a > o ? a : o;
#pragma GCC ivdep
            for (Py_ssize_t i = first; i < b; i++)
                y[i] -= band[i - o] * y[i - o];
        }
    }
}

/* Backward substitution on a run: y = D^-1 y, minus the products with L'. The
   recurrence is not included. */
INLINE void before_backward(const incomplete *F, Py_ssize_t a, Py_ssize_t b)
{
    double *y = F->y;
    int second = a >= F->half;
    for (Py_ssize_t i = a; i < b; i++)
        y[i] *= F->inverse[i];
    for (Py_ssize_t c = 0; c < F->count; c++) {
        Py_ssize_t o = F->offset[c], first, last;
        const double *band = F->bands + c * F->width;
        if (second) {
            first = a > F->half + o ? a : F->half + o;
            if (o > 1)
#pragma GCC ivdep
                for (Py_ssize_t i = first; i < b; i++)
                    y[i] -= band[i] * y[i - o];
            continue;
        }
        last = b < F->n - o ? b : F->n - o;
        if (o > 1) {
#pragma GCC ivdep
            for (Py_ssize_t i = a; i < last; i++)
                y[i] -= band[i] * y[i + o];
        } else if (b == F->half && b < F->n) { /* the recurrence starts in the other
        part */
            y[b - 1] -= band[b - 1] * y[b];
        }
    }
}

/* Start and coefficients of the recurrence y_i = y_i - l y_j on a run, where j is
   the row before i. */
typedef struct {
    Py_ssize_t at, left, step;
    const double *l;
    double last;
} recurrence;

/* The forward sweep ascends in the first part and descends in the second part. The
   backward sweep descends in the first part and ascends in the second part. */
INLINE recurrence
begin_recurrence(const incomplete *F, Py_ssize_t a, Py_ssize_t b, int backward)
{
    int second = a >= F->half, down = second != backward;
    recurrence c = {down ? b - 1 : a, b - a, down ? -1 : 1, F->bands, 0};
    Py_ssize_t before = c.at - c.step;
    /* the entry is stored with the column that is eliminated first */
    c.l += backward ? 0 : -c.step;
    if (second ? before >= F->half && before < F->n : before >= 0 && before < F->half)
        c.last = F->y[before];
    return c;
}

INLINE void go_on(recurrence *c, double *y, Py_ssize_t size)
{
    Py_ssize_t i = c->at, step = c->step;
    double last = c->last;
    const double *l = c->l;
    /* without a previous row, `last` is zero, and the coefficient is not read */
    if (size) {
        last = y[i] - (last != 0 ? l[i] * last : 0);
        y[i] = last;
        i += step;
    }
    for (Py_ssize_t k = 1; k < size; k++, i += step) {
        last = y[i] - l[i] * last;
        y[i] = last;
    }
    c->at = i;
    c->last = last;
    c->left -= size;
}

/* Evaluate two independent recurrences alternately. */
INLINE void go_on_together(recurrence *c, recurrence *d, double *y)
{
    Py_ssize_t size = c->left < d->left ? c->left : d->left;
    Py_ssize_t i = c->at, j = d->at, up = c->step, down = d->step;
    double first = c->last, second = d->last;
    const double *l = c->l, *m = d->l;
    if (size) { /* there may be no previous row */
        go_on(c, y, 1);
        go_on(d, y, 1);
        i = c->at, j = d->at, first = c->last, second = d->last;
        for (Py_ssize_t k = 1; k < size; k++, i += up, j += down) {
            first = y[i] - l[i] * first;
            second = y[j] - m[j] * second;
            y[i] = first;
            y[j] = second;
        }
        c->at = i, d->at = j, c->last = first, d->last = second;
        c->left -= size - 1, d->left -= size - 1;
    }
    go_on(c, y, c->left);
    go_on(d, y, d->left);
}

/* y = M^-1 v with L stored by diagonals. */
INLINE void solve_by_bands(const incomplete *F, in v)
{
    int chained = F->offset[0] == 1;
    Py_ssize_t a = 0, b = F->first_of_second, second = b, tail = F->first_of_tail;
    recurrence c, d;
    for (; a < second || b < F->runs; a++, b++) {
        int one = a < second, other = b < tail || (a >= second && b < F->runs);
        if (one)
            before_forward(F, F->from[a], F->to[a], v);
        if (other)
            before_forward(F, F->from[b], F->to[b], v);
        else
            b--;
        if (!chained)
            continue;
        if (one)
            c = begin_recurrence(F, F->from[a], F->to[a], 0);
        if (other)
            d = begin_recurrence(F, F->from[b], F->to[b], 0);
        if (one && other)
            go_on_together(&c, &d, F->y);
        else if (one)
            go_on(&c, F->y, c.left);
        else if (other)
            go_on(&d, F->y, d.left);
    }
    for (b = F->runs - 1; b >= tail; b--) {
        before_backward(F, F->from[b], F->to[b]);
        if (chained) {
            d = begin_recurrence(F, F->from[b], F->to[b], 1);
            go_on(&d, F->y, d.left);
        }
    }
    for (a = second - 1; a >= 0 || b >= second; a--, b--) {
        int one = a >= 0, other = b >= second;
        if (one)
            before_backward(F, F->from[a], F->to[a]);
        if (other)
            before_backward(F, F->from[b], F->to[b]);
        if (!chained)
            continue;
        if (one)
            c = begin_recurrence(F, F->from[a], F->to[a], 1);
        if (other)
            d = begin_recurrence(F, F->from[b], F->to[b], 1);
        if (one && other)
            go_on_together(&c, &d, F->y);
        else if (one)
            go_on(&c, F->y, c.left);
        else
            go_on(&d, F->y, d.left);
    }
}

INLINE void forward_column(const incomplete *F, Py_ssize_t j, in v)
{
    double *y = F->y, done = y[j] + v[j];
    y[j] = done;
    for (int k = F->start[j]; k < F->start[j + 1]; k++)
        y[F->row[k]] -= F->L[k] * done; /* L is zero in rows that are not free */
}

INLINE void backward_column(const incomplete *F, Py_ssize_t j)
{
    double *y = F->y, rest = y[j] * F->inverse[j];
    for (int k = F->start[j]; k < F->start[j + 1]; k++)
        rest -= F->L[k] * y[F->row[k]];
    y[j] = rest;
}

/* z = s M^-1 v for a v that is zero off the free set. */
CLONED static void solve_incompletely(const incomplete *F, double s, in v, out z)
{
    double *y = F->y;
    memset(z, 0, F->n * sizeof(double));
    if (F->count) {
        solve_by_bands(F, v);
    } else {
        for (Py_ssize_t r = 0; r < F->runs; r++)
            memset(y + F->from[r], 0, (F->to[r] - F->from[r]) * sizeof(double));
        for (Py_ssize_t r = 0; r < F->first_of_second; r++)
            for (Py_ssize_t j = F->from[r]; j < F->to[r]; j++)
                forward_column(F, j, v);
        for (Py_ssize_t r = F->first_of_second; r < F->runs; r++)
            for (Py_ssize_t j = F->to[r] - 1; j >= F->from[r]; j--)
                forward_column(F, j, v);
        for (Py_ssize_t r = F->runs - 1; r >= F->first_of_second; r--)
            for (Py_ssize_t j = F->from[r]; j < F->to[r]; j++)
                backward_column(F, j);
        for (Py_ssize_t r = F->first_of_second - 1; r >= 0; r--)
            for (Py_ssize_t j = F->to[r] - 1; j >= F->from[r]; j--)
                backward_column(F, j);
    }
    for (Py_ssize_t r = 0; r < F->runs; r++)
        for (Py_ssize_t j = F->from[r]; j < F->to[r]; j++)
            z[j] = s * y[j];
}

#endif
