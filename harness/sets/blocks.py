"""Base class of discs and cones: convex sets on disjoint blocks of variables."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import fields
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csc_array

from mortarbench.harness.errors import InputError
from mortarbench.harness.sets.convex import Vector, numeric_array


class Blocks(ABC):
    """Base of dataclasses that define a convex set on each of k blocks of variables.

    The first field is `index` (k, d), whose rows list the variables of the blocks; the
    second field contains one number for each block (k,). Both arrays are copied.
    """

    prefix: ClassVar[str]  #: prefix of the names of arrays in files
    least: ClassVar[int]  #: smallest number d of variables in a block
    #: text for messages that states the meaning of the columns of `index`
    columns: ClassVar[str]

    index: NDArray[np.int64]  #: (k, d) variables of each block

    def __post_init__(self) -> None:
        """Copy and check both arrays.

        Raises
        ------
        InputError
            If the shapes do not match, an index is not an integer, or a number is
            negative or not finite.

        """
        kind, size = type(self).__name__, fields(self)[1].name  # type: ignore[arg-type]
        index, sizes = (
            numeric_array(f"{kind}: {name}", getattr(self, name))
            for name in ("index", size)
        )
        if index.ndim != 2 or index.shape[1] < self.least:
            raise InputError(
                f"{kind}: index has shape {index.shape}; expected (k, {self.columns}), "
                "one row per block"
            )
        if sizes.shape != index.shape[:1]:
            raise InputError(
                f"{kind}: {size} has shape {sizes.shape}; expected {index.shape[:1]}, "
                "one number per row of index"
            )
        # a cast of NaN, or of numbers beyond the range of int64, is invalid
        with np.errstate(invalid="ignore"):
            whole = index.astype(np.int64)
        if not np.array_equal(whole, index):
            raise InputError(f"{kind}: index contains a number that is not an integer")
        bad = np.flatnonzero(~(np.isfinite(sizes) & (sizes >= 0)))
        if bad.size:
            raise InputError(
                f"{kind}: {size}[{bad[0]}] = {sizes[bad[0]]}; expected finite "
                "nonnegative numbers"
            )
        object.__setattr__(self, "index", whole)
        object.__setattr__(self, size, sizes)

    @property
    def block(self) -> NDArray[np.int64]:
        """All variables of the blocks, in ascending order."""
        return np.sort(self.index.ravel())

    def check(self, n: int) -> None:
        """Raise ValueError if an index is not in 0 … n − 1 or occurs twice."""
        kind, block = type(self).__name__, self.block
        outside = block[(block < 0) | (block >= n)]
        if outside.size:
            raise ValueError(
                f"{kind}: index {outside[0]} is out of range; expected 0 … {n - 1}"
            )
        twice = block[1:][np.diff(block) == 0]
        if twice.size:
            raise ValueError(
                f"{kind}: variable {twice[0]} is listed twice; expected disjoint blocks"
            )

    @abstractmethod
    def normals(self, x: Vector) -> tuple[csc_array, Vector]:
        """Return outward normals (n, j) at x (n,) of length ≤ 1, and their slacks (j,).

        Nonnegative combinations of the normals with zero slack span the normal cones,
        up to the discretisation of curved cones.
        """

    def arrays(self) -> dict[str, NDArray[Any]]:
        """Return the fields, keyed by their names in files, such as `disc_index`."""
        names = (field.name for field in fields(self))  # type: ignore[arg-type]
        return {f"{self.prefix}_{name}": getattr(self, name) for name in names}

    def entries(self, T: Any, a: Vector) -> tuple[NDArray[np.int64], Vector]:
        """Return columns and entries (k, d) of T in the rows of the blocks.

        T has a single entry in each row and column, and x = T x' + a is substituted.

        Raises
        ------
        ValueError
            If a (n,) is nonzero at a variable of a block.

        """
        if a[self.index].any():
            raise ValueError(f"{type(self).__name__} cannot be shifted")
        coo = T.tocoo()
        column, entry = np.empty(T.shape[0], dtype=np.int64), np.empty(T.shape[0])
        column[coo.row], entry[coo.row] = coo.col, coo.data
        return column[self.index], entry[self.index]


def norms(blocks: NDArray[Any]) -> NDArray[Any]:
    """Return the Euclidean norms (k,) of rows (k, d), without a change of precision."""
    return np.asarray(np.linalg.norm(blocks, axis=1))
