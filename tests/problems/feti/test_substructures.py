"""Local problems of torn bodies, compared with dense linear algebra."""

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.linalg import block_diag, null_space

from mortarbench.problems.feti.substructures import LocalProblems
from tests.support.decomposed_bodies import decomposed_pair


@pytest.fixture(scope="module")
def parts() -> LocalProblems:
    """Return the local problems of beam and ring of the benchmark in subdomains."""
    return decomposed_pair(most=8)[2].local_problems


def dense(parts: LocalProblems) -> np.ndarray:
    domains = parts.torn.domains
    blocks = (domains.template(k).K.toarray() for k in domains.class_of)
    return np.asarray(block_diag(*blocks))


def test_a_solve_projects_out_rigid_motions(
    parts: LocalProblems,
) -> None:
    """PK⁺Pb is the pseudoinverse of PKP applied to b, even for forces with
    resultants."""
    K, R = dense(parts), parts.kernel.toarray()
    rng = np.random.default_rng(8)
    b = rng.standard_normal(len(K)) + 1e3 * (R @ rng.standard_normal(R.shape[1]))
    found = parts.solve(b)

    balanced = b - R @ np.linalg.lstsq(R, b, rcond=None)[0]
    assert_allclose(K @ found, balanced, atol=1e-9 * np.abs(balanced).max())
    assert np.abs(R.T @ found).max() <= 1e-9 * np.abs(found).max()


def test_a_subdomain_without_force_has_no_displacement(parts: LocalProblems) -> None:
    start = parts.torn.domains.start
    b = np.zeros(start[-1])
    b[start[1] + 4] = 1.0
    found = parts.solve(b)
    assert found[start[1] : start[2]].any()
    assert not found[: start[1]].any()
    assert not found[start[2] :].any()


def test_the_kernel_is_that_of_the_stiffness(parts: LocalProblems) -> None:
    """Each subdomain has three rigid motions, which span the null space of its K."""
    R, start = parts.kernel.toarray(), parts.torn.domains.start
    assert R.shape[1] == 3 * (start.size - 1)
    own = slice(start[0], start[1])
    N = null_space(dense(parts)[own, own], rcond=1e-10)
    assert N.shape[1] == 3
    assert_allclose(N @ (N.T @ R[own]), R[own], atol=1e-9)


def test_weights_are_traces_of_nodal_blocks_and_diagonals_those_of_the_whole(
    parts: LocalProblems,
) -> None:
    K, T = dense(parts), parts.spread.toarray()
    trace = K.diagonal().reshape(-1, 2).sum(axis=1)
    assert_allclose(parts.weight, np.repeat(trace, 2))
    at = np.flatnonzero(T.any(axis=0))[::7]
    assert_allclose(parts.diagonal(at), (T.T @ K @ T).diagonal()[at])


def test_a_product_projects_rigid_motions_out_on_both_sides(
    parts: LocalProblems,
) -> None:
    K, R = dense(parts), parts.kernel.toarray()
    rng = np.random.default_rng(10)
    v = rng.standard_normal(len(K)) + 10 * (R @ rng.standard_normal(R.shape[1]))
    P = np.eye(len(K)) - R @ np.linalg.pinv(R)
    expected = P @ (K @ (P @ v))
    for precision in (np.float64, np.longdouble):
        found = parts.product(v.astype(precision))
        assert found.dtype == precision
        assert_allclose(
            found.astype(float), expected, atol=1e-11 * np.abs(expected).max()
        )


def test_a_squared_product_is_with_the_squares_of_all_entries(
    parts: LocalProblems,
) -> None:
    K = dense(parts)
    v = np.random.default_rng(11).standard_normal(len(K))
    expected = K**2 @ v
    found = parts.squared_product(v)
    assert_allclose(found, expected, atol=1e-12 * np.abs(expected).max())
    assert_allclose(dense(parts), K, atol=0)  # K is unchanged


def test_products_keep_digits_beyond_those_of_a_double(parts: LocalProblems) -> None:
    """The product is linear in a part of v that a double cannot represent beside v."""
    rng = np.random.default_rng(12)
    v, part = rng.standard_normal((2, parts.spread.shape[0])).astype(np.longdouble)
    part *= np.longdouble(2) ** -50
    change = parts.product(v + part) - parts.product(v)
    expected = parts.product(part)
    assert np.abs(change - expected).max() <= 0.01 * np.abs(expected).max()
