from typing import Any, TypeVar

from numpy import float64, int64, longdouble
from numpy.typing import NDArray

Reals = TypeVar("Reals", NDArray[float64], NDArray[longdouble])

def times_columns(
    data: NDArray[float64],
    indices: NDArray[Any],
    indptr: NDArray[Any],
    x: NDArray[longdouble],
    rows: int,
) -> NDArray[longdouble]: ...
def times_rows(
    data: NDArray[float64],
    indices: NDArray[Any],
    indptr: NDArray[Any],
    x: NDArray[longdouble],
) -> NDArray[longdouble]: ...
def projected_products(
    data: NDArray[float64],
    indices: NDArray[Any],
    indptr: NDArray[Any],
    R: NDArray[float64],
    starts: NDArray[int64],
    v: Reals,
    found: Reals,
) -> None: ...
