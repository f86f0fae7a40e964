"""QPS: the MPS format of linear programs with a section for the quadratic term.

Fields are separated by white space. Therefore names cannot contain white space. Files
in fixed columns can be read if their names contain no spaces. Sections follow Maros and
Mészáros (1999), "A repository of convex quadratic programming problems", Optim. Methods
Softw. 11/12:

* N rows after the first are ignored; the RHS of the objective is the negative of the
  constant in the objective.
* A number R in RANGES changes  ≤ b  to [b − |R|, b],  ≥ b  to [b, b + |R|],  and  = b
  to [b, b + R] or, if R < 0, to [b + R, b].
* BOUNDS default to [0, ∞); a negative UP without LO removes the lower bound, as in
  commercial readers.
* QUADOBJ and QSECTION contain one triangle of P, and QMATRIX contains both triangles.
  The objective is ½xᵀPx + qᵀx; the diagonal entries are stored as in P, not halved.

Undefined names and malformed numbers raise an error that states the line number. (The
reader of HiGHS 1.15 ignores undefined names, and reads malformed numbers as 0.)

Writing and reading a QP whose P is exactly symmetric reproduces every number to the
last digit. If P is symmetric only up to rounding, its symmetric part is written. The
objective depends only on this part, and HiGHS rejects a QMATRIX whose triangles differ
in the last digit.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from scipy.sparse import coo_array, csc_array, tril, vstack

from mortarbench.harness import QP, InputError, Vector
from mortarbench.harness.errors import shortened, unknown
from mortarbench.harness.files.durable import replacing
from mortarbench.harness.files.qpfile import explicit_matrices
from mortarbench.problems.files.two_sided import MIN_INFINITE, TwoSidedQP

_NUMBER = re.compile(
    r"[+-]?(\d+(\.\d*)?|\.\d+)([ED][+-]?\d+)?|[+-]?INF(INITY)?",
    re.IGNORECASE | re.ASCII,
)


@dataclass(eq=False)
class _QPSModel:
    """Contents of the sections that have been read, by names of rows and columns."""

    #: type of each row: N, L, G or E
    rows: dict[str, str] = field(default_factory=dict)
    columns: dict[str, int] = field(default_factory=dict)
    #: coefficients by row and column
    entries: dict[tuple[str, str], float] = field(default_factory=dict)
    rhs: dict[str, float] = field(default_factory=dict)
    ranges: dict[str, float] = field(default_factory=dict)
    lower: dict[str, float] = field(default_factory=dict)
    upper: dict[str, float] = field(default_factory=dict)
    triangle: dict[tuple[str, str], float] = field(default_factory=dict)
    whole: dict[tuple[str, str], float] = field(default_factory=dict)
    sign: float = 1.0  #: −1 if the objective is maximised, otherwise 1
    objective: str = ""  #: name of the objective, the first row of type N


def parse_qps(text: str) -> tuple[TwoSidedQP, float]:
    """Parse the text of a QPS file; return the problem and the sign of its objective.

    If the objective is to be maximised, the sign is −1, and the returned problem is to
    minimise the negative objective, including its constant.

    Raises
    ------
    InputError
        If the text is malformed; the message states the line if possible.

    """
    model, section, ended = _QPSModel(), "", False
    for number, line in enumerate(text.splitlines(), 1):
        words = line.split()
        if not words or line.startswith("*"):
            continue
        try:
            if line[0].isspace():
                _data(model, section, words)
                continue
            section = words[0].upper()
            _header(model, section, words)
        except InputError as e:
            raise InputError(f"line {number}: {shortened(str(e), 400)}") from None
        if ended := section == "ENDATA":
            break
    if not ended:
        raise InputError("no ENDATA; the file is truncated or not QPS")
    if not model.objective:
        raise InputError("no row of type N; expected the objective among ROWS")
    if math.isinf(model.rhs.get(model.objective, 0.0)):
        raise InputError("the constant of the objective is infinite")
    return _two_sided(model), model.sign


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
    try:
        with replacing(path) as file:
            for line in _lines(qp, meta):
                file.write(f"{line}\n".encode())
    except OSError as e:
        raise InputError(f"{path}: cannot be written: {e.strerror}") from None


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


def _header(model: _QPSModel, section: str, words: list[str]) -> None:
    known = (*_SECTIONS, "NAME", "ENDATA")
    if section not in known:
        raise unknown("section", words[0], known)
    if section == "QSECTION" and words[1:] not in ([], [model.objective]):
        raise InputError(
            f"QSECTION {words[1]!r} belongs to a constraint; expected "
            f"{model.objective!r}"
        )
    if section == "OBJSENSE" and words[1:]:
        _sense(model, words[1:])


def _data(model: _QPSModel, section: str, words: list[str]) -> None:
    if section not in _SECTIONS:
        raise InputError(f"{words[0]!r} is outside every section; expected ROWS")
    _SECTIONS[section](model, words)


def _sense(model: _QPSModel, words: list[str]) -> None:
    senses = {"MIN": 1.0, "MINIMIZE": 1.0, "MAX": -1.0, "MAXIMIZE": -1.0}
    if words[0].upper() not in senses:
        raise unknown("objective sense", words[0], senses)
    model.sign = senses[words[0].upper()]


def _row(model: _QPSModel, words: list[str]) -> None:
    _expect(len(words) == 2, "a type and a name")
    kind, name = words[0].upper(), words[1]
    if kind not in ("N", "L", "G", "E"):
        raise unknown("row type", words[0], ("N", "L", "G", "E"))
    _new(name not in model.rows, f"row {name!r}")
    model.rows[name] = kind
    if kind == "N" and not model.objective:
        model.objective = name


def _column(model: _QPSModel, words: list[str]) -> None:
    if len(words) > 1 and words[1].strip("'") == "MARKER":
        raise InputError("integer variables; expected continuous variables")
    _expect(len(words) in (3, 5), "a column and one or two pairs of row and number")
    name = words[0]
    model.columns.setdefault(name, len(model.columns))
    for row, value in _pairs(model, words[1:], _finite):
        _new((row, name) not in model.entries, f"row {row!r} of column {name!r}")
        model.entries[row, name] = value


def _sides(target: str) -> Callable[[_QPSModel, list[str]], None]:
    """Return a reader of lines of RHS or RANGES, where the set name is optional."""

    def read(model: _QPSModel, words: list[str]) -> None:
        _expect(2 <= len(words) <= 5, "one or two pairs of row and number")
        values: dict[str, float] = getattr(model, target)
        for row, value in _pairs(model, words[len(words) % 2 :], _number):
            _new(row not in values, f"row {row!r}")
            values[row] = value

    return read


def _bound(model: _QPSModel, words: list[str]) -> None:
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
        name, value = rest[min(len(rest) - 1, 1)], math.inf
        if len(rest) == 2 and rest[1] not in model.columns:
            name = rest[0]
    else:
        _expect(len(rest) in (2, 3), "a column and a number")
        name, value = rest[-2], _number(rest[-1])
    _known_column(model, name)
    if kind in ("LO", "FX"):
        model.lower[name] = value
    if kind in ("UP", "FX", "PL", "FR"):
        model.upper[name] = value
    if kind in ("MI", "FR"):
        model.lower[name] = -math.inf


def _quadratic(target: str) -> Callable[[_QPSModel, list[str]], None]:
    def read(model: _QPSModel, words: list[str]) -> None:
        _expect(
            len(words) in (3, 5), "a column and one or two pairs of column and number"
        )
        values: dict[tuple[str, str], float] = getattr(model, target)
        i = words[0]
        for j, number in zip(words[1::2], words[2::2], strict=True):
            _known_column(model, i)
            _known_column(model, j)
            twice = (i, j) in values or (target == "triangle" and (j, i) in values)
            _new(not twice, f"entry {i!r}, {j!r}")
            values[i, j] = _finite(number)

    return read


_SECTIONS: dict[str, Callable[[_QPSModel, list[str]], None]] = {
    "OBJSENSE": _sense,
    "ROWS": _row,
    "COLUMNS": _column,
    "RHS": _sides("rhs"),
    "RANGES": _sides("ranges"),
    "BOUNDS": _bound,
    "QUADOBJ": _quadratic("triangle"),
    "QSECTION": _quadratic("triangle"),
    "QMATRIX": _quadratic("whole"),
}


def _two_sided(model: _QPSModel) -> TwoSidedQP:
    names, n = list(model.columns), len(model.columns)
    rows = {
        row: i for i, row in enumerate(k for k, v in model.rows.items() if v != "N")
    }
    sides = np.array([_limits(model, row) for row in rows]).reshape(-1, 2)
    A = [
        (rows[r], model.columns[c], v)
        for (r, c), v in model.entries.items()
        if r in rows
    ]
    P = [
        (model.columns[i], model.columns[j], v)
        for (i, j), v in (model.whole | model.triangle).items()
    ]
    P += [
        (model.columns[j], model.columns[i], v)
        for (i, j), v in model.triangle.items()
        if i != j
    ]
    objective = model.objective
    q = np.array([model.entries.get((objective, name), 0.0) for name in names])
    free = [model.upper.get(name, math.inf) < 0 for name in names]
    lower = [
        model.lower.get(name, -math.inf if f else 0.0)
        for name, f in zip(names, free, strict=True)
    ]
    return TwoSidedQP(
        P=model.sign * _sparse(P, (n, n)),
        q=model.sign * q,
        r=-model.sign * model.rhs.get(objective, 0.0),
        A=_sparse(A, (len(rows), n)),
        l=sides[:, 0],
        u=sides[:, 1],
        lb=np.array(lower),
        ub=np.array([model.upper.get(k, math.inf) for k in names]),
    )


def _limits(model: _QPSModel, row: str) -> tuple[float, float]:
    """Return l and u of a row from its type, right-hand side and range."""
    b, R = model.rhs.get(row, 0.0), model.ranges.get(row)
    match model.rows[row]:
        case "E":
            return b + min(R or 0.0, 0.0), b + max(R or 0.0, 0.0)
        case "L":
            return -math.inf if R is None else b - abs(R), b
        case _:
            return b, math.inf if R is None else b + abs(R)


def _sparse(entries: list[tuple[int, int, float]], shape: tuple[int, int]) -> coo_array:
    i, j, values = zip(*entries, strict=True) if entries else ((), (), ())
    at = (np.array(i, dtype=np.int64), np.array(j, dtype=np.int64))
    return coo_array((np.array(values, dtype=float), at), shape=shape)


def _pairs(
    model: _QPSModel, words: list[str], read: Callable[[str], float]
) -> list[tuple[str, float]]:
    for row in words[::2]:
        if row not in model.rows:
            raise InputError(f"row {row!r} is not among ROWS")
    return [(r, read(v)) for r, v in zip(words[::2], words[1::2], strict=True)]


def _known_column(model: _QPSModel, name: str) -> None:
    if name not in model.columns:
        raise InputError(f"column {name!r} is not among COLUMNS")


def _number(text: str) -> float:
    """Read a number in Fortran notation, or ±inf for an absent limit."""
    if not _NUMBER.fullmatch(text):
        raise InputError(f"{text!r} is not a number")
    if text[-1] not in "0123456789.":
        return float(text)
    value = float(text.upper().replace("D", "E"))
    if math.isinf(value):
        raise InputError(f"{text!r} exceeds 1.8e308")
    return value


def _finite(text: str) -> float:
    """Read a finite coefficient of a matrix or of the objective."""
    if math.isinf(value := _number(text)):
        raise InputError(f"{text!r} is not a finite number")
    return value


def _expect(right: bool, what: str) -> None:
    if not right:
        raise InputError(f"wrong number of fields; expected {what}")


def _new(new: bool, what: str) -> None:
    if not new:
        raise InputError(f"{what} is given twice; expected once")
