"""Stiffness ∫ ∇N_a·∇N_b of strings and membranes at unit tension on uniform grids."""

from __future__ import annotations

from functools import reduce

import numpy as np
from scipy.sparse import csc_array, diags_array, kron


def grid_stiffness(cells: tuple[int, ...], h: float = 1.0) -> csc_array:
    """Assemble K for linear (one direction) or bilinear elements (two directions).

    Node numbers vary fastest along the last direction.

    Parameters
    ----------
    cells : number of cells along each of one or two directions
    h : length of a cell in all directions; in two dimensions, K is independent of h

    """
    # stiffness of a tensor product grid: K ⊗ M + M ⊗ K
    K, M = zip(*(_along(n, h) for n in cells), strict=True)
    terms = (
        reduce(kron, [K[i] if i == j else M[i] for i in range(len(cells))])
        for j in range(len(cells))
    )
    return csc_array(sum(terms))


def _along(n: int, h: float) -> tuple[csc_array, csc_array]:
    """Return ∫N_a′N_b′ and ∫N_aN_b of a line of n linear elements of length h."""
    inside = np.ones(n)
    # number of cells adjacent to each node
    ends = np.r_[1.0, np.full(n - 1, 2.0), 1.0]
    K = diags_array([-inside, ends, -inside], offsets=[-1, 0, 1]) / h
    M = diags_array([inside, 2 * ends, inside], offsets=[-1, 0, 1]) * (h / 6)
    return csc_array(K), csc_array(M)
