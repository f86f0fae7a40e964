"""Plug-in with solvers that make false claims, and the problem min ½(x + 1)², x ≤ 0."""

from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np

from mortarbench.harness import QP, Case, Family, Solution, Status, no_rows
from mortarbench.solvers.reference.solve import reference_solution


@dataclass(frozen=True)
class Half(Family):
    forms: ClassVar = ("qp",)

    def build(self, form, reference):
        qp = QP(
            P=np.eye(1), q=np.ones(1), A=no_rows(1), b=np.zeros(0),
            G=np.eye(1), h=np.zeros(1), lb=np.full(1, -np.inf), ub=np.full(1, np.inf),
        )  # fmt: skip
        return Case(qp=qp, recover=lambda s: s.x, quantities=lambda s: {})


class Any:
    """Solver that accepts every QP."""

    def declines(self, qp):
        return None


@dataclass(frozen=True)
class Stale(Any):
    """Solver that returns the answer to the previous QP of the same size."""

    def prepare(self, qp, tol):
        def solve():
            answer, before = reference_solution(qp), MEMORY.get(qp.q.size)
            MEMORY[qp.q.size] = answer
            return answer if before is None else before

        return solve


@dataclass(frozen=True)
class Pulls(Any):
    """Solver that returns a multiplier of the wrong sign on an inactive constraint."""

    def prepare(self, qp, tol):
        def solve():
            s = reference_solution(qp)
            z, z_box = s.z.copy(), s.z_box.copy()
            if z.size:
                z[np.argmax(qp.h - qp.G @ s.x)] = -np.abs(z).max()
            else:
                z_box[np.argmax(s.x - qp.lb)] = np.abs(z_box).max()
            return replace(s, z=z, z_box=z_box)

        return solve


@dataclass(frozen=True)
class Denies(Any):
    """Solver that claims that the QP is infeasible."""

    def prepare(self, qp, tol):
        return lambda: Solution.without_point(qp, Status.INFEASIBLE)


MEMORY = {}  #: last answer of `Stale` for each size
SOLVERS = {
    "stale": Stale(),
    "pulls": Pulls(),
    "denies": Denies(),
}
PROBLEMS = {"half": Half()}
