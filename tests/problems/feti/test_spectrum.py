"""Extreme eigenvalues by the Lanczos method, for operators with known spectra."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.linalg import null_space, orth
from scipy.sparse import csr_array

from mortarbench.harness import QP, Vector, no_rows
from mortarbench.problems.contact.stepping import load_steps
from mortarbench.problems.duality.decomposed import decompose, subdivided
from mortarbench.problems.duality.feti_dual import TornDual
from mortarbench.problems.families.beam_ring import bodies as of_beam_ring
from mortarbench.problems.families.feti_models import Membranes
from mortarbench.problems.feti import spectrum as module
from mortarbench.problems.feti.served import Served
from mortarbench.problems.feti.spectrum import (
    Spectrum,
    projector,
    ritz_bounds,
    spectra,
    spectrum,
)
from mortarbench.problems.feti.subdomains import Contact, DecomposedProblem, TornBodies
from tests.support.decomposed_bodies import (
    decomposed_pair,
    labelled,
    parts_by,
)


def identity(x: Vector) -> Vector:
    return x


def test_eigenvalues_of_a_diagonal_are_its_entries() -> None:
    entries = np.linspace(2.0, 50.0, 40)
    found = spectrum(lambda x: entries * x, identity, 40)
    assert_allclose([found.smallest, found.largest], [2.0, 50.0], rtol=1e-10)
    assert found.condition == pytest.approx(25.0)


def test_equality_rows_remove_their_directions() -> None:
    entries = np.linspace(2.0, 50.0, 40)
    kept = np.ones(40)
    kept[[0, 39]] = 0.0
    found = spectrum(lambda x: entries * x, lambda x: kept * x, 40)
    assert_allclose([found.smallest, found.largest], entries[[1, 38]], rtol=1e-10)


def test_a_preconditioner_changes_the_operator_but_not_its_space() -> None:
    entries = np.linspace(2.0, 50.0, 40)
    near = 1 / entries
    near[[3, 7]] *= [0.25, 4.0]
    found = spectrum(lambda x: entries * x, identity, 40, lambda x: near * x)
    assert_allclose([found.smallest, found.largest], [0.25, 4.0], rtol=1e-10)


@pytest.mark.parametrize("crowded", ["below", "above"])
def test_the_error_bounds_hold_and_are_within_the_tolerance(crowded: str) -> None:
    entries = 1.0 + 9.0 * np.linspace(0.0, 1.0, 400) ** 2
    if crowded == "above":
        entries = 11.0 - entries
    found = spectrum(lambda x: entries * x, identity, 400, tol=1e-3)
    assert found.steps < 350
    assert abs(found.smallest - 1.0) <= found.smallest_error <= 1e-3
    assert abs(found.largest - 10.0) <= found.largest_error <= 1e-3 * 10.0
    slow = "smallest_error" if crowded == "below" else "largest_error"
    assert getattr(found, slow) > 1e-8  # the other eigenvalue converges long before
    assert abs(found.condition - 10.0) <= 1.001 * found.condition_error


def test_errors_of_ritz_values_come_from_the_last_entries_of_their_vectors() -> None:
    """The eigenpairs of [[2, 2], [2, 5]] are 1, (2, −1)/√5 and 6, (1, 2)/√5."""
    found = ritz_bounds(np.array([2.0, 5.0]), np.array([2.0]), 0.5)
    assert [found.smallest, found.largest] == pytest.approx([1.0, 6.0])
    errors = [found.smallest_error, found.largest_error]
    assert errors == pytest.approx([0.5 / 5**0.5, 1 / 5**0.5])
    assert found.condition_error == pytest.approx(6 * (errors[0] + errors[1] / 6))


@pytest.mark.parametrize(
    ("errors", "is_within"),
    [
        ((0.01, 0.1), True),
        ((0.02, 0.0), False),
        ((0.0, 0.2), False),
        ((0.0, 0.0), True),
    ],
)
def test_each_error_is_relative_to_its_own_eigenvalue(
    errors: tuple[float, float], is_within: bool
) -> None:
    """The errors 0.01 and 0.1 are 1 % of the eigenvalues 1 and 10."""
    assert Spectrum(1.0, 10.0, *errors, 7).within(0.01) is is_within


def dual_of(problem: DecomposedProblem) -> tuple[QP, csr_array]:
    """Return a dual on one process, and its rows B."""
    served = Served(TornBodies(problem))
    return TornDual(served).qp, served.torn.rows.B


@pytest.mark.parametrize("rows", ["orthonormal", "redundant"])
def test_the_projector_is_onto_the_kernel_of_g_in_the_range_of_b(rows: str) -> None:
    bodies, primal, _ = decomposed_pair(rows)
    label = subdivided(bodies.shape, 2).label
    primal = replace(primal, G=no_rows(primal.q.size), h=np.zeros(0))
    parts = parts_by(bodies, labelled(bodies, label), primal, rows=rows)
    qp, B = dual_of(parts)
    G = csr_array(qp.A)
    P = projector(B, G)
    dense = B.toarray()
    x = np.sin(np.arange(B.shape[0]) ** 2)
    y = P(x)
    assert_allclose(P(y), y, atol=1e-12)
    assert abs(G @ y).max() < 1e-10 * abs(G).max()
    size, u = np.linalg.eigh(dense @ dense.T)
    u = u[:, size > 1e-12 * size[-1]]
    assert_allclose(u @ (u.T @ y), y, atol=1e-12)  # in range B
    inside = dense @ np.cos(np.arange(B.shape[1]))  # the remainder is orthogonal
    assert abs((x - y) @ P(inside)) < 1e-9 * np.linalg.norm(inside)


def spectrum_of_beam_ring(layers: int, cells: int) -> Spectrum:
    """Compute the spectrum for supports and gluing of beam and ring, without
    contact."""
    bodies = of_beam_ring(layers, layers // 2, layers, "strain")
    (stage,) = load_steps(1, 1, bodies.f, bodies.fixed)
    layout = subdivided(bodies.shape, cells)
    contact = Contact(no_rows(2 * layout.nodes), np.zeros(0), np.zeros(0))
    parts = decompose(bodies, layout, "orthonormal", stage, contact)
    (result,) = spectra(*dual_of(parts), tol=1e-3)
    return result


@pytest.mark.slow
@pytest.mark.parametrize(("cells", "layers"), [(4, 48), (8, 96)])
def test_the_condition_number_is_almost_constant_from_16_900_unknowns_on(cells, layers):
    small, large = (spectrum_of_beam_ring(n, cells).condition for n in (24, layers))
    assert small < large < 1.06 * small


def test_the_condition_is_wrong_by_the_relative_errors_of_both_eigenvalues():
    """The eigenvalues are 2 ± 0.1 and 8 ± 0.8; the relative errors are 5 % and 10 %."""
    found = Spectrum(2.0, 8.0, 0.1, 0.8, steps=1)
    assert found.condition == 4.0
    assert found.condition_error == pytest.approx(4 * 0.15)
    assert found.within(0.1)
    assert not found.within(0.09)
    assert not found._replace(smallest_error=0.3).within(0.1)
    assert not found._replace(largest_error=0.9).within(0.1)


def test_without_equations_the_projector_is_onto_the_range_of_the_rows():
    parts = Membranes(S=2, n=2, glue="redundant").in_subdomains()
    empty = no_rows(parts.contact.rows.shape[1])
    torn = TornBodies(replace(parts, contact=Contact(empty, *np.zeros((2, 0)))))
    dense = torn.rows.B.toarray()
    x = np.random.default_rng(1).standard_normal(len(dense))
    P = projector(torn.rows.B, csr_array((0, len(x))))
    assert P(x) == pytest.approx(dense @ np.linalg.lstsq(dense, x, rcond=None)[0])


@pytest.mark.parametrize(
    "floating", [True, pytest.param(False, marks=pytest.mark.slow)]
)
def test_eigenvalues_are_those_of_the_dense_operator(floating):
    """The space is ker G ∩ range B, or range B without a coarse problem."""
    parts = Membranes(S=2, n=2, glue="redundant").in_subdomains()
    empty = no_rows(parts.contact.rows.shape[1])
    qp, B = dual_of(replace(parts, contact=Contact(empty, *np.zeros((2, 0)))))
    if not floating:
        qp = replace(qp, A=no_rows(qp.q.size), b=np.zeros(0))
    names = (None, ("lumped", "stiffness"))
    found = spectra(qp, B, names, tol=1e-9)

    Q = orth(B.toarray())
    Q = Q @ null_space(qp.A.toarray() @ Q)
    F, unit = qp.P.build(), np.eye(qp.q.size)
    dense = Q.T @ F(unit) @ Q
    M = Q.T @ F.preconditioner(*names[1])(unit) @ Q
    known = [np.linalg.eigvalsh(dense), np.sort(np.linalg.eigvals(M @ dense).real)]
    for got, values in zip(found, known, strict=True):
        assert got.smallest == pytest.approx(values[0], rel=1e-8)
        assert got.largest == pytest.approx(values[-1], rel=1e-8)
        assert got.within(1e-9)


@pytest.mark.parametrize("sign", [-1, 1])
def test_errors_of_ritz_values_are_bounded_by_residuals(
    sign: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The residual norm of a Ritz vector is the last off-diagonal entry times the
    magnitude of the last coefficient.
    """
    rng, solve = np.random.default_rng(0), module.eigh_tridiagonal

    def turned(*args: Any, **how: Any) -> Any:
        values, vectors = solve(*args, **how)
        return values, sign * vectors

    monkeypatch.setattr(module, "eigh_tridiagonal", turned)
    alpha, beta = rng.uniform(1, 2, 5), rng.uniform(0.1, 0.5, 4)
    values, vectors = np.linalg.eigh(
        np.diag(alpha) + np.diag(beta, 1) + np.diag(beta, -1)
    )
    found = ritz_bounds(alpha, beta, 0.5)
    residuals = 0.5 * np.abs(vectors[-1])
    assert found.smallest == pytest.approx(values[0])
    assert found.largest == pytest.approx(values[-1])
    assert found.smallest_error == pytest.approx(residuals[0])
    assert found.largest_error == pytest.approx(residuals[-1])


def test_a_zero_residual_leaves_rounding_of_the_largest_eigenvalue() -> None:
    """The operator has eigenvalues up to 9e6, and five steps are taken."""
    found = ritz_bounds(1e6 * np.array([1.0, 9, 2, 3, 4]), np.zeros(4), 0.0)
    rounding = 5 * np.finfo(float).eps * 9e6
    assert found.smallest_error == pytest.approx(rounding, abs=0)
    assert found.largest_error == pytest.approx(rounding, abs=0)


@pytest.mark.parametrize("unit", [1e-8, 1e8])
def test_eigenvalues_in_other_units_are_as_accurate(unit: float) -> None:
    entries = unit * np.linspace(2.0, 50.0, 40)
    found = spectrum(lambda x: entries * x, identity, 40)
    assert_allclose([found.smallest, found.largest], entries[[0, -1]], rtol=1e-10)
