"""Rigid motions that supports allow: balance before a solve, least motion after it.

The potential energy is unbounded below if and only if the load does positive work fᵀr
on a rigid motion r that the supports allow (B_D r = 0) and that closes no gap (B
r ≤ 0). Let Z be a basis of the motions that the supports allow. By Farkas' lemma, the
energy is bounded if and only if there are contact forces λ ≥ 0 with Zᵀ(f − Bᵀλ) = 0. If
there are no such forces, Moreau's decomposition applies: the residual of the
non-negative least-squares problem for λ is a motion r as above (in coordinates of Z),
and also the unbalanced part of the load.

If rigid motions remain that neither supports nor closed contacts prevent, the forces of
a solution are unique and its displacement is not. A disc between plates can roll, for
example: mortar rows of its nodes do not change if it turns about its centre, because
the averaged normals of a regular chain are radial. Only at the ends of its arc are they
normal to a single chord, so that a solver could turn the disc until an end touches.
`least_motion` selects the displacement with the least rigid motion.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag
from scipy.sparse import csr_array

from mortarbench.harness import QP, Friction, InputError, Matrix, Solution
from mortarbench.harness.mechanics import contact_rows
from mortarbench.problems.contact.bodies import UnassembledBodies
from mortarbench.problems.contact.sides import active
from mortarbench.problems.fem.elasticity import rigid_motions

#: largest unbalanced fraction of the load that is attributed to rounding of
#: coordinates, normals and tractions
MAX_IMBALANCE = 1e-6
#: components of a motion below this fraction of the largest one are not reported; a
#: uniform load on an irregular mesh has a moment of 1e-3 about the mean of the nodes
_MIN_MOTION = 1e-2
_AXES = "xyz"
#: number of sides of polygons around discs; the radius of their corners is
#: 1/cos(π/16) = 1.02 times that of the disc
POLYGON = 16

Floats = NDArray[np.float64]


def is_determined(bodies: UnassembledBodies, rows: Matrix) -> bool:
    """Return True if supports and closed, sticking contact exclude all rigid motions.

    rows : (m, n) normal rows, and tangential rows of contacts with friction
    """
    R = _motions(bodies)
    allowed = _kernel(bodies.held @ R)
    return not _kernel(csr_array(rows) @ R @ allowed).shape[1]


def check_balance(bodies: UnassembledBodies, B: Matrix) -> None:
    """Check that supports and contacts together can balance the load on all bodies.

    B : (m, n) contact rows at u = 0

    Raises
    ------
    InputError
        If the load can move a body. The message names the bodies that move, and the
        direction of the motion unless one of them turns.

    """
    R = _motions(bodies)
    allowed = _kernel(bodies.held @ R)  # Z = R·allowed
    if not allowed.shape[1]:  # the supports fix every body
        return
    # the least-squares residual is a motion that closes no gap and on which the load
    # does positive work
    load, closing = R.T @ bodies.f, csr_array(B) @ R
    motion = allowed @ _unbalanced_load(allowed.T @ load, closing @ allowed)
    if np.linalg.norm(motion) <= MAX_IMBALANCE * np.abs(bodies.f).sum():
        return
    names, dim = bodies.piece_names, bodies.mesh.dim
    parts = np.abs(motion.reshape(len(names), -1))
    parts = parts > _MIN_MOTION * parts.max()
    moving = [name for name, part in zip(names, parts, strict=True) if part.any()]
    who, whose = ("bodies", "their") if len(moving) > 1 else ("body", "its")
    what = f"the moment of {whose} load"
    if not parts[:, dim:].any():
        axes = [_AXES[axis] for axis in np.flatnonzero(parts.any(axis=0))]
        what = f"{whose} load in {' and '.join(axes)}"
    raise InputError(
        f"{who} {' and '.join(map(repr, moving))}: nothing balances {what}; expected a "
        "support, or a contact that resists the load"
    )


def check_friction(
    bodies: UnassembledBodies, B: Matrix, friction: Friction, step: int, share: float
) -> None:
    """Check that supports, contact and bounded friction can balance the load.

    Otherwise, the primal QP is unbounded below: at points so far away that rounding
    errors exceed the load, its residuals are small, and the point would be verified.

    A load can be balanced if there exist forces λ_n ≥ 0 of the contact rows B, and
    forces λ_t of the friction rows T with ‖λ_t‖ ≤ g, such that the residual  Zᵀ(f −
    Bᵀλ_n − Tᵀλ_t)  is zero. A linear program minimises the 1-norm of this residual. In
    3D, circumscribed polygons with `POLYGON` sides replace the discs. Hence, a load
    that exceeds the friction bound by less than 2 % may pass this check, although the
    solve then fails.

    step : number of the load step
    share : load factor of this step

    Raises
    ------
    InputError
        If no such forces exist. The message states the unbalanced fraction of the load.

    """
    R = _motions(bodies)
    allowed = _kernel(bodies.held @ R)
    if not allowed.shape[1] or not friction.bound.size:
        return
    # imported here, because it is rarely needed and slow to import
    from scipy.optimize import linprog

    motions = R @ allowed
    forces = np.hstack([(csr_array(M) @ motions).T for M in (B, friction.T)])
    eye, load = np.eye(allowed.shape[1]), motions.T @ bodies.f * share
    rows = B.shape[0]
    limits = [(0, None)] * rows + [(-g, g) for g in friction.bound]
    size = np.abs(bodies.f).sum() * share
    sides = _polygons(friction, rows, 2 * len(eye))
    # unknowns: λ_n, λ_t, and the positive and negative parts of the residual
    program = linprog(
        np.append(np.zeros(forces.shape[1]), np.ones(2 * len(eye))),
        A_eq=np.hstack([forces, eye, -eye]),
        b_eq=load,
        **sides,
        bounds=limits + [(0, None)] * (2 * len(eye)),
        method="highs",
    )
    if program.x is not None and program.fun > MAX_IMBALANCE * size:
        raise InputError(
            f"load step {step}: friction cannot hold the load: "
            f"{program.fun / size:.2%} of the load remains unbalanced within the bound "
            "of Tresca's law; expected additional supports, or a larger bound"
        )


def least_motion(
    rigid: Floats, primal: QP, s: Solution, friction: Friction
) -> Solution:
    """Return a solution without rigid motions that change neither forces nor slip.

    The motion Mβ that is subtracted from u solves  min ‖β − Mᵀu‖  subject to the
    contact rows, with an orthonormal basis M of the motions along all closed contacts.
    This is a least-distance problem (Lawson and Hanson 1974, chapter 23).

    rigid : (n, r) orthonormal rigid motions of all bodies
    """
    Z = rigid @ _kernel(rigid[csr_array(primal.A).indices])
    if not Z.shape[1]:
        return s
    rows, limits = contact_rows(primal, friction)
    closed = np.append(active(s.z[: primal.h.size]), friction.bound > 0)
    M = Z @ _kernel(rows[closed] @ Z, MAX_IMBALANCE)
    # γ = β − Mᵀu: min ‖γ‖ subject to Aγ ≥ h
    A, aim = rows[~closed] @ M, M.T @ s.x
    h = -np.maximum((limits - rows @ s.x)[~closed], 0.0) - A @ aim
    change = np.zeros(aim.size)
    if aim.size and (h > 0).any():
        # imported here, because it is rarely needed
        from scipy.optimize import nnls

        E, one = np.vstack([A.T, h]), np.append(change, 1.0)
        r = E @ nnls(E, one)[0] - one
        change = -r[:-1] / r[-1]
    return replace(s, x=s.x - M @ (aim + change))


def _polygons(friction: Friction, before: int, after: int) -> dict[str, Any]:
    """Return the rows of polygons around discs, as arguments of `linprog`.

    The result is empty in 2D, where bounds on the unknowns suffice.

    before, after : numbers of other unknowns before and after those of friction
    """
    vectors = friction.vectors
    if vectors.shape[1] == 1:
        return {}
    angle = 2 * np.pi * np.arange(POLYGON) / POLYGON
    sides = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    row = np.arange(len(vectors) * POLYGON).reshape(-1, POLYGON, 1)
    at = np.broadcast_to(before + vectors[:, None], (len(vectors), POLYGON, 2))
    values = np.broadcast_to(sides, at.shape)
    A = csr_array(
        (values.ravel(), (np.broadcast_to(row, at.shape).ravel(), at.ravel())),
        shape=(row.size, before + vectors.size + after),
    )
    return {"A_ub": A, "b_ub": np.repeat(friction.bound[vectors[:, 0]], POLYGON)}


def _motions(bodies: UnassembledBodies) -> Floats:
    """Return the rigid motions R (n, r·bodies) of all bodies.

    The columns of a body are its translations, followed by rotations about its centre
    that displace points at the distance of the extent of all bodies by 1. With this
    scaling, all entries of Rᵀf are forces.
    """
    motions = [rigid_motions(part) for part in bodies.points_of_pieces]
    for R in motions:
        R[:, bodies.mesh.dim :] /= float(np.ptp(bodies.mesh.points, axis=0).max())
    return np.asarray(block_diag(*motions))


def _kernel(A: Floats, tolerance: float = 1e-9) -> Floats:
    """Return an orthonormal basis (k, r) of the kernel of A (m, k).

    tolerance : singular values below this fraction of the largest one count as zero
    """
    # the triangular factor has the same kernel, and at most k rows
    _, singular_values, Vt = np.linalg.svd(np.linalg.qr(A, mode="r"))
    rank = int((singular_values > tolerance * singular_values.max(initial=0.0)).sum())
    return np.asarray(Vt[rank:].T)


def _unbalanced_load(load: Floats, closing: Floats) -> Floats:
    """Return the unbalanced part (k,) of a load for contact rows `closing` (m, k).

    The result is the residual of the least-squares problem over forces λ ≥ 0.
    """
    # imported here, because only floating bodies need it
    from scipy.optimize import nnls

    sizes = np.linalg.norm(closing, axis=1)
    rows = closing[sizes > 1e-12 * sizes.max(initial=0.0)]
    if not rows.size:
        return load
    A = (rows / np.linalg.norm(rows, axis=1)[:, None]).T
    try:
        forces, _ = nnls(A, load, maxiter=100 * A.shape[1])
    except RuntimeError:  # reaching the iteration limit does not prove an imbalance
        return np.zeros_like(load)
    return np.asarray(load - A @ forces)
