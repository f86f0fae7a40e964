"""Heights of a self-affine surface, reproducible from a seed.

The surface is a sum of waves in a square of side L, with all wave vectors 2πk/L for
integers k = (i, j) whose length is between two limits,

    z(x) = Σ A_k cos(2πk·x/L + φ_k),    A_k ∝ |k|^−(1 + H),    LONGEST ≤ |k| ≤ SHORTEST

so that the power spectral density falls like |k|^−2(1 + H) with the Hurst exponent H
(Persson et al. 2005, J. Phys.: Condens. Matter 17, R1). The amplitudes follow this law
exactly, and the phases φ_k are random. The surface does not depend on the grid on which
it is evaluated.

For a given seed, heights are identical on every machine and with every version of
NumPy, with very rare exceptions. Phases are drawn by `random.Random.random`, for which
Python guarantees the same sequence for the same seed. Sums of cosines may differ in the
last bits. Heights are therefore rounded to multiples of 2⁻²⁰ times the root mean square
of the surface. About one height in 10⁹ is so close to the midpoint of two multiples
that the rounded heights may still differ.
"""

from __future__ import annotations

from random import Random

import numpy as np
from numpy.typing import NDArray

from mortarbench.harness import Vector

#: numbers of periods along L of the longest and of the shortest wave; on 64 × 64 cells,
#: the shortest wavelength is two cells
LONGEST, SHORTEST = 2, 32
_DIGITS = 2.0**20  #: heights are multiples of rms/_DIGITS


def rough_surface(x: Vector, hurst: float, seed: int) -> NDArray[np.float64]:
    """Return heights (n, n) at the points (xᵢ, xⱼ).

    The root mean square of the heights over the whole square is one.

    x : (n,) coordinates in units of L
    """
    k = np.arange(-SHORTEST, SHORTEST + 1)
    # k and −k denote the same wave: keep the one with i > 0, or with j > 0 if i = 0
    i, j = (index.ravel() for index in np.meshgrid(k, k, indexing="ij"))
    squared = i**2 + j**2
    used = (squared >= LONGEST**2) & (squared <= SHORTEST**2)
    used &= (i > 0) | ((i == 0) & (j > 0))
    random = Random(seed)
    phase = 2 * np.pi * np.array([random.random() for _ in range(int(used.sum()))])
    amplitude = squared[used] ** (-(1 + hurst) / 2)
    amplitude *= np.sqrt(2 / (amplitude @ amplitude))
    waves = np.zeros(used.size, dtype=complex)
    waves[used] = amplitude * np.exp(1j * phase)
    factors = np.exp(2j * np.pi * np.outer(x, k))
    heights = (factors @ waves.reshape(k.size, k.size) @ factors.T).real
    return np.asarray(np.round(heights * _DIGITS) / _DIGITS)
