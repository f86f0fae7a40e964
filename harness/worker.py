"""The process that one solver lives in, between measurements too.

It answers the requests of `harness.serving` with these of its own:

* the warm-up solves tiny QPs, so that imports which a solver puts off until its first
  solve are not timed
* ``{"qp": PATH, "tol": TOL, "out": PATH}``: it loads the QP, measures, and writes the
  point to `out`

Every measurement loads its QP afresh, so that nothing that a solver did to the last one
is left.
"""

from __future__ import annotations

import gc
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from harness.measure import Measurement, measure
from harness.plugin import Solver
from harness.qp import QP, no_rows
from harness.qpfile import load_qp
from harness.serving import answer_requests
from harness.store import write_point


def serve(solver: Solver, request_fd: int, reply_fd: int) -> None:
    """Answer requests until there are no more."""

    def handle(request: dict[str, Any], start: Callable[[], None]) -> dict[str, Any]:
        return _answer(solver, request, start)

    answer_requests(handle, lambda: _warm_up(solver), request_fd, reply_fd)


def _answer(
    solver: Solver, request: dict[str, Any], start: Callable[[], None]
) -> dict[str, Any]:
    qp, _ = load_qp(Path(request["qp"]))
    start()
    measurement = _measured_here(solver, qp, request["tol"])
    s = measurement.solution
    write_point(Path(request["out"]), s)
    return {
        "claimed": s.status,
        "message": s.message,
        "iterations": s.iterations,
        "counts": s.counts,
        "prepare_seconds": measurement.prepare_seconds,
        "solve_seconds": measurement.solve_seconds,
        "total_seconds": measurement.total_seconds,
        "peak_mib": measurement.peak_mib,
    }


def _measured_here(solver: Solver, qp: QP, tol: float) -> Measurement:
    """Measure; a child that the solver forked and let return to us ends here."""
    process = os.getpid()
    measurement = measure(solver, qp, tol)
    if os.getpid() != process:
        os._exit(0)
    return measurement


def _warm_up(solver: Solver) -> None:
    """Solve a QP with bounds and one with rows; how that ends will show later."""
    eye, ones = np.eye(2), np.ones(2)
    bounds = dict(q=-ones, lb=np.zeros(2), ub=np.full(2, np.inf))
    no_row = dict(A=no_rows(2), b=np.zeros(0), G=no_rows(2), h=np.zeros(0))
    one_row_each = dict(A=ones[None], b=ones[:1], G=eye[:1], h=ones[:1])
    for rows in (no_row, one_row_each):
        _measured_here(solver, QP(P=eye, **bounds, **rows), 1e-6)
    gc.freeze()  # the modules that are loaded by now need no further collecting
