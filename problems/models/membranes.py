"""Two membranes in contact along an edge: a model problem of Total FETI.

The problem is that of Dostál and Horák 2004, "Scalable FETI with optimal dual penalty
for a variational inequality" (ref. [20] of the paper), which the developers of PERMON
use as a benchmark. Under unit tension,

    min Σ_b ∫ ½|∇u_b|² − f_b u_b,    u_1 = 0 on x = 0,   u_1 ≤ u_2 on x = 1

on Ω_1 = (0, 1)² and Ω_2 = (1, 2) × (0, 1). The load pulls down: f_1 = −3 for y > ¾, f_2
= −1 for y < ¼, and both are zero elsewhere. The second membrane floats and is supported
by the first one alone; therefore, the sum of the contact forces is its load, ¼.

Elements are bilinear. Each membrane is decomposed into S × S congruent squares of n × n
cells.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from time import perf_counter
from typing import Any

import numpy as np
from scipy.sparse import block_diag, csc_array, csr_array, eye_array

from mortarbench.harness import (
    QP,
    Case,
    Mechanics,
    Solution,
    Value,
    Vector,
)
from mortarbench.harness.mechanics import DecomposedMechanics
from mortarbench.problems.contact.sides import active
from mortarbench.problems.duality.dualisation import Transformed, primal_form
from mortarbench.problems.duality.feti_dual import (
    decomposition_quantities,
    digest_of,
    feti_dual,
    feti_matrices,
)
from mortarbench.problems.fem.fixing import fixing_nodes
from mortarbench.problems.fem.inverse import GeneralisedInverse, supported_inverse
from mortarbench.problems.fem.laplacian import grid_stiffness
from mortarbench.problems.fem.mesh import (
    Mesh,
    Nodes,
    StructuredGrid,
    join,
    rectangle_grid,
)
from mortarbench.problems.feti.mechanics import torn_mechanics
from mortarbench.problems.feti.served import Served
from mortarbench.problems.feti.structured import grids_in_blocks
from mortarbench.problems.feti.subdomain_classes import SubdomainClass
from mortarbench.problems.feti.subdomains import (
    Contact,
    DecomposedProblem,
    TornBodies,
)
from mortarbench.problems.feti.tearing import SubdomainMesh

NAMES = ("left", "right")
#: load f of each membrane, and the interval of y on which it acts
LOADS = ((-3.0, (0.75, 1.0)), (-1.0, (0.0, 0.25)))


def membranes(form: str, params: Mapping[str, Value]) -> Case:
    """Return the case in the form `form`."""
    p: Any = params
    pair = Membranes(p["S"], p["n"])
    if form == "primal":
        return _case(pair, primal_form(pair.qp))
    start = perf_counter()
    served = Served(TornBodies(in_subdomains(params)))
    case = decomposed_case(params, served)
    return replace(case, dualise_seconds=perf_counter() - start)


def in_subdomains(params: Mapping[str, Value]) -> DecomposedProblem:
    """Return the decomposed problem for `params`, which must contain all keys."""
    p: Any = params
    return Membranes(p["S"], p["n"]).in_subdomains(p["glue"])


def decomposed_case(params: Mapping[str, Value], served: Served) -> Case:
    """Return the case of the dual of decomposed membranes on rank 0."""
    p: Any = params
    pair = Membranes(p["S"], p["n"])
    new = feti_dual(served, pair.qp)
    case = _case(pair, new, torn_mechanics(served, pair.qp.P))
    sizes = decomposition_quantities(served, new.qp)
    return replace(
        case,
        digest=digest_of(served, served.torn),
        quantities=lambda s: {**case.quantities(s), **sizes},
        matrices=feti_matrices(served, new.qp),
    )


def _case(
    pair: Membranes,
    new: Transformed,
    subdomains: Callable[[], DecomposedMechanics] | None = None,
) -> Case:
    return Case(
        qp=new.qp,
        recover=lambda s: new.recover(s).x,
        quantities=lambda s: pair.quantities(new.recover(s)),
        scale=new.sign,
        constant=new.constant,
        mechanics=Mechanics(
            primal=pair.qp,
            to_primal=new.recover,
            factorise=pair.factorise,
            mesh_size=1 / pair.side,
            rigid=pair.rigid,
            names=NAMES,
            subdomains=subdomains,
        ),
    )


@dataclass(frozen=True, eq=False)
class Membranes:
    """Two membranes on uniform grids, with the nodes of the left one first."""

    S: int  #: number of subdomains along a side of a membrane, 1/H
    n: int  #: number of cells along a side of a subdomain, H/h

    @property
    def side(self) -> int:
        """Number of cells along a side of a membrane."""
        return self.S * self.n

    @cached_property
    def _joined(self) -> tuple[Mesh, Nodes]:
        return join(tuple(grid.mesh() for grid in self.grids))

    @property
    def grids(self) -> tuple[StructuredGrid, ...]:
        """Grids of the two adjacent squares, the left one first."""
        return tuple(
            rectangle_grid((x, 0.0), (1.0, 1.0), (self.side,) * 2).prefixed(f"{name} ")
            for x, name in zip((0.0, 1.0), NAMES, strict=True)
        )

    @property
    def mesh(self) -> Mesh:
        """Mesh of both squares; nodes on the common edge are duplicated."""
        return self._joined[0]

    @property
    def body(self) -> Nodes:
        """Index of the membrane of each cell, (E,)."""
        return self._joined[1]

    @cached_property
    def qp(self) -> QP:
        """Primal problem for the heights u of the nodes."""
        nodes, sides = len(self.mesh.points), self.mesh.boundaries
        K = grid_stiffness((self.side, self.side))
        one = csr_array(eye_array(nodes, format="csr"))
        A, G = one[np.sort(sides["left left"])], _contact_rows(sides, nodes)
        return QP(
            P=csc_array(block_diag([K, K], format="csc")),
            q=-self.load(np.arange(nodes)),
            A=A,
            b=np.zeros(A.shape[0]),
            G=G,
            h=np.zeros(G.shape[0]),
            lb=np.full(nodes, -np.inf),
            ub=np.full(nodes, np.inf),
        )

    def load(self, node: Nodes) -> Vector:
        """Return the nodal forces (k,) on the nodes `node` (k,)."""
        body, within = np.divmod(node, (self.side + 1) ** 2)
        row, column = np.divmod(within, self.side + 1)
        f = np.array([value for value, _ in LOADS])
        heights = np.stack([hat_integrals(self.side, *y) for _, y in LOADS])
        along = hat_integrals(self.side, 0.0, 1.0)
        return np.asarray(f[body] * (heights[body, row] * along[column]))

    def in_subdomains(self, rows: str) -> DecomposedProblem:
        """Return the decomposed problem of both membranes.

        rows : type of the rows that join copies of a node, the value of the key `glue`
        """
        layout = grids_in_blocks(self.grids, self.n, self._joined)
        sides = self.mesh.boundaries
        G = _contact_rows(sides, layout.nodes)
        return DecomposedProblem(
            layout=layout,
            components=1,
            material=np.zeros(layout.count, dtype=int),
            assemble_class=membrane_class,
            E=np.ones(2),
            names=NAMES,
            load=self.load(np.arange(layout.nodes)),
            glue=rows,
            fixed=np.sort(sides["left left"]),
            contact=Contact(G, np.zeros(G.shape[0]), np.zeros(0)),
        )

    @property
    def rigid(self) -> Any:
        """Orthonormal translations of each membrane, (nodes, 2)."""
        half = self.qp.q.size // 2
        return np.kron(np.eye(2), np.full((half, 1), half**-0.5))

    def factorise(self) -> GeneralisedInverse:
        """Factorise K on the free components; the right membrane may move rigidly."""
        free = np.setdiff1d(np.arange(self.qp.q.size), csr_array(self.qp.A).indices)
        return supported_inverse(self.qp.P, free, self.rigid)

    def quantities(self, s: Solution) -> dict[str, Any]:
        """Return counts, energy, contact force and least height of a primal solution.

        Energy and force are divided by the tension.
        """
        nodes = 2 * (self.side + 1) ** 2
        return {
            "nodes": nodes,
            "elements": 2 * self.side**2,
            "dofs": nodes,
            "equality_rows": self.side + 1,
            "contact_rows": s.z.size,
            "active": int(active(s.z).sum()),
            "energy": self.qp.objective(s.x),
            "contact_force": float(s.z.sum()),
            "lowest": float(s.x.min()),
        }


def membrane_class(part: SubdomainMesh, h: float = 1.0) -> SubdomainClass:
    """Assemble a floating subdomain of a grid under unit tension.

    The kernel consists of the constants. Nodes are numbered as in `grid_stiffness`.

    h : length of a cell; in 2D, the stiffness does not depend on it
    """
    # round, because coordinates of nodes on one grid line differ in their last digits
    lines = [np.unique(x.round(9)) for x in (part.points / h).T]
    cells = tuple(x.size - 1 for x in lines)
    nodes = len(part.points)
    at = np.indices([x.size for x in lines]).reshape(len(cells), -1)
    last = np.array(cells)[:, None]
    return SubdomainClass(
        K=grid_stiffness(cells, h),
        R=np.full((nodes, 1), nodes**-0.5),
        fixing=fixing_nodes(part.points),
        boundary=np.flatnonzero(((at == 0) | (at == last)).any(axis=0)),
        stiffness=np.ones(nodes),
    )


def _contact_rows(sides: Mapping[str, Nodes], nodes: int) -> csr_array:
    """Return the rows  u_1 − u_2 ≤ 0  of opposite nodes, (m, nodes)."""
    # sorted node numbers ascend with y on both sides, and the grids match
    pairs = np.stack([np.sort(sides[s]) for s in ("left right", "right left")], axis=1)
    ends = 2 * np.arange(len(pairs) + 1)
    data = np.tile([1.0, -1.0], len(pairs))
    return csr_array((data, pairs.ravel(), ends), shape=(len(pairs), nodes))


def hat_integrals(n: int, lower: float, upper: float) -> Vector:
    """Return ∫N_j over lower < y < upper of the n + 1 hat functions on (0, 1)."""
    begin, end = (np.clip(y * n - np.arange(n), 0, 1) for y in (lower, upper))
    # integrals of the rising and the falling hat function over each cell
    rising = (end**2 - begin**2) / 2
    return np.asarray((np.append(end - begin - rising, 0) + np.append(0, rising)) / n)
