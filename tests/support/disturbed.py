"""Answers that are disturbed at random, to try certificates with."""

from dataclasses import replace

import numpy as np

from harness import Solution


def noise(s: Solution, size: float, rng: np.random.Generator) -> Solution:
    x = s.x + size * np.abs(s.x).max() * rng.standard_normal(s.x.size)
    z = s.z + size * np.abs(s.z).max() * rng.standard_normal(s.z.size)
    return replace(s, x=x, z=z)


def scaled(s: Solution, size: float, rng: np.random.Generator) -> Solution:
    a, b = 1 + size * rng.standard_normal(2)
    return replace(s, x=a * s.x, z=b * s.z)


def wrong_rows(s: Solution, size: float, rng: np.random.Generator) -> Solution:
    """Move forces from rows in contact to others."""
    z, swapped = s.z.copy(), rng.random(s.z.size) < max(size, 1.5 / s.z.size)
    z[swapped] = rng.permutation(z)[swapped]
    return replace(s, z=z)


def infeasible(s: Solution, size: float, rng: np.random.Generator) -> Solution:
    """Push bodies into each other, move what is held, and let contact pull."""
    x = s.x * (1 + 10 * size) + size * np.abs(s.x).max() * rng.random(s.x.size)
    return replace(s, x=x, z=s.z - size * np.abs(s.z).max() * rng.random(s.z.size))


def shifted(s: Solution, size: float, rng: np.random.Generator) -> Solution:
    """Move and bend all bodies together."""
    u = s.x.reshape(-1, 2)
    bend = np.cumsum(rng.standard_normal(u.shape), axis=0) / len(u) ** 0.5
    moved = u + size * np.abs(u).max() * (rng.standard_normal(2) + bend)
    return replace(s, x=moved.ravel())


DISTURBANCES = (noise, scaled, wrong_rows, infeasible, shifted)
