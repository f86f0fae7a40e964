"""Variational inequalities with bounds alone, from collections of test problems.

Each is min ½vᵀPv + qᵀv, l ≤ v ≤ u with a sparse P; unknowns and energies have no units.

* string: the first tutorial of PERMON, u″ = 30 on (0, 1) above a sine
* journal bearing and torsion: Averick, Carter, Moré and Xue 1992, "The MINPACK-2 test
  problem collection"; linear elements on the triangles that halve the cells of a
  uniform grid, coefficients by their mean over the corners
"""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy.sparse import csc_array, diags_array, eye_array, kron

from mortarbench.harness import QP, Case, Solution, Vector, no_rows

HALF_WIDTH = 10.0  #: b of the journal bearing's rectangle (0, 2π) × (0, 2b)


def string(n: int) -> Case:
    """Hang a string of n points on [0, 1] over the obstacle ½ sin(4πx − π/6) − 2.

    The first and the last are held at 0, each by an equation of its own.
    """
    h = 1 / (n - 1)
    inside = np.r_[0.0, np.ones(n - 2), 0.0]
    between = np.r_[0.0, -np.ones(n - 3), 0.0]
    P = diags_array([between, 1 + inside, between], offsets=[-1, 0, 1])
    obstacle = np.sin(4 * np.pi * h * np.arange(n) - np.pi / 6) / 2 - 2
    return _case(P, 30 * h**2 * inside, obstacle * inside, np.full(n, np.inf))


def journal_bearing(n: int, eccentricity: float) -> Case:
    """Find the pressure v ≥ 0 of the film in a journal bearing, n² inner nodes.

    v minimises ∫ ½(1 + ε cos ξ)³|∇v|² − ε sin ξ v over (0, 2π) × (0, 2b), v = 0 at the
    boundary. Node i + n·j is at the i-th ξ and the j-th height.
    """
    hx, hy = 2 * np.pi / (n + 1), 2 * HALF_WIDTH / (n + 1)
    xi = hx * np.arange(n + 2)
    film = (1 + eccentricity * np.cos(xi)) ** 3
    along = (film[:-1] + film[1:]) / 2 * hy / hx  # of edges between ξ_i and ξ_i+1
    across = (film[:-2] + 4 * film[1:-1] + film[2:]) / 6 * hx / hy
    X = diags_array(
        [-along[1:-1], along[:-1] + along[1:], -along[1:-1]], offsets=[-1, 0, 1]
    )
    P = kron(eye_array(n), X) + kron(_second_difference(n), diags_array(across))
    q = np.tile(-eccentricity * np.sin(xi[1:-1]) * hx * hy, n)
    return _case(P, q, np.zeros(n**2), np.full(n**2, np.inf))


def torsion(n: int, twist: float) -> Case:
    """Find the stress function of a twisted elastic-plastic bar, n² inner nodes.

    It minimises ∫ ½|∇v|² − c v over the unit square, v = 0 at the boundary, within the
    distance from the boundary on both sides; c is the twist per length. Plastic is
    where it reaches that.
    """
    h = 1 / (n + 1)
    near = h * np.minimum(np.arange(1, n + 1), np.arange(n, 0, -1))
    distance = np.minimum.outer(near, near).ravel()
    T, one = _second_difference(n), eye_array(n)
    q = np.full(n**2, -twist * h**2)
    return _case(kron(T, one) + kron(one, T), q, -distance, distance)


def _second_difference(n: int) -> Any:
    one = np.ones(n - 1)
    return diags_array([-one, np.full(n, 2.0), -one], offsets=[-1, 0, 1])


def _case(P: Any, q: Vector, lower: Vector, upper: Vector) -> Case:
    qp = QP(
        P=csc_array(P), q=q, A=no_rows(q.size), b=np.zeros(0),
        G=no_rows(q.size), h=np.zeros(0), lb=lower, ub=upper,
    )  # fmt: skip

    def quantities(s: Solution) -> dict[str, float]:
        at_bound = (s.x <= lower) | (s.x >= upper)
        return {
            "unknowns": q.size,
            "active": int(np.count_nonzero(at_bound)),
            "energy": qp.objective(s.x),
        }

    return Case(qp=qp, recover=lambda s: s.x, quantities=quantities)
