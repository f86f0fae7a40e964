"""Reference solves over cones with a singular P, as for rigid bodies."""

import numpy as np
import pytest

from mortarbench.harness import QP, Cones
from mortarbench.harness.verify.kkt import kkt_residuals
from mortarbench.solvers.reference.solve import reference_solution
from tests.support.box_stack import box_stack


@pytest.mark.parametrize(
    ("boxes", "mu"),
    [(2, 0.5), *(pytest.param(3, mu, marks=pytest.mark.slow) for mu in (0.5, 0.8))],
)
def test_a_problem_over_cones_with_p_of_half_rank_is_solved_to_rounding(boxes, mu):
    M, H, f, mu_of = box_stack(boxes, mu, seed=0)
    W, q = H.T @ (H / M[:, None]), H.T @ (f / M)
    W, q = W / W.diagonal().max(), q / np.abs(q).max()
    index = np.arange(q.size).reshape(-1, 3)
    qp = QP.from_arrays((W + W.T) / 2, q, sets=(Cones(index, mu_of),))
    s = reference_solution(qp)

    assert np.linalg.matrix_rank(W) <= q.size / 2
    assert kkt_residuals(qp, s).worst <= 1e-12
    step = s.x - qp.sets[1].project(s.x - (W @ s.x + q) / np.linalg.norm(W, 2))
    assert np.linalg.norm(step) <= 1e-12 * np.linalg.norm(s.x)


@pytest.mark.parametrize(
    "seed", [0, 1, *(pytest.param(k, marks=pytest.mark.slow) for k in (2, 3, 4))]
)
def test_cones_with_curvatures_of_different_size_are_solved_to_rounding(seed):
    """Friction between stiff and soft bodies, with indeterminate forces."""
    rng = np.random.default_rng(seed)
    k = 6
    sizes = np.repeat(10.0 ** rng.uniform(-3.5, 0, k), 3)
    M = sizes * rng.standard_normal((3 * k - 4, 3 * k))
    index, slope = np.arange(3 * k).reshape(k, 3), np.full(k, 0.3)
    x, z = np.zeros(3 * k), np.zeros(3 * k)
    for (normal, *tangents), slips in zip(index, rng.random(k) < 0.5, strict=True):
        direction = rng.standard_normal(2)
        direction /= np.linalg.norm(direction)
        x[normal], x[tangents] = 1, 0.3 * direction * (1 if slips else 0.5)
        z[normal], z[tangents] = -0.3 * slips, direction * slips
    z *= sizes**2
    qp = QP.from_arrays(M.T @ M, -(M.T @ (M @ x) + z), sets=(Cones(index, slope),))

    assert kkt_residuals(qp, reference_solution(qp)).worst <= 1e-13
