"""SMALBE-M and MPRGP as Dostál's book states them, in NumPy.

The QP is  minimise ½xᵀFx − dᵀx  subject to  Gx = e, x ∈ Ω,  where Ω consists of bounds,
and of discs ‖x_I‖ ≤ r over variables without bounds. The method (Dostál, Optimal
Quadratic Programming Algorithms, 2009, the paper's reference [3]) has two loops:

* SMALBE-M, Chapter 6 (`smalbe`): augmented Lagrangians for the equality rows. Inner
  problems are solved to a precision that is proportional to the violation of the rows.
* MPRGP, Chapter 5 (`mprgp`): the inner loop for x ∈ Ω. With discs it is MPGP (Bouchala,
  Dostál, Kozubek, Pospíšil and Vodstrčil 2014).

The steps are numbered as in the book, and every formula stands in a docstring. The file
is the oracle of the compiled solver, and the form in which published rules are run: the
options select the rules of PERMON, of ESPRESO and of the book.

`homogenised` prepares the QP as both codes do. With orthonormal rows C that span the
rows of G, Q = CᵀC, 𝒫 = I − Q, c = Cx̃, the shortest x̃ with Gx̃ = e, and N = ‖𝒫F𝒫‖,

    minimise ½xᵀAx − bᵀx  subject to  Cx = c, x ∈ Ω,
    A = 𝒫F𝒫/N,   b = 𝒫(d − Fx̃)/N.

The variable is x, where the codes use ν = x − x̃, so that Ω is not shifted.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial
from time import perf_counter
from typing import Any, ClassVar, Literal, NamedTuple, get_args

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import eigh_tridiagonal

from mortarbench.harness import QP, About, Box, Discs, Solution, Status, Vector
from mortarbench.harness.sets.convex import hull
from mortarbench.solvers.common.conversion import (
    DIVERGED,
    check_choice,
    check_positive,
)
from mortarbench.solvers.common.infeasibility_certificate import proves_unbounded
from mortarbench.solvers.common.stopping import relative_residual
from mortarbench.solvers.smalbe.infeasibility import infeasible
from mortarbench.solvers.smalbe.rows import Rows, equality_rows

#: Rule of the expansion step; the number of products with F is in brackets.
#: std: to the boundary along the CG direction, then x ← Π(x − ᾱφ) (the book; 2)
#: projcg: x ← Π(x − α_cg p), even if the cost increases (PERMON; 2)
#: mixed: projcg, or std if projcg would not decrease the cost (ESPRESO; 2 or 3)
Expansion = Literal["std", "projcg", "mixed"]
#: Rule of the proportioning step, which takes 1 product. On discs it is a projection.
#: cg: minimise along −β as far as feasible (the book, PERMON)
#: projection: x ← Π(x − ᾱg) (ESPRESO; MPGP)
Proportioning = Literal["cg", "projection"]
#: Estimate of N = ‖𝒫F𝒫‖: `lanczos`, or PERMON's `power_method`
Norm = Literal["lanczos", "power"]

#: curvatures pᵀHp below this factor times ‖H‖‖p‖² are rounding errors of zero
ZERO_CURVATURE = 1e-14
#: relative rounding of a step that ends on the boundary, and of ‖x_I‖ on a disc
BOUNDARY_ROUNDING = 16 * float(np.finfo(float).eps)
MAX_RHO = 1e10  #: rounding of ρQx dominates the gradient with a larger penalty
LANCZOS_STEPS = 12  #: largest number of products of `lanczos`
#: the solve ends if the tolerance of ‖g^P‖ falls below this factor times tol
MIN_TIGHTENING = 1e-4
STEPS = {"c": "cg", "e": "expansion", "f": "fallback", "p": "proportioning"}


@dataclass(frozen=True)
class Textbook:
    """SMALBE-M and MPRGP of Dostál's book, in NumPy.

    The loop ends when ‖g^P‖ ≤ tol‖b‖ and ‖Cx − c‖ ≤ tol·max(‖x̃‖, ‖b‖) for the
    normalised QP. If the relative KKT residual of the QP then exceeds tol, the loop
    continues with a smaller tolerance. The counts of products depend on rounding, which
    decides which of several nearly degenerate bounds is met first.
    """

    expansion: Expansion = "std"
    proportioning: Proportioning = "cg"
    Gamma: float = 1.0  #: proportioning constant Γ
    #: True to proportion if ‖β‖² > Γ²φ̃ᵀφ (the book), False if ‖β‖² > Γ²φᵀφ (PERMON)
    reduced: bool = True
    alpha: float = 1.9  #: ᾱ‖H‖, the relative length of gradient projections, at most 2
    rho: float = 1.0  #: penalty ρ, relative to ‖𝒫F𝒫‖
    rho_growth: float = 1.0  #: multiplies ρ if the Lagrangian grows too little
    #: multiplies ρ while ‖g^P‖ meets the tolerance, but the rows do not (PERMON)
    late_growth: float = 2.0
    M: float = 1.0  #: initial M; inner runs end at ‖g^P‖ ≤ M‖Cx − c‖
    beta: float = 0.5  #: multiplies M if the Lagrangian grows too little
    eta: float = 0.1  #: largest ‖g^P‖/‖b‖ at the end of an inner run
    norm: Norm = "lanczos"  #: method that estimates ‖𝒫F𝒫‖
    history: bool = False  #: True to record each step
    max_steps: int = 200_000  #: limit of the number of MPRGP steps
    max_outer: int = 1000  #: limit of the number of outer iterations

    about: ClassVar[About] = About(
        title="SMALBE, textbook (ours)",
        licence="BSD-3-Clause",
        method="augmented Lagrangian with an inner active-set method (MPRGP)",
        linear_solver="none (products with P)",
        phases="orthonormalisation of rows and estimate of the norm (preparing); "
        "iterations (solving)",
        limits=(
            "Vectors are processed in NumPy: times do not represent PERMON or ESPRESO.",
            "Counts of products depend on rounding, by up to a half.",
        ),
    )
    accepts: ClassVar[tuple[type, ...]] = (Box, Discs)

    def __post_init__(self) -> None:
        check_positive(
            Gamma=self.Gamma, alpha=self.alpha, rho=self.rho, M=self.M, eta=self.eta,
            max_steps=self.max_steps, max_outer=self.max_outer,
        )  # fmt: skip
        check_choice("expansion", self.expansion, get_args(Expansion))
        check_choice("proportioning", self.proportioning, get_args(Proportioning))
        check_choice("norm", self.norm, get_args(Norm))
        if not 0 < self.beta < 1:
            raise ValueError(f"beta = {self.beta}; expected a number between 0 and 1")
        for name in ("rho_growth", "late_growth"):
            if not getattr(self, name) >= 1:
                value = getattr(self, name)
                raise ValueError(f"{name} = {value}; expected at least 1")
        if not self.alpha <= 2:
            raise ValueError(f"alpha = {self.alpha}; expected at most 2")

    def declines(self, qp: QP) -> str | None:
        if qp.h.size:
            return "accepts bounds, discs and equality rows, but no inequality rows"
        return None

    def prepare(self, qp: QP, tol: float) -> Callable[[], Solution]:
        began = perf_counter()
        problem = homogenised(qp, self.norm)
        history = History(problem, began) if self.history else None
        return lambda: _solve_to_tolerance(problem, self, tol, history)


#: defaults of PERMON 3.25 (SMALXE with MPGP), relative to ‖A‖
PERMON = Textbook(reduced=False, alpha=2.0, rho=1.1, M=100.0, norm="power")
#: defaults of ESPRESO, relative to ‖A‖
ESPRESO = Textbook(
    expansion="mixed", proportioning="projection", alpha=2.0, beta=0.8, eta=1.0,
    norm="power",
)  # fmt: skip
#: constants of the book, with which the paper's algorithm is compared
PAPER = Textbook()


# The outer loop


class State(NamedTuple):
    """State of the outer loop."""

    x: Vector  #: (n,) in Ω
    mu: Vector  #: (r,) multipliers μ of Cx = c, relative to N
    M: float
    rho: float
    outer: int = 0  #: number k of outer iterations
    steps: str = ""  #: letters of all inner steps
    status: Status = Status.ITERATION_LIMIT
    ray: Vector | None = None  #: see `Minimum`


def smalbe(
    problem: Problem, at: State, options: Textbook, tol: float, history: History | None
) -> State:
    """Continue SMALBE-M from a state until ‖g^P‖ ≤ tol‖b‖ and the rows hold.

    The rows hold if ‖Cx − c‖ ≤ tol·max(‖x̃‖, ‖b‖); ‖b‖ is a length because ‖A‖ = 1.
    Each inner problem is to minimise the augmented Lagrangian over Ω,

        L(x, μ, ρ) = ½xᵀAx − bᵀx + μᵀ(Cx − c) + ρ/2·‖Cx − c‖².

    ‖b‖ is the norm of the initial gradient if b = 0.
    """
    # Step 0. Choose η > 0, 0 < β < 1, M₀ > 0, ρ > 0, μ⁰: `Textbook` and `at`
    C, c, last = problem.rows.C, problem.c, -np.inf
    x, mu, M, rho, outer, steps, *_ = at
    note = None if history is None else history.note
    while True:
        # Step 1. Inner iteration with adaptive precision control: find x ∈ Ω with
        # ‖g^P(x, μ, ρ)‖ ≤ min(M‖Cx − c‖, η‖b‖)
        if history is not None:
            history.begin(outer, mu)
        run = mprgp(
            partial(problem.product, rho),
            problem.b + C.T @ (rho * c - mu), problem.omega, x, options,
            alpha_bar=options.alpha / problem.norm_of_hessian(rho),
            stop=partial(_is_precise, problem, options, M, tol),
            max_steps=options.max_steps - len(steps), note=note,
        )  # fmt: skip
        solved = _is_solved(problem, tol, run.x, run.gradient)
        x, steps = run.x, steps + run.steps
        error = C @ x - c
        lagrangian = problem.lagrangian(x, run.g, mu)
        # Step 2. Update the multipliers
        mu = mu + rho * error
        # Step 3. Update M, or ρ: the Lagrangian must grow by ρ/2·‖Cx − c‖²
        if lagrangian < last + rho / 2 * (error @ error):
            M, rho = options.beta * M, options.rho_growth * rho
        if run.gradient <= tol * problem.size and not solved:
            rho = min(options.late_growth * rho, MAX_RHO)
        last = lagrangian
        # Step 4. k ← k + 1
        outer += 1
        at = State(x, mu, M, rho, outer, steps, ray=run.ray)
        if solved:
            return at._replace(status=Status.SOLVED)
        if c.size and infeasible(problem.rows, problem.hull, x - problem.rows.x_tilde):
            return at._replace(status=Status.INFEASIBLE)
        if not run.stopped or outer >= options.max_outer:
            return at


def _is_precise(
    problem: Problem,
    options: Textbook,
    M: float,
    tol: float,
    x: Vector,
    gradient: float,
) -> bool:
    """Return True if an inner run may end at x with ‖g^P‖ = `gradient`.

    It also ends if ‖g^P‖ meets the final tolerance and is at most ‖Cx − c‖ (PERMON).
    """
    error, size = problem.violation(x), problem.size
    small = min(M * error, options.eta * size)
    small = max(small, min(error, tol * size))
    is_precise = problem.c.size > 0 and gradient <= small
    return is_precise or _is_solved(problem, tol, x, gradient)


def _is_solved(problem: Problem, tol: float, x: Vector, gradient: float) -> bool:
    length = max(problem.size, float(np.linalg.norm(problem.rows.x_tilde)))
    return gradient <= tol * problem.size and problem.violation(x) <= tol * length


# The inner loop


class Minimum(NamedTuple):
    """Result of MPRGP."""

    x: Vector
    g: Vector  #: Hx − b
    gradient: float  #: ‖g^P‖
    steps: str  #: letter of each step, see `STEPS`
    stopped: bool  #: True if the criterion `stop` ended the run
    #: direction of descent without curvature that never leaves Ω, or None
    ray: Vector | None = None


def mprgp(
    H: Callable[[Vector], Vector],
    b: Vector,
    omega: Omega,
    x: Vector,
    options: Textbook,
    *,
    alpha_bar: float,
    stop: Callable[[Vector, float], bool],
    max_steps: int,
    note: Callable[[str, Vector, Vector], None] | None = None,
) -> Minimum:
    """Minimise f(x) = ½xᵀHx − bᵀx over Ω by MPRGP.

    With the free gradient φ, the chopped gradient β, the projected gradient g^P = φ + β
    (`Omega.split`), and the reduced free gradient  φ̃ = (x − Π(x − ᾱφ))/ᾱ,  x is
    *strictly proportional* if  ‖β‖² ≤ Γ²φ̃ᵀφ.

    x : (n,) a point of Ω
    alpha_bar : ᾱ ∈ (0, 2/‖H‖], the length of gradient projections
    stop : function of x and ‖g^P‖ that returns True to stop; called before each step
    note : observer called after each step with its letter, x and g
    """
    # Step 0. Initialise
    g = H(x) - b
    steps, ray = "", None
    phi, beta = omega.split(x, g)
    p = phi
    while not (stopped := stop(x, _norm(phi, beta))) and len(steps) < max_steps:
        free = phi
        if options.reduced:
            free = (x - omega.project(x - alpha_bar * phi)) / alpha_bar
        if beta @ beta <= options.Gamma**2 * (free @ phi):
            # Step 1. Proportional x: trial conjugate gradient step
            Hp = H(p)
            alpha_cg = _minimising_length(g, p, Hp, alpha_bar)
            alpha_f = omega.feasible_length(x, p)
            if np.isinf(min(alpha_cg, alpha_f)):
                ray = -p
                break
            if alpha_cg <= alpha_f:
                # Step 2. Conjugate gradient step
                letter = "c"
                x, g = omega.step(x, p, alpha_cg), g - alpha_cg * Hp
                phi, beta = omega.split(x, g)
                p = phi - (phi @ Hp) / (p @ Hp) * p
            else:
                # Step 3. Expansion step
                letter, x, g = _expand(
                    H, b, omega, x, g, p, Hp, options.expansion, alpha_bar=alpha_bar,
                    alpha_cg=alpha_cg, alpha_f=alpha_f,
                )  # fmt: skip
                phi, beta = omega.split(x, g)
                p = phi
        else:
            # Step 4. Proportioning step
            letter = "p"
            if options.proportioning == "projection" or omega.discs:
                x = omega.project(x - alpha_bar * g)
                g = H(x) - b
            else:
                Hp = H(beta)
                # the book has lower bounds only, and needs no limit
                alpha = min(
                    _minimising_length(g, beta, Hp, alpha_bar),
                    omega.feasible_length(x, beta),
                )
                if np.isinf(alpha):
                    ray = -beta
                    break
                x, g = omega.step(x, beta, alpha), g - alpha * Hp
            phi, beta = omega.split(x, g)
            p = phi
        steps += letter
        if note is not None:
            note(letter, x, g)
    # Step 5. Return the solution
    return Minimum(x, g, _norm(phi, beta), steps, stopped, ray)


def _norm(phi: Vector, beta: Vector) -> float:
    """Return ‖g^P‖ = ‖φ + β‖; φ and β are orthogonal."""
    return float(np.sqrt(phi @ phi + beta @ beta))


def _minimising_length(g: Vector, p: Vector, Hp: Vector, alpha_bar: float) -> float:
    """Return α_cg = gᵀp/pᵀHp, which minimises f(x − αp); inf without curvature."""
    curvature = float(p @ Hp)
    if curvature * alpha_bar <= ZERO_CURVATURE * (p @ p):
        return np.inf
    return float(g @ p) / curvature


def _expand(
    H: Callable[[Vector], Vector], b: Vector, omega: Omega, x: Vector, g: Vector,
    p: Vector, Hp: Vector, expansion: Expansion, *, alpha_bar: float, alpha_cg: float,
    alpha_f: float,
) -> tuple[str, Vector, Vector]:  # fmt: skip
    """Expand the active set; return the letter of the step, x and its gradient."""
    letter = "e"
    if expansion != "std" and np.isfinite(alpha_cg):
        projected = omega.project(x - alpha_cg * p)
        gradient = H(projected) - b
        if expansion == "projcg" or projected @ (gradient - b) < x @ (g - b):
            return letter, projected, gradient
        letter = "f"
    half = omega.step(x, p, alpha_f)
    phi, _ = omega.split(half, g - alpha_f * Hp)
    x = omega.project(half - alpha_bar * phi)
    return letter, x, H(x) - b


# The feasible set


@dataclass(frozen=True, eq=False)
class Omega:
    """The set Ω: bounds l ≤ x ≤ u, and discs ‖x_I‖ ≤ r over variables without bounds.

    A component is *free* inside its bounds, and all components of a disc are free
    inside the disc. The others are *active*.
    """

    lower: Vector
    upper: Vector
    discs: tuple[Discs, ...] = ()

    def project(self, x: Vector) -> Vector:
        """Return Π(x), the point of Ω that is nearest to x."""
        x = np.clip(x, self.lower, self.upper)
        for one in self.discs:
            x = one.project(x)
        return x

    def split(self, x: Vector, g: Vector) -> tuple[Vector, Vector]:
        """Return the free gradient φ and the chopped gradient β at x.

        φᵢ = gᵢ and βᵢ = 0 for free components. For active ones, φᵢ = 0, and β is the
        part of g for which −β is a feasible direction: βᵢ = min(gᵢ, 0) at a lower
        bound, βᵢ = max(gᵢ, 0) at an upper bound, and β = g − min(nᵀg, 0)n on a disc
        with the outward normal n.
        """
        free = (self.lower < x) & (x < self.upper)
        inward = ((g > 0) & (x > self.lower)) | ((g < 0) & (x < self.upper))
        beta = np.where(inward & ~free, g, 0.0)
        for one, active in self.active_discs(x):
            index, r = one.index[active], one.radius[active, None]
            n = np.divide(x[index], r, out=np.zeros(index.shape), where=r > 0)
            outward = np.minimum((n * g[index]).sum(axis=1, keepdims=True), 0)
            free[index], beta[index] = False, np.where(r > 0, g[index] - outward * n, 0)
        return np.where(free, g, 0.0), beta

    def active_discs(self, x: Vector) -> list[tuple[Discs, NDArray[np.bool_]]]:
        """Return the discs with the masks (k,) of those with x on their boundary."""
        return [
            (one, np.linalg.norm(x[one.index], axis=1)
             >= (1 - BOUNDARY_ROUNDING) * one.radius)
            for one in self.discs
        ]  # fmt: skip

    def active(self, x: Vector) -> NDArray[np.bool_]:
        """Return the mask (n,) of the active components."""
        mask = (x <= self.lower) | (x >= self.upper)
        for one, active in self.active_discs(x):
            mask[one.index[active]] = True
        return mask

    def feasible_length(self, x: Vector, p: Vector) -> float:
        """Return α_f, the largest α for which x − αp ∈ Ω; inf if there is no limit."""
        room = np.where(p > 0, x - self.lower, self.upper - x)
        lengths = np.divide(room, np.abs(p), out=np.full(p.size, np.inf), where=p != 0)
        least = float(lengths.min(initial=np.inf))
        for one in self.discs:
            # ‖x_I − αp_I‖² = r² is aα² − 2hα − s = 0 with s = r² − ‖x_I‖² ≥ 0
            y, d = x[one.index], p[one.index]
            a, h = (d * d).sum(axis=1), (y * d).sum(axis=1)
            s = np.maximum(one.radius**2 - (y * y).sum(axis=1), 0)
            root = np.sqrt(h * h + a * s)
            # the form without cancellation of (h + root)/a
            over, under = np.where(h > 0, h + root, s), np.where(h > 0, a, root - h)
            alpha = np.where(a > 0, 0.0, np.inf)
            np.divide(over, under, out=alpha, where=under > 0)
            least = min(least, float(alpha.min(initial=np.inf)))
        return least

    def step(self, x: Vector, p: Vector, alpha: float) -> Vector:
        """Return x − αp, a point of Ω, with bounds that it reaches up to rounding."""
        y = x - alpha * p
        rounding = BOUNDARY_ROUNDING * (np.abs(x) + np.abs(y))
        y = np.where(y - self.lower <= rounding, self.lower, y)
        return self.project(np.where(self.upper - y <= rounding, self.upper, y))


# The problem


@dataclass(eq=False)
class Problem:
    """The homogenised, projected and normalised QP, with a count of its products."""

    qp: QP
    rows: Rows  #: orthonormal rows C, x̃, and 𝒫
    omega: Omega
    products: int = 0  #: number of products with F
    norm: float = 1.0  #: N = ‖𝒫F𝒫‖, an estimate
    b: Vector = field(default_factory=lambda: np.zeros(0))
    c: Vector = field(default_factory=lambda: np.zeros(0))
    size: float = 0.0  #: ‖b‖, or the norm of the initial gradient if b = 0

    def F(self, v: Vector) -> Vector:
        """Return Fv."""
        self.products += 1
        return np.asarray(self.qp.P @ v)

    def projected(self, v: Vector) -> Vector:
        """Return 𝒫F𝒫v."""
        return self.rows.project(self.F(self.rows.project(v)))

    def product(self, rho: float, v: Vector) -> Vector:
        """Return Hv with H = A + ρQ."""
        C = self.rows.C
        return self.projected(v) / self.norm + rho * (C.T @ (C @ v))

    def violation(self, x: Vector) -> float:
        """Return ‖Cx − c‖."""
        return float(np.linalg.norm(self.rows.C @ x - self.c))

    def norm_of_hessian(self, rho: float) -> float:
        """Return ‖H‖ = max(1, ρ), since ker 𝒫F𝒫 contains the rows of C."""
        return max(1.0, rho) if self.c.size else 1.0

    def lagrangian(self, x: Vector, g: Vector, mu: Vector) -> float:
        """Return L(x, μ, ρ) up to a constant; g is its gradient.

        With ν = x − x̃ and Ax̃ = 0,  2L = νᵀ(g − b) + μᵀCν,  because
        g = Aν − b + Cᵀ(μ + ρCν).
        """
        nu = x - self.rows.x_tilde
        return float(0.5 * (nu @ (g - self.b) + mu @ (self.rows.C @ nu)))

    @property
    def hull(self) -> tuple[Vector, Vector]:
        """Bounds (n,) of the smallest box that contains all feasible ν = x − x̃."""
        lower, upper = hull(self.qp.sets, self.qp.q.size)
        return lower - self.rows.x_tilde, upper - self.rows.x_tilde


def homogenised(qp: QP, norm: Norm) -> Problem:
    """Homogenise, project and normalise a QP.

    The products are those of the estimate of the norm, and one if x̃ ≠ 0.
    """
    bounds = hull(qp.sets, qp.q.size)
    rows = equality_rows(qp.A, qp.b, np.isfinite(bounds[0]) | np.isfinite(bounds[1]))
    discs = tuple(one for one in qp.sets if isinstance(one, Discs))
    problem = Problem(qp, rows, Omega(qp.box.lower, qp.box.upper, discs))
    n, x_tilde = qp.q.size, rows.x_tilde
    estimate = {"lanczos": lanczos, "power": power_method}[norm](problem.projected, n)
    diagonal = qp.diagonal()
    mean = 0.0 if diagonal is None else float(np.abs(diagonal).mean())
    # 𝒫F𝒫 = 0 up to rounding if the rows determine x
    problem.norm = estimate if estimate > 1e-13 * mean else mean or 1.0
    d = -qp.q - problem.F(x_tilde) if x_tilde.any() else -qp.q
    b = rows.project(d)
    if np.linalg.norm(b) <= 1e-14 * np.linalg.norm(d):  # rounding errors of d
        b = 0 * d
    problem.b, problem.c = b / problem.norm, rows.C @ x_tilde
    problem.size = float(np.linalg.norm(problem.b))
    return problem


def power_method(H: Callable[[Vector], Vector], n: int) -> float:
    """Estimate ‖H‖ by PERMON's power method, with at most 50 products.

    The iteration starts from a vector of ones and ends when a step changes the Rayleigh
    quotient by less than 1e-4, relative to the quotient. The last quotient is a lower
    bound on ‖H‖ and is used without a safety factor, as in PERMON.
    """
    v, estimate = np.full(n, 1 / np.sqrt(n)), 0.0
    for _ in range(50):
        Hv = H(v)
        before, estimate = estimate, float(v @ Hv)
        size = float(np.linalg.norm(Hv))
        if size == 0 or abs(estimate - before) < 1e-4 * abs(estimate):
            break
        v = Hv / size
    return estimate


def lanczos(H: Callable[[Vector], Vector], n: int) -> float:
    """Estimate ‖H‖ by the largest Ritz value θ of a Lanczos process plus its residual.

    The residual of the pair (θ, Vs) is |β s_k| with the last off-diagonal entry β. The
    start vector is random, with a fixed seed.
    """
    v, before = np.random.default_rng(19640229).standard_normal(n), np.zeros(n)
    diagonal: list[float] = []
    off = [float(np.linalg.norm(v))]
    for _ in range(min(LANCZOS_STEPS, n)):
        v = v / off[-1]
        w = H(v) - (off[-1] if diagonal else 0.0) * before
        diagonal.append(float(v @ w))
        before, v = v, w - diagonal[-1] * v
        off.append(float(np.linalg.norm(v)))
        if off[-1] <= 1e-12 * max(map(abs, diagonal)):
            break
    theta, S = eigh_tridiagonal(np.array(diagonal), np.array(off[1:-1]))
    return float(theta[-1] + off[-1] * abs(S[-1, -1]))


# The answer


def _solve_to_tolerance(
    problem: Problem, options: Textbook, tol: float, history: History | None
) -> Solution:
    """Tighten SMALBE-M until the relative KKT residual of the QP is at most tol."""
    qp, rows, tighter = problem.qp, problem.rows, 1.0
    if not rows.consistent:
        message = "the equality rows contradict each other"
        return Solution.without_point(qp, Status.INFEASIBLE, message)
    x = problem.omega.project(np.zeros(qp.q.size))
    if not problem.size:
        start = problem.product(options.rho, x)
        start = start - rows.C.T @ (options.rho * problem.c)
        problem.size = float(np.linalg.norm(start))
    at = State(x, np.zeros(problem.c.size), options.M, options.rho)
    while True:
        at = smalbe(problem, at, options, tighter * tol, history)
        if (nowhere := _without_solution(problem, at)) is not None:
            return nowhere
        point = _recovered(problem, at, history)
        worst = relative_residual(qp, point, tol)
        if worst <= tol:
            return point
        tighter *= min(0.5, max(0.01, tol / worst))
        if at.ray is not None:
            message = "a direction of descent has no curvature and no bound"
            return replace(point, status=Status.FAILED, message=message)
        if at.status is not Status.SOLVED or tighter < MIN_TIGHTENING:
            message = "step limit"
            if at.status is Status.SOLVED:
                message = f"stagnated at residual {worst:.1e} because of rounding"
            return replace(point, status=Status.ITERATION_LIMIT, message=message)


def _without_solution(problem: Problem, at: State) -> Solution | None:
    """Return the claim that the QP has no solution, or None."""
    qp, ray = problem.qp, at.ray
    if at.status is Status.INFEASIBLE:
        message = "no point of the set satisfies the equality rows"
        return Solution.without_point(qp, Status.INFEASIBLE, message)
    if ray is not None and proves_unbounded(qp, problem.rows.project(ray)):
        message = "the objective is unbounded below"
        return Solution.without_point(qp, Status.UNBOUNDED, message)
    if not np.abs(at.x).max(initial=0.0) < DIVERGED:
        return Solution.without_point(qp, Status.FAILED, "the iterates diverged")
    return None


def _recovered(problem: Problem, at: State, history: History | None) -> Solution:
    """Return the point with the multipliers of the QP.

    With r = Fx − d, the multipliers a of Cx = c are a = Nμ − Cr, so that r + Cᵀa is N
    times the gradient of the Lagrangian, up to terms of the order of ‖Cx − c‖. A
    least-squares correction of a removes these terms on the free components. The
    multipliers of Ω are the part of −(r + Cᵀa) that is normal to Ω at x.
    """
    qp, rows, omega = problem.qp, problem.rows, problem.omega
    r = problem.F(at.x) + qp.q
    a = problem.norm * at.mu - rows.C @ r
    if a.size:
        a = a + rows.fitted(~omega.active(at.x), r + rows.C.T @ a)
    r = r + rows.C.T @ a
    phi, beta = omega.split(at.x, r)
    problem.products += 1  # the product of the caller's test
    counts = {"P_products": problem.products, "outer": at.outer}
    for letter, name in STEPS.items():
        if letter in at.steps:
            counts[name] = at.steps.count(letter)
    return Solution(
        status=Status.SOLVED,
        x=at.x,
        y=rows.multipliers(a),
        z=np.zeros(0),
        z_box=(phi + beta) - r,
        iterations=len(at.steps),
        counts=counts,
        message="converged",
        history=history.columns if history else {},
    )


@dataclass(eq=False)
class History:
    """History of a run, a row per step; the columns are those of `harness.solution`.

    Gradients and costs refer to the normalised problem.
    """

    problem: Problem
    began: float  #: time at the start of `prepare`
    rows: list[dict[str, Any]] = field(default_factory=list)
    outer: int = 0
    mu: Vector = field(default_factory=lambda: np.zeros(0))

    def begin(self, outer: int, mu: Vector) -> None:
        """Begin the inner run of outer iteration `outer`."""
        self.outer, self.mu = outer, mu

    def note(self, letter: str, x: Vector, g: Vector) -> None:
        """Record a step with its letter, x and the gradient."""
        problem, omega = self.problem, self.problem.omega
        phi, beta = omega.split(x, g)
        lower, upper = hull(problem.qp.sets, x.size)
        active = omega.active(x)
        two = np.isfinite(lower) & np.isfinite(upper) & (lower < upper)
        size = np.linalg.norm(problem.rows.x_tilde) or np.linalg.norm(x) or 1.0
        self.rows.append(
            {
                "step": letter,
                "outer": self.outer,
                "products": problem.products,
                "free_gradient": np.linalg.norm(phi),
                "chopped_gradient": np.linalg.norm(beta),
                "infeasibility": np.linalg.norm(problem.rows.C @ x - problem.c) / size,
                "active": np.count_nonzero(active),
                **({"two_sided": np.count_nonzero(active & two)} if two.any() else {}),
                "cost": problem.lagrangian(x, g, self.mu),
                "seconds": perf_counter() - self.began,
            }
        )

    @property
    def columns(self) -> dict[str, NDArray[Any]]:
        """Columns of the history as arrays of equal length."""
        first = self.rows[0] if self.rows else {}
        return {name: np.array([row[name] for row in self.rows]) for name in first}
