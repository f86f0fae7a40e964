# cython: language_level=3, boundscheck=False, wraparound=False, cdivision=True
"""Products of dense blocks with the columns of all subdomains of a class.

BLAS copies (packs) the block in every product. With two dozen columns, the copy takes a
third of the time of a product. This module avoids the copy. The module is compiled when
the package is installed; `blocks.pyi` declares its types.
"""

from libc.stdlib cimport calloc, free
from libc.string cimport memset
from scipy.linalg.cython_blas cimport dspmv

from mortarbench.harness.distributed.sparse cimport LinearMap

import numpy as np

cdef extern from "blocks.h" nogil:
    void product(
        const double *M, Py_ssize_t rows, Py_ssize_t n, const double *X, double *Y,
        Py_ssize_t columns
    )

ctypedef struct block:
    Py_ssize_t rows, n, members
    const double *entries  # NULL if the block is empty or an object with `@`
    bint is_triangle


cdef class BlockDiagonal(LinearMap):
    """Block diagonal map of packed vectors; block M_g (r_g, n_g) acts on S_g subdomains.

    The entries of a vector for one block form a matrix (n_g, S_g), stored by rows; the
    block maps it to a matrix (r_g, S_g).

    blocks : for each g an array (r_g, n_g) or a square object with `@`. If S_g = 1, a
        symmetric block may be replaced by its upper triangle (n_g (n_g + 1)/2,),
        stored by columns
    sizes : n_g for each g
    members : S_g for each g

    Raises
    ------
    ValueError
        If the shape of an array does not match its size and number of members.

    """

    cdef list blocks
    cdef Py_ssize_t count
    cdef block *at  # (count,)

    def __init__(self, blocks, sizes, members):
        cdef Py_ssize_t i
        cdef const double[::1] entries
        self.blocks, self.count = list(blocks), len(blocks)
        self.at = <block *> calloc(max(self.count, 1), sizeof(block))
        if not self.at:
            raise MemoryError
        for i in range(self.count):
            n, w, M = int(sizes[i]), int(members[i]), self.blocks[i]
            is_array = isinstance(M, np.ndarray)
            rows = M.shape[0] if is_array and M.ndim == 2 else n
            self.at[i].rows, self.at[i].n, self.at[i].members = rows, n, w
            self.n += rows * w
            self.k += n * w
            if not is_array:
                continue
            self.at[i].is_triangle = M.ndim == 1
            fits = M.shape == ((rows, n) if M.ndim == 2 else (n * (n + 1) // 2,))
            if not fits or (M.ndim == 1 and w != 1):
                raise ValueError(f"a block {M.shape} cannot multiply a ({n}, {w}) array")
            self.blocks[i] = np.ascontiguousarray(M, dtype=np.float64)
            entries = self.blocks[i].reshape(-1)
            self.at[i].entries = &entries[0] if entries.shape[0] else NULL
        self.shape = self.n, self.k

    def __dealloc__(self):
        free(self.at)

    cdef int apply(self, const double *x, double *y, Py_ssize_t columns) except -1:
        cdef Py_ssize_t i, c, rows, n, w
        cdef int size, step = <int> columns
        cdef double one = 1.0, zero = 0.0
        for i in range(self.count):
            rows, n, w = self.at[i].rows, self.at[i].n, self.at[i].members * columns
            if not rows * n * w:
                memset(y, 0, rows * w * sizeof(double))
            elif not self.at[i].entries:
                X = np.asarray(<double[:n, :w]> <double *> x)
                Y = np.asarray(<double[:n, :w]> y)
                Y[:] = self.blocks[i] @ X
            elif self.at[i].is_triangle:
                size = <int> n
                for c in range(columns):
                    dspmv(b"U", &size, &one, <double *> self.at[i].entries,
                          <double *> x + c, &step, &zero, y + c, &step)
            else:
                product(self.at[i].entries, rows, n, x, y, w)
            x += n * w
            y += rows * w
        return 0
