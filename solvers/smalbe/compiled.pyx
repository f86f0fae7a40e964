# cython: language_level=3, boundscheck=False, wraparound=False, cdivision=True
# cython: initializedcheck=False
"""Compiled part of SMALBE: preparation, MPRGP, outer loop, recovery of the solution.

A single loop, written in terms of a few operations, solves all problems. The
operations run without Python if P is a matrix or a compiled linear map
(`mortarbench.harness.distributed.sparse`).

* operations.pxi: products with F, products with orthonormal rows
* coarse.pxi: sparse rows and the factor of GGᵀ
* feasible_set.pxi: steps to the boundary of the set, projections, φ and β
* model.pxi: the model of H, minimised over the set and inverted on a face
* preparation.pxi: orthonormal rows, Lanczos, the normalised problem
* incomplete.pxi: incomplete Cholesky factors of the free block of a sparse P
* approximate.pxi: sparse approximate inverses of the free block of a dense P
* stopping.pxi: the relative KKT residuals of the stopping test
* mprgp.pxi: the inner loop
* release.pxi: proportioning in the inner loop with an incomplete factor
* outer.pxi: the outer loop and the recovery of x and its multipliers

textbook.py contains the published algorithms in NumPy.

P is dense, sparse, a compiled linear map, or an operator called through Python. A sparse
P with few nonzero diagonals, such as a matrix on a grid, is stored by diagonals.
"""

cimport cython
cimport numpy as cnp
from cpython.exc cimport PyErr_CheckSignals
from libc.math cimport INFINITY, fabs, fmax, fmin, isfinite, isinf, sqrt
from libc.stdlib cimport calloc, free as release_memory, realloc
from libc.string cimport memcpy, memset
from scipy.linalg.cython_blas cimport dsymv
from scipy.linalg.cython_lapack cimport dgeqp3, dorgqr, dpotrf, dpotrs, dstev

from mortarbench.harness.distributed.sparse cimport BorderedFactor, CompressedRows, LinearMap

import numpy as np
from scipy.sparse import csr_array, issparse

from mortarbench.harness import Status
from mortarbench.harness.operators import linear_map
from mortarbench.solvers.smalbe.extension import Step

cnp.import_array()

cdef extern from "vectors.h" nogil:
    ctypedef struct sparse:
        Py_ssize_t n, count
        const int *indptr
        const int *indices
        const Py_ssize_t *offset
        const double *data
        const double *diagonals
    int MAX_DIAGONALS
    double STEP_ROUNDING
    Py_ssize_t find_diagonals(const sparse *F, Py_ssize_t most, Py_ssize_t *offset,
                              signed char *slot)
    void fill_diagonals(const sparse *F, const signed char *slot, double *diagonals)
    void sparse_product(const sparse *F, double s, const double *v, double *y)
    double dot(const double *a, const double *b, Py_ssize_t n)
    void add(double s, const double *a, double *b, Py_ssize_t n)
    void scale(double s, double *a, Py_ssize_t n)
    void copy_scaled(double s, const double *a, double *b, Py_ssize_t n)
    bint same(const double *a, const double *b, Py_ssize_t n)
    void rows_times(const double *U, const double *v, double *c, Py_ssize_t k,
                    Py_ssize_t n)
    void add_outer(double s, const double *U, Py_ssize_t n, double *S, Py_ssize_t k)
    void add_combination(double s, const double *U, const double *c, double *y,
                         Py_ssize_t k, Py_ssize_t n)
    void masked(const double *free, const double *a, double *t, Py_ssize_t n)
    void update_direction(const double *z, double gamma, double *p, Py_ssize_t n)
    double first_bound(const double *x, const double *p, const double *lower,
                       const double *upper, double least, Py_ssize_t n)
    void split(const double *x, const double *g, const double *lower,
               const double *upper, double tau, double *phi, double *free,
               Py_ssize_t n, double *result)
    void advance(double alpha, double *x, double *g, const double *p, const double *Hp,
                 const double *lower, const double *upper, double tau, double *phi,
                 double *free, Py_ssize_t n, double *result)
    void projected(const double *x, double alpha, const double *p, const double *lower,
                   const double *upper, double *y, Py_ssize_t n)
    void projected_gradient(const double *x, const double *g, const double *lower,
                            const double *upper, double *y, Py_ssize_t n)
    void model_minimiser(const double *x, const double *g, double tau,
                         const double *lower, const double *upper, double *s,
                         double *piece, Py_ssize_t n)
    void terms_of_test(const double *x, const double *Px, const double *q,
                       const double *r, const double *w, Py_ssize_t n, double *sums,
                       double *most)
    void solve_cholesky(const double *L, double *y, Py_ssize_t k)

cdef extern from "incomplete.h" nogil:
    int RUN
    ctypedef struct incomplete:
        Py_ssize_t n, count, runs, width
        const int *start
        const int *row
        const Py_ssize_t *pair
        const int *target
        const double *below
        const double *diagonal
        const Py_ssize_t *offset
        const int *between
        int *from_ "from"
        int *to
        double *L
        double *pivot
        double *inverse
        double *y
    void find_runs(incomplete *F, const double *free, Py_ssize_t most)
    bint factorise_incompletely(incomplete *F, const double *free, double keep,
                                double shift, double least)
    void solve_incompletely(const incomplete *F, double s, const double *v, double *z)

cdef extern from "approximate.h" nogil:
    int NEIGHBOURS
    ctypedef struct sparse_row:
        int count
        int *column
    void find_row(const double *F, const double *w, Py_ssize_t n, int i,
                  double *strength, sparse_row *row)
    void approximate_inverse(const sparse_row *G, const double *v, double *y,
                             Py_ssize_t n)
    double coupling(const double *F, const double *w, Py_ssize_t n,
                    const sparse_row *G, double *t)

include "operations.pxi"
include "coarse.pxi"
include "preparation.pxi"
include "feasible_set.pxi"
include "model.pxi"
include "incomplete.pxi"
include "approximate.pxi"
include "stopping.pxi"
include "mprgp.pxi"
include "release.pxi"
include "outer.pxi"
