"""Variational inequalities with bound constraints only, from test collections.

Each problem is min ½vᵀPv + qᵀv, l ≤ v ≤ u with a sparse P; all data are dimensionless.

* string: the first tutorial of PERMON, u″ = 30 on (0, 1) above a sine-shaped obstacle
* journal bearing and torsion: Averick, Carter, Moré and Xue 1992, "The MINPACK-2 test
  problem collection". Elements are linear triangles, two per cell of a uniform grid;
  coefficients are averaged over the corners of a triangle
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Any, ClassVar

import numpy as np
from scipy.sparse import csc_array, diags_array, eye_array, kron

from mortarbench.harness import (
    QP,
    Case,
    Family,
    InputError,
    Reference,
    Solution,
    Vector,
)
from mortarbench.harness.keys import Range
from mortarbench.problems.keys import POSITIVE, check_memory

HALF_WIDTH = 10.0  #: half width b of the journal bearing's rectangle (0, 2π) × (0, 2b)


@dataclass(frozen=True, kw_only=True)
class String(Family):
    """A string over a sine-shaped obstacle: PERMON's first tutorial."""

    forms: ClassVar = ("primal",)

    n: Annotated[int, Range(3), "points"] = 100

    def __post_init__(self) -> None:
        """Check that the problem fits into memory."""
        super().__post_init__()
        check_memory(self.n)

    def build(self, form: str, reference: Reference) -> Case:
        """Return the problem of a string of n points over ½ sin(4πx − π/6) − 2.

        The string spans [0, 1]. Decoupled rows of P fix its end points at 0.
        """
        n = self.n
        h = 1 / (n - 1)
        inside = np.r_[0.0, np.ones(n - 2), 0.0]
        between = np.r_[0.0, -np.ones(n - 3), 0.0]
        P = diags_array([between, 1 + inside, between], offsets=[-1, 0, 1])
        obstacle = np.sin(4 * np.pi * h * np.arange(n) - np.pi / 6) / 2 - 2
        return bounded_case(
            P, 30 * h**2 * inside, obstacle * inside, np.full(n, np.inf)
        )


@dataclass(frozen=True, kw_only=True)
class JournalBearing(Family):
    """The non-negative pressure in a journal bearing: MINPACK-2."""

    forms: ClassVar = ("primal",)

    n: Annotated[int, Range(2), "inner nodes along each side"] = 50
    eccentricity: Annotated[float, POSITIVE, "of the shaft, below 1"] = 0.1

    def __post_init__(self) -> None:
        """Check the eccentricity (surfaces touch at 1) and the size."""
        super().__post_init__()
        if self.eccentricity >= 1:
            raise InputError(f"eccentricity={self.eccentricity} must be below 1")
        check_memory(self.n**2)

    def build(self, form: str, reference: Reference) -> Case:
        """Return the problem of the pressure v ≥ 0 with n² inner nodes.

        The pressure minimises ∫ ½(1 + ε cos ξ)³|∇v|² − ε sin ξ v over the rectangle
        (0, 2π) × (0, 2b), with v = 0 on the boundary. Node i + n·j has the i-th ξ and
        the j-th height.
        """
        n, eccentricity = self.n, self.eccentricity
        hx, hy = 2 * np.pi / (n + 1), 2 * HALF_WIDTH / (n + 1)
        xi = hx * np.arange(n + 2)
        film = (1 + eccentricity * np.cos(xi)) ** 3
        along = (film[:-1] + film[1:]) / 2 * hy / hx  # for edges between ξ_i and ξ_i+1
        across = (film[:-2] + 4 * film[1:-1] + film[2:]) / 6 * hx / hy
        X = diags_array(
            [-along[1:-1], along[:-1] + along[1:], -along[1:-1]], offsets=[-1, 0, 1]
        )
        P = kron(eye_array(n), X) + kron(_second_difference(n), diags_array(across))
        q = np.tile(-eccentricity * np.sin(xi[1:-1]) * hx * hy, n)
        return bounded_case(P, q, np.zeros(n**2), np.full(n**2, np.inf))


@dataclass(frozen=True, kw_only=True)
class Torsion(Family):
    """Elastic-plastic torsion of a square bar, with two-sided bounds: MINPACK-2."""

    forms: ClassVar = ("primal",)

    n: Annotated[int, Range(2), "inner nodes along each side"] = 50
    twist: Annotated[float, POSITIVE, "twist per length"] = 5.0

    def __post_init__(self) -> None:
        """Check that the problem fits into memory."""
        super().__post_init__()
        check_memory(self.n**2)

    def build(self, form: str, reference: Reference) -> Case:
        """Return the problem of the stress function v with n² inner nodes.

        The stress function minimises ∫ ½|∇v|² − c v over the unit square, with v = 0 on
        the boundary and |v| bounded by the distance from the boundary; c is the twist
        per length. The bar is plastic where |v| attains its bound.
        """
        n = self.n
        h = 1 / (n + 1)
        # distance to the nearer end of an interval; on a square, the smaller of two
        near = h * np.minimum(np.arange(1, n + 1), np.arange(n, 0, -1))
        distance = np.minimum.outer(near, near).ravel()
        T, one = _second_difference(n), eye_array(n)
        q = np.full(n**2, -self.twist * h**2)
        return bounded_case(kron(T, one) + kron(one, T), q, -distance, distance)


def _second_difference(n: int) -> Any:
    one = np.ones(n - 1)
    return diags_array([-one, np.full(n, 2.0), -one], offsets=[-1, 0, 1])


def bounded_case(P: Any, q: Vector, lower: Vector, upper: Vector) -> Case:
    """Return the case of  min ½vᵀPv + qᵀv,  lower ≤ v ≤ upper."""
    qp = QP(
        P=csc_array(P),
        q=q,
        lb=lower,
        ub=upper,
    )

    def quantities(s: Solution) -> dict[str, float]:
        at_bound = (s.x <= lower) | (s.x >= upper)
        return {
            "unknowns": q.size,
            "active": int(np.count_nonzero(at_bound)),
            "energy": qp.objective(s.x),
        }

    return Case(qp=qp, recover=lambda s: s.x, quantities=quantities)
