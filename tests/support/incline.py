"""Block that only friction keeps from sliding on an inclined plane (CGS-4)."""

from __future__ import annotations

import numpy as np

from mortarbench.harness import Case
from mortarbench.problems.contact.bodies import (
    Bodies,
    ContactPair,
    assemble,
)
from mortarbench.problems.contact.friction import FrictionLaw
from mortarbench.problems.contact.stepping import load_steps
from mortarbench.problems.duality.case_forms import case_of
from mortarbench.problems.duality.problem import (
    Choice,
    ContactProblem,
    keyed_linearisation,
)
from mortarbench.problems.fem.elasticity import Material
from mortarbench.problems.fem.mesh import join, prefixed, rectangle
from mortarbench.solvers.reference.solve import reference_solution

WEIGHT = 1e5  #: weight G of the block, N/m


def incline(ratio: float, slope: float = 0.1) -> Bodies:
    """Push a block of weight G up an incline by the horizontal force ratio·G.

    The incline is along the x axis. Only contact and friction support the block.
    """
    mesh, body = join((
        prefixed(rectangle((0.0, 0.0), (2.0, 0.5), (8, 2)), "base_"),
        prefixed(rectangle((0.5, 0.5), (1.0, 0.5), (5, 2)), "block_"),
    ))  # fmt: skip
    sides = mesh.boundaries
    cosine, sine = np.array([1.0, slope]) / np.hypot(1, slope)
    along, onto = ratio * cosine - sine, cosine + ratio * sine
    load = np.zeros((len(mesh.points), 2))
    of_block = np.unique(mesh.cells[body == 1])
    load[of_block] = np.array([along, -onto]) * WEIGHT / of_block.size
    held = sides["base_bottom"]
    return assemble(
        mesh, body, names=("base", "block"),
        materials=(Material(2e9, 0.3), Material(1e9, 0.3)), plane="strain",
        units=(1.0, WEIGHT), fixed=np.concatenate([2 * held, 2 * held + 1]),
        load=load.ravel(),
        pairs=(ContactPair(sides["block_bottom"], sides["base_top"]),),
    )  # fmt: skip


def block_on_incline(ratio: float, law: FrictionLaw, *, form: str = "dual") -> Case:
    """Return the case of the block with a friction law, in one form of the QP."""
    bodies = incline(ratio)
    problem = ContactProblem(
        bodies=bodies,
        linearise=keyed_linearisation("mortar", "dual"),
        stages=load_steps(1, 1, bodies.f, bodies.fixed, (law,)),
        initial_force=float(np.abs(bodies.f).sum()),
    )  # fmt: skip
    return case_of(problem, form, Choice(), reference_solution)
