"""QPS: the MPS format of linear programs with a section for the quadratic term.

Fields are separated by white space or, if names contain spaces, are in fixed columns.
Sections follow Maros and Mészáros (1999), "A repository of convex quadratic programming
problems", Optim. Methods Softw. 11/12, and the format of CPLEX:

* N rows after the first are ignored; the RHS of the objective is the negative of the
  constant in the objective.
* A number R in RANGES changes  ≤ b  to [b − |R|, b],  ≥ b  to [b, b + |R|],  and  = b
  to [b, b + R] or, if R < 0, to [b + R, b].
* If RHS, RANGES or BOUNDS contain several sets, the first is used.
* BOUNDS default to [0, ∞); a negative UP without LO removes the lower bound, as in
  commercial readers.
* QUADOBJ and QSECTION contain one triangle of P, and QMATRIX contains both triangles.
  The objective is ½xᵀPx + qᵀx; the diagonal entries are stored as in P, not halved.
* A line that begins with * or $ is a comment, and so is the rest of a line from a field
  on, not before the third, that begins with * or $ and is not a name.

Undefined names and malformed numbers raise an error that states the line number. This
is why files are not read by HiGHS: its reader (1.15) ignores undefined names, and reads
malformed numbers as 0.

Writing and reading a QP whose P is exactly symmetric reproduces every number to the
last digit. If P is symmetric only up to rounding, its symmetric part is written. The
objective depends only on this part, and HiGHS rejects a QMATRIX whose triangles differ
in the last digit.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Container, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from scipy.sparse import coo_array, csc_array, tril, vstack

from mortarbench.harness import QP, InputError, Vector
from mortarbench.harness.errors import shortened, unknown
from mortarbench.harness.files.durable import writing
from mortarbench.harness.files.qpfile import explicit_matrices
from mortarbench.harness.qp import MIN_INFINITE
from mortarbench.problems.files.two_sided import TwoSidedQP, real_number, sparse


@dataclass(eq=False)
class _Model:
    """Contents of the sections that have been read, by names of rows and columns."""

    #: type of each row: N, L, G or E
    rows: dict[str, str] = field(default_factory=dict)
    columns: dict[str, int] = field(default_factory=dict)
    #: coefficients by row and column
    entries: dict[tuple[str, str], float] = field(default_factory=dict)
    #: numbers by section (RHS or RANGES) and row
    sides: dict[tuple[str, str], float] = field(default_factory=dict)
    lower: dict[str, float] = field(default_factory=dict)
    upper: dict[str, float] = field(default_factory=dict)
    bounds: dict[tuple[str, str], float] = field(default_factory=dict)  #: as in file
    #: entries of the triangle of P or, for QMATRIX, of P, by two columns
    quadratic: dict[tuple[str, str], float] = field(default_factory=dict)
    quadratic_section: str = ""  #: the section that contains these entries
    first_sets: dict[str, str] = field(default_factory=dict)  #: names by section
    remarks: dict[str, None] = field(default_factory=dict)  #: in order, without repeats
    maximise: bool = False
    objective: str = ""  #: name of the objective, the first row of type N


class _LineError(InputError):
    """Error on a line."""

    def __init__(self, message: str, number: int) -> None:
        super().__init__(f"line {number}: {message}")
        self.number = number  #: number of the line, from 1


def parse_qps(text: str) -> TwoSidedQP:
    """Parse the text of a QPS file.

    If the fields are not valid when split at white space, names may contain spaces, and
    the fields are in fixed columns.

    Raises
    ------
    InputError
        If the text is malformed; the message states the line if possible.

    """
    try:
        return _two_sided(_parsed(text, str.split))
    except _LineError as e:
        try:
            return _two_sided(_parsed(text, _fixed_columns))
        except _LineError as fixed:
            raise (e if e.number >= fixed.number else fixed) from None


def _parsed(text: str, split: Callable[[str], list[str]]) -> _Model:
    """Return the contents of all sections.

    split : function that splits a line into fields
    """
    model, section = _Model(), ""
    for number, line in enumerate(text.splitlines(), 1):
        if not line.strip() or line[0] in "*$":
            continue
        try:
            if line[0].isspace():
                if section not in _SECTIONS:
                    raise InputError("data outside every section; expected ROWS")
                _SECTIONS[section](model, section, _without_comment(model, split(line)))
                continue
            section = line.split()[0].upper()
            _header(model, section, line.split())
        except InputError as e:
            raise _LineError(shortened(str(e), 400), number) from None
        if section == "ENDATA":
            return model
    raise InputError("no ENDATA; the file is truncated or not QPS")


def _fixed_columns(line: str) -> list[str]:
    """Split a line whose names, which may contain spaces, are in fixed columns.

    The fields 1 to 3 are in the columns 2-3, 5-12 and 15-22. A number, and possibly a
    name and a number, follow from column 25 on.
    """
    if (line[3:4] + line[12:14] + line[22:24]).strip():
        raise InputError("the fields are neither free of spaces nor in fixed columns")
    number, _, rest = line[24:].strip().partition(" ")
    name, _, last = rest.strip().rpartition(" ")
    fields = (line[1:3], line[4:12], line[14:22], number, name, last)
    return [text for text in map(str.strip, fields) if text]


def _without_comment(model: _Model, words: list[str]) -> list[str]:
    """Remove a comment: from the third field on, a field that begins with $ or *.

    A field that is the name of a row or column does not begin a comment.
    """
    for i, word in enumerate(words):
        is_name = word in model.rows or word in model.columns
        if i > 1 and word[0] in "$*" and not is_name:
            return words[:i]
    return words


def _header(model: _Model, section: str, words: list[str]) -> None:
    known = (*_SECTIONS, "NAME", "ENDATA")
    if section not in known:
        raise unknown("section", words[0], known)
    if section in _QUADRATIC:
        if model.quadratic_section not in ("", section):
            raise InputError(
                f"{section} after {model.quadratic_section}; expected one of them"
            )
        model.quadratic_section = section
    if section == "QSECTION" and words[1:] not in ([], [model.objective]):
        raise InputError(
            f"QSECTION {words[1]!r} belongs to a constraint; expected "
            f"{model.objective!r}"
        )
    if section == "OBJSENSE" and words[1:]:
        _sense(model, section, words[1:])


def _sense(model: _Model, section: str, words: list[str]) -> None:
    senses = {"MIN": False, "MINIMIZE": False, "MAX": True, "MAXIMIZE": True}
    if words[0].upper() not in senses:
        raise unknown("objective sense", words[0], senses)
    model.maximise = senses[words[0].upper()]


def _row(model: _Model, section: str, words: list[str]) -> None:
    _expect(len(words) == 2, "a type and a name")
    kind, name = words[0].upper(), words[1]
    if kind not in ("N", "L", "G", "E"):
        raise unknown("row type", words[0], ("N", "L", "G", "E"))
    _store(model.rows, name, kind, f"row {name!r}")
    if kind == "N" and not model.objective:
        model.objective = name


def _column(model: _Model, section: str, words: list[str]) -> None:
    if len(words) > 1 and words[1].strip("'") == "MARKER":
        raise InputError("integer variables; expected continuous variables")
    _expect(len(words) in (3, 5), "a column and one or two pairs of row and number")
    name = words[0]
    model.columns.setdefault(name, len(model.columns))
    for row, number in zip(words[1::2], words[2::2], strict=True):
        _known(row, model.rows, "row", "ROWS")
        text = f"row {row!r} of column {name!r}"
        _store(model.entries, (row, name), _finite(number), text)


def _sides(model: _Model, section: str, words: list[str]) -> None:
    """Read a line of RHS or RANGES, in which the name of the set is optional."""
    _expect(2 <= len(words) <= 5, "one or two pairs of row and number")
    if len(words) % 2:
        name, *words = words
        if not _is_first_set(model, section, name):
            return
    for row, number in zip(words[::2], words[1::2], strict=True):
        _known(row, model.rows, "row", "ROWS")
        _store(model.sides, (section, row), real_number(number), f"row {row!r}")


def _is_first_set(model: _Model, section: str, name: str) -> bool:
    """Return True for the first set of a section; add a remark for other sets."""
    first = model.first_sets.setdefault(section, name)
    if name != first:
        model.remarks[
            f"{section}: the set {shortened(name)!r} is ignored; as in other readers, "
            f"only the first set, {shortened(first)!r}, is used"
        ] = None
    return name == first


def _bound(model: _Model, section: str, words: list[str]) -> None:
    kind, *rest = words
    kind = kind.upper()
    if kind in ("BV", "LI", "UI", "SC", "SI"):
        raise InputError(
            f"bound {kind} makes the variable discrete; expected continuous variables"
        )
    if kind not in ("LO", "UP", "FX", "FR", "MI", "PL"):
        raise unknown("bound type", words[0], ("LO", "UP", "FX", "FR", "MI", "PL"))
    if kind in ("FR", "MI", "PL"):
        _expect(1 <= len(rest) <= 3, "a column")
        # [set] column [ignored number]
        at, value = min(len(rest) - 1, 1), math.inf
        if len(rest) == 2 and rest[1] not in model.columns:
            at = 0
    else:
        _expect(len(rest) in (2, 3), "a column and a number")
        at, value = len(rest) - 2, real_number(rest[-1])
    name = rest[at]
    if at == 1 and not _is_first_set(model, section, rest[0]):
        return
    _known(name, model.columns, "column", "COLUMNS")
    _store(model.bounds, (kind, name), value, f"bound {kind} of column {name!r}")
    if kind in ("LO", "FX"):
        model.lower[name] = value
    if kind in ("UP", "FX", "PL", "FR"):
        model.upper[name] = value
    if kind in ("MI", "FR"):
        model.lower[name] = -math.inf


def _quadratic(model: _Model, section: str, words: list[str]) -> None:
    _expect(len(words) in (3, 5), "a column and one or two pairs of column and number")
    i = words[0]
    for j, number in zip(words[1::2], words[2::2], strict=True):
        for name in (i, j):
            _known(name, model.columns, "column", "COLUMNS")
        is_swapped = section != "QMATRIX" and model.columns[i] > model.columns[j]
        key = (j, i) if is_swapped else (i, j)
        _store(model.quadratic, key, _finite(number), f"entry {i!r}, {j!r}")


_QUADRATIC = ("QUADOBJ", "QSECTION", "QMATRIX")
_SECTIONS: dict[str, Callable[[_Model, str, list[str]], None]] = {
    "OBJSENSE": _sense,
    "ROWS": _row,
    "COLUMNS": _column,
    "RHS": _sides,
    "RANGES": _sides,
    "BOUNDS": _bound,
    **dict.fromkeys(_QUADRATIC, _quadratic),
}


def _two_sided(model: _Model) -> TwoSidedQP:
    objective = model.objective
    if not objective:
        raise InputError("no row of type N; expected the objective among ROWS")
    constant = -model.sides.get(("RHS", objective), 0.0)
    if math.isinf(constant):
        raise InputError("the constant of the objective is infinite")
    names = [name for name, kind in model.rows.items() if kind != "N"]
    rows, columns = {name: i for i, name in enumerate(names)}, model.columns
    n, upper = len(columns), [model.upper.get(name, math.inf) for name in columns]
    lower = [
        model.lower.get(name, -math.inf if high < 0 else 0.0)
        for name, high in zip(columns, upper, strict=True)
    ]
    limits = [_limits(model, name) for name in names]
    P = [(columns[i], columns[j], v) for (i, j), v in model.quadratic.items()]
    A = [(rows[r], columns[c], v) for (r, c), v in model.entries.items() if r in rows]
    if model.quadratic_section != "QMATRIX":
        P += [(j, i, v) for i, j, v in P if i != j]
    return TwoSidedQP(
        P=sparse(P, (n, n)),
        q=np.array([model.entries.get((objective, name), 0.0) for name in columns]),
        r=constant,
        A=sparse(A, (len(rows), n)),
        l=np.array([low for low, _ in limits]),
        u=np.array([high for _, high in limits]),
        lb=np.array(lower),
        ub=np.array(upper),
        maximise=model.maximise,
        rows=names,
        columns=[*columns],
        remarks=tuple(model.remarks),
    )


def _limits(model: _Model, row: str) -> tuple[float, float]:
    """Return l and u of a row from its type, right-hand side and range."""
    b, R = model.sides.get(("RHS", row), 0.0), model.sides.get(("RANGES", row))
    match model.rows[row]:
        case "E":
            return b + min(R or 0.0, 0.0), b + max(R or 0.0, 0.0)
        case "L":
            return -math.inf if R is None else b - abs(R), b
        case _:
            return b, math.inf if R is None else b + abs(R)


def _finite(text: str) -> float:
    """Read a finite coefficient of a matrix or of the objective."""
    if math.isinf(value := real_number(text)):
        raise InputError(f"{text!r} is not a finite number")
    return value


def _expect(right: bool, what: str) -> None:
    if not right:
        raise InputError(f"wrong number of fields; expected {what}")


def _known(name: str, known: Container[str], what: str, section: str) -> None:
    if name not in known:
        raise InputError(f"{what} {name!r} is not among {section}")


def _store(target: dict[Any, Any], key: object, value: object, what: str) -> None:
    if key in target:
        raise InputError(f"{what} is given twice; expected once")
    target[key] = value


def save_qps(path: Path, qp: QP, meta: Mapping[str, Any]) -> None:
    """Write `qp` as a QPS file; an operator P is assembled.

    meta : metadata of plain types, written as comments because QPS has no metadata

    Raises
    ------
    InputError
        If the QP has sets other than bounds, if a finite right-hand side or bound would
        be infinite in the format, or if the file cannot be written.

    """
    if len(qp.sets) > 1:
        raise InputError(
            f"{path}: QPS cannot store {type(qp.sets[1]).__name__}; "
            "expected .npz or .mat"
        )
    for name in ("b", "h", "lb", "ub"):
        values = getattr(qp, name)
        large = np.isfinite(values) & (np.abs(values) >= MIN_INFINITE)
        if large.any():
            raise InputError(
                f"{path}: {name} contains {values[large.argmax()]:g}, but QPS treats "
                f"{MIN_INFINITE:g} or more as infinite; expected .npz or .mat"
            )
    with writing(path) as file:
        for line in _lines(qp, meta):
            file.write(f"{line}\n".encode())


def _lines(qp: QP, meta: Mapping[str, Any]) -> Iterator[str]:
    """Yield the lines of a QPS file.

    Rows e1, e2, … represent Ax = b, rows i1, i2, … represent Gx ≤ h, and columns x1,
    x2, … represent the variables.
    """
    rows = [f"e{i + 1}" for i in range(qp.b.size)]
    rows += [f"i{i + 1}" for i in range(qp.h.size)]
    for key, value in meta.items():
        yield f"* {key}: {' '.join(str(value).split())}"
    yield f"NAME          {'_'.join(str(meta.get('name', 'QP')).split())}"
    yield "ROWS"
    yield " N  obj"
    yield from (f" {'E' if row[0] == 'e' else 'L'}  {row}" for row in rows)
    yield "COLUMNS"
    yield from _column_lines(
        csc_array(vstack([csc_array(qp.A), csc_array(qp.G)])), qp.q, rows
    )
    yield "RHS"
    sides = zip(rows, np.append(qp.b, qp.h), strict=True)
    yield from (f"    rhs       {row}  {_digits(side)}" for row, side in sides if side)
    yield "BOUNDS"
    for j, (low, high) in enumerate(zip(qp.lb, qp.ub, strict=True)):
        for kind, value in _bound_kinds(low, high):
            yield f" {kind} bnd       x{j + 1}  {value}".rstrip()
    P = csc_array(explicit_matrices(qp)[0]["P"])
    entries = coo_array(tril((P + P.T) / 2))
    yield "QUADOBJ"
    for i, j, value in zip(*entries.coords, entries.data, strict=True):
        yield f"    x{j + 1}  x{i + 1}  {_digits(value)}"
    yield "ENDATA"


def _column_lines(A: csc_array, q: Vector, rows: list[str]) -> Iterator[str]:
    """Yield the lines of each column, including columns without entries."""
    for j, cost in enumerate(q):
        part = slice(A.indptr[j], A.indptr[j + 1])
        if cost or part.start == part.stop:
            yield f"    x{j + 1}  obj  {_digits(cost)}"
        for i, value in zip(A.indices[part], A.data[part], strict=True):
            yield f"    x{j + 1}  {rows[i]}  {_digits(value)}"


def _bound_kinds(low: float, high: float) -> Iterator[tuple[str, str]]:
    """Yield the types and values of BOUNDS that change [0, ∞) to [low, high]."""
    if low == high:
        yield "FX", _digits(low)
        return
    if math.isinf(low):
        yield ("FR" if math.isinf(high) else "MI"), ""
    elif low:
        yield "LO", _digits(low)
    if not math.isinf(high):
        yield "UP", _digits(high)


def _digits(value: float) -> str:
    """Return the shortest text that is read as the same number."""
    return repr(float(value))
