"""An operator P as a recipe: plain arrays, and the name of what multiplies by it.

A matrix-free P cannot be written to a file, but what it is made from can. It travels to
workers as these arrays and is put together there, on the clock: whatever an operator
needs before its first product (a factor, say) is part of what the solver is charged to
prepare.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from importlib import import_module
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse.linalg import LinearOperator

Arrays = Mapping[str, NDArray[Any]]
Product = Callable[[NDArray[np.float64]], NDArray[np.float64]]


class Recipe(LinearOperator):  # type: ignore[misc]  # scipy has no types
    """A symmetric operator x ↦ Px on vectors of `n` components.

    maker : ``"module:function"``; the function takes `arrays` and returns x ↦ Px, which
        must also take (n, k) matrices. A worker imports it: it belongs at the top level
        of a module of a package, or of a plug-in
    arrays : plain arrays under names of your own
    """

    def __init__(self, n: int, maker: str, arrays: Arrays) -> None:
        super().__init__(np.dtype(float), (n, n))
        self.maker = maker
        self.arrays = arrays
        self._product: Product | None = None

    def build(self) -> Product:
        """Put the operator together, unless it is."""
        if self._product is None:
            module, _, function = self.maker.partition(":")
            self._product = getattr(import_module(module), function)(self.arrays)
        product: Product = self._product
        return product

    def forget(self) -> None:
        """Drop what was built, so that the next one is charged with it again."""
        self._product = None

    def _matvec(self, x: NDArray[np.float64]) -> NDArray[np.float64]:
        return self.build()(x)

    def _matmat(self, X: NDArray[np.float64]) -> NDArray[np.float64]:
        return self.build()(X)

    def _adjoint(self) -> Recipe:
        return self
