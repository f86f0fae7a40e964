"""Contact rows of several pairs, by node-to-segment or mortar methods."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mortarbench.harness import InputError, Vector
from mortarbench.problems.contact.bodies import (
    Bodies,
    ContactPair,
    UnassembledBodies,
)
from mortarbench.problems.contact.face_mortar import face_mortar
from mortarbench.problems.contact.friction import FrictionLaw
from mortarbench.problems.contact.mortar import mortar
from mortarbench.problems.contact.node_to_facet import (
    geometric_stiffness,
    node_to_facet,
)
from mortarbench.problems.contact.rigid import rigid_rows
from mortarbench.problems.contact.rows import ContactRows, joined
from mortarbench.problems.contact.sides import pair_names
from mortarbench.problems.contact.surface import (
    Points,
    Reach,
    closest_points,
    current_positions,
    current_surface,
    divided,
)
from mortarbench.problems.fem.mesh import Nodes


def linearisation(
    bodies: UnassembledBodies,
    contact: str,
    basis: Any,
    laws: Sequence[FrictionLaw] = (),
    fixed_segments: Nodes | None = None,
) -> Callable[[Vector], ContactRows]:
    """Return a function that maps a displacement (n,) in m to the rows of all pairs.

    The returned function raises InputError at zero displacement if a pair has no row.

    contact : "nts" (node to segment, or node to face in 3D) or "mortar"; pairs with
        a rigid master have nodal rows
    basis : multiplier basis of mortar contact, "dual" or "standard"
    laws : friction law of each pair; empty without friction
    fixed_segments : (places,) segment of each slave node for node-to-segment contact,
        numbered as in `closest_segments`; −1 selects the closest segment at each u
    """
    integral = mortar if bodies.mesh.dim == 2 else face_mortar
    pairs, nodes = bodies.pairs, [pair.slave_nodes for pair in bodies.pairs]
    methods: list[Callable[..., ContactRows]] = [
        rigid_rows
        if pair.rigid is not None
        else node_to_facet
        if contact == "nts"
        else partial(integral, basis=basis, reach=Reach(distance=pair.reach))
        for pair in pairs
    ]
    if fixed_segments is not None:
        parts = _split_by_pair(bodies, fixed_segments)
        methods = [partial(node_to_facet, fixed_segments=part) for part in parts]
    size = float(np.ptp(bodies.mesh.points, axis=0).max())
    has_friction = [law.acts for law in laws] or [False] * len(pairs)

    def linearise(u: Vector) -> ContactRows:
        parts = [
            _within_reach(
                rows(
                    bodies.mesh.points,
                    u,
                    pair.slave,
                    pair.master if pair.rigid is None else pair.rigid,
                    tangential=tangential,
                ),
                bodies.mesh.points,
                u,
                pair,
            )
            for rows, pair, tangential in zip(methods, pairs, has_friction, strict=True)
        ]
        if not u.any():
            for name, pair, part in zip(pair_names(bodies), pairs, parts, strict=True):
                _check_facing(name, pair, part, bodies.mesh.points)
        return parts[0] if len(parts) == 1 else joined(parts, nodes, size)

    return linearise


def _within_reach(
    rows: ContactRows, points: Points, u: Vector, pair: ContactPair
) -> ContactRows:
    """Return the rows whose gaps at u are within the reach of the pair."""
    distance = pair.reach
    if distance is None and pair.rigid is None:
        sides = (current_positions(points, u, side.ravel(), "") for side in pair.sides)
        distance = max(float(np.linalg.norm(np.ptp(x, axis=0))) for x in sides)
    if distance is None:
        return rows
    near = np.abs(rows.c - rows.B @ u) <= distance
    return rows if near.all() else rows.selected(near)


def _check_facing(
    name: str, pair: ContactPair, rows: ContactRows, points: Points
) -> None:
    """Raise InputError if no row pushes the undeformed slave against its normal.

    The angle may be up to 60°, as for the rays of mortar contact.
    """
    side = current_surface(points, np.zeros(points.size), pair.slave, "slave")
    along = rows.resultants(pair.slave_nodes, points.shape[1])
    outward = np.einsum("ex,ex->e", along, side.node_normal[rows.place])
    if not (outward >= -Reach().cosine).any():
        raise InputError(
            f"contact {name}: no node of the slave side faces its master within reach; "
            "expected two sides that face each other, each with its body on the left "
            "(in 3D, with outward normals), or the normal of a rigid plane towards the "
            "slave"
        )


def contact_stiffness(
    bodies: Bodies, fixed_segments: Nodes | None = None
) -> Callable[[Vector, Vector], tuple[NDArray[np.float64], Nodes]]:
    """Return a function that evaluates the blocks −λ_i g_i''(u).

    The arguments of this function are u (n,) in m and λ (s,) in N/m, and its result is
    that of `problems.contact.node_to_facet.geometric_stiffness` for all pairs.
    Contact is node to segment, and λ has one entry per slave node.

    fixed_segments : see `linearisation`
    """
    segments = (
        [None] * len(bodies.pairs)
        if fixed_segments is None
        else _split_by_pair(bodies, fixed_segments)
    )

    def blocks(u: Vector, multipliers: Vector) -> tuple[NDArray[np.float64], Nodes]:
        forces = _split_by_pair(bodies, multipliers)
        per_pair = [
            geometric_stiffness(bodies.mesh.points, u, *pair.sides, force, own)
            for pair, force, own in zip(bodies.pairs, forces, segments, strict=True)
        ]
        values, components = zip(*per_pair, strict=True)
        return np.concatenate(values), np.concatenate(components)

    return blocks


def closest_segments(bodies: Bodies, u: Vector) -> Nodes:
    """Return the closest master segment of each slave node of all pairs.

    u : (n,) displacement, m

    Returns
    -------
    (places,) segment of the master, as numbered in its `Surface`

    """
    segments = []
    for pair in bodies.pairs:
        x = current_positions(bodies.mesh.points, u, pair.slave, "slave")
        line = current_surface(bodies.mesh.points, u, pair.master, "master")
        segments.append(closest_points(x, divided(line)).facet)
    return np.concatenate(segments)


def _split_by_pair(
    bodies: UnassembledBodies, values: NDArray[Any]
) -> list[NDArray[Any]]:
    """Split an array with one entry per slave node into one array per pair."""
    ends = np.cumsum([pair.slave_nodes.size for pair in bodies.pairs])[:-1]
    return np.split(values, ends)
