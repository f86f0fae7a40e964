"""The vector operations of one MPRGP step, fused and compiled.

In NumPy each step makes some thirty passes over vectors of a few hundred numbers, at a
microsecond of overhead each; here it makes four. What a step does is written in
`solvers.smalbe.mprgp`. Every function is plain Python, too: ``f.py_func``.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from harness import Vector

Mask = NDArray[np.bool_]
ROUNDING = 4 * float(np.finfo(float).eps)  #: relative error of a few operations


@njit(cache=True)
def lengths(
    x: Vector, g: Vector, p: Vector, Hp: Vector, lower: Vector, upper: Vector
) -> tuple[float, float]:
    """Return of steps x − αp the minimising α, and the largest that is feasible.

    The first is inf along a direction without curvature.
    """
    curvature, slope, feasible = 0.0, 0.0, np.inf
    for i in range(x.size):
        curvature += p[i] * Hp[i]
        slope += g[i] * p[i]
        if p[i] > 0:
            feasible = min(feasible, (x[i] - lower[i]) / p[i])
        elif p[i] < 0:
            feasible = min(feasible, (x[i] - upper[i]) / p[i])
    return slope / curvature if curvature > 0 else np.inf, feasible


@njit(cache=True)
def moved(
    x: Vector, g: Vector, alpha: float, p: Vector, Hp: Vector,
    lower: Vector, upper: Vector,
) -> tuple[Vector, Vector]:  # fmt: skip
    """Return x − αp and its gradient.

    What is beyond a bound, or nearer to it than rounding can tell, is on the bound: a
    step as far as it is feasible must not stop short of the face.
    """
    new_x, new_g = np.empty_like(x), np.empty_like(g)
    for i in range(x.size):
        step = alpha * p[i]
        new, noise = x[i] - step, ROUNDING * (abs(x[i]) + abs(step))
        if new - lower[i] <= noise and step >= 0:
            new = lower[i]
        elif upper[i] - new <= noise and step <= 0:
            new = upper[i]
        new_x[i] = new
        new_g[i] = g[i] - alpha * Hp[i]
    return new_x, new_g


@njit(cache=True)
def split(
    x: Vector, g: Vector, lower: Vector, upper: Vector
) -> tuple[Mask, Vector, Vector, float, float]:
    """Split the gradient: free components, φ, β, ‖φ‖², ‖β‖²."""
    free, phi, beta = np.empty(x.size, np.bool_), np.zeros_like(g), np.zeros_like(g)
    phi_square, beta_square = 0.0, 0.0
    for i in range(x.size):
        at_lower, at_upper = x[i] <= lower[i], x[i] >= upper[i]
        free[i] = not (at_lower or at_upper)
        if free[i]:
            phi[i] = g[i]
            phi_square += g[i] * g[i]
        elif (g[i] < 0 and not at_upper) or (g[i] > 0 and not at_lower):
            beta[i] = g[i]
            beta_square += g[i] * g[i]
    return free, phi, beta, phi_square, beta_square


@njit(cache=True)
def reduced(
    x: Vector, phi: Vector, alpha: float, lower: Vector, upper: Vector
) -> Vector:
    """Return φ̃: the free gradient, cut so that x − ᾱφ̃ is feasible."""
    cut = np.empty_like(phi)
    for i in range(x.size):
        cut[i] = min(max(phi[i], (x[i] - upper[i]) / alpha), (x[i] - lower[i]) / alpha)
    return cut


@njit(cache=True)
def conjugate(z: Vector, p: Vector, Hp: Vector) -> Vector:
    """Return z − (zᵀHp / pᵀHp) p."""
    zHp, pHp = 0.0, 0.0
    for i in range(z.size):
        zHp += z[i] * Hp[i]
        pHp += p[i] * Hp[i]
    return z - (zHp / pHp) * p


@njit(cache=True)
def tilted_step(
    x: Vector, g: Vector, tau: float, lower: Vector, upper: Vector
) -> tuple[Vector, NDArray[np.int8]]:
    """Minimise gᵀs + τ/2‖s‖² over the box: s, and its piece.

    The piece is −1 where s ends at the lower bound, 1 at the upper, 0 between.
    """
    s, piece = np.empty_like(x), np.zeros(x.size, np.int8)
    for i in range(x.size):
        target = x[i] - g[i] / tau
        if target <= lower[i]:
            target, piece[i] = lower[i], -1
        elif target >= upper[i]:
            target, piece[i] = upper[i], 1
        s[i] = target - x[i]
    return s, piece
