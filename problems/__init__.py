"""Families of problems: each emits the same contact problem as several QPs."""

from harness import Family
from problems.families.beam_ring import BeamRing
from problems.families.gmsh_bodies import GmshBodies
from problems.families.hertz import HertzCylinder, HertzPlane
from problems.families.obstacle import Obstacle
from problems.families.patch import ContactPatch
from problems.files.from_file import FromFile

FAMILIES: tuple[Family, ...] = (
    BeamRing(),
    ContactPatch(),
    HertzPlane(),
    HertzCylinder(),
    Obstacle(),
    GmshBodies(),
    FromFile(),
)

PROBLEMS: dict[str, Family] = {family.name: family for family in FAMILIES}
