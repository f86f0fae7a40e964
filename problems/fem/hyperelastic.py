"""Hyperelastic materials in plane strain: energy, stress and tangent from F.

A material is defined by its strain energy W per reference area, a function of the
deformation gradient F = ∂x/∂X (plane strain: F₃₃ = 1). The energy is split into a shear
and a dilatational part,

    W(F) = w(F) + U(θ(F)),        P = ∂W/∂F  (first Piola-Kirchhoff),  A = ∂P/∂F

with a measure θ of the dilatation. The mean dilatation method requires this split, see
`problems.fem.finite_strain`. With the Lamé constants Λ, μ:

    neo-Hooke                 w = μ/2 (F:F − 2 − 2 ln J),    θ = J,     U = Λ/2 ln²θ
    St. Venant-Kirchhoff      w = μ E:E,   E = ½(FᵀF − I),   θ = tr E,  U = Λ/2 θ²

The neo-Hookean energy is taken from Bonet and Wood 2008, "Nonlinear Continuum Mechanics
for Finite Element Analysis", Section 6.4, with the invariant I₁ = F:F + 1 in plane
strain. At F = I both tangents are those of linear elasticity. The St. Venant-Kirchhoff
material softens under compression: if a uniaxial stretch decreases below 1/√3, the
magnitude of the nominal stress decreases as well. Its energy remains finite as J → 0.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import NamedTuple

import numpy as np

from mortarbench.problems.fem.elasticity import Material
from mortarbench.problems.fem.elements import Floats, determinant, inverse_transpose

_I = np.eye(2)
#: second derivative of J = det F: ε_ik ε_jl with the permutation symbol
_CURVATURE_OF_J = np.einsum("ik,jl->ijkl", [[0, 1], [-1, 0]], [[0, 1], [-1, 0]])


class Derivatives(NamedTuple):
    """Values and derivatives of a scalar function of F, at points (…)."""

    value: Floats  #: (…) values
    first: Floats  #: (…, 2, 2) first derivatives
    second: Floats  #: (…, 2, 2, 2, 2) second derivatives


@dataclass(frozen=True)
class Hyperelastic(ABC):
    """An isotropic hyperelastic material; F has the shape (…, 2, 2) throughout."""

    E: float  #: Young's modulus of small strains, Pa
    nu: float  #: Poisson's ratio of small strains

    @property
    def lame(self) -> float:
        """First Lamé constant Λ, Pa."""
        return self.E * self.nu / ((1 + self.nu) * (1 - 2 * self.nu))

    @property
    def shear_modulus(self) -> float:
        """Shear modulus μ, Pa."""
        return self.E / (2 * (1 + self.nu))

    @abstractmethod
    def shear(self, F: Floats) -> Derivatives:
        """Return w with its derivatives with respect to F, Pa."""

    @abstractmethod
    def dilatation(self, F: Floats) -> Derivatives:
        """Return the dilatation measure θ with its derivatives with respect to F."""

    @abstractmethod
    def volumetric(self, theta: Floats) -> tuple[Floats, Floats, Floats]:
        """Return U(θ), U′(θ) and U″(θ) (…), Pa."""

    @abstractmethod
    def thickness_rate(self, F: Floats) -> Floats:
        """Return ∂θ/∂F₃₃ (…) at F₃₃ = 1, where ∂w/∂F₃₃ = 0."""

    def energy(self, F: Floats) -> Floats:
        """Return W (…), Pa."""
        theta = self.dilatation(F).value
        return np.asarray(self.shear(F).value + self.volumetric(theta)[0])

    def stress(self, F: Floats) -> Floats:
        """Return P = ∂W/∂F (…, 2, 2), Pa: force per reference area."""
        theta = self.dilatation(F)
        slope = self.volumetric(theta.value)[1]
        return np.asarray(self.shear(F).first + slope[..., None, None] * theta.first)

    def tangent(self, F: Floats) -> Floats:
        """Return A = ∂P/∂F (…, 2, 2, 2, 2), Pa."""
        theta = self.dilatation(F)
        _, slope, curvature = (
            part[..., None, None, None, None] for part in self.volumetric(theta.value)
        )
        outer = np.einsum("...ij,...kl->...ijkl", theta.first, theta.first)
        return np.asarray(
            self.shear(F).second + slope * theta.second + curvature * outer
        )


class NeoHooke(Hyperelastic):
    """Compressible neo-Hookean material, W = μ/2 (I₁ − 3 − 2 ln J) + Λ/2 ln²J."""

    def shear(self, F: Floats) -> Derivatives:
        """Return w = μ/2 (F:F − 2 − 2 ln J) with its derivatives.

        For J ≤ 0, w is infinite or NaN.
        """
        mu, back = self.shear_modulus, inverse_transpose(F)
        with np.errstate(invalid="ignore", divide="ignore"):
            log_J = np.log(determinant(F))
        return Derivatives(
            mu * ((F**2).sum((-2, -1)) / 2 - 1 - log_J),
            mu * (F - back),  # ∂ ln J/∂F = F⁻ᵀ
            mu
            * (
                np.einsum("ik,jl->ijkl", _I, _I)
                + np.einsum("...il,...kj->...ijkl", back, back)
            ),
        )

    def dilatation(self, F: Floats) -> Derivatives:
        """Return θ = J with its derivatives."""
        J = determinant(F)
        return Derivatives(
            J,
            J[..., None, None] * inverse_transpose(F),
            np.broadcast_to(_CURVATURE_OF_J, (*J.shape, 2, 2, 2, 2)),
        )

    def volumetric(self, theta: Floats) -> tuple[Floats, Floats, Floats]:
        """Return U = Λ/2 ln²θ with its derivatives; infinite or NaN if θ ≤ 0."""
        with np.errstate(invalid="ignore", divide="ignore"):
            log = np.log(theta)
        return (
            self.lame / 2 * log**2,
            self.lame * log / theta,
            self.lame * (1 - log) / theta**2,
        )

    def thickness_rate(self, F: Floats) -> Floats:
        """Return ∂θ/∂F₃₃ = J (…)."""
        # det F = F₃₃ J₂ with the determinant J₂ of the in-plane part
        return determinant(F)


class StVenantKirchhoff(Hyperelastic):
    """St. Venant-Kirchhoff material, W = Λ/2 (tr E)² + μ E:E with E = ½(FᵀF − I)."""

    def shear(self, F: Floats) -> Derivatives:
        """Return w = μ E:E with its derivatives."""
        mu, E = self.shear_modulus, (np.swapaxes(F, -1, -2) @ F - _I) / 2
        return Derivatives(
            mu * (E**2).sum((-2, -1)),
            2 * mu * (F @ E),
            mu
            * (
                2 * np.einsum("ik,...jl->...ijkl", _I, E)
                + np.einsum("...il,...kj->...ijkl", F, F)
                + np.einsum("...ik,jl->...ijkl", F @ np.swapaxes(F, -1, -2), _I)
            ),
        )

    def dilatation(self, F: Floats) -> Derivatives:
        """Return θ = tr E with its derivatives."""
        theta = (F**2).sum((-2, -1)) / 2 - 1  # tr E = ½ F:F − 1 in 2D
        identity = np.einsum("ik,jl->ijkl", _I, _I)
        return Derivatives(
            theta, F, np.broadcast_to(identity, (*theta.shape, 2, 2, 2, 2))
        )

    def volumetric(self, theta: Floats) -> tuple[Floats, Floats, Floats]:
        """Return U = Λ/2 θ² with its derivatives."""
        lame = self.lame
        return lame / 2 * theta**2, lame * theta, np.full_like(theta, lame)

    def thickness_rate(self, F: Floats) -> Floats:
        """Return ∂θ/∂F₃₃ = 1 (…)."""
        # tr E = … + ½(F₃₃² − 1)
        return np.ones(F.shape[:-2])


#: mapping from the value of the key `material` to the class of the material
MATERIALS: Mapping[str, Callable[[float, float], Hyperelastic]] = MappingProxyType(
    {"neo-hooke": NeoHooke, "svk": StVenantKirchhoff}
)


def hyperelastic(name: str, linear: Material, unit: float = 1.0) -> Hyperelastic:
    """Return the material `name` of MATERIALS with the moduli of `linear`.

    unit : unit of stress, Pa, by which the moduli are divided
    """
    return MATERIALS[name](linear.E / unit, linear.nu)
