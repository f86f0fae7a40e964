"""An elastic plate in square subdomains: a linear problem to measure FETI on.

A plate of `width` × `height` is held at its left edge and pulled down by 1 MN per m of
thickness. It consists of Sx × Sy subdomains of n × ny cells, of steel, with `jump`
times its modulus in some of them: every other one (``checkerboard``) or those at the
held edge (``column``). Nothing touches it, so that the dual has equations only, and its
condition numbers say how well the method scales, without load, stopping test or units.

The load acts at the upper right corner (``point``), as a constant traction on the right
edge (``edge``), or in equal parts on the nodes of that edge (``nodal``).

Supports are rows of B as everywhere (Total FETI), or ``eliminated``: then subdomains at
the held edge do not float, as in FETI-1 (Farhat and Roux 1991).
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

LENGTH = 1.0  #: l, m
LOAD = 1e6  #: F₀, N/m
STEEL = Material(E=210e9, nu=0.3)
#: preconditioner and scaling, by the names under which their spectra are reported
PRECONDITIONERS: Mapping[str, tuple[str, str] | None] = {
    "none": None,
    "lumped": ("lumped", "multiplicity"),
    "dirichlet": ("dirichlet", "multiplicity"),
    "dirichlet_stiffness": ("dirichlet", "stiffness"),
}


def clamped_plate(form: str, params: Mapping[str, Value]) -> Case:
    """Emit the QP in one form."""
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
    """The plate of one set of keys; K, f and moduli have no dimension, by l and F₀."""

    size: tuple[float, float]  #: width and height, m
    mesh: Mesh
    subdomain: NDArray[np.int64]  #: (E,) of each cell
    material: NDArray[np.int64]  #: (E,) of each cell, a place in `moduli`
    moduli: Vector  #: of the materials; the first is that of steel
    D: NDArray[np.float64]  #: (k, 3, 3) elasticity matrices of the materials
    primal: QP
    parts: DecomposedProblem

    @cached_property
    def own(self) -> LocalSubdomains:
        """The plate in its subdomains, all of them."""
        return on_one_process(self.parts)

    @property
    def torn(self) -> DecomposedBodies:
        """The same with what was made of them."""
        return self.own.decomposed

    @cached_property
    def dual(self) -> Transformed:
        """The dual of the torn plate."""
        return feti_dual(self.torn, self.primal)

    @cached_property
    def spectra(self) -> Mapping[str, Spectrum]:
        """Spectra of F on its equations, alone and with preconditioners."""
        return _spectra(self.moduli, LocalDual(self.own))

    @property
    def held(self) -> NDArray[np.int64]:
        """Components at the held edge."""
        return dofs_of(self.mesh.boundaries["left"], 2)

    def factorise(self) -> GeneralisedInverse:
        """Factorise K without the prescribed components."""
        free = np.setdiff1d(np.arange(self.mesh.dofs), self.held)
        return regular_inverse(self.primal.P, free)


def _spectra(moduli: Vector, dual: LocalDual) -> Mapping[str, Spectrum]:
    """Find the spectra by the names of `PRECONDITIONERS`; called by all ranks."""
    qp = dual.share().qp
    names = dict(PRECONDITIONERS)
    uniform = moduli[0] == moduli[1]  # so that both scalings are one
    if uniform:
        del names["dirichlet_stiffness"]
    found = spectra_over_ranks(qp.P, qp.A, list(names.values()))
    spectra = dict(zip(names, found, strict=True))
    return spectra | ({"dirichlet_stiffness": spectra["dirichlet"]} if uniform else {})


@lru_cache(maxsize=4)
def model(params: tuple[tuple[str, Value], ...]) -> Plate:
    """Mesh and assemble the plate of complete keys; it is one body."""
    p: Any = dict(params)
    grid, side = _grid(p), _side(p)
    mesh = grid.mesh()
    subdomain = blocks(grid.divisions, side)
    material = _material(p, subdomain % p["Sx"], subdomain // p["Sx"])
    moduli, D = _stiffness(p)
    n = mesh.dofs
    one = csr_array(eye_array(n, format="csr"))
    held = dofs_of(mesh.boundaries["left"], 2)
    primal = QP(
        P=stiffness(mesh, D, material), q=-load(grid, p["load"]),
        A=one[held], b=np.zeros(held.size), G=no_rows(n), h=np.zeros(0),
        lb=np.full(n, -np.inf), ub=np.full(n, np.inf),
    )  # fmt: skip
    return Plate(
        size=_size(p), mesh=mesh, subdomain=subdomain, material=material, moduli=moduli,
        D=D, primal=primal, parts=in_subdomains(p),
    )  # fmt: skip


def in_subdomains(params: Mapping[str, Value]) -> DecomposedProblem:
    """Describe the dual of the plate."""
    p: Any = params
    grid, (moduli, D) = _grid(p), _stiffness(p)
    layout = Layout.of((grid,), _side(p))
    column, row = (x.astype(np.int64) for x in layout.block[1:])
    none = np.zeros(0)
    return DecomposedProblem(
        layout=layout, components=2, E=moduli[:1], names=("plate",), glue=p["glue"],
        material=_material(p, column, row),
        assemble_class=partial(elastic_class, D=D, E=moduli),
        load=force_lookup(Forces(*_pull(grid, p["load"]))),
        fixed=dofs_of(grid.sides["left"], 2),
        eliminated=p["supports"] == "eliminated",
        contact=Contact(no_rows(2 * grid.nodes), none, none),
    )  # fmt: skip


def results(params: Mapping[str, Value], dual: LocalDual) -> Results:
    """Report what ranks have found, as `quantities`."""
    return partial(_found_by_ranks, _grid(params), _stiffness(params)[0], dual)


def _found_by_ranks(
    grid: StructuredGrid, moduli: Vector, dual: LocalDual, found: LocalSolution
) -> dict[str, Any]:
    """Report what ranks have found; called by all of them."""
    own = found.subdomains
    tip = dofs_of(np.intersect1d(grid.sides["top"], grid.sides["right"]), 2)
    known = {
        "nodes": grid.nodes,
        "elements": int(np.prod(grid.divisions)),
        "dofs": 2 * grid.nodes,
        "equality_rows": own.problem.fixed.size,
        "energy": found.energy * LOAD * LENGTH,
        "tip": (found.at(tip) * LENGTH).tolist(),
    }
    return known | conditions(_spectra(moduli, dual))


def _size(p: Mapping[str, Any]) -> tuple[float, float]:
    return p["width"] or float(p["Sx"]), p["height"] or float(p["Sy"])


def _side(p: Mapping[str, Any]) -> tuple[int, int]:
    """Return the cells along the sides of a subdomain."""
    return p["n"], p["ny"] or p["n"]


def _grid(p: Mapping[str, Any]) -> StructuredGrid:
    n, ny = _side(p)
    return rectangle_grid((0.0, 0.0), _size(p), (n * p["Sx"], ny * p["Sy"]))


def _material(
    p: Mapping[str, Any], column: NDArray[np.int64], row: NDArray[np.int64]
) -> NDArray[np.int64]:
    """Choose the material by columns and rows of subdomains."""
    patterns: dict[str, NDArray[np.int64]] = {
        "uniform": np.zeros_like(column),
        "checkerboard": (column + row) % 2,
        "column": (column == 0).astype(np.int64),
    }
    return patterns[p["pattern"]]


def _stiffness(p: Mapping[str, Any]) -> tuple[Vector, NDArray[np.float64]]:
    """Return moduli (2,) and elasticity matrices (2, 3, 3), without dimension."""
    moduli = np.array([1.0, p["jump"]]) * STEEL.E * LENGTH / LOAD
    materials = [Material(E, STEEL.nu) for E in moduli]
    return moduli, np.stack([elasticity_matrix(m, p["plane"]) for m in materials])


def load(grid: StructuredGrid, kind: str) -> Vector:
    """Return nodal forces (2N,) that pull down with F₀ in all, without dimension."""
    component, force = _pull(grid, kind)
    f = np.zeros(2 * grid.nodes)
    f[component] = force
    return f


def _pull(grid: StructuredGrid, kind: str) -> tuple[Nodes, Vector]:
    """Return the components that are pulled, and the forces there."""
    right = grid.sides["right"]
    share = {
        "point": (right == np.intersect1d(right, grid.sides["top"])).astype(float),
        "edge": nodal_lengths(grid.side("right")),
        "nodal": np.ones(right.size),
    }[kind]
    return dofs_of(right, 2, 1), -share / share.sum()


def quantities(plate: Plate, s: Solution) -> dict[str, Any]:
    """Report counts, energy, J/m, and the tip [u_x, u_y], m: the upper right corner."""
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
    """Report how the plate is torn, ‖PFP‖, and condition numbers with error bounds.

    norm_PFP: that for E = 1, as all rows are scaled by √E. kappa: κ(PFP).
    kappa_lumped, kappa_dirichlet, kappa_dirichlet_stiffness: with these
    preconditioners, by multiplicity but for the last. Each has an `…_error`.
    """
    torn = decomposition_quantities(plate.torn, plate.dual.qp)
    return conditions(plate.spectra) | torn


def conditions(spectra: Mapping[str, Spectrum]) -> dict[str, Any]:
    """Report ‖PFP‖ and condition numbers, see `dual_quantities`."""
    found: dict[str, Any] = {
        "norm_PFP": spectra["none"].largest,
        "norm_PFP_error": spectra["none"].largest_error,
    }
    for name, of in spectra.items():
        key = "kappa" if name == "none" else f"kappa_{name}"
        found |= {key: of.condition, f"{key}_error": of.condition_error}
    return found
