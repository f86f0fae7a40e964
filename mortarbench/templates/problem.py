"""Template for a family of problems: replace the keys, and the model in `build`.

    mortarbench solve NAME/n=100/primal --solver clarabel --plugin NAME.py

Suites refer to the family as NAME, and its cases are called NAME/key=value/…/FORM.
Scale the data of the QP to order one, so that tolerances have the same meaning as for
other families. The functions `recover` and `quantities` convert results to physical
units; the energy in these units is scale · objective + constant.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from scipy.sparse import diags_array

from mortarbench.harness import (
    QP,
    Case,
    Family,
    InputError,
    Reference,
    Solution,
    Value,
    no_rows,
)


@dataclass(frozen=True)
class Problem(Family):
    """String on (0, 1) under a unit load, above a flat obstacle: u ≥ −depth."""

    name: str = "NAME"
    #: keys with their default values, in the order in which case names contain them
    defaults: Mapping[str, Value] = field(
        default_factory=lambda: {"n": 50, "depth": 0.05}, hash=False
    )
    forms: tuple[str, ...] = ("primal",)

    def check(self, params: Mapping[str, Value]) -> None:
        """Raise an `InputError` with a one-line message if a value is out of range."""
        n, depth = int(params["n"]), float(params["depth"])
        if n < 2:
            raise InputError(f"NAME: n = {n}; expected at least 2")
        if not depth > 0:
            raise InputError(f"NAME: depth = {depth}; expected a positive number")

    def build(
        self, form: str, params: Mapping[str, Value], reference: Reference
    ) -> Case:
        """Build one case, with linear finite elements and n interior nodes."""
        n, depth = int(params["n"]), float(params["depth"])
        h = 1 / (n + 1)
        K = diags_array([-1.0, 2.0, -1.0], offsets=[-1, 0, 1], shape=(n, n)) / h
        qp = QP(
            P=K.tocsc(),
            q=np.full(n, h),
            A=no_rows(n),
            b=np.zeros(0),
            G=no_rows(n),
            h=np.zeros(0),
            lb=np.full(n, -depth),
            ub=np.full(n, np.inf),
        )

        def quantities(s: Solution) -> Mapping[str, Any]:
            touching = np.count_nonzero(s.x <= -depth * (1 - 1e-6))
            return {"lowest": float(s.x.min()), "touching": int(touching)}

        return Case(qp=qp, recover=lambda s: s.x, quantities=quantities)


PROBLEMS = {"NAME": Problem()}
