"""Two stacked three-dimensional blocks as a gmsh file and its description."""

import numpy as np

from mortarbench.harness.mechanics import boundary_facets
from mortarbench.problems.fem.mesh import box
from tests.support.gmsh_files import solids22
from tests.support.hexahedra import divided

PRESSURE, E, NU = 1e6, 1e9, 0.3

TOML = """\
mesh = "blocks.msh"
contact = "mortar"
steps = 1
[[bodies]]
name = "lower"
E = 1e9
nu = 0.3
[[bodies]]
name = "upper"
E = 1e9
nu = 0.3
[[supports]]
boundary = "base"
fix = ["z"]
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
master = "table"
"""
#: for each boundary of both cubes, the index of the coordinate that is zero on it
_PLANES = {"left": 0, "front": 1}


def solid_blocks(folder, corners=None, toml=TOML, divisions=((3, 3, 2), (2, 2, 2))):
    """Write two unit cubes, one above the other; return the path of the description.

    corners : corners of the cells into which each hexahedron is divided, see
        `tests.support.hexahedra`
    """
    points, bodies, faces, start = [], {}, {"left": [], "front": []}, 0
    for z, name, cells in zip((0.0, 1.0), ("lower", "upper"), divisions, strict=True):
        mesh = box((0.0, 0.0, z), (1.0, 1.0, 1.0), cells)
        if corners is not None:
            mesh = divided(mesh, corners)
        facets = boundary_facets(mesh.cells, 3)
        at = mesh.points[facets]
        ends = ("base", "table") if name == "lower" else ("foot", "top")
        for side, place in zip(ends, (z, z + 1), strict=True):
            faces[side] = facets[(at[..., 2] == place).all(axis=1)] + start
        for side, axis in _PLANES.items():
            faces[side] += (facets[(at[..., axis] == 0).all(axis=1)] + start).tolist()
        points.append(mesh.points)
        bodies[name] = mesh.cells + start
        start += len(mesh.points)
    (folder / "blocks.msh").write_text(solids22(np.vstack(points), bodies, faces))
    path = folder / "blocks.toml"
    path.write_text(toml)
    return path
