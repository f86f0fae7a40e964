"""Rows that hold torn bodies together: supports, gluing, contact.

Supports are rows of every copy of a node. Copies of a component that is free are glued,
m copies by one of

* ``orthonormal``: m − 1 orthonormal rows that are orthogonal to (1, …, 1),
* ``chain``: m − 1 rows  v_p − v_q = 0  of copies that follow one another,
* ``redundant``: all m(m − 1)/2 rows  v_p − v_q = 0.

Contact rows act on the average of the copies, which is the same for all of them once
they are glued; so a contact row is there once, wherever subdomains meet, and orthogonal
to all gluing.

Rows of a body are scaled by √E of that body, contact rows by that of the softest body
they touch, after they are normalised: then F does not depend on E where each body is
homogeneous. A factor of E may follow the shape of cells (`problems.feti.structured`).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from itertools import combinations
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import null_space, qr
from scipy.sparse import bsr_array, csc_array, csr_array, diags_array, eye_array, vstack

from mortarbench.harness import Vector
from mortarbench.problems.fem.mesh import Nodes
from mortarbench.problems.feti.tearing import Decomposition
from mortarbench.problems.feti.torn import Kind, Subdomains, Torn

Weights = Callable[[int], NDArray[np.float64]]


def _orthonormal(m: int) -> NDArray[np.float64]:
    return np.asarray(np.linalg.qr(np.ones((m, 1)), mode="complete")[0][:, 1:].T)


def _chain(m: int) -> NDArray[np.float64]:
    return np.eye(m - 1, m) - np.eye(m - 1, m, 1)


def _redundant(m: int) -> NDArray[np.float64]:
    p, q = np.array(list(combinations(range(m), 2))).T
    return np.asarray(np.eye(m)[p] - np.eye(m)[q])


#: the weights (rows, m) of m copies of a component
GLUE: Mapping[str, Weights] = MappingProxyType(
    {"orthonormal": _orthonormal, "chain": _chain, "redundant": _redundant}
)


def glue(
    decomposition: Decomposition,
    kinds: tuple[Kind, ...],
    *,
    load: Vector,
    supports: csr_array,
    supported: Vector,
    contact: csr_array,
    c: Vector,
    E: Vector,
    shape: Vector | float = 1.0,
    rows: str = "orthonormal",
) -> Torn:
    """Pose a contact problem of the whole on the subdomains.

    Parameters
    ----------
    kinds : of the parts of the decomposition
    load : (n,) of the whole; shared equally by the copies of a node
    supports, supported : (k, n) one unit entry per prescribed component, and (k,) its
        value
    contact, c : (m_I, n) and (m_I,) of the whole, normals, then tangents
    E : (nodes,) stiffness of the body that each node belongs to, without dimension
    shape : factor of E in rows of supports and gluing, (n,) of the components or one
    rows : how copies are glued, one of GLUE

    """
    d = load.size // decomposition.nodes
    #: of the whole, of each torn component
    component = (d * decomposition.node[:, None] + np.arange(d)).ravel()
    copies = _unit_rows(component, load.size)
    turn = _rotation(decomposition, d)
    T = csr_array(turn.T @ copies)
    average = csr_array(T @ diags_array(1 / np.bincount(component)))  # T (TᵀT)⁻¹

    held = np.zeros(load.size, dtype=bool)
    held[supports.indices] = True
    glued = _gluing(component, np.flatnonzero(~held), GLUE[rows])
    reached = csr_array(supports @ copies.T)  # the copies of a support in its row
    on_supports = _unit_rows(reached.indices, component.size)
    B_E = csr_array(vstack([on_supports, glued]))
    of_row = component[B_E.indices[B_E.indptr[:-1]]]
    B_I = csr_array(contact @ average.T)
    norm = np.sqrt(B_I.multiply(B_I).sum(axis=1))
    E_of = np.repeat(E, d)
    softest = np.minimum.reduceat(E_of[contact.indices], contact.indptr[:-1])
    scale = np.sqrt(np.append((E_of * shape)[of_row], softest / norm**2))
    values = np.zeros(of_row.size)
    values[: reached.nnz] = np.repeat(supported, np.diff(reached.indptr))
    return Torn(
        kinds=kinds, kind=decomposition.kind, spread=T,
        B=csr_array(diags_array(scale) @ vstack([B_E @ turn, B_I])),
        c=scale * np.append(values, c), scale=scale, f=average @ load,
        equalities=of_row.size, label=decomposition.label,
    )  # fmt: skip


def _unit_rows(columns: Nodes, size: int) -> csr_array:
    """Return rows with one unit entry each, (k, size)."""
    k = columns.size
    return csr_array((np.ones(k), columns, np.arange(k + 1)), shape=(k, size))


def _gluing(component: Nodes, free: Nodes, weights: Weights) -> csr_array:
    """Return the rows that glue all copies of the free components.

    Parameters
    ----------
    component : (N,) of the whole, of each torn component
    free : components of the whole that are glued

    """
    order = np.argsort(component, kind="stable")
    times = np.bincount(component)
    first = np.cumsum(times) - times
    rows = [csr_array((0, component.size))]
    for m in np.unique(times[times > 1]):
        several = free[times[free] == m]
        members = order[first[several, None] + np.arange(m)]
        W = weights(int(m))
        shape = (several.size * len(W), component.size)
        ends = np.arange(shape[0] + 1) * m
        columns = np.repeat(members, len(W), axis=0).ravel()
        data = np.tile(W, (several.size, 1)).ravel()
        rows.append(csr_array((data, columns, ends), shape=shape))
    glued = csr_array(vstack(rows))
    glued.eliminate_zeros()
    return glued


def _rotation(decomposition: Decomposition, d: int) -> csr_array:
    """Return Q = diag(Q_1 … Q_S) (N, N): from axes of subdomains to those of the whole.

    d : components per node; a single one is a scalar, the same in all axes
    """
    M = decomposition.node.size
    if d == 1:
        return csr_array(eye_array(M))
    blocks = decomposition.rotation[decomposition.subdomain]
    Q = csr_array(
        bsr_array((blocks, np.arange(M), np.arange(M + 1)), shape=(M * d, M * d))
    )
    Q.eliminate_zeros()
    return Q


def without_supports(torn: Torn, held: Nodes) -> Torn:
    """Eliminate what supports hold, as FETI-1 does: such subdomains do not float.

    Parameters
    ----------
    torn : its supports hold components at zero, in the axes of the whole
    held : these components of the whole

    """
    N, E = torn.f.size, torn.equalities
    free = np.ones(N, dtype=bool)
    free[csr_array(torn.spread[:, held]).nonzero()[0]] = False
    kept = np.flatnonzero(free)
    B = csr_array(torn.B[:, kept])
    rows = np.flatnonzero((np.diff(B.indptr) > 0) | (np.arange(B.shape[0]) >= E))
    domains = without(torn.domains, free)
    return Torn(
        kinds=domains.kinds, kind=domains.kind, spread=csr_array(torn.spread[kept]),
        B=csr_array(B[rows]), c=torn.c[rows], scale=torn.scale[rows], f=torn.f[kept],
        equalities=int((rows < E).sum()),
    )  # fmt: skip


def without(domains: Subdomains, free: NDArray[np.bool_]) -> Subdomains:
    """Return subdomains without all but their free torn unknowns (N,)."""
    kinds, kind = list[Kind](), np.empty_like(domains.kind)
    known = dict[tuple[int, bytes], int]()
    for s, k in enumerate(domains.kind):
        mine = free[domains.start[s] : domains.start[s + 1]]
        found = known.setdefault((int(k), mine.tobytes()), len(kinds))
        if found == len(kinds):
            kinds.append(_held(domains.kinds[k], mine))
        kind[s] = found
    return Subdomains(tuple(kinds), kind)


def _held(kind: Kind, free: NDArray[np.bool_]) -> Kind:
    """Return a subdomain without all but its free components (n_k,)."""
    if free.all():
        return kind
    R = kind.R @ null_space(kind.R[~free])
    R = np.linalg.qr(R[free])[0]
    number = np.cumsum(free) - 1
    return Kind(
        K=csc_array(kind.K[free][:, free]), R=R,
        fixing=np.sort(qr(R.T, mode="r", pivoting=True)[1][: R.shape[1]]),
        boundary=number[kind.boundary[free[kind.boundary]]],
        stiffness=kind.stiffness[free],
    )  # fmt: skip
