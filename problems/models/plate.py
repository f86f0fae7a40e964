"""An elastic plate in rectangular subdomains: a linear problem for studies of FETI.

A plate of `width` × `height` is clamped at its left edge and pulled down by 1 MN per m
of thickness. It consists of Sx × Sy subdomains of n × ny cells of steel. In some
subdomains, the modulus is multiplied by `jump`: in every other subdomain
(``checkerboard``) or in the subdomains at the clamped edge (``column``). There is no
contact; therefore, the dual has equality constraints only. Condition numbers of the
dual measure the scalability of the method independently of load, stopping criterion and
units.

The load acts at the upper right corner (``point``), as a constant traction on the right
edge (``edge``), or in equal parts on the nodes of that edge (``nodal``).

Supports are rows of B as in the other decomposed problems (Total FETI), or they are
``eliminated``. In the latter case, subdomains at the clamped edge do not float, as in
FETI-1 (Farhat and Roux 1991).

In 3D (dim=3) the plate is a box of Sx × Sy × Sz subdomains with n cells along z. It
is clamped at x = 0 and pulled along −z by 1 MN on the face at the largest x, or
at its corner of largest y and z (``point``).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import cache, lru_cache, partial
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array, eye_array

from mortarbench.harness import (
    QP,
    Case,
    Fields,
    Grid,
    Mechanics,
    Solution,
    Value,
    Vector,
    no_rows,
)
from mortarbench.harness.mechanics import DecomposedMechanics
from mortarbench.problems.contact.stepping import Forces
from mortarbench.problems.duality.decomposed import elastic_class
from mortarbench.problems.duality.dualisation import Transformed, primal_form
from mortarbench.problems.duality.feti_dual import (
    decomposition_quantities,
    digest_of,
    feti_dual,
    feti_matrices,
)
from mortarbench.problems.duality.problem import StructuredGrids, StructuredSolids
from mortarbench.problems.fem.elasticity import (
    Material,
    Plane,
    elasticity_matrix,
    rigid_modes,
    stiffness,
)
from mortarbench.problems.fem.inverse import GeneralisedInverse, regular_inverse
from mortarbench.problems.fem.mesh import (
    Mesh,
    Nodes,
    as_vectors,
    box,
    dofs_of,
    nodal_areas,
    nodal_lengths,
    nodes_of_side,
    rectangle_grid,
)
from mortarbench.problems.fem.stress import centre_stress, recover, von_mises
from mortarbench.problems.feti.mechanics import torn_mechanics
from mortarbench.problems.feti.served import Served
from mortarbench.problems.feti.spectrum import Spectrum, spectra
from mortarbench.problems.feti.structured import grids_in_blocks
from mortarbench.problems.feti.subdivision import Subdivision
from mortarbench.problems.feti.subdomains import (
    Contact,
    DecomposedProblem,
    TornBodies,
)
from mortarbench.problems.feti.tearing import blocks

LENGTH = 1.0  #: l, unit of length, m
LOAD = 1e6  #: F₀, the load: N/m in 2D, N in 3D
STEEL = Material(E=210e9, nu=0.3)
#: mapping from the name of a spectrum to its preconditioner and scaling; None means no
#: preconditioner
PRECONDITIONERS: Mapping[str, tuple[str, str] | None] = {
    "none": None,
    "lumped": ("lumped", "multiplicity"),
    "dirichlet": ("dirichlet", "multiplicity"),
    "dirichlet_stiffness": ("dirichlet", "stiffness"),
}


def clamped_plate(form: str, params: Mapping[str, Value]) -> Case:
    """Return the case in the form `form`."""
    if form == "dual":
        served = Served(TornBodies(in_subdomains(params)))
        return decomposed_case(params, served)
    plate = model(tuple(params.items()))
    return _case(plate, primal_form(plate.primal))


def decomposed_case(params: Mapping[str, Value], served: Served) -> Case:
    """Return the case of the dual in subdomains on rank 0."""
    plate = model(tuple(params.items()))
    new = feti_dual(served, plate.primal)
    case = _case(plate, new, torn_mechanics(served, plate.primal.P))
    conditions = cache(
        lambda: dual_quantities(plate.moduli, new.qp, served.torn.rows.B)
    )
    sizes = decomposition_quantities(served, new.qp)
    return replace(
        case,
        digest=digest_of(served, served.torn),
        quantities=lambda s: {**case.quantities(s), **conditions(), **sizes},
        matrices=feti_matrices(served, new.qp),
    )


def _case(
    plate: Plate,
    new: Transformed,
    subdomains: Callable[[], DecomposedMechanics] | None = None,
) -> Case:
    mesh = plate.mesh
    return Case(
        qp=new.qp,
        recover=lambda s: new.recover(s).x * LENGTH,
        quantities=lambda s: quantities(plate, new.recover(s)),
        fields=lambda s: Fields(
            points=mesh.points,
            cells=mesh.cells,
            bodies=plate.material,
            displacement=as_vectors(new.recover(s).x * LENGTH, mesh.dim),
            nodal={"von_mises": plate.von_mises(new.recover(s).x * LENGTH)},
        ),
        scale=new.sign * LOAD * LENGTH,
        constant=new.constant * LOAD * LENGTH,
        mechanics=Mechanics(
            primal=plate.primal,
            to_primal=new.recover,
            factorise=plate.factorise,
            mesh_size=(plate.volume / len(mesh.cells)) ** (1 / mesh.dim) / LENGTH,
            rigid=rigid_modes(mesh.points),
            names=("plate",),
            scale=LOAD * LENGTH,
            grid=Grid(
                mesh.points, mesh.cells, np.zeros(len(mesh.cells), dtype=np.int64)
            ),
            subdomains=subdomains,
        ),
    )


@dataclass(frozen=True, eq=False, kw_only=True)
class Plate:
    """Plate for one set of keys; K, f and moduli are in units of l and F₀."""

    volume: float  #: width × height in m² (2D), or volume in m³ (3D)
    mesh: Mesh
    subdomain: NDArray[np.int64]  #: (E,) subdomain of each cell
    material: NDArray[np.int64]  #: (E,) material of each cell, an index into `moduli`
    moduli: Vector  #: (k,) moduli of the materials, the modulus of steel first
    plane: Plane | None  #: plane state; None in 3D
    D: NDArray[np.float64]  #: (k, v, v) elasticity matrices of the materials
    primal: QP

    @property
    def clamped(self) -> NDArray[np.int64]:
        """Displacement components at the clamped edge."""
        return _clamped(self.mesh.boundaries, self.mesh.dim)

    def von_mises(self, u: Vector) -> Vector:
        """Recover the von Mises stress (N,) at the nodes in Pa from u in m.

        A node between two materials has one value, although the stress jumps there.
        """
        D = self.D[self.material] * (LOAD / LENGTH)
        stress = recover(self.mesh, centre_stress(self.mesh, D, u))
        return von_mises(stress, STEEL.nu, self.plane)

    def factorise(self) -> GeneralisedInverse:
        """Factorise K without the prescribed components."""
        free = np.setdiff1d(np.arange(self.mesh.dofs), self.clamped)
        return regular_inverse(self.primal.P, free)


@lru_cache(maxsize=4)
def model(params: tuple[tuple[str, Value], ...]) -> Plate:
    """Mesh and assemble the undivided plate; `params` must contain all keys."""
    p: Any = dict(params)
    parts, shape = in_subdomains(p), _shape(p)
    mesh, subdomain = shape.mesh, parts.layout.label
    material = np.asarray(parts.material[subdomain], dtype=np.int64)
    moduli, D = _stiffness(p)
    n = mesh.dofs
    one = csr_array(eye_array(n, format="csr"))
    clamped = _clamped(mesh.boundaries, mesh.dim)
    primal = QP(
        P=stiffness(mesh, D, material),
        q=-parts.load,
        A=one[clamped],
        b=np.zeros(clamped.size),
        G=no_rows(n),
        h=np.zeros(0),
        lb=np.full(n, -np.inf),
        ub=np.full(n, np.inf),
    )
    return Plate(
        volume=float(np.prod(_size(p))),
        mesh=mesh,
        subdomain=subdomain,
        material=material,
        moduli=moduli,
        plane=_plane(p),
        D=D,
        primal=primal,
    )


def in_subdomains(params: Mapping[str, Value]) -> DecomposedProblem:
    """Return the decomposed problem for `params`, which must contain all keys."""
    p: Any = params
    shape, (moduli, D) = _shape(p), _stiffness(p)
    layout = _layout(shape, _side(p))
    # the plate is treated as a contact problem without contact rows
    none = np.zeros(0)
    return DecomposedProblem(
        layout=layout,
        components=shape.dim,
        E=moduli[:1],
        names=("plate",),
        glue=p["glue"],
        material=_material(p),
        assemble_class=partial(elastic_class, D=D, E=moduli),
        load=_pull(layout, shape.sides["right"], p["load"]).on(shape.mesh.dofs),
        fixed=_clamped(shape.sides, shape.dim),
        eliminated=p["supports"] == "eliminated",
        contact=Contact(no_rows(shape.dim * layout.nodes), none, none),
    )


def _counts(p: Mapping[str, Any]) -> tuple[int, ...]:
    """Return the numbers of subdomains along the axes."""
    return (p["Sx"], p["Sy"], p["Sz"])[: p["dim"]]


def _size(p: Mapping[str, Any]) -> tuple[float, ...]:
    """Return the lengths of the plate along the axes, m."""
    lengths = p["width"] or p["Sx"], p["height"] or p["Sy"], p["Sz"]
    return tuple(map(float, lengths[: p["dim"]]))


def _side(p: Mapping[str, Any]) -> tuple[int, ...]:
    """Return the numbers of cells per subdomain along the axes."""
    return (p["n"], p["ny"] or p["n"], p["n"])[: p["dim"]]


def _divisions(p: Mapping[str, Any]) -> tuple[int, ...]:
    """Return the numbers of cells along the axes."""
    return tuple(n * S for n, S in zip(_side(p), _counts(p), strict=True))


def _shape(p: Mapping[str, Any]) -> StructuredGrids | StructuredSolids:
    size, divisions = _size(p), _divisions(p)
    if p["dim"] == 3:
        x, y, z = divisions
        return StructuredSolids((box((0.0,) * 3, size, divisions),), ((x, y, z),))
    (width, height), (nx, ny) = size, divisions
    return StructuredGrids((rectangle_grid((0.0, 0.0), (width, height), (nx, ny)),))


def _layout(
    shape: StructuredGrids | StructuredSolids, side: tuple[int, ...]
) -> Subdivision:
    """Cut the plate into subdomains of `side` cells along the axes."""
    if isinstance(shape, StructuredGrids):
        return grids_in_blocks(shape.parts, side, shape.joined)
    return Subdivision(shape.mesh, blocks(shape.divisions[0], side), shape.body)


def _material(p: Mapping[str, Any]) -> NDArray[np.int64]:
    """Return the material of each subdomain, (S,)."""
    counts = _counts(p)[::-1]
    place = np.array(np.unravel_index(np.arange(np.prod(counts)), counts))
    patterns: dict[str, NDArray[np.int64]] = {
        "uniform": np.zeros_like(place[0]),
        "checkerboard": place.sum(axis=0) % 2,
        "column": (place[-1] == 0).astype(np.int64),
    }
    return patterns[p["pattern"]]


def _stiffness(p: Mapping[str, Any]) -> tuple[Vector, NDArray[np.float64]]:
    """Return non-dimensional moduli (2,) and elasticity matrices (2, v, v)."""
    moduli = np.array([1.0, p["jump"]]) * STEEL.E * LENGTH / LOAD
    materials = [Material(E, STEEL.nu) for E in moduli]
    return moduli, np.stack([elasticity_matrix(m, _plane(p)) for m in materials])


def _plane(p: Mapping[str, Any]) -> Plane | None:
    """Return the plane state; None in 3D."""
    return p["plane"] if p["dim"] == 2 else None


def _clamped(sides: Mapping[str, Nodes], dim: int) -> Nodes:
    """Return the displacement components of the nodes on the clamped side."""
    return dofs_of(nodes_of_side(sides["left"]), dim)


def _pull(layout: Subdivision, side: Nodes, kind: str) -> Forces:
    """Return the load, distributed over a side according to the key `load`."""
    nodes = nodes_of_side(side)
    points = layout.mesh.points[nodes]
    dim = points.shape[1]
    if kind == "point":
        share = (nodes == nodes.max()).astype(float)
    elif kind == "nodal":
        share = np.ones(nodes.size)
    elif dim == 3:
        share = nodal_areas(points, np.searchsorted(nodes, side))[1]
    else:
        share = nodal_lengths(points)
    return Forces(dofs_of(nodes, dim, dim - 1), -share / share.sum())


def _tip(nodes: int, dim: int) -> Nodes:
    """Return the components of the last node, the corner of largest coordinates."""
    return dofs_of(np.array([nodes - 1]), dim)


def quantities(plate: Plate, s: Solution) -> dict[str, Any]:
    """Return counts, the energy in J/m, and the tip displacement in m.

    The tip is the upper right corner. In 3D, the energy is in J, and the tip is the
    corner with the largest x, y and z.
    """
    mesh = plate.mesh
    tip = _tip(len(mesh.points), mesh.dim)
    return {
        "nodes": len(mesh.points),
        "elements": len(mesh.cells),
        "dofs": mesh.dofs,
        "equality_rows": plate.primal.b.size,
        "energy": plate.primal.objective(s.x) * LOAD * LENGTH,
        "tip": (s.x[tip] * LENGTH).tolist(),
    }


def dual_quantities(moduli: Vector, qp: QP, B: csr_array) -> dict[str, Any]:
    """Return ‖PFP‖ and condition numbers with error bounds.

    P is the projector onto the kernel of the equality rows. `norm_PFP` is ‖PFP‖ for
    E = 1, because all rows are scaled by √E; `kappa` is κ(PFP). `kappa_lumped` and
    `kappa_dirichlet` are κ with the preconditioner of that name and scaling by
    multiplicity, `kappa_dirichlet_stiffness` with scaling by stiffness. Keys that end
    in `_error` contain error bounds.

    moduli : (2,) moduli of the materials
    qp : dual with the rows B of supports and gluing
    """
    names = dict(PRECONDITIONERS)
    uniform = moduli[0] == moduli[1]  # both scalings are then equal
    if uniform:
        del names["dirichlet_stiffness"]
    found = dict(zip(names, spectra(qp, B, list(names.values())), strict=True))
    if uniform:
        found["dirichlet_stiffness"] = found["dirichlet"]
    return conditions(found)


def conditions(spectra: Mapping[str, Spectrum]) -> dict[str, Any]:
    """Return the quantities of `dual_quantities` from the spectra by name."""
    values: dict[str, Any] = {
        "norm_PFP": spectra["none"].largest,
        "norm_PFP_error": spectra["none"].largest_error,
    }
    for name, spectrum in spectra.items():
        key = "kappa" if name == "none" else f"kappa_{name}"
        values |= {key: spectrum.condition, f"{key}_error": spectrum.condition_error}
    return values
