from typing import Any

from numpy import float64, longdouble
from numpy.typing import NDArray

def times_columns(
    data: NDArray[float64],
    indices: NDArray[Any],
    indptr: NDArray[Any],
    x: NDArray[longdouble],
    rows: int,
) -> NDArray[longdouble]: ...
