"""When there are enough blocks, and how sure one is of a ratio of times."""

from dataclasses import replace

import numpy as np
import pytest

from mortarbench.harness import Verdict
from mortarbench.harness.names import assemble
from mortarbench.harness.plugin import Family
from mortarbench.harness.registry import SolverSpec
from mortarbench.harness.running.pairs import paired_ratio, widest
from mortarbench.harness.running.schedule import Schedule
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


def planned(**changes):
    """Plan three repeats of one case by the solvers a and b, but for the changes."""
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


def carried_out(noise, *, seed=271828, verdict=Verdict.VERIFIED, **changes):
    """Carry out a suite whose measured times are 1, 2 and 4 s but for some noise."""
    rng = np.random.default_rng(seed)
    schedule = planned(**changes)
    made = []
    for block in schedule.blocks():
        for (record,) in block.turns:
            seconds = {"a": 1.0, "b": 2.0, "c": 4.0}[record.solver]
            seconds *= float(np.exp(noise * rng.standard_normal()))
            record = record.replace(verdict=verdict, total_seconds=seconds)
            schedule.note(record)
            made.append(record)
    assert len(made) + schedule.progress.skipped == schedule.cells
    return made


def test_who_was_first_in_a_block_is_last_in_the_next():
    """So no place in a block favours anybody; pairs of blocks differ by chance."""
    solvers = tuple(SolverSpec(name=s, label=s) for s in "abcdef")
    blocks = list(planned(solvers=solvers, repeats=6).blocks())
    orders = ["".join(turn[0].solver for turn in b.turns) for b in blocks]

    assert [order[::-1] for order in orders[::2]] == orders[1::2]
    assert {"".join(sorted(order)) for order in orders} == {"abcdef"}
    assert len(set(orders)) == 6


def test_of_a_sequence_the_whole_is_compared():
    """Its steps are noisy, but what one takes longer the other takes less."""
    rng = np.random.default_rng(161803)
    steps = cases_of(1, 2)
    schedule = planned(cases=(), sequences=(steps,), precision=0.05, max_repeats=50)
    blocks = 0
    for block in schedule.blocks():
        blocks += 1
        for turn in block.turns:
            whole = {"a": 1.0, "b": 2.0}[turn[0].solver]
            part = whole * rng.uniform(0.2, 0.8)
            for record, seconds in zip(turn, (part, whole - part), strict=True):
                timed = record.replace(verdict=Verdict.VERIFIED, total_seconds=seconds)
                schedule.note(timed)

        assert block.is_sequence

    assert blocks == 3


def records_of(blocks):
    return [record for block in blocks for turn in block.turns for record in turn]


def test_a_resumed_run_measures_what_is_left_and_nothing_twice():
    """After every number of measurements; blocks keep their numbers apart."""
    suite = dict(
        tolerances=(1e-4, 1e-6), repeats=2,
        cases=cases_of(1, 2),
    )  # fmt: skip
    every = records_of(planned(**suite).blocks())
    assert len({r.run_id for r in every}) == planned(**suite).cells == 2 * 2 * 2 * 2

    for done in range(len(every) + 1):
        resumed = planned(**suite)
        for record in every[:done]:
            resumed.note(record)
        left = records_of(resumed.blocks())
        assert {r.run_id for r in left} == {r.run_id for r in every[done:]}
        assert len(left) + resumed.progress.skipped == resumed.cells
        first = max((r.block for r in every[:done]), default=-1) + 1
        numbers = sorted({r.block for r in left})
        assert numbers == list(range(first, first + len(numbers)))


def test_a_solver_that_declined_a_case_is_not_asked_again():
    schedule = planned()
    asked = []
    for block in schedule.blocks():
        for (record,) in block.turns:
            asked.append(record.solver)
            verdict = Verdict.DECLINED if record.solver == "a" else Verdict.VERIFIED
            schedule.note(record.replace(verdict=verdict, total_seconds=1.0))

    assert (asked.count("a"), asked.count("b")) == (1, 3)


def test_a_case_that_cannot_be_built_is_left_out_from_then_on():
    cases = cases_of(1, 2)
    schedule = planned(cases=cases)
    blocks = schedule.blocks()
    failed = next(blocks)

    assert schedule.give_up(failed)
    assert not schedule.give_up(failed)  # known by now
    assert [b.cases for b in blocks] == 3 * [("f/n=2/p",)]


def test_each_block_says_what_it_is_before_it_starts():
    schedule = planned(repeats=2)
    list(schedule.blocks())

    assert schedule.progress.said == [
        "f/p, tol 1e-06, repeat 1",
        "f/p, tol 1e-06, repeat 2",
    ]


def test_without_a_precision_there_are_the_repeats_of_the_suite():
    assert len(carried_out(0.5)) == 2 * 3


def test_quiet_times_are_enough_after_the_repeats_of_the_suite():
    assert len(carried_out(1e-4, precision=0.05)) == 2 * 3


@pytest.mark.parametrize("solvers", ["ab", "abc"])
def test_blocks_go_on_until_the_ratio_is_known_as_well_as_asked(solvers):
    specs = tuple(SolverSpec(name=s, label=s) for s in solvers)
    made = carried_out(0.1, solvers=specs, precision=0.05, max_repeats=200)
    times = {
        s: {r.repeat: r.total_seconds for r in made if r.solver == s} for s in solvers
    }
    before = {s: {k: v for k, v in t.items() if k < max(t)} for s, t in times.items()}

    assert len(solvers) * 3 < len(made) < len(solvers) * 200
    assert widest(times) <= 0.05 < widest(before)


def test_blocks_end_at_the_most_repeats_and_at_the_budget():
    assert len(carried_out(2.0, precision=0.01, max_repeats=7)) == 2 * 7
    spent = carried_out(0.1, precision=0.001, max_repeats=99, budget=30.0)

    assert 30 <= sum(r.total_seconds for r in spent) < 36


def test_what_has_no_time_spends_no_budget():
    """One solver fails, and has none; the others are told apart after many blocks."""
    specs = tuple(SolverSpec(name=s, label=s) for s in "abc")
    schedule = planned(solvers=specs, precision=1e-9, max_repeats=20, budget=30.0)
    rng = np.random.default_rng(271828)
    spent = 0.0
    for block in schedule.blocks():
        for (record,) in block.turns:
            if record.solver == "c":
                schedule.note(record.replace(verdict=Verdict.FAILED))
                continue
            seconds = float(rng.uniform(0.9, 1.1))
            spent += seconds
            schedule.note(
                record.replace(verdict=Verdict.VERIFIED, total_seconds=seconds)
            )

    assert 30 <= spent < 33


def test_parts_of_a_block_keep_a_number_each():
    schedule = planned()
    first = next(schedule.blocks()).number
    numbers = [schedule.number_of_part(*key) for key in ((0, 1), (0, 2), (1, 1))]

    assert len({first, *numbers}) == 4
    assert schedule.number_of_part(0, 2) == numbers[1]
    assert next(schedule.blocks()).number not in numbers


def test_solvers_that_fail_are_no_reason_to_go_on():
    assert len(carried_out(2.0, precision=0.01, verdict=Verdict.WRONG)) == 2 * 3


def test_the_paired_interval_covers_as_often_as_it_says():
    rng = np.random.default_rng(314159)
    hits = 0
    for _ in range(2000):
        drift = np.exp(rng.standard_normal(8))  # of the machine: whole blocks
        a, b = (drift * np.exp(0.1 * rng.standard_normal(8)) * s for s in (3.0, 1.0))
        r = paired_ratio(dict(enumerate(a)), dict(enumerate(b)))
        hits += r.low <= 3.0 <= r.high

    assert hits / 2000 == pytest.approx(0.95, abs=0.015)


def test_only_blocks_that_both_were_in_are_compared():
    r = paired_ratio({0: 2.0, 1: 8.0, 5: 1e9}, {0: 1.0, 1: 4.0, 7: 1e-9})

    assert (r.value, r.pairs) == (pytest.approx(2.0), 2)
    assert paired_ratio({0: 1.0}, {0: 1.0}) is None
