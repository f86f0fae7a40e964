"""Schedule of blocks: order and resumption."""

from dataclasses import replace

import numpy as np
import pytest

from mortarbench.harness import Verdict
from mortarbench.harness.names import assemble
from mortarbench.harness.plugin import Family
from mortarbench.harness.registry import SolverSpec
from mortarbench.harness.running.pairs import paired_ratio
from mortarbench.harness.running.schedule import Schedule
from mortarbench.harness.suite.parameter_grid import Growth
from mortarbench.harness.suite.suite import Suite


class Squares(Family):
    name, defaults, forms = "f", {"n": 1}, ("p",)

    def build(self, form, params, reference):
        raise AssertionError("it is only named, never run")


def cases_of(*sizes):
    return tuple(assemble(Squares(), {"n": n}, "p") for n in sizes)


class Quiet:
    def __init__(self):
        self.skipped = 0
        self.said = []

    def advance(self, record):
        self.skipped += 1

    def say(self, text):
        self.said.append(text)


def schedule_of(**changes):
    """Return a schedule of one case, three repeats and solvers a and b; `changes`
    replaces fields of its suite.
    """
    suite = Suite(
        name="s", tolerances=(1e-6,), repeats=3, time_limit=1.0, memory_limit=1.0,
        solvers=tuple(SolverSpec(name=s, label=s) for s in "ab"),
        cases=cases_of(1), text="",
    )  # fmt: skip
    suite = replace(suite, **changes)
    return Schedule(
        suite=suite, environment="e", progress=Quiet(),
        options={s.label: {} for s in suite.solvers},
    )  # fmt: skip


def test_the_order_of_a_block_is_reversed_in_the_next():
    """Mean positions of solvers are equal; pairs of blocks have random orders."""
    solvers = tuple(SolverSpec(name=s, label=s) for s in "abcdef")
    blocks = list(schedule_of(solvers=solvers, repeats=6).blocks())
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
            schedule.add(record.replace(verdict=verdict, total_seconds=1.0))

    assert (asked.count("a"), asked.count("b")) == (1, 3)


def test_a_case_that_cannot_be_built_is_omitted_from_later_blocks():
    cases = cases_of(1, 2)
    schedule = schedule_of(cases=cases)
    blocks = schedule.blocks()
    failed = next(blocks)

    assert schedule.give_up(failed)
    assert not schedule.give_up(failed)  # the case was given up before
    assert [b.cases for b in blocks] == 3 * [("f/n=2/p",)]


def test_each_block_is_announced_before_it_starts():
    schedule = schedule_of(repeats=2)
    list(schedule.blocks())

    assert schedule.progress.said == [
        "f/p, tol 1e-06, repeat 1",
        "f/p, tol 1e-06, repeat 2",
    ]


def test_each_part_of_a_block_has_its_own_number():
    schedule = schedule_of()
    first = next(schedule.blocks()).number
    numbers = [schedule.block_of_part(*key) for key in ((0, 1), (0, 2), (1, 1))]

    assert len({first, *numbers}) == 4
    assert schedule.block_of_part(0, 2) == numbers[1]
    assert next(schedule.blocks()).number not in numbers


def test_the_paired_interval_has_its_nominal_coverage():
    rng = np.random.default_rng(314159)
    hits = 0
    for _ in range(2000):
        # drift of the machine, which affects whole blocks
        drift = np.exp(rng.standard_normal(8))
        a, b = (drift * np.exp(0.1 * rng.standard_normal(8)) * s for s in (3.0, 1.0))
        r = paired_ratio(dict(enumerate(a)), dict(enumerate(b)))
        hits += r.low <= 3.0 <= r.high

    assert hits / 2000 == pytest.approx(0.95, abs=0.015)


def test_only_common_blocks_are_compared():
    r = paired_ratio({0: 2.0, 1: 8.0, 5: 1e9}, {0: 1.0, 1: 4.0, 7: 1e-9})

    assert (r.value, r.pairs) == (pytest.approx(2.0), 2)
    assert paired_ratio({0: 1.0}, {0: 1.0}) is None


def test_the_first_answer_that_is_not_verified_ends_a_growing_series():
    """Solver a ends at n = 2 in its first repeat; b declines n = 1 and continues."""
    small, middle, large = cases = cases_of(1, 2, 3)
    growing = {
        small.name: Growth("", small),
        middle.name: Growth(small.name, small),
        large.name: Growth(middle.name, small),
    }
    verdicts = {
        ("a", middle.name): Verdict.TIME_LIMIT, ("b", small.name): Verdict.DECLINED
    }  # fmt: skip
    schedule = schedule_of(cases=cases, growing=growing)
    made = []
    for block in schedule.blocks():
        assert block.warm_up["name"] == small.name
        for (record,) in block.turns:
            verdict = verdicts.get((record.solver, record.case), Verdict.VERIFIED)
            made.append((record.solver, record.case, record.repeat))
            schedule.add(record.replace(verdict=verdict))

    count = {(s, c.name): sum(m[:2] == (s, c.name) for m in made)
             for s in "ab" for c in cases}  # fmt: skip
    assert count == {
        ("a", small.name): 3, ("a", middle.name): 1, ("a", large.name): 0,
        ("b", small.name): 1, ("b", middle.name): 3, ("b", large.name): 3,
    }  # fmt: skip
