"""Timing of individual parts: assembly, contact rows, generalised inverse."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mortarbench.harness import Value
from mortarbench.problems.contact.mortar import mortar
from mortarbench.problems.contact.node_to_facet import node_to_facet
from mortarbench.problems.experiments.clock import Laps, Stopwatch, race, timed_as_one
from mortarbench.problems.experiments.plan import Plan
from mortarbench.problems.families.beam_ring import BEAM, LENGTH, LOAD, model
from mortarbench.problems.fem.elasticity import (
    elasticity_matrix,
    rigid_modes,
    sparsity,
    stiffness,
)
from mortarbench.problems.fem.fixing import fixing_nodes, spectral_fixing_nodes
from mortarbench.problems.fem.inverse import floating_inverse
from mortarbench.problems.fem.mesh import Mesh, Nodes, dofs_of, rectangle
from mortarbench.problems.fem.triplets import stiffness_by_triplets

Rows = Iterator[dict[str, Value]]


def beam(Nr: int) -> Mesh:
    """Return the mesh of the rectangle without the ring, 8Nr × Nr cells."""
    return rectangle((0.0, 0.5), (LENGTH, 0.25), (8 * Nr, Nr))


def counts(Nr: int, Nh: int) -> Rows:
    """Yield the sizes of the mesh of each body, as in Table 1."""
    bodies = model(Nr, Nh, 2 * Nh, "strain")
    (pair,) = bodies.pairs
    for b, (name, N, chain) in enumerate(
        (("rectangle", Nr, pair.master), ("ring", Nh, pair.slave))
    ):
        nodes = int((bodies.body_of_node == b).sum())
        yield {
            "body": name,
            "N": N,
            "nodes": nodes,
            "elements": int((bodies.body == b).sum()),
            "dofs": 2 * nodes,
            "segments": len(chain) - 1,
        }


def assembly(plan: Plan) -> Rows:
    """Time the assembly of the stiffness matrix of the rectangle (Figure 3)."""
    D = elasticity_matrix(BEAM, "strain")
    for Nr in plan.assembly:
        mesh = beam(Nr)
        pattern = sparsity(mesh)
        contestants = {
            "triplets": timed_as_one(partial(stiffness_by_triplets, mesh, D)),
            "compiled": timed_as_one(partial(stiffness, mesh, D)),
            "compiled-reused": timed_as_one(
                partial(stiffness, mesh, D, pattern=pattern)
            ),
        }
        for row in race(contestants, plan.assembly_rounds):
            yield {"Nr": Nr, "n": mesh.dofs} | row


def contact(plan: Plan) -> Rows:
    """Time one linearisation of contact at u = 0 (Figure 4)."""
    for Nr in plan.contact[0]:
        for Nh in plan.contact[1]:
            # the number of layers of the ring (2) has no effect on contact
            bodies = model(Nr, Nh, 2, "strain")
            (pair,) = bodies.pairs
            points, u = bodies.mesh.points, np.zeros(bodies.mesh.dofs)
            contestants = {
                "nts": timed_as_one(partial(node_to_facet, points, u, *pair.sides)),
                "mortar": timed_as_one(partial(mortar, points, u, *pair.sides)),
            }
            size = {"master": len(pair.master) - 1, "slave": len(pair.slave) - 1}
            for row in race(contestants, plan.contact_rounds):
                yield {"Nr": Nr, "Nh": Nh} | size | row


def inverse(plan: Plan) -> Rows:
    """Time the construction of K⁺ of the rectangle and the product K⁺v (Figure 5)."""
    D = elasticity_matrix(BEAM, "strain") * (LENGTH / LOAD)
    random = np.random.default_rng(2024)
    for Nr in plan.inverse:
        mesh = beam(Nr)
        K, v = stiffness(mesh, D), random.standard_normal(mesh.dofs)
        contestants: dict[str, Callable[[], Laps]] = {
            "geometric": partial(_cholesky, mesh, K, v, fixing_nodes),
            "spectral": partial(_cholesky, mesh, K, v, partial(_spectral, mesh)),
        }
        rows = race(contestants, plan.inverse_rounds)
        if mesh.dofs <= plan.dense:
            pinv = {"pinv": partial(_pinv, K, v)}
            # the pseudoinverse is timed separately, because its dense matrices would
            # evict the data of the other methods from the caches
            rows += race(pinv, plan.inverse_rounds, warm=False)
        for row in rows:
            yield {"Nr": Nr, "n": mesh.dofs} | row


def _cholesky(
    mesh: Mesh, K: Any, v: NDArray[np.float64], fixing: Callable[..., Nodes]
) -> Laps:
    watch = Stopwatch()
    fixing_dofs = dofs_of(fixing(mesh.points), mesh.dim)
    inverse = floating_inverse(K, [rigid_modes(mesh.points)], [fixing_dofs])
    watch.lap("build")
    inverse(v)
    watch.lap("multiply")
    return watch.laps


def _spectral(mesh: Mesh, points: NDArray[np.float64]) -> Nodes:
    return spectral_fixing_nodes(mesh.cells, len(points))


def _pinv(K: Any, v: NDArray[np.float64]) -> Laps:
    dense = K.toarray()
    watch = Stopwatch()
    P = np.linalg.pinv(dense)  # singular value decomposition, as in MATLAB
    watch.lap("build")
    P @ v
    watch.lap("multiply")
    return watch.laps
