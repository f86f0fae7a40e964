from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from mortarbench.harness import Matrix, Vector
from mortarbench.solvers.smalbe.options import Options
from mortarbench.solvers.smalbe.outer_loop import Iterate
from mortarbench.solvers.smalbe.projected import Projected

Array = NDArray[np.float64]
Kept = NDArray[np.int32]

class Product:
    count: int
    def __init__(self, P: Matrix, n: int) -> None: ...
    def __call__(self, v: Vector) -> Vector: ...

class Solver:
    def __init__(
        self,
        problem: Projected,
        F: Product,
        options: Options,
        preconditioned: bool,
    ) -> None: ...
    def begin(self, x: Vector, mu: Vector, rho: float) -> tuple[Vector, Vector]: ...
    def smalbe(
        self,
        options: Options,
        tol: float,
        at: Iterate,
        infeasible: Callable[[Vector], bool],
        watch: Callable[[int, Vector], Callable[[str, Vector, Vector], None]] | None,
    ) -> tuple[
        Vector,
        Vector,
        Vector,
        float,
        float,
        list[tuple[str, float, float, float, float]],
        str,
    ]: ...
    def point(
        self, nu: Vector, mu: Vector, lb: Vector, ub: Vector
    ) -> tuple[Vector, Vector, Vector, Vector] | None: ...

def residual_bound(
    cost: Vector,
    told_diagonal: Vector,
    x: Vector,
    y: Vector,
    z_box: Vector,
    Fx: Vector,
    lower: Vector,
    upper: Vector,
    right: Vector,
    rows: Array,
) -> float: ...
def orthonormal(
    G: Array, e: Vector
) -> tuple[
    tuple[Array, Array, Array, float, float, Vector, bool], tuple[Array, Kept, Vector]
]: ...
def lanczos(
    F: Product, C: Array, start: Vector, steps: int
) -> tuple[Vector, Vector, Array, float]: ...
def homogenised(
    F: Product,
    C: Array,
    x_tilde: Vector,
    q: Vector,
    lb: Vector,
    ub: Vector,
    norm: float,
) -> tuple[Vector, tuple[Vector, Vector]]: ...
def multipliers(m: int, R: Array, kept: Kept, size: Vector, a: Vector) -> Vector: ...
