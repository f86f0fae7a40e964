"""Records of answers: verdict, residuals, certificates and physical quantities."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from datetime import UTC, datetime
from time import perf_counter
from typing import Any

import numpy as np

from mortarbench.harness.digest import hex_digest
from mortarbench.harness.errors import described
from mortarbench.harness.names import CaseId
from mortarbench.harness.plugin import Case
from mortarbench.harness.qp import QP
from mortarbench.harness.record import Record, Verdict
from mortarbench.harness.registry import SolverSpec
from mortarbench.harness.solution import NO_SOLUTION, Solution, Status
from mortarbench.harness.verify.certificate import (
    Certificate,
    EigenvalueCertificate,
    UncertifiableError,
    certify,
    certify_by_eigenvalue,
    certify_pair,
)
from mortarbench.harness.verify.infeasibility import certificate_of
from mortarbench.harness.verify.kkt import (
    diagnosis,
    kkt_residuals,
    scaling_of,
    verdict,
)

#: Version of the data from which a run_id is computed, independent of the schema of
#: records.
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
    """Return the record of a measurement that has not begun.

    options : all options of the solver, including defaults
    environment : digest of the environment
    mode, accuracy, session : see `Record`
    """
    options = plain(options)
    identity = [IDENTITY, case.name, spec.label, spec.name, options, tol, repeat]
    if (mode, accuracy) != ("cold", None):
        identity += [mode, accuracy]
    if spec.ranks > 1:
        identity += [{"ranks": spec.ranks}]
    text = json.dumps(identity, sort_keys=True)
    return Record(
        run_id=hex_digest([text.encode()]),
        case=case.name,
        family=case.family_name,
        params=case.params,
        form=case.form,
        sizes={},
        solver=spec.label,
        method=spec.name,
        options=options,
        tol=tol,
        repeat=repeat,
        block=block,
        status=Verdict.FAILED,
        environment=environment,
        mode=mode,
        accuracy=accuracy,
        arm=spec.role,
        ranks=spec.ranks,
        started=datetime.now(UTC).isoformat(timespec="milliseconds"),
        session=session,
    )


def judged(record: Record, qp: QP, s: Solution) -> Record:
    """Complete a record with the claim of an answer, its residuals and the verdict."""
    record = claimed(record.replace(sizes=qp.sizes), s)
    fields, note = judgement(qp, s, record.judged_at)
    return noted(record.replace(**fields), note)


def claimed(record: Record, s: Solution) -> Record:
    """Complete a record with the claim of an answer."""
    return record.replace(
        claimed=s.status.value,
        message=s.message,
        iterations=s.iterations,
        counts=s.counts,
        reported=s.reported,
    )


def judgement(qp: QP, s: Solution, tol: float) -> tuple[dict[str, Any], str]:
    """Return the verdict on an answer with its residuals, as fields of a record.

    The second result is a note on the reason if the answer is not verified, else "".
    """
    if s.status is Status.DECLINED:
        return {"status": Verdict.DECLINED}, ""
    with np.errstate(all="ignore"):  # a point may contain NaN, inf, or 1e300
        residuals, objective = kkt_residuals(qp, s), qp.objective(s.x)
    outcome, note = verdict(s.status, residuals, tol), ""
    if s.status in NO_SOLUTION:
        holds, note = certificate_of(qp, s, tol)
        outcome = Verdict(f"verified_{s.status}") if holds else outcome
    elif s.status is Status.SOLVED and not outcome.is_verified:
        note = diagnosis(qp, s, tol)
    return {
        "status": outcome,
        "objective": objective,
        "approximate_scale": scaling_of(qp).is_approximate,
        **residuals._asdict(),
    }, note


def evaluated(case: Case, s: Solution, tol: float) -> tuple[dict[str, Any], list[str]]:
    """Judge an answer completely: return fields of a record, and notes."""
    fields, *notes = judgement(case.qp, s, tol)
    if s.status is Status.DECLINED:
        return fields, notes
    results, further = results_of(case, s)
    return fields | results, notes + further


def results_of(case: Case, s: Solution) -> tuple[dict[str, Any], list[str]]:
    """Return quantities and error bounds as fields of a record, and notes on failures.

    There are none if the answer has no finite point.
    """
    if not has_point(s):
        return {}, []
    start, note = perf_counter(), ""
    try:
        with np.errstate(all="ignore"):  # a point may contain 1e300
            quantities = plain(case.quantities(s))
    except Exception as e:  # an error of the family must not discard the record
        quantities, note = {}, note_of("quantities", e)
    fields = {"quantities": quantities, "recover_seconds": perf_counter() - start}
    bounds, objection = certified(case, s)
    return fields | bounds, [note, objection]


def certified(case: Case, s: Solution) -> tuple[dict[str, Any], str]:
    """Bound the error of a point; return fields of a record, and a note on failure.

    ``energy_bound`` bounds the errors of the answer and of the displacements û and u_λ
    that prove the bound (`harness.verify.certificate`). ``certificate`` contains the
    components of the bound, relative to a lower bound on ‖u*‖: `pair` = √(2(J − D)),
    `distance` = ‖û − u_λ‖, `work` (√(2λ̂ᵀ(c − Bû)) without friction), `answer` (the
    bound of the answer alone), `moved` = ‖u − û‖, and `friction`, the frictional part
    of `work`. `seminorm` is 1 if bodies can move rigidly; the errors of these motions
    are not bounded.

    If the case has no mechanics and no rows, but an operator P with a positive
    `least_eigenvalue`, the error of x is bounded in the norm of P
    (`certify_by_eigenvalue`).
    """
    mechanics = case.mechanics
    if mechanics is None and case.certifiable is None:
        least = getattr(case.qp.P, "least_eigenvalue", None)
        if least is None or not least > 0 or case.qp.b.size + case.qp.h.size:
            return {}, ""
        return _certified(lambda: certify_by_eigenvalue(case.qp, s, least))

    def certificate() -> Certificate:
        if mechanics is None:
            assert case.certifiable is not None
            return certify_pair(*case.certifiable(s))
        return certify(mechanics, mechanics.to_primal(s))

    return _certified(certificate)


def _certified(
    certificate: Callable[[], Certificate | EigenvalueCertificate],
) -> tuple[dict[str, Any], str]:
    start = perf_counter()
    try:
        bound = certificate()
    except UncertifiableError as e:
        seconds = perf_counter() - start
        return {"certify_seconds": seconds}, f"no energy_bound: {e}"
    except Exception as e:  # an error of the family must not discard the record
        return {}, note_of("energy_bound", e)
    return {
        "energy_bound": bound.bound,
        "certificate": bound.parts,
        "certify_seconds": perf_counter() - start,
    }, ""


def has_point(s: Solution) -> bool:
    """Return True if x is not empty and x, y, z and z_box are finite."""
    return bool(s.x.size) and all(
        np.isfinite(v).all() for v in (s.x, s.y, s.z, s.z_box)
    )


def note_of(what: str, e: Exception) -> str:
    """Return a one-line note that an exception prevented the computation of `what`."""
    return f"no {what}: {described(e)}"


def noted(record: Record, *notes: str) -> Record:
    """Add notes to the message of a record."""
    return record.replace(message="; ".join(filter(None, [record.message, *notes])))


def plain(data: Any) -> Any:
    """Convert data to JSON types; objects of other types become their repr."""
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
