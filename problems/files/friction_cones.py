"""Coulomb's law for contacts between many bodies, by sequences of convex problems.

The unknowns are the contact forces r, with a normal and one or two tangential
components per contact, in the product K of the friction cones ‖r_T‖ ≤ μ r_N, and
multipliers λ of the equations Vᵀr = b. The relative velocities at the contacts are
u = W r + Vλ + q, with a positive semidefinite matrix W (Delassus operator) and the
velocities q in the absence of forces. Coulomb's law is

    û = u + (μ‖u_T‖, 0),   K* ∋ û ⊥ r ∈ K.

This law does not derive from a potential, but two sequences of convex problems may
converge to its solutions. The data of each problem are computed from the solution of
its predecessor:

* ``cones``: min ½rᵀWr + (q + s)ᵀr over K with s = (μ‖u_T‖, 0), initially 0 (Acary,
  Cadoux, Lemaréchal and Malick 2011, Z. Angew. Math. Mech. 91);
* ``tresca``: the same objective with s = 0 over r_N ≥ 0, ‖r_T‖ ≤ g, with the bound
  g = μ r_N (Haslinger 1983, Math. Methods Appl. Sci. 5); the first problem is that of
  ``cones``.

If rigid bodies have more contacts than equations of motion, W is singular, and contact
forces are not unique. In this case the bounds of ``tresca`` may drift in the null space
of W, so that the loop does not converge; three stacked boxes are an example. The loop
``tresca`` therefore takes proximal steps: it adds ½δ‖r − r'‖² to the objective, where
r' are the forces of the predecessor. The term vanishes as the loop converges. The loop
``cones`` takes proximal steps only after one of its problems has had no solution.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csc_array, csr_array, eye_array
from scipy.sparse.linalg import eigsh

from mortarbench.harness import QP, InputError, Solution, Vector, no_rows
from mortarbench.harness.sets.cones import Cones
from mortarbench.harness.sets.discs import Discs
from mortarbench.problems.contact.friction import MAX_ITERATES, MAX_STAGNATION

LOOPS = ("cones", "tresca")
#: largest asymmetry of W, relative to its largest entry, that counts as rounding.
#: Symmetrising W changes the scaled natural map by about the same amount, that is, by
#: about FIXED_POINT_TOLERANCE at most
MAX_ASYMMETRY = 1e-9
#: scaled natural map at which Coulomb's law counts as solved
FIXED_POINT_TOLERANCE = 1e-9
#: largest dimension of W for which all eigenvalues are computed (about 20 s)
MAX_DENSE_ROWS = 3000
#: eigenvalues of W below this fraction of the largest count as zero
RANK_TOLERANCE = 1e-10
#: δ of the proximal step relative to the largest eigenvalue of W. For three stacked
#: boxes, ``tresca`` takes 56 problems with 1e-2, 15 with 1e-3 and 9 with 1e-4, and
#: diverges with 1e-5
PROXIMITY = 1e-4
ACTIVE = 1e-6  #: forces below this fraction of the largest count as zero


@dataclass(frozen=True, eq=False)
class FrictionalContact:
    """Contacts with Coulomb friction; see the module docstring for the symbols.

    Raises
    ------
    InputError
        If W is not symmetric, because a QP requires a symmetric Hessian.

    """

    W: Any  #: (n, n) sparse matrix, stored as its symmetric part
    q: Vector  #: (n,) velocity in the absence of contact forces
    mu: Vector  #: (k,) coefficients of friction; a contact has n/k components
    A: Any = None  #: (p, n) matrix Vᵀ of the equations
    #: (p,) right-hand side b of the equations
    b: Vector = field(default_factory=lambda: np.zeros(0))

    def __post_init__(self) -> None:
        """Symmetrise W up to rounding."""
        largest = abs(self.W).max() if self.W.nnz else 0.0
        asymmetry = abs(self.W - self.W.T).max() / (largest or 1.0)
        if asymmetry > MAX_ASYMMETRY:
            raise InputError(
                f"W is not symmetric: the largest entry of W − Wᵀ is {asymmetry:.2g} "
                "of the largest entry of W; expected a symmetric W"
            )
        object.__setattr__(self, "W", csc_array((self.W + self.W.T) / 2))
        if self.A is None:
            object.__setattr__(self, "A", no_rows(self.q.size))

    def check_convex(self) -> None:
        """Raise InputError if W has a negative eigenvalue beyond rounding errors.

        If W has more than `MAX_DENSE_ROWS` rows, negative eigenvalues are not detected.
        """
        least = self._eigenvalues[0]
        if least < -RANK_TOLERANCE * self.stiffness:
            raise InputError(
                f"W has the negative eigenvalue {least:.2g}, "
                f"{least / self.stiffness:.1g} times the largest one; expected a "
                "positive semidefinite W"
            )

    @cached_property
    def _eigenvalues(self) -> Vector:
        """Eigenvalues of W, ascending.

        If W has more than `MAX_DENSE_ROWS` rows, only the largest eigenvalue.
        """
        if self.q.size <= MAX_DENSE_ROWS:
            return np.asarray(np.linalg.eigvalsh(self.W.toarray()))
        return np.asarray(eigsh(self.W, 1, return_eigenvectors=False))

    @property
    def stiffness(self) -> float:
        """The largest eigenvalue of W, or 1 if W is zero."""
        return float(self._eigenvalues[-1]) or 1.0

    @property
    def rank(self) -> int | None:
        """Rank of W; None if W has more than `MAX_DENSE_ROWS` rows."""
        if self._eigenvalues.size < self.q.size:
            return None
        return int((self._eigenvalues > RANK_TOLERANCE * self.stiffness).sum())

    @property
    def cones(self) -> Cones:
        """The friction cones of all contacts."""
        n, k = self.q.size, self.mu.size
        return Cones(np.arange(n).reshape(k, n // k), self.mu)

    def velocity(self, r: Vector, multipliers: Vector) -> Vector:
        """Return the velocities u (n,) for forces r (n,) and multipliers λ (p,)."""
        u: Vector = self.W @ r + self.q + self.A.T @ multipliers
        return u

    def tangential(self, v: Vector) -> Vector:
        """Return the norm (k,) of the tangential part of v (n,)."""
        norms: Vector = np.linalg.norm(v[self.cones.index[:, 1:]], axis=1)
        return norms

    def natural_map(
        self, r: Vector, multipliers: Vector, omega: float | None = None
    ) -> float:
        """Return the scaled natural map, which is zero at solutions.

        The result is  ‖r − Π(r − û/ω)‖·ω/‖q‖ + ‖A r − b‖/‖b‖  with the projector Π onto
        the friction cones. A denominator that is zero is replaced by 1.

        Parameters
        ----------
        r, multipliers : (n,) forces and λ (p,)
        omega : factor that converts forces to velocities. The default is the largest
            eigenvalue of W, which makes the result independent of units. The error
            defined by FCLIB uses omega = 1 in the units of the file

        """
        omega = self.stiffness if omega is None else omega
        u = self.velocity(r, multipliers)
        u[self.cones.index[:, 0]] += self.mu * self.tangential(u)
        change = r - self.cones.project(r - u / omega)
        off = self.A @ r - self.b
        return sum(
            float(np.linalg.norm(error)) / (float(np.linalg.norm(size)) or 1.0)
            for error, size in ((change * omega, self.q), (off, self.b))
        )

    def scaled(self, force: float, velocity: float) -> FrictionalContact:
        """Return the problem in the given units of force and velocity."""
        return replace(
            self, W=self.W * (force / velocity), q=self.q / velocity, b=self.b / force
        )

    def cone_step(self, slip: Vector) -> QP:
        """Return the problem of the loop `cones` with s = (slip, 0).

        slip : (k,) μ‖u_T‖ of each contact
        """
        q = self.q.copy()
        q[self.cones.index[:, 0]] += slip
        return self._qp(q, np.full(q.size, -np.inf), self.cones)

    def tresca_step(self, bound: Vector) -> QP:
        """Return the problem of the loop `tresca` with ‖r_T‖ ≤ bound.

        bound : (k,) friction bound g of each contact
        """
        lower, index = np.full(self.q.size, -np.inf), self.cones.index
        lower[index[:, 0]] = 0.0
        return self._qp(self.q, lower, Discs(index[:, 1:], bound))

    def _qp(self, q: Vector, lower: Vector, one: Cones | Discs) -> QP:
        return QP(
            P=self.W,
            q=q,
            A=csr_array(self.A),
            b=self.b,
            lb=lower,
            sets=(one,),
        )


class ConvexStep(NamedTuple):
    """One convex problem of a sequence for Coulomb's law."""

    qp: QP
    error: float  #: scaled natural map of Coulomb's law at the solution of `qp`


def coulomb_steps(
    contact: FrictionalContact, loop: str, solve: Callable[[QP], Solution]
) -> list[ConvexStep]:
    """Return the convex problems of a sequence for Coulomb's law, until convergence.

    In the loop ``tresca``, the list begins with the first problem over ‖r_T‖ ≤ g, after
    the problem over the cones.

    Parameters
    ----------
    loop : name of the sequence, one of `LOOPS`
    solve : function that solves a convex problem and raises ArithmeticError if the
        problem has no solution

    Raises
    ------
    InputError
        If a problem has no solution even with a proximal term, or if the sequence does
        not converge.

    """
    steps, errors, method = (
        list[ConvexStep](),
        list[float](),
        _ProximalMethod(contact, solve),
    )

    r, qp = np.zeros(contact.q.size), contact.cone_step(np.zeros(contact.mu.size))
    if loop == "tresca":
        s = method.solve(qp, r)
        r, qp, method.is_proximal = s.x, _successor(contact, loop, s), True
    while len(steps) < MAX_ITERATES:
        s = method.solve(qp, r)
        errors.append(contact.natural_map(s.x, s.y))
        steps.append(ConvexStep(qp, errors[-1]))
        if errors[-1] <= FIXED_POINT_TOLERANCE:
            return steps
        if len(steps) - 1 - int(np.argmin(errors)) > MAX_STAGNATION:
            break
        r, qp = s.x, _successor(contact, loop, s)
    raise InputError(
        f"loop={loop} does not converge to Coulomb's law: after {len(steps)} convex "
        f"problems the scaled natural map is {errors[-1]:.1e}, and was at best "
        f"{min(errors):.1e}; expected another loop, or a smaller mu"
    )


class _ProximalMethod:
    """Solver of the convex problems; takes proximal steps once `is_proximal` is set.

    A failed solve sets `is_proximal`.
    """

    def __init__(
        self, contact: FrictionalContact, solve: Callable[[QP], Solution]
    ) -> None:
        self.is_proximal = False
        self._solve, self._delta = solve, PROXIMITY * contact.stiffness

    def solve(self, qp: QP, r: Vector) -> Solution:
        """Solve `qp`; in a proximal step, ½δ‖x − r‖² is added to its objective."""
        if not self.is_proximal:
            try:
                return self._solve(qp)
            except ArithmeticError:  # W is singular and the objective unbounded
                self.is_proximal = True
        P = csc_array(qp.P + self._delta * eye_array(r.size))
        try:
            return self._solve(replace(qp, P=P, q=qp.q - self._delta * r))
        except ArithmeticError as e:
            raise InputError(f"a convex problem has no solution: {e}") from None


def _successor(contact: FrictionalContact, loop: str, s: Solution) -> QP:
    """Return the next problem, given the solution s of its predecessor."""
    if loop == "tresca":
        normal = np.maximum(s.x[contact.cones.index[:, 0]], 0.0)
        return contact.tresca_step(contact.mu * normal)
    slip = contact.tangential(contact.velocity(s.x, s.y))
    return contact.cone_step(contact.mu * slip)


def states(contact: FrictionalContact, r: Vector) -> NDArray[Any]:
    """Return the state "open", "stick" or "slip" of each contact (k,) for r (n,)."""
    normal = r[contact.cones.index[:, 0]]
    least = ACTIVE * float(np.abs(r).max(initial=0.0))
    slips = contact.tangential(r) >= (1 - ACTIVE) * contact.mu * normal
    return np.where(normal <= least, "open", np.where(slips, "slip", "stick"))
