/* Incomplete Cholesky factors of principal submatrices of a sparse symmetric matrix.

   M = (I + L) D (I + L)' where L has the pattern of P. Fill-in outside this pattern is
   dropped, and `keep` times each dropped entry is added to the diagonal entries of its
   row and column (keep = 0: Meijerink and van der Vorst 1977). Only free components are
   included. If P has few diagonals, L is stored by diagonals: only entries next to the
   main diagonal then form a recurrence, and all others are subtracted for a few hundred
   rows at the same time. */

#ifndef INCOMPLETE_H
#define INCOMPLETE_H

enum {
    RUN = 256 /* largest number of components of a run, chosen to fit the L1 cache */
};

typedef struct {
    /* count: number of diagonals on one side of the main diagonal; 0 if L is stored
       by columns */
    Py_ssize_t n, count, runs;
    Py_ssize_t width;            /* stored length of a diagonal of L: n + last offset */
    const int *start, *row;      /* (n + 1,), (nnz,) later rows of each column */
    const Py_ssize_t *pair;      /* (n,) the first pair of entries of each column */
    const int *target;           /* entry changed by each pair; -1 if it is dropped */
    const double *below, *diagonal; /* the matrix, by columns or diagonals (count, n) */
    const Py_ssize_t *offset;    /* (count,) offsets of the diagonals, ascending */
    const int *between;          /* diagonal whose offset is the difference of two, or -1 */
    int *from, *to;              /* (runs,) intervals of free components */
    double *L, *pivot, *inverse, *y;
} incomplete;

/* Find the intervals of free components, none longer than `most`. */
static void find_runs(incomplete *F, in free, Py_ssize_t most)
{
    F->runs = 0;
    for (Py_ssize_t i = 0; i < F->n;) {
        Py_ssize_t first = i;
        while (i < F->n && free[i] != 0 && i < first + most)
            i++;
        if (i > first) {
            F->from[F->runs] = (int) first;
            F->to[F->runs++] = (int) i;
        }
        i += i < F->n && free[i] == 0;
    }
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
    Py_ssize_t width = F->width;
    double *pivot = F->pivot, p = pivot[j], inverse = 1 / p;
    double l[MAX_DIAGONALS], taken[MAX_DIAGONALS];
    F->inverse[j] = inverse;
    for (Py_ssize_t c = 0; c < count; c++) {
        l[c] = F->L[c * width + j];
        taken[c] = l[c] * l[c];
    }
#pragma GCC unroll 4
    for (Py_ssize_t c = 0; c < count; c++)
#pragma GCC unroll 4
        for (Py_ssize_t d = c + 1; d < count; d++) {
            double fill = l[c] * l[d];
            int e = F->between[c * MAX_DIAGONALS + d];
            if (e >= 0) {
                F->L[e * width + j + F->offset[c]] -= fill * inverse;
            } else {
                taken[c] += keep * fill;
                taken[d] += keep * fill;
            }
        }
    for (Py_ssize_t c = 0; c < count; c++) {
        pivot[j + F->offset[c]] -= taken[c] * inverse;
        F->L[c * width + j] = l[c] * inverse;
    }
    return (p > least * F->diagonal[j]) & (p < INFINITY);
}

INLINE int eliminate_all(const incomplete *F, Py_ssize_t count, double keep, double least)
{
    int good = 1;
    for (Py_ssize_t r = 0; r < F->runs; r++)
        for (Py_ssize_t j = F->from[r]; j < F->to[r]; j++)
            good &= count ? eliminate_by_bands(F, j, count, keep, least)
                          : eliminate_column(F, j, keep, least);
    return good;
}

/* Factorise P_FF with its diagonal multiplied by 1 + shift; return true if all pivots are
   at least `least` times this diagonal. */
CLONED static int
factorise_incompletely(incomplete *F, in free, double keep, double shift, double least)
{
    const int *restrict start = F->start, *restrict row = F->row;
    Py_ssize_t n = F->n;
    memset(F->inverse, 0, n * sizeof(double));
    memset(F->y, 0, n * sizeof(double)); /* stays zero for components that are not free */
    memset(F->L, 0, (F->count ? F->count * F->width : start[n]) * sizeof(double));
    for (Py_ssize_t r = 0; r < F->runs; r++) {
        Py_ssize_t a = F->from[r], b = F->to[r];
        for (Py_ssize_t j = a; j < b; j++)
            F->pivot[j] = (1 + shift) * F->diagonal[j];
        for (Py_ssize_t c = 0; c < F->count; c++) {
            Py_ssize_t o = F->offset[c], last = SMALLER(b, n - o);
            for (Py_ssize_t j = a; j < last; j++)
                F->L[c * F->width + j] = F->below[c * n + j] * free[j + o];
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

/* Forward and backward substitution on the run [a, b) of a factor by diagonals. A run is
   no longer than the second offset, so that only entries next to the main diagonal
   couple its components. */
INLINE void forward_run(const incomplete *F, Py_ssize_t a, Py_ssize_t b, in v)
{
    double *y = F->y;
    memcpy(y + a, v + a, (b - a) * sizeof(double));
    for (Py_ssize_t c = F->count - 1; c >= 0; c--) {
        Py_ssize_t o = F->offset[c], first = LARGER(a, o);
        const double *band = F->L + c * F->width;
        if (o > 1) {
#pragma GCC ivdep
            for (Py_ssize_t i = first; i < b; i++)
                y[i] -= band[i - o] * y[i - o];
        } else if (first < b) {
            double last = y[first - 1];
            for (Py_ssize_t i = first; i < b; i++)
                y[i] = last = y[i] - band[i - 1] * last;
        }
    }
}

INLINE void backward_run(const incomplete *F, Py_ssize_t a, Py_ssize_t b)
{
    double *y = F->y;
    for (Py_ssize_t i = a; i < b; i++)
        y[i] *= F->inverse[i];
    for (Py_ssize_t c = F->count - 1; c >= 0; c--) {
        Py_ssize_t o = F->offset[c], end = SMALLER(b, F->n - o);
        const double *band = F->L + c * F->width;
        if (o > 1) {
#pragma GCC ivdep
            for (Py_ssize_t i = a; i < end; i++)
                y[i] -= band[i] * y[i + o];
        } else if (a < end) {
            double last = y[end];
            for (Py_ssize_t i = end - 1; i >= a; i--)
                y[i] = last = y[i] - band[i] * last;
        }
    }
}

/* z = s M^-1 v for a v that is zero off the free set. */
CLONED static void solve_incompletely(const incomplete *F, double s, in v, out z)
{
    double *y = F->y;
    memset(z, 0, F->n * sizeof(double));
    for (Py_ssize_t r = 0; r < F->runs && !F->count; r++)
        memcpy(y + F->from[r], v + F->from[r], (F->to[r] - F->from[r]) * sizeof(double));
    for (Py_ssize_t r = 0; r < F->runs; r++) {
        if (F->count)
            forward_run(F, F->from[r], F->to[r], v);
        for (Py_ssize_t j = F->from[r]; j < F->to[r] && !F->count; j++)
            for (int k = F->start[j]; k < F->start[j + 1]; k++)
                y[F->row[k]] -= F->L[k] * y[j]; /* L is zero in rows that are not free */
    }
    for (Py_ssize_t r = F->runs - 1; r >= 0; r--) {
        if (F->count)
            backward_run(F, F->from[r], F->to[r]);
        for (Py_ssize_t j = F->to[r] - 1; j >= F->from[r] && !F->count; j--) {
            double rest = y[j] * F->inverse[j];
            for (int k = F->start[j]; k < F->start[j + 1]; k++)
                rest -= F->L[k] * y[F->row[k]];
            y[j] = rest;
        }
        for (Py_ssize_t j = F->from[r]; j < F->to[r]; j++)
            z[j] = s * y[j];
    }
}

#endif
