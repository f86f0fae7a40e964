"""String and membrane over an obstacle: closed forms, rates, agreement of the forms."""

import numpy as np
import pytest

from mortarbench.harness.verify.kkt import kkt_residuals
from mortarbench.problems.families.feti_models import (
    CONTACT_RADIUS,
    Obstacle,
    exact_energy,
    exact_height,
    obstacle_height,
    obstacle_problem,
)
from mortarbench.solvers.adapters.clarabel_ import Clarabel
from mortarbench.solvers.reference.solve import reference_solution
from mortarbench.solvers.smalbe.solver import SMALBE

TOL = 1e-11


def solved(solver, form, dim, n):
    case = Obstacle(dim=dim, n=n).build(form, reference_solution)
    if solver is reference_solution:
        s = reference_solution(case.qp)
    else:
        s = solver.prepare(case.qp, TOL)()
    assert kkt_residuals(case.qp, s).worst <= 10 * TOL
    return case, s


def result(dim, n):
    case, s = solved(SMALBE(), "primal", dim, n)
    return case.quantities(s)


def rates(errors):
    return np.log2(np.divide(errors[:-1], errors[1:]))


@pytest.mark.parametrize("dim", [1, 2])
def test_off_the_obstacle_the_exact_height_satisfies_the_differential_equation(dim):
    """Δu = 2 for r > 1; for r ≤ 1 the solution is zero, and its slope is continuous at
    r = 1."""
    rng = np.random.default_rng(20090)
    x, h = rng.uniform(-1.5, 1.5, (400, dim)), 1e-4
    steps = h * np.eye(dim)
    laplacian = sum(
        exact_height(x + e) - 2 * exact_height(x) + exact_height(x - e) for e in steps
    ) / h**2  # fmt: skip
    r = np.linalg.norm(x, axis=1)
    rim = x[abs(r - 1) < 0.05] / r[abs(r - 1) < 0.05, None]

    assert laplacian[r > 1 + h] == pytest.approx(2, abs=1e-5)
    assert (exact_height(x[r <= 1]) == 0).all()
    assert exact_height(rim * (1 + h)) == pytest.approx(h**2, rel=1e-3)


@pytest.mark.parametrize(
    ("dim", "n", "shape", "load", "tol"),
    [(1, 2000, "flat", 2, 1e-5), (2, 700, "flat", 2, 1e-5),
     (2, 800, "hemisphere", 0, 1e-4)],
)  # fmt: skip
def test_the_exact_energy_is_that_of_the_exact_height(dim, n, shape, load, tol):
    """The integral of ½|∇u|² + load·u is evaluated by the midpoint rule."""
    size, h = 4 if shape == "hemisphere" else 3, 1e-5
    x = size * ((np.arange(n) + 0.5) / n - 0.5)
    points = np.stack([a.ravel() for a in np.meshgrid(*[x] * dim)], axis=1)
    slopes = [
        (exact_height(points + e, shape) - exact_height(points - e, shape)) / (2 * h)
        for e in h * np.eye(dim)
    ]
    density = np.square(slopes).sum(axis=0) / 2 + load * exact_height(points, shape)

    energy = density.mean() * size**dim
    assert energy == pytest.approx(exact_energy(dim, shape), rel=tol)


def test_the_string_is_exact_at_the_nodes_if_contact_ends_at_a_node():
    """Linear elements are exact at nodes if the contact region ends at a node."""
    case, s = solved(SMALBE(), "primal", 1, 12)
    got = case.quantities(s)

    assert got["max_error"] <= 1e-14
    assert got["obstacle_force"] == pytest.approx(4, rel=1e-12)
    assert got["active"] == 9
    # error of the interpolant's energy for u″ = 2 over length 1:
    # −½∫(u′ − u_h′)² + ∫2(u_h − u)
    h = 0.25
    assert got["energy"] - 1 / 3 == pytest.approx(-4 * h**2 / 24 + 4 * h**2 / 12)


@pytest.mark.parametrize("phase", [10, 20])
def test_the_string_converges_with_second_order(phase):
    """On all grids, the contact region ends ⅓ or ⅔ of a cell from a node."""
    got = [result(1, n) for n in (4 * phase, 16 * phase, 64 * phase)]

    for error in ("max_error", "energy_error"):
        assert rates([g[error] for g in got]) / 2 == pytest.approx(2, abs=0.1)
    assert got[-1]["force_error"] == pytest.approx(0, abs=1e-5)


def test_the_membrane_converges_with_second_order():
    meshes = (10, 20, 40, 80)
    got = [result(2, n) for n in meshes]

    assert rates([g["energy_error"] for g in got]) == pytest.approx(2, abs=0.1)
    for n, g in zip(meshes, got, strict=True):
        assert g["max_error"] <= 0.2 * (3 / n) ** 2
    assert abs(got[-1]["force_error"]) <= 1e-3


@pytest.mark.parametrize(("dim", "n"), [(1, 20), (2, 12)])
def test_every_form_and_solver_gives_the_same_heights_energy_and_forces(dim, n):
    expected, s = solved(reference_solution, "primal", dim, n)
    u, quantities = expected.recover(s), expected.quantities(s)
    runs = [
        (reference_solution, "dual-bounds"), (SMALBE(), "dual-bounds"),
        (SMALBE(), "primal"), (Clarabel(), "primal"), (Clarabel(), "dual-bounds"),
    ]  # fmt: skip
    for solver, form in runs:
        case, s = solved(solver, form, dim, n)

        assert case.recover(s) == pytest.approx(u, abs=1e-8)
        assert case.quantities(s) == pytest.approx(quantities, rel=1e-6, abs=1e-8)
        assert case.scale * case.qp.objective(s.x) + case.constant == pytest.approx(
            quantities["energy"], rel=1e-9
        )


def test_the_membrane_keeps_the_symmetry_of_the_square():
    case, s = solved(SMALBE(), "primal", 2, 14)
    u = case.recover(s).reshape(15, 15)

    for image in (u.T, u[::-1], u[:, ::-1]):
        assert image == pytest.approx(u, abs=1e-10)


def test_the_boundary_has_the_exact_height():
    problem = obstacle_problem(2, 8)
    at_boundary = abs(problem.x).max(axis=1) == 1.5
    case, s = solved(SMALBE(), "primal", 2, 8)

    assert at_boundary.sum() == problem.qp.b.size == 32
    assert case.recover(s)[at_boundary] == pytest.approx(
        exact_height(problem.x[at_boundary])
    )


def test_outside_contact_the_exact_height_over_the_hemisphere_is_harmonic():
    rng = np.random.default_rng(20090)
    x, h = rng.uniform(-2, 2, (400, 2)), 1e-4
    laplacian = sum(
        exact_height(x + e, "hemisphere") - 2 * exact_height(x, "hemisphere")
        + exact_height(x - e, "hemisphere") for e in h * np.eye(2)
    ) / h**2  # fmt: skip
    r = np.linalg.norm(x, axis=1)
    lift = exact_height(x, "hemisphere") - obstacle_height(x, "hemisphere")
    near = abs(r - CONTACT_RADIUS) < 0.02

    assert laplacian[r > CONTACT_RADIUS + h] == pytest.approx(0, abs=1e-5)
    assert (laplacian[r < CONTACT_RADIUS - h] < -1).all()
    assert (lift >= 0).all()
    assert lift[near].max() <= 3 * 0.02**2
    assert exact_height(np.array([[2.0, 0.0]]), "hemisphere") == pytest.approx(0)


@pytest.mark.parametrize(
    "form", ["primal", pytest.param("dual-bounds", marks=pytest.mark.slow)]
)
def test_over_the_hemisphere_the_membrane_converges_with_second_order(form):
    got = []
    for n in (16, 32, 64):
        case = Obstacle(n=n, shape="hemisphere").build(form, reference_solution)
        s = SMALBE().prepare(case.qp, 1e-9)()
        got.append(case.quantities(s))

    assert rates([g["energy_error"] for g in got]) == pytest.approx(2, abs=0.15)
    assert got[-1]["max_error"] <= 2e-3
    assert abs(got[-1]["force_error"]) <= 2e-3
