"""Schedule of blocks: order and resumption."""

from collections import Counter
from dataclasses import dataclass
from typing import ClassVar

import pytest

from mortarbench.harness import Verdict
from mortarbench.harness.names import assemble
from mortarbench.harness.plugin import Family
from mortarbench.harness.running.schedule import Schedule
from tests.support.suites import suite_of


@dataclass(frozen=True)
class Squares(Family):
    forms: ClassVar = ("p",)
    n: int = 1
    kind: str = "soft"

    def build(self, form, reference):
        raise AssertionError("it is only named, never run")


def cases_of(*sizes):
    return tuple(assemble("f", Squares(), {"n": n}, "p") for n in sizes)


class Quiet:
    def __init__(self):
        self.skipped = 0
        self.said = []

    def advance(self, record):
        self.skipped += 1

    def say(self, text):
        self.said.append(text)


def schedule_of(*solvers, **changes):
    """Return a schedule of one case, three repeats and solvers a and b; `changes`
    replaces parts of its suite.
    """
    suite = suite_of(
        *(solvers or "ab"),
        **{"name": "s", "repeats": 3, "cases": cases_of(1)} | changes,
    )
    return Schedule(
        suite=suite, environment="e", progress=Quiet(),
        options={s.label: {} for s in suite.solvers},
    )  # fmt: skip


def test_the_order_of_a_block_is_reversed_in_the_next():
    """Mean positions of solvers are equal; pairs of blocks have random orders."""
    blocks = list(schedule_of(*"abcdef", repeats=6).blocks())
    orders = ["".join(turn[0].solver for turn in b.turns) for b in blocks]

    assert [order[::-1] for order in orders[::2]] == orders[1::2]
    assert {"".join(sorted(order)) for order in orders} == {"abcdef"}
    assert len(set(orders)) == 6


def records_of(blocks):
    return [record for block in blocks for turn in block.turns for record in turn]


def test_a_resumed_run_measures_only_missing_measurements():
    """Test every number of earlier measurements; block numbers stay distinct."""
    suite = dict(
        tolerances=(1e-4, 1e-6), repeats=2,
        cases=cases_of(1, 2),
    )  # fmt: skip
    every = records_of(schedule_of(**suite).blocks())
    assert len({r.run_id for r in every}) == schedule_of(**suite).cells == 2 * 2 * 2 * 2

    for done in range(len(every) + 1):
        resumed = schedule_of(**suite)
        for record in every[:done]:
            resumed.add(record)
        left = records_of(resumed.blocks())
        assert {r.run_id for r in left} == {r.run_id for r in every[done:]}
        assert len(left) + resumed.progress.skipped == resumed.cells
        first = max((r.block for r in every[:done]), default=-1) + 1
        numbers = sorted({r.block for r in left})
        assert numbers == list(range(first, first + len(numbers)))


def test_a_declined_case_is_not_offered_again():
    schedule = schedule_of()
    asked = []
    for block in schedule.blocks():
        for (record,) in block.turns:
            asked.append(record.solver)
            verdict = Verdict.DECLINED if record.solver == "a" else Verdict.VERIFIED
            schedule.add(record.replace(status=verdict, total_seconds=1.0))

    assert (asked.count("a"), asked.count("b")) == (1, 3)


def test_a_case_that_cannot_be_built_is_omitted_from_later_blocks():
    cases = cases_of(1, 2)
    schedule = schedule_of(cases=cases)
    blocks = schedule.blocks()
    failed = next(blocks)

    assert schedule.give_up(failed)
    assert not schedule.give_up(failed)  # the case was given up before
    assert [b.cases for b in blocks] == 3 * [("f/n=2/p",)]


@pytest.mark.parametrize(
    ("sizes", "last"), [((10, 20, 30, 40), 0), ((10, 10, 10, 10), 3), ((20, 10, 5), 3)]
)
def test_beyond_a_limit_only_larger_cases_are_skipped(sizes, last):
    """Solver a hits the time limit at n = 2; b hits an iteration limit.

    sizes : number of variables of the cases n = 1, 2, …
    last : number of measurements of a at each n > 2
    """
    cases = cases_of(*range(1, len(sizes) + 1))
    names = [case.name for case in cases]
    schedule = schedule_of(cases=cases)
    made = Counter()
    for block in schedule.blocks():
        for (record,) in block.turns:
            n = names.index(record.case) + 1
            verdict = Verdict.ITERATION_LIMIT
            if record.solver == "a":
                verdict = Verdict.TIME_LIMIT if n == 2 else Verdict.VERIFIED
            made[record.solver, n] += 1
            filled = {"variables": sizes[n - 1]}
            schedule.add(record.replace(status=verdict, sizes=filled))

    assert [made["b", n + 1] for n in range(len(sizes))] == [3] * len(sizes)
    assert [made["a", n + 1] for n in range(len(sizes))] == [
        3, 3, *[last] * (len(sizes) - 2)
    ]  # fmt: skip


def test_a_limit_at_one_setting_does_not_skip_another_setting():
    """The sizes n = 1, 2, 3 of two kinds are independent, as are tolerances."""
    hard = [assemble("f", Squares(), {"n": n, "kind": "hard"}, "p") for n in (1, 2, 3)]
    cases = (*cases_of(1, 2, 3), *hard)
    names = [case.name for case in cases]
    schedule = schedule_of(cases=cases, tolerances=(1e-3, 1e-6))
    made = Counter()
    for block in schedule.blocks():
        for (record,) in block.turns:
            n = names.index(record.case) + 1
            at = (record.solver, n, record.tol)
            verdict = Verdict.MEMORY_LIMIT if at == ("a", 2, 1e-6) else Verdict.VERIFIED
            made[at] += 1
            schedule.add(record.replace(status=verdict, sizes={"variables": n}))

    assert [made["a", n, 1e-6] for n in range(1, 7)] == [3, 3, 0, 3, 3, 3]
    assert [made["a", n, 1e-3] for n in range(1, 7)] == [3] * 6
