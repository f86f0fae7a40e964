"""The vector operations of an MPRGP step."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from harness import Vector
from harness.distributed.vectors import inner_products, on_slices

Mask = NDArray[np.bool_]
ROUNDING = 4 * float(np.finfo(float).eps)  #: relative error of a few operations


def lengths(
    x: Vector, g: Vector, p: Vector, Hp: Vector, lower: Vector, upper: Vector
) -> tuple[float, float]:
    """Return of steps x − αp the minimising α, and the largest that is feasible.

    The first is inf along a direction without curvature.
    """
    curvature, slope, feasible = inner_products(
        (p, Hp), (g, p), least=_to_bounds(x, p, lower, upper)
    )
    return slope / curvature if curvature > 0 else np.inf, feasible


@on_slices
def _to_bounds(x: Vector, p: Vector, lower: Vector, upper: Vector) -> Vector:
    """Return, of components that move, the α at which they are on a bound."""
    moves = p != 0
    bound = np.where(p > 0, lower, upper)[moves]
    found: Vector = (x[moves] - bound) / p[moves]
    return found


@on_slices
def moved(
    x: Vector, g: Vector, alpha: float, p: Vector, Hp: Vector,
    lower: Vector, upper: Vector,
) -> tuple[Vector, Vector]:  # fmt: skip
    """Return x − αp and its gradient.

    What is beyond a bound, or nearer to it than rounding can tell, is on the bound: a
    step as far as it is feasible must not stop short of the face.
    """
    step = alpha * p
    new, noise = x - step, ROUNDING * (np.abs(x) + np.abs(step))
    down = (new - lower <= noise) & (step >= 0)
    up = (upper - new <= noise) & (step <= 0) & ~down
    return np.where(down, lower, np.where(up, upper, new)), g - alpha * Hp


def within(x: Vector, s: Vector, lower: Vector, upper: Vector) -> Vector:
    """Return x + s, in the box up to rounding, on the bounds that it reaches."""
    to, noise = x + s, ROUNDING * (np.abs(x) + np.abs(s))
    down, up = to - lower <= noise, upper - to <= noise
    return np.where(down, lower, np.where(up, upper, to))


def split(
    x: Vector, g: Vector, lower: Vector, upper: Vector
) -> tuple[Mask, Vector, Vector, float, float]:
    """Split the gradient: free components, φ, β, ‖φ‖², ‖β‖²."""
    free, phi, beta = _parted(x, g, lower, upper)
    phi_square, beta_square = inner_products((phi, phi), (beta, beta))
    return free, phi, beta, phi_square, beta_square


@on_slices
def _parted(
    x: Vector, g: Vector, lower: Vector, upper: Vector
) -> tuple[Mask, Vector, Vector]:
    at_lower, at_upper = x <= lower, x >= upper
    free = ~(at_lower | at_upper)
    leads_inside = ((g < 0) & ~at_upper) | ((g > 0) & ~at_lower)
    return free, np.where(free, g, 0.0), np.where(~free & leads_inside, g, 0.0)


@on_slices
def reduced(
    x: Vector, phi: Vector, alpha: float, lower: Vector, upper: Vector
) -> Vector:
    """Return φ̃: the free gradient, cut so that x − ᾱφ̃ is feasible."""
    cut: Vector = np.minimum(np.maximum(phi, (x - upper) / alpha), (x - lower) / alpha)
    return cut


def conjugate(z: Vector, p: Vector, Hp: Vector) -> Vector:
    """Return z − (zᵀHp / pᵀHp) p."""
    along, curvature = inner_products((z, Hp), (p, Hp))
    return z - along / curvature * p


@on_slices
def tilted_step(
    x: Vector, g: Vector, tau: float, lower: Vector, upper: Vector
) -> tuple[Vector, NDArray[np.int8]]:
    """Minimise gᵀs + τ/2‖s‖² over the box: s, and its piece.

    The piece is −1 where s ends at the lower bound, 1 at the upper, 0 between.
    """
    target = x - g / tau
    down = target <= lower
    up = (target >= upper) & ~down
    s = np.where(down, lower, np.where(up, upper, target)) - x
    return s, up.astype(np.int8) - down.astype(np.int8)
