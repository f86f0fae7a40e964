"""Figures and tables of the paper, from small measurements."""

import csv
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
from matplotlib import image

from mortarbench.harness import Record, Verdict
from mortarbench.harness.results.journal import Journal
from mortarbench.problems.experiments import QUICK, paper_experiment
from mortarbench.problems.experiments.analysis import VARIANTS, analyse
from mortarbench.problems.experiments.clock import Rounds, Stopwatch, race, timed_as_one
from mortarbench.problems.experiments.physics import stepping
from mortarbench.problems.families.beam_ring import BEAM
from mortarbench.problems.fem.elasticity import elasticity_matrix, stiffness
from mortarbench.problems.fem.inverse import CholeskyInverse
from mortarbench.problems.fem.mesh import half_ring
from mortarbench.problems.fem.triplets import stiffness_by_triplets
from mortarbench.reports.data.evidence import Evidence, arrange, read_evidence
from mortarbench.reports.paper.bodies import dimensions, extent
from mortarbench.reports.paper.fleet import (
    certified_table,
    fleet_figure,
    fleet_table,
    totals_table,
)
from mortarbench.reports.paper.physics import active, errors, order
from mortarbench.reports.paper.report import compose, write_paper
from mortarbench.reports.paper.timings import PARTS, fit, medians, times
from mortarbench.reports.render.saving import save_all
from mortarbench.solvers.reference.solve import reference_solution
from mortarbench.solvers.smalbe.solver import SMALBE
from mortarbench.solvers.smalbe.textbook import PAPER

#: one process runs the module, so that measurements and drawings are made only once
pytestmark = pytest.mark.together

FIGURES = [
    *(f"figure{i}" for i in range(1, 8)),
    "zoom", "pressure", "verification", "stepping", "fleet", "totals", "certified",
]  # fmt: skip
SORTS = ("figure1", "verification", "fleet")  #: of a mesh, of curves, of solvers
TWICE = Rounds(most=2, least=2)
LITTLE = replace(
    QUICK,
    assembly=(1, 2, 3), assembly_rounds=TWICE,
    contact=((1, 2), (1, 2)), contact_rounds=TWICE,
    inverse=(1, 2, 3, 4), inverse_rounds=TWICE, dense=200,
    scaling=(1, 2), scaling_rounds=TWICE, Nh=2, steps=2,
    stepped=(2, 2), stepping=(1, 2, 4), relin=(1, 2), patch=(2, 4), hertz=(1, 2),
)  # fmt: skip


def solve(qp):
    return SMALBE().prepare(qp, 1e-8)()


@pytest.fixture(scope="module")
def experiment():
    environment = {"machine": {"cpu": "Abacus & Sons <9>"}, "now": {"time": "noon"}}
    said = []
    done = paper_experiment(
        LITTLE, solve, environment, said.append,
        baseline=lambda qp: PAPER.prepare(qp, 1e-8)(), reference=reference_solution,
    )  # fmt: skip
    assert len(said) == 8
    return done


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    """Return a folder that contains only measurements of suites."""
    path = tmp_path_factory.mktemp("paper") / "measured"
    for name, records in synthetic().items():
        with Journal(path / "data" / name, "here") as journal:
            for record in records:
                journal.append(record)
    return path


@pytest.fixture(scope="module")
def folder(data, experiment, blank):
    """Return a folder with the page and its tables, with empty figures."""
    path = data.with_name("page")
    shutil.copytree(data, path)
    with blank():
        write_paper(path, experiment)
    return path


@pytest.fixture(scope="module")
def all_formats(data, experiment):
    path = data.with_name("all formats")
    shutil.copytree(data, path)
    write_paper(path, experiment)
    return path


@pytest.fixture(scope="module")
def pictures(data, experiment):
    """Return the pictures of stored data by name, not yet drawn."""
    suites = {n: read_evidence(data / "data" / n) for n in synthetic()}
    page = compose(experiment, suites)
    return {p.name: p for s in page.sections for p in s.pictures}


#: m → n of the planted cases
SIZES = {50: 500, 100: 2000, 200: 8000}


def record(solver, form, m, seconds, repeat, **changes):
    given = dict(
        run_id=f"{solver} {form} {m} {repeat} {changes.get('tol')}",
        case=f"beam-ring/m={m}/{form}", family="beam-ring", params={"m": m}, form=form,
        sizes={"variables": SIZES[m] if form == "primal" else m}, solver=solver,
        options={}, tol=1e-6, repeat=repeat, block=repeat, status=Verdict.VERIFIED,
        claimed="solved", total_seconds=seconds, primal=1e-9, dual=1e-9,
        complementarity=1e-9, gap=1e-9, quantities={"dofs": SIZES[m]},
        dualise_seconds=None if form == "primal" else 0.5,
    )  # fmt: skip
    return Record(**(given | changes))


def synthetic():
    """Return the records of two suites.

    In `paper-fleet`, times are about 1e-6·m² s; at the largest size, `lazy` returns a
    wrong answer after 1 ns. In `paper-accuracy`, times are 1e-3·tol^-0.1 s.
    """
    fleet = [
        record(solver, form, m, 1e-6 * m**2 * (1 + repeat / 100), repeat,
               **(wrong if solver == "lazy" and m == 200 else {}))
        for wrong in [dict(status=Verdict.WRONG, total_seconds=1e-9, quantities={})]
        for solver in ("smalbe", "lazy") for form in ("primal", "dual", "dual-bounds")
        for m in SIZES for repeat in range(3)
    ]  # fmt: skip
    sweep = [
        record("smalbe", "dual", 200, 1e-3 / tol**0.1, repeat, tol=tol,
               energy_bound=10 * tol)
        for tol in (1e-2, 1e-4, 1e-6) for repeat in range(3)
    ]  # fmt: skip
    return {"paper-fleet": fleet, "paper-accuracy": sweep}


def rows_of(path):
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


@pytest.mark.parametrize(
    "name", [SORTS[1], *(pytest.param(n, marks=pytest.mark.slow) for n in SORTS[::2])]
)
def test_a_figure_of_each_type_exists_in_three_formats(pictures, tmp_path, name):
    save_all(pictures[name].figure, tmp_path, name)
    assert_three_formats(tmp_path, name)


@pytest.mark.slow
@pytest.mark.parametrize("name", FIGURES)
def test_every_figure_exists_in_three_formats(all_formats, name):
    assert_three_formats(all_formats / "figures", name)


def elements(svg):
    return len(ElementTree.parse(svg).findall(".//*"))


def assert_three_formats(figures, name):
    pixels = image.imread(figures / f"{name}.png")

    assert pixels.shape[1] > 1400
    assert (pixels[..., :3].min(axis=-1) < 0.9).mean() > 0.01
    assert (figures / f"{name}.pdf").read_bytes().startswith(b"%PDF")
    assert elements(figures / f"{name}.svg") > 30


def test_the_page_is_complete_and_escapes_foreign_text(folder):
    page = (folder / "index.html").read_text()

    assert page.count("<svg") == page.count("<b>Figure ") == 14
    assert page.count("<b>Table ") == 7
    assert "Abacus &amp; Sons &lt;9&gt;" in page
    assert "AMD Ryzen 5 3600, MATLAB R2020a" in page
    assert "http://" not in page.replace("http://www.w3.org", "")


@pytest.mark.slow
def test_all_figures_have_reproducible_bytes(all_formats, data, experiment, tmp_path):
    shutil.copytree(data / "data", tmp_path / "data")
    again = write_paper(tmp_path, experiment)

    assert len(again) == 1 + 14 * 3 + 5 + 8
    for path in again:
        first = all_formats / path.relative_to(tmp_path)
        assert path.read_bytes() == first.read_bytes()


def test_table_1_satisfies_the_formulas_of_the_paper(experiment):
    """The beam has (8Nr + 1)(Nr + 1) nodes and 8Nr² elements.

    The ring has (12Nh + 1)(2Nh + 1) nodes and 24Nh² elements.
    """
    beam, ring = experiment.tables["table1"]

    assert list(beam.values()) == ["rectangle", 2, 17 * 3, 32, 102, 16]
    assert list(ring.values()) == ["ring", 2, 25 * 5, 96, 250, 24]


@pytest.mark.parametrize("Nr", [1, 2])
def test_the_dual_has_the_sizes_of_the_papers_formulas(experiment, Nr):
    """There are m_E = 2(Nr + 1) + 4(2Nh + 1) and m_I = 12Nh + 1 rows."""
    sizes = {
        (r["n"], r["m_E"], r["m_I"])
        for r in experiment.tables["figure6"] if r["Nr"] == Nr
    }  # fmt: skip

    largest = len(experiment.states["largest"].points)
    assert largest == 17 * 3 + 25 * 5
    assert sizes == {(2 * (8 * Nr + 1) * (Nr + 1) + 250, 2 * (Nr + 1) + 20, 25)}


def test_figure_2_is_drawn_with_both_rules_for_the_ring(experiment, folder):
    """Erratum: with Nh layers, there are 313 nodes; with 2·Nh, as in the text, 424."""
    nodes = [
        len(experiment.states[s].points) for s in ("example-Nh", "example-2Nh")
    ]  # fmt: skip

    assert nodes == [313, 424]
    assert "313 nodes" in (folder / "index.html").read_text()


def test_figure_1_has_the_dimensions_of_the_paper(experiment):
    d = dimensions(experiment.states["example-2Nh"])

    assert (d.l, d.h, d.a) == pytest.approx((2, 0.25, 0.5))
    assert (*d.centre, d.r1, d.r2) == pytest.approx((1, 0, 0.3, 0.49))


def test_both_methods_give_the_same_final_displacement():
    one, other = (
        analyse(
            2, 2, solve=lambda qp: SMALBE().prepare(qp, 1e-11)(), condense=c, steps=3
        )
        for c in VARIANTS.values()
    )

    assert one.solution.x == pytest.approx(other.solution.x, abs=1e-9)
    assert set(one.laps) == set(other.laps) == {
        "assembly", "factor", "contact", "dualisation", "qp", "recovery",
    }  # fmt: skip


@pytest.mark.parametrize(("way", "solves"), [("per-row", 3), ("condensed", 0)])
def test_only_the_papers_method_solves_for_all_rows_in_each_step(
    way, solves, monkeypatch
):
    calls, congruence = [], CholeskyInverse.congruence
    monkeypatch.setattr(
        CholeskyInverse, "congruence", lambda s, B: calls.append(B) or congruence(s, B)
    )
    done = analyse(1, 1, solve=solve, condense=VARIANTS[way], steps=3)

    assert len(calls) == solves
    assert all(B.shape[0] == done.dual.q.size for B in calls)


def test_an_analysis_solves_the_problem_of_its_last_step():
    """The solution satisfies primal stationarity and the contact rows."""
    a = analyse(2, 2, solve=solve, condense=True, steps=2)
    qp, s = a.primal, a.solution
    residual = qp.P @ s.x + qp.q + qp.A.T @ s.y + qp.G.T @ s.z

    assert abs(residual).max() < 1e-6
    assert (qp.G @ s.x - qp.h).max() < 1e-6
    assert s.z.min() >= 0
    assert s.z.max() > 0.1


def test_an_unsolved_qp_raises_an_error():
    def lost(qp):
        return SMALBE(max_steps=1).prepare(qp, 1e-8)()

    with pytest.raises(RuntimeError, match="not solved"):
        analyse(1, 1, solve=lost, condense=True, steps=1)


def test_fitted_times_are_marked_as_fitted(folder):
    """Rows beyond the largest dense size are c·n³ and c·n², marked as fitted."""
    rows = [r for r in rows_of(folder / "tables" / "figure5.csv")
            if r["method"] == "pinv"]  # fmt: skip
    kinds = {(r["part"], int(r["n"])): r["kind"] for r in rows}

    assert kinds == {
        (part, n): "measured" if n <= 200 else "fitted"
        for part in ("build", "multiply") for n in (36, 102, 200, 330)
    }  # fmt: skip
    assert all(float(r["low"]) <= float(r["median"]) <= float(r["high"]) for r in rows)


def cubes(*sizes, factor=lambda n: 2e-9):
    return [
        {"n": n, "repeat": k, "seconds": factor(n) * n**3 * (1 + 0.1 * k)}
        for n in sizes for k in range(3)
    ]  # fmt: skip


def test_a_fit_of_cubes_returns_their_factor():
    law = fit(times(cubes(10, 20, 40, 80), "n"), 3)

    assert (law.c, law.low, law.high) == pytest.approx((2.2e-9,) * 3)
    assert (law.since, law.until) == (40, 80)


def test_the_band_of_a_fit_contains_the_factors_of_all_fitted_sizes():
    law = fit(times(cubes(10, 20, 40, 80, factor=lambda n: n * 1e-9), "n"), 3)

    assert (law.low, law.high) == pytest.approx((44e-9, 88e-9))
    assert law.c == pytest.approx(np.sqrt(44 * 88) * 1e-9)  # geometric mean


def test_parts_are_summed_within_each_repeat_before_the_median_is_taken():
    """The parts of the repeats take 1 + 9, 2 + 2 and 3 + 3; the median sum is 6."""
    seconds = {"a": (1, 2, 3), "b": (9, 2, 3)}
    rows = [
        {"n": 5, "part": part, "repeat": k, "seconds": s}
        for part, values in seconds.items() for k, s in enumerate(values)
    ]  # fmt: skip

    assert medians(rows, ["n"])[(5,)][:3] == (6, 4, 10)
    (point,) = times(rows, "n", part=("a",))
    assert (point.x, point.time.value) == (5, 2)


def test_published_times_are_compared_at_the_published_size_only(experiment):
    """The time of a smaller problem is not compared with the published time."""

    def ratios(experiment):
        final = next(s for s in compose(experiment).sections if s.name == "results")
        return [row[-1].text for row in final.tables[1].rows]

    assert set(ratios(experiment)) == {"–"}
    grown = [
        dict(r, Nr=30, Nh=15) if r["Nr"] == 2 else r
        for r in experiment.tables["figure6"]
    ]  # fmt: skip
    tables = {**experiment.tables, "figure6": grown}
    compared = ratios(replace(experiment, tables=tables))
    ours = [r for r in grown if r["Nr"] == 30]
    total, set_up = (
        times(ours, "n", method="condensed", part=parts)[0].time.value
        for parts in (PARTS, ("factor", "dualisation"))
    )
    assert float(compared[-1].split()[0]) == pytest.approx(29.99 / total, rel=0.01)
    assert float(compared[4].split()[0]) == pytest.approx(26.764 / set_up, rel=0.01)
    assert compared[6] == "–"  # the paper does not state the time of recovery


def with_orders(p):
    """Return rows with relative errors of 0.1·steps⁻ᵖ, and the exact row.

    The errors are those of `tip_x` and `force_y`.
    """

    def row(steps, relin, error):
        return {"steps": steps, "relin": relin, "tip_x": 3 * (1 + error), "tip_y": 4,
                "force_x": 0.0, "force_y": 1e8 * (1 - error)}  # fmt: skip

    return [*(row(n, 1, 0.1 * n**-p) for n in (1, 2, 5, 10, 20, 40)), row(2, 8, 0.0)]


@pytest.mark.parametrize("p", [1.0, 2.0])
@pytest.mark.parametrize(("quantity", "part"), [("tip displacement", 0.6),
                                                ("contact force", 1.0)])  # fmt: skip
def test_the_order_of_the_stepping_is_recovered(p, quantity, part):
    rows = with_orders(p)

    assert dict(errors(rows, 1, quantity))[10] == pytest.approx(0.1 * 10**-p * part)
    law = order(rows, 1, quantity)
    assert (law.exponent, law.low, law.high) == pytest.approx((p, p, p))


def test_the_papers_stepping_is_of_first_order():
    """The errors of tip displacement and contact force are of order 1/steps."""
    plan = replace(LITTLE, stepped=(6, 3), stepping=(5, 10, 20, 40), relin=(1,))
    rows = list(stepping(plan, reference_solution))

    for quantity in ("tip displacement", "contact force"):
        assert order(rows, 1, quantity).exponent == pytest.approx(1, abs=0.2)


def test_mortar_passes_the_patch_test_and_node_to_segment_does_not(experiment):
    found = {"nts": [], "mortar": [], "mortar-standard": []}
    for r in experiment.tables["verification"]:
        if r["problem"] == "patch":
            found[r["contact"]].append(r["error"])

    assert max(found["mortar"] + found["mortar-standard"]) < 1e-10
    assert min(found["nts"]) > 0.05


def test_the_pressures_of_a_step_carry_the_force_of_its_nodes(experiment):
    rows = experiment.tables["pressures"]

    assert {(r["contact"], r["step"]) for r in rows} == {
        (contact, step) for contact in ("nts", "mortar") for step in (1, 2)
    }
    for r in rows:
        assert r["pressure"] * r["length"] == pytest.approx(r["force"])
    arc = sum(r["length"] for r in rows if (r["contact"], r["step"]) == ("nts", 1))
    assert arc == pytest.approx(np.pi * 0.49, rel=0.01)
    assert len(active(rows, "nts")[2]) >= 1


def evidence(name):
    return Evidence(directory=Path(), records=arrange(synthetic()[name]))


def test_an_answer_that_is_not_verified_is_never_drawn_as_a_time():
    """The wrong answer of `lazy` after 1 ns is drawn as a cross outside the axes."""
    figure = fleet_figure(evidence("paper-fleet"))
    upper, strips = (row.panels for row in figure.rows)

    for panel in upper:
        assert min(y for series in panel.marks for y in series.y) >= 2.5e-3
    for panel in strips:
        assert [series.x for series in panel.marks] == [(200,)]
        assert [series.solver for series in panel.marks] == ["lazy"]
    assert len(strips) == 2


def test_a_planted_growth_is_tabulated_and_failures_as_such():
    table = fleet_table(evidence("paper-fleet"), "dual")
    smalbe, lazy = (
        dict(zip(table.columns, row, strict=True)) for row in sorted(
            table.rows, key=lambda row: row[0].text, reverse=True
        )
    )  # fmt: skip

    assert smalbe["p [95 %]"].value == pytest.approx(2)
    assert smalbe["m = 200"].value == pytest.approx(0.0404)
    assert lazy["m = 200"].text.startswith("wrong")
    assert lazy["p [95 %]"].value is None  # only two sizes are verified


def test_dual_totals_include_the_dualisation():
    table = totals_table(evidence("paper-fleet"))
    values = {row[0].text: [cell.value for cell in row[1:]] for row in table.rows}

    assert values["smalbe"] == pytest.approx([0.0404, 0.0404, 0.5, 0.5404])


def test_the_time_to_an_error_is_that_of_the_cheapest_certified_answer():
    """Certified errors are 0.1, 1e-3 and 1e-5 at tolerances 1e-2, 1e-4 and 1e-6."""
    (row,) = certified_table(evidence("paper-accuracy")).rows

    assert row[2].value == pytest.approx(1e-3 * 1e-4**-0.1)
    assert row[3].value == pytest.approx(1e-3 * 1e-6**-0.1)
    assert row[4].text == "not reached"


def test_no_panel_is_empty(experiment):
    suites = {name: evidence(name) for name in synthetic()}
    for section in compose(experiment, suites).sections:
        for picture in section.pictures:
            assert all(panel.marks for panel in picture.figure.panels), picture.name


def test_colours_end_at_the_quantile_of_the_size(experiment):
    fields = experiment.states["largest"]
    values = np.zeros(len(fields.points))
    values[:2] = -7e9, 3e9
    ends = extent(replace(fields, nodal={"sxx": values}), "sxx")

    assert ends.largest == 7e9
    assert ends.clipped < 7e9


def test_triplets_give_the_same_matrix_as_the_compiled_loops():
    mesh = half_ring((1, 0), (0.3, 0.49), (6, 3))
    D = elasticity_matrix(BEAM, "stress")
    K = stiffness(mesh, D)

    assert abs(K - stiffness_by_triplets(mesh, D)).max() <= 1e-13 * abs(K).max()


def test_methods_are_interleaved_with_one_row_per_measurement():
    calls = []
    entrants = {
        name: timed_as_one(lambda name=name: calls.append(name)) for name in "ab"
    }
    rows = race(entrants, Rounds(most=3))

    assert calls == list("abababab")  # the first two calls are a warm-up
    assert [(r["method"], r["repeat"]) for r in rows] == [
        (name, k) for k in range(3) for name in "ab"
    ]
    assert all(r["seconds"] >= 0 and r["part"] == "all" for r in rows)


def test_repeats_end_at_the_time_limit_after_the_minimum_number():
    calls = []
    entrant = {"a": timed_as_one(lambda: calls.append(1))}
    race(entrant, Rounds(most=9, least=4, seconds=-1), warm=False)

    assert len(calls) == 4


def test_a_stopwatch_sums_the_times_of_a_part(monkeypatch):
    times = iter([0.0, 1.0, 3.0, 6.0])
    monkeypatch.setattr(
        "mortarbench.problems.experiments.clock.perf_counter", lambda: next(times)
    )
    watch = Stopwatch()
    for part in "aba":
        watch.lap(part)

    assert watch.laps == {"a": 4.0, "b": 2.0}


@pytest.mark.slow
def test_the_command_writes_all_files(tmp_path):
    done = subprocess.run(
        [sys.executable, "-m", "mortarbench", "paper", "--quick", "--out", tmp_path],
        capture_output=True, text=True, timeout=1200, check=True,
    )  # fmt: skip

    assert done.stdout == f"{tmp_path / 'index.html'}\n"
    (beam, ring) = rows_of(tmp_path / "tables" / "table1.csv")
    assert (beam["dofs"], ring["dofs"]) == ("14942", "11222")
