"""Counts of solvers and condition numbers, drawn against size and H/h."""

from pathlib import Path

import pytest

from mortarbench.harness import Record, Verdict
from mortarbench.reports.data.evidence import Evidence, arrange
from mortarbench.reports.data.size_series import size_series, sweeps
from mortarbench.reports.document.figure import Series
from mortarbench.reports.figures.scaling import steps_figure, subdomain_figure
from mortarbench.reports.sections import Analysis
from mortarbench.reports.sections.scaling import steps

SIZES = (1_000, 16_000, 81_000, 256_000)  # n/1000 are fourth powers of integers


def records(**but):
    """Yield answers with CG steps of order n^¼, other constant counts, and κ."""
    for n in SIZES:
        yield Record(
            run_id=f"{n:012d}", case=f"plate/Sx={n}/dual", family="plate",
            params={"Sx": n}, form="dual", solver="smalbe", options={}, tol=1e-6,
            repeat=0, block=0, status=Verdict.VERIFIED, claimed="solved",
            iterations=20, total_seconds=1e-6 * n, sizes={},
            counts={"P_products": 30, "cg": round((n / 1000) ** 0.25 * 7),
                    "expansion": 2, "proportioning": 0},
            quantities={"dofs": n, "kappa": 20.0 + n / 1e5, "kappa_error": 1e-9,
                        "kappa_lumped": 5.0},
            **but,
        )  # fmt: skip


def evidence(given):
    return Evidence(directory=Path(), records=arrange(list(given)))


@pytest.fixture(scope="module")
def figure():
    (series,) = size_series(evidence(records()))
    return steps_figure(series, "smalbe")


def test_counts_and_condition_numbers_have_a_panel_each(figure):
    titles = [panel.title for panel in figure.panels]
    assert titles == ["products", "steps", "condition number"]
    # counts that are zero at some size are also drawn, since the axes begin at zero
    assert all(panel.y.low == 0 and not panel.y.log for panel in figure.panels)


def test_points_are_the_counts_of_the_measurements_behind_them(figure):
    steps_panel = figure.panels[1]
    (cg, *others) = (
        m for m in steps_panel.marks if isinstance(m, Series) and m.runs
    )  # fmt: skip
    assert cg.x == tuple(map(float, SIZES))
    assert cg.y == (7, 14, 21, 28)
    assert [m.y for m in others] == [(2,) * 4, (0,) * 4]
    assert cg.runs == tuple((f"{n:012d}",) for n in SIZES)


def test_legends_contain_the_exponent_and_its_interval(figure):
    labels = {key.label for key in figure.legend.keys}
    assert "cg,  p = 0.25 [0.25, 0.25]" in labels
    assert "P products,  p = 0.00 [0.00, 0.00]" in labels
    assert "proportioning" in labels  # without an exponent, because a count is zero
    assert {r"$\kappa$", r"$\kappa$ lumped"} <= labels


def test_a_fitted_curve_passes_through_its_points(figure):
    fits = [m for m in figure.panels[1].marks if isinstance(m, Series) and not m.runs]
    cg = fits[0]
    assert (cg.x[0], cg.x[-1]) == pytest.approx((SIZES[0], SIZES[-1]))
    assert (cg.y[0], cg.y[-1]) == pytest.approx((7, 28), rel=1e-6)


def test_counts_against_cells_of_a_subdomain_have_their_values_as_ticks():
    torn = [
        r.replace(
            case=f"plate/feti={h}/dual", params={"feti": h},
            quantities={"dofs": 1000, "equality_rows": 10, "contact_rows": 0},
        )
        for r, h in zip(records(), (4, 8, 16, 32), strict=True)
    ]  # fmt: skip
    found = evidence(torn)
    (sweep,) = sweeps(found, "feti")
    figure = subdomain_figure(sweep)
    assert [name for _, name in figure.panels[0].x.ticks] == ["4", "8", "16", "32"]
    section = steps(Analysis(found))
    assert [p.name for p in section.pictures] == ["steps-1"]


def test_a_solver_without_counts_has_no_figure():
    bare = (
        r.replace(counts={}, quantities={"dofs": r.params["Sx"]}) for r in records()
    )
    (series,) = size_series(evidence(bare))
    assert steps_figure(series, "smalbe") is None
