/* Product of a dense block with the columns of all subdomains of a class.

   GCC 12 or newer on x86-64 Linux compiles the product twice, for processors with AVX2 and
   FMA and for all others, and the loader selects one of the two versions when the module
   is imported. Elsewhere there is one version. */

#include <string.h>

#if defined(__x86_64__) && defined(__gnu_linux__) && !defined(__clang__) && __GNUC__ >= 12
#define TWICE __attribute__((target_clones("arch=x86-64-v3", "default")))
#else
#define TWICE
#endif

#define INLINE static inline __attribute__((always_inline))

typedef const double *restrict in;
typedef double *restrict out;
typedef double __attribute__((vector_size(32), aligned(8), may_alias)) four;
#define FOUR(a) (*(four *) (a))

enum {
    ROWS = 4,   /* rows of M per tile */
    WIDTH = 12, /* columns of X per tile: 12 vector sums, 3 vectors of X and 1 of M fill the
                   16 registers */
    LINE = 8,   /* doubles in a cache line */
    DEPTH = 256 /* rows of X per pass: DEPTH * WIDTH doubles (24 KiB) fit the L1 cache */
};

/* Y += M X for `rows` rows of M (ROWS or 1) and `some` columns. Each row of the packed X
   consists of w <= 3 vectors of four columns, padded with zeros: some <= 4w. */
INLINE void
add_tile(in M, Py_ssize_t stride, in X, Py_ssize_t depth, int rows, int w, out Y,
         Py_ssize_t columns, Py_ssize_t some)
{
    four sum[ROWS][WIDTH / 4] = {0};
    for (Py_ssize_t begin = 0; begin < depth; begin += LINE) {
        Py_ssize_t end = begin + LINE < depth ? begin + LINE : depth;
        for (int r = 0; r < rows; r++) /* prefetch the next rows of M from the outer caches */
            __builtin_prefetch(M + (rows + r) * stride + begin);
        for (Py_ssize_t k = begin; k < end; k++)
            for (int r = 0; r < rows; r++) {
                double m = M[r * stride + k];
                for (int c = 0; c < w; c++)
                    sum[r][c] += m * FOUR((double *) X + 4 * (w * k + c));
            }
    }
    for (int r = 0; r < rows; r++)
        if (some == 4 * w)
            for (int c = 0; c < w; c++)
                FOUR(Y + r * columns + 4 * c) += sum[r][c];
        else
            for (Py_ssize_t c = 0; c < some; c++)
                Y[r * columns + c] += sum[r][c / 4][c % 4];
}

/* Y += M X for all rows of M (rows, depth), which are n doubles apart; `X`, `w` and `some`
   as in add_tile. */
INLINE void
add_strip(in M, Py_ssize_t rows, Py_ssize_t n, in X, Py_ssize_t depth, int w, out Y,
          Py_ssize_t columns, Py_ssize_t some)
{
    Py_ssize_t i = 0;
    for (; i + ROWS <= rows; i += ROWS)
        add_tile(M + i * n, n, X, depth, ROWS, w, Y + i * columns, columns, some);
    for (; i < rows; i++)
        add_tile(M + i * n, n, X, depth, 1, w, Y + i * columns, columns, some);
}

/* Y = M X with M (rows, n), X (n, columns) and Y (rows, columns), all row-major. */
TWICE static void
product(in M, Py_ssize_t rows, Py_ssize_t n, in X, out Y, Py_ssize_t columns)
{
    double packed[DEPTH * WIDTH];
    memset(Y, 0, rows * columns * sizeof(double));
    for (Py_ssize_t first = 0; first < columns; first += WIDTH) {
        Py_ssize_t some = columns - first < WIDTH ? columns - first : WIDTH;
        Py_ssize_t w = (some + 3) / 4;
        for (Py_ssize_t begin = 0; begin < n; begin += DEPTH) {
            Py_ssize_t depth = n - begin < DEPTH ? n - begin : DEPTH;
            for (Py_ssize_t k = 0; k < depth; k++) {
                in x = X + (begin + k) * columns + first;
                if (some == WIDTH)
                    memcpy(packed + WIDTH * k, x, sizeof(double[WIDTH]));
                else
                    for (Py_ssize_t c = 0; c < 4 * w; c++)
                        packed[4 * w * k + c] = c < some ? x[c] : 0.0;
            }
            if (w == 3)
                add_strip(M + begin, rows, n, packed, depth, 3, Y + first, columns,
                          some);
            else if (w == 2)
                add_strip(M + begin, rows, n, packed, depth, 2, Y + first, columns,
                          some);
            else
                add_strip(M + begin, rows, n, packed, depth, 1, Y + first, columns,
                          some);
        }
    }
}
