"""Decomposition of an undivided mesh and its gluing rows, by sparse algebra.

An independent derivation, for tests. Rows are those of
`mortarbench.problems.feti.subdomains`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import bsr_array, csr_array, diags_array, eye_array, vstack

from mortarbench.harness import Vector
from mortarbench.problems.fem.mesh import Nodes
from mortarbench.problems.feti.subdomain_classes import DecomposedBodies, SubdomainClass
from mortarbench.problems.feti.subdomains import GLUE, Weights
from mortarbench.problems.feti.tearing import SubdomainMesh, blocks, classify


@dataclass(frozen=True, eq=False, kw_only=True)
class Decomposition:
    """A mesh whose S subdomains have nodes of their own, M in all.

    Torn nodes are numbered subdomain after subdomain, and within one in the order of
    the nodes that they are copies of.
    """

    node: Nodes  #: (M,) node of the whole mesh that each torn node is a copy of
    nodes: int  #: of the whole mesh
    start: NDArray[np.int64]  #: (S + 1,) first torn node of each subdomain, and M
    parts: tuple[SubdomainMesh, ...]  #: the first subdomain of each kind
    class_of: NDArray[np.int64]  #: (S,) of each subdomain, a place in `parts`
    #: (S, dim, dim) turns the part of its kind into each subdomain: x = Q x_part + t
    rotation: NDArray[np.float64]
    label: NDArray[np.int64]  #: (E,) subdomain of each cell of the whole mesh

    @property
    def subdomain(self) -> NDArray[np.int64]:
        """Subdomain of each torn node, (M,)."""
        return np.repeat(np.arange(self.class_of.size), np.diff(self.start))


def structured_bodies(
    divisions: Sequence[tuple[int, ...]], most: int
) -> NDArray[np.int64]:
    """Label the cells of structured meshes, one after another, each by its `blocks`.

    Parameters
    ----------
    divisions : of each body, as of `blocks`
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
    """Cut a mesh into the subdomains that its cells are labelled with.

    Parameters
    ----------
    points : (n, dim)
    cells : (E, corners)
    label : (E,) subdomain of each cell, 0 … S − 1, none of them empty
    material : (E,) of each cell; subdomains of one kind have the same

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


def glue(
    decomposition: Decomposition,
    classes: tuple[SubdomainClass, ...],
    *,
    load: Vector,
    supports: csr_array,
    supported: Vector,
    contact: csr_array,
    c: Vector,
    E: Vector,
    shape: Vector | float = 1.0,
    rows: str = "orthonormal",
) -> DecomposedBodies:
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
    return DecomposedBodies(
        classes=classes, class_of=decomposition.class_of, spread=T,
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
