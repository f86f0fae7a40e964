"""One line of evidence: a measurement as plain data."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from enum import StrEnum
from functools import cache
from typing import Any, Self

SCHEMA = 1  #: version of the journal line; raised whenever a field changes its meaning


_JSON_TYPES: Mapping[str, set[type]] = {
    "None": {type(None)}, "str": {str}, "Verdict": {str}, "int": {int},
    "float": {int, float}, "Mapping": {dict},
}  # fmt: skip


class Verdict(StrEnum):
    """Our judgement of a measurement, whatever the solver claimed."""

    VERIFIED = "verified"  #: every residual ≤ 10·tol
    INACCURATE = "inaccurate"  #: claimed solved; at least half the digits are there
    WRONG = "wrong"  #: claimed solved, refuted
    INFEASIBLE_CLAIM = "infeasible_claim"
    ITERATION_LIMIT = "iteration_limit"
    TIME_LIMIT = "time_limit"
    MEMORY_LIMIT = "memory_limit"
    CRASHED = "crashed"  #: the process died
    FAILED = "failed"  #: it raised or gave up
    DECLINED = "declined"  #: it said beforehand why it cannot


@dataclass(frozen=True, kw_only=True)
class Record:
    """One solver on one case at one tolerance, once: plain scalars, one JSON line.

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
    status: Verdict
    claimed: str | None = None  #: the solver's own status
    message: str = ""  #: its words, the reason it declined, or how it died
    iterations: int | None = None
    counts: Mapping[str, int] = field(default_factory=dict)
    reported: Mapping[str, Any] = field(
        default_factory=dict
    )  #: its linear solver, its own times in seconds
    prepare_seconds: float | None = None
    solve_seconds: float | None = None
    total_seconds: float | None = None  #: prepare + solve
    peak_mib: float | None = None  #: resident memory of the worker, peak
    prepare_peak_mib: float | None = None
    solve_peak_mib: float | None = None
    inner: int = 1  #: prepared and solved so often; the seconds are the mean
    build_seconds: float | None = None  #: of the case, in the process that built it
    dualise_seconds: float | None = (
        None  #: part of build: factor, dual; dual forms only
    )
    recover_seconds: float | None = None  #: from the point to quantities
    certify_seconds: float | None = None  #: from the point to energy_bound
    canary_seconds: float | None = None  #: a fixed kernel, just before: drift
    threads: int | None = None  #: most threads of any library in the worker, as checked
    cpu: int | None = None  #: that the worker was bound to
    mode: str = "cold"  #: or "sequence": may use what earlier steps left
    accuracy: float | None = None  #: judged at, where that is not `tol`: a sweep
    arm: str = ""  #: "null": the same solver once more, to show the noise
    primal: float | None = None  #: the four scale-free residuals of harness.kkt
    dual: float | None = None
    complementarity: float | None = None
    gap: float | None = None
    energy_bound: float | None = None  #: certified relative error, energy norm
    #: what it is made of, as relative; see `harness.judge.certified`
    certificate: Mapping[str, float] = field(default_factory=dict)
    objective: float | None = None  #: ½xᵀPx + qᵀx of the emitted QP
    quantities: Mapping[str, Any] = field(default_factory=dict)  #: physical, SI
    qp: str | None = None  #: digest of the emitted QP; None in old journals
    environment: str = ""  #: digest of environment.json or of one in environments/
    node: str = ""  #: host name, where a cluster measured
    vectors: str | None = None  #: digest of the stored solution
    fields: str | None = None  #: digest of the stored deformed state
    started: str = ""  #: UTC, ISO 8601

    def but(self, **changes: Any) -> Self:
        """Copy with some fields changed."""
        return replace(self, **changes)

    def to_json(self) -> str:
        """Serialise to one line of strict JSON: NaN and inf become null."""
        return json.dumps(finite(vars(self)), allow_nan=False)

    @classmethod
    def from_json(cls, line: str) -> Self:
        """Parse what `to_json` wrote; fields that we do not know are ignored.

        A lone surrogate, which no file can hold, is spelt out.

        Raises
        ------
        ValueError
            When the line is no JSON object, lacks a field, has another schema, or a
            field of the wrong type.

        """
        row = json.loads(line)
        if "\\ud" in line:  # or the half of a pair that is whole
            row = _spelt(row)
        if not isinstance(row, dict) or row.get("schema") != SCHEMA:
            raise ValueError(f"not a journal line of schema {SCHEMA}")
        known = {f.name: str(f.type) for f in fields(cls)}
        given = {k: v for k, v in row.items() if k in known}
        for name, value in given.items():
            if type(value) not in _json_types(known[name]):
                raise ValueError(f"{name} = {value!r}; expected {known[name]}")
        try:
            record = cls(**given)
        except TypeError as e:
            raise ValueError(f"incomplete journal line: {e}") from None
        return replace(record, status=Verdict(record.status))


@cache
def _json_types(annotation: str) -> set[type]:
    """List what JSON gives for a field with that annotation, e.g. "float | None"."""
    kinds = [kind.partition("[")[0] for kind in annotation.split(" | ")]
    return set().union(*(_JSON_TYPES[kind] for kind in kinds))


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
    """Replace every non-finite float inside nested plain data by None."""
    match data:
        case float():
            return data if math.isfinite(data) else None
        case dict():
            return {k: finite(v) for k, v in data.items()}
        case list() | tuple():
            return [finite(v) for v in data]
        case _:
            return data
