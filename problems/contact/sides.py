"""Contact results along slave sides: forces, pressures, gaps and friction states."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csc_array, csr_array, diags_array, vstack

from mortarbench.harness import QP, ContactSide, Friction, Solution, Vector
from mortarbench.harness.mechanics import NO_FRICTION
from mortarbench.harness.plugin import SLIDING
from mortarbench.harness.sets.blocks import norms
from mortarbench.problems.contact.bodies import (
    ContactPair,
    UnassembledBodies,
)
from mortarbench.problems.contact.rows import (
    ContactRows,
    barely_covered,
    handed_over,
)
from mortarbench.problems.contact.surface import current_surface
from mortarbench.problems.fem.mesh import Nodes, as_vectors

RIGID = "rigid"  #: name of a rigid master
ACTIVE_THRESHOLD = 1e-6  #: a contact row is active where λ_i > ACTIVE_THRESHOLD·max λ
#: largest slip that counts as zero, relative to the largest displacement
NO_SLIP = 1e-12
#: pivots of the Gram matrix of unit rows up to this value belong to dependent rows; the
#: matrix is regularised by the square of this value
DEPENDENT = 1e-8
#: ratio of the covered areas of neighbouring slave nodes below which a node has no
#: pressure, and its force and area are added to those of its neighbours: small forces
#: would otherwise be large pressures. At a straight border, this applies to nodes more
#: than half a facet beyond, see `problems.contact.rows.MIN_COVER`
BARELY = 1 / 7
_STATE = f"U{len(SLIDING)}"  #: dtype of arrays of states; SLIDING is the longest name


def contact_sides(
    bodies: UnassembledBodies,
    primal: QP,
    s: Solution,
    rows: ContactRows,
    friction: Friction = NO_FRICTION,
) -> tuple[ContactSide, ...]:
    """Return forces, pressures and gaps along the slave side of each pair, in SI units.

    The nodal force is the sum of the contact and friction forces of the pair on a slave
    node. The pressure is the force of the node's row on the slave, against the outward
    normal of the deformed side, divided by the part of the undeformed length (in 3D,
    area) ∫N_j that the master covers. For the basis N_j of mortar contact, it is the
    nodal value of the traction. The gap is the slack c − Bu of the row of the node;
    with mortar contact, it is the mean gap around the node, weighted as in the row.

    With friction, the shear is the multiplier of the friction row, along the tangent
    (−n_y, n_x) and divided by the same length; in 3D, it is the norm of the two
    multipliers, divided by the area. A node with a row has one of the `states`; the
    state of a node without a row is the empty string.

    rows : the rows of `primal` and `friction`
    """
    B, l, F = csr_array(primal.G), bodies.length, bodies.force
    normal, tangential = np.split(s.z * F, [primal.h.size])
    points, dim, u = bodies.mesh.points, bodies.mesh.dim, s.x * l
    slaves = [pair.slave_nodes for pair in bodies.pairs]
    first = np.cumsum([0, *(nodes.size for nodes in slaves)])
    owner, places = np.repeat(np.arange(len(slaves)), np.diff(first)), int(first[-1])
    # results of each contact row, then of each slave node
    row = friction.row[friction.vectors[:, 0]]
    state, shear = np.full(normal.size, "open", dtype=_STATE), np.zeros(normal.size)
    state[row] = states(primal, s, friction)
    vectors = tangential[friction.vectors]
    shear[row] = 0.0 - vectors[:, 0] if dim == 2 else norms(vectors)
    push, shear = rows.at_places(normal, places), rows.at_places(shear, places)
    gap, covered = np.full(places, np.nan), np.ones(places)
    gap[rows.place] = ((primal.h - B @ s.x) * l)[rows.at]
    covered[rows.place] = rows.covered
    nodal_state = np.full(places, "", dtype=_STATE)
    nodal_state[rows.place] = state[rows.at]
    sides = []
    for k, (name, pair) in enumerate(
        zip(pair_names(bodies), bodies.pairs, strict=True)
    ):
        slave, here = slaves[k], slice(first[k], first[k + 1])
        mine = owner[rows.place] == k
        # fraction (m,) of each row's force that belongs to this pair
        own = rows.of_rows(rows.share * mine) / rows.of_rows(rows.share)
        # 0.0 − x instead of −x avoids negative zeros in reports
        force = as_vectors(0.0 - B.T @ (normal * own), dim)[slave]
        slipping = own[friction.row]  # (k,) the same for friction rows
        acts = bool(slipping.any())
        shearing = np.zeros_like(force)
        if acts:
            shearing -= as_vectors(friction.T.T @ (tangential * slipping), dim)[slave]
        side = current_surface(points, 0 * u, pair.slave, "slave")
        outward = current_surface(points, u, pair.slave, "slave").node_normal
        at, along = rows.place[mine] - first[k], rows.resultants(slave, dim)
        against = np.zeros(slave.size)  # n · (force on the slave) per unit multiplier
        against[at] = np.einsum("ex,ex->e", along[rows.at[mine]], outward[at])
        # barely covered nodes hand their area and forces over to their neighbours
        has_row = np.isin(np.arange(slave.size), at)
        area = side.areas * covered[here]
        kept = has_row & ~barely_covered(area * has_row, side.facets, BARELY)
        E = handed_over(side.facets, kept)
        pressing, shear_force, pushing = (
            E @ v for v in (push[here] * against, shear[here], push[here])
        )
        area = np.where(has_row, E @ (area * has_row), area)
        per_area = np.divide(1.0, area, out=np.zeros_like(area), where=kept)
        sides.append(
            ContactSide(
                name=name,
                nodes=slave,
                length=area,
                force=force + shearing,
                pressure=pressing * per_area,
                gap=gap[here],
                push=pushing,
                shear=shear_force * per_area if acts else None,
                friction=nodal_state[here] if acts else None,
                friction_force=shearing if acts else None,
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
    shear = norms(tangential[vectors])
    sticks = _room(primal, s, friction) >= norms(friction.slip(s.x))
    closed = active(normal)[friction.row[vectors[:, 0]]]
    sheared = shear > ACTIVE_THRESHOLD * np.abs(s.z).max(initial=0.0)
    apart = np.where(sheared, SLIDING, "open")
    touching = np.where(sticks, "stick", "slip")
    return np.where(closed, touching, apart).astype(_STATE)


def _room(primal: QP, s: Solution, friction: Friction) -> Vector:
    """Return the slip (v,) up to which tangential vectors stick, see `states`."""
    vectors, diagonal = friction.vectors, csr_array(primal.P).diagonal()
    # T diag(K)⁻¹ Tᵀ of each row, with stiffness 1 for components without stiffness
    softness = friction.T.multiply(friction.T) @ (1 / np.where(diagonal, diagonal, 1.0))
    shear = norms(s.z[primal.h.size :][vectors])
    room = friction.bound[vectors[:, 0]] - shear
    return np.asarray(room * softness[vectors].mean(axis=1))


def undetermined_friction(primal: QP, s: Solution, friction: Friction) -> int:
    """Return the dimension of the multipliers of sticking rows that change no force.

    The rows of closed contact and of sticking vectors are restricted to the components
    that supports leave free. Combinations of these rows that vanish have no effect on
    the displacement; those of contact rows alone are not counted.
    """
    slip, size = norms(friction.slip(s.x)), np.abs(s.x).max(initial=0.0)
    sticks = slip <= np.maximum(_room(primal, s, friction), NO_SLIP * size)
    sticks &= friction.bound[friction.vectors[:, 0]] > 0
    B = csr_array(primal.G)[active(s.z[: primal.h.size])]
    T = friction.T[friction.vectors[sticks].ravel()]
    free = np.ones(s.x.size)
    free[csr_array(primal.A).indices] = 0.0
    every = csr_array(vstack([B, T]) @ diags_array(free))
    return _defect(every) - _defect(every[: B.shape[0]])


def _defect(rows: csr_array) -> int:
    """Return the number of rows (m, n) that depend on the others."""
    if not rows.shape[0]:
        return 0
    length = np.sqrt(rows.multiply(rows).sum(axis=1))
    rows = csr_array(diags_array(1 / np.where(length > 0, length, 1.0)) @ rows)
    # imported here, because only friction needs it
    from sksparse.cholmod import cholesky

    pivots = cholesky(csc_array(rows @ rows.T), beta=DEPENDENT**2).D()
    return int((pivots <= DEPENDENT).sum())


def active(normal: Vector) -> NDArray[np.bool_]:
    """Return a mask (m,) of the active contact rows."""
    return np.asarray(normal > ACTIVE_THRESHOLD * normal.max(initial=0.0))


def pair_names(bodies: UnassembledBodies) -> list[str]:
    """Return the names "SLAVE on MASTER" of all pairs; repetitions get a number > 1."""
    names: list[str] = []
    for pair in bodies.pairs:
        slave, master = bodies_of(bodies, pair)
        name = f"{slave} on {master}"
        repeats = sum(other.partition(" (")[0] == name for other in names)
        names.append(f"{name} ({repeats + 1})" if repeats else name)
    return names


def bodies_of(bodies: UnassembledBodies, pair: ContactPair) -> tuple[str, str]:
    """Return the names of the bodies of slave and master."""

    def owner(side: Nodes) -> str:
        """Return the body with the most nodes; end nodes may be common to several."""
        return bodies.names[np.bincount(bodies.body_of_node[side.ravel()]).argmax()]

    return owner(pair.slave), owner(pair.master) if pair.master.size else RIGID
