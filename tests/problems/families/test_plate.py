"""The plate in subdomains: condition numbers, and displacements of the dual form."""

from functools import cache
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose

from mortarbench.problems.families.feti_models import (
    Plate,
    dual_quantities,
)
from mortarbench.problems.feti.subdomains import TornBodies
from mortarbench.solvers.reference.solve import reference_solution
from mortarbench.solvers.smalbe.solver import SMALBE
from tests.support.cases import built

pytestmark = pytest.mark.together

#: bodies of a test of MSolve (Papagiannakis 2011); E of the left column is 1/1000 of E
#: elsewhere
CANTILEVER = (
    "plate/Sy=2/n=5/ny=10/width=3.0/height=1.5/pattern=column/jump=0.001/glue=redundant"
)
CUBES = {"dim": 3, "Sx": 2, "Sy": 2, "Sz": 2}
#: keys; number of multipliers; κ(PFP), ‖PFP‖, κ lumped, κ Dirichlet
PUBLISHED = [
    ({"Sx": 2, "Sy": 2}, 56, (9.9829, 5.63810, 2.9140, 1.8597)),
    ({"Sx": 2, "Sy": 2, "n": 8}, 104, (19.4934, 10.92276, 5.5564, 2.7512)),
    ({}, 256, (10.7836, 5.96542, 3.0658, 1.8299)),
    ({"Sx": 16, "Sy": 2, "n": 8}, 832, (19.5099, 10.93137, 5.7382, 2.7958)),
    ({**CUBES, "n": 2}, 348, (15.7460, 21.79912, 2.0329, 1.9021)),
    ({**CUBES, "n": 4}, 1056, (27.3018, 65.02473, 3.7288, 3.0151)),
]
#: one plane and one three-dimensional problem
QUICK = [PUBLISHED[0], PUBLISHED[4]]


@cache
def reported(**keys: Any) -> dict[str, Any]:
    plate, torn = Plate(**keys), torn_plate(**keys)
    qp = plate.build("dual", reference_solution).qp
    return dual_quantities(plate.moduli, qp, torn.rows.B)


def torn_plate(**keys: Any) -> TornBodies:
    return TornBodies(Plate(**keys).in_subdomains())


@pytest.mark.parametrize(
    ("keys", "multipliers", "numbers"),
    [pytest.param(*row, marks=[pytest.mark.slow] * (row not in QUICK))
     for row in PUBLISHED],
)  # fmt: skip
def test_condition_numbers_are_those_of_a_prototype(keys, multipliers, numbers):
    values = reported(**keys)
    names = ("kappa", "norm_PFP", "kappa_lumped", "kappa_dirichlet")
    assert torn_plate(**keys).rows.c.size == multipliers
    assert_allclose([values[name] for name in names], numbers, rtol=3e-5)
    assert values["kappa_dirichlet_stiffness"] == pytest.approx(
        values["kappa_dirichlet"]
    )
    assert all(values[f"{name}_error"] <= 3e-5 * values[name] for name in names)


@pytest.mark.parametrize(
    ("jump", "name", "value"),
    [
        (10.0, "kappa", 86.2039),
        (10.0, "kappa_dirichlet", 9.1477),
        (10.0, "kappa_dirichlet_stiffness", 3.5126),
        pytest.param(1e4, "kappa_dirichlet_stiffness", 2350.7, marks=pytest.mark.slow),
    ],
)
def test_condition_numbers_with_jumps_are_those_of_a_prototype(jump, name, value):
    values = reported(pattern="checkerboard", jump=jump)
    assert values[name] == pytest.approx(value, rel=3e-5)


@pytest.mark.parametrize(
    "name",
    [
        *(f"plate/pattern=checkerboard/jump=100.0/glue={glue}"
          for glue in ("orthonormal", "redundant")),
        "plate/Sx=3/Sy=2/n=3",
        CANTILEVER,
        *(f"plate/Sx=2/Sy=3/n=2/ny=1/pattern=checkerboard/jump=100.0/glue={glue}/dim=3"
          "/Sz=2" for glue in ("orthonormal", "redundant")),
        "plate/Sx=2/Sy=2/n=2/dim=3/Sz=2",
    ],
)  # fmt: skip
def test_the_dual_has_the_displacement_of_the_plate(name):
    case = built(f"{name}/dual")
    s = SMALBE().prepare(case.qp, 1e-9)()
    primal = case.mechanics.primal
    u = case.mechanics.inverse(-primal.q)
    back = case.mechanics.to_primal(s)
    K_norm = np.sqrt(u @ (primal.P @ u))
    off = back.x - u
    assert np.sqrt(off @ (primal.P @ off)) <= 1e-7 * K_norm
    assert_allclose(back.y, -(primal.A @ (primal.P @ u + primal.q)), atol=1e-6)
    assert case.scale * case.qp.objective(s.x) + case.constant == pytest.approx(
        abs(case.scale) * primal.objective(u), rel=1e-8
    )


@pytest.mark.parametrize("keys", [{}, {**CUBES, "n": 2}])
def test_the_load_pulls_with_one_meganewton(keys):
    plate = Plate(**keys)
    f = -plate.qp.q.reshape(-1, plate.dim)
    assert f[:, -1].sum() == pytest.approx(-1.0)
    assert not f[:, :-1].any()
