import numpy as np
from numpy.typing import NDArray

from mortarbench.harness import Vector

class Faces:
    products: int
    solves: int
    joined: int
    left: int
    rho: float
    diagonal: Vector
    def __init__(
        self,
        P: NDArray[np.float64],
        q: Vector,
        C: NDArray[np.float64],
        x_tilde: Vector,
        bounds: tuple[Vector, Vector],
        rho: float,
        delta: float,
    ) -> None: ...
    @property
    def a(self) -> Vector: ...
    def at(self, a: Vector) -> tuple[Vector, Vector, Vector]: ...
    def update(self) -> float: ...
    def penalise(self, rho: float) -> None: ...
    def minimise(self, most: int) -> bool: ...
