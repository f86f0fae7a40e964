"""VTU files, read back by meshio and by an XML parser."""

from dataclasses import replace
from xml.etree import ElementTree

import meshio
import numpy as np
import pandas as pd
import pytest

from mortarbench.harness import ContactSide, Fields, InputError
from mortarbench.harness.files.qpfile import save_qp
from mortarbench.harness.files.store import field_arrays, load_fields, save
from mortarbench.harness.names import parse
from mortarbench.problems import PROBLEMS
from mortarbench.reports.export.vtu import write_series, write_vtu
from mortarbench.solvers import SOLVERS
from mortarbench.solvers.reference.solve import reference_solution

FIELDS = Fields(
    points=np.array([[0.0, 0], [1, 0], [1, 1], [0, 1], [0, 2], [1, 2], [1, 3], [0, 3]]),
    cells=np.array([[0, 1, 2, 3], [4, 5, 6, 7]]),
    bodies=np.array([0, 1]),
    displacement=np.arange(16).reshape(8, 2) / 7,
    nodal={"von_mises": np.linspace(1e6, 2e6, 8)},
    contact_nodes=np.array([3, 2]),
    contact_forces=np.array([[0.0, -3e5], [0.0, -0.1]]),
)


@pytest.fixture
def grid(tmp_path):
    write_vtu(FIELDS, tmp_path / "a.vtu")
    return meshio.read(tmp_path / "a.vtu")


def test_points_and_vectors_have_three_components(grid):
    np.testing.assert_array_equal(grid.points[:, :2], FIELDS.points)
    u = grid.point_data["displacement"]
    np.testing.assert_array_equal(u[:, :2], FIELDS.displacement)
    for vectors in (grid.points, u, grid.point_data["contact_force"]):
        assert vectors.shape == (8, 3)
        assert not vectors[:, 2].any()


def test_cell_data_contain_the_body(grid):
    (block,) = grid.cells

    assert block.type == "quad"
    np.testing.assert_array_equal(block.data, FIELDS.cells)
    np.testing.assert_array_equal(grid.cell_data["body"][0], [0, 1])


def test_a_family_states_the_subdomain_of_every_cell(tmp_path):
    case = parse("beam-ring/Nr=4/Nh=3/steps=1/feti=3/dual", PROBLEMS).build(
        reference_solution
    )
    answer = SOLVERS["smalbe"].prepare(case.qp, 1e-6)()
    fields = case.fields(answer)
    stored = load_fields(tmp_path, save(tmp_path, field_arrays(fields)))
    subdomains = case.quantities(answer)["subdomains"]
    assert np.unique(fields.subdomains).size == subdomains
    assert fields.subdomains.shape == (len(fields.cells),)
    np.testing.assert_array_equal(stored.subdomains, fields.subdomains)
    for number in np.unique(fields.subdomains):  # each subdomain is part of one body
        assert np.unique(fields.bodies[fields.subdomains == number]).size == 1
        assert np.bincount(fields.subdomains)[number] <= 9  # 3 cells per side


def test_triangles_are_triangles_with_their_bodies(tmp_path):
    cells = np.array([[0, 1, 2, 3], [4, 5, 6, 6], [4, 6, 7, 7]])
    torn = replace(
        FIELDS, cells=cells, bodies=np.array([3, 4, 5]), subdomains=np.array([2, 0, 1])
    )
    write_vtu(torn, tmp_path / "a.vtu")
    grid = meshio.read(tmp_path / "a.vtu")

    assert [block.type for block in grid.cells] == ["triangle", "quad"]
    np.testing.assert_array_equal(grid.cells[0].data, cells[1:, :3])
    np.testing.assert_array_equal(grid.cells[1].data, cells[:1])
    assert [body.tolist() for body in grid.cell_data["body"]] == [[4, 5], [3]]
    assert [part.tolist() for part in grid.cell_data["subdomain"]] == [[0, 1], [2]]


def test_contact_is_a_force_and_a_flag_without_gaps_elsewhere(grid):
    force, flag = grid.point_data["contact_force"], grid.point_data["in_contact"]

    np.testing.assert_array_equal(force[:, 1], [0, 0, -0.1, -3e5, 0, 0, 0, 0])
    assert flag.dtype.kind == "i"  # relative to the first force, the second is rounding
    np.testing.assert_array_equal(flag, [0, 0, 0, 1, 0, 0, 0, 0])
    np.testing.assert_array_equal(
        grid.point_data["von_mises"], FIELDS.nodal["von_mises"]
    )


def test_bodies_without_contact_are_written_too(tmp_path):
    bare = Fields(points=FIELDS.points, cells=FIELDS.cells, bodies=FIELDS.bodies,
                  displacement=FIELDS.displacement)  # fmt: skip
    write_vtu(bare, tmp_path / "a.vtu")
    data = meshio.read(tmp_path / "a.vtu").point_data

    assert not data["contact_force"].any()
    assert not data["in_contact"].any()


def test_a_solved_case_is_written_without_nan_and_its_contact_balances(tmp_path):
    params = dict(Nr=2, Nh=1, steps=1)
    family = PROBLEMS["beam-ring"]
    case = family.with_keys(**params).build("dual-bounds", reference_solution)
    s = SOLVERS["clarabel"].prepare(case.qp, 1e-8)()
    write_vtu(case.fields(s), tmp_path / "a.vtu")
    data = meshio.read(tmp_path / "a.vtu").point_data

    side = np.isfinite(data["gap"])
    assert side.sum() == case.qp.q.size  # one row for each slave node
    assert all(np.isfinite(values).all() for k, values in data.items() if k != "gap")
    assert not data["pressure"][~side].any()
    found = case.quantities(s)["contacts"]["ring on beam"]
    assert data["pressure"].max() == found["largest_pressure"]
    assert data["gap"][side].min() == found["smallest_gap"]
    assert data["in_contact"].sum() == case.quantities(s)["active"]
    # the force on the ring is opposite to the force on the beam
    on_beam = case.quantities(s)["contact_force"]
    np.testing.assert_allclose(
        data["contact_force"].sum(axis=0)[:2], np.negative(on_beam)
    )
    np.testing.assert_allclose(data["displacement"][:, :2].ravel(), case.recover(s))


SIDE = ContactSide(
    name="disc on a/b (2)", nodes=np.array([3, 2, 7]), length=np.array([0.5, 1.0, 0.5]),
    force=np.array([[0.0, -3e5], [1e-3, -0.1], [0.0, 0.0]]),
    pressure=np.array([6e5, 0.1, 0.0]), gap=np.array([-1e-18, 0.25, np.nan]),
)  # fmt: skip


def test_each_contact_has_a_csv_table(tmp_path):
    written = write_vtu(replace(FIELDS, contacts=(SIDE,)), tmp_path / "a.vtu")
    table = pd.read_csv(tmp_path / "a-disc-on-a-b-2.csv")

    assert written == [tmp_path / "a.vtu", tmp_path / "a-disc-on-a-b-2.csv"]
    assert table.along_m.tolist() == [0, 1, 1 + np.sqrt(5)]
    assert table.pressure_Pa.tolist() == SIDE.pressure.tolist()
    assert table.gap_m[:2].tolist() == SIDE.gap[:2].tolist()
    assert table.gap_m.isna().tolist() == [False, False, True]
    np.testing.assert_array_equal(
        table[["force_x_N_per_m", "force_y_N_per_m"]], SIDE.force
    )
    np.testing.assert_array_equal(table[["x_m", "y_m"]], FIELDS.points[SIDE.nodes])


def test_a_table_in_3d_has_areas_and_no_arc_length(tmp_path):
    axis = (0.0, 1.0)
    points = np.array([[x, y, z] for z in axis for y in axis for x in axis])
    side = ContactSide(
        name="cube on rigid", nodes=np.arange(4), length=np.full(4, 0.25),
        force=np.eye(4, 3), pressure=np.ones(4), gap=np.zeros(4), shear=np.ones(4),
        friction=np.array(["open", "stick", "slip", ""]), friction_force=np.eye(4, 3),
    )  # fmt: skip
    fields = Fields(
        points=points, cells=np.array([[0, 1, 3, 2, 4, 5, 7, 6]]), bodies=np.zeros(1),
        displacement=0 * points, contacts=(side,),
    )  # fmt: skip
    write_vtu(fields, tmp_path / "a.vtu")
    table = pd.read_csv(tmp_path / "a-cube-on-rigid.csv", keep_default_na=False)

    assert [*table.columns] == [
        "x_m", "y_m", "z_m", "ux_m", "uy_m", "uz_m", "area_m2", "force_x_N",
        "force_y_N", "force_z_N", "pressure_Pa", "gap_m", "shear_Pa", "friction",
    ]  # fmt: skip
    assert table.friction.tolist() == ["open", "stick", "slip", ""]


def test_grid_and_table_contain_shear_and_friction_states(tmp_path):
    rough = replace(
        SIDE, shear=np.array([1e5, -0.5, 0.0]),
        friction=np.array(["slip", "stick", "open"]),
    )  # fmt: skip
    write_vtu(replace(FIELDS, contacts=(rough,)), tmp_path / "a.vtu")
    data = meshio.read(tmp_path / "a.vtu").point_data
    table = pd.read_csv(tmp_path / "a-disc-on-a-b-2.csv")

    assert data["shear"][SIDE.nodes].tolist() == rough.shear.tolist()
    assert data["friction"][SIDE.nodes].tolist() == [2, 1, 0]
    assert table.friction.tolist() == rough.friction.tolist()
    assert table.shear_Pa.tolist() == rough.shear.tolist()
    assert data["in_contact"][SIDE.nodes].tolist() == [1, 1, 0]
    write_vtu(replace(FIELDS, contacts=(SIDE,)), tmp_path / "b.vtu")
    assert "friction" not in meshio.read(tmp_path / "b.vtu").point_data


def test_contact_takes_precedence_over_sliding_without_contact(tmp_path):
    def rough(*states):
        return replace(SIDE, shear=np.ones(3), friction=np.array(states))

    apart = "sliding without contact"
    sides = rough(apart, apart, apart), rough("open", "stick", "slip")
    write_vtu(replace(FIELDS, contacts=sides[:1]), tmp_path / "a.vtu")
    write_vtu(replace(FIELDS, contacts=sides), tmp_path / "b.vtu")
    one, both = (meshio.read(tmp_path / f"{n}.vtu").point_data for n in "ab")
    table = pd.read_csv(tmp_path / "a-disc-on-a-b-2.csv")

    assert one["friction"][SIDE.nodes].tolist() == [3, 3, 3]
    assert one["in_contact"].sum() == 0
    assert table.friction.tolist() == [apart] * 3
    assert both["friction"][SIDE.nodes].tolist() == [3, 1, 2]
    assert both["in_contact"][SIDE.nodes].tolist() == [0, 1, 1]


def test_friction_on_open_nodes_does_not_count_as_contact(tmp_path):
    family = PROBLEMS["beam-ring"]
    configured = family.with_keys(Nr=4, Nh=2, steps=1, friction="tresca", bound=1e8)
    case = configured.build("dual-bounds", reference_solution)
    s = reference_solution(case.qp)
    write_vtu(case.fields(s), tmp_path / "a.vtu")
    data = meshio.read(tmp_path / "a.vtu").point_data
    found = case.quantities(s)
    pressed = data["in_contact"] == 1

    touching = np.isin(data["friction"], [1, 2])
    assert pressed.sum() == found["active"] == touching.sum()
    assert (data["friction"] == 3).sum() == found["sliding_without_contact"] > 0
    assert np.linalg.norm(data["contact_force"], axis=1)[~pressed].max() > 1e4
    (side,) = case.fields(s).contacts
    half = side.length[np.isin(side.friction, ["stick", "slip"])].sum() / 2
    assert found["contacts"]["ring on beam"]["half_width"] == half


@pytest.fixture
def solve(tmp_path, command):
    """Solve a case with --vtu; return exit code, stderr and the file."""

    def solve(case, name="a.vtu"):
        path = tmp_path / name
        code, _, err = command("solve", case, "--solver", "clarabel", "--vtu", path)
        return code, err, path

    return solve


def test_solve_refuses_unsupported_cases_and_formats(solve, manufactured, tmp_path):
    save_qp(tmp_path / "a.npz", manufactured("box")[0], {})
    code, err, path = solve(f"file:{tmp_path / 'a.npz'}")

    assert (code, path.exists()) == (2, False)
    assert err.endswith("has no bodies to draw; leave out --vtu\n")
    code, err, _ = solve("beam-ring/dual", "a.vtk")
    assert code == 2
    assert err.endswith("a.vtk: unknown format '.vtk'; expected .vtu or .pvd\n")


def test_a_series_lists_its_files_and_times(tmp_path):
    path = tmp_path / "a & b.pvd"
    written = write_series([(0.5, FIELDS), (1.0, FIELDS)], path)
    sets = ElementTree.parse(path).getroot().findall("Collection/DataSet")

    assert written[0] == path
    assert [float(s.get("timestep")) for s in sets] == [0.5, 1.0]
    assert [tmp_path / s.get("file") for s in sets] == written[1:]
    assert len(written) == 3
    for file in written[1:]:
        assert len(meshio.read(file).points) == 8


def test_a_file_that_cannot_be_written_is_named(tmp_path):
    with pytest.raises(InputError, match=r"a\.vtu: cannot be written"):
        write_vtu(FIELDS, tmp_path / "no" / "a.vtu")
    with pytest.raises(InputError, match=r"a\.pvd: cannot be written"):
        write_series([], tmp_path / "no" / "a.pvd")


def test_a_series_contains_all_load_steps_up_to_the_requested_one(solve, tmp_path):
    code, _, path = solve("beam-ring/Nr=2/Nh=2/steps=4/step=3/dual-bounds", "a.pvd")
    series = ElementTree.parse(path).getroot().findall("Collection/DataSet")
    tips = [
        meshio.read(tmp_path / entry.get("file")).point_data["displacement"][:, 1].min()
        for entry in series
    ]

    assert code == 0
    assert [float(entry.get("timestep")) for entry in series] == [1, 2, 3]
    assert tips[0] > tips[1] > tips[2]  # the tip sinks


def test_solids_are_written_by_cell_type_with_forces_in_newtons(tmp_path):
    corners = np.array(list(np.ndindex(2, 2, 2)), dtype=float)
    tetra = [0, 4, 6, 7, 7, 7, 7, 7]  # as degenerate hexahedra
    wedge = [0, 4, 6, 6, 1, 5, 7, 7]
    touching = ContactSide(
        name="cube on wall", nodes=np.arange(4), length=np.full(4, 0.25),
        force=np.tile([0.0, 0, 2], (4, 1)), pressure=np.full(4, 8.0), gap=np.zeros(4),
    )  # fmt: skip
    cube = Fields(
        points=corners, cells=np.array([tetra, wedge, [0, 4, 6, 2, 1, 5, 7, 3]]),
        bodies=np.array([1, 2, 0]), displacement=corners / 7, contacts=(touching,),
    )  # fmt: skip

    paths = write_vtu(cube, tmp_path / "a.vtu")

    grid = meshio.read(paths[0])
    assert {b.type: b.data.tolist() for b in grid.cells} == {
        "tetra": [tetra[:4]],
        "wedge": [[0, 4, 6, 1, 5, 7]],
        "hexahedron": [[0, 4, 6, 2, 1, 5, 7, 3]],
    }
    assert [own.tolist() for own in grid.cell_data["body"]] == [[1], [2], [0]]
    np.testing.assert_array_equal(grid.point_data["displacement"], corners / 7)
    along = pd.read_csv(paths[1])
    assert along[["force_x_N", "force_y_N", "force_z_N"]].sum().tolist() == [0, 0, 8]
    assert along["area_m2"].sum() == 1
    assert along[["x_m", "y_m", "z_m"]].to_numpy().tolist() == corners[:4].tolist()


def test_a_node_of_two_contacts_has_the_larger_pressure_and_the_smaller_gap(tmp_path):
    other = replace(
        SIDE, name="b on c", pressure=np.array([0.0, 7.0, 0.0]),
        gap=np.array([0.5, np.nan, np.nan]),
    )  # fmt: skip
    write_vtu(replace(FIELDS, contacts=(SIDE, other)), tmp_path / "a.vtu")
    data = meshio.read(tmp_path / "a.vtu").point_data

    assert data["pressure"].tolist() == [0, 0, 7.0, 6e5, 0, 0, 0, 0]
    np.testing.assert_array_equal(data["gap"][[3, 2]], [-1e-18, 0.25])
    assert np.isnan(data["gap"]).sum() == 6
