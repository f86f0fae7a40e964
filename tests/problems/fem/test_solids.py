"""Tetrahedra, wedges and hexahedra: exact solutions, independent code, invariants."""

import numpy as np
import pytest
from scipy.sparse import csc_matrix, eye_array
from scipy.sparse.linalg import spsolve
from scipy.spatial.transform import Rotation
from skfem import (
    Basis,
    ElementHex1,
    ElementTetP1,
    ElementVector,
    ElementWedge1,
    MeshHex,
    MeshTet,
    MeshWedge1,
)
from skfem.models.elasticity import lame_parameters, linear_elasticity
from skfem.quadrature import get_quadrature
from skfem.refdom import RefHex, RefLine, RefTet, RefTri
from sksparse.cholmod import cholesky

from mortarbench.problems.fem.elasticity import (
    Material,
    elasticity_matrix,
    rigid_modes,
    stiffness,
)
from mortarbench.problems.fem.elements import ELEMENTS, HEXAHEDRON, TETRA, WEDGE
from mortarbench.problems.fem.fixing import fixing_nodes
from mortarbench.problems.fem.inverse import floating_inverse, supported_inverse
from mortarbench.problems.fem.mesh import (
    Mesh,
    boundary_facets,
    box,
    dofs_of,
    join,
    nodal_areas,
)
from mortarbench.problems.fem.multifrontal import multifrontal
from mortarbench.problems.fem.stress import (
    centre_stress,
    gauss_stress,
    recover,
    von_mises,
)
from tests.support.hexahedra import (
    TETRAHEDRA,
    WEDGES,
    bent,
    degenerate,
    divided,
)

STEEL = Material(E=200e9, nu=0.3)
D = elasticity_matrix(STEEL, None)
KINDS = ("tetra", "wedge", "hexahedron")
#: mesh, element and corners of the reference cell of scikit-fem, by meshio's names
PEERS = {
    "tetra": (MeshTet, ElementTetP1, TETRA.corners),
    "wedge": (MeshWedge1, ElementWedge1, np.add(WEDGE.corners, [0, 0, 1]) / [1, 1, 2]),
    "hexahedron": (MeshHex, ElementHex1, (HEXAHEDRON.corners + 1) / 2),
}


def cube(kind, n=3, amplitude=0.05):
    """Return the unit cube with cells of one type, smoothly distorted."""
    mesh = bent(box((0.0, 0.0, 0.0), (1.0, 1.0, 1.0), (n, n, n)), amplitude)
    corners = {"tetra": TETRAHEDRA, "wedge": WEDGES}.get(kind)
    return mesh if corners is None else divided(mesh, corners)


def independent(mesh, **rule):
    """Assemble the stiffness matrix with scikit-fem."""
    theirs, element, ours = PEERS[mesh.element.kind]
    place = [int(np.abs(np.subtract(ours, x)).sum(axis=1).argmin())
             for x in element.doflocs]  # fmt: skip
    grid = theirs(mesh.points.T.copy(), mesh.cells[:, place].T.copy())
    basis = Basis(grid, ElementVector(element()), **rule)
    return linear_elasticity(*lame_parameters(STEEL.E, STEEL.nu)).assemble(basis)


def quadrature(element):
    """Return our quadrature rule on scikit-fem's reference cell, with intervals [0,
    1]."""
    points, weights = element.points.T.copy(), element.weights.copy()
    axis = 0
    for simplex in element.simplices:
        if simplex.shape[1] == 1:
            points[axis] = (points[axis] + 1) / 2
            weights = weights / 2
        axis += simplex.shape[1]
    return points, weights


def exact_rule(kind):
    """Return a quadrature rule of degree 6 on scikit-fem's reference cell.

    The rule of scikit-fem 12.0.2 for wedges has weights that sum to 1/4 instead of 1/2.
    """
    if kind != "wedge":
        return get_quadrature({"tetra": RefTet, "hexahedron": RefHex}[kind], 6)
    (x, v), (z, w) = get_quadrature(RefTri, 6), get_quadrature(RefLine, 6)
    points = np.vstack([np.repeat(x, w.size, axis=1), np.tile(z, v.size)])
    return points, np.outer(v, w).ravel()


@pytest.mark.parametrize("kind", KINDS)
def test_stiffness_of_distorted_cells_equals_an_independent_code(kind):
    mesh = cube(kind)
    expected = independent(mesh, quadrature=quadrature(mesh.element))

    K = stiffness(mesh, D)

    assert [block.kind for block in mesh.blocks] == [kind]
    assert abs(K - expected).max() <= 1e-13 * abs(expected).max()
    assert abs(K - K.T).max() <= 1e-14 * abs(K).max()


@pytest.mark.parametrize("kind", KINDS)
def test_stiffness_of_affine_cells_is_exact(kind):
    mesh = cube(kind, 2, 0.0)
    mesh = Mesh(mesh.points @ [[1.0, 0.2, 0.1], [0.0, 0.7, -0.3], [0, 0, 1.3]],
                mesh.cells, {})  # fmt: skip
    expected = independent(mesh, quadrature=exact_rule(kind))

    assert abs(stiffness(mesh, D) - expected).max() <= 1e-13 * abs(expected).max()


@pytest.mark.parametrize("kind", KINDS)
def test_cells_have_their_volume_and_six_rigid_modes(kind):
    mesh = cube(kind, 2)
    element, volume = mesh.element, 0.0
    for xi, weight in zip(element.points, element.weights, strict=True):
        J = np.einsum("ar,eax->erx", element.gradients(xi), mesh.points[mesh.cells])
        volume += weight * np.linalg.det(J).sum()
    K, R = stiffness(mesh, D), rigid_modes(mesh.points)

    assert volume == pytest.approx(1, rel=1e-3 if kind == "wedge" else 1e-13)
    assert abs(K @ R).max() <= 1e-13 * abs(K).max()
    sizes = np.linalg.eigvalsh(K.toarray())
    assert (abs(sizes[:6]) <= 1e-13 * sizes[-1]).all()
    assert sizes[6] > 1e-4 * sizes[-1]


@pytest.mark.parametrize("element", ELEMENTS.values(), ids=lambda e: e.kind)
def test_shape_functions_interpolate_and_their_gradients_are_derivatives(element):
    corners = element.corners.astype(float)
    at_corners = np.array([element.shapes(x) for x in corners])
    np.testing.assert_allclose(at_corners, np.eye(len(corners)), atol=1e-15)

    xi, step = element.centre + 0.1 * np.arange(element.dim), 1e-6
    assert element.shapes(xi).sum() == pytest.approx(1, rel=1e-15)
    np.testing.assert_allclose(element.shapes(xi) @ corners, xi, atol=1e-15)
    for k, axis in enumerate(np.eye(element.dim)):
        slope = element.shapes(xi + step * axis) - element.shapes(xi - step * axis)
        expected = slope / (2 * step)
        np.testing.assert_allclose(element.gradients(xi)[:, k], expected, atol=1e-9)


@pytest.mark.parametrize("kind", KINDS)
def test_a_linear_displacement_has_its_constant_stress_and_solves_the_problem(kind):
    """In this patch test, K u = 0 at inner nodes, and the boundary values determine
    u."""
    mesh, gradient = cube(kind), np.arange(9).reshape(3, 3) / 7 - 0.4
    u = (mesh.points @ gradient.T).ravel()
    e = (gradient + gradient.T) / 2
    stress = D @ [*np.diag(e), 2 * e[1, 2], 2 * e[0, 2], 2 * e[0, 1]]

    for found in (centre_stress(mesh, D, u), gauss_stress(mesh, D, u)):
        np.testing.assert_allclose(found, np.broadcast_to(stress, found.shape), 1e-11)
    recovered = recover(mesh, centre_stress(mesh, D, u))
    np.testing.assert_allclose(recovered, np.tile(stress, (64, 1)), rtol=1e-10)
    K = stiffness(mesh, D)
    inner = dofs_of(np.flatnonzero((abs(mesh.points - 0.5) < 0.49).all(axis=1)), 3)
    assert inner.size == 24
    assert abs((K @ u)[inner]).max() <= 1e-13 * abs(K @ u).max()
    solved = np.where(np.isin(np.arange(u.size), inner), 0.0, u)
    solved[inner] = spsolve(K[inner][:, inner], -(K @ solved)[inner])
    np.testing.assert_allclose(solved, u, atol=1e-14)


def test_degenerate_hexahedra_have_the_stiffness_of_the_cells_themselves():
    for corners in (TETRAHEDRA, WEDGES):
        mesh = divided(box((0.0, 0.0, 0.0), (1.0, 0.8, 0.6), (2, 2, 2)), corners)
        mixed = degenerate(mesh)
        expected = stiffness(mesh, D)

        assert abs(stiffness(mixed, D) - expected).max() <= 1e-13 * abs(expected).max()
        (block,) = mixed.blocks
        assert block.kind == mesh.element.kind
        assert (block.nodes == mesh.cells).all()
        u = np.random.default_rng(2).standard_normal(mesh.dofs)
        stress = centre_stress(mesh, D, u)
        np.testing.assert_allclose(centre_stress(mixed, D, u), stress, rtol=1e-12)
        of_cells = np.broadcast_to(D, (len(mesh.cells), 6, 6))
        np.testing.assert_allclose(centre_stress(mixed, of_cells, u), stress, 1e-12)
        facets = [boundary_facets(m.cells, 3).tolist() for m in (mesh, mixed)]
        assert {turned(f) for f in facets[0]} == {turned(f) for f in facets[1]}
        assert all(len(set(f[:3])) == 3 for f in facets[0] + facets[1])


def turned(facet):
    """Return the distinct corners of a facet, starting from the lowest number."""
    corners = list(dict.fromkeys(facet))
    first = corners.index(min(corners))
    return (*corners[first:], *corners[:first])


@pytest.mark.parametrize(("kind", "faces"), [("tetra", 108), ("wedge", 72),
                                             ("hexahedron", 54)])  # fmt: skip
def test_facets_enclose_the_body_anticlockwise_from_outside(kind, faces):
    mesh = cube(kind, amplitude=0.0)
    facets = boundary_facets(mesh.cells, 3)
    a, b, c, d = np.moveaxis(mesh.points[facets], 1, 0)
    area = np.cross(c - a, d - b) / 2
    nodes, shares = nodal_areas(mesh.points, facets)

    assert len(facets) == faces
    assert np.linalg.norm(area, axis=1).sum() == pytest.approx(6)
    assert (np.einsum("fx,fx->f", area, (a + b + c) / 3 - 0.5) > 0).all()
    assert nodes.tolist() == np.unique(facets).tolist()
    assert shares.sum() == pytest.approx(6)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("size", [(1, 1, 1), (1, 1, 12), (9, 2, 1)])
def test_six_rigid_modes_are_the_kernel_of_a_floating_inverse(kind, size):
    """Some bodies are bars, whose central nodes alone would be collinear."""
    mesh = box((0.0, 0.0, 0.0), tuple(map(float, size)), size)
    corners = {"tetra": TETRAHEDRA, "wedge": WEDGES}.get(kind)
    mesh = mesh if corners is None else divided(mesh, corners)
    K, R = stiffness(mesh, D / STEEL.E), rigid_modes(mesh.points)
    inverse = floating_inverse(K, [R], [dofs_of(fixing_nodes(mesh.points), 3)])
    f = np.random.default_rng(7).standard_normal(mesh.dofs)
    f -= R @ (R.T @ f)

    np.testing.assert_allclose(R.T @ R, np.eye(6), atol=1e-14)
    assert abs(K @ inverse(f) - f).max() <= 1e-10 * abs(f).max()


def test_recovered_stress_of_a_bent_bar_converges_with_second_order():
    """Pure bending with anticlastic curvature has the exact stress σ_z = −E κ x; all
    other components are zero."""
    nu, kappa, errors = STEEL.nu, 1e-3, []
    for n in (4, 8, 16):
        mesh = bent(box((0.0, 0.0, 0.0), (1.0, 1.0, 1.0), (n, n, n)), 0.03)
        x, y, z = mesh.points.T - 0.5
        u = kappa / 2 * np.stack(
            [z**2 + nu * (x**2 - y**2), 2 * nu * x * y, -2 * x * z], axis=-1
        ).ravel()  # fmt: skip
        sigma = recover(mesh, centre_stress(mesh, D, u))
        exact = np.zeros_like(sigma)
        exact[:, 2] = -STEEL.E * kappa * x
        errors.append(abs(sigma - exact).max() / (STEEL.E * kappa))
        stress = von_mises(exact, nu, None)
        np.testing.assert_allclose(stress, abs(exact[:, 2]), rtol=1e-12)

    rates = np.log2(np.divide(errors[:-1], errors[1:]))
    assert rates[-1] == pytest.approx(2, abs=0.3)


def test_the_fill_of_a_box_does_not_depend_on_its_orientation():
    mesh = box((0.0, 0.0, 0.0), (0.8, 1.0, 1.3), (8, 10, 13))
    K = stiffness(mesh, D / STEEL.E) + eye_array(mesh.dofs, format="csc")
    turn = Rotation.from_rotvec([0.3, 0.9, -0.5]).as_matrix()
    every, none = np.arange(mesh.dofs), np.zeros(0, dtype=np.int64)
    sizes = [
        multifrontal(K, every, points, none).rows.size
        for points in (mesh.points, mesh.points @ turn, mesh.points[:, [2, 0, 1]])
    ]
    metis = cholesky(csc_matrix(K), mode="supernodal", ordering_method="nesdis")

    assert max(sizes) <= 1.05 * min(sizes), sizes
    assert max(sizes) <= 2 * metis.L().nnz


@pytest.mark.parametrize("across", [1, 2, 3])
def test_fixing_nodes_of_bars_exclude_every_rotation(across):
    """The central nodes of 3 × 3 × 11 cells would be on an axis of rotation."""
    for length in range(1, 30):
        divisions = across, across, length
        mesh = box((0.0, 0.0, 0.0), tuple(map(float, divisions)), divisions)
        fixed = dofs_of(fixing_nodes(mesh.points), 3)
        sizes = np.linalg.svd(rigid_modes(mesh.points)[fixed], compute_uv=False)
        assert sizes[-1] > 0.25 * sizes[0]


def test_rounding_errors_choose_neither_nodes_nor_bases_of_symmetric_bodies():
    """Nodes of a cube are tied; with its base on a plane, it can slide and turn."""
    mesh = box((0.0, 0.0, 0.0), (1.0, 1.0, 1.0), (4, 4, 4))
    rng = np.random.default_rng(3)
    nodes, R = fixing_nodes(mesh.points), rigid_modes(mesh.points)
    K = stiffness(mesh, D / STEEL.E)
    base = 3 * np.flatnonzero(mesh.points[:, 2] == 0) + 2
    free = np.setdiff1d(np.arange(mesh.dofs), base)
    inverse = supported_inverse(K, free, R)
    f = rng.standard_normal(mesh.dofs)
    assert inverse.kernel.shape[1] == 3
    for _ in range(10):
        noise = 1e-14 * rng.standard_normal(mesh.points.shape)
        turned = R @ np.linalg.qr(rng.standard_normal((6, 6)))[0]
        other = supported_inverse(K, free, turned)
        assert fixing_nodes(mesh.points + noise).tolist() == nodes.tolist()
        np.testing.assert_allclose(rigid_modes(mesh.points + noise), R, atol=1e-12)
        np.testing.assert_allclose(other.kernel, inverse.kernel, atol=1e-12)
        np.testing.assert_allclose(other(f), inverse(f), rtol=1e-9, atol=1e-9)


def test_stresses_of_mixed_cells_use_the_material_of_each():
    wedges = degenerate(
        divided(box((0.0, 0.0, 0.0), (1.0, 1.0, 1.0), (1, 1, 1)), WEDGES)
    )
    mesh, body = join((box((2.0, 0.0, 0.0), (1.0, 1.0, 1.0), (1, 1, 1)), wedges))
    of_cells = np.stack([D, 2 * D])[body]
    u = (mesh.points * [0, 0, 1e-3]).ravel()
    stress = centre_stress(mesh, of_cells, u)

    assert body.tolist() == [0, 1, 1]
    assert stress == pytest.approx(np.outer([1, 2, 2], 1e-3 * D[2]), rel=1e-12)
