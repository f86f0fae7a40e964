import numpy as np
from numpy.typing import NDArray

from mortarbench.problems.fem.elements import Element

Ints = NDArray[np.int32]
Floats = NDArray[np.float64]

def node_pattern(cells: Ints, nodes: int) -> tuple[Ints, Ints]: ...
def dof_pattern(ptr: Ints, idx: Ints, dim: int) -> tuple[Ints, Ints]: ...
def slots(cells: Ints, ptr: Ints, idx: Ints) -> Ints: ...
def add_stiffness(
    elem: Element,
    points: Floats,
    cells: Ints,
    D: Floats,
    material: Ints,
    ptr: Ints,
    slot: Ints,
) -> Floats: ...
def congruence(
    ptr: Ints, idx: Ints, data: Floats, number: Ints, C: Floats
) -> tuple[Floats, bool]: ...
