"""Plug-in with projected gradient descent and valid or invalid histories."""

import time
from dataclasses import dataclass, replace

import numpy as np

from mortarbench.harness import Solution, Status


@dataclass(frozen=True)
class Descent:
    """Solver with the slow iteration x ← clip(x − g/‖P‖), for QPs with bounds only."""

    history: bool = False  #: True to store a row per step
    max_iter: int = 50_000

    def declines(self, qp):
        return "takes bounds only" if qp.b.size or qp.h.size else None

    def prepare(self, qp, tol):
        start = time.perf_counter()
        P = np.asarray(qp.P if isinstance(qp.P, np.ndarray) else qp.P.todense())
        alpha = 1 / np.linalg.norm(P, 2)
        return lambda: self.solve(qp, P, alpha, tol, start)

    def solve(self, qp, P, alpha, tol, start):
        x = np.clip(0 * qp.q, qp.lb, qp.ub)
        rows, status = [], Status.ITERATION_LIMIT
        for k in range(1, self.max_iter + 1):
            g = P @ x + qp.q
            at_lb, at_ub = x <= qp.lb, x >= qp.ub
            active = at_lb | at_ub
            phi = np.where(active, 0.0, g)
            beta = np.where(at_lb, np.minimum(g, 0), 0.0)
            beta += np.where(at_ub, np.maximum(g, 0), 0.0)
            if self.history:
                rows.append((
                    "e", k, np.linalg.norm(phi), np.linalg.norm(beta), active.sum(),
                    x @ (g + qp.q) / 2, time.perf_counter() - start,
                ))  # fmt: skip
            if np.hypot(*map(np.linalg.norm, (phi, beta))) <= tol * 0.1:
                status = Status.SOLVED
                break
            x = np.clip(x - alpha * g, qp.lb, qp.ub)
        names = (
            "step", "products", "free_gradient", "chopped_gradient", "active", "cost",
            "seconds",
        )  # fmt: skip
        columns = map(np.array, zip(*rows, strict=True))
        return Solution(
            status=status, x=x, y=qp.b, z=qp.h, z_box=np.where(active, -g, 0.0),
            iterations=k, counts={"P_products": k},
            history=dict(zip(names, columns, strict=False)),
        )  # fmt: skip


@dataclass(frozen=True)
class Garbled(Descent):
    """Solver that returns the same answer with an invalid history."""

    history: object = None

    def solve(self, *problem):
        return replace(Descent.solve(replace(self, history=False), *problem),
                       history=self.history)  # fmt: skip


class Angry(dict):
    def items(self):
        raise ZeroDivisionError("no history for you")


GARBLED = {
    "ragged": {"cost": np.zeros(3), "active": np.zeros(2, int)},
    "square": {"cost": np.zeros((2, 2))},
    "scalar": {"cost": 1.0},
    "objects": {"cost": np.array([None, {}])},
    "complex": {"cost": np.array([1j])},
    "long": {"step": np.array(["a" * 17])},
    "path": {"../cost": np.zeros(2)},
    "number": {7: np.zeros(2)},
    "none": None,
    "list": [1.0, 2.0],
    "angry": Angry(cost=np.zeros(1)),
}
SOLVERS = {
    "descent": Descent(),
    **{name: Garbled(history=history) for name, history in GARBLED.items()},
    "unkept": Garbled(history={}),
    "notes": Garbled(history={
        "step": ["a", "bc"], "big": np.array([1, 2], np.uint8), "flag": [True, False],
        "cost": np.array([np.nan, np.inf], np.float32),
    }),
}  # fmt: skip
