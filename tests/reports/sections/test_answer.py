"""Opening of the report: the fastest solver, if the measurements support the claim."""

import re
from functools import partial

import numpy as np
import pytest

from mortarbench.harness import InputError, Verdict
from mortarbench.harness.results.journal import Journal
from mortarbench.reports import answer, write_report
from mortarbench.reports.data.comparison_groups import all_groups, answers_of
from mortarbench.reports.data.evidence import Evidence, arrange
from mortarbench.reports.data.fastest import Finding, fastest_solvers
from mortarbench.reports.figures.fastest import fastest_figure
from mortarbench.reports.folder import compose
from mortarbench.reports.render.html_page import html
from mortarbench.reports.render.latex import latex
from mortarbench.reports.render.markdown import markdown
from tests.support.box_records import box_record

LIMIT = 5.0


@pytest.fixture
def record():
    return partial(box_record, environment="abc")


@pytest.fixture
def evidence(tmp_path):
    def make(records, **suite):
        given = {"time_limit": LIMIT} | suite
        return Evidence(directory=tmp_path, records=arrange(records), suite=given)

    return make


@pytest.fixture
def opened(evidence):
    """Return a function from records to the opening statements, by subject."""

    def make(records):
        first, second = compose(evidence(records)).sections[:2]
        assert first.name == "answer"
        found = [*first.statements, *second.statements * (second.name == "forms")]
        return {s.subject: s for s in found}

    return make


def found(evidence):
    return fastest_solvers(answers_of(evidence), all_groups(evidence))


def one_case(record, seed=1, blocks=6, case=0, **factors):
    """Return records of one case, in which slowdowns of blocks affect all solvers."""
    rng = np.random.default_rng(seed)
    slow = rng.lognormal(0, 0.3, blocks)
    return [
        record(s, case, 0.01 * factor * slow[i] * rng.lognormal(0, 0.02), i)
        for s, factor in factors.items()
        for i in range(blocks)
    ]


def many_cases(record, cases=8, seed=1, scatter=0.05, **factors):
    """Return records of cases of very different sizes, measured once each."""
    rng = np.random.default_rng(seed)
    return [
        record(s, k, 1e-3 * 2.0**k * factor * rng.lognormal(0, scatter))
        for s, factor in factors.items()
        for k in range(cases)
    ]


def ratio_in(text):
    """Return the first ratio in a text and its interval."""
    value, low, high = re.search(
        r"took (?:at least )?(\S+) \[(\S+), (\S+)\]", text
    ).groups()
    return float(value), float(low), float(high)


# ---- the fastest solver


@pytest.mark.parametrize("make", [one_case, many_cases])
def test_a_planted_winner_is_named_with_its_planted_ratio(record, opened, make):
    records = make(record, slow=2.0, fast=1.0, slowest=5.0)
    (claim,) = opened(records)["dual"].claims
    assert claim.startswith("fast was the fastest")
    assert "the next, slow, took" in claim
    value, low, high = ratio_in(claim)
    assert low < 2.0 < high
    assert value == pytest.approx(2.0, rel=0.1)
    assert "slowest" not in claim


@pytest.mark.parametrize("make", [one_case, many_cases])
def test_equal_solvers_tie_and_the_next_solver_is_named(record, opened, make):
    (claim,) = opened(make(record, a=1.0, b=1.0, slow=3.0))["dual"].claims
    assert claim.startswith("A tie")
    assert re.search(r"\b(a and b|b and a) do not differ significantly", claim)
    _, low, high = ratio_in(claim)
    assert low <= 1 <= high
    assert "the next, slow, took 3" in claim or "the next, slow, took 2.9" in claim


@pytest.mark.parametrize(
    ("logs", "why"),
    [
        # with one of six signs reversed, the sign-flip test is not significant
        ([0.3, 0.3, 0.3, 0.3, 0.3, -0.01], "b took 1.28 [0.990, 1.46] times as long"),
        # all signs agree, but the interval of the mean contains 0
        ([0.01, 0.01, 0.01, 0.01, 0.01, 3.0], "b took 1.66 [0.4"),
    ],
)
def test_a_winner_needs_both_the_interval_and_the_signs(record, opened, logs, why):
    records = [
        r for k, log in enumerate(logs)
        for r in (record("a", k, 0.01), record("b", k, 0.01 * np.exp(log)))
    ]  # fmt: skip
    (claim,) = opened(records)["dual"].claims
    assert claim.startswith("A tie over 6 cases at tol 1e-6: the times of a and b do")
    assert why in claim
    assert "more repeats may separate them (--repeats 9)" in claim


def test_few_solved_cases_have_no_ratio_over_cases(record, opened):
    """This occurs, for example, if more steps are requested than a sequence has."""
    records = [
        record(s, k, 0.01, **({} if k < 4 else {"status": Verdict.DECLINED}))
        for k in range(9) for s in "ab"
    ]  # fmt: skip
    (claim,) = opened(records)["dual"].claims
    assert "over 9 cases" not in claim
    assert "was the fastest" not in claim


@pytest.mark.parametrize(
    "cases", [2, *(pytest.param(n, marks=pytest.mark.slow) for n in (1, 7))]
)
def test_a_winner_among_equal_solvers_is_rarely_named(record, evidence, cases):
    rng = np.random.default_rng(cases)
    named = 0
    for _ in range(100):
        records = [
            record(s, case, 0.01 * rng.lognormal(0, 0.2), i)
            for case in range(cases) for s in "abcd" for i in range(4)
        ]  # fmt: skip
        named += found(evidence(records))[0].finding is Finding.FASTEST
    assert named <= 10  # at most 5 are expected; P(more than 10) is about 1 %


@pytest.mark.parametrize("make", [one_case, many_cases])
def test_a_fast_solver_with_refuted_claims_does_not_win(record, opened, make):
    lies = dict(status=Verdict.WRONG, claimed="solved", dual=0.03)
    liar = [r.replace(**lies) for r in make(record, liar=0.01)]
    statement = opened(make(record, honest=1.0, slow=2.0) + liar)["dual"]
    (claim,) = statement.claims
    assert claim.startswith("honest was the fastest")
    assert "liar" not in claim
    (failed,) = (text for text in statement.remarks if text.startswith("Failed"))
    assert "liar claimed success but was wrong on" in failed
    assert "(residual 3.0e-2, allowed 1.0e-5)" in failed
    assert "verdicts" in statement.evidence


def test_one_refuted_repeat_excludes_a_solver(record, opened):
    records = one_case(record, fast=0.1, honest=1.0, slow=2.0)
    records[3] = records[3].replace(status=Verdict.INACCURATE, dual=1e-3)
    statement = opened(records)["dual"]
    assert statement.claims[0].startswith("honest was the fastest")
    assert (
        "fast claimed success but was inaccurate on 1 of 1 case" in statement.remarks[0]
    )


def test_a_solver_that_fails_on_half_of_the_cases_is_not_the_fastest(record, opened):
    half = [
        r.replace(status=Verdict.ITERATION_LIMIT, claimed="iteration_limit")
        if r.params["n"] % 2 else r
        for r in many_cases(record, half=1e-4)
    ]  # fmt: skip
    statement = opened(many_cases(record, sure=1.0, slow=2.0) + half)["dual"]
    assert statement.claims[0].startswith("sure was the fastest over 8 cases")
    assert "half reached the iteration limit on 4 of 8 cases" in statement.remarks[0]


def test_faster_solvers_that_are_not_always_verified_are_named(record, opened):
    almost = many_cases(record, almost=0.5)
    almost[0] = almost[0].replace(status=Verdict.CRASHED)
    statement = opened(many_cases(record, sure=1.0, slow=2.0) + almost)["dual"]
    assert statement.claims[0].startswith("sure was the fastest over 8 cases")
    faster = statement.remarks[0]
    assert faster.startswith(
        "Faster, but not verified on every case, at tol 1e-6: almost (verified on 7 of "
        "8 cases"
    )
    value, low, high = re.search(r"(\S+) \[(\S+), (\S+)\] times", faster).groups()
    assert 0.4 < float(low) <= float(value) <= float(high) < 0.6
    assert float(value) == pytest.approx(0.5, rel=0.1)


def test_no_winner_is_named_if_every_solver_failed_on_some_case(record, opened):
    a, b = many_cases(record, a=1.0), many_cases(record, b=2.0)
    a[0] = a[0].replace(status=Verdict.TIME_LIMIT)
    b[5] = b[5].replace(status=Verdict.CRASHED, message="signal 11")
    b[6] = b[6].replace(status=Verdict.CRASHED, message="signal 11")
    statement = opened(a + b)["dual"]
    assert statement.claims == (
        "No solver is named the fastest over 8 cases at tol 1e-6: no solver was "
        "verified on all cases; a was verified on the largest number of cases "
        "(7 of 8).",
    )
    assert "b crashed on 2 of 8 cases (signal 11)" in statement.remarks[0]


def test_a_case_that_no_solver_solved_is_counted_separately(record, opened):
    records = [
        r.replace(status=Verdict.TIME_LIMIT) if r.params["n"] == 7 else r
        for r in many_cases(record, fast=1.0, slow=3.0)
    ]
    statement = opened(records)["dual"]
    assert statement.claims[0].startswith("fast was the fastest over 7 cases")
    assert "No solver solved 1 further case." in statement.remarks


def test_a_single_solver_is_not_compared(record, opened):
    (claim,) = opened(one_case(record, lonely=1.0))["dual"].claims
    assert claim.startswith("Only lonely was measured on the only case at tol 1e-6:")
    assert claim.endswith("there is no other solver to compare with.")


def test_the_only_verified_solver_is_not_named_the_fastest(record, opened):
    failed = [r.replace(status=Verdict.FAILED, message="gave up")
              for r in one_case(record, other=0.5)]  # fmt: skip
    (claim,) = opened(one_case(record, lonely=1.0) + failed)["dual"].claims
    assert "No solver is named the fastest" in claim
    assert claim.endswith(": only lonely was verified.")


@pytest.mark.parametrize("make", [one_case, many_cases])
def test_a_solver_that_reuses_answers_is_never_named_the_fastest(record, opened, make):
    """A single marked record suffices, also if its time is a hundredth."""
    cached = make(record, cached=0.01)
    cached[0] = cached[0].replace(remembered=True)
    honest = make(record, slow=3.0, fast=1.0)
    statement = opened(honest + cached)["dual"]

    assert statement.claims[0].startswith("fast was the fastest")
    assert "cached" not in statement.claims[0]
    assert statement.remarks[0].startswith(
        "Not compared, because answers of earlier solves are reused: cached."
    )

    fresh = [r.replace(remembered=False) for r in cached]
    statement = opened(honest + fresh)["dual"]
    assert statement.claims[0].startswith("cached was the fastest")


def test_the_only_solver_that_reuses_no_answers_is_not_the_fastest(record, opened):
    cached = [r.replace(remembered=True) for r in one_case(record, cached=0.01)]
    (claim,) = opened(one_case(record, lonely=1.0) + cached)["dual"].claims
    assert claim.endswith(": only lonely was verified without reusing answers.")

    both = [r.replace(remembered=True) for r in one_case(record, other=0.02)]
    (claim,) = opened(cached + both)["dual"].claims
    assert claim == "No answer was verified at tol 1e-6 without reusing answers."


def test_a_form_without_verified_answers_is_reported(record, opened):
    records = [
        r.replace(status=Verdict.ITERATION_LIMIT)
        for r in one_case(record, a=1.0, b=2.0)
    ]
    assert opened(records)["dual"].claims == ("No answer was verified at tol 1e-6.",)


def test_one_repeat_gives_advice_but_no_winner(record, opened):
    statement = opened(one_case(record, blocks=1, fast=1.0, slow=9.0))["dual"]
    (claim,) = statement.claims
    assert claim.startswith("fast had the smallest time on the only case at tol 1e-6")
    value = float(re.search(r"\(next: slow, about (\S+) times", claim)[1])
    assert value == pytest.approx(9, rel=0.1)
    assert "no solver is named the fastest: an interval needs at least two" in claim
    assert "two blocks of repeats (--repeats 9)" in claim


def test_results_on_few_cases_do_not_extend_to_other_cases(record, opened):
    records = [
        r for case in range(3)
        for r in one_case(record, seed=case, case=case, fast=1.0, slow=2.0 + case)
    ]  # fmt: skip
    statement = opened(records)["dual"]
    assert statement.claims[0].startswith("fast was the fastest on each of 3 cases")
    value, _, _ = ratio_in(statement.claims[0])
    assert "took at least" in statement.claims[0]
    assert value == pytest.approx(2.0, rel=0.1)  # the least of 2, 3 and 4
    assert (
        "With fewer than 6 cases, the result does not extend to other cases."
        in statement.remarks
    )


def test_different_winners_by_case_give_no_fastest_solver(record, opened):
    records = [
        *one_case(record, case=0, a=1.0, b=2.0),
        *one_case(record, case=1, a=2.0, b=1.0),
        *one_case(record, case=2, a=3.0, b=1.0),
    ]
    (claim,) = opened(records)["dual"].claims
    assert claim == (
        "No solver was the fastest on each of 3 cases at tol 1e-6: b on 2, a on 1."
    )


# ---- separate comparisons


def test_forms_and_tolerances_have_separate_statements(record, opened):
    def measured(form, tol, **factors):
        return [
            r.replace(form=form, tol=tol, case=f"box/n=0/{form}",
                  run_id=f"{r.run_id}-{form}-{tol}")
            for r in one_case(record, **factors)
        ]  # fmt: skip

    told = opened([
        *measured("dual", 1e-3, a=1.0, b=2.0),
        *measured("dual", 1e-6, a=2.0, b=1.0),
        *measured("primal", 1e-6, a=1.0, c=4.0),
    ])  # fmt: skip
    assert list(told) == ["dual", "primal"]
    tight, loose = told["dual"].claims
    assert loose.startswith("a was the fastest on the only case at tol 1e-3")
    assert tight.startswith("b was the fastest on the only case at tol 1e-6")
    assert told["primal"].claims[0].startswith("a was the fastest")


def test_only_a_few_of_many_tolerances_are_described(record, opened):
    tols = [10.0**-k for k in range(2, 10)]
    records = [
        r.replace(tol=tol, run_id=f"{r.run_id}-{tol}")
        for tol in tols for r in one_case(record, a=1.0, b=2.0)
    ]  # fmt: skip
    statement = opened(records)["dual"]
    assert [re.search(r"tol (\S+),", c)[1] for c in statement.claims] == [
        "1e-9", "1e-5", "1e-2",
    ]  # fmt: skip
    assert "5 more tolerances are in the sections below." in statement.remarks

    fewest = [r for r in records if r.tol > 1e-6]
    assert (
        "1 more tolerance is in the sections below." in opened(fewest)["dual"].remarks
    )


def test_a_null_arm_does_not_compete(record, opened):
    records = one_case(record, a=1.0, b=2.0)
    null = [r.replace(solver="a (null)", arm="null", run_id=f"{r.run_id}-null")
            for r in one_case(record, seed=2, a=1.0)]  # fmt: skip
    null[0] = null[0].replace(status=Verdict.CRASHED)
    statement = opened(records + null)["dual"]
    assert statement.claims[0].startswith("a was the fastest")
    assert not any("null" in line for line in statement.lines)


def test_sequences_are_compared_with_sequences(record, opened):
    cold = one_case(record, a=1.0, b=2.0)
    warm = [
        r.replace(mode="sequence", solver=f"{r.solver} (sequence)",
              run_id=f"{r.run_id}-warm", total_seconds=r.total_seconds / 100)
        for r in one_case(record, a=2.0, b=1.0)
    ]  # fmt: skip
    told = opened(cold + warm)
    assert list(told) == ["dual", "dual, sequence"]
    assert told["dual"].claims[0].startswith("a was the fastest")
    assert told["dual, sequence"].claims[0].startswith("b (sequence) was the fastest")


def test_the_fastest_verified_answers_of_sweeps_are_compared(record, opened):
    def swept(solver, tol, seconds, status=Verdict.VERIFIED):
        return [
            record(solver, 0, seconds * (1 + i / 100), i, tol=tol, accuracy=1e-6,
                   status=status)
            for i in range(4)
        ]  # fmt: skip

    statement = opened([
        *swept("hasty", 1e-2, 0.001, Verdict.INACCURATE), *swept("hasty", 1e-6, 0.08),
        *swept("sound", 1e-2, 0.02), *swept("sound", 1e-6, 0.07),
    ])["dual"]  # fmt: skip
    (claim,) = statement.claims
    assert claim.startswith("sound was the fastest on the only case at accuracy 1e-6")
    assert ratio_in(claim)[0] == pytest.approx(4.0)
    assert not any(text.startswith("Failed") for text in statement.remarks)


def test_times_at_equal_certified_error_are_compared(record, opened):
    """At equal tolerances, the answers of b are a hundred times more accurate."""
    records = [
        record(s, 0, factor * (8 - np.log10(tol)) * 1e-3 * (1 + i / 1000), i, tol=tol,
               energy_bound=tol / better)
        for s, factor, better in (("a", 1.0, 1.0), ("b", 1.05, 100.0))
        for tol in (1e-1, 1e-2, 1e-3, 1e-4, 1e-5, 1e-6) for i in range(4)
    ]  # fmt: skip
    statement = opened(records)["dual"]
    assert statement.claims[0] == (
        "Fastest at equal certified error (1 case): at 1e-4 b on 1; at 1e-6 b on 1."
    )
    assert "accuracy" in statement.evidence


def test_declined_cases_are_reported_separately_from_failures(record, opened):
    shy = record(
        "shy", 0, None, status=Verdict.DECLINED, claimed="", message="too large"
    )
    statement = opened([*one_case(record, a=1.0, b=2.0), shy])["dual"]
    assert "Declined: shy (too large)." in statement.remarks
    assert not any(text.startswith("Failed") for text in statement.remarks)


def test_many_failures_are_counted_not_listed(record, opened):
    lost = [
        r.replace(status=Verdict.FAILED, message="no")
        for k in range(30) for r in one_case(record, blocks=2, **{f"s{k:02d}": 1.0})
    ]  # fmt: skip
    statement = opened([*one_case(record, a=1.0, b=2.0), *lost])["dual"]
    (failed,) = (text for text in statement.remarks if text.startswith("Failed"))
    assert len(failed) < 300
    assert "and 23 more" in failed


# ---- rendering


@pytest.mark.usefixtures("blank_figures")
def test_the_answer_is_first_in_every_format_and_its_evidence_is_linked(
    record, evidence, tmp_path
):
    page = compose(evidence(many_cases(record, fast=1.0, slow=2.0)))
    text, source = html(page), markdown(page)
    names = {s.name for s in page.sections}
    first = text[text.index("<main>") : text.index('<section id="summary"')]
    assert "fast was the fastest" in first
    targets = set(re.findall(r'<a href="#([^"]+)"', first))
    assert {"means", "ranking", "verdicts"} <= targets <= names
    headings = {
        re.sub(r"[^\w -]", "", line[3:].lower()).replace(" ", "-")
        for line in source.splitlines() if line.startswith("## ")
    }  # fmt: skip
    opening = source[: source.index("## Summary")]
    anchors = set(re.findall(r"\]\(#([^)]+)\)", opening))
    assert "means-over-cases" in anchors
    assert anchors <= headings
    assert "![answer](figures/answer.png)" in opening
    tex = latex(page.sections[0].tables, page.sections[0].statements)
    assert r"\item[{dual}] fast was the fastest" in tex


@pytest.mark.usefixtures("blank_figures")
def test_plain_sentences_equal_the_sentences_of_the_report(record, tmp_path):
    with Journal(tmp_path, "test") as journal:
        for r in one_case(record, fast=1.0, slow=2.0):
            journal.append(r)
    lines = answer(tmp_path)
    assert lines[0].startswith("dual: fast was the fastest on the only case at tol")
    write_report(tmp_path, ["md", "tex"])
    text = (tmp_path / "report/report.md").read_text("utf-8")
    assert (
        lines[0].removeprefix("dual: ").replace("[", r"\[").replace("]", r"\]") in text
    )
    assert (tmp_path / "report/tables/answer.tex").is_file()
    with pytest.raises(InputError, match="no such folder"):
        answer(tmp_path / "empty")


@pytest.mark.usefixtures("blank_figures")
def test_names_cannot_break_out_of_the_answer(record, evidence):
    names = ("<b>x</b>", r"\input{a}$", "| a |\n## b", "\u202eleft", "", "n" * 5000)
    records = [
        record(name, 0, 0.01 * (k + 1) * (1 + i / 100), i, form=form,
               status=Verdict.WRONG if k == 2 else Verdict.VERIFIED, message=name,
               run_id=f"{k}-{i}-{n}")
        for n, form in enumerate((*names, "dual"))
        for k, name in enumerate(names) for i in range(3)
    ]  # fmt: skip
    page = compose(evidence(records))
    text = html(page)
    opening = text[text.index('<dl class="answer">') : text.index("</dl>")]
    assert not {"b", "input"} & set(re.findall(r"</?(\w+)", opening))
    assert "\u202e" not in opening
    assert "n" * 100 not in opening
    assert not re.search(r"^## b", markdown(page), flags=re.MULTILINE)
    tex = latex((), page.sections[0].statements)
    for line in tex.splitlines():
        bare = re.sub(r"\\[\\{}$&#%_]", "", line)
        assert bare.count("{") == bare.count("}"), line


# ---- the figure


def test_every_point_of_the_figure_shows_its_measurements(record, evidence):
    made = evidence(many_cases(record, fast=1.0, slow=2.0))
    (panel,) = fastest_figure(found(made), made.solvers).panels
    owners = {}
    for series in panel.marks:
        assert len(series.runs) == len(series.x)
        assert all(series.runs)
        owners.setdefault(series.solver, []).append(series.x)
    ratios, mean = sorted(owners["slow"], key=len, reverse=True)
    assert len(ratios) == 8
    assert np.exp(np.mean(np.log(ratios))) == pytest.approx(mean[0])
    assert owners["fast"] == [(1.0,)]
    own = {r.run_id for r in made.records if r.solver == "slow"}
    slow = [series for series in panel.marks if series.solver == "slow"]
    shown = {run_id for series in slow for ids in series.runs for run_id in ids}
    assert shown == own


def test_unverified_answers_are_at_the_edge_with_their_verdict(record, evidence):
    lost = [r.replace(status=Verdict.TIME_LIMIT) for r in one_case(record, lost=0.1)]
    made = evidence(one_case(record, a=1.0, b=2.0) + lost)
    (panel,) = fastest_figure(found(made), made.solvers).panels
    assert panel.y.ticks == ((0.0, "a"), (-1.0, "b"), (-2.0, "lost"))
    (text,) = panel.texts
    assert (text.text, text.place) == ("time limit", (0.995, -2.0))
    assert text.inside == (True, False)
    assert {y for series in panel.marks for y in series.y} == {0.0, -1.0}


def test_without_answers_there_is_no_figure(record, evidence):
    lost = [
        r.replace(status=Verdict.TIME_LIMIT) for r in one_case(record, a=1.0, b=1.0)
    ]
    made = evidence(lost)
    assert fastest_figure(found(made), made.solvers) is None
    assert compose(made).sections[0].pictures == ()
