"""From a contact problem to the case of each form, and to what ranks emit of it."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from time import perf_counter
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array, vstack

from mortarbench.harness import (
    QP,
    Case,
    Fields,
    Friction,
    Grid,
    Mechanics,
    Reference,
    Solution,
    Vector,
)
from mortarbench.harness.mechanics import NO_FRICTION, contact_rows
from mortarbench.problems.contact.bodies import Bodies
from mortarbench.problems.contact.results import fields, quantities
from mortarbench.problems.duality.decomposed import cached_layout, decompose
from mortarbench.problems.duality.dualisation import dual_bounds, dualise, primal_form
from mortarbench.problems.duality.feti_dual import (
    decomposition_quantities,
    feti_dual,
    feti_matrices,
)
from mortarbench.problems.duality.monolithic import monolithic_path
from mortarbench.problems.duality.problem import (
    Choice,
    ContactProblem,
    DisplacedMesh,
    InterfaceState,
)
from mortarbench.problems.fem.inverse import GeneralisedInverse
from mortarbench.problems.fem.mesh import Mesh, Nodes
from mortarbench.problems.feti.local_bodies import certifier
from mortarbench.problems.feti.subdomains import (
    Contact,
    DecomposedProblem,
    on_one_process,
)

FORMS = ("primal", "dual", "dual-bounds")


Factorise = Callable[[], GeneralisedInverse]


def case_of(
    problem: ContactProblem, form: str, choice: Choice, reference: Reference
) -> Case:
    """Emit the QP of a contact problem that is chosen, in one of FORMS."""
    of = problem.bodies
    path, parts = monolithic_path(problem, reference), None
    whole, friction, _ = path.problem(choice.step, choice.iterate)
    primal, count = whole.primal, path.iterates(choice.step)
    if choice.size:
        contact = Contact(*contact_rows(primal, friction), friction.bound)
        stage = problem.stages[path.last_of(choice.step)]
        layout = cached_layout(of, choice.size)
        parts = decompose(of, layout, choice.glue, stage, contact)
    bodies = of.assembled

    def results(s: Solution) -> Mapping[str, Any]:
        found = MonolithicSolution(
            InterfaceState(bodies, primal, s, friction), bodies, count
        )
        return {**quantities(bodies, primal, s, friction), **problem.results(found)}

    case = contact_case(
        bodies, primal, form, parts=parts,
        floating=lambda: of.floating, clamped=lambda: of.clamped,
        supported=lambda: of.supported, quantities=results, friction=friction,
    )  # fmt: skip
    return case if problem.exact is None else with_exact_tractions(case, problem.exact)


def with_exact_tractions(case: Case, exact: NDArray[np.float64]) -> Case:
    """Draw the exact tractions beside the contact, see `ContactProblem.exact`."""
    solved = case.fields
    assert solved is not None

    def fields(s: Solution) -> Fields:
        found = solved(s)
        (side,) = found.contacts
        return replace(found, contacts=(replace(side, exact=exact),))

    return replace(case, fields=fields)


@dataclass(frozen=True, eq=False)
class MonolithicSolution:
    """An answer to the problem of undivided bodies; see `ContactSolution`."""

    sides: InterfaceState
    bodies: Bodies
    problems: int

    def at(self, component: Nodes) -> Vector:
        """Return the displacement at components (k,)."""
        return self.sides.solution.x[component]

    def largest(self, value: float) -> float:
        """Return the value, there being no other rank."""
        return value

    def meshes(self) -> Iterator[DisplacedMesh]:
        """Give the bodies, one after another."""
        bodies, u = self.bodies, self.sides.solution.x * self.bodies.length
        for b in range(len(bodies.names)):
            mesh = Mesh(bodies.mesh.points, bodies.mesh.cells[bodies.body == b], {})
            yield DisplacedMesh(b, mesh, bodies.body_of_node == b, u)


def contact_case(
    bodies: Bodies,
    primal: QP,
    form: str,
    *,
    floating: Factorise,
    clamped: Factorise,
    supported: Factorise,
    quantities: Callable[[Solution], Mapping[str, Any]],
    friction: Friction = NO_FRICTION,
    parts: DecomposedProblem | None = None,
) -> Case:
    """Emit the primal QP of a contact problem in one of FORMS.

    Parameters
    ----------
    floating, clamped : factorise K with its rigid modes, and without the prescribed
        components; called where the form needs it
    supported : as clamped, but of bodies, too, that contact alone holds; called when an
        answer is to be certified
    quantities : physical results from a solution of the primal problem; its z holds
        the multipliers of the contact rows, then those of the friction
    friction : with a given bound; its work is a part of the energy that the objective
        stands for
    parts : the same in subdomains, whose dual is emitted then

    """
    matrices: Mapping[str, Any] = {}
    decomposition: Mapping[str, Any] = {}
    seconds, certify_by_subdomains, subdomains = None, None, None
    if parts is not None:
        start = perf_counter()
        own = on_one_process(parts)
        pieces, certify_by_subdomains = own.decomposed, certifier(own, primal.P)
        new = feti_dual(pieces, primal, friction)
        seconds = perf_counter() - start
        subdomains = parts.layout.label
        matrices = feti_matrices(pieces, new.qp)
        decomposition = decomposition_quantities(pieces, new.qp)
    elif form == "primal":
        new = primal_form(primal, friction)
    else:
        inverse = floating() if form == "dual" else clamped()
        start = perf_counter()
        transform = dualise if form == "dual" else dual_bounds
        new = transform(primal, inverse, friction=friction)
        # the factor may be there already, from another load step: it is charged for
        seconds = inverse.seconds + perf_counter() - start
        matrices = _paper(new.qp, primal, friction, form, inverse)
    energy = bodies.force * bodies.length
    return Case(
        qp=new.qp,
        recover=lambda s: new.recover(s).x * bodies.length,
        quantities=lambda s: {**quantities(new.recover(s)), **decomposition},
        fields=lambda s: fields(
            bodies, primal, new.recover(s), friction, subdomains=subdomains
        ),
        scale=new.sign * energy,
        constant=new.constant * energy,
        matrices=matrices,
        dualise_seconds=seconds,
        mechanics=Mechanics(
            primal=primal, to_primal=new.recover, factorise=supported,
            mesh_size=bodies.mesh_size, rigid=bodies.rigid, names=bodies.names,
            scale=energy, grid=Grid(
                bodies.mesh.points, bodies.mesh.cells, bodies.body,
                np.zeros(bodies.mesh.dofs),
            ),
            friction=friction, certify_by_subdomains=certify_by_subdomains,
        ),
        unsettled=friction.unsettled,
    )  # fmt: skip


def _paper(
    dual: QP, primal: QP, friction: Friction, form: str, inverse: GeneralisedInverse
) -> dict[str, Any]:
    """Name the matrices of the dual as the paper does, (2)-(5)."""
    B, c = contact_rows(primal, friction)
    if form == "dual":
        B, c = csr_array(vstack([primal.A, B])), np.append(primal.b, c)
    return {"F": dual.P, "d": -dual.q, "B": B, "c": c, "R": inverse.kernel}
