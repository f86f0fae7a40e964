"""User-defined bodies, ``bodies:PATH.toml/key=value/…/FORM``.

For the TOML file, see `problems.families.description`.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Annotated, Any, ClassVar

import numpy as np
from numpy.linalg import LinAlgError
from scipy.sparse import vstack
from sksparse.cholmod import CholmodNotPositiveDefiniteError

from mortarbench.harness import Case, InputError, Reference
from mortarbench.harness.checked import located
from mortarbench.harness.files.datafile import content_digest
from mortarbench.harness.keys import DERIVED, Range, keys_of
from mortarbench.harness.mechanics import boundary_facets, cell_blocks
from mortarbench.problems.contact.balance import check_balance, is_determined
from mortarbench.problems.contact.bodies import Bodies, UnassembledBodies
from mortarbench.problems.contact.friction import FrictionLaw
from mortarbench.problems.contact.rows import ContactRows, without_fixed
from mortarbench.problems.contact.sides import pair_names
from mortarbench.problems.contact.stepping import load_steps, with_normal_forces
from mortarbench.problems.duality.problem import (
    ContactProblem,
    keyed_linearisation,
)
from mortarbench.problems.families.contact import ContactFamily
from mortarbench.problems.families.description import (
    SETTINGS,
    pair_laws,
    read_bodies,
    read_description,
    remarks,
)
from mortarbench.problems.fem.elasticity import NEARLY_INCOMPRESSIBLE
from mortarbench.problems.fem.mesh import (
    Mesh,
    Nodes,
    adjacent_cells,
    facet_quadrature,
)
from mortarbench.problems.fem.mesh_files.named import place
from mortarbench.problems.files.file_digest import check_digest
from mortarbench.problems.keys import (
    CONTACT_FORMS,
    PLANE_ONLY,
    Basis,
    Bound,
    ContactStiffness,
    Glue,
    Kinematics,
    Law,
    Loading,
    MaterialLaw,
    Method,
    Mu,
    Newton,
    PlaneState,
    Step,
    Steps,
    check_decomposition,
    check_friction,
    refuse_unbuilt,
)

#: largest overlap of contact sides that causes no remark, relative to the extent of the
#: smallest body. The chords of touching arcs overlap by up to 5R/n² with n edges per
#: circle, which is 0.4 % of R for n = 36
MAX_OVERLAP = 0.01
#: largest distance of two nodes at the same place, relative to the extent of the mesh
COINCIDENCE = 1e-9
#: smallest cosine of the angle between the normals of adjacent contact faces; a right
#: angle, as at the edges of a box, is admissible
MIN_COSINE = -0.5


@dataclass(frozen=True, kw_only=True)
class MeshedBodies(ContactFamily):
    """User-defined bodies: a mesh file, and a TOML file with materials and contacts.

    The digest of both files is a key of the case, so that changed files define a
    different case.
    """

    forms: ClassVar = CONTACT_FORMS
    path_suffix: ClassVar = ".toml"

    path: Annotated[str, "path of the TOML file"] = ""
    sha256: Annotated[str, "digest of the TOML file and the mesh"] = DERIVED
    contact: Method = DERIVED
    basis: Basis = DERIVED
    plane: PlaneState = DERIVED
    steps: Steps = DERIVED
    friction: Law = DERIVED
    bound: Bound = DERIVED
    mu: Mu = DERIVED
    loading: Loading = DERIVED
    kinematics: Kinematics = DERIVED
    material: MaterialLaw = DERIVED
    contact_stiffness: ContactStiffness = DERIVED
    step: Step = DERIVED
    newton: Newton = 0
    parts: Annotated[int, Range(0), "number of subdomains; 0: undivided bodies"] = 0
    glue: Glue = "orthonormal"

    def __post_init__(self) -> None:
        """Read settings from the TOML file; check all keys and the digest."""
        if not self.path:
            return  # the family of the registry, which has no file
        path, keys = Path(self.path), keys_of(type(self))
        table = read_description(path)
        with located(self.path):
            given = {k: keys[k].typed(table[k]) for k in SETTINGS if k in table}
            for key, value in given.items():
                keys[key].check(value)
        self.derive(**{**SETTINGS, **given})
        digest = content_digest(path, path.parent / table["mesh"])
        self.derive(step=self.steps, sha256=digest)
        super().__post_init__()
        check_decomposition(self, "parts", "the number of subdomains")
        check_digest(self.path, self.sha256, digest)

    def check_laws(self) -> None:
        """Check the friction keys together with the laws of individual pairs."""
        contacts = read_description(Path(self.path))["contacts"]
        own = any({"friction", "bound", "mu"} & entry.keys() for entry in contacts)
        check_friction(self, elsewhere=own)
        with located(self.path):
            pair_laws(contacts, self.params)

    def laws(self) -> tuple[FrictionLaw, ...]:
        """Return the friction law of each pair, see `pair_laws`."""
        contacts = read_description(Path(self.path))["contacts"]
        return pair_laws(contacts, self.params)

    def bodies(self) -> UnassembledBodies:
        """Return the bodies; in 3D, no key may have a value for plane bodies."""
        bodies = _bodies(self.path, self.sha256, self.plane)
        if bodies.mesh.dim > 2:
            refuse_unbuilt(self, PLANE_ONLY, "volumes", "a plane problem")
        return bodies

    def rows(self) -> ContactRows:
        """Return the contact rows of the undeformed bodies."""
        whole = self.bodies()
        linearise = keyed_linearisation(self.contact, self.basis)
        return linearise(whole, self.laws())(np.zeros(whole.mesh.dofs))

    def contact_problem(self) -> ContactProblem:
        """Return the problem.

        Raises
        ------
        InputError
            If `step` is above 1 although supports and friction allow a rigid motion.

        """
        problem = super().contact_problem()
        if self.step == 1 or problem.bodies.is_supported:
            return problem
        # if a rigid motion along frictionless contact is possible, the displacements,
        # and hence the next linearisation, are not unique
        rows = self.rows()
        if not is_determined(problem.bodies, vstack([rows.B, rows.T])):
            raise InputError(
                f"{self.path}: supports and friction allow a rigid motion of some "
                "body, which is not supported with several load steps; expected "
                "steps=1"
            )
        return problem

    def problem(self) -> ContactProblem:
        """Return the problem of the bodies, loaded in `steps` equal load steps.

        Raises
        ------
        InputError
            If nothing stresses the bodies, supports move both sides of a contact into
            each other, or the load of a body cannot be balanced.

        """
        whole, laws, rows = self.bodies(), self.laws(), self.rows()
        overlap = -float(rows.c.min(initial=0.0))
        if not whole.f.any() and whole.lift is None and not overlap:
            raise InputError(
                f"{self.path}: nothing stresses the bodies; expected a load, gravity, "
                "a displacement, or contact sides that overlap (a press fit)"
            )
        if whole.lift is not None:
            kept = without_fixed(rows, whole.fixed).place
            depth = (rows.B @ whole.lift * whole.length - rows.c)[
                ~np.isin(rows.place, kept)
            ]
            if depth.max(initial=0.0) > COINCIDENCE * whole.length:
                raise InputError(
                    f"{self.path}: supports move both sides of a contact "
                    f"{depth.max():.3g} m into each other; expected displacements that "
                    "leave a side free"
                )
        stages = load_steps(
            self.steps,
            1,
            whole.f,
            whole.fixed,
            laws,
            quasi_static=self.loading == "quasi-static",
        )
        whole_load = float(np.abs(whole.f).sum()) or 1.0
        if not whole.is_supported:
            # the friction force of a tangential row can act in both directions
            with located(self.path):
                check_balance(whole, vstack([rows.B, rows.T, -rows.T]))
            stages = tuple(
                replace(stage, begin=with_normal_forces(stage.begin, whole_load))
                for stage in stages
            )
        return ContactProblem(
            bodies=whole,
            linearise=keyed_linearisation(self.contact, self.basis),
            stages=stages,
            # the first friction bound of Coulomb's law must be large enough for
            # friction to support bodies that nothing else supports
            initial_force=whole_load if self.steps == 1 else 0.0,
        )

    def finite_bodies(self) -> Bodies:
        """Return the assembled bodies; refuse what finite strain does not support."""
        elastic = self.bodies()
        unbuilt = {
            "friction": any(law.acts for law in self.laws()),
            "prescribed displacements": elastic.lift is not None,
            "springs": elastic.springs is not None,
            "bodies with common nodes": elastic.piece is not None,
            "rigid bodies": any(pair.rigid is not None for pair in elastic.pairs),
        }
        if what := [name for name, is_used in unbuilt.items() if is_used]:
            raise InputError(
                f"{self.path}: kinematics=finite with {' and '.join(what)} is not "
                "built; expected kinematics=linear"
            )
        return elastic.assembled

    def build(self, form: str, reference: Reference) -> Case:
        """Return the case of one load step in the form `form`.

        Raises
        ------
        InputError
            If a file is invalid, or if the Cholesky factorisation fails because of
            rounding.

        """
        try:
            case = super().build(form, reference)
        except (LinAlgError, CholmodNotPositiveDefiniteError):
            raise InputError(
                f"{self.path}: the stiffness has no Cholesky factor in double "
                "precision; expected smaller ratios between the sides of cells and "
                "between the moduli E"
            ) from None
        notes = (
            *remarks(Path(self.path)),
            *mesh_remarks(self),
            *contact_remarks(self),
        )
        return replace(case, remarks=notes)


def contact_remarks(family: MeshedBodies) -> tuple[str, ...]:
    """Return remarks on the contact rows of the undeformed bodies.

    Remarks concern slave nodes inside their master before any load acts, except for
    overlaps of up to `MAX_OVERLAP` times the extent of the smallest body, and rows that
    are dropped because they have no free component.
    """
    whole = family.bodies()
    mesh, found = whole.mesh, []
    rows = family.rows()
    depth = -float(rows.c.min(initial=0.0))
    size = min(
        float(np.ptp(mesh.points[mesh.cells[whole.body == b].ravel()], axis=0).max())
        for b in range(len(whole.names))
    )
    if depth > MAX_OVERLAP * size and whole.f.any():  # without loads: a press fit
        found.append(
            f"{family.path}: before any load acts, a slave node lies {depth:.3g} m "
            "inside its master (or behind the plane of its edge): check length_unit "
            "and the positions of the bodies, unless a press fit is meant"
        )
    kept = without_fixed(rows, whole.fixed).place
    first = np.cumsum([0, *(pair.slave_nodes.size for pair in whole.pairs)])
    before, after = (np.histogram(place, first)[0] for place in (rows.place, kept))
    found += [
        f"{family.path}: contact {name}: {a - b} of {a} contact rows were dropped, "
        "because supports fix all components of these rows, and therefore carry any "
        "force there"
        for name, a, b in zip(pair_names(whole), before, after, strict=True)
        if b < a
    ]
    return tuple(found)


def mesh_remarks(family: MeshedBodies) -> tuple[str, ...]:
    """Return remarks on cracks, folded contact faces, and cells that are too stiff."""
    from scipy.spatial import KDTree  # takes 0.1 s

    whole = family.bodies()
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
            and family.plane != "stress"
            and kinds & {"triangle", "tetra"}
        ):
            remarks.append(
                f"{whole.names[b]!r} has linear triangles or tetrahedra, which are too "
                f"stiff for nu = {material.nu:g}; use quadrilaterals or hexahedra"
            )
    return tuple(f"{family.path}: {remark}" for remark in remarks)


def _fold(mesh: Mesh, faces: Nodes) -> Nodes | None:
    """Return the nodes of an edge at which faces fold, or of a folded face, or None."""
    areas = facet_quadrature(mesh.points, faces)[1]
    normal = areas.sum(axis=0) / np.linalg.norm(areas.sum(axis=0), axis=1)[:, None]
    if (bad := (np.einsum("qkx,kx->qk", areas, normal) <= 0).any(axis=0)).any():
        return np.asarray(faces[bad.argmax()])
    one, other, edges = adjacent_cells(faces, 2)
    turned = np.einsum("kx,kx->k", normal[one], normal[other]) < MIN_COSINE
    return edges[turned.argmax()] if turned.any() else None


@lru_cache(maxsize=4)
def _bodies(path: str, sha256: str, plane: Any) -> UnassembledBodies:
    """Return the bodies of a TOML file; `sha256` only distinguishes cached results."""
    del sha256
    return read_bodies(Path(path), plane)
