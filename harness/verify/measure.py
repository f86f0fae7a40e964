"""The clock: one solver on one QP, once, in this process."""

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
SAMPLE_SECONDS = 0.005  #: a timed sample is not much shorter than this
MOST_INNER = 100
MOST_ASSEMBLED = 3000  #: rows of an operator P that is multiplied out
LARGEST_COUNT = 2**53
LONGEST_MESSAGE = 1900  #: characters
_LONGEST_NAME = 60  #: characters of a file's name in a message

_VECTORS = ("x", "y", "z", "z_box")


class Timed(NamedTuple):
    """What a solver returned, and what that cost."""

    solution: Solution  #: float vectors of the right shapes, whatever happened
    cost: Measurement
    first_seconds: float | None = None  #: of the first time, where there were others


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
    """Let `solver` prepare and solve `qp`, both timed; asking it first is preparing.

    Nothing that the solver does wrong raises: an exception, a missing library or a
    malformed answer becomes the status and message of a solution without a point.

    An operator P that the solver cannot use as such (`harness.needs_matrices`) is
    multiplied out where it has at most MOST_ASSEMBLED rows: that is preparing, too.

    prepare : where that is a step of a sequence, see `harness.plugin.Chained`
    sample_seconds : what takes less is prepared afresh and solved again until all that
        takes as long; the answer is the first, the times are the mean of the others,
        since the first meets cold caches. Each time the QP is made of other objects,
        so that nothing is found again by who it is
    starts, ends : called just before the clock starts, and when it has stopped
    """
    ask = _Asked(solver, prepare or (lambda qp: solver.prepare(qp, tol)))
    with _garbage_collection_off():
        starts()
        try:  # only the solver's own code: a bug of ours must not pass for its failure
            answer, seconds, peaks = _timed(ask, qp)
            first = sum(seconds)
            inner = _inner(first, sample_seconds)
            if inner > 1:
                again = [
                    _timed(ask, _fresh_copy(qp), peaks=False)[1] for _ in range(inner)
                ]
                seconds = tuple(
                    sum(phase) / inner for phase in zip(*again, strict=True)
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
class _Asked:
    """What of a solver is timed as preparing: whether it takes a QP, and `prepare`."""

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
    """A solver declares or returns no usable reason to decline."""


def reason_to_decline(solver: Solver, qp: QP) -> str | None:
    """Return the reason why `solver` does not take `qp`, or None if it does.

    A set of a kind that the solver does not declare in `accepts` is one: without a
    declaration it accepts bounds alone.

    Raises
    ------
    ReasonError
        When `accepts` is not a tuple of classes, or `declines` returns anything else,
        such as False.

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
            return f"does not accept sets of the kind {type(one).__name__}"
    reason: object = solver.declines(qp)
    if reason is None or isinstance(reason, str):
        return reason
    is_plain = isinstance(reason, bool | Real | np.generic)
    got = shown(reason) if is_plain else type(reason).__name__
    raise ReasonError(f"declines returned {got}; expected None or a text")


def _explicit(qp: QP) -> QP:
    """Multiply an operator P out, where it is small."""
    n = qp.q.size
    if n > MOST_ASSEMBLED or too_large(n, 3):
        raise _DeclinedError(
            f"{NEEDS_MATRICES}; P is an operator of {n} rows, and is multiplied out up "
            f"to {MOST_ASSEMBLED} where memory allows"
        )
    return replace(qp, P=assembled(qp.P))


class _DeclinedError(Exception):
    """A solver does not take a QP; the message is its reason."""


def _timed(
    prepare: Prepare, qp: QP, *, peaks: bool = True
) -> tuple[object, tuple[float, ...], tuple[float | None, float | None]]:
    """Prepare and solve once: the answer, and both phases' seconds and peaks in MiB."""
    reset = peaks and _reset_peak()
    start = perf_counter()
    solve = prepare(qp)
    ready = perf_counter()
    prepare_peak = memory_mib("VmHWM") if reset else None
    reset = peaks and _reset_peak()
    again = perf_counter()
    answer = solve()
    end = perf_counter()
    solve_peak = memory_mib("VmHWM") if reset else None
    if isinstance(qp.P, SerialisableOperator):
        qp.P.forget()
    return answer, (ready - start, end - again), (prepare_peak, solve_peak)


def _fresh_copy(qp: QP) -> QP:
    """Return the same QP in objects of its own; the numbers are shared."""

    def other(M: Any) -> Any:
        if isinstance(M, tuple):
            return tuple(_with_parts(one, other) for one in M)
        if isinstance(M, np.ndarray):
            return M.view()
        if issparse(M) and hasattr(M, "indptr"):
            M = copy(M)
            M.data, M.indices, M.indptr = (
                M.data.view(), M.indices.view(), M.indptr.view(),
            )  # fmt: skip
        return M

    return _with_parts(qp, other)


def _with_parts(whole: T, other: Callable[[Any], Any]) -> T:
    """Copy a dataclass, each attribute replaced by `other` of it."""
    new = copy(whole)  # not checked once more: that takes longer than a small solve
    vars(new).update({name: other(part) for name, part in vars(whole).items()})
    return new


def _inner(seconds: float, sample_seconds: float) -> int:
    """Choose how often to repeat so that a sample takes `sample_seconds`."""
    if seconds >= sample_seconds / 2:
        return 1
    return min(ceil(sample_seconds / max(seconds, 1e-9)), MOST_INNER)


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


def _without_point(qp: QP, status: Status, message: str) -> Timed:
    solution = Solution.without_point(qp, status, message)
    return Timed(solution, Measurement())


def one_line(message: object) -> str:
    """Give what a solver says as one line that any file can hold."""
    whole = " ".join(str(message).split())
    text = whole.encode(errors="backslashreplace").decode()
    return text if len(text) <= LONGEST_MESSAGE else f"{text[:LONGEST_MESSAGE]}…"


def failure(solver: Solver, e: BaseException) -> str:
    """Describe an exception of a solver in one line that ends with its place.

    The place is the last call in the file of the solver's class, without its folder:
    ``KeyError: 'rho' (mine.py:24)``. An exception from elsewhere has no place.
    """
    line = one_line(f"{type(e).__name__}: {_said(e)}")
    file = _file_of(type(getattr(solver, "__wrapped__", solver)))
    calls = [
        at for frame, at in walk_tb(e.__traceback__) if frame.f_code.co_filename == file
    ]
    if not calls:
        return line
    return f"{line} ({shortened(one_line(Path(file).name), _LONGEST_NAME)}:{calls[-1]})"


def _file_of(kind: type) -> str:
    """Find the file of a class by its methods; empty if no file has them.

    A class that cloudpickle copied has a module of another process.
    """
    for one in kind.__mro__:
        for part in vars(one).values():
            if not isinstance(part, FunctionType) or part.__module__ != one.__module__:
                continue
            file: str = unwrap(part).__code__.co_filename
            if Path(file).is_file():  # methods that dataclasses generate have none
                return file
    return ""


def _said(e: BaseException) -> str:
    """Show an exception of a solver, whose own code may fail again at that."""
    try:
        return str(e)
    except Exception:
        return "(it cannot be shown)"


def _checked(answer: object, qp: QP) -> Solution:
    """Turn whatever a solver returned into a solution that fits `qp`."""
    if not isinstance(answer, Solution):
        message = f"returned {type(answer).__name__}, expected Solution"
        return Solution.without_point(qp, Status.FAILED, message)
    try:  # reading the solver's objects runs its code
        if (mismatch := answer.mismatch(qp)) is not None:
            return Solution.without_point(qp, Status.FAILED, mismatch)
        return _plain(answer)
    except Exception as e:
        message = one_line(f"malformed Solution: {_said(e)}")
        return Solution.without_point(qp, Status.FAILED, message)


def _plain(s: Solution) -> Solution:
    """Replace whatever compares or prints like the right type by the right type."""
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
    """Take a vector of real numbers for what it is; nothing is made one."""
    array = np.asarray(values)
    if array.dtype.kind not in "biuf":
        raise ValueError(f"{name} has dtype {array.dtype}, expected real numbers")
    return np.asarray(array, dtype=float)


def _count(name: str, value: Any) -> int:
    count = int(value)
    if not 0 <= count <= LARGEST_COUNT:
        got = count if abs(count) < 10 * LARGEST_COUNT else "a number far out of range"
        raise ValueError(f"{name} = {got}, expected 0 to 2**53")
    return count


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
