"""Regressions that fail a CI job: detection, and false alarms for equal runs."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.special import bdtrc

from mortarbench.harness import Record, Verdict
from mortarbench.reports.compare.changes import compare
from mortarbench.reports.compare.conclusions import verdict_lines
from mortarbench.reports.compare.regressions import CELLS, regressions
from mortarbench.reports.data.evidence import Evidence, arrange

SOLVERS = ("one", "two", "three")


def record(solver, case, repeat, seconds, **changes):
    defaults = dict(
        run_id=f"{solver}-{case}-{repeat}", case=f"box/n={case}/dual", family="box",
        params={"n": case}, form="dual", sizes={}, solver=solver, options={}, tol=1e-6,
        repeat=repeat, block=repeat, status=Verdict.VERIFIED, claimed="solved",
        total_seconds=seconds, environment="e",
    )  # fmt: skip
    return Record(**(defaults | changes))


def session(rng, name, *, draw, cases=8, repeats=4, slower=None, solvers=SOLVERS):
    """Return the records of a session.

    Slowdowns of the session, of a case or of a block affect all solvers alike.

    draw : function that returns logarithms with a scatter of about one tenth
    slower : factors by solver, or by solver and case
    """
    slower = slower or {}
    drift = draw(rng)
    made = []
    for case in range(cases):
        while_case = draw(rng)
        for repeat in range(repeats):
            while_block = draw(rng)
            for solver in solvers:
                factor = slower.get(solver, 1.0) * slower.get((solver, case), 1.0)
                noise = drift + while_case + while_block + 0.5 * draw(rng)
                seconds = 1e-3 * 2.0**case * factor * np.exp(noise)
                made.append(record(solver, case, repeat, seconds, session=name))
    return made


@pytest.fixture
def changed(tmp_path):
    def make(before, after):
        one, two = (
            Evidence(directory=tmp_path / n, records=arrange(r))
            for n, r in (("a", before), ("b", after))
        )
        return compare(one, two)

    return make


def normal(rng):
    return rng.normal(0, 0.1)


def heavy(rng):
    """Draw from Student's distribution with three degrees of freedom."""
    return 0.1 * rng.standard_t(3) / np.sqrt(3)


def skewed(rng):
    """Draw increases by about a tenth, and in one of twenty cases by about a half."""
    return rng.exponential(0.1) + 0.4 * (rng.random() < 0.05)


@pytest.mark.parametrize(
    ("draw", "shape"),
    [
        (skewed, (3, 2, 2)),
        pytest.param(normal, (8, 3, 3), marks=pytest.mark.slow),
        pytest.param(heavy, (10, 3, 2), marks=pytest.mark.slow),
    ],
)
def test_equal_runs_cause_alarms_in_at_most_five_percent(changed, draw, shape):
    """The number of alarms is consistent with an error probability of at most 5 %."""
    cases, repeats, solvers = shape
    rng = np.random.default_rng(662607)
    shape = dict(cases=cases, repeats=repeats, solvers=SOLVERS[:solvers])
    pairs = 40
    alarms = sum(
        bool(
            regressions(
                changed(
                    session(rng, "a", draw=draw, **shape),
                    session(rng, "b", draw=draw, **shape),
                )
            ).slower
        )
        for _ in range(pairs)
    )
    assert bdtrc(alarms - 1, pairs, 0.05) > 0.01  # P(at least as many by chance)


def test_only_the_solver_that_is_fifty_percent_slower_is_found(changed):
    rng = np.random.default_rng(314159)
    slower = session(rng, "b", draw=normal, slower={"two": 1.5})
    c = changed(session(rng, "a", draw=normal), slower)
    found = regressions(c)

    assert {one.solver for one in found.slower} == {"two"}
    over = next(one for one in found.slower if not one.case)
    assert over.relative.low < 1.5 < over.relative.high
    assert (found.solvers, found.cells) == (3, 24)
    said = "Slower, beyond chance and the machine: two 1."
    assert any(line.startswith(said) for line in verdict_lines(c))
    back = regressions(changed(slower, session(rng, "c", draw=normal))).slower
    assert "two" not in {one.solver for one in back}


def test_a_single_much_slower_case_is_found(changed):
    rng = np.random.default_rng(141421)
    after = session(rng, "b", draw=normal, slower={("two", 3): 4.0})
    found = regressions(changed(session(rng, "a", draw=normal), after)).slower

    assert [(one.solver, one.case) for one in found] == [("two", "box/n=3/dual")]


def test_a_slowdown_of_all_solvers_is_attributed_to_the_machine(changed):
    rng = np.random.default_rng(271828)
    twice = dict.fromkeys(SOLVERS, 2.0)
    c = changed(
        session(rng, "a", draw=normal), session(rng, "b", draw=normal, slower=twice)
    )
    assert not regressions(c).slower


def test_a_solver_is_not_slower_because_others_became_faster(changed):
    rng = np.random.default_rng(173205)
    faster = {"two": 0.3, "three": 0.3}
    c = changed(
        session(rng, "a", draw=normal), session(rng, "b", draw=normal, slower=faster)
    )
    assert not regressions(c).slower


def test_intervals_widen_with_the_number_of_compared_folders(changed):
    rng = np.random.default_rng(223606)
    after = session(rng, "b", draw=normal, slower={"two": 2.0})
    c = changed(session(rng, "a", draw=normal), after)
    one, many = (regressions(replace(c, folders=n)).slower[0] for n in (1, 10))

    assert many.relative.value == one.relative.value
    assert many.relative.low < one.relative.low
    assert many.ratio.high > one.ratio.high


def test_the_reason_is_reported_if_nothing_can_be_judged(changed, tmp_path):
    rng = np.random.default_rng(244948)

    def why(after_too=lambda made: made, **shape):
        before = session(rng, "a", draw=normal, **shape)
        found = regressions(
            changed(before, after_too(session(rng, "b", draw=normal, **shape)))
        )
        assert not found.slower
        return found.why_not

    def elsewhere(made):
        return [r.replace(environment="f") for r in made]

    assert why(solvers=("one",)).endswith("add a solver that does not change")

    def wrong(*solvers):
        def spoil(made):
            return [
                r.replace(status=Verdict.WRONG) if r.solver in solvers else r
                for r in made
            ]

        return spoil

    pair, b = ("one", "two"), tmp_path / "b"
    lacking = f"two has no verified answer in {b}: nothing to compare"
    assert why(wrong("two"), solvers=pair) == lacking
    assert why(wrong("two"), solvers=("two",)) == lacking
    assert why(wrong("two"), solvers=pair, repeats=1) == lacking
    assert why(repeats=1) == "no cell has two verified repeats in both folders"
    assert why(elsewhere) == "no cell was measured on equal machines in both folders"
    assert (
        why(cases=2) == f"no solver has 3 cases, and there are fewer than {CELLS} cells"
    )
    assert why(cases=3) == ""


def test_a_solver_without_a_verified_answer_is_named(changed, tmp_path):
    rng = np.random.default_rng(141421)
    before, after = (session(rng, name, draw=normal) for name in "ab")
    spoilt = [
        r.replace(status=Verdict.WRONG) if r.solver == "two" else r for r in after
    ]
    found = regressions(c := changed(before, spoilt))
    named = f"two has no verified answer in {tmp_path / 'b'}: nothing to compare"

    assert (found.solvers, found.why_not) == (2, "")
    assert found.unverified == (named,)
    assert any(named in line for line in verdict_lines(c))
    assert regressions(changed(before, after)).unverified == ()
