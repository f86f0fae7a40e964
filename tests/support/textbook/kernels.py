"""The vector operations of an MPRGP step.

Steps to bounds are evaluated only for components with finite bounds; many duals have
few of these.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import blas

from mortarbench.harness import Vector

Mask = NDArray[np.bool_]
ROUNDING = 4 * float(np.finfo(float).eps)  #: relative error of a few operations


def inner_products(
    *pairs: tuple[Vector, Vector], least: Vector | None = None
) -> tuple[float, ...]:
    """Return xᵀy of each pair; if `least` is given, append its least component.

    The least component of an empty vector is inf.
    """
    products = [float(x @ y) for x, y in pairs]
    return (*products, *([] if least is None else [float(least.min(initial=np.inf))]))


def lengths(
    x: Vector, g: Vector, p: Vector, Hp: Vector, lower: Vector, upper: Vector
) -> tuple[float, float]:
    """Return the minimising α and the largest feasible α of the step x − αp.

    The minimising α is inf along a direction without positive curvature.
    """
    curvature, slope, feasible = inner_products(
        (p, Hp), (g, p), least=_to_bounds(x, p, lower, upper)
    )
    return slope / curvature if curvature > 0 else np.inf, feasible


def _to_bounds(x: Vector, p: Vector, lower: Vector, upper: Vector) -> Vector:
    """Return the α at which each component that moves towards a bound reaches it."""
    bound = np.where(p > 0, lower, upper)
    at = np.flatnonzero(np.isfinite(bound) & (p != 0))
    found: Vector = (x[at] - bound[at]) / p[at]
    return found


def moved(
    x: Vector, g: Vector, alpha: float, p: Vector, Hp: Vector,
    lower: Vector, upper: Vector,
) -> tuple[Vector, Vector]:  # fmt: skip
    """Return x − αp and its gradient.

    Components that have moved beyond a bound, or to it within rounding error, are set
    to the bound. Otherwise the largest feasible step could end just before the face.
    """
    new = x - alpha * p
    at = np.flatnonzero((lower > -np.inf) | (upper < np.inf))
    step, to, low, high = alpha * p[at], new[at], lower[at], upper[at]
    noise = ROUNDING * (np.abs(x[at]) + np.abs(step))
    down = (to - low <= noise) & (step >= 0)
    up = (high - to <= noise) & (step <= 0) & ~down
    new[at] = np.where(down, low, np.where(up, high, to))
    return new, g - alpha * Hp


def within(x: Vector, s: Vector, lower: Vector, upper: Vector) -> Vector:
    """Return x + s, which is in the box up to rounding.

    Components beyond a bound, or within rounding error of it, are set to the bound.
    """
    to, noise = x + s, ROUNDING * (np.abs(x) + np.abs(s))
    down, up = to - lower <= noise, upper - to <= noise
    return np.where(down, lower, np.where(up, upper, to))


def split(
    x: Vector, g: Vector, lower: Vector, upper: Vector
) -> tuple[Mask, Vector, Vector, float, float]:
    """Return the mask of free components, φ, β, ‖φ‖² and ‖β‖²."""
    free, phi, beta = _parted(x, g, lower, upper)
    phi_square, beta_square = inner_products((phi, phi), (beta, beta))
    return free, phi, beta, phi_square, beta_square


def _parted(
    x: Vector, g: Vector, lower: Vector, upper: Vector
) -> tuple[Mask, Vector, Vector]:
    free = (x > lower) & (x < upper)
    held = np.flatnonzero(~free)
    at, leads = x[held], g[held]
    inside = ((leads < 0) & (at < upper[held])) | ((leads > 0) & (at > lower[held]))
    phi, beta = g.copy(), np.zeros_like(g)
    phi[held], beta[held] = 0.0, np.where(inside, leads, 0.0)
    return free, phi, beta


def reduced(
    x: Vector, phi: Vector, alpha: float, lower: Vector, upper: Vector
) -> Vector:
    """Return φ̃: the free gradient, reduced so that x − ᾱφ̃ is feasible."""
    cut: Vector = np.minimum(np.maximum(phi, (x - upper) / alpha), (x - lower) / alpha)
    return cut


def conjugate(z: Vector, p: Vector, Hp: Vector) -> Vector:
    """Return z − (zᵀHp / pᵀHp) p."""
    along, curvature = inner_products((z, Hp), (p, Hp))
    return less(z, (along / curvature,), p)


def less(v: Vector, shares: Sequence[float], *vectors: Vector) -> Vector:
    """Return v − Σ sᵢvᵢ."""
    found = v.copy()
    for share, one in zip(shares, vectors, strict=True):
        found = blas.daxpy(one, found, a=-share)  # in place
    return found


def scaled(s: float, v: Vector) -> Vector:
    """Return sv."""
    found: Vector = s * v
    return found


def tilted_step(
    x: Vector, g: Vector, tau: float, lower: Vector, upper: Vector
) -> tuple[Vector, NDArray[np.int8]]:
    """Return the minimiser s of gᵀs + τ/2‖s‖² over the box, and its piece.

    The piece is −1 where x + s is at the lower bound, 1 at the upper bound, and 0
    between the bounds.
    """
    target, piece = x - g / tau, np.zeros(x.size, dtype=np.int8)
    ends = np.flatnonzero((target <= lower) | (target >= upper))
    down = target[ends] <= lower[ends]
    target[ends] = np.where(down, lower[ends], upper[ends])
    piece[ends] = np.where(down, -1, 1)
    return target - x, piece


def weighted_difference(v: Vector, w: Vector, weights: Vector) -> Vector:
    """Return weightsᵢ·(vᵢ − wᵢ)."""
    found: Vector = v - w
    found *= weights
    return found


def combined(s: float, v: Vector, t: float, w: Vector) -> Vector:
    """Return sv + tw."""
    found: Vector = s * v
    found += w if t == 1 else t * w
    return found
