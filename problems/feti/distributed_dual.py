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
    EMITTED,
    DistributedColumns,
    DistributedVector,
    Emitted,
    Ranks,
    Share,
    distributed,
)
from mortarbench.problems.fem.mesh import Nodes
from mortarbench.problems.feti.distributed import (
    Halo,
    RankOperator,
    assign_owners,
    build_halo,
    condense_over_ranks,
    gather_on_rank_0,
)
from mortarbench.problems.feti.local_bodies import Results, answers
from mortarbench.problems.feti.operators import (
    DualOperator,
    block_bytes,
    explicit_classes,
    touched_components,
)
from mortarbench.problems.feti.subdomain_classes import Subdomains
from mortarbench.problems.feti.subdomains import (
    DecomposedProblem,
    LocalSubdomains,
    subdomains_of,
)


@dataclass(frozen=True, eq=False)
class LocalDual:
    """The rows of a dual that a rank owns; what is asked for, all ranks ask for."""

    subdomains: LocalSubdomains

    @cached_property
    def halo(self) -> Halo:
        """The rows, and what is exchanged of them."""
        rows = self.subdomains.rows
        owner = assign_owners(rows.number, rows.reach)
        return build_halo(self.subdomains.ranks, rows.number, rows.reach, owner)

    @cached_property
    def explicit(self) -> NDArray[np.bool_]:
        """Kinds whose blocks are formed."""
        return explicit_classes(self.subdomains.rows.B, self.subdomains.domains)

    @cached_property
    def q(self) -> Vector:
        """C − BK⁺f (o,) of own rows."""
        own = self.subdomains
        return np.asarray(
            own.rows.c[self.halo.owned]
            - self.halo.accumulate(own.rows.B @ own.domains.inverse(own.f))
        )

    @cached_property
    def G(self) -> csr_array:
        """RᵀBᵀ (r, o) of own rows."""
        return _coarse_rows(self.subdomains, self.halo.rows[self.halo.owned])

    @cached_property
    def b(self) -> Vector:
        """Rᵀf (r,)."""
        return _resultants(self.subdomains)

    def share(self) -> Share:
        """Put the operator together, without any factor."""
        rows, domains, ranks = (
            self.subdomains.rows,
            self.subdomains.domains,
            self.subdomains.ranks,
        )
        classes = tuple(kind.without_factor() for kind in domains.classes)
        anew = Subdomains(classes, domains.class_of)
        local = DualOperator(
            rows.B, anew, self.explicit, rows.equalities,
            partial(condense_over_ranks, ranks=ranks),
        )  # fmt: skip
        lower, upper = self.bounds(self.subdomains.problem.contact.bound)
        part = QP(
            P=RankOperator(local, self.halo), q=distributed(self.q, ranks),
            lb=lower, ub=upper, G=no_rows(self.q.size), h=np.zeros(0),
            A=DistributedColumns(self.G, ranks), b=self.b,
        )  # fmt: skip
        return Share(part, gather_on_rank_0(self.halo, rows.total))

    def bounds(self, bound: Vector) -> tuple[DistributedVector, DistributedVector]:
        """Bound the multipliers of own rows (o,), those of friction by (k,)."""
        ranks, E = self.subdomains.ranks, self.subdomains.rows.equalities
        scale = self.subdomains.problem.contact_scale
        pressing = scale.size - bound.size
        bound = bound / scale[pressing:]
        below = np.concatenate([np.zeros(pressing), -bound])
        above = np.concatenate([np.full(pressing, np.inf), bound])
        number = self.halo.rows[self.halo.owned]
        touching = number >= E
        lower, upper = (np.full(number.size, x) for x in (-np.inf, np.inf))
        lower[touching] = below[number[touching] - E]
        upper[touching] = above[number[touching] - E]
        return distributed(lower, ranks), distributed(upper, ranks)

    def with_bound(self, bound: Vector) -> LocalDual:
        """Return the same with another bound (k,) of friction."""
        found = LocalDual(self.subdomains.with_bound(bound))
        vars(found).update({**vars(self), "subdomains": found.subdomains})
        return found


def dual_on(problem: DecomposedProblem, ranks: Ranks) -> LocalDual:
    """Give subdomains to ranks, for the rows of a dual; called by all of them.

    Raises
    ------
    InputError
        Where there are fewer subdomains than ranks, or ranks know different ones.

    """
    return LocalDual(LocalSubdomains(problem, ranks, _agreed(problem, ranks)))


def distributed_qp(
    dual: LocalDual,
    results: Results | None,
    first: LocalDual | None = None,
    others: int = 0,
) -> Emitted:
    """Describe this rank's share of the dual; called by all ranks.

    The digest of a problem that others come before is that of the first of these, with
    their number: what was solved differs by rounding where ranks are more or less.

    Parameters
    ----------
    results : what an answer means physically; None where only the whole tells
    first, others : the first problem that came before, and how many did

    """
    own = dual.subdomains
    for part in ("explicit", "q", "G", "b"):
        getattr(dual, part)  # made here, so that no solver pays for it in `prepare`

    def digest() -> str:
        names = others * [_digest(first.subdomains)] if first else [_digest(own)]
        return EMITTED + hex_digest(map(str.encode, names), 16)

    limits = dual.bounds(own.problem.contact.bound)
    return Emitted(
        variables=own.rows.total, equality_rows=own.coarse,
        bounds=sum(int(np.count_nonzero(np.isfinite(v))) for v in limits),
        share=dual.share, digest=digest,
        answer=answers(
            own, dual.halo, _torn(own, dual.explicit), results
        ),
    )  # fmt: skip


def _torn(own: LocalSubdomains, explicit: NDArray[np.bool_]) -> dict[str, Any]:
    """Report how bodies are torn, as `decomposition_quantities`.

    explicit_mib: what blocks take on all ranks together; one of a kind that several
    ranks have is on each of these.
    """
    domains, rows, ranks = own.domains, own.rows, own.ranks
    sizes = np.array([part.size for part in touched_components(rows.B, domains)])
    taken = block_bytes(sizes, domains)[explicit].sum() / 2**20
    counts = [own.f.size, explicit[domains.class_of].sum(), taken]
    torn_dofs, formed, mib = ranks.total(np.array(counts, dtype=float)).tolist()
    classes = ranks.comm.allgather({kind.name for kind in domains.classes})
    return {
        "subdomains": own.rank.size, "kinds": len(set().union(*classes)),
        "torn_dofs": int(torn_dofs), "multipliers": rows.total,
        "explicit_subdomains": int(formed), "explicit_mib": mib,
    }  # fmt: skip


def _digest(own: LocalSubdomains) -> str:
    """Name the numbers of the QP, whichever rank has which subdomain.

    That of each subdomain: its kind, its load, and its columns of B; and of all of them
    in turn, with what every rank has of the contact.
    """
    domains, rows, contact = own.domains, own.rows, own.problem.contact
    names = [kind.name.encode() for kind in domains.classes]
    B = csc_array(rows.B)
    B.sort_indices()
    told = []
    for s, (begin, end) in enumerate(pairwise(domains.start)):
        ends = B.indptr[begin : end + 1]
        entries = slice(ends[0], ends[-1])
        parts = rows.number[B.indices[entries]], B.data[entries], ends - ends[0]
        numbers = (*map(np.ndarray.tobytes, parts), own.f[begin:end].tobytes())
        name = hex_digest((names[domains.class_of[s]], *numbers))
        told.append((int(own.number[s]), name))
    of_all = sorted(chain.from_iterable(own.ranks.comm.allgather(told)))
    shared = contact.rows.data, contact.c, contact.bound
    content = (*(name.encode() for _, name in of_all), *(v.tobytes() for v in shared))
    return hex_digest(content, 64)


def _agreed(problem: DecomposedProblem, ranks: Ranks) -> NDArray[np.int64]:
    """Give subdomains to ranks (S,), if all ranks know the same subdomains.

    Partitions of graphs are made on every rank, by whatever library it has.

    Raises
    ------
    InputError
        Where they know others, or there are fewer subdomains than ranks.

    """
    found = subdomains_of(problem, ranks.size)
    known = hex_digest(
        x.tobytes() for x in (found, *problem.layout.shared_node_counts())
    )
    if len(set(ranks.comm.allgather(known))) > 1:
        raise InputError(
            "ranks have cut the bodies into different subdomains; expected the same "
            "version of METIS on all nodes"
        )
    return found


def _coarse_rows(own: LocalSubdomains, mine: Nodes) -> csr_array:
    """Return the columns of RᵀBᵀ that belong to own rows, (3S, o)."""
    ranks, rows = own.ranks, own.rows
    B, t = rows.B, rows.number.size
    unknown, place = np.unique(B.indices, return_inverse=True)
    R = own.resultants(unknown, np.ones(unknown.size))
    touched = csr_array((B.data, place, B.indptr), shape=(t, unknown.size))
    part = csr_array(touched @ R)
    owner = assign_owners(rows.number, rows.reach)
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


def _resultants(own: LocalSubdomains) -> Vector:
    """Return Rᵀf (3S,) of all subdomains."""
    loaded = np.flatnonzero(own.f)
    mine = own.resultants(loaded, own.f[loaded])
    found = np.zeros(own.coarse)
    for number, part in own.ranks.comm.allgather((mine.indices, mine.data)):
        np.add.at(found, number, part)
    return found
