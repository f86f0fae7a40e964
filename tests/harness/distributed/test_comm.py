"""Ranks that work together, and rank 0 that leads, with threads as ranks."""

import numpy as np
import pytest

from mortarbench.harness import InputError
from mortarbench.harness.distributed import comm as module
from mortarbench.harness.distributed.comm import SERIAL, Lead, RankFailedError, led
from tests.support.threads_comm import on_ranks, results_of


class Numbers:
    """An array on each rank, with methods that all ranks call together."""

    def __init__(self, comm, own):
        self.comm, self.own, self.inner = comm, own, self

    def total(self, factor, shift):
        return self.comm.sum(factor * self.own + shift)

    def rank(self):
        return self.comm.rank

    def failing_on(self, rank):
        if self.comm.rank == rank:
            raise ValueError("no number")
        return self.comm.sum(self.own)


@pytest.mark.parametrize("size", [1, 2, 3])
def test_sums_and_lists_arrive_on_rank_0_and_broadcasts_everywhere(size):
    def work(comm):
        part = np.full(4, comm.rank + 1.0)
        whole = np.where(np.arange(size) == comm.rank, comm.rank + 1.0, 0.0)
        comm.fill(whole, [slice(rank, rank + 1) for rank in range(size)])
        assert comm.rank or whole.tolist() == list(range(1, size + 1))
        return (
            comm.sum(part),
            comm.gather(comm.rank),
            comm.bcast(comm.rank, size - 1),
        )

    found = results_of(size, work)

    assert found[0][0].tolist() == [size * (size + 1) / 2] * 4
    assert [ranks for _, ranks, _ in found] == [list(range(size)), *[[]] * (size - 1)]
    assert {last for _, _, last in found} == {size - 1}


def test_one_process_is_a_communicator_of_one_rank():
    assert SERIAL.sum(np.ones(2)).tolist() == [1, 1]
    assert SERIAL.gather(5) == [5]
    assert SERIAL.bcast(5) == 5
    assert SERIAL.together(lambda: 5) == 5
    numbers = Numbers(SERIAL, np.arange(3.0))
    assert (
        led(SERIAL, numbers, lambda: Lead(SERIAL, numbers)("total", 2.0, 1.0)[2]) == 5
    )


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


@pytest.mark.parametrize("size", [2, 3])
def test_the_result_of_rank_0_is_returned_on_all_ranks(size):
    """The others serve: each adds its part to every sum that rank 0 orders."""

    def work(comm):
        numbers = Numbers(comm, np.arange(3.0) + comm.rank)
        lead = Lead(comm, numbers)

        def first():
            once = lead("total", 2.0, np.ones(3))
            return once, lead("inner.total", 1.0, 0.0), lead("rank")

        # the service has ended; another one may follow
        return led(comm, numbers, first), led(comm, numbers, lambda: lead("rank"))

    own = [np.arange(3.0) + r for r in range(size)]
    for (once, inner, first), again in results_of(size, work):
        assert once.tolist() == (2 * sum(own) + size).tolist()
        assert inner.tolist() == sum(own).tolist()
        assert first == again == 0


def test_an_error_of_rank_0_is_raised_on_all_ranks():
    def work(comm):
        numbers = Numbers(comm, np.zeros(1))

        def fails():
            Lead(comm, numbers)("total", 1.0, 0.0)
            raise InputError("tol=-1; expected a positive number")

        with pytest.raises(InputError, match="tol=-1; expected a positive number"):
            led(comm, numbers, fails)
        return led(comm, numbers, lambda: "next")

    assert results_of(3, work) == ["next"] * 3


def test_an_error_of_a_rank_that_serves_ends_all_ranks(monkeypatch, capfd):
    """Rank 0 waits for the part of rank 1, which can never arrive."""
    monkeypatch.setattr(module, "PEER_TIMEOUT", 0.1)

    def work(comm):
        numbers = Numbers(comm, np.zeros(1))
        return led(comm, numbers, lambda: Lead(comm, numbers)("failing_on", 1))

    found = on_ranks(2, work)

    assert all(isinstance(e, BaseException) for e in found)
    assert "ValueError: no number" in capfd.readouterr().err


def test_an_error_of_a_rank_that_serves_is_raised_by_rank_0():
    """Rank 1 has sent its part of the sum, which must not meet the next sum."""

    class Late(Numbers):
        def failing_on(self, rank):
            if self.comm.rank == rank:
                raise ValueError("no number")
            return self.comm.sum(self.own) if self.comm.rank else None

    def work(comm):
        numbers = Late(comm, np.arange(2.0) + comm.rank)
        lead = Lead(comm, numbers)

        def call():
            with pytest.raises(RankFailedError, match="rank 0 of 2: ValueError: no"):
                lead("failing_on", 0)
            return lead("total", 10.0, 0.0)

        return led(comm, numbers, call)

    assert [found.tolist() for found in results_of(2, work)] == [[10, 30]] * 2


def test_the_objects_of_an_earlier_problem_are_refused():
    lead = Lead(SERIAL, None)
    with pytest.raises(RuntimeError, match="keep only the QP that they built last"):
        lead("total", 1.0, 0.0)


def test_an_error_of_all_ranks_in_a_service_is_that_of_rank_0():
    def work(comm):
        numbers = Numbers(comm, np.zeros(1))
        with pytest.raises(AttributeError, match="no attribute 'product'"):
            led(comm, numbers, lambda: Lead(comm, numbers)("product"))
        return True

    assert results_of(2, work) == [True, True]
