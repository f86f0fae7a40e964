"""Finite strain with bilinear quadrilaterals: total Lagrangian, plane strain.

With the displacement u = x − X of the nodes, F = I + Σ_a u_a ⊗ ∂N_a/∂X, and 2×2 Gauss
points in the reference configuration,

    Π(u) = Σ_e ∫ W(F) dA,     r = ∂Π/∂u = Σ_e ∫ P ∂N/∂X,     K_t = ∂r/∂u

(Wriggers 2008, "Nonlinear Finite Element Methods", Section 4.2). Triangles are
quadrilaterals with two corners in one, see `problems.fem.mesh`; their F is constant.

Nearly incompressible materials (ν ≥ NEARLY_INCOMPRESSIBLE) lock: four points ask for
four changes of volume, which eight displacements cannot meet. Their cells take the mean
dilatation (Q1P0; Simo, Taylor and Pister 1985): with W = w + U(θ) the volumetric part
sees the average of the cell only,

    Π_e = ∫ w(F) dA + V U(θ̄),    θ̄ = 1/V ∫ θ(F) dA,    K_e = ∫ ∂²(w + U′(θ̄)θ) + U″/V ggᵀ

with g = ∫ ∂θ/∂u dA. As Π_e is an energy, K_e is symmetric. Triangles gain nothing by
it. Under strong compression of a cell Q1P0 is known for hourglass modes.

Units are those of the mesh's coordinates and of the moduli, and nothing else: with
lengths in l and moduli in F₀/l, forces are in F₀ and energies in F₀l.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csc_array

from mortarbench.harness import Vector
from mortarbench.problems.fem.elasticity import (
    Pattern,
    cell_dofs,
    shape_gradients,
    sparsity,
)
from mortarbench.problems.fem.elements import Floats, determinant
from mortarbench.problems.fem.hyperelastic import Hyperelastic
from mortarbench.problems.fem.kernels import add_tangents, cell_tangents
from mortarbench.problems.fem.mesh import Mesh, is_triangle

#: Poisson's ratio from which on cells take the mean dilatation
NEARLY_INCOMPRESSIBLE = 0.4
#: eigenvalues of a cell's tangent below −ROUNDING times its largest are negative
EIGENVALUE_ROUNDING = 1e-12
#: what negative ones are raised to, as a part of the cell's largest eigenvalue
CLIPPED_EIGENVALUE = 1e-6


class InvertedCellError(ArithmeticError):
    """A cell is turned inside out: J ≤ 0 at one of its quadrature points."""

    def __init__(self, cell: int, determinant: float) -> None:
        self.cell, self.determinant = cell, determinant
        super().__init__(f"cell {cell} is inverted: det F = {determinant:.3g}")


@dataclass(frozen=True, eq=False)
class Cells:
    """Cells of hyperelastic bodies: what of them does not depend on u."""

    mesh: Mesh
    materials: tuple[Hyperelastic, ...]  #: of the bodies
    body: NDArray[np.int64]  #: (E,) of each cell
    dofs: NDArray[np.int64]  #: (E, n·dim)
    gradients: Floats  #: (E, q, n, dim)  ∂N_a/∂X at the Gauss points; second: point
    volumes: Floats  #: (E, q) that each Gauss point stands for
    pattern: Pattern  #: of K_t


class EnergyDerivatives(NamedTuple):
    """The strain energy of a state, with its derivatives."""

    energy: float  #: Π
    forces: Vector  #: (n,)  r = ∂Π/∂u, internal forces
    tangents: Floats  #: (E, n·dim, n·dim)  ∂²Π_e/∂u² of each cell, see `assemble`


def cells_of(
    mesh: Mesh, materials: Sequence[Hyperelastic], body: NDArray[np.int64]
) -> Cells:
    """Prepare the cells of bodies, (E,) numbers `body`, with a material each."""
    corners = mesh.points[mesh.cells]
    points = [shape_gradients(corners, point) for point in mesh.element.points]
    return Cells(
        mesh, tuple(materials), body, cell_dofs(mesh),
        gradients=np.stack([gradients for gradients, _ in points], axis=1),
        volumes=np.stack([det for _, det in points], axis=1),
        pattern=sparsity(mesh),
    )  # fmt: skip


def deformation_gradients(cells: Cells, u: Vector) -> Floats:
    """Return F = I + ∂u/∂X (E, q, dim, dim) at the Gauss points."""
    return _deformed(cells, u, cells.gradients)


def _deformed(cells: Cells, u: Vector, gradients: Floats) -> Floats:
    """Return F (E, q, dim, dim) where shape functions have these gradients."""
    E, _, n, dim = gradients.shape
    moved = u[cells.dofs].reshape(E, 1, n, dim)
    return np.asarray(np.eye(dim) + np.swapaxes(moved, -1, -2) @ gradients)


def strain_energy(cells: Cells, u: Vector) -> float:
    """Return Π(u); infinite where a cell is inverted."""
    F = deformation_gradients(cells, u)
    if (determinant(F) <= 0).any():
        return np.inf
    total = 0.0
    for material, own in _by_material(cells):
        theta = material.dilatation(F[own]).value
        if mean_dilatation(material):
            theta = _average(theta, cells.volumes[own])
        W = material.shear(F[own]).value + material.volumetric(theta)[0]
        total += float((cells.volumes[own] * W).sum())
    return total


def evaluate(cells: Cells, u: Vector) -> EnergyDerivatives:
    """Return the strain energy with its derivatives.

    Raises
    ------
    InvertedCellError
        When J ≤ 0 at a Gauss point; with the cell where J is the smallest.

    """
    F = deformation_gradients(cells, u)
    J = determinant(F).min(axis=1)
    worst = int(np.argmin(J))
    if not J[worst] > 0:
        raise InvertedCellError(worst, float(J[worst]))
    energy, forces = 0.0, np.zeros(u.size)
    tangents = np.empty((len(J), 8, 8))
    for material, own in _by_material(cells):
        volumes, gradients = cells.volumes[own], cells.gradients[own]
        w, theta = material.shear(F[own]), material.dilatation(F[own])
        mean = mean_dilatation(material)
        measure = _average(theta.value, volumes) if mean else theta.value
        U, slope, curvature = material.volumetric(measure)
        energy += float((volumes * (w.value + U)).sum())
        P = w.first + slope[..., None, None] * theta.first
        nodal = _nodal(P, gradients, volumes)
        forces += np.bincount(cells.dofs[own].ravel(), nodal.ravel(), u.size)
        A = w.second + slope[..., None, None, None, None] * theta.second
        if not mean:
            A += np.einsum(
                "eq,eqij,eqkl->eqijkl", curvature, theta.first, theta.first
            )  # fmt: skip
        tangents[own] = cell_tangents(gradients, volumes, A)
        if mean:
            g = _nodal(theta.first, gradients, volumes)
            part = curvature[:, 0] / volumes.sum(axis=1)
            tangents[own] += part[:, None, None] * (g[:, :, None] * g[:, None, :])
    return EnergyDerivatives(energy, forces, tangents)


def assemble(cells: Cells, tangents: Floats) -> csc_array:
    """Sum the tangents of the cells to K_t."""
    at = cells.pattern
    data = add_tangents(np.ascontiguousarray(tangents), at.cells, at.ptr, at.slot)
    n = cells.mesh.dofs
    return csc_array((data, at.indices, at.indptr), shape=(n, n))


def convex_tangent(
    cells: Cells, tangents: Floats, positive: Callable[[csc_array], bool]
) -> tuple[csc_array, int]:
    """Assemble K_t, made positive definite cell by cell where it is not so itself.

    Of the spectral decomposition of each cell's tangent, negative eigenvalues are
    raised to a small positive part of the largest one (Teran, Sifakis, Irving and
    Fedkiw 2005, "Robust quasistatic finite elements and flesh simulation", who take 0).
    What stays in the kernel of a cell is what was there: translations.

    Parameters
    ----------
    tangents : of the cells, see `EnergyDerivatives`
    positive : whether a sum K_t (n, n) is positive definite as the caller needs it: by
        its Cholesky factor, with the supports

    Returns
    -------
    K_t, and the number of cells that were changed, 0 where K_t is exact

    Raises
    ------
    ArithmeticError
        When the sum is not positive definite all the same.

    """
    exact = assemble(cells, tangents)
    if positive(exact):
        return exact, 0
    clipped, changed = clip_eigenvalues(_on_corners(cells.mesh, tangents))
    K = assemble(cells, clipped)
    if not positive(K):
        raise ArithmeticError(
            f"the tangent is not positive definite with {changed} of {len(tangents)} "
            "cells made convex; expected supports that hold every body"
        )
    return K, changed


def clip_eigenvalues(tangents: Floats) -> tuple[Floats, int]:
    """Raise the negative eigenvalues of symmetric matrices (E, k, k); count these."""
    values, vectors = np.linalg.eigh(tangents)
    largest = np.abs(values).max(axis=1, initial=0.0)
    negative = values < -EIGENVALUE_ROUNDING * largest[:, None]
    changed = negative.any(axis=1)
    raised = np.where(negative, CLIPPED_EIGENVALUE * largest[:, None], values)[changed]
    vectors = vectors[changed]
    clipped = tangents.copy()
    product = (vectors * raised[:, None, :]) @ np.swapaxes(vectors, 1, 2)
    clipped[changed] = (product + np.swapaxes(product, 1, 2)) / 2
    return clipped, int(changed.sum())


def cauchy_stress(cells: Cells, u: Vector) -> Floats:
    """Return σ = PFᵀ/J at the cell centres, (E, 4): σ_x, σ_y, τ_xy, σ_z."""
    mesh = cells.mesh
    gradients, _ = shape_gradients(mesh.points[mesh.cells], np.zeros(mesh.dim))
    centre = _deformed(cells, u, gradients[:, None])[:, 0]
    inside = deformation_gradients(cells, u)
    stress = np.empty((len(centre), 4))
    for material, own in _by_material(cells):
        F, theta = centre[own], material.dilatation(centre[own])
        measure = theta.value
        if mean_dilatation(material):
            at_points = material.dilatation(inside[own]).value
            measure = _average(at_points, cells.volumes[own])[:, 0]
        slope = material.volumetric(measure)[1]
        P = material.shear(F).first + slope[:, None, None] * theta.first
        J = determinant(F)
        sigma = P @ np.swapaxes(F, 1, 2) / J[:, None, None]
        stress[own] = np.column_stack([
            sigma[:, 0, 0], sigma[:, 1, 1], sigma[:, 0, 1],
            slope * material.thickness_rate(F) / J,
        ])  # fmt: skip
    return stress


def mean_dilatation(material: Hyperelastic) -> bool:
    """Whether its cells take the mean dilatation (Q1P0)."""
    return material.nu >= NEARLY_INCOMPRESSIBLE


def _by_material(cells: Cells) -> list[tuple[Hyperelastic, NDArray[np.int64]]]:
    """Pair each body's material with its cells."""
    return [
        (material, np.flatnonzero(cells.body == b))
        for b, material in enumerate(cells.materials)
    ]


def _average(values: Floats, volumes: Floats) -> Floats:
    """Return the mean over each cell's points, at each of its points (E, q)."""
    mean = (values * volumes).sum(axis=1) / volumes.sum(axis=1)
    return np.repeat(mean[:, None], volumes.shape[1], axis=1)


def _nodal(P: Floats, gradients: Floats, volumes: Floats) -> Floats:
    """Integrate ∫ P ∂N/∂X, (E, n·dim)."""
    at_points = gradients @ np.swapaxes(P, -1, -2)  # (E, q, n, dim)
    nodal = (volumes[:, :, None, None] * at_points).sum(axis=1)
    return np.asarray(nodal.reshape(-1, np.prod(nodal.shape[1:])))


def _on_corners(mesh: Mesh, tangents: Floats) -> Floats:
    """Put what the last corner of a triangle has to the corner that it repeats.

    The sum over cells is the same; the cell's own eigenvalues are those of a triangle.
    """
    moved, cells = tangents.copy(), is_triangle(mesh.cells)
    moved[cells, 4:6] += moved[cells, 6:]
    moved[cells, :, 4:6] += moved[cells, :, 6:]
    moved[cells, 6:] = 0
    moved[cells, :, 6:] = 0
    return moved
