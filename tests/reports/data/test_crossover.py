"""Crossover maps: routes, times, crossover sizes and ends of routes."""

from functools import partial

import pytest

from mortarbench.harness import Verdict
from mortarbench.reports.data.crossover import (
    Route,
    charged_seconds,
    crossover_maps,
)
from mortarbench.reports.data.evidence import Evidence, arrange
from mortarbench.reports.figures.crossover import crossover_figure, end_letter
from mortarbench.reports.sections import Analysis
from mortarbench.reports.sections.crossover import crossover
from tests.support.box_records import box_record

PRIMAL, DUAL = Route("primal", "", 1), Route("dual", "", 1)
TFETI, RANKS = Route("TFETI", "feti=4", 1), Route("TFETI", "feti=4", 2)
SIZES = (9, 19, 39, 79)  # parameter n of the box: 1000, 2000, 4000 and 8000 dofs


def record(solver, n, build, total, repeat=0, form="dual", feti=0, **changes):
    """Return a record in which recovery takes 1 s."""
    name = f"box/n={n}/feti={feti}/{form}"
    changes = {"recover_seconds": 1.0, **changes}
    made = box_record(solver, n, total, repeat, form=form, **changes)
    return made.replace(
        case=name, build_seconds=build, run_id=f"{solver} {name} {repeat}",
        params={"n": n, "feti": feti}, peak_mib=20.0,
    )  # fmt: skip


def measured(repeats=3):
    """Yield records of three routes and two solvers.

    With solver a, the primal route takes n²/10 + 2 s, the dual route n/10 + 21 s, both
    with recovery, and TFETI ends early. Solver b is slower, but solves one more size.
    """
    for n in SIZES:
        for i in range(repeats):
            noise = 1 + 0.01 * i
            one = partial(record, repeat=i)
            if n < SIZES[-1]:
                yield one("a", n, 1.0, noise * n**2 / 10, form="primal")
            yield one("b", n, 1.0, noise * n**2, form="primal")
            yield one("a", n, 20.0, noise * n / 10)
            if n == SIZES[0]:
                yield one("a", n, 1.0, 1.0, feti=4)
                yield one("a ranks=2", n, 1.0, 1.0, feti=4, ranks=2)
    stop = dict(status=Verdict.MEMORY_LIMIT, quantities={}, total_seconds=None)
    yield record("a", SIZES[1], None, None, feti=4, **stop)


@pytest.fixture
def evidence(tmp_path):
    return lambda records: Evidence(directory=tmp_path, records=arrange(records))


def test_the_time_includes_all_work_from_mesh_to_recovered_answer():
    r = record("a", 9, 3.0, 4.0)
    assert charged_seconds(r) == 8.0
    assert charged_seconds(r.replace(recover_seconds=None)) is None


def test_a_route_has_its_fastest_solver_at_each_size(evidence):
    (one,) = crossover_maps(evidence(measured()))

    assert one.sizes == (1000, 2000, 4000, 8000)
    assert [o.solver for o in one.routes[PRIMAL].values()] == ["a", "a", "a", "b"]
    assert set(one.routes) == {PRIMAL, DUAL, TFETI, RANKS}
    assert one.missing == ("primal, multigrid", "dual-bounds")


def test_the_crossover_is_the_size_from_which_on_the_dual_is_faster(evidence):
    """n²/10 + 2 exceeds n/10 + 21 from n = 19 on: 38.1 s against 22.9 s."""
    (one,) = crossover_maps(evidence(measured()))

    at = one.crossover(DUAL, PRIMAL)
    assert (at.pays, at.smallest, at.largest, at.beyond) == (2000, 1000, 8000, False)
    assert at.ratio.value == pytest.approx((79**2 + 2) / (7.9 + 21), rel=0.02)


def test_a_size_with_a_single_run_does_not_decide(evidence):
    records = [r for r in measured() if r.params["n"] < SIZES[-1] or not r.repeat]
    (one,) = crossover_maps(evidence(records))

    at = one.crossover(DUAL, PRIMAL)
    assert (at.pays, at.largest, at.ratio.pairs) == (2000, 8000, 1)


def test_single_runs_are_never_called_faster(evidence):
    (one,) = crossover_maps(evidence(measured(repeats=1)))
    assert one.crossover(DUAL, PRIMAL).pays is None


def test_every_end_of_a_route_has_a_reason(evidence):
    (one,) = crossover_maps(evidence(measured()))

    stops = {route: (stop.dofs, stop.verdict) for route, stop in one.stops.items()}
    assert stops == {
        PRIMAL: (None, None), DUAL: (None, None),
        TFETI: (2000, Verdict.MEMORY_LIMIT), RANKS: (2000, None),
    }  # fmt: skip
    letters = {route: end_letter(one, route) for route in one.routes}
    assert letters == {PRIMAL: "", DUAL: "", TFETI: "m", RANKS: "?"}


def test_the_section_names_every_route_even_those_without_measurements(evidence):
    whole = crossover(Analysis(evidence(measured())))

    stops = whole.tables[-1]
    assert [row[0].text for row in stops.rows] == [
        "primal", "dual", "TFETI (feti=4)", "TFETI (feti=4), 2 ranks",
        "primal, multigrid", "dual-bounds",
    ]  # fmt: skip
    assert [row[3].text for row in stops.rows][2:5] == [
        "memory limit", "not measured", "not in this run"
    ]  # fmt: skip
    assert whole.pictures[0].name == "crossover"


def test_a_route_that_all_solvers_declined_differs_from_one_not_measured(evidence):
    declined = dict(status=Verdict.DECLINED, quantities={}, total_seconds=None)
    records = [
        *measured(),
        *(record("a", n, None, None, form="dual-bounds", **declined) for n in SIZES),
    ]
    whole = crossover(Analysis(evidence(records)))

    why = {row[0].text: row[3].text for row in whole.tables[-1].rows}
    assert why["dual-bounds"] == "declined by all solvers"
    assert why["primal, multigrid"] == "not in this run"


def test_a_folder_with_dual_forms_only_has_no_section(evidence):
    duals = [r for r in measured() if r.form != "primal"]
    assert crossover(Analysis(evidence(duals))) is None


def test_the_figure_has_a_line_per_route_and_its_measurements(evidence):
    maps = crossover_maps(evidence(measured()))
    figure = crossover_figure(maps, 120, 8192)

    time, peak = figure.panels
    assert len(time.marks) == len(peak.marks) == 4
    assert [text.text for text in time.texts] == ["?, m"]
    assert {rule.at for p in figure.panels for rule in p.rules} == {120.0, 8192.0}
    assert all(len(series.runs) == len(series.x) for series in time.marks)


def test_letters_of_lines_with_the_same_end_are_joined(evidence):
    """TFETI ends at 1000 dofs with 3 s on one rank (m) and on two (?)."""
    maps = crossover_maps(evidence(measured()))
    (text,) = crossover_figure(maps, 120, 8192).panels[0].texts
    assert (text.text, text.place) == ("?, m", (1000, pytest.approx(3.0)))


def test_the_section_starts_with_the_crossover_sizes(evidence):
    """TFETI ends at 1000 dofs and is not considered."""
    first = crossover(Analysis(evidence(measured()))).prose[0]
    assert first.endswith(
        "from 2000 dofs on, the route “dual” is significantly faster than the route "
        "“primal”."
    )
