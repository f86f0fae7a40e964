"""Plane linear elasticity with bilinear quadrilaterals (paper, Section 2).

Triangles are quadrilaterals with two corners in one, see `problems.fem.mesh`.

Voigt notation: strain (ε_x, ε_y, γ_xy), stress (σ_x, σ_y, τ_xy); stiffness per unit
thickness, so K has the unit of stress (Pa) and forces are in N/m.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csc_array

from mortarbench.harness import Vector
from mortarbench.problems.fem.kernels import (
    add_stiffness,
    dof_pattern,
    node_pattern,
    slots,
)
from mortarbench.problems.fem.mesh import Mesh, dofs_of

Plane = Literal["strain", "stress"]

#: 2×2 Gauss points of the reference square [−1, 1]², all of weight 1.
GAUSS = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) / np.sqrt(3)
CORNERS = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])


@dataclass(frozen=True)
class Material:
    """An isotropic linear material."""

    E: float  #: Young's modulus, Pa
    nu: float  #: Poisson's ratio


def elasticity_matrix(material: Material, plane: Plane) -> NDArray[np.float64]:
    """Return D (3, 3) of σ = D ε in plane strain or plane stress, Pa."""
    E, nu = material.E, material.nu
    if plane == "stress":
        factor, off, shear = E / (1 - nu**2), nu, (1 - nu) / 2
        return factor * np.array([[1, off, 0], [off, 1, 0], [0, 0, shear]])
    factor = E / ((1 + nu) * (1 - 2 * nu))
    a, b, shear = 1 - nu, nu, (1 - 2 * nu) / 2
    return factor * np.array([[a, b, 0], [b, a, 0], [0, 0, shear]])


def shape_gradients(
    corners: NDArray[np.float64], at: NDArray[np.float64]
) -> tuple[NDArray[np.float64], Vector]:
    """Differentiate the bilinear shape functions with respect to x and y.

    Parameters
    ----------
    corners : (E, 4, 2) corner positions of the cells
    at : (2,) point of the reference square

    Returns
    -------
    (E, 4, 2) gradients ∂N_a/∂(x, y) and (E,) Jacobian determinants

    """
    xi, eta = CORNERS[:, 0], CORNERS[:, 1]
    reference = np.stack(
        [xi * (1 + eta * at[1]), eta * (1 + xi * at[0])], axis=-1
    ) / 4  # (4, 2): ∂N_a/∂(ξ, η)  # fmt: skip
    J = np.einsum("ar,eax->erx", reference, corners)  # ∂x/∂ξ
    det = J[:, 0, 0] * J[:, 1, 1] - J[:, 0, 1] * J[:, 1, 0]
    inverse = np.empty_like(J)
    inverse[:, 0, 0], inverse[:, 1, 1] = J[:, 1, 1], J[:, 0, 0]
    inverse[:, 0, 1], inverse[:, 1, 0] = -J[:, 0, 1], -J[:, 1, 0]
    inverse /= det[:, None, None]  # ∂ξ/∂x, first index x
    gradients: NDArray[np.float64] = np.einsum("exr,ar->eax", inverse, reference)
    return gradients, det


def strain_matrix(gradients: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return B (E, 3, 8) of ε = B u_e, with u_e = (u_x1, u_y1, …, u_y4)."""
    B = np.zeros((len(gradients), 3, 8))
    B[:, 0, 0::2] = B[:, 2, 1::2] = gradients[:, :, 0]
    B[:, 1, 1::2] = B[:, 2, 0::2] = gradients[:, :, 1]
    return B


def stiffness(
    mesh: Mesh,
    D: NDArray[np.float64],
    material: NDArray[np.int64] | None = None,
    pattern: Pattern | None = None,
) -> csc_array:
    """Assemble K = Σ_e ∫ BᵀDB (2N, 2N) by 2×2 Gauss quadrature, Pa.

    Parameters
    ----------
    mesh : the body or bodies
    D : (3, 3), or (k, 3, 3) of k materials
    material : (E,) of each cell, 0 … k − 1; left out: all 0
    pattern : of the mesh, where it is known

    """
    pattern = pattern or sparsity(mesh)
    if material is None:
        material = np.zeros(len(mesh.cells), dtype=np.int64)
    data = add_stiffness(
        mesh.points, pattern.cells, D.reshape(-1, 3, 3), material.astype(np.int32),
        pattern.ptr, pattern.slot,
    )  # fmt: skip
    n = mesh.dofs
    return csc_array((data, pattern.indices, pattern.indptr), shape=(n, n))


@dataclass(frozen=True, eq=False)
class Pattern:
    """Where the entries of a stiffness matrix are; depends on the cells alone."""

    cells: NDArray[np.int32]  #: (E, 4)
    ptr: NDArray[np.int32]  #: (N + 1,) of the neighbours of each node
    slot: NDArray[np.int32]  #: (E, 4, 4) of node b among the neighbours of node a
    indptr: NDArray[np.int32]  #: (2N + 1,) of K
    indices: NDArray[np.int32]


def sparsity(mesh: Mesh) -> Pattern:
    """Find the pattern of K, once for all values."""
    cells = np.ascontiguousarray(mesh.cells, dtype=np.int32)
    ptr, idx = node_pattern(cells, len(mesh.points))
    return Pattern(cells, ptr, slots(cells, ptr, idx), *dof_pattern(ptr, idx))


def cell_dofs(mesh: Mesh) -> NDArray[np.int64]:
    """List the dofs of each cell, (E, 8)."""
    return dofs_of(mesh.cells.ravel()).reshape(-1, 8)


def rigid_modes(points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return an orthonormal basis R (2N, 3) of ker K of one body.

    Two translations and the linearised rotation (−(y − ȳ), x − x̄) about the centroid
    of the nodes: orthogonal by construction, the analytic formula of the paper.
    """
    x, y = (points - points.mean(axis=0)).T
    R = np.zeros((points.size, 3))
    R[0::2, 0] = R[1::2, 1] = 1
    R[0::2, 2], R[1::2, 2] = -y, x
    R /= np.linalg.norm(R, axis=0)
    return R
