"""Times of a product with a half-space operator, and of a solve per product."""

from time import process_time

import numpy as np
import pytest

from mortarbench.harness.verify.kkt import kkt_residuals
from mortarbench.problems import PROBLEMS
from mortarbench.solvers import SOLVERS
from mortarbench.solvers.reference.solve import reference_solution

TOL = 1e-8


def built(**keys):
    family = PROBLEMS["half-space"]
    return family.with_keys(**keys).build("dual", reference_solution)


@pytest.mark.parametrize("n", [64, 256, 512])
@pytest.mark.parametrize("law", ["hertz", "mindlin"])
def test_product(benchmark, law, n):
    qp = built(n=n, law=law).qp
    x = np.random.default_rng(1).standard_normal(qp.q.size)
    assert np.isfinite(benchmark(lambda: qp.P @ x)).all()


@pytest.mark.parametrize("nu", [0.0, 0.3])
@pytest.mark.parametrize("n", [256, 512])
def test_time_of_a_solve_relative_to_its_products(note, n, nu):
    """Report the ratio of the times; check the residuals.

    For ν = 0, also check the tangential force and the stick radius. The error of this
    radius is below 0.3 % for n = 256 and below 0.1 % for n = 512.
    """
    case = built(n=n, law="mindlin", nu=nu)
    x = np.random.default_rng(1).standard_normal(case.qp.q.size)
    case.qp.P @ x  # builds the operator
    start = process_time()
    for _ in range(20):
        case.qp.P @ x
    product = (process_time() - start) / 20
    start = process_time()
    s = SOLVERS["smalbe"].prepare(case.qp, TOL)()
    seconds, products = process_time() - start, s.counts["P_products"]
    got = case.quantities(s)
    note(
        f"half-space n={n} nu={nu}: {1e3 * product:.2f} ms per product, {products} "
        f"products, {seconds:.2f} s, ratio {seconds / products / product:.2f}, "
        f"c/a {got['c_over_a']:.5f}, error {100 * got['c_over_a_error']:+.3f} %"
    )
    assert kkt_residuals(case.qp, s).worst <= 10 * TOL
    if nu == 0:
        assert abs(got["c_over_a_error"]) < (0.003 if n == 256 else 0.001)
        assert abs(got["force_error"]) < 1e-4
