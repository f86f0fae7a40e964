"""Three-dimensional meshes from gmsh files: cells, orientation, names,
rejected files.
"""

import meshio
import numpy as np
import pytest

from mortarbench.harness import InputError
from mortarbench.problems.fem.elasticity import Material, elasticity_matrix, stiffness
from mortarbench.problems.fem.mesh import Mesh, boundary_facets, box
from mortarbench.problems.fem.mesh_files.reading import read_msh
from tests.support.gmsh_files import solids22
from tests.support.hexahedra import TETRAHEDRA, WEDGES, divided
from tests.support.refusals import refused

D = elasticity_matrix(Material(E=1.0, nu=0.3), None)


def write(path, bodies, *, binary=False):
    """Write named bodies with their sides as gmsh does, in format 2.2."""
    points, cells, faces, start = [], {}, {}, 0
    for name, mesh in bodies.items():
        points.append(mesh.points)
        cells[name] = mesh.cells + start
        for side in ("bottom", "top"):
            faces[f"{name}_{side}"] = mesh.boundaries[side] + start
        start += len(mesh.points)
    path.write_text(solids22(np.concatenate(points), cells, faces))
    if binary:
        meshio.gmsh.write(path, meshio.gmsh.read(path), "2.2", binary=True)
    return path


def cut(corners=None, shift=0.0):
    """Return a cube of one type of cell, with triangular or quadrilateral faces."""
    mesh = box((shift, 0.0, 0.0), (1.0, 1.0, 1.0), (2, 2, 2))
    if corners is not None:
        mesh = divided(mesh, corners)
    facets = boundary_facets(mesh.cells, 3)
    z = mesh.points[facets][..., 2]
    ends = {"bottom": 0.0, "top": 1.0}
    sides = {name: facets[(z == at).all(axis=1)] for name, at in ends.items()}
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
        (lambda cells: cells[:, [0, 2, 1, 3, 4, 5, 6, 7]], "the hexahedron around "
         "(0.25, 0.25, 0.25) has no volume or folds over; expected distinct corners"),
        (lambda cells: cells[:4], "surface 'block_top' has a face that bounds "
         "no body in the file (shells and beams are not bodies); expected every body "
         "to have a name: "
         'Physical Volume("NAME") in the .geo file'),
    ],
)  # fmt: skip
def test_unreadable_files_are_refused_in_one_line(tmp_path, change, message):
    cube = cut()
    body = Mesh(cube.points, change(cube.cells), cube.boundaries)
    with refused(message):
        read_msh(write(tmp_path / "a.msh", {"block": body}))


def test_volumes_without_a_name_are_refused(tmp_path):
    path = write(tmp_path / "a.msh", {"block": cut()})
    path.write_text(path.read_text().replace('3 1 "block"', '3 77 "block"'))
    with pytest.raises(InputError, match="8 cells without a name; expected a name for "
                       r'each: Physical Volume\("NAME"\)'):  # fmt: skip
        read_msh(path)
