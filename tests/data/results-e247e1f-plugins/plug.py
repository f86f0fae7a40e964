"""A plug-in of the time when the packages had names of their own."""

from dataclasses import dataclass, field

import numpy as np
from lengths import CLIPPED

from harness import QP, Case, Family, Solution, Status, no_rows


@dataclass(frozen=True)
class Parabola(Family):
    """A parabola over a half line: x = depth."""

    name: str = "parabola"
    defaults: dict = field(default_factory=lambda: {"n": 3, "depth": 1.0})
    forms: tuple = ("bounds",)

    def build(self, form, params, reference):
        n, depth = params["n"], params["depth"]
        qp = QP(
            P=np.eye(n), q=np.full(n, -depth), A=no_rows(n), b=np.zeros(0),
            G=no_rows(n), h=np.zeros(0), lb=np.zeros(n), ub=np.full(n, np.inf),
        )  # fmt: skip
        return Case(
            qp=qp,
            recover=lambda s: s.x,
            quantities=lambda s: {"largest": float(s.x.max())},
        )


@dataclass(frozen=True)
class Clipped:
    """The exact minimum for a diagonal P and bounds."""

    factor: float = CLIPPED

    def declines(self, qp):
        from harness import needs_matrices

        return needs_matrices(qp) or ("has rows" if qp.b.size + qp.h.size else None)

    def prepare(self, qp, tol):
        x = np.clip(-self.factor * qp.q / qp.P.diagonal(), qp.lb, qp.ub)
        none = np.zeros(0)
        z_box = -(qp.P @ x + qp.q)
        return lambda: Solution(
            status=Status.SOLVED, x=x, y=none, z=none, z_box=z_box, iterations=1
        )


SOLVERS = {"clipped": Clipped()}
PROBLEMS = {"parabola": Parabola()}
