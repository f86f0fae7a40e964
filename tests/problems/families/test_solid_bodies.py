"""Solids from gmsh files, compared with exact solutions and decomposed bodies."""

import shutil

import numpy as np
import pytest

from mortarbench.harness import InputError
from mortarbench.problems.families.description import read_bodies
from mortarbench.solvers import SOLVERS
from mortarbench.solvers.reference.solve import reference_solution
from tests.support import ROOT
from tests.support.cases import built
from tests.support.hexahedra import TETRAHEDRA, WEDGES
from tests.support.refusals import refused
from tests.support.solid_blocks import NU, PRESSURE, TOML, E, solid_blocks

KINDS = {"tetra": TETRAHEDRA, "wedge": WEDGES, "hexahedron": None}
#: clamped at both ends, so that supports exclude all rigid motions
HELD = """\
mesh = "blocks.msh"
steps = 1
[[bodies]]
name = "lower"
E = 1e9
nu = 0.3
[[bodies]]
name = "upper"
E = 2e9
nu = 0.2
[[supports]]
boundary = "base"
fix = ["x", "y", "z"]
[[supports]]
boundary = "top"
fix = ["z", "x", "y"]
[[loads]]
boundary = "left"
traction = [2e5, 0, -1e6]
[[contacts]]
slave = "foot"
master = "table"
"""


@pytest.mark.parametrize(
    ("keys", "kind"),
    [
        pytest.param(keys, kind, marks=[pytest.mark.slow] * (i != j))
        for i, keys in enumerate(["primal", "dual", "basis=standard/dual"])
        for j, kind in enumerate(KINDS)
    ],
)
def test_mortar_contact_transfers_a_uniform_pressure_exactly(tmp_path, kind, keys):
    """On interfaces that do not match, the displacement is p/E (ν x, ν y, −z) in both
    blocks."""
    case = built(f"bodies:{solid_blocks(tmp_path, KINDS[kind])}/{keys}")
    s = reference_solution(case.qp)
    fields = case.fields(s)
    exact = PRESSURE / E * fields.points * [NU, NU, -1]
    values = case.quantities(s)
    pair = values["contacts"]["upper on lower"]

    assert abs(fields.displacement - exact).max() <= 1e-9 * abs(exact).max()
    assert pair["force"]["upper"] == pytest.approx([0, 0, PRESSURE], abs=1e-9 * 1e6)
    assert pair["largest_pressure"] == pytest.approx(PRESSURE, rel=1e-9)
    # half the work of the load on the area 1, whose displacement is −2p/E
    assert values["energy"] == pytest.approx(-(PRESSURE**2) / E, rel=1e-9)


@pytest.mark.parametrize(
    ("kind", "contact"),
    [("tetra", "nts"), ("hexahedron", "mortar"),
     pytest.param("tetra", "mortar", marks=pytest.mark.slow),
     pytest.param("hexahedron", "nts", marks=pytest.mark.slow)],
)  # fmt: skip
def test_forms_and_subdomains_have_the_same_answer(tmp_path, kind, contact):
    text = f"bodies:{solid_blocks(tmp_path, KINDS[kind], HELD)}/contact={contact}"
    answers = []
    for form in ("dual-bounds", "primal", "dual", "parts=4/dual"):
        case = built(f"{text}/{form}")
        if "parts" in form:  # P is an operator
            s = SOLVERS["smalbe"].prepare(case.qp, 1e-11)()
        else:
            s = reference_solution(case.qp)
        answers.append((case.fields(s), case.quantities(s)))
    (whole, values), *others = answers
    largest = abs(whole.displacement).max()

    for fields, found in others:
        assert found["energy"] == pytest.approx(values["energy"], rel=1e-8)
        assert found["active"] == values["active"]
        np.testing.assert_array_equal(fields.points, whole.points)
        assert abs(fields.displacement - whole.displacement).max() <= 1e-7 * largest


def test_loads_on_faces_are_spread_by_area(tmp_path):
    """Tractions and total forces are tested on a mesh of tetrahedra, where the number
    of triangles differs from corner to corner of the loaded face."""
    for load in ("traction = [3e5, -2e5, 1e6]", "force = [3e5, -2e5, 1e6]"):
        toml = TOML.replace("traction = [0, 0, -1e6]", load)
        whole = read_bodies(solid_blocks(tmp_path, TETRAHEDRA, toml), "strain")
        f = whole.f.reshape(-1, 3) * whole.force
        x = whole.mesh.points
        loaded = np.flatnonzero(f.any(axis=1))

        assert (x[loaded, 2] == 2).all()
        assert loaded.size == 9
        assert f.sum(axis=0) == pytest.approx([3e5, -2e5, 1e6], rel=1e-12)
        # no moment about the centre of the face
        arm = x - [0.5, 0.5, 2.0]
        assert abs(np.cross(arm, f).sum(axis=0)).max() <= 1e-9 * 1e6
        assert whole.plane is None


@pytest.mark.parametrize(
    ("old", "new", "keys", "message"),
    [
        ("", "", "/kinematics=finite", "kinematics=finite with volumes is not built"),
        ("", "", "/plane=stress", "plane=stress with volumes is not built; expected"),
        ('name = "lower"', 'name = "lowr"', "",
         "bodies[0]: name: unknown physical volume 'lowr'; did you mean 'lower'?"),
        ('boundary = "base"', 'boundary = "bass"', "",
         "supports[0]: boundary: unknown physical surface 'bass'; did you mean 'base"),
        ('boundary = "base"', 'point = "base"', "",
         "supports[0]: point: unknown physical point or curve 'base'"),
        ('slave = "foot"', 'slave = "boot"', "",
         "contacts[0]: slave: unknown physical surface 'boot'; did you mean 'foot'?"),
        ("[0, 0, -1e6]", "[0, -1e6]", "",
         "traction = [0, -1000000.0]; expected three numbers, [x, y, z]"),
        ('boundary = "top"', 'boundary = "base"', "", "acts on 'base' in z, where a"),
    ],
)  # fmt: skip
def test_settings_unsupported_for_volumes_are_refused_in_one_line(
    tmp_path, old, new, keys, message
):
    toml = TOML.replace(old, new) if old else TOML
    with refused(message):
        built(f"bodies:{solid_blocks(tmp_path, TETRAHEDRA, toml)}{keys}/dual")


def test_a_uniform_pull_on_an_irregular_mesh_is_named_by_its_direction(tmp_path):
    text = (ROOT / "tests/data/blocks.toml").read_text()
    shutil.copy(ROOT / "tests/data/blocks.msh", tmp_path)
    path = tmp_path / "blocks.toml"
    path.write_text(text.replace("[0, 0, -1e6]", "[0, 0, 1e6]"))
    with refused("body 'upper': nothing balances its load in z;"):
        built(f"bodies:{path}/dual")


def test_a_block_that_tips_over_an_edge_is_refused(tmp_path):
    """The resultant of the loads acts at x = 1.25, beyond the edge of the foot at
    x = 1."""
    toml = TOML.replace('boundary = "left"', 'boundary = "foot"')
    toml = toml.replace('boundary = "front"', 'boundary = "foot"')
    toml = toml.replace('fix = ["z"]', 'fix = ["x", "y", "z"]')
    toml += '[[loads]]\nboundary = "left"\ntraction = [0, 0, 6e5]\n'
    path = solid_blocks(tmp_path, toml=toml)
    with pytest.raises(InputError, match="'upper': nothing balances the moment of its"):
        built(f"bodies:{path}/contact=nts/dual")
