"""Vectors distributed over the processes of one solve, the *ranks* of MPI.

Every rank runs the same code on its local slice. Elementwise operations need no
communication; reductions to a number run over all ranks and return the same number on
each, so that all ranks take the same branches. An algorithm written for NumPy vectors
therefore runs on ranks unchanged:

    x + alpha*p, np.where(free, g, 0)   on each slice
    x @ y, v.max(), moves.any()         over all ranks

A `DistributedVector` raises TypeError for any other operation, whose result would
depend on the local slice only.
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
#: Arrays of up to this size are gathered and added in the order of the ranks, so that
#: rounding is the same on all ranks. Allreduce sums longer arrays.
MAX_ORDERED_SUM = 64

#: Parts of the time of a solve: products with local operators; packing and unpacking of
#: exchanged values; solves of the coarse problem and other work repeated on all ranks;
#: waiting in MPI for other ranks.
PARTS = ("products", "exchange", "coarse", "waiting")


@dataclass(frozen=True, eq=False)
class Ranks:
    """The processes of one solve, with timers and counters of this process."""

    comm: Comm
    #: time spent on each of the `PARTS`, which do not overlap, s
    seconds: dict[str, float] = field(default_factory=lambda: dict.fromkeys(PARTS, 0.0))
    #: numbers of reductions, of messages to single ranks, and of their bytes
    counts: dict[str, int] = field(
        default_factory=lambda: {"reductions": 0, "messages": 0, "bytes": 0}
    )
    #: latencies and time per byte, s, from `harness.distributed.network.network`;
    #: empty if they were not measured
    network: Mapping[str, float] = field(default_factory=dict)

    @cached_property
    def private_comm(self) -> Comm:
        """A duplicate of the communicator; the first access is collective."""
        return self.comm.Dup()

    @property
    def size(self) -> int:
        """Number of ranks."""
        return int(self.comm.size)

    @property
    def rank(self) -> int:
        """Index of this rank, from 0."""
        return int(self.comm.rank)

    def total(self, part: NDArray[np.float64]) -> NDArray[np.float64]:
        """Sum arrays of equal shape over all ranks; every rank gets the same result."""
        part = np.ascontiguousarray(part, dtype=float)
        if part.size <= MAX_ORDERED_SUM:
            return np.asarray(self.gather_all(part).sum(axis=0))
        total = np.empty_like(part)
        self.counts["reductions"] += 1
        with self.clocked("waiting"):
            self.comm.Allreduce(part, total)
        return total

    def extreme(self, value: float, pick: Callable[[Any], Any]) -> float:
        """Return the least or largest number of all ranks.

        pick : np.min or np.max
        """
        return float(pick(self.gather_all(np.array([value], dtype=float))))

    def gather_all(self, part: NDArray[np.float64]) -> NDArray[np.float64]:
        """Gather the arrays of all ranks, of equal shape, to (size, …) on each."""
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
        """Start to exchange consecutive parts of an array with other ranks.

        sizes, coming : (size,) numbers of entries sent to and received from each rank

        Returns
        -------
        a function that waits for all messages and returns the entries received, in the
        order of the ranks; work done before its call overlaps with communication

        """
        out, received = np.ascontiguousarray(out), np.empty(int(coming.sum()))
        ends, at = np.cumsum(sizes), np.cumsum(coming)
        sends, comes = (np.flatnonzero(n).tolist() for n in (sizes, coming))
        self.counts["messages"] += len(sends)
        self.counts["bytes"] += out.nbytes
        posted = [
            self.comm.Irecv(received[at[r] - coming[r] : at[r]], source=r)
            for r in comes
        ]
        posted += [
            self.comm.Isend(out[ends[r] - sizes[r] : ends[r]], dest=r) for r in sends
        ]

        def arrived() -> NDArray[np.float64]:
            if posted:
                with self.clocked("waiting"):
                    for request in posted:
                        request.Wait()
            return received

        return arrived

    def clocked(self, part: str) -> _Clock:
        """Return a context that adds its time to one of the `PARTS`.

        The time of nested contexts counts only for their own parts.
        """
        return _Clock(self.seconds, part)

    def clear(self) -> None:
        """Reset timers and counters."""
        for table in (self.seconds, self.counts):
            table.update(dict.fromkeys(table, 0))


def single_process() -> Ranks:
    """Return the `Ranks` of a single process, without MPI."""
    return Ranks(cast("Comm", _SingleProcess()))


class _SingleProcess:
    """Communicator of a single process without other ranks."""

    size = 1
    rank = 0

    def Dup(self) -> _SingleProcess:
        """Return a communicator of the same process."""
        return self

    def allgather(self, part: T) -> list[T]:
        """Return the objects of all ranks, in their order."""
        return [part]

    def alltoall(self, parts: list[T]) -> list[T]:
        """Return the objects that all ranks send to this one."""
        return parts

    def Allgather(self, part: NDArray[Any], parts: NDArray[Any]) -> None:
        """Fill parts (1, …) with the arrays of all ranks."""
        parts[0] = part

    def Allreduce(self, part: NDArray[Any], total: NDArray[Any]) -> None:
        """Fill `total` with the sum over all ranks."""
        total[...] = part


class _Clock:
    """Timer of a block for one part, without the time of nested blocks.

    This is a class because a generator-based context is a few times slower.
    """

    __slots__ = ("before", "part", "seconds", "start")

    def __init__(self, seconds: dict[str, float], part: str) -> None:
        self.seconds, self.part = seconds, part

    def __enter__(self) -> None:
        # nested blocks add to the same table; their time is subtracted at the end
        self.before = sum(self.seconds.values())
        self.start = perf_counter()

    def __exit__(self, *_: object) -> None:
        passed = perf_counter() - self.start
        within = sum(self.seconds.values()) - self.before
        self.seconds[self.part] += passed - within


class DistributedVector(np.ndarray):
    """The local slice (n_rank,) of a vector; reductions run over all ranks.

    Selected components may form rows (k, d), each of them on one rank: sums and norms
    along axis 1 need no other rank.

    Raises
    ------
    TypeError
        If an operation is neither elementwise nor one of the reductions sum, min, max,
        any, all, dot product, norm and count.

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
        if method == "reduce" and how.get("axis") == 1:  # within rows (k, d)
            return _rewrap(self.ranks, ufunc.reduce(*plain, **how))
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
        if function is np.linalg.norm and len(args) == 1 and kwargs == {"axis": 1}:
            return _rewrap(self.ranks, np.linalg.norm(plain[0], axis=1))
        if function is np.linalg.norm and len(args) == 1 and not kwargs:
            return np.sqrt(float(_contracted(self.ranks, plain[0], plain[0])))
        if function is np.count_nonzero:
            return int(self.ranks.total(np.array([np.count_nonzero(plain[0])]))[0])
        if function in _ELEMENTWISE:
            return _rewrap(self.ranks, function(*plain, **kwargs))
        raise TypeError(f"{function.__name__} of a distributed vector")


def distributed(part: NDArray[Any], ranks: Ranks) -> DistributedVector:
    """Wrap an array (n_rank,) as the local slice of a vector."""
    vector = np.ascontiguousarray(part).view(DistributedVector)
    vector.ranks = ranks
    return vector


def _slice(value: Any) -> Any:
    return np.asarray(value) if isinstance(value, DistributedVector) else value


def _rewrap(ranks: Ranks, result: Any) -> Any:
    if isinstance(result, tuple):
        return tuple(_rewrap(ranks, r) for r in result)
    return distributed(result, ranks) if np.ndim(result) else result


def _contracted(ranks: Ranks, a: NDArray[Any], b: NDArray[Any]) -> Any:
    """Multiply (n,) or (k, n) by (n,) or (n, k), and sum over all ranks."""
    product = ranks.total(np.atleast_1d(a @ b))
    return product if np.ndim(a) + np.ndim(b) > 2 else float(product[0])


@dataclass(frozen=True, eq=False)
class DistributedColumns:
    """A sparse matrix G (r, n) whose columns are distributed over the ranks.

    Vectors (r,) are replicated on all ranks: r is the size of a coarse problem.
    """

    part: csr_array  #: (r, n_rank)
    ranks: Ranks

    @property
    def shape(self) -> tuple[int, int]:
        """Number of rows, and of local columns."""
        rows, columns = self.part.shape
        return rows, columns

    @property
    def T(self) -> _DistributedRows:
        """Gᵀ, which maps (r,) to the local slice of (n,)."""
        return _DistributedRows(self)

    def __matmul__(self, v: NDArray[np.float64]) -> NDArray[np.float64]:
        return self.ranks.total(self.part @ np.asarray(v))

    def __abs__(self) -> DistributedColumns:
        return DistributedColumns(abs(self.part), self.ranks)

    def scaled(self, s: NDArray[np.float64]) -> DistributedColumns:
        """Multiply row i by s[i]."""
        return DistributedColumns(csr_array(diags_array(s) @ self.part), self.ranks)

    def __getitem__(self, rows: NDArray[np.int64]) -> DistributedColumns:
        return DistributedColumns(csr_array(self.part[rows]), self.ranks)

    def gram(self, columns: NDArray[np.bool_] | None = None) -> csc_array:
        """Return G_F G_Fᵀ (r, r) for the columns F, or GGᵀ.

        columns : (n_rank,) mask of F; None for all columns
        """
        part = self.part
        if columns is not None:
            part = part[:, np.flatnonzero(np.asarray(columns))]
        with self.ranks.clocked("coarse"):
            local = csc_array(part @ part.T)
            with self.ranks.clocked("waiting"):
                grams = self.ranks.comm.allgather(local)
            return csc_array(sum(grams))


@dataclass(frozen=True, eq=False)
class _DistributedRows:
    columns: DistributedColumns

    def __matmul__(self, y: NDArray[np.float64]) -> DistributedVector:
        return distributed(self.columns.part.T @ y, self.columns.ranks)


class Share(NamedTuple):
    """The part of a distributed QP on one rank."""

    qp: QP  #: vectors and the columns of A are distributed, b is replicated
    #: gathers a solution on rank 0; returns None on other ranks
    whole: Callable[[Solution], Solution | None]


#: Prefix of the digest of a QP that is not stored as a whole: `DistributedQP.digest`.
DISTRIBUTED_DIGEST = "emitted-"


class Evaluation(NamedTuple):
    """Collective evaluation of a solution; its functions are called by all ranks."""

    #: arguments of `certify_over_ranks` (`harness.verify.over_ranks`); None if a
    #: certificate needs the whole QP
    certifiable: Any | None
    #: returns physical results, SI, equal on all ranks; None if they need the whole QP
    quantities: Callable[[], Mapping[str, Any]] | None


class DistributedQP(NamedTuple):
    """A QP assembled by ranks, each its share; no process stores it as a whole."""

    variables: int  #: total number
    equality_rows: int  #: total number
    bounds: int  #: total number of finite bounds
    #: assembles the local share; each call builds a new operator. Collective.
    share: Callable[[], Share]
    #: digest of the coefficients. Collective. It differs from
    #: `harness.files.qpfile.qp_digest`, which needs the whole QP, and therefore has the
    #: prefix `DISTRIBUTED_DIGEST`.
    digest: Callable[[], str]
    #: evaluates a solution from its local slice. Collective.
    answer: Callable[[Solution], Evaluation]
    discs: int = 0  #: total number

    @property
    def sizes(self) -> dict[str, int]:
        """Sizes of the whole QP, as in `harness.qp.QP.sizes`."""
        sizes = {
            "variables": self.variables,
            "equalities": self.equality_rows,
            "inequalities": 0,
            "bounds": self.bounds,
        }
        return {**sizes, "discs": self.discs} if self.discs else sizes


#: Assembles a case, given by family, params and form, on all ranks. Collective.
Emit = Callable[[Mapping[str, Any], Ranks], DistributedQP]


@runtime_checkable
class Distributable(Protocol):
    """A product x ↦ Px that can be distributed over ranks.

    A maker of an operator (`harness.operators`) may return one.
    """

    @property
    def parts(self) -> int:
        """Number of parts, which is the largest number of ranks."""

    def share(self, qp: QP, ranks: Ranks) -> Share:
        """Return the local share of a `qp` with this P; called by all ranks.

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
_ELEMENTWISE = frozenset(
    {np.where, np.clip, np.zeros_like, np.empty_like, np.copy, np.broadcast_to}
)
