"""What an elastic family of one's own is made of: the list that plug-ins may rely on.

Mesh the bodies, `join` them, `assemble` their supports, load and contact pairs, and let
`one_step` emit the QP: docs/plugins.md has a whole family. All lengths are in m, moduli
and tractions in Pa, forces in N per m of thickness.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Literal

import numpy as np

from harness import Case, InputError, Solution
from problems.contact.balance import check_balance
from problems.contact.bodies import (
    Bodies,
    ContactPair,
    assemble,
    clamped,
    floating,
    supported,
)
from problems.contact.linearise import linearisation
from problems.contact.results import quantities
from problems.duality.case_forms import FORMS, contact_case
from problems.duality.stepping import primal_qp
from problems.fem.elasticity import Material
from problems.fem.gmsh_mesh import NamedMesh, read_msh
from problems.fem.mesh import (
    Mesh,
    half_disc,
    half_ring,
    join,
    nodal_lengths,
    prefixed,
    rectangle,
)
from problems.ranges import at_least, at_most, one_of, positive

__all__ = [
    "Bodies",
    "ContactPair",
    "Material",
    "Mesh",
    "NamedMesh",
    "assemble",
    "at_least",
    "at_most",
    "half_disc",
    "half_ring",
    "join",
    "nodal_lengths",
    "one_of",
    "one_step",
    "positive",
    "prefixed",
    "read_msh",
    "rectangle",
]


def one_step(
    bodies: Bodies,
    form: str,
    *,
    contact: Literal["nts", "mortar"] = "mortar",
    basis: Literal["dual", "standard"] = "dual",
) -> Case:
    """Emit the QP of bodies under their full load, contact linearised where they lie.

    Parameters
    ----------
    form : "primal", "dual" or, where supports alone hold every body, "dual-bounds"
    contact : node to segment, or mortar
    basis : of the multipliers of mortar contact

    Raises
    ------
    InputError
        When the form is none of these, no slave node faces its master, or nothing
        balances the load of some body.

    """
    if form not in FORMS:
        raise InputError(f"form {form!r}; expected one of {', '.join(FORMS)}")
    rows = linearisation(bodies, contact, basis)(np.zeros(bodies.mesh.dofs))
    check_balance(bodies, rows.B)
    primal = primal_qp(bodies, rows)

    def results(s: Solution) -> Mapping[str, Any]:
        return quantities(bodies, primal, s)

    return contact_case(
        bodies, primal, form,
        floating=lambda: floating(bodies), clamped=lambda: clamped(bodies),
        supported=lambda: supported(bodies), quantities=results,
    )  # fmt: skip
