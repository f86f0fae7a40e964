"""What a solver hands back: a claim, a primal-dual point, and a row per iteration.

The columns of a history are free and of one length. Reports know these, and any solver
may fill some of them:

* ``step``: kind of the step, one letter: c cg, e expansion, f fallback, p proportioning
* ``outer``: number of the outer iteration; ``products``: products with P so far
* ``free_gradient``, ``chopped_gradient``: ‖φ‖ and ‖β‖, so that the projected gradient
  has the norm √(‖φ‖² + ‖β‖²)
* ``infeasibility``: ‖Ax − b‖, relative; ``active``: number of active bounds
* ``two_sided``: number of active bounds of components between two bounds; in a dual
  with friction the rows that slip, while those between their bounds stick
* ``cost``: value of the objective or the Lagrangian; ``seconds``: since prepare began

All of it is the solver's own word; no verdict rests on it.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mortarbench.harness.qp import QP, Vector

History = Mapping[str, NDArray[Any]]

_LONGEST_TEXT = 16  #: characters
MOST_HISTORY = 2**28  #: bytes, so that no folder of results fills the disk
_STORED_AS = {"b": np.int64, "i": np.int64, "u": np.int64, "f": np.float64}


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

    At a solution  P x + q + Aᵀy + Gᵀz + z_box = 0.  With a claim of infeasibility, y, z
    and z_box may be a certificate: see `without_point`.
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
    )  #: columns of one length, a row per iteration; see the top of this module

    @classmethod
    def without_point(
        cls,
        qp: QP,
        status: Status,
        message: str = "",
        *,
        y: Vector | None = None,
        z: Vector | None = None,
        z_box: Vector | None = None,
    ) -> Solution:
        """Report that no point was found: NaN vectors of the right shapes.

        y, z, z_box : a certificate that no point is feasible, where the solver has one:
            Aᵀy + Gᵀz + z_box = 0, z ≥ 0, and the sum of bᵀy, hᵀz and of z_box times its
            bounds is negative
        """
        n, m, p = (np.full(v.size, np.nan) for v in (qp.q, qp.b, qp.h))
        return cls(
            status=status, message=message, x=n, y=m if y is None else y,
            z=p if z is None else z, z_box=n if z_box is None else z_box,
        )  # fmt: skip

    def mismatch(self, qp: QP) -> str | None:
        """Say which vector has a shape that does not fit `qp`, or None."""
        expected = {"x": qp.q, "y": qp.b, "z": qp.h, "z_box": qp.q}
        for name, like in expected.items():
            got = np.shape(getattr(self, name))
            if got != like.shape:
                return f"Solution.{name} has shape {got}, expected {like.shape}"
        return None


def usable_history(history: object) -> tuple[History, str]:
    """Return a history as plain arrays and "", or none and what is wrong with it.

    Never raises: a malformed history must not cost the answer that it came with.
    """
    try:
        return checked_history(history), ""
    except Exception as e:  # the solver's own object; it may do anything when read
        return {}, f"history dropped: {e}"


def checked_history(history: object) -> History:
    """Return a history as arrays of int64, float64 or short texts.

    Raises
    ------
    ValueError
        When it is no mapping from identifiers to columns of one length, or larger than
        MOST_HISTORY.

    """
    if not isinstance(history, Mapping):
        raise ValueError(f"it is of type {type(history).__name__}, expected a mapping")
    columns = {name: _column(name, values) for name, values in history.items()}
    lengths = {name: column.size for name, column in columns.items()}
    if len(set(lengths.values())) > 1:
        found = ", ".join(f"{name} {length}" for name, length in lengths.items())
        raise ValueError(f"its columns have different lengths: {found}")
    if (size := sum(column.nbytes for column in columns.values())) > MOST_HISTORY:
        raise ValueError(f"it has {size} bytes, expected at most {MOST_HISTORY}")
    return columns


def _column(name: object, values: object) -> NDArray[Any]:
    if not isinstance(name, str) or not name.isidentifier():
        raise ValueError(f"{name!r} names a column, expected an identifier")
    column = np.asarray(values)
    if column.ndim != 1:
        raise ValueError(f"{name} has shape {column.shape}, expected one row each")
    kind = column.dtype.kind
    if kind == "U" and column.dtype.itemsize <= 4 * _LONGEST_TEXT:
        return column
    if kind not in _STORED_AS:
        expected = f"numbers or texts of up to {_LONGEST_TEXT} characters"
        raise ValueError(f"{name} has dtype {column.dtype}, expected {expected}")
    return column.astype(_STORED_AS[kind])
