"""Records of answers: verdict, residuals, certificates and physical quantities."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Mapping
from dataclasses import replace
from datetime import UTC, datetime
from time import perf_counter
from typing import Any

import numpy as np
from scipy.sparse import csr_array, hstack
from scipy.sparse.linalg import LinearOperator

from mortarbench.harness.digest import hex_digest
from mortarbench.harness.distributed.failures import run_collectively
from mortarbench.harness.distributed.vectors import (
    DistributedQP,
    Ranks,
    distributed,
)
from mortarbench.harness.names import CaseId
from mortarbench.harness.plugin import Case
from mortarbench.harness.qp import QP, Vector, no_rows
from mortarbench.harness.record import Record, Verdict
from mortarbench.harness.registry import COPIES, SolverSpec
from mortarbench.harness.sets.box import Box
from mortarbench.harness.sets.convex import ConvexSet
from mortarbench.harness.sets.discs import Discs
from mortarbench.harness.solution import NO_SOLUTION, Solution, Status
from mortarbench.harness.verify.certificate import (
    Certificate,
    EigenvalueCertificate,
    UncertifiableError,
    certify,
    certify_by_eigenvalue,
)
from mortarbench.harness.verify.infeasibility import certificate_of
from mortarbench.harness.verify.kkt import (
    Residuals,
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
    values: Mapping[str, Any] | None = None,
) -> Record:
    """Complete a record with the claim of an answer `s`, its residuals and the verdict.

    values : residuals and objective that ranks have evaluated; None to evaluate them in
        this function
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
    if values is not None:
        residuals = Residuals(*(values[name] for name in Residuals._fields))
        objective = values["objective"]
    else:
        with np.errstate(all="ignore"):  # a point may contain NaN, inf, or 1e300
            residuals = kkt_residuals(qp, s)
            objective = qp.objective(s.x)
    tol = record.judged_at
    outcome = verdict(s.status, residuals, tol)
    if s.status in NO_SOLUTION:
        if values is not None:
            holds, reason = False, f"claims of {s.status} QPs are not examined on ranks"
        else:
            holds, reason = certificate_of(qp, s, tol)
        outcome = Verdict(f"verified_{s.status}") if holds else outcome
        record = noted(record, reason)
    elif s.status is Status.SOLVED and not outcome.is_verified and values is None:
        record = noted(record, diagnosis(qp, s, tol))
    return record.replace(
        verdict=outcome,
        objective=objective,
        approximate_scale=values is None and scaling_of(qp).is_approximate,
        **residuals._asdict(),
    )


def quantities_of(case: Case, s: Solution) -> tuple[dict[str, Any], str]:
    """Return the physical quantities of a point, and a note on failure.

    The note is empty on success. Quantities and note are empty if the answer has no
    finite point.
    """
    if not has_point(s):
        return {}, ""
    try:
        with np.errstate(all="ignore"):  # a point may contain 1e300
            return plain(case.quantities(s)), ""
    except Exception as e:  # an error of the family must not discard the record
        return {}, note_of("quantities", e)


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
    if not has_point(s):
        return {}, ""
    mechanics, was_loaded = case.mechanics, LATE_IMPORT in sys.modules
    if mechanics is None:
        least = getattr(case.qp.P, "least_eigenvalue", None)
        if least is None or not least > 0 or case.qp.b.size + case.qp.h.size:
            return {}, ""
        return _certified(lambda: certify_by_eigenvalue(case.qp, s, least))

    def certificate() -> Certificate:
        return certify(mechanics, mechanics.to_primal(s))

    result = _certified(certificate)
    if not was_loaded and LATE_IMPORT in sys.modules:  # exclude the time of the import
        result = _certified(certificate)
    return result


def evaluated_by_ranks(
    emitted: DistributedQP, s: Solution, ranks: Ranks
) -> dict[str, Any]:
    """Evaluate an answer on all ranks, from the local slices of the solution.

    The evaluation uses a new copy of the local part of the QP, which the solver cannot
    have modified. All ranks must call this function, and all ranks report the failure
    of any rank (`harness.distributed.failures`).

    Returns
    -------
    a dict with `values`: objective and residuals, or None if they are not finite or
    require the whole QP; `bounds`: None, since a certificate requires the whole QP;
    `quantities`: physical quantities, or None if they require the whole QP;
    `recover_seconds`: time to evaluate the quantities; `notes`: reasons of failures.
    After a failure, the values concerned are None or empty. If `values` is None, all
    values are None

    """
    found: dict[str, Any] = {
        "values": None,
        "bounds": None,
        "quantities": None,
        "recover_seconds": None,
        "notes": list[str](),
    }
    try:
        found["values"] = run_collectively(
            ranks, lambda: _values_by_ranks(emitted, s, ranks)
        )
        if found["values"] is None:
            return found
        answered = run_collectively(ranks, lambda: emitted.answer(s))
    except Exception as e:
        return {**found, "notes": [note_of("evaluation by ranks", e)]}
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
    """Evaluate objective and residuals; return None if they are not finite."""
    share = emitted.share().qp
    qp, s = gathered(share, s, ranks)
    with np.errstate(all="ignore"):
        residuals, objective = kkt_residuals(qp, s), qp.objective(s.x)
    if not np.isfinite([*residuals, objective]).all():
        return None
    return {"objective": float(objective), **residuals._asdict()}


def gathered(share: QP, s: Solution, ranks: Ranks) -> tuple[QP, Solution]:
    """Return the whole QP and solution on every rank, given the slices of all ranks.

    Variables are in the order of the ranks, of which residuals are independent. P
    remains distributed: a product is collective.
    """
    counts = ranks.comm.allgather(share.q.size)
    start, n = sum(counts[: ranks.rank]), sum(counts)
    here = slice(start, start + counts[ranks.rank])

    def whole(part: Any) -> Vector:
        return np.concatenate(ranks.comm.allgather(np.asarray(part)))

    def product(x: Vector) -> Vector:
        return whole(share.P @ distributed(x.ravel()[here], ranks))

    P = LinearOperator((n, n), matvec=product, dtype=float)
    diagonal = share.diagonal()
    if diagonal is not None:
        total = whole(diagonal)
        P.diagonal = lambda: total
    sets: list[ConvexSet] = [Box(whole(share.lb), whole(share.ub))]
    discs = [one for one in share.sets[1:] if isinstance(one, Discs)]
    parts = ranks.comm.allgather(
        [(one.index + start, np.asarray(one.radius)) for one in discs]
    )
    for same in zip(*parts, strict=True):
        index, radius = (np.concatenate(arrays) for arrays in zip(*same, strict=True))
        if radius.size:
            sets.append(Discs(index, radius))
    A = csr_array(hstack(ranks.comm.allgather(share.A.part)))
    qp = QP(P=P, q=whole(share.q), A=A, b=share.b, G=no_rows(n), h=share.h, sets=sets)
    return qp, replace(s, x=whole(s.x), z_box=whole(s.z_box))


#: module that loads slowly, needed by `certify` for some bodies
LATE_IMPORT = "scipy.optimize"


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
    return " ".join(f"no {what}: {type(e).__name__}: {e}".split())


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
