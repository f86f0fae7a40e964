"""What a solver tells of its iterations: columns of one length, a row per iteration.

Columns are free; reports know these, and any solver may fill some of them:

* ``step``: kind of the step, one letter: c cg, e expansion, f fallback, p proportioning
* ``outer``: number of the outer iteration; ``products``: products with P so far
* ``free_gradient``, ``chopped_gradient``: ‖φ‖ and ‖β‖, so that the projected gradient
  has the norm √(‖φ‖² + ‖β‖²)
* ``infeasibility``: ‖Ax − b‖, relative; ``active``: number of active bounds
* ``cost``: value of the objective or the Lagrangian; ``seconds``: since prepare began

All of it is the solver's own word; no verdict rests on it.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

History = Mapping[str, NDArray[Any]]

_LONGEST_TEXT = 16  #: characters
_STORED_AS = {"b": np.int64, "i": np.int64, "u": np.int64, "f": np.float64}


def usable(history: object) -> tuple[History, str]:
    """Return a history as plain arrays and "", or none and what is wrong with it.

    Never raises: a malformed history must not cost the answer that it came with.
    """
    try:
        return checked(history), ""
    except Exception as e:  # the solver's own object; it may do anything when read
        return {}, f"history dropped: {e}"


def checked(history: object) -> History:
    """Return a history as arrays of int64, float64 or short texts.

    Raises
    ------
    ValueError
        When it is no mapping from identifiers to columns of one length.

    """
    if not isinstance(history, Mapping):
        raise ValueError(f"it is of type {type(history).__name__}, expected a mapping")
    columns = {name: _column(name, values) for name, values in history.items()}
    lengths = {name: column.size for name, column in columns.items()}
    if len(set(lengths.values())) > 1:
        found = ", ".join(f"{name} {length}" for name, length in lengths.items())
        raise ValueError(f"its columns have different lengths: {found}")
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
