"""Solutions and physical results on one rank."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mortarbench.harness import Solution, Vector
from mortarbench.harness.distributed.vectors import Evaluation
from mortarbench.problems.fem.mesh import Nodes
from mortarbench.problems.feti.distributed import Halo
from mortarbench.problems.feti.subdomains import LocalSubdomains
from mortarbench.problems.feti.substructures import LocalProblems


class LocalBodies:
    """Subdomains that one rank stores, and sums over all ranks."""

    def __init__(self, local: LocalSubdomains) -> None:
        """Exchange the numbers of the components that several ranks store.

        local : floating subdomains, with supports as rows of B
        """
        self.ranks, self.f = local.ranks, local.f
        self.parts = LocalProblems(local.decomposed, local.problem.components)
        self.components, place = local.components, local.place
        #: (n,) number of copies of each component on all ranks
        self.multiplicity = np.empty(self.components.size)
        self.multiplicity[place] = local.multiplicity
        shared = np.bincount(place, minlength=self.multiplicity.size)
        self._shared = shared < self.multiplicity
        comm, mine = self.ranks.comm, self.components[self._shared]
        interface = np.unique(np.concatenate(comm.allgather(mine)))
        self._place = np.searchsorted(interface, mine)
        first = np.full(interface.size, comm.size)
        first[self._place] = comm.rank
        lowest = np.min(comm.allgather(first), axis=0)
        #: (n,) mask of the components that no lower rank stores
        self._is_owner = np.ones(self.components.size, dtype=bool)
        self._is_owner[self._shared] = lowest[self._place] == comm.rank
        self._size = interface.size

    def completed(self, v: Vector) -> Vector:
        """Add other ranks' contributions to v (n,)."""
        exchanged = np.zeros(self._size)
        exchanged[self._place] = v[self._shared]
        complete = v.copy()
        complete[self._shared] = self.ranks.total(exchanged)[self._place]
        return complete

    def values_at(self, v: Vector, at: Nodes) -> Vector:
        """Return the values of v (n,) at global components `at` (w,), on all ranks."""
        places, here = self.places(at)
        owned = self._is_owner[places[here]]  # count each component on one rank only
        values = np.zeros(at.size)
        values[np.flatnonzero(here)[owned]] = v[places[here][owned]]
        return np.asarray(self.ranks.total(values))

    def places(self, at: Nodes) -> tuple[Nodes, NDArray[np.bool_]]:
        """Return the local position of each component `at`, and a mask of local ones.

        Both have the shape (w,). Positions are meaningless where the mask is False.
        """
        places = np.searchsorted(self.components, at)
        places = np.minimum(places, self.components.size - 1)
        return places, self.components[places] == at


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
        return np.asarray(self.bodies.values_at(self.u, component))

    def diagonal(self, component: Nodes) -> Vector:
        """Return diagonal entries (w,) of the undivided stiffness matrix K.

        component : (w,) global components
        """
        places, here = self.bodies.places(component)
        local = np.unique(places[here])
        values = np.zeros(self.u.size)
        values[local] = self.bodies.parts.diagonal(local)
        return self.bodies.values_at(self.bodies.completed(values), component)

    @cached_property
    def energy(self) -> float:
        """Nondimensional potential energy ½uᵀKu − fᵀu of all bodies on all ranks."""
        v = self.bodies.parts.spread @ self.u
        work = v @ self.bodies.parts.product(v) / 2 - v @ self.bodies.f
        return float(self.bodies.ranks.total(np.array([work]))[0])


#: function that evaluates physical results in SI units, equal on all ranks
Results = Callable[[LocalSolution], Mapping[str, Any]]


def local_solution(local: LocalSubdomains, halo: Halo, s: Solution) -> LocalSolution:
    """Recover the local displacement from the multipliers of the dual.

    The torn displacement is v = K⁺(f − Bᵀλ) − Rα, where α are the multipliers of
    RᵀBᵀλ = Rᵀf. With clusters, K̃⁺ and RN replace K⁺ and R (see `Clusters`). The result
    is the average of v over the copies of each node on all ranks (see
    `problems.duality.feti_dual`). Eliminated components are zero.
    """
    bodies = LocalBodies(local.floating)
    T, alpha = bodies.parts.spread, np.asarray(s.y)[local.local_unit_motions]
    multipliers = halo.gather(np.asarray(s.x))
    v = np.zeros(T.shape[0])
    v[local.free] = local.units.inverse(local.f - local.rows.B.T @ multipliers)
    v[local.free] -= local.units.kernel @ alpha
    u = bodies.completed(T.T @ v) / bodies.multiplicity
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

    def answer(s: Solution) -> Evaluation:
        solution, results = local_solution(local, halo, s), None
        if reported is not None:

            def results() -> Mapping[str, Any]:
                return {**reported(solution), **decomposition}

        return Evaluation(results)

    return answer
