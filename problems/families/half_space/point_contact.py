"""Exact contact of two spheres: Hertz's pressure, Cattaneo and Mindlin's shear.

Two elastic bodies with paraboloids of relative curvature 1/R = 1/R₁ + 1/R₂, and with
1/E* = Σ(1 − νᵢ²)/Eᵢ, touch on a disc of radius a under the force P, with the pressure
and the approach of distant points (Johnson 1985, "Contact mechanics", Section 4.2)

    p(r) = p₀√(1 − r²/a²),   a³ = 3PR/4E*,   p₀ = 3P/2πa²,   δ_n = a²/R

If both bodies are of the same material and a tangential force Q < μP is applied after
P, the annulus c ≤ r ≤ a slips and the disc r < c sticks (Cattaneo 1938; Mindlin 1949;
Johnson, Section 7.2), with the shear traction and the displacement

    q(r) = μp₀√(1 − r²/a²) − μp₀(c/a)√(1 − r²/c²),   c/a = (1 − Q/μP)^⅓
    δ = 3μP(2 − ν)/(8Ga)·(1 − (c/a)²)

where square roots of negative numbers count as zero, q acts along Q, and δ is the
tangential displacement of distant points. The solution is exact for ν = 0. For ν > 0
the slip is not exactly parallel to q; the theory neglects the small transverse
tractions that would make it parallel.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mortarbench.harness import Vector


@dataclass(frozen=True)
class PointContact:
    """Hertz's solution for a normal force P."""

    P: float  #: normal force, N
    R: float  #: relative radius, m
    E_star: float  #: contact modulus, Pa

    @property
    def a(self) -> float:
        """Radius of the contact, m."""
        return float(np.cbrt(0.75 * self.P * self.R / self.E_star))

    @property
    def p0(self) -> float:
        """Peak pressure, Pa."""
        return float(1.5 * self.P / (np.pi * self.a**2))

    @property
    def approach(self) -> float:
        """Approach of distant points, m."""
        return self.a**2 / self.R

    def pressure(self, r: Vector) -> Vector:
        """Return p(r), Pa; zero outside the contact."""
        return self.p0 * _root(r / self.a)


@dataclass(frozen=True)
class ShearedPointContact:
    """Cattaneo and Mindlin's solution for a tangential force Q applied after P."""

    normal: PointContact
    mu: float
    nu: float
    Q: float  #: tangential force in units of μP, below 1

    @property
    def G(self) -> float:
        """Shear modulus of both bodies, G = (1 − ν)E*, Pa."""
        return self.normal.E_star * (1 - self.nu)

    @property
    def c(self) -> float:
        """Radius of the stick zone, m."""
        return float(self.normal.a * np.cbrt(1 - self.Q))

    @property
    def displacement(self) -> float:
        """Tangential displacement δ of distant points, m."""
        limit = 3 * self.mu * self.normal.P * (2 - self.nu) / (8 * self.G)
        return float(limit / self.normal.a * (1 - (self.c / self.normal.a) ** 2))

    def traction(self, r: Vector) -> Vector:
        """Return q(r), Pa."""
        a, c, limit = self.normal.a, self.c, self.mu * self.normal.p0
        return limit * (_root(r / a) - c / a * _root(r / c))


def _root(s: Vector) -> Vector:
    """Return √(1 − s²), or zero for |s| > 1."""
    return np.asarray(np.sqrt(np.maximum(1 - s**2, 0)))
