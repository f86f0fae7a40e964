"""Reference solves over cones with a singular P, as for rigid bodies."""

import numpy as np
import pytest

from mortarbench.harness import QP, Cones, kkt_residuals
from mortarbench.solvers.reference.solve import reference_solution
from tests.support.box_stack import box_stack


@pytest.mark.parametrize("mu", [0.5, pytest.param(0.8, marks=pytest.mark.slow)])
def test_a_problem_over_cones_with_p_of_half_rank_is_solved_to_rounding(mu):
    M, H, f, mu_of = box_stack(3, mu, seed=0)
    W, q = H.T @ (H / M[:, None]), H.T @ (f / M)
    W, q = W / W.diagonal().max(), q / np.abs(q).max()
    index = np.arange(q.size).reshape(-1, 3)
    qp = QP.from_arrays((W + W.T) / 2, q, sets=(Cones(index, mu_of),))
    s = reference_solution(qp)

    assert np.linalg.matrix_rank(W) <= q.size / 2
    assert kkt_residuals(qp, s).worst <= 1e-12
    step = s.x - qp.sets[1].project(s.x - (W @ s.x + q) / np.linalg.norm(W, 2))
    assert np.linalg.norm(step) <= 1e-12 * np.linalg.norm(s.x)
