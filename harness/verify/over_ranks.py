"""The certificate of torn bodies by the ranks that hold them: no process has the whole.

As `harness.verify.substructured`, with what other ranks have added where a sum says so.
Each rank has the components that its subdomains touch. Copies of a component on several
ranks get the same value on all of them. The rows of contact and friction, which are no
longer than the sides, are on every rank, and so is the coarse problem.

Where contact alone holds a body, its rigid motions R are a few columns of which each
rank has the rows of its components; products with Rᵀ are sums over all components, in
extended precision. That is all that λ̂ needs to balance the load (`harness.verify.
admissible.Balance`): the load along R, and the motion of the rows, which every rank
has.

K is the sum TᵀK_T T over subdomains here, since nobody has another one: what rounding
makes of it is no part of the problem.
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
    Exact,
    Extended,
    Real,
    Substructures,
    cancelling,
    felt_first,
)
from mortarbench.harness.qp import Vector
from mortarbench.harness.verify.active_set_refinement import (
    CLOSED,
    at_bounds,
    suggested,
)
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
    """All rows of contact, then of friction with a bound above zero; on every rank."""

    rows: csr_array  #: (m, n) columns are components of the whole
    c: Vector  #: (m,)
    bound: Vector  #: (k,) of the last rows


@dataclass(frozen=True, eq=False, kw_only=True)
class FloatingBodies:
    """The rigid motions of bodies that supports do not hold, as one rank has them.

    Columns are orthonormal to double precision, in the sum over the components of all
    ranks.
    """

    motions: csr_array  #: (n, k) of single bodies, supports or not, in turn
    combinations: NDArray[
        np.float64
    ]  #: (k, r) combinations that move nothing that is held
    names: tuple[str, ...]  #: of these bodies


@dataclass(frozen=True, eq=False, kw_only=True)
class LocalBodies:
    """What one rank has of torn bodies."""

    ranks: Ranks
    parts: Substructures  #: its subdomains; T has a column for each of its components
    components: NDArray[np.int64]  #: (n,) of the whole, ascending
    shared: NDArray[np.bool_]  #: (n,) whether other ranks have copies, too
    coarse: NDArray[np.int64]  #: (r,) of each column of R, reduction those of all ranks
    motions: int  #: of all subdomains of all ranks
    f: Vector  #: (N,) the load of a component is the sum of those of its copies
    fixed: NDArray[np.int64]  #: (h,) places in `components` of those prescribed
    contact: Contact
    floating: FloatingBodies
    #: (n, n) of a single process that has assembled it: what rounding makes of it is a
    #: part of the problem then, where an answer moves bodies with their supports
    stored: csr_array | None = None

    @cached_property
    def reduction(self) -> MPIReduction:
        """How sums are completed."""
        return MPIReduction(self)


class MPIReduction:
    """Adds what other ranks have; see `harness.verify.substructured.Reduction`."""

    def __init__(self, local: LocalBodies) -> None:
        self._local, comm = local, local.ranks.comm
        mine = local.components[local.shared]
        known = np.unique(np.concatenate(comm.allgather(mine)))
        self._size = known.size
        #: of each component, its place reduction all shared ones
        self._place = np.full(local.components.size, -1)
        self._place[local.shared] = np.searchsorted(known, mine)
        first = np.full(known.size, comm.size)
        first[self._place[local.shared]] = comm.rank
        lowest = np.min(comm.allgather(first), axis=0)
        #: whether this is the first rank that has a component
        self.counts = np.ones(local.components.size, dtype=bool)
        self.counts[local.shared] = lowest[self._place[local.shared]] == comm.rank

    def summed(self, x: NDArray[Any]) -> NDArray[Any]:
        """Add arrays in the order of the ranks: all get the same digits."""
        parts = np.empty((self._local.ranks.size, *x.shape), dtype=x.dtype)
        self._local.ranks.comm.Allgather(x, parts)
        return np.asarray(parts.sum(axis=0))

    def completed(self, v: Any, at: Any = None) -> Any:
        """Add what other ranks have of the components `at` (t,), or of all (n,)."""
        place = self._place if at is None else self._place[at]
        here = place >= 0
        exchanged = np.zeros(self._size, dtype=v.dtype)
        exchanged[place[here]] = v[here]
        found = v.copy()
        found[here] = self.summed(exchanged)[place[here]]
        return found

    def along(self, M: Any, v: NDArray[Any]) -> NDArray[Any]:
        """Return Mᵀv of the whole (k,), of columns M (n, k), sparse, and v (n,)."""
        return self.summed(np.asarray(M.T @ np.where(self.counts, v, 0)))

    def total(self, *numbers: float) -> list[float]:
        """Add numbers over all ranks."""
        return [float(x) for x in self._local.ranks.total(np.array(numbers))]

    def gathered(self, alpha: Vector) -> Vector:
        """Gather the coefficients of rigid motions of all ranks."""
        whole = np.zeros(self._local.motions)
        whole[self._local.coarse] = alpha
        return self.summed(whole)

    def local_part(self, alpha: Vector) -> Vector:
        """Take the coefficients of local rigid motions."""
        return np.asarray(alpha[self._local.coarse])

    def traced(self, v: NDArray[Any], at: NDArray[np.int64]) -> Any:
        """Tell all ranks the values of v (n,) at components `at` (w,) of the whole."""
        places, here = self.places(at)
        counted = self.counts[places[here]]
        found = np.zeros(at.size, dtype=v.dtype)
        found[np.flatnonzero(here)[counted]] = v[places[here][counted]]
        return self.summed(found)

    def places(
        self, at: NDArray[np.int64]
    ) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
        """Return local places of global components (w,), and a mask of those here."""
        local = self._local.components
        places = np.minimum(np.searchsorted(local, at), local.size - 1)
        return places, local[places] == at

    def coarse(self, M: csr_array, S: csr_array, scale: Vector, at: Any) -> csr_array:
        """Return  M − Sᵀ diag(scale) S,  with M and S added up over all ranks."""
        r, comm = self._local.motions, self._local.ranks.comm
        place = self._place[at]
        alone, jointly = place < 0, place >= 0
        local = csr_array(S[alone])
        mine = coo_array(M - local.T @ scaled_rows(local, scale[alone]))
        numbers = self._local.coarse
        row, column = numbers[mine.row], numbers[mine.col]
        told = csr_array((mine.data, (row, column)), shape=(r, r))
        rows = coo_array(S[jointly])
        across = csr_array(
            (rows.data, (place[jointly][rows.row], numbers[rows.col])),
            shape=(self._size, r),
        )
        weight = np.zeros(self._size)
        weight[place[jointly]] = scale[jointly]
        parts, crossing, weights = zip(
            *comm.allgather((told, across, weight)), strict=True
        )
        S_all = csr_array(sum(crossing[1:], start=crossing[0]))
        whole = sum(parts[1:], start=parts[0])
        return csr_array(whole - S_all.T @ scaled_rows(S_all, np.max(weights, axis=0)))


@np.errstate(all="ignore")  # as `harness.verify.certificate.certify`
def certify_over_ranks(
    local: LocalBodies, claimed: Vector, multipliers: Vector
) -> Certificate:
    """Bound the error of an answer; called by all ranks, which get the same bound.

    Pairs are those of `harness.verify.certificate.certify`, without exchanged rows.

    Parameters
    ----------
    claimed : (n,) displacement of local components, the same of copies on several ranks
    multipliers : (m,) of all rows, on every rank

    Returns
    -------
    of which `u` and `off` are those of local components and subdomains

    Raises
    ------
    UncertifiableError
        When the answer holds NaN or inf, or no admissible pair is found near it.

    """
    finite = np.isfinite(claimed).all() and np.isfinite(multipliers).all()
    if local.reduction.total(float(finite))[0] < local.ranks.size:
        raise UncertifiableError("the answer holds NaN or inf")
    u = claimed.astype(Real)
    u[local.fixed] = 0
    split = _OnRanks(local)
    at, exact, rigid, softness = split.at, split.exact, split.rigid, split.softness
    u = rigid.without_free(local, u)
    trace = local.reduction.traced(u, at)
    raw = np.clip(multipliers.astype(Real), exact.lower, exact.upper)
    states = suggested(exact, trace, raw)
    tidied = at_bounds(exact, states, raw), states == CLOSED
    none = np.zeros(raw.size, dtype=bool)

    def proved(
        u: Extended, trace: Extended, lam: Extended, closed: NDArray[np.bool_]
    ) -> Certificate | str:
        try:
            mended, feasible, forces = _mended(
                local, exact, rigid, (at, softness, trace), u, lam, closed
            )
            return proven(
                split, exact, rigid.balance.G, claimed=claimed, u=feasible,
                at_rows=mended, multipliers=forces,
            )  # fmt: skip
        except UncertifiableError as e:
            return str(e)

    def certificates() -> Iterator[Certificate | str]:
        for lam, closed in (tidied, (raw, none)):
            found = proved(u, trace, lam, closed)
            yield found
            if is_sharp(found):
                return

    def at_rest() -> Certificate | str:
        return proved(0 * u, 0 * trace, 0 * raw, none)

    return sharpest(certificates(), at_rest)


def _mended(
    local: LocalBodies, exact: Exact, rigid: _RigidMotions,
    trace: tuple[NDArray[np.int64], Vector, Extended],
    u: Extended, lam: Extended, closed: NDArray[np.bool_],
) -> tuple[Extended, Extended, Extended]:  # fmt: skip
    """Find û at the components of the rows (w,) and at local ones (n,), and λ̂.

    Raises
    ------
    UncertifiableError
        When they cannot be mended.

    """
    at, softness, start = trace
    found = feasible_at_rows(exact, rigid.at_rows, softness, start, closed)
    if found is None:
        raise UncertifiableError("the answer penetrates beyond repair")
    if rigid.driven:
        raise UncertifiableError(rigid.driven)
    places, here = local.reduction.places(at)
    feasible = rigid.moved(u * found.theta, found.u[at.size :])
    feasible[places[here]] = found.u[: at.size][here]
    return found.u[: at.size], feasible, rigid.balance.near(lam)


def _at_rows(local: LocalBodies, at: NDArray[np.int64]) -> tuple[Exact, Vector]:
    """Return the rows on the components they touch (w,), and 1/Kᵢᵢ there, (w,)."""
    contact, k = local.contact, local.contact.bound.size
    B, contacts = csr_array(contact.rows[:, at]), contact.c.size - k
    places, here = local.reduction.places(at)
    diagonal = np.zeros(local.components.size)
    known = np.unique(places[here])
    diagonal[known] = local.parts.diagonal(known)
    diagonal = local.reduction.traced(local.reduction.completed(diagonal), at)
    free = np.ones(local.components.size)
    free[local.fixed] = 0
    is_free = local.reduction.traced(free, at) > 0
    softness = np.where(is_free & (diagonal > 0), 1 / diagonal, 0)
    bound = contact.bound.astype(Real)
    return Exact(
        f=np.zeros(0, dtype=Real), B=B.astype(Real), c=contact.c.astype(Real),
        fixed=np.flatnonzero(~is_free),
        lower=np.append(np.zeros(contacts, dtype=Real), -bound),
        upper=np.append(np.full(contacts, np.inf, dtype=Real), bound),
        compliance=(B.multiply(B) @ softness).astype(Real),
    ), softness  # fmt: skip


@dataclass(frozen=True, eq=False)
class _RigidMotions:
    """The rigid motions that supports leave, and what contact must do about them.

    As `harness.mechanics.RigidMotions`, columns are orthonormal in extended precision,
    in the sum over the components of all ranks. K of subdomains is exactly zero along
    them.
    """

    #: (n, r) sparse, of local components. Contact rows open or close along the first p,
    #: which are *felt*; along the others, *free*, no gap changes but for rounding
    all: Any
    at_rows: NDArray[np.float64]  #: (w, p) felt ones, of the components that rows touch
    together: NDArray[np.float64]  #: (motions, r) coefficients of R of all subdomains
    balance: Balance  #: of the load along felt ones
    driven: str = ""  #: which load along free ones nothing can balance, if there is one

    def without_free(self, local: LocalBodies, v: Extended) -> Extended:
        """Take the free motions out of v (n,)."""
        p, r = self.at_rows.shape[1], self.all.shape[1]
        if p == r:
            return v
        along = local.reduction.along(self.all, v)
        along[:p] = 0
        return np.asarray(v - self.all @ along)

    def moved(self, v: Extended, alpha: Extended) -> Extended:
        """Add felt motions with the coefficients alpha (p,) to v (n,)."""
        if not alpha.size:
            return v
        free = np.zeros(self.all.shape[1] - alpha.size)
        return np.asarray(v + self.all @ np.append(alpha, free))


def _rigid_motions(
    local: LocalBodies, exact: Exact, at: NDArray[np.int64]
) -> _RigidMotions:
    """Split the rigid motions by whether rows feel them at the components `at` (w,)."""
    reduction, parts, floating = local.reduction, local.parts, local.floating

    if not floating.combinations.shape[1]:
        none, rows = csr_array((local.components.size, 0)), exact.c.size
        return _RigidMotions(
            none, np.zeros((at.size, 0)), np.zeros((local.motions, 0)),
            Balance(*np.zeros((2, rows, 0)), *np.zeros((3, 0)), *np.zeros((2, rows))),
        )  # fmt: skip

    def seen(R: Any) -> NDArray[Any]:
        """Tell all ranks columns (n, k) at these components: (w, k)."""
        columns = (R[:, [k]].toarray().ravel() for k in range(R.shape[1]))
        return np.stack([reduction.traced(column, at) for column in columns], axis=1)

    free = np.ones(local.components.size)
    free[local.fixed] = 0
    R = csr_array(
        diags_array(free) @ floating.motions @ csr_array(floating.combinations)
    )
    turn, p = felt_first(local.contact.rows[:, at], seen(R))
    R = _orthonormal(local, csr_array(R @ csr_array(turn)))
    largest, R_at = _largest(local, R), seen(R)
    f = reduction.completed(parts.spread.T @ local.f.astype(Real))
    size, along = np.abs(f), reduction.along(R, f)
    total = reduction.summed(size[reduction.counts].sum(keepdims=True))
    why, terms = "", reduction.along(abs(R), size)
    if is_driven(along[p:], terms[p:], total * largest[p:]):
        along_free = np.append(np.zeros(p), along[p:])
        why = driven(reduction.along(floating.motions, R @ along_free), floating.names)
    local_motions = csr_array(parts.kernel.T @ (parts.spread @ R.astype(np.float64)))
    together = [reduction.gathered(column) for column in local_motions.toarray().T]
    felt = R_at[:, :p]
    return _RigidMotions(
        R, felt.astype(np.float64), np.stack(together, axis=1),
        Balance(
            np.asarray(exact.B @ felt),
            np.asarray(abs(exact.B) @ np.where(felt, largest[:p], 0)),
            along[:p], (reduction.along(R != 0, size) * largest)[:p],
            np.zeros(p, dtype=Real), exact.lower, exact.upper,
        ),
        why,
    )  # fmt: skip


def _orthonormal(local: LocalBodies, R: csr_array) -> Any:
    """Orthonormalise columns (n, r) that are so to double precision; sparse."""
    R = csr_array(R.astype(Real))
    counted = R[local.reduction.counts]
    gram = local.reduction.summed((counted.T @ counted).toarray())
    return csr_array(R + R @ csr_array(0.5 * (np.eye(R.shape[1]) - gram)))


def _largest(local: LocalBodies, R: Any) -> Extended:
    """Return the largest size in each column (k,) on all ranks."""
    found = abs(csc_array(R))
    sizes = found.max(axis=0).toarray().ravel() if found.nnz else np.zeros(R.shape[1])
    return np.asarray(np.max(local.ranks.comm.allgather(sizes), axis=0))


class _OnRanks:
    """The bodies of all ranks; see `harness.verify.substructured.Split`.

    No rank has the assembled K. The residual is that of TᵀK_T T, where subdomains have
    exact kernels, and E is estimated by samples of the rounding of doubles.
    """

    def __init__(self, local: LocalBodies) -> None:
        """Prepare what several pairs need."""
        self._local = local
        #: (w,) components that the rows touch
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
            # bodies that w moves far with their supports leave Kw as sums that cancel
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
