"""The textbook: steps worked out by hand, counters of PERMON, honest claims."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.sparse.linalg import aslinearoperator

from mortarbench.harness import QP, Discs, Status
from mortarbench.harness.conformance.manufactured import unbounded
from mortarbench.harness.names import parse
from mortarbench.problems import PROBLEMS
from mortarbench.solvers import SOLVERS
from mortarbench.solvers.reference.solve import reference_solution
from mortarbench.solvers.smalbe.textbook import (
    PERMON,
    Omega,
    Textbook,
    lanczos,
    mprgp,
    power_method,
)
from tests.solvers.smalbe.test_hostile import ends
from tests.support.discs import qp_on_discs
from tests.support.permon import string

NAMES = ["smalbe-textbook", "smalbe-permon", "smalbe-espreso", "smalbe-paper"]


def minimise(A, b, lower, upper=None, *, alpha_bar, tol=1e-12, options=None):
    """Run MPRGP from Π(0); return its result and the number of products."""
    products = []

    def H(v):
        products.append(v)
        return A @ v

    upper = np.full(b.size, np.inf) if upper is None else upper
    omega = Omega(lower, upper)
    run = mprgp(
        H, b, omega, omega.project(np.zeros(b.size)), options or Textbook(),
        alpha_bar=alpha_bar, stop=lambda x, gradient: gradient <= tol, max_steps=1000,
    )  # fmt: skip
    return run, len(products)


@pytest.mark.parametrize(
    ("expansion", "iterations", "products", "cg", "expansions", "proportionings"),
    [("std", 181, 200, 156, 18, 7), ("projcg", 160, 175, 134, 14, 12)],
)
def test_the_rules_of_permon_take_the_steps_of_permon(
    expansion, iterations, products, cg, expansions, proportionings
):
    """The expected numbers are the counters that PERMON 3.25 prints for this problem at
    rtol = 1e-5.
    """
    A, b, lower = string()
    run, counted = minimise(
        A, b, lower, alpha_bar=2 / power_method(A.__matmul__, b.size),
        tol=1e-5 * np.linalg.norm(b), options=replace(PERMON, expansion=expansion),
    )  # fmt: skip

    assert len(run.steps) == iterations
    assert counted == products
    counts = [run.steps.count(letter) for letter in "cep"]
    assert counts == [cg, expansions, proportionings]


@pytest.mark.parametrize(
    ("expansion", "alpha_bar", "steps", "products"),
    [
        # To (⅔, −1) on the boundary, then by ᾱφ = (−4/3, 0) to the solution
        ("std", 1.0, "e", 3),
        # half as far, and a CG step along the face
        ("std", 0.5, "ec", 4),
        # Π(x − α_cg p) with α_cg = 1 is the solution
        ("projcg", 0.5, "e", 3),
        ("mixed", 0.5, "e", 3),
    ],
)
def test_expansions_by_hand(expansion, alpha_bar, steps, products):
    """Minimise ½‖x‖² − 2x₁ + 3x₂ over x ≥ −1 from 0, where p = φ = (−2, 3)."""
    run, counted = minimise(
        np.eye(2), np.array([2.0, -3]), np.full(2, -1.0), alpha_bar=alpha_bar,
        options=Textbook(expansion=expansion),
    )  # fmt: skip

    assert (run.steps, counted) == (steps, products)
    assert run.x == pytest.approx([2, -1])


def test_a_projected_step_that_raises_the_cost_falls_back_to_the_standard_step():
    """f = ½xᵀHx − bᵀx from 0 over x ≥ (−0.1, −10): x − α_cg p = (−0.8, −0.6), and its
    projection (−0.1, −0.6) costs 0.095, since H couples x₁ and x₂ strongly.
    """
    H, p = np.array([[1.0, -0.99], [-0.99, 1]]), np.array([0.8, 0.6])
    b = -p * (p @ H @ p)
    run, counted = minimise(
        H, b, np.array([-0.1, -10]), alpha_bar=0.5, options=Textbook(expansion="mixed")
    )

    projected = np.array([-0.1, -0.6])
    assert 0.5 * projected @ H @ projected > b @ projected
    assert run.steps[0] == "f"
    assert run.x == pytest.approx([-0.1, b[1] - 0.099])
    assert counted == 1 + 3 + run.steps[1:].count("c")


@pytest.mark.parametrize("name", NAMES)
def test_proportioning_respects_the_upper_bound(name):
    """For ½x² − 10x on [0, 1], PERMON's proportioning step ends at 10."""
    qp = QP.from_arrays([[1]], [-10], lb=0, ub=1)
    s = SOLVERS[name].prepare(qp, 1e-8)()

    assert s.status is Status.SOLVED
    assert s.x.tolist() == [1]
    assert s.z_box == pytest.approx([9])


@pytest.mark.parametrize("Gamma", [0.1, 1.0, 10.0])
def test_a_face_is_left_if_the_chopped_gradient_exceeds_gamma_times_the_free_one(Gamma):
    """At x = 0, φ = (−1, 0) and β = (0, −5): Γ = 10 minimises along the face first."""
    run, _ = minimise(
        np.diag([1.0, 2.0]), np.array([1.0, 5]), np.array([-9.0, 0]), alpha_bar=0.5,
        options=Textbook(Gamma=Gamma),
    )  # fmt: skip

    assert run.steps == ("cp" if Gamma == 10 else "pc")
    assert run.x == pytest.approx([1, 2.5])


@pytest.mark.parametrize("name", NAMES)
def test_the_outer_loop_by_hand(name):
    """Minimise ½‖x‖² over x₁ + x₂ = 2: H = I for ρ = 1, and one step solves. Since
    b = 0, η refers to the first gradient; with η = 1, no step would be taken.
    """
    qp = QP.from_arrays(np.eye(2), [0, 0], A=[1, 1], b=2)
    solver = replace(SOLVERS[name], rho=1.0, norm="lanczos", eta=0.1)
    s = solver.prepare(qp, 1e-8)()

    assert s.status is Status.SOLVED
    assert (s.counts["cg"], s.counts["outer"]) == (1, 1)
    assert s.x == pytest.approx([1, 1])
    assert s.y == pytest.approx([-1])


def test_a_solve_without_rows_prints_nothing(capfd):
    """LAPACK reports empty systems on stdout, which may be the JSON of a command."""
    qp = QP.from_arrays(np.eye(2), [-1, 1], lb=0)
    assert Textbook().prepare(qp, 1e-8)().x == pytest.approx([1, 0])
    assert capfd.readouterr() == ("", "")


def test_a_growing_penalty_takes_fewer_outer_iterations():
    """Minimise ½‖x‖² over x₁ + x₂ = 1, x₁ ≤ 0.2: x = (0.2, 0.8) and y = −0.8."""
    qp = QP.from_arrays(np.eye(2), [0, 0], A=[1, 1], b=1, ub=[0.2, np.inf])
    outer = []
    for growth in (1.0, 2.0, 10.0):
        s = Textbook(rho=0.1, late_growth=growth).prepare(qp, 1e-8)()
        assert s.status is Status.SOLVED
        assert s.x == pytest.approx([0.2, 0.8])
        assert s.y == pytest.approx([-0.8])
        outer.append(s.counts["outer"])

    assert outer[2] < outer[1] < outer[0]


def test_multipliers_converge_at_the_rate_of_the_method_of_multipliers():
    """For minimise ½‖x‖² − dᵀx over x₁ = x₂, A = diag(1, 0) in rotated variables. With
    exact inner solutions and no bounds, the rows hold after one outer iteration.
    """
    qp = QP.from_arrays(np.eye(2), [-3, -1], A=[1, -1], b=0)
    s = Textbook(M=1e-6).prepare(qp, 1e-10)()

    assert s.counts["outer"] == 1
    assert s.x == pytest.approx([2, 2])
    assert s.y == pytest.approx([1])


def rays():
    """Yield QPs whose objective is unbounded below."""
    yield unbounded()
    yield QP.from_arrays(np.zeros((2, 2)), [1, 0], ub=3)
    rng = np.random.default_rng(271828)
    W = rng.standard_normal((6, 5))
    P = W @ W.T  # the kernel is one-dimensional
    kernel = np.linalg.svd(W.T)[2][-1]
    lower = np.where(kernel > 0, -1.0, -np.inf)  # the ray is +kernel
    upper = np.where(kernel > 0, np.inf, 1.0)
    yield QP.from_arrays(P, -kernel + W @ rng.standard_normal(5), lb=lower, ub=upper)
    row = kernel[1] * np.eye(6)[0] - kernel[0] * np.eye(6)[1]  # orthogonal to the ray
    yield QP.from_arrays(P, -kernel, A=row, b=0.1, lb=lower, ub=upper)


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("qp", list(rays()))
def test_unbounded_qps_are_reported(name, qp):
    s = SOLVERS[name].prepare(qp, 1e-8)()
    assert s.status is Status.UNBOUNDED

    # without a diagonal of P, the ray is no proof
    s = SOLVERS[name].prepare(replace(qp, P=aslinearoperator(qp.P)), 1e-8)()
    assert s.status is Status.FAILED
    assert s.message == "a direction of descent has no curvature and no bound"


@pytest.mark.parametrize("name", NAMES)
def test_a_row_that_misses_a_disc_is_reported(name):
    qp = QP.from_arrays(np.eye(2), [0, 0], A=[1, 0], b=2, sets=(Discs([[0, 1]], [1]),))
    s = SOLVERS[name].prepare(qp, 1e-8)()
    assert s.status is Status.INFEASIBLE


@pytest.mark.parametrize("name", NAMES)
def test_a_singular_matrix_with_a_bounded_objective_is_solved(name):
    """q is in the range of P: no direction without curvature descends."""
    rng = np.random.default_rng(314159)
    W = rng.standard_normal((8, 4))
    qp = QP.from_arrays(W @ W.T, W @ rng.standard_normal(4), lb=-1)

    assert SOLVERS[name].prepare(qp, 1e-8)().status is Status.SOLVED


@pytest.mark.parametrize("seed", range(20))
def test_parts_of_a_gradient_and_feasible_lengths(seed):
    """−φ and −β are feasible directions, φ + β is the negative projection of −g onto
    the tangent cone, and α_f is the largest length.
    """
    rng = np.random.default_rng(seed)
    lower, upper = np.full(12, -np.inf), np.full(12, np.inf)
    lower[:3], upper[2:5] = -1, 0.5
    discs = Discs([[6, 7, 8], [9, 10, 11]], [1.0, 2.0])
    omega = Omega(lower, upper, (discs,))
    x = omega.project(3 * rng.standard_normal(12))
    g = rng.standard_normal(12)
    phi, beta = omega.split(x, g)
    t = 1e-7
    tangent = (omega.project(x - t * g) - x) / t

    assert phi @ beta == 0
    assert tangent == pytest.approx(-(phi + beta), abs=1e-5)
    p = rng.standard_normal(12)
    alpha = omega.feasible_length(x, p)
    for length in (alpha * (1 - 1e-9), 0.5 * alpha):
        y = x - length * p
        assert y == pytest.approx(omega.project(y), abs=1e-12)
    y = x - (alpha + 1e-3) * p
    assert np.abs(y - omega.project(y)).max() > 1e-9


def test_the_power_method_stops_at_its_tolerance():
    """For eigenvalues 1 and 1/2, each product reduces the error by a factor of 4, to
    10⁻⁴ in a few products.
    """
    products = []

    def H(v):
        products.append(v)
        return v * [1.0, 0.5]

    assert power_method(H, 2) == pytest.approx(1.0, abs=1e-4)
    assert 5 <= len(products) <= 10


def test_a_step_does_not_stop_short_of_a_bound():
    """A feasible step to 0.3 − 3·0.1 = 5.6e-17 ends exactly at the bound."""
    omega = Omega(np.zeros(2), np.ones(2))
    x = omega.step(np.array([0.3, 1.0]), np.array([0.1, 0.0]), 3.0)

    assert x.tolist() == [0, 1]


@pytest.mark.parametrize("expansion", ["std", "mixed"])
def test_every_iterate_is_feasible_and_the_cost_never_rises(manufactured, expansion):
    qp, _ = manufactured("box", seed=271828, dense=True, n=24)
    omega = Omega(qp.lb, qp.ub)
    seen = [omega.project(np.zeros(24))]
    mprgp(
        qp.P.__matmul__, -qp.q, omega, seen[0], Textbook(expansion=expansion),
        alpha_bar=1.9 / np.linalg.norm(qp.P, 2), stop=lambda x, gradient: False,
        max_steps=30, note=lambda letter, x, g: seen.append(x),
    )  # fmt: skip
    costs = [qp.objective(x) for x in seen]

    assert len(seen) == 31
    assert all((omega.project(x) == x).all() for x in seen)
    assert np.diff(costs).max() <= 1e-13 * abs(costs[0])


@pytest.mark.parametrize("seed", range(5))
def test_estimates_of_the_norm(seed):
    """The power method yields a lower bound, Lanczos the norm to a per cent."""
    rng = np.random.default_rng(seed)
    Q = np.linalg.qr(rng.standard_normal((30, 30)))[0]
    H = (Q * np.linspace(0, 1, 30) ** 3) @ Q.T

    assert 0.8 <= power_method(H.__matmul__, 30) <= 1 + 1e-12
    assert lanczos(H.__matmul__, 30) == pytest.approx(1, rel=0.01)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"expansion": "model"}, "expected 'std', 'projcg' or 'mixed'"),
        ({"alpha": 2.5}, "alpha = 2.5; expected at most 2"),
        ({"beta": 1.0}, "beta = 1.0; expected a number between 0 and 1"),
        ({"rho_growth": 0.5}, "rho_growth = 0.5; expected at least 1"),
    ],
)
def test_wrong_options_are_refused(options, message):
    with pytest.raises(ValueError, match=message):
        Textbook(**options)


def agreeing_answers(qp, tol=1e-8):
    """Return the answers of the compiled solver and of the textbook, both solved."""
    solvers = (SOLVERS["smalbe"], SOLVERS["smalbe-textbook"])
    fast, slow = (solver.prepare(qp, tol)() for solver in solvers)
    assert fast.status is slow.status is Status.SOLVED
    energy = abs(qp.objective(fast.x)) + 0.5 * fast.x @ (qp.P @ fast.x)
    assert qp.objective(slow.x) == pytest.approx(
        qp.objective(fast.x), abs=1e-7 * energy
    )
    return fast, slow


@pytest.mark.parametrize("rows", [0, 2])
@pytest.mark.parametrize("seed", range(4))
def test_the_compiled_solver_has_the_answers_of_the_textbook_on_discs(seed, rows):
    qp, x = qp_on_discs(seed + 400, dim=2 + seed % 2, rows=rows)
    for s in agreeing_answers(qp):
        assert s.x == pytest.approx(x, abs=1e-5 * np.abs(x).max())


@pytest.mark.parametrize(
    "case",
    [
        "beam-ring/Nr=4/Nh=3/step=10/dual",
        "membranes/S=2/n=4/dual",  # P is an operator, and rows are those of subdomains
        "greco/n=16/dual",
    ],
)
def test_contact_forces_agree_with_those_of_the_textbook(case):
    qp = parse(case, PROBLEMS).build(reference_solution).qp
    fast, slow = agreeing_answers(qp)
    bounded = np.isfinite(qp.lb) | np.isfinite(qp.ub)
    forces = fast.x[bounded]

    assert slow.x[bounded] == pytest.approx(forces, abs=1e-5 * np.abs(forces).max())


@pytest.mark.slow
def test_no_claim_about_a_hostile_qp_is_wrong():
    """The QPs have solutions; see `tests.solvers.smalbe.test_hostile`."""
    _, runs, wrong = ends(range(1000, 1015), "smalbe-textbook")

    assert runs == 45
    assert wrong == []
