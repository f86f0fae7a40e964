"""The reference service: the solution of a case to more digits than solvers reach.

The closed rows are identified by the injected reference solve, which is none of the
solvers under test, on the dual of the contact rows;
`harness.verify.active_set_refinement` does the rest in extended precision. The result
is believed no more than a solver's: `harness.verify.certificate` bounds its error. What
is kept on file is only which rows are closed, and it is a guess like any other when it
is read.
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

TRUSTED = 1e-7  #: bound up to which a solution from stored rows is one


class UnsolvedError(Exception):
    """Why there is no reference solution."""


@dataclass(frozen=True, eq=False, kw_only=True)
class ReferencePoint:
    """A solution of the elastic problem, and the proof of its error."""

    u: Extended  #: (n,) admissible
    multipliers: Extended  #: (m,) of the rows of contact and friction
    equilibrium: Extended  #: u_λ (n,)
    states: States  #: (m,) which rows were closed, and at which bound the others are
    norm: float  #: ‖u‖_K
    bound: float  #: certified relative error, as `Certificate.bound`

    @property
    def active(self) -> NDArray[np.bool_]:
        """Which rows are closed, (m,)."""
        return np.asarray(self.states == CLOSED)


def reference_point(
    mechanics: Mechanics, solve: Reference, folder: Path | None = None
) -> ReferencePoint:
    """Solve the elastic problem behind a case, or look the solution up.

    solve : identifies the closed rows, on  min ½λᵀFλ − dᵀλ,  RᵀBᵀλ = Rᵀf,  where λ ≥ 0
        of the contact and |λ| ≤ g of the friction
    folder : keeps the states of the rows, one file under the digest of each problem

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
        if point.bound <= TRUSTED:
            return point
    point = _solved(mechanics, _identified(mechanics, solve))
    if path is not None:
        path.parent.mkdir(parents=True, exist_ok=True)
        write_arrays(path, {"states": point.states})
    return point


def _stored(path: Path, rows: int) -> States | None:
    """Read the states of the rows; None where the file is not what it was."""
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
        found = proof(Undivided(mechanics), u, u, lam, states == CLOSED)
    except UncertifiableError as e:
        raise UnsolvedError(
            f"the reference solve found no admissible pair: {e}"
        ) from None
    return ReferencePoint(
        u=found.u, multipliers=found.multipliers, equilibrium=found.equilibrium,
        states=states, norm=found.norm, bound=found.bound,
    )  # fmt: skip


def _identified(mechanics: Mechanics, solve: Reference) -> States:
    """Guess the states of the rows; of none or very many, from the bodies alone."""
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
