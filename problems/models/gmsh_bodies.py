"""A user's own bodies: ``bodies:PATH.toml/key=value/…/FORM``.

The TOML file is described in `problems.models.description`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from functools import lru_cache, partial
from pathlib import Path
from typing import Any

import numpy as np
from scipy.sparse import vstack
from sksparse.cholmod import CholmodNotPositiveDefiniteError

from mortarbench.harness import QP, Case, Friction, InputError, Reference, Value
from mortarbench.harness.checked import located
from mortarbench.problems.contact.balance import check_balance, check_friction
from mortarbench.problems.contact.bodies import (
    Bodies,
    assembled,
    clamped,
    floating,
    supported,
)
from mortarbench.problems.contact.friction import FrictionLaw, friction_of
from mortarbench.problems.contact.linearise import linearisation
from mortarbench.problems.contact.results import quantities
from mortarbench.problems.duality.case_forms import contact_case
from mortarbench.problems.duality.newton import NewtonPath
from mortarbench.problems.duality.newton_case import newton_case, newton_path
from mortarbench.problems.duality.stepping import LoadPath, single_load
from mortarbench.problems.fem.inverse import GeneralisedInverse
from mortarbench.problems.feti.elastic import (
    Displaced,
    SubdividedBodies,
    in_parts,
    linearised_by,
    load_path,
    subdivide,
    torn,
)
from mortarbench.problems.feti.emission import ProblemInParts
from mortarbench.problems.feti.own_bodies import holds_all
from mortarbench.problems.feti.partition import graph_partition
from mortarbench.problems.feti.subdivision import mesh_in_parts
from mortarbench.problems.models.description import (
    described_bodies,
    pair_laws,
    read_description,
    remarks,
)

STRAIGHT = 1e-6  #: angle between edges of a straight side, which coordinates round
ARC = np.pi / 4  #: between chords of an arc, at most; larger angles are drawn corners


def load_step(form: str, params: Mapping[str, Value], reference: Reference) -> Case:
    """Emit the QP of one load step in one form.

    Raises
    ------
    InputError
        Also where rounding leaves the stiffness without a Cholesky factor.

    """
    try:
        return _load_step(form, params, reference)
    except (np.linalg.LinAlgError, CholmodNotPositiveDefiniteError):
        raise InputError(
            f"{params['path']}: the stiffness has no Cholesky factor in double "
            "precision; expected cells whose sides, and bodies whose E, differ by less"
        ) from None


def _load_step(form: str, params: Mapping[str, Value], reference: Reference) -> Case:
    p: Any = params
    source = (p["path"], p["sha256"], p["plane"], p["halvings"])
    bodies = model(*source)
    if p["kinematics"] == "finite":
        return _finite(form, source, p, reference)
    if p["parts"] and form != "dual":
        raise InputError(
            f"parts with form {form} is not built; expected form dual, or no parts"
        )
    primal, friction = _posed(source, p, reference)
    pieces = None
    if p["parts"]:
        with located(source[0]):
            parts = _subdivided(source, p["parts"])
        pieces = partial(torn, parts, primal, friction, p["glue"])
    case = contact_case(
        bodies, primal, form, torn=pieces,
        floating=lambda: _floating(*source), clamped=lambda: _clamped(*source),
        supported=lambda: _supported(*source),
        quantities=lambda s: quantities(bodies, primal, s, friction),
        friction=friction,
    )  # fmt: skip
    return replace(case, remarks=remarks(Path(p["path"])))


def _finite(
    form: str, source: tuple[str, str, Any, int], p: Any, reference: Reference
) -> Case:
    """Emit the QP of one Newton iteration of one load step."""
    laws = laws_of(p)
    with located(source[0]):
        if any(law.acts for law in laws):
            raise InputError(
                "friction of a contact with kinematics=finite is not built; expected "
                "no friction, or kinematics=linear"
            )
        path = _newton_path(
            source, (p["contact"], p["basis"]), p["steps"], p["material"],
            p["contact_stiffness"], reference,
        )  # fmt: skip
        case = newton_case(path, form, p["step"], p["newton"])
    return replace(case, remarks=remarks(Path(source[0])))


def _posed(
    source: tuple[str, str, Any, int], p: Any, reference: Reference
) -> tuple[QP, Friction]:
    """Linearise the contact where the load path is; at first, that is u = 0."""
    laws = laws_of(p)
    method = (p["contact"], p["basis"])
    if p["step"] == p["relin"] == 1:  # bodies that only contact holds have no path
        bodies = model(*source)
        linearise = linearisation(bodies, *method, laws)
        rows = linearise(np.zeros(bodies.mesh.dofs))
        with located(source[0]):  # friction may hold either way
            check_balance(bodies, vstack([rows.B, rows.T, -rows.T]))
            return single_load(
                bodies, linearise, laws,
                factorise=lambda: _floating(*source), reference=reference,
                steps=p["steps"], iterate=p["iterate"],
            )  # fmt: skip
    quasi_static = p["loading"] == "quasi-static"
    path = _path(source, method, p["steps"], p["relin"], laws, quasi_static, reference)
    problem = path.problem(p["step"], p["iterate"])
    return problem.primal, problem.friction


def in_subdomains(params: Mapping[str, Value]) -> ProblemInParts:
    """Describe a load step in parts, and before it the first one and those between.

    The mesh is read and cut as a whole.
    """
    p: Any = params
    bodies, laws = (
        described_bodies(Path(p["path"]), p["plane"], p["halvings"]),
        laws_of(params),
    )
    mesh, method = bodies.mesh, (p["contact"], p["basis"])
    with located(p["path"]):
        if p["step"] == p["relin"] == 1:  # bodies that only contact holds have no path
            at_rest = np.zeros(mesh.dofs)
            rows = linearisation(bodies, *method, laws)(at_rest)
            check_balance(bodies, vstack([rows.B, rows.T, -rows.T]))
            if not any(law.mu for law in laws):
                unpressed = np.zeros(sum(pair.slave.size for pair in bodies.pairs))
                friction = friction_of(bodies, rows, laws, at_rest, unpressed)
                check_friction(bodies, rows.B, friction, 1, 1 / p["steps"])
        label = graph_partition(mesh.points, mesh.cells, bodies.body, p["parts"])
    fixed, loaded = bodies.B_D.indices, np.flatnonzero(bodies.f)
    named = np.concatenate([fixed, bodies.interface]) // mesh.dim
    layout, pairs = mesh_in_parts(mesh, label, bodies.body, named), bodies.pairs

    def posed(step: int, displaced: Displaced) -> ProblemInParts:
        force = bodies.f[loaded] * (bodies.force * (step / p["steps"]))
        return in_parts(
            layout, materials=bodies.materials, plane=bodies.plane,
            units=(bodies.length, bodies.force), names=bodies.names, fixed=fixed,
            load=(loaded, force), pairs=pairs, linearise=linearised_by(*method, laws),
            laws=laws, glue=p["glue"], displaced=displaced, step=step,
            iterate=p["iterate"],
        )  # fmt: skip

    steps = np.repeat(np.arange(1, p["step"] + 1), p["relin"]).tolist()
    is_single = len(steps) == 1  # as of `single_load`, friction may hold bodies then
    problem = load_path(
        posed, pairs, steps, quasi_static=p["loading"] == "quasi-static",
        pressed=float(np.abs(bodies.f).sum()) if is_single else 0.0,
    )  # fmt: skip
    if not is_single and not holds_all(problem):
        raise _unsupported(p["path"])
    return problem


def laws_of(params: Mapping[str, Value]) -> tuple[FrictionLaw, ...]:
    """Find the law of each pair, see `pair_laws`."""
    return pair_laws(read_description(Path(str(params["path"])))["contacts"], params)


@lru_cache(maxsize=4)
def model(path: str, sha256: str, plane: Any, halvings: int) -> Bodies:
    """Assemble the bodies of a description; the digest tells contents apart."""
    del sha256
    return assembled(described_bodies(Path(path), plane, halvings))


def has_arcs(params: Mapping[str, Value]) -> bool:
    """Return True if a side that may touch has edges that meet at less than ARC."""
    p: Any = params
    bodies = model(p["path"], p["sha256"], p["plane"], p["halvings"])
    for side in (chain for pair in bodies.pairs for chain in pair):
        edges = np.diff(bodies.mesh.points[side], axis=0)
        angles = np.unwrap(np.arctan2(edges[:, 1], edges[:, 0]))
        turns = np.abs(np.diff(angles))
        if ((turns > STRAIGHT) & (turns < ARC)).any():
            return True
    return False


@lru_cache(maxsize=4)
def _subdivided(source: tuple[str, str, Any, int], parts: int) -> SubdividedBodies:
    bodies = model(*source)
    label = graph_partition(bodies.mesh.points, bodies.mesh.cells, bodies.body, parts)
    return subdivide(bodies, label)


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
    source: tuple[str, str, Any, int], method: tuple[str, str], steps: int, relin: int,
    laws: tuple[FrictionLaw, ...], quasi_static: bool, reference: Reference,
) -> LoadPath:  # fmt: skip
    bodies = model(*source)
    try:
        inverse = _clamped(*source)
    except InputError:
        raise _unsupported(source[0]) from None
    return LoadPath(
        bodies, linearisation(bodies, *method, laws), lambda: inverse, reference, steps,
        relin, laws=laws, quasi_static=quasi_static,
    )  # fmt: skip


def _unsupported(path: str) -> InputError:
    return InputError(
        f"{path}: the supports leave a rigid motion of some body, which load "
        "steps and re-linearisations do not allow; expected steps=1 and relin=1"
    )


@lru_cache(maxsize=4)
def _newton_path(
    source: tuple[str, str, Any, int], method: tuple[str, str], steps: int,
    material: str, contact_stiffness: str, reference: Reference,
) -> NewtonPath:  # fmt: skip
    bodies = model(*source)
    keys = {
        "material": material, "contact": method[0],
        "contact_stiffness": contact_stiffness,
    }  # fmt: skip
    return newton_path(bodies, linearisation(bodies, *method), keys, reference, steps)
