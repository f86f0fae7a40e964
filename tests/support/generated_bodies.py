"""Random contact problems, determined by a seed.

The bodies are towers of blocks on a base, beams on pillars, or discs between plates.
There are one to four contacts, some with gaps, and some bodies are supported only by
contact. Moduli differ by up to six orders of magnitude. The contact rows are
node-to-segment or mortar with either basis, and either side is the slave. The loads
press the bodies together, so that every problem has a solution.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from mortarbench.harness import Case
from mortarbench.problems.contact.bodies import (
    ContactPair,
    assemble,
)
from mortarbench.problems.contact.linearise import linearisation
from mortarbench.problems.contact.results import quantities
from mortarbench.problems.duality.case_forms import contact_case
from mortarbench.problems.duality.monolithic import primal_qp
from mortarbench.problems.fem.elasticity import Material
from mortarbench.problems.fem.mesh import (
    Mesh,
    Nodes,
    join,
    nodal_lengths,
    prefixed,
    rectangle,
)
from tests.support.supported_by_contact import disc_between_plates

PRESSURE = 1e7  #: mean pressure of the loads, Pa
METHODS = (("nts", "dual"), ("mortar", "dual"), ("mortar", "standard"))


def generated_case(seed: int) -> Case:
    """Draw the problem of a seed: successive seeds give a tower, pillars and a disc."""
    rng = np.random.default_rng(seed)
    contact, basis = METHODS[rng.integers(3)]
    make = (_tower, _pillars, _disc)[seed % 3]
    return make(rng, contact, basis)


def _tower(rng: np.random.Generator, contact: str, basis: str) -> Case:
    """Stack one to three blocks on a base; only the base is supported.

    The faces are flat, or they are crowned and the load is central. With an eccentric
    load on crowned faces, the blocks would roll off.
    """
    crown, tilt = (0.01, 0.0) if rng.random() < 0.5 else (0.0, 0.5)
    parts = [_block(rng, (-1.5, -1.0), (3.0, 1.0), crown)]
    for _ in range(rng.integers(1, 4)):
        below = parts[-1].points
        width = rng.uniform(0.4, 1.0) * np.ptp(below[:, 0])
        left = below[:, 0].mean() - width / 2
        corner = (left, below[:, 1].max())
        parts.append(_block(rng, corner, (width, rng.uniform(0.3, 1.0)), crown))
    pairs = [((k + 1, "bottom"), (k, "top")) for k in range(len(parts) - 1)]
    held = [(0, "bottom", "xy")]
    return _case(rng, parts, pairs, held, tilt=tilt, method=(contact, basis))


def _pillars(rng: np.random.Generator, contact: str, basis: str) -> Case:
    """Lay a beam, clamped or guided at its left end, on two to four pillars."""
    count = int(rng.integers(2, 5))
    beam = _block(rng, (0.0, 0.0), (3.0, rng.uniform(0.1, 0.5)), 0.01, least=3 * count)
    pillars = [
        _block(rng, (3 * (k + 0.3) / count, -1.0), (1.2 / count, 1.0), 0.01)
        for k in range(count)
    ]
    pairs = [((k + 1, "top"), (0, "bottom")) for k in range(count)]
    held = [(k + 1, "bottom", "xy") for k in range(count)]
    held.append((0, "left", "xy" if rng.random() < 0.5 else "x"))
    return _case(rng, [beam, *pillars], pairs, held, method=(contact, basis))


def _disc(rng: np.random.Generator, contact: str, basis: str) -> Case:
    """Press a disc between two plates, one of which is clamped or on rollers."""
    lower, disc, upper = 10 ** rng.uniform(8, 12, 3)
    return disc_between_plates(
        int(rng.integers(4, 12)), form="dual", contact=contact, basis=basis,
        disc_is_slave=bool(rng.random() < 0.5), rollers=bool(rng.random() < 0.5),
        turn=rng.uniform(0, 0.7), tilt=rng.uniform(0, 1.5), E=(lower, disc, upper),
    )  # fmt: skip


def _block(
    rng: np.random.Generator,
    corner: tuple[float, float],
    size: tuple[float, float],
    most: float,
    *,
    least: int = 3,
) -> Mesh:
    """Mesh a rectangle; crown top and bottom by at most `most` times its height."""
    divisions = int(rng.integers(least, least + 15)), int(rng.integers(2, 8))
    flat = rectangle(corner, size, divisions)
    x, y = ((flat.points - corner) / size).T
    crown = most * rng.random() * size[1] * (2 * x - 1) ** 2 * (2 * y - 1)
    points = flat.points - np.stack([np.zeros_like(crown), crown], axis=1)
    return Mesh(points, flat.cells, flat.boundaries)


def _case(
    rng: np.random.Generator,
    parts: list[Mesh],
    pairs: list[tuple[tuple[int, str], tuple[int, str]]],
    held: list[tuple[int, str, str]],
    *,
    tilt: float = 0.5,
    method: tuple[str, Any],
) -> Case:
    """Build the case of parts under pressure on the top; draw which sides are slaves.

    held : part, side, and the components of the displacement that are zero there
    tilt : bound on the relative deviation of the pressure from its mean
    """
    mesh, body = join(tuple(prefixed(m, f"{k}_") for k, m in enumerate(parts)))

    def side(at: tuple[int, str]) -> Nodes:
        return mesh.boundaries[f"{at[0]}_{at[1]}"]

    highest = int(np.argmax([m.points[:, 1].max() for m in parts]))
    top = side((highest, "top"))
    x = mesh.points[top, 0]
    slope = 2 * rng.uniform(-tilt, tilt) * (x - x.mean()) / np.ptp(x)
    load = np.zeros((len(mesh.points), 2))
    load[top, 1] = -PRESSURE * nodal_lengths(mesh.points[top]) * (1 + slope)
    swap = bool(rng.random() < 0.5)
    bodies = assemble(
        mesh, body, names=tuple(map(str, range(len(parts)))),
        materials=tuple(
            Material(10 ** rng.uniform(7, 13), rng.uniform(0, 0.45)) for _ in parts
        ),
        plane="strain", units=(3.0, 3 * PRESSURE),
        fixed=np.unique(np.concatenate([
            2 * side((part, name)) + "xy".index(component)
            for part, name, components in held for component in components
        ])),
        load=load.ravel(),
        pairs=tuple(
            ContactPair(*map(side, pair[::-1] if swap else pair)) for pair in pairs
        ),
    )  # fmt: skip
    rows = linearisation(bodies, *method)(np.zeros(mesh.dofs))
    primal = primal_qp(bodies, rows)
    return contact_case(
        bodies, primal, rows, "dual",
        quantities=lambda s: quantities(bodies, primal, s, rows),
    )  # fmt: skip
