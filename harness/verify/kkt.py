"""Optimality of a primal-dual point, measured by us and never by the solver.

Every residual is scale-free: multiplying the objective, a constraint row or the unit of
a variable by a constant changes none of them, so that one threshold means the same for
every problem. All four are zero exactly at a KKT point, which is a solution if P is
positive semidefinite; that is taken on trust. What small residuals prove of the
objective, and what they cannot, is in docs/verdicts.md; where they cannot,
`harness.verify.optimum` compares with a proven optimum.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array

from mortarbench.harness.qp import QP, Matrix, Vector
from mortarbench.harness.record import VERIFIED_FACTOR, Record, Verdict
from mortarbench.harness.solution import Solution, Status

ROUNDING = 8 * float(np.finfo(float).eps)  #: of a sum of terms, relative to their sizes
EXCUSED = 2e-4  #: of its scale: more of a residual is never called rounding
CANCELLED = 1e4  #: terms may exceed their sum by so much before the sum counts alone
SHARE = 1e-2  #: of a natural energy: the least scale of energy
VANISHING = 1e-6  #: of a natural energy: a point with less has none of its own
NOISE = 1e-26  #: of the largest natural energy: smaller ones come of rounding in q
OWN = 10.0  #: times its own terms: the size of a row
ROUNDED = 1e-9  #: of a row's scale: more of a violation is never called rounding
TOLD = 1e-12  #: of a row's own terms: a right-hand side below may be rounding
SMALL = 1e-9  #: of the energies that are known: a point's energy below tells nothing
INFLATED = 1e3  #: lengths that the energy knows of: x counts for no more


class Residuals(NamedTuple):
    """Scale-free KKT residuals; NaN where the point holds NaN."""

    primal: float  #: worst violation of a row or bound
    dual: float  #: stationarity and multiplier signs
    complementarity: float  #: worst |multiplier·slack|
    gap: float  #: |primal − dual objective|

    @property
    def worst(self) -> float:
        """The largest of the four; NaN if any is NaN."""
        return float(np.max(self))


class Scales(NamedTuple):
    """What errors of a point are compared with."""

    energy: float  #: E
    x: Vector  #: Xⱼ (n,), size of each variable


class _Constraints(NamedTuple):
    """Rows of A or G, or the lower or upper bounds that there are, at a point."""

    slack: Vector  #: b − Ax, h − Gx, x − lb or ub − x
    rhs: Vector  #: |b|, |h|, |lb| or |ub|
    terms: Vector  #: Σ|aᵢⱼ||xⱼ|
    sized: Callable[[Vector], Vector]  #: X (n,) ↦ Σ|aᵢⱼ|Xⱼ


@dataclass(frozen=True, eq=False)
class _Terms:
    """Products of the QP with a point, and the sizes of what was summed."""

    x: Vector  #: |x|
    constraints: dict[str, _Constraints]  #: by the name of the QP's field
    Px: Vector
    Px_size: Vector  #: at least Σ|Pᵢⱼ||xⱼ|
    curvature: Vector  #: Pᵢᵢ, zero where P does not tell
    told: bool  #: whether P tells its diagonal
    forces: Vector  #: Aᵀy + Gᵀz + z_box
    forces_size: Vector
    residual: Vector  #: Px + q + Aᵀy + Gᵀz⁺ + z_box, without what no bound can bear
    energies: Vector  #: xᵀPx, qᵀx, bᵀy + hᵀz + bounds
    energies_size: float


@np.errstate(all="ignore")  # a point may hold NaN, inf, or 1e300
def kkt_residuals(qp: QP, s: Solution, *, generous: bool = False) -> Residuals:
    """Measure how far `s` is from satisfying the KKT conditions of `qp`.

    With the scale of energy E and the sizes Xⱼ of the variables (`scales_at`), and
    r = Px + q + Aᵀy + Gᵀz⁺ + z_box less multipliers of absent bounds:

    * primal: violation of aᵢx = bᵢ, gᵢx ≤ hᵢ or a bound, relative to |bᵢ| + Σ|aᵢⱼ|Xⱼ,
      and 1e-4 times that relative to |bᵢ| + Σ|aᵢⱼxⱼ| alone
    * dual: |rᵢ| relative to S, the largest of ‖Px‖∞, ‖q‖∞, ‖Aᵀy + Gᵀz + z_box‖∞ and
      √(E·min Pⱼⱼ), and relative to its own |Px|ᵢ, |qᵢ|, |Aᵀy + Gᵀz + z_box|ᵢ unless
      |rᵢ|Dᵢ/E is smaller; zᵢ⁻‖gᵢ‖∞/S
    * complementarity: max |zᵢ(h − Gx)ᵢ|/E over rows and bounds
    * gap: |xᵀPx + qᵀx + bᵀy + hᵀz + lbᵀz_box⁻ + ubᵀz_box⁺|/E

    Dᵢ is the larger of |xᵢ| and the step |rᵢ|/Pᵢᵢ to the minimum along i (Xᵢ for a
    variable without curvature and cost), but no longer than the way to the bounds. From
    each residual is taken first what rounding to double precision explains: 8·2⁻⁵² of
    the sum of its absolute terms, but never more than 2e-4 of its scale.

    generous : with the largest scale of energy that can be justified, and all rounding
        of energies forgiven
    """
    t, excused = _terms(qp, s), np.inf if generous else EXCUSED
    E, X = _scales(qp, s.x, _energy(qp, t, generous), t.curvature, told=t.told)
    return Residuals(
        _violation(t.constraints, X, OWN * (t.x + _pushed(s.x, t.Px, t.curvature))),
        _dual(qp, s, t, E, X),
        _complementarity(qp, s, t.constraints, E, excused),
        _excess(t.energies.sum(keepdims=True), t.energies_size, E, excused),
    )


def _terms(qp: QP, s: Solution) -> _Terms:
    lower, upper = np.isfinite(qp.lb), np.isfinite(qp.ub)
    x, z_lb, z_ub = np.abs(s.x), np.maximum(-s.z_box, 0), np.maximum(s.z_box, 0)
    d, told = _curvature(qp)
    root, A_size, G_size = np.sqrt(d), _abs(qp.A), _abs(qp.G)
    Px = qp.P @ s.x
    Px_size = root * (root @ x) if told else 0 * x + _sup(Px)
    rows = _combined(qp.A, s.y) + _combined(qp.G, np.maximum(s.z, 0))
    borne = np.where(upper, z_ub, 0) - np.where(lower, z_lb, 0)
    held = qp.b @ s.y + qp.h @ s.z
    held += qp.ub[upper] @ z_ub[upper] - qp.lb[lower] @ z_lb[lower]
    sizes = (
        x @ np.abs(Px), np.abs(qp.q) @ x, np.abs(qp.b) @ np.abs(s.y),
        np.abs(qp.h) @ np.abs(s.z), np.abs(qp.ub[upper]) @ z_ub[upper],
        np.abs(qp.lb[lower]) @ z_lb[lower],
    )  # fmt: skip
    return _Terms(
        x=x, constraints=_constraints(qp, s.x, A_size, G_size),
        Px=Px, Px_size=Px_size, curvature=d, told=told,
        forces=rows + _combined(qp.G, np.minimum(s.z, 0)) + s.z_box,
        forces_size=_combined(A_size, np.abs(s.y)) + _combined(G_size, np.abs(s.z))
        + np.abs(s.z_box),
        residual=Px + qp.q + rows + borne,
        energies=np.array([s.x @ Px, qp.q @ s.x, held]),
        energies_size=float(np.sum(sizes)),
    )  # fmt: skip


def _combined(M: Matrix, z: Vector) -> Vector | float:
    """Return Mᵀz (n,); 0 without rows."""
    return M.T @ z if M.shape[0] else 0.0


def _constraints(
    qp: QP, x: Vector, A_size: Matrix, G_size: Matrix
) -> dict[str, _Constraints]:
    """Measure the constraints at x (n,), kind by kind, of each kind that there is.

    A_size, G_size : |A| and |G|
    """
    size, found = np.abs(x), dict[str, _Constraints]()
    for name, M, rhs, sizes in (
        ("A", qp.A, qp.b, A_size), ("G", qp.G, qp.h, G_size),
    ):  # fmt: skip
        if M.shape[0]:
            found[name] = _Constraints(
                rhs - M @ x, np.abs(rhs), sizes @ size, sizes.__matmul__
            )
    for name, bound, sign in (("lb", qp.lb, 1), ("ub", qp.ub, -1)):
        told = np.isfinite(bound)
        if told.any():
            at = bound[told]
            found[name] = _Constraints(
                sign * (x[told] - at), np.abs(at), size[told], partial(_where, told)
            )
    return found


def violation(qp: QP, x: Vector, X: Vector, own: Vector) -> float:
    """Measure the worst violation of a row or bound, as `kkt_residuals` says.

    X : (n,) sizes of the variables that the energy knows of
    own : (n,) sizes of the variables themselves (`own_sizes`)
    """
    return _violation(_constraints(qp, x, _abs(qp.A), _abs(qp.G)), X, own)


def _violation(constraints: dict[str, _Constraints], X: Vector, own: Vector) -> float:
    return _largest(
        0.0,
        *(
            _violated(
                c.slack if name == "A" else np.minimum(c.slack, 0),
                c.rhs, c.terms, c.sized(X), c.sized(own),
            )
            for name, c in constraints.items()
        ),
    )  # fmt: skip


def _violated(
    error: Vector, rhs: Vector, terms: Vector, known: Vector, own: Vector
) -> float:
    """Compare with |bᵢ| + Σ|aᵢⱼ|Xⱼ, and where bᵢ is a size of its own with its row."""
    felt = _excess(error, rhs + terms, rhs + known, ROUNDED)
    size = OWN * rhs + own
    told = rhs > TOLD * size
    if not told.any():
        return felt
    return _largest(
        felt, _excess(error[told], (rhs + terms)[told], size[told], ROUNDED)
    )


def own_sizes(qp: QP, x: Vector) -> Vector:
    """Give the sizes of variables at a solution x (n,), without any scale of energy.

    Ten times |xⱼ|, or as far as the others push variable j, |Σₖ Pⱼₖxₖ|/Pⱼⱼ over k ≠ j,
    if that is further.
    """
    return np.maximum(OWN * np.abs(x), _pushed(x, qp.P @ x, _curvature(qp)[0]))


def _pushed(x: Vector, Px: Vector, d: Vector) -> Vector:
    bends = d > 0
    return np.where(bends, np.abs(Px - d * x) / np.where(bends, d, 1), 0)


def _dual(qp: QP, s: Solution, t: _Terms, E: float, X: Vector) -> float:
    softest = _least(t.curvature[t.curvature > 0])
    least = np.sqrt(E * softest) if softest < np.inf else 0.0
    S = _largest(_sup(t.Px), _sup(qp.q), _sup(t.forces), least)
    size = t.Px_size + np.abs(qp.q) + t.forces_size
    own = np.maximum.reduce([np.abs(t.Px), np.abs(qp.q), np.abs(t.forces)])
    r = np.abs(t.residual)
    own_r = np.maximum(r - ROUNDING * size, 0)
    # what neither bends nor costs is as long as it is
    is_idle = (t.curvature == 0) & (qp.q == 0)
    # an operator may not tell Pᵢᵢ: x tells one curvature of it, but for x = 0
    step = _over(r, t.curvature if t.told else _rayleigh(s.x, t.Px))
    step = np.where(is_idle, np.maximum(t.x, X), step)
    way = np.where(t.residual > 0, s.x - qp.lb, qp.ub - s.x)  # downhill
    step = np.minimum(np.maximum(t.x, step), np.maximum(way, 0))
    gain = np.where(own_r > 0, own_r * step, 0.0)
    lower, upper = np.isfinite(qp.lb), np.isfinite(qp.ub)
    signed = (s.z >= 0).all()  # NaN is not
    pulling = 0.0 if signed else _ratio(np.minimum(s.z, 0) * _row_maxima(qp.G), S)
    return _largest(
        _excess(r, size, S),
        _sup(np.minimum(_ratios(own_r, own), _ratios(gain, E))),
        pulling,
        _ratio(np.minimum(s.z_box, 0)[~lower], S),
        _ratio(np.maximum(s.z_box, 0)[~upper], S),
    )


def _rayleigh(x: Vector, Px: Vector) -> Vector:
    """Give xᵀPx/xᵀx for each variable (n,), 0 where x is zero."""
    squared = float(x @ x)
    return float(x @ Px) / squared + 0 * x if squared > 0 else 0 * x


def _complementarity(
    qp: QP, s: Solution, constraints: dict[str, _Constraints], E: float, excused: float
) -> float:
    found = [0.0]
    for name, c in constraints.items():
        match name:
            case "A":
                continue
            case "G":
                z = s.z
            case "lb":
                z = np.maximum(-s.z_box, 0)[np.isfinite(qp.lb)]
            case _:
                z = np.maximum(s.z_box, 0)[np.isfinite(qp.ub)]
        found.append(_excess(z * c.slack, np.abs(z) * (c.terms + c.rhs), E, excused))
    return _largest(*found)


def energy_at(qp: QP, s: Solution, *, generous: bool = False) -> float:
    """Find the scale of energy at a point, see `_energy`."""
    return _energy(qp, _terms(qp, s), generous)


def _energy(qp: QP, t: _Terms, generous: bool) -> float:
    """Find the scale of energy E at a point.

    The largest of |xᵀPx|, |qᵀx| and |bᵀy + hᵀz + bounds|: sums, since multipliers that
    cancel could make their parts as large as one likes; but no more than 1e4 times
    their own sum, the objective, or than 1e-4 of itself where the objective vanishes.
    At least a hundredth of the smallest natural energy of a variable (`_alone`).

    generous : cancellation is forgiven, and the median of natural energies counts, all
        of it where the point has no energy of its own
    """
    terms = _sup(t.energies)
    value = abs(float(t.energies[0] / 2 + t.energies[1]))
    capped = min(terms, max(CANCELLED * value, terms / CANCELLED))
    E, pick = (terms, _middle) if generous else (capped, _least)
    if np.isnan(terms):
        return terms
    known = _sup(qp.b), _sup(qp.h), _finite_sup(qp.lb), _finite_sup(qp.ub)
    is_tiny = E <= SMALL * _sup(t.curvature) * np.square(max(known))
    by_length = is_tiny or not qp.q.any()
    alone = pick(_alone(qp, t.curvature, (qp.lb, qp.ub), by_length=by_length))
    if E < SHARE * alone:  # seldom, and tightening costs more
        alone = pick(_alone(qp, t.curvature, tightened(qp), by_length=True))
    if not alone < np.inf:
        return E
    vanishes = generous and E <= VANISHING * alone
    return alone if vanishes else max(E, SHARE * alone)


def _least(values: Vector) -> float:
    """Give the least value, over all ranks of a distributed vector; inf without any."""
    return float(values.min(initial=np.inf))


def _middle(values: Vector) -> float:
    return float(np.sort(values)[(values.size - 1) // 2]) if values.size else np.inf


def _alone(
    qp: QP, d: Vector, bounds: tuple[Vector, Vector], *, by_length: bool
) -> Vector:
    """List natural energies: what a variable alone can gain, of each that tells one.

    Its own energy |½Pᵢᵢxᵢ² + qᵢxᵢ| where it is least within its bounds; where that is
    at xᵢ = 0, qᵢ²/Pᵢᵢ, or |qᵢ|wᵢ over its feasible width, if that is less.

    bounds : lower and upper (n,) each, tightened by rows or not
    by_length : without curvature at most |qᵢ|lᵢ, and where q is rounding Pᵢᵢlᵢ², of the
        least length lᵢ that a row or bound knows, 1 if none does
    """
    q, (lb, ub) = np.abs(qp.q), bounds
    gain = np.where(q > 0, np.minimum(_over(q**2, d), q * np.maximum(ub - lb, 0)), 0)
    least = np.clip(-np.sign(qp.q) * _over(q, d), lb, ub)
    own = np.abs(d / 2 * least**2 + qp.q * least)
    told = (q > 0) & (least != 0) & np.isfinite(own)
    gain = np.where(told, np.where(gain > 0, np.minimum(own, gain), own), gain)
    lengths = _lengths(qp) if by_length else np.full(q.size, np.inf)
    if by_length and not np.isfinite(lengths).any():
        lengths = np.ones(q.size)
    flat = (d == 0) & np.isfinite(lengths)
    gain = np.where(flat, np.minimum(gain, q * lengths), gain)
    gain = np.where(np.isfinite(gain), gain, 0)
    gain = gain[gain > NOISE * gain.max(initial=0)]
    bend: Vector = (d * lengths**2)[(d > 0) & np.isfinite(lengths)]
    if bend.size and gain.max(initial=0) <= NOISE * bend.min():
        return bend
    found: Vector = gain
    return found


def _lengths(qp: QP) -> Vector:
    """Give the least |bᵢ/aᵢⱼ| or |bound| of each variable, of those that are not 0."""
    least = np.full(qp.q.size, np.inf)
    for bound in (qp.lb, qp.ub):
        told = np.isfinite(bound) & (bound != 0)
        least[told] = np.minimum(least[told], np.abs(bound[told]))
    for i, j, a, rhs in _entries(qp):
        told = rhs[i] != 0
        np.minimum.at(least, j[told], np.abs(rhs[i][told] / a[told]))
    return least


def tightened(qp: QP) -> tuple[Vector, Vector]:
    """Give lower and upper bounds (n,) each, tightened by what single rows allow."""
    lb, ub = qp.lb.copy(), qp.ub.copy()
    for k, (i, j, a, rhs) in enumerate(_entries(qp)):
        for sign in (1, -1) if k == 0 else (1,):  # aᵢx = bᵢ is also −aᵢx ≤ −bᵢ
            c = sign * a
            least = np.where(c > 0, c * qp.lb[j], c * qp.ub[j])
            endless = np.isinf(least)
            total = np.bincount(i, np.where(endless, 0, least), rhs.size)
            count = np.bincount(i, endless, rhs.size)
            others = np.where(endless, total[i], total[i] - least)
            room = (sign * rhs[i] - others) / c
            known = count[i] == endless
            up, down = known & (c > 0), known & (c < 0)
            np.minimum.at(ub, j[up], room[up])
            np.maximum.at(lb, j[down], room[down])
    return lb, ub


def _entries(qp: QP) -> Iterator[tuple[Vector, Vector, Vector, Vector]]:
    """Give rows, columns and values of A, then of G, with the right-hand side."""
    for M, rhs in ((qp.A, qp.b), (qp.G, qp.h)):
        at = csr_array(M).tocoo()
        told = at.data != 0
        yield at.row[told], at.col[told], at.data[told], rhs


def scales_at(qp: QP, x: Vector, E: float) -> Scales:
    """Give the sizes of variables that a scale of energy knows of.

    The energy changes by E over the length lⱼ, the least of √(E/Pⱼⱼ) and E/|qⱼ|: Xⱼ is
    the larger of lⱼ and |xⱼ|, but at most 1e3·lⱼ: along a direction that costs nothing,
    an answer could make x as long as it likes. A variable without curvature and cost is
    as long as its active rows know from the others.
    """
    d, told = _curvature(qp)
    return _scales(qp, x, E, d, told=told)


def _scales(qp: QP, x: Vector, E: float, d: Vector, *, told: bool) -> Scales:
    x, E = x.astype(float), float(E)
    size = np.abs(x)
    length = np.minimum(np.sqrt(_over(E, d)), _over(E, np.abs(qp.q)))
    felt = np.isfinite(length)
    X = np.where(felt, np.maximum(np.minimum(size, INFLATED * length), length), 0)
    if not told:
        X = np.minimum(X, np.maximum(size, _sup(x)))
    if not felt.all():
        X = _told_by_rows(qp, x, X, felt)
    return Scales(E, X)


def _told_by_rows(qp: QP, x: Vector, X: Vector, felt: NDArray[np.bool_]) -> Vector:
    """Fill in the sizes of variables that no energy feels, row by active row."""
    size, known = np.abs(x), felt.copy()
    rows = [
        (i, j, np.abs(a), np.abs(rhs), M @ x - rhs, _abs(M) @ size + np.abs(rhs))
        for (i, j, a, rhs), M in zip(_entries(qp), (qp.A, qp.G), strict=True)
    ]
    for _ in range(3):  # rows of rows
        told = np.zeros(x.size)
        for i, j, a, rhs, error, terms in rows:
            total = rhs + np.bincount(i, a * np.where(known, X, 0)[j], rhs.size)
            use = (~known[j]) & (error[i] >= -1e-6 * terms[i])
            np.maximum.at(told, j[use], (total[i] / a)[use])
        new = ~known & (told > 0)
        if not new.any():
            break
        X = np.where(new, told, X)
        known |= new
    return np.where(known, X, size)


def allowed(tol: float, factor: float = VERIFIED_FACTOR) -> float:
    """Return the largest residual that verification allows: factor·tol, at most 0.1."""
    return min(factor * tol, 0.1)


def verdict(
    claimed: Status,
    residuals: Residuals,
    tol: float,
    factor: float = VERIFIED_FACTOR,
    *,
    error: float | None = None,
    infeasible: bool = False,
) -> Verdict:
    """Judge a point by its residuals; the claim decides only how a failure is called.

    Verified: every residual ≤ factor·tol, whatever was claimed; where an error against
    a proven optimum is known, it stands for all of them. A refuted claim of
    success is `inaccurate` while at least half of the digits asked for are there (worst
    residual ≤ √(factor·tol)), and `wrong` beyond. A residual above 0.1 verifies
    nothing, whatever the tolerance.

    infeasible : whether the QP is proven to have no feasible point; a claim of that is
        verified, whatever point comes with it
    """
    most = allowed(tol, factor)
    worst = residuals.worst if error is None else error
    if claimed is Status.DECLINED:
        return Verdict.DECLINED
    if claimed is Status.INFEASIBLE and infeasible:
        return Verdict.VERIFIED_INFEASIBLE
    if worst <= most:
        return Verdict.VERIFIED
    match claimed:
        case Status.SOLVED:
            close = worst <= max(most, np.sqrt(most))
            return Verdict.INACCURATE if close else Verdict.WRONG
        case Status.INFEASIBLE:
            return Verdict.INFEASIBLE_CLAIM
        case _:
            return Verdict(claimed.value)


def rejudged(record: Record, factor: float) -> Verdict:
    """Judge a stored measurement anew, at factor·tol instead of 10·tol.

    Claim and residuals decide, or the error against a proven optimum where it did
    (`Record.decided_by`). Where they do not explain the stored status (a limit, a
    crash, a sequence that had ended before, a proof of infeasibility, which knows no
    tolerance), it was decided by something else, and stands.
    """
    if record.claimed is None:
        return record.verdict
    stored = (getattr(record, name) for name in Residuals._fields)
    residuals = Residuals(*(np.inf if r is None else r for r in stored))
    tol, error = record.judged_at, record.optimum_error
    claimed = Status(record.claimed)
    if verdict(claimed, residuals, tol, error=error) is not record.verdict:
        return record.verdict
    return verdict(claimed, residuals, tol, factor, error=error)


def _curvature(qp: QP) -> tuple[Vector, bool]:
    """Give Pᵢᵢ, and whether P tells it; zeros where it does not."""
    diagonal = qp.diagonal()
    if diagonal is None:
        return np.zeros(qp.q.size), False
    return np.maximum(diagonal, 0), True


def _sup(v: Vector) -> float:
    return float(np.abs(v).max(initial=0.0))


def _finite_sup(v: Vector) -> float:
    return _sup(v[np.isfinite(v)])


def _where(mask: NDArray[np.bool_], v: Vector) -> Vector:
    return v[mask]


def _abs(M: Matrix) -> Matrix:
    return abs(M) if M.shape[0] else M


def _over(a: Vector | float, b: Vector) -> Vector:
    """Divide, by zero to infinity."""
    return np.where(b > 0, a / np.where(b > 0, b, 1), np.inf)


def _largest(*values: float) -> float:
    """Give the largest value; NaN is larger than every number."""
    return max(values, key=lambda value: np.inf if np.isnan(value) else value)


def _ratios(error: Vector, scale: Vector | float) -> Vector:
    """|error|/scale, where 0/0 = 0; a scale that overflowed tells nothing."""
    error = np.abs(error)
    safe = np.where(error == 0, 1.0, scale)
    return np.where(np.isinf(safe), np.inf, error / safe)


def _ratio(error: Vector, scale: Vector | float) -> float:
    if isinstance(scale, float) and 0 < scale < np.inf:  # rounding is monotonic
        return float(np.abs(error).max(initial=0.0) / scale)
    return float(_ratios(error, scale).max(initial=0.0))


def _excess(
    error: Vector,
    size: Vector | float,
    scale: Vector | float,
    excused: float = EXCUSED,
) -> float:
    """Largest ratio to the scale of what rounding of terms of that size leaves open.

    excused : of the scale, what is called rounding at most
    """
    rounding = np.minimum(ROUNDING * size, excused * scale)
    rounding = np.where(np.isfinite(rounding), rounding, 0)
    return _ratio(np.maximum(np.abs(error) - rounding, 0), scale)


def _row_maxima(M: Matrix) -> Vector:
    if 0 in M.shape:
        return np.zeros(M.shape[0])
    largest = abs(M).max(axis=1)
    return np.asarray(
        largest.toarray() if hasattr(largest, "toarray") else largest
    ).ravel()
