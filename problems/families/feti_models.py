"""Scalar problems, and a plate without contact, as models for Total FETI.

The string and the membrane over an obstacle, the two membranes and the plate have no
`ContactProblem`. They define the decomposed problem themselves.
"""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import cache, cached_property, partial
from time import perf_counter
from typing import Annotated, Any, ClassVar, Literal

import numpy as np
from numpy.polynomial.legendre import leggauss
from numpy.typing import NDArray
from scipy.sparse import block_diag, csc_array, csr_array, eye_array

from mortarbench.harness import (
    QP,
    Case,
    Divided,
    Family,
    Fields,
    Grid,
    InputError,
    Mechanics,
    Reference,
    ReferenceOfOperator,
    Solution,
    Vector,
    no_rows,
)
from mortarbench.harness.distributed.comm import Team
from mortarbench.harness.keys import Range
from mortarbench.harness.mechanics import DecomposedMechanics
from mortarbench.problems.contact.sides import active
from mortarbench.problems.duality.dualisation import (
    Transformed,
    dual_bounds,
    dualise,
    primal_form,
)
from mortarbench.problems.duality.feti_dual import feti_dual, with_decomposition
from mortarbench.problems.fem.elasticity import (
    Material,
    Plane,
    elasticity_matrix,
    rigid_modes,
    stiffness,
)
from mortarbench.problems.fem.fixing import fixing_nodes
from mortarbench.problems.fem.inverse import (
    GeneralisedInverse,
    regular_inverse,
    supported_inverse,
)
from mortarbench.problems.fem.laplacian import grid_stiffness
from mortarbench.problems.fem.mesh import (
    Mesh,
    Nodes,
    as_vectors,
    box,
    cells_of_block,
    dofs_of,
    join,
    nodal_sizes,
    nodes_of_side,
    prefixed,
    rectangle,
)
from mortarbench.problems.fem.stress import centre_stress, recover, von_mises
from mortarbench.problems.feti.elastic import elastic_class
from mortarbench.problems.feti.mechanics import torn_mechanics
from mortarbench.problems.feti.served import Served
from mortarbench.problems.feti.spectrum import Spectrum, spectra
from mortarbench.problems.feti.subdivision import Subdivision
from mortarbench.problems.feti.subdomain_classes import SubdomainClass
from mortarbench.problems.feti.subdomains import (
    Contact,
    DecomposedProblem,
    TornBodies,
)
from mortarbench.problems.feti.tearing import SubdomainMesh, blocks, joined_labels
from mortarbench.problems.keys import (
    CONTACT_FORMS,
    MAX_SIZE,
    MIN_SIZE,
    POSITIVE,
    Dimension,
    Feti,
    Glue,
    check_decomposition,
    check_memory,
    refuse_unused,
)


class DecomposedFamily(Family):
    """A family whose dual is formed by subdomains."""

    @property
    def is_divided(self) -> bool:
        """True if the dual is that of subdomains."""
        return True

    @abstractmethod
    def in_subdomains(self) -> DecomposedProblem:
        """Return the decomposed problem."""

    @property
    @abstractmethod
    def qp(self) -> QP:
        """QP of the undivided problem."""

    @abstractmethod
    def case(
        self,
        new: Transformed,
        subdomains: Callable[[], DecomposedMechanics] | None = None,
    ) -> Case:
        """Return the case of a form of the problem.

        new : form of the primal QP
        subdomains : function that returns the subdomains for certificates; None for
            undivided problems
        """

    def undivided(self, form: str) -> Transformed:
        """Return a form of the undivided problem."""
        return primal_form(self.qp)

    def build(self, form: str, reference: Reference) -> Case:
        """Return the case in the form `form`."""
        if form == "primal":
            return self.case(self.undivided(form))
        start = perf_counter()
        if form == "dual" and self.is_divided:
            case = self.decomposed_case(Served(TornBodies(self.in_subdomains())))
        else:
            case = self.case(self.undivided(form))
        return replace(case, dualise_seconds=perf_counter() - start)

    def decomposed_case(self, served: Served) -> Case:
        """Return the case of the dual in subdomains."""
        new = feti_dual(served, self.qp)
        case = self.case(new, torn_mechanics(served, self.qp.P))
        return with_decomposition(case, served, served.torn)

    def divided(self, form: str) -> Divided | None:
        """Return the subdomains of a form, or None if it is not in subdomains."""
        if form != "dual" or not self.is_divided:
            return None
        problem = self.in_subdomains()

        def build(team: Team, _: ReferenceOfOperator) -> Case:
            return self.decomposed_case(Served(TornBodies(problem, team)))

        return Divided(problem.layout.count, build)


HALF_WIDTH = {"flat": 1.5, "hemisphere": 2.0}  #: half the width of Ω for each shape, m
OBSTACLE_LOAD = {"flat": 2.0, "hemisphere": 0.0}  #: load q for each shape, 1/m
TANGENT_RADIUS = 0.9  #: radius r beyond which ψ is continued by its tangent, m
#: contact radius a, the root of a²(ln 2 − ln a) = 1 − a², m
CONTACT_RADIUS = 0.697965148223374
#: coefficient A of the solution, m
SLOPE = CONTACT_RADIUS**2 / np.sqrt(1 - CONTACT_RADIUS**2)


@dataclass(frozen=True, kw_only=True)
class Obstacle(DecomposedFamily):
    """A string or membrane over an obstacle, with an exact solution.

    *Flat.* Under unit tension and the downward load q = 2 over Ω = (−3/2, 3/2)^dim,
    with the exact solution as Dirichlet data, u minimises ∫ ½|∇u|² + q u over u ≥ 0.
    With the distance r from the origin, the contact region is r ≤ 1, and for r ≥ 1

        string (dim = 1):    u = (r − 1)²               u″ = 2
        membrane (dim = 2):  u = r²/2 − ln r − ½        Δu = u″ + u′/r = 2

    both with u = u′ = 0 at r = 1. The pressure of the obstacle in the contact region is
    q, and its total force is 2q for the string and πq for the membrane. (The membrane
    is a standard test problem, for instance in Bartels and Carstensen 2004.)

    *Hemisphere.* A membrane over Ω = (−2, 2)² without load lies on the unit ball, ψ =
    √(1 − r²) for r ≤ 0.9, continued by its tangent for r > 0.9 (tutorial 9 of PETSc's
    SNES; Bueler, "PETSc for partial differential equations", 2021, Chapter 12). The
    contact region is r ≤ a, with

        a²(ln 2 − ln a) = 1 − a²,    u = A ln(2/r) for r ≥ a,   A = a²/√(1 − a²)

    so that u = ψ and u′ = ψ′ at r = a, and u = 0 at r = 2. The force of the ball is
    2πA.

    Elements are linear or bilinear on a uniform grid. Nodal errors and the error of the
    energy are of second order. Lengths are in m, and forces are divided by the tension.
    """

    forms: ClassVar = CONTACT_FORMS

    dim: Annotated[Literal[1, 2], "1: a string, 2: a membrane"] = 2
    n: Annotated[int, Range(2), "cells along each side"] = 20
    shape: Annotated[Literal["flat", "hemisphere"], "shape of the obstacle"] = "flat"
    feti: Feti = 0
    glue: Glue = "orthonormal"

    def __post_init__(self) -> None:
        """Check the dimension and the size."""
        super().__post_init__()
        meaning = "the largest number of cells along the side of a subdomain"
        check_decomposition(self, "feti", meaning)
        if self.shape == "hemisphere" and self.dim != 2:
            raise InputError("shape=hemisphere needs dim=2")
        check_memory(self.n**self.dim)

    @property
    def is_divided(self) -> bool:
        """True if `feti` requests subdomains."""
        return self.feti > 0

    @cached_property
    def problem(self) -> ObstacleProblem:
        """Problem on the whole grid."""
        return obstacle_problem(self.dim, self.n, self.shape)

    @property
    def qp(self) -> QP:
        """QP of the undivided problem."""
        return self.problem.qp

    def undivided(self, form: str) -> Transformed:
        """Return a form of the undivided problem."""
        problem = self.problem
        if form == "dual":
            return dualise(problem.qp, problem.floating())
        if form == "dual-bounds":
            return dual_bounds(problem.qp, problem.factorise())
        return bound_form(problem.qp)

    def build(self, form: str, reference: Reference) -> Case:
        """Return the case in the form `form`."""
        if self.feti and form != "dual":
            raise InputError(
                f"feti with form {form} is not built; expected form dual, or no feti"
            )
        return super().build(form, reference)

    def case(
        self,
        new: Transformed,
        subdomains: Callable[[], DecomposedMechanics] | None = None,
    ) -> Case:
        """Return the case of a form of the problem."""
        problem = self.problem
        size = problem.qp.q.size
        datum = problem.energy(np.zeros(size))
        return Case(
            qp=new.qp,
            recover=lambda s: problem.lift + new.recover(s).x,
            quantities=lambda s: obstacle_quantities(problem, new.recover(s)),
            scale=new.sign,
            constant=new.constant + datum,
            mechanics=Mechanics(
                primal=problem.qp,
                to_primal=new.recover,
                factorise=problem.factorise,
                rigid=np.zeros((size, 0)),
                subdomains=subdomains,
            ),
        )

    def in_subdomains(self) -> DecomposedProblem:
        """Return the decomposed problem; every interior node has a contact row."""
        n, dim, qp = self.n, self.dim, self.qp
        cells = cells_of_block(n + 1, n + 1)
        if dim == 1:
            cells = np.stack([np.arange(n), np.arange(1, n + 1)], axis=-1)
        body = np.zeros(len(cells), dtype=np.int64)
        label = blocks((n,) * dim, self.feti)
        layout = Subdivision(Mesh(self.problem.x, cells, {}), label, body)
        return DecomposedProblem(
            layout=layout,
            components=1,
            material=np.zeros(layout.count, dtype=np.int64),
            assemble_class=partial(membrane_class, h=2 * HALF_WIDTH[self.shape] / n),
            E=np.ones(1),
            names=("string" if dim == 1 else "membrane",),
            load=-qp.q,
            fixed=csr_array(qp.A).indices,
            contact=Contact(csr_array(qp.G), qp.h, np.zeros(0)),
            glue=self.glue,
        )


@dataclass(frozen=True, eq=False)
class ObstacleProblem:
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


def obstacle_problem(dim: int, n: int, shape: str = "flat") -> ObstacleProblem:
    """Assemble the problem on a uniform grid with n cells per side."""
    h = 2 * HALF_WIDTH[shape] / n
    K = grid_stiffness((n,) * dim, h)
    along = n * h * hat_integrals(n, 0.0, 1.0)  # ∫N on a line
    share = along if dim == 1 else np.outer(along, along).ravel()
    x = nodes(dim, n, shape)
    # subtract half a cell, because coordinates are rounded
    at_boundary = np.abs(x).max(axis=1) > HALF_WIDTH[shape] - h / 2
    w = np.where(at_boundary, exact_height(x, shape), 0.0)
    one = csr_array(eye_array(len(x)))
    qp = QP(
        P=K,
        q=OBSTACLE_LOAD[shape] * share + K @ w,
        A=one[at_boundary],
        b=np.zeros(at_boundary.sum()),
        G=-one[~at_boundary],
        h=-obstacle_height(x[~at_boundary], shape),
    )
    return ObstacleProblem(shape, x, n**dim, w, qp)


def bound_form(rows: QP) -> Transformed:
    """Eliminate the prescribed components, and replace −v ≤ −ψ by bounds v ≥ ψ."""
    free = csr_array(rows.G).indices
    n = rows.q.size
    K = csc_array(rows.P)
    qp = QP(
        P=K[free][:, free],
        q=rows.q[free],
        lb=-rows.h,
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
    x = np.linspace(-HALF_WIDTH[shape], HALF_WIDTH[shape], n + 1)
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

        8 ∫_0^{π/4} [⅜(ρ⁴ − 1) − ½(ρ² − 1) + (½ − ρ²) ln ρ] dφ,    ρ = HALF_WIDTH/cos φ

    For the hemisphere: π∫_0^a r³/(1 − r²) dr + 8 ∫_0^{π/4} ½A² ln(ρ/a) dφ.
    """
    if dim == 1:
        return 1 / 3
    at, weights = leggauss(20)  # exact up to rounding for these smooth integrands
    rho = HALF_WIDTH[shape] / np.cos(np.pi / 8 * (1 + at))
    if shape == "hemisphere":
        ball = -np.pi / 2 * (CONTACT_RADIUS**2 + np.log(1 - CONTACT_RADIUS**2))
        return float(
            ball + np.pi * weights @ (SLOPE**2 / 2 * np.log(rho / CONTACT_RADIUS))
        )
    along_ray = 3 / 8 * (rho**4 - 1) - (rho**2 - 1) / 2 + (0.5 - rho**2) * np.log(rho)
    return float(np.pi * weights @ along_ray)


def obstacle_quantities(problem: ObstacleProblem, s: Solution) -> dict[str, Any]:
    """Return counts, energy and force of the obstacle, with their errors.

    `energy` and `obstacle_force`, Σλ, are divided by the tension; `energy_error` and
    `force_error` are relative; `max_error` is the largest nodal error of u in m.
    """
    (N, dim), shape = problem.x.shape, problem.shape
    energy, force = problem.energy(s.x), float(s.z.sum())
    flat = OBSTACLE_LOAD["flat"] * (2.0 if dim == 1 else np.pi)
    exact_force = flat if shape == "flat" else 2 * np.pi * SLOPE
    error = problem.lift + s.x - exact_height(problem.x, shape)
    return {
        "nodes": N,
        "elements": problem.cells,
        "dofs": N,
        "equality_rows": problem.qp.b.size,
        "contact_rows": s.z.size,
        "active": int(active(s.z).sum()),
        "energy": energy,
        "energy_error": energy / exact_energy(dim, shape) - 1,
        "obstacle_force": force,
        "force_error": force / exact_force - 1,
        "max_error": float(np.abs(error).max()),
    }


MEMBRANES = ("left", "right")
#: load f of each membrane, and the interval of y on which it acts
MEMBRANE_LOADS = ((-3.0, (0.75, 1.0)), (-1.0, (0.0, 0.25)))


@dataclass(frozen=True, kw_only=True)
class Membranes(DecomposedFamily):
    """Two membranes in contact along an edge; the right one floats.

    The problem is that of Dostál and Horák 2004, "Scalable FETI with optimal dual
    penalty for a variational inequality" (ref. [20] of the paper), which the developers
    of PERMON use as a benchmark. Under unit tension,

        min Σ_b ∫ ½|∇u_b|² − f_b u_b,    u_1 = 0 on x = 0,   u_1 ≤ u_2 on x = 1

    on Ω_1 = (0, 1)² and Ω_2 = (1, 2) × (0, 1). The load pulls down: f_1 = −3 for y > ¾,
    f_2 = −1 for y < ¼, and both are zero elsewhere. The second membrane floats and is
    supported by the first one alone; therefore, the sum of the contact forces is its
    load, ¼.

    Elements are bilinear. Each membrane is decomposed into S × S congruent squares of n
    × n cells.
    """

    forms: ClassVar = ("primal", "dual")

    S: Annotated[int, Range(1), "subdomains along a side of a membrane, 1/H"] = 2
    n: Annotated[int, Range(1), "cells along a side of a subdomain, H/h"] = 8
    glue: Glue = "orthonormal"

    def __post_init__(self) -> None:
        """Check that the membranes fit into memory."""
        super().__post_init__()
        check_memory(2 * (self.side + 1) ** 2)

    def case(
        self,
        new: Transformed,
        subdomains: Callable[[], DecomposedMechanics] | None = None,
    ) -> Case:
        """Return the case of a form of the problem."""
        return Case(
            qp=new.qp,
            recover=lambda s: new.recover(s).x,
            quantities=lambda s: self.quantities(new.recover(s)),
            scale=new.sign,
            constant=new.constant,
            mechanics=Mechanics(
                primal=self.qp,
                to_primal=new.recover,
                factorise=self.factorise,
                rigid=self.rigid,
                names=MEMBRANES,
                subdomains=subdomains,
            ),
        )

    @property
    def side(self) -> int:
        """Number of cells along a side of a membrane."""
        return self.S * self.n

    @cached_property
    def joined(self) -> tuple[Mesh, Nodes]:
        """Mesh of both squares, and the membrane (E,) of each cell.

        Nodes on the common edge are duplicated.
        """
        squares = (
            prefixed(rectangle((x, 0.0), (1.0, 1.0), (self.side,) * 2), f"{name} ")
            for x, name in zip((0.0, 1.0), MEMBRANES, strict=True)
        )
        return join(tuple(squares))

    @cached_property
    def qp(self) -> QP:
        """Primal problem for the heights u of the nodes."""
        mesh = self.joined[0]
        nodes, sides = len(mesh.points), mesh.boundaries
        K = grid_stiffness((self.side, self.side))
        one = csr_array(eye_array(nodes, format="csr"))
        A, G = one[np.sort(sides["left left"])], self.contact_rows
        return QP(
            P=csc_array(block_diag([K, K], format="csc")),
            q=-self.load,
            A=A,
            b=np.zeros(A.shape[0]),
            G=G,
            h=np.zeros(G.shape[0]),
        )

    @property
    def load(self) -> Vector:
        """Nodal forces, (nodes,); x varies fastest in the numbers of nodes."""
        along = hat_integrals(self.side, 0.0, 1.0)
        parts = [
            value * np.outer(hat_integrals(self.side, *y), along).ravel()
            for value, y in MEMBRANE_LOADS
        ]
        return np.concatenate(parts)

    @property
    def contact_rows(self) -> csr_array:
        """Rows  u_1 − u_2 ≤ 0  of opposite nodes, (m, nodes)."""
        mesh = self.joined[0]
        one = csr_array(eye_array(len(mesh.points), format="csr"))
        # sorted node numbers ascend with y on both sides, and the grids match
        left, right = (
            np.sort(mesh.boundaries[side]) for side in ("left right", "right left")
        )
        return csr_array(one[left] - one[right])

    def in_subdomains(self) -> DecomposedProblem:
        """Return the decomposed problem of both membranes."""
        mesh, body = self.joined
        label = joined_labels([blocks((self.side,) * 2, self.n)] * 2)
        layout, sides = Subdivision(mesh, label, body), mesh.boundaries
        G = self.contact_rows
        return DecomposedProblem(
            layout=layout,
            components=1,
            material=np.zeros(layout.count, dtype=int),
            assemble_class=membrane_class,
            E=np.ones(2),
            names=MEMBRANES,
            load=self.load,
            glue=self.glue,
            fixed=np.sort(sides["left left"]),
            contact=Contact(G, np.zeros(G.shape[0]), np.zeros(0)),
        )

    @property
    def rigid(self) -> Any:
        """Orthonormal translations of each membrane, (nodes, 2)."""
        half = self.qp.q.size // 2
        return np.kron(np.eye(2), np.full((half, 1), half**-0.5))

    def factorise(self) -> GeneralisedInverse:
        """Factorise K on the free components; the right membrane may move rigidly."""
        free = np.setdiff1d(np.arange(self.qp.q.size), csr_array(self.qp.A).indices)
        return supported_inverse(self.qp.P, free, self.rigid)

    def quantities(self, s: Solution) -> dict[str, Any]:
        """Return counts, energy, contact force and least height of a primal solution.

        Energy and force are divided by the tension.
        """
        nodes = 2 * (self.side + 1) ** 2
        return {
            "nodes": nodes,
            "elements": 2 * self.side**2,
            "dofs": nodes,
            "equality_rows": self.side + 1,
            "contact_rows": s.z.size,
            "active": int(active(s.z).sum()),
            "energy": self.qp.objective(s.x),
            "contact_force": float(s.z.sum()),
            "lowest": float(s.x.min()),
        }


def membrane_class(part: SubdomainMesh, h: float = 1.0) -> SubdomainClass:
    """Assemble a floating subdomain of a grid under unit tension.

    The kernel consists of the constants. Nodes are numbered as in `grid_stiffness`.

    h : length of a cell; in 2D, the stiffness does not depend on it
    """
    # round, because coordinates of nodes on one grid line differ in their last digits
    lines = [np.unique(x.round(9)) for x in (part.points / h).T]
    cells = tuple(x.size - 1 for x in lines)
    nodes = len(part.points)
    at = np.indices([x.size for x in lines]).reshape(len(cells), -1)
    last = np.array(cells)[:, None]
    return SubdomainClass(
        K=grid_stiffness(cells, h),
        R=np.full((nodes, 1), nodes**-0.5),
        fixing=fixing_nodes(part.points),
        boundary=np.flatnonzero(((at == 0) | (at == last)).any(axis=0)),
        stiffness=np.ones(nodes),
    )


def hat_integrals(n: int, lower: float, upper: float) -> Vector:
    """Return ∫N_j over lower < y < upper of the n + 1 hat functions on (0, 1)."""
    begin, end = (np.clip(y * n - np.arange(n), 0, 1) for y in (lower, upper))
    # integrals of the rising and the falling hat function over each cell
    rising = (end**2 - begin**2) / 2
    return np.asarray((np.append(end - begin - rising, 0) + np.append(0, rising)) / n)


PLATE_LENGTH = 1.0  #: l, unit of length, m
PLATE_LOAD = 1e6  #: F₀, the load: N/m in 2D, N in 3D
STEEL = Material(E=210e9, nu=0.3)
#: mapping from the name of a spectrum to its preconditioner and scaling; None means no
#: preconditioner
PRECONDITIONERS: Mapping[str, tuple[str, str] | None] = {
    "none": None,
    "lumped": ("lumped", "multiplicity"),
    "dirichlet": ("dirichlet", "multiplicity"),
    "dirichlet_stiffness": ("dirichlet", "stiffness"),
}


@dataclass(frozen=True, kw_only=True)
class Plate(DecomposedFamily):
    """A clamped plate or box of subdomains with jumps of E, for studies of FETI.

    A plate of `width` × `height` in plane strain is clamped at its left edge, and a
    constant traction on its right edge pulls it down by 1 MN per m of thickness. It
    consists of Sx × Sy subdomains of n × ny cells of steel. In some subdomains, the
    modulus is multiplied by `jump`: in every other subdomain (``checkerboard``) or
    in the subdomains at the clamped edge (``column``). There is no contact;
    therefore, the dual has equality constraints only. Condition numbers of the dual
    measure the scalability of the method independently of load, stopping criterion
    and units.

    In 3D (dim=3) the plate is a box of Sx × Sy × Sz subdomains with n cells along z. It
    is clamped at x = 0 and pulled along −z by 1 MN on the face at the largest x.
    """

    forms: ClassVar = ("primal", "dual")

    Sx: Annotated[int, Range(1), "subdomains along x"] = 4
    Sy: Annotated[int, Range(1), "subdomains along y"] = 4
    n: Annotated[int, Range(1), "cells of a subdomain along x and z"] = 4
    ny: Annotated[int, Range(0), "cells of a subdomain along y; 0: n"] = 0
    width: Annotated[float, Range(0, MAX_SIZE), "m; 0: Sx"] = 0.0
    height: Annotated[float, Range(0, MAX_SIZE), "m; 0: Sy"] = 0.0
    pattern: Annotated[
        Literal["uniform", "checkerboard", "column"],
        "subdomains whose modulus is multiplied by `jump`",
    ] = "uniform"
    jump: Annotated[float, POSITIVE, "ratio of the two moduli"] = 1.0
    glue: Glue = "orthonormal"
    dim: Dimension = 2
    Sz: Annotated[int, Range(1), "subdomains along z in 3D"] = 1

    def __post_init__(self) -> None:
        """Check that every key is used, and that the plate fits into memory."""
        super().__post_init__()
        check_memory(self.dim * math.prod(self.divisions))
        for name in ("width", "height"):
            if 0 < (value := getattr(self, name)) < MIN_SIZE:
                raise InputError(f"{name}={value} must be 0, or at least {MIN_SIZE:g}")
        if self.pattern == "uniform":
            refuse_unused(
                self,
                "jump",
                "pattern=uniform",
                "pattern=checkerboard or pattern=column",
            )
        if self.dim == 2:
            refuse_unused(self, "Sz", "dim=2", "dim=3")

    @property
    def counts(self) -> tuple[int, ...]:
        """Numbers of subdomains along the axes."""
        return (self.Sx, self.Sy, self.Sz)[: self.dim]

    @property
    def side(self) -> tuple[int, ...]:
        """Numbers of cells per subdomain along the axes."""
        return (self.n, self.ny or self.n, self.n)[: self.dim]

    @property
    def divisions(self) -> tuple[int, ...]:
        """Numbers of cells along the axes."""
        return tuple(n * S for n, S in zip(self.side, self.counts, strict=True))

    @property
    def size(self) -> tuple[float, ...]:
        """Lengths along the axes, m."""
        lengths = self.width or self.Sx, self.height or self.Sy, self.Sz
        return tuple(map(float, lengths[: self.dim]))

    @property
    def state(self) -> Plane | None:
        """Plane state; None in 3D."""
        return "strain" if self.dim == 2 else None

    @property
    def moduli(self) -> Vector:
        """Non-dimensional moduli (2,) of the materials, that of steel first."""
        return np.array([1.0, self.jump]) * STEEL.E * PLATE_LENGTH / PLATE_LOAD

    @property
    def D(self) -> NDArray[np.float64]:
        """Non-dimensional elasticity matrices (2, v, v) of the materials."""
        materials = [Material(E, STEEL.nu) for E in self.moduli]
        return np.stack([elasticity_matrix(m, self.state) for m in materials])

    @cached_property
    def mesh(self) -> Mesh:
        """Mesh of the undivided plate."""
        build: Any = rectangle if self.dim == 2 else box
        mesh: Mesh = build((0.0,) * self.dim, self.size, self.divisions)
        return mesh

    @property
    def clamped(self) -> Nodes:
        """Displacement components of the nodes on the clamped side."""
        return dofs_of(nodes_of_side(self.mesh.boundaries["left"]), self.dim)

    @cached_property
    def material(self) -> NDArray[np.int64]:
        """Material of each cell of the undivided plate, (E,)."""
        label = self.in_subdomains().layout.label
        return np.asarray(_pattern(self)[label], dtype=np.int64)

    @cached_property
    def qp(self) -> QP:
        """Primal problem of the undivided plate."""
        mesh = self.mesh
        n = mesh.dofs
        one = csr_array(eye_array(n, format="csr"))
        return QP(
            P=stiffness(mesh, self.D, self.material),
            q=-self.in_subdomains().load,
            A=one[self.clamped],
            b=np.zeros(self.clamped.size),
        )

    def factorise(self) -> GeneralisedInverse:
        """Factorise K without the prescribed components."""
        free = np.setdiff1d(np.arange(self.mesh.dofs), self.clamped)
        return regular_inverse(self.qp.P, free)

    def von_mises(self, u: Vector) -> Vector:
        """Recover the von Mises stress (N,) at the nodes in Pa from u in m.

        A node between two materials has one value, although the stress jumps there.
        """
        mesh, D = self.mesh, self.D[self.material] * (PLATE_LOAD / PLATE_LENGTH)
        stress = recover(mesh, centre_stress(mesh, D, u))
        return von_mises(stress, STEEL.nu, self.state)

    def decomposed_case(self, served: Served) -> Case:
        """Return the case of the dual in subdomains, with condition numbers."""
        case = super().decomposed_case(served)
        conditions = cache(
            lambda: dual_quantities(self.moduli, case.qp, served.torn.rows.B)
        )
        return replace(
            case, quantities=lambda s: {**case.quantities(s), **conditions()}
        )

    def case(
        self,
        new: Transformed,
        subdomains: Callable[[], DecomposedMechanics] | None = None,
    ) -> Case:
        """Return the case of a form of the problem."""
        mesh, unit = self.mesh, PLATE_LOAD * PLATE_LENGTH
        cells = len(mesh.cells)
        return Case(
            qp=new.qp,
            recover=lambda s: new.recover(s).x * PLATE_LENGTH,
            quantities=lambda s: self.quantities(new.recover(s)),
            fields=lambda s: Fields(
                points=mesh.points,
                cells=mesh.cells,
                bodies=self.material,
                displacement=as_vectors(new.recover(s).x * PLATE_LENGTH, mesh.dim),
                nodal={"von_mises": self.von_mises(new.recover(s).x * PLATE_LENGTH)},
            ),
            scale=new.sign * unit,
            constant=new.constant * unit,
            mechanics=Mechanics(
                primal=self.qp,
                to_primal=new.recover,
                factorise=self.factorise,
                rigid=rigid_modes(mesh.points),
                names=("plate",),
                grid=Grid(mesh.points, mesh.cells, np.zeros(cells, dtype=np.int64)),
                subdomains=subdomains,
            ),
        )

    def quantities(self, s: Solution) -> dict[str, Any]:
        """Return counts, the energy in J/m (3D: J), and the tip displacement in m.

        The tip is the corner with the largest coordinates.
        """
        mesh = self.mesh
        tip = dofs_of(np.array([len(mesh.points) - 1]), mesh.dim)
        return {
            "nodes": len(mesh.points),
            "elements": len(mesh.cells),
            "dofs": mesh.dofs,
            "equality_rows": self.qp.b.size,
            "energy": self.qp.objective(s.x) * PLATE_LOAD * PLATE_LENGTH,
            "tip": (s.x[tip] * PLATE_LENGTH).tolist(),
        }

    def in_subdomains(self) -> DecomposedProblem:
        """Return the decomposed problem: a contact problem without contact rows."""
        mesh, none = self.mesh, np.zeros(0)
        body = np.zeros(len(mesh.cells), dtype=np.int64)
        layout = Subdivision(mesh, blocks(self.divisions, self.side), body)
        return DecomposedProblem(
            layout=layout,
            components=self.dim,
            E=self.moduli[:1],
            names=("plate",),
            glue=self.glue,
            material=_pattern(self),
            assemble_class=partial(elastic_class, D=self.D, E=self.moduli),
            load=_pull(mesh),
            fixed=self.clamped,
            contact=Contact(no_rows(self.dim * layout.nodes), none, none),
        )


def _pattern(plate: Plate) -> NDArray[np.int64]:
    """Return the material of each subdomain, (S,)."""
    counts = plate.counts[::-1]
    place = np.array(np.unravel_index(np.arange(np.prod(counts)), counts))
    patterns: dict[str, NDArray[np.int64]] = {
        "uniform": np.zeros_like(place[0]),
        "checkerboard": place.sum(axis=0) % 2,
        "column": (place[-1] == 0).astype(np.int64),
    }
    return patterns[plate.pattern]


def _pull(mesh: Mesh) -> Vector:
    """Return the load (n,), a constant traction on the right side."""
    nodes, share = nodal_sizes(mesh.points, mesh.boundaries["right"])
    f = np.zeros(mesh.dofs)
    f[dofs_of(nodes, mesh.dim, mesh.dim - 1)] = -share / share.sum()
    return f


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
