"""The code in docs/verdicts.md computes the residuals of the product."""

import re
from pathlib import Path

import numpy as np
import pytest

from mortarbench.harness import QP, Solution, Status
from mortarbench.harness.conformance.manufactured import SHAPES, manufactured
from mortarbench.harness.verify.kkt import kkt_residuals

PAGE = Path(__file__).parents[3] / "docs" / "verdicts.md"


def documented():
    names = {}
    code = re.search(r"```python\n(.*?)```", PAGE.read_text("utf-8"), re.DOTALL)[1]
    exec(code, names)
    return names["residuals"]


@pytest.mark.parametrize("shape", SHAPES)
def test_the_documented_code_computes_the_residuals_of_the_product(shape):
    rng = np.random.default_rng(len(shape))
    qp, s = manufactured(shape)
    for size in (0.0, 1e-6, 1e-2, 1.0):
        x, y, z, z_box = (
            v * (1 + size * rng.standard_normal(v.size))
            for v in (s.x, s.y, s.z, s.z_box)
        )
        point = Solution(status=s.status, x=x, y=y, z=z, z_box=z_box)
        with np.errstate(all="ignore"):
            found = documented()(
                qp.P, qp.q, qp.A, qp.b, qp.G, qp.h, qp.lb, qp.ub, x, y, z, z_box
            )

        expected = kkt_residuals(qp, point)
        assert found == pytest.approx(tuple(expected), rel=1e-6, abs=1e-14)


@pytest.mark.parametrize("q", [0.0, -1.0])
@pytest.mark.parametrize("P", [0.0, 1.0])
def test_the_documented_units_hold_if_energies_or_forces_vanish(P, q):
    qp = QP.from_arrays([[P, 0], [0, 0]], [q, 0], A=[[0, 1]], b=[0], lb=0, ub=6)
    x, y, none, z_box = [1e-9, 1e-9], [1e-9], [], [1e-7, -1e-9]
    vectors = [np.array(v, dtype=float) for v in (x, y, none, z_box)]
    with np.errstate(all="ignore"):
        found = documented()(qp.P, qp.q, qp.A, qp.b, qp.G, qp.h, qp.lb, qp.ub, *vectors)
    point = dict(zip(("x", "y", "z", "z_box"), vectors, strict=True))
    expected = kkt_residuals(qp, Solution(status=Status.SOLVED, **point))
    assert found == pytest.approx(tuple(expected), rel=1e-12)
