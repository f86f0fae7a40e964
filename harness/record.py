"""Records of measurements, which are stored as lines of the journal."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Mapping
from dataclasses import MISSING, Field, dataclass, field, fields, replace
from enum import StrEnum
from functools import cache
from operator import attrgetter
from typing import TYPE_CHECKING, Any, NoReturn, Self, get_type_hints

from mortarbench.harness.errors import shown

if TYPE_CHECKING:
    from msgspec import Struct
    from msgspec.json import Decoder

#: Version of a journal line, which increases whenever the meaning of a field changes.
#: Version 2 changed the scales of the four residuals (docs/verdicts.md).
#: Version 3 judges by the rule of `harness.verify.kkt`; earlier versions are refused.
SCHEMA = 3
#: An answer counts as verified if its residuals are at most this multiple of the
#: tolerance.
VERIFIED_FACTOR = 10.0
LARGEST_INTEGER = 2**63 - 1  #: largest integer that 64-bit formats (Parquet) can store
#: smallest and largest valid measured time in s; 0 is also valid
SECONDS = (1e-12, 1e10)
MAX_LEVELS = 20  #: largest depth of nested lists and tables in a field

_WRONG_SCHEMA = f"not a journal line of schema {SCHEMA}"
_TOO_LARGE = "expected an integer of at most 64 bits"
#: fields whose values are equal in many lines; equal values are stored only once in
#: memory
_TEXTS = (
    "case", "family", "form", "solver", "claimed", "mode", "qp", "environment",
    "session",
)  # fmt: skip
_TABLES = ("params", "sizes", "options", "counts", "certificate", "quantities")


class Verdict(StrEnum):
    """Verdict on a measurement: states whether the claim of the solver is true."""

    #: every residual is ≤ min(10·tol, 0.1)
    VERIFIED = "verified"
    #: the solver claimed infeasibility, and a Farkas certificate holds; see
    #: `harness.verify.infeasibility`
    VERIFIED_INFEASIBLE = "verified_infeasible"
    #: the solver claimed an unbounded objective, and a ray and a feasible point hold
    VERIFIED_UNBOUNDED = "verified_unbounded"
    #: the solver claimed a solution, which is not verified but has at least half of the
    #: requested digits
    INACCURATE = "inaccurate"
    WRONG = "wrong"  #: the solver claimed a solution, but the claim is refuted
    #: the solver claimed infeasibility, but no certificate was found
    INFEASIBLE_CLAIM = "infeasible_claim"
    #: the solver claimed an unbounded objective, but no ray or feasible point was found
    UNBOUNDED_CLAIM = "unbounded_claim"
    ITERATION_LIMIT = "iteration_limit"
    TIME_LIMIT = "time_limit"
    MEMORY_LIMIT = "memory_limit"
    CRASHED = "crashed"  #: the process ended without an answer
    FAILED = "failed"  #: the solver raised an exception or stopped without a solution
    DECLINED = "declined"  #: the solver does not accept the QP

    @property
    def words(self) -> str:
        """The verdict as text, with spaces instead of underscores."""
        return self.value.replace("_", " ")

    @property
    def is_verified(self) -> bool:
        """True if a solution, or a claim that none exists, was verified.

        >>> from mortarbench import Verdict
        >>> [v.value for v in Verdict if v.is_verified]
        ['verified', 'verified_infeasible', 'verified_unbounded']
        """
        return self.value.startswith("verified")


#: Verdicts on claims that a QP has no solution, verified by a certificate.
PROVEN = (Verdict.VERIFIED_INFEASIBLE, Verdict.VERIFIED_UNBOUNDED)
#: Verdicts on claims that are not true, or not proven.
REFUTED = (
    Verdict.INACCURATE,
    Verdict.WRONG,
    Verdict.INFEASIBLE_CLAIM,
    Verdict.UNBOUNDED_CLAIM,
)


@dataclass(frozen=True, kw_only=True, slots=True)
class Measurement:
    """Time and memory needed to prepare and to solve; None if not measured.

    Every field is also a field of the journal, with a nonnegative value or null.
    `harness.verify.measure` sets the fields in the worker, and all fields are
    transferred to the record.
    """

    prepare_seconds: float | None = None
    solve_seconds: float | None = None
    total_seconds: float | None = None  #: prepare + solve
    peak_mib: float | None = None  #: peak resident memory of the worker
    prepare_peak_mib: float | None = None
    solve_peak_mib: float | None = None
    #: number of timed solves; times are means over these solves
    inner_loops: int = 1
    #: number of untimed solves before and between the timed ones; 0 if the first solve
    #: is timed, as for solves of more than a second and for steps of a sequence
    untimed_loops: int = 0
    #: True if the solver reuses answers of earlier solves, so that its times are not
    #: those of a solve; None if no QP with another objective was solved for comparison,
    #: see `harness.verify.measure`
    remembered: bool | None = None


MEASURED = tuple(f.name for f in fields(Measurement))


@dataclass(frozen=True, kw_only=True, slots=True)
class Record(Measurement):
    """A single run of one solver on one case at one tolerance; one JSON line.

    A record contains the task, the measured costs, the claim of the solver and the
    verdict. Values that were not measured, or cannot be measured, are None, since JSON
    has no NaN.
    """

    schema: int = SCHEMA
    #: digest of the task; equal in every run of the same suite, see `identity`
    run_id: str
    case: str  #: canonical name
    family: str
    params: Mapping[str, Any]
    form: str
    sizes: Mapping[str, int]  #: sizes of the QP, see `harness.qp.QP.sizes`
    solver: str  #: label in the suite
    options: Mapping[str, Any]  #: all options of the solver, including defaults
    tol: float
    repeat: int  #: number of the repeat, from 0
    block: int  #: number of the work unit, whose measurements ran consecutively
    verdict: Verdict
    #: status claimed by the solver; None if the solver made no claim
    claimed: str | None = None
    #: message of the solver, reason to decline, or description of the end of the worker
    message: str = ""
    iterations: int | None = None
    counts: Mapping[str, Any] = field(default_factory=dict)
    #: other data from the solver, such as its own times in seconds
    reported: Mapping[str, Any] = field(default_factory=dict)
    #: time to build the case, in the process that built it
    build_seconds: float | None = None
    #: part of `build_seconds` spent on the factorisation and the dual; dual forms only
    dualise_seconds: float | None = None
    recover_seconds: float | None = None  #: time to compute quantities from the point
    certify_seconds: float | None = None  #: time to compute `energy_bound`
    threads: int | None = None  #: largest thread count of any library in the worker
    cpu: int | None = None  #: number of the CPU to which the worker was bound
    ranks: int = 1  #: number of MPI processes of the solve
    #: "cold" for a single case; "sequence" if results of earlier steps may be reused
    mode: str = "cold"
    #: tolerance of the verdict if it differs from `tol`, as in accuracy sweeps; else
    #: None
    accuracy: float | None = None
    #: "" for an ordinary solver; "null" for the second copy of a solver in an A/A
    #: comparison, which measures the noise
    role: str = ""
    #: primal residual; `primal`, `dual`, `complementarity` and `gap` are defined in
    #: `harness.verify.kkt`
    primal: float | None = None
    dual: float | None = None
    complementarity: float | None = None
    gap: float | None = None
    #: True if P has no diagonal, so that the residuals are relative to estimated scales
    approximate_scale: bool = False
    #: certified bound on the relative error in the energy norm
    energy_bound: float | None = None
    #: relative components of `energy_bound`; see `harness.verify.verdicts.certified`
    certificate: Mapping[str, Any] = field(default_factory=dict)
    #: objective ½xᵀPx + qᵀx of the emitted QP at the answer
    objective: float | None = None
    #: physical results by name, in SI units
    quantities: Mapping[str, Any] = field(default_factory=dict)
    #: digest of the emitted QP, which identifies the problem; None if no QP was emitted
    qp: str | None = None
    environment: str = ""  #: digest of environment.json, or of a file in environments/
    node: str = ""  #: host name of the cluster node; empty without a cluster
    vectors: str | None = None  #: digest of the stored solution
    fields: str | None = None  #: digest of the stored deformed state
    started: str = ""  #: start of the measurement, UTC, ISO 8601
    session: str = ""  #: id of the run command; empty outside a result folder

    @property
    def identity(self) -> str:
        """Session and run_id, "SESSION-RUN_ID", which only this measurement has."""
        return f"{self.session}-{self.run_id}" if self.session else self.run_id

    @property
    def judged_at(self) -> float:
        """Tolerance on which the verdict is based."""
        return self.tol if self.accuracy is None else self.accuracy

    @property
    def claims_answer(self) -> bool:
        """True if a solution is claimed, or if a certificate verifies another claim."""
        return self.claimed == "solved" or self.verdict in PROVEN

    def replace(self, **changes: Any) -> Self:
        """Return a copy with the fields in `changes` replaced."""
        return replace(self, **changes)

    def to_dict(self) -> dict[str, Any]:
        """Return all fields by their journal names; nested data is not copied."""
        return {name: getattr(self, f.name) for name, f in JOURNAL.items()}

    def to_json(self) -> str:
        """Return one line of strict JSON.

        NaN, inf and integers beyond 64 bits become null.
        """
        return json.dumps(finite(self.to_dict()), allow_nan=False)

    @staticmethod
    def from_json(line: str | bytes, shared: dict[Any, Any] | None = None) -> Record:
        """Parse a journal line as written by `to_json`; unknown fields are ignored.

        Lone surrogates are escaped, since they cannot be encoded in UTF-8. If a key
        occurs several times, its last value counts.

        shared : texts and tables of earlier lines, to which the texts and tables of
            this line are added, so that equal objects are stored only once

        Raises
        ------
        ValueError
            If the line is not a JSON object, lacks a field, has an unknown schema, or
            if a field has a wrong type or an invalid value.

        """
        import msgspec  # imported here, since measuring processes do not need msgspec

        try:
            try:
                parsed = _decoder().decode(line)
            except msgspec.ValidationError as e:
                raise ValueError(_explained(e, _parsed(line))) from None
            # the line is malformed or contains a lone surrogate
            except msgspec.DecodeError:
                row = _escaped(_parsed(line))
                try:
                    parsed = msgspec.convert(row, _line())
                except msgspec.ValidationError as e:
                    raise ValueError(_explained(e, row)) from None
            record = msgspec.convert(parsed, Record, from_attributes=True)
            _check(record)
            return _share(record, {} if shared is None else shared)
        except RecursionError:
            raise ValueError(f"nested deeper than {MAX_LEVELS} levels") from None


#: journal names of attributes whose journal name differs from the attribute name
_JOURNAL_NAMES = {
    "verdict": "status",
    "inner_loops": "inner",
    "untimed_loops": "untimed",
    "role": "arm",
}


def in_space(quantities: Mapping[str, Any]) -> bool:
    """Return True if the quantities belong to three-dimensional bodies.

    Forces are then in N and energies in J, instead of N/m and J/m in 2D.
    """
    nodes, dofs = quantities.get("nodes"), quantities.get("dofs")
    return isinstance(nodes, int) and nodes > 0 and dofs == 3 * nodes


def journal_name(name: str) -> str:
    """Return the journal name of a field, given the name of its attribute."""
    return _JOURNAL_NAMES.get(name, name)


def _journal() -> dict[str, Field[Any]]:
    others = [f for f in fields(Record) if f.name not in MEASURED]
    at = [f.name for f in others].index("build_seconds")  # next to the other times
    ordered = (*others[:at], *fields(Measurement), *others[at:])
    return {journal_name(f.name): f for f in ordered}


#: fields of a record by their journal names, in their order within a journal line
JOURNAL: Mapping[str, Field[Any]] = _journal()
_NOT_NEGATIVE = (
    "repeat",
    "block",
    *MEASURED,
    "build_seconds",
    "dualise_seconds",
    "recover_seconds",
    "certify_seconds",
    "threads",
    "cpu",
    "primal",
    "dual",
    "complementarity",
    "gap",
    "energy_bound",
)
_SECONDS = tuple(name for name in _NOT_NEGATIVE if name.endswith("_seconds"))
_texts, _tables = attrgetter(*_TEXTS), attrgetter(*_TABLES)
_not_negative = attrgetter(*_NOT_NEGATIVE)
_seconds = attrgetter(*_SECONDS)


def _parsed(line: str | bytes) -> Any:
    """Parse strict JSON; refuse NaN and Infinity, which Python accepts."""

    def refuse(text: str) -> NoReturn:
        raise ValueError(f"{text} is not a number in JSON; expected null or a number")

    return json.loads(line, parse_constant=refuse)


@cache
def _decoder() -> Decoder[Struct]:
    from msgspec.json import Decoder

    return Decoder(_line())


@cache
def _line() -> type[Struct]:
    """Return the msgspec type of a journal line, with the journal names of fields."""
    import msgspec

    types = get_type_hints(Record)
    line: list[Any] = []
    for f in JOURNAL.values():
        if f.default_factory is not MISSING:
            default = msgspec.field(default_factory=f.default_factory)
        else:
            default = msgspec.NODEFAULT if f.default is MISSING else f.default
        line.append((f.name, types[f.name], default))
    return msgspec.defstruct("Line", line, rename=_JOURNAL_NAMES, kw_only=True)


def _explained(e: Exception, row: object) -> str:
    """Return the message for a journal line with a missing field or a wrong type.

    e : error of msgspec, which contains the path of the field
    """
    if not isinstance(row, dict) or row.get("schema") != SCHEMA:
        return _WRONG_SCHEMA
    place = re.search(r"at `\$\.(\w+)", str(e))
    if place is None:
        return f"incomplete journal line: {e}"
    name = place[1]
    annotation = str(JOURNAL[name].type)
    if annotation == "Verdict" and isinstance(row[name], str):
        annotation = f"one of {', '.join(Verdict)}"
    return f"{name} = {shown(row[name])}; expected {annotation}"


def _check(r: Record) -> None:
    """Check that all values are in their ranges.

    Raises
    ------
    ValueError
        If a value is out of range; the message states field, value and range.

    """
    if r.schema != SCHEMA:
        raise ValueError(_WRONG_SCHEMA)
    if not r.run_id:
        raise ValueError("run_id is empty; expected a nonempty string")
    for name, at in (("tol", r.tol), ("accuracy", r.accuracy)):
        if at is not None and not 0 < at <= 1:
            raise ValueError(f"{name} = {at!r}; expected a number above 0, at most 1")
    numbers = [n for n in _not_negative(r) if n]
    if numbers and not 0 < min(numbers) <= max(numbers) <= LARGEST_INTEGER:
        for name, value in zip(_NOT_NEGATIVE, _not_negative(r), strict=True):
            if (value or 0) < 0:
                name = journal_name(name)
                raise ValueError(f"{name} = {value!r}; expected a number of at least 0")
            _check_nested(journal_name(name), value, 0)
    if not 1 <= r.ranks <= LARGEST_INTEGER:
        raise ValueError(f"ranks = {r.ranks!r}; expected a number of ranks, 1 or more")
    _check_seconds(r)
    _check_nested("iterations", r.iterations, 0)
    _check_nested("reported", r.reported, MAX_LEVELS)


def _check_seconds(r: Record) -> None:
    for name, value in zip(_SECONDS, _seconds(r), strict=True):
        if value and not SECONDS[0] <= value <= SECONDS[1]:
            raise ValueError(
                f"{name} = {value!r}; expected 0, or {SECONDS[0]:g} to {SECONDS[1]:g}"
            )


def _share(record: Record, shared: dict[Any, Any]) -> Record:
    """Replace texts and tables by equal objects of earlier lines; check new tables."""
    for name, text in zip(_TEXTS, _texts(record), strict=True):
        object.__setattr__(record, name, shared.setdefault(text, text))
    for name, table in zip(_TABLES, _tables(record), strict=True):
        key = (repr(table),)  # a tuple, which differs from the keys of all texts
        if key not in shared:
            _check_nested(name, table, MAX_LEVELS)
            if name == "params":
                _check_values(table)
            shared[key] = table
        object.__setattr__(record, name, shared[key])
    return record


def _check_values(params: Mapping[str, Any]) -> None:
    """Raise ValueError for a list or a table, which a case name cannot contain."""
    for key, value in params.items():
        if isinstance(value, dict | list):
            raise ValueError(
                f"params.{key} = {shown(value)}; expected a number or a string"
            )


def _check_nested(where: str, data: Any, levels: int) -> None:
    """Raise ValueError if data are nested too deeply, or integers exceed 64 bits."""
    match data:
        case dict() | list() if not levels:
            raise ValueError(f"{where} is nested deeper than {MAX_LEVELS} levels")
        case dict():
            for key, value in data.items():
                _check_nested(f"{where}.{key}", value, levels - 1)
        case list():
            for value in data:
                _check_nested(where, value, levels - 1)
        case int() if abs(data) > LARGEST_INTEGER:
            raise ValueError(f"{where} = {shown(data)}; {_TOO_LARGE}")


def _escaped(data: Any) -> Any:
    """Escape the lone surrogates in nested plain data."""
    match data:
        case str():
            return data.encode(errors="backslashreplace").decode()
        case dict():
            return {_escaped(k): _escaped(v) for k, v in data.items()}
        case list():
            return [_escaped(v) for v in data]
        case _:
            return data


def finite(data: Any) -> Any:
    """Replace NaN, inf and integers beyond 64 bits in nested plain data by None.

    >>> from mortarbench.harness.record import finite
    >>> finite({"gap": [1e-9, float("nan")], "count": 3})
    {'gap': [1e-09, None], 'count': 3}
    """
    match data:
        case float():
            return data if math.isfinite(data) else None
        case int():
            return data if abs(data) <= LARGEST_INTEGER else None
        case dict():
            return {k: finite(v) for k, v in data.items()}
        case list() | tuple():
            return [finite(v) for v in data]
        case _:
            return data
