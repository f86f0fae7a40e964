"""A string or membrane over an obstacle, with exact solutions in closed form.

*Flat.* Under unit tension and the downward load q = 2 over Ω = (−3/2, 3/2)^dim, with
the exact solution as Dirichlet data, u minimises ∫ ½|∇u|² + q u over u ≥ 0. With the
distance r from the origin, the contact region is r ≤ 1, and for r ≥ 1

    string (dim = 1):    u = (r − 1)²               u″ = 2
    membrane (dim = 2):  u = r²/2 − ln r − ½        Δu = u″ + u′/r = 2

both with u = u′ = 0 at r = 1. The pressure of the obstacle in the contact region is q,
and its total force is 2q for the string and πq for the membrane. (The membrane is a
standard test problem, for instance in Bartels and Carstensen 2004.)

*Hemisphere.* A membrane over Ω = (−2, 2)² without load lies on the unit ball,
ψ = √(1 − r²) for r ≤ 0.9, continued by its tangent for r > 0.9 (tutorial 9 of PETSc's
SNES; Bueler, "PETSc for partial differential equations", 2021, Chapter 12). The contact
region is r ≤ a, with

    a²(ln 2 − ln a) = 1 − a²,    u = A ln(2/r) for r ≥ a,   A = a²/√(1 − a²)

so that u = ψ and u′ = ψ′ at r = a, and u = 0 at r = 2. The force of the ball is 2πA.

Elements are linear or bilinear on a uniform grid. Nodal errors and the error of the
energy are of second order. Lengths are in m, and forces are divided by the tension.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from time import perf_counter
from typing import Any

import numpy as np
from numpy.polynomial.legendre import leggauss
from scipy.sparse import csc_array, csr_array, eye_array

from mortarbench.harness import (
    QP,
    Case,
    InputError,
    Mechanics,
    Solution,
    Value,
    Vector,
    no_rows,
)
from mortarbench.harness.mechanics import DecomposedMechanics
from mortarbench.problems.contact.sides import ACTIVE_THRESHOLD
from mortarbench.problems.duality.dualisation import Transformed, dual_bounds, dualise
from mortarbench.problems.duality.feti_dual import (
    decomposition_quantities,
    digest_of,
    feti_dual,
)
from mortarbench.problems.fem.inverse import (
    GeneralisedInverse,
    regular_inverse,
    supported_inverse,
)
from mortarbench.problems.fem.laplacian import grid_stiffness
from mortarbench.problems.fem.mesh import Mesh, Nodes, StructuredGrid
from mortarbench.problems.feti.mechanics import torn_mechanics
from mortarbench.problems.feti.served import Served
from mortarbench.problems.feti.structured import grids_in_blocks
from mortarbench.problems.feti.subdivision import Subdivision
from mortarbench.problems.feti.subdomains import (
    Contact,
    DecomposedProblem,
    TornBodies,
)
from mortarbench.problems.feti.tearing import blocks
from mortarbench.problems.models.membranes import membrane_class

HALF = {"flat": 1.5, "hemisphere": 2.0}  #: half the width of Ω for each shape, m
LOAD = {"flat": 2.0, "hemisphere": 0.0}  #: load q for each shape, 1/m
TANGENT_RADIUS = 0.9  #: radius r beyond which ψ is continued by its tangent, m
#: contact radius a, the root of a²(ln 2 − ln a) = 1 − a², m
CONTACT_RADIUS = 0.697965148223374
#: coefficient A of the solution, m
SLOPE = CONTACT_RADIUS**2 / np.sqrt(1 - CONTACT_RADIUS**2)


def obstacle_case(form: str, params: Mapping[str, Value]) -> Case:
    """Return the case in the form `form`."""
    p: Any = params
    if p["feti"] and form != "dual":
        raise InputError(
            f"feti with form {form} is not built; expected form dual, or no feti"
        )
    problem = obstacle_problem(p["dim"], p["n"], p["shape"])
    if form == "primal":
        return _case(p, problem, bound_form(problem.qp))
    start = perf_counter()
    if p["feti"]:
        served = Served(TornBodies(in_subdomains(params)))
        case = decomposed_case(p, served)
    elif form == "dual":
        case = _case(p, problem, dualise(problem.qp, problem.floating()))
    else:
        case = _case(p, problem, dual_bounds(problem.qp, problem.factorise()))
    return replace(case, dualise_seconds=perf_counter() - start)


def decomposed_case(params: Mapping[str, Any], served: Served) -> Case:
    """Return the case of the dual in subdomains on rank 0."""
    problem = obstacle_problem(params["dim"], params["n"], params["shape"])
    new = feti_dual(served, problem.qp)
    case = _case(params, problem, new, torn_mechanics(served, problem.qp.P))
    sizes = decomposition_quantities(served, new.qp)
    return replace(
        case,
        digest=digest_of(served, served.torn),
        quantities=lambda s: {**case.quantities(s), **sizes},
    )


def _case(
    params: Mapping[str, Any],
    problem: Problem,
    new: Transformed,
    subdomains: Callable[[], DecomposedMechanics] | None = None,
) -> Case:
    n, rows = params["n"], problem.qp
    datum = problem.energy(np.zeros(rows.q.size))
    return Case(
        qp=new.qp,
        recover=lambda s: problem.lift + new.recover(s).x,
        quantities=lambda s: obstacle_quantities(problem, new.recover(s)),
        scale=new.sign,
        constant=new.constant + datum,
        mechanics=Mechanics(
            primal=rows,
            to_primal=new.recover,
            factorise=problem.factorise,
            mesh_size=2 * HALF[params["shape"]] / n,
            rigid=np.zeros((rows.q.size, 0)),
            subdomains=subdomains,
            constant=datum,
        ),
    )


def in_subdomains(params: Mapping[str, Value]) -> DecomposedProblem:
    """Return the decomposed problem; every interior node has a contact row."""
    p: Any = params
    if p["dim"] == 1:
        return _string_in_subdomains(p)
    n, shape = p["n"], p["shape"]
    grid = _grid(n, shape)
    layout = grids_in_blocks((grid,), p["feti"])
    boundary = np.unique(np.concatenate([*grid.sides.values()]))
    free = np.setdiff1d(np.arange(grid.nodes), boundary)
    psi = obstacle_height(grid.position(free), shape)
    ends = np.arange(free.size + 1)
    rows = csr_array((np.full(free.size, -1.0), free, ends), (free.size, grid.nodes))
    return DecomposedProblem(
        layout=layout,
        components=1,
        material=np.zeros(layout.count, dtype=np.int64),
        assemble_class=partial(membrane_class, h=2 * HALF[shape] / n),
        E=np.ones(1),
        names=("membrane",),
        load=_load(grid, shape, np.arange(grid.nodes)),
        fixed=boundary,
        contact=Contact(rows, -psi, np.zeros(0)),
        glue=p["glue"],
    )


def _string_in_subdomains(p: Mapping[str, Any]) -> DecomposedProblem:
    """Return the decomposed problem of a string; the whole mesh is generated."""
    n = p["n"]
    problem = obstacle_problem(1, n)
    node = np.arange(n + 1)
    segments = np.stack([node[:-1], node[1:]], axis=-1)
    mesh, body = Mesh(problem.x, segments, {}), np.zeros(n, dtype=np.int64)
    layout = Subdivision(mesh, blocks((n,), p["feti"]), body)
    qp = problem.qp
    return DecomposedProblem(
        layout=layout,
        components=1,
        material=np.zeros(layout.count, dtype=np.int64),
        assemble_class=partial(membrane_class, h=2 * HALF["flat"] / n),
        E=np.ones(1),
        names=("string",),
        load=-qp.q,
        fixed=csr_array(qp.A).indices,
        contact=Contact(csr_array(qp.G), qp.h, np.zeros(0)),
        glue=p["glue"],
    )


def _grid(n: int, shape: str) -> StructuredGrid:
    """Return the grid of Ω ⊂ ℝ², numbered as in `nodes`, that is, fastest along y."""
    x = np.linspace(-HALF[shape], HALF[shape], n + 1)
    points = np.stack(np.meshgrid(x, x, indexing="ij"), axis=-1)
    return StructuredGrid(points, names=("left", "top", "right", "bottom"))


def _load(grid: StructuredGrid, shape: str, node: Nodes) -> Vector:
    """Return the nodal forces −q − Kw of `Problem` at the nodes `node` (k,).

    On a square, K = K₁ ⊗ M₁ + M₁ ⊗ K₁, with the stiffness K₁ and mass matrix M₁ of
    linear elements on a line. Kw is zero except at nodes on the boundary and at their
    neighbours.
    """
    n = grid.divisions[0]
    h, (i, j) = 2 * HALF[shape] / n, np.divmod(node, n + 1)

    def along(k: Nodes, step: int) -> tuple[Vector, Vector]:
        one = np.ones(k.size)
        stiff, mass = (-one, one) if step else (_cells_at(k, n), 2 * _cells_at(k, n))
        return stiff / h, mass * (h / 6)

    f = -LOAD[shape] * _hat_integrals(n, h, node)
    for a, b in np.ndindex(3, 3):
        beside = np.stack([i + a - 1, j + b - 1])
        at_boundary = ((beside == 0) | (beside == n)).any(axis=0)
        k = np.flatnonzero(at_boundary & ((beside >= 0) & (beside <= n)).all(axis=0))
        (K_i, M_i), (K_j, M_j) = along(i[k], a - 1), along(j[k], b - 1)
        w = exact_height(grid.position(beside[0, k] * (n + 1) + beside[1, k]), shape)
        f[k] -= (K_i * M_j + M_i * K_j) * w
    return np.asarray(f)


def _cells_at(line: Nodes, n: int) -> Vector:
    """Return the number of cells adjacent to each point (k,) of a line of n cells."""
    return np.where((line == 0) | (line == n), 1.0, 2.0)


def _hat_integrals(n: int, h: float, node: Nodes) -> Vector:
    """Return ∫N_j of the nodes `node` (k,) of a grid of n × n cells with side h."""
    i, j = np.divmod(node, n + 1)
    return np.asarray((h / 2) ** 2 * _cells_at(i, n) * _cells_at(j, n))


@dataclass(frozen=True, eq=False)
class Problem:
    """Obstacle problem for v = u − w, with w = u at boundary nodes and 0 at all others.

    ::

        min ½vᵀKv + (q + Kw)ᵀv,   v = 0 at the boundary,   −v ≤ −ψ at the other nodes
    """

    shape: str  #: "flat" (ψ = 0) or "hemisphere"
    x: Vector  #: (N, dim) nodes, m
    cells: int  #: number of cells
    lift: Vector  #: lift w (N,), m
    qp: QP

    def factorise(self) -> GeneralisedInverse:
        """Factorise K without the prescribed components."""
        return regular_inverse(self.qp.P, csr_array(self.qp.G).indices)

    def floating(self) -> GeneralisedInverse:
        """Factorise the whole K, with constants as kernel, for the form dual."""
        N = self.qp.q.size
        return supported_inverse(self.qp.P, np.arange(N), np.full((N, 1), N**-0.5))

    def energy(self, v: Vector) -> float:
        """Return ∫ ½|∇u|² + q u for u = v + w, divided by the tension."""
        w, qp = self.lift, self.qp
        constant = qp.q @ w - 0.5 * w @ (qp.P @ w)
        return qp.objective(v) + float(constant)


def obstacle_problem(dim: int, n: int, shape: str = "flat") -> Problem:
    """Assemble the problem on a uniform grid with n cells per side."""
    h = 2 * HALF[shape] / n
    ends = np.array([1.0] + [2.0] * (n - 1) + [1.0])
    K = grid_stiffness((n,) * dim, h)
    share: Vector = h / 2 * ends  # ∫N
    if dim == 2:
        share = np.outer(share, share).ravel()
    x = nodes(dim, n, shape)
    # subtract half a cell, because coordinates are rounded
    at_boundary = np.abs(x).max(axis=1) > HALF[shape] - h / 2
    w = np.where(at_boundary, exact_height(x, shape), 0.0)
    one, N = csr_array(eye_array(len(x))), len(x)
    qp = QP(
        P=K,
        q=LOAD[shape] * share + K @ w,
        A=one[at_boundary],
        b=np.zeros(at_boundary.sum()),
        G=-one[~at_boundary],
        h=-obstacle_height(x[~at_boundary], shape),
        lb=np.full(N, -np.inf),
        ub=np.full(N, np.inf),
    )
    return Problem(shape, x, n**dim, w, qp)


def bound_form(rows: QP) -> Transformed:
    """Eliminate the prescribed components, and replace −v ≤ −ψ by bounds v ≥ ψ."""
    free = csr_array(rows.G).indices
    n, m = rows.q.size, free.size
    K = csc_array(rows.P)
    qp = QP(
        P=K[free][:, free],
        q=rows.q[free],
        A=no_rows(m),
        b=np.zeros(0),
        G=no_rows(m),
        h=np.zeros(0),
        lb=-rows.h,
        ub=np.full(m, np.inf),
    )

    def recover(s: Solution) -> Solution:
        v = np.zeros(n)
        v[free] = s.x
        z = -s.z_box
        reactions = -rows.A @ (rows.P @ v + rows.q + rows.G.T @ z)
        return replace(s, x=v, y=reactions, z=z, z_box=np.zeros(n))

    return Transformed(qp, recover, 1.0, 0.0, lambda s: recover(s).x)


def nodes(dim: int, n: int, shape: str = "flat") -> Vector:
    """Return the positions (N, dim) of the nodes of a grid with n cells per side, m."""
    x = np.linspace(-HALF[shape], HALF[shape], n + 1)
    grid = np.meshgrid(*[x] * dim, indexing="ij")
    return np.stack([axis.ravel() for axis in grid], axis=-1)


def obstacle_height(x: Vector, shape: str) -> Vector:
    """Return ψ at positions (N, dim), m."""
    if shape == "flat":
        return np.zeros(len(x))
    r = np.linalg.norm(x, axis=1)
    ball = np.sqrt(1 - np.minimum(r, TANGENT_RADIUS) ** 2)
    return np.asarray(ball - TANGENT_RADIUS / ball * np.maximum(r - TANGENT_RADIUS, 0))


def exact_height(x: Vector, shape: str = "flat") -> Vector:
    """Return the exact u at positions (N, dim), m."""
    if shape == "hemisphere":
        r = np.linalg.norm(x, axis=1)
        beyond = SLOPE * np.log(2 / np.maximum(r, CONTACT_RADIUS))
        return np.where(r <= CONTACT_RADIUS, obstacle_height(x, shape), beyond)
    r = np.maximum(np.linalg.norm(x, axis=1), 1.0)
    if x.shape[1] == 1:
        return np.asarray((r - 1) ** 2)
    return np.asarray(r**2 / 2 - np.log(r) - 0.5)


def exact_energy(dim: int, shape: str = "flat") -> float:
    """Return ∫ ½|∇u|² + q u of the exact solution, which is ⅓ for the string.

    For the membrane, the integral over r is evaluated in closed form, and the integral
    over the angle φ numerically. With the distance ρ of the boundary in the direction
    φ, the energy is

        8 ∫_0^{π/4} [⅜(ρ⁴ − 1) − ½(ρ² − 1) + (½ − ρ²) ln ρ] dφ,    ρ = HALF/cos φ

    For the hemisphere: π∫_0^a r³/(1 − r²) dr + 8 ∫_0^{π/4} ½A² ln(ρ/a) dφ.
    """
    if dim == 1:
        return 1 / 3
    at, weights = leggauss(20)  # exact up to rounding for these smooth integrands
    rho = HALF[shape] / np.cos(np.pi / 8 * (1 + at))
    if shape == "hemisphere":
        ball = -np.pi / 2 * (CONTACT_RADIUS**2 + np.log(1 - CONTACT_RADIUS**2))
        return float(
            ball + np.pi * weights @ (SLOPE**2 / 2 * np.log(rho / CONTACT_RADIUS))
        )
    along_ray = 3 / 8 * (rho**4 - 1) - (rho**2 - 1) / 2 + (0.5 - rho**2) * np.log(rho)
    return float(np.pi * weights @ along_ray)


def obstacle_quantities(problem: Problem, s: Solution) -> dict[str, Any]:
    """Return counts, energy and force of the obstacle, with their errors.

    `energy` and `obstacle_force`, Σλ, are divided by the tension; `energy_error` and
    `force_error` are relative; `max_error` is the largest nodal error of u in m.
    """
    N, dim = problem.x.shape
    error = problem.lift + s.x - exact_height(problem.x, problem.shape)
    return _quantities(
        problem.shape,
        (dim, N, problem.cells, problem.qp.b.size),
        s.z,
        problem.energy(s.x),
        float(np.abs(error).max()),
    )


def _quantities(
    shape: str, sizes: tuple[int, int, int, int], z: Vector, energy: float, error: float
) -> dict[str, Any]:
    """Return the dictionary of `obstacle_quantities`.

    sizes : dimension, and numbers of nodes, cells and boundary nodes
    z : multipliers of the obstacle
    error : largest nodal error of u, m
    """
    (dim, N, elements, boundary), force = sizes, float(z.sum())
    flat = LOAD["flat"] * (2.0 if dim == 1 else np.pi)
    exact_force = flat if shape == "flat" else 2 * np.pi * SLOPE
    return {
        "nodes": N,
        "elements": elements,
        "dofs": N,
        "equality_rows": boundary,
        "contact_rows": z.size,
        "active": int((z > ACTIVE_THRESHOLD * z.max(initial=0.0)).sum()),
        "energy": energy,
        "energy_error": energy / exact_energy(dim, shape) - 1,
        "obstacle_force": force,
        "force_error": force / exact_force - 1,
        "max_error": error,
    }
