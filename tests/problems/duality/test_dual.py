"""Generalised inverses, condensation and dualisation: algebraic identities."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.sparse import csc_array, csr_array

from mortarbench.harness import QP, Solution, Status
from mortarbench.harness.verify.kkt import kkt_residuals
from mortarbench.problems import PROBLEMS
from mortarbench.problems.contact.linearise import linearisation
from mortarbench.problems.contact.stepping import load_steps
from mortarbench.problems.duality.dualisation import dual_bounds, dualise
from mortarbench.problems.duality.monolithic import load_path, primal_qp, recovered
from mortarbench.problems.families.beam_ring import model
from mortarbench.problems.fem.elasticity import (
    Material,
    elasticity_matrix,
    rigid_modes,
    stiffness,
)
from mortarbench.problems.fem.fixing import fixing_nodes, spectral_fixing_nodes
from mortarbench.problems.fem.inverse import (
    Interface,
    floating_inverse,
    regular_inverse,
)
from mortarbench.problems.fem.mesh import dofs_of, half_ring, join, rectangle
from mortarbench.solvers.adapters.clarabel_ import Clarabel
from mortarbench.solvers.reference.solve import reference_solution

D = elasticity_matrix(Material(E=2e3, nu=0.3), "strain")
BEAM = rectangle((0, 0.5), (2, 0.25), (24, 3))
RING = half_ring((1, 0), (0.3, 0.49), (24, 4))
MESH, _ = join((BEAM, RING))
TOUCHED = dofs_of(np.concatenate([MESH.boundaries[b] for b in ("outer", "bottom")]), 2)
ONTO = Interface(TOUCHED, MESH.points)


def floating_of(interface):
    """Return the stiffness of both bodies and its generalised inverse."""
    parts = [BEAM.points, RING.points]
    K = stiffness(MESH, D)
    inverse = floating_inverse(
        K,
        [rigid_modes(p) for p in parts],
        [dofs_of(fixing_nodes(p), 2) for p in parts],
        interface,
    )
    return K, inverse


@pytest.fixture(scope="module", params=[None, ONTO], ids=["factor", "condensed"])
def floating(request):
    return floating_of(request.param)


def test_the_inverse_is_a_symmetric_generalised_inverse(floating):
    K, inverse = floating
    K_plus = inverse(np.eye(K.shape[0]))

    assert abs(K @ K_plus @ K - K).max() <= 1e-10 * abs(K).max()
    assert abs(K_plus - K_plus.T).max() <= 1e-10 * abs(K_plus).max()


def test_the_kernel_is_the_whole_kernel(floating):
    K, inverse = floating
    R = inverse.kernel

    assert R.shape[1] == 6
    assert R.T @ R == pytest.approx(np.eye(6), abs=1e-14)
    assert abs(K @ R).max() <= 1e-12 * abs(K).max()
    assert np.linalg.eigvalsh(K.toarray())[6] > 1e-8 * abs(K).max()


@pytest.mark.parametrize("seed", [271828, 314159])
def test_the_congruence_is_that_of_a_dense_inverse(floating, seed):
    K, inverse = floating
    rng = np.random.default_rng(seed)
    B = np.zeros((5, K.shape[0]))
    B[:, TOUCHED] = rng.standard_normal((5, TOUCHED.size))
    K_plus = inverse(np.eye(K.shape[0]))

    F = inverse.congruence(csr_array(B))

    assert (F == F.T).all()
    assert pytest.approx(B @ K_plus @ B.T, rel=1e-9) == F


@pytest.mark.parametrize("interface", [None, ONTO], ids=["factor", "condensed"])
def test_a_supported_body_has_its_inverse_on_the_free_components(interface):
    K = stiffness(MESH, D)
    fixed = dofs_of(
        np.concatenate(
            [MESH.boundaries[b] for b in ("left", "left_foot", "right_foot")]
        ),
        2,
    )
    free = np.setdiff1d(np.arange(MESH.dofs), fixed)
    exact = np.zeros(K.shape)
    exact[np.ix_(free, free)] = np.linalg.inv(K.toarray()[np.ix_(free, free)])
    B = np.zeros((TOUCHED.size, MESH.dofs))
    B[np.arange(TOUCHED.size), TOUCHED] = 1  # prescribed components among them

    inverse = regular_inverse(K, free, interface)

    scale = abs(exact).max()
    assert_allclose(inverse(np.eye(MESH.dofs)), exact, rtol=0, atol=1e-10 * scale)
    assert_allclose(
        inverse.congruence(csr_array(B)), B @ exact @ B.T, rtol=0, atol=1e-10 * scale
    )


def test_rows_outside_the_condensed_interface_are_refused():
    _, inverse = floating_of(ONTO)
    fixed = dofs_of(MESH.boundaries["left"], 2)
    B = csr_array((np.ones(1), ([0], [fixed[0]])), shape=(1, MESH.dofs))

    with pytest.raises(ValueError, match="outside the condensed interface"):
        inverse.congruence(B)


def test_displacements_at_constraints_are_those_of_the_whole_inverse(floating):
    K, inverse = floating
    b = np.zeros(K.shape[0])
    b[TOUCHED] = np.random.default_rng(223606).standard_normal(TOUCHED.size)

    u = inverse.at_constraints(b)

    assert u[TOUCHED] == pytest.approx(inverse(b)[TOUCHED], rel=1e-9)


def condition(mesh, nodes):
    """Return the condition number of the stiffness with `nodes` fixed."""
    K = stiffness(mesh, D).toarray()
    free = np.setdiff1d(np.arange(mesh.dofs), dofs_of(np.asarray(nodes), 2))
    return np.linalg.cond(K[np.ix_(free, free)])


@pytest.mark.parametrize("mesh", [BEAM, RING], ids=["beam", "ring"])
def test_well_spread_fixing_nodes_condition_the_stiffness_well(mesh):
    """With distant fixing nodes, the condition number is below that of K on its range;
    with two neighbouring nodes, it is more than 20 times that of K on its range."""
    eigenvalues = np.linalg.eigvalsh(stiffness(mesh, D).toarray())
    effective = eigenvalues[-1] / eigenvalues[3]
    spectral = spectral_fixing_nodes(mesh.cells, len(mesh.points))

    assert len(set(spectral)) == len(set(fixing_nodes(mesh.points))) == 4
    assert condition(mesh, fixing_nodes(mesh.points)) < effective
    assert condition(mesh, spectral) < effective
    assert condition(mesh, [0, 1]) > 20 * effective


def test_spectral_bisection_of_a_strip_finds_the_centres_of_its_quarters():
    """The Fiedler vector of a long strip is monotone along the strip, so that the
    central nodes are at ⅛, ⅜, ⅝ and ⅞ of its length."""
    strip = rectangle((0, 0), (8, 1), (32, 4))

    nodes = spectral_fixing_nodes(strip.cells, len(strip.points))

    x, y = strip.points[nodes].T
    assert np.sort(x) == pytest.approx([1, 3, 5, 7], abs=0.3)
    assert y == pytest.approx(0.5, abs=0.3)


def clamped_bar(n=12):
    """Return the QP of a row of springs, clamped on the left, with stops from node 6
    on."""
    K = 2 * np.eye(n) - np.eye(n, k=1) - np.eye(n, k=-1)
    K[0, 0] = K[-1, -1] = 1
    G = np.eye(n)[6:]
    f = np.linspace(0.1, 0.3, n)
    return QP(
        P=csc_array(K), q=-f,
        A=csr_array(np.eye(n)[:1]), b=np.zeros(1),
        G=csr_array(G), h=np.full(6, 4.0),
        lb=np.full(n, -np.inf), ub=np.full(n, np.inf),
    )  # fmt: skip


def test_recovered_points_of_the_duals_solve_the_primal_problem():
    """The recovered point satisfies the KKT conditions of the primal problem, and the
    objectives satisfy the relation of `Transformed`."""
    primal = clamped_bar()
    inverse = regular_inverse(primal.P, np.arange(1, 12))
    dual = dual_bounds(primal, inverse)
    s = reference_solution(dual.qp)

    back = dual.recover(s)

    assert kkt_residuals(dual.qp, s).worst < 1e-12
    assert kkt_residuals(primal, back).worst < 1e-12
    assert back.x[0] == 0
    assert (back.z > 0).any()
    assert dual.sign * dual.qp.objective(s.x) + dual.constant == pytest.approx(
        primal.objective(back.x)
    )


def test_eliminated_supports_may_leave_rigid_motions_which_contact_balances():
    """For Hertz's sphere, both duals recover the same displacement."""
    bodies = PROBLEMS["hertz-sphere"].with_keys(n=1).problem().bodies.assembled
    rows = linearisation(bodies, "nts", "dual")(np.zeros(bodies.mesh.dofs))
    primal = primal_qp(bodies, rows)
    answers = []
    for dual in (
        dualise(primal, bodies.floating), dual_bounds(primal, bodies.supported)
    ):  # fmt: skip
        s = reference_solution(dual.qp)
        back = dual.recover(s)
        answers.append(back.x)
        assert kkt_residuals(primal, back).worst < 1e-10
        touched = bodies.interface
        assert dual.interface_displacement(s)[touched] == pytest.approx(
            back.x[touched], abs=1e-10
        )
        assert dual.sign * dual.qp.objective(s.x) + dual.constant == pytest.approx(
            primal.objective(back.x)
        )

    assert dual.qp.A.shape == (1, primal.h.size)
    assert_allclose(*answers, atol=1e-10)


def test_equality_rows_become_free_multipliers():
    primal = clamped_bar()
    stiffer = replace(primal, P=csc_array(primal.P.toarray() + 0.1 * np.eye(12)))
    dual = dualise(stiffer, regular_inverse(stiffer.P, np.arange(12)))
    s = Clarabel().prepare(dual.qp, 1e-12)()

    back = dual.recover(s)

    assert np.isinf(dual.qp.lb).tolist() == [True] + 6 * [False]
    assert kkt_residuals(stiffer, back).worst < 1e-10
    assert dual.sign * dual.qp.objective(s.x) + dual.constant == pytest.approx(
        stiffer.objective(back.x)
    )


def test_a_known_free_displacement_changes_nothing():
    primal = clamped_bar()
    inverse = regular_inverse(primal.P, np.arange(1, 12))
    plain, told = (
        dual_bounds(primal, inverse),
        dual_bounds(primal, inverse, inverse(-primal.q)),
    )

    assert (plain.qp.q == told.qp.q).all()
    assert plain.constant == told.constant


def test_recovery_keeps_the_claim():
    primal = clamped_bar()
    dual = dual_bounds(primal, regular_inverse(primal.P, np.arange(1, 12)))
    claim = Solution.without_point(dual.qp, Status.TIME_LIMIT, "too slow")

    back = dual.recover(claim)

    assert (back.status, back.message) == (Status.TIME_LIMIT, "too slow")


@pytest.mark.parametrize("form", ["dual", "dual-bounds"])
def test_the_time_of_a_dual_includes_a_cached_factorisation(form):
    family = PROBLEMS["beam-ring"]
    for step in (1, 2):
        configured = family.with_keys(Nr=3, Nh=2, step=step)
        # the bodies of the same cached problem that `build` uses
        bodies = configured.contact_problem().bodies.assembled
        factor = {"dual": bodies.floating, "dual-bounds": bodies.clamped}[form]
        assert factor.seconds > 0
        case = configured.build(form, reference_solution)
        assert case.dualise_seconds > factor.seconds


class Counted:
    """Generalised inverse K⁺ that counts its solves."""

    def __init__(self, inverse):
        self.inverse, self.solves = inverse, 0

    def __getattr__(self, name):
        return getattr(self.inverse, name)

    def __call__(self, b):
        self.solves += 1
        return self.inverse(b)


@pytest.mark.parametrize(
    ("factorise", "transform"), [("floating", dualise), ("clamped", dual_bounds)]
)
def test_a_path_of_many_steps_recovers_only_requested_steps(factorise, transform):
    geometry = (3, 2, 4, "strain")
    bodies, inverse = (
        model(*geometry),
        Counted(getattr(model(*geometry), factorise)),
    )
    linearise = linearisation(bodies, "nts", "dual")
    path = load_path(
        bodies, load_steps(6, 1, bodies.f, bodies.fixed),
        lambda _: linearise, lambda _: inverse, reference_solution, transform,
    )  # fmt: skip

    last = recovered(path.problem(6))

    assert inverse.solves == 2  # one for the load, and one for the last step
    primal = path.problem(6).problem.primal
    assert kkt_residuals(primal, last).worst <= 1e-6
    recovered(path.problem(3))
    assert inverse.solves == 3
