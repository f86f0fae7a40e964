"""Finite strain with bilinear quadrilaterals: total Lagrangian, plane strain.

With the nodal displacement u = x − X, the deformation gradient F = I + Σ_a u_a ⊗
∂N_a/∂X, and 2×2 Gauss points in the reference configuration,

    Π(u) = Σ_e ∫ W(F) dA,     r = ∂Π/∂u = Σ_e ∫ P ∂N/∂X,     K_t = ∂r/∂u

(Wriggers 2008, "Nonlinear Finite Element Methods", Section 4.2). Triangles are
degenerate quadrilaterals, see `problems.fem.mesh`; their F is constant.

Nearly incompressible materials (ν ≥ NEARLY_INCOMPRESSIBLE) would lock, because the four
Gauss points of a cell impose more volume constraints than its nodes can satisfy. Cells
of such materials use the mean dilatation (Q1P0; Simo, Taylor and Pister 1985): with
W = w + U(θ), the volumetric part only depends on the average over the cell,

    Π_e = ∫ w(F) dA + V U(θ̄),    θ̄ = 1/V ∫ θ(F) dA,    K_e = ∫ ∂²(w + U′(θ̄)θ) + U″/V ggᵀ

with the area V of the cell and g = ∫ ∂θ/∂u dA. Since Π_e is an energy, K_e is
symmetric. On triangles, where θ is constant, the method has no effect. Q1P0 may develop
hourglass modes under strong compression.

The units of coordinates and moduli determine all others: with lengths in units of l and
moduli in units of F₀/l, forces are in units of F₀ and energies in units of F₀l.
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
from mortarbench.problems.fem.mesh import Mesh, is_triangle

#: smallest Poisson's ratio for which cells use the mean dilatation; for smaller ratios,
#: cells are fully integrated. Without the mean dilatation, a cantilever is 3.9 % too
#: stiff at ν = 0.45, and 21 times as stiff as it should be at ν = 0.4999
NEARLY_INCOMPRESSIBLE = 0.4
#: a negative eigenvalue of a cell tangent counts as zero if its magnitude is at most
#: this fraction of the largest magnitude: rounding may make the zero eigenvalues of
#: translations negative
EIGENVALUE_ROUNDING = 1e-12
#: positive value that replaces negative eigenvalues of a cell tangent, as a fraction of
#: the largest magnitude of its eigenvalues
CLIPPED_EIGENVALUE = 1e-6


class InvertedCellError(ArithmeticError):
    """Error for an inverted cell: J = det F ≤ 0 at one of its Gauss points."""

    def __init__(self, cell: int, determinant: float) -> None:
        self.cell, self.determinant = cell, determinant
        super().__init__(f"cell {cell} is inverted: det F = {determinant:.3g}")


@dataclass(frozen=True, eq=False)
class Cells:
    """Data of the cells of hyperelastic bodies, independent of the displacement u."""

    mesh: Mesh
    materials: tuple[Hyperelastic, ...]  #: material of each body
    body: NDArray[np.int64]  #: (E,) body of each cell
    dofs: NDArray[np.int64]  #: (E, n·dim) dofs of each cell
    gradients: Floats  #: (E, q, n, dim)  ∂N_a/∂X at the q Gauss points
    volumes: Floats  #: (E, q) weight of each Gauss point in the integral over the cell
    pattern: Pattern  #: sparsity of K_t
    entries: NDArray[np.int64]  #: (E, n·dim, n·dim) positions of tangents in K_t.data


class EnergyDerivatives(NamedTuple):
    """Strain energy of a displacement u, with its derivatives with respect to u."""

    energy: float  #: strain energy Π
    forces: Vector  #: (n,)  r = ∂Π/∂u, internal forces
    tangents: Floats  #: (E, n·dim, n·dim)  ∂²Π_e/∂u² of each cell, see `assemble`


def cells_of(
    mesh: Mesh, materials: Sequence[Hyperelastic], body: NDArray[np.int64]
) -> Cells:
    """Return the data of the cells of a mesh.

    materials : material of each body
    body : (E,) body of each cell
    """
    corners = mesh.points[mesh.cells]
    points = [shape_gradients(corners, point) for point in mesh.element.points]
    pattern = sparsity(mesh)
    return Cells(
        mesh,
        tuple(materials),
        body,
        cell_dofs(mesh),
        gradients=np.stack([gradients for gradients, _ in points], axis=1),
        volumes=np.stack([det for _, det in points], axis=1),
        pattern=pattern,
        entries=pattern.entries(mesh.dim),
    )


def deformation_gradients(cells: Cells, u: Vector) -> Floats:
    """Return F = I + ∂u/∂X (E, q, dim, dim) at the Gauss points."""
    return _deformed(cells, u, cells.gradients)


def _deformed(cells: Cells, u: Vector, gradients: Floats) -> Floats:
    """Return F (E, q, dim, dim) at points with gradients ∂N_a/∂X (E, q, n, dim)."""
    E, _, n, dim = gradients.shape
    moved = u[cells.dofs].reshape(E, 1, n, dim)
    return np.asarray(np.eye(dim) + np.swapaxes(moved, -1, -2) @ gradients)


def strain_energy(cells: Cells, u: Vector) -> float:
    """Return the strain energy Π(u), or infinity if a cell is inverted."""
    F = deformation_gradients(cells, u)
    if (determinant(F) <= 0).any():
        return np.inf
    total = 0.0
    for material, index in _by_material(cells):
        theta = material.dilatation(F[index]).value
        if mean_dilatation(material):
            theta = _average(theta, cells.volumes[index])
        W = material.shear(F[index]).value + material.volumetric(theta)[0]
        total += float((cells.volumes[index] * W).sum())
    return total


def evaluate(cells: Cells, u: Vector) -> EnergyDerivatives:
    """Return the strain energy with its first and second derivatives.

    Raises
    ------
    InvertedCellError
        If J ≤ 0 at a Gauss point. The error names the cell with the smallest J.

    """
    F = deformation_gradients(cells, u)
    J = determinant(F).min(axis=1)
    worst = int(np.argmin(J))
    if not J[worst] > 0:  # also true for NaN
        raise InvertedCellError(worst, float(J[worst]))
    energy, forces = 0.0, np.zeros(u.size)
    tangents = np.empty((len(J), 8, 8))  # plane strain: four nodes, two components
    for material, index in _by_material(cells):
        volumes, gradients = cells.volumes[index], cells.gradients[index]
        w, theta = material.shear(F[index]), material.dilatation(F[index])
        mean = mean_dilatation(material)
        measure = _average(theta.value, volumes) if mean else theta.value
        U, slope, curvature = material.volumetric(measure)
        energy += float((volumes * (w.value + U)).sum())
        P = w.first + slope[..., None, None] * theta.first
        nodal = _nodal(P, gradients, volumes)
        forces += np.bincount(cells.dofs[index].ravel(), nodal.ravel(), u.size)
        # ∂²(w + U′θ)/∂F² at fixed U′; the remainder is U″ θ′⊗θ′, or U″/V ggᵀ for Q1P0
        A = w.second + slope[..., None, None, None, None] * theta.second
        if not mean:
            A += np.einsum("eq,eqij,eqkl->eqijkl", curvature, theta.first, theta.first)
        tangents[index] = _cell_tangents(gradients, volumes, A)
        if mean:
            g = _nodal(theta.first, gradients, volumes)
            part = curvature[:, 0] / volumes.sum(axis=1)
            tangents[index] += part[:, None, None] * (g[:, :, None] * g[:, None, :])
    return EnergyDerivatives(energy, forces, tangents)


def assemble(cells: Cells, tangents: Floats) -> csc_array:
    """Assemble K_t (n, n) from the tangents of the cells."""
    pattern, n = cells.pattern, cells.mesh.dofs
    data = np.bincount(cells.entries.ravel(), tangents.ravel(), pattern.indices.size)
    return csc_array((data, pattern.indices, pattern.indptr), shape=(n, n))


def convex_tangent(
    cells: Cells, tangents: Floats, positive: Callable[[csc_array], bool]
) -> tuple[csc_array, int]:
    """Assemble K_t; if it is not positive definite, modify the tangents of cells.

    Negative eigenvalues of a cell tangent are replaced by a small positive fraction of
    the largest magnitude of its eigenvalues (in Teran, Sifakis, Irving and Fedkiw 2005,
    "Robust quasistatic finite elements and flesh simulation", they are replaced by 0).
    Zero eigenvalues are kept, so that translations remain in the kernel of each cell
    tangent.

    Parameters
    ----------
    tangents : tangents of the cells, see `EnergyDerivatives`
    positive : function that returns True if K_t (n, n) is positive definite on the
        motions that the supports allow, as tested by a Cholesky factorisation

    Returns
    -------
    K_t, and the number of modified cells, 0 if K_t is exact

    Raises
    ------
    ArithmeticError
        If the modified K_t is not positive definite either.

    """
    # the sum of indefinite cell tangents may be definite: modify only if necessary
    exact = assemble(cells, tangents)
    if positive(exact):
        return exact, 0
    clipped, changed = clip_eigenvalues(_on_corners(cells.mesh, tangents))
    K = assemble(cells, clipped)
    if not positive(K):
        raise ArithmeticError(
            f"the tangent is not positive definite with {changed} of {len(tangents)} "
            "cells modified; expected supports that hold every body"
        )
    return K, changed


def clip_eigenvalues(tangents: Floats) -> tuple[Floats, int]:
    """Replace negative eigenvalues of symmetric matrices (E, k, k) by positive ones.

    Returns
    -------
    the new matrices, and the number of matrices that had negative eigenvalues beyond
    rounding

    """
    values, vectors = np.linalg.eigh(tangents)
    largest = np.abs(values).max(axis=1, initial=0.0)
    negative = values < -EIGENVALUE_ROUNDING * largest[:, None]
    changed = negative.any(axis=1)
    raised = np.where(negative, CLIPPED_EIGENVALUE * largest[:, None], values)[changed]
    vectors = vectors[changed]
    clipped = tangents.copy()
    product = (vectors * raised[:, None, :]) @ np.swapaxes(vectors, 1, 2)
    # make the result exactly symmetric
    clipped[changed] = (product + np.swapaxes(product, 1, 2)) / 2
    return clipped, int(changed.sum())


def cauchy_stress(cells: Cells, u: Vector) -> Floats:
    """Return σ = PFᵀ/J at the cell centres, (E, 4): σ_x, σ_y, τ_xy, σ_z."""
    mesh = cells.mesh
    gradients, _ = shape_gradients(mesh.points[mesh.cells], mesh.element.centre)
    centre = _deformed(cells, u, gradients[:, None])[:, 0]
    inside = deformation_gradients(cells, u)
    stress = np.empty((len(centre), 4))
    for material, index in _by_material(cells):
        F, theta = centre[index], material.dilatation(centre[index])
        measure = theta.value
        if mean_dilatation(material):
            at_points = material.dilatation(inside[index]).value
            measure = _average(at_points, cells.volumes[index])[:, 0]
        slope = material.volumetric(measure)[1]
        P = material.shear(F).first + slope[:, None, None] * theta.first
        J = determinant(F)
        sigma = P @ np.swapaxes(F, 1, 2) / J[:, None, None]
        stress[index] = np.column_stack(
            [
                sigma[:, 0, 0],
                sigma[:, 1, 1],
                sigma[:, 0, 1],
                slope * material.thickness_rate(F) / J,
            ]
        )
    return stress


def mean_dilatation(material: Hyperelastic) -> bool:
    """Return True if cells of the material use the mean dilatation (Q1P0)."""
    return material.nu >= NEARLY_INCOMPRESSIBLE


def _by_material(cells: Cells) -> list[tuple[Hyperelastic, NDArray[np.int64]]]:
    """Return the material and the cell numbers of each body."""
    return [
        (material, np.flatnonzero(cells.body == b))
        for b, material in enumerate(cells.materials)
    ]


def _average(values: Floats, volumes: Floats) -> Floats:
    """Return the mean over each cell, repeated at each of its Gauss points, (E, q)."""
    mean = (values * volumes).sum(axis=1) / volumes.sum(axis=1)
    return np.repeat(mean[:, None], volumes.shape[1], axis=1)


def _nodal(P: Floats, gradients: Floats, volumes: Floats) -> Floats:
    """Return ∫ P ∂N_a/∂X dA of each cell and corner a, (E, n·dim)."""
    at_points = gradients @ np.swapaxes(P, -1, -2)  # (E, q, n, dim)
    nodal = (volumes[:, :, None, None] * at_points).sum(axis=1)
    return np.asarray(nodal.reshape(-1, np.prod(nodal.shape[1:])))


def _cell_tangents(gradients: Floats, volumes: Floats, A: Floats) -> Floats:
    """Integrate  K_(ai)(bj) = Σ_q v_q ∂N_a/∂X_m A_imjn ∂N_b/∂X_n  of each cell.

    gradients : (E, q, n, dim) shape function gradients at the quadrature points
    volumes : (E, q) v_q
    A : (E, q, dim, dim, dim, dim), symmetric

    Returns
    -------
    (E, n·dim, n·dim), exactly symmetric

    """
    E, _, n, dim = gradients.shape
    weighted = volumes[..., None, None] * gradients
    left = np.einsum("eqam,eqimjn->eqaijn", weighted, A)
    K = np.einsum("eqaijn,eqbn->eaibj", left, gradients).reshape(E, n * dim, n * dim)
    return np.asarray((K + np.swapaxes(K, 1, 2)) / 2)


def _on_corners(mesh: Mesh, tangents: Floats) -> Floats:
    """Add rows and columns of the fourth corner of triangles to those of the third.

    A triangle is stored with its third corner repeated. The assembled K_t is unchanged,
    but each block then has the eigenvalues of the triangle, instead of those of a
    quadrilateral whose third and fourth corners may move apart.
    """
    moved, cells = tangents.copy(), is_triangle(mesh.cells)
    moved[cells, 4:6] += moved[cells, 6:]
    moved[cells, :, 4:6] += moved[cells, :, 6:]
    moved[cells, 6:] = 0
    moved[cells, :, 6:] = 0
    return moved
