"""Disc constraints whose components are distributed over MPI ranks."""

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
    """Discs whose components are on this rank, with radii as a distributed vector.

    All components of a disc are on the same rank, so that only sums over discs need
    communication. Every rank has an object of this class, even if the rank has no
    discs, since all ranks must take part in the sums.

    Parameters
    ----------
    index : (k, d) positions of the components in the local slice
    radius : (k,) radii, a distributed vector

    """

    may_be_empty: ClassVar[bool] = True

    radius: DistributedVector

    def __post_init__(self) -> None:
        """Copy and check both arrays; the copied radii are again distributed."""
        ranks = self.radius.ranks
        super().__post_init__()
        object.__setattr__(self, "radius", distributed(self.radius, ranks))

    @classmethod
    def of(
        cls, discs: Discs, owned: NDArray[np.int64], ranks: Ranks
    ) -> DistributedDiscs:
        """Return the discs of this rank, selected from all discs of a QP.

        discs : all discs, with global numbers of components
        owned : (o,) global numbers of the components on this rank, ascending

        Raises
        ------
        ValueError
            If this rank has some, but not all, of the components of a disc.

        """
        is_owned = np.isin(discs.index, owned)
        here = is_owned.all(axis=1)
        split = np.flatnonzero(is_owned.any(axis=1) & ~here)
        if split.size:
            raise ValueError(
                f"the components {discs.index[split[0]].tolist()} of a disc are on "
                "several ranks; expected all components of a disc on one rank"
            )
        index = np.searchsorted(owned, discs.index[here])
        return cls(index, distributed(discs.radius[here], ranks))
