"""Meshes of Abaqus, CalculiX and Salome: same bodies and sides as the .msh file."""

import h5py
import numpy as np
import pytest

from mortarbench.harness import InputError
from mortarbench.problems.fem.mesh import nodal_areas
from mortarbench.problems.fem.mesh_files.named import named_mesh
from mortarbench.problems.fem.mesh_files.reading import read_mesh_file, read_msh
from tests.support.cases import built, solved
from tests.support.gmsh_files import entities41, solids22, text22
from tests.support.hexahedra import TETRAHEDRA, WEDGES
from tests.support.mesh_formats import INSTANCES, write_inp, write_med
from tests.support.refusals import refused
from tests.support.solid_blocks import TOML, solid_blocks

KINDS = {"tetra": TETRAHEDRA, "wedge": WEDGES, "hexahedron": None}
WRITERS = {
    "elements.inp": write_inp,
    "nodes.inp": lambda source, path: write_inp(source, path, sides="nodes"),
    "groups.med": write_med,
}


def facets(named, name):
    """Return the set of facets of a side, each as a set of corner coordinates."""
    places = named.points.round(12).tolist()
    return {frozenset(tuple(places[n]) for n in facet)
            for facet in named.curves[name].tolist()}  # fmt: skip


@pytest.mark.parametrize(
    ("name", "kind"),
    [
        pytest.param(name, kind, marks=[pytest.mark.slow] * (i != j))
        for i, name in enumerate(WRITERS)
        for j, kind in enumerate(KINDS)
    ],
)
def test_a_mesh_has_the_bodies_and_sides_of_the_msh_file(tmp_path, kind, name):
    path = solid_blocks(tmp_path, KINDS[kind])
    expected = read_msh(tmp_path / "blocks.msh")
    WRITERS[name](tmp_path / "blocks.msh", tmp_path / name)
    energies = []
    for mesh in ("blocks.msh", name):
        path.write_text(TOML.replace("blocks.msh", mesh))
        energies.append(solved(f"bodies:{path}/dual")[2]["energy"])
    chosen = named_like(tmp_path / name, expected)

    assert energies[1] == pytest.approx(energies[0], rel=1e-12)
    for side in expected.curves:
        assert facets(chosen, side) == facets(expected, side)
        # corners are anticlockwise as seen from outside
        areas = []
        for one in (chosen, expected):
            a, b, c, d = np.moveaxis(one.points[one.curves[side]], 1, 0)
            areas.append(np.cross(c - a, d - b).sum(axis=0))
        np.testing.assert_allclose(*areas, atol=1e-12)


def named_like(path, expected):
    return named_mesh(read_mesh_file(path), expected.surfaces)


#: corners of one element, and the plane (axis and position) of each face S1, S2, …,
#: or None for the oblique face
ONE = {
    "C3D8": (
        [(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0),
         (0, 0, 1), (1, 0, 1), (1, 1, 1), (0, 1, 1)],
        [(2, 0), (2, 1), (1, 0), (0, 1), (1, 1), (0, 0)],
    ),
    "C3D6": (
        [(0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1), (1, 0, 1), (0, 1, 1)],
        [(2, 0), (2, 1), (1, 0), None, (0, 0)],
    ),
    "C3D4": (
        [(0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1)],
        [(2, 0), (1, 0), None, (0, 0)],
    ),
    "CPE4": ([(0, 0), (1, 0), (1, 1), (0, 1)], [(1, 0), (0, 1), (1, 1), (0, 0)]),
    "CPS3": ([(0, 0), (1, 0), (0, 1)], [(1, 0), None, (0, 0)]),
}  # fmt: skip


def one_element(kind, more=""):
    corners, _ = ONE[kind]
    nodes = "\n".join(
        f"{i}, {', '.join(map(str, x))}" for i, x in enumerate(corners, 1)
    )
    numbers = ", ".join(str(i) for i in range(1, len(corners) + 1))
    return f"*Node\n{nodes}\n*Element, type={kind}, elset=Body\n5, {numbers}\n{more}"


@pytest.mark.parametrize("kind", ONE)
def test_faces_of_elements_have_the_numbers_of_the_manual(tmp_path, kind):
    planes = ONE[kind][1]
    surfaces = "".join(
        f"*Surface, name=F{i}, type=ELEMENT\n{of}, S{i}\n"
        for i, of in zip(range(1, len(planes) + 1), ["Body", "5", "BODY", "body"] * 2,
                         strict=False)
    )  # fmt: skip
    (tmp_path / "a.inp").write_text(one_element(kind, surfaces))
    named = read_msh(tmp_path / "a.inp")

    assert list(named.surfaces) == ["Body"]
    for i, plane in enumerate(planes, 1):
        points = named.points[named.curves[f"F{i}"]].reshape(-1, named.dim)
        if plane is None:
            in_plane = (
                points.sum(axis=1) if kind != "C3D6" else points[:, :2].sum(axis=1)
            )
            assert (in_plane == 1).all()
        else:
            assert (points[:, plane[0]] == plane[1]).all()


def test_sets_may_be_generated_nested_continued_and_in_any_case(tmp_path):
    sets = (
        "*NSET, NSET=low, GENERATE\n1, 4, 1\n*nset, nset=Odd\n1, 3,\n5, 7\n"
        '*NSET, NSET="all"\nlow, ODD, 2\n*NSET, NSET=all\n8\n'
        "*SURFACE, NAME=under, TYPE=NODE\nlow, 1.0\n"
    )
    (tmp_path / "a.inp").write_text(one_element("C3D8", sets))
    named = read_msh(tmp_path / "a.inp")
    at = {name: set(named.points[nodes][:, 2]) for name, nodes in named.spots.items()}

    assert {k: len(v) for k, v in named.spots.items()} == {
        "low": 4, "Odd": 4, "all": 7, "under": 4,
    }  # fmt: skip
    assert at["low"] == at["under"] == {0}
    # a set of nodes is a boundary if it contains all corners of a facet
    assert {k: len(v) for k, v in named.curves.items()} == {
        "low": 1, "all": 3, "under": 1,
    }  # fmt: skip


def test_nodes_may_come_in_several_blocks_and_lines_may_end_in_a_comma(tmp_path):
    """meshio would keep the last block of nodes only."""
    text = one_element("C3D8").replace("\n5, 0, 0, 1", ",\n*NODE\n5, 0, 0, 1,")
    (tmp_path / "a.inp").write_text(text.replace("*Element, ", "*Element,\n"))

    assert len(read_msh(tmp_path / "a.inp").points) == 8


def test_sets_that_overlap_the_described_bodies_are_not_needed(tmp_path):
    path = solid_blocks(tmp_path)
    write_inp(tmp_path / "blocks.msh", tmp_path / "blocks.inp")
    path.write_text(TOML.replace("blocks.msh", "blocks.inp"))
    inp = (tmp_path / "blocks.inp").read_text()
    (tmp_path / "blocks.inp").write_text(inp + "*ELSET, ELSET=both\nlower, upper\n")
    case, s, _ = solved(f"bodies:{path}/dual")

    assert case.fields(s).bodies.max() == 1
    for old, new, message in (
        ('"lower"', '"lowr"', "unknown element set 'lowr'; did you mean 'lower'?"),
        ('"lower"', '"both"', "element set 'both' shares 8 cells with another body"),
        ('boundary = "top"', 'boundary = "topp"', "boundary: unknown surface, element "
         "set or node set 'topp'; did you mean 'top'?"),
        ('boundary = "top"', 'point = "Body"', "point: unknown node set 'Body'"),
    ):  # fmt: skip
        path.write_text(TOML.replace("blocks.msh", "blocks.inp").replace(old, new))
        with refused(message):
            built(f"bodies:{path}/dual")
    body = TOML[TOML.index('[[bodies]]\nname = "upper"') : TOML.index("[[supports]]")]
    path.write_text(TOML.replace("blocks.msh", "blocks.inp").replace(body, ""))
    with pytest.raises(InputError, match=r"bodies: element set '.*' has no entry"):
        built(f"bodies:{path}/dual")


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("type=C3D8", "type=C3D20", "elements of type C3D20; expected elements of first"
         " order: C3D4, C3D6, C3D8, or CPE3, CPE4 in the plane; choose linear (first "
         "order) elements in the program that wrote the file, in gmsh -order 1"),
        ("type=C3D8", "type=C3D10", "elements of type C3D10; expected elements of"),
        ("type=C3D8", "type=MASS", "line 10: elements of type MASS; expected elem"),
        ("*Node", "*INCLUDE, INPUT=/etc/passwd\n*Node", "*INCLUDE: other files are not "
         "opened; expected all data in this file"),
        ("*Node", "*Node, input=/etc/passwd\n*Node", "*NODE: other files are not open"),
        ("type=C3D8", "type=B31", "elements of type B31; expected elements of first"),
        ("*Node", "*Part, name=p\n*Node", "*PART without *INSTANCE; expected an inst"),
        ("*Node", "*Instance, name=i, part=p\n*Node", "line 1: unknown part 'p'; kno"),
        ("*Node", "*System\n0,0,1\n*Node", "line 1: *SYSTEM: it generates or moves no"),
        ("*Node", "*Node, system=C", "line 1: *NODE: it generates or moves nodes or"),
        ("*Element", "9, 9, 9, 9\n*Element, type=S3\n7, 1, 2, 9\n*Element", "line 11: "
         "elements of type S3 (shells, membranes or trusses) apart from the solids; "),
        (", 4, 5, 6, 7, 8", ", 4", "line 11: an element with 4 nodes; C3D8 has 8"),
        ("1, 0, 0, 0", "1, 0, 0x, 0", "line 2: '0x'; expected a number"),
        ("5, 1,", "5, 99,", "element 5 refers to node 99, which is not in the file"),
        ("\n3, 1", "\n2, 1", "node 2 is defined 2 times; expected every number once"),
        ("*Element", "*Nset, nset=a\n1, 77\n*Element", "set 'a' contains 77, which is"),
        ("*Element", "*Nset, nset=a\nb\n*Element", "set 'a': unknown set 'b'; known: "),
        ("*Element", "*Nset\n1\n*Element", "*NSET without a name; expected NSET=NAME"),
        ("*Element", "*Surface, name=s\nBody, S7\n*Element", "surface 's': unknown "
         "face of a hexahedron 'S7'; known: S1, S2, S3, S4, S5, S6"),
        ("*Element", "*Surface, name=s\nBody\n*Element", "surface 's': unknown face"),
        (", elset=Body", "", "1 cells without a name; expected a name for each: "
         "*ELEMENT, ELSET=NAME or *ELSET, ELSET=NAME"),
        ("1, 0, 0, 0", "1, nan, 0, 0", "coordinates are missing or not below 1e+100"),
        ("*Node", "*Nodes", "no nodes; expected *NODE and *ELEMENT"),
        ("*Element", "*Elements", "no elements; expected *NODE and *ELEMENT"),
    ],
)  # fmt: skip
def test_an_inp_file_that_cannot_be_read_is_refused_in_one_line(
    tmp_path, old, new, message
):
    path = tmp_path / "a.inp"
    path.write_text(one_element("C3D8").replace(old, new, 1))
    with refused(message, start=f"{path}: "):
        read_msh(path)


def test_sets_of_sets_without_end_are_refused(tmp_path):
    more = "*NSET, NSET=a, GENERATE\n1, 2000000000\n" + "*NSET, NSET=a\na\n" * 1000
    (tmp_path / "a.inp").write_text(one_element("C3D8", more))
    read_msh(tmp_path / "a.inp")
    nodes = "*NODE\n" + "".join(f"{i}, 0, 0, {i}\n" for i in range(100, 2000))
    (tmp_path / "a.inp").write_text(one_element("C3D8", nodes + more))
    with pytest.raises(InputError, match="the sets have too many members in total"):
        read_msh(tmp_path / "a.inp")


def med(tmp_path, change):
    """Write the mesh of the blocks as a MED file, and apply `change` to the open
    file."""
    solid_blocks(tmp_path)
    write_med(tmp_path / "blocks.msh", tmp_path / "a.med")
    with h5py.File(tmp_path / "a.med", "r+") as file:
        change(file, next(iter(file["ENS_MAA/mesh"].values())))
    return tmp_path / "a.med"


def test_groups_of_nodes_are_boundaries_and_a_kind_may_have_no_families(tmp_path):
    """meshio rejects files in which cells of some type have no families."""

    def change(file, step):
        del step["MAI/QU4/FAM"]
        z = step["NOE/COO"][()].reshape(3, -1)[2]
        step["NOE"]["FAM"] = np.where(z == 0, 3, np.where(z == 2, 8, 0))
        for number, names in ((3, [b"under", b"ends"]), (8, [b"ends"])):
            family = file.create_group(f"FAS/mesh/NOEUD/F{number}")
            family.attrs["NUM"] = number
            text = [np.frombuffer(n.ljust(80, b"\0"), dtype=np.int8) for n in names]
            family["GRO/NOM"] = np.array(text)

    named = read_msh(med(tmp_path, change))

    assert sorted(named.surfaces) == ["lower", "upper"]
    assert {name: len(at) for name, at in named.curves.items()} == {
        "under": 9, "ends": 13,
    }  # fmt: skip


def renamed(file, step):
    step.move("MAI/HE8", "MAI/H20")


def second(file, step):
    file.copy("ENS_MAA/mesh", "ENS_MAA/other")


def elsewhere(file, step):
    del step["NOE/COO"]
    step["NOE"].create_dataset("COO", (99,), dtype="f8", external="/etc/passwd")


def linked(file, step):
    del step["NOE"]
    step["NOE"] = h5py.ExternalLink("/etc/other.med", "/NOE")


def huge(file, step):
    del step["NOE/COO"]
    step["NOE"].create_dataset("COO", (3, 10**12), dtype="f8", chunks=(3, 1024))


def outside(file, step):
    step["MAI/HE8/NOD"][0] = 10**6


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (renamed, "cells of type hexahedron20; expected cells of first order: in "
         "Salome, Modification, Convert to/from quadratic; in gmsh, -order 1"),
        (second, "2 meshes with 2 time steps; expected one mesh with one step"),
        (elsewhere, "arrays in other files, which are not opened; expected all data"),
        (linked, "1 meshes with 0 time steps; expected one mesh with one step"),
        (huge, "its arrays would take 183105468 MiB of memory; expected at most"),
        (outside, "cells refer to nodes that are not in the file; define these"),
        (lambda file, step: step["MAI/HE8/NOD"].attrs.modify("NBR", 7),
         "damaged, or not a .med file in HDF5"),
    ],
)  # fmt: skip
def test_a_med_file_that_cannot_be_read_is_refused_in_one_line(
    tmp_path, change, message
):
    with refused(message):
        read_msh(med(tmp_path, change))


def test_other_content_is_not_a_med_file(tmp_path):
    for content in (b"", b"hello", b"\x89HDF\r\n\x1a\n" + bytes(200)):
        (tmp_path / "a.med").write_bytes(content)
        with pytest.raises(InputError, match=r"a\.med: damaged, or not a \.med file"):
            read_msh(tmp_path / "a.med")


def test_instances_are_moved_copies_of_their_part(tmp_path):
    """The second square is turned by 180° about a point of the first."""
    (tmp_path / "a.inp").write_text(INSTANCES)
    named = read_msh(tmp_path / "a.inp")
    first, second = named.points[:6], named.points[6:]

    assert sorted(named.surfaces) == ["lower.cells", "upper.cells"]
    np.testing.assert_allclose(second, [2, 4] - first, atol=1e-15)
    assert facets(named, "foot") == facets(named, "table")
    assert facets(named, "base") == {frozenset({(0, 0), (1, 0)}),
                                     frozenset({(1, 0), (2, 0)})}  # fmt: skip
    # sets of the assembly add members of both instances
    assert set(named.points[named.spots["axis"]][:, 0].round(12)) == {0.0}
    # the elements of an instance are a body of its name, if the description uses it
    whole = named_mesh(read_mesh_file(tmp_path / "a.inp"), ["upper"])
    assert sorted(whole.surfaces) == ["lower.cells", "upper"]


@pytest.mark.parametrize(
    ("turn", "expected"),
    [
        ("", [1, 2, 3]),
        ("0, 0, 0, 0, 0, 2, 90", [-2, 1, 3]),  # (1, 2) turns to (−2, 1)
        ("5, 0, 0, 5, 0, -1, 90.", [7, 4, 3]),  # clockwise about (5, 0)
        ("0, 0, 0, 1, 1, 1, 120", [3, 1, 2]),  # x → y → z → x
    ],
)  # fmt: skip
def test_an_instance_is_translated_and_then_rotated(tmp_path, turn, expected):
    assert ONE["C3D8"][0][3] == (0, 1, 0)  # node 4 of the part
    text = f"*PART, NAME=p\n{one_element('C3D8')}*END PART\n*ASSEMBLY\n"
    text += f"*INSTANCE, NAME=i, PART=P\n1, 1, 3\n{turn}\n*END INSTANCE\n"
    (tmp_path / "a.inp").write_text(f"{text}*NSET, NSET=o\ni.4\n*END ASSEMBLY\n")
    named = read_msh(tmp_path / "a.inp")

    np.testing.assert_allclose(named.points[named.spots["o"]], [expected], atol=1e-14)


def test_node_sets_of_element_sets_and_short_lines(tmp_path):
    """Missing coordinates are 0, exponents may be D, unused nodes are ignored."""
    text = (
        "*NODE, NSET=all\n1\n2, 1.D0\n3, 1, 1.0d+00\n4,, 1\n"
        "5, 2.0, 0,, 1\n6, 2, 1\n99, 7, 7, 7.5\n"
        "*ELEMENT, TYPE=CPS4, ELSET=a\n1, 1, 2, 3, 4\n*ELEMENT, TYPE=CPS4, ELSET=b\n"
        "2, 2, 5, 6,\n3\n*NSET, NSET=right, ELSET=b\n*ELSET, ELSET=both\na, b\n"
    )
    (tmp_path / "a.inp").write_text(text)
    named = read_msh(tmp_path / "a.inp")

    assert named.points.tolist() == [[0, 0], [1, 0], [1, 1], [0, 1], [2, 0], [2, 1]]
    assert named.points[named.spots["right"]].tolist() == [
        [1, 0],
        [1, 1],
        [2, 0],
        [2, 1],
    ]
    assert list(named.surfaces) == ["a", "b"]
    assert named.piece.tolist() == [0, 0]


def test_other_suffixes_name_the_formats_that_are_read(tmp_path):
    (tmp_path / "a.stl").write_text("solid a\nendsolid a\n")
    with pytest.raises(InputError) as e:
        read_msh(tmp_path / "a.stl")
    assert str(e.value).endswith(
        "a.stl: a mesh of unknown format '.stl'; expected .msh (gmsh), .inp (Abaqus, "
        "CalculiX) or .med (Salome)"
    )


SQUARE = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]])


@pytest.mark.parametrize("binary", [False, True])
def test_an_entity_may_belong_to_several_groups(tmp_path, binary):
    """Groups of one entity, as in "sides" and "left" of one curve."""
    entities = [
        (1, 1, [[3, 0]], ["sides", "left"]),
        (1, 1, [[1, 2]], ["sides"]),
        (1, 1, [[0, 1]], []),
        (2, 3, [[0, 1, 2, 3]], ["everything", "body"]),
    ]
    (tmp_path / "a.msh").write_bytes(entities41(SQUARE, entities, binary))
    file = read_mesh_file(tmp_path / "a.msh")
    named = named_mesh(file, ["body"])

    assert {name: len(curve) for name, curve in named.curves.items()} == {
        "sides": 2, "left": 1,
    }  # fmt: skip
    assert list(named.surfaces) == ["body"]
    assert list(named_mesh(file).surfaces) == ["everything"]


@pytest.mark.parametrize("name", ["a.msh", "a.inp"])
def test_facets_and_cells_that_are_listed_twice_count_once(tmp_path, name):
    """A group of format 2 repeats its cells; a surface may name a face twice."""
    if name == "a.inp":
        text = one_element("C3D8", "*Surface, name=top\nBody, S2\n5, S2\nBody, S2\n")
        text += "*ELEMENT, TYPE=S4, ELSET=top\n9, 5, 6, 7, 8\n10, 8, 7, 6, 5\n"
        text += "*ELEMENT, TYPE=C3D8, ELSET=again\n6, 5, 6, 7, 8, 1, 2, 3, 4\n"
    else:
        cell, corners = [list(range(8))], np.array(ONE["C3D8"][0])
        text = solids22(
            corners,
            {"Body": cell, "again": cell},
            {"top": [[4, 5, 6, 7], [7, 6, 5, 4]]},
        )
    (tmp_path / name).write_text(text)
    named = read_msh(tmp_path / name)

    assert len(named.cells) == 1
    assert list(named.surfaces) == ["Body"]
    assert len(named.curves["top"]) == 1
    assert nodal_areas(named.points, named.curves["top"])[1].sum() == pytest.approx(1)


@pytest.mark.parametrize(
    ("kind", "cells", "faces"),
    [(4, [[0, 1, 2, 3], [1, 2, 3, 3]], [[0, 1, 2]]),
     (5, [[0, 1, 2, 2, 4, 5, 6, 7]], [[0, 1, 2]]),
     (4, [[0, 1, 2, 3]], [[0, 1, 1]])],
)  # fmt: skip
def test_a_cell_that_repeats_a_node_is_refused_with_its_place(
    tmp_path, kind, cells, faces
):
    points = np.array(ONE["C3D8"][0])
    body = [f"{i} {kind} 2 1 1 {' '.join(str(n + 1) for n in c)}"
            for i, c in enumerate(cells, 1)]  # fmt: skip
    rows = [f"{i} 2 2 2 2 {' '.join(str(n + 1) for n in c)}"
            for i, c in enumerate(faces, 9)]  # fmt: skip
    groups = ['3 1 "body"', '2 2 "face"']
    (tmp_path / "a.msh").write_text(text22(points, groups, body + rows))
    with pytest.raises(
        InputError, match=r"around \(.*\) repeats a node; expected dist"
    ):
        read_msh(tmp_path / "a.msh")
