"""Random disturbances of answers, to test certificates."""

from dataclasses import replace

import numpy as np

from mortarbench.harness import Mechanics, Solution
from mortarbench.harness.mechanics import Real


def noise(s: Solution, size: float, rng: np.random.Generator) -> Solution:
    x = s.x + size * np.abs(s.x).max() * rng.standard_normal(s.x.size)
    z = s.z + size * np.abs(s.z).max(initial=0.0) * rng.standard_normal(s.z.size)
    return replace(s, x=x, z=z)


def scaled(s: Solution, size: float, rng: np.random.Generator) -> Solution:
    a, b = 1 + size * rng.standard_normal(2)
    return replace(s, x=a * s.x, z=b * s.z)


def wrong_rows(s: Solution, size: float, rng: np.random.Generator) -> Solution:
    """Replace the forces of random rows by forces of other rows."""
    z, swapped = s.z.copy(), rng.random(s.z.size) < max(size, 1.5 / max(s.z.size, 1))
    z[swapped] = rng.permutation(z)[swapped]
    return replace(s, z=z)


def infeasible(s: Solution, size: float, rng: np.random.Generator) -> Solution:
    """Add penetration, displaced supports and tensile contact forces."""
    x = s.x * (1 + 10 * size) + size * np.abs(s.x).max() * rng.random(s.x.size)
    return replace(
        s, x=x, z=s.z - size * np.abs(s.z).max(initial=0.0) * rng.random(s.z.size)
    )


def shifted(s: Solution, size: float, rng: np.random.Generator) -> Solution:
    """Move and bend all bodies together."""
    u = s.x.reshape(-1, 1 if s.x.size % 2 else 2)
    bend = np.cumsum(rng.standard_normal(u.shape), axis=0) / len(u) ** 0.5
    moved = u + size * np.abs(u).max() * (rng.standard_normal(u.shape[1]) + bend)
    return replace(s, x=moved.ravel())


def relative_noise(s: Solution, size: float, rng: np.random.Generator) -> Solution:
    x, z = (v * (1 + size * rng.standard_normal(v.size)) for v in (s.x, s.z))
    return replace(s, x=x, z=z)


def moved_apart(
    s: Solution, size: float, rng: np.random.Generator, mechanics: Mechanics
) -> Solution:
    """Move each body rigidly, by the order of size·‖x‖ to 10⁴·size·‖x‖."""
    far = 10 ** rng.uniform(0, 4) * size * np.linalg.norm(s.x)
    R = mechanics.rigid
    return replace(s, x=s.x + R @ (far * rng.standard_normal(R.shape[1])))


def bent(
    s: Solution, size: float, rng: np.random.Generator, mechanics: Mechanics
) -> Solution:
    """Add approximately the deformation mode of least energy."""
    whole, x = mechanics.whole, s.x.astype(Real)
    v = whole.apply_inverse(
        whole.apply_inverse(rng.standard_normal(x.size).astype(Real))
    )
    far = size * whole.norm(x) / whole.norm(v)
    return replace(s, x=(x + far * v).astype(np.float64))


DISTURBANCES = (noise, scaled, wrong_rows, infeasible, shifted)


def disturbed(
    s: Solution, i: int, rng: np.random.Generator, mechanics: Mechanics
) -> Solution:
    """Apply disturbance number i (cyclically) with a relative size of 1e-13 to 2."""
    size = 10 ** rng.uniform(-13, 0.3)
    ways = len(DISTURBANCES) + 3
    match i % ways - len(DISTURBANCES):
        case 0:
            return relative_noise(s, size, rng)
        case 1:
            return moved_apart(s, size, rng, mechanics)
        case 2:
            return bent(s, size, rng, mechanics)
    return DISTURBANCES[i % ways](s, size, rng)
