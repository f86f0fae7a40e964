"""Surface displacements of half-spaces under forces on square cells, by FFT.

A force on a cell of side h is distributed as a uniform traction. The relative
displacement of the surfaces of two half-spaces of the same material, at the centre of a
cell at the offset (x, y), is twice the displacement of one surface. For a unit normal
force and unit tangential forces, the relative displacement is (Boussinesq and Cerruti;
Johnson 1985, "Contact mechanics", Sections 3.2 and 3.6)

    F_n = I₀/(πE*h²)
    F_t = 1/(πGh²) · [[(1 − ν)I₀ + νI_xx, νI_xy], [νI_xy, (1 − ν)I₀ + νI_yy]]

with E* = E/2(1 − ν²), G = E/2(1 + ν) and integrals over the cell,

    I₀ = ∫1/r = I_xx + I_yy,   I_xx = ∫x²/r³,   I_yy = ∫y²/r³,   I_xy = ∫xy/r³

Since both half-spaces are of the same material, normal forces cause no relative
tangential displacement, and tangential forces cause no relative normal displacement.
The antiderivatives are Y ln(X + r) for I_xx, X ln(Y + r) for I_yy and −r for I_xy (Love
1929).

An entry depends only on the relative position of two cells. Therefore F is a principal
submatrix of the circulant matrix C of a periodic grid of about twice the size:
Fx = RᵀCRx, where R extends x by zeros. The FFT diagonalises C. Hence
λ_min(F) ≥ λ_min(C); see docs/certificates.md.
"""

from __future__ import annotations

from copy import copy
from typing import Any, NamedTuple

import numpy as np
import scipy.fft
from numpy.typing import NDArray

from mortarbench.harness.operators import Arrays, Product, SerialisableOperator

NAME = "half-space"  #: name in `problems.OPERATORS`, stored in files
#: bound on the error of computed eigenvalues of C, relative to the largest eigenvalue.
#: Errors of an FFT of M × M values are below 2⁻⁵³·log₂(M²)·‖C‖, which is 3e-15·‖C‖ for
#: M = 8192
EIGENVALUE_ROUNDING = 1e-12
#: size of a strip of transforms, bytes; small enough for the cache
_STRIP_BYTES = 2**19

Array = NDArray[np.float64]


class CellIntegrals(NamedTuple):
    """Integrals (m0, m1) over a unit cell, indexed by offsets along x and along y.

    I_xy is odd in x and in y; I_xx and I_yy are even.
    """

    xx: Array  #: I_xx
    yy: Array  #: I_yy
    xy: Array  #: I_xy


def cell_integrals(m0: int, m1: int) -> CellIntegrals:
    """Integrate x²/r³, y²/r³ and xy/r³ over unit cells at distances 0 … m0−1, 0 … m1−1.

    The integrals are differences of the antiderivatives at the four corners. At a large
    distance m, about log₁₀(m) digits are lost by cancellation.
    """
    X: Array = (np.arange(m0 + 1, dtype=float) - 0.5)[:, None]
    Y: Array = np.arange(m1 + 1, dtype=float) - 0.5
    r = np.hypot(X, Y)

    def log_sum(a: Array, b: Array) -> Array:
        # for a < 0, a + r = b²/(r − a) avoids cancellation
        safe = 2 * np.log(np.abs(b)) - np.log(r + np.abs(a))
        return np.asarray(np.where(a < 0, safe, np.log(r + np.abs(a))))

    def over_corners(f: Array) -> Array:
        return np.asarray(np.diff(np.diff(f, axis=0), axis=1))

    return CellIntegrals(
        xx=over_corners(Y * log_sum(X, Y)),
        yy=over_corners(X * log_sum(Y, X)),
        xy=over_corners(-r),
    )


class Influence:
    """The product x ↦ Fx for cells of a grid, with πE* = 1 (normal) or πG = 1 (shear).

    cells : (k, 2) indices of each cell along x and along y
    h : side of a cell
    nu : Poisson's ratio for shear, with two consecutive components per cell; None for
        normal forces, with one component per cell
    """

    def __init__(self, cells: NDArray[Any], h: float, nu: float | None) -> None:
        i, j = (cells - cells.min(axis=0)).astype(np.int64).T
        m0, m1 = int(i.max()) + 1, int(j.max()) + 1
        M0 = scipy.fft.next_fast_len(2 * m0 - 1, real=True)
        M1 = scipy.fft.next_fast_len(2 * m1 - 1)
        # make the row length odd: if rows are a power of two apart, entries of a column
        # compete for cache lines, and transforms along columns take 1.5 times as long
        m1 |= 1
        self._period = M0, M1
        kernels = _kernels(cell_integrals(M0 // 2 + 1, M1 // 2 + 1), self._period, nu)
        self._diagonal = float(kernels[0][0, 0]) / h
        #: eigenvalues of C: (1, M0/2 + 1, M1) for F_n, or (3, M0/2 + 1, M1) for the xx,
        #: yy and xy parts of F_t
        self._symbol = np.array(
            [scipy.fft.rfft2(K, axes=(1, 0)).real / h for K in kernels]
        )
        self._shape = 1 if nu is None else 2, m0, m1
        self._places = i * m1 + j  # indices in the grid of m0 × m1 cells

    def __call__(self, x: Array) -> Array:
        """Multiply F by a vector (n,) or by a matrix (n, k)."""
        if x.ndim == 2:
            return np.array([self(column) for column in x.T]).reshape(x.shape[::-1]).T
        (M0, M1), (components, m0, m1) = self._period, self._shape
        force, grid = x.reshape(-1, components), np.zeros(self._shape)
        for c in range(components):
            grid[c].reshape(-1)[self._places] = force[:, c]
        U = scipy.fft.rfft(grid, n=M0, axis=1)
        # transform along y in strips that stay in the cache. The padded rows are never
        # stored as a whole: half of the input is zero, and half of the output is unused
        height = min(max(_STRIP_BYTES // (16 * components * M1), 1), U.shape[1])
        strip = np.empty((components, height, M1), dtype=complex)
        for start in range(0, U.shape[1], height):
            part = U[:, start : start + height]
            V = strip[:, : part.shape[1]]
            V[:, :, :m1], V[:, :, m1:] = part, 0
            V = scipy.fft.fft(V, axis=2, overwrite_x=True)
            self._multiply(V, self._symbol[:, start : start + height])
            part[:] = scipy.fft.ifft(V, axis=2, overwrite_x=True)[:, :, :m1]
        grid = scipy.fft.irfft(U, n=M0, axis=1)[:, :m0]
        product = np.empty(force.shape)
        for c in range(components):
            product[:, c] = grid[c].reshape(-1)[self._places]
        return product.reshape(-1)

    @staticmethod
    def _multiply(V: NDArray[np.complex128], symbol: Array) -> None:
        """Multiply the transforms V by the eigenvalues `symbol`, in place."""
        if len(V) == 1:
            V *= symbol
            return
        (xx, yy, xy), (x, y) = symbol, V
        coupled = xy * x
        x *= xx
        x += xy * y
        y *= yy
        y += coupled

    def diagonal(self) -> Array:
        """Return Fᵢᵢ (n,)."""
        return np.full(self._shape[0] * self._places.size, self._diagonal)

    @property
    def least_eigenvalue(self) -> float:
        """Lower bound on the eigenvalues of F: λ_min(C) minus a bound on its error."""
        least = greatest = self._symbol[0]
        if len(self._symbol) > 1:
            xx, yy, xy = self._symbol
            mean, radius = (xx + yy) / 2, np.hypot((xx - yy) / 2, xy)
            least, greatest = mean - radius, mean + radius
        return float(least.min() - EIGENVALUE_ROUNDING * np.abs(greatest).max())


class NormalInfluence(Influence):
    """The product for normal forces, with a preconditioner M.

    The product for shear has no preconditioner. In problems over discs, solvers take so
    few CG steps that preconditioning would save no products.
    """

    def __init__(self, cells: NDArray[Any], h: float) -> None:
        super().__init__(cells, h, None)

    def preconditioner(self, kind: str, scaling: str) -> Product:
        """Return x ↦ Mx = RᵀC⁻¹Rx, with the stiffness C⁻¹ of the periodic surface.

        kind : "dirichlet", because M maps displacements of a surface to forces on it
        scaling : not used, because each force acts on one cell only

        Raises
        ------
        ValueError
            If `kind` is not "dirichlet".

        """
        if kind != "dirichlet":
            raise ValueError(
                f"half-spaces have no preconditioner {kind!r}; known: 'dirichlet'"
            )
        inverse = copy(self)
        inverse._symbol = 1 / self._symbol
        return inverse


def _kernels(
    integrals: CellIntegrals, period: tuple[int, int], nu: float | None
) -> list[Array]:
    """Return periodic kernels (M0, M1) of F_n, or of the xx, yy and xy parts of F_t.

    integrals : cell integrals for distances up to half the period
    """
    I_xx, I_yy, I_xy = integrals
    I_0 = I_xx + I_yy
    if nu is None:
        return [_extended(I_0, period)]
    # an odd function jumps at half a period; its value at the jump is arbitrary,
    # because no two cells are that far apart
    for axis, M in enumerate(period):
        if M % 2 == 0:
            np.moveaxis(I_xy, axis, 0)[M // 2] = 0
    even = [(1 - nu) * I_0 + nu * I for I in (I_xx, I_yy)]
    return [
        *(_extended(I, period) for I in even),
        nu * _extended(I_xy, period, odd=True),
    ]


def _extended(quadrant: Array, period: tuple[int, int], *, odd: bool = False) -> Array:
    """Extend a function from a quadrant to the period, even or odd in x and in y."""
    lag_0, lag_1 = (np.arange(M) - M * (np.arange(M) > M // 2) for M in period)
    function: Array = quadrant[np.abs(lag_0)[:, None], np.abs(lag_1)]
    if odd:
        function[lag_0 < 0] *= -1
        function[:, lag_1 < 0] *= -1
    return function


def influence_operator(
    cells: NDArray[np.int64], h: float, nu: float | None = None
) -> SerialisableOperator:
    """Return F for cells of a grid as an operator that can be stored in files.

    Parameters
    ----------
    cells, h, nu : see `Influence`

    """
    arrays = {
        "cells": cells.astype(np.int32),
        "h": np.array([h]),
        "nu": np.array([] if nu is None else [nu]),
    }
    n = cells.shape[0] * (1 if nu is None else 2)
    return SerialisableOperator(n, NAME, arrays, {NAME: influence_from_arrays})


def influence_from_arrays(arrays: Arrays) -> Influence:
    """Restore F from the arrays of `influence_operator`."""
    (h,), nu = arrays["h"].tolist(), arrays["nu"].tolist()
    if nu:
        return Influence(arrays["cells"], h, nu[0])
    return NormalInfluence(arrays["cells"], h)
