"""One line of evidence: a measurement as plain data."""

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

#: version of the journal line; raised whenever a field changes its meaning.
#: 2: the four residuals have other scales (docs/verdicts.md)
SCHEMA = 2
VERIFIED_FACTOR = 10.0  #: verified: every residual ≤ this times the tolerance
READABLE = (1, 2)  #: the versions that `Record.from_json` takes, each as it was meant
TIGHTENING = "sequence, tighten="  #: begins the mode of a sequence that tightens
LARGEST_INTEGER = 2**63 - 1  #: what arrays, Parquet and other readers can hold
SECONDS = (1e-12, 1e10)  #: between these is every time that is measured and not 0
MOST_LEVELS = 20  #: of what is nested in a field

_WRONG_SCHEMA = f"not a journal line of schema {' or '.join(map(str, READABLE))}"
_TOO_LARGE = "expected an integer of at most 64 bits"
#: fields that many lines share
_TEXTS = (
    "case", "family", "form", "solver", "claimed", "mode", "qp", "environment",
    "session",
)  # fmt: skip
_TABLES = ("params", "sizes", "options", "counts", "certificate", "quantities")


class Verdict(StrEnum):
    """Our judgement of a measurement, whatever the solver claimed."""

    VERIFIED = "verified"  #: every residual ≤ 10·tol, or `optimum_error` where known
    #: claimed infeasible, and proven by a certificate: `harness.verify.infeasibility`
    VERIFIED_INFEASIBLE = "verified_infeasible"
    INACCURATE = "inaccurate"  #: claimed solved; at least half the digits are there
    WRONG = "wrong"  #: claimed solved, refuted
    INFEASIBLE_CLAIM = "infeasible_claim"  #: not proven
    ITERATION_LIMIT = "iteration_limit"
    TIME_LIMIT = "time_limit"
    MEMORY_LIMIT = "memory_limit"
    CRASHED = "crashed"  #: the process died
    FAILED = "failed"  #: it raised or gave up
    DECLINED = "declined"  #: it said beforehand why it cannot

    @property
    def words(self) -> str:
        """The verdict as text."""
        return self.value.replace("_", " ")

    @property
    def is_verified(self) -> bool:
        """True for a right answer: a solution, or a proof that there is none."""
        return self in (Verdict.VERIFIED, Verdict.VERIFIED_INFEASIBLE)


@dataclass(frozen=True, kw_only=True, slots=True)
class Measurement:
    """What preparing and solving cost; None where nothing was measured.

    Every field is one of the journal, too: what is added here, and filled in by
    `harness.verify.measure`, is carried from the worker to the record as it is. It is
    no negative number.
    """

    prepare_seconds: float | None = None
    solve_seconds: float | None = None
    total_seconds: float | None = None  #: prepare + solve
    peak_mib: float | None = None  #: resident memory of the worker, peak
    prepare_peak_mib: float | None = None
    solve_peak_mib: float | None = None
    inner_loops: int = 1  #: prepared and solved so often; the seconds are the mean


MEASURED = tuple(f.name for f in fields(Measurement))


@dataclass(frozen=True, kw_only=True, slots=True)
class Record(Measurement):
    """One solver on one case at one tolerance, once: plain scalars, one JSON line.

    It is a measurement together with what was asked for, what the solver said of its
    answer, and what we find of it.

    None stands for what was not or cannot be measured (NaN has no place in JSON).
    """

    schema: int = SCHEMA
    run_id: str  #: names the measurement; equal cells of equal suites have equal ids
    case: str  #: canonical name
    family: str
    params: Mapping[str, Any]
    form: str
    sizes: Mapping[str, int]  #: variables, equalities, inequalities, bounds of the QP
    solver: str  #: its label in the suite
    options: Mapping[str, Any]  #: every option of the solver, defaults resolved
    tol: float
    repeat: int  #: 0, 1, …
    block: int  #: measurements of one block ran next to each other in time
    verdict: Verdict
    claimed: str | None = None  #: the solver's own status
    message: str = ""  #: its words, the reason it declined, or how it died
    iterations: int | None = None
    counts: Mapping[str, Any] = field(default_factory=dict)
    reported: Mapping[str, Any] = field(
        default_factory=dict
    )  #: its linear solver, its own times in seconds
    build_seconds: float | None = None  #: of the case, in the process that built it
    dualise_seconds: float | None = (
        None  #: part of build: factor, dual; dual forms only
    )
    recover_seconds: float | None = None  #: from the point to quantities
    certify_seconds: float | None = None  #: from a new point to energy_bound
    canary_seconds: float | None = None  #: a fixed kernel, just before: drift
    threads: int | None = None  #: most threads of any library in the worker, as checked
    cpu: int | None = None  #: that the worker was bound to
    ranks: int = 1  #: processes of MPI that solved it together
    #: of the solve on ranks, [mean, largest] of these, s: products, exchange, coarse,
    #: waiting; see `harness.distributed.vectors.Ranks`
    rank_seconds: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    #: alike: reductions, messages sent to neighbours, bytes of these
    rank_counts: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    #: alike: what one of these takes, s: reduction_seconds, message_seconds,
    #: seconds_per_byte; see `harness.distributed.network`
    rank_network: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    #: or "sequence": may use what earlier steps left; "sequence, tighten=θ": to
    #: tolerances that tighten, see `Record.tighten`
    mode: str = "cold"
    #: solved to and judged at, where that is looser than `tol`: an early step of a
    #: sequence that tightens
    step_tol: float | None = None
    accuracy: float | None = None  #: judged at, where that is not `tol`: a sweep
    #: "null": the same solver once more, to show the noise; "copies": as many of it at
    #: once as there are `ranks`, each by itself
    role: str = ""
    primal: float | None = None  #: the four scale-free residuals of harness.verify.kkt
    dual: float | None = None
    complementarity: float | None = None
    gap: float | None = None
    #: "reference" where `optimum_error` decided the verdict, and not the residuals;
    #: "certificate" where a claim of infeasibility was proven
    decided_by: str = "residuals"
    optimum_error: float | None = (
        None  #: against the proven optimum, harness.verify.optimum
    )
    energy_bound: float | None = None  #: certified relative error, energy norm
    #: what it is made of, as relative; see `harness.verify.verdicts.certified`
    certificate: Mapping[str, Any] = field(default_factory=dict)
    objective: float | None = None  #: ½xᵀPx + qᵀx of the emitted QP
    quantities: Mapping[str, Any] = field(default_factory=dict)  #: physical, SI
    qp: str | None = None  #: digest of the emitted QP; None in old journals
    environment: str = ""  #: digest of environment.json or of one in environments/
    node: str = ""  #: host name, where a cluster measured
    vectors: str | None = None  #: digest of the stored solution
    fields: str | None = None  #: digest of the stored deformed state
    started: str = ""  #: UTC, ISO 8601
    session: str = ""  #: of one command; empty in journals from before there were any

    @property
    def tighten(self) -> float:
        """θ of a sequence whose tolerances tighten towards `tol`, else 0.

        A step of it is solved to max(tol, θ·`harness.plugin.Case.unsettled`).
        """
        _, _, number = self.mode.partition(TIGHTENING)
        return float(number or 0)

    @property
    def asked_tol(self) -> float:
        """The tolerance that the solver was given."""
        return self.tol if self.step_tol is None else self.step_tol

    @property
    def judged_at(self) -> float:
        """The tolerance that the verdict is about."""
        return self.asked_tol if self.accuracy is None else self.accuracy

    @property
    def claims_answer(self) -> bool:
        """True if the solver claims a solution, or rightly that there is none."""
        return self.claimed == "solved" or self.verdict is Verdict.VERIFIED_INFEASIBLE

    def replace(self, **changes: Any) -> Self:
        """Copy with some fields changed."""
        return replace(self, **changes)

    def to_dict(self) -> dict[str, Any]:
        """Give every field by its name in the journal; nested data is not copied."""
        return {name: getattr(self, f.name) for name, f in JOURNAL.items()}

    def to_json(self) -> str:
        """Serialise to one line of strict JSON.

        NaN, inf and integers that no reader can hold become null. A line from before
        there were sessions, or steps with a tolerance of their own, is written as it
        was read.
        """
        row = finite(self.to_dict())
        if not self.session:
            del row["session"]
        if self.step_tol is None:
            del row["step_tol"]
        if self.ranks == 1:
            del row["ranks"]
        for name in ("rank_seconds", "rank_counts", "rank_network"):
            if not row[name]:
                del row[name]
        return json.dumps(row, allow_nan=False)

    @staticmethod
    def from_json(line: str | bytes, shared: dict[Any, Any] | None = None) -> Record:
        """Parse what `to_json` wrote; fields that we do not know are ignored.

        A lone surrogate, which no file can hold, is spelt out. Of a key that is there
        twice the last one counts.

        shared : texts and tables of the lines before; what equals one of them is held
            in memory once

        Raises
        ------
        ValueError
            When the line is no JSON object, lacks a field, has another schema, or a
            field of the wrong type or out of its range.

        """
        import msgspec  # here: the processes that measure read no journal

        try:
            try:
                parsed = _decoder().decode(line)
            except msgspec.ValidationError as e:
                raise ValueError(_explained(e, _parsed(line))) from None
            except msgspec.DecodeError:  # no JSON, or a lone surrogate
                row = _spelt(_parsed(line))
                try:
                    parsed = msgspec.convert(row, _line())
                except msgspec.ValidationError as e:
                    raise ValueError(_explained(e, row)) from None
            record = msgspec.convert(parsed, Record, from_attributes=True)
            _check(record)
            return _share(record, {} if shared is None else shared)
        except RecursionError:
            raise ValueError(f"nested deeper than {MOST_LEVELS} levels") from None


#: what fields are called in the journal, where that is not the name in the code
_JOURNAL_NAMES = {"verdict": "status", "inner_loops": "inner", "role": "arm"}


def in_space(quantities: Mapping[str, Any]) -> bool:
    """Return whether these are of bodies in space, which have no thickness.

    Forces are in N there and energies in J, in the plane in N/m and J/m.
    """
    nodes, dofs = quantities.get("nodes"), quantities.get("dofs")
    return isinstance(nodes, int) and nodes > 0 and dofs == 3 * nodes


def journal_name(name: str) -> str:
    """Give the name in the journal of a field."""
    return _JOURNAL_NAMES.get(name, name)


def _journal() -> dict[str, Field[Any]]:
    own = [f for f in fields(Record) if f.name not in MEASURED]
    at = [f.name for f in own].index("build_seconds")  # of what else took time
    ordered = (*own[:at], *fields(Measurement), *own[at:])
    return {journal_name(f.name): f for f in ordered}


#: the fields of a record by their names in the journal, in the order of a line
JOURNAL: Mapping[str, Field[Any]] = _journal()
_NOT_NEGATIVE = (
    "repeat", "block", *MEASURED, "build_seconds", "dualise_seconds",
    "recover_seconds", "certify_seconds", "canary_seconds", "threads", "cpu", "primal",
    "dual", "complementarity", "gap", "energy_bound", "optimum_error",
)  # fmt: skip
_SECONDS = tuple(name for name in _NOT_NEGATIVE if name.endswith("_seconds"))
_texts, _tables = attrgetter(*_TEXTS), attrgetter(*_TABLES)
_not_negative = attrgetter(*_NOT_NEGATIVE)
_seconds = attrgetter(*_SECONDS)


def _parsed(line: str | bytes) -> Any:
    """Parse JSON without the constants that only Python knows."""

    def refuse(text: str) -> NoReturn:
        raise ValueError(f"{text} is no number in JSON; expected null or a number")

    return json.loads(line, parse_constant=refuse)


@cache
def _decoder() -> Decoder[Struct]:
    from msgspec.json import Decoder

    return Decoder(_line())


@cache
def _line() -> type[Struct]:
    """Make the type of a journal line: a record's fields, by the journal's names."""
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
    """Say which field of a journal line has the wrong type, and its value."""
    if not isinstance(row, dict) or row.get("schema") not in READABLE:
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
    """Refuse a record with a value out of its range.

    Raises
    ------
    ValueError
        With the field, its value, and what would be right.

    """
    if r.schema not in READABLE:
        raise ValueError(_WRONG_SCHEMA)
    if not r.run_id:
        raise ValueError("run_id is empty; expected a text")
    for name, at in (
        ("tol", r.tol), ("accuracy", r.accuracy), ("step_tol", r.step_tol)
    ):  # fmt: skip
        if at is not None and not 0 < at <= 1:
            raise ValueError(f"{name} = {at!r}; expected a number above 0, at most 1")
    theta = r.mode.removeprefix(TIGHTENING)
    if theta != r.mode and not re.fullmatch(r"0\.[0-9]+|[0-9.]+e-[0-9]+", theta):
        raise ValueError(
            f"mode = {shown(r.mode)}; expected {TIGHTENING}θ, θ between 0 and 1"
        )
    numbers = [n for n in _not_negative(r) if n]
    if numbers and not 0 < min(numbers) <= max(numbers) <= LARGEST_INTEGER:
        for name, value in zip(_NOT_NEGATIVE, _not_negative(r), strict=True):
            if (value or 0) < 0:
                name = journal_name(name)
                raise ValueError(f"{name} = {value!r}; expected no negative number")
            _check_nested(journal_name(name), value, 0)
    if not 1 <= r.ranks <= LARGEST_INTEGER:
        raise ValueError(f"ranks = {r.ranks!r}; expected a number of ranks, 1 or more")
    _check_seconds(r)
    _check_nested("iterations", r.iterations, 0)
    _check_nested("reported", r.reported, MOST_LEVELS)
    _check_spent("rank_seconds", r.rank_seconds)
    _check_spent("rank_counts", r.rank_counts)
    _check_spent("rank_network", r.rank_network)


def _check_seconds(r: Record) -> None:
    for name, value in zip(_SECONDS, _seconds(r), strict=True):
        if value and not SECONDS[0] <= value <= SECONDS[1]:
            raise ValueError(
                f"{name} = {value!r}; expected 0, or {SECONDS[0]:g} to {SECONDS[1]:g}"
            )


def _check_spent(where: str, spent: Mapping[str, tuple[float, float]]) -> None:
    for part, pair in spent.items():
        if not min(pair) >= 0:
            raise ValueError(
                f"{where}[{shown(part)}] = {pair!r}; expected no negative number"
            )


def _share(record: Record, shared: dict[Any, Any]) -> Record:
    """Replace texts and tables by equal ones met before; check those that are new."""
    for name, text in zip(_TEXTS, _texts(record), strict=True):
        object.__setattr__(record, name, shared.setdefault(text, text))
    for name, table in zip(_TABLES, _tables(record), strict=True):
        key = (repr(table),)  # a tuple: no text is taken for a table
        if key not in shared:
            _check_nested(name, table, MOST_LEVELS)
            if name == "params":
                _check_values(table)
            shared[key] = table
        object.__setattr__(record, name, shared[key])
    return record


def _check_values(params: Mapping[str, Any]) -> None:
    """Refuse what no case name can hold."""
    for key, value in params.items():
        if isinstance(value, dict | list):
            raise ValueError(
                f"params.{key} = {shown(value)}; expected a number or a text"
            )


def _check_nested(where: str, data: Any, levels: int) -> None:
    """Refuse what is nested too deeply, and integers that no reader can hold."""
    match data:
        case dict() | list() if not levels:
            raise ValueError(f"{where} is nested deeper than {MOST_LEVELS} levels")
        case dict():
            for key, value in data.items():
                _check_nested(f"{where}.{key}", value, levels - 1)
        case list():
            for value in data:
                _check_nested(where, value, levels - 1)
        case int() if abs(data) > LARGEST_INTEGER:
            raise ValueError(f"{where} = {shown(data)}; {_TOO_LARGE}")


def _spelt(data: Any) -> Any:
    """Spell out the lone surrogates inside nested plain data."""
    match data:
        case str():
            return data.encode(errors="backslashreplace").decode()
        case dict():
            return {_spelt(k): _spelt(v) for k, v in data.items()}
        case list():
            return [_spelt(v) for v in data]
        case _:
            return data


def finite(data: Any) -> Any:
    """Replace numbers inside nested plain data that JSON's readers cannot hold by None.

    These are NaN, inf and integers beyond 64 bits.
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
