"""Serialisable operators P: plain arrays, and the name of a function that builds P.

A matrix-free P cannot be written to a file, but the arrays that it is built from can.
Workers receive these arrays and build the operator on the clock: work before the first
product, such as a factorisation, counts as preparation of the solver.

The function is looked up by name in a table of *makers*: the ``OPERATORS`` of a
plug-in, or that of a package. A file contains the name only. It cannot specify a module
to import.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import Any, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray
from scipy.sparse.linalg import LinearOperator

from mortarbench.harness.distributed.sparse import LinearMap

Arrays = Mapping[str, NDArray[Any]]
Product = Callable[[NDArray[np.float64]], NDArray[np.float64]]
#: Maps plain arrays to x ↦ Px, for vectors (n,) and matrices (n, k).
Maker = Callable[[Arrays], Product]
NO_MAKERS: Mapping[str, Maker] = MappingProxyType({})


@runtime_checkable
class Preconditioned(Protocol):
    """A product x ↦ Px that also offers approximate inverses of P.

    A maker may return one; solvers get it from `SerialisableOperator.build`.
    """

    def __call__(self, x: NDArray[np.float64]) -> NDArray[np.float64]:
        """Multiply P by (n,) or (n, k)."""

    def preconditioner(self, kind: str, scaling: str) -> Product:
        """Return x ↦ Mx, symmetric positive semidefinite, for (n,) and (n, k).

        kind, scaling : names that the operator defines

        Raises
        ------
        ValueError
            If a name is unknown; the message lists the valid names.

        """


@runtime_checkable
class WithDiagonal(Protocol):
    """A product x ↦ Px that also offers the diagonal of P; a maker may return one.

    Pᵢᵢ scales the residual of component i. Without it, an operator is judged more
    strictly than a matrix (`harness.verify.kkt`).
    """

    def __call__(self, x: NDArray[np.float64]) -> NDArray[np.float64]:
        """Multiply P by (n,) or (n, k)."""

    def diagonal(self) -> NDArray[np.float64]:
        """Return Pᵢᵢ (n,)."""


@runtime_checkable
class Compiled(Protocol):
    """A product x ↦ Px whose map compiled solvers apply without calling Python."""

    @property
    def linear_map(self) -> LinearMap:
        """The same product."""


class SerialisableOperator(LinearOperator):  # type: ignore[misc]  # scipy has no types
    """A symmetric operator x ↦ Px on vectors of `n` components.

    maker : name of a function in `makers`
    arrays : plain arrays by name, the argument of that function
    makers : functions by name; workers have the same table, with the ``OPERATORS`` of
        the same plug-ins

    Raises
    ------
    ValueError
        When `maker` is not in `makers`.

    Examples
    --------
    A rank-one P = vvᵀ that is never stored as a matrix:

    >>> import numpy as np
    >>> from mortarbench.harness.operators import SerialisableOperator
    >>> def rank_one(arrays):
    ...     v = arrays["v"]
    ...     return lambda x: v * (v @ x)
    >>> v = np.array([1.0, 2.0])
    >>> P = SerialisableOperator(2, "rank-one", {"v": v}, {"rank-one": rank_one})
    >>> P @ np.array([1.0, 1.0])
    array([3., 6.])

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
        """Return the product, built at the first call."""
        if self._product is None:
            self._product = self._make(self.arrays)
        return self._product

    def diagonal(self) -> NDArray[np.float64] | None:
        """Return Pᵢᵢ (n,), or None if the product is not a `WithDiagonal`."""
        product = self.build()
        return product.diagonal() if hasattr(product, "diagonal") else None

    @property
    def least_eigenvalue(self) -> float | None:
        """Proven lower bound of the eigenvalues of P that the product offers, or None.

        With a positive one, errors of answers over convex sets are bounded
        (`harness.verify.certificate.certify_by_eigenvalue`).
        """
        return getattr(self.build(), "least_eigenvalue", None)

    def forget(self) -> None:
        """Drop the product, so that the next solver is charged for building it."""
        self._product = None

    def _matvec(self, x: NDArray[np.float64]) -> NDArray[np.float64]:
        return self.build()(x)

    def _matmat(self, X: NDArray[np.float64]) -> NDArray[np.float64]:
        return self.build()(X)

    def _adjoint(self) -> SerialisableOperator:
        return self


# The next functions look for an attribute: `isinstance` with a protocol takes longer
# than several products with a small operator.


def preconditioned(P: Any) -> Preconditioned | None:
    """Return an operator P, or its product, if it is `Preconditioned`; else None."""
    product: Any = P.build() if isinstance(P, SerialisableOperator) else P
    return product if hasattr(product, "preconditioner") else None


def linear_map(P: Any) -> LinearMap | None:
    """Return the map of an operator P that is `Compiled`; else None."""
    product = P.build() if isinstance(P, SerialisableOperator) else P
    return getattr(product, "linear_map", None)


def assembled(P: LinearOperator) -> NDArray[np.float64]:
    """Return an operator as a matrix (n, n), the symmetric part of P·I."""
    M = np.asarray(P @ np.eye(P.shape[0]))
    M += M.T.copy()  # rounding of products makes P·I slightly asymmetric
    M /= 2
    return M
