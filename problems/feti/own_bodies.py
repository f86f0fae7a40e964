"""What a rank has of torn bodies and of an answer, to certify and to report it."""

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
    OwnSubdomains,
    ProblemInParts,
)
from mortarbench.problems.feti.substructures import LocalProblems


@dataclass(frozen=True, eq=False, kw_only=True)
class OwnSolution:
    """What one rank has of a displacement, and the forces along all contacts.

    Its methods are called by all ranks, and give them the same.
    """

    subdomains: OwnSubdomains
    bodies: LocalBodies
    u: Vector  #: (n,) at `bodies.components`, the same of copies on several ranks
    z: Vector  #: (m,) multipliers of all rows of contact and friction, on every rank

    def at(self, component: Nodes) -> Vector:
        """Tell all ranks the displacement at components (w,) of the whole."""
        return np.asarray(self.bodies.reduction.values_at(self.u, component))

    def diagonal(self, component: Nodes) -> Vector:
        """Tell all ranks the diagonal of K at components (w,) of the whole."""
        reduction = self.bodies.reduction
        places, here = reduction.places(component)
        known = np.unique(places[here])
        found = np.zeros(self.u.size)
        found[known] = self.bodies.parts.diagonal(known)
        return np.asarray(reduction.values_at(reduction.completed(found), component))

    @cached_property
    def energy(self) -> float:
        """½uᵀKu − fᵀu of the whole."""
        v = self.bodies.parts.spread @ self.u
        work = v @ self.bodies.parts.product(v) / 2 - v @ self.bodies.f
        return self.bodies.reduction.total(float(work))[0]


#: of what ranks have found → physical results, SI, the same on all ranks
Results = Callable[[OwnSolution], Mapping[str, Any]]


def own_solution(own: OwnSubdomains, halo: Halo, s: Solution) -> OwnSolution:
    """Go back from multipliers to displacements, on each rank for its own.

    It is the way of `problems.duality.torn_dual`: v = K⁺(f − Bᵀλ) − Rα with α the
    multipliers of RᵀBᵀλ = Rᵀf, averaged over the copies on all ranks. Components that
    supports eliminate are zero.
    """
    bodies, times = _bodies(own.floating)
    T, alpha = bodies.parts.spread, np.asarray(s.y)[own.own_motions]
    touched = halo.gathered(np.asarray(s.x))
    v = np.zeros(T.shape[0])
    v[own.kept] = own.domains.inverse(own.f - own.rows.B.T @ touched)
    v[own.kept] -= own.domains.kernel @ alpha
    u = bodies.reduction.completed(T.T @ v) / times
    z = contact_multipliers(own, halo, s)
    return OwnSolution(subdomains=own, bodies=bodies, u=u, z=z)


def contact_multipliers(own: OwnSubdomains, halo: Halo, s: Solution) -> Vector:
    """Return multipliers (m,) of rows of contact and friction, on all ranks."""
    rows, scale = own.rows, own.problem.contact_scale
    owned = rows.number[halo.own]
    is_contact = owned >= rows.equalities
    z = np.zeros(scale.size)
    z[owned[is_contact] - rows.equalities] = np.asarray(s.x)[is_contact]
    return np.asarray(scale * own.ranks.total(z))


def answers(
    own: OwnSubdomains,
    halo: Halo,
    torn: Mapping[str, Any],
    reported: Results | None,
) -> Callable[[Solution], Evaluation]:
    """Make what says what an answer means, on each rank for its own.

    Parameters
    ----------
    torn : how the bodies are torn, as of `problems.duality.torn_dual.torn_quantities`
    reported : reports more of an answer; None where only the whole tells

    """
    problem = own.problem

    def answer(s: Solution) -> Evaluation:
        found, results = own_solution(own, halo, s), None
        if reported is not None:

            def results() -> Mapping[str, Any]:
                return {**reported(found), **torn}

        return Evaluation((found.bodies, found.u, found.z[_carrying(problem)]), results)

    return answer


def certified_by(
    own: OwnSubdomains, K: csc_array
) -> Callable[[Vector, Vector], Certificate]:
    """Return a bound of the error of displacements with multipliers, by subdomains.

    K : (n, n) of the whole, as it is stored on this one process
    """
    bodies = cache(lambda: replace(own_bodies(own), stored=csr_array(K)))
    return lambda u, multipliers: certify_over_ranks(bodies(), u, multipliers)


def own_bodies(own: OwnSubdomains) -> LocalBodies:
    """Gather what certificates need of this rank's subdomains."""
    return _bodies(own.floating)[0]


def _bodies(own: OwnSubdomains) -> tuple[LocalBodies, Vector]:
    """Gather what this rank has, and count the copies (n,) of its components.

    own : its subdomains float
    """
    problem, components, place = own.problem, own.components, own.place
    contact, kept = problem.contact, _carrying(problem)
    times = np.empty(components.size)
    times[place] = own.times
    parts = LocalProblems(own.torn_bodies, problem.components)
    return LocalBodies(
        ranks=own.ranks, parts=parts, components=components,
        shared=np.bincount(place, minlength=times.size) < times,
        coarse=own.own_motions,
        motions=own.coarse, f=own.f,
        fixed=np.flatnonzero(np.isin(components, problem.held)),
        contact=Contact(
            rows=csr_array(contact.rows[kept]), c=contact.c[kept],
            bound=contact.bound[contact.bound > 0],
        ),
        floating=_floating(own),
    ), times  # fmt: skip


def _carrying(problem: ProblemInParts) -> Nodes:
    """List the rows of contact, and those of friction with a bound above zero."""
    m, bound = problem.contact.rows.shape[0], problem.contact.bound
    return np.flatnonzero(np.append(np.ones(m - bound.size), bound) > 0)


def unheld_bodies(problem: ProblemInParts) -> list[int]:
    """List the bodies that supports leave some rigid motion."""
    of, d = problem.layout, problem.components
    node, axis = np.divmod(problem.held, d)
    body = of.body[of.holder(node)]

    def is_held(b: int) -> bool:
        own = body == b
        if not own.any():
            return False
        points = of.position(node[own])
        size = np.ptp(points, axis=0).max() or 1.0
        motions = _motions((points - points[0]) / size, axis[own], d)
        return bool(np.linalg.matrix_rank(motions) == motions.shape[1])

    return [b for b in range(problem.E.size) if not is_held(b)]


def _motions(points: Points, axis: Nodes, d: int) -> NDArray[np.float64]:
    """Return the rigid motions (k, r) of components of points, r = d (d + 1) / 2.

    Those of `problems.fem.elasticity.rigid_motions`, about the origin.

    axis : (k,) of each component, one of d
    """
    found = [np.where(axis == k, 1.0, 0.0) for k in range(d)]
    for k, l in combinations(range(d), 2):
        turned = np.where(axis == l, points[:, k], 0.0)
        found.append(np.where(axis == k, -points[:, l], turned))
    return np.stack(found, axis=1)


class _Extent(NamedTuple):
    """Where a body is, and how large, by its N nodes."""

    centre: Vector  #: (dim,)
    radius: float  #: √ of the mean square distance from it
    size: float  #: √N
    #: (k, k) combines rotations to such that are orthonormal; None for at most one
    turn: NDArray[np.float64] | None

    def motions(self, points: Points, axis: Nodes, d: int) -> NDArray[np.float64]:
        """Return its rigid motions, orthonormal in the sum over all nodes."""
        found = _motions((points - self.centre) / self.radius, axis, d)
        if self.turn is not None:
            found[:, d:] = found[:, d:] @ self.turn
        return found / self.size


def _floating(own: OwnSubdomains) -> FloatingBodies:
    """Gather the rigid motions of the bodies that supports leave any."""
    #: of each own node, in turn, a copy among the own torn nodes
    copy = np.unique(own.nodes.number, return_index=True)[1]
    problem, of, d = own.problem, own.problem.layout, own.problem.components
    components = d * copy.size
    motions, left, names = [csr_array((components, 0))], list[Any](), list[str]()
    if not (unheld := unheld_bodies(problem)):
        return FloatingBodies(
            motions=motions[0], combinations=np.zeros((0, 0)), names=()
        )
    points = np.concatenate([*of.points(own.number)])
    body = of.body[own.number][own.nodes.subdomain]
    held, axis = np.divmod(problem.held, d)
    body_held = of.body[of.holder(held)]
    for b in unheld:
        extent = _extent(own, points, np.where(body == b, 1 / own.nodes.times, 0.0))
        of_body = body_held == b
        at_held = extent.motions(of.position(held[of_body]), axis[of_body], d)
        left.append(null_space(at_held) if of_body.any() else np.eye(at_held.shape[1]))
        mine = np.flatnonzero(body[copy] == b)
        at = np.repeat(points[copy[mine]], d, axis=0)
        found = extent.motions(at, np.tile(np.arange(d), mine.size), d)
        rows = (d * mine[:, None] + np.arange(d)).ravel()
        one = csr_array(
            (np.ones(rows.size), (rows, np.arange(rows.size))),
            shape=(components, rows.size),
        )
        motions.append(one @ csr_array(found))
        names.append(problem.names[b])
    return FloatingBodies(
        motions=csr_array(hstack(motions)),
        combinations=block_diag(*left),
        names=tuple(names),
    )


def _extent(own: OwnSubdomains, points: Points, share: Vector) -> _Extent:
    """Measure a body whose nodes all ranks have; called by all of them.

    Parameters
    ----------
    points : of own torn nodes (M, dim)
    share : (M,) of all copies of a node, which add up to one in the body

    """
    total = own.ranks.total
    count, *moments = total(np.append(share.sum(), share @ points))
    centre = np.array(moments) / count
    spread = total(np.array([share @ ((points - centre) ** 2).sum(axis=1)]))[0]
    radius, d, turn = float(np.sqrt(spread / count)), own.problem.components, None
    if d > 2:
        scaled = np.repeat((points - centre) / radius, d, axis=0)
        turns = _motions(scaled, np.tile(np.arange(d), len(points)), d)[:, d:]
        gram = total(turns.T @ (np.repeat(share, d)[:, None] * turns) / count)
        sizes, axes = np.linalg.eigh(gram)
        turn = axes / np.sqrt(sizes)
    return _Extent(centre, radius, float(np.sqrt(count)), turn)
