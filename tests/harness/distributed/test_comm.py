"""Ranks that work together, and rank 0 that leads, with threads as ranks."""

import numpy as np
import pytest

from mortarbench.harness import InputError
from mortarbench.harness.distributed import comm as module
from mortarbench.harness.distributed.comm import RankFailedError, Team
from tests.support.threads_comm import on_rank_0, on_ranks, results_of


class Numbers:
    """An array on each rank."""

    def __init__(self, own, other=None):
        self.own, self.other = own, other

    def scaled(self, factor, shift=0.0):
        if np.isnan(factor):
            raise ValueError("no factor")
        return factor * self.own + shift

    def shifted(self, part):
        return part + self.own[0]

    def failing_on(self, value):
        if self.own[0] == value:
            raise ValueError("no number")
        return self.own

    def others(self):
        return self.other.own.tolist()


def numbered(team):
    """Place the array (r, r, r) on each rank r."""
    return team.place(Numbers, [np.full(3, float(r)) for r in range(team.comm.size)])


@pytest.mark.parametrize("size", [1, 2, 3])
def test_parts_lists_and_sums_arrive(size):
    def work(comm):
        own = comm.scatter(None if comm.rank else [10 * r for r in range(size)])
        return comm.sum(np.full(4, comm.rank + 1.0)), comm.gather(comm.rank), own

    found = results_of(size, work)

    assert found[0][0].tolist() == [size * (size + 1) / 2] * 4
    assert [ranks for _, ranks, _ in found] == [list(range(size)), *[[]] * (size - 1)]
    assert [own for *_, own in found] == [10 * r for r in range(size)]


def works_together(team):
    """Use every operation of a team; return its results and those expected."""
    size, numbers = team.comm.size, numbered(team)
    x = np.arange(3.0)
    ends = [2 * r for r in range(size + 1)]
    v = np.arange(2.0 * size, dtype=np.longdouble)
    pairs = team.place(Numbers, [x] * size, numbers)
    return [
        (numbers.total("scaled", 2.0, x).tolist(),
         (size * x + size * (size - 1)).tolist()),
        (numbers.apply("shifted", v, ends).tolist(),
         (v + np.repeat(np.arange(size), 2)).tolist()),
        ([part.tolist() for part in numbers("scaled", 1.0)],
         [[float(r)] * 3 for r in range(size)]),
        (pairs("others"), [[float(r)] * 3 for r in range(size)]),
    ]  # fmt: skip


@pytest.mark.parametrize("size", [2, 3])
def test_rank_0_uses_objects_with_parts_on_all_ranks(size):
    for found, expected in on_rank_0(size, works_together):
        assert found == expected


def test_one_process_is_a_team_of_one_rank():
    for found, expected in works_together(Team()):
        assert found == expected


def test_parts_are_freed_with_their_object():
    def work(team):
        numbers, other = numbered(team), numbered(team)
        del numbers
        other("scaled", 1.0)
        return len(team._parts)

    assert on_rank_0(2, work) == 2  # the service, and `other`


def test_an_exception_on_one_rank_is_raised_on_all_ranks():
    def work(comm):
        return comm.together(lambda: 1 // (1 - comm.rank))

    found = on_ranks(3, work)

    assert {type(e) for e in found} == {RankFailedError}
    assert {str(e) for e in found} == {
        "rank 1 of 3: ZeroDivisionError: integer division or modulo by zero"
    }


def test_an_exception_of_all_ranks_is_raised_as_it_is():
    def refuse():
        raise InputError("S=0; expected a positive number")

    found = on_ranks(2, lambda comm: comm.together(refuse))

    assert [type(e) for e in found] == [InputError] * 2


def test_ranks_that_succeed_return_their_own_results():
    assert results_of(3, lambda comm: comm.together(lambda: comm.rank)) == [0, 1, 2]


def test_an_error_of_all_ranks_is_raised_as_it_is():
    def work(team):
        with pytest.raises(ValueError, match=r"^no factor$"):
            numbered(team).total("scaled", np.nan)
        return True

    assert on_rank_0(2, work)


def test_an_error_of_a_rank_for_which_others_wait_ends_all_ranks(monkeypatch, capfd):
    """Rank 0 waits in another exchange, for which rank 1 never arrives."""
    monkeypatch.setattr(module, "PEER_TIMEOUT", 0.1)

    def work(comm):
        return comm.together(lambda: 1 // 0) if comm.rank else comm.gather(0)

    found = on_ranks(2, work)

    assert all(isinstance(e, BaseException) for e in found)
    assert "ZeroDivisionError" in capfd.readouterr().err


@pytest.mark.parametrize("rank", [0, 1, 2])
def test_no_rank_waits_for_the_result_of_a_rank_that_fails(rank):
    def work(team):
        numbers = numbered(team)
        with pytest.raises(RankFailedError, match=f"rank {rank} of 3: ValueError: no"):
            numbers.total("failing_on", rank)
        return numbers.total("scaled", 10.0).tolist()

    assert on_rank_0(3, work) == [30.0] * 3
