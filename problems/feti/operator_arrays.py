"""The dual operator of Total FETI as plain arrays, for files and processes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.sparse import block_diag, csc_array, csr_array

from mortarbench.harness import QP
from mortarbench.harness.distributed.vectors import Ranks, Share
from mortarbench.harness.operators import Arrays, SerialisableOperator
from mortarbench.problems.feti.distributed import local_share
from mortarbench.problems.feti.operators import DualOperator, explicit_classes
from mortarbench.problems.feti.subdomain_classes import SubdomainClass, Subdomains

NAME = "tfeti"  #: of the maker, in `problems.OPERATORS`
_PARTS = ("data", "indices", "indptr")
_OF_KINDS = ("stiffness", "fixing", "boundary")  #: whose lengths differ by kind


@dataclass(frozen=True, eq=False)
class StoredOperator(DualOperator):
    """F put together from its arrays, which ranks can divide among themselves."""

    @property
    def parts(self) -> int:
        """Number of subdomains."""
        return int(self.domains.class_of.size)

    def share(self, qp: QP, ranks: Ranks) -> Share:
        """Take this rank's share of a dual with this F."""
        return local_share(qp, self, ranks)


def dual_operator(
    B: csr_array, domains: Subdomains, equalities: int
) -> SerialisableOperator:
    """Make F as an operator that can be written: every kind once, and B.

    equalities : rows of B that are equations, the first ones
    """
    classes = domains.classes
    K = csc_array(block_diag([kind.K for kind in classes], format="csc"))
    modes = np.array([kind.R.shape[1] for kind in classes])
    R = [
        np.pad(kind.R, ((0, 0), (0, modes.max() - kind.R.shape[1]))) for kind in classes
    ]
    arrays = {
        **{f"K_{part}": getattr(K, part) for part in _PARTS},
        **{f"B_{part}": getattr(B, part) for part in _PARTS},
        "R": np.concatenate(R),
        "modes": modes,
        "stiffness": np.concatenate([kind.stiffness for kind in classes]),
        "fixing": np.concatenate([kind.fixing for kind in classes]),
        "boundary": np.concatenate([kind.boundary for kind in classes]),
        "kind": domains.class_of,
        "explicit": explicit_classes(B, domains),
        "equalities": np.array(equalities),
    }
    for name in _OF_KINDS:
        arrays[f"{name}_ends"] = np.cumsum([len(getattr(k, name)) for k in classes])
    return SerialisableOperator(
        B.shape[0], NAME, arrays, {NAME: dual_operator_from_arrays}
    )


def dual_operator_from_arrays(arrays: Arrays) -> StoredOperator:
    """Put F together from the arrays of `dual_operator`."""
    ends = [np.append(0, arrays[f"{name}_ends"]) for name in _OF_KINDS]
    data, indices, indptr = (arrays[f"K_{part}"] for part in _PARTS)

    def kind(k: int) -> SubdomainClass:
        own, fixing, boundary = (slice(end[k], end[k + 1]) for end in ends)
        columns, n = indptr[own.start : own.stop + 1], own.stop - own.start
        within = slice(columns[0], columns[-1])
        K = (data[within], indices[within] - own.start, columns - columns[0])
        return SubdomainClass(
            K=csc_array(K, shape=(n, n)),
            R=arrays["R"][own, : arrays["modes"][k]],
            fixing=arrays["fixing"][fixing],
            boundary=arrays["boundary"][boundary],
            stiffness=arrays["stiffness"][own],
        )

    domains = Subdomains(tuple(map(kind, range(ends[0].size - 1))), arrays["kind"])
    shape = arrays["B_indptr"].size - 1, domains.start[-1]
    B = csr_array(tuple(arrays[f"B_{part}"] for part in _PARTS), shape=shape)
    return StoredOperator(B, domains, arrays["explicit"], int(arrays["equalities"]))
