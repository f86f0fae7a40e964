"""Extreme eigenvalues by Lanczos, where they are known without it."""

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.sparse import csr_array

from problems.feti.spectrum import dependencies, spectrum
from tests.support.torn_bodies import torn_pair

NO_ROWS = csr_array((0, 40))


def test_eigenvalues_of_a_diagonal_are_its_entries() -> None:
    entries = np.linspace(2.0, 50.0, 40)
    found = spectrum(lambda x: entries * x, NO_ROWS)
    assert_allclose([found.smallest, found.largest], [2.0, 50.0], rtol=1e-10)
    assert found.condition == pytest.approx(25.0)


def test_equations_take_their_directions_out() -> None:
    entries = np.linspace(2.0, 50.0, 40)
    G = csr_array((np.array([3.0, 0.1]), ([0, 1], [0, 39])), shape=(2, 40))
    found = spectrum(lambda x: entries * x, G)
    assert_allclose([found.smallest, found.largest], entries[[1, 38]], rtol=1e-10)


def test_a_preconditioner_changes_the_operator_not_where_it_acts() -> None:
    entries = np.linspace(2.0, 50.0, 40)
    near = 1 / entries
    near[[3, 7]] *= [0.25, 4.0]
    found = spectrum(lambda x: entries * x, NO_ROWS, lambda x: near * x)
    assert_allclose([found.smallest, found.largest], [0.25, 4.0], rtol=1e-10)


@pytest.mark.parametrize("crowded", ["below", "above"])
def test_the_error_bounds_hold_and_are_as_small_as_asked(crowded: str) -> None:
    entries = 1.0 + 9.0 * np.linspace(0.0, 1.0, 400) ** 2
    if crowded == "above":
        entries = 11.0 - entries
    found = spectrum(lambda x: entries * x, csr_array((0, 400)), tol=1e-3)
    assert found.steps < 350
    assert abs(found.smallest - 1.0) <= found.smallest_error <= 1e-3
    assert abs(found.largest - 10.0) <= found.largest_error <= 1e-3 * 10.0
    slow = "smallest_error" if crowded == "below" else "largest_error"
    assert getattr(found, slow) > 1e-8  # the other end is found long before
    assert abs(found.condition - 10.0) <= 1.001 * found.condition_error


def test_redundant_rows_depend_on_one_another_at_crosspoints_alone() -> None:
    _, _, pair = torn_pair("redundant")
    B = pair.B[: pair.equalities]
    N = dependencies(B)
    rank = np.linalg.matrix_rank(B.toarray())
    assert N.shape[0] == pair.equalities - rank
    assert_allclose((N @ N.T).toarray(), np.eye(N.shape[0]), atol=1e-12)
    assert abs(N @ B).max() < 1e-10 * abs(B).max()


@pytest.mark.parametrize("rows", ["orthonormal", "chain"])
def test_other_rows_do_not_depend_on_one_another(rows: str) -> None:
    _, _, pair = torn_pair(rows)
    assert dependencies(pair.B[: pair.equalities]).shape[0] == 0
