"""From one linearised contact problem to the case of each form."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from harness import QP, Case, Solution
from problems.bodies import Bodies
from problems.dual import Transformed, dualise
from problems.inverse import GeneralisedInverse
from problems.results import fields
from problems.stepping import dual_bounds

FORMS = ("primal", "dual", "dual-bounds")

Factorise = Callable[[], GeneralisedInverse]


def contact_case(
    bodies: Bodies,
    primal: QP,
    form: str,
    *,
    floating: Factorise,
    clamped: Factorise,
    quantities: Callable[[Solution], Mapping[str, Any]],
) -> Case:
    """Emit the primal QP of a contact problem in one of FORMS.

    Parameters
    ----------
    floating, clamped : factorise K with its rigid modes, and without the prescribed
        components; called where the form needs it
    quantities : physical results from a solution of the primal QP

    """
    match form:
        case "primal":
            new = Transformed(primal, lambda s: s, 1.0, 0.0)
        case "dual":
            new = dualise(primal, floating())
        case _:
            new = dual_bounds(primal, clamped())
    energy = bodies.force * bodies.length
    return Case(
        qp=new.qp,
        recover=lambda s: new.recover(s).x * bodies.length,
        quantities=lambda s: quantities(new.recover(s)),
        fields=lambda s: fields(bodies, primal, new.recover(s)),
        scale=new.sign * energy,
        constant=new.constant * energy,
    )
