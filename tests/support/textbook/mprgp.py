"""MPRGP: modified proportioning with reduced gradient projections.

Minimises ½xᵀHx − bᵀx over l ≤ x ≤ u (Dostál 2009, the paper's reference [3], Chapter 5;
Dostál and Schöberl 2005). With the gradient g = Hx − b, the free gradient φ (g where x
is off its bounds), the chopped gradient β (the part of g on the bounds that leads
inside) and the projected gradient g^P = φ + β, each step is one of

* c, conjugate gradient: minimise along p on the face, if the minimiser is feasible; p
  is conjugate to all stored `Directions` of the face, not only to the last one
* b, beyond: conjugate gradients on the face without its bounds, before an expansion
* e, expansion of the active set by the rule `Expansion`
* f, fallback: safe repetition of an expansion whose gain is too small
* p, proportioning: free components by the rule `Proportioning`

A proportioning step is taken if  ‖β‖² > Γ² φ̃ᵀφ,  where φ̃ is the reduced free gradient:
a step of length ᾱ along −φ̃ does not leave the box.

A run also ends if it *stagnates*. Stagnation is tested after `FIRST_LOOK` steps, then
each time the number of steps has doubled. A run stagnates if, since the previous test,
the least ‖g^P‖ was not halved and the decrease of the cost is within the rounding error
of its terms. Rounding then leaves no descent direction that is conjugate to the
previous ones.

No step except projcg increases the cost; with the model τI, the reduction is
sufficient for the convergence rate of the book. Expansion never frees a component that
the half step left at a bound, except in the first expansion by a model with directions.
Apart from this exception, the active set only grows between two proportioning steps.
See docs/smalbe-theory.md.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal, NamedTuple, get_args

import numpy as np

from mortarbench.harness import Vector
from tests.support.textbook import kernels
from tests.support.textbook.kernels import Mask, inner_products
from tests.support.textbook.model import BoxModel

Operator = Callable[[Vector], Vector]
#: function from the mask of free components to their preconditioner
Precondition = Callable[[Mask], Operator]

#: Rules of expansion:
#: std: the largest feasible CG step, then x ← x − ᾱφ̃ (the book; 2 products)
#: projcg: x ← P(x − α_cg p), even if the cost increases (PERMON; 2 products)
#: mixed: projcg or, if it increases the cost, std (ESPRESO; 2 or 3 products)
#: model: the CG point, projected in the metric of the model (2 products, or 1 if only
#: the largest feasible CG step is taken; a product for each step beyond the box; and
#: one more if the gain is below that of gradient projection)
Expansion = Literal["std", "projcg", "mixed", "model"]
#: Rules of proportioning:
#: cg: minimise along −β within the box (the book; 1 product)
#: model: a `Model.step`, which for B = I/ᾱ is a projected gradient step (1 product);
#: after `MOST_IDLE` successive proportionings that did not halve ‖β‖², cg is used
Proportioning = Literal["cg", "model"]
MOST_IDLE = 2
FIRST_LOOK = 500  #: number of steps after which the progress of a run is first tested
#: ratio of the slopes along p and along z, below which the gradient has drifted back
#: into the span of the previous directions
DRIFT = 0.5
NOISE = 1e-13  #: fraction of the terms of a cost that is attributed to rounding
EXPANSIONS, PROPORTIONINGS = get_args(Expansion), get_args(Proportioning)


@dataclass(frozen=True)
class Rules:
    """Rules by which MPRGP moves between faces."""

    Gamma: float = 1.0  #: proportioning constant Γ > 0
    expansion: Expansion = "model"
    proportioning: Proportioning = "model"
    reduced: bool = True  #: compare ‖β‖² with φ̃ᵀφ (the book), not with φᵀφ (PERMON)
    #: divisor of τ in expansions by the model; ᾱ‖H‖ in gradient projection
    relaxation: float = 1.9
    kept: int = 0  #: maximum number of CG directions stored on a face


class Point(NamedTuple):
    """A feasible x with its gradient."""

    x: Vector
    g: Vector  #: Hx − b


class Face(NamedTuple):
    """The gradient split by the face on which x lies."""

    free: Mask  #: components off their bounds
    phi: Vector  #: free gradient
    beta: Vector  #: chopped gradient
    phi_square: float  #: ‖φ‖²
    beta_square: float  #: ‖β‖²

    @property
    def projected_norm(self) -> float:
        """‖g^P‖₂, zero exactly at the minimiser."""
        return math.sqrt(self.phi_square + self.beta_square)


@dataclass(frozen=True, eq=False)
class Directions:
    """The last k conjugate directions of CG on a face, scaled such that pᵢᵀHpⱼ = δᵢⱼ.

    In exact arithmetic, conjugacy to the last direction implies conjugacy to all k.
    Rounding destroys this after some dozens of steps, and a new right-hand side on the
    same face (after a multiplier step) destroys it immediately. Explicit
    orthogonalisation against all k directions avoids both, at the cost of two passes
    over k vectors per step (Farhat, Crivelli and Roux, Comput. Methods Appl. Mech.
    Engrg. 117, 1994, 195-209).
    """

    free: Mask
    p: tuple[Vector, ...] = ()
    Hp: tuple[Vector, ...] = ()

    def next(
        self, z: Vector, p: Vector, Hp: Vector, most: int
    ) -> tuple[Directions, Vector]:
        """Append p, and return z made conjugate to all directions.

        If there are more than `most` directions, the oldest one is dropped. On several
        ranks, all inner products share one reduction.
        """
        curvature, along, *others = inner_products(
            (p, Hp), (z, Hp), *((z, Hq) for Hq in self.Hp)
        )
        new = kernels.less(z, (along / curvature, *others), p, *self.p)
        if not most:
            return self, new
        scale = 1 / math.sqrt(curvature)
        kept = Directions(
            self.free,
            (*self.p, kernels.scaled(scale, p))[-most:],
            (*self.Hp, kernels.scaled(scale, Hp))[-most:],
        )
        return kept, new

    def conjugate(self, p: Vector) -> Vector:
        """Return p made conjugate to the stored directions."""
        if not self.p:
            return p
        along = inner_products(*((p, Hq) for Hq in self.Hp))
        return kernels.less(p, along, *self.p)

    def minimising(self, g: Vector) -> tuple[Vector, Vector]:
        """Return s and Hs such that x − s minimises the cost over the directions."""
        shares = inner_products(*((g, q) for q in self.p))
        back, none = [-share for share in shares], np.zeros_like(g)
        return kernels.less(none, back, *self.p), kernels.less(none, back, *self.Hp)


class Progress(NamedTuple):
    """Progress of a run since the last test for stagnation."""

    least: float = math.inf  #: least ‖g^P‖² since the last test
    before: float = math.inf  #: least ‖g^P‖² before the last test
    cost: float = math.inf  #: twice the cost at the last test

    def with_gradient(self, square: float) -> Progress:
        """Return the progress with ‖g^P‖² of a further point."""
        return self._replace(least=min(self.least, square))

    def stagnates(self, cost: float, terms: float) -> bool:
        """Return True if neither the gradient nor the cost has decreased enough.

        cost : twice the cost
        terms : sum of the absolute values of the terms of the cost
        """
        falls = self.cost - cost > NOISE * terms
        return not falls and 4 * self.least > self.before

    def from_here(self, cost: float) -> Progress:
        """Return the progress restarted at this value of twice the cost."""
        return Progress(before=min(self.least, self.before), cost=cost)


class Minimum(NamedTuple):
    """Result of MPRGP."""

    x: Vector
    g: Vector  #: Hx − b
    face: Face
    stopped: bool  #: True if the criterion `stop` ended the run
    trace: str  #: one letter per step: c, b, e, f, p
    directions: Directions  #: directions on the last face


#: observer called after each step within the box: letter, new point and its face
Watch = Callable[[str, Point, Face], None]
#: letters (the last is that of the step itself), new point and model; None if the cost
#: is unbounded below or cannot decrease within rounding
Step = tuple[str, Point, BoxModel] | None


class _Line(NamedTuple):
    """A direction of conjugate gradients and its step lengths."""

    p: Vector
    Hp: Vector
    cg: float  #: α_cg, which minimises the cost at x − αp; inf if pᵀHp ≤ 0
    feasible: float  #: largest feasible α


class _Stay(NamedTuple):
    """CG steps on one face."""

    inside: int  #: number of CG steps on the face
    began: float  #: ‖φ‖² at the first of these steps


class _Task(NamedTuple):
    H: Operator
    b: Vector
    bounds: tuple[Vector, Vector]
    rules: Rules


def mprgp(
    H: Operator,
    b: Vector,
    bounds: tuple[Vector, Vector],
    start: tuple[Vector, Vector],
    *,
    B: BoxModel,
    stop: Callable[[Point, Face], bool],
    rules: Rules,
    precondition: Precondition | None = None,
    watch: Watch | None = None,
    max_steps: int = 10_000,
    directions: Directions | None = None,
) -> Minimum:
    """Minimise ½xᵀHx − bᵀx over l ≤ x ≤ u.

    Parameters
    ----------
    H : symmetric positive semidefinite (n, n) as a function v → Hv
    bounds : l and u (n,), possibly infinite
    start : a feasible x (n,) and its gradient Hx − b
    B : a model of H; ᾱ = 1/τ is the length of plain gradient projection steps
    stop : function of point and face that returns True to stop; called before every
        step
    precondition : function that returns the preconditioner of the CG steps in a face
    watch : observer of each step, called with its letter, the new point and its face
    directions : directions of an earlier run with the same H. If that run ended on the
        face of the start, the cost is first minimised over them, without a product

    """
    task = _Task(H, b, bounds, rules)
    precondition = precondition or _none
    trace = ""
    at, face, known = _minimised_along(task, Point(*start), directions)
    z_of = precondition(face.free)
    z = z_of(face.phi)
    p, stay = known.conjugate(z), _Stay(0, face.phi_square)
    at_drift = math.inf  # ‖φ‖² at the last removal of rounding along the directions
    idle, chopped = 0, math.inf  # number of idle proportionings, and the last ‖β‖²
    progress, look = Progress(), FIRST_LOOK
    while not (done := stop(at, face)) and len(trace) < max_steps:
        progress = progress.with_gradient(face.phi_square + face.beta_square)
        if len(trace) >= look:
            terms = inner_products((at.x, at.g - b), (np.abs(at.x), np.abs(at.g - b)))
            if progress.stagnates(*terms):
                break
            progress, look = progress.from_here(terms[0]), 2 * len(trace)
        if _disproportional(task, at, face, B):
            idle = idle + 1 if face.beta_square > chopped / 2 else 0
            chopped = face.beta_square
            step = _proportion(
                task, at, face, B, by_model=idle < MOST_IDLE or not B.has_directions
            )
        else:
            Hp = H(p)
            slope, expected = inner_products((at.g, p), (face.phi, z))
            drifts = bool(known.p) and (
                slope < DRIFT * expected and 4 * face.phi_square < at_drift
            )
            step = _minimise_or_expand(
                task, at, face, p, Hp, B, stay=stay, first=not trace.strip("cp"),
                uphill=drifts and slope <= 0,
            )  # fmt: skip
        if step is None:
            break
        letters, at, B = step
        face = split(at, bounds)
        if letters == "c" and drifts:
            if slope > 0:
                known, _ = known.next(z, p, Hp, rules.kept)
            at, face, known = _minimised_along(task, at, known)
            at_drift = face.phi_square
            z_of = precondition(face.free)
            z = z_of(face.phi)
            p, stay = known.conjugate(z), stay._replace(inside=stay.inside + 1)
        elif letters == "c":
            z = z_of(face.phi)
            known, p = known.next(z, p, Hp, rules.kept)
            stay = stay._replace(inside=stay.inside + 1)
        else:
            z_of, known = precondition(face.free), Directions(face.free)
            p = z = z_of(face.phi)
            stay, at_drift = _Stay(0, face.phi_square), math.inf
        trace += letters
        if watch is not None:
            watch(letters[-1], at, face)
    return Minimum(at.x, at.g, face, done, trace, known)


def _minimised_along(
    task: _Task, at: Point, known: Directions | None
) -> tuple[Point, Face, Directions]:
    """Minimise over the stored directions of this face, as far as the step is feasible.

    If the step reaches a bound, the face changes and the directions are discarded.
    """
    face = split(at, task.bounds)
    if known is None or not known.p or not (known.free == face.free).all():
        return at, face, Directions(face.free)
    s, Hs = known.minimising(at.g)
    if inner_products((at.g, s))[0] > 0:
        length = min(kernels.lengths(*at, s, Hs, *task.bounds))
        at = _moved(task, at, length, s, Hs)
    face = split(at, task.bounds)
    same = bool((known.free == face.free).all())
    return at, face, known if same else Directions(face.free)


def split(at: Point, bounds: tuple[Vector, Vector]) -> Face:
    """Split the gradient into the free and the chopped gradient."""
    return Face(*kernels.split(*at, *bounds))


def _disproportional(task: _Task, at: Point, face: Face, B: BoxModel) -> bool:
    """Return True if ‖β‖ is large relative to ‖φ‖, so that the face should be left."""
    if face.beta_square == 0:
        return False
    free_square = face.phi_square
    if task.rules.reduced:
        cut = kernels.reduced(at.x, face.phi, 1 / B.tau, *task.bounds)
        free_square = float(cut @ face.phi)
    return face.beta_square > task.rules.Gamma**2 * free_square


def _proportion(
    task: _Task, at: Point, face: Face, B: BoxModel, *, by_model: bool
) -> Step:
    """Take a step that frees components and respects the opposite bounds."""
    if by_model and task.rules.proportioning == "model":
        return _model_step(task, at, B)
    p = face.beta
    Hp = task.H(p)
    length = min(kernels.lengths(*at, p, Hp, *task.bounds))
    return None if math.isinf(length) else ("p", _moved(task, at, length, p, Hp), B)


def _minimise_or_expand(
    task: _Task, at: Point, face: Face, p: Vector, Hp: Vector, B: BoxModel,
    *, stay: _Stay, first: bool, uphill: bool,
) -> Step:  # fmt: skip
    """Take the CG step if it is feasible (of length 0 if it is uphill); else expand."""
    H, b, bounds, rules = task
    cg, feasible = kernels.lengths(*at, p, Hp, *bounds)
    if math.isinf(min(cg, feasible)):
        return None
    if cg <= feasible:
        return "c", _moved(task, at, 0.0 if uphill else cg, p, Hp), B
    if rules.expansion in ("projcg", "mixed") and math.isfinite(cg):
        x = np.clip(at.x - cg * p, *bounds)
        new = Point(x, H(x) - b)
        if rules.expansion == "projcg" or _cost(new, b) <= _cost(at, b):
            return "e", new, B
    half = _moved(task, at, feasible, p, Hp)
    if rules.expansion == "model":
        line = _Line(p, Hp, cg, feasible)
        return _model_expansion(task, at, face, half, line, B, stay=stay, first=first)
    x = np.clip(half.x - split(half, bounds).phi / B.tau, *bounds)  # cuts φ to φ̃
    letter = "f" if rules.expansion == "mixed" else "e"
    return letter, Point(x, H(x) - b), B


def _model_step(task: _Task, at: Point, B: BoxModel) -> Step:
    """Minimise the model over the box, then the cost along the resulting step.

    If B ≥ H, the minimising length is at least 1. If the product shows that B < H along
    the step, the model is raised; the line search reduces the cost in either case.
    """
    s = B.step(at.x, at.g, task.bounds)
    if not s.any():  # no further decrease is possible within rounding
        return None
    Hs = task.H(s)
    cost, feasible = kernels.lengths(*at, -s, -Hs, *task.bounds)
    length = min(cost, max(1.0, feasible))
    if math.isinf(length):
        return None
    B = B if cost >= 1 else B.raised(s, float(s @ Hs))
    return "p", _moved(task, at, -length, s, Hs), B


def _model_expansion(
    task: _Task, at: Point, face: Face, half: Point, line: _Line, B: BoxModel,
    *, stay: _Stay, first: bool,
) -> Step:  # fmt: skip
    """Project the infeasible CG point z onto the box in the metric of the model.

    z is x − α_cg p. In a flat spectrum (a model without directions), z is the result of
    further CG steps on the face without bounds. The cost at z is known.
    If B ≥ H, the model bounds the cost at other points,

        f(z + r) ≤ f(z) + g(z)ᵀr + ½rᵀBr,

    and z + r minimises the right-hand side over the box. The tail of B is divided by
    the relaxation, just as gradient projection steps are longer than 1/‖H‖. Components
    that the half step left at a bound stay there, except in the `first` expansion by a
    model with directions, because the active set is then only a guess. The step from
    the half step ends at z + r if the cost there is below the cost at x; otherwise its
    length minimises the cost. If B = τI and the decrease is less than φ̃ᵀφ/2τ (the
    decrease by gradient projection from x for τ ≥ ‖H‖), gradient projection is used.
    """
    (p, Hp, cg, feasible), (lower, upper) = line, task.bounds
    release = first and B.has_directions
    held = ((half.x <= lower) | (half.x >= upper)) & (not release)
    box = np.where(held, half.x, lower), np.where(held, half.x, upper)
    z, letters = half, ""
    if math.isfinite(cg):
        z = Point(half.x - (cg - feasible) * p, half.g - (cg - feasible) * Hp)
        if not B.has_directions:
            z, letters = _beyond(task, z, face.free, line, stay)
    relaxed = B.relaxed(task.rules.relaxation)
    to = kernels.within(z.x, relaxed.step(*z, box), *box)
    s = np.where(held, 0.0, to - half.x)
    if half.g @ s >= 0:
        z, s = half, B.step(*half, box)
    new, raised = half, B
    change = _change(inner_products((at.g, -p), (p, Hp)), feasible)
    if s.any():
        Hs = task.H(s)
        cost, most = kernels.lengths(*half, -s, -Hs, *task.bounds)
        length = min(cost, max(1.0, most))
        if math.isinf(length):
            return None
        along = inner_products((half.g, s), (s, Hs))
        if change + _change(along, 1.0) < 0:
            length = max(length, 1.0)
        change += _change(along, length)
        r, Hr = half.x + s - z.x, half.g + Hs - z.g
        new, raised = _moved(task, half, -length, s, Hs), B.raised(r, float(r @ Hr))
    if not B.has_directions:
        cut = kernels.reduced(at.x, face.phi, 1 / B.tau, *task.bounds)
        if -change < float(cut @ face.phi) / (2 * B.tau):
            return _project_gradient(task, at, face, B.tau, raised, letters)
    return letters + "e", new, raised


def _beyond(
    task: _Task, z: Point, free: Mask, line: _Line, stay: _Stay
) -> tuple[Point, str]:
    """Continue with CG on the face without its bounds and without a preconditioner.

    Stop if the free gradient is as small as at the start on the face, and at the latest
    after as many steps as were taken inside the box (at least one).
    """
    p, Hp, letters = line.p, line.Hp, ""
    for _ in range(max(stay.inside, 1)):
        phi = np.where(free, z.g, 0.0)
        if phi @ phi <= stay.began:
            break
        p = kernels.conjugate(phi, p, Hp)
        Hp, letters = task.H(p), letters + "b"
        curvature = float(p @ Hp)
        if curvature <= 0:
            break
        length = float(phi @ p) / curvature
        z = Point(z.x - length * p, z.g - length * Hp)
    return z, letters


def _project_gradient(
    task: _Task, at: Point, face: Face, tau: float, B: BoxModel, letters: str
) -> Step:
    """Step along s = P(x − φ/τ) − x to the minimum of the cost within the box."""
    s = np.clip(at.x - face.phi / tau, *task.bounds) - at.x
    if not s.any():
        return None
    Hs = task.H(s)
    cost, most = kernels.lengths(*at, -s, -Hs, *task.bounds)
    length = min(cost, max(1.0, most))
    if math.isinf(length):
        return None
    B = B.raised(s, float(s @ Hs))
    return letters + "f", _moved(task, at, -length, s, Hs), B


def _change(along: tuple[float, ...], t: float) -> float:
    """Return f(x + ts) − f(x), computed from gᵀs and sᵀHs."""
    slope, curvature = along
    return t * (slope + 0.5 * t * curvature)


def _moved(task: _Task, at: Point, alpha: float, p: Vector, Hp: Vector) -> Point:
    """Return x − αp with its gradient, which needs no product with H."""
    return Point(*kernels.moved(*at, alpha, p, Hp, *task.bounds))


def _cost(at: Point, b: Vector) -> float:
    """Return xᵀHx − 2bᵀx, twice the cost, from the gradient."""
    return float(at.x @ (at.g - b))


def _none(free: Mask) -> Operator:
    return lambda v: v
