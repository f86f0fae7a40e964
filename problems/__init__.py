"""Families of problems: each emits the same contact problem as several QPs."""

from harness import Family
from problems.beam_ring import BeamRing

FAMILIES: tuple[Family, ...] = (BeamRing(),)

PROBLEMS: dict[str, Family] = {family.name: family for family in FAMILIES}
