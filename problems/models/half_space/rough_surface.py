"""Heights of a self-affine surface, reproducible from a seed.

The surface is a sum of waves in a square of side L, with all wave vectors 2πk/L for
integers k = (i, j) whose length is between two limits,

    z(x) = Σ A_k cos(2πk·x/L + φ_k),    A_k ∝ |k|^−(1 + H),    LONGEST ≤ |k| ≤ SHORTEST

so that the power spectral density falls like |k|^−2(1 + H) with the Hurst exponent H
(Persson et al. 2005, J. Phys.: Condens. Matter 17, R1). The amplitudes are exact, the
phases φ_k random; the surface does not depend on the grid at which it is evaluated.

For a given seed, heights are identical on every machine and with every version of
NumPy, with very rare exceptions. Phases are from `random.Random.random`, whose sequence
for a seed Python guarantees. Sums of cosines may differ in their last bits. Heights are
therefore rounded to multiples of 2⁻²⁰ of their root mean square. About one height in
10⁹ is so close to the midpoint of two multiples that the rounding may still differ.
"""

from __future__ import annotations

from random import Random

import numpy as np
from numpy.typing import NDArray

from mortarbench.harness import Vector

#: numbers of waves along L of the longest and the shortest component; on 64 × 64 cells,
#: the shortest wave spans two cells
LONGEST, SHORTEST = 2, 32
_DIGITS = 2.0**20  #: heights are multiples of rms/_DIGITS


def rough_surface(x: Vector, hurst: float, seed: int) -> NDArray[np.float64]:
    """Return heights (n, n) at the points (xᵢ, xⱼ).

    Their root mean square over the whole square is one.

    x : (n,) coordinates in units of L
    """
    k = np.arange(-SHORTEST, SHORTEST + 1)
    # k and −k are the same wave: drop the first of each pair in this order
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
