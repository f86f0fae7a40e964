import numpy as np
from numpy.typing import NDArray

def multiply(
    M: NDArray[np.float64], X: NDArray[np.float64], Y: NDArray[np.float64]
) -> None: ...
