"""What a rank has of torn bodies and of an answer, to certify and to report it."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.sparse import bsr_array, csr_array

from harness import Solution, Vector
from harness.distributed.vectors import Answered
from harness.verify.over_ranks import Contact, OwnBodies
from problems.fem.mesh import Nodes
from problems.feti.distributed import Halo
from problems.feti.substructures import LocalProblems
from problems.feti.torn import Torn

if TYPE_CHECKING:
    from problems.feti.emission import OwnSubdomains, ProblemInParts


@dataclass(frozen=True, eq=False, kw_only=True)
class OwnSolution:
    """What one rank has of a displacement, and the forces along all contacts.

    Its methods are called by all ranks, and give them the same.
    """

    subdomains: OwnSubdomains
    bodies: OwnBodies
    u: Vector  #: (n,) at `bodies.components`, the same of copies on several ranks
    z: Vector  #: (m,) multipliers of all rows of contact and friction, on every rank

    def at(self, component: Nodes) -> Vector:
        """Tell all ranks the displacement at components (w,) of the whole."""
        return np.asarray(self.bodies.among.traced(self.u, component))

    def diagonal(self, component: Nodes) -> Vector:
        """Tell all ranks the diagonal of K at components (w,) of the whole."""
        among = self.bodies.among
        places, here = among.places(component)
        known = np.unique(places[here])
        found = np.zeros(self.u.size)
        found[known] = self.bodies.parts.diagonal(known)
        return np.asarray(among.traced(among.completed(found), component))

    @cached_property
    def energy(self) -> float:
        """½uᵀKu − fᵀu of the whole."""
        v = self.bodies.parts.spread @ self.u
        work = v @ self.bodies.parts.product(v) / 2 - v @ self.bodies.f
        return self.bodies.among.total(float(work))[0]


#: of what ranks have found → physical results, SI, the same on all ranks
Results = Callable[[OwnSolution], Mapping[str, Any]]


def own_solution(
    own: OwnSubdomains, halo: Halo, scale: Vector, s: Solution
) -> OwnSolution:
    """Go back from multipliers to displacements, on each rank for its own.

    It is the way of `problems.duality.torn_dual`: v = K⁺(f − Bᵀλ) − Rα with α the
    multipliers of RᵀBᵀλ = Rᵀf, averaged over the copies on all ranks.

    scale : (m,) by which the rows of contact and friction are multiplied
    """
    rows = own.rows
    bodies, times = _bodies(own)
    T, R = bodies.parts.spread, bodies.parts.kernel
    touched = halo.gathered(np.asarray(s.x))
    v = own.domains.inverse(own.f - rows.B.T @ touched)
    v -= R @ np.asarray(s.y)[bodies.coarse]
    u = bodies.among.completed(T.T @ v) / times
    z = contact_multipliers(own, halo, scale, s)
    return OwnSolution(subdomains=own, bodies=bodies, u=u, z=z)


def contact_multipliers(
    own: OwnSubdomains, halo: Halo, scale: Vector, s: Solution
) -> Vector:
    """Tell all ranks the multipliers (m,) of the rows of contact and friction.

    scale : (m,) by which these rows are multiplied
    """
    rows = own.rows
    owned = rows.number[halo.own]
    is_contact = owned >= rows.equalities
    z = np.zeros(scale.size)
    z[owned[is_contact] - rows.equalities] = np.asarray(s.x)[is_contact]
    return np.asarray(scale * own.ranks.total(z))


def answers(
    own: OwnSubdomains, halo: Halo, scale: Vector, torn: Mapping[str, Any]
) -> Callable[[Solution], Answered]:
    """Make what says what an answer means, on each rank for its own.

    Where the supports leave a rigid motion of some body, only the whole knows what
    holds it; where they are eliminated, subdomains do not float, as is taken here.

    Parameters
    ----------
    scale : as of `own_solution`
    torn : how the bodies are torn, as of `problems.duality.torn_dual.torn_quantities`

    """
    problem, is_held = own.problem, holds_all(own.problem)

    def answer(s: Solution) -> Answered:
        if problem.eliminated:
            return Answered(None, None)
        found, results = own_solution(own, halo, scale, s), None
        if (reported := problem.results) is not None:

            def results() -> Mapping[str, Any]:
                return {**reported(found), **torn}

        return Answered(
            (found.bodies, found.u, found.z[_carrying(problem)]) if is_held else None,
            results,
        )

    return answer


def _bodies(own: OwnSubdomains) -> tuple[OwnBodies, Vector]:
    """Gather what this rank has, and count the copies (n,) of its components."""
    problem, domains, rows = own.problem, own.domains, own.rows
    d, contact, kept = problem.components, problem.contact, _carrying(problem)
    nodes, of_node = np.unique(own.nodes.number, return_inverse=True)
    components, place = (
        (d * at[:, None] + np.arange(d)).ravel() for at in (nodes, of_node)
    )
    times = np.empty(components.size)
    times[place] = own.times
    T = _spread(own, place, components.size)
    first, end = own.motions[own.number], own.motions[own.number + 1]
    coarse = [np.arange(*motions) for motions in zip(first, end, strict=True)]
    torn = Torn(
        kinds=domains.kinds, kind=domains.kind, spread=T, B=rows.B, c=rows.c,
        scale=np.ones(rows.number.size), f=own.f, equalities=rows.equalities,
    )  # fmt: skip
    return OwnBodies(
        ranks=own.ranks, parts=LocalProblems(torn, d), components=components,
        shared=np.bincount(place, minlength=times.size) < times,
        coarse=np.concatenate(coarse),
        motions=own.coarse, f=own.f,
        held=np.flatnonzero(np.isin(components, problem.held)),
        contact=Contact(
            rows=csr_array(contact.rows[kept]), c=contact.c[kept],
            bound=contact.bound[contact.bound > 0],
        ),
    ), times  # fmt: skip


def _spread(own: OwnSubdomains, place: Nodes, n: int) -> csr_array:
    """Return T (N, n): a block Qᵀ for each torn node, into the axes of subdomains."""
    d, N = own.problem.components, place.size
    if d == 1:
        return csr_array((np.ones(N), place, np.arange(N + 1)), shape=(N, n))
    turn = own.rotation[own.nodes.subdomain].transpose(0, 2, 1)
    blocks = np.ascontiguousarray(turn), place[::d] // d, np.arange(N // d + 1)
    T = csr_array(bsr_array(blocks, shape=(N, n)))
    T.eliminate_zeros()
    return T


def _carrying(problem: ProblemInParts) -> Nodes:
    """List the rows of contact, and those of friction with a bound above zero."""
    m, bound = problem.contact.rows.shape[0], problem.contact.bound
    return np.flatnonzero(np.append(np.ones(m - bound.size), bound) > 0)


def holds_all(problem: ProblemInParts) -> bool:
    """Whether the supports leave no rigid motion of any body."""
    of, d = problem.layout, problem.components
    node, k = np.divmod(problem.held, d)
    body = of.body[of.holder(node)]
    for b in range(problem.E.size):
        own = body == b
        if not own.any():
            return False
        if d == 1:
            continue
        points = of.position(node[own])
        size = np.ptp(points, axis=0).max(initial=0.0) or 1.0
        x, y = ((points - points[:1]) / size).T
        along_x = k[own] == 0
        motions = np.stack([along_x, ~along_x, np.where(along_x, -y, x)], axis=1)
        if np.linalg.matrix_rank(motions) < 3:
            return False
    return True
