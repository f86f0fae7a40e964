"""Decomposed bodies for certificates: local problems, contact and rigid motions."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import null_space
from scipy.sparse import bsr_array, csc_array, csr_array, hstack

from mortarbench.harness import Vector
from mortarbench.harness.mechanics import (
    DecomposedMechanics,
    Real,
    contact_data,
    friction_discs,
)
from mortarbench.harness.verify.products import projected_products
from mortarbench.problems.fem.elasticity import rigid_modes, rigid_motions
from mortarbench.problems.fem.mesh import dofs_of
from mortarbench.problems.feti.subdivision import Points
from mortarbench.problems.feti.subdomain_classes import DecomposedBodies, SubdomainClass
from mortarbench.problems.feti.subdomains import DecomposedProblem, LocalSubdomains


@dataclass(frozen=True, eq=False)
class LocalProblems:
    """Local problems of decomposed bodies; see `harness.mechanics.Substructures`.

    Stiffness matrices are factorised on first use.
    """

    torn: DecomposedBodies
    #: number of components per node; torn unknowns are numbered node by node
    components: int = 2

    @property
    def spread(self) -> csr_array:
        """T (N, n), which maps the components of local nodes to torn unknowns."""
        return self.torn.spread

    @property
    def kernel(self) -> csr_array:
        """R (N, r), a basis of the rigid motions of all subdomains."""
        return self.torn.domains.kernel

    @cached_property
    def weight(self) -> Vector:
        """Sum of the diagonal entries of K at the node of each torn unknown, (N,)."""
        d, weight = self.components, np.empty(self.spread.shape[0])
        for template, place in self._classes():
            trace = template.K.diagonal().reshape(-1, d).sum(axis=1)
            weight[place] = np.repeat(trace, d)[:, None]
        return weight

    def diagonal(self, at: NDArray[np.int64]) -> Vector:
        """Return the diagonal entries of TᵀKT for the columns `at` (k,) of T."""
        d = self.components
        nodes = np.unique(csr_array(self.spread[:, at]).nonzero()[0] // d)
        number = np.full(self.spread.shape[0] // d, -1)
        number[nodes] = np.arange(nodes.size)
        blocks = np.empty((nodes.size, d, d))
        for template, place in self._classes():
            places = number[place[::d] // d]
            node, subdomain = np.nonzero(places >= 0)
            blocks[places[node, subdomain]] = _nodal(template, d)[node]
        rows = (d * nodes[:, None] + np.arange(d)).ravel()
        T = csr_array(self.spread[rows][:, at])
        ends = np.arange(nodes.size + 1)
        K = csr_array(bsr_array((blocks, ends[:-1], ends), shape=(rows.size,) * 2))
        return np.asarray(T.multiply(K @ T).sum(axis=0))

    def product(self, v: NDArray[Any]) -> NDArray[Any]:
        """Apply PKP to v (N,) in the precision of v.

        P is the orthogonal projector that removes rigid motions.
        """
        image, domains = np.zeros_like(v), self.torn.domains
        for template, members in zip(domains.classes, domains.members, strict=True):
            K, R = template.K, np.ascontiguousarray(template.R)
            projected_products(
                K.data, K.indices, K.indptr, R, domains.start[members], v, image
            )
        return image

    def squared_product(self, v: Vector) -> Vector:
        """Apply K∘K, the squares of the entries of K, to v (N,)."""
        image = np.empty_like(v)
        for template, place in self._classes():
            K = template.K.copy()
            K.data = K.data**2
            image[place] = K @ v[place]
        return image

    def solve(self, b: Vector) -> Vector:
        """Apply PK⁺P, with P of `product`, to b (N,).

        The systems of all subdomains of a class where b is nonzero are solved at once,
        with one column of the right-hand side for each of these subdomains.
        """
        solution, domains = np.zeros_like(b), self.torn.domains
        acting = np.logical_or.reduceat(b != 0, domains.start[:-1])
        for (template, place), members in zip(
            self._classes(), domains.members, strict=True
        ):
            place = place[:, acting[members]]  # the solution is zero where b = 0
            columns, R = b[place], template.R
            columns -= R @ (R.T @ columns)
            image = template.inverse(columns)
            image -= R @ (R.T @ image)
            solution[place] = image
        return solution

    def _classes(self) -> zip[tuple[SubdomainClass, NDArray[np.int64]]]:
        """Return each class with the torn unknowns (n_k, S_k) of its subdomains."""
        return zip(self.torn.classes, self.torn.domains.places(), strict=True)


def _nodal(template: SubdomainClass, d: int) -> NDArray[np.float64]:
    """Return the diagonal block of K for each node, (n_k/d, d, d)."""
    blocks = np.empty((template.K.shape[0] // d, d, d))
    for i, j in np.ndindex(d, d):
        blocks[:, i, j] = template.K.diagonal(j - i)[min(i, j) :: d]
    return blocks


def decomposed_mechanics(
    local: LocalSubdomains, K: csc_array | None = None
) -> Callable[[], DecomposedMechanics]:
    """Return a function that returns the decomposed bodies, for certificates.

    K : (n, n) stiffness matrix of the undivided bodies; None if it is not assembled
    """

    @cache
    def bodies() -> DecomposedMechanics:
        floating = local.floating  # supports are rows of B
        problem, contact = floating.problem, floating.problem.contact
        n, m = problem.components * problem.layout.nodes, contact.c.size
        bound = contact.bound
        acts = np.append(np.ones(m - bound.size), bound) > 0
        rows, diagonal = csr_array(contact.rows[acts]), np.zeros(n)
        at = np.unique(rows.indices)
        parts = LocalProblems(floating.decomposed, problem.components)
        diagonal[at] = parts.diagonal(at)
        return DecomposedMechanics(
            parts=parts,
            exact=contact_data(
                problem.load(np.arange(n)).astype(Real),
                (rows, contact.c[acts]),
                friction_discs(bound[bound > 0], contact.tangents, m - bound.size),
                np.unique(problem.fixed),
                diagonal,
            ),
            stored=None if K is None else csr_array(K),
            **_rigid_motions(problem),
        )

    return bodies


def _rigid_motions(problem: DecomposedProblem) -> dict[str, Any]:
    """Return the fields of `DecomposedMechanics` that describe rigid motions."""
    layout, d, names = problem.layout, problem.components, list[str]()
    node, axis = np.divmod(problem.fixed, d)
    body = problem.piece_of[layout.holder(node)]
    none = csr_array((d * layout.nodes, 0))
    kernel, rigid = [none], [none]
    for b, name in enumerate(problem.names):
        fixed, axes = node[body == b], axis[body == b]
        if _prevents_motion(layout.position(fixed), axes, d):
            continue
        nodes = layout.subdomain_nodes(np.arange(layout.count))
        of_body = np.unique(nodes.number[problem.piece_of[nodes.subdomain] == b])
        points, dofs = layout.position(of_body), dofs_of(of_body, d)
        R = (
            rigid_modes(points)
            if d > 1
            else np.full((len(points), 1), len(points) ** -0.5)
        )
        at = d * np.searchsorted(of_body, fixed) + axes
        allowed = R @ null_space(R[at]) if at.size else R.copy()
        allowed[at] = 0
        embedding = csr_array(
            (np.ones(dofs.size), (dofs, np.arange(dofs.size))),
            shape=(d * layout.nodes, dofs.size),
        )
        rigid.append(embedding @ csr_array(R))
        kernel.append(embedding @ csr_array(allowed))
        names.append(name)
    return {
        "kernel": csr_array(hstack(kernel)),
        "rigid": csr_array(hstack(rigid)),
        "names": tuple(names),
    }


def _prevents_motion(points: Points, axes: NDArray[np.int64], d: int) -> bool:
    """Return True if no rigid motion is zero along `axes[i]` at all points i."""
    if d == 1 or not len(points):
        return len(points) > 0
    size = np.ptp(points, axis=0).max() or 1.0
    R = rigid_motions(points / size)[d * np.arange(axes.size) + axes]
    return bool(np.linalg.matrix_rank(R) == R.shape[1])
