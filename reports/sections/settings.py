"""What was solved and under which conditions, what the numbers mean, what they do not.

Every case is listed with all of its parameters, and the sizes of its QP.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from mortarbench.reports.data.cells import source
from mortarbench.reports.data.environment import flatten
from mortarbench.reports.data.evidence import Evidence, Outcome
from mortarbench.reports.document.formatting import (
    ABSENT,
    TIMED,
    clean,
    plain_value,
    plural,
    tolerance,
)
from mortarbench.reports.document.layout import Cell, Section, Table, name_cell

_SIZES = ("variables", "equalities", "inequalities", "bounds")


def cases(evidence: Evidence) -> Section:
    """List every case, one table per family; records hold defaults with the rest."""
    found: dict[str, Outcome] = {}
    measured: dict[str, list[Outcome]] = {}
    for o in evidence.flat:
        measured.setdefault(o.case, []).append(o)
        if o.case not in found or not found[o.case].first.sizes:
            found[o.case] = o
    runs = {case: source(*outcomes) for case, outcomes in measured.items()}
    families = dict.fromkeys(o.first.family for o in found.values())
    return Section(
        name="cases",
        title="Cases",
        prose=(
            "A case name lists the parameters that differ from the defaults of the "
            "family; here are all of them, and the sizes of the QP that solvers got.",
        ),
        tables=tuple(
            _table(
                family, [o for o in found.values() if o.first.family == family], runs
            )
            for family in families
        ),
    )


def _table(family: str, outcomes: list[Outcome], runs: Mapping[str, str]) -> Table:
    """Give every parameter that varies a column, and the caption the others."""
    keys = list(dict.fromkeys(k for o in outcomes for k in o.first.params))
    values = {k: [_value(o, k) for o in outcomes] for k in keys}
    fixed = {k: v[0] for k, v in values.items() if len(set(v)) == 1}
    varying = [k for k in keys if k not in fixed]
    shared = ", ".join(f"{clean(k, 40)} = {v}" for k, v in fixed.items())
    count = plural(len(outcomes), "case")
    rows = [
        (
            name_cell(o.case),
            Cell(text=clean(o.first.form, 24)),
            *(_parameter(o, k) for k in varying),
            *(_size(o, name, runs[o.case]) for name in _SIZES),
        )
        for o in outcomes
    ]
    return Table(
        caption=f"Cases of {clean(family, 40)}: {count}.",
        notes=(f"{'The same for all' if rows[1:] else 'Parameters'}: {shared}.",)
        if shared
        else (),
        columns=("case", "form", *(clean(k, 40) for k in varying), *_SIZES),
        rows=tuple(rows),
        text_columns=2,
    )


def _value(outcome: Outcome, key: str) -> str:
    params = outcome.first.params
    return plain_value(params[key], 60) if key in params else ABSENT


def _parameter(outcome: Outcome, key: str) -> Cell:
    value = outcome.first.params.get(key)
    number = float(value) if isinstance(value, int | float) else None
    return Cell(text=_value(outcome, key), value=number)


def _size(outcome: Outcome, name: str, runs: str) -> Cell:
    n = outcome.first.sizes.get(name)
    if n is None:
        return Cell()
    return Cell(text=plain_value(n, 24), value=_number(n), title=runs)


def _number(value: object) -> float | None:
    return float(value) if isinstance(value, int | float) else None


def environment(evidence: Evidence) -> Section:
    """List machine, versions and limits as recorded."""
    leaves = flatten(evidence.environment)
    tables = [_settings(evidence), _options(evidence)]
    if leaves and evidence.environment:
        tables.append(_pairs("Environment, as recorded with the measurements.", leaves))
    return Section(
        name="environment",
        title="Environment and settings",
        tables=tuple(t for t in tables if t.rows),
    )


def _settings(evidence: Evidence) -> Table:
    suite = evidence.suite
    tols = sorted({r.tol for r in evidence.records}, reverse=True)
    limits = {
        "tolerances asked for": ", ".join(map(tolerance, tols)),
        "verified if every residual ≤": f"{evidence.factor:g} × tolerance",
        "repeats, each prepared afresh": 1 + max(r.repeat for r in evidence.records),
        "time limit in s": suite.get("time_limit"),
        "memory limit in MiB": suite.get("memory_limit"),
        "environment digest": ", ".join(
            sorted({r.environment for r in evidence.records if r.environment})
        ),
    }
    known = [(k, v) for k, v in limits.items() if v not in (None, "")]
    return _pairs("Settings of the run.", known)


def _options(evidence: Evidence) -> Table:
    """List the options of every solver, defaults resolved."""
    options = {r.solver: r.options for r in evidence.records}
    leaves = [(s, flatten(options[s])) for s in evidence.solvers if options[s]]
    return _pairs(
        "Options of the solvers, defaults resolved.",
        [(f"{s}.{k}", v) for s, pairs in leaves for k, v in pairs],
    )


def _pairs(caption: str, pairs: list[tuple[str, Any]]) -> Table:
    return Table(
        caption=caption,
        columns=("key", "value"),
        rows=tuple(
            (Cell(text=clean(k)), Cell(text=_plain(v), kind="words")) for k, v in pairs
        ),
    )


def _plain(value: Any) -> str:
    match value:
        case None:
            return "unknown"
        case bool():
            return "yes" if value else "no"
        case list() | tuple():
            return clean(", ".join(map(str, value)), 400) or "none"
        case _:
            return plain_value(value, 400)


def definitions(factor: float) -> Section:
    """Define residuals, verdicts and energies, and say what the report cannot show."""
    return Section(
        name="definitions",
        title="Definitions and limitations",
        prose=(
            r"Every problem is \(\min \tfrac12 x^{\mathsf T}Px + q^{\mathsf T}x\) "
            r"subject to \(Ax = b\), \(Gx \le h\), \(\mathrm{lb} \le x \le "
            r"\mathrm{ub}\), with multipliers such that \(Px + q + A^{\mathsf T}y + "
            r"G^{\mathsf T}z + z_\mathrm{box} = 0\), \(z \ge 0\), \(z_\mathrm{box} \le "
            r"0\) at an active lower and \(\ge 0\) at an active upper bound. "
            "Four residuals vanish exactly at a solution. None changes when the "
            "objective, a row or the unit of a variable is scaled. "
            r"\(E\) is the largest of \(|x^{\mathsf T}Px|\), \(|q^{\mathsf T}x|\) and "
            r"\(|b^{\mathsf T}y + h^{\mathsf T}z + \text{the bounds' term}|\), at "
            r"most \(10^4\) times the "
            "objective and at least a hundredth of what the least variable alone can "
            r"gain; \(X_j\) is the larger of \(|x_j|\) and the length over which the "
            r"energy changes by \(E\); \(S\) is the largest of \(\|Px\|\), \(\|q\|\) "
            r"and \(\|A^{\mathsf T}y + G^{\mathsf T}z + z_\mathrm{box}\|\) in "
            "the maximum norm. What rounding explains is taken off first. (Records of "
            "schema 1 have other scales.)",
        ),
        points=(
            r"Primal: the worst violation of a row or bound, relative to \(|b_i| + "
            r"\sum |a_{ij}|X_j\).",
            r"Dual: \(\|Px + q + A^{\mathsf T}y + G^{\mathsf T}z + z_\mathrm{box}"
            r"\|_\infty / S\), each component relative to its "
            r"own terms, unless the energy at stake is small against \(E\); and every "
            "multiplier of the wrong sign; one on an absent bound has the wrong sign.",
            r"Complementarity: the largest \(|\text{multiplier} \times \text{slack}| / "
            r"E\).",
            r"Gap: \(|\text{primal objective} - \text{dual objective}| / E\).",
            f"Verified: every residual ≤ {factor:g} × tol (and ≤ 0.1), whatever was "
            "claimed. "
            "Where a QP is small enough to be solved once more, the difference to its "
            "proven optimum decides instead (decided_by is then reference). "
            "Verified infeasible: a claim of infeasibility that a Farkas certificate, "
            "evaluated without rounding, proves. "
            "Inaccurate: success was claimed and refuted, but at least half of the "
            rf"digits are there (worst residual \(\le \sqrt{{{factor:g} \, "
            r"\mathrm{tol}}\)). Wrong: refuted "
            "beyond that.",
            "Failures keep the name of their cause: iteration, time or memory limit, "
            "crashed (the process died), failed (it raised or gave up), declined (it "
            "said beforehand why it cannot).",
            "Limitation: the same tolerance is not the same accuracy. Each solver "
            "tests it in its own norm, and many deliver more than they were asked for.",
            f"{TIMED} Conversion to the solver's own format counts as preparation.",
            "Limitation: times hold for the machine and the versions listed above.",
            "Limitation: multipliers are not unique where constraints are redundant, "
            "so energies and displacements are compared, never multipliers.",
        ),
    )
