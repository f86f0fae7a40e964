"""Extreme eigenvalues by Lanczos, where they are known without it."""

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.sparse import csr_array, eye_array

from harness import Vector
from problems.feti.spectrum import projector, spectrum
from tests.support.torn_bodies import torn_pair


def identity(x: Vector) -> Vector:
    return x


def test_eigenvalues_of_a_diagonal_are_its_entries() -> None:
    entries = np.linspace(2.0, 50.0, 40)
    found = spectrum(lambda x: entries * x, identity, 40)
    assert_allclose([found.smallest, found.largest], [2.0, 50.0], rtol=1e-10)
    assert found.condition == pytest.approx(25.0)


def test_equations_take_their_directions_out() -> None:
    entries = np.linspace(2.0, 50.0, 40)
    G = csr_array((np.array([3.0, 0.1]), ([0, 1], [0, 39])), shape=(2, 40))
    rows = csr_array(eye_array(40))
    found = spectrum(lambda x: entries * x, projector(G, rows), 40)
    assert_allclose([found.smallest, found.largest], entries[[1, 38]], rtol=1e-10)


def test_a_preconditioner_changes_the_operator_not_where_it_acts() -> None:
    entries = np.linspace(2.0, 50.0, 40)
    near = 1 / entries
    near[[3, 7]] *= [0.25, 4.0]
    found = spectrum(lambda x: entries * x, identity, 40, lambda x: near * x)
    assert_allclose([found.smallest, found.largest], [0.25, 4.0], rtol=1e-10)


@pytest.mark.parametrize("crowded", ["below", "above"])
def test_the_error_bounds_hold_and_are_as_small_as_asked(crowded: str) -> None:
    entries = 1.0 + 9.0 * np.linspace(0.0, 1.0, 400) ** 2
    if crowded == "above":
        entries = 11.0 - entries
    found = spectrum(lambda x: entries * x, identity, 400, tol=1e-3)
    assert found.steps < 350
    assert abs(found.smallest - 1.0) <= found.smallest_error <= 1e-3
    assert abs(found.largest - 10.0) <= found.largest_error <= 1e-3 * 10.0
    slow = "smallest_error" if crowded == "below" else "largest_error"
    assert getattr(found, slow) > 1e-8  # the other end is found long before
    assert abs(found.condition - 10.0) <= 1.001 * found.condition_error


@pytest.mark.parametrize("rows", ["orthonormal", "chain", "redundant"])
def test_the_projector_is_onto_what_equations_and_rows_leave(rows: str) -> None:
    _, _, pair = torn_pair(rows)
    B = pair.B[: pair.equalities]
    G = csr_array((B @ pair.domains.kernel).T)
    P, dense = projector(G, B), B.toarray()
    x = np.sin(np.arange(B.shape[0]) ** 2)
    y = P(x)
    assert_allclose(P(y), y, atol=1e-12)
    assert abs(G @ y).max() < 1e-10 * abs(G).max()
    u = np.linalg.svd(dense)[0][:, : np.linalg.matrix_rank(dense)]
    assert_allclose(u @ (u.T @ y), y, atol=1e-12)  # in range B
    inside = dense @ np.cos(np.arange(B.shape[1]))  # what is left out is orthogonal
    assert abs((x - y) @ P(inside)) < 1e-9 * np.linalg.norm(inside)
