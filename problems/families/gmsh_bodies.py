"""A user's own bodies: ``bodies:PATH.toml/key=value/…/FORM``.

The TOML file is described in `problems.families.description`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np

from harness import QP, Case, Family, InputError, Reference, Value
from problems.contact.bodies import Bodies, clamped, floating, supported
from problems.contact.linearise import linearisation
from problems.contact.results import quantities
from problems.duality.case_forms import FORMS, contact_case
from problems.duality.stepping import LoadPath, primal_qp
from problems.families.description import (
    CHOICES,
    SETTINGS,
    described_bodies,
    read_description,
)
from problems.families.ranges import MOST_STEPS, at_least, at_most, one_of
from problems.fem.inverse import GeneralisedInverse
from problems.files.file_digest import check_digest, digest


@dataclass(frozen=True)
class GmshBodies(Family):
    """Bodies of the user: a mesh from gmsh, and a TOML with materials, loads, contacts.

    The digest of the content of both files is a parameter of the case, so that a
    changed file is not taken for the one that was measured.
    """

    name: str = "bodies"
    path_suffix: str = ".toml"
    defaults: Mapping[str, Value] = field(
        default_factory=lambda: MappingProxyType(
            {"path": "", "sha256": "", **SETTINGS, "step": 0}
        ),
        hash=False,
    )
    forms: tuple[str, ...] = FORMS

    def complete(self, given: Mapping[str, Value]) -> Mapping[str, Value]:
        """Fill in what the file says, its digest, and step, by default steps."""
        params: dict[str, Value] = {**self.defaults, **given}
        if params["path"]:
            path = Path(str(params["path"]))
            table = read_description(path)
            params = {
                **params,
                **{k: table[k] for k in SETTINGS if k in table},
                **given,
            }
            if "sha256" not in given:
                params["sha256"] = digest(path, path.parent / table["mesh"])
        return params if "step" in given else params | {"step": params["steps"]}

    def check(self, params: Mapping[str, Value]) -> None:
        """Raise InputError unless every key is in its range and the files are there."""
        p: Any = params
        if not p["path"]:
            raise InputError(f"{self.name}: path is missing; expected bodies:PATH.toml")
        at_least(1, self.name, params, ("steps", "step", "relin"))
        at_most(MOST_STEPS, self.name, params, ("steps", "relin"))
        if p["step"] > p["steps"]:
            raise InputError(
                f"{self.name}: step={p['step']} must be in 1..steps={p['steps']}"
            )
        one_of(self.name, params, CHOICES)
        path = Path(p["path"])
        mesh = path.parent / read_description(path)["mesh"]
        check_digest(p["path"], p["sha256"], digest(path, mesh))

    def build(
        self, form: str, params: Mapping[str, Value], reference: Reference
    ) -> Case:
        """Emit the QP of one load step in one form."""
        self.check(params)
        p: Any = params
        source = (p["path"], p["sha256"], p["plane"])
        bodies = model(*source)
        primal = _primal(source, p, reference)
        return contact_case(
            bodies, primal, form,
            floating=lambda: _floating(*source), clamped=lambda: _clamped(*source),
            supported=lambda: _supported(*source),
            quantities=lambda s: quantities(bodies, primal, s),
        )  # fmt: skip


def _primal(source: tuple[str, str, Any], p: Any, reference: Reference) -> QP:
    """Linearise the contact where the load path is; at first, that is u = 0."""
    bodies = model(*source)
    if p["step"] == p["relin"] == 1:  # bodies that only contact holds have no path
        linearise = linearisation(bodies, p["contact"], p["basis"])
        rows = linearise(np.zeros(bodies.mesh.dofs))
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
