"""Distribution of subdomains over ranks by graph partitioning (METIS)."""

from __future__ import annotations

from itertools import product

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array

from mortarbench.harness import InputError
from mortarbench.harness.distributed.mpi import too_few_parts

#: work (or sizes) of the ranks count as balanced if the ratio of the maximum to the
#: mean is at most this value
MAX_IMBALANCE = 1.1
METIS_SEEDS = 12  #: number of random seeds tried for METIS
SIZE_WEIGHTS = (0.25, 0.5, 1.0)  #: trial weights of the size relative to the work


def balanced_partition(
    graph: csr_array,
    work: NDArray[np.int64],
    size: NDArray[np.int64],
    ranks: int,
) -> NDArray[np.int64]:
    """Partition S subdomains over ranks, balancing both work and size.

    METIS balances a single weight. The work is tried first. On graded half discs, where
    a few subdomains account for most of the work, the sizes are then out of balance. In
    such cases, several combinations of work and size are tried. A trial replaces the
    best partition so far if its work is balanced and its sizes are better balanced.

    Parameters
    ----------
    graph : (S, S) number of rows shared by each pair of subdomains
    work, size : (S,) work and size of each subdomain, each in an arbitrary unit

    Returns
    -------
    rank of each subdomain, (S,)

    Raises
    ------
    InputError
        If there are fewer subdomains than ranks.

    """
    if work.size < ranks:
        raise InputError(too_few_parts(work.size, ranks))
    if ranks == 1:
        return np.zeros(work.size, dtype=np.int64)
    graph = graph.copy()
    graph.setdiag(0)
    graph.eliminate_zeros()

    def uneven(weight: NDArray[np.int64], rank: NDArray[np.int64]) -> float:
        sums = np.bincount(rank, weight, minlength=ranks)
        return float(sums.max() / sums.mean())

    rank = _partitioned(graph, work // max(int(work.min()), 1), ranks)
    best = uneven(size, rank)
    for seed, share in product(range(METIS_SEEDS), SIZE_WEIGHTS):
        if best <= MAX_IMBALANCE:
            break
        weight = work / work.mean() + share * size / size.mean()
        other = _partitioned(graph, (weight / weight.min()).astype(int), ranks, seed)
        if uneven(work, other) <= MAX_IMBALANCE and uneven(size, other) < best:
            rank, best = other, uneven(size, other)
    return rank


def _partitioned(
    graph: csr_array, weight: NDArray[np.int64], ranks: int, seed: int | None = None
) -> NDArray[np.int64]:
    """Partition a graph with vertex weights (S,); return the rank of each vertex."""
    from pymetis import CSRAdjacency, Options, part_graph  # unused on a single rank

    _, labels = part_graph(
        ranks,
        CSRAdjacency(graph.indptr, graph.indices),
        eweights=graph.data,
        vweights=weight,
        recursive=True,
        options=Options() if seed is None else Options(seed=seed),
    )
    rank = np.array(labels, dtype=np.int64)
    # with few subdomains METIS may leave a rank empty
    for idle in np.setdiff1d(np.arange(ranks), rank):
        largest = np.bincount(rank, minlength=ranks).argmax()
        rank[np.flatnonzero(rank == largest)[-1]] = idle
    return rank
