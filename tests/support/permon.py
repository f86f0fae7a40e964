"""QPs of the tutorials of PERMON."""

import numpy as np


def string():
    """Return matrix, load and obstacle of the string of PERMON's first tutorial.

    The string has 100 points and lies above a sine-shaped obstacle.
    """
    n, h = 100, 1 / 99
    A = 2 * np.eye(n) - np.eye(n, k=1) - np.eye(n, k=-1)
    A[[0, -1]], A[:, [0, -1]] = 0, 0
    A[[0, -1], [0, -1]] = 1
    inside = np.r_[0, np.ones(n - 2), 0]
    obstacle = np.sin(4 * np.pi * h * np.arange(n) - np.pi / 6) / 2 - 2
    return A, -30 * h**2 * inside, obstacle * inside
