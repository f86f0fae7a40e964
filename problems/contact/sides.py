"""Contact results along the slave side of each pair: forces, pressures, gaps, states.

The rows of the primal QP are ordered pair by pair, and along the slave side within a
pair. A pair with a rigid master has one row per slave node that is not clamped. Any
other row is assigned to the first pair whose two sides contain all nodes of the row;
the search starts at the pair of the preceding row. If two pairs share nodes on both
sides, rows on these nodes are therefore assigned to the first of these pairs.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array

from mortarbench.harness import QP, ContactSide, Friction, Solution, Vector
from mortarbench.harness.mechanics import NO_FRICTION
from mortarbench.harness.plugin import SLIDING
from mortarbench.harness.sets.blocks import norms
from mortarbench.problems.contact.bodies import Bodies, ContactPair, ContactSides
from mortarbench.problems.contact.surface import current_surface, unit
from mortarbench.problems.fem.mesh import (
    Nodes,
    as_vectors,
    dofs_of,
)

RIGID = "rigid"  #: name of a rigid master
ACTIVE_THRESHOLD = 1e-6  #: a contact row is active where λ_i > ACTIVE_THRESHOLD·max λ
_STATE = f"U{len(SLIDING)}"  #: dtype of arrays of states; SLIDING is the longest name


def contact_sides(
    bodies: Bodies | ContactSides,
    primal: QP,
    s: Solution,
    friction: Friction = NO_FRICTION,
) -> tuple[ContactSide, ...]:
    """Return forces, pressures and gaps along the slave side of each pair, in SI units.

    The nodal force is the sum of the contact and friction forces on a slave node. The
    pressure is the component of the contact force against the outward normal of the
    deformed side, divided by the undeformed length ∫N_j (in 3D, area) that belongs
    to the node. The gap is the slack c − Bu of the row of the node; with mortar
    contact, it is the mean gap around the node, weighted as in the row.

    With friction, the shear is the friction force along the tangent (−n_y, n_x),
    divided by the same length; in 3D, it is the norm of the friction force, divided
    by the area. A node with a row has one of the `states`; the state of a node without
    a row is the empty string.
    """
    B, l, F = csr_array(primal.G), bodies.length, bodies.force
    tangential, state = s.z[primal.h.size :], states(primal, s, friction)
    points, dim, u = bodies.mesh.points, bodies.mesh.dim, s.x * l
    row = friction.row[friction.vectors[:, 0]]  # contact row of each state
    slack = (primal.h - B @ s.x) * l
    sides = []
    for name, pair, rows in zip(
        pair_names(bodies), bodies.pairs, rows_of_pairs(B, bodies), strict=True
    ):
        # 0.0 − x instead of −x avoids negative zeros in reports
        slave = pair.slave_nodes
        contact_force = as_vectors(0.0 - (B[rows].T @ s.z[rows]) * F, dim)[slave]
        own = (friction.row >= rows.start) & (friction.row < rows.stop)
        shearing = np.zeros_like(contact_force)
        if own.any():
            force = friction.T[own].T @ tangential[own]
            shearing -= as_vectors(force, dim)[slave] * F
        side = current_surface(points, u, pair.slave, "slave")
        length = current_surface(points, np.zeros_like(u), pair.slave, "slave").areas
        normal = np.einsum("sx,sx->s", contact_force, side.node_normal)
        gap, push = np.full((2, len(slave)), np.nan)
        # nodes without a row keep the gap NaN
        place, direction = slave_places(B[rows], slave, dim)
        gap[place] = slack[rows]
        push[place] = np.einsum("rx,rx->r", contact_force[place], -direction)
        push = np.nan_to_num(push)
        nodal_state = np.full(len(slave), "", dtype=state.dtype)
        nodal_state[place] = "open"
        here = (row >= rows.start) & (row < rows.stop)
        nodal_state[place[row[here] - rows.start]] = state[here]
        along = side.tangents[:, 0] if dim == 2 else unit(shearing, 0 * shearing)
        sides.append(
            ContactSide(
                name=name,
                nodes=slave,
                length=length,
                force=contact_force + shearing,
                pressure=(0.0 - normal) / length,
                gap=gap,
                push=push,
                shear=np.einsum("sx,sx->s", shearing, along) / length
                if own.any()
                else None,
                friction=nodal_state if own.any() else None,
                friction_force=shearing if own.any() else None,
            )
        )
    return tuple(sides)


def states(primal: QP, s: Solution, friction: Friction) -> NDArray[np.str_]:
    """Classify tangential vectors (v,) as "open", "stick", "slip" or `SLIDING`.

    A vector of an inactive row is open, or `SLIDING` if it has a significant shear,
    which Tresca's law allows and Coulomb's does not. A vector of an active row sticks
    if its slip is at most (g − ‖λ_t‖) T diag(K)⁻¹ Tᵀ, with the bound g, the shear λ_t
    and the rows T. This value estimates the slip that the unused part of the bound
    would cause if only the nodes of the row could move.
    """
    vectors = friction.vectors
    if not vectors.size:
        return np.zeros(0, dtype=_STATE)
    normal, tangential = np.split(s.z, [primal.h.size])
    diagonal = csr_array(primal.P).diagonal()
    # T diag(K)⁻¹ Tᵀ of each row, with stiffness 1 for components without stiffness
    softness = friction.T.multiply(friction.T) @ (1 / np.where(diagonal, diagonal, 1.0))
    shear, first = norms(tangential[vectors]), vectors[:, 0]
    room = (friction.bound[first] - shear) * softness[vectors].mean(axis=1)
    sticks = room >= norms(friction.slip(s.x))
    closed = active(normal)[friction.row[first]]
    sheared = shear > ACTIVE_THRESHOLD * np.abs(s.z).max(initial=0.0)
    apart = np.where(sheared, SLIDING, "open")
    touching = np.where(sticks, "stick", "slip")
    return np.where(closed, touching, apart).astype(_STATE)


def active(normal: Vector) -> NDArray[np.bool_]:
    """Return a mask (m,) of the active contact rows."""
    return np.asarray(normal > ACTIVE_THRESHOLD * normal.max(initial=0.0))


def pair_names(bodies: Bodies | ContactSides) -> list[str]:
    """Return the names "SLAVE on MASTER" of all pairs; repetitions get a number > 1."""
    names: list[str] = []
    for pair in bodies.pairs:
        slave, master = bodies_of(bodies, pair)
        name = f"{slave} on {master}"
        repeats = sum(other.partition(" (")[0] == name for other in names)
        names.append(f"{name} ({repeats + 1})" if repeats else name)
    return names


def bodies_of(bodies: Bodies | ContactSides, pair: ContactPair) -> tuple[str, str]:
    """Return the names of the bodies of slave and master."""
    owner = bodies.body_of_node
    master = bodies.names[owner[pair.master.flat[0]]] if pair.master.size else RIGID
    return bodies.names[owner[pair.slave.flat[0]]], master


def rows_of_pairs(B: csr_array, bodies: Bodies | ContactSides) -> list[slice]:
    """Return, for each pair, the slice of its rows in B (m, n)."""
    m, (N, dim) = B.shape[0], bodies.mesh.points.shape
    # (m, N) nodes of each row, and for each pair a mask of the rows with other nodes
    touches = csr_array((np.ones(B.nnz), B.indices // dim, B.indptr), shape=(m, N))
    slices, first = [], 0
    for pair in bodies.pairs:
        if pair.rigid is not None:
            end = first + pair.slave_nodes.size - pair.clamped.size
        else:
            # the rows of the pair end before the first row with a node outside both
            # sides, or the first row against a rigid master, which has slave nodes only
            other, opposite = np.ones(N), np.zeros(N)
            other[pair.nodes] = 0.0
            opposite[pair.master if pair.master.size else pair.slave] = 1.0
            outside = (touches @ other > 0) | (touches @ opposite == 0)
            beyond = np.flatnonzero(outside[first:])
            end = first + int(beyond[0]) if beyond.size else m
        slices.append(slice(first, end))
        first = end
    return slices


def slave_places(
    B: csr_array, slave: Nodes, dim: int
) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Return the slave node of each row: the node of `slave` with the largest entries.

    Returns
    -------
    positions (r,) in `slave`, and unit vectors (r, dim) along the entries of that node

    """
    components = [B[:, dofs_of(slave, dim, axis)] for axis in range(dim)]
    entries = np.stack([part.toarray() for part in components], axis=-1)
    place = np.abs(entries).sum(axis=2).argmax(axis=1)
    entry = entries[np.arange(len(place)), place]
    return place, entry / np.linalg.norm(entry, axis=1, keepdims=True)
