"""A cantilever under an end load at finite strain, compared with the elastica.

A beam of length L and thickness t = L/slenderness, clamped at its left end, carries the
dead load P per width at its right end, distributed uniformly over the end face. In the
slender limit, the beam is an inextensible elastica with the bending stiffness of plane
strain,

    EI θ″ = −P cos θ,    EI = E t³ / (12(1 − ν²)),    θ(0) = θ′(L) = 0,

where θ is the slope of the beam axis. The solution by elliptic integrals (Bisshopp and
Drucker 1945, Quarterly of Applied Mathematics 3, 272-275) depends only on PL²/EI, the
key `load`. The error of this model is of order (t/L)²: under small loads, shear
increases the deflection by the fraction 3/(5(1 − ν)) (t/L)², 0.2 % for L/t = 20 and
ν = 0.3.

Bilinear cells h_x × h_y cannot represent bending exactly. In linear elasticity the beam
is therefore too stiff by the fraction

    (1 − ν)/2 (h_x/t)²  (parasitic shear)  +  ν²/(1 − 2ν) (h_y/t)²  (constant ε_y)

whose terms are 0.55 % and 0.35 % for square cells, ν = 0.3 and t = 8h. With the default
`nx`, cells have h_x = h_y/2 to reduce the first term. With mean dilatation
(`problems.fem.finite_strain`) the second term is −ν(h_y/t)².
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Any, ClassVar, NamedTuple

import numpy as np
from scipy.optimize import brentq
from scipy.special import ellipe, ellipeinc, ellipk, ellipkinc

from mortarbench.harness import Case, Reference, Solution, no_rows
from mortarbench.harness.keys import DERIVED, Range
from mortarbench.problems.contact.bodies import Bodies, assemble
from mortarbench.problems.contact.rows import ContactRows
from mortarbench.problems.duality.newton import Iteration, NewtonPath
from mortarbench.problems.duality.newton_case import newton_path
from mortarbench.problems.families.contact import NewtonFamily
from mortarbench.problems.fem.elasticity import Material
from mortarbench.problems.fem.mesh import (
    as_vectors,
    dofs_of,
    nodal_lengths,
    rectangle,
)
from mortarbench.problems.keys import (
    MAX_SIZE,
    MaterialLaw,
    Newton,
    Step,
    Steps,
    check_memory,
)

LENGTH = 1.0  #: length L, m
E = 10e6  #: modulus of rubber, Pa
MIN_SLENDERNESS = 2.0  #: smallest ratio of length to thickness
#: smallest and largest PL²/EI; outside this range, the formula of the elastica loses
#: digits
MIN_LOAD, MAX_LOAD = 1e-3, 1e3
#: largest Poisson's ratio; closer to ½, the Cholesky factor of the tangent loses nearly
#: all digits
MAX_NU = 0.4999


@dataclass(frozen=True, kw_only=True)
class Cantilever(NewtonFamily):
    """A slender cantilever under an end load at finite strain: the elastica."""

    forms: ClassVar = ("primal", "dual")

    slenderness: Annotated[
        float, Range(MIN_SLENDERNESS, MAX_SIZE), "ratio of length to thickness"
    ] = 20.0
    load: Annotated[float, Range(MIN_LOAD, MAX_LOAD), "PL²/EI"] = 1.0
    nx: Annotated[
        int, Range(1), "cells along the length; default: 2·ny·slenderness"
    ] = DERIVED
    ny: Annotated[int, Range(1), "cells across the thickness"] = 10
    nu: Annotated[float, Range(0, MAX_NU), "Poisson's ratio"] = 0.3
    material: MaterialLaw = "neo-hooke"
    steps: Steps = 1
    step: Step = DERIVED
    newton: Newton = 0

    def __post_init__(self) -> None:
        """Derive `nx` and `step`; check that the mesh fits into memory."""
        # limit the number before rounding it, because slenderness may be up to 1e30
        cells = min(max(2 * self.ny * self.slenderness, 1), 1e9)
        self.derive(nx=round(cells), step=self.steps)
        super().__post_init__()
        check_memory(2 * (self.nx + 1) * (self.ny + 1))

    def build(self, form: str, reference: Reference) -> Case:
        """Return the case of one Newton iteration of a load step."""
        return self.newton_case(form, reference)

    def newton_path(self, reference: Reference) -> NewtonPath:
        """Return the path of Newton iterations."""
        bodies = beam(self.slenderness, self.load, (self.nx, self.ny), self.nu)
        n = bodies.mesh.dofs
        none, at = np.zeros(0), np.zeros(0, dtype=np.int64)
        nothing = ContactRows(no_rows(n), none, no_rows(n), at, none, at, none, at)
        return newton_path(
            bodies,
            lambda u: nothing,
            reference,
            material=self.material,
            steps=self.steps,
        )

    def newton_results(
        self, path: NewtonPath, at: Iteration, s: Solution
    ) -> Mapping[str, Any]:
        """Compare the mean displacement of the end face, m, with the elastica."""
        exact = elastica(self.load * self.step / self.steps)
        end = at.tangent.mesh.boundaries["right"]
        # mean over the face, with the weights ∫N_j of the nodes
        share = nodal_lengths(at.tangent.mesh.points[end])
        u = share @ as_vectors(s.x, 2)[end] / share.sum() * LENGTH
        return {
            "tip": u.tolist(),
            "deflection": -u[1] / LENGTH,
            "deflection_error": -u[1] / LENGTH / exact.deflection - 1,
            "shortening": -u[0] / LENGTH,
            "shortening_error": -u[0] / LENGTH / exact.shortening - 1,
        }


class Elastica(NamedTuple):
    """Displacement of the loaded end of the elastica."""

    deflection: float  #: deflection w/L in the direction of the load
    shortening: float  #: displacement u/L towards the clamp


def elastica(load: float) -> Elastica:
    """Return the end displacement of a cantilever under the end load PL²/EI = `load`.

    With the slope θ₀ of the end, k² = ½(1 + sin θ₀), sin φ = 1/(k√2), and the elliptic
    integrals K, F (first kind) and E (second kind):

        √load = K(k) − F(φ, k),    w/L = 1 − 2(E(k) − E(φ, k))/√load,
        1 − u/L = √(2 sin θ₀/load).
    """

    def modulus(slope: float) -> tuple[float, float]:
        m = (1 + np.sin(slope)) / 2
        return m, float(np.arcsin(1 / np.sqrt(2 * m)))

    def residual(slope: float) -> float:
        m, phi = modulus(slope)
        return float(ellipk(m) - ellipkinc(phi, m) - np.sqrt(load))

    # θ₀ → π/2 only for infinite loads, where K(k) is infinite
    slope = brentq(residual, 0.0, np.pi / 2 * (1 - 1e-15), xtol=1e-15)
    m, phi = modulus(slope)
    return Elastica(
        1 - 2 * float(ellipe(m) - ellipeinc(phi, m)) / float(np.sqrt(load)),
        1 - float(np.sqrt(2 * np.sin(slope) / load)),
    )


def beam(slenderness: float, load: float, cells: tuple[int, int], nu: float) -> Bodies:
    """Assemble the beam of nx × ny cells, clamped on the left, under its full load."""
    t = LENGTH / slenderness
    # P = load·EI/L² with EI = E t³/(12(1 − ν²))
    P = load * E * t**3 / (12 * (1 - nu**2)) / LENGTH**2
    mesh = rectangle((0.0, -t / 2), (LENGTH, t), cells)
    end = mesh.boundaries["right"]
    share = nodal_lengths(mesh.points[end])
    force = np.zeros(mesh.dofs)
    force[dofs_of(end, 2, 1)] = -P * share / share.sum()
    return assemble(
        mesh,
        np.zeros(len(mesh.cells), dtype=np.int64),
        names=("beam",),
        materials=(Material(E, nu),),
        plane="strain",
        units=(LENGTH, P),
        fixed=dofs_of(mesh.boundaries["left"], 2),
        load=force,
        pairs=(),
    )
