"""Figures and tables of the paper, from small measurements."""

from dataclasses import replace

import numpy as np
import pandas as pd
import pytest

from mortarbench.harness import Record, Verdict
from mortarbench.harness.results.journal import Journal
from mortarbench.problems.experiments import QUICK, paper_experiment
from mortarbench.problems.experiments.clock import Rounds
from mortarbench.problems.experiments.parts import counts
from mortarbench.reports.document import Table
from mortarbench.reports.measurements import read_measurements
from mortarbench.reports.paper import bodies, timings
from mortarbench.reports.paper.report import compose, write_paper
from mortarbench.solvers.smalbe.solver import SMALBE
from mortarbench.solvers.smalbe.textbook import PAPER

#: one process runs the module, so that measurements are made only once
pytestmark = pytest.mark.together

FIGURES = [
    *(f"figure{i}" for i in range(1, 8)),
    "zoom",
    "fleet",
    "totals",
    "certified",
]
TWICE = Rounds(most=2, least=2)
LITTLE = replace(
    QUICK,
    assembly=(1, 2, 3), assembly_rounds=TWICE,
    contact=((1, 2), (1, 2)), contact_rounds=TWICE,
    inverse=(1, 2, 3, 4), inverse_rounds=TWICE, dense=200,
    scaling=(1, 2), scaling_rounds=TWICE, Nh=2, steps=2,
)  # fmt: skip


@pytest.fixture(scope="module")
def experiment():
    environment = {"machine": {"cpu": "Abacus & Sons <9>"}, "now": {"time": "noon"}}
    return paper_experiment(
        LITTLE, lambda qp: SMALBE().prepare(qp, 1e-8)(), environment, lambda _: None,
        baseline=lambda qp: PAPER.prepare(qp, 1e-8)(),
    )  # fmt: skip


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    """Return a folder that contains only measurements of suites."""
    path = tmp_path_factory.mktemp("paper")
    for name, records in suite_records().items():
        with Journal(path / "data" / name, "here") as journal:
            for record in records:
                journal.append(record)
    return path


@pytest.fixture(scope="module")
def document(data, experiment):
    suites = {n: read_measurements(data / "data" / n) for n in suite_records()}
    return compose(experiment, suites)


#: m → n of the planted cases
SIZES = {50: 500, 100: 2000, 200: 8000}


def record(solver, form, m, seconds, repeat, **changes):
    given = dict(
        run_id=f"{solver} {form} {m} {repeat} {changes.get('tol')}",
        case=f"beam-ring/m={m}/{form}", family="beam-ring", params={"m": m}, form=form,
        sizes={"variables": SIZES[m] if form == "primal" else m}, solver=solver,
        options={}, tol=1e-6, remembered=False, repeat=repeat, block=repeat,
        status=Verdict.VERIFIED, claimed="solved", total_seconds=seconds,
        primal=1e-9, dual=1e-9,
        complementarity=1e-9, gap=1e-9, quantities={"dofs": SIZES[m]},
        dualise_seconds=None if form == "primal" else 0.5,
    )  # fmt: skip
    return Record(**(given | changes))


def suite_records():
    """Return the records of two suites.

    In `paper-fleet`, times are about 1e-6·m² s; at the largest size, `lazy` returns a
    wrong answer after 1 ns. In `paper-accuracy`, times are 1e-3·tol^-0.1 s, and the
    certified error is 10·tol.
    """
    fleet = [
        record(solver, form, m, 1e-6 * m**2 * (1 + repeat / 100), repeat,
               **(wrong if solver == "lazy" and m == 200 else {}))
        for wrong in [dict(status=Verdict.WRONG, total_seconds=1e-9, quantities={})]
        for solver in ("smalbe", "lazy") for form in ("primal", "dual", "dual-bounds")
        for m in SIZES for repeat in range(3)
    ]  # fmt: skip
    sweep = [
        record(solver, "dual", 200, factor * 1e-3 / tol**0.1, repeat, tol=tol,
               energy_bound=10 * tol)
        for solver, factor in (("smalbe", 1), ("slow", 4))
        for tol in (1e-2, 1e-4, 1e-6) for repeat in range(3)
    ]  # fmt: skip
    return {"paper-fleet": fleet, "paper-accuracy": sweep}


def pictures(document):
    return {p.name: p for s in document.sections for p in s.pictures}


def table(document, name):
    """Return a table of the page as dictionaries, by the text of the first column."""
    (found,) = (t for s in document.sections for t in s.tables if t.name == name)
    return {row[0]: dict(zip(found.head, row, strict=True)) for row in found.rows}


def test_table_1_has_the_counts_of_the_paper(experiment):
    """Counts of the largest problem equal the paper's; others satisfy its formulas."""
    large = timings.table_1(pd.DataFrame(counts(30, 15)))
    small = timings.table_1(pd.DataFrame(list(experiment.tables["table1"])))

    assert large.rows == (
        ("rectangle", "30", "7471", "7200", "14942", "240", "equal"),
        ("ring", "15", "5611", "5400", "11222", "180", "equal"),
        ("total", "", "13082", "12600", "26164", "", "equal"),
    )
    assert [row[1:-1] for row in small.rows[:2]] == [
        ("2", "51", "32", "102", "16"), ("2", "125", "96", "250", "24"),
    ]  # fmt: skip
    assert {row[-1] for row in small.rows} == {"different size"}


@pytest.mark.parametrize("Nr", [1, 2])
def test_the_dual_has_the_sizes_of_the_papers_formulas(experiment, Nr):
    """There are m_E = 2(Nr + 1) + 4(2Nh + 1) and m_I = 12Nh + 1 rows."""
    sizes = {
        (r["n"], r["m_E"], r["m_I"])
        for r in experiment.tables["figure6"] if r["Nr"] == Nr
    }  # fmt: skip

    assert sizes == {(2 * (8 * Nr + 1) * (Nr + 1) + 250, 2 * (Nr + 1) + 20, 25)}


def test_figure_1_has_the_dimensions_of_the_paper(experiment):
    d = bodies.dimensions(experiment.states["example-2Nh"])

    assert (d.l, d.h, d.a) == pytest.approx((2, 0.25, 0.5))
    assert (*d.centre, d.r1, d.r2) == pytest.approx((1, 0, 0.3, 0.49))


def test_parts_are_summed_within_each_repeat_before_the_median_is_taken():
    """The parts of the repeats take 1 + 9, 2 + 2 and 3 + 3; the median sum is 6."""
    seconds = {"a": (1, 2, 3), "b": (9, 2, 3)}
    rows = pd.DataFrame(
        {"n": 5, "part": part, "repeat": k, "seconds": s}
        for part, values in seconds.items() for k, s in enumerate(values)
    )  # fmt: skip

    assert timings.medians(rows, ["n"]).to_numpy().tolist() == [[5, 6, 4, 10, 3]]
    assert timings.medians(rows[rows.part == "a"], ["n"])["median"].tolist() == [2]


def test_dense_times_are_extrapolated_by_their_cubes():
    """The times 2e-9·n³ and 3e-9·n² of the dense inverse continue beyond n = 80."""
    rows = pd.DataFrame(
        {"n": n, "method": method, "part": part, "repeat": k, "seconds": c * n**p}
        for part, c, p in (("build", 2e-9, 3), ("multiply", 3e-9, 2))
        for method in ("pinv", "geometric", "spectral") for k in range(3)
        for n in ((10, 20, 40, 80) if method == "pinv" else (10, 1000))
    )  # fmt: skip
    figure = timings.inverse_figure(rows)

    for axes, time in zip(figure.axes, (2e-9 * 1e9, 3e-9 * 1e6), strict=True):
        (dotted,) = (line for line in axes.lines if line.get_linestyle() == ":")
        assert dotted.get_xydata()[[0, -1], 0] == pytest.approx([80, 1000])
        assert dotted.get_ydata()[-1] == pytest.approx(time)


def test_published_times_are_compared_at_the_published_size_only(experiment):
    rows = pd.DataFrame(list(experiment.tables["figure6"]))
    small = rows[rows.Nr == 2]
    ratios = [
        [row[-1] for row in timings.timings(of, 2, "here").rows]
        for of in (small, small.assign(Nr=30, Nh=15))
    ]
    total = timings.medians(small[small.method == "condensed"], ["n"])["median"][0]

    assert set(ratios[0]) == {"–"}
    assert float(ratios[1][-1].split()[0]) == pytest.approx(29.99 / total, rel=0.01)
    assert ratios[1][6] == "–"  # the paper does not state the time of recovery


def test_an_answer_that_is_not_verified_is_never_drawn_as_a_time(document):
    """The wrong answer of `lazy` after 1 ns appears in tables only."""
    for name in ("fleet", "totals"):
        for axes in pictures(document)[name].draw().axes:
            times = np.concatenate([line.get_ydata() for line in axes.lines])
            assert times.min() >= 2.5e-3
    rows = table(document, "times-dual")
    assert rows["lazy"]["m = 200"] == "wrong"
    assert rows["smalbe"]["m = 200"].startswith("40.4 ms")
    assert rows["smalbe"]["p"].startswith("2.00")


def test_dual_times_are_drawn_with_the_dualisation(document):
    """The dual forms take 0.5 s longer than the primal form."""
    primal, dual = (
        next(line for line in axes.lines if line.get_label() == "smalbe")
        for axes in pictures(document)["totals"].draw().axes
    )

    assert dual.get_ydata() - primal.get_ydata() == pytest.approx(0.5)
    assert primal.get_xdata() == pytest.approx(list(SIZES.values()))


def test_solvers_are_compared_at_equal_certified_error(document):
    """A solver that takes four times as long at each tolerance is four times slower."""
    (section,) = (s for s in document.sections if s.name == "certified")
    (found,) = (t for t in section.tables if isinstance(t, Table))

    slow = [row[found.head.index("slow")] for row in found.rows]

    assert [row[1] for row in found.rows] == ["error 1e-2", "error 1e-4", "error 1e-6"]
    assert [float(cell.split()[0]) for cell in slow[:2]] == [4.0, 4.0]
    assert slow[2].startswith("–")  # the smallest certified error is 1e-5


@pytest.mark.slow
def test_all_figures_are_drawn_to_files_with_equal_bytes(data, experiment, tmp_path):
    (tmp_path / "data").mkdir()
    for name in suite_records():
        (tmp_path / "data" / name).symlink_to(data / "data" / name)
    files, again = (write_paper(p, experiment) for p in (data, tmp_path))

    assert {p.stem for p in files if p.suffix == ".png"} == set(FIGURES)
    for one, other in zip(files, again, strict=True):
        assert one.relative_to(data) == other.relative_to(tmp_path)
        assert one.read_bytes() == other.read_bytes(), one.name


def test_the_page_contains_figures_errata_and_escaped_names(
    data, experiment, monkeypatch
):
    monkeypatch.setattr(
        "mortarbench.reports.writing.draw_files", lambda *_: ([], "<svg></svg>")
    )
    files = {p.relative_to(data).as_posix() for p in write_paper(data, experiment)}
    page = (data / "index.html").read_text()
    medians = pd.read_csv(data / "tables" / "figure6.csv")

    assert page.count("<svg") == len(FIGURES)
    assert "Abacus &amp; Sons &lt;9&gt;" in page
    assert "313 nodes (n = 626)" in page  # an erratum
    assert "http://" not in page.replace("http://www.w3.org", "")
    assert {"index.html", "tables/table1.csv", "tables/figure7.tex"} <= files
    assert (medians.low <= medians["median"]).all()
    assert (medians["median"] <= medians.high).all()


def test_every_panel_is_drawn_and_labelled(document):
    for name, picture in pictures(document).items():
        for axes in picture.draw().axes:
            if not axes.axison:  # Figure 1
                continue
            assert axes.has_data(), name
            labels = (axes.get_xlabel(), axes.get_ylabel())
            assert any(labels) or name in ("figure2", "figure7"), name


def test_axes_state_quantity_and_unit(document):
    drawn = pictures(document)
    ends = {
        name: (axes.get_xlabel(), axes.get_ylabel())
        for name in ("figure3", "figure4", "zoom")
        for axes in drawn[name].draw().axes[:1]
    }

    assert ends == {
        "figure3": ("degrees of freedom $n$", "assembly time in s"),
        "figure4": ("slave segments", "time of one linearisation in s"),
        "zoom": ("$x$ in m", "$y$ in m"),
    }


def test_colours_end_at_the_quantile_of_the_size(experiment):
    fields = experiment.states["largest"]
    values = np.zeros(len(fields.points))
    values[:2] = -7e9, 3e9
    clipped, largest = bodies.extent(replace(fields, nodal={"sxx": values}), "sxx")

    assert largest == 7e9
    assert clipped < 7e9
