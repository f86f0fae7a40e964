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
from scipy.sparse import csr_array

from harness.errors import InputError
from harness.files.qpfile import qp_digest
from harness.files.store import read_arrays, write_arrays
from harness.mechanics import Extended, Mechanics
from harness.plugin import Reference
from harness.qp import QP, no_rows
from harness.verify.active_set_refinement import exchanged, unconstrained_guess
from harness.verify.admissible import DENSE
from harness.verify.certificate import UncertifiableError, proof

TRUSTED = 1e-7  #: bound up to which a solution from stored rows is one


class UnsolvedError(Exception):
    """Why there is no reference solution."""


@dataclass(frozen=True, eq=False, kw_only=True)
class ReferencePoint:
    """A solution of ``mechanics.primal``, and the proof of its error."""

    u: Extended  #: (n,) admissible
    multipliers: Extended  #: (m,) of the contact rows, ≥ 0
    equilibrium: Extended  #: u_λ (n,)
    active: NDArray[np.bool_]  #: (m,) rows that were closed
    norm: float  #: ‖u‖_K
    bound: float  #: certified relative error, as `Certificate.bound`


def reference_point(
    mechanics: Mechanics, solve: Reference, folder: Path | None = None
) -> ReferencePoint:
    """Solve the elastic problem behind a case, or look the solution up.

    solve : identifies the active rows, on  min ½λᵀFλ − dᵀλ,  λ ≥ 0,  RᵀBᵀλ = Rᵀf
    folder : keeps the closed rows, one file under the digest of each problem

    Raises
    ------
    UnsolvedError
        When no admissible pair was found, or `solve` failed.

    """
    path = folder / f"{qp_digest(mechanics.primal)}.npz" if folder else None
    rows = mechanics.primal.h.size
    stored = _stored(path, rows) if path is not None and path.exists() else None
    if stored is not None:
        point = _solved(mechanics, stored)
        if point.bound <= TRUSTED:
            return point
    point = _solved(mechanics, _identified(mechanics, solve))
    if path is not None:
        path.parent.mkdir(parents=True, exist_ok=True)
        write_arrays(path, {"active": point.active})
    return point


def _stored(path: Path, rows: int) -> NDArray[np.bool_] | None:
    """Read the closed rows of a solution; None where the file is not what it was."""
    try:
        active = read_arrays(path, ("active",))["active"]
    except InputError:
        return None
    fits = active.dtype == np.bool_ and active.shape == (rows,)
    return active if fits else None


def _solved(mechanics: Mechanics, guess: NDArray[np.bool_]) -> ReferencePoint:
    u, lam, active = exchanged(mechanics, guess)
    try:
        found = proof(mechanics, u, u, lam, active)
    except UncertifiableError as e:
        raise UnsolvedError(
            f"the reference solve found no admissible pair: {e}"
        ) from None
    return ReferencePoint(
        u=found.u, multipliers=found.multipliers, equilibrium=found.equilibrium,
        active=active, norm=found.norm, bound=found.bound,
    )  # fmt: skip


def _identified(mechanics: Mechanics, solve: Reference) -> NDArray[np.bool_]:
    """Guess the active rows; of very many, those that bodies alone would violate."""
    inverse = mechanics.inverse
    R, m = mechanics.motions.felt.toarray().astype(np.float64), mechanics.primal.h.size
    f, B = -mechanics.primal.q, csr_array(mechanics.primal.G)
    if m > DENSE and not R.shape[1]:
        return unconstrained_guess(mechanics)
    qp = QP(
        P=inverse.congruence(B), q=mechanics.primal.h - B @ inverse(f),
        A=np.ascontiguousarray((B @ R).T) if R.shape[1] else no_rows(m), b=R.T @ f,
        G=no_rows(m), h=np.zeros(0), lb=np.zeros(m), ub=np.full(m, np.inf),
    )  # fmt: skip
    try:
        s = solve(qp)
    except (ArithmeticError, ValueError, np.linalg.LinAlgError) as e:
        raise UnsolvedError(f"the reference solve failed: {e}") from None
    return np.asarray(s.x * np.maximum(qp.P.diagonal(), 0) > -s.z_box)
