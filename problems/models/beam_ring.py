"""The paper's benchmark: an elastic beam pressed onto a half ring (Section 2).

A beam of 2 m × 0.25 m (Figure 1 of the paper), with its lower left corner at height
0.5 m, is clamped on the left and pulled down by F₀ = 10⁸ N/m at its upper right corner.
Below the beam is a half ring with radii 0.3 m and 0.49 m around (1 m, 0), clamped at
both feet. The initial gap is 1 cm.

The paper is not consistent in some details. The 313 nodes that it states for Nr = 4,
Nh = 3 imply a ring with Nh radial layers (``radial=3``), whereas the text and Table 1
of the paper imply 2·Nh layers (424 nodes). m_E is the number of prescribed displacement
components, 2(Nr + 1) + 4(radial + 1), not of prescribed nodes. Plane strain and a force
per unit thickness are implied, not stated.

With depth > 0 the bodies are extruded to `depth` layers of hexahedra over a thickness
of 1 m. The end faces are free, or in plane strain (u_z = 0). Clamped sides are fixed in
all directions, and F₀ = 10⁸ N is distributed over the loaded edge.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import lru_cache
from typing import Any

import numpy as np

from mortarbench.harness import Case, Reference, Solution, Value, Vector
from mortarbench.problems.contact.bodies import Bodies, ContactPair
from mortarbench.problems.contact.friction import law_of
from mortarbench.problems.contact.linearise import linearisation
from mortarbench.problems.contact.stepping import Forces, load_steps
from mortarbench.problems.duality.newton import Iteration, NewtonPath
from mortarbench.problems.duality.newton_case import newton_case, newton_path
from mortarbench.problems.duality.problem import (
    ContactProblem,
    ElasticBodies,
    Shape,
    StructuredGrids,
    StructuredSolids,
    cached_problem,
    keyed_linearisation,
)
from mortarbench.problems.fem.elasticity import Material, Plane
from mortarbench.problems.fem.mesh import (
    Nodes,
    StructuredGrid,
    as_vectors,
    dofs_of,
    extruded,
    half_ring_grid,
    nodal_lengths,
    nodes_of_side,
    rectangle_grid,
)

LENGTH = 2.0  #: l, length of the beam, m
LOAD = 1e8  #: F₀, N per m of thickness
THICKNESS = 1.0  #: thickness of extruded bodies, m
NAMES = ("beam", "ring")
BEAM = Material(E=200e9, nu=0.3)
RING = Material(E=20e9, nu=0.3)


@cached_problem
def problem(params: Mapping[str, Value]) -> ContactProblem:
    """Return the benchmark, loaded in `steps` equal load steps."""
    p: Any = params
    elastic = bodies(p["Nr"], p["Nh"], p["radial"], p["plane"], p["depth"], p["sides"])
    tip, share = _tip(elastic.shape)
    return ContactProblem(
        bodies=elastic,
        linearise=keyed_linearisation(p),
        stages=load_steps(
            p["steps"],
            p["relin"],
            elastic.forces,
            elastic.fixed,
            (law_of(p),),
            quasi_static=p["loading"] == "quasi-static",
        ),
        results=lambda answer: {
            "tip": (
                share @ as_vectors(answer.at(tip), elastic.shape.dim) * LENGTH
            ).tolist()
        },
    )


def newton_step(form: str, params: Mapping[str, Value], reference: Reference) -> Case:
    """Return the case of one Newton iteration of a load step at finite strain."""
    p: Any = params
    geometry = (p["Nr"], p["Nh"], p["radial"], p["plane"])
    path = _newton_path(
        geometry,
        (p["contact"], p["basis"]),
        p["steps"],
        p["material"],
        p["contact_stiffness"],
        reference,
    )
    tip, _ = _tip(bodies(*geometry).shape)

    def results(_: Iteration, s: Solution) -> dict[str, Any]:
        return {"tip": (s.x[tip] * LENGTH).tolist()}

    return newton_case(path, form, p["step"], p["newton"], results)


@lru_cache(maxsize=4)
def bodies(
    Nr: int, Nh: int, radial: int, plane: Plane, depth: int = 0, sides: str = "free"
) -> ElasticBodies:
    """Return a beam of 8Nr × Nr cells above a ring of 12Nh × radial cells.

    depth : number of layers across the thickness; 0 for plane bodies
    sides : condition on the end faces in 3D, "free" or "plane-strain"
    """
    grids = _grids(Nr, Nh, radial)
    shape: Shape = StructuredGrids(grids)
    if depth:
        solids = [extruded(grid.mesh(), depth, THICKNESS) for grid in grids]
        shape = StructuredSolids(
            tuple(solids), tuple((*grid.divisions, depth) for grid in grids)
        )
    by_name = shape.sides
    # in 2D, these are m_E = 2(Nr + 1) + 4(radial + 1) components
    clamped = [
        dofs_of(nodes_of_side(by_name[b]), shape.dim)
        for b in ("left", "left_foot", "right_foot")
    ]
    if sides == "plane-strain":
        ends = np.isin(shape.mesh.points[:, 2], (0.0, THICKNESS))
        clamped.append(dofs_of(np.flatnonzero(ends), 3, 2))
    fixed = np.concatenate(clamped)
    tip, share = _tip(shape)
    return ElasticBodies(
        shape=shape,
        names=NAMES,
        materials=(BEAM, RING),
        plane=None if depth else plane,
        length=LENGTH,
        force=LOAD,
        fixed=np.unique(fixed) if depth else fixed,
        forces=Forces(tip[1 :: shape.dim], -share),
        # as in the paper: the ring is the slave, the beam the master
        pairs=(ContactPair(slave=by_name["outer"], master=by_name["bottom"]),),
    )


def model(Nr: int, Nh: int, radial: int, plane: Plane) -> Bodies:
    """Mesh and assemble the beam and the ring."""
    return bodies(Nr, Nh, radial, plane).assembled


def _grids(Nr: int, Nh: int, radial: int) -> tuple[StructuredGrid, StructuredGrid]:
    return (
        rectangle_grid((0.0, 0.5), (LENGTH, 0.25), (8 * Nr, Nr)),
        half_ring_grid((1.0, 0.0), (0.3, 0.49), (12 * Nh, radial)),
    )


def _tip(shape: Shape) -> tuple[Nodes, Vector]:
    """Return the components of the loaded corner, at the upper right of the beam.

    Returns
    -------
    components (dim·k,) of the k nodes of the corner (an edge in 3D), and the
    fraction (k,) of the load that acts on each node

    """
    sides = shape.sides
    nodes = np.intersect1d(sides["top"], sides["right"])
    share = np.ones(1)
    if shape.dim == 3:
        share = nodal_lengths(shape.mesh.points[nodes]) / THICKNESS
    return dofs_of(nodes, shape.dim), share


@lru_cache(maxsize=4)
def _newton_path(
    geometry: tuple[Any, ...],
    method: tuple[Any, Any],
    steps: int,
    material: str,
    contact_stiffness: str,
    reference: Reference,
) -> NewtonPath:
    whole = model(*geometry)
    keys = {
        "material": material,
        "contact": method[0],
        "contact_stiffness": contact_stiffness,
    }
    return newton_path(whole, linearisation(whole, *method), keys, reference, steps)
