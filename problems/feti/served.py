"""The dual operator and the local problems of torn bodies, on one or several ranks."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, partial
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array
from scipy.sparse.linalg import LinearOperator

from mortarbench.harness import Vector
from mortarbench.harness.distributed.comm import Placed
from mortarbench.harness.operators import Product, SerialisableOperator
from mortarbench.problems.fem.mesh import Nodes
from mortarbench.problems.feti.operator_arrays import dual_operator
from mortarbench.problems.feti.operators import (
    DualOperator,
    explicit_classes,
    gram_inverses,
    touched_components,
)
from mortarbench.problems.feti.subdomain_classes import Dense, Subdomains
from mortarbench.problems.feti.subdomains import TornBodies
from mortarbench.problems.feti.substructures import LocalProblems


@dataclass(eq=False)
class Served:
    """Operators of torn bodies; on several ranks, on rank 0."""

    torn: TornBodies

    @property
    def domains(self) -> Subdomains:
        """The subdomains of all ranks."""
        return self.torn.domains

    @cached_property
    def explicit(self) -> NDArray[np.bool_]:
        """Mask (classes,) of the classes with explicit blocks."""
        return explicit_classes(self.torn.rows.B, self.domains)

    @cached_property
    def operator(self) -> DualOperator:
        """The dual operator F on one process; it computes its own factors."""
        (B, _, equalities), redundant = self.torn.rows, self.torn.problem.redundant
        return DualOperator(B, self.domains, self.explicit, equalities, redundant)

    @cached_property
    def local_problems(self) -> LocalProblems:
        """The local problems for certificates; supports are rows of B."""
        return LocalProblems(self.torn)


def operator_of(served: Served) -> SerialisableOperator | OperatorOnRanks:
    """Return the dual operator; on one process, it can be stored in files."""
    if served.torn.team.comm.size == 1:
        return dual_operator(served.operator)
    return OperatorOnRanks(served)


class LocalRows(NamedTuple):
    """Data of the dual operator on one rank, see `DualOperator`."""

    B: csr_array  #: (m, N_r) columns of the unknowns of this rank
    explicit: NDArray[np.bool_]
    equalities: int
    semidefinite: bool
    touched: list[Nodes]


def local_operator(rows: LocalRows, domains: Subdomains) -> DualOperator:
    """Return the dual operator of the subdomains of one rank."""
    return DualOperator(rows.B, domains, *rows[1:])


class OperatorOnRanks(LinearOperator):  # type: ignore[misc]  # scipy has no types
    """The operator F on rank 0; each product is a call of all ranks.

    served : objects on rank 0
    """

    def __init__(self, served: Served) -> None:
        torn = served.torn
        B, _, self._equalities = torn.rows
        super().__init__(np.dtype(float), (B.shape[0],) * 2)
        self.semidefinite = torn.problem.redundant
        same = (
            served.explicit,
            self._equalities,
            self.semidefinite,
            touched_components(B, torn.domains),
        )
        ends = zip(torn.ends[:-1], torn.ends[1:], strict=True)
        rows = [LocalRows(csr_array(B[:, a:b]), *same) for a, b in ends]
        self._preconditioners: dict[tuple[str, str], Product] = {}
        self._parts: Placed = torn.team.place(local_operator, rows, torn.parts)

    def build(self) -> OperatorOnRanks:
        """Factorise the subdomains on all ranks."""
        self._parts("prepare")
        return self

    def forget(self) -> None:
        """Discard all factors; the next product computes them again."""
        self._preconditioners.clear()
        self._parts("forget")

    def diagonal(self) -> Vector:
        """Return the diagonal of F, (m,)."""
        return self._parts.total("diagonal")

    def preconditioner(self, kind: str, scaling: str) -> Product:
        """Return x ↦ B_D diag(D) B_Dᵀx; see `DualOperator.preconditioner`."""
        name = kind, scaling
        if name not in self._preconditioners:
            first, *others = self._parts("gram", *name)
            inverse, outer = gram_inverses(sum(others, start=first), self._equalities)
            self._parts("weigh", *name, inverse)
            inner = partial(self._parts.total, "weighted", *name)
            self._preconditioners[name] = lambda x: outer(inner(outer(x)))
        return self._preconditioners[name]

    def _matvec(self, x: Vector) -> Vector:
        return self._parts.total("__call__", x)

    def _matmat(self, X: Dense) -> Dense:
        return self._parts.total("__call__", X)

    def _adjoint(self) -> OperatorOnRanks:
        return self
