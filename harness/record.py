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
_Size = Annotated[float, Meta(ge=0)]
_Seconds = Annotated[float, Meta(ge=0, le=1e10)]
_Tolerance = Annotated[float, Meta(gt=0, le=1)]
_Scalar = (
    None
    | bool
    | Annotated[int, Meta(ge=-LARGEST_INTEGER, le=LARGEST_INTEGER)]
    | float
    | str
)
if TYPE_CHECKING:
    _Nested = Any
else:
    _Nested = _Scalar
    for _ in range(LEVELS - 1):
        _Nested = _Scalar | list[_Nested] | dict[str, _Nested]


def _about(description: str) -> Meta:
    """Return the documentation of a field, with its unit."""
    return Meta(description=description)


class Record(Struct, frozen=True, kw_only=True):
    """A single run of one solver on one case at one tolerance; one JSON line.

    A record contains the task, the measured costs, the claim of the solver and the
    verdict. Values that were not measured, or cannot be measured, are None, since JSON
    has no NaN. The annotations define type, range, unit and meaning of every field; the
    journal, the tables and the reference page use them.
    """

    schema: Annotated[
        int, Meta(ge=SCHEMA, le=SCHEMA), _about("version of the line")
    ] = SCHEMA
    run_id: Annotated[
        str, Meta(min_length=1), _about("digest of the task, equal in every such run")
    ]
    case: Annotated[str, _about("canonical name of the case")]
    family: Annotated[str, _about("family of the case")]
    params: Annotated[Mapping[str, _Scalar], _about("values of all keys of the case")]
    form: Annotated[str, _about("form of the QP: primal, dual or dual-bounds")]
    sizes: Annotated[
        Mapping[str, _Count], _about("numbers of unknowns and constraints")
    ]
    solver: Annotated[str, _about("label of the solver in the suite")]
    method: Annotated[str, _about("name of the solver in the registry")] = ""
    options: Annotated[
        Mapping[str, _Nested], _about("all options of the solver, including defaults")
    ]
    tol: Annotated[_Tolerance, _about("tolerance")]
    repeat: Annotated[_Count, _about("number of the repeat, from 0")]
    block: Annotated[
        _Count, _about("number of the block, whose measurements ran consecutively")
    ]
    status: Annotated[Verdict, _about("verdict on the claim of the solver")]
    claimed: Annotated[
        str | None, _about("status claimed by the solver; null without a claim")
    ] = None
    message: Annotated[
        str, _about("message of the solver, reason to decline, or end of the worker")
    ] = ""
    iterations: Annotated[_Count | None, _about("number of iterations")] = None
    counts: Annotated[
        Mapping[str, _Nested], _about("numbers of operations of the solver by name")
    ] = {}
    reported: Annotated[
        Mapping[str, _Nested],
        _about("other data from the solver, such as its own times"),
    ] = {}
    prepare_seconds: Annotated[_Seconds | None, _about("time of preparation, s")] = None
    solve_seconds: Annotated[_Seconds | None, _about("time of the solve, s")] = None
    total_seconds: Annotated[_Seconds | None, _about("prepare + solve, s")] = None
    peak_mib: Annotated[
        _Size | None, _about("peak resident memory of the worker, MiB")
    ] = None
    prepare_peak_mib: Annotated[
        _Size | None, _about("peak resident memory during preparation, MiB")
    ] = None
    solve_peak_mib: Annotated[
        _Size | None, _about("peak resident memory during the solve, MiB")
    ] = None
    inner: Annotated[
        _Count, _about("number of timed solves; times are means over them")
    ] = 1
    untimed: Annotated[
        _Count, _about("number of untimed solves before and between the timed ones")
    ] = 0
    remembered: Annotated[
        bool | None,
        _about("the solver reuses answers of earlier solves; null: unknown"),
    ] = None
    build_seconds: Annotated[
        _Seconds | None, _about("time to build the case, where it was built, s")
    ] = None
    dualise_seconds: Annotated[
        _Seconds | None, _about("part of build_seconds: factorisation and dual, s")
    ] = None
    recover_seconds: Annotated[
        _Seconds | None, _about("time to compute quantities from the point, s")
    ] = None
    certify_seconds: Annotated[
        _Seconds | None, _about("time to compute energy_bound, s")
    ] = None
    threads: Annotated[
        _Count | None, _about("largest thread count of any library in the worker")
    ] = None
    cpu: Annotated[
        _Count | None, _about("number of the CPU to which the worker was bound")
    ] = None
    ranks: Annotated[
        int,
        Meta(ge=1, le=LARGEST_INTEGER),
        _about("number of MPI processes of the solve"),
    ] = 1
    mode: Annotated[
        str,
        Meta(pattern="^(cold|sequence)$"),
        _about("sequence: results of earlier steps may be used; cold: a single case"),
    ] = "cold"
    accuracy: Annotated[
        _Tolerance | None, _about("tolerance of the verdict if it differs from tol")
    ] = None
    arm: Annotated[
        str, _about("null for the second copy of a solver in an A/A comparison")
    ] = ""
    primal: Annotated[
        _Size | None, _about("primal residual, relative; see the page on verdicts")
    ] = None
    dual: Annotated[_Size | None, _about("dual residual, relative")] = None
    complementarity: Annotated[
        _Size | None, _about("complementarity residual, relative")
    ] = None
    gap: Annotated[_Size | None, _about("duality gap, relative")] = None
    approximate_scale: Annotated[
        bool, _about("P has no diagonal; the scales of the residuals are estimates")
    ] = False
    energy_bound: Annotated[
        _Size | None, _about("certified bound on the relative error in energy norm")
    ] = None
    certificate: Annotated[
        Mapping[str, _Nested], _about("relative components of energy_bound")
    ] = {}
    objective: Annotated[
        float | None, _about("objective ½xᵀPx + qᵀx of the emitted QP at the answer")
    ] = None
    quantities: Annotated[
        Mapping[str, _Nested],
        _about("physical results by name, in metre, newton and second"),
    ] = {}
    qp: Annotated[
        str | None, _about("digest of the emitted QP, which identifies the problem")
    ] = None
    environment: Annotated[
        str, _about("digest of environment.json, or of a file in environments/")
    ] = ""
    node: Annotated[str, _about("host name of the cluster node")] = ""
    vectors: Annotated[str | None, _about("digest of the stored solution")] = None
    fields: Annotated[str | None, _about("digest of the stored deformed state")] = None
    started: Annotated[str, _about("start of the measurement, UTC, ISO 8601")] = ""
    session: Annotated[str, _about("id of the run command")] = ""

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
        return self.claimed == "solved" or self.status in PROVEN

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
                structs.force_setattr(
                    record, name, shared.setdefault(repr(value), value)
                )
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
