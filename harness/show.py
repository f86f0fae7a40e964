"""What commands print for people: aligned text from plain data."""

from __future__ import annotations

import inspect
import math
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from harness.record import Record, Verdict
from harness.solution import Status

#: of the quantities that the interface promises of elastic bodies; others are bare
UNITS = {
    "energy": "J/m",
    "tip": "m",
    "contact_force": "N/m",
    "multiplier_sum": "N/m",
    "max_von_mises": "Pa",
}


def first_sentence(thing: object) -> str:
    """Cut the docstring of an instance's class after its first sentence.

    Empty where the class has none but that which `dataclass` makes of its fields.
    """
    kind = type(thing)
    paragraph = (inspect.getdoc(kind) or "").partition("\n\n")[0]
    if paragraph.startswith(f"{kind.__name__}("):
        return ""
    sentence, dot, _ = (" ".join(paragraph.split()) + " ").partition(". ")
    return f"{sentence}." if dot else sentence.strip()


def first_comment(path: Path) -> str:
    """Read the comment that a suite starts with."""
    line = path.read_text("utf-8").partition("\n")[0]
    return line.removeprefix("#").strip() if line.startswith("#") else ""


def listing(rows: Iterable[Mapping[str, Any]]) -> str:
    """Lay out one line per row: name, description, and what can be set."""
    return aligned(
        [
            row["name"],
            row["description"],
            " ".join(
                f"{key}={value}"
                for key, value in (
                    row.get("defaults") or row.get("options", {})
                ).items()
            ),
            " | ".join(row.get("forms", ())),
        ]
        for row in rows
    )


def summary(records: Iterable[Record], solvers: Sequence[str]) -> str:
    """Count what each of `solvers` claimed and what of it is so; others come last."""
    latest = {r.run_id: r for r in records}.values()
    header = [
        "solver", "measured", "claimed solved", "verified", "refuted", "declined",
        "other",
    ]  # fmt: skip
    rows = [header]
    present = {r.solver for r in latest}
    for solver in dict.fromkeys([*solvers, *sorted(present)]):
        every = [r for r in latest if r.solver == solver]
        declined = [r for r in every if r.status is Verdict.DECLINED]
        own = [r for r in every if r.status is not Verdict.DECLINED]
        claimed = [r for r in own if r.claimed == Status.SOLVED]
        verified = [r for r in own if r.status is Verdict.VERIFIED]
        refuted = [r for r in claimed if r.status is not Verdict.VERIFIED]
        other = len(own) - len(verified) - len(refuted)
        counts = map(len, (own, claimed, verified, refuted, declined))
        rows.append([solver, *map(str, counts), str(other)])
    return aligned(rows, right=range(1, len(header)))


def outcome(r: Record) -> str:
    """Lay out one measurement, in SI units."""
    options = ", ".join(f"{key}={value}" for key, value in r.options.items())
    units = UNITS if "dofs" in r.quantities else {}
    rows = [
        ("case", r.case),
        ("size", ", ".join(f"{count} {what}" for what, count in r.sizes.items())),
        ("solver", f"{r.solver} ({options})" if options else r.solver),
        ("tolerance", f"{r.tol:g}"),
        ("status", f"{r.status} (claimed {r.claimed})"),
        ("message", r.message),
        ("iterations", _text(r.iterations)),
        ("counts", _text(r.counts)),
        ("it reports", _text(r.reported)),
        ("prepare", _text(r.prepare_seconds, "s (one run)", digits=3)),
        ("solve", _text(r.solve_seconds, "s (one run)", digits=3)),
        ("peak memory", _text(r.peak_mib, "MiB", digits=4)),
        *(
            (f"{name} residual", _text(_known(getattr(r, name)), digits=2))
            for name in ("primal", "dual", "complementarity", "gap")
        ),
        ("objective", _text(_known(r.objective))),
        *(
            (name.replace("_", " "), _text(value, units.get(name, "")))
            for name, value in r.quantities.items()
        ),
    ]
    return aligned([name, value] for name, value in rows if value)


def aligned(rows: Iterable[Sequence[str]], right: Iterable[int] = ()) -> str:
    """Pad columns to their widest cell; those listed in `right` on the left side."""
    table = list(rows)
    widths = [max(map(len, column)) for column in zip(*table, strict=True)]
    right = set(right)
    lines = (
        "  ".join(
            cell.rjust(width) if i in right else cell.ljust(width)
            for i, (cell, width) in enumerate(zip(row, widths, strict=True))
        )
        for row in table
    )
    return "\n".join(line.rstrip() for line in lines)


def _known(value: float | None) -> float | None:
    """Take NaN for what it says: there is no such number."""
    return None if value is None or math.isnan(value) else value


def _text(value: Any, unit: str = "", digits: int = 9) -> str:
    """Show a number, or nested numbers, with a unit; empty where there is nothing."""
    match value:
        case None:
            return ""
        case float():
            text = f"{value:.{digits}g}"
        case list() | tuple():
            text = f"({', '.join(_text(v, digits=digits) for v in value)})"
        case Mapping():
            parts = (f"{key} {_text(v, unit, digits)}" for key, v in value.items())
            return ", ".join(parts)
        case _:
            text = str(value)
    return f"{text} {unit}".rstrip()
