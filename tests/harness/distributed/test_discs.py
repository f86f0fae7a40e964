"""Distributed discs: same operations as in one process, and one owner of each disc."""

import numpy as np
import pytest

from mortarbench.harness import Discs
from mortarbench.harness.distributed.discs import DistributedDiscs
from mortarbench.harness.distributed.vectors import distributed, single_process
from tests.support.threads import on_threads


def test_a_disc_on_two_ranks_is_refused():
    discs = Discs([[0, 1], [2, 3]], [1.0, 2.0])

    with pytest.raises(ValueError, match=r"components \[2, 3\] of a disc are on sev"):
        DistributedDiscs.of(discs, np.array([0, 1, 2]), single_process())


def test_every_split_of_a_disc_is_detected():
    """For random owners of components, some rank refuses if and only if a disc is
    split.
    """
    rng, ranks = np.random.default_rng(0), single_process()
    seen = set()
    for _ in range(400):
        d, k = rng.integers(2, 4), rng.integers(1, 4)
        components = rng.permutation(d * k + 3)
        discs = Discs(components[: d * k].reshape(k, d), rng.random(k))
        owner = rng.integers(2, size=components.size)
        if rng.random() < 0.5:
            owner[discs.index] = owner[discs.index[:, :1]]
        is_split = bool((owner[discs.index] != owner[discs.index[:, :1]]).any())
        refused, indices = False, []
        for rank in range(2):
            owned = np.flatnonzero(owner == rank)
            try:
                local = DistributedDiscs.of(discs, owned, ranks)
            except ValueError:
                refused = True
            else:
                indices += owned[local.index].tolist()
        assert refused == is_split
        if not is_split:
            assert sorted(indices) == sorted(discs.index.tolist())
        seen.add(is_split)
    assert seen == {True, False}


def test_operations_on_discs_of_ranks_are_those_of_one_process():
    """Rank 2 has no discs but takes part in every sum."""
    rng, n = np.random.default_rng(1), 12
    whole = Discs([[0, 1], [2, 3], [6, 7]], [0.3, 2.0, 0.0])
    x, z = rng.standard_normal((2, n))
    ends = (0, 4, 8, n)
    limits = whole.limits(x)

    def measured(ranks):
        owned = np.arange(ends[ranks.rank], ends[ranks.rank + 1])
        mine, one, force = (
            DistributedDiscs.of(whole, owned, ranks),
            distributed(x[owned], ranks),
            distributed(z[owned], ranks),
        )
        (own,) = mine.limits(one)
        (gap,) = mine.support_gaps(one, force, [own])
        return (
            own.slack.min(initial=np.inf),
            mine.support(force),
            np.abs(gap).max(initial=0.0),
            np.linalg.norm(mine.admissible(force)),
            np.linalg.norm(mine.project(one)),
            mine.normal_distances(one, force, 0.1).max(initial=0.0),
        )

    (gap,) = whole.support_gaps(x, z, limits)
    known = (
        limits[0].slack.min(),
        whole.support(z),
        np.abs(gap).max(initial=0.0),
        np.linalg.norm(whole.admissible(z)),
        np.linalg.norm(whole.project(x)),
        whole.normal_distances(x, z, 0.1).max(),
    )
    for rank in on_threads(3, measured):
        np.testing.assert_allclose(rank, known, rtol=1e-14)
