"""Objects of torn bodies that exist on every rank, and their use from rank 0."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache, cached_property, partial
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
from scipy.sparse.linalg import LinearOperator

from mortarbench.harness import Case, CaseOnRanks, ReferenceOfOperator, Vector
from mortarbench.harness.distributed.comm import Comm, Lead
from mortarbench.harness.mechanics import Substructures
from mortarbench.harness.operators import Product, SerialisableOperator
from mortarbench.problems.feti.operator_arrays import dual_operator
from mortarbench.problems.feti.operators import DualOperator, explicit_classes
from mortarbench.problems.feti.subdomain_classes import Dense, Subdomains
from mortarbench.problems.feti.subdomains import DecomposedProblem, TornBodies
from mortarbench.problems.feti.substructures import LocalProblems


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
        """The subdomains."""
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
        return LocalProblems(self.torn)

    @cached_property
    def local_problems(self) -> Substructures:
        """The local problems on rank 0; on several ranks, methods call all ranks."""
        if self.torn.comm.size == 1:
            return self.parts
        methods = ("diagonal", "product", "squared_product", "solve")
        on_ranks: Any = SimpleNamespace(
            spread=self.parts.spread,
            kernel=self.lead("parts.torn.domains.kernel"),
            weight=self.lead("weights"),
            **{name: partial(self.lead, f"parts.{name}") for name in methods},
        )
        return cast(Substructures, on_ranks)

    def weights(self) -> Vector:
        """Return the weights of the local problems, (N,)."""
        return self.parts.weight

    def largest_stresses(self, u: Vector) -> Vector:
        """Return the largest stress of each body, (bodies,), Pa.

        u : (n,) nondimensional displacement
        """
        assert self.stresses is not None
        comm = self.torn.comm
        largest = comm.gather(comm.together(partial(self.stresses, u)))
        return np.max(largest, axis=0) if largest else np.zeros(0)

    def forget(self) -> None:
        """Discard the factors of the dual operator."""
        vars(self).pop("operator", None)


def case_of_torn(
    problem: DecomposedProblem,
    case: Callable[[Served], Case],
    comm: Comm,
    _: ReferenceOfOperator,
) -> CaseOnRanks:
    """Return a case that needs no previous solutions; all ranks call this together.

    case : returns the case on rank 0
    """
    served = Served(TornBodies(problem, comm))
    return CaseOnRanks(served, partial(case, served))


def operator_of(served: Served) -> SerialisableOperator | OperatorOnRanks:
    """Return the dual operator on rank 0; on one process, it can be stored in files."""
    if served.torn.comm.size == 1:
        return dual_operator(served.operator)
    return OperatorOnRanks(served)


class OperatorOnRanks(LinearOperator):  # type: ignore[misc]  # scipy has no types
    """The operator F on rank 0; each product is a call of all ranks.

    served : objects on rank 0
    """

    def __init__(self, served: Served) -> None:
        m = served.operator.B.shape[0]
        super().__init__(np.dtype(float), (m, m))
        self._served = served
        self.semidefinite = served.operator.semidefinite

    def build(self) -> OperatorOnRanks:
        """Factorise the subdomains on all ranks."""
        self._served.lead("operator.prepare")
        return self

    def forget(self) -> None:
        """Discard all factors; the next product computes them again."""
        self._served.lead("forget")

    def diagonal(self) -> Vector:
        """Return the diagonal of F, (m,)."""
        return np.asarray(self._served.lead("operator.diagonal"))

    def preconditioner(self, kind: str, scaling: str) -> Product:
        """Return x ↦ B_D diag(D) B_Dᵀx; see `DualOperator.preconditioner`."""
        outer, _ = self._served.lead("operator.preconditioner_parts", kind, scaling)
        inner = partial(self._served.lead, "operator.precondition", kind, scaling)
        return lambda x: outer(inner(outer(x)))

    def _matvec(self, x: Vector) -> Vector:
        return np.asarray(self._served.lead("operator", x))

    def _matmat(self, X: Dense) -> Dense:
        return np.asarray(self._served.lead("operator", X))

    def _adjoint(self) -> OperatorOnRanks:
        return self
