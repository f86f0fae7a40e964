"""Three-dimensional meshes from gmsh files: cells, orientation, names,
rejected files.
"""

import meshio
import numpy as np
import pytest

from mortarbench.harness import Fields, InputError
from mortarbench.problems.fem.elasticity import Material, elasticity_matrix, stiffness
from mortarbench.problems.fem.mesh import Mesh, box
from mortarbench.problems.fem.mesh_files.reading import read_msh
from mortarbench.reports.export.vtu import write_vtu
from tests.support.hexahedra import TETRAHEDRA, WEDGES, divided

D = elasticity_matrix(Material(E=1.0, nu=0.3), None)
CUBE = box((0.0, 0.0, 0.0), (1.0, 1.0, 1.0), (2, 2, 2))


def blocks_of(mesh, name, names):
    """Return cells, and faces of bottom and top, with the numbers of their names."""
    faces = [(side, mesh.boundaries[side]) for side in ("bottom", "top")]
    out = [(block.kind, block.nodes, names[name]) for block in mesh.blocks]
    for side, faces_of_side in faces:
        for face in faces_of_side:
            corners = list(dict.fromkeys(face.tolist()))
            kind = "quad" if len(corners) == 4 else "triangle"
            out.append((kind, np.array([corners]), names[f"{name}_{side}"]))
    return out


def write(path, bodies, version="2.2", binary=False):
    """Write named bodies as gmsh does; nodes are numbered body by body."""
    names, cells, tags, points, start = {}, [], [], [], 0
    for name in bodies:
        for part in (name, f"{name}_bottom", f"{name}_top"):
            names[part] = len(names) + 1
    for name, mesh in bodies.items():
        for kind, nodes, number in blocks_of(mesh, name, names):
            cells.append((kind, nodes + start))
            tags.append(np.full(len(nodes), number))
        points.append(mesh.points)
        start += len(mesh.points)
    field_data = {
        name: np.array([number, 3 if name in bodies else 2])
        for name, number in names.items()
    }
    grid = meshio.Mesh(
        np.concatenate(points), cells, field_data=field_data,
        cell_data={"gmsh:physical": tags, "gmsh:geometrical": tags},
    )  # fmt: skip
    meshio.gmsh.write(path, grid, fmt_version=version, binary=binary)
    return path


def cut(corners=None, shift=0.0):
    """Return a cube of one type of cell, with triangular or quadrilateral faces."""
    mesh = Mesh(np.add(CUBE.points, [shift, 0, 0]), CUBE.cells, CUBE.boundaries)
    if corners is None:
        return mesh
    mesh = divided(mesh, corners)
    sides = {  # both diagonals start at the corner with the lowest number
        name: np.concatenate([
            [[f[i], f[(i + 1) % 4], f[(i + 2) % 4], f[(i + 2) % 4]],
             [f[i], f[(i + 2) % 4], f[(i + 3) % 4], f[(i + 3) % 4]]]
            for f in faces.tolist() for i in [int(np.argmin(f))]
        ])
        for name, faces in CUBE.boundaries.items() if name in ("bottom", "top")
    }  # fmt: skip
    return Mesh(mesh.points, mesh.cells, sides)


KINDS = {"tetra": TETRAHEDRA, "wedge": WEDGES, "hexahedron": None}


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("binary", [False, True])
def test_a_body_is_read_with_its_cells_and_sides(tmp_path, kind, binary):
    body = cut(KINDS[kind])
    named = read_msh(write(tmp_path / "a.msh", {"block": body}, binary=binary))
    mesh = Mesh(named.points, named.cells, named.curves)
    place = np.array([
        int(np.linalg.norm(named.points - x, axis=1).argmin()) for x in body.points
    ])  # fmt: skip
    at = (3 * place[:, None] + np.arange(3)).ravel()

    assert [block.kind for block in mesh.blocks] == [kind]
    assert named.surfaces["block"].tolist() == list(range(len(body.cells)))
    K, expected = stiffness(mesh, D), stiffness(body, D)
    assert abs(K[at][:, at] - expected).max() <= 1e-15
    for name, z in (("block_bottom", 0), ("block_top", 1)):
        a, b, c, d = np.moveaxis(named.points[named.curves[name]], 1, 0)
        area = np.cross(c - a, d - b) / 2
        assert area.sum(axis=0) == pytest.approx([0, 0, 2 * z - 1])
        assert (a[:, 2] == z).all()


def test_bodies_of_several_kinds_are_degenerate_hexahedra(tmp_path):
    bodies = {kind: cut(corners, 2.0 * i) for i, (kind, corners) in
              enumerate(KINDS.items())}  # fmt: skip
    named = read_msh(write(tmp_path / "a.msh", bodies))
    mesh = Mesh(named.points, named.cells, named.curves)
    apart = [stiffness(body, D).trace() for body in bodies.values()]

    assert {block.kind for block in mesh.blocks} == set(KINDS)
    assert list(named.surfaces) == list(KINDS)
    assert stiffness(mesh, D).trace() == pytest.approx(sum(apart), rel=1e-13)
    u = np.outer(named.points[:, 2], [0, 0, 1])
    fields = Fields(
        points=named.points, cells=named.cells, displacement=u,
        bodies=np.repeat([0, 1, 2], [len(c) for c in named.surfaces.values()]),
    )  # fmt: skip
    write_vtu(fields, tmp_path / "a.vtu")
    grid = meshio.read(tmp_path / "a.vtu")
    assert sorted(block.type for block in grid.cells) == sorted(KINDS)
    for block, numbers in zip(grid.cells, grid.cell_data["body"], strict=True):
        assert set(numbers.tolist()) == {list(KINDS).index(block.type)}


@pytest.mark.parametrize("kind", KINDS)
def test_mirrored_cells_are_turned(tmp_path, kind):
    body = cut(KINDS[kind])
    mirrored = Mesh(body.points * [-1, 1, 1], body.cells, body.boundaries)
    named = read_msh(write(tmp_path / "a.msh", {"block": mirrored}))
    K = stiffness(Mesh(named.points, named.cells, {}), D)

    assert np.linalg.eigvalsh(K.toarray())[0] >= -1e-14
    expected = stiffness(body, D).trace()
    assert K.trace() == pytest.approx(expected)
    assert len(named.curves["block_top"]) == len(body.boundaries["top"])


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda b: b.cells[:, [0, 2, 1, 3, 4, 5, 6, 7]], "the hexahedron around "
         "(0.25, 0.25, 0.25) has no volume or folds over; expected distinct corners"),
        (lambda b: b.cells[:4], "surface 'block_top' has a face that bounds "
         "no body in the file (shells and beams are not bodies); expected every body "
         "to have a name: "
         'Physical Volume("NAME") in the .geo file'),
        (lambda b: np.hstack([b.cells, b.cells, b.cells[:, :4]]), "cells of type "
         "hexahedron20; expected cells of first order: Mesh.ElementOrder = 1 in the "
         ".geo file, or gmsh -3 -order 1"),
        (lambda b: b.cells[:, :5], "cells of type pyramid; expected no pyramids"),
    ],
)  # fmt: skip
def test_unreadable_files_are_refused_in_one_line(tmp_path, change, message):
    cells = change(CUBE)
    kind = {5: "pyramid", 8: "hexahedron", 20: "hexahedron20"}[cells.shape[1]]
    top = CUBE.boundaries["top"]
    grid = meshio.Mesh(
        CUBE.points, [(kind, cells), ("quad", top)],
        cell_data={
            f"gmsh:{name}": [np.full(len(cells), 1), np.full(len(top), 2)]
            for name in ("physical", "geometrical")
        },
        field_data={"block": np.array([1, 3]), "block_top": np.array([2, 2])},
    )  # fmt: skip
    meshio.gmsh.write(tmp_path / "a.msh", grid, fmt_version="2.2", binary=False)
    with pytest.raises(InputError) as e:
        read_msh(tmp_path / "a.msh")
    assert message in str(e.value)
    assert "\n" not in str(e.value)


def test_volumes_without_a_name_are_refused(tmp_path):
    path = write(tmp_path / "a.msh", {"block": CUBE})
    path.write_text(path.read_text().replace('3 1 "block"', '3 77 "block"'))
    with pytest.raises(InputError, match="8 cells without a name; expected a name for "
                       r'each: Physical Volume\("NAME"\)'):  # fmt: skip
        read_msh(path)
