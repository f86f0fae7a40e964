"""Decomposition of an undivided mesh and its gluing rows, by sparse matrix products.

Tests compare this independent derivation with the package. The rows equal those of
`mortarbench.problems.feti.subdomains`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import bsr_array, csr_array, diags_array, eye_array, vstack

from mortarbench.harness import Vector
from mortarbench.problems.fem.mesh import Nodes
from mortarbench.problems.feti.subdomains import GLUE, Weights
from mortarbench.problems.feti.tearing import SubdomainMesh, blocks, classify


@dataclass(frozen=True, eq=False, kw_only=True)
class Decomposition:
    """A mesh whose S subdomains have separate nodes, M in total.

    Every torn node is a copy of a node of the undivided mesh. Torn nodes are numbered
    subdomain by subdomain, and within a subdomain in the order of the original nodes.
    """

    node: Nodes  #: (M,) node of the undivided mesh of which each torn node is a copy
    nodes: int  #: number of nodes of the undivided mesh
    start: NDArray[np.int64]  #: (S + 1,) first torn node of each subdomain, and M
    parts: tuple[SubdomainMesh, ...]  #: first subdomain of each class
    class_of: NDArray[np.int64]  #: (S,) class of each subdomain, an index into `parts`
    #: (S, dim, dim) rotations Q of the first subdomain of a class into each subdomain:
    #: x = Q x_part + t
    rotation: NDArray[np.float64]
    label: NDArray[np.int64]  #: (E,) subdomain of each cell of the undivided mesh

    @property
    def subdomain(self) -> NDArray[np.int64]:
        """Subdomain of each torn node, (M,)."""
        return np.repeat(np.arange(self.class_of.size), np.diff(self.start))


def structured_bodies(
    divisions: Sequence[tuple[int, ...]], most: int
) -> NDArray[np.int64]:
    """Label the cells of structured meshes with the subdomains that `blocks` yields.

    Parameters
    ----------
    divisions : numbers of cells of each body, as for `blocks`
    most : H/h

    """
    labels = [np.zeros(0, dtype=np.int64)]
    for body in divisions:
        labels.append(blocks(body, most) + labels[-1].max(initial=-1) + 1)
    return np.concatenate(labels)


def decompose(
    points: NDArray[np.float64],
    cells: Nodes,
    label: NDArray[np.int64],
    material: NDArray[np.int64],
) -> Decomposition:
    """Decompose a mesh into subdomains by labels of its cells.

    Parameters
    ----------
    points : (n, dim)
    cells : (E, corners)
    label : (E,) subdomain of each cell, 0 … S − 1; no subdomain is empty
    material : (E,) material of each cell; equal for all subdomains of a class

    """
    n, S = len(points), int(label.max()) + 1
    by_label = np.argsort(label, kind="stable")
    copies, corner = np.unique(
        (label[by_label, None] * n + cells[by_label]).ravel(), return_inverse=True
    )
    start = np.searchsorted(copies, n * np.arange(S + 1))
    first_cell = np.searchsorted(label[by_label], np.arange(S + 1))
    node = copies % n
    corner = corner.reshape(cells.shape) - start[label[by_label], None]

    def part(s: int) -> SubdomainMesh:
        mine = slice(first_cell[s], first_cell[s + 1])
        own = node[start[s] : start[s + 1]]
        return SubdomainMesh(points[own], corner[mine], material[by_label[mine]])

    def key(s: int) -> tuple[bytes, bytes]:
        mine = part(s)
        return mine.cells.tobytes(), mine.material.tobytes()

    torn = np.split(points[node], start[1:-1])
    first, kind, rotation = classify(map(key, range(S)), torn)
    return Decomposition(
        node=node, nodes=n, start=start, parts=tuple(map(part, first)),
        class_of=kind, rotation=rotation, label=label,
    )  # fmt: skip


class Glued(NamedTuple):
    """A contact problem on the subdomains."""

    spread: csr_array  #: T (N, n), which maps displacements to torn unknowns
    B: csr_array  #: (m, N) rows of supports, gluing and contact
    c: Vector  #: (m,) right-hand side
    scale: Vector  #: (m_I,) scales of the contact rows
    f: Vector  #: (N,) torn load
    equalities: int  #: number of rows of supports and gluing


def glue(
    decomposition: Decomposition,
    *,
    load: Vector,
    supports: csr_array,
    supported: Vector,
    contact: csr_array,
    c: Vector,
    E: Vector,
    shape: Vector | float = 1.0,
    rows: str = "orthonormal",
) -> Glued:
    """Return the contact problem of the undivided mesh on the subdomains.

    Parameters
    ----------
    load : (n,) load on the undivided mesh; the copies of a node share it equally
    supports, supported : (k, n) one unit entry per prescribed component, and (k,) its
        value
    contact, c : (m_I, n) and (m_I,) contact rows of the undivided mesh, normals before
        tangents, and their gaps
    E : (nodes,) dimensionless stiffness of the body of each node
    shape : factor of E in rows of supports and gluing; (n,) by component, or a scalar
    rows : gluing of the copies, one of GLUE

    """
    d = load.size // decomposition.nodes
    #: component of the undivided mesh for each torn component
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
    return Glued(
        spread=T,
        B=csr_array(diags_array(scale) @ vstack([B_E @ turn, B_I])),
        c=scale * np.append(values, c), scale=scale[of_row.size :],
        f=average @ load, equalities=of_row.size,
    )  # fmt: skip


def _unit_rows(columns: Nodes, size: int) -> csr_array:
    """Return rows with one unit entry each, (k, size)."""
    k = columns.size
    return csr_array((np.ones(k), columns, np.arange(k + 1)), shape=(k, size))


def _gluing(component: Nodes, free: Nodes, weights: Weights) -> csr_array:
    """Return the rows that glue all copies of the free components.

    Parameters
    ----------
    component : (N,) component of the undivided mesh for each torn component
    free : components of the undivided mesh that are glued

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
    """Return Q = diag(Q_1 … Q_S) (N, N): from local axes of subdomains to global axes.

    d : number of components per node; for d = 1, the scalar does not depend on axes
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
