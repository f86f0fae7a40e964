"""Families of problems: each emits the same contact problem as several QPs."""

from __future__ import annotations

from typing import TYPE_CHECKING

from harness.plugin import Family
from harness.registry import Registry, entry

if TYPE_CHECKING:
    from harness.operators import Maker

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
        "membranes": entry("problems.families.membranes", "Membranes"),
        "string": entry("problems.families.variational", "String"),
        "journal-bearing": entry("problems.families.variational", "JournalBearing"),
        "torsion": entry("problems.families.variational", "Torsion"),
        "plate": entry("problems.families.plate", "Plate"),
        "bodies": entry("problems.families.gmsh_bodies", "GmshBodies"),
        "file": entry("problems.families.from_file", "FromFile"),
    }
)

#: what puts an operator P of these families together, see `harness.operators`
OPERATORS: Registry[Maker] = Registry(
    {"tfeti": entry("problems.feti.operators", "made")}
)
