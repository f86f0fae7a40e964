"""Vectors distributed over the MPI processes of one solve, called *ranks*.

Every rank runs the same code, and stores a slice of each vector. Elementwise operations
need no communication. Reductions to a number are collective and return the same number
on every rank, so that all ranks take the same branches. An algorithm that applies only
such operations to NumPy vectors therefore runs unchanged on several ranks:

    x + alpha*p, np.where(free, g, 0)   elementwise, on the local slice
    x @ y, v.max(), moves.any()         reduction over all ranks

A `DistributedVector` raises TypeError for all other NumPy functions, and for methods
such as `mean` and `argmax`, since their results would depend on the local slice only.
Indexing and conversion by `np.asarray` apply to the local slice.
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
#: Largest size of arrays that are gathered and added in the order of the ranks, so that
#: every rank obtains the same rounding errors. Longer arrays are summed by Allreduce.
MAX_ORDERED_SUM = 64

#: Categories of the time of a solve. "products" are products with local operators.
#: "exchange" is packing and unpacking of exchanged values. "coarse" comprises solves of
#: the coarse problem and other work that every rank repeats. "waiting" is waiting for
#: other ranks in MPI.
PARTS = ("products", "exchange", "coarse", "waiting")


@dataclass(frozen=True, eq=False)
class Ranks:
    """The MPI processes of one solve, with timers and counters of this process."""

    comm: Comm
    #: time in s that this process spent in each of the `PARTS`, which do not overlap
    seconds: dict[str, float] = field(default_factory=lambda: dict.fromkeys(PARTS, 0.0))
    #: numbers of reductions, of messages to single ranks, and of bytes in the messages
    counts: dict[str, int] = field(
        default_factory=lambda: {"reductions": 0, "messages": 0, "bytes": 0}
    )

    @cached_property
    def private_comm(self) -> Comm:
        """A duplicate of `comm`; the first access is collective."""
        return self.comm.Dup()

    @property
    def size(self) -> int:
        """Number of ranks."""
        return int(self.comm.size)

    @property
    def rank(self) -> int:
        """Number of this rank, from 0."""
        return int(self.comm.rank)

    def total(self, part: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return, on every rank, the sum over all ranks of arrays of equal shape."""
        part = np.ascontiguousarray(part, dtype=float)
        if part.size <= MAX_ORDERED_SUM:
            return np.asarray(self.gather_all(part).sum(axis=0))
        total = np.empty_like(part)
        self.counts["reductions"] += 1
        with self.clocked("waiting"):
            self.comm.Allreduce(part, total)
        return total

    def extreme(self, value: float, pick: Callable[[Any], Any]) -> float:
        """Return, on every rank, the least or the largest of the numbers of all ranks.

        pick : np.min or np.max
        """
        return float(pick(self.gather_all(np.array([value], dtype=float))))

    def gather_all(self, part: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the stacked arrays (size, …) of all ranks, which have equal shapes."""
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
        """Start sending consecutive parts of an array to other ranks.

        out : entries to be sent, in the order of the ranks
        sizes, coming : (size,) numbers of entries sent to and received from each rank

        Returns
        -------
        a function that waits for all messages, and returns the received entries in the
        order of the ranks; work done before its call overlaps with the communication

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
        """Return a context manager that adds the run time of its block to a category.

        The time of a nested block is added only to the category of the nested block.

        part : one of the `PARTS`
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
    """Substitute for an MPI communicator in a single process."""

    size = 1
    rank = 0

    def Dup(self) -> _SingleProcess:
        """Return a communicator of the same process."""
        return self

    def allgather(self, part: T) -> list[T]:
        """Return the list of the objects of all ranks."""
        return [part]

    def alltoall(self, parts: list[T]) -> list[T]:
        """Return the list of the objects that all ranks send to this rank."""
        return parts

    def Allgather(self, part: NDArray[Any], parts: NDArray[Any]) -> None:
        """Fill parts (1, …) with the arrays of all ranks."""
        parts[0] = part

    def Allreduce(self, part: NDArray[Any], total: NDArray[Any]) -> None:
        """Fill `total` with the sum over all ranks."""
        total[...] = part


class _Clock:
    """Timer that adds the time of a block, without nested blocks, to a category.

    A context manager based on a generator would be several times slower.
    """

    __slots__ = ("before", "part", "seconds", "start")

    def __init__(self, seconds: dict[str, float], part: str) -> None:
        self.seconds, self.part = seconds, part

    def __enter__(self) -> None:
        # nested blocks add their times to the same table; __exit__ subtracts these
        # times
        self.before = sum(self.seconds.values())
        self.start = perf_counter()

    def __exit__(self, *_: object) -> None:
        passed = perf_counter() - self.start
        within = sum(self.seconds.values()) - self.before
        self.seconds[self.part] += passed - within


class DistributedVector(np.ndarray):
    """The local slice (n_rank,) of a vector, with reductions over all ranks.

    The slice may also be a matrix (k, d) whose rows are blocks of components. Since
    each block is on a single rank, sums and norms along axis 1 need no communication.

    Raises
    ------
    TypeError
        If a NumPy function is neither elementwise nor one of the reductions sum, min,
        max, any, all, dot product, norm and count of nonzeros, or if a method such as
        `mean` or `argmax` would use only the local slice.

    """

    ranks: Ranks

    def __array_finalize__(self, obj: Any) -> None:
        if isinstance(obj, DistributedVector):
            self.ranks = obj.ranks

    def dot(self, other: Any) -> Any:  # type: ignore[override]  # no `out`
        """Return the dot product, summed over all ranks."""
        return self @ other

    def _refused(self, *args: Any, **kwargs: Any) -> Any:
        raise TypeError(
            "this method of a distributed vector would use only its local slice"
        )

    argmax = argmin = argpartition = argsort = cumprod = cumsum = mean = _refused
    partition = prod = sort = std = trace = var = searchsorted = tofile = _refused

    def __array_ufunc__(
        self, ufunc: np.ufunc, method: str, *inputs: Any, **how: Any
    ) -> Any:
        plain = [_slice(i) for i in inputs]
        if ufunc is np.matmul:
            return _contracted(self.ranks, *plain)
        if (
            method == "reduce" and how.get("axis") == 1
        ):  # each row of a matrix (k, d) is on one rank
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
    """Wrap an array (n_rank,) as the local slice of a distributed vector."""
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
    """Return a @ b, summed over ranks, for slices (n,) or matrices (k, n), (n, k)."""
    product = ranks.total(np.atleast_1d(a @ b))
    return product if np.ndim(a) + np.ndim(b) > 2 else float(product[0])


@dataclass(frozen=True, eq=False)
class DistributedColumns:
    """A sparse matrix G (r, n) whose columns are distributed over the ranks.

    Vectors (r,) are equal on all ranks; r is small, the size of a coarse problem.
    """

    part: csr_array  #: (r, n_rank) columns of this rank
    ranks: Ranks

    @property
    def shape(self) -> tuple[int, int]:
        """Numbers of rows and of local columns."""
        rows, columns = self.part.shape
        return rows, columns

    @property
    def T(self) -> _DistributedRows:
        """Gᵀ, which maps a vector (r,) to the local slice of a vector (n,)."""
        return _DistributedRows(self)

    def __matmul__(self, v: NDArray[np.float64]) -> NDArray[np.float64]:
        return self.ranks.total(self.part @ np.asarray(v))

    def __abs__(self) -> DistributedColumns:
        return DistributedColumns(abs(self.part), self.ranks)

    def scaled(self, s: NDArray[np.float64]) -> DistributedColumns:
        """Return the matrix with each row i multiplied by s[i]."""
        return DistributedColumns(csr_array(diags_array(s) @ self.part), self.ranks)

    def __getitem__(self, rows: NDArray[np.int64]) -> DistributedColumns:
        return DistributedColumns(csr_array(self.part[rows]), self.ranks)

    def gram(self, columns: NDArray[np.bool_] | None = None) -> csc_array:
        """Return G_F G_Fᵀ (r, r), where G_F consists of selected columns of G.

        columns : (n_rank,) mask of the selected local columns; None for all columns
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
    """Part of a distributed QP that is stored on one rank."""

    #: local part of the QP; vectors and the columns of A are distributed, and b is
    #: equal on all ranks
    qp: QP
    #: gathers a solution on rank 0; returns None on other ranks
    whole: Callable[[Solution], Solution | None]


#: Prefix of the digest of a QP that no process stores as a whole, see `DistributedQP`.
DISTRIBUTED_DIGEST = "emitted-"


class Evaluation(NamedTuple):
    """Evaluation of a solution that is distributed over ranks."""

    #: function, called by all ranks, that returns the physical results in SI units,
    #: equal on all ranks; None if the results need the whole QP
    quantities: Callable[[], Mapping[str, Any]] | None


class DistributedQP(NamedTuple):
    """A QP of which each rank assembles its own part; no process stores the whole QP.

    All ranks must call the functions `share`, `digest` and `answer`.
    """

    variables: int  #: number of variables on all ranks
    equality_rows: int  #: number of equality rows
    bounds: int  #: number of finite bounds on all ranks
    #: assembles the part of this rank; each call builds a new operator
    share: Callable[[], Share]
    #: returns a digest of the coefficients. The digest differs from
    #: `harness.files.qpfile.qp_digest`, which needs the whole QP, and therefore has the
    #: prefix `DISTRIBUTED_DIGEST`
    digest: Callable[[], str]
    #: evaluates a solution, given by its local slice
    answer: Callable[[Solution], Evaluation]
    discs: int = 0  #: number of discs on all ranks

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


#: Function, called by all ranks, that assembles the QP of a case. The case is given as
#: a mapping with family, params and form.
Emit = Callable[[Mapping[str, Any], Ranks], DistributedQP]


@runtime_checkable
class Distributable(Protocol):
    """A product x ↦ Px that can be distributed over ranks.

    The function that builds an operator (`harness.operators`) may return such a
    product.
    """

    @property
    def parts(self) -> int:
        """Number of parts of the operator, which limits the number of ranks."""

    def share(self, qp: QP, ranks: Ranks) -> Share:
        """Return the part of a `qp` with this P on this rank; called by all ranks.

        Raises
        ------
        InputError
            If there are more ranks than parts.

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
