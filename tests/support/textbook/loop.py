"""Textbook replacement of `solvers.smalbe.driver.outer_loop`."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from scipy.sparse import issparse

from mortarbench.harness import QP, Status, Vector
from mortarbench.solvers.smalbe.driver import History, recovered
from mortarbench.solvers.smalbe.options import Options
from mortarbench.solvers.smalbe.preconditioner import (
    Preconditioner,
    resolved_preconditioner,
    structural_preconditioner,
)
from mortarbench.solvers.smalbe.projected import Iterate
from mortarbench.solvers.smalbe.rows import Mask
from tests.support.textbook import kernels
from tests.support.textbook.mprgp import Operator, Precondition, Rules, Watch
from tests.support.textbook.outer_loop import (
    Constants,
    InnerSolver,
    first_iterate,
    smalbe,
)
from tests.support.textbook.projected import Projected

KEPT = 200  #: maximum number of CG directions kept on a face
ALTERNATIONS = 4  #: number of pairs of projections, onto Cν = 0 and onto the face


@dataclass(frozen=True, eq=False)
class TextbookLoop:
    """Outer loop in textbook form."""

    problem: Projected
    constants: Constants
    inner: InnerSolver

    def first(self, x: Vector, mu: Vector, *, M: float, rho: float) -> Any:
        return first_iterate(self.problem, x, mu, M=M, rho=rho)

    def solve(self, tol: float, at: Any) -> Any:
        at = smalbe(self.problem, self.constants, self.inner, tol, at)
        if at.status is not Status.INFEASIBLE and not at.nu @ at.nu < np.inf:
            return at._replace(status=Status.FAILED)
        return at

    def recovered(self, qp: QP, at: Iterate) -> tuple[Vector, Vector, Vector, Vector]:
        nu, C, (lower, upper) = at.nu, self.problem.rows.C, self.problem.bounds
        free = (lower < nu) & (nu < upper)
        for _ in range(ALTERNATIONS):
            nu = np.clip(nu - free * (C.T @ (C @ nu)), lower, upper)
        return recovered(self.problem, qp, at._replace(nu=nu))


def outer_loop(
    problem: Any, qp: QP, options: Options, history: History | None = None
) -> TextbookLoop:
    """Return the textbook version of `solvers.smalbe.driver.outer_loop`."""
    fields = vars(problem)
    problem = Projected(**fields)
    kept = KEPT if options.recycle and not issparse(qp.P) else 0
    rules = Rules(
        options.Gamma, options.expansion, options.proportioning, options.reduced,
        options.alpha, kept=kept,
    )  # fmt: skip
    constants = Constants(
        options.M, options.beta, options.eta, options.rho_growth, options.max_steps,
        options.energy,
    )  # fmt: skip
    plain = partial(problem.plain_model, alpha=options.alpha)
    inner = InnerSolver(
        rules=rules,
        model=problem.model if options.expansion == "model" else plain,
        precondition=face_preconditioner(
            problem, qp, resolved_preconditioner(qp, options.preconditioner)
        ),
        watch=None if history is None else partial(_watched, history, problem),
    )
    return TextbookLoop(problem, constants, inner)


def _watched(history: History, problem: Projected, outer: int, rhs: Vector) -> Watch:
    note = history.watch(problem, partial(_face, problem.bounds), outer, rhs)
    return lambda letter, at, face: note(letter, at.x, at.g)


def _face(
    bounds: tuple[Vector, Vector], x: Vector, g: Vector
) -> tuple[Vector, Vector, Vector]:
    """Return the mask of the face, and free and chopped gradient."""
    lower, upper = bounds
    free = (x > lower) & (x < upper)
    leads = ((g < 0) & (x < upper)) | ((g > 0) & (x > lower))
    phi, beta = np.where(free, g, 0.0), np.where(leads & ~free, g, 0.0)
    return free.astype(float), phi, beta


def face_preconditioner(
    problem: Projected, qp: QP, kind: Preconditioner
) -> Callable[[float], Precondition | None]:
    """Return a function that maps ρ to the preconditioner of `mprgp`."""
    if kind == "none":
        return lambda rho: None
    if kind == "model":
        return lambda rho: problem.model(rho).inverse_in
    M = structural_preconditioner(qp, kind)
    assert M is not None

    def in_face(free: Mask, rho: float) -> Operator:
        of_penalty = problem.penalty(max(rho, 1.0)).inverse_in(free)

        def apply(v: Vector) -> Vector:
            problem.counts["preconditioner_applies"] += 1
            Pv = of_penalty(v)
            rest = kernels.combined(problem.spectrum.norm, M(Pv), -1.0, Pv)
            return of_penalty(rest) + Pv

        return apply

    return lambda rho: partial(in_face, rho=rho)
