"""How much accuracy was worth paying for: solver errors beside those of the mesh."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from statistics import median

from mortarbench.harness.crossval.discretisation import (
    Discretisation,
    read_discretisation,
)
from mortarbench.harness.running.pairs import ratio_of
from mortarbench.reports.data.cells import source
from mortarbench.reports.data.evidence import Evidence, Outcome
from mortarbench.reports.data.time_at_accuracy import counts
from mortarbench.reports.document.formatting import (
    ABSENT,
    TIMED,
    clean,
    plural,
    power,
    seconds,
    significant,
    tolerance,
)
from mortarbench.reports.document.layout import Cell, Section, Table, name_cell
from mortarbench.reports.document.mesh_errors import mesh_table
from mortarbench.reports.figures.sweeps import SHARE

_KNOWN = ("limit", "change")  #: kinds with an error to compare with

Priced = Mapping[str, Mapping[str, Sequence[Outcome]]]  #: case → solver, loosest first


def value_of_accuracy(evidence: Evidence) -> Section | None:
    """Set certified errors beside discretisation errors; None where none are known."""
    meshes = read_discretisation(evidence.directory)
    physical = dict.fromkeys(o.physical for o in evidence.flat)
    mine = {name: meshes[name] for name in physical if name in meshes}
    if not mine:
        return None
    priced = _priced(evidence, mine)
    present = [s for s in evidence.solvers if any(s in row for row in priced.values())]
    tables = [mesh_table(list(mine.values()))]
    if priced:
        tables += [_shares(priced, present, mine), _prices(priced, present, mine)]
    return Section(
        name="worth",
        title="How much accuracy was worth paying for",
        prose=(
            "A solver's error is certified against the solution on its mesh, and that "
            "solution is wrong itself: by the discretisation error, which a finer mesh "
            "would remove. A solver that adds less than a tenth of it is accurate "
            "enough for the bodies; what more digits cost says nothing about them.",
            *_headline(priced, mine),
        ),
        tables=tuple(tables),
    )


def _priced(
    evidence: Evidence, meshes: Mapping[str, Discretisation]
) -> dict[str, dict[str, list[Outcome]]]:
    """Group outcomes with a certified error on meshes with a known one."""
    found: dict[str, dict[str, list[Outcome]]] = {}
    for o in sorted(evidence.flat, key=lambda o: -o.tol):
        mesh = meshes.get(o.physical)
        if mesh and mesh.kind in _KNOWN and o.largest("energy_bound") is not None:
            found.setdefault(o.case, {}).setdefault(o.solver, []).append(o)
    return found


def _headline(priced: Priced, meshes: Mapping[str, Discretisation]) -> tuple[str, ...]:
    """Say over all cases and solvers what the digits beyond cost."""
    factors = [
        tight.value / enough.value
        for row in priced.values()
        for outcomes in row.values()
        if (ends := _ends(outcomes, meshes)) is not None
        and (enough := ends[0].seconds("total")) is not None
        and (tight := ends[1].seconds("total")) is not None
    ]
    if not factors:
        return ()
    return (
        f"Over {plural(len(factors), 'pair')} of case and solver, the tightest "
        "tolerance that was asked for took a median of "
        f"{significant(median(factors), 2)} times as long as the loosest that was "
        f"accurate enough (from {significant(min(factors), 2)} to "
        f"{significant(max(factors), 2)} times).",
    )


def _shares(
    priced: Priced, solvers: Sequence[str], meshes: Mapping[str, Discretisation]
) -> Table:
    rows = []
    for case, row in priced.items():
        at = {s: {o.tol: o for o in outcomes} for s, outcomes in row.items()}
        for tol in sorted({t for of in at.values() for t in of}, reverse=True):
            cells = [_fraction(at.get(s, {}).get(tol), meshes) for s in solvers]
            rows.append((name_cell(case), Cell(text=tolerance(tol), value=tol), *cells))
    return Table(
        caption="Certified error of the solver over the discretisation error.",
        notes=(
            "In parentheses: the solver did not claim to have solved it, or a limit "
            "ended it. Marked: more than a tenth.",
        ),
        columns=("case", "tol", *(clean(s, 40) for s in solvers)),
        rows=tuple(rows),
    )


def _fraction(outcome: Outcome | None, meshes: Mapping[str, Discretisation]) -> Cell:
    if outcome is None:
        return Cell()
    share = share_of(outcome, meshes)
    assert share is not None
    text = power(share)
    return Cell(
        text=text if counts(outcome) else f"({text})",
        kind="over" if share > SHARE else "",
        value=share,
        title=source(outcome),
    )


def share_of(outcome: Outcome, meshes: Mapping[str, Discretisation]) -> float | None:
    """Divide the certified error by the discretisation error, where both are known."""
    bound, mesh = outcome.largest("energy_bound"), meshes.get(outcome.physical)
    if bound is None or mesh is None or mesh.kind not in _KNOWN or not mesh.error:
        return None
    return bound / mesh.error


def _ends(
    outcomes: Sequence[Outcome], meshes: Mapping[str, Discretisation]
) -> tuple[Outcome, Outcome] | None:
    """Pick the loosest tolerance that is accurate enough, and the tightest reached."""
    reached = [o for o in outcomes if counts(o)]
    enough = [o for o in reached if (share_of(o, meshes) or 0.0) <= SHARE]
    if not enough:
        return None
    return max(enough, key=lambda o: o.tol), min(reached, key=lambda o: o.tol)


def _prices(
    priced: Priced, solvers: Sequence[str], meshes: Mapping[str, Discretisation]
) -> Table:
    rows = [
        (name_cell(case), *(_price(row.get(s, ()), meshes) for s in solvers))
        for case, row in priced.items()
    ]
    return Table(
        caption="What was accurate enough: median total time at the loosest tolerance "
        "with an error below a tenth of the discretisation error, and how many "
        "times as long the tightest tolerance took.",
        notes=(
            "The factor's interval is Student's, over the logarithms of its repeats.",
            TIMED,
        ),
        columns=("case", *(clean(s, 40) for s in solvers)),
        rows=tuple(rows),
    )


def _price(outcomes: Sequence[Outcome], meshes: Mapping[str, Discretisation]) -> Cell:
    ends = _ends(outcomes, meshes)
    if ends is None:
        return Cell(text="never enough" if outcomes else ABSENT, kind="quiet")
    enough, tightest = ends
    time = enough.seconds("total")
    assert time is not None
    return Cell(
        text=seconds(time),
        after=f"tol {tolerance(enough.tol)}{_further(enough, tightest)}",
        value=time.value,
        title=source(enough),
    )


def _further(enough: Outcome, tightest: Outcome) -> str:
    if enough is tightest:
        return ", the tightest"
    ratio = ratio_of(tightest.by_block, enough.by_block)
    at = f"times as long at {tolerance(tightest.tol)}"
    if ratio is not None:
        return f"; {ratio.value:.2f} [{ratio.low:.2f}, {ratio.high:.2f}] {at}"
    a, b = tightest.seconds("total"), enough.seconds("total")
    return f"; {a.value / b.value:.2f} [1 run] {at}" if a and b else ""
