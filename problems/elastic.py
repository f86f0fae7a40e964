"""Building blocks of elastic families in plug-ins; the names in `__all__` are stable.

Mesh the bodies, `join` them, `assemble` them with supports, load and contact pairs, and
obtain the QP from `one_step`. Lengths are in m, moduli and tractions in Pa, forces in N
per m of thickness.

For example, one steel block is pressed onto another::

    lower = prefixed(rectangle((0.0, 0.0), (1.0, 0.5), (6, 3)), "lower_")
    upper = prefixed(rectangle((0.0, 0.5), (1.0, 0.5), (4, 2)), "upper_")
    mesh, body = join((lower, upper))
    side, load = mesh.boundaries, np.zeros(mesh.dofs)
    top = side["upper_top"]
    load[dofs_of(top, 2, 1)] = -1e6 * nodal_lengths(mesh.points[top])
    left = np.concatenate([side["lower_left"], side["upper_left"]])
    bodies = assemble(
        mesh, body, names=("lower", "upper"), materials=(Material(210e9, 0.3),) * 2,
        plane="strain", units=(1.0, 1e6),
        fixed=np.append(dofs_of(left, 2, 0), dofs_of(side["lower_bottom"], 2, 1)),
        load=load, pairs=(ContactPair(side["upper_bottom"], side["lower_top"]),),
    )
    case = one_step(bodies, "dual")
"""

from __future__ import annotations

from dataclasses import replace
from typing import Literal

import numpy as np
from scipy.sparse import vstack

from mortarbench.harness import QP, Case, InputError, Reference, Solution
from mortarbench.problems.contact.balance import check_balance
from mortarbench.problems.contact.bodies import (
    Bodies,
    ContactPair,
    Shape,
    assemble,
)
from mortarbench.problems.contact.friction import FrictionLaw
from mortarbench.problems.contact.linearise import linearisation
from mortarbench.problems.contact.stepping import load_steps
from mortarbench.problems.duality.case_forms import FORMS, case_of
from mortarbench.problems.duality.problem import (
    Choice,
    ContactProblem,
    keyed_linearisation,
)
from mortarbench.problems.fem.elasticity import Material
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
from mortarbench.problems.fem.mesh_files.named import NamedMesh
from mortarbench.problems.fem.mesh_files.reading import read_msh
from mortarbench.problems.feti.subdomains import GLUE

__all__ = [
    "Bodies",
    "ContactPair",
    "FrictionLaw",
    "Material",
    "Mesh",
    "NamedMesh",
    "assemble",
    "dofs_of",
    "half_disc",
    "half_ring",
    "join",
    "nodal_lengths",
    "one_step",
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
    glue: Literal["orthonormal", "redundant"] = "orthonormal",
) -> Case:
    """Return the case of `bodies` under their full load, linearised at u = 0.

    Parameters
    ----------
    form : "primal", "dual" or, if the supports fix every body, "dual-bounds"
    contact : "nts" (node to segment) or "mortar"
    basis : basis of the multipliers of mortar contact
    friction : friction law of every contact pair. Either FrictionLaw("tresca",
        bound=1e6), with the bound in Pa, or FrictionLaw("coulomb", mu=0.3), whose QP is
        the last fixed-point iterate
    reference : function that solves a QP, as in `Family.build`; required by Coulomb's
        law
    parts : total number of subdomains (Total FETI), for form "dual" only; 0 for no
        decomposition
    glue : type of the constraint rows that join the copies of nodes of several
        subdomains

    Raises
    ------
    InputError
        If the form is unknown, no slave node faces the master side, the load of a body
        cannot be balanced, Coulomb's law has no `reference`, the fixed-point iteration
        does not converge, or `parts` or `glue` is invalid.

    """
    if form not in FORMS:
        raise InputError(f"form {form!r}; expected {' or '.join(map(repr, FORMS))}")
    if glue not in GLUE:
        raise InputError(f"glue {glue!r}; expected {' or '.join(map(repr, GLUE))}")
    if parts and form != "dual":
        raise InputError(
            f"parts with form {form} is not built; expected form dual, or parts=0"
        )
    law = FrictionLaw() if friction is None else friction
    if law.mu and reference is None:
        raise InputError(
            "friction coulomb needs a reference solver; expected the argument "
            "`reference` of `Family.build`"
        )
    laws = (law,) * len(bodies.pairs)
    # without grids, `parts` is the number of subdomains for structured bodies as well
    bodies = replace(bodies, shape=Shape(bodies.mesh, bodies.body))
    rows = linearisation(bodies, contact, basis, laws)(np.zeros(bodies.mesh.dofs))
    # the friction force of a tangential row can act in both directions
    check_balance(bodies, vstack([rows.B, rows.T, -rows.T]))
    problem = ContactProblem(
        bodies=bodies,
        linearise=keyed_linearisation(contact, basis),
        stages=load_steps(1, 1, bodies.f, bodies.fixed, laws),
        # the first friction bound of Coulomb's law must be large enough for friction to
        # support bodies that nothing else supports
        initial_force=float(np.abs(bodies.f).sum()),
    )
    choice = Choice(size=parts, glue=glue)
    return case_of(problem, form, choice, reference or _no_reference)


def _no_reference(qp: QP) -> Solution:
    """Raise AssertionError; placeholder for a reference solver that is never called."""
    raise AssertionError("no reference solve was given")
