"""Linear elasticity with linear and multilinear elements, in 2D and 3D.

In 2D the element is the bilinear quadrilateral of the paper (Section 2);
triangles are degenerate quadrilaterals with two coincident corners, see
`problems.fem.mesh`.

In Voigt's notation, strain is (ε_x, ε_y, γ_xy) in 2D and
(ε_x, ε_y, ε_z, γ_yz, γ_xz, γ_xy) in 3D, and stress has the same order. In 2D,
stiffness is per unit thickness: K is in Pa and forces are in N/m. In 3D, K is in N/m
and forces are in N.

If ν > `NEARLY_INCOMPRESSIBLE`, the dilatation θ of quadrilaterals, hexahedra and wedges
is replaced by its mean over the cell (B-bar method: Hughes 1980, Int. J. Numer. Methods
Eng. 15; Simo, Taylor and Pister 1985). With the bulk modulus κ, the stiffness changes
by

    −κ ∫ (b − b̄)ᵀ(b − b̄),      θ = b u,   b̄ = ∫ b / ∫ 1

which is zero on linear triangles and tetrahedra, and for uniform strain.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import combinations
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csc_array

from mortarbench.harness import Vector
from mortarbench.problems.fem.elements import (
    ELEMENTS,
    Floats,
    determinant,
    inverse_transpose,
)
from mortarbench.problems.fem.kernels import (
    add_stiffness,
    dof_pattern,
    node_pattern,
    slots,
)
from mortarbench.problems.fem.mesh import Mesh, dofs_of

Plane = Literal["strain", "stress"]
#: largest Poisson's ratio of fully integrated cells. Closer to ½, they are too stiff,
#: because θ vanishes at every Gauss point
NEARLY_INCOMPRESSIBLE = 0.45
#: indices of the components of a symmetric tensor in Voigt's notation, by dimension
VOIGT = {
    2: np.array([[0, 2], [2, 1]]),
    3: np.array([[0, 5, 4], [5, 1, 3], [4, 3, 2]]),
}


@dataclass(frozen=True)
class Material:
    """An isotropic, linearly elastic material.

    >>> Material(E=210e9, nu=0.3)
    Material(E=210000000000.0, nu=0.3)
    """

    E: float  #: Young's modulus, Pa
    nu: float  #: Poisson's ratio


def elasticity_matrix(material: Material, plane: Plane | None) -> Floats:
    """Return D in σ = D ε, Pa: (3, 3) in plane strain or stress, (6, 6) in 3D."""
    E, nu = material.E, material.nu
    if plane == "stress":
        factor, off, shear = E / (1 - nu**2), nu, (1 - nu) / 2
        return factor * np.array([[1, off, 0], [off, 1, 0], [0, 0, shear]])
    factor = E / ((1 + nu) * (1 - 2 * nu))
    D = np.diag([1 - nu] * 3 + [(1 - 2 * nu) / 2] * 3)
    D[:3, :3][~np.eye(3, dtype=bool)] = nu
    # plane strain: ε_z = γ_yz = γ_xz = 0
    components = [0, 1, 5] if plane == "strain" else list(range(6))
    return np.asarray(factor * D[np.ix_(components, components)])


def shape_gradients(corners: Floats, xi: Vector) -> tuple[Floats, Vector]:
    """Differentiate the shape functions of cells with respect to x.

    Parameters
    ----------
    corners : (E, n, dim) corner positions of the cells
    xi : (dim,) point of the reference cell

    Returns
    -------
    (E, n, dim) gradients ∂N_a/∂x and (E,) Jacobian determinants

    """
    reference = ELEMENTS[corners.shape[2], corners.shape[1]].gradients(xi)
    J = np.einsum("ar,eax->erx", reference, corners)  # ∂x/∂ξ
    gradients: Floats = np.einsum("erx,ar->eax", inverse_transpose(J), reference)
    return gradients, determinant(J)


def strain_matrix(gradients: Floats) -> Floats:
    """Return B (E, v, n·dim) in ε = B u_e for v strains and u_e = (u_x1, u_y1, …)."""
    E, n, dim = gradients.shape
    B = np.zeros((E, dim * (dim + 1) // 2, n * dim))
    for (i, j), component in np.ndenumerate(VOIGT[dim]):
        B[:, component, i::dim] = gradients[:, :, j]
    return B


def nodal_masses(mesh: Mesh, density: Vector) -> Vector:
    """Return ∫ρN_j dV of the shape functions, (N,): kg in 3D, kg per m of thickness.

    density : ρ (E,) of each cell, kg/m³
    """
    masses = np.zeros(len(mesh.points))
    # a degenerate quadrilateral is a triangle, but a degenerate hexahedron is not exact
    cells = [(mesh.cells, density)]
    if mesh.dim == 3:
        cells = [(block.nodes, density[block.cells]) for block in mesh.blocks]
    for nodes, rho in cells:
        element = ELEMENTS[mesh.dim, nodes.shape[1]]
        for xi, weight in zip(element.points, element.weights, strict=True):
            _, volume = shape_gradients(mesh.points[nodes], xi)
            mass = (weight * rho * volume)[:, None] * element.shapes(xi)
            np.add.at(masses, nodes, mass)
    return masses


def stiffness(
    mesh: Mesh,
    D: NDArray[np.float64],
    material: NDArray[np.int64] | None = None,
    pattern: Pattern | None = None,
) -> csc_array:
    """Assemble K = Σ_e ∫ BᵀDB (n, n), n = dim·N, by Gauss quadrature.

    Parameters
    ----------
    D : (v, v) elasticity matrix, or (k, v, v) for k materials
    material : (E,) index of the material of each cell; default: 0 for all cells
    pattern : sparsity pattern of the mesh; computed by default

    """
    pattern = pattern or sparsity(mesh)
    if material is None:
        material = np.zeros(len(mesh.cells), dtype=np.int64)
    data = add_stiffness(
        mesh.element,
        mesh.points,
        pattern.cells,
        D.reshape(-1, *D.shape[-2:]),
        material.astype(np.int32),
        pattern.ptr,
        pattern.slot,
    )
    n = mesh.dofs
    K = csc_array((data, pattern.indices, pattern.indptr), shape=(n, n))
    for part in mean_dilatation(mesh, D.reshape(-1, *D.shape[-2:]), material):
        off = part.b - part.mean
        change = -np.einsum("qe,qea,qeb->eab", part.kappa * part.volume, off, off)
        row, column = (
            np.broadcast_to(part.dofs[(..., *axis)], change.shape).ravel()
            for axis in ((slice(None), None), (None, slice(None)))
        )
        K = K + csc_array((change.ravel(), (row, column)), shape=(n, n))
        K.sort_indices()
    return K


class MeanDilatation(NamedTuple):
    """Dilatation of E cells of one type at their Gauss points and on average."""

    cells: NDArray[np.int64]  #: (E,) numbers of the cells
    dofs: NDArray[np.int64]  #: (E, m) dofs of each cell
    kappa: Vector  #: (E,) bulk modulus
    volume: Floats  #: (q, E) weight of each Gauss point
    b: Floats  #: (q, E, m) rows b in θ = b u at the Gauss points
    centre: Floats  #: (E, m) rows b at the centres

    @property
    def mean(self) -> Floats:
        """Mean b̄ (E, m) of b over each cell."""
        total = np.einsum("qe,qem->em", self.volume, self.b)
        return np.asarray(total / self.volume.sum(axis=0)[:, None])


def mean_dilatation(
    mesh: Mesh, D: Floats, material: NDArray[np.int64]
) -> Iterator[MeanDilatation]:
    """Yield the cells whose dilatation is replaced by its mean.

    In plane stress, D corresponds to plane strain with Poisson's ratio ν/(1 + ν), which
    is below 0.34, so that no cells are selected.

    D, material : (k, v, v) and (E,), see `stiffness`
    """
    lame, shear = D[:, 0, 1], D[:, -1, -1]
    if not (nearly := lame > 2 * NEARLY_INCOMPRESSIBLE * (lame + shear)).any():
        return
    for block in mesh.blocks:
        chosen = nearly[material[block.cells]]
        if block.kind in ("triangle", "tetra") or not chosen.any():
            continue
        nodes, of = block.nodes[chosen], material[block.cells[chosen]]
        element, corners = ELEMENTS[mesh.dim, nodes.shape[1]], mesh.points[nodes]
        *slopes, centre = (
            shape_gradients(corners, xi) for xi in (*element.points, element.centre)
        )
        yield MeanDilatation(
            block.cells[chosen],
            dofs_of(nodes, mesh.dim).reshape(len(nodes), -1),
            lame[of] + 2 / 3 * shear[of],
            element.weights[:, None] * np.stack([det for _, det in slopes]),
            np.stack([gradients.reshape(len(nodes), -1) for gradients, _ in slopes]),
            centre[0].reshape(len(nodes), -1),
        )


@dataclass(frozen=True, eq=False)
class Pattern:
    """Sparsity pattern of a stiffness matrix, which depends only on the cells."""

    cells: NDArray[np.int32]  #: (E, c) nodes of each cell
    ptr: NDArray[np.int32]  #: (N + 1,) row pointers of the node graph
    #: (E, c, c) index of corner b in the list of neighbours of corner a
    slot: NDArray[np.int32]
    indptr: NDArray[np.int32]  #: (n + 1,) column pointers of K in CSC
    indices: NDArray[np.int32]  #: row indices of K in CSC

    def entries(self, dim: int) -> NDArray[np.int64]:
        """Return the position in K.data of each entry of the cells' blocks.

        The result is (E, c·dim, c·dim), with rows and columns ordered by corner, then
        by component.
        """
        first = self.ptr[self.cells].astype(np.int64)
        length = self.ptr[self.cells + 1] - first
        k = np.arange(dim)
        row = dim * (dim * first[..., None] + length[..., None] * k)
        column = dim * self.slot.astype(np.int64)[..., None] + k
        place = row[:, :, :, None, None] + column[:, :, None]
        size = dim * self.cells.shape[1]
        return np.asarray(place.reshape(-1, size, size))


def sparsity(mesh: Mesh) -> Pattern:
    """Compute the sparsity pattern of K."""
    cells = np.ascontiguousarray(mesh.cells, dtype=np.int32)
    ptr, idx = node_pattern(cells, len(mesh.points))
    pattern = dof_pattern(ptr, idx, mesh.dim)
    return Pattern(cells, ptr, slots(cells, ptr, idx), *pattern)


def cell_dofs(mesh: Mesh) -> NDArray[np.int64]:
    """Return the dofs of each cell, (E, n·dim)."""
    return dofs_of(mesh.cells, mesh.dim).reshape(-1, mesh.dim * mesh.cells.shape[1])


def rigid_motions(points: Floats) -> Floats:
    """Return the linearised rigid motions (n, r) of one body with nodes at `points`.

    The columns are a translation along each axis, followed by the linearised rotation
    x_k e_l − x_l e_k about the centroid of the nodes for each pair of axes (k, l). The
    number r is 1 in 1D, 3 in 2D and 6 in 3D.
    """
    N, dim = points.shape
    # about the centroid, rotations are orthogonal to translations
    offset = points - points.mean(axis=0)
    planes = list(combinations(range(dim), 2))
    motions = np.zeros((N, dim, dim + len(planes)))
    motions[:, range(dim), range(dim)] = 1
    for mode, (k, l) in enumerate(planes, start=dim):
        motions[:, k, mode], motions[:, l, mode] = -offset[:, l], offset[:, k]
    return motions.reshape(N * dim, -1)


def rigid_modes(points: Floats) -> Floats:
    """Return an orthonormal basis R (n, r) of ker K of one body, see paper, eq. (4).

    In 2D, the rigid motions of `rigid_motions` are already orthogonal. In 3D, rotations
    about the coordinate axes need not be.
    """
    return gram_schmidt(rigid_motions(points))


def gram_schmidt(vectors: Floats) -> Floats:
    """Return the orthonormal basis of independent columns that Gram–Schmidt defines.

    In contrast to a factor Q of LAPACK, its signs do not depend on rounding errors.
    """
    Q, R = np.linalg.qr(vectors)
    basis: Floats = Q * np.sign(R.diagonal())
    return basis
