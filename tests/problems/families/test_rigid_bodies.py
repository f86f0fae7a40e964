"""Contact of user-defined bodies with rigid planes, cylinders and spheres."""

from dataclasses import replace

import numpy as np
import pytest

from mortarbench.problems import PROBLEMS
from mortarbench.problems.contact.bodies import ContactPair
from mortarbench.problems.contact.linearise import linearisation
from mortarbench.problems.contact.rigid import RigidSphere
from mortarbench.problems.duality.case_forms import case_of
from mortarbench.problems.duality.problem import Choice
from mortarbench.problems.families.half_space.point_contact import PointContact
from mortarbench.problems.families.line_contact import LineContact
from mortarbench.problems.fem.mesh import box, rectangle
from mortarbench.solvers import SOLVERS
from mortarbench.solvers.reference.solve import reference_solution
from tests.support.cases import built
from tests.support.gmsh_files import msh22, solids22
from tests.support.refusals import refused

E, NU, PRESSURE = 1e9, 0.3, 1e6
CELLS = 6, 3, 4
TOML = """\
mesh = "block.msh"
steps = 1
[[bodies]]
name = "block"
E = 1e9
nu = 0.3
[[supports]]
boundary = "left"
fix = ["x"]
[[supports]]
boundary = "front"
fix = ["y"]
[[loads]]
boundary = "top"
traction = [0, 0, -1e6]
[[contacts]]
slave = "foot"
rigid = { shape = "plane", point = [7, 7, 0], normal = [0, 0, 2] }
"""
IN_PLANE = (
    TOML.replace('[[supports]]\nboundary = "front"\nfix = ["y"]\n', "")
    .replace("[0, 0, -1e6]", "[0, -1e6]")
    .replace("[7, 7, 0]", "[7, 0]")
    .replace("[0, 0, 2]", "[0, 3]")
)
PLANE = 'shape = "plane", point = [7, 7, 0], normal = [0, 0, 2]'
LINE = 'shape = "plane", point = [7, 0], normal = [0, 3]'
SPHERE = 'shape = "sphere", centre = [0, 0, -2], radius = 2'
CYLINDER = 'shape = "cylinder", centre = [0, 9, -2], axis = [0, -3, 0], radius = 2'
DISC = 'shape = "cylinder", centre = [0, -2], radius = 2'


def block(folder, toml):
    """Write a block of 1 m (in 3D, 0.5 m deep) whose foot is at height zero, and a TOML
    file; return the path of the TOML file.
    """
    if toml.count("traction = [0, -"):
        mesh = rectangle((0, 0), (1, 1), (CELLS[0], CELLS[2]))
        chains = {"left": "left", "foot": "bottom", "top": "top"}
        curves = {
            name: np.stack([side[:-1], side[1:]], axis=1)
            for name, side in ((k, mesh.boundaries[v]) for k, v in chains.items())
        }
        points = np.column_stack([mesh.points, np.zeros(len(mesh.points))])
        text = msh22(points, {"block": mesh.cells}, curves, {})
    else:
        mesh = box((0, 0, 0), (1, 0.5, 1), CELLS)
        names = {"left": "left", "front": "front", "back": "back", "foot": "bottom"}
        faces = {k: mesh.boundaries[v] for k, v in (names | {"top": "top"}).items()}
        text = solids22(mesh.points, {"block": mesh.cells}, faces)
    (folder / "block.msh").write_text(text)
    path = folder / "block.toml"
    path.write_text(toml)
    return path


def solve(text, form="dual"):
    case = built(f"bodies:{text}/{form}")
    if "parts" in form:  # P is an operator
        s = SOLVERS["smalbe"].prepare(case.qp, 1e-11)()
    else:
        s = reference_solution(case.qp)
    return case.fields(s), case.quantities(s)


@pytest.mark.parametrize("contact", ["nts", "mortar"])
def test_a_block_on_a_rigid_plane_is_in_uniaxial_stress(tmp_path, contact):
    stress = IN_PLANE.replace("steps", 'plane = "stress"\nsteps')
    for toml, dim in ((TOML, 3), (stress, 2)):
        fields, values = solve(block(tmp_path, toml), f"contact={contact}/dual")
        exact = PRESSURE / E * fields.points * [NU, NU, -1][-dim:]
        pair = values["contacts"]["block on rigid"]
        area = 0.5 if dim == 3 else 1.0

        assert abs(fields.displacement - exact).max() <= 1e-9 * abs(exact).max()
        assert pair["force"]["block"][-1] == pytest.approx(area * PRESSURE, rel=1e-9)
        assert pair["largest_pressure"] == pytest.approx(PRESSURE, rel=1e-9)


def test_a_block_in_plane_strain_on_a_cylinder_is_the_plane_block_on_a_disc(tmp_path):
    """Only a part of the foot is in contact, and the vector along the cylinder's axis
    is not a unit vector."""
    held = 'boundary = "back"\nfix = ["y"]\n[[supports]]\nboundary = "left"'
    toml = TOML.replace(PLANE, CYLINDER).replace('boundary = "left"', held)
    for path in ("steps=1", "steps=2"):
        fields, values = solve(block(tmp_path, toml), f"{path}/dual")
        plane, expected = solve(
            block(tmp_path, IN_PLANE.replace(LINE, DISC)), f"{path}/dual"
        )
        front = fields.points[:, 1] == 0
        u = fields.displacement[front]
        order = np.lexsort(fields.points[front][:, [0, 2]].T)
        order_2d = np.lexsort(plane.points.T)
        largest = abs(u).max()

        assert abs(fields.displacement[:, 1]).max() <= 1e-12 * largest
        difference = u[order][:, [0, 2]] - plane.displacement[order_2d]
        assert abs(difference).max() <= 1e-9 * largest
        assert 0 < expected["active"] < CELLS[0]
        assert values["active"] == (CELLS[1] + 1) * expected["active"]
        assert values["energy"] == pytest.approx(0.5 * expected["energy"], rel=1e-9)


def test_forms_and_subdomains_agree_about_a_block_above_a_sphere(tmp_path):
    """The clamped edge has no contact row; nodes in contact lie on the sphere."""
    toml = TOML.replace('fix = ["y"]', 'fix = ["x", "y", "z"]').replace("-1e6", "-1e7")
    centre = np.array([0.5, 0.5, -20])
    ball = f'shape = "sphere", centre = {centre.tolist()}, radius = 20'
    path = block(tmp_path, toml.replace(PLANE, ball))
    forms = "dual-bounds", "primal", "dual", "parts=4/dual"
    (first, values), *others = [solve(path, k) for k in forms]
    largest = abs(first.displacement).max()

    assert values["contact_rows"] == (CELLS[0] + 1) * CELLS[1]
    for fields, found in others:
        assert found["energy"] == pytest.approx(values["energy"], rel=1e-8)
        assert found["active"] == values["active"] > 3
        assert abs(fields.displacement - first.displacement).max() <= 1e-7 * largest
    nodes = first.contacts[0].nodes[first.contacts[0].force[:, 2] > 0]
    x = (first.points + first.displacement)[nodes]
    assert abs(np.linalg.norm(x - centre, axis=1) - 20).max() <= 1e-5


def test_one_side_may_press_on_two_rigid_bodies(tmp_path):
    """The bodies are a plane and a sphere whose top is 0.5 mm above the plane at one
    node."""
    second = '[[contacts]]\nslave = "foot"\nrigid = {{ {} }}\n'
    toml = TOML + second.format(SPHERE.replace("[0, 0, -2]", "[0.5, 0.5, -1.9995]"))
    _, values = solve(block(tmp_path, toml))
    on_plane, on_sphere = values["contacts"].values()

    assert list(values["contacts"]) == ["block on rigid", "block on rigid (2)"]
    assert values["contact_rows"] == 2 * (CELLS[0] + 1) * (CELLS[1] + 1)
    assert on_plane["smallest_gap"] == pytest.approx(0, abs=1e-9)
    assert on_plane["force"]["block"][2] > 1e4
    assert on_sphere["force"]["block"][2] > 1e4
    total = on_plane["force"]["block"][2] + on_sphere["force"]["block"][2]
    assert total == pytest.approx(0.5 * PRESSURE, rel=1e-9)


@pytest.mark.parametrize(
    ("toml", "old", "new", "message"),
    [
        (TOML, 'slave = "foot"', 'slave = "foot"\nmaster = "top"',
         "expected either master (a physical surface) or rigid"),
        (TOML, f"rigid = {{ {PLANE} }}", "", "expected either master (a physical surf"),
        (TOML, f"{{ {PLANE} }}", '"plane"', "rigid = 'plane'; expected a table"),
        (TOML, 'shape = "plane"', 'shape = "plain"',
         "rigid: unknown shape 'plain'; did you mean 'plane'? known: cylinder, plane"),
        (TOML, 'shape = "plane", ', "",
         "rigid: shape is missing; expected cylinder or plane or sphere"),
        (TOML, "point = [7, 7, 0], ", "", "rigid: point is missing"),
        (TOML, "point = [7, 7, 0], ", "centre = [7, 7, 0], ",
         "rigid: unknown key 'centre'"),
        (TOML, "[0, 0, 2]", "[0, 2]", "normal = [0, 2]; expected three numbers, [x, y"),
        (TOML, "[0, 0, 2]", "[0, 0, 0]", "rigid: normal is zero; expected a direction"),
        (TOML, "[0, 0, 2]", "[0, 0, -2]",
         "no node of the slave side faces its master within reach; expected two sid"),
        (TOML, PLANE, SPHERE.replace("radius = 2", "radius = 0"),
         "rigid: radius = 0; expected a positive number"),
        (TOML, PLANE, SPHERE.replace("-2", "2"), "no node of the slave side faces its"),
        (TOML, PLANE, CYLINDER.replace("axis = [0, -3, 0], ", ""), "axis is missing"),
        (TOML, PLANE, CYLINDER.replace("-3", "0"), "axis is zero; expected a"),
        (IN_PLANE, LINE, 'shape = "sphere", centre = [0, -2], radius = 2',
         "rigid: unknown shape 'sphere'; known: cylinder, plane"),
        (IN_PLANE, LINE, DISC.replace("radius", "axis = [0, 1], radius"),
         "rigid: unknown key 'axis'"),
        (IN_PLANE, "steps", 'kinematics = "finite"\nsteps',
         "kinematics=finite with rigid bodies is not built; expected kinematics=lin"),
    ],
)  # fmt: skip
def test_a_wrong_rigid_body_is_refused_in_one_line(tmp_path, toml, old, new, message):
    assert old in toml
    with refused(message):
        solve(block(tmp_path, toml.replace(old, new)))


def against(problem, rigid):
    """Return the quantities of a problem with one contact pair whose rigid body is
    replaced."""
    (pair,) = problem.bodies.pairs
    pairs = (ContactPair(pair.slave, pair.master, rigid),)
    changed = replace(
        problem, bodies=replace(problem.bodies, pairs=pairs),
        linearise=lambda bodies, laws: linearisation(bodies, "nts", "dual", laws),
    )  # fmt: skip
    case = case_of(changed, "dual", Choice(), reference_solution)
    return case.quantities(SOLVERS["smalbe"].prepare(case.qp, 1e-11)())


def test_a_sphere_on_a_rigid_sphere_agrees_with_hertz():
    """The relative curvature is 1/R = 1/8 + 1/24."""
    family = PROBLEMS["hertz-sphere"]
    problem = family.with_keys(n=4).contact_problem()
    values = against(problem, RigidSphere((0.0, 0.0, -24.0), 24.0))
    exact = PointContact(10.0, 6.0, 200 / (1 - NU**2))

    assert values["contact_radius"] == pytest.approx(exact.a, rel=0.03)
    assert values["p_max"] == pytest.approx(exact.p0, rel=0.03)
    assert values["approach"] == pytest.approx(exact.approach, rel=0.03)
    assert values["contact_force"] == pytest.approx([0, 0, 10], abs=1e-8)


def test_a_cylinder_on_a_rigid_cylinder_agrees_with_hertz():
    """The relative curvature is 1/R = 1/8 + 1/24 per mm; in the plane, a cylinder is a
    disc."""
    family = PROBLEMS["hertz-plane"]
    problem = family.with_keys(n=8, load=5.0).contact_problem()
    values = against(problem, RigidSphere((0.0, -24e-3), 24e-3))
    exact = LineContact(5e6, 6e-3, 200e9 / (1 - NU**2))

    assert values["half_width"] == pytest.approx(exact.a, rel=0.02)
    assert values["p_max"] == pytest.approx(exact.p0, rel=0.02)
    assert values["contact_force"] == pytest.approx([0, 5e6], abs=1e-2)
