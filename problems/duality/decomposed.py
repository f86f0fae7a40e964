"""Load steps of decomposed elastic bodies in contact, on several ranks.

The linearisation of contact only requires the positions and displacements of the nodes
on the contact sides; no undivided stiffness matrix is assembled.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache, partial
from typing import Any

import numpy as np
from scipy.sparse import csc_array, csr_array, diags_array, eye_array

from mortarbench.harness import (
    QP,
    Case,
    Friction,
    InputError,
    ReferenceOfOperator,
    Solution,
    Status,
    Vector,
)
from mortarbench.harness.distributed.comm import Team
from mortarbench.harness.mechanics import contact_rows
from mortarbench.problems.contact.bodies import (
    Shape,
    UnassembledBodies,
    elasticity_matrices,
    joined_names,
    slave_places,
)
from mortarbench.problems.contact.friction import friction_of
from mortarbench.problems.contact.results import quantities
from mortarbench.problems.contact.rows import MIN_FREE, ContactRows, without_fixed
from mortarbench.problems.contact.stepping import LoadPath, Stage, State
from mortarbench.problems.duality.feti_dual import TornDual, with_decomposition
from mortarbench.problems.duality.problem import (
    Choice,
    ContactProblem,
    ContactSolution,
    InterfaceState,
)
from mortarbench.problems.fem.mesh import Nodes, as_vectors
from mortarbench.problems.feti.elastic import (
    STRESS_LAYERS,
    Patch,
    elastic_class,
    largest_in_patches,
)
from mortarbench.problems.feti.mechanics import torn_mechanics
from mortarbench.problems.feti.partition import graph_partition
from mortarbench.problems.feti.served import Served
from mortarbench.problems.feti.subdivision import Subdivision
from mortarbench.problems.feti.subdomains import (
    Contact,
    DecomposedProblem,
    TornBodies,
)
from mortarbench.problems.feti.tearing import blocks, compact_blocks, joined_labels


@dataclass(frozen=True, eq=False)
class DecomposedLinearisation:
    """Linearised contact problem of torn bodies; see `LinearisedProblem`."""

    bodies: UnassembledBodies
    served: Served
    fixed: Nodes  #: components fixed by supports
    rows: ContactRows  #: contact rows, m
    friction: Friction
    reference: ReferenceOfOperator

    @cached_property
    def dual(self) -> TornDual:
        """The dual."""
        return TornDual(self.served)

    def solve(self, friction: Friction, start: Solution | None = None) -> Solution:
        """Solve the dual with the given friction bounds."""
        bounded = replace(
            self.dual, served=Served(self.served.torn.with_bound(friction.bound))
        )
        return self.reference(replace(self.dual.qp, sets=bounded.sets), start)

    def normal_multipliers(self, s: Solution) -> Vector:
        """Return the multipliers λ_n (m,) of the contact rows."""
        return self.dual.multipliers(s)[: self.rows.c.size]

    def end_state(self, s: Solution) -> tuple[Vector, Vector]:
        """Return u (n,) and the normal forces (places,) of all slave nodes."""
        u = self.dual.displacement(s)
        self.dual.qp.P.forget()  # release the large explicit blocks
        # negative multipliers of inexact solutions would be negative friction bounds
        normal = np.maximum(self.normal_multipliers(s), 0.0)
        return u, self.rows.at_places(normal, slave_places(self.bodies.pairs))


def decomposed_path(
    problem: ContactProblem, choice: Choice, team: Team, reference: ReferenceOfOperator
) -> LoadPath[DecomposedLinearisation]:
    """Return the load path of a decomposed contact problem."""
    bodies, first = problem.bodies, list[TornBodies]()
    layout = subdivided(bodies.shape, choice.size)
    zero, places = np.zeros(bodies.mesh.dofs), slave_places(bodies.pairs)

    def pose(stage: Stage, at: State) -> DecomposedLinearisation:
        rows = problem.linearise(bodies, stage.laws)(at.u * bodies.length)
        rows = without_fixed(rows, stage.fixed)
        friction = friction_of(
            bodies, rows, stage.laws, at.slip_origin, at.normal_forces
        )
        contact = contact_of(_interface_qp(bodies, stage.fixed, rows), friction)
        parts = decompose(bodies, layout, choice.glue, stage, contact)
        if not first:
            first.append(TornBodies(parts, team))
        # the bodies are unchanged, so reuse their classes of subdomains
        served = Served(first[0].with_problem(parts))
        return DecomposedLinearisation(
            bodies, served, stage.fixed, rows, friction, reference
        )

    rest = State(zero, zero, np.full(places, problem.initial_force))
    return LoadPath(problem.stages, pose, rest)


def contact_of(primal: QP, friction: Friction) -> Contact:
    """Return the contact rows of `primal`, followed by the friction rows."""
    rows, c = contact_rows(primal, friction)
    return Contact(csr_array(rows), c, friction.bound, friction.tangents)


@lru_cache(maxsize=4)
def subdivided(shape: Shape, size: int) -> Subdivision:
    """Cut bodies into subdomains; the result is cached.

    size : largest number of cells along a side of a subdomain; for unstructured meshes,
        which METIS cuts, the number of subdomains
    """
    mesh, body = shape.mesh, shape.body
    if not shape.grids:
        label = graph_partition(mesh.points, mesh.cells, body, size)
    elif mesh.dim == 3 or any(
        part.grid.size > part.points.size for part in shape.grids
    ):
        # boxes of hexahedra, and half discs, whose central nodes coincide
        label = joined_labels([compact_blocks(part.grid, size) for part in shape.grids])
    else:
        label = joined_labels([blocks(part.divisions, size) for part in shape.grids])
    return Subdivision(mesh, label, body)


def case_on_ranks(
    problem: ContactProblem, choice: Choice, team: Team, reference: ReferenceOfOperator
) -> Case:
    """Return the selected dual of decomposed bodies.

    Raises
    ------
    InputError
        If displacements are prescribed, or if the fixed-point iteration for Coulomb's
        law does not converge.

    """
    if problem.bodies.lift is not None:
        raise InputError(
            "prescribed displacements on MPI ranks are not built; expected no ranks, "
            "or supports without displacement"
        )
    path = decomposed_path(problem, choice, team, reference)
    chosen = path.problem(choice.step)
    others = path.before(choice.step, chosen)
    count = path.iterates(choice.step)
    torn = chosen.problem.served.torn.with_bound(chosen.friction.bound)
    served = Served(torn)
    first = path.problems(0)[0].problem.served.torn if others else torn
    linearised = replace(chosen.problem, friction=chosen.friction)
    dual, elastic = TornDual(served), problem.bodies
    displacement = lru_cache(maxsize=1)(dual.displacement)
    mechanics, bound = torn_mechanics(served), chosen.friction.bound
    acts = np.append(np.ones(linearised.rows.c.size), bound) > 0

    def results(s: Solution) -> Mapping[str, Any]:
        u, parts = displacement(s), served.local_problems
        state, v = interface_state(dual, linearised, u, s), parts.spread @ u
        energy = float(v @ parts.product(v) / 2 - v @ torn.f)
        largest = largest_stresses(torn, elastic, u)
        return {
            **quantities(*state, energy, largest),
            **problem.results(ContactSolution(state, count)),
        }

    case = Case(
        qp=dual.qp,
        recover=lambda s: displacement(s) * elastic.length,
        quantities=results,
        certifiable=lambda s: (
            mechanics(),
            displacement(s),
            dual.multipliers(s)[acts],
        ),
    )
    return with_decomposition(case, served, first, others)


def interface_state(
    dual: TornDual, at: DecomposedLinearisation, u: Vector, s: Solution
) -> InterfaceState:
    """Return the state of the contact interface.

    u : (n,) nondimensional displacement
    s : solution of the dual
    """
    primal = _interface_qp(at.bodies, at.fixed, at.rows)
    if at.friction.bound.size:
        diagonal, components = np.zeros(u.size), np.unique(at.friction.T.indices)
        diagonal[components] = dual.served.local_problems.diagonal(components)
        primal = replace(primal, P=csc_array(diags_array(diagonal)))
    y, z = np.zeros(primal.b.size), dual.multipliers(s)
    whole = Solution(status=Status.SOLVED, x=u, y=y, z=z, z_box=np.zeros(u.size))
    return InterfaceState(at.bodies, primal, whole, at.rows, at.friction)


def _interface_qp(bodies: UnassembledBodies, fixed: Nodes, rows: ContactRows) -> QP:
    """Return the rows of supports and contact as a QP with P = 0."""
    n = bodies.mesh.dofs
    return QP(
        P=csc_array((n, n)),
        q=np.zeros(n),
        A=csr_array(eye_array(n, format="csr")[fixed]),
        b=np.zeros(fixed.size),
        G=rows.B,
        h=rows.c / bodies.length,
    )


def decompose(
    bodies: UnassembledBodies,
    layout: Subdivision,
    glue: str,
    stage: Stage,
    contact: Contact,
) -> DecomposedProblem:
    """Return the decomposed problem of elastic bodies under the load of a `Stage`.

    Raises
    ------
    InputError
        If the bodies have springs.

    """
    if bodies.springs is not None:
        raise InputError(
            "springs on bodies in parts are not built; expected no parts, or no springs"
        )
    unit, pieces = bodies.length / bodies.force, bodies.piece
    D = elasticity_matrices(bodies.materials, bodies.plane) * unit
    E = np.array([m.E for m in bodies.materials]) * unit
    n = contact.rows.shape[1]
    lift = None if bodies.lift is None else bodies.lift * stage.part
    return DecomposedProblem(
        layout=layout,
        components=bodies.mesh.dim,
        material=layout.body,
        assemble_class=partial(elastic_class, D=D, E=E),
        E=E,
        names=bodies.names if pieces is None else joined_names(bodies.names, pieces),
        piece=pieces,
        fixed=stage.fixed,
        # an array that several stages share takes memory only once
        load=stage.load if stage.part == 1 else stage.load * stage.part,
        lift=lift,
        glue=glue,
        contact=_without_supports(
            contact, stage.fixed, np.zeros(n) if lift is None else lift
        ),
    )


def _without_supports(contact: Contact, fixed: Nodes, u: Vector) -> Contact:
    """Return friction rows without entries at components that supports prescribe.

    Rows of supports prescribe these components, so that the problem stays the same.
    With the entries, the row of a supported node that slides on a stiff body would be
    nearly a multiple of a row of its supports, and F nearly singular. Contact rows are
    unchanged, and so are rows that have entries at such components only.

    u : (n,) displacement with the prescribed values at the components `fixed`
    """
    free = np.ones(contact.rows.shape[1])
    free[fixed] = 0.0
    size = abs(contact.rows)
    changes = (size @ free > MIN_FREE * size.sum(axis=1)).astype(float)
    changes[: changes.size - contact.bound.size] = 0.0
    off = csr_array(diags_array(changes) @ contact.rows @ diags_array(1 - free))
    rows = csr_array(contact.rows - off)
    rows.eliminate_zeros()
    return contact._replace(rows=rows, c=contact.c - off @ u)


def largest_stresses(torn: TornBodies, elastic: UnassembledBodies, u: Vector) -> Vector:
    """Return the largest nodal von Mises stress of each body, Pa.

    Each rank evaluates the nodes of its subdomains.

    u : (n,) nondimensional displacement
    """
    materials, layout, plane = elastic.materials, torn.problem.layout, elastic.plane
    points, D = layout.mesh.points, elasticity_matrices(materials, plane)
    rank, u = torn.rank[layout.label], as_vectors(u * elastic.length, layout.mesh.dim)
    patches: list[list[Patch]] = [[] for _ in range(torn.team.comm.size)]
    for b, material in enumerate(materials):
        of_body = layout.body_of_cell == b
        cells, owner = layout.mesh.cells[of_body], rank[of_body]
        for own, of_rank in enumerate(patches):
            inner, outer = cells[owner == own], cells[owner != own]
            is_inside, corners = np.zeros(len(points), dtype=bool), outer.T.copy()
            is_inside[inner] = True
            near = is_inside.copy()
            for _ in range(STRESS_LAYERS):
                around = outer[near[corners].any(axis=0)]
                near[around] = True
            local = (np.cumsum(near) - 1)[np.concatenate([inner, around])]
            mesh = points[near], local, u[near], is_inside[near]
            of_rank.append(Patch(*mesh, D[b], material.nu, plane))
    largest = torn.team.place(largest_in_patches, patches)
    return np.asarray(np.max(largest("tolist"), axis=0))
