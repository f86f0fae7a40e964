"""The result of a solver: a claim, a primal-dual point, and a history of iterations.

A history consists of columns of equal length with arbitrary names. Reports use the
following columns:

* ``step``: type of the step as one letter: c for CG, e for expansion, f for fallback, p
  for proportioning, n for Newton
* ``outer``: number of the outer iteration
* ``products``: number of products with P so far
* ``free_gradient``, ``chopped_gradient``: norms ‖φ‖ and ‖β‖ of the free and the chopped
  gradient; the norm of the projected gradient is √(‖φ‖² + ‖β‖²)
* ``infeasibility``: relative norm of Ax − b
* ``active``: number of active bounds
* ``two_sided``: number of components at a bound that have two finite bounds; in the
  dual QP of a 2D problem with friction, these components are the rows that slip
* ``cost``: value of the objective or the Lagrangian
* ``seconds``: time since the start of `prepare`

The solver reports these values. Verdicts do not depend on them.
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

_MAX_TEXT = 16  #: largest number of characters of a text in a history
#: Largest size of a history, so that a result folder does not fill the disk.
MAX_HISTORY_BYTES = 2**28
_STORED_AS = {"b": np.int64, "i": np.int64, "u": np.int64, "f": np.float64}


class Status(StrEnum):
    """Outcome of a solve as claimed by the solver."""

    SOLVED = "solved"  #: the solver claims that its point satisfies the tolerance
    ITERATION_LIMIT = "iteration_limit"
    TIME_LIMIT = "time_limit"
    INFEASIBLE = "infeasible"  #: the solver claims that the feasible set is empty
    #: the solver claims that the objective is unbounded below
    UNBOUNDED = "unbounded"
    FAILED = "failed"  #: the solver stopped without a solution, or raised an exception
    DECLINED = "declined"  #: the solver was not started; `message` states the reason


#: claims that the QP has no solution
NO_SOLUTION = (Status.INFEASIBLE, Status.UNBOUNDED)


@dataclass(frozen=True, eq=False, kw_only=True)
class Solution:
    """A primal-dual point in the sign convention of `QP`, and the claim of the solver.

    At a solution  P x + q + Aᵀy + Gᵀz + z_box = 0.  If the solver returns no point, the
    vectors are NaN. If the solver claims infeasibility, y, z and z_box may instead be a
    certificate of infeasibility, see `without_point`.

    Examples
    --------
    The minimum of ½x² − x subject to x ≤ ½, where z_box balances the gradient −½:

    >>> import numpy as np
    >>> from mortarbench import QP, Solution, Status, verify
    >>> qp = QP.from_arrays([[1]], [-1], ub=0.5)
    >>> s = Solution(
    ...     status=Status.SOLVED, x=np.array([0.5]), y=np.zeros(0), z=np.zeros(0),
    ...     z_box=np.array([0.5]),
    ... )
    >>> verify(qp, s.x, s.y, s.z, s.z_box).verdict.value
    'verified'

    """

    status: Status
    x: Vector  #: (n,) primal variables
    y: Vector  #: (m,) multipliers of A x = b
    z: Vector  #: (p,) multipliers of G x ≤ h, nonnegative
    #: (n,) multipliers of bounds, ≤ 0 at an active lb and ≥ 0 at an active ub
    z_box: Vector
    #: number of iterations; None if the solver does not report it
    iterations: int | None = None
    #: numbers of operations by name, e.g. {"P_products": 61}
    counts: Mapping[str, int] = field(default_factory=dict)
    message: str = ""  #: message of the solver, stored in the record
    #: other data from the solver by name, e.g. {"linear_solver": "qdldl",
    #: "setup_seconds": 0.01}
    reported: Mapping[str, float | str] = field(default_factory=dict)
    #: columns of equal length, a row per iteration; see `harness.solution`
    history: History = field(default_factory=dict)

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
        """Return a solution without a point: NaN vectors of the right shapes.

        y, z, z_box : a certificate of infeasibility (Farkas), if the solver has one:
            Aᵀy + Gᵀz + z_box = 0, z ≥ 0, and  bᵀy + hᵀz + ubᵀ(z_box)₊ − lbᵀ(−z_box)₊ <
            0, where (·)₊ is the positive part

        Examples
        --------
        >>> from mortarbench import QP, Solution, Status
        >>> qp = QP.from_arrays([[1]], [0])
        >>> Solution.without_point(qp, Status.ITERATION_LIMIT, "200 iterations").x
        array([nan])

        """
        n, m, p = (np.full(v.size, np.nan) for v in (qp.q, qp.b, qp.h))
        return cls(
            status=status,
            message=message,
            x=n,
            y=m if y is None else y,
            z=p if z is None else z,
            z_box=n if z_box is None else z_box,
        )

    def mismatch(self, qp: QP) -> str | None:
        """Return a message if the shape of a vector does not fit `qp`, else None."""
        expected = {"x": qp.q, "y": qp.b, "z": qp.h, "z_box": qp.q}
        for name, like in expected.items():
            got = np.shape(getattr(self, name))
            if got != like.shape:
                return f"Solution.{name} has shape {got}, expected {like.shape}"
        return None


def usable_history(history: object) -> tuple[History, str]:
    """Return the history as plain arrays and "", or {} and a description of a defect.

    The function does not raise exceptions, so that a malformed history does not
    invalidate the answer.
    """
    try:
        return checked_history(history), ""
    except Exception as e:  # raised while an object of the solver is read
        return {}, f"history dropped: {e}"


def checked_history(history: object) -> History:
    """Check a history, and return its columns as arrays of int64, float64 or texts.

    Raises
    ------
    ValueError
        If `history` is not a mapping from identifiers to columns of equal length, if a
        column contains neither numbers nor texts of at most 16 characters, or if the
        size exceeds MAX_HISTORY_BYTES.

    """
    if not isinstance(history, Mapping):
        raise ValueError(f"it is of type {type(history).__name__}, expected a mapping")
    columns = {name: _column(name, values) for name, values in history.items()}
    lengths = {name: column.size for name, column in columns.items()}
    if len(set(lengths.values())) > 1:
        listed = ", ".join(f"{name} {length}" for name, length in lengths.items())
        raise ValueError(f"its columns have different lengths: {listed}")
    if (size := sum(column.nbytes for column in columns.values())) > MAX_HISTORY_BYTES:
        raise ValueError(f"it has {size} bytes, expected at most {MAX_HISTORY_BYTES}")
    return columns


def _column(name: object, values: object) -> NDArray[Any]:
    if not isinstance(name, str) or not name.isidentifier():
        raise ValueError(f"{name!r} is the name of a column, expected an identifier")
    column = np.asarray(values)
    if column.ndim != 1:
        raise ValueError(f"{name} has shape {column.shape}, expected one dimension")
    kind = column.dtype.kind
    if kind == "U" and column.dtype.itemsize <= 4 * _MAX_TEXT:
        return column
    if kind not in _STORED_AS:
        expected = f"numbers or strings of up to {_MAX_TEXT} characters"
        raise ValueError(f"{name} has dtype {column.dtype}, expected {expected}")
    return column.astype(_STORED_AS[kind])
