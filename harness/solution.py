"""What a solver hands back: a claim and a primal-dual point."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import StrEnum

import numpy as np

from harness.history import History
from harness.qp import QP, Vector


class Status(StrEnum):
    """A solver's own claim about how its run ended."""

    SOLVED = "solved"  #: it says that it met its tolerance
    ITERATION_LIMIT = "iteration_limit"
    TIME_LIMIT = "time_limit"
    INFEASIBLE = "infeasible"  #: it says that no feasible (or no bounded) point exists
    FAILED = "failed"  #: it gave up, or raised
    DECLINED = "declined"  #: never started; the reason is in the message


@dataclass(frozen=True, eq=False, kw_only=True)
class Solution:
    """A primal-dual point in the sign convention of `QP`; NaN where there is none.

    At a solution  P x + q + Aᵀy + Gᵀz + z_box = 0.
    """

    status: Status
    x: Vector  #: (n,)
    y: Vector  #: (m,) of A x = b
    z: Vector  #: (p,) of G x ≤ h, nonnegative
    z_box: Vector  #: (n,) of the bounds, ≤ 0 at an active lb, ≥ 0 at an active ub
    iterations: int | None = None  #: None where the solver does not tell
    counts: Mapping[str, int] = field(default_factory=dict)  #: e.g. {"P_products": 61}
    message: str = ""  #: the solver's own words, for the record
    reported: Mapping[str, float | str] = field(
        default_factory=dict
    )  #: what it tells besides, e.g. {"linear_solver": "qdldl", "setup_seconds": 0.01}
    history: History = field(
        default_factory=dict
    )  #: columns of one length, a row per iteration; see `harness.history`

    @classmethod
    def without_point(cls, qp: QP, status: Status, message: str = "") -> Solution:
        """Report that no point was found: NaN vectors of the right shapes."""
        n, m, p = (np.full(v.size, np.nan) for v in (qp.q, qp.b, qp.h))
        return cls(status=status, x=n, y=m, z=p, z_box=n, message=message)

    def mismatch(self, qp: QP) -> str | None:
        """Say which vector has a shape that does not fit `qp`, or None."""
        expected = {"x": qp.q, "y": qp.b, "z": qp.h, "z_box": qp.q}
        for name, like in expected.items():
            got = np.shape(getattr(self, name))
            if got != like.shape:
                return f"Solution.{name} has shape {got}, expected {like.shape}"
        return None
