"""A quadratic model of the operator, minimised over a box without its products.

    B = τI + UᵀWU,    U (k, n) orthonormal rows, W = diag(w) > 0.

The rows of U are the directions in which H is large, with eigenvalues w + τ, and τ
replaces H on the orthogonal complement. If B ≥ H, then
f(x + s) ≤ f(x) + gᵀs + ½sᵀBs, and the minimiser of the right-hand side over the box is
a gradient projection step in the metric of B. Without U it is the ordinary step
x ← P(x − g/τ), whose length is limited by ‖H‖. With U, the length is limited only by
the rest of the spectrum. The product with H that each step needs also tests B ≥ H
along the step; if the inequality is violated, τ is raised.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from mortarbench.harness import Vector
from tests.support.textbook import kernels
from tests.support.textbook.kernels import Mask, inner_products

NEWTON_STEPS = 100
SEARCH_STEPS = 60


class BoxModel(Protocol):
    """A model of H with tail τ, which can be minimised over a box and on a face."""

    @property
    def tau(self) -> float: ...
    @property
    def has_directions(self) -> bool: ...
    def step(self, x: Vector, g: Vector, bounds: tuple[Vector, Vector]) -> Vector: ...
    def raised(self, s: Vector, sHs: float) -> BoxModel: ...
    def relaxed(self, factor: float) -> BoxModel: ...
    def inverse_in(self, free: Mask) -> Callable[[Vector], Vector]: ...


class Tilted(NamedTuple):
    """The minimiser s(y) for a multiplier y, on the evaluated components."""

    s: Vector  #: minimiser on the evaluated components
    piece: NDArray[np.int8]  #: bounds that x + s reaches: −1 lower, 1 upper, 0 none
    slope: Vector  #: gradient of the dual function with respect to y


@dataclass(frozen=True, eq=False)
class Model:
    """B = τI + Uᵀdiag(w)U."""

    tau: float
    U: NDArray[np.float64]  #: (k, n) orthonormal rows
    w: Vector  #: (k,) positive

    @classmethod
    def of_norm(cls, norm: float, n: int) -> Model:
        """Return B = norm·I, a model of H (n, n) with the given norm."""
        return cls(norm, np.zeros((0, n)), np.zeros(0))

    @property
    def has_directions(self) -> bool:
        """True if the model contains directions in addition to the norm of H."""
        return bool(len(self.U))

    def step(self, x: Vector, g: Vector, bounds: tuple[Vector, Vector]) -> Vector:
        """Return s = argmin gᵀs + ½sᵀBs subject to l ≤ x + s ≤ u.

        With y = WUs as multiplier, s(y) = P(x − (g + Uᵀy)/τ) − x, and y maximises a
        concave, piecewise quadratic function of k variables whose gradient is
        Us(y) − W⁻¹y: Newton's method with a line search ends on the right piece.
        """
        U, tau, w = self.U, self.tau, self.w
        root = np.sqrt(w)

        def at(y: Vector) -> Tilted:
            s, piece = kernels.tilted_step(x, g + y @ U, tau, *bounds)
            return Tilted(s, piece, U @ s - y / w)

        def newton(slope: Vector, free: Mask) -> Vector:
            core = _core(U[:, free], root, tau)
            return np.asarray(root * np.linalg.solve(core, root * slope) * tau)

        if not w.size:
            return kernels.tilted_step(x, g, tau, *bounds)[0]
        found = minimised(at, newton, w.size)
        if found is None:
            return Model.of_norm(tau + float(w.max()), x.size).step(x, g, bounds)
        return found[1].s

    def raised(self, s: Vector, sHs: float) -> Model:
        """Raise τ, at most tenfold, until sᵀBs ≥ sᵀHs, with constant w + τ."""
        Us = self.U @ s
        rest = float(s @ s - Us @ Us)
        missing = sHs - self.tau * float(s @ s) - float((self.w * Us) @ Us)
        tau = self.tau + missing / rest if rest > 0 else np.inf
        return self.with_tail(min(max(tau, self.tau), 10 * self.tau))

    def with_tail(self, tau: float) -> Model:
        """Return the model with a new τ.

        Directions whose sum w + τ exceeds the new τ keep this sum; others are dropped.
        """
        w = self.w + self.tau - tau
        return Model(tau, self.U[w > 0], w[w > 0])

    def relaxed(self, factor: float) -> Model:
        """Return the model with τ divided by a factor."""
        return Model(self.tau / factor, self.U, self.w)

    def core_in(self, free: Mask) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return U_F, zero off the face F, and N with B_FF⁻¹ = (I − U_FᵀNU_F)/τ.

        N = (τW⁻¹ + U_F U_Fᵀ)⁻¹ by Sherman, Morrison and Woodbury.
        """
        U_f, root = self.U * free, np.sqrt(self.w)
        return U_f, root[:, None] * np.linalg.inv(_core(U_f, root, self.tau)) * root

    def inverse_in(self, free: Mask) -> Callable[[Vector], Vector]:
        """Return v → B_FF⁻¹v_F, zero off the face F."""
        U_f, core = self.core_in(free)

        def apply(v: Vector) -> Vector:
            v = np.where(free, v, 0.0)
            return np.asarray(v - U_f.T @ (core @ (U_f @ v))) / self.tau

        return apply


def _core(U_f: NDArray[np.float64], root: Vector, tau: float) -> NDArray[np.float64]:
    """Return τI + W¹ᐟ²U_F U_FᵀW¹ᐟ², which is at least τI for any W."""
    S = root[:, None] * U_f
    return np.asarray(S @ S.T + tau * np.eye(root.size))


def minimised(
    at: Callable[[Vector], Tilted],
    newton: Callable[[Vector, Mask], Vector],
    k: int,
) -> tuple[Vector, Tilted] | None:
    """Maximise the dual function of k multipliers y; return None if this fails.

    at : function that returns s(y), at least on the components with bounds
    newton : function that returns the step dy for a slope and the free components
    """
    y: Vector = np.zeros(k)
    here = at(y)
    for _ in range(NEWTON_STEPS):
        dy = newton(here.slope, here.piece == 0)
        there = at(y + dy)
        first, last, same = inner_products(
            (here.slope, dy), (there.slope, dy), least=_equal(here.piece, there.piece)
        )
        if same:  # Newton's method is exact on one piece
            return y + dy, there
        t, here = _searched(at, y, dy, there, (first, last))
        y = y + t * dy
    return None


def _searched(
    at: Callable[[Vector], Tilted],
    y: Vector,
    dy: Vector,
    there: Tilted,
    slopes: tuple[float, float],
) -> tuple[float, Tilted]:
    """Search t ≤ 1 at which the slope is at most a tenth of the slope at t = 0.

    Return t and s(y + t dy).

    there : s(y + dy)
    slopes : slopes at t = 0 and at t = 1
    """
    first, slope = slopes
    low, high, at_low, at_high, t = 0.0, 1.0, first, slope, 1.0
    for _ in range(SEARCH_STEPS):
        if abs(slope) <= 0.1 * first or (slope > 0 and t == 1) or at_low <= at_high:
            break
        share = at_low / (at_low - at_high)  # regula falsi, limited away from the ends
        t = low + (high - low) * min(max(share, 0.05), 0.95)
        there = at(y + t * dy)
        slope = float(there.slope @ dy)
        if slope > 0:
            low, at_low = t, slope
        else:
            high, at_high = t, slope
    return t, there


def _equal(one: NDArray[np.int8], other: NDArray[np.int8]) -> Vector:
    """Return 1 where two pieces are equal, else 0."""
    return np.where(one == other, 1.0, 0.0)
