"""Reference solutions of contact problems, to more digits than solvers reach.

The injected reference solve, which is none of the solvers under test, identifies the
closed rows from the dual of the contact rows. `harness.verify.active_set_refinement`
then computes the solution in extended precision, and `harness.verify.certificate`
bounds its error, as for any answer. Only the states of the rows are cached in a file.
They are an initial guess when they are read.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mortarbench.harness.errors import InputError
from mortarbench.harness.files.qpfile import qp_digest
from mortarbench.harness.files.store import read_arrays, write_arrays
from mortarbench.harness.mechanics import Extended, Mechanics
from mortarbench.harness.plugin import Reference
from mortarbench.harness.qp import QP, no_rows
from mortarbench.harness.verify.active_set_refinement import (
    CLOSED,
    UPPER,
    States,
    exchanged,
    predicted,
    unconstrained_guess,
)
from mortarbench.harness.verify.admissible import MAX_DENSE_ROWS
from mortarbench.harness.verify.certificate import UncertifiableError, proof
from mortarbench.harness.verify.substructured import Undivided

MAX_CACHED_BOUND = 1e-7  #: largest error bound of a solution from cached rows


class UnsolvedError(Exception):
    """Failure of the reference solve; the message is the reason."""


@dataclass(frozen=True, eq=False, kw_only=True)
class ReferencePoint:
    """A solution of the elastic problem, and a certified bound of its error."""

    u: Extended  #: (n,) admissible
    multipliers: Extended  #: (m,) multipliers of contact, then of friction rows
    equilibrium: Extended  #: u_λ (n,)
    states: States  #: (m,) closed, or at a bound of the multiplier
    norm: float  #: ‖u‖_K
    bound: float  #: certified relative error, as `Certificate.bound`

    @property
    def active(self) -> NDArray[np.bool_]:
        """Mask (m,) of the closed rows."""
        return np.asarray(self.states == CLOSED)


def reference_point(
    mechanics: Mechanics, solve: Reference, folder: Path | None = None
) -> ReferencePoint:
    """Solve the elastic problem behind a case, starting from cached states if any.

    solve : identifies the closed rows from  min ½λᵀFλ − dᵀλ,  RᵀBᵀλ = Rᵀf,  with λ ≥ 0
        for contact and |λ| ≤ g for friction
    folder : cache of the states, a file per problem; None for no cache

    Raises
    ------
    UnsolvedError
        When no admissible pair was found, or `solve` failed.

    """
    mechanics = mechanics.whole
    path = folder / f"{qp_digest(mechanics.program)}.npz" if folder else None
    rows = mechanics.exact.c.size
    stored = _stored(path, rows) if path is not None and path.exists() else None
    if stored is not None:
        point = _solved(mechanics, stored)
        if point.bound <= MAX_CACHED_BOUND:
            return point
    point = _solved(mechanics, _identified(mechanics, solve))
    if path is not None:
        path.parent.mkdir(parents=True, exist_ok=True)
        write_arrays(path, {"states": point.states})
    return point


def _stored(path: Path, rows: int) -> States | None:
    """Read cached states of the rows; None if the file is damaged."""
    try:
        states = read_arrays(path, ("states",))["states"]
    except InputError:
        return None
    fits = states.dtype == np.int8 and states.shape == (rows,)
    return states if fits and (np.abs(states) <= 1).all() else None


def _solved(mechanics: Mechanics, guess: States) -> ReferencePoint:
    exact = mechanics.exact
    guess = np.where(exact.contact & (guess == UPPER), CLOSED, guess).astype(np.int8)
    u, lam, states = exchanged(mechanics, guess)
    try:
        certificate = proof(Undivided(mechanics), u, u, lam, states == CLOSED)
    except UncertifiableError as e:
        raise UnsolvedError(
            f"the reference solve found no admissible pair: {e}"
        ) from None
    return ReferencePoint(
        u=certificate.u, multipliers=certificate.multipliers,
        equilibrium=certificate.equilibrium, states=states, norm=certificate.norm,
        bound=certificate.bound,
    )  # fmt: skip


def _identified(mechanics: Mechanics, solve: Reference) -> States:
    """Guess the states of the rows by the dual QP.

    If there are no rows, or too many for a dense matrix, the guess follows from the
    displacement without contact.
    """
    inverse = mechanics.inverse
    R, exact = mechanics.motions.felt.toarray().astype(np.float64), mechanics.exact
    f, B = -mechanics.primal.q, mechanics.rows
    lb, ub = (v.astype(np.float64) for v in (exact.lower, exact.upper))
    m = exact.c.size
    if not m or (m > MAX_DENSE_ROWS and not R.shape[1]):
        return unconstrained_guess(mechanics)
    qp = QP(
        P=inverse.congruence(B), q=exact.c.astype(np.float64) - B @ inverse(f),
        A=np.ascontiguousarray((B @ R).T) if R.shape[1] else no_rows(m), b=R.T @ f,
        G=no_rows(m), h=np.zeros(0), lb=lb, ub=ub,
    )  # fmt: skip
    try:
        s = solve(qp)
    except (ArithmeticError, ValueError, np.linalg.LinAlgError) as e:
        raise UnsolvedError(f"the reference solve failed: {e}") from None
    softness = np.maximum(qp.P.diagonal(), 0)
    return predicted((s.x - lb, ub - s.x), softness, s.z_box)
