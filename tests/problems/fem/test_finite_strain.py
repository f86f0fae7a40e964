"""Hyperelastic cells: published digits, derivatives, objectivity, small strains."""

from dataclasses import replace

import numpy as np
import pytest

from mortarbench.problems.fem.elasticity import Material, elasticity_matrix, stiffness
from mortarbench.problems.fem.finite_strain import (
    NEARLY_INCOMPRESSIBLE,
    InvertedCellError,
    assemble,
    cauchy_stress,
    cells_of,
    clip_eigenvalues,
    convex_tangent,
    deformation_gradients,
    evaluate,
    strain_energy,
)
from mortarbench.problems.fem.hyperelastic import MATERIALS, hyperelastic
from mortarbench.problems.fem.mesh import half_disc, join, rectangle

SOFT = Material(E=1.0, nu=0.3)
NEARLY = Material(E=1.0, nu=0.49)


def mixed(nu):
    """Return a distorted mesh of a block of quadrilaterals and a half disc with
    triangles, the body of each cell, and the materials."""
    block = rectangle((0.0, 0.0), (2.0, 1.0), (4, 3))
    disc = half_disc((0.0, 3.0), np.linspace(0, np.pi, 7), np.array([1.0, 0.5]))
    mesh, body = join((block, disc))
    noise = 0.03 * np.random.default_rng(1).standard_normal(mesh.points.shape)
    return replace(mesh, points=mesh.points + noise), body, (Material(1.0, nu), SOFT)


def cells(name, nu):
    mesh, body, linear = mixed(nu)
    return cells_of(mesh, [hyperelastic(name, m) for m in linear], body)


def random_state(mesh):
    return 0.04 * np.random.default_rng(2).standard_normal(mesh.dofs)


every_material = pytest.mark.parametrize("name", MATERIALS)
both_elements = pytest.mark.parametrize("nu", [0.3, 0.47])


@every_material
@pytest.mark.parametrize("nu", [pytest.param(0.3, marks=pytest.mark.slow), 0.47])
def test_forces_and_tangent_are_the_derivatives_of_the_energy(name, nu):
    c = cells(name, nu)
    u, h = random_state(c.mesh), 1e-6
    directions = h * np.eye(c.mesh.dofs)

    at = evaluate(c, u)
    K = assemble(c, at.tangents).toarray()
    forces = [strain_energy(c, u + d) - strain_energy(c, u - d) for d in directions]
    columns = [
        evaluate(c, u + d).forces - evaluate(c, u - d).forces for d in directions
    ]

    assert at.energy == pytest.approx(strain_energy(c, u), rel=1e-14)
    assert np.abs(np.array(forces) / (2 * h) - at.forces).max() < 1e-8
    assert np.abs(np.array(columns).T / (2 * h) - K).max() < 1e-7 * np.abs(K).max()
    assert (K == K.T).all()


@every_material
@both_elements
def test_cells_agree_with_the_sums_over_their_points(name, nu):
    """The compiled loops are compared with the formulas of the documentation in
    NumPy."""
    c = cells(name, nu)
    u = random_state(c.mesh)
    F = deformation_gradients(c, u)
    volumes, gradients = c.volumes, c.gradients
    tangents = np.empty((len(F), 8, 8))
    for e, body in enumerate(c.body):
        material = c.materials[body]
        theta = material.dilatation(F[e])
        w = material.shear(F[e])
        measure = theta.value
        if material.nu >= NEARLY_INCOMPRESSIBLE:
            measure = np.full(4, volumes[e] @ theta.value / volumes[e].sum())
        _, slope, curvature = material.volumetric(measure)
        A = w.second + slope[:, None, None, None, None] * theta.second
        outer = "q,qam,qimjn,qbn->aibj"
        K = np.einsum(outer, volumes[e], gradients[e], A, gradients[e]).reshape(8, 8)
        g = np.einsum("q,qam,qim->qai", volumes[e], gradients[e], theta.first)
        g = g.reshape(4, 8)
        if material.nu >= NEARLY_INCOMPRESSIBLE:
            total = g.sum(axis=0)
            K += curvature[0] / volumes[e].sum() * np.outer(total, total)
        else:
            K += np.einsum("q,qa,qb->ab", curvature / volumes[e], g, g)
        tangents[e] = K

    assert np.abs(evaluate(c, u).tangents - tangents).max() < 1e-13 * tangents.max()


@every_material
@both_elements
def test_a_rotated_state_gives_rotated_forces(name, nu):
    c = cells(name, nu)
    u = random_state(c.mesh)
    Q = np.array([[np.cos(0.7), -np.sin(0.7)], [np.sin(0.7), np.cos(0.7)]])
    turned = (c.mesh.points + u.reshape(-1, 2)) @ Q.T + [1.0, 2.0] - c.mesh.points

    before, after = evaluate(c, u), evaluate(c, turned.ravel())

    assert after.energy == pytest.approx(before.energy, rel=1e-12)
    expected = before.forces.reshape(-1, 2) @ Q.T
    assert np.abs(after.forces.reshape(-1, 2) - expected).max() < 1e-13
    sigma, rotated = (
        np.moveaxis(np.array([[s[:, 0], s[:, 2]], [s[:, 2], s[:, 1]]]), 2, 0)
        for s in (cauchy_stress(c, u), cauchy_stress(c, turned.ravel()))
    )
    assert np.abs(rotated - Q @ sigma @ Q.T).max() < 1e-13


@pytest.mark.parametrize(
    ("name", "size", "along", "curvature"),
    [
        ("neo-hooke", 0.9124619375117772, -0.2384264993276412, 41.241874223133976),
        ("svk", 0.7337017368637873, -0.20988356405745323, 31.129611479376656),
    ],
)
def test_an_independent_code_has_the_same_forces_and_tangent(
    name, size, along, curvature
):
    """The digits are from FElupe 11.3.0 (FieldPlaneStrain, RegionQuad) on this mesh.

    They are ‖r‖, rᵀv and vᵀKv for NeoHookeCompressible and saint_venant_kirchhoff with
    equal Lamé constants. All entries of r and K, which are not stored here, agreed to
    2e-15.
    """
    mesh = rectangle((0.0, 0.0), (2.0, 1.0), (4, 3))
    x, y = mesh.points.T
    moved = np.column_stack([np.sin(5 * x + 3 * y), np.cos(4 * x - 2 * y)])
    mesh = replace(mesh, points=mesh.points + 0.03 * moved)
    X, Y = mesh.points.T
    u = 0.2 * np.column_stack([np.sin(2 * X + Y), np.cos(X - 3 * Y)]) * X[:, None] / 2
    v = np.sin(np.arange(mesh.dofs) + 1.0)

    c = cells_of(mesh, [hyperelastic(name, SOFT)], np.zeros(12, dtype=np.int64))
    at = evaluate(c, u.ravel())

    assert np.linalg.norm(at.forces) == pytest.approx(size, rel=1e-13)
    assert at.forces @ v == pytest.approx(along, rel=1e-12)
    assert v @ (assemble(c, at.tangents) @ v) == pytest.approx(curvature, rel=1e-13)


@every_material
def test_the_tangent_without_strain_is_that_of_linear_elasticity(name):
    mesh, body, linear = mixed(0.3)
    D = np.stack([elasticity_matrix(m, "strain") for m in linear])

    c = cells(name, 0.3)
    K = assemble(c, evaluate(c, np.zeros(mesh.dofs)).tangents)

    assert abs(K - stiffness(mesh, D, body)).max() < 1e-13


@every_material
def test_in_homogeneous_states_both_elements_agree_with_the_material(name):
    """For constant F, the mean dilatation changes neither the energy nor the stress
    σ = PFᵀ/J."""
    mesh, body, _ = mixed(0.3)
    F = np.array([[1.2, 0.3], [-0.1, 0.9]])
    u = (mesh.points @ (F - np.eye(2)).T).ravel()
    material = hyperelastic(name, NEARLY)

    c = cells_of(mesh, [material, material], body)
    stress = material.stress(F) @ F.T / np.linalg.det(F)

    area = c.volumes.sum()
    assert evaluate(c, u).energy == pytest.approx(area * material.energy(F), rel=1e-13)
    computed = cauchy_stress(c, u)
    assert np.allclose(computed[:, 0], stress[0, 0], rtol=1e-11)
    assert np.allclose(computed[:, 1], stress[1, 1], rtol=1e-11)
    assert np.allclose(computed[:, 2], stress[0, 1], rtol=1e-11)


def test_neo_hooke_stress_out_of_the_plane_is_that_of_a_confined_cube():
    """σ_z = Λ ln J/J, because μ(B₃₃ − 1) = 0 for F₃₃ = 1."""
    mesh = rectangle((0.0, 0.0), (1.0, 1.0), (2, 2))
    material = hyperelastic("neo-hooke", SOFT)
    c = cells_of(mesh, [material], np.zeros(4, dtype=np.int64))
    u = (mesh.points * [0.1, -0.2]).ravel()

    J = 1.1 * 0.8

    expected = 0.3 / 1.3 / 0.4 * np.log(J) / J
    assert np.allclose(cauchy_stress(c, u)[:, 3], expected, rtol=1e-12)


def test_an_inverted_cell_is_named_and_has_infinite_energy():
    mesh = rectangle((0.0, 0.0), (3.0, 1.0), (3, 1))
    c = cells_of(mesh, [hyperelastic("svk", SOFT)], np.zeros(3, dtype=np.int64))
    u = np.zeros(mesh.dofs)
    u[2 * mesh.boundaries["right"]] = -1.5

    with pytest.raises(InvertedCellError, match=r"cell 2 .* det F = -0\.5") as e:
        evaluate(c, u)

    assert e.value.cell == 2
    assert strain_energy(c, u) == np.inf


def test_clipping_leaves_convex_matrices_and_raises_negative_eigenvalues():
    rng = np.random.default_rng(4)
    Q = np.linalg.qr(rng.standard_normal((3, 8, 8)))[0]
    spectra = np.array([
        [0, 0, 1, 1, 2, 3, 4, 5], [0, 0, -1, 1, 2, 3, 4, 5], [-5, -1, 1, 1, 2, 3, 4, 5]
    ])  # fmt: skip
    symmetric = (Q * spectra[:, None, :]) @ np.swapaxes(Q, 1, 2)

    clipped, changed = clip_eigenvalues((symmetric + np.swapaxes(symmetric, 1, 2)) / 2)

    assert changed == 2
    computed = np.linalg.eigvalsh(clipped)
    assert np.allclose(computed, np.sort(np.maximum(spectra, 0)), atol=1e-5)
    assert computed.min() > -1e-14
    assert (clipped == np.swapaxes(clipped, 1, 2)).all()
    in_other_units, _ = clip_eigenvalues(
        1e6 * (symmetric + np.swapaxes(symmetric, 1, 2)) / 2
    )
    assert np.abs(in_other_units / 1e6 - clipped).max() < 1e-13


def test_only_a_tangent_that_is_not_convex_is_changed():
    """A strip buckles under compression but not under tension."""
    mesh = rectangle((0.0, 0.0), (10.0, 1.0), (20, 2))
    c = cells_of(
        mesh, [hyperelastic("neo-hooke", SOFT)], np.zeros(40, dtype=np.int64)
    )  # fmt: skip
    fixed = np.unique(np.r_[2 * mesh.boundaries["left"], 2 * mesh.boundaries["right"]])
    fixed = np.append(fixed, 1 + 2 * mesh.boundaries["left"])
    free = np.setdiff1d(np.arange(mesh.dofs), fixed)

    def positive(K):
        return np.linalg.eigvalsh(K.toarray()[np.ix_(free, free)])[0] > 0

    changed, exact = {}, {}
    for stretch in (0.9, 1.1):
        u = (mesh.points * [stretch - 1, 0]).ravel()
        tangents = evaluate(c, u).tangents
        K, changed[stretch] = convex_tangent(c, tangents, positive)
        exact[stretch] = abs(K - assemble(c, tangents)).max() == 0
        assert positive(K)

    assert exact == {0.9: False, 1.1: True}
    assert changed == {0.9: 40, 1.1: 0}


def test_convex_cells_are_unchanged_also_triangles():
    """Without strain, no cell tangent is changed, even if K_t counts as indefinite."""
    c = cells("neo-hooke", 0.3)
    tangents = evaluate(c, np.zeros(c.mesh.dofs)).tangents
    asked = iter([False, True])

    K, changed = convex_tangent(c, tangents, lambda K: next(asked))

    assert changed == 0
    assert abs(K - assemble(c, tangents)).max() < 1e-14


def test_a_floating_body_is_refused():
    mesh = rectangle((0.0, 0.0), (1.0, 1.0), (2, 2))
    c = cells_of(mesh, [hyperelastic("svk", SOFT)], np.zeros(4, dtype=np.int64))
    tangents = evaluate(c, np.zeros(mesh.dofs)).tangents

    with pytest.raises(ArithmeticError, match="expected supports that hold every body"):
        convex_tangent(c, tangents, lambda K: False)
