"""Data of bodies and solutions on one rank, for certificates and physical results."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import cache, cached_property
from itertools import combinations
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag, null_space
from scipy.sparse import csc_array, csr_array, hstack

from mortarbench.harness import Solution, Vector
from mortarbench.harness.distributed.vectors import Evaluation
from mortarbench.harness.verify.certificate import Certificate
from mortarbench.harness.verify.over_ranks import (
    Contact,
    FloatingBodies,
    LocalBodies,
    certify_over_ranks,
)
from mortarbench.problems.fem.mesh import Nodes
from mortarbench.problems.feti.distributed import Halo
from mortarbench.problems.feti.subdivision import Points
from mortarbench.problems.feti.subdomains import (
    DecomposedProblem,
    LocalSubdomains,
)
from mortarbench.problems.feti.substructures import LocalProblems


@dataclass(frozen=True, eq=False, kw_only=True)
class LocalSolution:
    """Local part of a displacement, with contact multipliers replicated on all ranks.

    All ranks must call its methods together; the results are equal on all ranks.
    """

    subdomains: LocalSubdomains
    bodies: LocalBodies
    #: (n,) displacement at `bodies.components`; equal on all ranks that share a
    #: component
    u: Vector
    z: Vector  #: (m,) multipliers of all rows of contact and friction

    def at(self, component: Nodes) -> Vector:
        """Return the nondimensional displacement (w,) at global components."""
        return np.asarray(self.bodies.reduction.values_at(self.u, component))

    def diagonal(self, component: Nodes) -> Vector:
        """Return diagonal entries (w,) of the undivided stiffness matrix K.

        component : (w,) global components
        """
        reduction = self.bodies.reduction
        places, here = reduction.places(component)
        local = np.unique(places[here])
        values = np.zeros(self.u.size)
        values[local] = self.bodies.parts.diagonal(local)
        return np.asarray(reduction.values_at(reduction.completed(values), component))

    @cached_property
    def energy(self) -> float:
        """Nondimensional potential energy ½uᵀKu − fᵀu of all bodies on all ranks."""
        v = self.bodies.parts.spread @ self.u
        work = v @ self.bodies.parts.product(v) / 2 - v @ self.bodies.f
        return self.bodies.reduction.total(float(work))[0]


#: function that evaluates physical results in SI units, equal on all ranks
Results = Callable[[LocalSolution], Mapping[str, Any]]


def local_solution(local: LocalSubdomains, halo: Halo, s: Solution) -> LocalSolution:
    """Recover the local displacement from the multipliers of the dual.

    The torn displacement is v = K⁺(f − Bᵀλ) − Rα, where α are the multipliers of
    RᵀBᵀλ = Rᵀf. The result is the average of v over the copies of each node on all
    ranks (see `problems.duality.feti_dual`). Eliminated components are zero.
    """
    bodies, multiplicity = _local_bodies(local.floating)
    T, alpha = bodies.parts.spread, np.asarray(s.y)[local.local_motions]
    multipliers = halo.gather(np.asarray(s.x))
    v = np.zeros(T.shape[0])
    v[local.free] = local.domains.inverse(local.f - local.rows.B.T @ multipliers)
    v[local.free] -= local.domains.kernel @ alpha
    u = bodies.reduction.completed(T.T @ v) / multiplicity
    z = contact_multipliers(local, halo, s)
    return LocalSolution(subdomains=local, bodies=bodies, u=u, z=z)


def contact_multipliers(local: LocalSubdomains, halo: Halo, s: Solution) -> Vector:
    """Return the multipliers (m,) of all unscaled contact and friction rows."""
    rows, scale = local.rows, local.problem.contact_scale
    owned = rows.number[halo.owned]
    is_contact = owned >= rows.equalities
    z = np.zeros(scale.size)
    z[owned[is_contact] - rows.equalities] = np.asarray(s.x)[is_contact]
    return np.asarray(scale * local.ranks.total(z))


def evaluation(
    local: LocalSubdomains,
    halo: Halo,
    decomposition: Mapping[str, Any],
    reported: Results | None,
) -> Callable[[Solution], Evaluation]:
    """Return a function that evaluates physical results for the local subdomains.

    Parameters
    ----------
    decomposition : quantities of the decomposition, added to the physical results
    reported : function that evaluates physical results; None if they require the
        undivided bodies

    """
    problem = local.problem

    def answer(s: Solution) -> Evaluation:
        solution, results = local_solution(local, halo, s), None
        if reported is not None:

            def results() -> Mapping[str, Any]:
                return {**reported(solution), **decomposition}

        return Evaluation(
            (solution.bodies, solution.u, solution.z[_force_rows(problem)]), results
        )

    return answer


def certifier(
    local: LocalSubdomains, K: csc_array
) -> Callable[[Vector, Vector], Certificate]:
    """Return a function that certifies solutions on a single process.

    Its arguments are a displacement and contact multipliers; the certificate bounds the
    error of the displacement.

    K : (n, n) stiffness matrix of the undivided bodies
    """
    bodies = cache(lambda: replace(local_bodies(local), stored=csr_array(K)))
    return lambda u, multipliers: certify_over_ranks(bodies(), u, multipliers)


def local_bodies(local: LocalSubdomains) -> LocalBodies:
    """Return the data for certificates on this rank; supports are rows of B."""
    return _local_bodies(local.floating)[0]


def _local_bodies(local: LocalSubdomains) -> tuple[LocalBodies, Vector]:
    """Return the data for certificates, and the number of copies of each component.

    local : floating subdomains, with supports as rows of B
    """
    problem, components, place = local.problem, local.components, local.place
    contact, active = problem.contact, _force_rows(problem)
    multiplicity = np.empty(components.size)
    multiplicity[place] = local.multiplicity
    parts = LocalProblems(local.decomposed, problem.components)
    return LocalBodies(
        ranks=local.ranks,
        parts=parts,
        components=components,
        shared=np.bincount(place, minlength=multiplicity.size) < multiplicity,
        coarse=local.local_motions,
        motions=local.coarse_size,
        f=local.f,
        fixed=np.flatnonzero(np.isin(components, problem.fixed)),
        contact=Contact(
            rows=csr_array(contact.rows[active]),
            c=contact.c[active],
            bound=contact.bound[contact.bound > 0],
            tangents=contact.tangents,
        ),
        floating=_floating_bodies(local),
    ), multiplicity


def _force_rows(problem: DecomposedProblem) -> Nodes:
    """Return the indices of all contact rows, and of friction rows with bounds > 0."""
    m, bound = problem.contact.rows.shape[0], problem.contact.bound
    return np.flatnonzero(np.append(np.ones(m - bound.size), bound) > 0)


def floating_bodies(problem: DecomposedProblem) -> list[int]:
    """Return the indices of the pieces that the supports allow to move rigidly."""
    layout, d = problem.layout, problem.components
    node, axis = np.divmod(problem.fixed, d)
    body = problem.piece_of[layout.holder(node)]

    def is_supported(b: int) -> bool:
        fixed = body == b
        if not fixed.any():
            return False
        points = layout.position(node[fixed])
        size = np.ptp(points, axis=0).max() or 1.0
        motions = _motions((points - points[0]) / size, axis[fixed], d)
        return bool(np.linalg.matrix_rank(motions) == motions.shape[1])

    return [b for b in range(int(problem.piece_of.max()) + 1) if not is_supported(b)]


def _motions(points: Points, axis: Nodes, d: int) -> NDArray[np.float64]:
    """Return the r = d (d + 1) / 2 rigid motions (k, r) at k displacement components.

    The modes are those of `problems.fem.elasticity.rigid_motions`, with rotations about
    the origin.

    points : (k, dim) point of each component
    axis : (k,) axis of each component, 0 … d − 1
    d : number of components per node
    """
    columns = [np.where(axis == k, 1.0, 0.0) for k in range(d)]
    for k, l in combinations(range(d), 2):
        column = np.where(axis == l, points[:, k], 0.0)
        columns.append(np.where(axis == k, -points[:, l], column))
    return np.stack(columns, axis=1)


class _Extent(NamedTuple):
    """Centre and size of a body with N nodes."""

    centre: Vector  #: (dim,) centroid of the nodes
    radius: float  #: root mean square distance of the nodes from the centroid
    size: float  #: √N for a body with N nodes
    #: (3, 3) matrix that combines the rotations into orthonormal ones; None in 2D, with
    #: at most one rotation
    turn: NDArray[np.float64] | None

    def motions(self, points: Points, axis: Nodes, d: int) -> NDArray[np.float64]:
        """Return rigid motions (k, r) that are orthonormal over all nodes of the body.

        points, axis, d : see `_motions`
        """
        motions = _motions((points - self.centre) / self.radius, axis, d)
        if self.turn is not None:
            motions[:, d:] = motions[:, d:] @ self.turn
        return motions / self.size


def _floating_bodies(local: LocalSubdomains) -> FloatingBodies:
    """Return the rigid motions of all floating bodies at the local components."""
    # index of one copy of each local node among the local torn nodes
    copy = np.unique(local.nodes.number, return_index=True)[1]
    problem, layout, d = local.problem, local.problem.layout, local.problem.components
    components = d * copy.size
    motions, remaining, names = [csr_array((components, 0))], list[Any](), list[str]()
    if not (numbers := floating_bodies(problem)):
        return FloatingBodies(
            motions=motions[0], combinations=np.zeros((0, 0)), names=()
        )
    points = np.concatenate([*layout.points(local.number)])
    body = problem.piece_of[local.number][local.nodes.subdomain]
    fixed, axis = np.divmod(problem.fixed, d)
    body_fixed = problem.piece_of[layout.holder(fixed)]
    for b in numbers:
        extent = _extent(
            local, points, np.where(body == b, 1 / local.nodes.multiplicity, 0.0)
        )
        of_body = body_fixed == b
        at_fixed = extent.motions(layout.position(fixed[of_body]), axis[of_body], d)
        remaining.append(
            null_space(at_fixed) if of_body.any() else np.eye(at_fixed.shape[1])
        )
        nodes = np.flatnonzero(body[copy] == b)
        at = np.repeat(points[copy[nodes]], d, axis=0)
        modes = extent.motions(at, np.tile(np.arange(d), nodes.size), d)
        rows = (d * nodes[:, None] + np.arange(d)).ravel()
        embedding = csr_array(
            (np.ones(rows.size), (rows, np.arange(rows.size))),
            shape=(components, rows.size),
        )
        motions.append(embedding @ csr_array(modes))
        names.append(problem.names[b])
    return FloatingBodies(
        motions=csr_array(hstack(motions)),
        combinations=block_diag(*remaining),
        names=tuple(names),
    )


def _extent(local: LocalSubdomains, points: Points, share: Vector) -> _Extent:
    """Return the extent of a distributed body; all ranks must call this together.

    Parameters
    ----------
    points : (M, dim) points of the local torn nodes
    share : (M,) weights: the reciprocal number of copies at nodes of the body, zero at
        all other nodes

    """
    total = local.ranks.total
    count, *moments = total(np.append(share.sum(), share @ points))
    centre = np.array(moments) / count
    spread = total(np.array([share @ ((points - centre) ** 2).sum(axis=1)]))[0]
    radius, d, rotations = (
        float(np.sqrt(spread / count)),
        local.problem.components,
        None,
    )
    if d > 2:
        scaled = np.repeat((points - centre) / radius, d, axis=0)
        modes = _motions(scaled, np.tile(np.arange(d), len(points)), d)[:, d:]
        gram = total(modes.T @ (np.repeat(share, d)[:, None] * modes) / count)
        sizes, axes = np.linalg.eigh(gram)
        rotations = axes / np.sqrt(sizes)
    return _Extent(centre, radius, float(np.sqrt(count)), rotations)
