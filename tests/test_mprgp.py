"""The path that MPRGP takes, which no test of its answer can see."""

import numpy as np
import pytest

from solvers.mprgp import mprgp, split


def minimise(A, b, lower, upper=None, x=None, *, alpha=None, tol=1e-10, **options):
    A, b, lower = (np.asarray(v, dtype=float) for v in (A, b, lower))
    upper = np.full(b.size, np.inf) if upper is None else np.asarray(upper, dtype=float)
    x = (
        np.clip(np.zeros(b.size), lower, upper)
        if x is None
        else np.asarray(x, dtype=float)
    )
    products = []

    def H(v):
        products.append(v)
        return A @ v

    run = mprgp(
        H, b, (lower, upper), (x, A @ x - b),
        alpha=alpha or 1.9 / np.linalg.norm(A, 2),
        stop=lambda x, size: size <= tol, **options,
    )  # fmt: skip
    return run, len(products)


def test_without_active_bounds_it_is_conjugate_gradients():
    """As many steps as there are distinct eigenvalues."""
    run, products = minimise(
        np.diag(np.repeat([1.0, 3.0, 10.0, 40.0], 5)), np.arange(1.0, 21.0),
        np.full(20, -np.inf),
    )  # fmt: skip

    assert (run.trace, products) == ("cccc", 4)


@pytest.mark.parametrize(("Gamma", "first"), [(1.9, "p"), (2.1, "c")])
def test_proportioning_when_beta_exceeds_gamma_times_phi(Gamma, first):
    """‖β‖ = 2, ‖φ̃‖ = ‖φ‖ = 1: Γ = 2 decides; Γ² = 4, not 2, multiplies ‖φ‖² = 1."""
    run, _ = minimise(np.eye(2), [-1.0, 2.0], [-np.inf, 0.0], Gamma=Gamma)

    assert run.trace[0] == first


def test_a_component_about_to_hit_its_bound_does_not_delay_proportioning():
    """φ = 1 but φ̃ = 10⁻⁹ at the first component: the reduced gradient decides."""
    run, _ = minimise(np.eye(2), [-1.0, 0.01], [-1e-9, 0.0], x=[0, 0], alpha=1.0)

    assert run.trace[0] == "p"


def test_proportioning_stops_at_the_opposite_bound():
    """min ½x² − 10x over [0, 1] from x = 0: the minimising step would end at 10."""
    run, _ = minimise([[1.0]], [10.0], [0.0], [1.0])

    assert run.x == pytest.approx([1.0])
    assert run.trace == "p"


def test_an_expansion_projects_the_cg_step():
    """From (1, 1) with H = I, b = (−1, 0): CG ends at (−1, 0), projected (0, 0)."""
    run, products = minimise(np.eye(2), [-1.0, 0.0], [0.0, 0.0], x=[1.0, 1.0])

    assert run.trace == "e"
    assert run.x == pytest.approx([0.0, 0.0])
    assert products == 2


def test_an_expansion_that_raises_the_cost_falls_back_to_a_safe_one():
    """In a tilted valley the second CG step ends at (−1, 0); cut at x₁ = 0 it climbs.
    One product for each c, three for the fallback."""
    A, b, lower = np.array([[1.0, -2.7], [-2.7, 9.0]]), [-1.0, 2.7], [0.0, -np.inf]
    run, products = minimise(A, b, lower, x=[1.0, 0.2])
    before, _ = minimise(A, b, lower, x=[1.0, 0.2], max_steps=1)

    def cost(x):
        return 0.5 * x @ A @ x - b @ x

    assert run.trace == "cfc"
    assert products == 5
    assert cost(np.array([0.0, 0.0])) > cost(before.x)
    assert run.x == pytest.approx([0.0, 0.3])


def test_a_fallback_is_a_half_step_and_a_gradient_projection():
    """By hand: the CG step as far as x₁ = 0, then −ᾱφ on what is still free."""
    A, b, lower = np.array([[1.0, -2.7], [-2.7, 9.0]]), [-1.0, 2.7], [0.0, -np.inf]
    before, _ = minimise(A, b, lower, x=[1.0, 0.2], max_steps=1)
    after, _ = minimise(A, b, lower, x=[1.0, 0.2], max_steps=2)
    target = np.array([-1.0, 0.0])  # of the unconstrained CG step
    p = before.x - target
    half = before.x - before.x[0] / p[0] * p
    g = A @ half - b
    alpha = 1.9 / np.linalg.norm(A, 2)

    assert after.trace == "cf"
    assert half[0] == pytest.approx(0, abs=1e-15)
    assert after.x == pytest.approx([0, half[1] - alpha * g[1]])


def test_a_fixed_variable_neither_moves_nor_delays():
    run, _ = minimise(np.diag([1.0, 2.0]), [3.0, 4.0], [0.5, -np.inf], [0.5, np.inf])

    assert run.stopped
    assert run.x == pytest.approx([0.5, 2.0])


def test_an_unbounded_cost_is_not_called_a_minimum():
    run, _ = minimise([[0.0]], [1.0], [0.0], alpha=1.0)

    assert not run.stopped


@pytest.mark.parametrize("seed", [271828, 314159, 161803])
def test_every_iterate_is_feasible_and_the_cost_never_rises(planted, seed):
    qp, _ = planted("box", seed=seed, dense=True, n=24)
    costs = []
    for steps in range(30):
        run, _ = minimise(qp.P, -qp.q, qp.lb, qp.ub, max_steps=steps, tol=0.0)
        costs.append(qp.objective(run.x))

        assert (run.x >= qp.lb).all()
        assert (run.x <= qp.ub).all()
        assert run.g == pytest.approx(qp.P @ run.x + qp.q, abs=1e-12)
    assert np.diff(costs).max() <= 1e-13 * abs(costs[0])


def test_the_split_gradient_adds_up_and_its_parts_are_admissible():
    x = np.array([0.0, 0.0, 0.5, 1.0, 1.0, 0.3])
    g = np.array([2.0, -2.0, 3.0, 2.0, -2.0, -4.0])
    face = split(x, g, np.zeros(6), np.ones(6), 0.5)

    assert face.phi.tolist() == [0, 0, 3, 0, 0, -4]
    assert face.beta.tolist() == [0, -2, 0, 2, 0, 0]  # only what leads inside
    assert face.phi_reduced == pytest.approx([0, 0, 1, 0, 0, -1.4])
    assert face.projected_norm == pytest.approx(np.sqrt(9 + 16 + 4 + 4))
