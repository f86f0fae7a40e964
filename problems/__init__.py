"""Families of problems: each emits the same contact problem as several QPs."""

from harness import Family
from problems.beam_ring import BeamRing
from problems.files import FromFile
from problems.gmsh_bodies import GmshBodies
from problems.hertz import HertzCylinder, HertzPlane
from problems.obstacle import Obstacle
from problems.patch import ContactPatch

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
