# cython: language_level=3, boundscheck=False, wraparound=False
"""Products of dense blocks with the columns of all subdomains of a class.

BLAS copies (packs) the block in every product, which takes a third of the time of a
product with two dozen columns. This module is compiled when the package is installed;
`blocks.pyi` declares its types.
"""

cdef extern from "blocks.h" nogil:
    void product(
        const double *M, Py_ssize_t n, const double *X, double *Y, Py_ssize_t columns
    )


def multiply(const double[:, ::1] M, const double[:, ::1] X, double[:, ::1] Y):
    """Store MX in Y (n, k), for a block M (n, n) and columns X (n, k).

    Raises
    ------
    ValueError
        If the shapes do not fit.

    """
    cdef Py_ssize_t n = M.shape[0]
    if not n == M.shape[1] == X.shape[0] == Y.shape[0] or X.shape[1] != Y.shape[1]:
        raise ValueError(f"({n}, {M.shape[1]}) times ({X.shape[0]}, {X.shape[1]})")
    if n and X.shape[1]:
        product(&M[0, 0], n, &X[0, 0], &Y[0, 0], X.shape[1])
