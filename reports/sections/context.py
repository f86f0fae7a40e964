"""Sections on physics, cross-validation, settings and definitions."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from functools import partial
from itertools import islice
from typing import Any

import pandas as pd

from mortarbench.harness import InputError
from mortarbench.harness.files.reading import read_json
from mortarbench.harness.files.store import load_fields
from mortarbench.harness.record import in_space
from mortarbench.harness.results.folder import differences
from mortarbench.reports.answer import Row
from mortarbench.reports.document import (
    Item,
    Picture,
    Table,
    clean,
    number,
    plural,
    short_name,
    tolerance,
)
from mortarbench.reports.figures.bodies import description, fields_figure
from mortarbench.reports.figures.tractions import loaded_sides, traction_figure
from mortarbench.reports.measurements import Measurements
from mortarbench.reports.validation import inaccurate, solver_table

MOST_BODIES = 3  #: largest number of cases that are drawn
MOST_PROBLEMS = 12  #: largest number of problems in the table of quantities
#: quantities of the table, with their units in the plane (in space: without "/m")
QUANTITIES = {
    "energy": "J/m", "contact_force": "N/m", "multiplier_sum": "N/m", "active": "",
    "tip": "m", "max_von_mises": "Pa",
}  # fmt: skip
VALIDATION = "validation.json"


def physics(run: Measurements, rows: list[Row]) -> Iterator[Item]:
    """Compare energies, tabulate quantities, and draw deformed bodies."""
    del rows
    good = run.answers[run.answers.verified]
    good = good[[isinstance(q, dict) and "energy" in q for q in good.quantities]]
    if len(good):
        energy = pd.Series([float(q["energy"]) for q in good.quantities], good.index)
        groups = energy.groupby([good.problem, good.tol])
        spread = (groups.max() - groups.min()) / groups.median().abs()
        (problem, tol), worst = spread.idxmax(), spread.max()
        yield (
            f"Energies of verified answers to one problem, over solvers and forms, "
            f"differ by at most {number(float(worst), 2)} relative "
            f"({clean(problem)}, tol {tolerance(tol)})."
        )
        best = good.sort_values("residual").drop_duplicates("problem").sort_index()
        yield Table(
            name="quantities",
            head=("problem", *QUANTITIES),
            rows=tuple(
                (clean(p, 60), *(_quantity(q, name) for name in QUANTITIES))
                for p, q in islice(
                    zip(best.problem, best.quantities, strict=True), MOST_PROBLEMS
                )
            ),
            caption="Quantities of the most accurate verified answer, in SI units: per "
            "metre of thickness for plane problems.",
        )
    yield from _bodies(run)


def _quantity(of: Mapping[str, Any], name: str) -> str:
    value, unit = of.get(name), QUANTITIES[name]
    if in_space(of):
        unit = unit.removesuffix("/m")
    parts: list[Any] = value if isinstance(value, list) else [value]
    if not all(isinstance(v, int | float) for v in parts):
        return ""
    size = max((abs(v) for v in parts), default=0.0)
    if isinstance(value, int):  # a number of rows
        return str(value)
    shown = ", ".join("0" if abs(v) < 1e-6 * size else number(v, 4) for v in parts)
    return f"{f'({shown})' if len(parts) > 1 else shown} {unit}".strip()


def _bodies(run: Measurements) -> Iterator[Item]:
    stored = run.answers[run.answers.verified & run.answers.fields.notna()]
    # the last case in the order of the suite, such as the last load step
    stored = stored[::-1].sort_values("n", ascending=False, kind="stable")
    drawn = 0
    for (_, _), of in stored.groupby(["environment", "family"], sort=False):
        case = clean(str(of.case.iloc[0]))
        try:
            fields = load_fields(run.folder, of.fields.iloc[0])
        except InputError as e:  # a report needs only the journal
            yield clean(f"{case} is not drawn: {e}", 400)
            continue
        drawn += 1
        yield Picture(
            name=f"fields-{drawn}",
            caption=f"{case}: {description(fields)}.",
            draw=partial(fields_figure, fields),
        )
        if len(fields.cells) and loaded_sides(fields):
            yield Picture(
                name=f"tractions-{drawn}",
                caption=f"{case}: tractions along the contact sides.",
                draw=partial(traction_figure, fields),
            )
        if drawn == MOST_BODIES:
            return


def crossval(run: Measurements, rows: list[Row]) -> Iterator[Item]:
    """Summarise the results of ``mortarbench validate``, if it has been run."""
    del rows
    path = run.folder / VALIDATION
    if not path.exists():
        return
    data = read_json(path, "the results of a validation")
    yield clean(data["headline"], 600)
    yield from inaccurate(data)
    yield solver_table(data)


def settings(run: Measurements, rows: list[Row]) -> Iterator[Item]:
    """Tabulate the options of the solvers, the settings and the environment."""
    del rows
    df = run.df
    options = df.drop_duplicates("solver").set_index("solver").options
    tolerances = sorted(set(df.tol), reverse=True)
    sessions = plural(df.session.nunique(), "session")
    repeats = df.groupby(["case", "solver", "tol"]).size().max()
    lines = {
        "tolerances": ", ".join(map(tolerance, tolerances)),
        "verified if every residual ≤": f"{run.factor:g} · tolerance",
        "repeats": f"{repeats} in {sessions}, {df.started.min()} to {df.started.max()}",
    }
    if run.suite:
        time, memory = run.suite.time_limit, run.suite.memory_limit
        lines["limits"] = f"{time:g} s, {memory:g} MiB"
    lines |= {f"options of {s}": _in_a_line(options[s]) for s in run.solvers}
    environments = [e for e in run.environments.values() if e]
    if environments:
        lines |= {k: _in_a_line(v) for k, v in environments[0].items()}
    yield Table(
        name="settings",
        head=("setting", "value"),
        rows=tuple(
            (clean(str(k), 60), clean(v, 800))
            for k, v in lines.items()
            if v and k != "digest"
        ),
        caption="Settings, options including defaults, and environment; times in UTC.",
        texts=2,
    )
    for other in environments[1:]:
        changed = "; ".join(
            f"{key}: {short_name(str(a))} → {short_name(str(b))}"
            for key, a, b in islice(differences(environments[0], other), 12)
        )
        yield f"A further environment differs in {changed}."


def _in_a_line(value: Any) -> str:
    """Return nested plain data as one line of text."""
    match value:
        case Mapping():
            return ", ".join(f"{k} {_in_a_line(v)}" for k, v in value.items())
        case list():
            return ", ".join(map(_in_a_line, value))
    return "unknown" if value is None else str(value)


DEFINITIONS = (
    "Times are wall times of preparation (conversion, factorisation) and solve in a "
    "separate process with one thread on one CPU, starting with the assembled QP. The "
    "repeats of all solvers are interleaved in random order.",
    "A claim is verified if the relative residuals of primal feasibility, "
    "stationarity, complementarity and gap are at most 10 times the tolerance; they "
    "are computed from the original QP by the harness (docs/verdicts.md).",
    "The certified error bounds the error of the recovered displacements in the energy "
    "norm, relative to the solution, by the identity of Prager and Synge. Without "
    "mechanics, the error is √(|f − f*|/|f*|), with the objective f* of the verified "
    "answer with the least residual.",
    "If a suite measures several tolerances, the first table compares solvers at equal "
    "error: a solver's time is that of its loosest tolerance whose answer is accurate "
    "enough.",
    "A solver is named fastest only among those that solved at least 90 % of the cases "
    "that any solver solved. Intervals that exclude 1 decide, one pair at a time, "
    "without a correction for the number of solvers.",
)


def definitions(run: Measurements, rows: list[Row]) -> Iterator[Item]:
    """State the definitions of times, verdicts, errors and comparisons."""
    del run, rows
    yield from DEFINITIONS
