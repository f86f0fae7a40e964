"""Reference solutions of contact problems, with certified error bounds.

An injected reference solver, which is not under test, solves the dual QP of the contact
and friction rows, unless this QP is too large (`_identified`). The solution of this QP
identifies the closed rows, which hold with equality: contacts that touch and friction
that sticks. `harness.verify.active_set_refinement` then computes the solution in
extended precision, and `harness.verify.certificate` bounds the error of this solution.
The cache contains only the states of the rows and the multipliers, which determine the
directions of slip. A later run uses the cached data as an initial guess.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mortarbench.harness.errors import InputError
from mortarbench.harness.files.qpfile import qp_digest
from mortarbench.harness.files.store import read_arrays, write_arrays
from mortarbench.harness.mechanics import Exact, Extended, Mechanics, Real
from mortarbench.harness.plugin import Reference
from mortarbench.harness.qp import QP, no_rows
from mortarbench.harness.verify.active_set_refinement import (
    CLOSED,
    UPPER,
    ActiveSet,
    States,
    exchanged,
    predicted,
    unconstrained_guess,
)
from mortarbench.harness.verify.admissible import MAX_DENSE_ROWS
from mortarbench.harness.verify.certificate import UncertifiableError, proof
from mortarbench.harness.verify.substructured import Undivided

#: a result computed from the cache is discarded if its error bound exceeds this value
MAX_CACHED_BOUND = 1e-7
#: Names and types of the cached arrays.
STORED = {"states": np.dtype(np.int8), "multipliers": np.dtype(float)}


class UnsolvedError(Exception):
    """Failure of the reference solve; the message is the reason."""


@dataclass(frozen=True, eq=False, kw_only=True)
class ReferencePoint:
    """A solution of the elastic problem, and a certified bound on its error."""

    u: Extended  #: (n,) admissible displacement
    multipliers: Extended  #: (m,) multipliers of contact, then of friction rows
    equilibrium: Extended  #: u_λ (n,), in equilibrium with the multipliers
    states: States  #: (m,) states of the rows: closed, or multiplier at a bound
    norm: float  #: ‖u‖_K
    bound: float  #: certified bound on the relative error; see `Certificate.bound`

    @property
    def active(self) -> NDArray[np.bool_]:
        """Mask (m,) of the closed rows."""
        return np.asarray(self.states == CLOSED)


def reference_point(
    mechanics: Mechanics, solve: Reference, folder: Path | None = None
) -> ReferencePoint:
    """Solve the elastic problem of a case, starting from cached states if available.

    solve : solves the dual QP, min ½λᵀFλ − dᵀλ subject to RᵀBᵀλ = Rᵀf, λ ≥ 0 for
        contact and ‖λ‖ ≤ g for friction
    folder : directory of cached states, with a file for each problem; None to disable
        the cache

    Raises
    ------
    UnsolvedError
        If no admissible pair is found, or `solve` fails.

    """
    mechanics = mechanics.whole
    path = folder / f"{qp_digest(mechanics.program)}.npz" if folder else None
    exact = mechanics.exact
    stored = _stored(path, exact) if path is not None and path.exists() else None
    if stored is not None:
        point = _solved(mechanics, stored)
        if point.bound <= MAX_CACHED_BOUND:
            return point
    point = _solved(mechanics, _identified(mechanics, solve))
    if path is not None:
        path.parent.mkdir(parents=True, exist_ok=True)
        write_arrays(
            path,
            {k: getattr(point, k).astype(kind) for k, kind in STORED.items()},
        )
    return point


def _stored(path: Path, exact: Exact) -> ActiveSet | None:
    """Read a cached active set; return None if the file is damaged."""
    try:
        arrays = read_arrays(path, tuple(STORED))
    except InputError:
        return None
    states, multipliers = (arrays[name] for name in STORED)
    fits = all(
        arrays[name].dtype == kind and arrays[name].shape == exact.c.shape
        for name, kind in STORED.items()
    )
    if not fits or (np.abs(states) > 1).any() or not np.isfinite(multipliers).all():
        return None
    states = np.where(exact.contact & (states == UPPER), CLOSED, states)
    # pass the multipliers as the motion, since only the direction is used
    pushed = predicted(
        exact.forces, 0 * multipliers.astype(Real), exact.compliance, multipliers
    )
    return ActiveSet(states.astype(np.int8), pushed.limits)


def _solved(mechanics: Mechanics, guess: ActiveSet) -> ReferencePoint:
    u, lam, active = exchanged(mechanics, guess)
    try:
        certificate = proof(Undivided(mechanics), u, u, lam, active.closed)
    except UncertifiableError as e:
        raise UnsolvedError(
            f"the reference solve found no admissible pair: {e}"
        ) from None
    return ReferencePoint(
        u=certificate.u,
        multipliers=certificate.multipliers,
        equilibrium=certificate.equilibrium,
        states=active.states,
        norm=certificate.norm,
        bound=certificate.bound,
    )


def _identified(mechanics: Mechanics, solve: Reference) -> ActiveSet:
    """Guess the states of the rows from the solution of the dual QP.

    The guess follows from the displacement without contact if there are no rows, or if
    supports fix all bodies and there are too many rows for a dense matrix.
    """
    inverse = mechanics.inverse
    R, exact = (
        mechanics.motions.constrained.toarray().astype(np.float64),
        mechanics.exact,
    )
    f, B = exact.f.astype(np.float64), mechanics.rows
    m = exact.c.size
    if not m or (m > MAX_DENSE_ROWS and not R.shape[1]):
        return unconstrained_guess(mechanics)
    qp = QP(
        P=inverse.congruence(B),
        q=exact.c.astype(np.float64) - B @ inverse(f),
        A=np.ascontiguousarray((B @ R).T) if R.shape[1] else no_rows(m),
        b=R.T @ f,
        G=no_rows(m),
        h=np.zeros(0),
        sets=exact.forces.sets,
    )
    try:
        s = solve(qp)
    except (ArithmeticError, ValueError, np.linalg.LinAlgError) as e:
        raise UnsolvedError(f"the reference solve failed: {e}") from None
    softness = np.maximum(qp.P.diagonal(), 0)
    return predicted(exact.forces, s.x.astype(Real), softness, s.z_box)
