"""Timing of one solver on one QP in this process."""

from __future__ import annotations

import gc
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from copy import copy
from dataclasses import dataclass, replace
from inspect import unwrap
from math import ceil
from numbers import Real
from pathlib import Path
from time import perf_counter
from traceback import walk_tb
from types import FunctionType
from typing import Any, NamedTuple, TypeVar

import numpy as np
from scipy.sparse import issparse

from mortarbench.harness.errors import shortened, shown
from mortarbench.harness.limits import too_large
from mortarbench.harness.operators import SerialisableOperator, assembled
from mortarbench.harness.plugin import Solver
from mortarbench.harness.qp import NEEDS_MATRICES, QP, Vector
from mortarbench.harness.record import Measurement
from mortarbench.harness.sets.box import Box
from mortarbench.harness.solution import Solution, Status, usable_history

T = TypeVar("T")
SAMPLE_SECONDS = 0.005  #: approximate total time of all repetitions (s); see `measure`
MAX_INNER_LOOPS = 100  #: largest number of repetitions of a short solve
#: Largest number of rows of an operator P that is assembled for a solver.
MAX_ASSEMBLED_ROWS = 3000
#: largest count that is stored, since doubles do not represent all larger integers
MAX_COUNT = 2**53
MAX_MESSAGE = 1900  #: largest length of a message of a solver, in characters
_MAX_NAME = 60  #: largest length of a file name in a message, in characters

_VECTORS = ("x", "y", "z", "z_box")


class Timed(NamedTuple):
    """A solution, and the cost of computing it."""

    solution: Solution  #: solution, whose vectors are float arrays of the right shapes
    cost: Measurement  #: times and memory
    #: time of the first solve in s; None if the solve was not repeated
    first_seconds: float | None = None


Prepare = Callable[[QP], Callable[[], Solution]]


def measure(
    solver: Solver,
    qp: QP,
    tol: float,
    *,
    prepare: Prepare | None = None,
    sample_seconds: float = 0.0,
    starts: Callable[[], None] = lambda: None,
    ends: Callable[[], None] = lambda: None,
) -> Timed:
    """Time the preparation and the solution of `qp` by `solver`.

    Errors of the solver are not raised. After an exception, a missing library or a
    malformed answer, the result is a solution without a point that has a status and a
    message. The call of `declines` counts as preparation. If the solver cannot use an
    operator P (`harness.needs_matrices`) and P has at most MAX_ASSEMBLED_ROWS rows, P
    is assembled, which also counts as preparation.

    prepare : function that replaces ``solver.prepare`` in a step of a sequence; see
        `harness.plugin.Chained`
    sample_seconds : if preparation and solve take less than half of this time, they are
        repeated until the repetitions together take about this time, or
        `MAX_INNER_LOOPS` times. The returned
        answer is the answer of the first solve. The times are means over the
        repetitions, because the first solve runs with cold caches. Every repetition
        receives a QP of new objects, so that the solver cannot recognise the QP by
        identity
    starts, ends : called just before the clock starts and just after the clock stops
    """
    preparation = _Preparation(solver, prepare or (lambda qp: solver.prepare(qp, tol)))
    with _garbage_collection_off():
        starts()
        try:  # only solver code may run here: bugs of the harness must be raised
            answer, seconds, peaks = _timed(preparation, qp)
            first = sum(seconds)
            inner = _inner(first, sample_seconds)
            if inner > 1:
                repeated = [
                    _timed(preparation, _fresh_copy(qp), peaks=False)[1]
                    for _ in range(inner)
                ]
                seconds = tuple(
                    sum(phase) / inner for phase in zip(*repeated, strict=True)
                )
        except _DeclinedError as e:
            return _without_point(qp, Status.DECLINED, one_line(e))
        except ImportError as e:
            name = e.name or str(e)
            message = f"not installed: {name} (pip install {name.partition('.')[0]})"
            return _without_point(qp, Status.DECLINED, one_line(message))
        except ReasonError as e:
            return _without_point(qp, Status.FAILED, str(e))
        except (Exception, SystemExit) as e:
            return _without_point(qp, Status.FAILED, failure(solver, e))
        finally:
            ends()
    cost = Measurement(
        prepare_seconds=seconds[0],
        solve_seconds=seconds[1],
        total_seconds=sum(seconds),
        peak_mib=max((p for p in peaks if p is not None), default=None),
        prepare_peak_mib=peaks[0],
        solve_peak_mib=peaks[1],
        inner_loops=inner,
    )
    return Timed(_checked(answer, qp), cost, first if inner > 1 else None)


@dataclass(frozen=True)
class _Preparation:
    """Timed preparation by a solver: call of `declines`, assembly of P, `prepare`."""

    solver: Solver
    prepare: Prepare

    def __call__(self, qp: QP) -> Callable[[], Solution]:
        reason = reason_to_decline(self.solver, qp)
        if reason == NEEDS_MATRICES and not qp.is_explicit:
            qp = _explicit(qp)
            reason = reason_to_decline(self.solver, qp)
        if reason is not None:
            raise _DeclinedError(reason)
        if isinstance(qp.P, SerialisableOperator):
            qp.P.build()
        return self.prepare(qp)


class ReasonError(Exception):
    """Error of a solver: `accepts` or the result of `declines` has the wrong type."""


def reason_to_decline(solver: Solver, qp: QP) -> str | None:
    """Return the reason why `solver` declines `qp`, or None if `solver` accepts it.

    A solver accepts only sets of the classes in its attribute `accepts`. A solver
    without this attribute accepts only bounds.

    Raises
    ------
    ReasonError
        If `accepts` is not a tuple of classes, or if `declines` returns neither None
        nor a string (for instance False).

    """
    accepted = getattr(solver, "accepts", (Box,))
    if not isinstance(accepted, tuple) or not all(
        isinstance(a, type) for a in accepted
    ):
        raise ReasonError(
            f"accepts = {shown(accepted)}; expected a tuple of classes, such as (Box,)"
        )
    for one in qp.sets:
        if not isinstance(one, accepted):
            return f"does not accept sets of the class {type(one).__name__}"
    reason: object = solver.declines(qp)
    if reason is None or isinstance(reason, str):
        return reason
    is_plain = isinstance(reason, bool | Real | np.generic)
    got = shown(reason) if is_plain else type(reason).__name__
    raise ReasonError(f"declines returned {got}; expected None or a string")


def _explicit(qp: QP) -> QP:
    """Return the QP with its operator P as a matrix; raise if P is too large."""
    n = qp.q.size
    if n > MAX_ASSEMBLED_ROWS or too_large(n, 3):
        raise _DeclinedError(
            f"{NEEDS_MATRICES}; P is an operator with {n} rows; operators are "
            f"assembled up to {MAX_ASSEMBLED_ROWS} rows, if memory allows"
        )
    return replace(qp, P=assembled(qp.P))


class _DeclinedError(Exception):
    """Refusal of a QP by a solver; the message contains the reason."""


def _timed(
    prepare: Prepare, qp: QP, *, peaks: bool = True
) -> tuple[object, tuple[float, ...], tuple[float | None, float | None]]:
    """Prepare and solve once.

    Returns the answer, the times of preparation and solve (s), and the memory peaks of
    preparation and solve (MiB; None if not measured).
    """
    reset = peaks and reset_peak()
    start = perf_counter()
    solve = prepare(qp)
    ready = perf_counter()
    prepare_peak = memory_mib("VmHWM") if reset else None
    reset = peaks and reset_peak()
    resumed = perf_counter()
    answer = solve()
    end = perf_counter()
    solve_peak = memory_mib("VmHWM") if reset else None
    if isinstance(qp.P, SerialisableOperator):
        qp.P.forget()
    return answer, (ready - start, end - resumed), (prepare_peak, solve_peak)


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
            M.data, M.indices, M.indptr = (
                M.data.view(),
                M.indices.view(),
                M.indptr.view(),
            )
        return M

    return _with_parts(qp, other)


def _with_parts(whole: T, other: Callable[[Any], Any]) -> T:
    """Copy a dataclass, and apply `other` to each attribute of the copy."""
    new = copy(whole)  # skip __init__, whose checks may take longer than a solve
    vars(new).update({name: other(part) for name, part in vars(whole).items()})
    return new


def _inner(seconds: float, sample_seconds: float) -> int:
    """Return the number of repetitions that together take about `sample_seconds`."""
    if seconds >= sample_seconds / 2:
        return 1
    return min(ceil(sample_seconds / max(seconds, 1e-9)), MAX_INNER_LOOPS)


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
        Path("/proc/self/clear_refs").write_text(
            "5"
        )  # the code 5 resets VmHWM, see proc(5)
    except OSError:
        return False
    return True


def _without_point(qp: QP, status: Status, message: str) -> Timed:
    solution = Solution.without_point(qp, status, message)
    return Timed(solution, Measurement())


def one_line(message: object) -> str:
    """Return a text as one line of limited length; lone surrogates are escaped."""
    whole = " ".join(str(message).split())
    text = whole.encode(errors="backslashreplace").decode()
    return text if len(text) <= MAX_MESSAGE else f"{text[:MAX_MESSAGE]}…"


def failure(solver: Solver, e: BaseException) -> str:
    """Describe an exception of a solver in one line, with file name and line number.

    File name and line number, as in ``KeyError: 'rho' (mine.py:24)``, refer to the
    innermost call in the file that defines the class of the solver. Both are omitted if
    the traceback does not contain this file.
    """
    line = one_line(f"{type(e).__name__}: {_text_of(e)}")
    file = _file_of(type(getattr(solver, "__wrapped__", solver)))
    calls = [
        at for frame, at in walk_tb(e.__traceback__) if frame.f_code.co_filename == file
    ]
    if not calls:
        return line
    return f"{line} ({shortened(one_line(Path(file).name), _MAX_NAME)}:{calls[-1]})"


def _file_of(kind: type) -> str:
    """Return the file that defines the methods of a class; "" if no file is found.

    The module of the class is not used: if cloudpickle has copied the class, the module
    may exist only in another process.
    """
    for one in kind.__mro__:
        for part in vars(one).values():
            if not isinstance(part, FunctionType) or part.__module__ != one.__module__:
                continue
            file: str = unwrap(part).__code__.co_filename
            if Path(file).is_file():  # methods generated by dataclasses have no file
                return file
    return ""


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
        got = (
            count if abs(count) < 10 * MAX_COUNT else "a number far outside this range"
        )
        raise ValueError(f"{name} = {got}, expected 0 to 2**53")
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
