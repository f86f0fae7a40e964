from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from mortarbench.harness import QP, Matrix, Solution, Status, Vector
from mortarbench.solvers.smalbe import rows as orthonormal_rows
from mortarbench.solvers.smalbe.extension import Operator, StepRule
from mortarbench.solvers.smalbe.options import Options
from mortarbench.solvers.smalbe.projected import Iterate, Projected

Array = NDArray[np.float64]
Indices = NDArray[np.int32]

class Product:
    n: int
    count: int
    def __init__(self, P: Matrix, n: int) -> None: ...
    def __call__(self, v: Vector) -> Vector: ...

class Rows:
    n: int
    source: orthonormal_rows.Rows
    def __init__(self, rows: orthonormal_rows.Rows) -> None: ...
    def fitted(self, free: NDArray[np.bool_], r: Vector) -> Vector: ...
    def met(self, nu: Vector, tol: float, least: float) -> bool: ...

def sparsity(matrix: Matrix) -> tuple[float, float, float, float, float]: ...

class IncompleteFactor:
    keep: float
    shift: float
    factorisations: int
    solves: int
    def __init__(
        self, matrix: Matrix, scale: float = 1.0, keep: bool = True
    ) -> None: ...
    def solve(self, free: NDArray[np.bool_], v: Vector) -> Vector: ...

class ApproximateInverse:
    def __init__(self, F: Product) -> None: ...
    def times(self, free: NDArray[np.bool_], v: Vector) -> tuple[Vector, bool]: ...

class SMALBE:
    def __init__(
        self,
        problem: Projected,
        options: Options,
        preconditioned: bool,
        M: Operator | ApproximateInverse | None = None,
        step_rule: StepRule | None = None,
    ) -> None: ...
    def begin(self, x: Vector, mu: Vector, rho: float) -> tuple[Vector, Vector]: ...
    def precondition(
        self, free: NDArray[np.bool_], v: Vector, rho: float
    ) -> Vector: ...
    def face_and_gradients(
        self, x: Vector, g: Vector
    ) -> tuple[Array, Array, Array]: ...
    def solve(
        self,
        options: Options,
        tol: float,
        at: Iterate,
        infeasible: Callable[[Vector], bool],
        watch: Callable[[int, Vector], Callable[[str, Vector, Vector], None]] | None,
        aim: float = 0.0,
    ) -> tuple[
        Vector,
        Vector,
        Vector,
        float,
        float,
        list[tuple[str, float, float, float, float]],
        Status,
    ]: ...
    def estimate(self, at: Iterate, force: float, energy: float) -> float: ...
    def point(
        self, nu: Vector, mu: Vector, rho: float, lb: Vector, ub: Vector
    ) -> tuple[Vector, Vector, Vector, Vector]: ...

def relative_residuals(
    qp: QP,
    s: Solution,
    tol: float,
    Px: Vector,
    diagonal: Vector,
    G: Matrix,
) -> tuple[float, float, float, float]: ...
def orthonormal(
    G: Array, e: Vector
) -> tuple[
    tuple[Array, Array, Array, float, float, Vector, bool],
    tuple[Array, Indices, Vector],
]: ...
def lanczos(
    F: Product, C: Rows, start: Vector, steps: int
) -> tuple[Vector, Vector, Array, float]: ...
def homogenised(
    F: Product,
    C: Rows,
    q: Vector,
    lb: Vector,
    ub: Vector,
    diagonal: Vector,
    norm: float,
) -> tuple[Vector, tuple[Vector, Vector], float]: ...
