"""Conversion of discs and cones to and from named arrays in files.

The first set of discs is stored as `disc_index` and `disc_radius`, the first set of
cones as `cone_index` and `cone_slope`. The names of further sets of the same class,
such as discs of another dimension, contain a number: `disc2_index`, `disc2_radius`,
`disc3_index`, … Discs are read before cones. Indices start at 0. `further_sets` states
which shapes are accepted.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mortarbench.harness.errors import InputError
from mortarbench.harness.sets.cones import Cones
from mortarbench.harness.sets.convex import ConvexSet
from mortarbench.harness.sets.discs import Discs

KINDS: tuple[type[Discs] | type[Cones], ...] = (Discs, Cones)
#: Pattern of the names of all arrays of discs and cones.
SET_ARRAY = re.compile(r"(disc|cone)[0-9]*_(index|radius|slope)")


def set_arrays(sets: Sequence[ConvexSet]) -> dict[str, NDArray[Any]]:
    """Return the arrays of discs and cones, keyed by their names in files.

    Raises
    ------
    InputError
        If a set consists of neither discs nor cones.

    """
    arrays: dict[str, NDArray[Any]] = {}
    counts = Counter[type]()
    for one in sets:
        if not isinstance(one, KINDS):
            raise InputError(
                f"sets of the class {type(one).__name__} cannot be stored in files; "
                "expected bounds, Discs and Cones"
            )
        counts[type(one)] += 1
        here = _prefix(type(one), counts[type(one)])
        for name, array in one.arrays().items():
            arrays[here + name.removeprefix(one.prefix)] = array
    return arrays


def further_sets(arrays: Mapping[str, Any]) -> tuple[ConvexSet, ...]:
    """Return the discs and cones whose arrays are in `arrays`.

    Vectors may be stored as rows or columns, as in .mat files. An index may be
    flattened in row-major order, as in Parquet files.

    Raises
    ------
    InputError
        If only one of the two arrays of a set is present, an array belongs to no set,
        or the arrays of a set are invalid.

    """
    sets: list[ConvexSet] = []
    names = {name for name in arrays if SET_ARRAY.fullmatch(name)}
    for kind in KINDS:
        count = 1
        while parts := _parts(kind, _prefix(kind, count), arrays, names):
            sets.append(kind(**parts))
            count += 1
    if names:  # ignoring this array would change the problem
        raise InputError(
            f"{min(names)} belongs to no set; expected disc_index and disc_radius, "
            "cone_index and cone_slope, then disc2_index, …"
        )
    return tuple(sets)


def _prefix(kind: type[Discs] | type[Cones], count: int) -> str:
    return kind.prefix + (str(count) if count > 1 else "")


def _parts(
    kind: Any, prefix: str, arrays: Mapping[str, Any], names: set[str]
) -> dict[str, Any]:
    """Return the constructor arguments of a set; empty if `arrays` lacks the set.

    names : names of the arrays that are not yet assigned to a set; the names of this
        set are removed in place
    """
    both = {f"{prefix}_{field.name}": field.name for field in fields(kind)}
    here = names.intersection(both)
    if not here:
        return {}
    if absent := both.keys() - here:
        raise InputError(f"{absent.pop()} is missing, but {here.pop()} is present")
    names -= here
    index, sizes = (np.asarray(arrays[name]) for name in both)
    sizes = sizes.ravel() if sizes.ndim == 2 and 1 in sizes.shape else sizes
    if index.ndim == 1 and sizes.size and index.size % sizes.size == 0:
        index = index.reshape(sizes.size, -1)
    return dict(zip(both.values(), (index, sizes), strict=True))
