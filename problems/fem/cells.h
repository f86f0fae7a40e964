/* Integrals over single cells, summed into the values of a CSC matrix.

   The functions apply to n <= NODES nodes and dim = 2 or 3 coordinates. They are
   inlined, so that compilers unroll the loops for callers that pass constants. */

#include <stddef.h>

#define NODES 8 /* nodes of the largest element */
#define DIM 3   /* largest dimension */

#if defined(__x86_64__) && defined(__gnu_linux__)
/* Compile two versions, one of which is selected at load time. Both round identically,
   because neither uses FMA. */
#define CLONED __attribute__((target_clones("avx2", "default")))
#else
#define CLONED
#endif
#if defined(__GNUC__)
#define INLINED static inline __attribute__((always_inline))
#else
#define INLINED static inline
#endif

/* Indices of the components of a symmetric tensor in Voigt's notation, by dimension. */
static const int VOIGT[DIM + 1][DIM][DIM] = {
    {{0}}, {{0}}, {{0, 2}, {2, 1}}, {{0, 5, 4}, {5, 1, 3}, {4, 3, 2}},
};

/* Tables of a finite element, see problems.fem.elements. */
typedef struct {
    int points, pairs;
    const double *gradients; /* (points, dim, n) gradients of the shape functions */
    const double *weights;   /* (points,) quadrature weights */
    const int *edges;        /* (dim, pairs, 2) first and last nodes of edges per axis */
} element;

/* Compute adj(J) with J adj(J) = det(J) I; return det(J). */
INLINED double adjugate(int dim, const double J[DIM][DIM], double adj[DIM][DIM]) {
    double det = 0;
    if (dim == 2) {
        adj[0][0] = J[1][1], adj[0][1] = -J[0][1];
        adj[1][0] = -J[1][0], adj[1][1] = J[0][0];
        return J[0][0] * J[1][1] - J[0][1] * J[1][0];
    }
    for (int i = 0; i < 3; i++)
        for (int j = 0; j < 3; j++)
            adj[j][i] = J[(i + 1) % 3][(j + 1) % 3] * J[(i + 2) % 3][(j + 2) % 3]
                      - J[(i + 1) % 3][(j + 2) % 3] * J[(i + 2) % 3][(j + 1) % 3];
    for (int j = 0; j < 3; j++)
        det += J[0][j] * adj[j][0];
    return det;
}

/* Integrate BᵀDB of one cell.

   x (n, dim) corners, D (v, v) with v = dim(dim + 1)/2 components of strain,
   Ke (dim, dim, n, n), indexed by components, then by nodes */
INLINED void cell_stiffness(
    int n, int dim, int pairs, const element *elem, const double *x, const double *D,
    double *Ke
) {
    const int v = dim * (dim + 1) / 2;
    double span[DIM * NODES * DIM], grad[DIM * NODES];
    double J[DIM][DIM], adj[DIM][DIM], stress[DIM * (DIM + 1) / 2];
    for (int e = 0; e < dim * pairs; e++)
        for (int m = 0; m < dim; m++)
            span[e * dim + m] =
                x[elem->edges[2 * e + 1] * dim + m] - x[elem->edges[2 * e] * dim + m];
    for (int i = 0; i < dim * dim * n * n; i++)
        Ke[i] = 0;
    for (int q = 0; q < elem->points; q++) {
        const double *reference = elem->gradients + q * dim * n;
        /* J = ∂x/∂ξ from differences of corners, because Σ x_a ∂N_a/∂ξ loses digits */
        for (int k = 0; k < dim; k++)
            for (int m = 0; m < dim; m++) {
                const int *last = elem->edges + 2 * k * pairs + 1;
                double sum = reference[k * n + last[0]] * span[k * pairs * dim + m];
                for (int e = 1; e < pairs; e++)
                    sum += reference[k * n + last[2 * e]]
                         * span[(k * pairs + e) * dim + m];
                J[k][m] = sum;
            }
        /* grad omits the factor 1/det, which enters twice: w det (1/det)² = w/det */
        const double weight = elem->weights[q] / adjugate(dim, J, adj);
        for (int m = 0; m < dim; m++)
            for (int a = 0; a < n; a++) {
                double sum = adj[m][0] * reference[a];
                for (int k = 1; k < dim; k++)
                    sum += adj[m][k] * reference[k * n + a];
                grad[m * n + a] = sum;
            }
        for (int k = 0; k < dim; k++)
            for (int i = 0; i < n; i++) {
                for (int c = 0; c < v; c++) {
                    double sum = D[VOIGT[dim][k][0] * v + c] * grad[i];
                    for (int m = 1; m < dim; m++)
                        sum += D[VOIGT[dim][k][m] * v + c] * grad[m * n + i];
                    stress[c] = sum * weight;
                }
                for (int l = 0; l < dim; l++) {
                    double *to = Ke + ((k * dim + l) * n + i) * n;
                    for (int j = 0; j < n; j++) {
                        double sum = stress[VOIGT[dim][l][0]] * grad[j];
                        for (int m = 1; m < dim; m++)
                            sum += stress[VOIGT[dim][l][m]] * grad[m * n + j];
                        to[j] += sum;
                    }
                }
            }
    }
}

/* Add the block Ke of a cell to the entries of a matrix in the order of dof_pattern.

   nodes (n,), ptr and slot (n, n): see problems.fem.elasticity.Pattern */
INLINED void scatter(
    int n, int dim, const double *Ke, const int *nodes, const int *ptr, const int *slot,
    double *data
) {
    for (int i = 0; i < n; i++) {
        const ptrdiff_t first = ptr[nodes[i]], row = dim * (ptr[nodes[i] + 1] - first);
        for (int j = 0; j < n; j++) {
            double *to = data + dim * dim * first + dim * slot[i * n + j];
            for (int k = 0; k < dim; k++)
                for (int l = 0; l < dim; l++)
                    to[k * row + l] += Ke[((k * dim + l) * n + i) * n + j];
        }
    }
}

INLINED void sum_cells(
    int n, int dim, int pairs, const element *elem, const double *points, ptrdiff_t E,
    const int *cells, const double *D, const int *material, const int *ptr,
    const int *slot, double *data
) {
    const int v = dim * (dim + 1) / 2;
    double x[NODES * DIM], Ke[NODES * NODES * DIM * DIM];
    for (ptrdiff_t e = 0; e < E; e++) {
        const int *nodes = cells + e * n;
        for (int i = 0; i < n; i++)
            for (int m = 0; m < dim; m++)
                x[i * dim + m] = points[(ptrdiff_t)nodes[i] * dim + m];
        cell_stiffness(n, dim, pairs, elem, x, D + material[e] * v * v, Ke);
        scatter(n, dim, Ke, nodes, ptr, slot + e * n * n, data);
    }
}

/* Sum the stiffness of E cells (E, n); points (N, dim), D (materials, v, v). */
CLONED static void sum_stiffness(
    int n, int dim, const element *elem, const double *points, ptrdiff_t E,
    const int *cells, const double *D, const int *material, const int *ptr,
    const int *slot, double *data
) {
    if (n == 4 && dim == 2 && elem->pairs == 2)
        sum_cells(4, 2, 2, elem, points, E, cells, D, material, ptr, slot, data);
    else if (n == 8 && dim == 3 && elem->pairs == 4)
        sum_cells(8, 3, 4, elem, points, E, cells, D, material, ptr, slot, data);
    else if (n == 4 && dim == 3 && elem->pairs == 1)
        sum_cells(4, 3, 1, elem, points, E, cells, D, material, ptr, slot, data);
    else
        sum_cells(n, dim, elem->pairs, elem, points, E, cells, D, material, ptr, slot, data);
}
