# cython: language_level=3, boundscheck=False, wraparound=False, cdivision=True
"""Compiled loops of finite strain: tangents of cells, and their sum in a CSC matrix.

`tangents.pyi` has the types, `problems.fem.finite_strain` the mathematics.
"""

import numpy as np


def cell_tangents(
    const double[:, :, :, ::1] gradients,
    const double[:, ::1] volumes,
    const double[:, :, :, :, :, ::1] A,
):
    """Integrate  K_(ai)(bj) = Σ_q v_q ∂N_a/∂X_m A_imjn ∂N_b/∂X_n  of each cell.

    gradients (E, 4, 4, 2) of the shape functions at the quadrature points, volumes
    (E, 4) of these, A (E, 4, 2, 2, 2, 2) symmetric; returned: (E, 8, 8), exactly
    symmetric.
    """
    cdef Py_ssize_t e, q, a, b, i, j, m, row, column
    cdef double[2] left
    cdef double total
    blocks = np.zeros((volumes.shape[0], 8, 8))
    cdef double[:, :, ::1] K = blocks
    for e in range(volumes.shape[0]):
        for q in range(4):
            for a in range(4):
                for i in range(2):
                    row = 2 * a + i
                    for j in range(2):
                        for m in range(2):  # ∂N_a/∂X_m A_imjn, of both n
                            left[m] = volumes[e, q] * (
                                gradients[e, q, a, 0] * A[e, q, i, 0, j, m]
                                + gradients[e, q, a, 1] * A[e, q, i, 1, j, m]
                            )
                        for b in range(a, 4):
                            column = 2 * b + j
                            if column < row:
                                continue
                            K[e, row, column] += (
                                left[0] * gradients[e, q, b, 0]
                                + left[1] * gradients[e, q, b, 1]
                            )
        for row in range(8):
            for column in range(row):
                K[e, row, column] = K[e, column, row]
    return blocks


def add_tangents(
    const double[:, :, ::1] tangents,
    const int[:, ::1] cells,
    const int[::1] ptr,
    const int[:, :, ::1] slot,
):
    """Sum the tangents (E, 8, 8) of the cells (E, 4) into the values of a dof pattern.

    ptr, slot: as of `problems.fem.elasticity.Pattern`.
    """
    cdef Py_ssize_t e, i, j, k, l, node, row, at
    values = np.zeros(4 * ptr[ptr.shape[0] - 1])
    cdef double[::1] data = values
    for e in range(cells.shape[0]):
        for i in range(4):
            node = cells[e, i]
            row = 2 * (ptr[node + 1] - ptr[node])  # entries per component
            for j in range(4):
                at = 4 * ptr[node] + 2 * slot[e, i, j]
                for k in range(2):
                    for l in range(2):
                        data[at + k * row + l] += tangents[e, 2 * i + k, 2 * j + l]
    return values
