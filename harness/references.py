"""The reference service: the solution of a case to more digits than solvers reach.

The active rows are identified by the injected reference solve, which is none of the
solvers under test, on the dual of the contact rows. Given the rows A, displacement and
multipliers follow from linear equations,

    K u + B_Aᵀλ_A = f,   B_A u = c_A,   λ = 0 elsewhere,

refined with residuals in extended precision until nothing is left of them; rows whose
multiplier pulls or whose gap closes are exchanged, as in a primal-dual active set
method. The result is believed no more than a solver's: `harness.certificate` bounds its
error.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array

from harness.admissible import DENSE, closing
from harness.certificate import equilibrium, proof
from harness.mechanics import Extended, Mechanics, Real
from harness.plugin import Reference
from harness.qp import QP, no_rows
from harness.qpfile import qp_digest
from harness.store import read_arrays, write_arrays

EXCHANGES = 60  #: of active sets
REFINEMENTS = 6

_EPS = Real(np.finfo(Real).eps)


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
    folder : keeps solutions, one file under the digest of each problem

    Raises
    ------
    UnsolvedError
        When no admissible pair was found, or `solve` failed.

    """
    path = folder / f"{qp_digest(mechanics.primal)}.npz" if folder else None
    if path is not None and path.exists():
        return _read(path)
    point = _solved(mechanics, solve)
    if path is not None:
        path.parent.mkdir(parents=True, exist_ok=True)
        write_arrays(path, {k: np.asarray(v) for k, v in vars(point).items()})
    return point


def _read(path: Path) -> ReferencePoint:
    names = ReferencePoint.__dataclass_fields__
    stored = read_arrays(path, tuple(names))
    norm, bound = float(stored.pop("norm")), float(stored.pop("bound"))
    return ReferencePoint(norm=norm, bound=bound, **{k: stored[k] for k in stored})


def _solved(mechanics: Mechanics, solve: Reference) -> ReferencePoint:
    exact = mechanics.exact
    active = _identified(mechanics, solve)
    seen: set[bytes] = set()
    for _ in range(EXCHANGES):
        u, lam = _given(mechanics, active)
        gap = exact.c - exact.B @ u
        rounding = 1e4 * _EPS * (abs(exact.B) @ np.abs(u) + np.abs(exact.c))
        pulls = active & (lam < -1e4 * _EPS * np.abs(lam).max(initial=Real(0)))
        closes = ~active & (gap < -rounding)
        if not (pulls.any() or closes.any()) or active.tobytes() in seen:
            break
        seen.add(active.tobytes())
        active = (active & ~pulls) | closes
    found = proof(mechanics, u, u, np.where(active, np.maximum(lam, 0), 0), active)
    if found is None:
        raise UnsolvedError("the reference solve found no admissible pair")
    return ReferencePoint(
        u=found.u, multipliers=found.multipliers, equilibrium=found.equilibrium,
        active=active, norm=found.norm, bound=found.bound,
    )  # fmt: skip


def _identified(mechanics: Mechanics, solve: Reference) -> NDArray[np.bool_]:
    """Guess the active rows; of very many, those that bodies alone would violate."""
    exact, inverse = mechanics.exact, mechanics.inverse
    R, m = inverse.kernel, mechanics.primal.h.size
    f, B = -mechanics.primal.q, csr_array(mechanics.primal.G)
    if m > DENSE and not R.shape[1]:
        free, _ = equilibrium(mechanics, exact.f)
        return np.asarray(exact.B @ free > exact.c)
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


def _given(
    mechanics: Mechanics, active: NDArray[np.bool_]
) -> tuple[Extended, Extended]:
    """Solve with equality on the active rows: u (n,) and multipliers (m,)."""
    exact, R = mechanics.exact, mechanics.inverse.kernel
    close = closing(mechanics, active)
    lam = np.zeros(exact.c.size, dtype=Real)
    alpha = np.zeros(R.shape[1], dtype=Real)
    for _ in range(REFINEMENTS):
        force = exact.f - exact.B.T @ lam
        u = equilibrium(mechanics, force)[0] + R @ alpha
        excess = (exact.B @ u - exact.c)[active]
        mu, further = close(excess.astype(np.float64), (R.T @ force).astype(np.float64))
        lam[active] += mu
        alpha = alpha + further
    return u, lam
