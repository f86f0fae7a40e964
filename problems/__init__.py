"""Registries of problem families and of functions that restore stored operators."""

from __future__ import annotations

from typing import TYPE_CHECKING

from mortarbench.harness.plugin import Family
from mortarbench.harness.registry import Registry, check_family

if TYPE_CHECKING:
    from mortarbench.harness.operators import Maker

#: module of `problems.families` and class of each family
_FAMILIES = {
    "beam-ring": "beam_ring:BeamRing",
    "contact-patch": "patch:ContactPatch",
    "hertz-plane": "hertz:HertzPlane",
    "hertz-cylinder": "hertz:HertzCylinder",
    "half-plane": "half_plane:HalfPlane",
    "hertz-sphere": "hertz_sphere:HertzSphere",
    "cube-wall": "cube_wall:CubeWall",
    "half-space": "half_space.cases:HalfSpace",
    "greco": "greco:Greco",
    "cantilever": "cantilever:Cantilever",
    "obstacle": "feti_models:Obstacle",
    "membranes": "feti_models:Membranes",
    "string": "variational:String",
    "journal-bearing": "variational:JournalBearing",
    "torsion": "variational:Torsion",
    "plate": "feti_models:Plate",
    "bodies": "bodies:MeshedBodies",
    "file": "from_file:FromFile",
    "fclib": "fclib:Fclib",
}
PROBLEMS: Registry[Family] = Registry(
    {name: f"mortarbench.problems.families.{at}" for name, at in _FAMILIES.items()},
    check_family,
    "mortarbench.problems",
)

#: mapping from the name of an operator to the function that restores it as the Hessian
#: P of a stored QP; see `harness.operators`
OPERATORS: Registry[Maker] = Registry(
    {
        "tfeti": "mortarbench.problems.feti.operator_arrays:dual_operator_from_arrays",
        "half-space": (
            "mortarbench.problems.families.half_space.influence:influence_from_arrays"
        ),
    }
)
