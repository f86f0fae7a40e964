"""Answers of solvers to a QP in a file, computed in processes with a time limit."""

from __future__ import annotations

import multiprocessing
from collections.abc import Iterator
from pathlib import Path
from queue import Empty
from typing import Any

import mortarbench as mb
from mortarbench.harness import Solution
from mortarbench.solvers import SOLVERS

SECONDS = 40.0  #: time limit of each solve


def limited_solves(
    path: Path, name: str, tolerances: tuple[float, ...]
) -> Iterator[tuple[float, Solution]]:
    """Yield tolerances and answers of a solver; nothing after a crash or the limit."""
    context = multiprocessing.get_context("spawn")
    queue = context.Queue()
    process = context.Process(target=_solve, args=(path, name, tolerances, queue))
    process.start()
    try:
        for tol in tolerances:
            answer = queue.get(timeout=SECONDS)
            if answer is None:  # the solver declines the QP
                return
            yield tol, answer
    except Empty:
        return
    finally:
        process.kill()
        process.join()


def _solve(path: Path, name: str, tolerances: tuple[float, ...], queue: Any) -> None:
    qp, solver = mb.build(f"file:{path}").family_case.qp, SOLVERS[name]
    for tol in tolerances:
        queue.put(None if solver.declines(qp) else solver.prepare(qp, tol)())
