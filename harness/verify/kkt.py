"""Measures of the optimality of a primal-dual point, independent of the solver.

All residuals are scale-free: they do not change if the objective or a row is multiplied
by a positive constant (and the multipliers are scaled accordingly), so that one
threshold suits every problem. If the diagonal of P is available, a change of the unit
of a variable can change only the dual residual, through the scale S of all components.
Up to rounding, all four residuals vanish if and only if the point is a KKT point. Such
a point is a solution if P is positive semidefinite, which is not checked here.
docs/verdicts.md states what small residuals prove about the objective. If residuals do
not suffice for a verdict, `harness.verify.optimum` compares the objective of the point
with a proven optimum.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array

from mortarbench.harness.qp import QP, Matrix, Vector
from mortarbench.harness.record import VERIFIED_FACTOR, Record, Verdict
from mortarbench.harness.sets.blocks import Blocks
from mortarbench.harness.sets.convex import Limits, Sum, admissible, hull
from mortarbench.harness.solution import Solution, Status
from mortarbench.harness.verify import scales

#: Rounding error of a sum, relative to the sum of its absolute terms. The error of a
#: sum of k terms grows like √k·2⁻⁵³, and this value covers k = 256. With 0, a row that
#: is satisfied exactly is reported as violated
#: (`test_rounding_in_products_with_an_operator_does_not_refute_an_answer`).
ROUNDING = 8 * float(np.finfo(float).eps)
#: Largest error, as a fraction of its scale, that may be attributed to rounding.
#: In a comparison with a proven optimum, `MAX_CANCELLATION` allows an error of 5e-4 of
#: the objective at tol 1e-8. This fraction is added twice, for the uncertainty of the
#: optimum and for rounding. The total is below 1e-3, so that three digits of the
#: objective are correct. With 2e-3,
#: `test_multipliers_that_cancel_leave_no_doubt_of_an_exact_point` fails; with 1e-9,
#: `test_cancelling_terms_are_evaluated_exactly` fails.
NEGLIGIBLE = 2e-4
#: Smallest scale of energy, as a fraction of a natural energy (`_natural_energies`).
#: If the energy of a point is smaller, for instance near x = 0, errors are divided by
#: this fraction of the natural energy. With 1e-3,
#: `test_rounding_errors_about_a_zero_solution_are_small` fails.
LEAST_ENERGY = 1e-2
#: Fraction of a natural energy below which the energy of a point is negligible. With
#: generous scales, errors of such a point are divided by the natural energy. With 1,
#: `test_the_code_of_your_own_solver` fails: answers with residuals of 1.2e-2 and 3.6e-2
#: are then compared with the proven optimum at tol 1e-3 and verified.
NO_ENERGY = 1e-6
#: Loads (entries of q) are attributed to rounding below this fraction of the largest
#: load, or of the largest diagonal entry of P times the largest right-hand side or
#: bound: about 450 errors of 2⁻⁵². With 0, loads of 1e-17 determine the scale
#: (`test_a_right_point_is_verified_by_its_residuals`, case 11).
LOAD_ROUNDING = 1e-13
#: Largest number of passes over the rows. Each pass determines the sizes of variables
#: without curvature and cost in active rows that have a nonzero right-hand side or a
#: variable of known size. The limit bounds the run time. With 3,
#: `test_a_chain_of_idle_variables_is_as_long_as_its_first_row` fails.
MAX_PASSES = 100
#: Number of power iterations for the largest eigenvalue of P. The estimate is typically
#: a few percent too small, which changes the natural map by a similar percentage.
POWER_STEPS = 20


class Residuals(NamedTuple):
    """Scale-free KKT residuals; at least one is NaN if the point contains NaN."""

    primal: float  #: largest violation of a row, bound or other set
    dual: float  #: largest error of stationarity or of the sign of a multiplier
    #: largest |multiplier·slack|, or |support gap| of a disc or cone, relative to E
    complementarity: float
    gap: float  #: |primal − dual objective|, relative to the scale E of energy

    @property
    def worst(self) -> float:
        """The largest of the four residuals; NaN if any of them is NaN."""
        return float(np.max(self))


class Normality(NamedTuple):
    """Distances from optimality for discs and cones; NaN if x contains NaN.

    The complementarity of a disc, r‖z‖ − zᵀx, is of second order in the angle between z
    and x, whereas these distances are of first order. Verdicts do not depend on these
    distances: verdicts bound the error of the objective, which is also of second order.
    """

    natural_map: float  #: ‖x − Π(x − g/L)‖·L/‖q‖, see `normality`
    #: largest distance of z_box from a normal cone at x, relative to forces
    normal_distance: float


class Scales(NamedTuple):
    """Units in which the errors of a point are measured."""

    energy: float  #: E, scale of errors of the objective
    x: Vector  #: Xⱼ (n,), size of each variable


class _Constraints(NamedTuple):
    """Slacks of all constraints at a point: b − Ax, h − Gx, and slacks of the sets."""

    equalities: Limits  #: in contrast to other limits, satisfied only if slack = 0
    inequalities: Limits
    sets: list[Sequence[Limits]]  #: limits of each set of the QP

    def inequalities_and_limits(self) -> Iterator[Limits]:
        """Yield inequality rows, if there are any, then the limits of the sets."""
        if self.inequalities.size.size:
            yield self.inequalities
        for limits in self.sets:  # collective: even without local components
            yield from limits


@dataclass(frozen=True, eq=False)
class _Terms:
    """Quantities in the KKT conditions at a point, and sums of their absolute terms."""

    x: Vector  #: |xⱼ| (n,)
    constraints: _Constraints
    Px: Vector
    #: upper bound on Σ|Pᵢⱼ||xⱼ|; ‖Px‖∞ if P has no diagonal
    Px_size: Vector
    curvature: Vector  #: max(Pᵢᵢ, 0); zero if P has no diagonal
    has_diagonal: bool  #: False if P is an operator that does not return its diagonal
    forces: Vector  #: Aᵀy + Gᵀz + z_box
    forces_size: Vector  #: sums of the absolute terms of `forces`
    residual: Vector  #: r in `kkt_residuals`: Px + q + Aᵀy + Gᵀz⁺ + admissible z_box
    #: z_box minus its admissible part, for instance the multipliers of absent bounds
    excess: Vector
    energies: Vector  #: xᵀPx, qᵀx, bᵀy + hᵀz + σ(z_box)
    energies_size: float  #: sum of the absolute terms of the three energies


@np.errstate(all="ignore")  # a point may contain NaN, inf, or 1e300
def kkt_residuals(qp: QP, s: Solution, *, generous: bool = False) -> Residuals:
    """Return the scale-free residuals of the KKT conditions of `qp` at `s`.

    Let E be the scale of energy, Xⱼ the sizes of the variables (`scales_at`), and
    r = Px + q + Aᵀy + Gᵀz⁺ + z_box without the multipliers of absent bounds, where
    v⁺ = max(v, 0) and v⁻ = min(v, 0). Each residual is the largest of these quantities:

    * primal: violations of aᵢx = bᵢ, gᵢx ≤ hᵢ or a bound, divided by |bᵢ| + Σ|aᵢⱼ|Xⱼ;
      if bᵢ ≠ 0, by the smaller of this sum and 10|bᵢ| + Σ|aᵢⱼ|oⱼ, where the sizes oⱼ
      are computed without a scale of energy (`own_size` in scales.h)
    * dual: |rᵢ|/S, |zᵢ⁻|‖gᵢ‖∞/S and multipliers of absent bounds divided by S, where S
      is the largest of ‖Px‖∞, ‖q‖∞, ‖Aᵀy + Gᵀz + z_box‖∞ and √(E·p), and p is the
      smallest positive Pⱼⱼ; the smaller of |rᵢ|Dᵢ/E and the ratio of |rᵢ| to the
      largest of |Px|ᵢ, |qᵢ| and |Aᵀy + Gᵀz + z_box|ᵢ
    * complementarity: |zᵢ(h − Gx)ᵢ|/E, and the same products for bounds
    * gap: |xᵀPx + qᵀx + bᵀy + hᵀz + lbᵀz_box⁻ + ubᵀz_box⁺|/E

    The violation, support gap and support function of each disc and cone are treated
    like those of bounds (`harness.sets.convex`). Dᵢ = min(max(|xᵢ|, sᵢ), wᵢ), where
    sᵢ = |rᵢ|/Pᵢᵢ is the step to the minimum along i (Xᵢ for a variable with neither
    curvature nor cost) and wᵢ the distance to the bound in that direction, 0 beyond the
    bound. If P has no diagonal, xᵀPx/xᵀx replaces Pᵢᵢ in sᵢ.

    Before a residual is divided by its scale, `ROUNDING` times the sum of its absolute
    terms is subtracted, but at most `NEGLIGIBLE` times the scale. In the ratios that
    contain Dᵢ or the largest term, the subtraction is not limited. Nothing is
    subtracted from zᵢ⁻ and from multipliers of absent bounds.

    generous : use the largest justifiable scale of energy, and subtract the rounding of
        energies even if it exceeds `NEGLIGIBLE` times the scale

    Examples
    --------
    >>> import numpy as np
    >>> from mortarbench import QP, Solution, Status
    >>> from mortarbench.harness.verify.kkt import kkt_residuals
    >>> qp = QP.from_arrays(np.eye(2), [-1, -1], lb=0)
    >>> s = Solution(
    ...     status=Status.SOLVED, x=np.array([1.0, 1.0 + 1e-6]), y=np.zeros(0),
    ...     z=np.zeros(0), z_box=np.zeros(2),
    ... )
    >>> kkt_residuals(qp, s).worst <= 1e-5  # verified at tolerance 1e-6
    True
    >>> kkt_residuals(qp, s).worst <= 1e-7  # but not at 1e-8
    False

    """
    t, most_rounding = _terms(qp, s), np.inf if generous else NEGLIGIBLE
    E, X = _scales(
        qp, s.x, _energy(qp, t, generous), t.curvature, has_diagonal=t.has_diagonal
    )
    return Residuals(
        _violation(
            t.constraints, X, scales.own_sizes(t.Px, t.curvature, s.x, dtype=float)
        ),
        _dual(qp, s, t, E, X),
        _complementarity(qp, s, t.constraints, E, most_rounding),
        _excess(t.energies.sum(keepdims=True), t.energies_size, E, most_rounding),
    )


@np.errstate(all="ignore")  # a point may contain NaN, inf, or 1e300
def normality(qp: QP, s: Solution, tol: float) -> Normality | None:
    """Return distances of a point from optimality; None without discs and cones.

    * `natural_map` is ‖x − Π(x − g/L)‖·L/‖q‖ with g = Px + q + Aᵀy + Gᵀz, the
      projection Π onto all sets and an estimate L of the largest eigenvalue of P. It
      does not depend on z_box. If q = 0, the value is relative to the larger of ‖Px‖
      and ‖Aᵀy + Gᵀz‖. If P = 0, L is 1.
    * `normal_distance` is the largest Euclidean distance of z_box on a disc or cone
      from the normal cone of the set at x, relative to the largest of ‖Px‖∞, ‖q‖∞ and
      ‖Aᵀy + Gᵀz + z_box‖∞.

    tol : a disc or cone is active if its relative slack is at most `tol`

    Examples
    --------
    The nearest point to (3, 4) in the unit disc, turned by an angle of 10⁻⁴:

    >>> import numpy as np
    >>> from mortarbench import QP, Discs, Solution, Status
    >>> from mortarbench.harness.verify.kkt import kkt_residuals, normality
    >>> qp = QP.from_arrays(np.eye(2), [-3, -4], sets=[Discs([[0, 1]], [1])])
    >>> c, s = np.cos(1e-4), np.sin(1e-4)
    >>> x = np.array([[c, -s], [s, c]]) @ [0.6, 0.8]
    >>> none = np.zeros(0)
    >>> point = Solution(
    ...     status=Status.SOLVED, x=x, y=none, z=none, z_box=[3, 4] - x
    ... )
    >>> f"{kkt_residuals(qp, point).worst:.0e}"
    '6e-09'
    >>> [f"{value:.0e}" for value in normality(qp, point, 1e-8)]
    ['2e-05', '1e-04']

    """
    blocks = [one for one in qp.sets[1:] if isinstance(one, Blocks)]
    if not blocks:
        return None
    Px, rows = qp.P @ s.x, qp.A.T @ s.y + qp.G.T @ s.z
    g, L = Px + qp.q + rows, largest_eigenvalue(qp)
    moved = s.x - g / L if L > 0 else s.x - g
    for one in qp.sets:
        moved = one.project(moved)
    sizes = [float(np.linalg.norm(v)) for v in (qp.q, Px, rows)]
    size = sizes[0] or max(sizes) or 1.0
    force = max(_sup(v) for v in (Px, qp.q, rows + s.z_box)) or 1.0
    distances = [one.normal_distances(s.x, s.z_box, tol) for one in blocks]
    return Normality(
        float(np.linalg.norm(s.x - moved)) * (L or 1.0) / size,
        float(np.max([np.max(d) for d in distances])) / force,
    )


def largest_eigenvalue(qp: QP) -> float:
    """Estimate the largest eigenvalue of P from below by power iteration."""
    v = np.random.default_rng(0).standard_normal(qp.q.size)
    for _ in range(POWER_STEPS):
        v = qp.P @ (v / np.linalg.norm(v))
        if not v.any():
            return 0.0
    return float(np.linalg.norm(v))


def _terms(qp: QP, s: Solution) -> _Terms:
    x = np.abs(s.x)
    d, has_diagonal = _curvature(qp)
    root, A_size, G_size = np.sqrt(d), _abs(qp.A), _abs(qp.G)
    Px = qp.P @ s.x
    # |Pᵢⱼ| ≤ √(PᵢᵢPⱼⱼ), as P is positive semidefinite
    Px_size = root * (root @ x) if has_diagonal else 0 * x + _sup(Px)
    rows = _combined(qp.A, s.y) + _combined(qp.G, np.maximum(s.z, 0))
    borne = admissible(qp.sets, s.z_box)
    supports = [one.support(s.z_box) for one in qp.sets]
    work = qp.b @ s.y + qp.h @ s.z
    for support in supports:
        work += support.value
    sizes = (
        x @ np.abs(Px),
        np.abs(qp.q) @ x,
        np.abs(qp.b) @ np.abs(s.y),
        np.abs(qp.h) @ np.abs(s.z),
        *(support.terms for support in supports),
    )
    return _Terms(
        x=x,
        constraints=_constraints(qp, s.x, A_size, G_size),
        Px=Px,
        Px_size=Px_size,
        curvature=d,
        has_diagonal=has_diagonal,
        forces=rows + _combined(qp.G, np.minimum(s.z, 0)) + s.z_box,
        forces_size=_combined(A_size, np.abs(s.y))
        + _combined(G_size, np.abs(s.z))
        + np.abs(s.z_box),
        residual=Px + qp.q + rows + borne,
        excess=s.z_box - borne,
        energies=np.array([s.x @ Px, qp.q @ s.x, work]),
        energies_size=float(np.sum(sizes)),
    )


def _combined(M: Matrix, z: Vector) -> Vector | float:
    """Return Mᵀz (n,); 0 if M has no rows."""
    return M.T @ z if M.shape[0] else 0.0


def _constraints(qp: QP, x: Vector, A_size: Matrix, G_size: Matrix) -> _Constraints:
    """Evaluate the constraints at x (n,).

    A_size, G_size : |A| and |G|
    """
    size = np.abs(x)
    equalities, inequalities = (
        Limits(rhs - M @ x, np.abs(rhs), sizes @ size, sizes.__matmul__)
        for M, rhs, sizes in ((qp.A, qp.b, A_size), (qp.G, qp.h, G_size))
    )
    return _Constraints(equalities, inequalities, [one.limits(x) for one in qp.sets])


def violation(qp: QP, x: Vector, X: Vector, own: Vector) -> float:
    """Return the largest relative violation of a row or bound; see `kkt_residuals`.

    X : (n,) sizes of the variables from the scale of energy
    own : (n,) sizes of the variables that do not depend on energies
    """
    return _violation(_constraints(qp, x, _abs(qp.A), _abs(qp.G)), X, own)


def _violation(constraints: _Constraints, X: Vector, own: Vector) -> float:
    c = constraints.equalities
    errors = [(c, c.slack)] if c.size.size else []
    for c in constraints.inequalities_and_limits():
        errors.append((c, np.minimum(c.slack, 0)))
    return _largest(
        0.0,
        *(
            _excess(
                error,
                c.size + c.terms,
                scales.row_scales(c.size, c.sized(X), c.sized(own), dtype=float),
            )
            for c, error in errors
        ),
    )


def own_sizes(qp: QP, x: Vector) -> Vector:
    """Return sizes (n,) of the variables at x (n,) that do not depend on energies.

    The size of variable j is the larger of 10|xⱼ| and |Σₖ Pⱼₖxₖ|/Pⱼⱼ with k ≠ j, the
    distance by which the other variables shift the minimum along j. It is at most the
    size oⱼ in `kkt_residuals`.
    """
    shifts = scales.minimum_shifts(qp.P @ x, _curvature(qp)[0], x, dtype=float)
    sizes: Vector = np.maximum(scales.TERMS_FACTOR * np.abs(x), shifts)
    return sizes


def _dual(qp: QP, s: Solution, t: _Terms, E: float, X: Vector) -> float:
    softest = _least(t.curvature[t.curvature > 0])
    least = np.sqrt(E * softest) if softest < np.inf else 0.0
    S = _largest(_sup(t.Px), _sup(qp.q), _sup(t.forces), least)
    size = t.Px_size + np.abs(qp.q) + t.forces_size
    own = np.maximum.reduce([np.abs(t.Px), np.abs(qp.q), np.abs(t.forces)])
    r = np.abs(t.residual)
    # without curvature and cost, the minimum along i is undetermined: use Xᵢ
    is_idle = (t.curvature == 0) & (qp.q == 0)
    # if P has no diagonal, use its Rayleigh quotient at x instead
    step = _over(r, t.curvature if t.has_diagonal else _rayleigh(s.x, t.Px))
    step = np.where(is_idle, np.maximum(t.x, X), step)
    lower, upper = hull(qp.sets, qp.q.size)
    room = np.where(
        t.residual > 0, s.x - lower, upper - s.x
    )  # distance to the bound in the direction of descent
    signed = (s.z >= 0).all()  # False if z contains NaN
    pulling = 0.0 if signed else _ratio(np.minimum(s.z, 0) * _row_maxima(qp.G), S)
    return _largest(
        _excess(r, size, S),
        _sup(
            scales.balance_errors(
                r, ROUNDING * size, own, step, s.x, room, E, dtype=float
            )
        ),
        pulling,
        _ratio(t.excess, S),
    )


def _rayleigh(x: Vector, Px: Vector) -> Vector:
    """Return the Rayleigh quotient xᵀPx/xᵀx in every component (n,); 0 if x = 0."""
    squared = float(x @ x)
    return float(x @ Px) / squared + 0 * x if squared > 0 else 0 * x


def _complementarity(
    qp: QP, s: Solution, constraints: _Constraints, E: float, most_rounding: float
) -> float:
    c = constraints.inequalities
    gaps = [Sum(s.z * c.slack, np.abs(s.z) * (c.terms + c.size))]
    for one, limits in zip(qp.sets, constraints.sets, strict=True):
        gaps += one.support_gaps(s.x, s.z_box, limits)
    worst = (_excess(gap.value, gap.terms, E, most_rounding) for gap in gaps)
    return _largest(0.0, *worst)


def energy_at(qp: QP, s: Solution, *, generous: bool = False) -> float:
    """Return the scale of energy at a point; see `_energy`."""
    return _energy(qp, _terms(qp, s), generous)


def _energy(qp: QP, t: _Terms, generous: bool) -> float:
    """Return the scale of energy E at a point.

    E is the largest of |xᵀPx|, |qᵀx| and |bᵀy + hᵀz + σ(z_box)|, where σ is the support
    function of the sets. The terms of the third sum are not used separately, since they
    can be arbitrarily large if multipliers cancel. E is limited to `MAX_CANCELLATION`
    times the absolute value of the objective (`energy_scale` in scales.h), and is then
    raised to at least `LEAST_ENERGY` times the smallest natural energy of a variable
    (`_natural_energies`).

    generous : do not limit E by `MAX_CANCELLATION`; use the median of the natural
        energies instead of the smallest, and return it if the energy of the point is
        negligible (`NO_ENERGY`)
    """
    terms = _sup(t.energies)
    if np.isnan(terms):
        return terms
    capped = float(scales.energy_scales(*t.energies, dtype=float))
    E, pick = (terms, _median) if generous else (capped, _least)
    bounds = hull(qp.sets, qp.q.size)
    longest = max(_sup(qp.b), _sup(qp.h), *map(_finite_sup, bounds))
    by_length = _sup(qp.q) <= LOAD_ROUNDING * _sup(t.curvature) * longest
    energies = _natural_energies(
        qp, t.curvature, bounds, by_length=by_length or not qp.q.any()
    )
    natural = pick(energies)
    if (
        E < LEAST_ENERGY * natural
    ):  # only in this rare case, since tightening bounds is expensive
        energies = _natural_energies(qp, t.curvature, tightened(qp), by_length=True)
        natural = pick(energies)
    if not natural < np.inf:
        return E
    vanishes = generous and E <= NO_ENERGY * natural
    return natural if vanishes else max(E, LEAST_ENERGY * natural)


def _least(values: Vector) -> float:
    """Return the least value, over all ranks if distributed; inf if empty."""
    return float(values.min(initial=np.inf))


def _median(values: Vector) -> float:
    """Return the lower median; inf if empty."""
    return float(np.sort(values)[(values.size - 1) // 2]) if values.size else np.inf


def _natural_energies(
    qp: QP, d: Vector, bounds: tuple[Vector, Vector], *, by_length: bool
) -> Vector:
    """Return the energies that single variables can gain; omit undetermined energies.

    The energy of variable i is the smallest of qᵢ²/Pᵢᵢ, |qᵢ|wᵢ and, unless the minimum
    of ½Pᵢᵢxᵢ² + qᵢxᵢ within the bounds is at xᵢ = 0, the magnitude of this minimum.
    Here, wᵢ is the width of the feasible interval. If wᵢ = 0, only the minimum is used.

    bounds : lower and upper bounds (n,), possibly tightened by rows
    by_length : limit the energies of variables without curvature to |qᵢ|lᵢ, and return
        Pᵢᵢlᵢ² if all qᵢ are zero up to rounding; lᵢ is the least length from a row or
        bound (`_lengths`), or 1 if no variable has such a length
    """
    q, (lb, ub) = np.abs(qp.q), bounds
    gain = np.where(q > 0, np.minimum(_over(q**2, d), q * np.maximum(ub - lb, 0)), 0)
    least = np.clip(-np.sign(qp.q) * _over(q, d), lb, ub)
    own = np.abs(d / 2 * least**2 + qp.q * least)
    has_own = (q > 0) & (least != 0) & np.isfinite(own)
    gain = np.where(has_own, np.where(gain > 0, np.minimum(own, gain), own), gain)
    lengths = _lengths(qp) if by_length else np.full(q.size, np.inf)
    if by_length and not np.isfinite(lengths).any():
        lengths = np.ones(q.size)
    flat = (d == 0) & np.isfinite(lengths)
    gain = np.where(flat, np.minimum(gain, q * lengths), gain)
    gain = np.where(np.isfinite(gain), gain, 0)
    # energies are quadratic in q, hence the square
    gain = gain[gain > LOAD_ROUNDING**2 * gain.max(initial=0)]
    bend: Vector = (d * lengths**2)[(d > 0) & np.isfinite(lengths)]
    if bend.size and gain.max(initial=0) <= LOAD_ROUNDING**2 * bend.min():
        return bend
    energies: Vector = gain
    return energies


def _lengths(qp: QP) -> Vector:
    """Return the least length of each variable (n,), inf if it has none.

    Lengths of variable j are nonzero |bᵢ/aᵢⱼ|, |hᵢ/gᵢⱼ|, and absolute values of bounds.
    """
    least = np.full(qp.q.size, np.inf)
    for bound in hull(qp.sets, qp.q.size):
        has_length = np.isfinite(bound) & (bound != 0)
        least[has_length] = np.minimum(least[has_length], np.abs(bound[has_length]))
    for i, j, a, rhs in _entries(qp):
        has_length = rhs[i] != 0
        np.minimum.at(least, j[has_length], np.abs(rhs[i][has_length] / a[has_length]))
    return least


def tightened(qp: QP) -> tuple[Vector, Vector]:
    """Return lower and upper bounds (n,), tightened by each row separately."""
    lower, upper = hull(qp.sets, qp.q.size)
    lb, ub = lower.copy(), upper.copy()
    for k, (i, j, a, rhs) in enumerate(_entries(qp)):
        for sign in (1, -1) if k == 0 else (1,):  # aᵢx = bᵢ is also −aᵢx ≤ −bᵢ
            c = sign * a
            least = np.where(c > 0, c * lower[j], c * upper[j])
            endless = np.isinf(least)
            total = np.bincount(i, np.where(endless, 0, least), rhs.size)
            count = np.bincount(i, endless, rhs.size)
            others = np.where(endless, total[i], total[i] - least)
            room = (sign * rhs[i] - others) / c
            is_bounded = count[i] == endless
            up, down = is_bounded & (c > 0), is_bounded & (c < 0)
            np.minimum.at(ub, j[up], room[up])
            np.maximum.at(lb, j[down], room[down])
    return lb, ub


def _entries(qp: QP) -> Iterator[tuple[Vector, Vector, Vector, Vector]]:
    """Yield rows, columns and values of nonzeros, and right-hand side; of A, then G."""
    for M, rhs in ((qp.A, qp.b), (qp.G, qp.h)):
        at = csr_array(M).tocoo()
        is_entry = at.data != 0
        yield at.row[is_entry], at.col[is_entry], at.data[is_entry], rhs


def scales_at(qp: QP, x: Vector, E: float) -> Scales:
    """Return the sizes of the variables that follow from a scale of energy.

    The energy changes by E over the length lⱼ, the smaller of √(E/Pⱼⱼ) and E/|qⱼ|. Xⱼ
    is the larger of lⱼ and |xⱼ|, but at most `MAX_LENGTHS`·lⱼ, since |xⱼ| may be
    arbitrarily large along a direction without cost. The size of a variable with
    neither curvature nor cost follows from its active rows; without such rows, it is
    |xⱼ|. If P has no diagonal, Xⱼ of a variable with cost is at most ‖x‖∞.
    """
    d, has_diagonal = _curvature(qp)
    return _scales(qp, x, E, d, has_diagonal=has_diagonal)


def _scales(qp: QP, x: Vector, E: float, d: Vector, *, has_diagonal: bool) -> Scales:
    x, E = x.astype(float), float(E)
    X = scales.variable_sizes(E, qp.q, d, x)
    has_length = ~np.isinf(X)
    X = np.where(has_length, X, 0)
    if not has_diagonal:
        X = np.minimum(X, np.maximum(np.abs(x), _sup(x)))
    if not has_length.all():
        X = _sizes_from_rows(qp, x, X, has_length)
    return Scales(E, X)


def _sizes_from_rows(
    qp: QP, x: Vector, X: Vector, has_size: NDArray[np.bool_]
) -> Vector:
    """Derive the sizes of variables with neither curvature nor cost from active rows.

    A row of G is active if its slack is negligible. Inactive rows are omitted, because
    the large right-hand side of a distant row would hide the violation of another row
    (`test_a_remote_row_hides_no_violation`).
    """
    size, has_size = np.abs(x), has_size.copy()
    rows = [
        (i, j, np.abs(a), np.abs(rhs), slack, _abs(M) @ size + np.abs(rhs))
        for (i, j, a, rhs), M, slack in zip(
            _entries(qp), (qp.A, qp.G), (0 * qp.b, qp.h - qp.G @ x), strict=True
        )
    ]
    for _ in range(MAX_PASSES):
        added = np.zeros(x.size)
        for i, j, a, rhs, slack, terms in rows:
            total = rhs + np.bincount(i, a * np.where(has_size, X, 0)[j], rhs.size)
            active = slack <= NEGLIGIBLE * np.maximum(terms, total)
            use = ~has_size[j] & active[i]
            np.maximum.at(added, j[use], (total[i] / a)[use])
        new = ~has_size & (added > 0)
        if not new.any():
            break
        X = np.where(new, added, X)
        has_size |= new
    return np.where(has_size, X, size)


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
    """Return the verdict on a point, given its residuals.

    A point is verified if every residual is at most `allowed(tol, factor)`, even if the
    solver claims no success, unless the solver declined the QP or makes a proven claim
    of infeasibility. Otherwise, the claim determines the type of failure. If the error
    relative to a proven optimum, `error`, is given, it replaces all residuals. A
    refuted claim of success is `inaccurate` if the point has at least half of the
    requested digits (worst residual ≤ √allowed), and `wrong` otherwise. A point whose
    `error`, or worst residual if `error` is None, exceeds 0.1 is not verified at any
    tolerance.

    infeasible : True if the QP is proven to have no feasible point, which verifies a
        claim of infeasibility regardless of the point
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
    """Recompute a stored verdict with the tolerance factor·tol instead of 10·tol.

    The verdict follows from the stored claim and residuals, or from the error relative
    to a proven optimum if that error decided the stored verdict (`Record.decided_by`).
    Verdicts that do not follow from these numbers are returned unchanged. These are
    verdicts on limits, on crashes and on steps after the end of a sequence, and
    verdicts by proofs of infeasibility, which do not depend on a tolerance.
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
    """Return max(Pᵢᵢ, 0) (n,) and True; zeros and False if Pᵢᵢ is unavailable."""
    diagonal = qp.diagonal()
    if diagonal is None:
        return np.zeros(qp.q.size), False
    return np.maximum(diagonal, 0), True


def _sup(v: Vector) -> float:
    return float(np.abs(v).max(initial=0.0))


def _finite_sup(v: Vector) -> float:
    return _sup(v[np.isfinite(v)])


def _abs(M: Matrix) -> Matrix:
    return abs(M) if M.shape[0] else M


def _over(a: Vector | float, b: Vector) -> Vector:
    """Return a/b (n,), with infinity where b is not positive."""
    return np.where(b > 0, a / np.where(b > 0, b, 1), np.inf)


def _largest(*values: float) -> float:
    """Return the largest value; NaN counts as infinite."""
    return max(values, key=lambda value: np.inf if np.isnan(value) else value)


def _ratio(error: Vector, scale: Vector | float) -> float:
    if (
        isinstance(scale, float) and 0 < scale < np.inf
    ):  # the largest error has the largest ratio, since rounded division is monotonic
        return float(np.abs(error).max(initial=0.0) / scale)
    return float(scales.excesses(error, 0.0, scale, dtype=float).max(initial=0.0))


def _excess(
    error: Vector,
    size: Vector | float,
    scale: Vector | float,
    most_rounding: float = NEGLIGIBLE,
) -> float:
    """Subtract rounding from errors, and return the largest ratio of error to scale.

    size : sum of the absolute terms of the error
    most_rounding : largest fraction of the scale that is subtracted as rounding
    """
    rounding = np.minimum(ROUNDING * size, most_rounding * scale)
    return float(scales.excesses(error, rounding, scale, dtype=float).max(initial=0.0))


def _row_maxima(M: Matrix) -> Vector:
    if 0 in M.shape:
        return np.zeros(M.shape[0])
    largest = abs(M).max(axis=1)
    return np.asarray(
        largest.toarray() if hasattr(largest, "toarray") else largest
    ).ravel()
