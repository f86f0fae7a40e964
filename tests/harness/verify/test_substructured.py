"""Certificates from subdomains: bounds hold, and no undecomposed K is factorised.

Bodies are cut into boxes. Errors are relative to the reference solution of the whole
problem, which is accurate up to rounding.
"""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.sparse import block_diag

from mortarbench.harness import Mechanics, UncertifiableError, certify
from mortarbench.harness.mechanics import DecomposedMechanics, Real
from mortarbench.harness.names import parse
from mortarbench.harness.verify.certificate import Certificate, certify_pair
from mortarbench.harness.verify.substructured import Subdomains, neighbour
from mortarbench.problems import PROBLEMS
from mortarbench.problems.feti.substructures import LocalProblems
from mortarbench.solvers.reference.solve import reference_solution
from mortarbench.solvers.smalbe.solver import SMALBE
from tests.support.decomposed_bodies import mechanics_of, parts_of
from tests.support.exact_solutions import refined_point
from tests.support.supported_by_contact import disc_between_plates, disc_in_parts

pytestmark = pytest.mark.together
RING = "beam-ring/Nr=3/Nh=2/steps=1/feti=3"
#: only contact supports the upper block
PATCH = "contact-patch/ratio=0.1/feti=2"


@cache
def known(name: str) -> tuple[Mechanics, DecomposedMechanics, Certificate]:
    """Return a problem, its subdomains, and its solution up to rounding."""
    case = parse(f"{name}/dual", PROBLEMS).build(reference_solution)
    assert case.mechanics is not None
    whole = case.mechanics.whole
    exact, _ = refined_point(case)
    return whole, mechanics_of(parts_of(f"{name}/dual")), exact


#: cases with answers at the level of rounding, where K and TᵀK_T T differ noticeably
ACCURATE = ("plate/Sy=2", "plate/Sx=8/Sy=1/n=4", "plate/Sx=8/Sy=2/n=2")


def excess_of_rounding(name: str, tols: tuple[float, ...]) -> list[float]:
    """Solve at given tolerances; return the largest error/bound of each answer."""
    case = parse(f"{name}/dual", PROBLEMS).build(reference_solution)
    assert case.mechanics is not None
    whole, ratios = case.mechanics.whole, list[float]()
    exact, _ = refined_point(case)
    for tol in tols:
        s = case.mechanics.to_primal(SMALBE().prepare(case.qp, tol)())
        found = certify(case.mechanics, s)
        points = found.u, s.x.astype(Real)
        error = max(whole.norm(v - exact.u) for v in points) / exact.norm
        ratios.append((error - exact.bound) / found.bound)
    return ratios


@pytest.mark.parametrize("name", ACCURATE)
def test_a_bound_at_the_level_of_rounding_is_valid(name: str) -> None:
    assert max(excess_of_rounding(name, (1e-12, 1e-14))) <= 1


def test_forces_of_subdomains_balance_and_add_up_to_the_residual() -> None:
    mechanics, own, exact = known(RING)
    parts, rng = own.parts, np.random.default_rng(5)
    u = exact.u + 1e-3 * np.abs(exact.u).max() * rng.standard_normal(exact.u.size)
    u[mechanics.exact.fixed] = 0
    split = Subdomains(own)
    near = neighbour(split, split.residual(u).rho + split.pulled(exact.multipliers))
    held = mechanics.exact.fixed
    b = parts.product(near.d)
    whole = mechanics.stiffness @ u - mechanics.exact.f
    whole = whole + mechanics.exact.B.T @ exact.multipliers
    free = np.setdiff1d(np.arange(u.size), held)
    size = float(np.abs(whole).max())
    assert_allclose(
        (parts.spread.T @ b - whole)[free].astype(float), 0, atol=1e-11 * size
    )
    assert np.abs(parts.kernel.T @ b).max() < 1e-11 * size
    assert near.left**2 < 1e-18 * (near.d @ b)


@pytest.mark.parametrize("name", [RING, PATCH])
def test_subdomains_that_moved_apart_are_moved_back_together(name: str) -> None:
    mechanics, own, _ = known(name)
    parts, rng = own.parts, np.random.default_rng(8)
    split = Subdomains(own)
    u = rng.standard_normal(mechanics.exact.f.size).astype(Real)
    u[mechanics.exact.fixed] = 0
    apart = parts.kernel @ rng.standard_normal(parts.kernel.shape[1])
    together = split.averaged(split.spread(u) + 100 * apart)
    # only contact supports a body of the patch
    left = split.motions.without(together - u)

    assert np.abs(left).max() < 1e-9


def test_local_problems_are_those_of_the_decomposed_bodies() -> None:
    parts = known(RING)[1].parts
    assert isinstance(parts, LocalProblems)
    domains = parts.torn.domains
    K = block_diag([domains.template(k).K for k in domains.class_of])
    rng = np.random.default_rng(6)
    v = rng.standard_normal(K.shape[0])
    b = v - parts.kernel @ (parts.kernel.T @ v)
    assert_allclose(parts.product(v.astype(Real)).astype(float), K @ v, rtol=1e-9)
    assert_allclose(K @ parts.solve(b), b, atol=1e-9 * np.abs(b).max())
    assert abs(K @ parts.kernel).max() < 1e-12 * abs(K).max()
    squares = K.multiply(K) @ v**2
    assert_allclose(parts.squared_product(v**2), squares, rtol=1e-12)


def test_local_solves_ignore_and_exclude_rigid_motions() -> None:
    parts = known(RING)[1].parts
    rng = np.random.default_rng(7)
    b, alpha = (rng.standard_normal(size) for size in parts.kernel.shape)
    d = parts.solve(b)
    size = np.abs(d).max()
    assert np.abs(parts.kernel.T @ d).max() < 1e-12 * size
    pushed = parts.solve(b + parts.kernel @ (1e3 * alpha))
    assert_allclose(pushed, d, atol=1e-9 * size)


@pytest.mark.parametrize(
    ("sign", "push", "reason"),
    [
        (1, 0.1, "nothing balances the load of body upper along x"),
        (-1, 0.0, "only tensile contact forces"),
    ],
)
def test_an_unbalanced_load_is_refused_as_for_undivided_bodies(
    sign: int, push: float, reason: str
) -> None:
    parts = disc_in_parts(push=push)
    parts = replace(parts, load=sign * parts.load)
    whole = disc_between_plates(push=push).mechanics
    assert whole is not None
    whole = replace(whole, primal=replace(whole.primal, q=sign * whole.primal.q))
    u, z = 0 * whole.primal.q, 0 * whole.primal.h
    reasons = []
    for bodies in (whole, mechanics_of(parts)):
        with pytest.raises(UncertifiableError, match=reason) as refusal:
            certify_pair(bodies, u, z)
        reasons.append(str(refusal.value))

    assert reasons[0] == reasons[1]
