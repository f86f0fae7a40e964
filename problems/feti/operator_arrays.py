"""Serialisation of the dual operator of Total FETI as plain arrays."""

from __future__ import annotations

import numpy as np
from scipy.sparse import block_diag, csc_array, csr_array

from mortarbench.harness.operators import Arrays, SerialisableOperator
from mortarbench.problems.feti.operators import DualOperator
from mortarbench.problems.feti.subdomain_classes import SubdomainClass, Subdomains

NAME = "tfeti"  #: name in `problems.OPERATORS`, stored in files
_PARTS = ("data", "indices", "indptr")
_BY_CLASS = ("stiffness", "fixing", "boundary")  #: arrays with class-dependent lengths


def dual_operator(F: DualOperator) -> SerialisableOperator:
    """Return F = BK⁺Bᵀ as a serialisable operator; each class is stored once."""
    domains = F.domains
    classes = [domains.template(k) for k in range(domains.sizes.size)]
    K = csc_array(block_diag([template.K for template in classes], format="csc"))
    arrays = {
        **{f"K_{part}": getattr(K, part) for part in _PARTS},
        **{f"B_{part}": getattr(F.B, part) for part in _PARTS},
        "R": np.concatenate([template.R for template in classes]),
        "kind": domains.class_of,
        "explicit": F.explicit,
        "equalities": np.array(F.equalities),
    }
    for name in _BY_CLASS:
        values = [getattr(template, name) for template in classes]
        arrays[name] = np.concatenate(values)
        arrays[f"{name}_ends"] = np.cumsum([len(v) for v in values])
    if F.semidefinite:
        arrays["redundant"] = np.array(True)
    return SerialisableOperator(
        F.B.shape[0], NAME, arrays, {NAME: dual_operator_from_arrays}
    )


def dual_operator_from_arrays(arrays: Arrays) -> DualOperator:
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
            R=arrays["R"][rows],
            fixing=arrays["fixing"][fixing],
            boundary=arrays["boundary"][boundary],
            stiffness=arrays["stiffness"][rows],
        )

    sizes = np.diff(ends[0])
    classes = [subdomain_class(k) for k in range(sizes.size)]
    domains = Subdomains(
        template=classes.__getitem__,
        sizes=sizes,
        class_of=arrays["kind"],
    )
    shape = arrays["B_indptr"].size - 1, domains.start[-1]
    B = csr_array(tuple(arrays[f"B_{part}"] for part in _PARTS), shape=shape)
    equalities = int(arrays["equalities"])
    return DualOperator(
        B, domains, arrays["explicit"], equalities, "redundant" in arrays
    )
