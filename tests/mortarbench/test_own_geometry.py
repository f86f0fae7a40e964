"""The tutorial docs/own-geometry.md, from the gmsh mesh to a file with
Hertz pressures.
"""

import re
import shutil

import meshio
import numpy as np
import pandas as pd
import pytest

import mortarbench as mb
from mortarbench.harness import kkt_residuals
from mortarbench.reports.export.vtu import write_vtu
from mortarbench.solvers import SOLVERS
from tests.support import ROOT

pytestmark = pytest.mark.together

PAGE = (ROOT / "docs" / "own-geometry.md").read_text("utf-8")
LOAD, RADIUS, E_STAR = 2e6, 0.01, 210e9 / (2 * (1 - 0.3**2))  # N/m, m, Pa
HALF_WIDTH = np.sqrt(4 * LOAD * RADIUS / (np.pi * E_STAR))
LARGEST = 2 * LOAD / (np.pi * HALF_WIDTH)


@pytest.fixture(scope="module")
def solved(tmp_path_factory):
    """The problem described on the page, meshed by gmsh and solved by Clarabel."""
    folder = tmp_path_factory.mktemp("press")
    shutil.copy(ROOT / "tests" / "data" / "press.msh", folder)
    (toml,) = re.findall(r"<!-- file: press.toml -->\n```toml\n(.*?)```", PAGE, re.S)
    (folder / "press.toml").write_text(toml)
    case = mb.build(f"bodies:{folder}/press.toml/dual")
    s = SOLVERS["clarabel"].prepare(case.qp, 1e-10)()
    assert kkt_residuals(case.qp, s).worst <= 1e-9
    return case, s, folder


def test_the_page_states_the_solution_of_hertz():
    assert f"{1e3 * HALF_WIDTH:.3f} mm" in PAGE
    assert f"{LARGEST / 1e9:.2f} GPa" in PAGE


def test_the_pressures_are_those_of_hertz(solved):
    case, s, _ = solved
    found = case.quantities(s)

    assert found["nodes"] == int(re.findall(r"\| 0.12 \| (\d+) \|", PAGE)[0])
    assert list(found["contacts"]) == ["disc on lower", "disc on upper"]
    for (_, pair), plate, sign in zip(
        found["contacts"].items(), ("lower", "upper"), (-1, 1), strict=True
    ):
        assert pair["largest_pressure"] == pytest.approx(LARGEST, rel=0.01)
        assert pair["half_width"] == pytest.approx(HALF_WIDTH, abs=0.12e-3 / 2)
        assert abs(pair["smallest_gap"]) < 1e-9
        force = np.array([0, sign * LOAD])
        assert pair["force"][plate] == pytest.approx(force, abs=1e-4 * LOAD)
        assert pair["force"]["disc"] == pytest.approx(-force, abs=1e-4 * LOAD)


def test_paraview_gets_triangles_pressures_and_a_table_along_each_contact(solved):
    case, s, folder = solved
    written = write_vtu(case.fields(s), folder / "press.vtu")
    grid = meshio.read(written[0])
    sides = [pd.read_csv(path) for path in written[1:]]

    assert [path.name for path in written[1:]] == [
        "press-disc-on-lower.csv", "press-disc-on-upper.csv",
    ]  # fmt: skip
    assert [block.type for block in grid.cells] == ["triangle"]
    assert np.ptp(grid.points[:, 0]) == pytest.approx(0.03)  # 30 mm
    for side in sides:
        near = side[side.pressure_Pa > 0]
        hertz = LARGEST * np.sqrt(np.maximum(1 - (near.x_m / HALF_WIDTH) ** 2, 0))
        assert np.abs(near.pressure_Pa - hertz).max() <= 0.1 * LARGEST
        assert near.force_y_N_per_m.abs().sum() == pytest.approx(LOAD, rel=1e-4)
        assert grid.point_data["pressure"].max() >= near.pressure_Pa.max()


def test_the_refusals_quoted_on_the_page_are_the_actual_messages(solved):
    """Every message in the table of the page occurs, except for its variable parts."""
    code = "".join(
        path.read_text("utf-8")
        for folder in ("problems/fem", "problems/contact", "problems/models")
        for path in (ROOT / folder).rglob("*.py")
    )
    for words in (
        "cells of type", "cells without a name", "share nodes", "is closed",
        "nothing balances", "the supports allow a rigid motion of some body",
        "Pa is softer than rubber", "with slave and master exchanged",
        "where a support fixes the displacement", "a drawing, not a mesh",
    ):  # fmt: skip
        assert words in PAGE
        assert words in code
