"""The contact patch test: a uniform pressure must pass through a non-matching joint.

Two blocks of 1 m × ½ m lie on each other without a gap, with or without friction, each
on rollers at its left side, the lower one on rollers at its bottom; the pressure p acts
on the top. The exact solution is linear in each block, so bilinear elements contain it:

    σ_y = −p,  σ_x = τ_xy = 0      (plane strain: ε_y = −(1 − ν²)p/E, ε_x = ν(1 + ν)p/E)

A contact discretisation that reproduces it transfers constant pressures exactly (Taylor
and Papadopoulos 1991). Mortar methods do, node-to-segment contact in one pass does not:
its error in σ_y is of order one and does not vanish with the mesh size. Friction makes
no difference while the blocks are of one material. Contact alone holds the upper block
up, so that ``dual-bounds`` does not exist.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache
from typing import Any

import numpy as np

from harness import Case, Reference, Solution, Value
from problems.contact.bodies import (
    Bodies,
    ContactPair,
    assemble,
    clamped,
    floating,
    supported,
)
from problems.contact.friction import law_of
from problems.contact.linearise import linearisation
from problems.contact.results import quantities
from problems.duality.case_forms import contact_case
from problems.duality.stepping import single_load
from problems.fem.elasticity import Material
from problems.fem.mesh import Mesh, join, nodal_lengths, prefixed, rectangle
from problems.fem.stress import gauss_stress
from problems.feti.elastic import SubdividedBodies, posed_on, subdivide
from problems.feti.tearing import structured_bodies

LENGTH, HEIGHT = 1.0, 0.5  #: of each block, m
PRESSURE = 1e6  #: p, Pa
E_UPPER, NU = 10e6, 0.3  #: Pa


def two_blocks(form: str, params: Mapping[str, Value], reference: Reference) -> Case:
    """Emit the QP in one form."""
    p: Any = params
    bodies = model(params)
    laws = (law_of(params),)
    linearise = linearisation(bodies, p["contact"], p["basis"], laws)
    factorised = cache(lambda: floating(bodies))
    primal, friction = single_load(
        bodies, linearise, laws,
        factorise=factorised, reference=reference, iterate=p["iterate"],
    )  # fmt: skip
    return contact_case(
        bodies, primal, form,
        torn=posed_on(params, lambda: subdivided(bodies, params), primal, friction),
        floating=factorised, clamped=lambda: clamped(bodies),
        supported=lambda: supported(bodies),
        quantities=lambda s: quantities(bodies, primal, s, friction)
        | {"stress_error": stress_error(bodies, s)},
        friction=friction,
    )  # fmt: skip


def subdivided(bodies: Bodies, params: Mapping[str, Value]) -> SubdividedBodies:
    """Cut the blocks into subdomains of at most `feti` cells a side."""
    p: Any = params
    divisions = [_divisions(p[name]) for name in ("lower", "upper")]
    return subdivide(bodies, structured_bodies(divisions, p["feti"]))


def model(params: Mapping[str, Value]) -> Bodies:
    """Mesh and assemble the blocks, with `lower` and `upper` elements along x."""
    p: Any = params
    mesh, body = join((
        prefixed(_block(0.0, p["lower"]), "lower_"),
        prefixed(_block(HEIGHT, p["upper"]), "upper_"),
    ))  # fmt: skip
    sides = mesh.boundaries
    load = np.zeros(mesh.dofs)
    top = sides["upper_top"]
    load[2 * top + 1] = -PRESSURE * nodal_lengths(mesh.points[top])
    rollers = (2 * sides["lower_left"], 2 * sides["upper_left"])
    lower, upper = sides["lower_top"], sides["upper_bottom"]
    return assemble(
        mesh, body, names=("lower", "upper"),
        materials=(Material(p["ratio"] * E_UPPER, NU), Material(E_UPPER, NU)),
        plane=p["plane"], units=(LENGTH, PRESSURE * LENGTH),
        fixed=np.concatenate([*rollers, 2 * sides["lower_bottom"] + 1]), load=load,
        pairs=(ContactPair(lower, upper) if p["slave"] == "lower"
               else ContactPair(upper, lower),),
    )  # fmt: skip


def _divisions(n: int) -> tuple[int, int]:
    return n, -(-n // 2)


def _block(bottom: float, n: int) -> Mesh:
    return rectangle((0.0, bottom), (LENGTH, HEIGHT), _divisions(n))


def stress_error(bodies: Bodies, s: Solution) -> float:
    """Return the largest |σ_y + p|/p over all Gauss points."""
    stress = gauss_stress(bodies.mesh, bodies.D, s.x * bodies.length)
    return float(np.abs(stress[..., 1] + PRESSURE).max() / PRESSURE)
