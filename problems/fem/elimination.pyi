import numpy as np
from numpy.typing import NDArray

Ints = NDArray[np.int32]
Longs = NDArray[np.int64]
Floats = NDArray[np.float64]

def eliminate(
    indptr: Ints,
    indices: Ints,
    data: Floats,
    order: Longs,
    position: Ints,
    start: Ints,
    first: Ints,
    border: Ints,
    children: Ints,
    offset: Longs,
    rows: Floats,
) -> bool: ...
def peak_storage(first: Ints, children: Ints) -> int: ...
def substitute(
    start: Ints, first: Ints, border: Ints, offset: Longs, rows: Floats, x: Floats
) -> None: ...
def scatter_symmetric(upper: Floats, at: Ints, to: Floats) -> None: ...
