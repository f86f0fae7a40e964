"""A user's own bodies: ``bodies:PATH.toml/key=value/…/FORM``.

The TOML file is described in `problems.models.description`.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from scipy.sparse import vstack

from mortarbench.harness import Case, InputError, Reference, Value
from mortarbench.harness.checked import located
from mortarbench.problems.contact.balance import check_balance
from mortarbench.problems.contact.friction import FrictionLaw
from mortarbench.problems.contact.linearise import linearisation
from mortarbench.problems.contact.stepping import load_steps
from mortarbench.problems.duality.newton import NewtonPath
from mortarbench.problems.duality.newton_case import newton_case, newton_path
from mortarbench.problems.duality.problem import (
    ContactProblem,
    ElasticBodies,
    cached_problem,
    elastic_bodies_of,
    keyed_linearisation,
)
from mortarbench.problems.models.description import (
    described_bodies,
    pair_laws,
    read_description,
)

STRAIGHT = 1e-6  #: angle between edges of a straight side, which coordinates round
ARC = np.pi / 4  #: between chords of an arc, at most; larger angles are drawn corners


def problem(params: Mapping[str, Value]) -> ContactProblem:
    """State the bodies; their load grows in `steps`.

    Raises
    ------
    InputError
        Where nothing balances the load of some body, or bodies that contact alone holds
        are asked for after the first linearisation.

    """
    p: Any = params
    found = _problem(params)
    if not found.bodies.is_supported and not p["step"] == p["relin"] == 1:
        raise InputError(
            f"{p['path']}: the supports leave a rigid motion of some body, which load "
            "steps and re-linearisations do not allow; expected steps=1 and relin=1"
        )
    return found


@cached_problem
def _problem(params: Mapping[str, Value]) -> ContactProblem:
    p: Any = params
    of, laws = bodies(p["path"], p["sha256"], p["plane"], p["halvings"]), laws_of(p)
    is_single = p["steps"] == p["relin"] == 1 or not of.is_supported
    if not of.is_supported:
        rows = keyed_linearisation(p)(of.whole, laws)(np.zeros(of.whole.mesh.dofs))
        with located(p["path"]):  # friction may hold either way
            check_balance(of.whole, vstack([rows.B, rows.T, -rows.T]))
    return ContactProblem(
        bodies=of, linearise=keyed_linearisation(p),
        stages=load_steps(
            p["steps"], p["relin"], of.forces, of.fixed, laws,
            quasi_static=p["loading"] == "quasi-static",
        ),
        # friction may have to hold bodies
        initial_force=float(np.abs(of.forces.value).sum()) if is_single else 0.0,
    )  # fmt: skip


def newton_step(form: str, params: Mapping[str, Value], reference: Reference) -> Case:
    """Emit the QP of one Newton iteration of one load step at finite strain."""
    p: Any = params
    source = (p["path"], p["sha256"], p["plane"], p["halvings"])
    with located(source[0]):
        if any(law.acts for law in laws_of(p)):
            raise InputError(
                "friction of a contact with kinematics=finite is not built; expected "
                "no friction, or kinematics=linear"
            )
        path = _newton_path(
            source, (p["contact"], p["basis"]), p["steps"], p["material"],
            p["contact_stiffness"], reference,
        )  # fmt: skip
        return newton_case(path, form, p["step"], p["newton"])


def laws_of(params: Mapping[str, Value]) -> tuple[FrictionLaw, ...]:
    """Find the law of each pair, see `pair_laws`."""
    return pair_laws(read_description(Path(str(params["path"])))["contacts"], params)


@lru_cache(maxsize=4)
def bodies(path: str, sha256: str, plane: Any, halvings: int) -> ElasticBodies:
    """State the bodies of a description; the digest tells contents apart."""
    del sha256
    return elastic_bodies_of(described_bodies(Path(path), plane, halvings))


def has_arcs(params: Mapping[str, Value]) -> bool:
    """Return True if a side that may touch has edges that meet at less than ARC."""
    p: Any = params
    of = bodies(p["path"], p["sha256"], p["plane"], p["halvings"])
    for side in (chain for pair in of.pairs for chain in pair):
        edges = np.diff(of.shape.mesh.points[side], axis=0)
        angles = np.unwrap(np.arctan2(edges[:, 1], edges[:, 0]))
        turns = np.abs(np.diff(angles))
        if ((turns > STRAIGHT) & (turns < ARC)).any():
            return True
    return False


@lru_cache(maxsize=4)
def _newton_path(
    source: tuple[str, str, Any, int], method: tuple[str, str], steps: int,
    material: str, contact_stiffness: str, reference: Reference,
) -> NewtonPath:  # fmt: skip
    whole = bodies(*source).assembled
    keys = {
        "material": material, "contact": method[0],
        "contact_stiffness": contact_stiffness,
    }  # fmt: skip
    return newton_path(whole, linearisation(whole, *method), keys, reference, steps)
