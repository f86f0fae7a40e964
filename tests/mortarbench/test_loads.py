"""Loads, supports and materials of user-defined bodies, from their gmsh meshes."""

import shutil

import numpy as np
import pytest

import mortarbench as mb
from tests.support import ROOT


@pytest.fixture
def solve(tmp_path):
    """Return a function that solves an example of `tests/data` with Clarabel."""

    def answer(name):
        for suffix in (".msh", ".toml"):
            shutil.copy(ROOT / "tests" / "data" / f"{name}{suffix}", tmp_path)
        found = mb.solve(f"bodies:{tmp_path}/{name}.toml/dual", "clarabel")
        assert found.verdict == "verified"
        return found

    return answer


def test_the_press_fit_has_lame_s_pressure(solve):
    a, b, c, d = 0.02, 0.05, 0.1, 1e-5
    p = 210e9 * d / b * (b**2 - a**2) * (c**2 - b**2) / (2 * b**2 * (c**2 - a**2))
    force = solve("fit").quantities["contacts"]["shaft on hub"]["force"]["hub"]

    assert force == pytest.approx([p * b, p * b], rel=6e-3)


def test_the_ground_carries_the_weight_of_the_pipe(solve):
    found = solve("pipe")
    weight = np.pi / 2 * (0.1**2 - 0.09**2) * 7850 * 9.81
    (pair,) = found.quantities["contacts"].values()

    assert -pair["force"]["ground"][1] == pytest.approx(weight, rel=5e-3)
    # the springs carry both weights; the hoop stress is that of a thick cylinder
    fields = found.fields()
    x, u = fields.points, fields.displacement
    bottom = np.flatnonzero(x[:, 1] == x[:, 1].min())
    bottom = bottom[np.argsort(x[bottom, 0])]
    soil = 0.15 * 0.06 * 1800 * 9.81
    sinking = np.trapezoid(u[bottom, 1], x[bottom, 0]) * 50e6
    assert -sinking == pytest.approx(weight + soil, rel=5e-3)
    hoop = fields.nodal["sxx"][(x[:, 0] == 0) & (abs(x[:, 1] - 0.19) < 1e-9)]
    assert hoop == pytest.approx(
        [2e6 * (0.1**2 + 0.09**2) / (0.1**2 - 0.09**2)], rel=0.1
    )


def test_the_bracket_presses_its_pad_onto_the_floor(solve):
    found = solve("bracket")
    (pair,) = found.quantities["contacts"].values()
    points, u = found.fields().points, found.fields().displacement
    sole = (points[:, 0] > 0.05) & (points[:, 1] < 0.0401)

    assert list(found.quantities["max_von_mises"]) == ["steel", "rubber"]
    assert 0 < pair["force"]["rubber"][1] < 0.02 * 80e3  # the pad is soft
    assert u[sole, 1] == pytest.approx(-1e-4, abs=1e-9)
    # tip of a cantilever of length 70 mm and thickness 10 mm under 1 MPa
    tip = 1e6 * 0.07**4 / (8 * 210e9 / (1 - 0.3**2) * 0.01**3 / 12)
    corner = np.argmax(points[:, 0] + points[:, 1])
    assert -tip * 1.6 < u[corner, 1] < -tip
