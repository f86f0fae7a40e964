"""A disc pressed between two bodies, as a description and a mesh from gmsh."""

from tests.support import ROOT

DISC = """\
mesh = "press.msh"
length_unit = "mm"
contact = "mortar"
steps = 1
[[bodies]]
name = "disc"
E = 210e9
nu = 0.3
[[bodies]]
name = "lower"
E = 210e9
nu = 0.3
[[bodies]]
name = "upper"
E = 210e9
nu = 0.3
[[supports]]
boundary = "base"
fix = ["x", "y"]
[[supports]]
boundary = "guides"
fix = ["x"]
[[supports]]
point = "axis"
fix = ["x"]
[[loads]]
boundary = "press"
force = [0, -2e6]
[[contacts]]
slave = "disc below"
master = "lower top"
[[contacts]]
slave = "disc above"
master = "upper bottom"
"""


def described(folder):
    """Write mesh and description into a folder; return the path of the description."""
    path = folder / "press.toml"
    path.write_text(DISC)
    mesh = (ROOT / "tests" / "data" / "press.msh").read_bytes()
    (folder / "press.msh").write_bytes(mesh)
    return path
