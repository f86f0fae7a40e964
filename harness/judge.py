"""From what a solver returned to a record: our verdict, residuals and quantities."""

from __future__ import annotations

import json
from collections.abc import Mapping
from datetime import UTC, datetime
from hashlib import sha256
from typing import Any

import numpy as np

from harness.kkt import kkt_residuals, verdict
from harness.measure import Measurement
from harness.names import CaseName
from harness.plugin import Case
from harness.record import SCHEMA, Record, Verdict
from harness.registry import SolverSpec
from harness.solution import Solution, Status


def blank(
    name: CaseName,
    case: str,
    spec: SolverSpec,
    *,
    options: Mapping[str, Any],
    tol: float,
    repeat: int,
    environment: str,
) -> Record:
    """Make the record of a measurement before it is made.

    case : the canonical name
    options : every option of the solver, defaults resolved
    environment : digest
    """
    options = plain(options)
    identity = [SCHEMA, case, spec.label, spec.name, options, tol, repeat]
    text = json.dumps(identity, sort_keys=True)
    return Record(
        run_id=sha256(text.encode()).hexdigest()[:12],
        case=case,
        family=name.family,
        params=name.params,
        form=name.form,
        sizes={},
        solver=spec.label,
        options=options,
        tol=tol,
        repeat=repeat,
        block=0,
        status=Verdict.FAILED,
        environment=environment,
        started=datetime.now(UTC).isoformat(timespec="milliseconds"),
    )


def judged(record: Record, case: Case, measurement: Measurement) -> Record:
    """Fill in what `measurement` is worth on `case`, by our own evaluation.

    Quantities that cannot be computed leave a note in the message.
    """
    s = measurement.solution
    record = record.but(
        sizes=case.qp.sizes,
        claimed=s.status.value,
        message=s.message,
        iterations=s.iterations,
        counts=s.counts,
        reported=s.reported,
        prepare_seconds=measurement.prepare_seconds,
        solve_seconds=measurement.solve_seconds,
        total_seconds=measurement.total_seconds,
        peak_mib=measurement.peak_mib,
    )
    if s.status is Status.DECLINED:
        return record.but(status=Verdict.DECLINED)
    with np.errstate(all="ignore"):  # a point may hold NaN, inf, or 1e300
        residuals = kkt_residuals(case.qp, s)
        objective = case.qp.objective(s.x)
    record = record.but(
        status=verdict(s.status, residuals, record.tol),
        objective=objective,
        **residuals._asdict(),
    )
    if not has_point(s):
        return record
    try:
        return record.but(quantities=plain(case.quantities(s)))
    except Exception as e:  # the family's code; its fault must not lose the record
        return noted(record, "quantities", e)


def has_point(s: Solution) -> bool:
    """Whether all four vectors are finite."""
    return all(np.isfinite(v).all() for v in (s.x, s.y, s.z, s.z_box))


def noted(record: Record, what: str, e: Exception) -> Record:
    """Say in the message of a record what could not be computed of it."""
    reason = " ".join(f"no {what}: {type(e).__name__}: {e}".split())
    return record.but(message="; ".join(filter(None, [record.message, reason])))


def plain(data: Any) -> Any:
    """Convert to what JSON knows; anything else is shown by its repr."""
    match data:
        case np.ndarray() | np.generic():
            return plain(data.tolist())
        case Mapping():
            return {str(key): plain(value) for key, value in data.items()}
        case list() | tuple():
            return [plain(value) for value in data]
        case None | bool() | int() | float() | str():
            return data
        case _:
            return repr(data)
