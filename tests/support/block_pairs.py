"""Two blocks, one on the other, as a gmsh file and its description, in 2D or 3D."""

import numpy as np

from mortarbench.harness.mechanics import boundary_facets
from mortarbench.problems.fem.mesh import box, rectangle
from tests.support.gmsh_files import msh22, solids22

PRESSURE = 1e6  #: pressure on the top of the upper block, Pa


def block_pair(
    folder, lower, upper, cells, contacts=(("foot", "table"),), *,
    gap=0.0, height=1.0, moduli=(1e9, 1e9), cut=None, supports="", keys="",
):  # fmt: skip
    """Write two blocks and their description; return the path of the description.

    The lower block is 1 m high and clamped at its base. The upper block slides along
    its top, on which the pressure acts. The ends are the faces across x of both blocks.

    lower, upper : interval of each horizontal axis, m
    cells : numbers of cells of both blocks along all axes
    contacts : (slave, master), sides among "foot" and "table", or their parts
    cut : coordinates x at which sides are cut into "foot left" and "foot right" (or
        "table …"), by name of the side
    supports, keys : further lines of the description
    """
    dim, sides, points, bodies, first = len(lower) + 1, {}, [], {}, 0
    for name, place, low, tall, number in (
        ("lower", lower, -1.0, 1.0, cells[0]), ("upper", upper, gap, height, cells[1]),
    ):  # fmt: skip
        corner = (*(start for start, _ in place), low)
        size = (*(end - start for start, end in place), tall)
        mesh = (rectangle if dim == 2 else box)(corner, size, number)
        facets = boundary_facets(mesh.cells, dim)
        z = mesh.points[facets][..., -1]
        ends = {"lower": ("base", "table"), "upper": ("foot", "top")}[name]
        for side, at in zip(ends, (low, low + tall), strict=True):
            sides[side] = facets[np.isclose(z, at).all(axis=1)] + first
        across = np.ptp(mesh.points[facets][..., 0], axis=1) == 0
        sides["ends"] = np.concatenate(
            [sides.get("ends", facets[:0]), facets[across] + first]
        )
        bodies[name] = mesh.cells + first
        points.append(mesh.points)
        first += len(mesh.points)
    points = np.vstack(points)
    for side, x in (cut or {}).items():
        is_left = points[sides[side]][..., 0].mean(axis=1) < x
        sides |= {
            f"{side} left": sides[side][is_left], f"{side} right": sides[side][~is_left]
        }  # fmt: skip
    used = {name for pair in contacts for name in pair} | {"base", "top", "ends"}
    named = {name: facets for name, facets in sides.items() if name in used}
    flat = np.column_stack([points, np.zeros(len(points))])
    text = (
        msh22(flat, bodies, named, {}) if dim == 2 else solids22(points, bodies, named)
    )
    (folder / "pair.msh").write_text(text)
    axes = ["x", "y", "z"][:dim]
    entries = "".join(
        f'[[contacts]]\nslave = "{slave}"\nmaster = "{master}"\n{keys}'
        for slave, master in contacts
    )
    path = folder / "pair.toml"
    path.write_text(f"""\
mesh = "pair.msh"
steps = 1
bodies = [
    {{ name = "lower", E = {moduli[0]!r}, nu = 0.3 }},
    {{ name = "upper", E = {moduli[1]!r}, nu = 0.3 }},
]
loads = [{{ boundary = "top", traction = {[0.0] * (dim - 1) + [-PRESSURE]} }}]
supports = [
    {{ boundary = "base", fix = {axes} }},
    {{ boundary = "top", fix = {axes[:-1]} }},
    {supports}
]
{entries}""")
    return path
