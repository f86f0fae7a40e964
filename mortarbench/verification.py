"""Verification of points by their KKT residuals, and doubts about verified answers."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from mortarbench.case import Case, as_case
from mortarbench.harness import QP, Record, Residuals, Solution, Verdict, checked
from mortarbench.harness.qp import Vector, numeric_vector
from mortarbench.harness.verify.kkt import (
    allowed,
    kkt_residuals,
    verdict,
)
from mortarbench.harness.verify.multipliers import with_multipliers
from mortarbench.registries import one_thread

if TYPE_CHECKING:
    from numpy.typing import ArrayLike


#: Certified relative error in the energy norm above which `remarks` returns a remark on
#: a verified answer.
MAX_CERTIFIED_ERROR = 0.01
#: Largest sum of contact forces, relative to the sum of loads, at which bodies count as
#: not in contact. Interior-point methods return forces of about 1e-8 at open contacts;
#: forces at closed contacts are far larger.
MAX_OPEN_FORCE = 1e-6


class Multipliers(NamedTuple):
    """Multipliers with the signs of P x + q + Aᵀy + Gᵀz + z_box = 0, as in `QP`."""

    y: Vector  #: (m,) multipliers of A x = b
    z: Vector  #: (p,) multipliers of G x ≤ h
    z_box: Vector  #: (n,) multipliers of the bounds


@dataclass(frozen=True, eq=False, repr=False, kw_only=True)
class Verification:
    """Verdict of `verify` on a point."""

    verdict: Verdict  #: `verified` or, if the point is refuted, `inaccurate` or `wrong`
    residuals: Residuals  #: relative KKT residuals
    #: multipliers passed to `verify`; those left out are computed
    multipliers: Multipliers
    objective: float  #: ½xᵀPx + qᵀx
    tol: float  #: relative KKT accuracy, as passed to `verify`

    def __repr__(self) -> str:
        values = self.residuals._asdict().items()
        error = ", ".join(f"{name} {value:.2g}" for name, value in values)
        return f"<{self.verdict}: {error}; allowed {allowed(self.tol):.2g}>"


def verify(
    qp: QP | Case | str | object,
    x: ArrayLike,
    y: ArrayLike | None = None,
    z: ArrayLike | None = None,
    z_box: ArrayLike | None = None,
    tol: float = 1e-8,
) -> Verification:
    """Verify a point by its KKT residuals, as the harness verifies answers of solvers.

    Multipliers that are left out minimise the residuals in a linear program over the
    nearly active rows, bounds and sets, see `harness.verify.multipliers`. If the
    residuals are large even with these multipliers, the point is refuted.

    Parameters
    ----------
    qp : a QP, a case of `build`, its name, or a problem of qpsolvers or cvxpy
    x : (n,) point
    y, z, z_box : multipliers of A x = b, G x ≤ h and the bounds, if known
    tol : relative KKT accuracy; a point is verified if every residual is at most
        10·tol (and at most 0.1), see docs/verdicts.md

    Raises
    ------
    InputError
        If the size of a vector does not match the QP, or multipliers are left out and
        the QP is too large to compute them.

    Examples
    --------
    >>> import mortarbench as mb
    >>> qp = mb.QP.from_arrays([[2.0, 0.0], [0.0, 2.0]], [-2.0, 2.0], lb=[0.0, 0.0])
    >>> str(mb.verify(qp, [1.0, 0.0]).verdict), str(mb.verify(qp, [0.9, 0.0]).verdict)
    ('verified', 'wrong')

    """
    tol = checked.tolerance(tol)
    case = as_case(qp)
    problem = case.family_case.qp
    sizes = {"x": problem.q, "y": problem.b, "z": problem.h, "z_box": problem.q}
    arguments = {"x": x, "y": y, "z": z, "z_box": z_box}
    vectors = {
        name: numeric_vector(name, v, sizes[name].size)
        for name, v in arguments.items()
        if v is not None or name == "x"
    }
    with one_thread():
        s = with_multipliers(problem, **vectors)
        with np.errstate(all="ignore"):  # x may contain NaN or 1e300
            residuals, objective = kkt_residuals(problem, s), problem.objective(s.x)
    return Verification(
        verdict=verdict(s.status, residuals, tol),
        residuals=residuals,
        multipliers=Multipliers(s.y, s.z, s.z_box),
        objective=objective,
        tol=tol,
    )


def remarks(case: Case, record: Record, solution: Solution | None) -> tuple[str, ...]:
    """Return reasons to doubt a verified answer, one line each.

    Although the QP is solved, the certified bound may be large or infinite, or the
    model may be inadequate: no node or only one node is in contact, or displacements
    are too large for linear kinematics.
    """
    if record.status is not Verdict.VERIFIED or solution is None:
        return ()
    reasons = []
    bound = record.energy_bound
    if bound is not None and bound == np.inf:
        reasons.append(
            "the certificate does not bound the solver's error, because the "
            "displacements may be as small as rounding errors, or because a load may "
            "act on supports"
        )
    elif bound is not None and bound > MAX_CERTIFIED_ERROR:
        reasons.append(
            f"the solver's error is only certified to be at most {100 * bound:.2g} %; "
            "a smaller tolerance may give a smaller bound"
        )
    # An exception in a remark must not make the solve fail. Displacements may be
    # recovered by code of a plug-in, and the case may not yet be built here.
    with suppress(Exception), one_thread():
        if _is_open(case, record, solution):
            reasons.append(
                "no node is in contact, so the answer is the same as without contact "
                "conditions; check the direction of the load and the initial gap"
            )
        elif _single_nodes(record):
            reasons.append(
                "a single node is in contact, so the computed pressure depends on the "
                "mesh width and grows on finer meshes; refine the mesh near the contact"
            )
        if record.quantities.get("undetermined_friction"):
            reasons.append(
                "friction forces are not unique: where supports or other contact rows "
                "prevent slip, other friction forces have the same displacements, so "
                "that sums such as friction_force depend on the solver; remove the "
                "friction or the supports along the contact"
            )
    with suppress(Exception), one_thread():
        reasons += _large_displacements(case, solution)
    return tuple(reasons)


def _single_nodes(record: Record) -> bool:
    """Return True if a pair with several rows is in contact at a single node."""
    pairs = record.quantities.get("contacts", {}).values()
    return any(pair.get("active") == 1 for pair in pairs) and (
        record.quantities["contact_rows"] > len(pairs)
    )


def _is_open(case: Case, record: Record, solution: Solution) -> bool:
    """Return True if contact forces sum to at most `MAX_OPEN_FORCE` times the loads."""
    if not record.quantities.get("contact_rows"):
        return False
    if record.quantities.get("active") == 0:
        return True
    mechanics = case.family_case.mechanics if "family_case" in vars(case) else None
    if mechanics is None:
        return False
    normal = mechanics.to_primal(solution).z[: mechanics.primal.h.size]
    load = np.abs(mechanics.primal.q).sum()
    return bool(np.abs(normal).sum() <= MAX_OPEN_FORCE * load)


def _large_displacements(case: Case, solution: Solution) -> Iterator[str]:
    """Yield a remark if, in linear kinematics, a body moves by more than its size."""
    if "family_case" not in vars(case) or case.params.get("kinematics") == "finite":
        return
    mechanics = case.family_case.mechanics
    if mechanics is None or mechanics.grid is None:
        return
    grid, u = mechanics.grid, case.family_case.recover(solution)
    lengths = np.linalg.norm(u.reshape(grid.points.shape), axis=1)
    sizes = []  # motion relative to the size, size in m, and number of each body
    for body in np.unique(grid.bodies):
        nodes = np.unique(grid.cells[grid.bodies == body])
        size = float(np.ptp(grid.points[nodes], axis=0).max())
        sizes.append((float(lengths[nodes].max()) / size, size, body))
    ratio, size, body = max(sizes)
    if ratio > 1:
        name = repr(mechanics.names[body]) if mechanics.names else str(body)
        yield (
            f"body {name} moves by up to {ratio * size:.3g} m, which exceeds its size "
            f"of {size:.3g} m; linear kinematics is valid only for small "
            "displacements: check the moduli, the loads and the supports"
        )
