"""The distributed reference solver, run on one rank in this process."""

import numpy as np
import pytest
from scipy.sparse import csr_array

from mortarbench.harness import QP, no_rows
from mortarbench.harness.distributed.vectors import (
    DistributedColumns,
    Ranks,
    distributed,
)
from mortarbench.solvers.reference.over_ranks import reference_over_ranks

mpi = pytest.importorskip("mpi4py.MPI")


class Identity:
    """F = I, with the interface of the operators of subdomains."""

    def __init__(self, n, ranks):
        self.shape, self.ranks = (n, n), ranks

    def __matmul__(self, x):
        return x.copy()

    def diagonal(self):
        return distributed(np.ones(self.shape[0]), self.ranks)

    def preconditioner(self, kind, scaling):
        return np.copy


def balance(q, force, moment):
    """Return min ½|x|² + qᵀx, x ≥ 0, for a body on three contacts at −1, 0 and 1."""
    ranks = Ranks(mpi.COMM_SELF)
    G = csr_array([[1.0, 1.0, 1.0], [-1.0, 0.0, 1.0]])
    vectors = (distributed(np.array(v), ranks) for v in (q, 3 * [0.0], 3 * [np.inf]))
    q, lb, ub = vectors
    return QP(
        P=Identity(3, ranks), q=q, A=DistributedColumns(G, ranks),
        b=np.array([force, moment]), h=np.zeros(0), lb=lb, ub=ub,
        G=DistributedColumns(no_rows(3), ranks),
    )  # fmt: skip


def test_contacts_that_support_a_body_carry_its_load():
    """With force 3 and moment 1, the admissible points are x = (t, 2 − 2t, 1 + t); the
    point nearest to −q has t = ½.
    """
    q = np.array([-0.5, -1.0, -1.5])

    solution = reference_over_ranks(balance(q, 3.0, 1.0))

    np.testing.assert_allclose(np.asarray(solution.x), -q, atol=1e-12)


def test_a_face_that_leaves_a_body_unsupported_is_refused_in_one_line():
    """Without bounds, x = (−2/3, 7/3, −2/3): one contact remains for two
    rigid motions.
    """
    with pytest.raises(ArithmeticError, match="may lack supports") as refused:
        reference_over_ranks(balance([1.0, -2.0, 1.0], 1.0, 0.0))

    assert "\n" not in str(refused.value)
