"""What an elastic family of one's own is made of: the list that plug-ins may rely on.

Mesh the bodies, `join` them, `assemble` their supports, load and contact pairs, and let
`one_step` emit the QP: docs/plugins.md has a whole family. All lengths are in m, moduli
and tractions in Pa, forces in N per m of thickness.
"""

from __future__ import annotations

from typing import Literal

import numpy as np
from scipy.sparse import vstack

from mortarbench.harness import QP, Case, InputError, Reference, Solution
from mortarbench.problems.contact.balance import check_balance
from mortarbench.problems.contact.bodies import (
    Bodies,
    ContactPair,
    assemble,
)
from mortarbench.problems.contact.friction import FrictionLaw
from mortarbench.problems.contact.linearise import linearisation
from mortarbench.problems.contact.stepping import load_steps
from mortarbench.problems.duality.case_forms import FORMS, case_of
from mortarbench.problems.duality.problem import (
    Choice,
    ContactProblem,
    elastic_bodies_of,
    keyed_linearisation,
)
from mortarbench.problems.fem.elasticity import Material
from mortarbench.problems.fem.gmsh_mesh import NamedMesh, read_msh
from mortarbench.problems.fem.mesh import (
    Mesh,
    dofs_of,
    half_disc,
    half_ring,
    join,
    nodal_lengths,
    prefixed,
    rectangle,
)
from mortarbench.problems.ranges import (
    GLUES,
    LAWS,
    NEEDED,
    at_least,
    at_most,
    one_of,
    physical,
    positive,
)

__all__ = [
    "Bodies",
    "ContactPair",
    "FrictionLaw",
    "Material",
    "Mesh",
    "NamedMesh",
    "assemble",
    "at_least",
    "at_most",
    "dofs_of",
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
    friction: FrictionLaw | None = None,
    reference: Reference | None = None,
    parts: int = 0,
    glue: Literal["orthonormal", "chain", "redundant"] = "orthonormal",
) -> Case:
    """Emit the QP of bodies under their full load, contact linearised where they lie.

    Parameters
    ----------
    form : "primal", "dual" or, where supports alone hold every body, "dual-bounds"
    contact : node to segment, or mortar
    basis : of the multipliers of mortar contact
    friction : between the sides of every pair: FrictionLaw("tresca", bound=1e6), in Pa,
        or FrictionLaw("coulomb", mu=0.3), the last of its fixed point
    reference : what `Family.build` is given; Coulomb's law needs its solutions
    parts : subdomains of all bodies together, for "dual" alone: Total FETI; 0: none
    glue : the rows that hold copies of a node together

    Raises
    ------
    InputError
        When the form is none of these, no slave node faces its master, nothing balances
        the load of some body, the law of friction is unknown or its value negative, the
        fixed point does not settle, or the bodies have no such parts or no such glue.

    """
    if form not in FORMS:
        raise InputError(f"form {form!r}; expected one of {', '.join(FORMS)}")
    GLUES["glue"].check("one_step", "glue", {"glue": glue})
    if parts and form != "dual":
        raise InputError(
            f"parts with form {form} is not built; expected form dual, or parts=0"
        )
    law = FrictionLaw() if friction is None else _checked(friction, reference)
    laws = (law,) * len(bodies.pairs)
    of = elastic_bodies_of(bodies)
    rows = linearisation(bodies, contact, basis, laws)(np.zeros(bodies.mesh.dofs))
    check_balance(bodies, vstack([rows.B, rows.T, -rows.T]))  # it may hold either way
    problem = ContactProblem(
        bodies=of, linearise=keyed_linearisation({"contact": contact, "basis": basis}),
        stages=load_steps(1, 1, of.forces, of.fixed, laws),
        # friction may have to hold bodies
        initial_force=float(np.abs(of.forces.value).sum()),
    )  # fmt: skip
    choice = Choice(size=parts, glue=glue)
    return case_of(problem, form, choice, reference or _no_reference)


def _checked(law: FrictionLaw, reference: Reference | None) -> FrictionLaw:
    """Raise InputError for a law that is none, or that lacks what it needs."""
    if law.kind not in LAWS:
        raise InputError(
            f"friction {law.kind!r} is unknown; expected one of {', '.join(LAWS)}"
        )
    if key := LAWS[law.kind]:
        value = physical(f"friction {law.kind}: {key}", getattr(law, key))
        if value < 0:
            raise InputError(
                f"friction {law.kind}: {key} = {value:g}; expected {NEEDED[key]}"
            )
    if law.mu and reference is None:
        raise InputError(
            "friction coulomb needs solutions; expected reference=, as build is given"
        )
    return law


def _no_reference(qp: QP) -> Solution:
    """Stand for the reference solve where nothing is to be solved."""
    raise AssertionError("no reference solve was given")
