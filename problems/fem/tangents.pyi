import numpy as np
from numpy.typing import NDArray

Ints = NDArray[np.int32]
Floats = NDArray[np.float64]

def cell_tangents(gradients: Floats, volumes: Floats, A: Floats) -> Floats: ...
def add_tangents(tangents: Floats, cells: Ints, ptr: Ints, slot: Ints) -> Floats: ...
