"""The reference solve of QPs whose P is an operator with preconditioners."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.sparse import csr_array

from mortarbench.harness import QP, Discs, no_rows
from mortarbench.solvers.reference.operators import reference_of_operator
from mortarbench.solvers.reference.solve import MAX_ASSEMBLED, reference_solution


class Diagonal:
    """P = diag(d), with the interface of the operators of subdomains."""

    def __init__(self, d):
        self.d, self.shape = np.asarray(d), (len(d), len(d))

    def __matmul__(self, x):
        return self.d * x

    def diagonal(self):
        return self.d

    def preconditioner(self, kind, scaling):
        return lambda x: x / self.d


def balance(q, force, moment):
    """Return min ½|x|² + qᵀx, x ≥ 0, for a body on three contacts at −1, 0 and 1."""
    return QP(
        P=Diagonal(np.ones(3)), q=np.array(q), b=np.array([force, moment]),
        A=csr_array([[1.0, 1.0, 1.0], [-1.0, 0.0, 1.0]]), h=np.zeros(0),
        lb=np.zeros(3), ub=np.full(3, np.inf), G=no_rows(3),
    )  # fmt: skip


def test_contacts_that_support_a_body_carry_its_load():
    """With force 3 and moment 1, the admissible points are x = (t, 2 − 2t, 1 + t); the
    point nearest to −q has t = ½.
    """
    q = np.array([-0.5, -1.0, -1.5])

    solution = reference_of_operator(balance(q, 3.0, 1.0))

    np.testing.assert_allclose(solution.x, -q, atol=1e-12)


def test_a_face_that_leaves_a_body_unsupported_is_refused_in_one_line():
    """Without bounds, x = (−2/3, 7/3, −2/3): one contact remains for two
    rigid motions.
    """
    with pytest.raises(ArithmeticError, match="may lack supports") as refused:
        reference_of_operator(balance([1.0, -2.0, 1.0], 1.0, 0.0))

    assert "\n" not in str(refused.value)


@pytest.fixture
def large():
    """Return min ½xᵀdiag(d)x + qᵀx, −1 ≤ x ≤ 2, with more unknowns than are assembled.

    Components 2i and 2i + 1 have equal entries of d.
    """
    rng, n = np.random.default_rng(3), MAX_ASSEMBLED + 2
    return QP(
        P=Diagonal(np.repeat(rng.uniform(0.1, 10, n // 2), 2)), h=np.zeros(0),
        q=3 * rng.standard_normal(n), A=no_rows(n), b=np.zeros(0), G=no_rows(n),
        lb=np.full(n, -1.0), ub=np.full(n, 2.0),
    )  # fmt: skip


def test_a_large_operator_with_a_preconditioner_is_solved(large):
    x = reference_solution(large).x

    assert x == pytest.approx(np.clip(-large.q / large.P.d, -1, 2), rel=1e-13)


def test_each_pair_of_variables_is_projected_onto_its_disc(large):
    n = large.q.size
    free = large.with_bounds(np.full(n, -np.inf), np.full(n, np.inf))
    discs = Discs(np.arange(n).reshape(-1, 2), np.full(n // 2, 0.7))
    x = reference_solution(replace(free, sets=(*free.sets, discs))).x

    assert x == pytest.approx(discs.project(-large.q / large.P.d), rel=1e-10)


def test_inequality_rows_of_a_large_operator_are_refused_in_one_line(large):
    rows = {"G": csr_array(np.ones((1, large.q.size))), "h": np.ones(1)}

    with pytest.raises(ValueError, match="at most one set of discs") as refused:
        reference_solution(replace(large, **rows))

    assert "\n" not in str(refused.value)
