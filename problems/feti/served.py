"""Objects of torn bodies that exist on every rank, and their use from rank 0."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache, cached_property, partial

import numpy as np

from mortarbench.harness import Vector
from mortarbench.harness.distributed.comm import Lead
from mortarbench.harness.operators import SerialisableOperator
from mortarbench.problems.feti.operator_arrays import dual_operator
from mortarbench.problems.feti.operators import (
    DualOperator,
    OperatorOnRanks,
    explicit_classes,
)
from mortarbench.problems.feti.subdomain_classes import Subdomains
from mortarbench.problems.feti.subdomains import TornBodies
from mortarbench.problems.feti.substructures import (
    LocalProblems,
    LocalProblemsOnRanks,
)


@dataclass(eq=False)
class Served:
    """Objects of torn bodies whose methods rank 0 calls on all ranks.

    Methods and attributes must be called by all ranks together, and their results are
    valid on rank 0. Rank 0 calls them by `lead`.
    """

    torn: TornBodies
    #: map from a displacement (n,) to the largest stress of each body on this rank
    stresses: Callable[[Vector], Vector] | None = None

    def __post_init__(self) -> None:
        """Let the ranks agree on their subdomains, and compute the rows of B."""
        _ = self.torn.rows
        self.lead = Lead(self.torn.comm, self)

    @property
    def domains(self) -> Subdomains:
        """The subdomains without eliminated components."""
        return self.torn.domains

    @cached_property
    def operator(self) -> DualOperator:
        """The dual operator F; it computes its own factors."""
        domains, rows = self.torn.domains, self.torn.rows
        unfactored = cache(lambda k: replace(domains.template(k)))
        return DualOperator(
            rows.B,
            replace(domains, template=unfactored),
            explicit_classes(rows.B, domains),
            rows.equalities,
            self.torn.problem.redundant,
        )

    @cached_property
    def parts(self) -> LocalProblems:
        """The local problems for certificates; supports are rows of B."""
        return LocalProblems(self.torn.floating)

    def weights(self) -> Vector:
        """Return the weights of the local problems, (N,)."""
        return self.parts.weight

    def forget(self) -> None:
        """Discard the factors of the dual operator."""
        vars(self).pop("operator", None)

    def largest_stresses(self, u: Vector) -> Vector:
        """Return the largest stress of each body, (bodies,)."""
        assert self.stresses is not None
        comm, stresses = self.torn.comm, partial(self.stresses, u)
        found = comm.gather(comm.together(stresses))
        return np.max(found, axis=0) if found else np.zeros(0)


def operator_of(served: Served) -> SerialisableOperator | OperatorOnRanks:
    """Return the dual operator on rank 0; on one process, it can be stored in files."""
    if served.torn.comm.size == 1:
        return dual_operator(served.operator)
    return OperatorOnRanks(served)


def parts_of(served: Served) -> LocalProblems | LocalProblemsOnRanks:
    """Return the local problems on rank 0."""
    if served.torn.comm.size == 1:
        return served.parts
    return LocalProblemsOnRanks(served)
