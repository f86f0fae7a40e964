"""Nested dissection and the multifrontal factor: identities of linear algebra."""

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.sparse import block_diag, csc_array, eye_array

from mortarbench.problems.fem.dissection import dissect
from mortarbench.problems.fem.elasticity import Material, elasticity_matrix, stiffness
from mortarbench.problems.fem.mesh import (
    box,
    dofs_of,
    half_disc,
    half_ring,
    join,
    rectangle,
)
from mortarbench.problems.fem.multifrontal import multifrontal

MATERIAL = Material(E=2e3, nu=0.3)
MESHES = {
    "beam": rectangle((0, 0), (4, 1), (32, 8)),
    "square": rectangle((0, 0), (1, 1), (13, 13)),
    "ring": half_ring((0, 0), (0.6, 1), (40, 5)),
    "disc": half_disc((0, 0), np.linspace(0, np.pi, 13), np.linspace(1, 0.2, 5)),
    "cell": rectangle((0, 0), (1, 1), (1, 1)),
    "three": join((
        rectangle((0, 0), (1, 1), (9, 9)),
        half_ring((0, 0), (0.6, 1), (20, 3)),
        rectangle((3, 0), (1, 1), (1, 1)),
    ))[0],
    "cube": box((0, 0, 0), (1, 1, 1), (5, 4, 6)),
}  # fmt: skip


def definite(mesh):
    """Return the positive definite stiffness matrix of a mesh on an elastic
    foundation."""
    D = elasticity_matrix(MATERIAL, "stress" if mesh.dim == 2 else None)
    return csc_array(stiffness(mesh, D) + 7.0 * eye_array(mesh.dofs))


def dense(factor):
    """Return the factor Lᵀ as a dense matrix."""
    f, U = factor.fronts, np.zeros((factor.order.size, factor.order.size))
    for s in range(len(f.children)):
        own = np.arange(f.start[s], f.start[s + 1])
        columns = np.concatenate([own, f.border[f.first[s] : f.first[s + 1]]])
        rows = factor.rows[factor.offset[s] : factor.offset[s + 1]]
        U[np.ix_(own, columns)] = rows.reshape(own.size, columns.size)
    return np.triu(U)


def choices(mesh):
    """Return pairs of free components and of components that are eliminated last."""
    n, rng = mesh.dofs, np.random.default_rng(161803)
    every, half = np.arange(n), np.sort(rng.permutation(n)[: n // 2])
    return [
        (every, half[::5]), (half, half[::7]), (every, every), (every, every[:0]),
        (every[n // 2 :], every[n // 2 :: 9]),  # some fronts have no pivots
    ]  # fmt: skip


@pytest.mark.parametrize("choice", range(5))
@pytest.mark.parametrize("name", MESHES)
def test_the_factor_multiplies_to_the_matrix(name, choice):
    mesh = MESHES[name]
    free, last = choices(mesh)[choice]
    K = definite(mesh)

    factor = multifrontal(K, free, mesh.points, last)

    U, o = dense(factor), factor.order
    assert np.array_equal(np.sort(o), free)
    assert abs(U.T @ U - K[o][:, o]).max() <= 1e-13 * abs(K).max()


@pytest.mark.parametrize("choice", range(5))
@pytest.mark.parametrize("name", MESHES)
def test_right_hand_sides_give_planted_solutions_alone_and_together(name, choice):
    mesh = MESHES[name]
    free, last = choices(mesh)[choice]
    K = definite(mesh)
    factor = multifrontal(K, free, mesh.points, last)
    K_oo = K[factor.order][:, factor.order]
    x = np.random.default_rng(141421).standard_normal((free.size, 3))

    together, alone = factor.solve(K_oo @ x), factor.solve(K_oo @ x[:, 1])

    assert_allclose(together, x, rtol=0, atol=1e-11 * abs(x).max())
    assert_allclose(alone, x[:, 1], rtol=0, atol=1e-11 * abs(x).max())


def test_matrices_with_one_unknown_per_node_are_factorised():
    mesh = MESHES["ring"]
    K = csc_array(definite(mesh)[::2][:, ::2])  # x components alone
    x = np.random.default_rng(173205).standard_normal(K.shape[0])

    factor = multifrontal(K, np.arange(K.shape[0]), mesh.points, np.arange(5))

    assert factor.solve(K[factor.order][:, factor.order] @ x) == pytest.approx(x)


def test_the_trailing_blocks_are_the_schur_complements_of_each_body():
    mesh = MESHES["three"]
    K, last = definite(mesh), dofs_of(np.array([3, 50, 120, len(mesh.points) - 1]), 2)

    blocks = multifrontal(K, np.arange(mesh.dofs), mesh.points, last).trailing()

    inverse = np.linalg.inv(K.toarray())
    assert np.array_equal(np.sort(np.concatenate([c for c, _ in blocks])), last)
    for components, U in blocks:
        schur = np.triu(U).T @ np.triu(U)
        exact = np.linalg.inv(inverse[np.ix_(components, components)])
        assert schur == pytest.approx(exact, rel=1e-9, abs=1e-9 * abs(exact).max())


def test_a_separator_separates():
    """No entry of K couples the two subtrees below a separator."""
    mesh = MESHES["beam"]
    K = definite(mesh)
    order, f = dissect(K, mesh.points, np.arange(4))
    coupled = abs(K[::2][:, ::2]).toarray()[np.ix_(order, order)] > 0
    subtrees = []
    for s, children in enumerate(f.children):
        below = [subtrees.pop() for _ in range(children)]
        if children == 2:
            assert not coupled[np.ix_(*below)].any()
        own = list(range(f.start[s], f.start[s + 1]))
        subtrees.append([i for part in below for i in part] + own)

    assert (f.children == 2).any()
    assert [len(part) for part in subtrees] == [len(mesh.points)]


def test_the_last_nodes_of_a_component_end_it():
    mesh, last = MESHES["three"], np.array([3, 50, 120])

    order, fronts = dissect(definite(mesh), mesh.points, last)

    roots = np.flatnonzero(fronts.roots)
    ends = [order[fronts.start[s] : fronts.start[s + 1]] for s in roots]
    assert np.array_equal(np.concatenate(ends), last)
    assert np.array_equal(np.sort(order), np.arange(len(mesh.points)))


@pytest.mark.parametrize(("name", "width"), [("beam", 9), ("square", 14), ("ring", 6)])
def test_the_last_separator_is_the_shortest_cut_into_halves(name, width):
    mesh = MESHES[name]
    _, f = dissect(definite(mesh), mesh.points, np.arange(0))
    top = np.flatnonzero(f.children == 2)[-1]

    assert f.start[top + 1] - f.start[top] == width
    assert f.start[top + 1] == len(mesh.points)


def test_nodes_in_one_place_are_not_cut():
    K = csc_array(block_diag([2 * np.ones((40, 40)) + np.eye(40)]))

    factor = multifrontal(K, np.arange(40), np.ones((20, 2)), np.array([0, 1]))

    assert factor.solve(K @ np.ones(40)) == pytest.approx(np.ones(40))


@pytest.mark.parametrize("name", ["beam", "three"])
def test_a_matrix_that_is_not_positive_definite_is_refused(name):
    mesh = MESHES[name]
    K = csc_array(definite(mesh) - 100.0 * eye_array(mesh.dofs))

    with pytest.raises(np.linalg.LinAlgError, match="not positive definite"):
        multifrontal(K, np.arange(mesh.dofs), mesh.points, np.arange(4))


@pytest.mark.parametrize("name", ["cell", "three"])
@pytest.mark.parametrize("entry", [0, -1])
def test_a_matrix_with_a_nan_is_refused(name, entry):
    mesh = MESHES[name]
    K = definite(mesh)
    K.data[entry] = np.nan

    with pytest.raises(np.linalg.LinAlgError, match="not positive definite"):
        multifrontal(K, np.arange(mesh.dofs), mesh.points, np.arange(4))


def test_long_indices_give_the_same_factor():
    mesh = MESHES["three"]
    K, long = definite(mesh), definite(mesh)
    long.indptr, long.indices = K.indptr.astype(np.int64), K.indices.astype(np.int64)

    factors = [
        multifrontal(A, np.arange(mesh.dofs), mesh.points, np.arange(8))
        for A in (K, long)
    ]

    assert np.array_equal(factors[0].rows, factors[1].rows)


@pytest.mark.parametrize("name", MESHES)
def test_borders_ascend_and_come_later(name):
    mesh = MESHES[name]
    _, f = dissect(definite(mesh), mesh.points, np.arange(2))

    for s in range(len(f.children)):
        border = f.border[f.first[s] : f.first[s + 1]]
        assert (np.diff(border) > 0).all()
        assert (border >= f.start[s + 1]).all()
