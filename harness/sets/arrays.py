"""Sets other than bounds as named arrays, as files hold them.

The first set of a kind has `disc_index, disc_radius` or `cone_index, cone_slope`. A
further one of the same kind, such as discs of another dimension, has a number after the
kind: `disc2_index, disc2_radius`, `disc3_index`, … Discs are read before cones. Indices
start at 0.
"""

from __future__ import annotations

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


def set_arrays(sets: Sequence[ConvexSet]) -> dict[str, NDArray[Any]]:
    """Return the arrays of sets other than bounds by their names in files.

    Raises
    ------
    InputError
        When a set is of another kind than discs and cones.

    """
    arrays: dict[str, NDArray[Any]] = {}
    counts = Counter[type]()
    for one in sets:
        if not isinstance(one, KINDS):
            raise InputError(
                f"no file holds sets of the kind {type(one).__name__}; expected "
                "bounds, Discs and Cones"
            )
        counts[type(one)] += 1
        here = _prefix(type(one), counts[type(one)])
        for name, array in one.arrays().items():
            arrays[here + name.removeprefix(one.prefix)] = array
    return arrays


def further_sets(arrays: Mapping[str, Any]) -> tuple[ConvexSet, ...]:
    """Return the sets other than bounds whose arrays are among `arrays`.

    Vectors may be rows or columns, as in .mat files.

    Raises
    ------
    InputError
        When an array is missing beside another, or they are not such sets.

    """
    sets: list[ConvexSet] = []
    for kind in KINDS:
        count = 1
        while parts := _parts(kind, _prefix(kind, count), arrays):
            sets.append(kind(**parts))
            count += 1
    return tuple(sets)


def _prefix(kind: type[Discs] | type[Cones], count: int) -> str:
    return kind.prefix + (str(count) if count > 1 else "")


def _parts(kind: Any, prefix: str, arrays: Mapping[str, Any]) -> dict[str, Any]:
    """Return the arguments of a set, none if `arrays` has no such set."""
    index, size = (field.name for field in fields(kind))
    lacking = [f"{prefix}_{name}" not in arrays for name in (index, size)]
    if all(lacking):
        return {}
    if any(lacking):
        names = [f"{prefix}_{index}", f"{prefix}_{size}"]
        here, absent = names if lacking[1] else reversed(names)
        raise InputError(f"{absent} is missing beside {here}")
    sizes = np.asarray(arrays[f"{prefix}_{size}"])
    if sizes.ndim == 2 and 1 in sizes.shape:
        sizes = sizes.ravel()
    return {index: arrays[f"{prefix}_{index}"], size: sizes}
