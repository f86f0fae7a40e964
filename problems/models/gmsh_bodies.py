"""User-defined bodies, ``bodies:PATH.toml/key=value/…/FORM``.

For the TOML file, see `problems.models.description`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from scipy.sparse import vstack
from scipy.spatial import KDTree

from mortarbench.harness import Case, InputError, Reference, Value
from mortarbench.harness.checked import located
from mortarbench.harness.mechanics import boundary_facets, cell_blocks
from mortarbench.problems.contact.balance import check_balance, is_determined
from mortarbench.problems.contact.friction import FrictionLaw
from mortarbench.problems.contact.linearise import linearisation
from mortarbench.problems.contact.rows import without_fixed
from mortarbench.problems.contact.sides import pair_names
from mortarbench.problems.contact.stepping import load_steps, with_normal_forces
from mortarbench.problems.duality.newton import NewtonPath
from mortarbench.problems.duality.newton_case import newton_case, newton_path
from mortarbench.problems.duality.problem import (
    ContactProblem,
    ElasticBodies,
    cached_problem,
    elastic_bodies_of,
    keyed_linearisation,
)
from mortarbench.problems.fem.elasticity import NEARLY_INCOMPRESSIBLE
from mortarbench.problems.fem.mesh import (
    Mesh,
    Nodes,
    adjacent_cells,
    facet_quadrature,
)
from mortarbench.problems.fem.mesh_files.named import place
from mortarbench.problems.models.description import (
    pair_laws,
    read_bodies,
    read_description,
)
from mortarbench.problems.ranges import check_plane_only

#: largest overlap of contact sides that causes no remark, relative to the extent of the
#: smallest body. The chords of touching arcs overlap by up to 5R/n² with n edges per
#: circle, which is 0.4 % of R for n = 36
MAX_OVERLAP = 0.01
#: largest distance of two nodes at the same place, relative to the extent of the mesh
COINCIDENCE = 1e-9
#: smallest cosine of the angle between the normals of adjacent contact faces; a right
#: angle, as at the edges of a box, is admissible
MIN_COSINE = -0.5


def problem(params: Mapping[str, Value]) -> ContactProblem:
    """Return the problem of the bodies, loaded in `steps` equal load steps.

    Raises
    ------
    InputError
        If the load of a body cannot be balanced, or if `step` or `relin` is above 1
        although supports and friction allow a rigid motion.

    """
    p: Any = params
    contact_problem = _problem(params)
    elastic = contact_problem.bodies
    if p["step"] == p["relin"] == 1 or elastic.is_supported:
        return contact_problem
    whole = elastic.whole
    rows = keyed_linearisation(p)(whole, laws_of(p))(np.zeros(whole.mesh.dofs))
    # if a rigid motion along frictionless contact is possible, the displacements, and
    # hence the next linearisation, are not unique
    if not is_determined(whole, vstack([rows.B, rows.T])):
        raise InputError(
            f"{p['path']}: supports and friction allow a rigid motion of some body, "
            "which is not supported with several load steps or linearisations; "
            "expected steps=1 and relin=1"
        )
    return contact_problem


@cached_problem
def _problem(params: Mapping[str, Value]) -> ContactProblem:
    p: Any = params
    elastic = bodies(p["path"], p["sha256"], p["plane"], p["halvings"])
    check_dimension(elastic, p)
    laws, whole = laws_of(p), elastic.whole
    if not whole.f.any() and whole.lift is None and not _overlap(p):
        raise InputError(
            f"{p['path']}: nothing stresses the bodies; expected a load, gravity, a "
            "displacement, or contact sides that overlap (a press fit)"
        )
    if whole.lift is not None:
        rows = keyed_linearisation(p)(whole, laws)(np.zeros(whole.mesh.dofs))
        kept = without_fixed(rows, elastic.fixed).place
        depth = (rows.B @ whole.lift * whole.length - rows.c)[
            ~np.isin(rows.place, kept)
        ]
        if depth.max(initial=0.0) > COINCIDENCE * whole.length:
            raise InputError(
                f"{p['path']}: supports move both sides of a contact {depth.max():.3g} "
                "m into each other; expected displacements that leave a side free"
            )
    stages = load_steps(
        p["steps"],
        p["relin"],
        elastic.forces,
        elastic.fixed,
        laws,
        quasi_static=p["loading"] == "quasi-static",
    )
    whole_load = float(np.abs(elastic.forces.value).sum()) or 1.0
    if not elastic.is_supported:
        rows = keyed_linearisation(p)(whole, laws)(np.zeros(whole.mesh.dofs))
        # the friction force of a tangential row can act in both directions
        with located(p["path"]):
            check_balance(whole, vstack([rows.B, rows.T, -rows.T]))
        stages = tuple(
            replace(stage, begin=with_normal_forces(stage.begin, whole_load))
            for stage in stages
        )
    return ContactProblem(
        bodies=elastic,
        linearise=keyed_linearisation(p),
        stages=stages,
        # the first friction bound of Coulomb's law must be large enough for friction to
        # support bodies that nothing else supports
        initial_force=whole_load if p["steps"] == p["relin"] == 1 else 0.0,
    )


def newton_step(form: str, params: Mapping[str, Value], reference: Reference) -> Case:
    """Return the case of one Newton iteration of a load step at finite strain."""
    p: Any = params
    source = (p["path"], p["sha256"], p["plane"], p["halvings"])
    with located(source[0]):
        if any(law.acts for law in laws_of(p)):
            raise InputError(
                "friction of a contact with kinematics=finite is not built; expected "
                "no friction, or kinematics=linear"
            )
        elastic = bodies(*source)
        check_dimension(elastic, p)
        built = {
            "prescribed displacements": elastic.lift is None,
            "springs": elastic.springs is None,
            "bodies with common nodes": elastic.piece is None,
        }
        for what, is_built in built.items():
            if not is_built:
                raise InputError(
                    f"{what} with kinematics=finite are not built; expected "
                    "kinematics=linear"
                )
        if any(pair.rigid is not None for pair in elastic.pairs):
            raise InputError(
                "contact with a rigid body and kinematics=finite is not built; "
                "expected a master, or kinematics=linear"
            )
        path = _newton_path(
            source,
            (p["contact"], p["basis"]),
            p["steps"],
            p["material"],
            p["contact_stiffness"],
            reference,
        )
        return newton_case(path, form, p["step"], p["newton"])


def check_dimension(elastic: ElasticBodies, params: Mapping[str, Value]) -> None:
    """Raise InputError if bodies are solids and a key has a value for plane bodies."""
    if elastic.shape.dim > 2:
        check_plane_only("bodies", params, "volumes")


def contact_remarks(params: Mapping[str, Value]) -> tuple[str, ...]:
    """Return remarks on the contact rows of the undeformed bodies.

    Remarks concern slave nodes inside their master before any load acts, except for
    overlaps of up to `MAX_OVERLAP` times the extent of the smallest body, and rows that
    are dropped because they have no free component.
    """
    p: Any = params
    whole = bodies(p["path"], p["sha256"], p["plane"], p["halvings"]).whole
    mesh, found = whole.mesh, []
    rows = keyed_linearisation(p)(whole, laws_of(p))(np.zeros(mesh.dofs))
    depth = -float(rows.c.min(initial=0.0))
    size = min(
        float(np.ptp(mesh.points[mesh.cells[whole.body == b].ravel()], axis=0).max())
        for b in range(len(whole.names))
    )
    if depth > MAX_OVERLAP * size and whole.f.any():  # without loads: a press fit
        found.append(
            f"{p['path']}: before any load acts, a slave node lies {depth:.3g} m "
            "inside its master (or behind the plane of its edge): check length_unit "
            "and the positions of the bodies, unless a press fit is meant"
        )
    kept = without_fixed(rows, whole.B_D.indices).place
    first = np.cumsum([0, *(pair.slave_nodes.size for pair in whole.pairs)])
    before, after = (np.histogram(place, first)[0] for place in (rows.place, kept))
    found += [
        f"{p['path']}: contact {name}: {a - b} of {a} contact rows were dropped, "
        "because supports fix all components of these rows, and therefore carry any "
        "force there"
        for name, a, b in zip(pair_names(whole), before, after, strict=True)
        if b < a
    ]
    return tuple(found)


def _overlap(params: Mapping[str, Value]) -> float:
    """Return the largest depth of a slave node inside its master before any load, m."""
    p: Any = params
    whole = bodies(p["path"], p["sha256"], p["plane"], p["halvings"]).whole
    rows = keyed_linearisation(p)(whole, laws_of(p))(np.zeros(whole.mesh.dofs))
    return -float(rows.c.min(initial=0.0))


def mesh_remarks(params: Mapping[str, Value]) -> tuple[str, ...]:
    """Return remarks on cracks, folded contact faces, and cells that are too stiff."""
    p: Any = params
    whole = bodies(p["path"], p["sha256"], p["plane"], p["halvings"]).whole
    mesh, remarks = whole.mesh, list[str]()
    nodes = np.unique(boundary_facets(mesh.cells, mesh.dim))
    tree = KDTree(mesh.points[nodes])
    reach = COINCIDENCE * float(np.ptp(mesh.points, axis=0).max())
    pairs = nodes[tree.query_pairs(reach, output_type="ndarray")]
    sides = np.concatenate([np.zeros(0, dtype=int), *(q.nodes for q in whole.pairs)])
    pairs = pairs[~np.isin(pairs, sides).all(axis=1)]  # faces of a crack in contact
    pairs = pairs[np.diff(whole.piece_of_node[pairs], axis=1)[:, 0] == 0]
    if len(pairs):
        remarks.append(
            f"{whole.names[whole.body_of_node[pairs[0, 0]]]!r} has {len(pairs)} pairs "
            "of nodes at the same place, for example at "
            f"{place(mesh.points[pairs[0]])} m: the cells are not joined there; merge "
            "these nodes, unless a crack is meant"
        )
    for side in {id(s): s for q in whole.pairs for s in q.sides if s.ndim > 1}.values():
        if len(side) and (fold := _fold(mesh, side)) is not None:
            remarks.append(
                f"a contact side is folded at {place(mesh.points[fold])} m, where "
                "contact is not reliable; expected faces that turn by less than 120° "
                "at their edges"
            )
    for b, material in enumerate(whole.materials):
        kinds = {
            part.kind for part in cell_blocks(mesh.cells[whole.body == b], mesh.dim)
        }
        if (
            material.nu > NEARLY_INCOMPRESSIBLE
            and p["plane"] != "stress"
            and kinds & {"triangle", "tetra"}
        ):
            remarks.append(
                f"{whole.names[b]!r} has linear triangles or tetrahedra, which are too "
                f"stiff for nu = {material.nu:g}; use quadrilaterals or hexahedra"
            )
    return tuple(f"{p['path']}: {remark}" for remark in remarks)


def _fold(mesh: Mesh, faces: Nodes) -> Nodes | None:
    """Return the nodes of an edge at which faces fold, or of a folded face, or None."""
    areas = facet_quadrature(mesh.points, faces)[1]
    normal = areas.sum(axis=0) / np.linalg.norm(areas.sum(axis=0), axis=1)[:, None]
    if (bad := (np.einsum("qkx,kx->qk", areas, normal) <= 0).any(axis=0)).any():
        return np.asarray(faces[bad.argmax()])
    one, other, edges = adjacent_cells(faces, 2)
    turned = np.einsum("kx,kx->k", normal[one], normal[other]) < MIN_COSINE
    return edges[turned.argmax()] if turned.any() else None


def laws_of(params: Mapping[str, Value]) -> tuple[FrictionLaw, ...]:
    """Return the friction law of each pair, see `pair_laws`."""
    return pair_laws(read_description(Path(str(params["path"])))["contacts"], params)


@lru_cache(maxsize=4)
def bodies(path: str, sha256: str, plane: Any, halvings: int) -> ElasticBodies:
    """Return the bodies of a TOML file; `sha256` only distinguishes cached results."""
    del sha256
    return elastic_bodies_of(read_bodies(Path(path), plane, halvings))


@lru_cache(maxsize=4)
def _newton_path(
    source: tuple[str, str, Any, int],
    method: tuple[str, str],
    steps: int,
    material: str,
    contact_stiffness: str,
    reference: Reference,
) -> NewtonPath:
    whole = bodies(*source).assembled
    keys = {
        "material": material,
        "contact": method[0],
        "contact_stiffness": contact_stiffness,
    }
    return newton_path(whole, linearisation(whole, *method), keys, reference, steps)
