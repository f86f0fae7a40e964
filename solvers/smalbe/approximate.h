/* A factorised sparse approximate inverse of the free block of a dense matrix. */

/* Number of neighbours of a component, and number of rows in the sample of `coupling`. */
enum { NEIGHBOURS = 6 };

/* Smallest pivot relative to the diagonal entry. It limits M where F is almost singular. */
#define LEAST_VARIANCE 1e-2

/* A row i of G: the entries in `count` columns, of which the last one is i. */
typedef struct {
    int count, column[NEIGHBOURS + 1];
    double entry[NEIGHBOURS + 1];
} sparse_row;

/* Compute row i of G. Its neighbours j are the components after i with the largest
   Fᵢⱼ²wⱼ, where wⱼ is 1/Fⱼⱼ for free components and 0 for others. With the factors LDLᵀ of F
   for the neighbours, followed by i, the row solves Lᵀg = e/√D with the last unit vector
   e. `strength` (n,) is workspace. */
CLONED static void find_row(in F, in w, Py_ssize_t n, int i, out strength, sparse_row *row)
{
    in at = F + i * n;
    int near[NEIGHBOURS + 1], found = 0, k = 0;
    double L[NEIGHBOURS + 1][NEIGHBOURS], inverse[NEIGHBOURS + 1], least = 0;
    for (Py_ssize_t j = i + 1; j < n; j++)
        strength[j] = at[j] * at[j] * w[j];
    for (int j = i + 1; j < n; j++) {
        if (!(strength[j] > least))
            continue;
        int c = found < NEIGHBOURS ? found++ : NEIGHBOURS - 1;
        for (; c > 0 && strength[near[c - 1]] < strength[j]; c--)
            near[c] = near[c - 1];
        near[c] = j;
        least = found < NEIGHBOURS ? 0 : strength[near[found - 1]];
    }
    near[found] = i;
    for (int c = 0; c <= found; c++) {
        int j = near[c];
        double pivot = F[j * n + j], noise = LEAST_VARIANCE * pivot, t[NEIGHBOURS];
        for (int d = 0; d < k; d++) {
            int l = row->column[d];
            t[d] = F[SMALLER(j, l) * n + LARGER(j, l)];
            for (int e = 0; e < d; e++)
                t[d] -= t[e] * L[d][e];
            L[k][d] = t[d] * inverse[d];
            pivot -= t[d] * L[k][d];
        }
        if (c < found && pivot <= noise)
            continue; /* the neighbour depends on stronger ones */
        inverse[k] = 1 / LARGER(pivot, noise);
        row->column[k++] = j;
    }
    row->count = k;
    row->entry[k - 1] = sqrt(inverse[k - 1]);
    for (int c = k - 2; c >= 0; c--) {
        row->entry[c] = 0;
        for (int d = c + 1; d < k; d++)
            row->entry[c] -= L[d][c] * row->entry[d];
    }
}

INLINE double times_row(const sparse_row *row, in v)
{
    double sum = 0;
    for (int k = 0; k < row->count; k++)
        sum += row->entry[k] * v[row->column[k]];
    return sum;
}

/* y = GᵀGv, without the rows whose count is zero. */
CLONED static void approximate_inverse(const sparse_row *G, in v, out y, Py_ssize_t n)
{
    memset(y, 0, n * sizeof(double));
    for (Py_ssize_t i = 0; i < n; i++) {
        double sum = times_row(G + i, v);
        for (int k = 0; k < G[i].count; k++)
            y[G[i].column[k]] += sum * G[i].entry[k];
    }
}

/* Return the mean of Σⱼ(GFGᵀ - I)ᵢⱼ² over a sample of free components i; t (n,): workspace */
CLONED static double coupling(in F, in w, Py_ssize_t n, const sparse_row *G, out t)
{
    Py_ssize_t free = 0, seen = 0, taken = 0;
    double total = 0;
    for (Py_ssize_t i = 0; i < n; i++)
        free += w[i] > 0;
    for (Py_ssize_t i = 0; i < n; i++) {
        if (w[i] == 0 || seen++ % (free / NEIGHBOURS + 1))
            continue;
        taken++;
        memset(t, 0, n * sizeof(double));
        for (int k = 0; k < G[i].count; k++)
            add(G[i].entry[k], F + n * G[i].column[k], t, n);
        for (Py_ssize_t j = 0; j < n; j++) {
            double error = w[j] > 0 ? times_row(G + j, t) - (j == i) : 0;
            total += error * error;
        }
    }
    return total / LARGER(taken, 1);
}
