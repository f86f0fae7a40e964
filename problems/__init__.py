"""Families of problems: each emits the same contact problem as several QPs."""

from harness.plugin import Family
from harness.registry import Registry, entry

PROBLEMS: Registry[Family] = Registry(
    {
        "beam-ring": entry("problems.families.beam_ring", "BeamRing"),
        "contact-patch": entry("problems.families.patch", "ContactPatch"),
        "hertz-plane": entry("problems.families.hertz", "HertzPlane"),
        "hertz-cylinder": entry("problems.families.hertz", "HertzCylinder"),
        "half-plane": entry("problems.families.half_plane", "HalfPlane"),
        "greco": entry("problems.families.greco", "Greco"),
        "cantilever": entry("problems.families.cantilever", "Cantilever"),
        "obstacle": entry("problems.families.obstacle", "Obstacle"),
        "string": entry("problems.families.variational", "String"),
        "journal-bearing": entry("problems.families.variational", "JournalBearing"),
        "torsion": entry("problems.families.variational", "Torsion"),
        "bodies": entry("problems.families.gmsh_bodies", "GmshBodies"),
        "file": entry("problems.families.from_file", "FromFile"),
    }
)
