"""Timing of one solver on one QP in this process."""

from __future__ import annotations

import gc
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from copy import copy
from dataclasses import replace
from inspect import unwrap
from itertools import count
from pathlib import Path
from statistics import median
from time import perf_counter
from traceback import walk_tb
from typing import Any, NamedTuple, TypeVar

import numpy as np
from scipy.sparse import issparse

from mortarbench.harness.errors import shortened, shown
from mortarbench.harness.limits import too_large
from mortarbench.harness.operators import assembled
from mortarbench.harness.plugin import About, Solver
from mortarbench.harness.qp import NEEDS_MATRICES, QP, Vector
from mortarbench.harness.sets.box import Box
from mortarbench.harness.solution import Solution, Status, usable_history

T = TypeVar("T")
SAMPLE_SECONDS = 0.005  #: smallest total time of the timed solves, s; see `measure`
#: Largest number of timed solves. It ends the repetition if the clock stands still.
MAX_INNER_LOOPS = 500
#: A first solve that takes longer, in s, is not repeated: it is the timed solve.
MAX_UNTIMED_SECONDS = 1.0
#: A solver reuses answers if its solves of a QP are more than this factor faster than
#: its solves of perturbed QPs. The work on two QPs that differ by 1 % rarely differs
#: by more than 2.
REMEMBERED_SPEEDUP = 5.0
#: Number of perturbed solves that must all be slower. At a load of 13 on two cores, all
#: of 3 solves were delayed in 4 of 724 measurements of solvers that reuse nothing.
MIN_PERTURBED_SOLVES = 10
#: Total time of perturbed solves, s, after which the timed solves follow each other. It
#: is exceeded only if perturbed solves are slower than the timed ones.
MAX_PERTURBED_SECONDS = 2 * SAMPLE_SECONDS
#: Largest number of rows of an operator P that is assembled for a solver.
MAX_ASSEMBLED_ROWS = 3000
#: largest count that is stored, since doubles do not represent all larger integers
MAX_COUNT = 2**53
MAX_MESSAGE = 1900  #: largest length of a message of a solver, in characters
_MAX_NAME = 60  #: largest length of a file name in a message, in characters

_VECTORS = ("x", "y", "z", "z_box")
_GOLDEN_RATIO = 0.6180339887498949
_perturbations = count(1)  # numbers of the perturbations in this process


class Timed(NamedTuple):
    """A solution, and the cost of computing it."""

    solution: Solution  #: solution, whose vectors are float arrays of the right shapes
    cost: Mapping[str, Any]  #: times and memory, as fields of a record
    worked_seconds: float = 0.0  #: total time of all solves, also of untimed ones, s
    solves: int = 0  #: number of all solves


Prepare = Callable[[QP], Callable[[], Solution]]


def _nothing() -> None:
    """Do nothing."""


def measure(
    solver: Solver,
    qp: QP,
    tol: float,
    *,
    prepare: Prepare | None = None,
    once: bool = False,
    starts: Callable[[], None] = _nothing,
    solved: Callable[[], None] = _nothing,
    ends: Callable[[], None] = _nothing,
) -> Timed:
    """Time the preparation and the solution of `qp` by `solver`.

    The first solve is not timed, because it may include compilation and loading. Then
    `qp` is solved until the timed solves together take `SAMPLE_SECONDS`, at least once.
    Each timed solve follows an untimed solve of a QP with another objective
    (`perturbed`), which overwrites results that the solver keeps. The recorded times
    are means over the timed solves, and the recorded answer is the last one. If the
    first solve takes more than `MAX_UNTIMED_SECONDS`, it is the only solve, and it is
    timed.

    The solver reuses answers (`Record.remembered`) if it returns the same point
    for both QPs, or if each of `MIN_PERTURBED_SOLVES` solves of perturbed QPs takes
    more than `REMEMBERED_SPEEDUP` times the median of the timed solves.

    Errors of the solver are not raised. After an exception, a missing library or a
    malformed answer, the result is a solution without a point that has a status and a
    message. Errors on perturbed QPs are ignored. The call of `declines` counts as
    preparation. If the solver cannot use an operator P (`harness.needs_matrices`) and
    P has at most MAX_ASSEMBLED_ROWS rows, P is assembled, which also counts as
    preparation.

    prepare : function that replaces ``solver.prepare`` in a step of a sequence, see
        `harness.plugin.Chained`; the step is solved once
    once : True for a single solve, which is timed
    starts : called just before the first solve
    solved : called after the first solve
    ends : called after the last solve
    """
    run = _Run(solver, prepare or (lambda qp: solver.prepare(qp, tol)))
    with _garbage_collection_off():
        reset = reset_peak()
        starts()
        try:  # only solver code may run here: bugs of the harness must be raised
            try:
                answer, seconds = run(qp)
            finally:
                solved()
            peak = memory_mib("VmHWM") if reset else None
            repeats, remembered, untimed = [seconds], None, 0
            if not (once or prepare or sum(seconds) > MAX_UNTIMED_SECONDS):
                rest = _Perturbed(run, qp, answer)
                answer, repeats = _repeated(run, qp, rest)
                remembered = rest.remembered(repeats)
                untimed = run.solves - len(repeats)
        except (DeclinedError, SolverError) as e:
            declined = isinstance(e, DeclinedError)
            status = Status.DECLINED if declined else Status.FAILED
            return Timed(Solution.without_point(qp, status, str(e)), {})
        finally:
            ends()
    means = [sum(phase) / len(repeats) for phase in zip(*repeats, strict=True)]
    cost = {
        "prepare_seconds": means[0],
        "solve_seconds": means[1],
        "total_seconds": sum(means),
        "peak_mib": peak,
        "inner": len(repeats),
        "untimed": untimed,
        "remembered": remembered,
    }
    return Timed(_checked(answer, qp), cost, run.worked_seconds, run.solves)


def solve_once(
    solver: Solver, qp: QP, tol: float, prepare: Prepare | None = None
) -> tuple[Solution, float]:
    """Solve `qp` once; return the answer and the time of preparation and solve (s).

    prepare : see `measure`

    Raises
    ------
    DeclinedError
        If the solver declines the QP, or its package is not installed.
    SolverError
        If the solver raises an exception.

    """
    run = _Run(solver, prepare or (lambda qp: solver.prepare(qp, tol)))
    with _garbage_collection_off():
        answer, seconds = run(qp)
    s = _checked(answer, qp)
    if s.status is Status.DECLINED:
        raise DeclinedError(s.message)
    return s, sum(seconds)


class DeclinedError(Exception):
    """Refusal of a QP by a solver; the message is the reason, in one line."""


class SolverError(Exception):
    """Exception of a solver; the message describes it in one line."""


class _Run:
    """Timed solves by one solver, with their number and their total time."""

    def __init__(self, solver: Solver, prepare: Prepare) -> None:
        self._solver = solver
        self._prepare = prepare
        self.solves = 0
        self.worked_seconds = 0.0

    def __call__(self, qp: QP) -> tuple[object, tuple[float, float]]:
        """Prepare and solve once; return the answer, and the times of both (s)."""
        process, self.solves = os.getpid(), self.solves + 1
        entered = perf_counter()
        try:
            start = perf_counter()
            solve = self._prepared(qp)
            ready = perf_counter()
            answer = solve()
            end = perf_counter()
        except (DeclinedError, SolverError):
            raise
        except ImportError as e:
            about = getattr(self._solver, "about", None)
            if isinstance(about, About) and (missing := about.missing):
                raise DeclinedError(one_line(missing)) from None
            raise SolverError(failure(self._solver, e)) from e
        except (Exception, SystemExit) as e:
            raise SolverError(failure(self._solver, e)) from e
        finally:
            if os.getpid() != process:
                os._exit(0)  # a child that the solver forked, and that returned
            self.worked_seconds += perf_counter() - entered
        if hasattr(qp.P, "forget"):
            qp.P.forget()
        return answer, (ready - start, end - ready)

    def _prepared(self, qp: QP) -> Callable[[], Solution]:
        """Call `declines`, assemble P if the solver needs its entries, and prepare."""
        reason = reason_to_decline(self._solver, qp)
        if reason == NEEDS_MATRICES and not qp.is_explicit:
            n = qp.q.size
            if n > MAX_ASSEMBLED_ROWS or too_large(n, 3):
                raise DeclinedError(
                    f"{NEEDS_MATRICES}; P is an operator with {n} rows; operators are "
                    f"assembled up to {MAX_ASSEMBLED_ROWS} rows, if memory allows"
                )
            qp = replace(qp, P=assembled(qp.P))
            reason = reason_to_decline(self._solver, qp)
        if reason is not None:
            raise DeclinedError(one_line(reason))
        if hasattr(qp.P, "build"):
            qp.P.build()
        return self._prepare(qp)


class _Perturbed:
    """Solves of perturbed QPs, with which the timed solves are compared."""

    def __init__(self, run: _Run, qp: QP, answer: object) -> None:
        self._run = run
        self._qp = qp
        first = _checked(answer, qp)
        # False if there is no perturbation, or the solver fails on a perturbed QP
        self._is_possible = first.status is Status.SOLVED
        self._answers = [first]  # answers to `qp` and to the last perturbed QP
        self._same = False  # True if the same point was returned for two QPs
        self._seconds: list[float] = []
        self.total_seconds = 0.0  #: total time of the solves, s

    def solve(self) -> None:
        """Solve one further perturbed QP, and ignore errors of the solver."""
        if not self._is_possible:
            return
        self._is_possible = False
        start = perf_counter()
        try:
            other = perturbed(self._qp, next(_perturbations))
            self._run.worked_seconds += perf_counter() - start
            if other is None:
                return
            answer, seconds = self._run(other)
        except (DeclinedError, SolverError, MemoryError):
            return
        s = _checked(answer, other)
        self._is_possible = s.status is Status.SOLVED
        self._same |= self._is_possible and any(
            all(np.array_equal(getattr(s, v), getattr(old, v)) for v in _VECTORS)
            for old in self._answers
        )
        self._answers[1:] = [s]
        self._seconds.append(sum(seconds))
        self.total_seconds += sum(seconds)

    def remembered(self, repeats: Sequence[tuple[float, float]]) -> bool | None:
        """Return True if the solver reuses answers; None if this cannot be decided.

        repeats : times of the timed solves, s
        """
        limit = REMEMBERED_SPEEDUP * median(map(sum, repeats))
        while self._is_possible and len(self._seconds) < MIN_PERTURBED_SOLVES:
            if min(self._seconds) <= limit:
                break
            self.solve()
        if not self._is_possible:
            return None
        return self._same or min(self._seconds) > limit


def _repeated(
    run: _Run, qp: QP, rest: _Perturbed
) -> tuple[object, list[tuple[float, float]]]:
    """Repeat a solve; return the last answer and the times of the timed solves.

    Each timed solve receives a QP of new objects, so that the solver cannot recognise
    the QP by identity.
    """
    repeats: list[tuple[float, float]] = []
    total = 0.0
    while not repeats or (total < SAMPLE_SECONDS and len(repeats) < MAX_INNER_LOOPS):
        if rest.total_seconds < MAX_PERTURBED_SECONDS:
            rest.solve()
        answer, seconds = run(_fresh_copy(qp))
        repeats.append(seconds)
        total += sum(seconds)
    return answer, repeats


def perturbed(qp: QP, number: int) -> QP | None:
    """Return `qp` with another objective, or None if the objective is zero.

    With f between 1.01 and 1.02, q is multiplied by f, and an explicit P is divided by
    f. The constraints are unchanged, P and P/f have the same null space, and on this
    space qᵀd and f qᵀd have the same sign. The perturbed QP is therefore solvable if
    `qp` is, and about as difficult. A P that is an operator, or to which a `structure`
    belongs, is not changed.

    number : different numbers yield different f, since multiples of the golden ratio
        are distinct modulo 1
    """
    f = 1.01 + 0.01 * (number * _GOLDEN_RATIO % 1)
    changes: dict[str, Any] = {"q": _scaled(qp.q, f)}
    if qp.is_explicit and qp.structure is None:
        changes["P"] = _scaled(qp.P, 1 / f)
    if not any(np.any(_entries(M)) for M in changes.values()):
        return None
    other = _fresh_copy(qp)
    vars(other).update(changes)
    return other


def _scaled(M: Any, factor: float) -> Any:
    """Return a read-only multiple of a vector or matrix."""
    M = M * factor
    _entries(M).flags.writeable = False
    return M


def _entries(M: Any) -> Any:
    return M.data if issparse(M) else M


def reason_to_decline(solver: Solver, qp: QP) -> str | None:
    """Return the reason why `solver` declines `qp`, or None if `solver` accepts it.

    A solver accepts only sets of the classes in its attribute `accepts`. A solver
    without this attribute accepts only bounds.

    Raises
    ------
    SolverError
        If `accepts` is not a tuple of classes, or if `declines` returns neither None
        nor a string (for instance False).

    """
    accepted = getattr(solver, "accepts", (Box,))
    if not isinstance(accepted, tuple) or not all(
        isinstance(a, type) for a in accepted
    ):
        raise SolverError(
            f"accepts = {shown(accepted)}; expected a tuple of classes, such as (Box,)"
        )
    for one in qp.sets:
        if not isinstance(one, accepted):
            return f"does not accept sets of the class {type(one).__name__}"
    reason: object = solver.declines(qp)
    if reason is None or isinstance(reason, str):
        return reason
    got = shown(reason) if isinstance(reason, int) else type(reason).__name__
    raise SolverError(f"declines returned {got}; expected None or a string")


def _fresh_copy(qp: QP) -> QP:
    """Return a QP of new objects that share the data of `qp`.

    Operators and `structure` are not copied.
    """

    def other(M: Any) -> Any:
        if isinstance(M, tuple):
            return tuple(_with_parts(one, other) for one in M)
        if isinstance(M, np.ndarray):
            return M.view()
        if issparse(M) and hasattr(M, "indptr"):
            M = copy(M)
            for name in ("data", "indices", "indptr"):
                setattr(M, name, getattr(M, name).view())
        return M

    return _with_parts(qp, other)


def _with_parts(whole: T, other: Callable[[Any], Any]) -> T:
    """Copy a dataclass, and apply `other` to each attribute of the copy."""
    new = copy(whole)  # skip __init__, whose checks may take longer than a solve
    vars(new).update({name: other(part) for name, part in vars(whole).items()})
    return new


def memory_mib(key: str, process: int | str = "self") -> float | None:
    """Return a size such as VmRSS (resident memory) in MiB, or None if it is unknown.

    key : name of the size in /proc/PID/status, such as VmHWM for the peak of VmRSS

    ``ru_maxrss`` is not used: a process inherits this value from its parent, even after
    exec.
    """
    try:
        lines = Path(f"/proc/{process}/status").read_text().splitlines()
    except OSError:
        return None
    values = [line.split()[1] for line in lines if line.startswith(f"{key}:")]
    return int(values[0]) / 1024 if values else None  # the file is in KiB


def reset_peak() -> bool:
    """Reset VmHWM to the resident memory; return False on failure."""
    try:
        Path("/proc/self/clear_refs").write_text("5")  # resets VmHWM, see proc(5)
    except OSError:
        return False
    return True


def one_line(message: object) -> str:
    """Return a text as one line of limited length; lone surrogates are escaped."""
    whole = " ".join(str(message).split())
    text = whole.encode(errors="backslashreplace").decode()
    return text if len(text) <= MAX_MESSAGE else f"{text[:MAX_MESSAGE]}…"


def failure(solver: Solver, e: BaseException) -> str:
    """Describe an exception of a solver in one line, with file name and line number.

    File name and line number, as in ``KeyError: 'rho' (mine.py:24)``, refer to the
    innermost call in the file that defines `prepare`. Both are omitted if the traceback
    does not contain this file.
    """
    line = one_line(f"{type(e).__name__}: {_text_of(e)}")
    # not the file of the module, since a class that cloudpickle copied has none
    kind: Any = type(getattr(solver, "__wrapped__", solver))
    code = getattr(unwrap(kind.prepare), "__code__", None)
    file = code.co_filename if code else ""
    calls = [
        at for frame, at in walk_tb(e.__traceback__) if frame.f_code.co_filename == file
    ]
    if not calls:
        return line
    return f"{line} ({shortened(one_line(Path(file).name), _MAX_NAME)}:{calls[-1]})"


def _text_of(e: BaseException) -> str:
    """Return the text of an exception, or a placeholder if its __str__ fails."""
    try:
        return str(e)
    except Exception:
        return "(it cannot be shown)"


def _checked(answer: object, qp: QP) -> Solution:
    """Return the answer if it is a solution of matching shapes, otherwise a failure."""
    if not isinstance(answer, Solution):
        message = f"returned {type(answer).__name__}, expected Solution"
        return Solution.without_point(qp, Status.FAILED, message)
    try:  # reading attributes may run code of the solver
        if (mismatch := answer.mismatch(qp)) is not None:
            return Solution.without_point(qp, Status.FAILED, mismatch)
        return _plain(answer)
    except Exception as e:
        message = one_line(f"malformed Solution: {_text_of(e)}")
        return Solution.without_point(qp, Status.FAILED, message)


def _plain(s: Solution) -> Solution:
    """Convert all fields of a solution to built-in types and float arrays."""
    history, objection = usable_history(s.history)
    vectors = {name: _numbers(name, getattr(s, name)) for name in _VECTORS}
    iterations = None if s.iterations is None else _count("iterations", s.iterations)
    return replace(
        s,
        status=Status(s.status),
        **vectors,
        iterations=iterations,
        counts={str(k): _count(f"counts[{k!r}]", n) for k, n in s.counts.items()},
        message=one_line("; ".join(filter(None, [str(s.message), objection]))),
        history=history,
        reported={
            str(k): one_line(v) if isinstance(v, str) else float(v)
            for k, v in s.reported.items()
        },
    )


def _numbers(name: str, values: object) -> Vector:
    """Check that `values` are real numbers, and return them as doubles."""
    array = np.asarray(values)
    if array.dtype.kind not in "biuf":
        raise ValueError(f"{name} has dtype {array.dtype}, expected real numbers")
    return np.asarray(array, dtype=float)


def _count(name: str, value: Any) -> int:
    count = int(value)
    if not 0 <= count <= MAX_COUNT:
        raise ValueError(f"{name} = {shown(count)}, expected 0 to 2**53")
    return count


@contextmanager
def _garbage_collection_off() -> Iterator[None]:
    """Collect garbage now, and disable collection during the measurement."""
    gc.collect()
    was_on = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if was_on:
            gc.enable()
