"""QPs with two-sided rows, as in test sets, and their conversion to `QP`."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from scipy.sparse import coo_array, csc_array, csr_array, vstack

from mortarbench.harness import QP, InputError, Vector
from mortarbench.harness.errors import shortened
from mortarbench.harness.qp import with_infinities

_NUMBER = re.compile(
    r"[+-]?(\d+(\.\d*)?|\.\d+)([ED][+-]?\d+)?|[+-]?INF(INITY)?",
    re.IGNORECASE | re.ASCII,
)


class LoadedQP(NamedTuple):
    """QP of a file, and the conversion to the objective of the file."""

    qp: QP
    #: the objective of the file is scale·(objective of the QP) + constant
    scale: float = 1.0
    constant: float = 0.0
    remarks: tuple[str, ...] = ()  #: parts of the file that are ignored, one line each


class TwoSidedQP(NamedTuple):
    """The problem  min ½xᵀPx + qᵀx + r  subject to  l ≤ Ax ≤ u, lb ≤ x ≤ ub.

    Limits of at least `MIN_INFINITE` of `harness.qp` are infinite.
    """

    P: Any  #: (n, n) sparse Hessian, with both triangles
    q: Vector  #: (n,) linear term
    r: float
    A: Any  #: (m, n) sparse constraint matrix
    l: Vector  #: (m,) lower limits
    u: Vector  #: (m,) upper limits
    lb: Vector  #: (n,) lower bounds
    ub: Vector  #: (n,) upper bounds
    maximise: bool = False  #: True if the objective is maximised
    rows: Sequence[str] = ()  #: names of the rows for messages; () if they have none
    columns: Sequence[str] = ()  #: names of the variables
    remarks: tuple[str, ...] = ()  #: as in `LoadedQP`


def loaded(qp: TwoSidedQP) -> LoadedQP:
    """Return the QP with rows l = u as equalities and all others as inequalities.

    Upper limits  Ax ≤ u  precede lower limits  −Ax ≤ −l; rows without limits are
    dropped. If the objective is maximised, the QP minimises the negative objective.

    Raises
    ------
    InputError
        If the QP is not convex, a number is not finite, or the limits of a row or
        variable exclude every value.

    """
    sign = -1.0 if qp.maximise else 1.0
    A = csr_array(qp.A, dtype=float)
    l, u = _limits("row", qp.l, qp.u, qp.rows)
    lb, ub = _limits("variable", qp.lb, qp.ub, qp.columns)
    equal = l == u
    upper, lower = np.isfinite(u) & ~equal, np.isfinite(l) & ~equal
    one_sided = QP.from_arrays(
        P=sign * csc_array(qp.P, dtype=float),
        q=sign * qp.q,
        A=A[equal],
        b=u[equal],
        G=vstack([A[upper], -A[lower]]),
        h=np.append(u[upper], -l[lower]),
        lb=lb,
        ub=ub,
    )
    return LoadedQP(one_sided, sign, qp.r, qp.remarks)


def sparse(entries: list[tuple[int, int, float]], shape: tuple[int, int]) -> coo_array:
    """Return the matrix with the entries (row, column, value)."""
    i, j, values = zip(*entries, strict=True) if entries else ((), (), ())
    at = (np.array(i, dtype=np.int64), np.array(j, dtype=np.int64))
    return coo_array((np.array(values, dtype=float), at), shape=shape)


def real_number(text: str) -> float:
    """Read a number in Fortran notation, or ±inf for an absent limit.

    Raises
    ------
    InputError
        If the text is not a number, or exceeds the range of a double.

    """
    if not _NUMBER.fullmatch(text):
        raise InputError(f"{shortened(text)!r} is not a number")
    if text[-1] not in "0123456789.":
        return float(text)
    value = float(text.upper().replace("D", "E"))
    if math.isinf(value):
        raise InputError(f"{shortened(text)!r} exceeds 1.8e308")
    return value


def _limits(
    what: str, low: Vector, high: Vector, names: Sequence[str]
) -> tuple[Vector, Vector]:
    """Replace absent limits by ±inf; raise InputError if they exclude every value."""
    low, high = with_infinities(low), with_infinities(high)
    crossed = ~(low <= high) | (low == np.inf) | (high == -np.inf)
    if crossed.any():
        i = int(crossed.argmax())
        name = f"{names[i]!r}" if names else f"{i} (from 0)"
        raise InputError(
            f"the limits of {what} {name} cross: {low[i]:g} > {high[i]:g}"
            if low[i] > high[i]
            else f"the limits of {what} {name} are {low[i]:g} and {high[i]:g}; "
            "expected a finite number between them"
        )
    return low, high
