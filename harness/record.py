"""Records of measurements, which are stored as lines of the journal."""

from __future__ import annotations

import math
from collections.abc import Mapping
from enum import StrEnum
from functools import cache
from typing import TYPE_CHECKING, Annotated, Any

from msgspec import DecodeError, Meta, Struct, ValidationError, json, structs

from mortarbench.harness.errors import shortened

#: Version of a journal line, which increases whenever the meaning of a field changes;
#: lines of other versions are refused.
SCHEMA = 3
#: An answer counts as verified if its residuals are at most this multiple of the
#: tolerance.
VERIFIED_FACTOR = 10.0
LARGEST_INTEGER = 2**63 - 1  #: largest integer that 64-bit formats (Parquet) can store
LEVELS = 8  #: largest depth of nested lists and tables in a field
#: fields whose values are equal in many lines; equal values are stored only once in
#: memory
_REPEATED = (
    "case", "family", "form", "solver", "method", "claimed", "mode", "qp", "session",
    "environment", "params", "sizes", "options", "counts", "certificate", "quantities",
)  # fmt: skip


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

        Examples
        --------
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

_Count = Annotated[int, Meta(ge=0, le=LARGEST_INTEGER)]
_Size = Annotated[float, Meta(ge=0)] | None
_Seconds = Annotated[float, Meta(ge=0, le=1e10)] | None
_Tolerance = Annotated[float, Meta(gt=0, le=1)]
_Schema = Annotated[int, Meta(ge=SCHEMA, le=SCHEMA)]
_Name = Annotated[str, Meta(min_length=1)]
_Mode = Annotated[str, Meta(pattern="^(cold|sequence)$")]
_Ranks = Annotated[int, Meta(ge=1, le=LARGEST_INTEGER)]
_Integer = Annotated[int, Meta(ge=-LARGEST_INTEGER, le=LARGEST_INTEGER)]
_Scalar = None | bool | _Integer | float | str
if TYPE_CHECKING:
    _Nested = Any
else:
    _Nested = _Scalar
    for _ in range(LEVELS - 1):
        _Nested = _Scalar | list[_Nested] | dict[str, _Nested]
_Table = Mapping[str, _Nested]


def _is(description: str) -> Meta:
    """Return the documentation of a field, which ends with its unit."""
    return Meta(description=description)


class Record(Struct, frozen=True, kw_only=True):
    """A single run of one solver on one case at one tolerance; one JSON line.

    A record contains the task, the measured costs, the claim of the solver and the
    verdict. Values that were not measured, or cannot be measured, are None, since JSON
    has no NaN. The annotations define type, range, unit and meaning of every field; the
    journal, the tables and the reference page use them.
    """

    schema: Annotated[_Schema, _is("version of the meaning of the fields")] = SCHEMA
    run_id: Annotated[_Name, _is("digest of the task, equal in all runs of a suite")]
    case: Annotated[str, _is("canonical name")]
    family: Annotated[str, _is("family of the case")]
    params: Annotated[Mapping[str, _Scalar], _is("values of all keys of the case")]
    form: Annotated[str, _is("form of the QP")]
    sizes: Annotated[Mapping[str, _Count], _is("sizes of the QP")]
    solver: Annotated[str, _is("label of the solver in the suite")]
    method: Annotated[str, _is("name of the solver in the registry")] = ""
    options: Annotated[_Table, _is("all options of the solver, with defaults")]
    tol: Annotated[_Tolerance, _is("tolerance passed to the solver")]
    repeat: Annotated[_Count, _is("number of the repeat, from 0")]
    block: Annotated[_Count, _is("number of the block of consecutive measurements")]
    status: Annotated[Verdict, _is("verdict on the claim of the solver")]
    claimed: Annotated[str | None, _is("status that the solver claims")] = None
    message: Annotated[str, _is("message of the solver, or why it has no answer")] = ""
    iterations: Annotated[_Count | None, _is("number of iterations")] = None
    counts: Annotated[_Table, _is("numbers of operations by name")] = {}
    reported: Annotated[_Table, _is("further data from the solver")] = {}
    prepare_seconds: Annotated[_Seconds, _is("conversion and factorisation, s")] = None
    solve_seconds: Annotated[_Seconds, _is("solve, s")] = None
    total_seconds: Annotated[_Seconds, _is("prepare + solve, s")] = None
    peak_mib: Annotated[_Size, _is("peak resident memory of the worker, MiB")] = None
    inner: Annotated[_Count, _is("timed solves, over which times are means")] = 1
    untimed: Annotated[_Count, _is("solves before and between the timed ones")] = 0
    remembered: Annotated[bool | None, _is("the solver reuses earlier answers")] = None
    build_seconds: Annotated[_Seconds, _is("building of the case, s")] = None
    dualise_seconds: Annotated[_Seconds, _is("part of build: dual QP, s")] = None
    recover_seconds: Annotated[_Seconds, _is("quantities from the point, s")] = None
    certify_seconds: Annotated[_Seconds, _is("bound on the error, s")] = None
    threads: Annotated[_Count | None, _is("most threads of a library")] = None
    cpu: Annotated[_Count | None, _is("number of the CPU of the worker")] = None
    ranks: Annotated[_Ranks, _is("number of MPI processes of the solve")] = 1
    mode: Annotated[_Mode, _is("sequence: earlier steps may be reused")] = "cold"
    accuracy: Annotated[_Tolerance | None, _is("tolerance of the verdict, or tol")] = (
        None
    )
    arm: Annotated[str, _is("null: second copy of a solver in an A/A test")] = ""
    primal: Annotated[_Size, _is("primal residual, relative")] = None
    dual: Annotated[_Size, _is("dual residual, relative")] = None
    complementarity: Annotated[_Size, _is("complementarity residual, relative")] = None
    gap: Annotated[_Size, _is("duality gap, relative")] = None
    approximate_scale: Annotated[bool, _is("scales of residuals are estimates")] = False
    energy_bound: Annotated[_Size, _is("certified relative error in energy")] = None
    certificate: Annotated[_Table, _is("components of energy_bound, relative")] = {}
    objective: Annotated[float | None, _is("½xᵀPx + qᵀx of the emitted QP")] = None
    quantities: Annotated[_Table, _is("physical results by name; m, N and s")] = {}
    qp: Annotated[str | None, _is("digest of the emitted QP")] = None
    environment: Annotated[str, _is("digest of the file of the environment")] = ""
    node: Annotated[str, _is("host name of the cluster node")] = ""
    vectors: Annotated[str | None, _is("digest of the stored solution")] = None
    fields: Annotated[str | None, _is("digest of the stored deformed state")] = None
    started: Annotated[str, _is("start of the measurement, UTC, ISO 8601")] = ""
    session: Annotated[str, _is("id of the run command")] = ""

    @property
    def identity(self) -> str:
        """Session and run_id, "SESSION-RUN_ID", which only this measurement has."""
        return f"{self.session}-{self.run_id}" if self.session else self.run_id

    @property
    def judged_at(self) -> float:
        """Tolerance on which the verdict is based."""
        return self.tol if self.accuracy is None else self.accuracy

    def replace(self, **changes: Any) -> Record:
        """Return a copy with the fields in `changes` replaced."""
        return structs.replace(self, **changes)

    def to_json(self) -> str:
        """Return one line of strict JSON, with the values of `finite`."""
        return json.encode(finite(structs.asdict(self), LEVELS + 1)).decode()

    @staticmethod
    def from_json(line: str | bytes, shared: dict[str, Any] | None = None) -> Record:
        """Parse a journal line as written by `to_json`; unknown fields are ignored.

        shared : texts and tables of earlier lines, to which the texts and tables of
            this line are added, so that equal objects are stored only once

        Raises
        ------
        ValueError
            If the line is not a JSON object, lacks a field, or a field has a wrong type
            or an invalid value.

        """
        try:
            record = _decoder().decode(line)
        except ValidationError as e:
            what, _, place = str(e).partition(" - at `$.")
            if place == "status`":
                what += f"; expected one of {', '.join(Verdict)}"
            place = place.strip("`") or "journal line"
            raise ValueError(f"{place}: {shortened(what)}") from None
        except (DecodeError, RecursionError, UnicodeDecodeError) as e:
            raise ValueError(f"damaged ({e}); expected a JSON object") from None
        if shared is not None:
            for name in _REPEATED:
                value = getattr(record, name)
                value = shared.setdefault(repr(value), value)
                structs.force_setattr(record, name, value)
        return record


@cache
def _decoder() -> json.Decoder[Record]:
    return json.Decoder(Record)


def in_space(quantities: Mapping[str, Any]) -> bool:
    """Return True if the quantities belong to three-dimensional bodies.

    Forces are then in N and energies in J, instead of N/m and J/m in 2D.
    """
    nodes, dofs = quantities.get("nodes"), quantities.get("dofs")
    return isinstance(nodes, int) and nodes > 0 and dofs == 3 * nodes


def finite(data: Any, levels: int = 20) -> Any:
    """Return nested plain data as a journal can store them.

    NaN, inf and integers beyond 64 bits become None, lone surrogates are escaped, and
    data below `levels` levels of lists and tables become text.

    >>> from mortarbench.harness.record import finite
    >>> finite({"gap": [1e-9, float("nan")], "count": 3})
    {'gap': [1e-09, None], 'count': 3}
    """
    match data:
        case str():
            return data.encode(errors="backslashreplace").decode()
        case float():
            return float(data) if math.isfinite(data) else None
        case int():
            return data if abs(data) <= LARGEST_INTEGER else None
        case dict() | list() | tuple() if not levels:
            return finite(repr(data))
        case dict():
            return {finite(k): finite(v, levels - 1) for k, v in data.items()}
        case list() | tuple():
            return [finite(v, levels - 1) for v in data]
        case _:
            return data
