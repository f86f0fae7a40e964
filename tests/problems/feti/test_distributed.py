"""Who forms the blocks of which kind."""

from contextlib import nullcontext
from types import SimpleNamespace

import numpy as np

from problems.feti.distributed import AFTER_FACTOR, Forming, Halo, forming, meanwhile


def loads(work):
    """Say what each rank does, if all do what `forming` says."""
    done = np.zeros(len(work))
    for name, task in forming(work).items():
        size = work[task.factor][name]
        done[task.factor] += (1 - AFTER_FACTOR) * size
        done[task.blocks] += AFTER_FACTOR * size
    return done


def test_of_an_odd_number_of_equal_kinds_two_ranks_do_half_each():
    kinds = dict.fromkeys("abcdefghi", 4)

    assert loads([kinds, kinds]).tolist() == [18, 18]
    factors = [task.factor for task in forming([kinds, kinds]).values()]
    assert sorted(np.bincount(factors)) == [4, 5]


def test_blocks_fill_the_time_until_factors_are_given_away():
    tasks = forming([dict.fromkeys("abcdefghi", 4)] * 2)
    factors = np.bincount([task.factor for task in tasks.values()])
    more, less = factors.argmax(), factors.argmin()

    assert meanwhile(tasks, more) == 0
    assert meanwhile(tasks, less) == 3  # blocks take a third of a factor


def test_a_kind_of_one_rank_alone_takes_its_factor_meanwhile_too():
    tasks = {
        "a": Forming(8, [0, 1], factor=0, blocks=1),  # whose factor takes 6
        "b": Forming(4, [1], factor=1, blocks=1),
        "c": Forming(4, [1], factor=1, blocks=1),
        "d": Forming(40, [0], factor=0, blocks=0),  # which nobody waits for
    }

    assert meanwhile(tasks, 1) == 1
    assert meanwhile(tasks, 0) == 0


def test_only_ranks_that_have_a_kind_do_anything_for_it():
    tasks = forming([{"a": 8, "b": 8}, {"b": 8}, {"c": 40}])

    assert tasks["a"] == (8, [0], 0, 0)
    assert tasks["b"] == (8, [0, 1], 1, 1)
    assert tasks["c"] == (40, [2], 2, 2)
    assert [meanwhile(tasks, rank) for rank in range(3)] == [1, 1, 1]


def test_one_rank_does_all():
    assert loads([{"a": 3, "b": 5}]).tolist() == [8]


def test_nobody_gets_more_to_do_than_who_gives_it_away():
    rng = np.random.default_rng(7)
    for _ in range(200):
        names = rng.permutation(12)
        size = rng.integers(1, 50, 12)
        work = [
            {str(k): int(size[k]) for k in names[: rng.integers(1, 13)]}
            for _ in range(rng.integers(1, 5))
        ]
        tasks = forming(work)
        whole = np.zeros(len(work))
        for name, task in tasks.items():
            assert {task.factor, task.blocks} <= set(task.have)
            whole[task.factor] += work[task.factor][name]
        assert set(tasks) == set().union(*work)
        assert loads(work).max() <= whole.max()


def test_what_several_neighbours_return_for_one_row_is_added_up():
    """Row 0 was lent to both neighbours, rows 2 and 1 to one each."""
    arriving = np.array([1.0, 10.0, 100.0, 1000.0])
    at = Halo(
        ranks=SimpleNamespace(
            clocked=lambda name: nullcontext(),
            exchange=lambda *what: lambda: arriving,
        ),
        rows=np.arange(3), own=np.arange(3), lent=np.array([0, 2, 0, 1]),
        borrowed=np.zeros(0, dtype=np.int64), lends=np.array([0, 2, 2]),
        borrows=np.zeros(3, dtype=np.int64),
    )  # fmt: skip
    assert at.added(np.array([0.5, 0.25, 0.125])).tolist() == [101.5, 1000.25, 10.125]
