"""Certificates for decomposed bodies, computed by the ranks that store the subdomains.

The method is described in `harness.verify.substructured`; MPI reductions complete the
sums. Each rank stores the components of its subdomains. A component that several ranks
store has the same value on all these ranks. The contact and friction rows and the
coarse problem are replicated on all ranks. The number of contact and friction rows is
of the order of the number of nodes of the contact sides.

If only contact supports a body, its rigid motions are the few columns of a distributed
matrix R, and products with Rᵀ are reductions in extended precision. The equilibrium of
λ̂ with the load (`harness.verify.admissible.Balance`) requires only the load along R
and the replicated motion of the contact rows.

K is defined as the sum TᵀK_T T over subdomains. On several ranks, K is not assembled,
so that the certificate includes no rounding from assembly.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array, csc_array, csr_array, diags_array

from mortarbench.harness.distributed.vectors import Ranks
from mortarbench.harness.mechanics import (
    AdmissibleForces,
    Exact,
    Extended,
    Real,
    Substructures,
    cancelling,
    constrained_first,
    friction_discs,
)
from mortarbench.harness.qp import Vector
from mortarbench.harness.verify.active_set_refinement import suggested
from mortarbench.harness.verify.admissible import (
    Balance,
    UncertifiableError,
    driven,
    feasible_at_rows,
    is_driven,
)
from mortarbench.harness.verify.certificate import (
    Certificate,
    is_sharp,
    proven,
    sharpest,
)
from mortarbench.harness.verify.products import times_columns, times_rows
from mortarbench.harness.verify.substructured import (
    SAFETY,
    Residual,
    Rounding,
    Sharing,
    length,
    sample,
    scaled_rows,
    without_rigid_motion,
)


@dataclass(frozen=True, eq=False, kw_only=True)
class Contact:
    """Contact rows, then friction rows with a positive bound; replicated on ranks."""

    rows: csr_array  #: (m, n) rows; the columns are the global components
    c: Vector  #: (m,) right-hand sides
    bound: Vector  #: (k,) friction bounds of the last k rows
    tangents: int = 1  #: number of friction rows of each tangential vector


@dataclass(frozen=True, eq=False, kw_only=True)
class FloatingBodies:
    """Rigid motions of bodies that supports do not fix, at the components of a rank.

    The columns of `motions` and of `combinations` are orthonormal to double precision,
    the former in the inner product over the components of all ranks.
    """

    motions: csr_array  #: (n, k) rigid motions, ordered by body, regardless of supports
    #: (k, r) coefficients of motions that do not move prescribed components
    combinations: NDArray[np.float64]
    names: tuple[str, ...]  #: names of these bodies


@dataclass(frozen=True, eq=False, kw_only=True)
class LocalBodies:
    """Subdomains of decomposed bodies that one rank stores."""

    ranks: Ranks
    #: local subdomains; the matrix T has a column for each local component
    parts: Substructures
    components: NDArray[np.int64]  #: (n,) global numbers of components, ascending
    shared: NDArray[np.bool_]  #: (n,) mask of components that are also on other ranks
    coarse: NDArray[np.int64]  #: (r,) global numbers of local rigid motions
    motions: int  #: number of rigid motions of all subdomains
    f: Vector  #: (N,) load; the load of a component is the sum over its copies
    fixed: NDArray[np.int64]  #: (h,) positions of prescribed components
    contact: Contact
    floating: FloatingBodies
    #: (n, n) K as assembled by a single process; None on several ranks. The rounding of
    #: the assembled K affects the error if an answer moves bodies together with their
    #: supports
    stored: csr_array | None = None

    @cached_property
    def reduction(self) -> MPIReduction:
        """Sums over all ranks."""
        return MPIReduction(self)


class MPIReduction:
    """Sums over MPI ranks; see `harness.verify.substructured.Reduction`."""

    def __init__(self, local: LocalBodies) -> None:
        self._local, comm = local, local.ranks.comm
        mine = local.components[local.shared]
        interface = np.unique(np.concatenate(comm.allgather(mine)))
        self._size = interface.size
        #: (n,) position of each component among all shared components; -1 if not shared
        self._place = np.full(local.components.size, -1)
        self._place[local.shared] = np.searchsorted(interface, mine)
        first = np.full(interface.size, comm.size)
        first[self._place[local.shared]] = comm.rank
        lowest = np.min(comm.allgather(first), axis=0)
        #: (n,) mask of the components that no lower rank stores; this rank contributes
        #: these components to sums
        self.is_owner = np.ones(local.components.size, dtype=bool)
        self.is_owner[local.shared] = lowest[self._place[local.shared]] == comm.rank

    def summed(self, x: NDArray[Any]) -> NDArray[Any]:
        """Sum arrays in the order of the ranks; all ranks get identical sums."""
        parts = np.empty((self._local.ranks.size, *x.shape), dtype=x.dtype)
        self._local.ranks.comm.Allgather(x, parts)
        return np.asarray(parts.sum(axis=0))

    def completed(self, v: Any, at: Any = None) -> Any:
        """Add other ranks' contributions to v at components `at` (default: all)."""
        place = self._place if at is None else self._place[at]
        here = place >= 0
        exchanged = np.zeros(self._size, dtype=v.dtype)
        exchanged[place[here]] = v[here]
        complete = v.copy()
        complete[here] = self.summed(exchanged)[place[here]]
        return complete

    def along(self, M: Any, v: NDArray[Any]) -> NDArray[Any]:
        """Return Mᵀv (k,), summed over all ranks, for sparse M (n, k) and v (n,)."""
        return self.summed(np.asarray(M.T @ np.where(self.is_owner, v, 0)))

    def total(self, *numbers: float) -> list[float]:
        """Sum each number over all ranks."""
        return [float(x) for x in self._local.ranks.total(np.array(numbers))]

    def gathered(self, alpha: Vector) -> Vector:
        """Gather the coefficients of the rigid motions of all subdomains."""
        whole = np.zeros(self._local.motions)
        whole[self._local.coarse] = alpha
        return self.summed(whole)

    def local_part(self, alpha: Vector) -> Vector:
        """Extract the coefficients of the local rigid motions."""
        return np.asarray(alpha[self._local.coarse])

    def values_at(self, v: NDArray[Any], at: NDArray[np.int64]) -> Any:
        """Return the values of v (n,) at global components `at` (w,), on all ranks."""
        places, here = self.places(at)
        owned = self.is_owner[places[here]]  # count each component on one rank only
        values = np.zeros(at.size, dtype=v.dtype)
        values[np.flatnonzero(here)[owned]] = v[places[here][owned]]
        return self.summed(values)

    def places(
        self, at: NDArray[np.int64]
    ) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
        """Return the local position of each component `at`, and a mask of local ones.

        Both have the shape (w,). Positions are meaningless where the mask is False.
        """
        local = self._local.components
        places = np.minimum(np.searchsorted(local, at), local.size - 1)
        return places, local[places] == at

    def coarse(self, M: csr_array, S: csr_array, scale: Vector, at: Any) -> csr_array:
        """Return  M − Sᵀ diag(scale) S  (r, r),  with M and S summed over all ranks.

        S has a row for each shared component `at` (t,).
        """
        r, comm = self._local.motions, self._local.ranks.comm
        place = self._place[at]
        # components on this rank only are eliminated here; shared ones are sent
        inner, jointly = place < 0, place >= 0
        S_inner = csr_array(S[inner])
        mine = coo_array(M - S_inner.T @ scaled_rows(S_inner, scale[inner]))
        numbers = self._local.coarse
        row, column = numbers[mine.row], numbers[mine.col]
        local_part = csr_array((mine.data, (row, column)), shape=(r, r))
        rows = coo_array(S[jointly])
        across = csr_array(
            (rows.data, (place[jointly][rows.row], numbers[rows.col])),
            shape=(self._size, r),
        )
        weight = np.zeros(self._size)
        weight[place[jointly]] = scale[jointly]
        parts, crossing, weights = zip(
            *comm.allgather((local_part, across, weight)), strict=True
        )
        S_all = csr_array(sum(crossing[1:], start=crossing[0]))
        whole = sum(parts[1:], start=parts[0])
        return csr_array(whole - S_all.T @ scaled_rows(S_all, np.max(weights, axis=0)))


@np.errstate(all="ignore")  # a point may contain 1e300, as in `certify`
def certify_over_ranks(
    local: LocalBodies, claimed: Vector, multipliers: Vector
) -> Certificate:
    """Bound the error of an answer; called by all ranks, which obtain the same bound.

    The pairs of `harness.verify.certificate.certify` are tried, the second before the
    first, except the pair that results from an exchange of closed rows.

    Parameters
    ----------
    claimed : (n,) displacement of the local components
    multipliers : (m,) multipliers of all rows, replicated

    Returns
    -------
    a certificate, whose `u` and `off` contain only local components and subdomains

    Raises
    ------
    UncertifiableError
        If the answer contains NaN or inf, or if no pair proves a bound.
    """
    finite = np.isfinite(claimed).all() and np.isfinite(multipliers).all()
    if local.reduction.total(float(finite))[0] < local.ranks.size:
        raise UncertifiableError("the answer contains NaN or inf")
    u = claimed.astype(Real)
    u[local.fixed] = 0
    split = _OnRanks(local)
    at, exact, rigid, softness = split.at, split.exact, split.rigid, split.softness
    u = rigid.without_free(local, u)
    trace = local.reduction.values_at(u, at)
    raw = exact.forces.project(multipliers.astype(Real))
    active = suggested(exact, trace, raw)
    complementary = active.at_bounds(raw), active.closed
    none = np.zeros(raw.size, dtype=bool)

    def attempt(
        u: Extended, trace: Extended, lam: Extended, closed: NDArray[np.bool_]
    ) -> Certificate | str:
        try:
            at_rows, feasible, forces = _admissible_pair(
                local, exact, rigid, (at, softness, trace), u, lam, closed
            )
            return proven(
                split,
                exact,
                rigid.balance.G,
                claimed=claimed,
                u=feasible,
                at_rows=at_rows,
                multipliers=forces,
            )
        except UncertifiableError as e:
            return str(e)

    def certificates() -> Iterator[Certificate | str]:
        for lam, closed in (complementary, (raw, none)):
            certificate = attempt(u, trace, lam, closed)
            yield certificate
            if is_sharp(certificate):
                return

    def at_rest() -> Certificate | str:
        return attempt(0 * u, 0 * trace, 0 * raw, none)

    return sharpest(certificates(), at_rest)


def _admissible_pair(
    local: LocalBodies,
    exact: Exact,
    rigid: _RigidMotions,
    trace: tuple[NDArray[np.int64], Vector, Extended],
    u: Extended,
    lam: Extended,
    closed: NDArray[np.bool_],
) -> tuple[Extended, Extended, Extended]:
    """Return û at the components in rows (w,), û at local components (n,), and λ̂.

    trace : global components in rows (w,), and 1/Kᵢᵢ (w,) and u (w,) at these
        components

    Raises
    ------
    UncertifiableError
        If no admissible pair near the answer is found.

    """
    at, softness, start = trace
    found = feasible_at_rows(exact, rigid.at_rows, softness, start, closed)
    if found is None:
        raise UncertifiableError(
            "no displacement without penetration was found near the answer"
        )
    if rigid.driven:
        raise UncertifiableError(rigid.driven)
    places, here = local.reduction.places(at)
    feasible = rigid.moved(u * found.theta, found.u[at.size :])
    feasible[places[here]] = found.u[: at.size][here]
    return found.u[: at.size], feasible, rigid.balance.near(lam)


def _at_rows(local: LocalBodies, at: NDArray[np.int64]) -> tuple[Exact, Vector]:
    """Return the data of the rows, restricted to the components `at` (w,), and 1/Kᵢᵢ.

    1/Kᵢᵢ (w,) is replaced by 0 at fixed components; `f` of the data is empty.
    """
    contact = local.contact
    B, m = csr_array(contact.rows[:, at]), contact.c.size
    places, here = local.reduction.places(at)
    diagonal = np.zeros(local.components.size)
    present = np.unique(places[here])
    diagonal[present] = local.parts.diagonal(present)
    diagonal = local.reduction.values_at(local.reduction.completed(diagonal), at)
    free = np.ones(local.components.size)
    free[local.fixed] = 0
    is_free = local.reduction.values_at(free, at) > 0
    softness = np.where(is_free & (diagonal > 0), 1 / diagonal, 0)
    first = m - contact.bound.size
    return Exact(
        f=np.zeros(0, dtype=Real),
        B=B.astype(Real),
        c=contact.c.astype(Real),
        fixed=np.flatnonzero(~is_free),
        forces=AdmissibleForces(
            m, friction_discs(contact.bound, contact.tangents, first)
        ),
        compliance=(B.multiply(B) @ softness).astype(Real),
    ), softness


@dataclass(frozen=True, eq=False)
class _RigidMotions:
    """Rigid motions that the supports allow, and the equilibrium of loads along them.

    Columns are orthonormal in extended precision, in the inner product over the
    components of all ranks. Products of K_T with these motions are exactly zero.
    """

    #: (n, r) sparse, at local components. The first p ("constrained") motions change
    #: gaps or slip; the other ("free") motions change them only by rounding
    all: Any
    at_rows: NDArray[np.float64]  #: (w, p) constrained motions at components in rows
    together: NDArray[np.float64]  #: (motions, r) coefficients in subdomain motions
    balance: Balance  #: equilibrium of the load along constrained motions
    driven: str = ""  #: error message if a free motion has a load, else empty

    def without_free(self, local: LocalBodies, v: Extended) -> Extended:
        """Subtract the free motions from v (n,)."""
        p, r = self.at_rows.shape[1], self.all.shape[1]
        if p == r:
            return v
        along = local.reduction.along(self.all, v)
        along[:p] = 0
        return np.asarray(v - self.all @ along)

    def moved(self, v: Extended, alpha: Extended) -> Extended:
        """Add constrained motions with the coefficients alpha (p,) to v (n,)."""
        if not alpha.size:
            return v
        free = np.zeros(self.all.shape[1] - alpha.size)
        return np.asarray(v + self.all @ np.append(alpha, free))


def _rigid_motions(
    local: LocalBodies, exact: Exact, at: NDArray[np.int64]
) -> _RigidMotions:
    """Split the rigid motions into motions that change gaps or slip, and free motions.

    at : (w,) global components in the rows
    """
    reduction, parts, floating = local.reduction, local.parts, local.floating

    if not floating.combinations.shape[1]:
        none = np.zeros((exact.c.size, 0), dtype=Real)
        no_load = np.zeros(0, dtype=Real)
        return _RigidMotions(
            csr_array((local.components.size, 0)),
            np.zeros((at.size, 0)),
            np.zeros((local.motions, 0)),
            Balance(none, none, no_load, no_load, no_load, exact.forces),
        )

    def at_components(R: Any) -> NDArray[Any]:
        """Return the rows (w, k) of distributed columns R (n, k) at components `at`."""
        columns = (R[:, [k]].toarray().ravel() for k in range(R.shape[1]))
        return np.stack([reduction.values_at(column, at) for column in columns], axis=1)

    free = np.ones(local.components.size)
    free[local.fixed] = 0
    R = csr_array(
        diags_array(free) @ floating.motions @ csr_array(floating.combinations)
    )
    turn, p = constrained_first(local.contact.rows[:, at], at_components(R))
    R = _orthonormal(local, csr_array(R @ csr_array(turn)))
    largest, R_at = _largest(local, R), at_components(R)
    f = reduction.completed(parts.spread.T @ local.f.astype(Real))
    size, along = np.abs(f), reduction.along(R, f)
    total = reduction.summed(size[reduction.is_owner].sum(keepdims=True))
    why, terms = "", reduction.along(abs(R), size)
    if is_driven(along[p:], terms[p:], total * largest[p:]):
        along_free = np.append(np.zeros(p), along[p:])
        why = driven(reduction.along(floating.motions, R @ along_free), floating.names)
    local_motions = csr_array(parts.kernel.T @ (parts.spread @ R.astype(np.float64)))
    together = [reduction.gathered(column) for column in local_motions.toarray().T]
    constrained = R_at[:, :p]
    return _RigidMotions(
        R,
        constrained.astype(np.float64),
        np.stack(together, axis=1),
        Balance(
            np.asarray(exact.B @ constrained),
            np.asarray(abs(exact.B) @ np.where(constrained, largest[:p], 0)),
            along[:p],
            (reduction.along(R != 0, size) * largest)[:p],
            np.zeros(p, dtype=Real),
            exact.forces,
        ),
        why,
    )


def _orthonormal(local: LocalBodies, R: csr_array) -> Any:
    """Orthonormalise sparse columns R (n, r) in extended precision.

    On entry, the columns are orthonormal to double precision. One iteration, R(3I −
    RᵀR)/2, squares the error of RᵀR = I.
    """
    R = csr_array(R.astype(Real))
    owned = R[local.reduction.is_owner]
    gram = local.reduction.summed((owned.T @ owned).toarray())
    return csr_array(R + R @ csr_array(0.5 * (np.eye(R.shape[1]) - gram)))


def _largest(local: LocalBodies, R: Any) -> Extended:
    """Return the largest absolute entry (k,) of each column over all ranks."""
    found = abs(csc_array(R))
    sizes = found.max(axis=0).toarray().ravel() if found.nnz else np.zeros(R.shape[1])
    return np.asarray(np.max(local.ranks.comm.allgather(sizes), axis=0))


class _OnRanks:
    """Bodies distributed over ranks; see `harness.verify.substructured.Split`.

    Residuals are evaluated with TᵀK_T T and the exact kernels of the subdomains, since
    K is not assembled on several ranks. E is estimated by sampling the rounding of
    double precision.
    """

    def __init__(self, local: LocalBodies) -> None:
        """Compute the data that all pairs need."""
        self._local = local
        #: (w,) global components that occur in rows
        self.at = np.unique(local.contact.rows.indices).astype(np.int64)
        self.exact, self.softness = _at_rows(local, self.at)
        self.rigid = _rigid_motions(local, self.exact, self.at)
        self._places, self._here = local.reduction.places(self.at)
        self._sharing = Sharing(
            local.parts, local.fixed, self.rigid.together, local.reduction
        )

    def along(self, v: Extended) -> Extended:
        return self._local.reduction.along(self.rigid.all, v)

    def motion(self, alpha: Extended) -> Extended:
        return np.asarray(self.rigid.all @ alpha)

    def residual(self, u: Extended) -> Residual:
        deformed = without_rigid_motion(self, u)
        v = self.spread(deformed)
        Kv = self.product(v)
        rho = self.joined(Kv - self._local.f)
        square = self.total(float(v @ Kv))[0]
        off = self._local.reduction.along(
            csr_array(deformed[:, None] ** 2), self.noise(deformed) ** 2
        )[0]
        theta = SAFETY * float(np.sqrt(off)) / square if square > 0 else 0.0
        return Residual(rho, v, Kv, theta)

    def pulled(self, multipliers: Extended) -> Extended:
        found = np.zeros(self._local.components.size, dtype=Real)
        forces = self.exact.B.T @ multipliers
        found[self._places[self._here]] = forces[self._here]
        found[self._local.fixed] = 0
        return found

    def spread(self, u: Extended) -> Extended:
        T = self._local.parts.spread
        return times_rows(T.data, T.indices, T.indptr, u)

    def joined(self, b: Extended) -> Extended:
        T, size = self._local.parts.spread, self._local.components.size
        found = times_columns(T.data, T.indices, T.indptr, b, size)
        found = self._local.reduction.completed(found)
        found[self._local.fixed] = 0
        return np.asarray(found)

    def averaged(self, v: Extended) -> Extended:
        return self.joined(self._sharing.part * self._sharing.matched(v))

    def product(self, v: Extended) -> Extended:
        return self._local.parts.product(v)

    def solve(self, rho: Extended) -> Vector:
        return self._local.parts.solve(self._sharing(rho.astype(np.float64)))

    def total(self, *numbers: float) -> list[float]:
        return self._local.reduction.total(*numbers)

    def scattered(self, v: Extended) -> Extended:
        R = csr_array(self.rigid.all)
        return np.asarray(np.sqrt(self._local.reduction.along(R.multiply(R), v**2)))

    def noise(self, u: Extended) -> Extended:
        variances = self._sharing.variances(self.spread(u))
        found = sample(variances, u, self._local.components, np.float64)
        found[self._local.fixed] = 0
        return found

    def excess(self, w: Extended) -> tuple[Extended, float]:
        if self._local.stored is not None:
            # If w moves bodies together with their supports, the terms of Kw cancel.
            v = self.spread(w)
            Kw, Kv = cancelling(self._local.stored, w[:, None])[:, 0], self.product(v)
            off = Kw - self.joined(Kv)
            off[self._local.fixed] = 0
            return off, abs(float(w @ Kw - v @ Kv))
        variances = self._sharing.variances(self.spread(w))
        off = sample(variances, w, self._local.components, np.float64)
        square = self._local.reduction.along(csr_array(w[:, None] ** 2), off**2)[0]
        off[self._local.fixed] = 0
        return off, float(np.sqrt(square))

    def rounding(self, supported: NDArray[np.float64]) -> Rounding:
        h, p = supported.shape[1], supported.shape[0]
        strain, curvature = np.zeros(h), np.zeros((h, h))
        rest = np.zeros(self.rigid.all.shape[1] - p)
        for k, motion in enumerate(supported.T):
            off = self.noise(self.motion(np.append(motion, rest)))
            strain[k] = length(self, off)
            curvature[k] = np.abs(supported.T) @ self.scattered(off)[:p]
        return Rounding(strain, curvature)
