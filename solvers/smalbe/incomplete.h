/* Incomplete Cholesky factors of principal submatrices of a sparse symmetric matrix.

   The strictly lower triangle is stored by columns, and its pattern is that of the factor:
   M = (I + L) D (I + L)' with the entries of L where P has some. What elimination would put
   elsewhere is dropped; `keep` times that is added to the two diagonal entries of its row
   and column, so that row sums are kept for keep = 1 (Gustafsson 1978, modified incomplete
   Cholesky; Meijerink and van der Vorst 1977 for keep = 0; survey: Benzi 2002).

   Only rows and columns in `runs`, intervals of components that are free, take part.
   Where P lies on few diagonals, L is stored by these, too: then only the entries next to
   the diagonal are a recurrence, and the others are taken off some hundred rows at once. */

#ifndef INCOMPLETE_H
#define INCOMPLETE_H

enum {
    RUN = 256 /* most components of a run: what stays in the nearest cache */
};

typedef struct {
    Py_ssize_t n, runs, count;   /* count: of diagonals below the main one, 0 without */
    const int *start, *row;      /* (n + 1,), (nnz,) pattern of the lower triangle */
    const int *target;           /* of each pair of a column: an entry, -1 if dropped */
    const double *below, *diagonal; /* the matrix */
    const double *scale;         /* (n,) S of the inverse S M^-1 S */
    const Py_ssize_t *offset;    /* (count,) of the diagonals, ascending */
    const int *place;            /* (nnz,) of each entry in `bands` */
    int *from, *to;              /* (runs,) intervals of free components */
    double *L, *pivot, *inverse, *bands, *y;
} incomplete;

/* Intervals of free components, none longer than `most`. */
static void find_runs(incomplete *F, in free, Py_ssize_t most)
{
    Py_ssize_t i = 0, count = 0;
    while (i < F->n) {
        Py_ssize_t first;
        while (i < F->n && free[i] == 0)
            i++;
        for (first = i; i < F->n && free[i] != 0 && i - first < most;)
            i++;
        if (i > first) {
            F->from[count] = (int) first;
            F->to[count++] = (int) i;
        }
    }
    F->runs = count;
}

/* Factorise P_FF, its diagonal multiplied by 1 + shift; the first component whose pivot
   is below `least` of that, or -1. */
TWICE static Py_ssize_t
factorise_incompletely(incomplete *F, in free, double keep, double shift, double least)
{
    const int *restrict start = F->start, *restrict row = F->row;
    const int *restrict target = F->target;
    double *L = F->L, *pivot = F->pivot;
    Py_ssize_t t = 0, seen = 0;
    memset(F->inverse, 0, F->n * sizeof(double));
    memset(F->y, 0, F->n * sizeof(double)); /* stays zero where nothing is free */
    memset(L, 0, start[F->n] * sizeof(double));
    if (F->count)
        memset(F->bands, 0, F->count * F->n * sizeof(double));
    for (Py_ssize_t r = 0; r < F->runs; r++)
        for (Py_ssize_t j = F->from[r]; j < F->to[r]; j++) {
            pivot[j] = (1 + shift) * F->diagonal[j];
            for (int k = start[j]; k < start[j + 1]; k++)
                L[k] = F->below[k] * free[row[k]];
        }
    for (Py_ssize_t r = 0; r < F->runs; r++)
        for (Py_ssize_t j = F->from[r]; j < F->to[r]; j++) {
            int first = start[j], last = start[j + 1];
            double p = pivot[j], inverse;
            for (; seen < j; seen++) { /* pairs of columns that are not free */
                Py_ssize_t size = start[seen + 1] - start[seen];
                t += size * (size - 1) / 2;
            }
            seen = j + 1;
            if (!(p > least * F->diagonal[j]) || !isfinite(p))
                return j;
            inverse = 1 / p;
            F->inverse[j] = inverse;
            for (int k = first; k < last; k++) { /* all but the product with 1/p is known */
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
            for (int k = start[j]; k < start[j + 1]; k++) {
                L[k] *= inverse;
                if (F->count)
                    F->bands[F->place[k]] = L[k];
            }
        }
    return -1;
}

/* y = (I + L)^-1 S v of a run, whose rows far from the diagonal are known. */
INLINE void forward_run(const incomplete *F, Py_ssize_t a, Py_ssize_t b, in v)
{
    double *y = F->y, last = 0;
    Py_ssize_t c = 0;
    in s = F->scale;
    for (Py_ssize_t i = a; i < b; i++)
        y[i] = s[i] * v[i];
    for (c = F->offset[0] == 1; c < F->count; c++) {
        Py_ssize_t o = F->offset[c], first = a > o ? a : o;
        const double *band = F->bands + c * F->n - o;
        const double *known = y - o;
#pragma GCC ivdep /* a run is no longer than the offset */
        for (Py_ssize_t i = first; i < b; i++)
            y[i] -= band[i] * known[i];
    }
    if (F->offset[0] != 1)
        return;
    if (a)
        last = y[a - 1];
    for (Py_ssize_t i = a; i < b; i++) {
        last = y[i] - (i ? F->bands[i - 1] : 0) * last;
        y[i] = last;
    }
}

/* z = S y with y = (I + L')^-1 D^-1 y of a run; the sum of z along. */
INLINE double
backward_run(const incomplete *F, Py_ssize_t a, Py_ssize_t b, in along, out z)
{
    double *y = F->y, last = b < F->n ? y[b] : 0, sum = 0;
    in s = F->scale;
    for (Py_ssize_t i = a; i < b; i++)
        y[i] *= F->inverse[i];
    for (Py_ssize_t c = F->offset[0] == 1; c < F->count; c++) {
        Py_ssize_t o = F->offset[c], end = b < F->n - o ? b : F->n - o;
        const double *band = F->bands + c * F->n;
        const double *known = y + o;
#pragma GCC ivdep
        for (Py_ssize_t i = a; i < end; i++)
            y[i] -= band[i] * known[i];
    }
    if (F->offset[0] == 1)
        for (Py_ssize_t i = b - 1; i >= a; i--) {
            last = y[i] - F->bands[i] * last;
            y[i] = last;
        }
    for (Py_ssize_t i = a; i < b; i++) {
        z[i] = s[i] * y[i];
        sum += z[i] * along[i];
    }
    return sum;
}

/* z = S M^-1 S v for v that is zero where nothing is free; the sum of z along. */
TWICE static double solve_incompletely(const incomplete *F, in v, in along, out z)
{
    const int *restrict start = F->start, *restrict row = F->row;
    double *y = F->y, sum = 0;
    in s = F->scale, L = F->L;
    for (Py_ssize_t r = 0, a = 0; r <= F->runs; r++) { /* between the runs */
        Py_ssize_t b = r < F->runs ? F->from[r] : F->n;
        if (a < b)
            memset(z + a, 0, (b - a) * sizeof(double));
        a = r < F->runs ? F->to[r] : F->n;
    }
    if (F->count) {
        for (Py_ssize_t r = 0; r < F->runs; r++)
            forward_run(F, F->from[r], F->to[r], v);
        for (Py_ssize_t r = F->runs - 1; r >= 0; r--)
            sum += backward_run(F, F->from[r], F->to[r], along, z);
        return sum;
    }
    for (Py_ssize_t r = 0; r < F->runs; r++)
        memset(y + F->from[r], 0, (F->to[r] - F->from[r]) * sizeof(double));
    for (Py_ssize_t r = 0; r < F->runs; r++)
        for (Py_ssize_t j = F->from[r]; j < F->to[r]; j++) {
            double done = y[j] + s[j] * v[j];
            y[j] = done;
            for (int k = start[j]; k < start[j + 1]; k++)
                y[row[k]] -= L[k] * done; /* L is zero where a row is not free */
        }
    for (Py_ssize_t r = F->runs - 1; r >= 0; r--)
        for (Py_ssize_t j = F->to[r] - 1; j >= F->from[r]; j--) {
            double rest = y[j] * F->inverse[j];
            for (int k = start[j]; k < start[j + 1]; k++)
                rest -= L[k] * y[row[k]];
            y[j] = rest;
            z[j] = s[j] * rest;
            sum += z[j] * along[j];
        }
    return sum;
}

/* s = P(x - z) - x, P the projection on lower <= x <= upper; g's. */
TWICE static double
projected_step(in x, in z, in g, in lower, in upper, out s, Py_ssize_t n)
{
    double slope = 0;
    for (Py_ssize_t i = 0; i < n; i++) {
        double to = x[i] - z[i];
        to = to > lower[i] ? to : lower[i];
        to = to < upper[i] ? to : upper[i];
        s[i] = to - x[i];
        slope += g[i] * s[i];
    }
    return slope;
}

/* S P S for P by rows, S diagonal: its entries, the largest sum of absolute values of a
   row, and the least sums of rows of P and of S P S, in units of the diagonal. */
TWICE static void
scaled_matrix(const int *indptr, const int *indices, in data, in s, out scaled,
              Py_ssize_t n, out told)
{
    double norm = 0, least = INFINITY, least_scaled = INFINITY;
    for (Py_ssize_t i = 0; i < n; i++) {
        double size = 0, sum = 0, sum_scaled = 0;
        for (int k = indptr[i]; k < indptr[i + 1]; k++) {
            double a = s[i] * data[k] * s[indices[k]];
            scaled[k] = a;
            size += fabs(a);
            sum += data[k];
            sum_scaled += a;
        }
        sum *= s[i] * s[i];
        norm = norm > size ? norm : size;
        least = least < sum ? least : sum;
        least_scaled = least_scaled < sum_scaled ? least_scaled : sum_scaled;
    }
    told[0] = norm;
    told[1] = least;
    told[2] = least_scaled;
}

#endif
