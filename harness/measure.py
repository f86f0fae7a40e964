"""The clock: one solver on one QP, once, in this process."""

from __future__ import annotations

import gc
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from time import perf_counter

import numpy as np

from harness.plugin import Solver
from harness.qp import QP
from harness.solution import Solution, Status


@dataclass(frozen=True, eq=False, kw_only=True)
class Measurement:
    """What a solver returned and what that cost; None where nothing was measured."""

    solution: Solution  #: float vectors of the right shapes, whatever happened
    prepare_seconds: float | None = None
    solve_seconds: float | None = None
    total_seconds: float | None = None  #: prepare + solve
    peak_mib: float | None = (
        None  #: largest resident memory while prepare and solve ran
    )


def measure(solver: Solver, qp: QP, tol: float) -> Measurement:
    """Let `solver` prepare and solve `qp` once, both timed.

    Nothing that the solver does wrong raises: an exception, a missing library or a
    malformed answer becomes the status and message of a solution without a point.
    """
    with _garbage_collection_off():
        reset = _reset_peak()
        try:  # only the solver's own code: a bug of ours must not pass for its failure
            if (reason := solver.declines(qp)) is not None:
                return _without_point(qp, Status.DECLINED, reason)
            start = perf_counter()
            solve = solver.prepare(qp, tol)
            ready = perf_counter()
            answer = solve()
            end = perf_counter()
        except ImportError as e:
            name = e.name or str(e)
            message = f"not installed: {name} (pip install {name.partition('.')[0]})"
            return _without_point(qp, Status.DECLINED, message)
        except (Exception, SystemExit) as e:
            return _without_point(qp, Status.FAILED, f"{type(e).__name__}: {e}")
        peak = memory_mib("VmHWM") if reset else None
    return Measurement(
        solution=_checked(answer, qp),
        prepare_seconds=ready - start,
        solve_seconds=end - ready,
        total_seconds=end - start,
        peak_mib=peak,
    )


def memory_mib(key: str, process: int | str = "self") -> float | None:
    """Read VmRSS (resident memory) or VmHWM (its peak); None where it cannot be had.

    ``ru_maxrss`` is no substitute: it is inherited from the parent, even by exec.
    """
    try:
        lines = Path(f"/proc/{process}/status").read_text().splitlines()
    except OSError:
        return None
    values = [line.split()[1] for line in lines if line.startswith(f"{key}:")]
    return int(values[0]) / 1024 if values else None  # the kernel counts in KiB


def _reset_peak() -> bool:
    """Make VmHWM start again from what is resident now; False where that fails."""
    try:
        Path("/proc/self/clear_refs").write_text("5")  # proc(5)
    except OSError:
        return False
    return True


def _without_point(qp: QP, status: Status, message: str) -> Measurement:
    one_line = " ".join(str(message).split())
    return Measurement(solution=Solution.without_point(qp, status, one_line))


def _checked(answer: object, qp: QP) -> Solution:
    """Turn whatever a solver returned into a solution that fits `qp`."""
    if not isinstance(answer, Solution):
        message = f"returned {type(answer).__name__}, expected Solution"
        return Solution.without_point(qp, Status.FAILED, message)
    try:
        if (mismatch := answer.mismatch(qp)) is not None:
            return Solution.without_point(qp, Status.FAILED, mismatch)
        return _plain(answer)
    except (TypeError, ValueError, AttributeError) as e:
        message = f"malformed Solution: {e}"
        return Solution.without_point(qp, Status.FAILED, message)


def _plain(s: Solution) -> Solution:
    """Replace whatever compares or prints like the right type by the right type."""
    return replace(
        s,
        status=Status(s.status),
        x=np.asarray(s.x, dtype=float),
        y=np.asarray(s.y, dtype=float),
        z=np.asarray(s.z, dtype=float),
        z_box=np.asarray(s.z_box, dtype=float),
        iterations=None if s.iterations is None else int(s.iterations),
        counts={str(name): int(count) for name, count in s.counts.items()},
        message=" ".join(str(s.message).split()),
        reported={
            str(k): v if isinstance(v, str) else float(v) for k, v in s.reported.items()
        },
    )


@contextmanager
def _garbage_collection_off() -> Iterator[None]:
    """Collect now rather than somewhere inside the measurement."""
    gc.collect()
    was_on = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if was_on:
            gc.enable()
