"""A user's own bodies: ``bodies:PATH.toml/key=value/…/FORM``.

The TOML file is described in `problems.models.description`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from harness import QP, Case, InputError, Reference, Value
from harness.checked import located
from problems.contact.balance import check_balance
from problems.contact.bodies import Bodies, clamped, floating, supported
from problems.contact.linearise import linearisation
from problems.contact.results import quantities
from problems.duality.case_forms import contact_case
from problems.duality.stepping import LoadPath, primal_qp
from problems.fem.inverse import GeneralisedInverse
from problems.models.description import described_bodies, remarks


def load_step(form: str, params: Mapping[str, Value], reference: Reference) -> Case:
    """Emit the QP of one load step in one form."""
    p: Any = params
    source = (p["path"], p["sha256"], p["plane"])
    bodies = model(*source)
    primal = _primal(source, p, reference)
    case = contact_case(
        bodies, primal, form,
        floating=lambda: _floating(*source), clamped=lambda: _clamped(*source),
        supported=lambda: _supported(*source),
        quantities=lambda s: quantities(bodies, primal, s),
    )  # fmt: skip
    return replace(case, remarks=remarks(Path(p["path"])))


def _primal(source: tuple[str, str, Any], p: Any, reference: Reference) -> QP:
    """Linearise the contact where the load path is; at first, that is u = 0."""
    bodies = model(*source)
    if p["step"] == p["relin"] == 1:  # bodies that only contact holds have no path
        linearise = linearisation(bodies, p["contact"], p["basis"])
        rows = linearise(np.zeros(bodies.mesh.dofs))
        with located(source[0]):
            check_balance(bodies, rows.B)
        return primal_qp(bodies, rows, 1 / p["steps"])
    path = _path(source, p["contact"], p["basis"], p["steps"], p["relin"], reference)
    return path.primal(p["step"])


@lru_cache(maxsize=4)
def model(path: str, sha256: str, plane: Any) -> Bodies:
    """Assemble the bodies of a description; the digest tells contents apart."""
    del sha256
    return described_bodies(Path(path), plane)


@lru_cache(maxsize=4)
def _floating(*source: Any) -> GeneralisedInverse:
    return floating(model(*source))


@lru_cache(maxsize=4)
def _clamped(*source: Any) -> GeneralisedInverse:
    return clamped(model(*source))


@lru_cache(maxsize=4)
def _supported(*source: Any) -> GeneralisedInverse:
    return supported(model(*source))


@lru_cache(maxsize=4)
def _path(
    source: tuple[str, str, Any], contact: str, basis: str, steps: int, relin: int,
    reference: Reference,
) -> LoadPath:  # fmt: skip
    bodies = model(*source)
    try:
        inverse = _clamped(*source)
    except InputError:
        raise InputError(
            f"{source[0]}: the supports leave a rigid motion of some body, which load "
            "steps and re-linearisations do not allow; expected steps=1 and relin=1"
        ) from None
    linearise = linearisation(bodies, contact, basis)
    return LoadPath(bodies, linearise, inverse, reference, steps, relin)
