"""From what a solver returned to a record: our verdict, residuals and quantities."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Mapping
from dataclasses import replace
from datetime import UTC, datetime
from time import perf_counter
from typing import Any

import numpy as np

from mortarbench.harness.digest import hex_digest
from mortarbench.harness.distributed.failures import run_collectively
from mortarbench.harness.distributed.vectors import (
    DistributedColumns,
    DistributedQP,
    Ranks,
)
from mortarbench.harness.names import CaseId
from mortarbench.harness.plugin import Case
from mortarbench.harness.qp import QP, no_rows
from mortarbench.harness.record import Record, Verdict
from mortarbench.harness.registry import COPIES, SolverSpec
from mortarbench.harness.solution import Solution, Status
from mortarbench.harness.verify.certificate import (
    Certificate,
    UncertifiableError,
    certify,
)
from mortarbench.harness.verify.infeasibility import infeasibility_margin
from mortarbench.harness.verify.kkt import Residuals, kkt_residuals, verdict
from mortarbench.harness.verify.optimum import Proves, decided
from mortarbench.harness.verify.over_ranks import certify_over_ranks

#: first part of what a run_id digests; it names a measurement, whatever is stored of it
IDENTITY = 1


def new_record(
    case: CaseId,
    spec: SolverSpec,
    *,
    options: Mapping[str, Any],
    tol: float,
    repeat: int,
    environment: str,
    block: int = 0,
    mode: str = "cold",
    accuracy: float | None = None,
    session: str = "",
) -> Record:
    """Make the record of a measurement before it is made.

    options : every option of the solver, defaults resolved
    environment : digest
    mode, accuracy, session : see `Record`
    """
    options = plain(options)
    identity = [IDENTITY, case.name, spec.label, spec.name, options, tol, repeat]
    if (mode, accuracy) != ("cold", None):
        identity += [mode, accuracy]
    if spec.ranks > 1:
        identity += [{"ranks": spec.ranks}]
    if spec.role == COPIES:
        identity += [COPIES]
    text = json.dumps(identity, sort_keys=True)
    return Record(
        run_id=hex_digest([text.encode()]),
        case=case.name,
        family=case.family.name,
        params=case.params,
        form=case.form,
        sizes={},
        solver=spec.label,
        options=options,
        tol=tol,
        repeat=repeat,
        block=block,
        verdict=Verdict.FAILED,
        environment=environment,
        mode=mode,
        accuracy=accuracy,
        role=spec.role,
        ranks=spec.ranks,
        started=datetime.now(UTC).isoformat(timespec="milliseconds"),
        session=session,
    )


def judged(
    record: Record,
    qp: QP,
    s: Solution,
    prove: Proves | None = None,
    found: Mapping[str, Any] | None = None,
) -> Record:
    """Fill in what a solver's answer `s` is worth on `qp`, by our own evaluation.

    prove : finds the optimum of `qp` where residuals cannot decide
    found : residuals and objective, where ranks have evaluated them together
    """
    record = record.replace(
        sizes=qp.sizes,
        claimed=s.status.value,
        message=s.message,
        iterations=s.iterations,
        counts=s.counts,
        reported=s.reported,
    )
    if s.status is Status.DECLINED:
        return record.replace(verdict=Verdict.DECLINED)
    if found is not None:
        residuals = Residuals(*(found[name] for name in Residuals._fields))
        objective = found["objective"]
    else:
        with np.errstate(all="ignore"):  # a point may hold NaN, inf, or 1e300
            residuals = kkt_residuals(qp, s)
            objective = qp.objective(s.x)
    tol, error, margin = record.judged_at, None, None
    if s.status is Status.INFEASIBLE and found is None:
        margin = infeasibility_margin(qp, s)
        record = noted(
            record,
            "no certificate of infeasibility was found" if margin is None
            else f"no feasible point: Farkas certificate with a margin of {margin:.1e}",
        )  # fmt: skip
    elif s.status is Status.INFEASIBLE:
        record = noted(record, "claims of infeasibility are not examined by ranks")
    if prove is not None and margin is None:
        error = decided(qp, s, residuals, tol, prove)
    decided_by = "residuals" if error is None else "reference"
    return record.replace(
        verdict=verdict(
            s.status, residuals, tol, error=error, infeasible=margin is not None
        ),
        objective=objective,
        decided_by=decided_by if margin is None else "certificate",
        optimum_error=error,
        **residuals._asdict(),
    )


def quantities_of(case: Case, s: Solution) -> tuple[dict[str, Any], str]:
    """Evaluate what a point means physically; with a note, if that is impossible."""
    if not has_point(s):
        return {}, ""
    try:
        with np.errstate(all="ignore"):  # a point may hold 1e300
            return plain(case.quantities(s)), ""
    except Exception as e:  # the family's code; its fault must not lose the record
        return {}, note_of("quantities", e)


def certified(case: Case, s: Solution) -> tuple[dict[str, Any], str]:
    """Bound the error of a point: fields of its record; with a note, if impossible.

    energy_bound covers the answer itself, û and u_λ of `harness.verify.certificate`.
    certificate: `pair` = √(2(J − D)), `distance` = ‖û − u_λ‖, `work` = √(2λ̂ᵀ(c − Bû)),
    `answer` (the bound of the answer alone) and `moved` = ‖u − û‖, all relative to a
    lower bound of ‖u*‖; `friction`, the part that friction has in `work`; `seminorm`, 1
    where bodies can move rigidly, which nothing bounds.
    """
    if case.mechanics is None or not has_point(s):
        return {}, ""
    mechanics, loaded = case.mechanics, LATE in sys.modules

    def certificate() -> Certificate:
        return certify(mechanics, mechanics.to_primal(s))

    told = _certified(certificate)
    if not loaded and LATE in sys.modules:  # and that is no part of the time
        told = _certified(certificate)
    return told


def evaluated_by_ranks(
    emitted: DistributedQP, s: Solution, ranks: Ranks
) -> dict[str, Any]:
    """Evaluate an answer on all ranks together; each has its slice of the solution.

    By a share of its own, without what the solver has made of the first one. All ranks
    call it. What one of them cannot do, none of them does (`harness.distributed
    .failures`).

    Returns
    -------
    `values`: objective and residuals, None where they cannot be evaluated in parts;
    `bounds`: fields of `certified`, and `quantities`, each None where it needs the
    whole; `recover_seconds` that quantities took; `notes` on what failed.

    """
    found: dict[str, Any] = {
        "values": None, "bounds": None, "quantities": None, "recover_seconds": None,
        "notes": list[str](),
    }  # fmt: skip
    try:
        found["values"] = run_collectively(
            ranks, lambda: _values_by_ranks(emitted, s, ranks)
        )
        if found["values"] is None:
            return found
        answered = run_collectively(ranks, lambda: emitted.answer(s))
    except Exception as e:
        return {**found, "notes": [note_of("evaluation by ranks", e)]}
    if (certifiable := answered.certifiable) is not None:
        found["bounds"], note = _certified(
            lambda: run_collectively(ranks, lambda: certify_over_ranks(*certifiable))
        )
        found["notes"] += filter(None, [note])
    if (results := answered.quantities) is not None:
        start = perf_counter()
        try:
            with np.errstate(all="ignore"):
                found["quantities"] = plain(run_collectively(ranks, results))
            found["recover_seconds"] = perf_counter() - start
        except Exception as e:
            found["quantities"] = {}
            found["notes"].append(note_of("quantities", e))
    return found


def _values_by_ranks(
    emitted: DistributedQP, s: Solution, ranks: Ranks
) -> dict[str, float] | None:
    """Evaluate objective and residuals; None where they are not finite.

    And where some scale of energy is one that only the whole knows, which a distributed
    vector refuses by a TypeError.
    """
    qp = emitted.share().qp
    qp = replace(qp, G=DistributedColumns(no_rows(qp.q.size), ranks))
    try:
        with np.errstate(all="ignore"):
            residuals, objective = kkt_residuals(qp, s), qp.objective(s.x)
    except TypeError:
        return None
    if not np.isfinite([*residuals, objective]).all():
        return None
    return {"objective": float(objective), **residuals._asdict()}


LATE = "scipy.optimize"  #: which `certify` imports for some bodies; it takes long


def _certified(certificate: Callable[[], Certificate]) -> tuple[dict[str, Any], str]:
    start = perf_counter()
    try:
        found = certificate()
    except UncertifiableError as e:
        seconds = perf_counter() - start
        return {"certify_seconds": seconds}, f"no energy_bound: {e}"
    except Exception as e:  # the family's code; its fault must not lose the record
        return {}, note_of("energy_bound", e)
    return {
        "energy_bound": found.bound,
        "certificate": found.parts,
        "certify_seconds": perf_counter() - start,
    }, ""


def has_point(s: Solution) -> bool:
    """Whether there are variables, and all four vectors are finite."""
    return bool(s.x.size) and all(
        np.isfinite(v).all() for v in (s.x, s.y, s.z, s.z_box)
    )


def note_of(what: str, e: Exception) -> str:
    """Say in one line what could not be computed of a record."""
    return " ".join(f"no {what}: {type(e).__name__}: {e}".split())


def noted(record: Record, *notes: str) -> Record:
    """Add notes to the message of a record."""
    return record.replace(message="; ".join(filter(None, [record.message, *notes])))


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
