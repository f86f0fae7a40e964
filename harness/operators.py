"""Serialisable operators: plain arrays and the name of a function that builds P.

P is the matrix of a QP. A matrix-free P cannot be written to a file, but the arrays
from which P is built can be written. Workers receive these arrays and build the
operator while the clock runs. Work before the first product, such as a factorisation,
therefore counts as preparation of the solver.

The function that builds P, called its *maker*, is looked up by name in a table, the
``OPERATORS`` of a plug-in or of a package. A file refers to the maker only by its name,
and therefore cannot cause the import of a module.
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
#: Function that builds x ↦ Px, for x of shape (n,) or (n, k), from plain arrays.
Maker = Callable[[Arrays], Product]
NO_MAKERS: Mapping[str, Maker] = MappingProxyType({})


@runtime_checkable
class Preconditioned(Protocol):
    """A product x ↦ Px with a method that returns preconditioners for P.

    A maker may return such a product; solvers obtain it from `preconditioned`.
    """

    def __call__(self, x: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return Px for x of shape (n,) or (n, k)."""

    def preconditioner(self, kind: str, scaling: str) -> Product:
        """Return x ↦ Mx for x of shape (n,) or (n, k), where M approximates P⁻¹.

        M is symmetric positive semidefinite.

        kind, scaling : names of a preconditioner and of its scaling; each operator
            defines its own names

        Raises
        ------
        ValueError
            If `kind` or `scaling` is unknown; the message lists the valid names.

        """


class SerialisableOperator(LinearOperator):  # type: ignore[misc]  # scipy has no types
    """A symmetric operator x ↦ Px on vectors of `n` components.

    maker : name of the function in `makers` that builds the map x ↦ Px
    arrays : plain arrays by name, the argument of the maker
    makers : functions by name; workers have the same table, since they load the same
        plug-ins

    Raises
    ------
    ValueError
        If `maker` is not a name in `makers`.

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
        """Return the product x ↦ Px, which the first call builds."""
        if self._product is None:
            self._product = self._make(self.arrays)
        return self._product

    def diagonal(self) -> NDArray[np.float64] | None:
        """Return the diagonal of P (n,), or None if x ↦ Px has no method `diagonal`."""
        product = self.build()
        return product.diagonal() if hasattr(product, "diagonal") else None

    @property
    def least_eigenvalue(self) -> float | None:
        """Proven lower bound on the eigenvalues of P, or None if it is unavailable.

        A positive bound yields error bounds for answers to QPs over convex sets without
        rows (`harness.verify.certificate.certify_by_eigenvalue`).
        """
        return getattr(self.build(), "least_eigenvalue", None)

    def forget(self) -> None:
        """Discard the product; the next solver then builds it while the clock runs."""
        self._product = None

    def _matvec(self, x: NDArray[np.float64]) -> NDArray[np.float64]:
        return self.build()(x)

    def _matmat(self, X: NDArray[np.float64]) -> NDArray[np.float64]:
        return self.build()(X)

    def _adjoint(self) -> SerialisableOperator:
        return self


# The following functions test for an attribute, since `isinstance` with a protocol
# takes longer than several products with a small operator.


def preconditioned(P: Any) -> Preconditioned | None:
    """Return P or its map x ↦ Px if one is `Preconditioned`, else None."""
    product: Any = P.build() if isinstance(P, SerialisableOperator) else P
    return product if hasattr(product, "preconditioner") else None


def is_semidefinite(P: Any) -> bool:
    """Return True if P or its map declares a kernel by its attribute `semidefinite`."""
    product = P.build() if isinstance(P, SerialisableOperator) else P
    return bool(getattr(product, "semidefinite", False))


def linear_map(P: Any) -> LinearMap | None:
    """Return x ↦ Px as a compiled map, or None if no compiled map is available."""
    product = P.build() if isinstance(P, SerialisableOperator) else P
    return getattr(product, "linear_map", None)


def assembled(P: LinearOperator) -> NDArray[np.float64]:
    """Assemble the matrix (n, n) of an operator by a product with the identity.

    The symmetric part of the product is returned.
    """
    M = np.asarray(P @ np.eye(P.shape[0]))
    M += M.T.copy()  # products have rounding errors, so P·I may be slightly asymmetric
    M /= 2
    return M
