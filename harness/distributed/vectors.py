"""Vectors that are spread over the processes of one solve, the *ranks* of MPI.

Every rank runs the same code on its own slice. What acts on each component alone needs
no other rank; what reduces a vector to a number reduces it over all of them, and all
ranks get the same number, so that they take the same branches. An algorithm that is
written with NumPy's vectors therefore runs on ranks as it is written:

    x + alpha*p, np.where(free, g, 0)   on each slice
    x @ y, v.max(), moves.any()         over all ranks

Whatever else is asked of a `DistributedVector` is refused, rather than answered with
the slice alone.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from time import perf_counter
from typing import (
    TYPE_CHECKING,
    Any,
    NamedTuple,
    Protocol,
    TypeVar,
    cast,
    runtime_checkable,
)

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csc_array, csr_array, diags_array

from mortarbench.harness.qp import QP
from mortarbench.harness.solution import Solution

if TYPE_CHECKING:
    from mpi4py.MPI import Comm

T = TypeVar("T")
FEW = 64  #: numbers that are added in the order of the ranks


#: what `Ranks.clocked` tells apart: products with local operators; copying what is
#: exchanged; solves of the coarse problem and what else all ranks do alike; blocked in
#: MPI until the numbers of the others have come
PARTS = ("products", "exchange", "coarse", "waiting")


@dataclass(frozen=True, eq=False)
class Ranks:
    """The processes of one solve, and what this one has spent on it."""

    comm: Comm
    #: s, of the `PARTS`, which do not overlap
    seconds: dict[str, float] = field(default_factory=lambda: dict.fromkeys(PARTS, 0.0))
    #: collective reductions; messages to single ranks, and bytes of these
    counts: dict[str, int] = field(
        default_factory=lambda: {"reductions": 0, "messages": 0, "bytes": 0}
    )
    #: s: how fast they talk to one another, as `harness.distributed.network.network`
    #: measured it; empty where it did not
    network: Mapping[str, float] = field(default_factory=dict)

    @cached_property
    def apart(self) -> Comm:
        """A communicator of the same processes; called first by all ranks together."""
        return self.comm.Dup()

    @property
    def size(self) -> int:
        """How many there are."""
        return int(self.comm.size)

    @property
    def rank(self) -> int:
        """Which one this process is, from 0 on."""
        return int(self.comm.rank)

    def total(self, part: NDArray[np.float64]) -> NDArray[np.float64]:
        """Add arrays of one shape over all ranks; every rank gets the same sum."""
        part = np.ascontiguousarray(part, dtype=float)
        if part.size <= FEW:
            return np.asarray(self.everyones(part).sum(axis=0))
        found = np.empty_like(part)
        self.counts["reductions"] += 1
        with self.clocked("waiting"):
            self.comm.Allreduce(part, found)
        return found

    def extreme(self, value: float, pick: Callable[[Any], Any]) -> float:
        """Pick the least or largest number of all ranks."""
        return float(pick(self.everyones(np.array([value], dtype=float))))

    def everyones(self, part: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the arrays of one shape of all ranks, (size, …)."""
        parts = np.empty((self.size, *part.shape))
        self.counts["reductions"] += 1
        with self.clocked("waiting"):
            self.comm.Allgather(part, parts)
        return parts

    def exchange(
        self,
        out: NDArray[np.float64],
        sizes: NDArray[np.int64],
        coming: NDArray[np.int64],
    ) -> Callable[[], NDArray[np.float64]]:
        """Send consecutive parts to other ranks, who send at the same time.

        sizes, coming : (size,) of what goes to each and of what comes from each

        Returns
        -------
        waits until all is there, and returns what came, in the order of the ranks;
        what is done before that is done meanwhile

        """
        out, found = np.ascontiguousarray(out), np.empty(int(coming.sum()))
        ends, at = np.cumsum(sizes), np.cumsum(coming)
        sends, comes = (np.flatnonzero(n).tolist() for n in (sizes, coming))
        self.counts["messages"] += len(sends)
        self.counts["bytes"] += out.nbytes
        posted = [
            self.comm.Irecv(found[at[r] - coming[r] : at[r]], source=r) for r in comes
        ]
        posted += [
            self.comm.Isend(out[ends[r] - sizes[r] : ends[r]], dest=r) for r in sends
        ]

        def arrived() -> NDArray[np.float64]:
            if posted:
                with self.clocked("waiting"):
                    for request in posted:
                        request.Wait()
            return found

        return arrived

    def clocked(self, what: str) -> _Clock:
        """Note how long something takes, one of the `PARTS`, less other parts in it."""
        return _Clock(self.seconds, what)

    def clear(self) -> None:
        """Begin to count anew."""
        for table in (self.seconds, self.counts):
            table.update(dict.fromkeys(table, 0))


def single_process() -> Ranks:
    """Return the ranks of a single process, which needs no MPI."""
    return Ranks(cast("Comm", _SingleProcess()))


class _SingleProcess:
    """The communicator of a single process: there is nobody else to hear from."""

    size = 1
    rank = 0

    def Dup(self) -> _SingleProcess:
        """Return a communicator of the same process."""
        return self

    def allgather(self, part: T) -> list[T]:
        """Return what all have, in the order of the ranks."""
        return [part]

    def alltoall(self, parts: list[T]) -> list[T]:
        """Return what all have for this one."""
        return parts

    def Allgather(self, part: NDArray[Any], parts: NDArray[Any]) -> None:
        """Fill parts (1, …) with what all have."""
        parts[0] = part

    def Allreduce(self, part: NDArray[Any], found: NDArray[Any]) -> None:
        """Fill `found` with the sum of what all have."""
        found[...] = part


class _Clock:
    """Adds what a block takes to a part, without what other parts in it took.

    A class, since as a generator it would take a few times as long.
    """

    __slots__ = ("before", "seconds", "start", "what")

    def __init__(self, seconds: dict[str, float], what: str) -> None:
        self.seconds, self.what = seconds, what

    def __enter__(self) -> None:
        self.before = sum(self.seconds.values())
        self.start = perf_counter()

    def __exit__(self, *_: object) -> None:
        passed = perf_counter() - self.start
        within = sum(self.seconds.values()) - self.before
        self.seconds[self.what] += passed - within


class DistributedVector(np.ndarray):
    """The slice (n_rank,) of a vector that this rank holds; reductions are of all.

    Raises
    ------
    TypeError
        For what is neither done component by component nor one of the reductions sum,
        min, max, any, all, dot product, norm and count.

    """

    ranks: Ranks

    def __array_finalize__(self, obj: Any) -> None:
        if isinstance(obj, DistributedVector):
            self.ranks = obj.ranks

    def dot(self, other: Any) -> Any:  # type: ignore[override]  # no `out`
        """Return the dot product over all ranks."""
        return self @ other

    def _refused(self, *args: Any, **kwargs: Any) -> Any:
        raise TypeError("this method of a distributed vector would see its slice only")

    argmax = argmin = argpartition = argsort = cumprod = cumsum = mean = _refused
    partition = prod = sort = std = trace = var = searchsorted = tofile = _refused

    def __array_ufunc__(
        self, ufunc: np.ufunc, method: str, *inputs: Any, **how: Any
    ) -> Any:
        plain = [_slice(i) for i in inputs]
        if ufunc is np.matmul:
            return _contracted(self.ranks, *plain)
        if method == "__call__":
            if "out" in how:
                how["out"] = tuple(_slice(out) for out in how["out"])
            return _rewrap(self.ranks, getattr(ufunc, method)(*plain, **how))
        if method == "reduce" and ufunc in _REDUCTIONS:
            return _REDUCTIONS[ufunc](self.ranks, ufunc.reduce(*plain, **how))
        raise TypeError(f"{ufunc.__name__}.{method} of a distributed vector")

    def __array_function__(
        self, function: Any, types: Any, args: Any, kwargs: Any
    ) -> Any:
        plain = [_slice(a) for a in args]
        if function is np.linalg.norm and len(args) == 1 and not kwargs:
            return np.sqrt(float(_contracted(self.ranks, plain[0], plain[0])))
        if function is np.count_nonzero:
            return int(self.ranks.total(np.array([np.count_nonzero(plain[0])]))[0])
        if function in _COMPONENTWISE:
            return _rewrap(self.ranks, function(*plain, **kwargs))
        raise TypeError(f"{function.__name__} of a distributed vector")


def distributed(part: NDArray[Any], ranks: Ranks) -> DistributedVector:
    """Take an array (n_rank,) for this rank's slice of a vector."""
    found = np.ascontiguousarray(part).view(DistributedVector)
    found.ranks = ranks
    return found


def _slice(value: Any) -> Any:
    return np.asarray(value) if isinstance(value, DistributedVector) else value


def _rewrap(ranks: Ranks, found: Any) -> Any:
    if isinstance(found, tuple):
        return tuple(_rewrap(ranks, f) for f in found)
    return distributed(found, ranks) if np.ndim(found) == 1 else found


def _contracted(ranks: Ranks, a: NDArray[Any], b: NDArray[Any]) -> Any:
    """Multiply (n,) or (k, n) with (n,) or (n, k), summed over all ranks."""
    found = ranks.total(np.atleast_1d(a @ b))
    return found if np.ndim(a) + np.ndim(b) > 2 else float(found[0])


@dataclass(frozen=True, eq=False)
class DistributedColumns:
    """A sparse matrix G (r, n) of whose columns each rank holds a slice.

    Vectors (r,) are the same on all ranks: r is the size of a coarse problem.
    """

    part: csr_array  #: (r, n_rank)
    ranks: Ranks

    @property
    def shape(self) -> tuple[int, int]:
        """Rows, and columns of this rank."""
        rows, columns = self.part.shape
        return rows, columns

    @property
    def T(self) -> _DistributedRows:
        """Gᵀ, which takes (r,) to this rank's slice of (n,)."""
        return _DistributedRows(self)

    def __matmul__(self, v: NDArray[np.float64]) -> NDArray[np.float64]:
        return self.ranks.total(self.part @ np.asarray(v))

    def __abs__(self) -> DistributedColumns:
        return DistributedColumns(abs(self.part), self.ranks)

    def scaled(self, s: NDArray[np.float64]) -> DistributedColumns:
        """Multiply row i with s[i]."""
        return DistributedColumns(csr_array(diags_array(s) @ self.part), self.ranks)

    def __getitem__(self, rows: NDArray[np.int64]) -> DistributedColumns:
        return DistributedColumns(csr_array(self.part[rows]), self.ranks)

    def gram(self, columns: NDArray[np.bool_] | None = None) -> csc_array:
        """Return G_F G_Fᵀ (r, r) of some columns F, or of all."""
        part = self.part
        if columns is not None:
            part = part[:, np.flatnonzero(np.asarray(columns))]
        with self.ranks.clocked("coarse"):
            mine = csc_array(part @ part.T)
            with self.ranks.clocked("waiting"):
                all_ = self.ranks.comm.allgather(mine)
            return csc_array(sum(all_))


@dataclass(frozen=True, eq=False)
class _DistributedRows:
    columns: DistributedColumns

    def __matmul__(self, y: NDArray[np.float64]) -> DistributedVector:
        return distributed(self.columns.part.T @ y, self.columns.ranks)


class Share(NamedTuple):
    """What one rank has of a QP that is solved on several."""

    qp: QP  #: vectors are distributed, A has distributed columns, b is on every rank
    #: gathers a solution of it on rank 0; None on the others
    whole: Callable[[Solution], Solution | None]


#: begins the digest of a QP that no process has whole: `DistributedQP.digest`
DISTRIBUTED_DIGEST = "emitted-"


class Evaluation(NamedTuple):
    """What ranks make of a solution together; all of them call what they call."""

    #: what `harness.verify.over_ranks` takes to certify it; None: that needs the whole
    certifiable: Any | None
    #: physical results, SI, the same on all ranks; None: these need the whole
    quantities: Callable[[], Mapping[str, Any]] | None


class DistributedQP(NamedTuple):
    """A QP that ranks have made together, each its share; no process has it whole."""

    variables: int  #: of the whole
    equality_rows: int  #: of the whole
    bounds: int  #: finite ones, of the whole
    #: puts this rank's operator together, anew each time: called by all ranks
    share: Callable[[], Share]
    #: names the numbers of the QP; called by all ranks. Not as
    #: `harness.files.qpfile.qp_digest`, which takes the whole, and therefore marked by
    #: `DISTRIBUTED_DIGEST`
    digest: Callable[[], str]
    #: of this rank's slice of a solution, what it means; called by all ranks
    answer: Callable[[Solution], Evaluation]

    @property
    def sizes(self) -> dict[str, int]:
        """Say of the whole what `harness.qp.QP.sizes` does."""
        return {
            "variables": self.variables, "equalities": self.equality_rows,
            "inequalities": 0, "bounds": self.bounds,
        }  # fmt: skip


#: has all ranks emit a case, family, params and form, where its family can
Emit = Callable[[Mapping[str, Any], Ranks], DistributedQP]


@runtime_checkable
class Distributable(Protocol):
    """A product x ↦ Px that can be done by several ranks.

    What puts an operator together may return one (`harness.operators`).
    """

    @property
    def parts(self) -> int:
        """How many parts there are, the most ranks that can share them."""

    def share(self, qp: QP, ranks: Ranks) -> Share:
        """Take this rank's share of a `qp` with this P; called by all ranks.

        Raises
        ------
        InputError
            When there are more ranks than parts.

        """


_REDUCTIONS: Mapping[np.ufunc, Callable[[Ranks, Any], Any]] = {
    np.add: lambda ranks, part: type(part)(ranks.total(np.array([part]))[0]),
    np.minimum: lambda ranks, part: ranks.extreme(part, np.min),
    np.maximum: lambda ranks, part: ranks.extreme(part, np.max),
    np.logical_or: lambda ranks, part: bool(ranks.extreme(part, np.max)),
    np.logical_and: lambda ranks, part: bool(ranks.extreme(part, np.min)),
}
_COMPONENTWISE = frozenset(
    {np.where, np.clip, np.zeros_like, np.empty_like, np.copy, np.broadcast_to}
)
