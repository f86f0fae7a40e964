"""Cases of a contact problem in primal or dual form."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
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
)
from mortarbench.harness.mechanics import NO_FRICTION, contact_rows
from mortarbench.problems.contact.balance import least_motion
from mortarbench.problems.contact.bodies import Bodies
from mortarbench.problems.contact.results import fields, quantities
from mortarbench.problems.contact.rows import ContactRows
from mortarbench.problems.duality.dualisation import (
    Transformed,
    dual_bounds,
    dualise,
    primal_form,
)
from mortarbench.problems.duality.monolithic import monolithic_path
from mortarbench.problems.duality.problem import (
    Choice,
    ContactProblem,
    ContactSolution,
    InterfaceState,
)
from mortarbench.problems.fem.inverse import GeneralisedInverse

FORMS = ("primal", "dual", "dual-bounds")


def case_of(
    problem: ContactProblem, form: str, choice: Choice, reference: Reference
) -> Case:
    """Return the case for the QP that `choice` selects.

    form : one of FORMS
    """
    path = monolithic_path(problem, reference)
    chosen = path.problem(choice.step)
    whole, friction, _ = chosen
    primal, count = whole.primal, path.iterates(choice.step)
    bodies = problem.bodies.assembled

    def results(s: Solution) -> Mapping[str, Any]:
        state = InterfaceState(bodies, primal, s, whole.rows, friction)
        solution = ContactSolution(state, count)
        return {**quantities(*state), **problem.results(solution)}

    build = partial(
        contact_case,
        bodies,
        primal,
        whole.rows,
        quantities=results,
        friction=friction,
        settle=lambda s: least_motion(bodies.rigid, primal, s, friction),
    )
    if choice.size:
        from mortarbench.problems.duality.torn_form import torn_case

        case = torn_case(problem, path, choice, chosen, build)
    else:
        case = build(form)
    return case if problem.exact is None else with_exact_tractions(case, problem.exact)


def with_exact_tractions(case: Case, exact: NDArray[np.float64]) -> Case:
    """Return `case` with the exact contact tractions added to its fields.

    exact : (k, 3), see `ContactProblem.exact`
    """
    solved = case.fields
    assert solved is not None

    def fields(s: Solution) -> Fields:
        result = solved(s)
        (side,) = result.contacts
        return replace(result, contacts=(replace(side, exact=exact),))

    return replace(case, fields=fields)


def contact_case(
    bodies: Bodies,
    primal: QP,
    rows: ContactRows,
    form: str | Transformed,
    *,
    settle: Callable[[Solution], Solution] = lambda s: s,
    floating: Callable[[Bodies], GeneralisedInverse] = lambda bodies: bodies.floating,
    quantities: Callable[[Solution], Mapping[str, Any]],
    friction: Friction = NO_FRICTION,
    subdomains: NDArray[np.int64] | None = None,
) -> Case:
    """Return the case of a contact problem with a given primal QP.

    Parameters
    ----------
    rows : contact rows of `primal`
    form : one of FORMS, or the dual itself
    settle : function that selects one of the solutions with equal forces, for all
        results except certificates
    floating : function that returns K⁺ for the form `dual`, with the rigid motions as
        kernel
    quantities : function that evaluates physical results from a solution of the primal
        problem; z of this solution lists the multipliers of the contact rows, then
        those of the friction rows
    friction : friction law with a prescribed bound; the objective includes its work
    subdomains : (E,) subdomain of each cell, for plots; None for undivided bodies

    """
    matrices: Mapping[str, Any] = {}
    seconds = None
    if isinstance(form, Transformed):
        transformed = form
    elif form == "primal":
        transformed = primal_form(primal, friction)
    else:
        inverse = floating(bodies) if form == "dual" else bodies.clamped
        start = perf_counter()
        transform = dualise if form == "dual" else dual_bounds
        transformed = transform(primal, inverse, friction=friction)
        # include the time of the factorisation even if it belongs to an earlier load
        # step
        seconds = inverse.seconds + perf_counter() - start
        matrices = _paper(transformed.qp, primal, friction, form, inverse)
    energy, lift = bodies.force * bodies.length, primal.A.T @ primal.b
    has_lift = bool(lift.any())

    def recovered(s: Solution) -> Solution:
        return settle(transformed.recover(s))

    def to_primal(s: Solution) -> Solution:
        """Return the solution with u − w, see `Mechanics`."""
        s = transformed.recover(s)
        return replace(s, x=s.x - lift) if has_lift else s

    return Case(
        qp=transformed.qp,
        recover=lambda s: recovered(s).x * bodies.length,
        quantities=lambda s: quantities(recovered(s)),
        fields=lambda s: fields(
            bodies,
            primal,
            recovered(s),
            rows,
            friction,
            subdomains=subdomains,
        ),
        scale=transformed.sign * energy,
        constant=transformed.constant * energy,
        matrices=matrices,
        dualise_seconds=seconds,
        mechanics=Mechanics(
            primal=primal,
            to_primal=to_primal,
            factorise=lambda: bodies.supported,
            rigid=bodies.rigid,
            names=bodies.piece_names,
            grid=Grid(
                bodies.mesh.points,
                bodies.mesh.cells,
                bodies.pieces[bodies.body],
            ),
            friction=friction,
        ),
    )


def _paper(
    dual: QP, primal: QP, friction: Friction, form: str, inverse: GeneralisedInverse
) -> dict[str, Any]:
    """Return the matrices of the dual, keyed by their names in (2)-(5) of the paper."""
    B, c = contact_rows(primal, friction)
    if form == "dual":
        B, c = csr_array(vstack([primal.A, B])), np.append(primal.b, c)
    return {"F": dual.P, "d": -dual.q, "B": B, "c": c, "R": inverse.kernel}
