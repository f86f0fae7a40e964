"""Whether supports and contacts can balance the loads on bodies, before any solve.

The potential energy has a lower bound if and only if no rigid motion r that the
supports allow (B_D r = 0) and that closes no gap (B r ≤ 0) gains from the load
(fᵀr > 0). With Z a basis of the motions that the supports allow, Farkas' lemma says the
same of forces: there are contact forces λ ≥ 0 with  Zᵀ(f − Bᵀλ) = 0.  Their best
approximation in the sense of least squares leaves, by Moreau's decomposition, a
remainder that *is* such a motion, and the part of the load that nothing balances.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag
from scipy.sparse import csr_array

from mortarbench.harness import Friction, InputError, Matrix
from mortarbench.problems.contact.bodies import UnassembledBodies
from mortarbench.problems.fem.elasticity import rigid_motions

#: part of the load that may be left: rounding of coordinates, normals and tractions
MAX_IMBALANCE = 1e-6
_SLIGHT = 1e-3  #: parts of a motion that are not worth a word
_AXES = "xyz"

Floats = NDArray[np.float64]


class _Moving(NamedTuple):
    """How a body moves."""

    name: str
    centre: Floats  #: (dim,) of its nodes, m
    velocity: Floats  #: (dim,) of the centre
    turn: float  #: anticlockwise, as a velocity at a `size` from the centre


def check_balance(bodies: UnassembledBodies, B: Matrix) -> None:
    """Refuse loads that neither supports nor contacts can balance.

    B : (m, n) contact rows at u = 0

    Raises
    ------
    InputError
        With the body, and the direction or the point about which it turns.

    """
    R, centres, size = _motions(bodies)
    allowed = _kernel(bodies.B_D @ R)
    if not allowed.shape[1]:  # the supports hold every body
        return
    load, closing = R.T @ bodies.f, csr_array(B) @ R
    least = MAX_IMBALANCE * np.abs(bodies.f).sum()
    of_body, dim = R.shape[1] // len(bodies.names), bodies.mesh.dim
    sliding = [
        (b, axis)
        for b in range(len(bodies.names))
        for axis in range(dim)
        if abs(load[k := of_body * b + axis]) > least
        and _slides(bodies, R[:, k], B, np.sign(load[k]))
    ]
    if sliding:
        first = sliding[0][0]
        axes = [_AXES[axis] for b, axis in sliding if b == first]
        raise InputError(
            _text([bodies.names[first]], f"its load in {' and '.join(axes)}")
        )
    left = allowed @ _remainder(allowed.T @ load, closing @ allowed)
    if np.linalg.norm(left) <= least:
        return
    parts = left.reshape(-1, of_body)
    moving = [
        _Moving(name, centre, part[:dim], float(part[dim]))
        for name, centre, part in zip(bodies.names, centres, parts, strict=True)
        if np.abs(part).max() > _SLIGHT * np.abs(parts).max()
    ]
    raise InputError(_named(moving, size))


def check_friction(
    bodies: UnassembledBodies, B: Matrix, friction: Friction, step: int, share: float
) -> None:
    """Refuse a load that friction with its bounds cannot hold.

    With forces λ_n ≥ 0 of the contact rows B and |λ_t| ≤ g of the rows T of friction,
    Zᵀ(f − Bᵀλ_n − Tᵀλ_t) = 0 has to have a solution. A linear program minimises the sum
    of what is left.

    step, share : number of the load step, and its part of the load

    Raises
    ------
    InputError
        With the part of the load that nothing holds.

    """
    R, _, _ = _motions(bodies)
    allowed = _kernel(bodies.B_D @ R)
    if not allowed.shape[1] or not friction.bound.size:
        return
    from scipy.optimize import linprog  # late, as above

    motions = R @ allowed
    forces = np.hstack([(csr_array(M) @ motions).T for M in (B, friction.T)])
    eye, load = np.eye(allowed.shape[1]), motions.T @ bodies.f * share
    rows = B.shape[0]
    limits = [(0, None)] * rows + [(-g, g) for g in friction.bound]
    size = np.abs(bodies.f).sum() * share
    found = linprog(
        np.append(np.zeros(forces.shape[1]), np.ones(2 * len(eye))),
        A_eq=np.hstack([forces, eye, -eye]), b_eq=load,
        bounds=limits + [(0, None)] * (2 * len(eye)), method="highs",
    )  # fmt: skip
    if found.x is not None and found.fun > MAX_IMBALANCE * size:
        raise InputError(
            f"load step {step}: friction cannot hold the load; within the bound of "
            f"Tresca's law nothing balances {found.fun / size:.2%} of it; expected "
            "supports that hold the bodies, or a larger bound"
        )


def _motions(bodies: UnassembledBodies) -> tuple[Floats, Floats, float]:
    """Return R (n, r bodies), the centres (bodies, dim) of the turns, and a size, m.

    Of each body: translations, and turns about its centre that move what is `size` away
    by 1, so that loads along all of them are forces.
    """
    size = float(np.ptp(bodies.mesh.points, axis=0).max())
    parts = bodies.points_of_bodies
    motions = [rigid_motions(part) for part in parts]
    for R in motions:
        R[:, bodies.mesh.dim :] /= size
    centres = np.array([part.mean(axis=0) for part in parts])
    return np.asarray(block_diag(*motions)), centres, size


def _kernel(A: Floats) -> Floats:
    """Orthonormal basis of the kernel of A (m, k), (k, r)."""
    _, sizes, turn = np.linalg.svd(A, full_matrices=True)
    rank = int((sizes > 1e-9 * sizes.max(initial=0.0)).sum())
    return np.asarray(turn[rank:].T)


def _slides(bodies: UnassembledBodies, r: Floats, B: Matrix, sign: float) -> bool:
    """Whether the motion sign·r is allowed by the supports and closes no gap."""
    closing = sign * (B @ r)
    free = not (bodies.B_D @ r).any()
    return free and bool((closing <= 1e-9).all())


def _remainder(load: Floats, closing: Floats) -> Floats:
    """Return what is left of a load (k,) by the best forces λ ≥ 0 on rows (m, k)."""
    from scipy.optimize import nnls  # late: only bodies that supports do not hold

    sizes = np.linalg.norm(closing, axis=1)
    rows = closing[sizes > 1e-12 * sizes.max(initial=0.0)]
    if not rows.size:
        return load
    A = (rows / np.linalg.norm(rows, axis=1)[:, None]).T
    try:
        forces, _ = nnls(A, load, maxiter=100 * A.shape[1])
    except RuntimeError:  # no answer within so many steps: nothing is known to be left
        return np.zeros_like(load)
    return np.asarray(load - A @ forces)


def _named(moving: list[_Moving], size: float) -> str:
    """Say in words what nothing balances."""
    turning = max(moving, key=lambda body: abs(body.turn))
    sliding = max(moving, key=lambda body: float(np.abs(body.velocity).max()))
    most = float(np.abs(sliding.velocity).max())
    if abs(turning.turn) <= _SLIGHT * most:
        axes = [
            axis
            for axis, v in zip(_AXES, sliding.velocity, strict=False)
            if abs(v) > _SLIGHT * most
        ]
        names = [body.name for body in moving]
        whose = "its" if len(names) == 1 else "their"
        return _text(names, f"{whose} load in {' and '.join(axes)}")
    (x, y), (vx, vy) = turning.centre, turning.velocity * size / turning.turn
    return _text(  # about the point that has no velocity
        [turning.name],
        f"the moment of its load: it can turn about ({x - vy:.4g}, {y + vx:.4g}) m",
    )


def _text(names: list[str], what: str) -> str:
    who = "bodies" if len(names) > 1 else "body"
    return (
        f"{who} {' and '.join(map(repr, names))}: nothing balances {what}; expected a "
        "support, or a contact that presses against it"
    )
