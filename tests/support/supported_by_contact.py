"""A disc between plates, which only contact supports."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from mortarbench.harness import QP, Case
from mortarbench.problems.contact.bodies import (
    Bodies,
    ContactPair,
    assemble,
)
from mortarbench.problems.contact.linearise import linearisation
from mortarbench.problems.contact.results import quantities
from mortarbench.problems.contact.rows import ContactRows
from mortarbench.problems.duality.case_forms import contact_case
from mortarbench.problems.duality.decomposed import subdivided
from mortarbench.problems.duality.feti_dual import feti_dual
from mortarbench.problems.duality.monolithic import primal_qp
from mortarbench.problems.fem.elasticity import Material
from mortarbench.problems.fem.mesh import Mesh, join, nodal_lengths, prefixed, rectangle
from mortarbench.problems.feti.subdomains import DecomposedProblem
from tests.support.decomposed_bodies import decompose_by_labels, parts_by

PRESSURE = 1e7  #: pressure on the upper plate, Pa


def disc_between_plates(n: int = 4, *, form: str = "primal", **given: Any) -> Case:
    """Press a disc of radius 1 m between a fixed plate and another, free or on rollers.

    given : arguments of `posed`
    """
    bodies, primal, rows = posed(n, **given)
    return contact_case(
        bodies, primal, rows, form,
        quantities=lambda s: quantities(bodies, primal, s, rows),
    )  # fmt: skip


def disc_in_parts(n: int = 4, *, parts: int = 6, **given: Any) -> DecomposedProblem:
    """Return the dual of `disc_between_plates`, decomposed by METIS."""
    bodies, primal, _ = posed(n, **given)
    return parts_by(bodies, subdivided(bodies.shape, parts), primal)


def dual_of_disc_between_plates(n: int = 4, *, parts: int = 6, **given: Any) -> QP:
    """Return the QP of `disc_in_parts` for a mesh of the disc along the axes."""
    bodies, primal, _ = posed(n, turn=0.0, **given)
    layout = subdivided(bodies.shape, parts)
    return feti_dual(decompose_by_labels(bodies, layout, primal), primal).qp


def posed(
    n: int, *, contact: str = "nts", basis: str = "dual", **shape: Any
) -> tuple[Bodies, QP, ContactRows]:
    """Return the bodies, their primal QP and its contact rows.

    shape : arguments of `_disc_and_plates`
    """
    bodies = _disc_and_plates(n, **shape)
    rows = linearisation(bodies, contact, basis)(np.zeros(bodies.mesh.dofs))
    return bodies, primal_qp(bodies, rows), rows


def _disc_and_plates(
    n: int,
    *,
    disc_is_slave: bool = True,
    rollers: bool = False,
    turn: float = 0.3,
    tilt: float = 0.0,
    push: float = 0.0,
    E: tuple[float, float, float] = (70e9, 200e9, 70e9),
) -> Bodies:
    """Assemble the bodies.

    n : number of cells across the disc
    rollers : True for rollers at the left side of the upper plate
    turn : angle of the mesh within the disc, rad
    tilt : angle by which the whole assembly is rotated, rad
    push : horizontal traction, as a fraction of the pressure
    """
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
