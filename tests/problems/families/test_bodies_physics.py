"""Loads, supports and materials of `bodies:`, against solutions known exactly."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from mortarbench.harness import InputError
from mortarbench.harness.distributed.comm import Team
from mortarbench.harness.names import parse
from mortarbench.harness.verify.certificate import certify
from mortarbench.problems import PROBLEMS
from mortarbench.solvers.reference.operators import reference_of_operator
from mortarbench.solvers.reference.solve import reference_solution
from tests.support.cases import built, solved
from tests.support.gmsh_files import msh22, solids22, square, stacked_mesh
from tests.support.refusals import refused
from tests.support.solid_blocks import solid_blocks

E, NU = 1e9, 0.3
#: modulus in uniaxial strain, Pa
M = E * (1 - NU) / ((1 + NU) * (1 - 2 * NU))
BODIES = f"""\
[[bodies]]
name = "lower"
E = {E}
nu = {NU}
density = 2000
[[bodies]]
name = "upper"
E = {E}
nu = {NU}
density = 1000
"""
#: squares of side 2 m, one above the other, that are held on the left and on the right
COLUMN = f"""\
mesh = "blocks.msh"
steps = 1
{BODIES}
[[supports]]
boundary = "axis"
fix = "normal"
[[supports]]
boundary = "right"
fix = ["x"]
[[contacts]]
slave = "foot"
master = "table"
"""
BASE = '[[supports]]\nboundary = "base"\nfix = "all"\n'
RIGHT = [[2, 5], [5, 8], [11, 14], [14, 17]]


@pytest.fixture(autouse=True)
def in_a_folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)


def column(more, keys="dual", top="", **mesh):
    """Write two squares and return the solved case."""
    Path("blocks.msh").write_text(stacked_mesh(right=RIGHT, **mesh))
    Path("a.toml").write_text(top + COLUMN + more)
    return solved(f"bodies:a.toml/{keys}")


def before_a_plane(mesh, slave, point, normal, more, **bodies):
    """Write bodies, one of which has a rigid plane as its master; return the case name.

    bodies : E and nu of each body, by its name
    """
    entries = ",".join(
        f'{{ name = "{name}", E = {E}, nu = {nu}, density = 100 }}'
        for name, (E, nu) in bodies.items()
    )
    Path("m.msh").write_text(mesh)
    Path("a.toml").write_text(f"""\
mesh = "m.msh"
steps = 1
bodies = [{entries}]
{more}
[[contacts]]
slave = "{slave}"
rigid = {{ shape = "plane", point = {point}, normal = {normal} }}
""")
    return "bodies:a.toml/dual"


def edges(chain):
    return np.stack([chain[:-1], chain[1:]], axis=1)


def displacements(case, s):
    """Return positions and displacements of the nodes."""
    fields = case.fields(s)
    return fields.points, fields.displacement


def error(case, u):
    """Return the relative energy norm of the error of u (N, dim) at a solution."""
    s = reference_solution(case.qp)
    K = case.mechanics.primal.P
    exact = u.ravel() / np.ptp(case.fields(s).points, axis=0).max()
    off = case.mechanics.to_primal(s).x + case.mechanics.lift.astype(float) - exact
    return np.sqrt(off @ K @ off / (exact @ K @ exact))


@pytest.mark.parametrize("form", ["primal", "dual", "dual-bounds", "parts=4/dual"])
@pytest.mark.parametrize("contact", ["nts", "mortar"])
def test_a_prescribed_displacement_compresses_a_column(form, contact):
    """Uniform strain: pressure M·d/H, energy ½·p·d·width."""
    more = BASE + '[[supports]]\nboundary = "top"\ndisplacement = ["free", -0.004]\n'
    case, s, values = column(more, f"contact={contact}/{form}")
    x, u = displacements(case, s)
    pressure = M * 0.001

    assert u == pytest.approx(np.outer(x[:, 1], [0, -0.001]), abs=1e-11)
    assert values["energy"] == pytest.approx(0.5 * pressure * 0.004 * 2, rel=1e-8)
    (pair,) = values["contacts"].values()
    assert pair["largest_pressure"] == pytest.approx(pressure, rel=1e-7)
    assert pair["force"]["upper"] == pytest.approx([0, 2 * pressure], abs=1)
    # energy = scale·objective + constant, in the dual as in the primal form
    energy = case.scale * case.qp.objective(s.x) + case.constant
    assert energy == pytest.approx(values["energy"], rel=1e-8)


def test_prescribed_displacements_on_ranks_are_refused():
    more = BASE + '[[supports]]\nboundary = "top"\ndisplacement = ["free", -0.004]\n'
    column(more)
    case = parse("bodies:a.toml/parts=4/dual", PROBLEMS)
    build = case.family.divided(case.form).build
    with pytest.raises(InputError, match="displacements on MPI ranks are not built"):
        build(Team(), reference_of_operator)


@pytest.mark.parametrize("form", ["primal", "dual-bounds", "parts=4/dual"])
def test_the_certificate_bounds_the_error_with_prescribed_displacements(form):
    """The bound is relative to the whole displacement, not to u − w."""
    more = BASE + '[[supports]]\nboundary = "top"\ndisplacement = ["free", -0.004]\n'
    case, s, _ = column(more, form)
    x, _ = displacements(case, s)
    exact = np.outer(x[:, 1], [0, -0.001])
    mechanics = case.mechanics
    moved, K = mechanics.to_primal(s), mechanics.primal.P
    rng = np.random.default_rng(5)
    for size in (0.0, 1e-6, 1e-3):
        x = moved.x + size * 1e-3 * rng.standard_normal(moved.x.size)
        point = replace(moved, x=x)
        off = x + mechanics.lift.astype(float) - exact.ravel() / 4
        norm = np.sqrt(exact.ravel() @ K @ exact.ravel()) / 4
        bound = certify(mechanics, point).bound

        assert np.sqrt(off @ K @ off) / norm <= bound * (1 + 1e-6) + 1e-14
        assert bound < 1e-6 + 200 * size
    assert case.quantities(s)["energy"] == pytest.approx(
        0.5 * M * 0.001 * 0.004 * 2, rel=1e-8
    )


def test_displacements_grow_with_the_load_steps():
    more = BASE + '[[supports]]\nboundary = "top"\ndisplacement = [0, -0.004]\n'
    for step in (1, 2, 4):
        case, s, _ = column(more, f"steps=4/step={step}/dual")
        x, u = displacements(case, s)
        expected = np.outer(x[:, 1], [0, -0.001 * step / 4])
        assert u == pytest.approx(expected, abs=1e-11)


@pytest.mark.parametrize("form", ["primal", "dual"])
def test_springs_alone_hold_a_body(form):
    """The column sinks by p/k, and shortens by pH/M."""
    more = (
        '[[supports]]\nboundary = "base"\nspring = 5e8\n'
        '[[loads]]\nboundary = "top"\npressure = 1e6\n'
    )
    case, s, values = column(more, form)
    x, u = displacements(case, s)

    expected = -1e6 / 5e8 - 1e6 / M * x[:, 1]
    assert u[:, 1] == pytest.approx(expected, abs=1e-11)
    assert u[:, 0] == pytest.approx(0, abs=1e-11)
    assert values["energy"] == pytest.approx(
        -0.5 * 2 * 1e6 * (1e6 / 5e8 + 4e6 / M), rel=1e-9
    )
    assert certify(case.mechanics, case.mechanics.to_primal(s)).bound < 1e-6


def test_a_spring_on_an_inclined_side_acts_along_its_normal():
    """A square on two inclined sides: 2·k·A·(n·u)² balances the weight."""
    points, cells = square()
    turn = np.array([[1, -1, 0], [1, 1, 0], [0, 0, 0]]) / np.sqrt(2)
    sides = {
        "left": [[6, 3], [3, 0]], "right": [[0, 1], [1, 2]], "top": [[8, 7], [7, 6]],
    }  # fmt: skip
    more = "gravity = [0, -10]\n" + "".join(
        f'[[supports]]\nboundary = "{side}"\nspring = 1e6\n'
        for side in ("left", "right")
    )
    mesh = msh22(points @ turn.T, {"a": cells}, sides, {})
    name = before_a_plane(mesh, "top", [0, 5], [0, -1], more, a=(1e15, 0.3))
    case, s, values = solved(name)
    _, u = displacements(case, s)

    # each side has the length 2 and the normal (±1, −1)/√2; the weight is 4000 N/m
    assert u == pytest.approx(np.outer(np.ones(9), [0, -4000 / (2 * 1e6)]), abs=1e-8)
    assert values["active"] == 0


def test_gravity_shortens_a_column_by_its_weight():
    """The displacement of linear elements is exact at the nodes."""
    more = BASE.replace('"all"', '["y"]')
    case, s, values = column(more, top="gravity = [0, -10]\n")
    x, u = displacements(case, s)
    y, is_upper = x[:, 1], np.arange(len(x)) >= 9

    def low(y):  # under its weight and that of the upper square
        return -(1e4 * 2 * y + 2e4 * (2 * y - y**2 / 2)) / M

    high = low(2.0) - 1e4 * (2 * (y - 2) - (y - 2) ** 2 / 2) / M
    assert u[:, 1] == pytest.approx(np.where(is_upper, high, low(y)), abs=1e-12)
    (pair,) = values["contacts"].values()
    assert pair["force"]["upper"] == pytest.approx([0, 4e4], rel=1e-9)


def test_a_pressure_is_a_traction_along_the_inner_normal():
    pressed, pulled = (
        column(f'{BASE}[[loads]]\nboundary = "top"\n{load}\n')[0].qp
        for load in ("pressure = 1e6", "traction = [0, -1e6]")
    )
    np.testing.assert_allclose(pressed.q, pulled.q, rtol=1e-12, atol=1e-14)


def test_a_side_may_be_moved_onto_its_master():
    """Without the gap, the result is that of touching squares, without stress."""
    load = f'{BASE}[[loads]]\nboundary = "top"\npressure = 1e6\n'
    _, _, touching = column(load)
    for gap in (1e-4, -1e-4):
        _, _, moved = column(f"adjust = 2e-4\n{load}", gap=gap)
        assert moved["energy"] == pytest.approx(touching["energy"], rel=1e-3)
        assert moved["multiplier_sum"] == pytest.approx(2e6, rel=1e-9)
        (pair,) = moved["contacts"].values()
        assert pair["smallest_gap"] == pytest.approx(0, abs=1e-12)
    case, s, _ = column(f"adjust = 5e-5\n{load}", gap=1e-4)
    x, u = displacements(case, s)
    assert (x + u)[9:12, 1] == pytest.approx((x + u)[6:9, 1], abs=1e-11)
    assert x[9, 1] - x[6, 1] == pytest.approx(1e-4)


def test_a_side_is_not_moved_through_a_cell():
    load = f'{BASE}[[loads]]\nboundary = "top"\npressure = 1e6\n'
    with pytest.raises(InputError, match=r"contacts\[0\]: adjust: .*; expected"):
        column(f"adjust = 3\n{load}", gap=-1.5)


def test_interference_is_a_load():
    """A column between two fixed ends that is 1 mm too long."""
    more = BASE + '[[supports]]\nboundary = "top"\nfix = ["y"]\n'
    for form in ("primal", "dual", "dual-bounds"):
        *_, values = column(more, form, gap=-0.001)
        (pair,) = values["contacts"].values()
        assert pair["largest_pressure"] == pytest.approx(M * 0.001 / 4, rel=1e-8)
    with pytest.raises(InputError, match="nothing stresses the bodies"):
        column(more)


def test_supports_that_press_both_sides_into_each_other_are_refused():
    more = '[[supports]]\nboundary = "table"\nfix = "all"\n[[supports]]\n'
    for move in (-0.01, 0.01):
        more_ = f'{more}boundary = "foot"\ndisplacement = [0, {move}]\n'
        if move > 0:
            assert column(more_)[2]["active"] == 0
            continue
        with pytest.raises(InputError, match=r"both sides of a contact 0\.01 m into"):
            column(more_)


def ring(radii, n, name, first, angle=np.pi / 2):
    """Return points, cells and sides of a sector of a ring with n × 2n cells."""
    r = radii[0] + (radii[1] - radii[0]) * np.arange(n + 1) / n
    a = angle * np.arange(2 * n + 1) / (2 * n)
    x = np.stack([np.outer(r, np.cos(a)), np.outer(r, np.sin(a))], axis=-1)
    k = first + np.arange(x[..., 0].size).reshape(n + 1, -1)
    cells = np.stack([k[:-1, :-1], k[1:, :-1], k[1:, 1:], k[:-1, 1:]], axis=-1)
    sides = {
        f"{name} inside": edges(k[0]), f"{name} outside": edges(k[-1]),
        f"{name} x": edges(k[:, 0]), f"{name} y": edges(k[:, -1]),
    }  # fmt: skip
    points = np.column_stack([x.reshape(-1, 2), np.zeros(k.size)])
    return points, cells.reshape(-1, 4), sides


@pytest.mark.parametrize("form", ["dual", "parts=7/dual"])
def test_a_cylinder_under_pressure_has_the_stress_of_lame(form):
    """Two bonded rings of one material are one thick cylinder."""
    a, b, c, p = 0.02, 0.05, 0.1, 1e7
    shaft = ring((a, b), 16, "shaft", 0)
    hub = ring((b, c), 16, "hub", 0)
    # the inner nodes of the hub are the outer nodes of the shaft
    start = len(shaft[0]) - 33
    points = np.vstack([shaft[0], hub[0][33:]])
    sides = shaft[2] | {k: v + start for k, v in hub[2].items()}
    wall = {"wall": sides.pop("hub outside")}
    del sides["shaft outside"], sides["hub inside"]
    mesh = msh22(points, {"shaft": shaft[1], "hub": hub[1] + start}, sides | wall, {})
    more = f'plane = "stress"\n[[loads]]\nboundary = "shaft inside"\npressure = {p}\n'
    more += "".join(
        f'[[supports]]\nboundary = "{name} {axis}"\nfix = "normal"\n'
        for name in ("hub", "shaft")
        for axis in "xy"
    )
    steel = (2e11, 0.3)
    before_a_plane(mesh, "wall", [0.2, 0], [-1, 0], more, hub=steel, shaft=steel)
    case, s, values = solved(f"bodies:a.toml/{form}")
    x, u = displacements(case, s)
    r = np.linalg.norm(x, axis=1)
    k = p * a**2 / (c**2 - a**2) / 2e11
    exact = k * (0.7 * r + 1.3 * c**2 / r)

    assert np.linalg.norm(u, axis=1) == pytest.approx(exact, rel=3e-3)
    assert list(values["max_von_mises"]) == ["shaft", "hub"]
    hoop = p * (c**2 + a**2) / (c**2 - a**2)
    stress = case.fields(s).nodal
    assert stress["syy"][0] == pytest.approx(hoop, rel=0.03)
    assert stress["sxx"][0] == pytest.approx(-p, rel=0.2)


@pytest.mark.parametrize("nu", [0.3, 0.4999])
def test_a_nearly_incompressible_cylinder_does_not_lock(nu):
    """Plane strain, u = (1 + ν)/E · p a²/(c² − a²) · ((1 − 2ν) r + c²/r)."""
    a, c, p, modulus = 0.02, 0.05, 1e5, 1e7
    points, cells, sides = ring((a, c), 10, "hub", 0)
    more = (
        '[[supports]]\nboundary = "hub x"\nfix = "normal"\n'
        '[[supports]]\nboundary = "hub y"\nfix = ["x"]\n'
        f'[[loads]]\nboundary = "hub inside"\npressure = {p}\n'
    )
    mesh = msh22(points, {"hub": cells}, sides, {})
    before_a_plane(mesh, "hub outside", [0.1, 0], [-1, 0], more, hub=(modulus, nu))
    case, s, _ = solved("bodies:a.toml/dual-bounds")
    x, u = displacements(case, s)
    r = np.linalg.norm(x, axis=1)
    k = (1 + nu) / modulus * p * a**2 / (c**2 - a**2)

    assert np.linalg.norm(u, axis=1) == pytest.approx(
        k * ((1 - 2 * nu) * r + c**2 / r), rel=0.01
    )
    inner = p * a**2 / (c**2 - a**2)
    stress = case.fields(s).nodal["sxx"][: 21 * 10 : 21]  # radial, along the x axis
    exact = inner * (1 - c**2 / r[: 21 * 10 : 21] ** 2)
    assert stress[2:] == pytest.approx(exact[2:], abs=0.04 * p)


STACK = {"soft": 1e8, "hard": 1e10}


@pytest.mark.parametrize("form", ["primal", "dual", "parts=4/dual"])
@pytest.mark.parametrize("contact", ["nts", "mortar"])
def test_bodies_that_share_nodes_are_one_piece(form, contact):
    """Each square consists of two layers of different moduli, in uniaxial stress."""
    text = stacked_mesh(right=RIGHT)
    # the lower rows of cells of both squares become "soft", the upper ones "hard"
    lines = text.splitlines()
    names = {line.split()[2]: line.split()[1] for line in lines if line[-1:] == '"'}
    low, high = names['"lower"'], names['"upper"']
    cells = [i for i, line in enumerate(lines) if line.split()[1:3] == ["3", "2"]]
    for k, i in enumerate(cells):
        number, kind, two, _, _, *nodes = lines[i].split()
        tag = high if k % 4 > 1 else low
        lines[i] = " ".join([number, kind, two, tag, tag, *nodes])
    text = "\n".join(lines).replace('"lower"', '"soft"').replace('"upper"', '"hard"')
    Path("blocks.msh").write_text(text + "\n")
    bodies = "".join(
        f'[[bodies]]\nname = "{k}"\nE = {e}\nnu = 0\n' for k, e in STACK.items()
    )
    Path("a.toml").write_text(
        COLUMN.replace(BODIES, bodies)
        + BASE
        + '[[loads]]\nboundary = "top"\ntraction = [0, -1e6]\n'
    )
    case, s, values = solved(f"bodies:a.toml/contact={contact}/{form}")
    x, u = displacements(case, s)
    soft, hard = 1e6 / STACK["soft"], 1e6 / STACK["hard"]
    below = np.where(np.arange(len(x)) >= 9, 1, 0)
    y = x[:, 1] - 2 * below
    exact = (
        below * (soft + hard) + np.minimum(y, 1) * soft + np.maximum(y - 1, 0) * hard
    )

    assert u[:, 1] == pytest.approx(-exact, abs=1e-9)
    assert values["energy"] == pytest.approx(-1e6 * 2 * (soft + hard), rel=1e-9)
    assert list(values["max_von_mises"]) == ["soft.1", "soft.2", "hard.1", "hard.2"]
    for stress in values["max_von_mises"].values():  # no average across materials
        assert stress == pytest.approx(1e6, rel=1e-6)
    (pair,) = values["contacts"].values()
    assert pair["force"] == {
        "hard.1": pytest.approx([0, -2e6], abs=1),
        "soft.2": pytest.approx([0, 2e6], abs=1),
    }  # fmt: skip
    bound = certify(case.mechanics, case.mechanics.to_primal(s)).bound
    assert bound < 1e-6


def test_a_piece_that_nothing_holds_is_named_by_its_bodies():
    points, cells = square()
    sides = {"base": [[0, 1], [1, 2]], "top": [[8, 7], [7, 6]]}
    mesh = msh22(points, {"a": cells[:2], "b": cells[2:]}, sides, {})
    load = 'loads = [{ boundary = "top", force = [1, -1] }]'
    name = before_a_plane(
        mesh, "base", [0, 0], [0, 1], load, a=(1e9, 0.3), b=(1e8, 0.3)
    )
    with pytest.raises(
        InputError, match=r"body 'a\+b': nothing balances its load in x"
    ):
        solved(name)


def remarks(points, cells, sides, nu=0.3, kind=3):
    """Return the remarks on a body that rests on a rigid plane."""
    mesh = msh22(points, {"a": cells}, sides, {}, quad_type=kind)
    more = (
        'supports = [{ boundary = "base", fix = ["x"] }]\n'
        'loads = [{ boundary = "top", force = [0, -1] }]\n'
    )
    name = before_a_plane(mesh, "base", [0, 0], [0, 1], more, a=(1e9, nu))
    return built(name).remarks


def test_a_crack_and_triangles_that_lock_are_remarked():
    points, cells = square(4)
    sides = {"base": [[0, 1], [1, 2], [2, 3], [3, 4]], "top": [[24, 23], [23, 22]]}
    assert remarks(points, cells, sides) == ()
    cracked = cells.copy()
    cracked[13:15, 0:2][cells[13:15, 0:2] == 17] = 25  # node 17 once more, above row 3
    (note,) = remarks(np.vstack([points, points[17:18]]), cracked, sides)
    assert note.startswith(
        "a.toml: 'a' has 1 pairs of nodes at the same place, for exam"
    )
    assert "at (2, 3) m" in note
    halves = np.vstack([cells[:, [0, 1, 2]], cells[:, [0, 2, 3]]])
    assert remarks(points, halves, sides, kind=2) == ()
    (note,) = remarks(points, halves, sides, nu=0.49, kind=2)
    assert "linear triangles or tetrahedra, which are too stiff for nu = 0.49" in note


@pytest.mark.parametrize(("height", "folds"), [(0.3, True), (2.0, False)])
def test_a_contact_side_around_a_sharp_edge_is_remarked(height, folds):
    """The side consists of two faces of a wedge, which meet at an edge."""
    triangle = np.array([[0, 0, 0], [1, 0, 0], [1, 0, height]])
    points = np.vstack([triangle, np.add(triangle, [0, 1, 0])])
    faces = {"slave": [[0, 1, 4, 3], [0, 2, 5, 3]], "end": [[1, 2, 5, 4]]}
    mesh = solids22(points, {"a": [[0, 1, 2, 3, 4, 5]]}, faces)
    more = (
        'supports = [{ boundary = "end", fix = ["x", "y"] }]\n'
        'loads = [{ boundary = "end", force = [0, 0, -1] }]\n'
    )
    name = before_a_plane(mesh, "slave", [0, 0, 0], [0, 0, 1], more, a=(1e9, 0.3))
    case = built(name)
    assert len(case.remarks) == folds
    assert not folds or "a contact side is folded at (0, 0.5, 0) m" in case.remarks[0]


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('fix = "normal"', 'fix = "sideways"', "fix = 'sideways'; expected a list"),
        ('fix = "all"', "displacement = [0.1]", "displacement = [0.1]; expected two"),
        ('fix = "all"', 'displacement = ["free", "free"]', "all components are free"),
        ('fix = "all"', "spring = -3", "spring = -3; expected a positive number"),
        ('fix = "all"', 'fix = "all"\nspring = 1', "expected one of fix, displacement"),
        ("pressure = 1e6", "pressure = [0, 1]", "pressure = [0, 1]; expected a number"),
        ('"right"\nfix = ["x"]', '"right"\ndisplacement = [1e-3, "free"]\n'
         '[[supports]]\nboundary = "right"\nfix = ["x"]', "supports[2] prescribes 0 m "
         "for a component for which another support prescribes 0.001 m"),
        ('steps = 1', 'steps = 1\ngravity = [0, -9, 0]', "gravity = [0, -9, 0]; exp"),
        ("density = 2000", "", "bodies: 'lower' has no density, which gravity needs"),
        ("density = 2000", "density = 0", "bodies[0]: density = 0; expected a posi"),
    ],
)  # fmt: skip
def test_an_invalid_load_or_support_is_refused_in_one_line(old, new, message):
    column(BASE + '[[loads]]\nboundary = "top"\npressure = 1e6\n')
    text = Path("a.toml").read_text().replace(old, new)
    if "density" in old:
        text = "gravity = [0, -9]\n" + text
    assert text != Path("a.toml").read_text()
    Path("a.toml").write_text(text)
    with refused(message):
        solved("bodies:a.toml/dual")


@pytest.mark.parametrize(
    ("more", "keys", "message"),
    [
        ('spring = 1e9', "parts=2/dual", "springs on bodies in parts are not built"),
        ('spring = 1e9', "kinematics=finite/dual", "kinematics=finite with springs"),
        ('displacement = [0, 1e-3]', "kinematics=finite/dual", "prescribed displ"),
    ],
)  # fmt: skip
def test_combinations_that_are_not_built_are_refused_by_name(more, keys, message):
    with pytest.raises(InputError, match=message):
        column(
            f'{BASE}[[supports]]\nboundary = "top"\n{more}\n'
            '[[loads]]\nboundary = "foot"\npressure = 1\n',
            keys,
        )


@pytest.mark.parametrize("form", ["primal", "dual-bounds"])
def test_solids_have_the_same_loads_and_supports(tmp_path, form):
    """Two cubes between a moving and a springy end, in uniaxial strain."""
    path = solid_blocks(tmp_path)
    text = path.read_text()
    text = text[: text.index("[[supports]]")]
    text += "".join(
        f'[[supports]]\nboundary = "{name}"\nfix = "normal"\n'
        for name in ("left", "front")
    )
    text += (
        '[[supports]]\nboundary = "base"\nspring = 1e9\n'
        '[[supports]]\nboundary = "top"\ndisplacement = ["free", "free", -1e-3]\n'
        '[[contacts]]\nslave = "foot"\nmaster = "table"\n'
    )
    path.write_text(text.replace("nu = 0.3", "nu = 0"))
    case, s, values = solved(f"bodies:{path}/{form}")
    x, u = displacements(case, s)
    p = 1e-3 / (1 / 1e9 + 2 / 1e9)

    assert u[:, 2] == pytest.approx(-p / 1e9 * (1 + x[:, 2]), abs=1e-10)
    assert values["energy"] == pytest.approx(0.5 * p * 1e-3, rel=1e-6)
    (pair,) = values["contacts"].values()
    assert pair["force"]["upper"] == pytest.approx([0, 0, p], abs=1e-3 * p)
