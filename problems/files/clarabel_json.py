"""Problems that Clarabel saves as JSON.

::

    min ½xᵀPx + qᵀx   s.t.   Ax + s = b,  s in a product of cones

P and A are stored by columns, as ``m, n, colptr, rowval, nzval``, P as its upper
triangle. ``cones`` lists the cones with their dimensions, for example
``[{"ZeroConeT": 1}, {"NonnegativeConeT": 4}]``; rows of other cones are not linear
constraints. Settings are ignored. Reference: https://clarabel.org.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy.sparse import tril, triu

from mortarbench.harness import QP, InputError, Matrix
from mortarbench.harness.checked import any_list, table
from mortarbench.harness.errors import shown
from mortarbench.harness.files.qpfile import compressed
from mortarbench.harness.qp import numeric_vector

_LINEAR = ("ZeroConeT", "NonnegativeConeT")  #: cones of linear constraints


def clarabel_qp(data: Any) -> QP:
    """Return the QP that parsed JSON defines.

    Raises
    ------
    InputError
        If a part is missing or malformed, or a cone is not one of linear constraints.

    """
    problem = table("the file", data, instead="an object with P, q, A, b and cones")
    if missing := [name for name in ("P", "q", "A", "b", "cones") if name not in data]:
        raise InputError(f"{missing[0]} is missing; expected a problem of Clarabel")
    P, A = (_matrix(name, problem[name]) for name in "PA")
    b = numeric_vector("b", problem["b"], A.shape[0])
    if not tril(P, -1).nnz:
        P = P + triu(P, 1).T
    is_equality = _equalities(problem["cones"], b.size)
    return QP.from_arrays(
        P=P,
        q=problem["q"],
        G=A[~is_equality],
        h=b[~is_equality],
        A=A[is_equality],
        b=b[is_equality],
    )


def _matrix(name: str, value: Any) -> Matrix:
    parts = table(name, value)
    try:
        m, n, colptr, rowval = (
            np.asarray(parts[key]) for key in ("m", "n", "colptr", "rowval")
        )
        if any(part.size and part.dtype.kind != "i" for part in (m, n, colptr, rowval)):
            raise ValueError("m, n, colptr and rowval must be integers")
        nzval = numeric_vector("nzval", parts["nzval"])
        shape = (int(m), int(n))
        return compressed(nzval, rowval.astype(int), colptr.astype(int), shape)
    except KeyError as e:
        raise InputError(f"{name} has no {e}; expected a matrix by columns") from None
    except (ValueError, TypeError, OverflowError) as e:
        raise InputError(f"{name} is not a matrix by columns: {e}") from None


def _equalities(cones: Any, m: int) -> Any:
    """Return a mask (m,) of the rows that are equalities."""
    kinds: list[bool] = []
    for cone in any_list("cones", cones):
        match cone:
            case {"ZeroConeT": int(size)} | {"NonnegativeConeT": int(size)} if (
                len(cone) == 1 and 0 <= size <= m
            ):
                kinds += ["ZeroConeT" in cone] * size
            case _:
                raise InputError(
                    f"cones contains {shown(cone)}; expected linear constraints, "
                    f"{' or '.join(_LINEAR)}, of at most {m} rows"
                )
    if len(kinds) != m:
        raise InputError(f"the cones have {len(kinds)} rows; expected {m}, as A and b")
    return np.array(kinds, dtype=bool)
