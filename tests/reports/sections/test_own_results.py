"""Opening of the report on a single solver: growth, condition numbers, failures."""

from functools import partial

import pytest

from mortarbench.harness import Verdict
from mortarbench.reports.data.evidence import Evidence, arrange
from mortarbench.reports.folder import compose
from mortarbench.reports.render.markdown import markdown
from tests.support.box_records import box_record


@pytest.fixture
def page(tmp_path):
    def make(records):
        return compose(Evidence(directory=tmp_path, records=arrange(records)))

    return make


@pytest.fixture
def record():
    return partial(box_record, environment="abc")


def sized(record, iterations, solver="a", **changes):
    """Return one answer per size; the k-th size has 100·4ᵏ degrees of freedom."""
    return [
        record(solver, 4**k - 1, 1e-3 * 4**k, iterations=its, **changes)
        for k, its in enumerate(iterations)
    ]


@pytest.mark.parametrize(
    ("iterations", "said"),
    [
        ([22, 22, 22, 22, 22], "takes 22 iterations; their number stays flat"),
        (
            [20, 24, 29, 35, 42],
            "20 to 42 iterations; their number grows (+36 % [",
        ),
        ([42, 35, 29, 24, 20], "takes 20 to 42 iterations; their number falls ("),
        ([19, 22, 22, 22, 22], "their number shows no clear trend ("),
    ],
)
def test_the_first_sentence_judges_the_growth_of_iterations(
    record, page, iterations, said
):
    made = page(sized(record, iterations))
    (statement,) = made.sections[0].statements
    assert statement.subject == "a"
    assert statement.claims[0].startswith("From 100 to 2.56e4 degrees of freedom, a ")
    assert said in statement.claims[0]
    assert markdown(made).index(statement.claims[0][:30]) < 200


def test_the_first_figure_shows_iterations_from_zero_on(record, page):
    records = sized(record, [19, 22, 22, 22, 22])
    (picture,) = page(records).sections[0].pictures
    (panel,) = picture.figure.panels
    assert panel.y.low == 0
    (series,) = panel.marks
    assert series.y == (19, 22, 22, 22, 22)
    assert {run for runs in series.runs for run in runs} == {r.run_id for r in records}


def test_condition_numbers_have_separate_ranges(record, page):
    records = [
        r.replace(quantities={**r.quantities, "kappa": 3.0 + k, "kappa_lumped": 2.0})
        for k, r in enumerate(sized(record, [9, 9, 9, 9]))
    ]
    (statement,) = page(records).sections[0].statements
    assert "box/dual, tol 1e-6: κ 3.00 to 6.00, κ lumped 2.00 to 2.00." in (
        statement.claims
    )


def test_failures_of_the_only_solver_are_reported(record, page):
    records = sized(record, [9, 9, 9, 9, 9])
    records[2] = records[2].replace(status=Verdict.WRONG, dual=0.03)
    own, dual = page(records).sections[0].statements
    assert own.subject == "a"
    assert "a claimed success but was wrong on 1 of 5 cases" in dual.remarks[0]


def test_a_report_on_two_solvers_opens_with_their_comparison(record, page):
    records = sized(record, [9] * 6) + sized(record, [9] * 6, solver="b")
    statements = page(records).sections[0].statements
    assert [s.subject for s in statements] == ["dual"]
    assert "a and b do not differ significantly" in statements[0].claims[0]
