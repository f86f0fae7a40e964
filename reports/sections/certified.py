"""Sweeps of tolerances against certified errors: curves, and times at matched error."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from harness import Verdict
from harness.crossval.discretisation import Discretisation
from reports.data.evidence import Evidence, Outcome
from reports.data.time_at_accuracy import (
    TimeAtAccuracy,
    counts,
    time_at_accuracy,
)
from reports.document.formatting import ABSENT, TIMED, clean, power, seconds, tolerance
from reports.document.layout import Cell, Picture, Table, name_cell
from reports.figures.sweeps import certified_figure
from reports.statistics.intervals import COVERAGE

ERRORS = (1e-2, 1e-4, 1e-6)  #: at which times are compared
LEAST = 3  #: tolerances that make a sweep
_PANELS = 4  #: cases that are drawn; all are tabulated

Sweeps = Mapping[str, Mapping[str, Sequence[Outcome]]]  #: case → solver → by tolerance


def certified_sweeps(evidence: Evidence) -> dict[str, dict[str, list[Outcome]]]:
    """Collect the cases with certified errors at three tolerances or more."""
    found: dict[str, dict[str, list[Outcome]]] = {}
    for o in sorted(evidence.flat, key=lambda o: -o.tol):
        found.setdefault(o.case, {}).setdefault(o.solver, []).append(o)
    return {case: row for case, row in sorted(found.items()) if _swept(row)}


def _swept(row: Mapping[str, Sequence[Outcome]]) -> bool:
    bounded = {
        o.tol for outcomes in row.values() for o in outcomes
        if o.largest("energy_bound") is not None
    }  # fmt: skip
    return len(bounded) >= LEAST


def time_at_accuracy_table(swept: Sweeps, solvers: Sequence[str]) -> Table:
    """Tabulate the times at matched certified errors."""
    present = [s for s in solvers if any(s in row for row in swept.values())]
    rows = []
    for case, row in swept.items():
        for error in ERRORS:
            found = {
                s: time_at_accuracy(outcomes, error) for s, outcomes in row.items()
            }
            kinds = _kinds({s: m for s, m in found.items() if not row[s][0].first.arm})
            cells = [
                _cell(found.get(s), row.get(s, ()), kinds.get(s, "")) for s in present
            ]
            rows.append(
                (name_cell(case), Cell(text=tolerance(error), value=error), *cells)
            )
    return Table(
        caption="Total time at matched certified error: relative, in the energy norm.",
        notes=(
            "Interpolated between the tolerances of the sweep, monotone and linear in "
            f"logarithms, never beyond them; in brackets the {COVERAGE:.0%} interval "
            "of a bootstrap over the repeats. ≤: the answer at the loosest tolerance "
            "is better than that already, and took so long; at this error it may take "
            "less than any other. Bold: the fastest of its row, where no other has a "
            "≤; ≈: the interval overlaps that of the fastest time without a ≤, so that "
            "this run does not tell them apart.",
            TIMED,
        ),
        columns=("case", "error", *(clean(s, 40) for s in present)),
        rows=tuple(rows),
    )


def _kinds(found: Mapping[str, TimeAtAccuracy]) -> dict[str, str]:
    """Rank the times of a row; what is only bounded from above has no place in it."""
    known = {s: m.time for s, m in found.items() if m.kind == "between" and m.time}
    if not known:
        return {}
    fastest = min(known.values(), key=lambda t: t.value)
    best = "" if any(m.kind == "looser" for m in found.values()) else "best"
    return {
        s: best if t.value == fastest.value
        else "tied" if t.low <= fastest.high and t.samples > 1
        else ""
        for s, t in known.items()
    }  # fmt: skip


def _cell(found: TimeAtAccuracy | None, tried: Sequence[Outcome], kind: str) -> Cell:
    if found is None:
        return Cell(text=ABSENT)
    reached = [o for o in tried if counts(o)]
    if found.time is None:
        if all(o.verdict is Verdict.DECLINED for o in tried):
            return Cell(text="declined", kind="quiet")
        closest = min((o.largest("energy_bound") or 0.0 for o in reached), default=None)
        after = "" if closest is None else f"at best {power(closest)}"
        return Cell(text="not reached", after=after, kind="quiet")
    runs = " ".join(i for o in reached for i in o.run_ids)
    looser = found.kind == "looser"
    return Cell(
        text=("≤ " if looser else "") + seconds(found.time),
        after="below the loosest tolerance" if looser else "",
        symbol="≈" if kind == "tied" else "",
        kind=kind,
        value=found.time.value,
        title=clean(f"from runs {runs}", 400),
    )


def certified_picture(
    swept: Sweeps, solvers: Sequence[str], meshes: Mapping[str, Discretisation]
) -> Picture:
    """Draw certified error against time for the first few cases."""
    drawn = dict([*swept.items()][:_PANELS])
    rest = f" The first {len(drawn)} of {len(swept)} cases." * (len(swept) > len(drawn))
    errors = {
        physical: mesh.error
        for physical, mesh in meshes.items()
        if mesh.kind in ("limit", "change") and mesh.error
    }
    lines = (
        " Below a tenth of the discretisation error, more digits say no more about the "
        "bodies; where refinement has no limit, it is the change to the next mesh."
    ) * any(_physical(row) in errors for row in drawn.values())
    return Picture(
        name="certified",
        caption="Certified relative error in the energy norm against the median total "
        "time, a line per solver through the tolerances asked for. Bars: interval of "
        "the median. Filled: the solver's own test ended the solve; hollow: a limit "
        f"did, or it gave up.{lines}{rest}",
        figure=certified_figure([*drawn.items()], solvers, errors),
    )


def _physical(row: Mapping[str, Sequence[Outcome]]) -> str:
    return next(iter(row.values()))[0].physical
