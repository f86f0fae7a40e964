"""MPRGP: modified proportioning with reduced gradient projections.

Minimises ½xᵀHx − bᵀx over l ≤ x ≤ u (Dostál 2009, the paper's reference [3], Chapter 5;
Dostál and Schöberl 2005). With the gradient g = Hx − b, the free gradient φ (g where x
is off its bounds), the chopped gradient β (the part of g on the bounds that leads
inside) and the projected gradient g^P = φ + β, each step is one of

* c, conjugate gradient: minimise along p on the face, if that stays feasible; p is made
  conjugate to all `Directions` taken on the face, not to the last alone
* b, beyond: conjugate gradients on the face as if it had no bounds, for the expansion
* e, expansion of the active set, by one of the `EXPANSIONS`
* f, fallback: an expansion that gained too little, done anew in the safe way
* p, proportioning: free components, by one of the `PROPORTIONINGS`

Proportioning when  ‖β‖² > Γ² φ̃ᵀφ,  with the reduced free gradient φ̃ that no step of
length ᾱ takes beyond a bound.

A run ends, too, when it *stagnates*: over as many steps as it took before these (at
least `FIRST_LOOK`), the least ‖g^P‖ was not halved and the cost fell by no more than
the rounding of its terms. Rounding then leaves no direction that is conjugate to those
before and along which the cost falls.

Every step but projcg's lessens the cost, and by the model τI as much as the rate of the
book needs. Expansion never frees a component that the
half step left at a bound, but for the first expansion by a model of directions: from
one proportioning to the next the active set only grows. See docs/smalbe-theory.md.
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
Precondition = Callable[[Mask], Operator]  #: free components → their preconditioner

#: std: the CG step as far as it is feasible, then x ← x − ᾱφ̃ (the book's; 2 products)
#: projcg: x ← P(x − α_cg p), whatever the cost (PERMON's; 2 products)
#: mixed: projcg; where it raised the cost, std (ESPRESO's; 2 or 3 products)
#: model: where CG leads, projected in the metric of the model (ours; 2 products, 1
#: where the CG step as far as it is feasible was all; one for each step beyond the box,
#: one more where it gained less than gradient projection must)
Expansion = Literal["std", "projcg", "mixed", "model"]
#: cg: minimise along −β, as far as feasible (the book's; 1 product)
#: model: a `Model.step`; for B = I/ᾱ a projected gradient step (1 product); else cg
#: where from one to the next `MOST_IDLE` times in a row ‖β‖² was not halved
Proportioning = Literal["cg", "model"]
MOST_IDLE = 2
FIRST_LOOK = 500  #: steps of a run after which its progress is looked at first
#: slope along p relative to that of z, below which the gradient has drifted back along
#: the directions that were taken
DRIFT = 0.5
NOISE = 1e-13  #: part of the terms of a cost that is taken for rounding
EXPANSIONS, PROPORTIONINGS = get_args(Expansion), get_args(Proportioning)


@dataclass(frozen=True)
class Rules:
    """Rules by which MPRGP moves between faces."""

    Gamma: float = 1.0  #: proportioning constant Γ > 0
    expansion: Expansion = "model"
    proportioning: Proportioning = "model"
    reduced: bool = True  #: compare β with φ̃ᵀφ (the book), not with φᵀφ (PERMON)
    relaxation: float = 1.9  #: of expansions by the model, ᾱ‖H‖ of gradient projection
    kept: int = 0  #: most directions of CG that are kept on a face


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
    """The last conjugate directions that CG took on a face, scaled to pᵢᵀHpⱼ = δᵢⱼ.

    In exact arithmetic CG is conjugate to all k of them through the last. Rounding
    undoes that after some dozens of steps, and a new right-hand side on the same face
    (a multiplier step's) at once. With all of them at hand neither does, for two passes
    over k vectors a step (Farhat, Crivelli and Roux, Comput. Methods Appl. Mech. Engrg.
    117, 1994, 195-209).
    """

    free: Mask
    p: tuple[Vector, ...] = ()
    Hp: tuple[Vector, ...] = ()

    def next(
        self, z: Vector, p: Vector, Hp: Vector, most: int
    ) -> tuple[Directions, Vector]:
        """Add p, and make z conjugate to it and to the others; over ranks, at once.

        Of more than `most` directions the first is left out.
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
        """Return p without its part along them."""
        if not self.p:
            return p
        along = inner_products(*((p, Hq) for Hq in self.Hp))
        return kernels.less(p, along, *self.p)

    def minimising(self, g: Vector) -> tuple[Vector, Vector]:
        """Return s and Hs, for which x − s minimises the cost along all of them."""
        shares = inner_products(*((g, q) for q in self.p))
        back, none = [-share for share in shares], np.zeros_like(g)
        return kernels.less(none, back, *self.p), kernels.less(none, back, *self.Hp)


class Progress(NamedTuple):
    """Progress of a run since it was last looked at, to notice stagnation."""

    least: float = math.inf  #: ‖g^P‖² since then
    before: float = math.inf  #: the least until then
    cost: float = math.inf  #: twice the cost then

    def with_gradient(self, square: float) -> Progress:
        """Add ‖g^P‖² at one more point."""
        return self._replace(least=min(self.least, square))

    def stagnates(self, cost: float, terms: float) -> bool:
        """Return whether neither the gradient nor the cost, twice, has come down.

        terms : sum of the absolute terms of the cost
        """
        falls = self.cost - cost > NOISE * terms
        return not falls and 4 * self.least > self.before

    def from_here(self, cost: float) -> Progress:
        """Return the progress restarted at this cost."""
        return Progress(before=min(self.least, self.before), cost=cost)


class Minimum(NamedTuple):
    """Result of MPRGP."""

    x: Vector
    g: Vector  #: Hx − b
    face: Face
    stopped: bool  #: by `stop`; not at the step limit, nor where no step leads on
    trace: str  #: one letter per step: c, b, e, f, p
    directions: Directions  #: of the last face


#: told after each step but those beyond the box: letter, where
Watch = Callable[[str, Point, Face], None]
#: letters, the last of the step itself; where, model; None where the cost falls
#: without end
Step = tuple[str, Point, BoxModel] | None


class _Line(NamedTuple):
    """Along a direction of conjugate gradients."""

    p: Vector
    Hp: Vector
    cg: float  #: α_cg, minimises the cost at x − αp; inf without curvature
    feasible: float  #: the largest α that is


class _Stay(NamedTuple):
    """On a face."""

    inside: int  #: CG steps taken there
    began: float  #: ‖φ‖² at the first


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
    stop : says from the point and its face whether to stop; asked before every step
    precondition : makes the preconditioner of the CG steps in a face
    watch : told the letter of each step, the new point and its face
    directions : of a run before with the same H: where it ended on the face of the
        start, the cost is minimised along them first, without a product

    """
    task = _Task(H, b, bounds, rules)
    precondition = precondition or _none
    trace = ""
    at, face, known = _minimised_along(task, Point(*start), directions)
    z_of = precondition(face.free)
    z = z_of(face.phi)
    p, stay = known.conjugate(z), _Stay(0, face.phi_square)
    at_drift = math.inf  # ‖φ‖² when rounding along directions was taken out last
    idle, chopped = 0, math.inf  # proportionings in vain, ‖β‖² at the last
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
    """Minimise along known directions of this face, as far as is feasible.

    Where that leads to a bound, the face is another one, and they are forgotten.
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
    """Split the gradient into its free and its chopped part."""
    return Face(*kernels.split(*at, *bounds))


def _disproportional(task: _Task, at: Point, face: Face, B: BoxModel) -> bool:
    """Return True if ‖β‖ is large relative to ‖φ‖: the face is to be left."""
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
    """Take a step that frees components; never beyond an opposite bound."""
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
    """Take the CG step, where it is feasible, but not uphill; else expand."""
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
    """Minimise the model over the box, then the cost along that step.

    Above H, the model makes the minimising length at least 1. Where the product shows
    that it is not above, it is raised; the line search lessens the cost anyway.
    """
    s = B.step(at.x, at.g, task.bounds)
    if not s.any():  # in rounding, nothing is left to gain
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
    """Project z, where CG leads beyond the box, on it in the metric of the model.

    z is x − α_cg p, and in a flat spectrum, where active sets change least in a step,
    what CG makes of it on the face without bounds. The cost is known at z and beyond it
    bounded by the model where that is above H,

        f(z + r) ≤ f(z) + g(z)ᵀr + ½rᵀBr,

    and z + r is where the right side is least, with the tail of B divided by the
    relaxation, as gradient projection steps are longer than 1/‖H‖. What the half step
    left at a bound stays there, unless this is the `first` expansion, before which the
    active set is a guess, and the model knows more than a norm. From the half step it
    goes all the way to z + r if the cost ends below that at x, else as far as that
    lessens the cost. Where B = τI and that is less than φ̃ᵀφ/2τ, by which gradient
    projection from x lessens the cost where τ ≥ ‖H‖, this is what is done.
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
    """Go on with CG on the face as if it had no bounds, without a preconditioner.

    Until the free gradient is what it was when the face was entered, and at most for as
    many steps as were taken inside the box (one, if there were none).
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
    """Go along P(x − φ/τ) − x, as far as that lessens the cost; at least all of it."""
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
    """Return f(x + ts) − f(x), of gᵀs and sᵀHs."""
    slope, curvature = along
    return t * (slope + 0.5 * t * curvature)


def _moved(task: _Task, at: Point, alpha: float, p: Vector, Hp: Vector) -> Point:
    """Go to x − αp; the gradient follows without a product."""
    return Point(*kernels.moved(*at, alpha, p, Hp, *task.bounds))


def _cost(at: Point, b: Vector) -> float:
    """Return xᵀHx − 2bᵀx, twice the cost, from the gradient."""
    return float(at.x @ (at.g - b))


def _none(free: Mask) -> Operator:
    return lambda v: v
