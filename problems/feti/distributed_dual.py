"""Distributed assembly of the dual of decomposed bodies.

Each rank assembles the rows that it owns from its local subdomains
(`problems.feti.subdomains`). Contact rows are linearised from the contact sides alone.

The ranks exchange

* the points of one subdomain of each class that may occur on several ranks, so that
  all ranks use the same frame for congruent subdomains,
* contributions to the entries of q, and to the columns of the equality matrix RᵀBᵀ,
  that belong to rows of B owned by other ranks,
* contributions to the right-hand side Rᵀf of the equalities.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, partial
from itertools import chain, pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array, csc_array, csr_array

from mortarbench.harness import QP, Box, InputError, Vector, no_rows
from mortarbench.harness.digest import hex_digest
from mortarbench.harness.distributed.discs import DistributedDiscs
from mortarbench.harness.distributed.vectors import (
    DISTRIBUTED_DIGEST,
    DistributedColumns,
    DistributedQP,
    Ranks,
    Share,
    distributed,
)
from mortarbench.harness.mechanics import friction_discs
from mortarbench.problems.fem.mesh import Nodes
from mortarbench.problems.feti.distributed import (
    Halo,
    RankOperator,
    assign_owners,
    build_halo,
    condense_over_ranks,
    gather_on_rank_0,
)
from mortarbench.problems.feti.local_bodies import Results, evaluation
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
    """Dual QP on the rows owned by one rank.

    Most members communicate; all ranks must evaluate each member together.
    """

    subdomains: LocalSubdomains

    @cached_property
    def halo(self) -> Halo:
        """Owned rows and ghost rows of this rank."""
        rows = self.subdomains.rows
        owner = assign_owners(rows.group, rows.reach)
        return build_halo(self.subdomains.ranks, rows.number, rows.reach, owner)

    @cached_property
    def explicit(self) -> NDArray[np.bool_]:
        """Mask (classes,) of the local subdomain classes with explicit blocks."""
        return explicit_classes(self.subdomains.rows.B, self.subdomains.domains)

    @cached_property
    def q(self) -> Vector:
        """Linear term −d = c − BK⁺f of the dual at the owned rows, (o,)."""
        local = self.subdomains
        return np.asarray(
            local.rows.c[self.halo.owned]
            - self.halo.accumulate(local.rows.B @ local.domains.inverse(local.f))
        )

    @cached_property
    def G(self) -> csr_array:
        """Columns of the equality matrix RᵀBᵀ for the owned rows of B, (r, o)."""
        return _coarse_rows(self.subdomains, self.halo.rows[self.halo.owned])

    @cached_property
    def b(self) -> Vector:
        """Right-hand side Rᵀf of the equalities, (r,), equal on every rank."""
        return _resultants(self.subdomains)

    def share(self) -> Share:
        """Return the dual QP on this rank; matrices are factorised on first use."""
        rows, domains, ranks = (
            self.subdomains.rows,
            self.subdomains.domains,
            self.subdomains.ranks,
        )
        classes = tuple(kind.without_factor() for kind in domains.classes)
        unfactored = Subdomains(classes, domains.class_of)
        local = DualOperator(
            rows.B,
            unfactored,
            self.explicit,
            rows.equalities,
            partial(condense_over_ranks, ranks=ranks),
            self.subdomains.problem.redundant,
        )
        qp = QP(
            P=RankOperator(local, self.halo),
            q=distributed(self.q, ranks),
            sets=self.sets(self.subdomains.problem.contact.bound),
            G=DistributedColumns(no_rows(self.q.size), ranks),
            h=np.zeros(0),
            A=DistributedColumns(self.G, ranks),
            b=self.b,
        )
        return Share(qp, gather_on_rank_0(self.halo, rows.total))

    def sets(self, bound: Vector) -> tuple[Box, DistributedDiscs]:
        """Return the sets of the multipliers of owned rows: λ_n ≥ 0, ‖λ_t‖ ≤ g/scale.

        bound : (k,) friction bounds g for the unscaled rows
        """
        ranks, E = self.subdomains.ranks, self.subdomains.rows.equalities
        contact = self.subdomains.problem.contact
        scale = self.subdomains.problem.contact_scale
        normal = scale.size - bound.size
        owned = self.halo.rows[self.halo.owned]
        lower, upper = (np.full(owned.size, x) for x in (-np.inf, np.inf))
        lower[(owned >= E) & (owned < E + normal)] = 0.0
        discs = friction_discs(bound / scale[normal:], contact.tangents, E + normal)
        return (
            Box(distributed(lower, ranks), distributed(upper, ranks)),
            DistributedDiscs.of(discs, owned, ranks),
        )

    def with_bound(self, bound: Vector) -> LocalDual:
        """Return a copy with friction bounds `bound` (k,); cached results are kept."""
        copy = LocalDual(self.subdomains.with_bound(bound))
        vars(copy).update({**vars(self), "subdomains": copy.subdomains})
        return copy


def dual_on(problem: DecomposedProblem, ranks: Ranks) -> LocalDual:
    """Distribute the subdomains of a problem; all ranks must call this together.

    Raises
    ------
    InputError
        If there are fewer subdomains than ranks, or if the ranks computed
        different subdivisions.

    """
    return LocalDual(
        LocalSubdomains(problem, ranks, _replicated_partition(problem, ranks))
    )


def distributed_qp(
    dual: LocalDual,
    results: Results | None,
    first: LocalDual | None = None,
    others: int = 0,
) -> DistributedQP:
    """Return the distributed dual QP; all ranks must call this function together.

    If the QP depends on solutions of previous problems, the rounding errors in the data
    of the QP depend on the number of ranks. In this case, the digest of the QP is
    computed from the first previous problem and the number of previous problems, so
    that the digest is independent of the number of ranks.

    Parameters
    ----------
    results : function that evaluates physical results; None if they require the
        undivided bodies
    first : first of the previous problems; None if there are no previous problems
    others : number of previous problems

    """
    local = dual.subdomains
    for part in ("explicit", "q", "G", "b"):
        # evaluate the data now, so that their time does not count towards `prepare`
        getattr(dual, part)

    def digest() -> str:
        names = others * [_digest(first.subdomains)] if first else [_digest(local)]
        return DISTRIBUTED_DIGEST + hex_digest(map(str.encode, names), 16)

    contact = local.problem.contact
    in_discs = contact.bound.size if contact.tangents > 1 else 0
    between = contact.bound.size - in_discs
    return DistributedQP(
        variables=local.rows.total,
        equality_rows=local.coarse_size,
        bounds=contact.rows.shape[0] - contact.bound.size + 2 * between,
        discs=in_discs // contact.tangents,
        share=dual.share,
        digest=digest,
        answer=evaluation(
            local, dual.halo, _decomposition(local, dual.explicit), results
        ),
    )


def _decomposition(
    local: LocalSubdomains, explicit: NDArray[np.bool_]
) -> dict[str, Any]:
    """Return the quantities of the decomposition for all ranks together.

    The keys are those of `problems.duality.feti_dual.decomposition_quantities`.
    `explicit_mib` is the sum over ranks: each rank on which a class occurs stores the
    blocks of this class.
    """
    domains, rows, ranks = local.domains, local.rows, local.ranks
    sizes = np.array([part.size for part in touched_components(rows.B, domains)])
    taken = block_bytes(sizes, domains)[explicit].sum() / 2**20
    counts = [local.f.size, explicit[domains.class_of].sum(), taken]
    dofs, formed, mib = ranks.total(np.array(counts, dtype=float)).tolist()
    classes = ranks.comm.allgather({kind.name for kind in domains.classes})
    return {
        "subdomains": local.rank.size,
        "kinds": len(set().union(*classes)),
        "torn_dofs": int(dofs),
        "multipliers": rows.total,
        "coarse_unknowns": local.coarse_size,
        "explicit_subdomains": int(formed),
        "explicit_mib": mib,
    }


def _digest(local: LocalSubdomains) -> str:
    """Return a digest of the QP that does not depend on the distribution over ranks.

    It is computed from the digests of the class, the load and the columns of B of each
    subdomain, in the order of the subdomains, and from the contact data,
    which are equal on all ranks.
    """
    domains, rows, contact = local.domains, local.rows, local.problem.contact
    names = [kind.name.encode() for kind in domains.classes]
    B = csc_array(rows.B)
    B.sort_indices()
    digests = []
    for s, (begin, end) in enumerate(pairwise(domains.start)):
        ends = B.indptr[begin : end + 1]
        entries = slice(ends[0], ends[-1])
        parts = rows.number[B.indices[entries]], B.data[entries], ends - ends[0]
        numbers = (*map(np.ndarray.tobytes, parts), local.f[begin:end].tobytes())
        name = hex_digest((names[domains.class_of[s]], *numbers))
        digests.append((int(local.number[s]), name))
    every = sorted(chain.from_iterable(local.ranks.comm.allgather(digests)))
    shared = [contact.rows.data, contact.c, contact.bound]
    content = (*(name.encode() for _, name in every), *(v.tobytes() for v in shared))
    return hex_digest(content, 64)


def _replicated_partition(
    problem: DecomposedProblem, ranks: Ranks
) -> NDArray[np.int64]:
    """Return the rank of each subdomain (S,); check that all ranks agree.

    Every rank partitions the graph with its own METIS library, and different versions
    may compute different partitions.

    Raises
    ------
    InputError
        If the subdomains or their ranks differ between ranks, or if there are fewer
        subdomains than ranks.

    """
    ranks_of = subdomains_of(problem, ranks.size)
    digest = hex_digest(
        x.tobytes() for x in (ranks_of, *problem.layout.shared_node_counts())
    )
    if len(set(ranks.comm.allgather(digest))) > 1:
        raise InputError(
            "the subdomains of the bodies differ between ranks; expected the same "
            "version of METIS on all computers"
        )
    return ranks_of


def _coarse_rows(local: LocalSubdomains, mine: Nodes) -> csr_array:
    """Return the columns (r, o) of RᵀBᵀ for the rows of B that this rank owns.

    mine : (o,) global numbers of these rows, ascending
    """
    ranks, rows = local.ranks, local.rows
    B, t = rows.B, rows.number.size
    unknown, place = np.unique(B.indices, return_inverse=True)
    R = local.resultants(unknown, np.ones(unknown.size))
    touched = csr_array((B.data, place, B.indptr), shape=(t, unknown.size))
    part = csr_array(touched @ R)
    owner = assign_owners(rows.group, rows.reach)
    messages: list[tuple[NDArray[Any], ...]] = [()] * ranks.size
    for one in set(range(ranks.size)) - {ranks.rank}:
        foreign = np.flatnonzero(owner == one)
        entries = coo_array(part[foreign])
        messages[one] = rows.number[foreign][entries.row], entries.col, entries.data
    G = csr_array(part[np.flatnonzero(owner == ranks.rank)])
    for row, column, data in filter(None, ranks.comm.alltoall(messages)):
        places = np.searchsorted(mine, row), column
        G += csr_array((data, places), shape=G.shape)
    return csr_array(G.T)


def _resultants(local: LocalSubdomains) -> Vector:
    """Return Rᵀf (r,) of all subdomains; the result is equal on every rank."""
    loaded = np.flatnonzero(local.f)
    resultants = local.resultants(loaded, local.f[loaded])
    total = np.zeros(local.coarse_size)
    for number, part in local.ranks.comm.allgather(
        (resultants.indices, resultants.data)
    ):
        np.add.at(total, number, part)
    return total
