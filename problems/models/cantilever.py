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
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
from scipy.optimize import brentq
from scipy.special import ellipe, ellipeinc, ellipk, ellipkinc

from mortarbench.harness import Case, Reference, Solution, Value, no_rows
from mortarbench.problems.contact.bodies import Bodies, assemble
from mortarbench.problems.contact.rows import ContactRows
from mortarbench.problems.duality.newton import Iteration, NewtonPath
from mortarbench.problems.duality.newton_case import newton_case, newton_path
from mortarbench.problems.fem.elasticity import Material
from mortarbench.problems.fem.mesh import (
    as_vectors,
    dofs_of,
    nodal_lengths,
    rectangle,
)

LENGTH = 1.0  #: length L, m
E = 10e6  #: modulus of rubber, Pa


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


def newton_step(form: str, params: Mapping[str, Value], reference: Reference) -> Case:
    """Return the case of one Newton iteration of a load step."""
    p: Any = params
    path = _path(
        p["slenderness"],
        p["load"],
        (p["nx"], p["ny"]),
        p["nu"],
        p["material"],
        p["steps"],
        reference,
    )
    exact = elastica(p["load"] * p["step"] / p["steps"])

    def results(at: Iteration, s: Solution) -> dict[str, Any]:
        """Compare the mean displacement of the end face, m, with the elastica."""
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

    return newton_case(path, form, p["step"], p["newton"], results)


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


@lru_cache(maxsize=4)
def _path(
    slenderness: float,
    load: float,
    cells: tuple[int, int],
    nu: float,
    material: str,
    steps: int,
    reference: Reference,
) -> NewtonPath:
    bodies = beam(slenderness, load, cells, nu)
    n = bodies.mesh.dofs
    none, place = np.zeros(0), np.zeros(0, dtype=np.int64)
    nothing = ContactRows(no_rows(n), none, no_rows(n), place, none, place, none, place)
    return newton_path(
        bodies, lambda u: nothing, {"material": material}, reference, steps
    )
