import numpy as np
from numpy.typing import NDArray

Ints = NDArray[np.int32]
Floats = NDArray[np.float64]
Marks = NDArray[np.bool_]

def dissect_components(
    ptr: Ints, idx: Ints, points: Floats, key: Ints, leaf: int
) -> tuple[Ints, Ints, Ints, Marks]: ...
def borders(
    ptr: Ints, idx: Ints, order: Ints, start: Ints, children: Ints
) -> tuple[Ints, Ints]: ...
