"""The process that one solver lives in, between measurements too.

It answers one line of JSON with one or more on another pipe:

* it says ``{"event": "ready"}`` when it can be asked
* ``{"warm_up": true}``: it solves tiny QPs, so that imports which a solver puts off
  until its first solve are not timed, and says ``{"event": "warm"}``
* ``{"qp": PATH, "tol": TOL, "out": PATH}``: it loads the QP, says
  ``{"event": "start"}``, measures, writes the point to `out` and says
  ``{"event": "done", "claimed": …, "message": …, …}``
* ``{"check": NAME}``: it runs one of `harness.conformance.CHECKS`, and says "start" and
  ``{"event": "done", "grade": …, "message": …}``

and ends when its requests do. Every measurement loads its QP afresh, so that nothing
that a solver did to the last one is left.
"""

from __future__ import annotations

import ctypes
import gc
import json
import os
import signal
import sys
from pathlib import Path
from typing import Any, TextIO

import numpy as np

from harness.conformance import run_check
from harness.measure import Measurement, measure
from harness.plugin import Solver
from harness.qp import QP, no_rows
from harness.qpfile import load_qp
from harness.record import finite
from harness.store import write_point

_PR_SET_PDEATHSIG = 1  # prctl(2)


def serve(solver: Solver, request_fd: int, reply_fd: int) -> None:
    """Answer requests until there are no more."""
    _die_with_parent()
    with os.fdopen(request_fd) as requests, os.fdopen(reply_fd, "w") as replies:
        _send(replies, event="ready")
        for line in requests:
            request = json.loads(line)
            if "check" in request:
                _examine(solver, request["check"], replies)
            elif "warm_up" in request:
                _warm_up(solver)
                _send(replies, event="warm")
            else:
                _answer(solver, request, replies)


def _answer(solver: Solver, request: dict[str, Any], replies: TextIO) -> None:
    qp, _ = load_qp(Path(request["qp"]))
    _send(replies, event="start")
    measurement = _measured_here(solver, qp, request["tol"])
    sys.stdout.flush()  # what the solver printed belongs to this measurement
    s = measurement.solution
    write_point(Path(request["out"]), s)
    _send(
        replies,
        event="done",
        claimed=s.status,
        message=s.message,
        iterations=s.iterations,
        counts=s.counts,
        reported=finite(dict(s.reported)),
        prepare_seconds=measurement.prepare_seconds,
        solve_seconds=measurement.solve_seconds,
        total_seconds=measurement.total_seconds,
        peak_mib=measurement.peak_mib,
    )


def _examine(solver: Solver, check: str, replies: TextIO) -> None:
    _send(replies, event="start")
    result = run_check(check, solver)
    _send(replies, event="done", **result._asdict())


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


def _send(replies: TextIO, **event: Any) -> None:
    replies.write(json.dumps(event) + "\n")
    replies.flush()


def _die_with_parent() -> None:
    """Have the kernel kill us when the parent dies, even in the middle of a solve."""
    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
