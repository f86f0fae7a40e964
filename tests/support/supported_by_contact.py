"""Bodies supported only by contact, and their solutions in extended precision.

The solutions satisfy the KKT equations of the stored data for given closed rows. They
are computed by Gaussian elimination in extended precision and refined with residuals
in rational arithmetic. Only the guess of the closed rows uses the code under test.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from mortarbench.harness import Case
from mortarbench.harness.mechanics import Extended
from mortarbench.problems.contact.bodies import (
    Bodies,
    ContactPair,
    assemble,
)
from mortarbench.problems.contact.linearise import linearisation
from mortarbench.problems.contact.results import quantities
from mortarbench.problems.duality.case_forms import contact_case
from mortarbench.problems.duality.decomposed import subdivided
from mortarbench.problems.duality.dualisation import Transformed
from mortarbench.problems.duality.feti_dual import feti_dual
from mortarbench.problems.duality.monolithic import primal_qp
from mortarbench.problems.fem.elasticity import Material
from mortarbench.problems.fem.mesh import Mesh, join, nodal_lengths, prefixed, rectangle
from mortarbench.problems.feti.subdomains import DecomposedProblem
from tests.support.decomposed_bodies import decompose_by_labels, parts_by

PRESSURE = 1e7  #: pressure on the upper plate, Pa


def disc_between_plates(
    n: int = 4,
    *,
    form: str = "primal",
    contact: str = "nts",
    basis: str = "dual",
    disc_is_slave: bool = True,
    rollers: bool = False,
    turn: float = 0.3,
    tilt: float = 0.0,
    push: float = 0.0,
    E: tuple[float, float, float] = (70e9, 200e9, 70e9),
) -> Case:
    """Press a disc of radius 1 m between a fixed plate and another, free or on rollers.

    n : number of cells across the disc
    rollers : True for rollers at the left side of the upper plate
    turn : angle of the mesh within the disc, rad
    tilt : angle by which the whole assembly is rotated, rad
    push : horizontal traction, as a fraction of the pressure
    """
    bodies = _disc_and_plates(n, disc_is_slave, rollers, turn, tilt, push, E)
    rows = linearisation(bodies, contact, basis)(np.zeros(bodies.mesh.dofs))
    primal = primal_qp(bodies, rows)
    return contact_case(
        bodies, primal, rows, form,
        quantities=lambda s: quantities(bodies, primal, s, rows),
    )  # fmt: skip


def disc_in_parts(
    n: int = 4,
    *,
    parts: int = 6,
    contact: str = "nts",
    basis: str = "dual",
    disc_is_slave: bool = True,
    rollers: bool = False,
    turn: float = 0.3,
    tilt: float = 0.0,
    push: float = 0.0,
    E: tuple[float, float, float] = (70e9, 200e9, 70e9),
) -> DecomposedProblem:
    """Return the dual of `disc_between_plates`, decomposed by METIS."""
    bodies = _disc_and_plates(n, disc_is_slave, rollers, turn, tilt, push, E)
    rows = linearisation(bodies, contact, basis)(np.zeros(bodies.mesh.dofs))
    primal = primal_qp(bodies, rows)
    return parts_by(bodies, subdivided(bodies.shape, parts), primal)


def dual_of_disc_between_plates(
    n: int = 4,
    *,
    parts: int = 6,
    contact: str = "nts",
    basis: str = "dual",
    turn: float = 0.0,
) -> Transformed:
    """Build the dual of a disc between plates, decomposed by METIS, on one process."""
    bodies = _disc_and_plates(n, True, False, turn, 0.0, 0.0, (70e9, 200e9, 70e9))
    rows = linearisation(bodies, contact, basis)(np.zeros(bodies.mesh.dofs))
    primal = primal_qp(bodies, rows)
    layout = subdivided(bodies.shape, parts)
    return feti_dual(decompose_by_labels(bodies, layout, primal), primal)


def _disc_and_plates(
    n: int, disc_is_slave: bool, rollers: bool, turn: float, tilt: float, push: float,
    E: tuple[float, float, float],
) -> Bodies:  # fmt: skip
    """Assemble the bodies of `disc_between_plates`."""
    lower = rectangle((-1.5, -1.0), (3.0, 1.0), (2 * n, n // 2))
    upper = rectangle((-1.5, 2.0), (3.0, 0.5), (2 * n + 1, n // 3))
    mesh, body = join((
        prefixed(lower, "lower_"),
        prefixed(_disc(n, turn), "disc_"),
        prefixed(upper, "upper_"),
    ))  # fmt: skip
    side = mesh.boundaries
    top, load = side["upper_top"], np.zeros((len(mesh.points), 2))
    load[top] = np.outer(nodal_lengths(mesh.points[top]), [push, -1.0]) * PRESSURE
    T = _rotation(tilt)
    mesh = Mesh(mesh.points @ T.T, mesh.cells, side)
    feet = side["lower_bottom"]
    fixed = [2 * feet, 2 * feet + 1] + ([2 * side["upper_left"]] if rollers else [])
    faces = (
        (side["disc_down"], side["lower_top"]),
        (side["disc_up"], side["upper_bottom"]),
    )
    return assemble(
        mesh, body, names=("lower", "disc", "upper"),
        materials=(Material(E[0], 0.33), Material(E[1], 0.3), Material(E[2], 0.33)),
        plane="strain", units=(3.0, 3 * PRESSURE), fixed=np.concatenate(fixed),
        load=(load @ T.T).ravel(),
        pairs=tuple(ContactPair(*(f if disc_is_slave else f[::-1])) for f in faces),
    )  # fmt: skip


def _disc(n: int, turn: float) -> Mesh:
    """Mesh the disc around (0, 1) with n² cells in rings from a square to the rim."""
    grid = np.linspace(-1, 1, n + 1)
    p = np.stack(np.meshgrid(grid, grid, indexing="ij"), axis=-1).reshape(-1, 2)
    r = np.abs(p).max(axis=1)
    square = p / np.where(r > 0, r, 1)[:, None]
    x, y = square.T
    beside = np.abs(x) >= np.abs(y)
    angle = np.where(
        beside,
        np.pi / 4 * y * np.sign(x) + np.pi * (x < 0),
        np.pi / 2 * np.sign(y) - np.pi / 4 * x * np.sign(y),
    )
    circle = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    points = r[:, None] * ((1 - r[:, None]) * square / np.sqrt(2) + r[:, None] * circle)
    points = points @ _rotation(turn).T
    i = np.arange((n + 1) ** 2).reshape(n + 1, n + 1)
    corners = (i[:-1, :-1], i[1:, :-1], i[1:, 1:], i[:-1, 1:])
    rim = np.concatenate([i[:, 0], i[-1, 1:], i[:-1, -1][::-1], i[0, 1:-1][::-1]])
    around = np.arctan2(*points[rim].T[::-1])
    sides = {}
    for name, middle in (("down", -np.pi / 2), ("up", np.pi / 2)):
        off = (around - middle + np.pi) % (2 * np.pi) - np.pi
        near = np.abs(off) < 0.9
        sides[name] = rim[near][np.argsort(off[near])]
    points[:, 1] += 1
    return Mesh(points, np.stack(corners, axis=-1).reshape(-1, 4), sides)


def _rotation(angle: float) -> NDArray[np.float64]:
    return np.array([
        [np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]
    ])  # fmt: skip


def _loose(rows: NDArray[np.float64], R: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the rigid motions (range of R) that lie in the kernel of the rows."""
    _, sizes, turn = np.linalg.svd(rows @ R)
    count = int((sizes > 1e-9 * sizes.max(initial=0.0)).sum())
    return np.asarray(R @ turn[count:].T)


def _eliminated(A: Extended) -> tuple[Extended, NDArray[np.int64]]:
    order = np.arange(len(A))
    for k in range(len(A)):
        pivot = k + int(np.abs(A[k:, k]).argmax())
        A[[k, pivot]], order[[k, pivot]] = A[[pivot, k]], order[[pivot, k]]
        A[k + 1 :, k] /= A[k, k]
        A[k + 1 :, k + 1 :] -= np.outer(A[k + 1 :, k], A[k, k + 1 :])
    return A, order


def _substituted(factor: Extended, b: Extended) -> Extended:
    x = b.copy()
    for k in range(len(x)):
        x[k + 1 :] -= factor[k + 1 :, k] * x[k]
    for k in reversed(range(len(x))):
        x[k] /= factor[k, k]
        x[:k] -= factor[:k, k] * x[k]
    return x
