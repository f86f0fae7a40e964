"""What the in-house solvers keep of each step, for plots of convergence."""

from __future__ import annotations

from dataclasses import dataclass, field
from time import perf_counter
from typing import Any

import numpy as np
from numpy.typing import NDArray

from harness import Vector
from solvers.smalbe.mprgp import Face, Point, Watch
from solvers.smalbe.projected import Projected

COLUMNS = (
    "step",  # c, e, f or p
    "outer",  # number of the outer iteration
    "products",  # with F, so far
    "free_gradient",  # ‖φ‖
    "chopped_gradient",  # ‖β‖
    "infeasibility",  # ‖Cν‖/‖x̃‖; for x̃ = 0, ‖Cν‖/‖ν‖
    "active",  # components on their bounds
    "cost",  # the augmented Lagrangian
    "seconds",  # since prepare began
)


@dataclass(frozen=True, eq=False)
class History:
    """Rows in the order of `COLUMNS`; gradients and costs of the normalised problem."""

    began: float = field(default_factory=perf_counter)
    rows: list[tuple[Any, ...]] = field(default_factory=list)

    def watch(self, problem: Projected, outer: int, rhs: Vector) -> Watch:
        """Make the observer of one inner run, whose right-hand side is `rhs`."""
        C, x_tilde = problem.rows.C, problem.rows.x_tilde
        size = float(np.linalg.norm(x_tilde))

        def note(letter: str, at: Point, face: Face) -> None:
            error = np.linalg.norm(C @ at.x) if len(C) else 0.0
            self.rows.append((
                letter, outer, problem.counts["P_products"],
                np.linalg.norm(face.phi), np.linalg.norm(face.beta),
                error / (size or np.linalg.norm(at.x) or 1.0),
                face.free.size - np.count_nonzero(face.free),
                0.5 * at.x @ (at.g - rhs), perf_counter() - self.began,
            ))  # fmt: skip

        return note

    @property
    def columns(self) -> dict[str, NDArray[Any]]:
        """The rows as arrays of one length."""
        columns = zip(*self.rows, strict=True) if self.rows else ((),) * len(COLUMNS)
        return {k: np.array(v) for k, v in zip(COLUMNS, columns, strict=True)}
