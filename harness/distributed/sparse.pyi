from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csc_array, csr_array

from mortarbench.harness.qp import Vector

Dense = NDArray[np.float64]
Indices = NDArray[np.int32] | NDArray[np.int64]

class LinearMap:
    shape: tuple[int, int]

    def __call__(self, x: Dense) -> Dense: ...
    def __matmul__(self, x: Dense) -> Dense: ...

class CompressedRows(LinearMap):
    def __init__(self, M: csr_array) -> None: ...
    def transposed_times(self, x: Vector) -> Vector: ...
    def outer_products(
        self, weights: Vector, place: NDArray[np.int32], size: int
    ) -> Dense: ...

class Block(LinearMap):
    def __init__(self, M: Any, n: int, members: int) -> None: ...

class Composition(LinearMap):
    def __init__(self, *maps: LinearMap) -> None: ...

class Identity(LinearMap):
    def __init__(self, n: int) -> None: ...

class DirectSum(LinearMap):
    def __init__(self, *maps: LinearMap) -> None: ...

class BorderedFactor(LinearMap):
    least_pivot: float

    def __init__(
        self, order: Indices, columns: csc_array, L_bb: Dense, scale: float = 1.0
    ) -> None: ...
    def forward(self, t: Vector) -> Vector: ...
    def backward(self, a: Vector) -> Vector: ...
    def shifted_without(
        self, shift: float, columns: CompressedRows, removed: Vector
    ) -> BorderedFactor: ...
