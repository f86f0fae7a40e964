"""The dual of bodies in subdomains, made by the ranks that hold it.

Each rank makes the rows that it owns, of what its subdomains are
(`problems.feti.subdomains`). Contact rows are linearised from the sides alone.

What ranks tell one another: of subdomains that may be alike, the points of one of each
kind, so that subdomains of one kind have one frame on all ranks; what they add to rows
that another one owns, of the right side q and of RᵀBᵀ; and their part of Rᵀf.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, partial
from itertools import chain, pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array, csc_array, csr_array

from mortarbench.harness import QP, InputError, Vector, no_rows
from mortarbench.harness.digest import hex_digest
from mortarbench.harness.distributed.vectors import (
    DISTRIBUTED_DIGEST,
    DistributedColumns,
    DistributedQP,
    DistributedVector,
    Ranks,
    Share,
    distributed,
)
from mortarbench.problems.fem.mesh import Nodes
from mortarbench.problems.feti.distributed import (
    Halo,
    RankOperator,
    condensed_by_ranks,
    gathered_on_one,
    halo,
    owners,
)
from mortarbench.problems.feti.operators import (
    DualOperator,
    block_bytes,
    explicit_kinds,
    touched,
)
from mortarbench.problems.feti.own_bodies import Results, answers
from mortarbench.problems.feti.subdomains import (
    OwnSubdomains,
    ProblemInParts,
    subdomains_of,
)
from mortarbench.problems.feti.torn import Subdomains


@dataclass(frozen=True, eq=False)
class OwnDual:
    """The rows of a dual that a rank owns; what is asked for, all ranks ask for."""

    own: OwnSubdomains

    @cached_property
    def at(self) -> Halo:
        """The rows, and what is exchanged of them."""
        rows = self.own.rows
        owner = owners(rows.number, rows.reach)
        return halo(self.own.ranks, rows.number, rows.reach, owner)

    @cached_property
    def explicit(self) -> NDArray[np.bool_]:
        """Kinds whose blocks are formed."""
        return explicit_kinds(self.own.rows.B, self.own.domains)

    @cached_property
    def q(self) -> Vector:
        """C − BK⁺f (o,) of own rows."""
        own = self.own
        return np.asarray(
            own.rows.c[self.at.own]
            - self.at.added(own.rows.B @ own.domains.inverse(own.f))
        )

    @cached_property
    def G(self) -> csr_array:
        """RᵀBᵀ (r, o) of own rows."""
        return _coarse_rows(self.own, self.at.rows[self.at.own])

    @cached_property
    def b(self) -> Vector:
        """Rᵀf (r,)."""
        return _resultants(self.own)

    def share(self) -> Share:
        """Put the operator together, without any factor."""
        rows, domains, ranks = self.own.rows, self.own.domains, self.own.ranks
        kinds = tuple(kind.without_factor() for kind in domains.kinds)
        anew = Subdomains(kinds, domains.kind)
        local = DualOperator(
            rows.B, anew, self.explicit, rows.equalities,
            partial(condensed_by_ranks, ranks=ranks),
        )  # fmt: skip
        lower, upper = self.bounds(self.own.problem.contact.bound)
        part = QP(
            P=RankOperator(local, self.at), q=distributed(self.q, ranks),
            lb=lower, ub=upper, G=no_rows(self.q.size), h=np.zeros(0),
            A=DistributedColumns(self.G, ranks), b=self.b,
        )  # fmt: skip
        return Share(part, gathered_on_one(self.at, rows.total))

    def bounds(self, bound: Vector) -> tuple[DistributedVector, DistributedVector]:
        """Bound the multipliers of own rows (o,), those of friction by (k,)."""
        ranks, E = self.own.ranks, self.own.rows.equalities
        scale = self.own.problem.contact_scale
        pressing = scale.size - bound.size
        bound = bound / scale[pressing:]
        below = np.concatenate([np.zeros(pressing), -bound])
        above = np.concatenate([np.full(pressing, np.inf), bound])
        number = self.at.rows[self.at.own]
        touching = number >= E
        lower, upper = (np.full(number.size, x) for x in (-np.inf, np.inf))
        lower[touching] = below[number[touching] - E]
        upper[touching] = above[number[touching] - E]
        return distributed(lower, ranks), distributed(upper, ranks)

    def bounded(self, bound: Vector) -> OwnDual:
        """Return the same with another bound (k,) of friction."""
        found = OwnDual(self.own.bounded(bound))
        vars(found).update({**vars(self), "own": found.own})
        return found


def dual_on(problem: ProblemInParts, ranks: Ranks) -> OwnDual:
    """Give subdomains to ranks, for the rows of a dual; called by all of them.

    Raises
    ------
    InputError
        Where there are fewer subdomains than ranks, or ranks know different ones.

    """
    return OwnDual(OwnSubdomains(problem, ranks, _agreed(problem, ranks)))


def emitted(
    dual: OwnDual,
    results: Results | None,
    first: OwnDual | None = None,
    others: int = 0,
) -> DistributedQP:
    """Describe this rank's share of the dual; called by all ranks.

    The digest of a problem that others come before is that of the first of these, with
    their number: what was solved differs by rounding where ranks are more or less.

    Parameters
    ----------
    results : what an answer means physically; None where only the whole tells
    first, others : the first problem that came before, and how many did

    """
    own = dual.own
    for part in ("explicit", "q", "G", "b"):
        getattr(dual, part)  # made here, so that no solver pays for it in `prepare`

    def digest() -> str:
        names = others * [_digest(first.own)] if first else [_digest(own)]
        return DISTRIBUTED_DIGEST + hex_digest(map(str.encode, names), 16)

    limits = dual.bounds(own.problem.contact.bound)
    return DistributedQP(
        variables=own.rows.total, equality_rows=own.coarse,
        bounds=sum(int(np.count_nonzero(np.isfinite(v))) for v in limits),
        share=dual.share, digest=digest,
        answer=answers(
            own, dual.at, _torn(own, dual.explicit), results
        ),
    )  # fmt: skip


def _torn(own: OwnSubdomains, explicit: NDArray[np.bool_]) -> dict[str, Any]:
    """Report how bodies are torn, as `problems.duality.torn_dual.torn_quantities`.

    explicit_mib: what blocks take on all ranks together; one of a kind that several
    ranks have is on each of these.
    """
    domains, rows, ranks = own.domains, own.rows, own.ranks
    sizes = np.array([part.size for part in touched(rows.B, domains)])
    taken = block_bytes(sizes, domains)[explicit].sum() / 2**20
    counts = [own.f.size, explicit[domains.kind].sum(), taken]
    torn_dofs, formed, mib = ranks.total(np.array(counts, dtype=float)).tolist()
    kinds = ranks.comm.allgather({kind.name for kind in domains.kinds})
    return {
        "subdomains": own.rank.size, "kinds": len(set().union(*kinds)),
        "torn_dofs": int(torn_dofs), "multipliers": rows.total,
        "explicit_subdomains": int(formed), "explicit_mib": mib,
    }  # fmt: skip


def _digest(own: OwnSubdomains) -> str:
    """Name the numbers of the QP, whichever rank has which subdomain.

    That of each subdomain: its kind, its load, and its columns of B; and of all of them
    in turn, with what every rank has of the contact.
    """
    domains, rows, contact = own.domains, own.rows, own.problem.contact
    names = [kind.name.encode() for kind in domains.kinds]
    B = csc_array(rows.B)
    B.sort_indices()
    told = []
    for s, (begin, end) in enumerate(pairwise(domains.start)):
        ends = B.indptr[begin : end + 1]
        entries = slice(ends[0], ends[-1])
        parts = rows.number[B.indices[entries]], B.data[entries], ends - ends[0]
        numbers = (*map(np.ndarray.tobytes, parts), own.f[begin:end].tobytes())
        name = hex_digest((names[domains.kind[s]], *numbers))
        told.append((int(own.number[s]), name))
    of_all = sorted(chain.from_iterable(own.ranks.comm.allgather(told)))
    shared = contact.rows.data, contact.c, contact.bound
    content = (*(name.encode() for _, name in of_all), *(v.tobytes() for v in shared))
    return hex_digest(content, 64)


def _agreed(problem: ProblemInParts, ranks: Ranks) -> NDArray[np.int64]:
    """Give subdomains to ranks (S,), if all ranks know the same subdomains.

    Partitions of graphs are made on every rank, by whatever library it has.

    Raises
    ------
    InputError
        Where they know others, or there are fewer subdomains than ranks.

    """
    found = subdomains_of(problem, ranks.size)
    known = hex_digest(x.tobytes() for x in (found, *problem.layout.sharing()))
    if len(set(ranks.comm.allgather(known))) > 1:
        raise InputError(
            "ranks have cut the bodies into different subdomains; expected the same "
            "version of METIS on all nodes"
        )
    return found


def _coarse_rows(own: OwnSubdomains, mine: Nodes) -> csr_array:
    """Return the columns of RᵀBᵀ that belong to own rows, (3S, o)."""
    ranks, rows = own.ranks, own.rows
    B, t = rows.B, rows.number.size
    unknown, place = np.unique(B.indices, return_inverse=True)
    R = own.resultants(unknown, np.ones(unknown.size))
    touched = csr_array((B.data, place, B.indptr), shape=(t, unknown.size))
    part = csr_array(touched @ R)
    owner = owners(rows.number, rows.reach)
    told: list[tuple[NDArray[Any], ...]] = [()] * ranks.size
    for one in set(range(ranks.size)) - {ranks.rank}:
        theirs = np.flatnonzero(owner == one)
        entries = coo_array(part[theirs])
        told[one] = rows.number[theirs][entries.row], entries.col, entries.data
    found = csr_array(part[np.flatnonzero(owner == ranks.rank)])
    for row, column, data in filter(None, ranks.comm.alltoall(told)):
        places = np.searchsorted(mine, row), column
        found += csr_array((data, places), shape=found.shape)
    return csr_array(found.T)


def _resultants(own: OwnSubdomains) -> Vector:
    """Return Rᵀf (3S,) of all subdomains."""
    loaded = np.flatnonzero(own.f)
    mine = own.resultants(loaded, own.f[loaded])
    found = np.zeros(own.coarse)
    for number, part in own.ranks.comm.allgather((mine.indices, mine.data)):
        np.add.at(found, number, part)
    return found
