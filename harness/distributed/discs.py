"""Discs of components that are distributed over MPI ranks."""

from __future__ import annotations

from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from mortarbench.harness.distributed.vectors import (
    DistributedVector,
    Ranks,
    distributed,
)
from mortarbench.harness.sets.discs import Discs


class DistributedDiscs(Discs):
    """The discs of one rank; their measures are distributed vectors.

    All components of a disc are on one rank, so that only sums over discs need other
    ranks. Every rank has a set, possibly without discs, and takes the same steps.

    Parameters
    ----------
    index : (k, d) places of the components in the local slice
    radius : (k,) a distributed vector

    """

    may_be_empty: ClassVar[bool] = True

    radius: DistributedVector

    def __post_init__(self) -> None:
        """Copy and check both arrays; the copy of the radii is distributed as well."""
        ranks = self.radius.ranks
        super().__post_init__()
        object.__setattr__(self, "radius", distributed(self.radius, ranks))

    @classmethod
    def of(
        cls, discs: Discs, owned: NDArray[np.int64], ranks: Ranks
    ) -> DistributedDiscs:
        """Return those of some discs whose components a rank owns.

        owned : (o,) global numbers of the components of its slice, ascending

        Raises
        ------
        ValueError
            When a rank owns some components of a disc, but not all.

        """
        is_owned = np.isin(discs.index, owned)
        here = is_owned.all(axis=1)
        split = np.flatnonzero(is_owned.any(axis=1) & ~here)
        if split.size:
            raise ValueError(
                f"the components {discs.index[split[0]].tolist()} of a disc are on "
                "several ranks; expected one rank for each disc"
            )
        index = np.searchsorted(owned, discs.index[here])
        return cls(index, distributed(discs.radius[here], ranks))
