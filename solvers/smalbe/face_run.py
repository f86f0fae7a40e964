"""MPRGP's conjugate gradient steps in one face, compiled, for a dense F.

`solvers.smalbe.mprgp` says what a step does and is the truth; this does the same for as
long as one c follows the other, without returning to Python: a step costs one product
and a few microseconds. Tests compare the two.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numba import njit
from numpy.typing import NDArray

from harness import Vector
from solvers.smalbe import kernels
from solvers.smalbe.model import Model
from solvers.smalbe.mprgp import Face, FaceRun, Point, Rules
from solvers.smalbe.outer_loop import Until
from solvers.smalbe.projected import Projected

Array = NDArray[np.float64]
SUMS = {"reassoc", "contract", "nsz"}  #: sums may be vectorised; inf and NaN are kept


def face_run(
    F: Array,
    problem: Projected,
    rules: Rules,
    preconditioner: Callable[[float], Model] | None,
) -> Callable[[float, Until], FaceRun]:
    """Make, for each ρ, what `mprgp` takes as `run`.

    Parameters
    ----------
    F : (n, n) symmetric, C-contiguous
    preconditioner : the model of H for ρ, whose inverse in the face preconditions

    """
    C, inverse_norm = problem.rows.C, 1 / problem.spectrum.norm

    def for_penalty(rho: float, until: Until) -> FaceRun:
        model = preconditioner(rho) if preconditioner else Model.of_norm(1.0, len(F))
        mask, U, core = np.zeros(0, dtype=bool), model.U, model.U

        def run(
            at: Point, p: Vector, face: Face, alpha: float, most: int
        ) -> tuple[Point, Vector, Vector | None, int]:
            nonlocal mask, core, U
            if not np.array_equal(mask, face.free):
                mask, (U, core) = face.free, model.core_in(face.free)
            x, g, p, Hp, steps, leaves = _steps(
                F, C, inverse_norm, rho, (U, core, model.tau), (at.x, at.g, p),
                problem.bounds, (rules.Gamma**2, alpha, rules.reduced), until, most,
            )  # fmt: skip
            problem.counts["P_products"] += steps + leaves
            return Point(x, g), p, Hp if leaves else None, steps

        return run

    return for_penalty


@njit(cache=True, fastmath=SUMS)
def _steps(
    F: Array,
    C: Array,
    inverse_norm: float,
    rho: float,
    preconditioner: tuple[Array, Array, float],
    state: tuple[Vector, Vector, Vector],
    bounds: tuple[Vector, Vector],
    proportion: tuple[float, float, bool],
    until: Until,
    most: int,
) -> tuple[Vector, Vector, Vector, Vector, int, bool]:
    """Return x, g, p, Hp, the number of steps, and whether the next leaves the box."""
    (U, core, tau), (x, g, p), (lower, upper) = preconditioner, state, bounds
    (Gamma_square, alpha, reduced), (small, coarse, M) = proportion, until
    steps = 0
    while True:
        Hp = _operator(F, C, inverse_norm, rho, p)
        cg, feasible = kernels.lengths(x, g, p, Hp, lower, upper)
        if cg > feasible or np.isinf(cg):
            return x, g, p, Hp, steps, True
        x, g = kernels.moved(x, g, cg, p, Hp, lower, upper)
        _, phi, _, phi_square, beta_square = kernels.split(x, g, lower, upper)
        steps += 1
        z = _preconditioned(phi, U, core, tau)
        p = kernels.conjugate(z, p, Hp)
        size = np.sqrt(phi_square + beta_square)
        if steps >= most or size <= small:
            return x, g, p, Hp, steps, False
        if size < coarse and len(C) and size < M * np.sqrt(_square(_rows(C, x))):
            return x, g, p, Hp, steps, False
        if beta_square > 0:
            if reduced:
                cut = kernels.reduced(x, phi, alpha, lower, upper)
                phi_square = _dot(cut, phi)
            if beta_square > Gamma_square * phi_square:
                return x, g, p, Hp, steps, False


@njit(cache=True, fastmath=SUMS)
def _operator(F: Array, C: Array, inverse_norm: float, rho: float, v: Vector) -> Vector:
    """Return Hv = 𝒫F𝒫v/‖𝒫F𝒫‖ + ρQv, as `Projected.H` does."""
    Cv = _rows(C, v)
    y = _symmetric(F, v - _combination(C, Cv)) * inverse_norm
    return y + _combination(C, rho * Cv - _rows(C, y))


@njit(cache=True, fastmath=SUMS)
def _symmetric(F: Array, v: Vector) -> Vector:
    """Return Fv, reading the lower triangle once, four rows at a time."""
    n = v.size
    y = np.zeros(n)
    for j in range(0, n - n % 4, 4):
        a, b, c, d = F[j], F[j + 1], F[j + 2], F[j + 3]
        va, vb, vc, vd = v[j], v[j + 1], v[j + 2], v[j + 3]
        sa = sb = sc = sd = 0.0
        for i in range(j):
            y[i] += va * a[i] + vb * b[i] + vc * c[i] + vd * d[i]
            sa += a[i] * v[i]
            sb += b[i] * v[i]
            sc += c[i] * v[i]
            sd += d[i] * v[i]
        y[j] += sa
        y[j + 1] += sb
        y[j + 2] += sc
        y[j + 3] += sd
        for i in range(j, j + 4):
            for k in range(j, j + 4):
                y[i] += F[i, k] * v[k]
    for j in range(n - n % 4, n):
        total = F[j, j] * v[j]
        for i in range(j):
            y[i] += F[j, i] * v[j]
            total += F[j, i] * v[i]
        y[j] += total
    return y


@njit(cache=True, fastmath=SUMS)
def _preconditioned(v: Vector, U: Array, core: Array, tau: float) -> Vector:
    """Return (v − Uᵀ core U v)/τ, as `Model.inverse_in` does."""
    if not len(U):
        return v / tau
    Uv = _rows(U, v)
    return (v - _combination(U, _rows(core, Uv))) / tau


@njit(cache=True, fastmath=SUMS)
def _rows(A: Array, v: Vector) -> Vector:
    """Return Av for few rows."""
    out = np.zeros(len(A))
    for i in range(len(A)):
        out[i] = _dot(A[i], v)
    return out


@njit(cache=True, fastmath=SUMS)
def _combination(A: Array, weights: Vector) -> Vector:
    """Return Aᵀw for few rows."""
    out = np.zeros(A.shape[1])
    for i in range(len(A)):
        row, weight = A[i], weights[i]
        for j in range(out.size):
            out[j] += weight * row[j]
    return out


@njit(cache=True, fastmath=SUMS)
def _dot(a: Vector, b: Vector) -> float:
    total = 0.0
    for i in range(a.size):
        total += a[i] * b[i]
    return total


@njit(cache=True, fastmath=SUMS)
def _square(a: Vector) -> float:
    return _dot(a, a)
