"""Each contact pair of a solution on its own: forces, pressures and gaps along a side.

The rows of the primal QP stand pair by pair, those of a pair along its slave side. A
row belongs to the first pair, from that of the row before on, whose two sides hold all
nodes that it touches; so what two pairs share with both their sides is told of the
first of them.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array

from mortarbench.harness import QP, ContactSide, Friction, Solution, Vector
from mortarbench.harness.mechanics import NO_FRICTION
from mortarbench.harness.plugin import SLIDING
from mortarbench.problems.contact.bodies import Bodies, ContactPair, ContactSides
from mortarbench.problems.contact.surface import current_surface, surface
from mortarbench.problems.fem.mesh import (
    Nodes,
    as_vectors,
    dofs_of,
)

RIGID = "rigid"  #: name of a master that is no body
ACTIVE_THRESHOLD = 1e-6  #: a contact row is active where λ_i > ACTIVE·max λ
_STATE = f"U{len(SLIDING)}"  #: type of arrays of states


def contact_sides(
    bodies: Bodies | ContactSides,
    primal: QP,
    s: Solution,
    friction: Friction = NO_FRICTION,
) -> tuple[ContactSide, ...]:
    """Evaluate every pair along its slave side; SI units.

    The force on a node is that of contact and friction. The pressure is the normal part
    of that of the contact, over the length of the undeformed side that belongs to the
    node, ∫N_j ds; the normal is that of the deformed side. The gap is the slack of the
    node's row, c − Bu: with mortar contact the mean of the gap around the node,
    weighted as its row is. Where there is friction, the shear is that of its force
    along the tangent (−n_y, n_x), and a node has one of the `states`.
    """
    B, l, F = csr_array(primal.G), bodies.length, bodies.force
    tangential, state = s.z[primal.h.size :], states(primal, s, friction)
    points, dim, u = bodies.mesh.points, bodies.mesh.dim, s.x * l
    slack = (primal.h - B @ s.x) * l
    found = []
    for name, pair, rows in zip(
        pair_names(bodies), bodies.pairs, rows_of_pairs(B, bodies), strict=True
    ):
        pressing = as_vectors(0.0 - (B[rows].T @ s.z[rows]) * F, dim)[pair.slave]
        rough = (friction.row >= rows.start) & (friction.row < rows.stop)
        rubbing = np.zeros_like(pressing)
        if rough.any():
            force = friction.T[rough].T @ tangential[rough]
            rubbing -= as_vectors(force, dim)[pair.slave] * F
        side = current_surface(points, u, pair.slave, "slave")
        length = surface(points[pair.slave], "slave").areas
        normal = np.einsum("sx,sx->s", pressing, side.node_normal)
        gap, push = np.full((2, len(pair.slave)), np.nan)
        place, own = slave_places(B[rows], pair.slave, dim)
        gap[place] = slack[rows]
        push[place] = np.einsum("rx,rx->r", pressing[place], -own)
        push = np.nan_to_num(push)
        told = np.full(len(pair.slave), "open", dtype=state.dtype)
        told[place[friction.row[rough] - rows.start]] = state[rough]
        found.append(
            ContactSide(
                name=name, nodes=pair.slave, length=length,
                force=pressing + rubbing, pressure=(0.0 - normal) / length, gap=gap,
                push=push,
                shear=np.einsum("sx,sx->s", rubbing, side.tangents[:, 0]) / length
                if rough.any() else None,
                friction=told if rough.any() else None,
            )
        )  # fmt: skip
    return tuple(found)


def states(primal: QP, s: Solution, friction: Friction) -> NDArray[np.str_]:
    """Classify friction rows (k,): "open", "stick", "slip" or `SLIDING`.

    Rows that are not active are open unless they carry shear, which Tresca's law allows
    and Coulomb's does not. An active row sticks up to the slip that the rest of its
    bound would bring about on the nodes of the row alone, (g − |λ_t|) T diag(K)⁻¹Tᵀ.
    """
    if not friction.bound.size:
        return np.zeros(0, dtype=_STATE)
    normal, tangential = np.split(s.z, [primal.h.size])
    diagonal = csr_array(primal.P).diagonal()
    softness = friction.T.multiply(friction.T) @ (1 / np.where(diagonal, diagonal, 1.0))
    slip = np.abs(friction.T @ s.x - friction.start)
    sticks = (friction.bound - np.abs(tangential)) * softness >= slip
    closed = active(normal)[friction.row]
    sheared = np.abs(tangential) > ACTIVE_THRESHOLD * np.abs(s.z).max(initial=0.0)
    apart = np.where(sheared, SLIDING, "open")
    touching = np.where(sticks, "stick", "slip")
    return np.where(closed, touching, apart).astype(_STATE)


def active(normal: Vector) -> NDArray[np.bool_]:
    """Tell which contact rows (m,) press."""
    return np.asarray(normal > ACTIVE_THRESHOLD * normal.max(initial=0.0))


def pair_names(bodies: Bodies | ContactSides) -> list[str]:
    """Name the pairs by their bodies, slave first; equal ones by a number, too."""
    names: list[str] = []
    for pair in bodies.pairs:
        slave, master = bodies_of(bodies, pair)
        name = f"{slave} on {master}"
        again = sum(known.partition(" (")[0] == name for known in names)
        names.append(f"{name} ({again + 1})" if again else name)
    return names


def bodies_of(bodies: Bodies | ContactSides, pair: ContactPair) -> tuple[str, str]:
    """Name the bodies of slave and master."""
    owner = bodies.body_of_node
    master = bodies.names[owner[pair.master[0]]] if pair.master.size else RIGID
    return bodies.names[owner[pair.slave[0]]], master


def rows_of_pairs(B: csr_array, bodies: Bodies | ContactSides) -> list[slice]:
    """Find which rows of B (m, n) belong to which pair."""
    m, (N, dim) = B.shape[0], bodies.mesh.points.shape
    touches = csr_array((np.ones(B.nnz), B.indices // dim, B.indptr), shape=(m, N))
    outside = []
    for pair in bodies.pairs:
        other = np.ones(N)
        other[np.concatenate(pair)] = 0.0
        outside.append(touches @ other > 0)
    slices, first = [], 0
    for k in range(len(bodies.pairs)):
        beyond = np.flatnonzero(outside[k][first:])
        end = first + int(beyond[0]) if beyond.size else m
        slices.append(slice(first, end))
        first = end
    return slices


def slave_places(
    B: csr_array, slave: Nodes, dim: int
) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Find each row's node, as its place on the slave side: where B is largest.

    Returns
    -------
    places (r,), and the directions (r, dim) of the rows there, unit vectors

    """
    components = [B[:, dofs_of(slave, dim, axis)] for axis in range(dim)]
    entries = np.stack([part.toarray() for part in components], axis=-1)
    place = np.abs(entries).sum(axis=2).argmax(axis=1)
    own = entries[np.arange(len(place)), place]
    return place, own / np.linalg.norm(own, axis=1, keepdims=True)
