"""Steps of MPRGP, which cannot be checked by solutions alone."""

import re
from collections import Counter
from functools import partial
from itertools import pairwise
from types import SimpleNamespace
from typing import Any, NamedTuple

import numpy as np
import pytest

from mortarbench.harness import no_rows
from mortarbench.solvers.smalbe.compiled import SMALBE, Product, Rows
from mortarbench.solvers.smalbe.projected import Iterate, Projected, Spectrum
from mortarbench.solvers.smalbe.rows import orthonormal_rows
from mortarbench.solvers.smalbe.spectrum import Ritz
from mortarbench.solvers.smalbe.textbook import Omega
from tests.support.permon import string


class Rules(NamedTuple):
    """Options of MPRGP, see `solvers.smalbe.options`."""

    Gamma: float = 1.0
    relaxation: float = 1.9
    kept: int = 0
    step_rule: Any = None  #: `solvers.smalbe.extension.StepRule`


class Model(NamedTuple):
    """The model B = τI + UᵀWU with the diagonal w of W and orthonormal rows of U."""

    tau: float
    U: Any
    w: Any

    @classmethod
    def of_norm(cls, tau, n):
        return cls(tau, np.zeros((0, n)), np.zeros(0))


class Point(NamedTuple):
    x: Any
    g: Any


def projected_cg(step):
    return step.x - step.alpha_cg * step.p


PROJECTED = Rules(step_rule=projected_cg)  # allows every type of step


def run_compiled(
    A, b, lower, upper, x, *, tau, tol, rules, B, M, watch=None, max_steps=10_000
):
    """Run the compiled MPRGP on a problem without rows.

    A model corresponds to Ritz pairs without residuals. Step rules work without a model
    and use τ = 1/ᾱ, so they are run in units in which this holds.
    """
    B = B or Model.of_norm(tau, b.size)
    unit = rules.relaxation * B.tau if rules.step_rule else 1.0
    order = np.argsort(-B.w)
    ritz = Ritz(
        np.append(B.w[order] + B.tau, B.tau), np.zeros(B.w.size + 1),
        np.vstack([B.U[order], np.zeros(b.size)]), 1.0,
    )  # fmt: skip
    rows, F = orthonormal_rows(no_rows(b.size), np.zeros(0)), Product(A, b.size)
    problem = Projected(
        F, rows, Rows(rows), Spectrum(unit, ritz), b / unit,
        (lower, upper), -b, np.zeros(0),
    )  # fmt: skip
    options = SimpleNamespace(
        Gamma=rules.Gamma, expansion="model", alpha=rules.relaxation,
        recycle=rules.kept > 0, max_steps=max_steps, eta=0.1, beta=0.5,
    )  # fmt: skip
    solver = SMALBE(
        problem, options, M is not None, None if M is None else M.__matmul__,
        rules.step_rule,
    )  # fmt: skip
    at = Iterate(x, (A @ x - b) / unit, np.zeros(0), 1.0, 1.0)
    omega = Omega(lower, upper)

    def note(letter, x, g):
        watch(letter, Point(x, unit * g), ~omega.active(x))

    x, g, *_, outer, status = solver.solve(
        options, tol / np.linalg.norm(b), at, lambda nu: False,
        watch and (lambda k, rhs: note),
    )  # fmt: skip
    run = SimpleNamespace(
        x=x, g=unit * g, trace=outer[0][0], stopped=status == "solved"
    )
    return run, F.count


def minimise(
    A,
    b,
    lower,
    upper=None,
    x=None,
    *,
    alpha=None,
    tol=1e-10,
    rules=PROJECTED,
    B=None,
    M=None,
    **options,
):
    A, b, lower = (np.asarray(v, dtype=float) for v in (A, b, lower))
    upper = np.full(b.size, np.inf) if upper is None else np.asarray(upper, dtype=float)
    x = (
        np.clip(np.zeros(b.size), lower, upper)
        if x is None
        else np.asarray(x, dtype=float)
    )
    tau = 1 / alpha if alpha else np.linalg.norm(A, 2) / 1.9
    return run_compiled(
        A, b, lower, upper, x, tau=tau, tol=tol, rules=rules, B=B, M=M, **options
    )


def test_without_active_bounds_it_is_conjugate_gradients():
    """The number of steps is the number of distinct eigenvalues."""
    run, products = minimise(
        np.diag(np.repeat([1.0, 3.0, 10.0, 40.0], 5)), np.arange(1.0, 21.0),
        np.full(20, -np.inf),
    )  # fmt: skip

    assert (run.trace, products) == ("cccc", 4)


@pytest.mark.parametrize(("Gamma", "first"), [(1.9, "p"), (2.1, "c")])
def test_proportioning_when_beta_exceeds_gamma_times_phi(Gamma, first):
    """‖β‖ = 2 and ‖φ̃‖ = ‖φ‖ = 1, so Γ = 2 is the threshold. The algorithm compares
    ‖β‖² with Γ²‖φ‖².
    """
    rules = PROJECTED._replace(Gamma=Gamma)
    run, _ = minimise(np.eye(2), [-1.0, 2.0], [-np.inf, 0.0], rules=rules)

    assert run.trace[0] == first


def test_a_component_about_to_hit_its_bound_does_not_delay_proportioning():
    """φ = 1 but φ̃ = 10⁻⁹ in the first component: the reduced gradient decides."""
    run, _ = minimise(np.eye(2), [-1.0, 0.01], [-1e-9, 0.0], x=[0, 0], alpha=1.0)

    assert run.trace[0] == "p"


def test_proportioning_stops_at_the_opposite_bound():
    """For min ½x² − 10x over [0, 1] from x = 0, the minimising step would end at 10."""
    run, _ = minimise([[1.0]], [10.0], [0.0], [1.0])

    assert run.x == pytest.approx([1.0])
    assert run.trace == "p"


def test_an_expansion_projects_the_cg_step():
    """From (1, 1) with H = I, b = (−1, 0), the CG step ends at (−1, 0), whose
    projection is (0, 0).
    """
    run, products = minimise(np.eye(2), [-1.0, 0.0], [0.0, 0.0], x=[1.0, 1.0])

    assert run.trace == "e"
    assert run.x == pytest.approx([0.0, 0.0])
    assert products == 2


def test_an_expansion_that_raises_the_cost_falls_back_to_a_safe_one():
    """In a tilted valley, the second CG step ends at (−1, 0); its projection onto x₁ =
    0 has a higher cost.

    Each letter c takes one product, and the fallback takes three.
    """
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
    """By hand: the CG step is cut at x₁ = 0 and followed by −ᾱφ on the remaining free
    components.
    """
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


@pytest.mark.parametrize("rules", [Rules(), PROJECTED], ids=["model", "projected cg"])
def test_every_iterate_is_feasible_and_the_cost_never_rises(manufactured, rules):
    qp, _ = manufactured("box", seed=271828, dense=True, n=24)
    costs = []
    for steps in range(30):
        run, _ = minimise(
            qp.P, -qp.q, qp.lb, qp.ub, max_steps=steps, tol=0.0, rules=rules
        )
        costs.append(qp.objective(run.x))

        assert (run.x >= qp.lb).all()
        assert (run.x <= qp.ub).all()
        assert run.g == pytest.approx(qp.P @ run.x + qp.q, abs=1e-12)
    assert np.diff(costs).max() <= 1e-13 * abs(costs[0])


def test_a_step_of_a_model_below_the_operator_is_shortened():
    """H = 4I and B = I: the step of the model is four times too long, and the line
    search ends at x = b/4.
    """
    run, products = minimise(
        4 * np.eye(2), [4.0, 40.0], [0.0, 0.0], B=Model.of_norm(1.0, 2), rules=Rules()
    )

    assert (run.trace, products) == ("p", 1)
    assert run.x == pytest.approx([1.0, 10.0])


def test_an_exact_model_finds_the_minimum_at_once():
    """For B = H, the first step ends at the minimiser."""
    U = np.linalg.qr(np.random.default_rng(271828).standard_normal((20, 4)))[0].T
    B = Model(1.0, U, np.array([50.0, 20.0, 10.0, 5.0]))
    H = np.eye(20) + U.T @ np.diag(B.w) @ U
    b = np.random.default_rng(314159).standard_normal(20)
    run, products = minimise(H, b, np.zeros(20), B=B, rules=Rules())

    assert (run.trace, products) == ("p", 1)


def test_a_preconditioner_in_the_face_is_used_with_conjugation():
    """M = A⁻¹ gives the solution in one step; with M = D⁻¹, the matrix D¹ᐟ²(I + rank
    2)D¹ᐟ² requires three steps.
    """
    rng = np.random.default_rng(271828)
    D, W = np.diag(rng.uniform(1, 100, 30)), rng.standard_normal((30, 2))
    half = np.sqrt(D)
    A, b, lower = (
        half @ (np.eye(30) + W @ W.T) @ half,
        rng.random(30),
        np.full(30, -np.inf),
    )

    def with_(M):
        return minimise(A, b, lower, M=M, tol=1e-8)

    assert with_(np.linalg.inv(A))[0].trace == "c"
    assert with_(np.linalg.inv(D))[0].trace == "ccc"
    assert len(minimise(A, b, lower, tol=1e-8)[0].trace) > 10


def test_the_observer_sees_every_step():
    seen = []
    A, b, lower = string()
    run, _ = minimise(A, b, lower, watch=lambda *step: seen.append(step), tol=1e-6)

    assert "".join(letter for letter, _, _ in seen) == run.trace
    assert (seen[-1][1].x == run.x).all()
    assert (seen[-1][2] == (run.x > lower)).all()


@pytest.mark.parametrize("seed", [1, 2])
def test_a_model_far_below_the_operator_is_raised_in_a_few_steps(seed):
    """For a flat spectrum in [1, 50] and B = I/20, about 27 products suffice; with
    constant τ, 40 are needed.
    """
    rng = np.random.default_rng(seed)
    V = np.linalg.qr(rng.standard_normal((60, 60)))[0]
    H, b = V * np.linspace(1, 50, 60) @ V.T, 10 * rng.standard_normal(60)
    run, products = minimise(
        H, b, np.zeros(60), np.ones(60), B=Model.of_norm(0.05, 60), rules=Rules(),
        tol=1e-8,
    )  # fmt: skip

    assert run.stopped
    assert products <= 32


def test_an_expansion_by_the_model_begins_with_the_half_step():
    """By hand: the CG step is cut at x₁ = 0; the second part ends at the minimum of the
    model, or is extended to the minimum of the cost along the same line.
    """
    A, b, lower = np.array([[1.0, -2.7], [-2.7, 9.0]]), [-1.0, 2.7], [0.0, -np.inf]
    B = Model.of_norm(np.linalg.norm(A, 2), 2)
    before, _ = minimise(A, b, lower, x=[1.0, 0.2], max_steps=1, B=B, rules=Rules())
    after, _ = minimise(A, b, lower, x=[1.0, 0.2], max_steps=2, B=B, rules=Rules())
    p = before.x - np.array([-1.0, 0.0])
    half = before.x - before.x[0] / p[0] * p
    g = A @ half - b
    s = np.maximum(half - g / B.tau, lower) - half
    step = max(1.0, -(g @ s) / (s @ A @ s))

    assert after.trace == "ce"
    assert after.x == pytest.approx(half + step * s)


def test_a_half_step_that_is_the_solution_is_kept():
    """For min ½x² + x over x ≥ −½ from 0, the CG step leads to −1, and the bound is the
    solution.
    """
    run, products = minimise([[1.0]], [-1.0], [-0.5], rules=Rules())

    assert run.stopped
    assert (run.trace, products) == ("e", 1)
    assert run.x == pytest.approx([-0.5])


def model_run(problem, rules, B=None, tol=1e-6):
    """Run MPRGP and record the letter, the active set and the cost of each step."""
    A, b, lower = problem
    upper, seen = np.full(b.size, np.inf), []

    def watch(letter, at, free):
        seen.append((letter, ~free, float(at.x @ (at.g - b)) / 2))

    norm = np.linalg.norm(A, 2)
    run, products = minimise(
        A, b, lower, upper, rules=rules, watch=watch, tol=tol * np.linalg.norm(b),
        B=B or Model.of_norm(norm, b.size),
    )  # fmt: skip
    assert run.stopped
    return seen, products


def test_expansions_by_the_model_keep_what_is_at_a_bound_and_add_to_it():
    """Otherwise an expansion would undo the previous one, and conjugate gradients would
    never start.
    """
    seen, products = model_run(string(), Rules())
    expansions = 0
    for (_, before, _), (letter, after, _) in pairwise(seen):
        if letter == "e":
            expansions += 1
            assert (after | ~before).all()
            assert after.sum() > before.sum()

    assert expansions > 5
    assert products <= 267  # number of products with PERMON's rules


def test_every_model_step_decreases_the_cost():
    steps, _ = model_run(string(), Rules())
    costs = [cost for _, _, cost in steps]

    assert (np.diff(costs) <= 1e-13 * abs(costs[-1])).all()


def tight_box(seed):
    """Draw a spectrum of up to four decades and a box with many active bounds."""
    rng = np.random.default_rng(seed)
    Q = np.linalg.qr(rng.standard_normal((30, 30)))[0]
    A = (Q * np.logspace(0, -rng.uniform(0, 4), 30)) @ Q.T
    lower = -rng.exponential(size=30) * 10 ** rng.uniform(-2, 1)
    upper = rng.exponential(size=30) * 10 ** rng.uniform(-2, 1)
    upper[rng.random(30) < 0.5] = np.inf
    return (A + A.T) / 2, rng.standard_normal(30), lower, upper


def string_and_boxes():
    A, b, lower = string()
    return [(A, b, lower, np.full(b.size, np.inf)), *map(tight_box, range(60))]


def test_there_are_at_most_as_many_steps_beyond_the_box_as_inside():
    """One step beyond the box is allowed without steps inside; hence the products are
    at most doubled.
    """
    most, steps = 0, 0
    for A, b, lower, upper in string_and_boxes():
        run, products = minimise(
            A, b, lower, upper, B=Model.of_norm(np.linalg.norm(A, 2), b.size),
            rules=Rules(), tol=1e-8 * np.linalg.norm(b),
        )  # fmt: skip
        for face in re.findall("c*b+", run.trace):
            assert face.count("b") <= max(face.count("c"), 1)
            most = max(most, face.count("b"))
        steps += run.trace.count("b")
        counts = Counter(run.trace)

        assert run.stopped
        assert products <= len(run.trace) + counts["e"] + 2 * counts["f"]

    assert most >= 5
    assert steps >= 50


def watched(seen, letter, at, free):
    seen.append(at)


def test_each_step_achieves_the_decrease_of_the_convergence_theory():
    """Each step decreases f by at least G/4τ, with G = τ²(x − P(x − g/τ))ᵀg/τ, τ = ‖H‖
    and Γ = 1. Hence f − f* decreases by at least the factor 1 − λ_min/4‖H‖, which the
    book proves for steps of length 1/‖H‖.
    """
    letters = Counter()
    for A, b, lower, upper in string_and_boxes():
        tau = np.linalg.norm(A, 2)
        seen = [Point(np.clip(np.zeros(b.size), lower, upper), b)]
        run, _ = minimise(
            A, b, lower, upper, B=Model.of_norm(tau, b.size), rules=Rules(),
            tol=1e-6 * np.linalg.norm(b), watch=partial(watched, seen),
        )  # fmt: skip
        letters.update(run.trace)
        exact_A, exact_b = A.astype(np.longdouble), b.astype(np.longdouble)
        points = [at.x.astype(np.longdouble) for at in seen]
        costs = np.array([0.5 * x @ exact_A @ x - exact_b @ x for x in points])
        for (x, _), fall in zip(seen, -np.diff(costs), strict=False):
            g = A @ x - b
            G = tau * g @ (x - np.clip(x - g / tau, lower, upper))

            assert fall >= 0.999 * G / (4 * tau) - 1e-14 * np.abs(costs).max()

        least = np.linalg.eigvalsh(A)[0]
        above = costs - costs[-1]
        rate = (1 - least / (4 * tau)) ** np.arange(len(costs))
        assert (above <= above[0] * rate + 1e-10 * above[0]).all()

    assert min(letters[letter] for letter in "cbefp") >= 5


def ill_conditioned(n):
    """Draw a matrix with condition number 10⁸ and distinct eigenvalues, and
    two vectors.
    """
    rng = np.random.default_rng(314159)
    Q = np.linalg.qr(rng.standard_normal((n, n)))[0]
    A = (Q * np.logspace(0, -8, n)) @ Q.T
    return (A + A.T) / 2, *rng.standard_normal((2, n))


def test_conjugate_to_all_directions_cg_ends_after_as_many_steps_as_unknowns():
    """If directions are conjugate to the last one only, rounding errors more than
    double the number of steps.
    """
    n = 40
    A, x, _ = ill_conditioned(n)
    b, free = A @ x, np.full(n, -np.inf)
    kept, _ = minimise(A, b, free, rules=Rules(kept=n))
    last, _ = minimise(A, b, free, rules=Rules())

    assert set(kept.trace) == {"c"}
    assert len(kept.trace) <= n
    assert len(last.trace) > 2 * n
