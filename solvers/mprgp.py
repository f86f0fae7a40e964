"""MPRGP: modified proportioning with reduced gradient projections.

Minimises ½xᵀHx − bᵀx over l ≤ x ≤ u (Dostál 2009, the paper's reference [3], Chapter 5;
Dostál and Schöberl 2005). With the gradient g = Hx − b, the free gradient φ (g where x
is off its bounds), the chopped gradient β (the part of g on the bounds that leads
inside) and the projected gradient g^P = φ + β, each step is one of

* c, conjugate gradient: minimise along p on the face, if that stays feasible
* e, expansion: x ← P(x − α_cg p), the CG step projected; one product more
* f, fallback, if e raised the cost: the CG step as far as it is feasible, then a
  gradient projection step of length ᾱ; two products more
* p, proportioning: minimise along −β, as far as feasible, to free components

Proportioning when  ‖β‖² > Γ² φ̃ᵀφ,  with the reduced free gradient φ̃ that no step of
length ᾱ takes beyond a bound.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from harness import Vector

Operator = Callable[[Vector], Vector]


class Face(NamedTuple):
    """The gradient split by the face on which x lies."""

    phi: Vector  #: free gradient
    beta: Vector  #: chopped gradient
    phi_reduced: Vector  #: free gradient cut so that x − ᾱφ̃ is feasible

    @property
    def projected_norm(self) -> float:
        """‖g^P‖₂, zero exactly at the minimiser."""
        return float(np.sqrt(self.phi @ self.phi + self.beta @ self.beta))


class Minimum(NamedTuple):
    """Where MPRGP stopped."""

    x: Vector
    g: Vector  #: Hx − b
    projected_norm: float  #: ‖g^P‖₂
    stopped: bool  #: by `stop`; False at the step limit, or if the cost is unbounded
    trace: str  #: one letter per step: c, e, f, p


def mprgp(
    H: Operator,
    b: Vector,
    bounds: tuple[Vector, Vector],
    start: tuple[Vector, Vector],
    *,
    alpha: float,
    stop: Callable[[Vector, float], bool],
    Gamma: float = 1.0,
    max_steps: int = 10_000,
) -> Minimum:
    """Minimise ½xᵀHx − bᵀx over l ≤ x ≤ u.

    Parameters
    ----------
    H : symmetric positive semidefinite (n, n) as a function v → Hv
    bounds : l and u (n,), possibly infinite
    start : a feasible x (n,) and its gradient Hx − b
    alpha : length ᾱ of a gradient projection step, in (0, 2/‖H‖)
    stop : says from x and ‖g^P‖₂ whether to stop; asked before every step
    Gamma : proportioning constant Γ > 0

    """
    lower, upper = bounds
    x, g = start
    face = split(x, g, lower, upper, alpha)
    p, trace = face.phi, ""
    while not stop(x, face.projected_norm):
        if len(trace) >= max_steps:
            return Minimum(x, g, face.projected_norm, False, trace)
        if face.beta @ face.beta > Gamma**2 * (face.phi_reduced @ face.phi):
            p = face.beta
            Hp = H(p)
            step = min(_cauchy(g, p, Hp), _feasible(x, p, lower, upper))
            if np.isinf(step):
                return Minimum(x, g, face.projected_norm, False, trace)
            x = np.clip(x - step * p, lower, upper)
            g = g - step * Hp
            face = split(x, g, lower, upper, alpha)
            p, trace = face.phi, trace + "p"
            continue
        Hp = H(p)
        cg, feasible = _cauchy(g, p, Hp), _feasible(x, p, lower, upper)
        if np.isinf(min(cg, feasible)):
            return Minimum(x, g, face.projected_norm, False, trace)
        if cg <= feasible:
            x = np.clip(x - cg * p, lower, upper)
            g = g - cg * Hp
            face = split(x, g, lower, upper, alpha)
            p = face.phi - (face.phi @ Hp) / (p @ Hp) * p
            trace += "c"
            continue
        x, g, letter = _expand(H, b, bounds, (x, g, p, Hp), (cg, feasible, alpha))
        face = split(x, g, lower, upper, alpha)
        p, trace = face.phi, trace + letter
    return Minimum(x, g, face.projected_norm, True, trace)


def _expand(
    H: Operator,
    b: Vector,
    bounds: tuple[Vector, Vector],
    state: tuple[Vector, Vector, Vector, Vector],
    lengths: tuple[float, float, float],
) -> tuple[Vector, Vector, str]:
    """Leave the face: the projected CG step, or where the cost grows the safe one."""
    x, g, p, Hp = state
    cg, feasible, alpha = lengths
    if np.isfinite(cg):
        trial = np.clip(x - cg * p, *bounds)
        g_trial = H(trial) - b
        if trial @ (g_trial - b) <= x @ (g - b):  # twice the costs
            return trial, g_trial, "e"
    x = np.clip(x - feasible * p, *bounds)
    g = g - feasible * Hp
    x = np.clip(x - alpha * split(x, g, *bounds, alpha).phi, *bounds)
    return x, H(x) - b, "f"


def split(x: Vector, g: Vector, lower: Vector, upper: Vector, alpha: float) -> Face:
    """Split the gradient at x into free, chopped and reduced free parts."""
    at_lower, at_upper = x <= lower, x >= upper
    phi = np.where(at_lower | at_upper, 0.0, g)
    beta = np.where(at_lower & ~at_upper, np.minimum(g, 0), 0.0)
    beta += np.where(at_upper & ~at_lower, np.maximum(g, 0), 0.0)
    reduced = np.clip(phi, (x - upper) / alpha, (x - lower) / alpha)
    return Face(phi, beta, reduced)


def _cauchy(g: Vector, p: Vector, Hp: Vector) -> float:
    """Length of the minimising step x − αp; inf along a direction without curvature."""
    curvature = float(p @ Hp)
    return float(g @ p) / curvature if curvature > 0 else np.inf


def _feasible(x: Vector, p: Vector, lower: Vector, upper: Vector) -> float:
    """Largest α for which x − αp stays within the bounds."""
    down, up = p > 0, p < 0
    to_lower = np.min((x[down] - lower[down]) / p[down], initial=np.inf)
    return float(np.min((x[up] - upper[up]) / p[up], initial=to_lower))
