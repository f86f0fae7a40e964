"""Generalised inverse, dualisation and elimination: identities of linear algebra."""

import numpy as np
import pytest
from scipy.sparse import csc_array, csr_array

from harness import QP, Solution, Status, kkt_residuals, no_rows
from problems.dual import dualise, eliminate
from problems.elasticity import Material, elasticity_matrix, rigid_modes, stiffness
from problems.inverse import fixing_nodes, floating_inverse, regular_inverse
from problems.mesh import half_ring, join, rectangle
from solvers.reference import reference_solution

D = elasticity_matrix(Material(E=2e3, nu=0.3), "strain")
BEAM = rectangle((0, 0.5), (2, 0.25), (24, 3))
RING = half_ring((1, 0), (0.3, 0.49), (24, 4))


@pytest.fixture(scope="module")
def floating():
    mesh, _ = join((BEAM, RING))
    parts = [BEAM.points, RING.points]
    K = stiffness(mesh, D)
    inverse = floating_inverse(
        K, [rigid_modes(p) for p in parts], [fixing_nodes(p) for p in parts]
    )
    return K, inverse


def test_the_generalised_inverse_is_one_and_symmetric(floating):
    K, inverse = floating
    K_plus = inverse(np.eye(K.shape[0]))

    assert abs(K @ K_plus @ K - K).max() <= 1e-10 * abs(K).max()
    assert abs(K_plus - K_plus.T).max() <= 1e-10 * abs(K_plus).max()


def test_the_kernel_is_the_whole_kernel(floating):
    K, inverse = floating
    R = inverse.kernel

    assert R.shape[1] == 6
    assert abs(K @ R).max() <= 1e-12 * abs(K).max()
    assert np.linalg.eigvalsh(K.toarray())[6] > 1e-8 * abs(K).max()


def test_half_products_give_the_congruence_with_the_inverse(floating):
    K, inverse = floating
    B = csr_array(np.random.default_rng(271828).standard_normal((5, K.shape[0])))
    W = inverse.half(B)

    assert W.T @ W == pytest.approx(B @ inverse(B.T.toarray()), rel=1e-9)


def test_fixing_nodes_keep_the_reduced_stiffness_well_conditioned():
    """K without the fixing nodes' dofs: far better than without one corner's edge."""
    K = stiffness(BEAM, D).toarray()

    def condition(nodes):
        free = np.setdiff1d(
            np.arange(BEAM.dofs), np.concatenate([2 * nodes, 2 * nodes + 1])
        )
        return np.linalg.cond(K[np.ix_(free, free)])

    assert condition(fixing_nodes(BEAM.points)) < condition(np.array([0, 1])) / 100


def clamped_bar(n=12):
    """A row of springs, clamped at the left, pushed against stops from node 6 on."""
    K = 2 * np.eye(n) - np.eye(n, k=1) - np.eye(n, k=-1)
    K[0, 0] = K[-1, -1] = 1
    G = np.eye(n)[6:]
    f = np.linspace(0.1, 0.3, n)
    return QP(
        P=csc_array(K), q=-f,
        A=csr_array(np.eye(n)[:1] * 2.0), b=np.array([0.5]),
        G=csr_array(G), h=np.full(6, 4.0),
        lb=np.full(n, -np.inf), ub=np.full(n, np.inf),
    )  # fmt: skip


def test_elimination_and_dualisation_carry_a_solution_all_the_way_back():
    """The recovered point satisfies the KKT conditions of the original problem, and
    the objectives are related as promised."""
    primal = clamped_bar()
    reduced = eliminate(primal)
    dual = dualise(reduced.qp, regular_inverse(reduced.qp.P))
    s = reference_solution(dual.qp)

    middle = dual.recover(s)
    back = reduced.recover(middle)

    assert kkt_residuals(dual.qp, s).worst < 1e-12
    assert kkt_residuals(reduced.qp, middle).worst < 1e-12
    assert kkt_residuals(primal, back).worst < 1e-12
    assert back.x[0] == pytest.approx(0.25)
    assert (back.z > 0).any()
    energy = primal.objective(back.x)
    assert dual.sign * dual.qp.objective(s.x) + dual.constant == pytest.approx(
        reduced.qp.objective(middle.x)
    )
    assert reduced.sign * reduced.qp.objective(middle.x) + reduced.constant == (
        pytest.approx(energy)
    )


def test_elimination_refuses_rows_that_couple_unknowns():
    qp = clamped_bar()
    coupled = QP(P=qp.P, q=qp.q, A=csr_array(np.ones((1, 12))), b=qp.b,
                 G=qp.G, h=qp.h, lb=qp.lb, ub=qp.ub)  # fmt: skip

    with pytest.raises(ValueError, match="exactly one entry"):
        eliminate(coupled)


def test_the_reference_finds_the_planted_active_set():
    """F = diag, so x_i = max(0, d_i / F_ii) exactly."""
    F = np.array([1.0, 2.0, 4.0, 8.0])
    d = np.array([3.0, -1.0, 2.0, -5.0])
    qp = QP(P=np.diag(F), q=-d, A=no_rows(4), b=np.zeros(0), G=no_rows(4),
            h=np.zeros(0), lb=np.zeros(4), ub=np.full(4, np.inf))  # fmt: skip

    s = reference_solution(qp)

    assert s.x == pytest.approx([3, 0, 0.5, 0])
    assert s.z_box == pytest.approx([0, -1, 0, -5])
    assert s.status is Status.SOLVED


def test_the_reference_refuses_what_it_cannot_take():
    qp = clamped_bar()

    with pytest.raises(ValueError, match="lower bounds only"):
        reference_solution(qp)


def test_recovery_keeps_the_claim():
    primal = clamped_bar()
    reduced = eliminate(primal)
    claim = Solution.without_point(reduced.qp, Status.TIME_LIMIT, "too slow")

    back = reduced.recover(claim)

    assert (back.status, back.message) == (Status.TIME_LIMIT, "too slow")
