"""Text output of commands, mainly tables with aligned columns."""

from __future__ import annotations

import inspect
import math
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mortarbench.harness.record import Record, Verdict, in_space

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from mortarbench.harness.solution import History

#: units of the quantities of elastic bodies; /m: per thickness, omitted in 3D. Other
#: quantities have no unit
UNITS = {
    "energy": "J/m",
    "dissipation": "J/m",
    "tip": "m",
    "corner": "m",
    "contact_radius": "m",
    "approach": "m",
    "p_max": "Pa",
    "contact_force": "N/m",
    "multiplier_sum": "N/m",
    "max_von_mises": "Pa",
    "tangential_force": "N/m",
    "stick_area": "m²",
    "stick_radius": "m",
    "displacement": "m",
    "normal_force": "N per m",
    "tangential_sum": "N per m",
    "published_error": "(relative)",
    "stress_error": "(dimensionless)",
}
_CONTACTS = "contacts"  #: quantity that maps each contact pair to a table of results
_CONTACT_UNITS = {
    "largest_pressure": "Pa",
    "mean_pressure": "Pa",
    "smallest_gap": "m",
    "half_width": "m",
    "pressed_area": "m²",
}


#: headings of the columns of a history, see `harness.solution`
_COLUMNS = {
    "free_gradient": "‖φ‖",
    "chopped_gradient": "‖β‖",
    "infeasibility": "‖Ax−b‖",
    "active": "at bound",
    "two_sided": "of two",
    "cost": "own cost",
}
#: columns of a history that are not shown, because times of single runs are unreliable
_HIDDEN = ("seconds",)
CLAIMED_SOLVED = "solved"  #: `harness.Status.SOLVED` in a record
_MAX_ROWS = 15  #: largest number of rows in a table of iterations


def first_sentence(thing: object) -> str:
    """Return the first sentence of the docstring of an object's class.

    The sentence is empty if the class has no docstring, or only the signature that
    `dataclass` generates.
    """
    kind = type(thing)
    paragraph = (inspect.getdoc(kind) or "").partition("\n\n")[0]
    if paragraph.startswith(f"{kind.__name__}("):
        return ""
    sentence, dot, _ = (" ".join(paragraph.split()) + " ").partition(". ")
    return f"{sentence}." if dot else sentence.strip()


def first_comment(path: Path) -> str:
    """Return the comment in the first line of a suite, or "" if there is no comment."""
    line = path.read_text("utf-8").partition("\n")[0]
    return line.removeprefix("#").strip() if line.startswith("#") else ""


def listing(rows: Iterable[Mapping[str, Any]]) -> str:
    """Return rows of name, description, keys and forms as aligned text.

    In a row for a solver, its options replace the keys.
    """
    return align(
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


def summary(records: Sequence[Record], solvers: Sequence[str]) -> str:
    """Count the claims and verdicts of each solver, in a table with a header.

    The rows of `solvers` come first, followed by the rows of other solvers in
    `records`.
    """
    header = [
        "solver",
        "measured",
        "claimed solved",
        "verified",
        "refuted",
        "declined",
        "other",
    ]
    rows = [header]
    present = {r.solver for r in records}
    for solver in dict.fromkeys([*solvers, *sorted(present)]):
        every = [r for r in records if r.solver == solver]
        declined = [r for r in every if r.status is Verdict.DECLINED]
        measured = [r for r in every if r.status is not Verdict.DECLINED]
        claimed = [r for r in measured if r.claimed == CLAIMED_SOLVED]
        verified = [r for r in measured if r.status.is_verified]
        refuted = [r for r in claimed if not r.status.is_verified]
        other = len(measured) - len(verified) - len(refuted)
        counts = map(len, (measured, claimed, verified, refuted, declined))
        rows.append([solver, *map(str, counts), str(other)])
    return align(rows, right=range(1, len(header)))


def outcome(r: Record, options: Iterable[str]) -> str:
    """Return the results of one measurement as rows of name and value, in SI units.

    options : names of the options to show
    """
    chosen = ", ".join(f"{key}={r.options[key]}" for key in options)
    per = "" if in_space(r.quantities) else "/m"
    units = {}
    if "dofs" in r.quantities:
        units = {name: unit.replace("/m", per) for name, unit in UNITS.items()}
    several = r.inner > 1
    timed = f"s (mean of {r.inner} runs)" if several else "s (one run)"
    rows = [
        ("case", r.case),
        ("size", ", ".join(f"{count} {what}" for what, count in r.sizes.items())),
        ("solver", f"{r.solver} ({chosen})" if chosen else r.solver),
        ("tolerance", f"{r.tol:g}"),
        ("status", f"{r.status.words} (claimed {r.claimed})"),
        ("message", r.message),
        ("iterations", _text(r.iterations)),
        ("counts", _text(r.counts)),
        ("solver data", _text(r.reported)),
        ("prepare", _text(r.prepare_seconds, timed, digits=3)),
        ("solve", _text(r.solve_seconds, timed, digits=3)),
        ("peak memory", _text(r.peak_mib, "MiB", digits=4)),
        *(
            (f"{name} residual", _text(getattr(r, name), digits=2))
            for name in ("primal", "dual", "complementarity", "gap")
        ),
        ("solver error", _bound(r)),
        ("objective", _text(r.objective)),
        *(
            (name.replace("_", " "), _text(value, units.get(name, "")))
            for name, value in r.quantities.items()
            if name != _CONTACTS
        ),
        *_contacts(r.quantities.get(_CONTACTS), f"N{per}"),
    ]
    return align([(name, value) for name, value in rows if value])


def _contacts(pairs: object, force: str) -> list[tuple[str, str]]:
    """Return the rows of results for each contact pair.

    pairs : results by name of the pair; no rows are returned if `pairs` is not a
        mapping
    force : unit of forces
    """
    if not isinstance(pairs, Mapping):
        return []
    rows = []
    for name, values in pairs.items():
        parts = (
            f"{key.replace('_', ' ')} {_text(values.get(key), unit, digits=4)}"
            for key, unit in _CONTACT_UNITS.items()
            if values.get(key) is not None
        )
        rows.append((f"contact {name}", ", ".join(parts)))
        rows.append(("  force on", _text(values.get("force"), force, digits=6)))
    return rows


def _bound(r: Record) -> str:
    """Return the certified error bound as text, or "" if there is no bound.

    The bound may be in a seminorm, which excludes rigid motions.
    """
    if r.energy_bound is None:
        return ""
    beside = ", excluding rigid motions" if r.certificate.get("seminorm") else ""
    return (
        f"at most {r.energy_bound:.2g} in the energy norm (certified, relative{beside};"
        " the discretisation error is not included)"
    )


def convergence(history: History) -> str:
    """Return a table of the iterations that a solver reports; "" without a history.

    Each row shows the end of an outer iteration or, if the solver has no outer
    iterations, a single iteration. If there are more than 15 rows, 15 evenly spaced
    rows are shown. Steps are counted by type since the previous row, such as "c12 e3".
    """
    columns = {k: v for k, v in history.items() if v.size and k not in _HIDDEN}
    if not columns:
        return ""
    ends = _milestones(history)
    starts = [0, *(end + 1 for end in ends[:-1])]
    cells = [["iteration", *(str(end + 1) for end in ends)]]
    for name, values in columns.items():
        texts = (
            [_tally(values[a : b + 1]) for a, b in zip(starts, ends, strict=True)]
            if values.dtype.kind == "U"
            else [_entry(name, values[end].item()) for end in ends]
        )
        cells.append([_COLUMNS.get(name, name.replace("_", " ")), *texts])
    return align(zip(*cells, strict=True), right=range(len(cells)))


def _milestones(history: History) -> list[int]:
    """Return the indices of the iterations to show, see `convergence`."""
    import numpy as np

    length = next(iter(history.values())).size
    outer = history.get("outer", np.zeros(length))
    ends = [*np.flatnonzero(outer[1:] != outer[:-1]).tolist(), length - 1]
    if len(ends) == 1:
        ends = list(range(length))
    if len(ends) <= _MAX_ROWS:
        return ends
    shown = np.linspace(0, len(ends) - 1, _MAX_ROWS).round().astype(int)
    return [ends[i] for i in shown]


def _tally(letters: NDArray[np.str_]) -> str:
    import numpy as np

    kinds, numbers = np.unique(letters, return_counts=True)
    return " ".join(f"{k}{n}" for k, n in zip(kinds, numbers, strict=True))


def _entry(name: str, value: float) -> str:
    digits = ".8g" if name == "cost" or value == 0 else ".2e"
    return str(value) if isinstance(value, int) else f"{value:{digits}}"


def align(rows: Iterable[Sequence[str]], right: Iterable[int] = ()) -> str:
    """Return a table as text with aligned columns.

    right : indices of right-aligned columns; the others are left-aligned
    """
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


def _text(value: Any, unit: str = "", digits: int = 9) -> str:
    """Return a number or nested numbers as text with a unit; "" for None and NaN."""
    match value:
        case None:
            return ""
        case float() if math.isnan(value):
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
