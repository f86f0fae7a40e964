"""Registries of problem families and of functions that restore stored operators."""

from __future__ import annotations

from typing import TYPE_CHECKING

from mortarbench.harness.plugin import Family
from mortarbench.harness.registry import Registry, entry

if TYPE_CHECKING:
    from mortarbench.harness.operators import Maker

PROBLEMS: Registry[Family] = Registry(
    {
        "beam-ring": entry("mortarbench.problems.families.beam_ring", "BeamRing"),
        "contact-patch": entry("mortarbench.problems.families.patch", "ContactPatch"),
        "hertz-plane": entry("mortarbench.problems.families.hertz", "HertzPlane"),
        "hertz-cylinder": entry("mortarbench.problems.families.hertz", "HertzCylinder"),
        "half-plane": entry("mortarbench.problems.families.half_plane", "HalfPlane"),
        "hertz-sphere": entry(
            "mortarbench.problems.families.hertz_sphere", "HertzSphere"
        ),
        "cube-wall": entry("mortarbench.problems.families.cube_wall", "CubeWall"),
        "half-space": entry(
            "mortarbench.problems.families.half_space.cases", "HalfSpace"
        ),
        "greco": entry("mortarbench.problems.families.greco", "Greco"),
        "cantilever": entry("mortarbench.problems.families.cantilever", "Cantilever"),
        "obstacle": entry("mortarbench.problems.families.feti_models", "Obstacle"),
        "membranes": entry("mortarbench.problems.families.feti_models", "Membranes"),
        "string": entry("mortarbench.problems.families.variational", "String"),
        "journal-bearing": entry(
            "mortarbench.problems.families.variational", "JournalBearing"
        ),
        "torsion": entry("mortarbench.problems.families.variational", "Torsion"),
        "plate": entry("mortarbench.problems.families.feti_models", "Plate"),
        "bodies": entry("mortarbench.problems.families.bodies", "MeshedBodies"),
        "file": entry("mortarbench.problems.families.from_file", "FromFile"),
        "fclib": entry("mortarbench.problems.families.fclib", "Fclib"),
    }
)

#: mapping from the name of an operator to the function that restores it as the Hessian
#: P of a stored QP; see `harness.operators`
OPERATORS: Registry[Maker] = Registry(
    {
        "tfeti": entry(
            "mortarbench.problems.feti.operator_arrays", "dual_operator_from_arrays"
        ),
        "half-space": entry(
            "mortarbench.problems.families.half_space.influence",
            "influence_from_arrays",
        ),
    }
)
