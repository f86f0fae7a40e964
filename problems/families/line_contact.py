"""Exact line contact: Hertz's pressure, and Cattaneo and Mindlin's shear traction.

Two elastic bodies with parabolic profiles of relative curvature 1/R = 1/R₁ + 1/R₂ and
with 1/E* = Σ(1 − νᵢ²)/Eᵢ (plane stress: Σ1/Eᵢ) are in contact over |x| ≤ a under the
force P per thickness, with the pressure (Johnson 1985, "Contact mechanics", Section
4.2)

    p(x) = p₀√(1 − x²/a²),   a = √(4PR/(πE*)),   p₀ = 2P/(πa),   ∫px² dx = Pa²/4

If both bodies are of the same material, p causes no relative tangential displacement,
and a shear traction causes no relative normal displacement. Under a tangential force
Q < μP applied after P, the zone c ≤ |x| ≤ a slips and the zone |x| < c sticks (Cattaneo
1938; Mindlin 1949; Johnson, Section 7.2), with the shear traction

    q(x) = μp₀√(1 − x²/a²) − μp₀(c/a)√(1 − x²/c²),    c/a = √(1 − Q/μP)

where square roots of negative numbers count as zero.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mortarbench.harness import Vector


@dataclass(frozen=True)
class LineContact:
    """Hertz's solution for a force per thickness."""

    P: float  #: force per thickness, N/m
    R: float  #: relative radius, m
    E_star: float  #: contact modulus, Pa

    @property
    def a(self) -> float:
        """Half width of the contact, m."""
        return float(np.sqrt(4 * self.P * self.R / (np.pi * self.E_star)))

    @property
    def p0(self) -> float:
        """Peak pressure, Pa."""
        return 2 * self.P / (np.pi * self.a)

    def pressure(self, x: Vector) -> Vector:
        """Return p(x), Pa; zero outside the contact."""
        return self.p0 * _root(x / self.a)

    def force(self, x: Vector) -> Vector:
        """Return ∫p from −a to x, N/m."""
        return self.P * _share(x / self.a)


@dataclass(frozen=True)
class TangentialContact:
    """Cattaneo and Mindlin's solution for a tangential force Q applied after P."""

    normal: LineContact
    mu: float
    Q: float  #: tangential force in units of μP, between 0 and 1

    @property
    def semicircles(self) -> tuple[tuple[float, float], ...]:
        """Pairs (w, c), in units of μP and a, with q = μP Σ w·2/(πc)√(1 − x²/c²)."""
        stuck = 1 - self.Q  # (c/a)², also the force of the semicircle of half width c
        return (1.0, 1.0), (-stuck, np.sqrt(stuck))

    @property
    def c(self) -> float:
        """Half width of the stick zone, m."""
        return float(self.normal.a * np.sqrt(1 - self.Q))

    def traction(self, x: Vector) -> Vector:
        """Return q(x), Pa."""
        s, p0 = x / self.normal.a, self.mu * self.normal.p0
        return np.asarray(p0 * sum(w / c * _root(s / c) for w, c in self.semicircles))

    def stick_half_width(self, shear: float, pressure: float) -> float:
        """Return the half width c of the stick zone from moments of the tractions, m.

        ∫x²q = μPa²/4 (1 − (c/a)⁴)  and  ∫x²p = Pa²/4. The result is clipped to [0, a].

        shear, pressure : moments ∫x²q dx and ∫x²p dx, N·m
        """
        rest = 1 - shear / (self.mu * pressure)
        return float(self.normal.a * np.clip(rest, 0, 1) ** 0.25)


def _root(s: Vector) -> Vector:
    """Return √(1 − s²), or zero for |s| > 1."""
    return np.asarray(np.sqrt(np.maximum(1 - s**2, 0)))


def _share(s: Vector) -> Vector:
    """Return (2/π)∫√(1 − t²) dt from −1 to s, between 0 and 1."""
    s = np.clip(s, -1, 1)
    return np.asarray(0.5 + (s * np.sqrt(1 - s**2) + np.arcsin(s)) / np.pi)
