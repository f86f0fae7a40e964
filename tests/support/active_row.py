"""Solver of one small QP.

Workers import the module of a solver object; this one loads faster than a test module.
"""

import time
from dataclasses import dataclass

import numpy as np

import mortarbench as mb

#: min ½(x₁² + 2x₂²) − x₁ − x₂ with x₁ ≤ ½: x = (½, ½), z = ½
QP = mb.QP.from_arrays(np.diag([1.0, 2.0]), [-1, -1], G=[1, 0], h=0.5)


@dataclass(frozen=True)
class ActiveRow:
    """Solver of `QP` that assumes an active row; `shift` perturbs the answer."""

    shift: float = 0.0

    def declines(self, qp):
        return None if (qp.q.size, qp.h.size) == (2, 1) else "other sizes"

    def prepare(self, qp, tol):
        x = np.array([qp.h[0], -qp.q[1] / 2]) + self.shift
        z = np.array([-qp.q[0] - qp.h[0]])
        none = np.zeros(0)
        solution = mb.Solution(
            status=mb.Status.SOLVED, x=x, y=none, z=z, z_box=np.zeros(2)
        )
        return lambda: solution


@dataclass(frozen=True)
class Hangs(ActiveRow):
    """Solver that hangs except in the warm-up, whose QPs have 32 unknowns."""

    def declines(self, qp):
        return "the warm-up" if qp.q.size == 32 else None

    def prepare(self, qp, tol):
        time.sleep(3600)
