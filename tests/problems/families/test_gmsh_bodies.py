"""Bodies from gmsh files, compared with the benchmark of the paper."""

import re
import shutil
from pathlib import Path

import numpy as np
import pytest

from mortarbench.harness import InputError
from mortarbench.harness.names import assemble, parse
from mortarbench.problems import PROBLEMS
from mortarbench.problems.contact.bodies import assemble_stiffness
from mortarbench.problems.families.beam_ring import model
from mortarbench.problems.families.description import read_bodies
from mortarbench.problems.fem.mesh import Mesh, nodal_lengths
from mortarbench.problems.fem.mesh_files.reading import read_msh
from mortarbench.solvers import SOLVERS
from mortarbench.solvers.reference.solve import reference_solution
from tests.support import ROOT
from tests.support.cases import built
from tests.support.gmsh_files import entities41, msh22, square, stacked_mesh
from tests.support.refusals import refused
from tests.support.triangles import halved

NR, NH = 2, 1
RING = model(NR, NH, 2, "strain")
CORNER = int(
    np.intersect1d(RING.mesh.boundaries["top"], RING.mesh.boundaries["right"])[0]
)

TOML = """\
mesh = "two.msh"
steps = 2
units = { length = 2.0, force = 1e8 }
[[bodies]]
name = "ring"
E = 20e9
nu = 0.3
[[bodies]]
name = "beam"
E = 200e9
nu = 0.3
[[supports]]
boundary = "left"
fix = ["x", "y"]
[[supports]]
boundary = "feet"
fix = ["x", "y"]
[[loads]]
point = "corner"
force = [0, -1e8]
[[contacts]]
slave = "outer"
master = "bottom"
"""

FLOATING = TOML.replace('[[supports]]\nboundary = "left"\nfix = ["x", "y"]\n', "")
TOP = 'force = [0, 0]\n[[loads]]\nboundary = "top"\nforce = [0, -1e8]'


def edges(chain):
    return np.column_stack([chain[:-1], chain[1:]])


def parts(flip=False):
    """Return cells, curves and points by name.

    flip : True for random order and orientation, as in files of gmsh
    """
    sides, rng = RING.mesh.boundaries, np.random.default_rng(577215)
    curves = {name: edges(sides[name]) for name in ("left", "outer", "bottom", "top")}
    curves["feet"] = np.vstack([edges(sides["left_foot"]), edges(sides["right_foot"])])
    if flip:
        for name, e in curves.items():
            swap = rng.random(len(e)) < 0.5
            e[swap] = e[swap][:, ::-1]
            curves[name] = rng.permutation(e)
    cells = RING.mesh.cells.copy()
    if flip:
        cells[::3] = cells[::3, ::-1]
    quads = {name: cells[RING.body == i] for i, name in enumerate(RING.names)}
    return quads, curves, {"corner": np.array([[CORNER]])}


def msh41(points, quads, curves, spots):
    """Return the text of a mesh in ASCII format 4.1, with one entity per physical group
    or unnamed set of cells, as by Mesh.SaveAll = 1."""
    kinds = (0, 15, spots), (1, 1, curves), (2, 3, quads)
    return entities41(points, [
        (dimension, kind, cells, [name] if name else [])
        for dimension, kind, named in kinds for name, cells in named.items()
    ]).decode()  # fmt: skip


POINTS = np.column_stack([RING.mesh.points, np.zeros(len(RING.mesh.points))])


@pytest.fixture
def described(tmp_path, monkeypatch):
    """Return a function that writes a mesh and a TOML file to the working directory and
    returns the case name."""
    monkeypatch.chdir(tmp_path)

    def write(mesh=None, toml=TOML):
        (tmp_path / "two.msh").write_text(mesh or msh22(POINTS, *parts()))
        (tmp_path / "a.toml").write_text(toml)
        return "bodies:a.toml"

    return write


@pytest.mark.parametrize("writer", [msh22, msh41])
@pytest.mark.parametrize("flip", [False, True])
def test_bodies_of_the_paper_from_a_gmsh_file_give_the_same_results(
    described, writer, flip
):
    described(writer(POINTS, *parts(flip)))
    ours = assemble_stiffness(read_bodies(Path("a.toml"), "strain"))

    assert ours.names == ("beam", "ring")
    np.testing.assert_array_equal(ours.mesh.points, RING.mesh.points)
    np.testing.assert_allclose(
        ours.K.toarray(), RING.K.toarray(), rtol=0, atol=1e-13 * abs(RING.K).max()
    )
    np.testing.assert_array_equal(ours.f, RING.f)
    fixed = np.sort(RING.fixed)
    np.testing.assert_array_equal(ours.fixed, fixed)
    (pair,), (expected,) = ours.pairs, RING.pairs
    np.testing.assert_array_equal(pair.slave, expected.slave)
    np.testing.assert_array_equal(pair.master, expected.master)


@pytest.mark.parametrize("clockwise", [False, True])
def test_triangles_of_any_orientation_are_read(tmp_path, clockwise):
    quads, curves, spots = parts()
    triangles = {
        name: halved(Mesh(RING.mesh.points, cells, {})).cells[:, :3]
        for name, cells in quads.items()
    }
    elements = {name: t[:, ::-1] if clockwise else t for name, t in triangles.items()}
    mesh = read(tmp_path, POINTS, elements, curves, spots, quad_type=2)

    for name, expected in triangles.items():
        got = mesh.cells[mesh.surfaces[name]]
        np.testing.assert_array_equal(np.sort(got[:, :3]), np.sort(expected))
        np.testing.assert_array_equal(got[:, 3], got[:, 2])
        (ax, ay), (bx, by) = (
            (mesh.points[got[:, k]] - mesh.points[got[:, 0]]).T for k in (1, 2)
        )
        assert (ax * by > ay * bx).all()
    whole = read(tmp_path, POINTS, quads, curves, spots)
    for name, edge in whole.curves.items():
        np.testing.assert_array_equal(mesh.curves[name], edge)


@pytest.mark.parametrize(
    ("keys", "form"),
    [
        pytest.param(keys, form, marks=[pytest.mark.slow] * (i % 2 == j))
        for i, keys in enumerate([
            "", "/step=1", "/contact=mortar", "/plane=stress",
            "/kinematics=finite",
            "/kinematics=finite/material=svk/contact_stiffness=geometric/newton=2/step=1",
        ])
        for j, form in enumerate(["primal", "dual-bounds"])
    ],
)  # fmt: skip
def test_the_user_s_qp_is_that_of_the_benchmark(described, keys, form):
    theirs = built(f"beam-ring/Nr={NR}/Nh={NH}/steps=2{keys}/{form}")
    ours = built(f"{described()}{keys}/{form}")

    for name in ("P", "q", "A", "b", "G", "h", "lb", "ub"):
        one, two = getattr(ours.qp, name), getattr(theirs.qp, name)
        one, two = (M.toarray() if hasattr(M, "toarray") else M for M in (one, two))
        if name == "A" and len(one):  # the order of support rows differs
            one, two = (M[np.argsort(M.argmax(axis=1))] for M in (one, two))
        np.testing.assert_allclose(one, two, rtol=1e-9, atol=1e-9)
    if form == "dual-bounds":
        s = reference_solution(ours.qp)
        np.testing.assert_allclose(
            ours.recover(s)[[2 * CORNER, 2 * CORNER + 1]],
            theirs.quantities(s)["tip"],
            rtol=1e-9,
        )
        energies = (ours.quantities(s)["energy"], theirs.quantities(s)["energy"])
        assert energies[0] == pytest.approx(energies[1], rel=1e-9)


def test_settings_in_the_name_override_those_in_the_file(described):
    text = described()
    plain, other = (parse(text + keys + "/dual", PROBLEMS)
                    for keys in ("", "/steps=4/plane=stress"))  # fmt: skip

    assert (plain.params["steps"], plain.params["step"]) == (2, 2)
    assert (other.params["steps"], other.params["step"]) == (4, 4)
    assert str(plain) == "bodies:a.toml/dual"
    assert str(other) == "bodies:a.toml/plane=stress/steps=4/dual"
    again = parse(str(other), PROBLEMS)
    assert again == other


def test_the_file_may_request_finite_strain(described):
    name = described(toml='kinematics = "finite"\nmaterial = "svk"\n' + TOML)
    params = parse(f"{name}/dual", PROBLEMS).params

    assert (params["kinematics"], params["material"]) == ("finite", "svk")
    described(toml='kinematics = "large"\n' + TOML)
    with pytest.raises(InputError, match=r"a\.toml: kinematics='large' is"):
        parse("bodies:a.toml/dual", PROBLEMS)


def test_friction_of_a_pair_at_finite_strain_is_refused(described):
    name = described(toml=TOML + 'friction = "coulomb"\nmu = 0.3\n')

    with pytest.raises(InputError, match=r"a\.toml: kinematics=finite with friction"):
        built(f"{name}/kinematics=finite/dual")


def test_a_body_that_may_turn_is_refused_at_finite_strain(described):
    name = described(
        toml=FLOATING.replace('"corner"\nforce = [0, -1e8]', f'"corner"\n{TOP}')
    )

    with pytest.raises(InputError, match="the supports allow body 'beam' to rotate"):
        built(f"{name}/kinematics=finite/dual")


@pytest.mark.parametrize("which", ["two.msh", "a.toml"])
def test_a_change_of_either_file_changes_the_case(described, tmp_path, which):
    before = parse(described() + "/dual", PROBLEMS)
    path = tmp_path / which
    path.write_text(
        path.read_text().replace("0.3", "0.25").replace("$Nodes", "$Nodes ")
    )
    after = parse("bodies:a.toml/dual", PROBLEMS)

    assert before.params["sha256"] != after.params["sha256"]
    with pytest.raises(InputError, match=r"a\.toml: its content has the digest"):
        assemble("bodies", before.family, before.params, "dual")


def test_loads_on_a_boundary_are_spread_by_the_shape_functions(described):
    point = 'point = "corner"\nforce = [0, -1e8]'
    top = RING.mesh.boundaries["top"]
    lengths = nodal_lengths(RING.mesh.points[top])
    for load, total in (("traction = [3e6, -5e6]", 2.0), ("force = [6e6, -1e7]", 2.0)):
        described(toml=TOML.replace(point, f'boundary = "top"\n{load}'))
        bodies = read_bodies(Path("a.toml"), "strain")
        f = bodies.f.reshape(-1, 2) * 1e8

        assert lengths.sum() == pytest.approx(total)
        np.testing.assert_allclose(f[top], np.outer(lengths, [3e6, -5e6]))
        assert np.count_nonzero(f) == 2 * len(top)


def test_without_units_the_extent_and_the_whole_load_are_the_scales(described):
    described(toml=TOML.replace("units = { length = 2.0, force = 1e8 }\n", ""))
    bodies = read_bodies(Path("a.toml"), "strain")

    assert bodies.length == pytest.approx(2.0)
    assert bodies.force == 1e8


def test_bodies_held_only_by_contact_have_one_qp_and_no_load_path(described):
    text = described(toml=FLOATING.replace("force = [0, -1e8]", TOP))

    dual = built(f"{text}/steps=1/dual")
    assert dual.qp.b.size == 6
    assert built(f"{text}/steps=1/primal").qp.b.size == 2 * 2 * 3
    with pytest.raises(InputError, match=r"expected steps=1"):
        built(f"{text}/dual")
    with pytest.raises(InputError, match=r"dual-bounds does not exist"):
        built(f"{text}/steps=1/dual-bounds")


SHEARED = """\
mesh = "two.msh"
plane = "stress"
units = { length = 4.0, force = 1e7 }
friction = "coulomb"
mu = 0.5
[[bodies]]
name = "lower"
E = 1e9
nu = 0
[[bodies]]
name = "upper"
E = 2e9
nu = 0
[[supports]]
boundary = "base"
fix = ["x", "y"]
[[loads]]
boundary = "top"
traction = [4e5, -1e6]
[[loads]]
boundary = "right"
traction = [0, 4e5]
[[loads]]
boundary = "axis"
traction = [0, -4e5]
[[contacts]]
slave = "foot"
master = "table"
"""


@pytest.fixture
def sheared_blocks(described):
    """Return a function that writes two squares of side 2 m and returns the case name.

    The squares are in a state of uniform pressure and shear stress.

    Poisson's ratio is zero, so that the common side stays straight and every load step
    has the same contact rows. Friction alone supports the upper square horizontally.
    """
    mesh = stacked_mesh(right=[[2, 5], [5, 8], [11, 14], [14, 17]])
    return lambda toml=SHEARED: described(mesh, toml)


@pytest.mark.parametrize(
    ("contact", "form"),
    [("nts", "dual"), ("mortar", "primal"),
     pytest.param("nts", "primal", marks=pytest.mark.slow),
     pytest.param("mortar", "dual", marks=pytest.mark.slow)],
)  # fmt: skip
@pytest.mark.parametrize("step", [pytest.param(1, marks=pytest.mark.slow), 2, 3])
def test_a_block_held_by_friction_is_loaded_in_steps(
    sheared_blocks, contact, form, step
):
    """After step k of 3, displacements and contact force are k/3 of their final
    values."""
    text = f"{sheared_blocks()}/contact={contact}/steps=3/step={step}/{form}"
    case = built(text)
    s = reference_solution(case.qp)
    fields, share = case.fields(s), step / 3
    points, u = fields.points, fields.displacement
    shear, press = 4e5 / np.array([5e8, 1e9]), 1e6 / np.array([1e9, 2e9])
    y, is_upper = points[:, 1], np.arange(len(points)) >= 9
    low, high = np.where(is_upper, 2.0, y), np.where(is_upper, y - 2.0, 0.0)
    expected = share * np.column_stack(
        [low * shear[0] + high * shear[1], -low * press[0] - high * press[1]]
    )

    assert u == pytest.approx(expected, abs=1e-9 * abs(expected).max())
    force = case.quantities(s)["contacts"]["upper on lower"]["force"]["upper"]
    assert force == pytest.approx(share * np.array([-8e5, 2e6]), abs=1)


def test_more_shear_than_friction_allows_is_refused_in_every_step(sheared_blocks):
    text = sheared_blocks(SHEARED.replace("4e5", "6e5"))
    for step in (1, 2):
        with pytest.raises(InputError, match="friction cannot hold the load"):
            built(f"{text}/steps=2/step={step}/dual")


@pytest.mark.parametrize(
    ("load", "message"),
    [
        ("force = [0, -1e8]", "body 'beam': nothing balances the moment of its load"),
        (f'{TOP}\n[[loads]]\nboundary = "left"\nforce = [-1e3, 0]', "beam"),
    ],
)
@pytest.mark.parametrize("form", ["primal", "dual"])
def test_an_unbalanced_load_is_refused_before_solving(described, load, message, form):
    text = described(toml=FLOATING.replace("force = [0, -1e8]", load))
    with refused(message, start="a.toml: body 'beam': nothing"):
        built(f"{text}/steps=1/{form}")


@pytest.mark.parametrize(
    ("unit", "size"), [("mm", 1e-3), ("cm", 1e-2), ("in", 0.0254), ("m", 1.0)]
)
def test_a_mesh_in_another_unit_of_length_is_the_same_problem(described, unit, size):
    ours = built(f"{described()}/step=1/dual-bounds")
    inches = TOML.replace("steps = 2", f'steps = 2\nlength_unit = "{unit}"')
    theirs = built(
        f"{described(msh22(POINTS / size, *parts()), inches)}/step=1/dual-bounds"
    )
    s = reference_solution(ours.qp)

    np.testing.assert_allclose(theirs.qp.P, ours.qp.P, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(theirs.qp.q, ours.qp.q, rtol=1e-9, atol=1e-12)
    assert theirs.quantities(s)["energy"] == pytest.approx(
        ours.quantities(s)["energy"], rel=1e-9
    )


def test_a_modulus_in_megapascals_causes_a_remark_and_a_rubber_does_not(described):
    soft = built(f"{described(toml=TOML.replace('200e9', '210000'))}/step=1/primal")
    (remark,) = soft.remarks

    assert remark.startswith("a.toml: bodies[1]: E = 210000 Pa is softer than rubber;")
    assert remark.endswith("if 210000 MPa is meant, write 2.1e+11")
    assert built(f"{described(toml=TOML.replace('20e9', '1e6'))}/primal").remarks == ()


PAIR = '[[contacts]]\nslave = "{}"\nmaster = "{}"\n'


def test_two_passes_cause_a_remark_and_share_the_force(described):
    one = built(f"{described()}/step=1/dual-bounds")
    two = built(
        f"{described(toml=TOML + PAIR.format('bottom', 'outer'))}/step=1/dual-bounds"
    )
    forces = []
    for case in (one, two):
        contacts = case.quantities(reference_solution(case.qp))["contacts"]
        forces.append(
            sum(np.array(pair["force"]["ring"]) for pair in contacts.values())
        )
    (remark,) = two.remarks

    assert one.remarks == ()
    assert remark.startswith("a.toml: contacts[1] is contacts[0] with slave and master")
    np.testing.assert_allclose(forces[1], forces[0], rtol=0.05, atol=0.05 * 1e8)


def test_a_contact_that_is_described_twice_is_refused(described):
    with pytest.raises(
        InputError, match=r"contacts\[1\] has the slave .* of contacts\[0\]"
    ):
        built(f"{described(toml=TOML + PAIR.format('outer', 'bottom'))}/step=1/primal")


def test_a_sliding_body_is_detected_although_rounding_hides_it(tmp_path):
    """The top of the body is on rollers, so that K is singular; because of rounding,
    its factorisation succeeds."""
    there = ROOT / "suites" / "crossval"
    shutil.copy(there / "punch.msh", tmp_path)
    toml = (there / "punch.toml").read_text()
    rollers = toml.replace('boundary = "side"', 'boundary = "top"')
    rollers = rollers.replace(
        'fix = ["x", "y"]\n\n[[loads]]', 'fix = ["x"]\n\n[[loads]]'
    )
    (tmp_path / "punch.toml").write_text(rollers.replace("steps = 2", "steps = 1"))

    built(f"bodies:{tmp_path}/punch.toml/dual")
    with pytest.raises(InputError, match="dual-bounds does not exist"):
        built(f"bodies:{tmp_path}/punch.toml/dual-bounds")


@pytest.mark.parametrize("form", ["primal", "dual", "dual-bounds"])
def test_the_order_of_the_nodes_in_the_file_does_not_matter(described, form):
    """Gmsh numbers the nodes of points first, then of curves, then of surfaces,
    regardless of the bodies."""
    to = np.random.default_rng(662607).permutation(len(POINTS))
    quads, curves, spots = ({k: to[v] for k, v in named.items()} for named in parts())
    shuffled = POINTS[np.argsort(to)]
    text = described(msh22(shuffled, quads, curves, spots))
    ours, theirs = (
        built(f"{name}/step=1/{form}")
        for name in (text, f"beam-ring/Nr={NR}/Nh={NH}/steps=2")
    )
    clarabel = SOLVERS["clarabel"]
    results = [
        case.quantities(clarabel.prepare(case.qp, 1e-10)()) for case in (ours, theirs)
    ]

    for name in ("energy", "contact_force", "active", "multiplier_sum"):
        assert results[0][name] == pytest.approx(results[1][name], rel=1e-6)


def test_nodes_of_no_cell_are_left_out(described):
    quads, curves, _ = parts()
    shift = {k: v + 1 for k, v in quads.items()}, {k: v + 1 for k, v in curves.items()}
    more = np.vstack([[[1.0, 0.0, 0.0]], POINTS])  # the centre of the ring
    described(msh22(more, *shift, {"corner": np.array([[CORNER + 1]])}))
    bodies = read_bodies(Path("a.toml"), "strain")

    np.testing.assert_array_equal(bodies.mesh.points, RING.mesh.points)
    np.testing.assert_array_equal(bodies.f, RING.f)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('mesh = "two.msh"', 'mesh = "too.msh"', "too.msh: No such file"),
        ('mesh = "two.msh"\n', "", "a.toml: mesh is missing"),
        ("steps", "stops", "a.toml: unknown key 'stops'; did you mean 'steps'?"),
        ("steps = 2", "steps = 2.5", "a.toml: steps=2.5; expected an integer"),
        ("steps = 2", 'plane = "bent"', "a.toml: plane='bent' is unknown"),
        ("steps = 2", 'length_unit = "mn"', "a.toml: unknown length_unit 'mn'; did"),
        ("steps = 2", "length_unit = 1e-3", "a.toml: length_unit = 0.001; expected"),
        ("steps = 2", "steps 2", "a.toml: line "),
        ('name = "ring"', 'name = "rink"',
         "a.toml: bodies[0]: name: unknown physical surface 'rink'; did you mean 'r"),
        ('name = "ring"', 'name = "beam"',
         "a.toml: bodies[1]: body 'beam' is described twice"),
        ("E = 20e9\n", "", "a.toml: bodies[0]: E is missing"),
        ("E = 20e9", "E = -1", "a.toml: bodies[0]: E = -1; expected a positive number"),
        ("nu = 0.3", "nu = 0.5", "a.toml: bodies[0]: nu = 0.5; expected a number betw"),
        ('boundary = "feet"', 'boundary = "feat"',
         "a.toml: supports[1]: boundary: unknown physical curve 'feat'; did you mean"),
        ('boundary = "feet"\n', "", "a.toml: supports[1]: expected either boundary or"),
        ('fix = ["x", "y"]', 'fix = ["z"]', "a.toml: supports[0]: unknown component"),
        ('fix = ["x", "y"]', 'fix = "x"', "a.toml: supports[0]: fix = 'x'; expected"),
        ('point = "corner"', 'point = "tip"',
         "a.toml: loads[0]: point: unknown physical point 'tip'; known: corner"),
        ("force = [0, -1e8]", "force = [0]", "a.toml: loads[0]: force = [0]; expected"),
        ("force = [0, -1e8]", "force = [0, inf]", "a.toml: loads[0]: force = inf; "),
        ("force = [0, -1e8]", "force = [0, 0.0]", "a.toml: nothing stresses the "),
        ("force = [0, -1e8]", "", "a.toml: loads[0]: expected one of force"),
        ("force = [0, -1e8]", "forces = [0, -1e8]",
         "a.toml: loads[0]: unknown key 'forces'; did you mean 'force'? known: "),
        ('point = "corner"', 'pint = "corner"',
         "a.toml: loads[0]: unknown key 'pint'; did you mean 'point'? known: "),
        ('boundary = "feet"', 'boundry = "feet"',
         "a.toml: supports[1]: unknown key 'boundry'; did you mean 'boundary'? known"),
        ("force = [0, -1e8]", "traction = [0, -1e8]",
         "a.toml: loads[0]: traction acts on a point"),
        ('slave = "outer"', 'slave = "outre"',
         "a.toml: contacts[0]: slave: unknown physical curve 'outre'; did you mean 'o"),
        ('slave = "outer"', 'slave = "feet"',
         "a.toml: contacts[0]: slave 'feet' is disconnected or has branches;"),
        ('slave = "outer"', 'slave = "left"',
         "a.toml: contacts[0]: slave and master share nodes"),
        ("length = 2.0", "length = 0", "a.toml: units: length = 0; expected a pos"),
        ("length", "lenght", "a.toml: units: unknown key 'lenght'; did you mean 'leng"),
    ],
)  # fmt: skip
def test_a_bad_description_is_refused_with_file_entry_and_remedy(
    described, old, new, message
):
    assert old in TOML
    text = described(toml=TOML.replace(old, new, 1))
    with refused(message):
        built(f"{text}/dual")


POINT_LOAD = 'point = "corner"\nforce = [0, -1e8]'


@pytest.mark.parametrize(
    ("load", "supports", "message"),
    [
        ('boundary = "feet"\nforce = [0, -1e8]', "", "acts on 'feet' in y, where"),
        ('boundary = "feet"\ntraction = [1e6, 0]', "", "acts on 'feet' in x, where"),
        ('boundary = "left"\nforce = [1, 2]', "", "acts on 'left' in x and y, where"),
        (POINT_LOAD, '[[supports]]\npoint = "corner"\nfix = ["y"]\n',
         "acts on 'corner' in y, where"),
        ('boundary = "top"\nforce = [1e5, -1e8]',
         '[[supports]]\nboundary = "top"\nfix = ["x"]\n', "acts on 'top' in x, where"),
    ],
)  # fmt: skip
def test_a_load_only_on_supports_is_refused(described, load, supports, message):
    """A load is rejected if supports fix all its nodes in one of its directions."""
    toml = TOML.replace(POINT_LOAD, load) + supports
    with pytest.raises(InputError) as e:
        built(f"{described(toml=toml)}/step=1/dual")

    assert str(e.value) == (
        f"a.toml: loads[0] {message} a support fixes the displacement; expected a load "
        "on another side, or other fixed components"
    )


@pytest.mark.parametrize(
    ("load", "supports"),
    [
        # the left end node of the top is fixed
        ('boundary = "top"\nforce = [0, -1e8]', ""),
        ('boundary = "top"\nforce = [0, -1e8]',
         '[[supports]]\nboundary = "top"\nfix = ["x"]\n'),
        ('boundary = "left"\nforce = [0, 0]\n[[loads]]\n' + POINT_LOAD, ""),
    ],
)  # fmt: skip
def test_a_load_partly_on_supports_is_accepted(described, load, supports):
    toml = TOML.replace(POINT_LOAD, load) + supports
    assert built(f"{described(toml=toml)}/step=1/dual").qp.q.any()


def test_a_missing_body_is_named(described):
    text = described(toml=re.sub(r'\[\[bodies\]\]\nname = "ring"\n.*\n.*\n', "", TOML))
    with pytest.raises(
        InputError, match="bodies: physical surface 'ring' has no entry"
    ):
        built(f"{text}/dual")


def read(tmp_path, *contents, **kinds):
    (tmp_path / "m.msh").write_text(msh22(*contents, **kinds))
    return read_msh(tmp_path / "m.msh")


def bent(points):
    """Return the points of nine nodes with the middle node moved beyond a corner."""
    return np.where(np.arange(9)[:, None] == 4, [-0.5, -0.5, 0.0], points)


@pytest.mark.parametrize(
    ("contents", "message"),
    [
        (lambda p, c: (p, {"a": c[:, [0, 1, 2, 3, 0, 1]]}, {}, {}, 9),
         "cells of type triangle6; expected cells of first order: Mesh.ElementOrder = 1"
         " in the .geo file, or gmsh -2 -order 1"),
        (lambda p, c: (p, {"a": c[:, [0, 1, 2, 3] * 2]}, {}, {}, 16),
         "cells of type quad8; expected cells of first order: Mesh.ElementOrder = 1"),
        (lambda p, c: (p, {"a": c[:, [0, 1, 2, 3, 0]]}, {}, {}, 7), "cells of type "
         "pyramid; expected no pyramids: volumes of tetrahedra alone"),
        (lambda p, c: (p, {"a": c[:, [0, 1, 2, 3, 0] * 2]}, {}, {}, 11), "cells of type"
         " tetra10; expected cells of first order: Mesh.ElementOrder = 1 in the .geo "
         "file, or gmsh -3 -order 1"),
        (lambda p, c: (p, {"a": c[:, [0, 1, 1]]}, {}, {}, 2), "the triangle around "
         "(0.666667, 0, 0) repeats a node; expected distinct corners"),
        (lambda p, c: (p, {"": c}, {}, {}), "4 cells without a name; expected a name "
         'for each: Physical Surface("NAME") in the .geo file'),
        # gmsh omits the cells of surfaces without a physical name
        (lambda p, c: (p, {"a": c[:1]}, {"m": [[7, 8]]}, {}), "curve 'm' has an edge "
         "that bounds no body in the file (shells and beams are not bodies); expected "
         "every body to have a name: "
         'Physical Surface("NAME") in the .geo file'),
        (lambda p, c: (p, {}, {"b": c[:, :2]}, {}), "no physical surface with cells"),
        (lambda p, c: (p, {"a": c[:1], "b": c[3:]}, {}, {}), "bodies 'a' and 'b' share "
         "the node at (1, 1), but no edge; expected separate nodes for each body, or a "
         "common edge"),
        (lambda p, c: (p, {"a": c[[0, 3]]}, {}, {}), "bodies 'a.1' and 'a.2' share"),
        (lambda p, c: (p, {"a": np.vstack([c, [[0, 1, 5, 4]]])}, {}, {}), "more than "
         "two cells share the edge around (1.5, 1); expected cells that do not"),
        (lambda p, c: (p, {"a": c[[0, 0]]}, {"m": c[3:, 1:3]}, {}), "curve 'm' has an"),
        (lambda p, c: (p, {"a": c}, {"m": [[1, 4]]}, {}), "curve 'm' has an edge that"),
        (lambda p, c: (p + [[0, 0, 1]] * (p[:, :1] > 1), {"a": c}, {}, {}), "the nodes "
         "are not all at the same z, and there"),
        (lambda p, c: (bent(p), {"a": c}, {}, {}), "the cell around ("),
    ],
)  # fmt: skip
def test_an_unsuitable_mesh_is_refused(tmp_path, contents, message):
    content = contents(*square())
    kinds = {"quad_type": content[4]} if len(content) > 4 else {}
    with refused(message, start=f"{tmp_path}/m.msh: "):
        read(tmp_path, *content[:4], **kinds)


def untagged(text):
    """Set physical tags without a name to zero in a file of format 2.2.

    With Mesh.SaveAll = 1, gmsh writes tag 0 for entities without a physical group.
    """
    named = set(re.findall(r'^\d (\d+) "', text, re.M))
    head, cells = text.split("$Elements\n")
    return head + "$Elements\n" + re.sub(
        r"^(\d+ \d+ 2) (\d+)",
        lambda m: m[0] if m[2] in named else f"{m[1]} 0", cells, flags=re.M,
    )  # fmt: skip


SAVED = [msh41, lambda *contents: untagged(msh22(*contents))]


@pytest.mark.parametrize("writer", SAVED)
def test_all_entities_may_be_saved_if_every_body_has_a_name(tmp_path, writer):
    """Unnamed curves and points, which Mesh.SaveAll = 1 writes, have no effect."""
    quads, curves, spots = parts()
    more = curves | {"": curves["top"][:2]}, spots | {"": np.array([[0]])}
    read = []
    for name, contents in (("a", (curves, spots)), ("b", more)):
        (tmp_path / f"{name}.msh").write_text(writer(POINTS, quads, *contents))
        read.append(read_msh(tmp_path / f"{name}.msh"))

    np.testing.assert_array_equal(read[0].points, read[1].points)
    np.testing.assert_array_equal(read[0].cells, read[1].cells)
    assert list(read[0].curves) == list(read[1].curves)
    for name, edge in read[0].curves.items():
        np.testing.assert_array_equal(edge, read[1].curves[name])


@pytest.mark.parametrize("writer", SAVED)
def test_cells_that_are_saved_without_a_name_are_refused(tmp_path, writer):
    points, cells = square()
    contents = points, {"a": cells[:1], "": cells[1:]}, {"m": [[7, 8]]}, {}
    (tmp_path / "m.msh").write_text(writer(*contents))
    with pytest.raises(InputError) as e:
        read_msh(tmp_path / "m.msh")

    assert str(e.value).endswith(
        "m.msh: 3 cells without a name; expected a name for each: "
        'Physical Surface("NAME") in the .geo file'
    )


def test_a_set_of_two_parts_becomes_two_bodies(tmp_path):
    one, cells = square()
    both = np.vstack([one, square(at=(5.0, 0.0))[0]])
    mesh = read(tmp_path, both, {"a": np.vstack([cells, cells + 9])}, {}, {})

    assert list(mesh.surfaces) == ["a.1", "a.2"]
    assert [mesh.points[mesh.cells[c], 0].min() for c in mesh.surfaces.values()] == [
        0.0, 5.0,
    ]  # fmt: skip


def test_a_stiffness_that_rounding_makes_indefinite_is_refused(described):
    far = POINTS.copy()
    far[CORNER, 0] += 1e14
    with pytest.raises(InputError, match=r"^a\.toml: the stiffness has no Cholesky"):
        built(f"{described(msh22(far, *parts()))}/steps=1/dual")


def test_a_closed_contact_side_is_refused(described):
    points, cells = square()
    shell = np.array([[0, 1], [1, 2], [2, 5], [5, 8], [8, 7], [7, 6], [6, 3], [3, 0]])
    more, shift = np.vstack([POINTS, points + np.array([5, 0, 0])]), len(POINTS)
    quads, curves, spots = parts()
    toml = TOML.replace('slave = "outer"', 'slave = "shell"')
    toml += '[[bodies]]\nname = "box"\nE = 1e9\nnu = 0.3\n'
    text = described(
        msh22(
            more,
            quads | {"box": cells + shift},
            curves | {"shell": shell + shift},
            spots,
        ),
        toml,
    )
    with pytest.raises(InputError, match="slave 'shell' is closed"):
        built(f"{text}/dual")


def test_other_files_are_refused(tmp_path, capsys):
    bad = tmp_path / "bad.msh"
    for text in ("hello\n", "$MeshFormat\n2.2 0 8\n$EndMeshFormat\n$Nodes\n3\n1 0 0\n"):
        bad.write_text(text)
        with pytest.raises(InputError, match=r"bad\.msh: not a \.msh file"):
            read_msh(bad)
    assert capsys.readouterr().out == ""


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("bodies", "bodies: the path is missing; expected bodies:PATH.toml"),
        (
            "bodies:a.msh/dual",
            "a.msh/dual: the path is missing; expected bodies:PATH.t",
        ),
        ("bodies:no/a.toml/dual", "no/a.toml: No such file or directory; expected a "),
        ("bodies:a.toml/step=3/dual", "bodies: step=3 must be at most steps=2"),
        ("bodies:a.toml/path=b/dual", "bodies: key 'path' is set twice"),
    ],
)
def test_a_bad_name_is_refused(described, text, message):
    described()
    with refused(message):
        parse(text, PROBLEMS)


def test_friction_is_the_same_from_the_key_the_file_or_the_pair(
    described,
):
    law = 'friction = "coulomb"\nmu = 0.3\n'
    same = "beam-ring/Nr=2/Nh=1/steps=1/friction=coulomb/mu=0.3/dual-bounds"
    expected_qp = built(same).qp
    for toml, keys in (
        (TOML, "/friction=coulomb/mu=0.3"),
        (law + TOML, ""),
        (TOML + law, ""),
        (TOML + law, "/friction=tresca/bound=1e3"),
    ):
        qp = built(f"{described(toml=toml)}{keys}/steps=1/dual-bounds").qp

        assert qp.ub.size == 2 * (12 * NH + 1)
        assert sorted(qp.ub) == pytest.approx(sorted(expected_qp.ub), abs=1e-9)


@pytest.mark.parametrize(
    ("keys", "pair", "message"),
    [
        ("", 'friction = "tresca"', "contacts[0]: friction 'tresca' needs bound"),
        (
            "",
            'friction = "tresca"\nbound = -1',
            "friction tresca: bound = -1; expected",
        ),
        ("", 'friction = "coulomb"\nbound = 1', "contacts[0]: bound is not used by"),
        ("", "mu = 0.1", "contacts[0]: mu is not used by friction 'none'"),
        ("", 'friction = "oily"', "contacts[0]: unknown value of friction 'oily'"),
        ("/friction=coulomb", "", "friction=coulomb needs mu"),
        ("/bound=3", "", "bound=3 is not used by friction=none"),
        ("/friction=coulomb", 'friction = "none"\nmu = 3', "mu is not used by"),
    ],
)
def test_a_law_of_a_pair_that_does_not_fit_is_refused_in_one_line(
    described, keys, pair, message
):
    with refused(message):
        built(f"{described(toml=TOML + pair)}{keys}/dual")


def test_friction_can_be_omitted_for_one_pair(described):
    name = described(toml=TOML + 'friction = "none"')
    qp = built(f"{name}/friction=coulomb/mu=1/dual-bounds").qp

    assert np.isinf(qp.ub).all()
