"""A cube of hexahedra beside a wall: digits of independent codes, in every form."""

from functools import cache

import numpy as np
import pytest

from mortarbench.harness import certify
from mortarbench.solvers import SOLVERS
from tests.support.cases import built

#: number of cells per edge → numbers of rows and active rows, force on the cube in N,
#: energy in J, u_z(1, 1, 1) in m
DIGITS = {
    4: (20, 15, -32.09439112, -5.0918173385, -2.1165548298e-2),
    20: (420, 317, -34.33006686, -5.1612796061, -2.1484044051e-2),
}


@cache
def solved(keys, solver):
    case = built(f"cube-wall/{keys}")
    return case, SOLVERS[solver].prepare(case.qp, 1e-11)()


@pytest.mark.parametrize(
    ("keys", "solver"),
    [
        ("n=4/primal", "piqp"), ("n=4/primal", "clarabel"), ("n=4/dual", "smalbe"),
        ("n=4/dual", "piqp"), ("n=4/dual-bounds", "smalbe"),
        ("n=4/dual-bounds", "clarabel"), ("n=4/feti=2/dual", "smalbe"),
        ("n=4/feti=1/glue=redundant/dual", "smalbe"), ("n=4/feti=3/dual", "smalbe"),
        pytest.param("n=20/dual-bounds", "smalbe", marks=pytest.mark.slow),
        pytest.param("n=20/dual-bounds", "clarabel", marks=pytest.mark.slow),
        pytest.param("n=20/dual", "smalbe", marks=pytest.mark.slow),
        pytest.param("n=20/feti=5/dual", "smalbe", marks=pytest.mark.slow),
    ],
)  # fmt: skip
def test_every_form_and_solver_has_the_digits_of_independent_codes(keys, solver):
    case, s = solved(keys, solver)
    n = int(keys.partition("/")[0].removeprefix("n="))
    rows, active, force, energy, corner = DIGITS[n]
    found = case.quantities(s)
    (wall,) = found["contacts"].values()

    assert (found["contact_rows"], found["active"]) == (rows, active)
    assert found["contact_force"] == pytest.approx([force, 0, 0], rel=3e-10)
    assert found["energy"] == pytest.approx(energy, rel=3e-11)
    assert found["corner"][2] == pytest.approx(corner, rel=1e-9)
    assert found["dofs"] == 3 * (n + 1) ** 3
    assert wall["force"] == {"cube": found["contact_force"]}
    assert wall["smallest_gap"] == pytest.approx(0, abs=1e-11)
    assert certify(case.mechanics, case.mechanics.to_primal(s)).bound < 1e-7


def test_pressures_on_the_wall_are_forces_over_the_areas_of_their_nodes():
    case, s = solved("n=4/dual", "smalbe")
    (side,) = case.fields(s).contacts

    assert side.name == "cube on rigid"
    assert side.length.sum() == pytest.approx(1)
    assert sorted(set(side.length.round(12))) == [1 / 64, 1 / 32, 1 / 16]
    clamped = case.fields(s).points[side.nodes, 2] == 0
    assert (np.isnan(side.gap) == clamped).all()
    touching = side.gap < 1e-9
    assert touching.sum() == 15
    expected = -side.force[touching, 0] / side.length[touching]
    # the normal of the deformed side is rotated by a few degrees
    assert side.pressure[touching] == pytest.approx(expected, rel=1e-2)
    assert case.quantities(s)["contacts"]["cube on rigid"][
        "pressed_area"
    ] == pytest.approx(side.length[touching].sum())


def test_energies_fall_and_converge_with_smaller_cells():
    energies = [
        case.quantities(s)["energy"]
        for case, s in (solved(f"n={n}/dual-bounds", "smalbe") for n in (2, 4, 8))
    ]
    assert (np.diff(energies) < 0).all()
    assert (np.diff(energies, 2) > 0).all()
