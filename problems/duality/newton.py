"""Load steps at finite strain with contact: each Newton iteration is one convex QP.

In step k, the bodies carry the dead load κf with κ = k/steps, and the displacement is a
minimiser of

    Π(u) = ∫ W(I + ∇u) dX − κ fᵀu   subject to   u = 0 on the supports,  g(u) ≥ 0

with the gaps g of the contact rows. Let r = Π'(u^j) at the iterate u^j, and let
B = −g'(u^j) and c = g(u^j) + B u^j be the rows of `problems.contact.linearise`. An
iteration of Newton's method (a step of sequential quadratic programming: Nocedal and
Wright 2006, ch. 18) is a QP in the total displacement, so that errors are relative to
u and not to an increment:

    min ½uᵀK u + (r − K u^j)ᵀu   subject to   B_D u = 0,   B u ≤ c.                (1)

*K* is the tangent Π''(u^j) if this tangent is positive definite on the motions that the
supports allow, which is tested by a Cholesky factorisation. Otherwise negative
eigenvalues of the tangents of single cells are raised
(`problems.fem.finite_strain.convex_tangent`). The second derivatives of the gaps,
−Σ λ_i g_i''(u^j) with the multipliers of the previous iteration ("geometric" contact
stiffness), may be added to the tangent. Without these derivatives, convergence is
linear if both sides deform. The term ρB_DᵀB_D is added to K. This term vanishes if
u = 0 on the supports, and makes K definite on rotations, on which the tangent of a
compressed body is indefinite rather than singular. The remaining kernel of K consists
of the translations that the supports allow.

*Line search*: with the solution u of (1), d = u − u^j and a weight w above ‖λ‖∞, d is a
descent direction of the exact penalty function (Nocedal and Wright, (18.27))

    φ(u) = Π(u) + w Σ max(0, −g_i(u)),

and the step length is the first of 1, ½, ¼, … that satisfies Armijo's condition. A full
step that halves the smallest residual so far is accepted without this test, because
curved constraints may increase φ near the solution (Maratos effect). Each such step
halves the smallest residual; therefore, only finitely many such steps occur.

*Vertices*: where the master surface is concave, a slave node may alternate between two
segments. If the iteration does not converge, pressing nodes (those with multipliers
λ_i > 0) are assigned to their closest segments. In further iterations, such a node
keeps its segment. It may slide slightly beyond the ends of the segment, along the
straight line through both ends.

*Convergence*: the iteration stops after a full step if `NewtonPath.residual`, evaluated
at the new iterate with the multipliers of the QP, is at most TOLERANCE plus a bound on
its rounding error.

*Load*: if the iteration fails, the load increment is halved, down to the fraction
2^−MAX_HALVINGS of the load step.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import null_space
from scipy.sparse import csc_array

from mortarbench.harness import (
    QP,
    InputError,
    Reference,
    Solution,
    Status,
    Vector,
)
from mortarbench.harness.errors import PastEndError
from mortarbench.harness.verify.kkt import kkt_residuals
from mortarbench.problems.contact.bodies import (
    Bodies,
    slave_places,
)
from mortarbench.problems.contact.rows import ContactRows, without_fixed
from mortarbench.problems.contact.sides import ACTIVE_THRESHOLD
from mortarbench.problems.duality.dualisation import dual_bounds, dualise
from mortarbench.problems.duality.monolithic import MAX_REFERENCE_RESIDUAL, primal_qp
from mortarbench.problems.duality.problem import Linearise
from mortarbench.problems.fem.finite_strain import (
    Cells,
    EnergyDerivatives,
    InvertedCellError,
    assemble,
    clip_eigenvalues,
    convex_tangent,
    evaluate,
)
from mortarbench.problems.fem.fixing import fixing_nodes
from mortarbench.problems.fem.inverse import (
    GeneralisedInverse,
    Interface,
    floating_inverse,
)
from mortarbench.problems.fem.mesh import dofs_of

#: largest `NewtonPath.residual`, minus a bound on its rounding error, at the end of a
#: load step
TOLERANCE = 1e-9
#: rounding error of nodal forces relative to |K||u|, which exceeds |Ku| because strains
#: are differences of displacements
FORCE_ROUNDING = 2 * float(np.finfo(float).eps)
MAX_ITERATIONS = 60  #: largest number of Newton iterations at one load
KEEP_AFTER = 20  #: number of iterations after which pressing nodes keep their segments
MAX_HALVINGS = 8  #: largest number of halvings of a load increment
MIN_STEP = 2.0**-16  #: smallest step length of the line search
#: rounding error of the merit function relative to the energies; without this
#: allowance, steps near the solution would be rejected, because the decrease of the
#: merit function is smaller than its rounding error
MERIT_ROUNDING = 8 * float(np.finfo(float).eps)
ARMIJO_FRACTION = 1e-4  #: required fraction of the decrease predicted by the slope
#: weight of the penalty relative to the largest multiplier; the penalty function is
#: exact for values above 1
PENALTY_FACTOR = 1.5
MAX_ROTATION = 1e-8  #: largest rotational fraction of a motion that counts as rounding

#: function that maps a displacement (n,) in m and multipliers (places,) in N/m to
#: blocks −λ_i g_i''(u), (places, k, k) in Pa, and their displacement components
Curvature = Callable[[Vector, Vector], tuple[NDArray[np.float64], NDArray[np.int64]]]


class Gaps(NamedTuple):
    """The gaps of the contact rows as functions of the displacement."""

    linearise: Linearise
    #: function that evaluates contact stiffness; None to neglect it
    curvature: Curvature | None = None
    #: function that returns, for a displacement (n,) in m and a mask (places,) of slave
    #: nodes, gaps with these nodes kept on their closest segments; None if the method
    #: of contact has no segments, or if nodes already keep their segments
    keep_segments: Callable[[Vector, NDArray[np.bool_]], Gaps] | None = None


class NoEquilibriumError(ArithmeticError):
    """Failure of Newton's method to reach an equilibrium at a load."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Iteration:
    """One iteration of Newton's method: its QP and the result."""

    #: the undeformed bodies, with their K and f replaced by K and K u^j − r of (1)
    tangent: Bodies
    primal: QP
    rows: ContactRows
    gaps: Gaps
    u: Vector  #: u^j (n,), nondimensional
    load_factor: float  #: load factor κ
    #: Π(u^j) − rᵀu^j + ½u^jᵀK u^j, the constant of the quadratic model of Π
    constant: float
    clipped: int  #: number of cells whose tangent was made positive semidefinite
    answer: Solution  #: solution of (1)
    length: float = 1.0  #: accepted step length
    residual: float = np.inf  #: `NewtonPath.residual` after the step


class Configuration(NamedTuple):
    """A displacement with the energy, its gradient and the gaps evaluated there."""

    u: Vector
    rows: ContactRows
    gap: Vector  #: (m,) gaps of the contact rows, nondimensional
    cells: EnergyDerivatives
    energy: float  #: potential energy Π(u), nondimensional
    r: Vector  #: (n,) gradient Π'(u)


@dataclass(frozen=True, eq=False)
class NewtonPath:
    """The load steps of one analysis at finite strain; solved steps are cached.

    Raises
    ------
    InputError
        If Newton's method does not reach the equilibrium of a load step, if a step has
        fewer iterations than requested, or if the supports allow a body to rotate.

    """

    bodies: Bodies  #: undeformed bodies and their stiffness matrix K
    cells: Cells  #: data of the cells, nondimensional like K
    gaps: Gaps
    reference: Reference
    steps: int = 1
    _steps: list[list[Iteration]] = field(default_factory=list, init=False)
    _parts: list[int] = field(default_factory=list, init=False)

    def iteration(self, k: int, newton: int = 0) -> Iteration:
        """Return Newton iteration 1, 2, … of step k (1 … steps); 0 selects the last."""
        iterations = self.iterations(k)
        if newton > len(iterations):
            raise PastEndError(
                f"newton={newton}: step {k} has {len(iterations)} Newton iterations; "
                f"expected at most {len(iterations)}, or 0 for the last"
            )
        return iterations[newton - 1]

    def iterations(self, k: int) -> list[Iteration]:
        """Return the Newton iterations of step k at its full load."""
        while len(self._steps) < k:
            iterations, parts = self._load_step(len(self._steps) + 1)
            self._steps.append(iterations)
            self._parts.append(parts)
        return self._steps[k - 1]

    def parts(self, k: int) -> int:
        """Return the number of load increments of step k; 1 if none was halved."""
        self.iterations(k)
        return self._parts[k - 1]

    def state(self, at: Iteration, s: Solution) -> tuple[float, float, float]:
        """Evaluate Π, the residual and the largest penetration at a solution of a QP.

        The values are nondimensional, and s is a solution of `at.primal`. Penetrations
        are measured to the closest segments, even for nodes that keep other segments.

        Raises
        ------
        InvertedCellError
            If a cell is inverted at s.x.

        """
        lam = self._at_places(replace(at, answer=s))
        reached = self._configuration(s.x, at.load_factor, at.gaps)
        gap = self._configuration(s.x, at.load_factor, self.gaps).gap
        penetration = float((-gap).max(initial=0.0))
        return reached.energy, self.residual(reached, lam, at.load_factor), penetration

    def _load_step(self, k: int) -> tuple[list[Iteration], int]:
        """Solve step k from the end of step k − 1; halve increments that fail.

        Returns
        -------
        iterations at the full load of the step, and the number of load increments

        """
        if self._kernel_defect:
            raise InputError(self._kernel_defect)
        reached, target = (k - 1) / self.steps, k / self.steps
        least = (target - reached) / 2**MAX_HALVINGS
        size, parts = target - reached, 0
        u, lam = self._start(k)
        while True:
            load_factor = (
                target if reached + size > target - least / 2 else reached + size
            )
            try:
                iterations = self._solve_load(load_factor, u, lam)
            except NoEquilibriumError as e:
                size /= 2
                if size < least:
                    raise InputError(
                        f"load step {k} of {self.steps}: the largest load factor with "
                        f"an equilibrium was {reached:.6g}; {e}; expected a smaller "
                        "load, additional supports, or kinematics=linear"
                    ) from None
                continue
            parts += 1
            if load_factor == target:
                return iterations, parts
            reached, (u, lam) = load_factor, self._end(iterations)

    def _start(self, k: int) -> tuple[Vector, Vector]:
        if k == 1:
            return np.zeros(self.bodies.mesh.dofs), np.zeros(self._places)
        return self._end(self.iterations(k - 1))

    def _end(self, iterations: list[Iteration]) -> tuple[Vector, Vector]:
        last = iterations[-1]
        return last.answer.x, self._at_places(last)

    @property
    def _places(self) -> int:
        return slave_places(self.bodies.pairs)

    def _at_places(self, at: Iteration) -> Vector:
        """Return multipliers (places,) of slave nodes; zero for nodes without a row."""
        return at.rows.at_places(np.maximum(at.answer.z, 0.0), self._places)

    def _solve_load(
        self, load_factor: float, u: Vector, lam: Vector
    ) -> list[Iteration]:
        """Return the iterations at one load, starting from u and the multipliers `lam`.

        If a line search fails, or after KEEP_AFTER iterations, pressing nodes keep
        their closest segments in all further iterations.

        Parameters
        ----------
        u : (n,) initial displacement, nondimensional
        lam : (places,) initial multipliers of the slave nodes

        """
        gaps = self.gaps
        at = self._configuration(u, load_factor, gaps)
        best, weight = self.residual(at, lam, load_factor), 0.0
        iterations: list[Iteration] = []
        while len(iterations) < MAX_ITERATIONS:
            reason = ""
            if len(iterations) < KEEP_AFTER or gaps.keep_segments is None:
                iteration = self._linearise(at, lam, load_factor, gaps)
                lam = self._at_places(iteration)
                weight = max(weight, PENALTY_FACTOR * lam.max(initial=0.0))
                try:
                    at, length, residual = self._line_search(
                        at, iteration, lam, weight, best
                    )
                except NoEquilibriumError as e:
                    reason = str(e)
                else:
                    best = min(best, residual)
                    iterations.append(
                        replace(iteration, length=length, residual=residual)
                    )
                    if length == 1 and residual <= TOLERANCE + self._rounding(
                        at, lam, iteration
                    ):
                        return iterations
                    continue
            if gaps.keep_segments is None:
                raise NoEquilibriumError(
                    f"at the load factor {load_factor:.6g}, iteration "
                    f"{len(iterations) + 1} ended with a residual of {best:.1e}: "
                    f"{reason}"
                )
            pressing = lam > ACTIVE_THRESHOLD * lam.max(initial=0.0)
            gaps = gaps.keep_segments(at.u * self.bodies.length, pressing)
            at = self._configuration(at.u, load_factor, gaps)
            best = self.residual(at, lam, load_factor)
        raise NoEquilibriumError(
            f"at the load factor {load_factor:.6g}, {MAX_ITERATIONS} iterations left a "
            f"residual of {best:.1e}"
        )

    def _configuration(
        self, u: Vector, load_factor: float, gaps: Gaps
    ) -> Configuration:
        rows = gaps.linearise(u * self.bodies.length)
        rows = without_fixed(rows, self.bodies.fixed)
        gap = rows.c / self.bodies.length - rows.B @ u
        cells, f = evaluate(self.cells, u), load_factor * self.bodies.f
        return Configuration(
            u, rows, gap, cells, cells.energy - float(f @ u), cells.forces - f
        )

    def residual(self, at: Configuration, lam: Vector, load_factor: float) -> float:
        """Return the residual of equilibrium and contact at a configuration.

        The residual is the maximum of three terms: ‖r + Bᵀλ‖ on the free components,
        relative to the larger of the norms of the load and of Bᵀλ; the largest
        penetration; and the largest |g_i| λ_i / max λ (complementarity). Gaps are
        divided by the unit of length of the bodies.

        lam : (places,) multipliers λ of the slave nodes
        """
        pressing = at.rows.of_rows(lam[at.rows.place])
        contact = at.rows.B.T @ pressing
        imbalance = self._free_norm(at.r + contact) / self._forces(at, lam, load_factor)
        largest = pressing.max(initial=0.0) or 1.0
        penetration = float((-at.gap).max(initial=0.0))
        complementarity = float((pressing / largest * np.abs(at.gap)).max(initial=0.0))
        return max(imbalance, penetration, complementarity)

    def _forces(self, at: Configuration, lam: Vector, load_factor: float) -> float:
        """Return the larger of the norms of the load and of Bᵀλ; 1 if both are zero."""
        contact = at.rows.B.T @ at.rows.of_rows(lam[at.rows.place])
        load = self._free_norm(load_factor * self.bodies.f)
        return max(load, self._free_norm(contact)) or 1.0

    def _free_norm(self, force: Vector) -> float:
        """Return the Euclidean norm of a force (n,) on the unsupported components."""
        free = np.ones(force.size, dtype=bool)
        free[self.bodies.fixed] = False
        return float(np.linalg.norm(force[free]))

    def _rounding(self, at: Configuration, lam: Vector, iteration: Iteration) -> float:
        """Return a bound on the rounding error of `residual`.

        Strains are differences of displacements. The rounding error of the forces Ku is
        therefore proportional to |K||u|, however small Ku is.
        """
        rounded = self._free_norm(abs(iteration.tangent.K) @ np.abs(at.u))
        return FORCE_ROUNDING * rounded / self._forces(at, lam, iteration.load_factor)

    def _linearise(
        self, at: Configuration, lam: Vector, load_factor: float, gaps: Gaps
    ) -> Iteration:
        """Assemble the QP (1) at a configuration, and solve this QP."""
        K, inverse, clipped = self._convex(at, lam, gaps.curvature)
        tangent = replace(self.bodies, K=K, f=K @ at.u - at.r)
        primal = primal_qp(tangent, at.rows)
        answer = self._solve(primal, inverse)
        return Iteration(
            tangent=tangent,
            primal=primal,
            rows=at.rows,
            gaps=gaps,
            u=at.u,
            load_factor=load_factor,
            clipped=clipped,
            answer=answer,
            constant=float(at.energy - at.r @ at.u + 0.5 * at.u @ (K @ at.u)),
        )

    def _convex(
        self, at: Configuration, lam: Vector, curvature: Curvature | None
    ) -> tuple[csc_array, GeneralisedInverse, int]:
        """Return a tangent, its inverse and the number of clipped cell tangents.

        The tangent is positive definite on the motions that the supports allow, except
        for translations. If the exact tangent is indefinite, negative eigenvalues of
        the contact stiffness are removed first. Negative eigenvalues of cell tangents
        are raised only if this does not suffice.
        """
        supports = self.bodies.B_D
        factorised: list[tuple[csc_array, GeneralisedInverse]] = []
        contact = self._contact_stiffness(at, lam, curvature)

        def positive(K: csc_array) -> bool:
            K = csc_array(K + contact)
            K = csc_array(K + K.diagonal().max() * (supports.T @ supports))
            try:
                factorised.append((K, self._inverse(K)))
            except np.linalg.LinAlgError:
                return False
            return True

        tangents = at.cells.tangents
        if contact.nnz and not positive(assemble(self.cells, tangents)):
            contact = self._contact_stiffness(at, lam, curvature, convex=True)
        clipped = 0
        if not factorised:
            try:
                _, clipped = convex_tangent(self.cells, tangents, positive)
            except ArithmeticError as e:
                raise NoEquilibriumError(str(e)) from None
        return *factorised[-1], clipped

    def _contact_stiffness(
        self,
        at: Configuration,
        lam: Vector,
        curvature: Curvature | None,
        *,
        convex: bool = False,
    ) -> csc_array:
        """Assemble the nondimensional −Σ λ_i g_i''; zero if `curvature` is None.

        convex : remove the negative eigenvalues of each block
        """
        n = at.u.size
        if curvature is None:
            return csc_array((n, n))
        l, F = self.bodies.length, self.bodies.force
        blocks, dofs = curvature(at.u * l, lam * F)
        if convex:
            blocks, _ = clip_eigenvalues(blocks)
        i, j = np.repeat(dofs, dofs.shape[1], axis=1), np.tile(dofs, (1, dofs.shape[1]))
        return csc_array((blocks.ravel() * l / F, (i.ravel(), j.ravel())), shape=(n, n))

    def _inverse(self, K: csc_array) -> GeneralisedInverse:
        tangent = replace(self.bodies, K=K)
        is_supported = self.bodies.is_supported
        return tangent.clamped if is_supported else sliding_inverse(tangent)

    @cached_property
    def _kernel_defect(self) -> str:
        """Reason why the kernel does not consist of translations; empty if it does."""
        try:
            free_translations(self.bodies)
        except InputError as e:
            return str(e)
        if self.gaps.curvature is not None and not self.bodies.is_supported:
            return (
                "contact_stiffness=geometric is not built for bodies supported by "
                "contact alone, because their translations change the contact forces; "
                "expected contact_stiffness=none, or supports that fix every body"
            )
        return ""

    def _solve(self, primal: QP, inverse: GeneralisedInverse) -> Solution:
        transform = dual_bounds if self.bodies.is_supported else dualise
        new = transform(primal, inverse)
        if not new.qp.q.size:
            none = np.zeros(0)
            return new.recover(
                Solution(status=Status.SOLVED, x=none, y=none, z=none, z_box=none)
            )
        try:
            s = self.reference(new.qp)
        except ArithmeticError as e:
            raise NoEquilibriumError(f"its QP was not solved: {e}") from None
        if not (worst := kkt_residuals(new.qp, s).worst) <= MAX_REFERENCE_RESIDUAL:
            raise NoEquilibriumError(
                f"its reference solve left a residual of {worst:.1e}, more than "
                f"{MAX_REFERENCE_RESIDUAL:g}"
            )
        return new.recover(s)

    def _line_search(
        self,
        at: Configuration,
        iteration: Iteration,
        lam: Vector,
        weight: float,
        best: float,
    ) -> tuple[Configuration, float, float]:
        """Return the new configuration, the step length and the residual.

        Parameters
        ----------
        weight : weight w of the penalty in φ
        best : smallest residual so far

        """
        load_factor = iteration.load_factor
        d = iteration.answer.x - at.u
        merit = _merit(at, weight)
        noise = MERIT_ROUNDING * (abs(at.cells.energy) + abs(at.energy))
        slope = float(at.r @ d) - weight * float(np.maximum(-at.gap, 0.0).sum())
        length, inverted = 1.0, None
        while length >= MIN_STEP:
            try:
                new = self._configuration(
                    at.u + length * d, load_factor, iteration.gaps
                )
            except InvertedCellError as e:
                inverted = e
            else:
                residual = self.residual(new, lam, load_factor)
                if (length == 1 and residual <= best / 2) or (
                    _merit(new, weight)
                    <= merit + ARMIJO_FRACTION * length * min(slope, 0.0) + noise
                ):
                    return new, length, residual
            length /= 2
        raise NoEquilibriumError(
            str(inverted) if inverted else "no step decreases the merit function"
        )


def _merit(at: Configuration, weight: float) -> float:
    """Return the merit function φ at a configuration."""
    return at.energy + weight * float(np.maximum(-at.gap, 0.0).sum())


def free_translations(bodies: Bodies) -> list[NDArray[np.float64]]:
    """Return, for each body, an orthonormal basis (2N_body, r) of free translations.

    Raises
    ------
    InputError
        If the supports allow a body to rotate. The tangent, which does not include
        contact, may be indefinite on rotations.

    """
    owner, bases = bodies.body_of_node, []
    fixed = np.zeros(bodies.mesh.dofs, dtype=bool)
    fixed[bodies.fixed] = True
    rigid = bodies.rigid
    for b, name in enumerate(bodies.names):
        dofs = dofs_of(np.flatnonzero(owner == b), bodies.mesh.dim)
        R = rigid[dofs][:, 3 * b : 3 * b + 3]
        remaining = null_space(R[fixed[dofs]]) if fixed[dofs].any() else np.eye(3)
        if np.abs(remaining[2]).max(initial=0.0) > MAX_ROTATION:
            raise InputError(
                f"kinematics=finite: the supports allow body {name!r} to rotate, and "
                "the stiffness of a stressed body may be negative on rotations; "
                "expected supports that allow translations at most"
            )
        bases.append(R @ remaining)
    return bases


def sliding_inverse(tangent: Bodies) -> GeneralisedInverse:
    """Factorise K for the form `dual`, with the free translations as kernel."""
    kernels = free_translations(tangent)
    owner, points = tangent.body_of_node, tangent.mesh.points
    dim, none = tangent.mesh.dim, np.zeros(0, dtype=np.int64)
    fixing = [
        dofs_of(fixing_nodes(points[owner == b]), dim) if R.shape[1] else none
        for b, R in enumerate(kernels)
    ]
    touched = np.union1d(tangent.interface, tangent.fixed)
    return floating_inverse(tangent.K, kernels, fixing, Interface(touched, points))
