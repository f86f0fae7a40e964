"""Template for a family of problems: replace the keys, and the model in `build`.

    mortarbench solve NAME/n=100/primal --solver clarabel --plugin NAME.py

Suites refer to the family as NAME, and its cases are called NAME/key=value/…/FORM.
Scale the data of the QP to order one, so that tolerances have the same meaning as for
other families. The functions `recover` and `quantities` convert results to physical
units; the energy in these units is scale · objective + constant.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Any, ClassVar

import numpy as np
from scipy.sparse import diags_array

from mortarbench import QP, Case, Family, InputError, Range, Solution


@dataclass(frozen=True, kw_only=True)
class Problem(Family):
    """String on (0, 1) under a unit load, above a flat obstacle: u ≥ −depth."""

    forms: ClassVar = ("primal",)

    # keys with type, range, help text and default, in the order of case names
    n: Annotated[int, Range(2), "interior nodes"] = 50
    depth: Annotated[float, Range(0, 1e9), "distance of the obstacle"] = 0.05

    def __post_init__(self) -> None:
        """Raise an `InputError` with a one-line message if values do not fit."""
        super().__post_init__()  # checks every range
        if self.depth == 0:
            raise InputError("depth=0; expected a positive number")

    def build(self, form: str, reference: object) -> Case:
        """Build one case, with linear finite elements and n interior nodes."""
        n = self.n
        h = 1 / (n + 1)
        K = diags_array([-1.0, 2.0, -1.0], offsets=[-1, 0, 1], shape=(n, n)) / h
        qp = QP.from_arrays(K.tocsc(), np.full(n, h), lb=np.full(n, -self.depth))

        def quantities(s: Solution) -> Mapping[str, Any]:
            touching = np.count_nonzero(s.x <= -self.depth * (1 - 1e-6))
            return {"lowest": float(s.x.min()), "touching": int(touching)}

        return Case(qp=qp, recover=lambda s: s.x, quantities=quantities)


PROBLEMS = {"NAME": Problem()}
