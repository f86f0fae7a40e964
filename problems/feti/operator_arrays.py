"""Serialisation of the dual operator of Total FETI as plain arrays."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.sparse import block_diag, csc_array, csr_array

from mortarbench.harness import QP
from mortarbench.harness.distributed.vectors import Ranks, Share
from mortarbench.harness.operators import Arrays, SerialisableOperator
from mortarbench.problems.feti.distributed import local_share
from mortarbench.problems.feti.operators import DualOperator, explicit_classes
from mortarbench.problems.feti.subdomain_classes import (
    SubdomainClass,
    Subdomains,
)

NAME = "tfeti"  #: name in `problems.OPERATORS`, stored in files
_PARTS = ("data", "indices", "indptr")
_BY_CLASS = ("stiffness", "fixing", "boundary")  #: arrays with class-dependent lengths


@dataclass(frozen=True, eq=False)
class StoredOperator(DualOperator):
    """Operator F restored from its arrays; it can be distributed over ranks."""

    @property
    def parts(self) -> int:
        """Number of subdomains."""
        return int(self.domains.class_of.size)

    def share(self, qp: QP, ranks: Ranks) -> Share:
        """Return the part of a dual QP with this F that this rank stores."""
        return local_share(qp, self, ranks)


def dual_operator(
    B: csr_array,
    domains: Subdomains,
    equalities: int,
    redundant: bool = False,
) -> SerialisableOperator:
    """Return F = BK⁺Bᵀ as a serialisable operator; each class is stored once.

    Parameters
    ----------
    equalities : number of equality rows of B, which come first
    redundant : True if the equality rows may be linearly dependent

    """
    classes = domains.classes
    K = csc_array(block_diag([template.K for template in classes], format="csc"))
    modes = np.array([template.R.shape[1] for template in classes])
    R = [
        np.pad(template.R, ((0, 0), (0, modes.max() - template.R.shape[1])))
        for template in classes
    ]
    arrays = {
        **{f"K_{part}": getattr(K, part) for part in _PARTS},
        **{f"B_{part}": getattr(B, part) for part in _PARTS},
        "R": np.concatenate(R),
        "modes": modes,
        "stiffness": np.concatenate([template.stiffness for template in classes]),
        "fixing": np.concatenate([template.fixing for template in classes]),
        "boundary": np.concatenate([template.boundary for template in classes]),
        "kind": domains.class_of,
        "explicit": explicit_classes(B, domains),
        "equalities": np.array(equalities),
    }
    for name in _BY_CLASS:
        arrays[f"{name}_ends"] = np.cumsum([len(getattr(k, name)) for k in classes])
    if redundant:
        arrays["redundant"] = np.array(True)
    return SerialisableOperator(
        B.shape[0], NAME, arrays, {NAME: dual_operator_from_arrays}
    )


def dual_operator_from_arrays(arrays: Arrays) -> StoredOperator:
    """Restore F from the arrays of `dual_operator`."""
    ends = [np.append(0, arrays[f"{name}_ends"]) for name in _BY_CLASS]
    data, indices, indptr = (arrays[f"K_{part}"] for part in _PARTS)

    def subdomain_class(k: int) -> SubdomainClass:
        rows, fixing, boundary = (slice(end[k], end[k + 1]) for end in ends)
        columns, n = indptr[rows.start : rows.stop + 1], rows.stop - rows.start
        within = slice(columns[0], columns[-1])
        K = (data[within], indices[within] - rows.start, columns - columns[0])
        return SubdomainClass(
            K=csc_array(K, shape=(n, n)),
            R=arrays["R"][rows, : arrays["modes"][k]],
            fixing=arrays["fixing"][fixing],
            boundary=arrays["boundary"][boundary],
            stiffness=arrays["stiffness"][rows],
        )

    domains = Subdomains(
        tuple(map(subdomain_class, range(ends[0].size - 1))), arrays["kind"]
    )
    shape = arrays["B_indptr"].size - 1, domains.start[-1]
    B = csr_array(tuple(arrays[f"B_{part}"] for part in _PARTS), shape=shape)
    return StoredOperator(
        B,
        domains,
        arrays["explicit"],
        int(arrays["equalities"]),
        redundant="redundant" in arrays,
    )
