"""Distributed vectors on ranks that are threads, compared with whole vectors."""

from types import SimpleNamespace

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.sparse import csr_array

from mortarbench.harness.distributed import vectors
from mortarbench.harness.distributed.vectors import (
    PARTS,
    DistributedColumns,
    DistributedQP,
    DistributedVector,
    Ranks,
    distributed,
)
from tests.support import on_ranks
from tests.support.threads import on_threads


@pytest.mark.parametrize("size", [1, 2, 3])
def test_reductions_are_those_of_the_whole_and_slices_alone_are_refused(size):
    for found in on_threads(size, on_ranks.vectors):
        assert found["answered"] == []
        assert found["kept"]
        for name, (got, known) in found["pairs"].items():
            assert got == pytest.approx(known, abs=1e-12), name


@pytest.mark.parametrize("count", [1, 64, 65, 300])
def test_a_total_is_the_sum_in_the_order_of_the_ranks(count):
    """Few numbers are gathered, many are reduced; each operation is counted once."""

    def work(ranks):
        part = np.arange(count) + 0.1 * 10.0**ranks.rank
        return ranks.total(part), ranks.counts["reductions"]

    for total, reductions in on_threads(3, work):
        assert total == pytest.approx(3 * np.arange(count) + 11.1, rel=1e-15)
        assert reductions == 1


def test_short_arrays_are_gathered_with_equal_rounding_on_all_ranks(monkeypatch):
    """MPI may sum in any order, whereas gathered numbers are summed in a
    fixed order.
    """
    assert vectors.MAX_ORDERED_SUM >= 1
    reduced = []
    ranks = Ranks(
        SimpleNamespace(
            size=1, rank=0,
            Allgather=lambda part, parts: np.copyto(parts, part),
            Allreduce=lambda part, found: (reduced.append(part.size),
                                           np.copyto(found, part)),
        )
    )  # fmt: skip
    for count in (1, vectors.MAX_ORDERED_SUM, vectors.MAX_ORDERED_SUM + 1):
        assert (ranks.total(np.ones(count)) == 1).all()
    assert reduced == [vectors.MAX_ORDERED_SUM + 1]


def test_neighbours_exchange_consecutive_parts_and_count_what_they_send():
    """Rank p sends p + r numbers, 100 p + 10 r + i, to every other rank r."""

    def work(ranks):
        p = ranks.rank
        others = [r for r in range(3) if r != p]
        sizes = np.array([p + r if r != p else 0 for r in range(3)])
        out = np.concatenate(
            [100 * p + 10 * r + np.arange(p + r) for r in others]
        ).astype(float)
        came = ranks.exchange(out, sizes, sizes)()
        known = np.concatenate([100 * r + 10 * p + np.arange(p + r) for r in others])
        return came.tolist() == known.tolist(), dict(ranks.counts)

    found = on_threads(3, work)
    assert all(same for same, _ in found)
    for p, (_, counts) in enumerate(found):
        numbers = sum(p + r for r in range(3) if r != p)
        assert counts == {"reductions": 0, "messages": 2, "bytes": 8 * numbers}


def test_ranks_without_neighbours_send_nothing_and_wait_for_nothing():
    def work(ranks):
        none = np.zeros(1, dtype=np.int64)
        return ranks.exchange(np.zeros(0), none, none)().size, ranks.counts["messages"]

    assert on_threads(1, work) == [(0, 0)]


@pytest.fixture
def ticking(monkeypatch):
    """Replace the clock by a clock that the test sets."""
    clock = SimpleNamespace(now=0.0)
    monkeypatch.setattr(vectors, "perf_counter", lambda: clock.now)
    return clock


def test_parts_of_the_time_do_not_overlap(ticking):
    """A block of products takes 2 s before and 1 s after a nested wait of 4 s."""
    ranks = Ranks(SimpleNamespace(size=1, rank=0))
    assert set(ranks.seconds) == set(PARTS)
    assert set(ranks.seconds.values()) == {0.0}
    ticking.now = 10.0
    with ranks.clocked("coarse"):
        ticking.now += 8.0
    with ranks.clocked("products"):
        ticking.now += 2.0
        with ranks.clocked("waiting"):
            ticking.now += 4.0
        ticking.now += 1.0
    assert ranks.seconds == {
        "products": 3.0, "waiting": 4.0, "coarse": 8.0, "exchange": 0.0,
    }  # fmt: skip
    ranks.counts["bytes"] = 5
    ranks.clear()
    assert set(ranks.seconds.values()) == {0}
    assert ranks.counts == {"reductions": 0, "messages": 0, "bytes": 0}


def test_waiting_for_other_ranks_is_recorded_as_waiting(ticking):
    class Slow:
        size, rank = 2, 0

        def Allgather(self, part, parts):
            ticking.now += 1.0
            parts[...] = part

        def Allreduce(self, part, found):
            ticking.now += 10.0
            found[...] = part

        def allgather(self, value):
            ticking.now += 100.0
            return [value, value]

        def Irecv(self, array, source):
            return SimpleNamespace(Wait=self.wait)

        def Isend(self, array, dest):
            return SimpleNamespace(Wait=lambda: None)

        def wait(self):
            ticking.now += 1000.0

    ranks, one = Ranks(Slow()), np.array([0, 1])
    ranks.extreme(1.0, np.max)
    ranks.total(np.ones(1000))
    DistributedColumns(csr_array(np.eye(2)), ranks).gram()
    ranks.exchange(np.ones(1), one, one)()
    assert ranks.seconds["waiting"] == 1111.0
    assert ranks.seconds["coarse"] == 0.0


def test_columns_over_ranks_multiply_as_the_whole_matrix():
    rng = np.random.default_rng(2)
    G, x, y, s = (rng.standard_normal(n) for n in ((4, 9), 9, 4, 4))
    free = x > 0
    slices = (slice(0, 2), slice(2, 2), slice(2, 9))

    def work(ranks):
        own = slices[ranks.rank]
        part = DistributedColumns(csr_array(G[:, own]), ranks)
        v = distributed(x[own], ranks)
        assert part.shape == (4, own.stop - own.start)
        some = np.array([3, 1])
        for got, known in (
            (part @ v, G @ x),
            (abs(part) @ v, abs(G) @ x),
            (part.scaled(s) @ v, s * (G @ x)),
            (part[some] @ v, (G @ x)[some]),
            (part.T @ y, (G.T @ y)[own]),
            (part.gram().toarray(), G @ G.T),
            (part.gram(free[own]).toarray(), G[:, free] @ G[:, free].T),
        ):
            assert_allclose(np.asarray(got), known, atol=1e-13)
        return type(part.T @ y)

    assert on_threads(3, work) == [DistributedVector] * 3


def test_elementwise_operations_act_on_local_slices_and_keep_the_ranks():
    """The argument `out` may be a distributed vector."""
    x = np.arange(6.0)

    def work(ranks):
        own = slice(3 * ranks.rank, 3 * ranks.rank + 3)
        v, out = distributed(x[own], ranks), distributed(np.empty(3), ranks)
        assert np.add(v, 1.0, out=out) is not None
        assert (np.asarray(out) == x[own] + 1).all()
        for w, known in ((v + 2 * x[own], 3 * x[own]), (v * x[own], x[own] ** 2)):
            assert type(w) is DistributedVector
            assert w.ranks is ranks
            assert (np.asarray(w) == known).all()
        assert type(v[1:]) is DistributedVector
        assert v[1:].ranks is ranks
        return True

    assert all(on_threads(2, work))


def test_functions_that_are_neither_elementwise_nor_reductions_are_refused():
    def work(ranks):
        v = distributed(np.arange(3.0), ranks)
        for ask in (
            lambda: np.linalg.norm(v, 1),
            lambda: np.linalg.norm(v, ord=np.inf),
            lambda: np.multiply.reduce(v),
            lambda: np.add.accumulate(v),
            lambda: np.multiply.outer(v, v),
        ):
            with pytest.raises(TypeError, match="distributed vector"):
                ask()
        return float(np.linalg.norm(v))

    assert on_threads(2, work) == pytest.approx([np.sqrt(10)] * 2)


def test_sizes_of_an_emitted_qp_are_those_of_the_whole():
    emitted = DistributedQP(
        variables=7, equality_rows=3, bounds=2, share=None, digest=None, answer=None
    )
    assert emitted.sizes == {
        "variables": 7, "equalities": 3, "inequalities": 0, "bounds": 2,
    }  # fmt: skip
