"""An elastic plate in rectangular subdomains: a linear problem to study FETI.

A plate of `width` × `height` is clamped at its left edge and pulled down by 1 MN per m
of thickness. It consists of Sx × Sy subdomains of n × ny cells of steel. In some of
them, the modulus is larger by the factor `jump`: in every other one (``checkerboard``)
or in those at the clamped edge (``column``). There is no contact, so that the dual has
equations only. Its condition numbers measure the scalability of the method
independently of load, stopping test and units.

The load acts at the upper right corner (``point``), as a constant traction on the right
edge (``edge``), or in equal parts on the nodes of that edge (``nodal``).

Supports are rows of B as in all families (Total FETI), or ``eliminated``: subdomains at
the clamped edge then do not float, as in FETI-1 (Farhat and Roux 1991).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property, lru_cache, partial
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
from mortarbench.problems.contact.stepping import Forces
from mortarbench.problems.duality.decomposed import elastic_class, force_lookup
from mortarbench.problems.duality.dualisation import Transformed, primal_form
from mortarbench.problems.duality.feti_dual import (
    decomposition_quantities,
    feti_dual,
    feti_matrices,
)
from mortarbench.problems.fem.elasticity import (
    Material,
    elasticity_matrix,
    rigid_modes,
    stiffness,
)
from mortarbench.problems.fem.inverse import GeneralisedInverse, regular_inverse
from mortarbench.problems.fem.mesh import (
    Mesh,
    Nodes,
    StructuredGrid,
    as_vectors,
    dofs_of,
    nodal_lengths,
    rectangle_grid,
)
from mortarbench.problems.feti.distributed_dual import LocalDual
from mortarbench.problems.feti.local_bodies import LocalSolution, Results, certifier
from mortarbench.problems.feti.spectrum import (
    Spectrum,
    spectra_over_ranks,
)
from mortarbench.problems.feti.structured import Layout
from mortarbench.problems.feti.subdomain_classes import DecomposedBodies
from mortarbench.problems.feti.subdomains import (
    Contact,
    DecomposedProblem,
    LocalSubdomains,
    on_one_process,
)
from mortarbench.problems.feti.tearing import blocks

LENGTH = 1.0  #: l, unit of length, m
LOAD = 1e6  #: F₀, the load, N/m
STEEL = Material(E=210e9, nu=0.3)
#: preconditioner and scaling by the name of the spectrum; None: no preconditioner
PRECONDITIONERS: Mapping[str, tuple[str, str] | None] = {
    "none": None,
    "lumped": ("lumped", "multiplicity"),
    "dirichlet": ("dirichlet", "multiplicity"),
    "dirichlet_stiffness": ("dirichlet", "stiffness"),
}


def clamped_plate(form: str, params: Mapping[str, Value]) -> Case:
    """Return the QP in one form."""
    plate = model(tuple(params.items()))
    mesh = plate.mesh
    new = plate.dual if form == "dual" else primal_form(plate.primal)

    def results(s: Solution) -> Mapping[str, Any]:
        counts = quantities(plate, new.recover(s))
        return counts | (dual_quantities(plate) if form == "dual" else {})

    return Case(
        qp=new.qp,
        recover=lambda s: new.recover(s).x * LENGTH,
        quantities=results,
        fields=lambda s: Fields(
            points=mesh.points, cells=mesh.cells, bodies=plate.material,
            displacement=as_vectors(new.recover(s).x * LENGTH, mesh.dim),
        ),
        scale=new.sign * LOAD * LENGTH,
        constant=new.constant * LOAD * LENGTH,
        matrices=feti_matrices(plate.torn, new.qp) if form == "dual" else {},
        mechanics=Mechanics(
            primal=plate.primal, to_primal=new.recover, factorise=plate.factorise,
            mesh_size=float(np.sqrt(np.prod(plate.size) / len(mesh.cells)) / LENGTH),
            rigid=rigid_modes(mesh.points), names=("plate",),
            scale=LOAD * LENGTH, grid=Grid(
                mesh.points, mesh.cells, np.zeros(len(mesh.cells), dtype=np.int64),
                np.zeros(mesh.dofs),
            ),
            certify_by_subdomains=(
                certifier(plate.own, plate.primal.P) if form == "dual" else None
            ),
        ),
    )  # fmt: skip


@dataclass(frozen=True, eq=False, kw_only=True)
class Plate:
    """Plate of one set of keys; K, f and moduli are non-dimensional, by l and F₀."""

    size: tuple[float, float]  #: width and height, m
    mesh: Mesh
    subdomain: NDArray[np.int64]  #: (E,) subdomain of each cell
    material: NDArray[np.int64]  #: (E,) material of each cell, an index into `moduli`
    moduli: Vector  #: (k,) moduli of the materials, that of steel first
    D: NDArray[np.float64]  #: (k, 3, 3) elasticity matrices of the materials
    primal: QP
    parts: DecomposedProblem

    @cached_property
    def own(self) -> LocalSubdomains:
        """All subdomains of the plate, on this process."""
        return on_one_process(self.parts)

    @property
    def torn(self) -> DecomposedBodies:
        """Assembled subdomains of the plate."""
        return self.own.decomposed

    @cached_property
    def dual(self) -> Transformed:
        """Dual of the decomposed plate."""
        return feti_dual(self.torn, self.primal)

    @cached_property
    def spectra(self) -> Mapping[str, Spectrum]:
        """Spectra of F on the kernel of its equations, by preconditioner."""
        return _spectra(self.moduli, LocalDual(self.own))

    @property
    def clamped(self) -> NDArray[np.int64]:
        """Displacement components at the clamped edge."""
        return dofs_of(self.mesh.boundaries["left"], 2)

    def factorise(self) -> GeneralisedInverse:
        """Factorise K without the prescribed components."""
        free = np.setdiff1d(np.arange(self.mesh.dofs), self.clamped)
        return regular_inverse(self.primal.P, free)


def _spectra(moduli: Vector, dual: LocalDual) -> Mapping[str, Spectrum]:
    """Compute the spectra by the names of `PRECONDITIONERS`; collective over ranks."""
    qp = dual.share().qp
    names = dict(PRECONDITIONERS)
    uniform = moduli[0] == moduli[1]  # then both scalings are the same
    if uniform:
        del names["dirichlet_stiffness"]
    per_name = spectra_over_ranks(qp.P, qp.A, list(names.values()))
    spectra = dict(zip(names, per_name, strict=True))
    return spectra | ({"dirichlet_stiffness": spectra["dirichlet"]} if uniform else {})


@lru_cache(maxsize=4)
def model(params: tuple[tuple[str, Value], ...]) -> Plate:
    """Mesh and assemble the plate of complete keys as one body."""
    p: Any = dict(params)
    grid, side = _grid(p), _side(p)
    mesh = grid.mesh()
    subdomain = blocks(grid.divisions, side)
    material = _material(p, subdomain % p["Sx"], subdomain // p["Sx"])
    moduli, D = _stiffness(p)
    n = mesh.dofs
    one = csr_array(eye_array(n, format="csr"))
    clamped = dofs_of(mesh.boundaries["left"], 2)
    primal = QP(
        P=stiffness(mesh, D, material), q=-load(grid, p["load"]),
        A=one[clamped], b=np.zeros(clamped.size), G=no_rows(n), h=np.zeros(0),
        lb=np.full(n, -np.inf), ub=np.full(n, np.inf),
    )  # fmt: skip
    return Plate(
        size=_size(p), mesh=mesh, subdomain=subdomain, material=material, moduli=moduli,
        D=D, primal=primal, parts=in_subdomains(p),
    )  # fmt: skip


def in_subdomains(params: Mapping[str, Value]) -> DecomposedProblem:
    """Return the decomposed problem of complete keys."""
    p: Any = params
    grid, (moduli, D) = _grid(p), _stiffness(p)
    layout = Layout.of((grid,), _side(p))
    column, row = (x.astype(np.int64) for x in layout.block[1:])
    # no contact rows, but the interface of problems with contact
    none = np.zeros(0)
    return DecomposedProblem(
        layout=layout, components=2, E=moduli[:1], names=("plate",), glue=p["glue"],
        cluster=p["cluster"],
        material=_material(p, column, row),
        assemble_class=partial(elastic_class, D=D, E=moduli),
        load=force_lookup(Forces(*_pull(grid, p["load"]))),
        fixed=dofs_of(grid.sides["left"], 2),
        eliminated=p["supports"] == "eliminated",
        contact=Contact(no_rows(2 * grid.nodes), none, none),
    )  # fmt: skip


def results(params: Mapping[str, Value], dual: LocalDual) -> Results:
    """Return the function that evaluates `quantities` on ranks."""
    return partial(_rank_quantities, _grid(params), _stiffness(params)[0], dual)


def _rank_quantities(
    grid: StructuredGrid, moduli: Vector, dual: LocalDual, answer: LocalSolution
) -> dict[str, Any]:
    """Return `quantities` and condition numbers from all ranks; collective."""
    own = answer.subdomains
    tip = dofs_of(np.intersect1d(grid.sides["top"], grid.sides["right"]), 2)
    values = {
        "nodes": grid.nodes,
        "elements": int(np.prod(grid.divisions)),
        "dofs": 2 * grid.nodes,
        "equality_rows": own.problem.fixed.size,
        "energy": answer.energy * LOAD * LENGTH,
        "tip": (answer.at(tip) * LENGTH).tolist(),
    }
    return values | conditions(_spectra(moduli, dual))


def _size(p: Mapping[str, Any]) -> tuple[float, float]:
    return p["width"] or float(p["Sx"]), p["height"] or float(p["Sy"])


def _side(p: Mapping[str, Any]) -> tuple[int, int]:
    """Return the numbers of cells along the sides of a subdomain."""
    return p["n"], p["ny"] or p["n"]


def _grid(p: Mapping[str, Any]) -> StructuredGrid:
    n, ny = _side(p)
    return rectangle_grid((0.0, 0.0), _size(p), (n * p["Sx"], ny * p["Sy"]))


def _material(
    p: Mapping[str, Any], column: NDArray[np.int64], row: NDArray[np.int64]
) -> NDArray[np.int64]:
    """Return the materials of subdomains by their columns and rows."""
    patterns: dict[str, NDArray[np.int64]] = {
        "uniform": np.zeros_like(column),
        "checkerboard": (column + row) % 2,
        "column": (column == 0).astype(np.int64),
    }
    return patterns[p["pattern"]]


def _stiffness(p: Mapping[str, Any]) -> tuple[Vector, NDArray[np.float64]]:
    """Return non-dimensional moduli (2,) and elasticity matrices (2, 3, 3)."""
    moduli = np.array([1.0, p["jump"]]) * STEEL.E * LENGTH / LOAD
    materials = [Material(E, STEEL.nu) for E in moduli]
    return moduli, np.stack([elasticity_matrix(m, p["plane"]) for m in materials])


def load(grid: StructuredGrid, kind: str) -> Vector:
    """Return the non-dimensional nodal forces (2N,) of the load F₀."""
    component, force = _pull(grid, kind)
    f = np.zeros(2 * grid.nodes)
    f[component] = force
    return f


def _pull(grid: StructuredGrid, kind: str) -> tuple[Nodes, Vector]:
    """Return the loaded components and their forces."""
    right = grid.sides["right"]
    share = {
        "point": (right == np.intersect1d(right, grid.sides["top"])).astype(float),
        "edge": nodal_lengths(grid.side("right")),
        "nodal": np.ones(right.size),
    }[kind]
    return dofs_of(right, 2, 1), -share / share.sum()


def quantities(plate: Plate, s: Solution) -> dict[str, Any]:
    """Return counts, energy, J/m, and the tip [u_x, u_y] (upper right corner), m."""
    mesh = plate.mesh
    tip = dofs_of(np.intersect1d(mesh.boundaries["top"], mesh.boundaries["right"]), 2)
    return {
        "nodes": len(mesh.points),
        "elements": len(mesh.cells),
        "dofs": mesh.dofs,
        "equality_rows": plate.primal.b.size,
        "energy": plate.primal.objective(s.x) * LOAD * LENGTH,
        "tip": (s.x[tip] * LENGTH).tolist(),
    }


def dual_quantities(plate: Plate) -> dict[str, Any]:
    """Return the decomposition, ‖PFP‖, and condition numbers with error bounds.

    norm_PFP: ‖PFP‖ for E = 1, as all rows are scaled by √E. kappa: κ(PFP).
    kappa_lumped, kappa_dirichlet: with these preconditioners, scaled by multiplicity.
    kappa_dirichlet_stiffness: scaled by stiffness. Each has an `…_error`.
    """
    return conditions(plate.spectra) | decomposition_quantities(
        plate.torn, plate.dual.qp
    )


def conditions(spectra: Mapping[str, Spectrum]) -> dict[str, Any]:
    """Return ‖PFP‖ and condition numbers, see `dual_quantities`."""
    values: dict[str, Any] = {
        "norm_PFP": spectra["none"].largest,
        "norm_PFP_error": spectra["none"].largest_error,
    }
    for name, spectrum in spectra.items():
        key = "kappa" if name == "none" else f"kappa_{name}"
        values |= {key: spectrum.condition, f"{key}_error": spectrum.condition_error}
    return values
