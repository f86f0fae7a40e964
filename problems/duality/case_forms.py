"""From one linearised contact problem to the case of each form."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from time import perf_counter
from typing import Any

import numpy as np
from scipy.sparse import csr_array, vstack

from mortarbench.harness import (
    QP,
    Case,
    Friction,
    Grid,
    InputError,
    Mechanics,
    Solution,
)
from mortarbench.harness.mechanics import NO_FRICTION, contact_rows
from mortarbench.problems.contact.bodies import Bodies
from mortarbench.problems.contact.results import fields
from mortarbench.problems.duality.dualisation import dual_bounds, dualise, posed
from mortarbench.problems.duality.torn_dual import (
    torn_dual,
    torn_matrices,
    torn_quantities,
)
from mortarbench.problems.fem.inverse import GeneralisedInverse
from mortarbench.problems.feti.substructures import LocalProblems
from mortarbench.problems.feti.torn import Torn

FORMS = ("primal", "dual", "dual-bounds")

Factorise = Callable[[], GeneralisedInverse]


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
    torn: Callable[[], Torn] | None = None,
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
    torn : poses the problem on subdomains; then its dual is emitted, and no other form

    Raises
    ------
    InputError
        When a problem on subdomains is asked for in another form.

    """
    matrices: Mapping[str, Any] = {}
    decomposition: Mapping[str, Any] = {}
    seconds, tear, subdomains = None, None, None
    if torn is not None:
        if form != "dual":
            raise InputError(
                f"feti with form {form} is not built; expected form dual, or no feti"
            )
        start = perf_counter()
        pieces = torn()
        new = torn_dual(pieces, primal, friction)
        tear = partial(LocalProblems, pieces, bodies.mesh.dim)
        seconds = perf_counter() - start
        subdomains = pieces.label
        matrices = torn_matrices(pieces, new.qp)
        decomposition = torn_quantities(pieces, new.qp)
    elif form == "primal":
        new = posed(primal, friction)
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
            primal=primal, back=new.recover, factorise=supported,
            mesh_size=bodies.mesh_size, rigid=bodies.rigid, names=bodies.names,
            scale=energy, grid=Grid(
                bodies.mesh.points, bodies.mesh.cells, bodies.body,
                np.zeros(bodies.mesh.dofs),
            ),
            friction=friction, tear=tear,
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
