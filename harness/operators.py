"""Operators P that can be written: plain arrays, and the name of what multiplies.

A matrix-free P cannot be written to a file, but what it is made from can. It travels to
workers as these arrays and is put together there, on the clock: whatever an operator
needs before its first product (a factor, say) is part of what the solver is charged to
prepare.

What is put together by is looked up by name in a table of *makers* that code fills: the
``OPERATORS`` of a plug-in, or a package's own. A file can name one of them and nothing
else; it never says what is imported.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import Any, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray
from scipy.sparse.linalg import LinearOperator

Arrays = Mapping[str, NDArray[Any]]
Product = Callable[[NDArray[np.float64]], NDArray[np.float64]]
#: takes plain arrays and returns x ↦ Px, which must also take (n, k) matrices
Maker = Callable[[Arrays], Product]
NO_MAKERS: Mapping[str, Maker] = MappingProxyType({})


@runtime_checkable
class Preconditioned(Protocol):
    """A product x ↦ Px that also knows approximate inverses of P.

    A maker may return one; solvers find it by `SerialisableOperator.build`.
    """

    def __call__(self, x: NDArray[np.float64]) -> NDArray[np.float64]:
        """Multiply (n,) or (n, k) with P."""

    def preconditioner(self, kind: str, scaling: str) -> Product:
        """Make x ↦ Mx, symmetric positive semidefinite, for (n,) and (n, k).

        kind, scaling : names of its own

        Raises
        ------
        ValueError
            When there is none of these names; the message lists what there is.

        """


@runtime_checkable
class WithDiagonal(Protocol):
    """A product x ↦ Px that also knows the diagonal of P; a maker may return one.

    The size of Pᵢᵢ tells how much a residual matters: without it an operator is held
    to a stricter measure than a matrix (`harness.verify.kkt`).
    """

    def __call__(self, x: NDArray[np.float64]) -> NDArray[np.float64]:
        """Multiply (n,) or (n, k) with P."""

    def diagonal(self) -> NDArray[np.float64]:
        """Give Pᵢᵢ (n,)."""


class SerialisableOperator(LinearOperator):  # type: ignore[misc]  # scipy has no types
    """A symmetric operator x ↦ Px on vectors of `n` components.

    maker : what puts it together, a name in `makers`
    arrays : plain arrays under names of your own
    makers : the table; workers look the name up in theirs, which has the ``OPERATORS``
        of the same plug-ins

    Raises
    ------
    ValueError
        When `makers` has no such name.

    """

    def __init__(
        self, n: int, maker: str, arrays: Arrays, makers: Mapping[str, Maker]
    ) -> None:
        super().__init__(np.dtype(float), (n, n))
        if maker not in makers:
            known = ", ".join(sorted(makers)) or "none"
            raise ValueError(f"P is the operator {maker!r:.200}; known: {known}")
        self.maker = maker
        self.arrays = arrays
        self._make = makers[maker]
        self._product: Product | None = None

    def build(self) -> Product:
        """Put the operator together, unless it is."""
        if self._product is None:
            self._product = self._make(self.arrays)
        return self._product

    def diagonal(self) -> NDArray[np.float64] | None:
        """Give Pᵢᵢ (n,); None where what was put together does not tell."""
        product = self.build()
        return product.diagonal() if isinstance(product, WithDiagonal) else None

    def forget(self) -> None:
        """Drop what was built, so that the next one is charged with it again."""
        self._product = None

    def _matvec(self, x: NDArray[np.float64]) -> NDArray[np.float64]:
        return self.build()(x)

    def _matmat(self, X: NDArray[np.float64]) -> NDArray[np.float64]:
        return self.build()(X)

    def _adjoint(self) -> SerialisableOperator:
        return self


def assembled(P: LinearOperator) -> NDArray[np.float64]:
    """Multiply an operator out: the symmetric part of P·1, (n, n)."""
    M = np.asarray(P @ np.eye(P.shape[0]))
    M += M.T.copy()
    M /= 2
    return M
