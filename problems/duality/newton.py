"""Load steps at finite strain with contact: each Newton iteration is one convex QP.

Step k carries the load κf, κ = k/steps (dead loads), and seeks a minimiser of

    Π(u) = ∫ W(I + ∇u) dX − κ fᵀu   subject to   u = 0 on the supports,  g(u) ≥ 0

with the gaps g of the contact rows. At u^j, with r = Π'(u^j) and the rows
B = −g'(u^j), c = g(u^j) + B u^j of `problems.contact.linearise`, Newton's iteration (a
step of sequential quadratic programming: Nocedal and Wright 2006, ch. 18) is a QP in
the total displacement, so that errors are relative to u and not to an increment:

    min ½uᵀK u + (r − K u^j)ᵀu   subject to   B_D u = 0,   B u ≤ c.                (1)

*K* is the tangent Π''(u^j) where that is positive definite on what the supports leave,
which a Cholesky factorisation tells. Where it is not, the negative eigenvalues of the
tangents of single cells are raised (`problems.fem.finite_strain.convex_tangent`). The
second derivatives of the gaps, −Σ λ_i g_i''(u^j) with the multipliers of the iteration
before ("geometric" contact stiffness), may join the tangent; without them the
convergence is linear where both sides deform. To K is added ρB_DᵀB_D, which changes
nothing where u = 0 on the supports and makes K positive definite as a whole: under
compression the tangent is not singular but indefinite on rotations. What it stays
singular on are translations that the supports leave, exactly.

*Line search*: with the solution u of (1), d = u − u^j and a weight w above ‖λ‖∞, d is a
descent direction of the exact penalty function (Nocedal and Wright, (18.27))

    φ(u) = Π(u) + w Σ max(0, −g_i(u)),

and the step is the first of 1, ½, ¼, … that decreases it enough (Armijo). A full step
that halves the least residual so far is taken without, as curved constraints may make φ
grow near the solution (Maratos effect); that can happen a finite number of times only.

*Vertices*: where the master bends inwards, a slave node may be pushed to and fro
between two segments. When the iteration comes to no end, nodes that press keep the
segments that are the closest there, and may leave them by a little on their lines.

*Convergence*: equilibrium and gaps at the new u, with the multipliers of the QP, to
TOLERANCE; see `NewtonPath.residual`. *Load*: where that is not reached, the load step
is halved and the rest of it follows, down to the fraction 2^−MAX_HALVINGS.
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
    kkt_residuals,
)
from mortarbench.harness.errors import PastEndError
from mortarbench.problems.contact.bodies import Bodies, factorise_clamped
from mortarbench.problems.contact.node_to_segment import ContactRows
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

TOLERANCE = 1e-9  #: residual of equilibrium and gaps at the end of a step
ROUNDING = 2 * float(np.finfo(float).eps)  #: of the forces |K||u| within cells
MAX_ITERATIONS = 60  #: of Newton's method at one load
KEEP_AFTER = 20  #: of them after which nodes that press keep their segments
MAX_HALVINGS = 8  #: of a load step
MIN_STEP = 2.0**-16  #: step of the line search
MERIT_ROUNDING = 8 * float(
    np.finfo(float).eps
)  #: of the merit function, relative to energies
ARMIJO_FRACTION = 1e-4  #: part of the predicted decrease that a step has to bring
PENALTY_FACTOR = 1.5  #: weight of the penalty over the largest multiplier
MAX_ROTATION = 1e-8  #: part of a rigid motion that is a rotation, beyond rounding

#: displacement (n,) in m, multipliers (m,) in N/m → blocks (m, k, k) in Pa of
#: −Σ λ_i g_i''(u), and the components (m, k) that they are of
Curvature = Callable[[Vector, Vector], tuple[NDArray[np.float64], NDArray[np.int64]]]


class Gaps(NamedTuple):
    """The gaps of the contact rows as functions of the displacement."""

    linearise: Linearise
    curvature: Curvature | None = None  #: left out where there is none
    #: at a displacement (n,) in m, the gaps for which the slave nodes (places,) named
    #: keep the segments that are the closest there; none where there is no such choice
    keep_segments: Callable[[Vector, NDArray[np.bool_]], Gaps] | None = None


class NoEquilibriumError(ArithmeticError):
    """Newton's method has not come to an equilibrium at some load."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Iteration:
    """One iteration of Newton's method: its QP, and what came of it."""

    #: with K and f of (1), f = K u^j − r; all else of the undeformed bodies
    tangent: Bodies
    primal: QP
    rows: ContactRows
    gaps: Gaps
    u: Vector  #: u^j (n,), without dimensions
    load_factor: float  #: κ
    constant: float  #: Π(u^j) − rᵀu^j + ½u^jᵀK u^j, what (1) lacks of Π's model
    clipped: int  #: cells whose tangent was made positive semidefinite
    answer: Solution  #: of (1)
    length: float = 1.0  #: of the step that was taken
    residual: float = np.inf  #: after it


class Configuration(NamedTuple):
    """A displacement, with everything that is evaluated there."""

    u: Vector
    rows: ContactRows
    gap: Vector  #: (m,) without dimensions
    cells: EnergyDerivatives
    energy: float  #: Π
    r: Vector  #: (n,) Π'


@dataclass(frozen=True, eq=False)
class NewtonPath:
    """The load steps of one analysis at finite strain; what was solved is remembered.

    Raises
    ------
    InputError
        When a load step has no equilibrium that the method finds, or less iterations
        than are asked for, or the supports leave a body to rotate.

    """

    bodies: Bodies  #: K is that of the undeformed bodies
    cells: Cells  #: without dimensions, as K is
    gaps: Gaps
    reference: Reference
    steps: int = 1
    _steps: list[list[Iteration]] = field(default_factory=list, init=False)
    _parts: list[int] = field(default_factory=list, init=False)

    def iteration(self, k: int, newton: int = 0) -> Iteration:
        """Pose step k (1 … steps): its iteration 1, 2, …, or the last one for 0."""
        found = self.iterations(k)
        if newton > len(found):
            raise PastEndError(
                f"newton={newton}: step {k} has {len(found)} Newton iterations; "
                "expected at most that, or 0 for the last"
            )
        return found[newton - 1]

    def iterations(self, k: int) -> list[Iteration]:
        """List the Newton iterations of step k at its full load."""
        while len(self._steps) < k:
            found, parts = self._load_step(len(self._steps) + 1)
            self._steps.append(found)
            self._parts.append(parts)
        return self._steps[k - 1]

    def parts(self, k: int) -> int:
        """Count the parts that the load of step k came in; 1 without a cut-back."""
        self.iterations(k)
        return self._parts[k - 1]

    def state(self, at: Iteration, s: Solution) -> tuple[float, float, float]:
        """Evaluate Π, the residual and the largest penetration at a solution of a QP.

        Without dimensions; s is of `at.primal`. The penetration is that of the closest
        segments, whichever are kept.

        Raises
        ------
        InvertedCellError
            When a cell is inverted there.

        """
        lam = self._at_places(replace(at, answer=s))
        reached = self._configuration(s.x, at.load_factor, at.gaps)
        gap = self._configuration(s.x, at.load_factor, self.gaps).gap
        penetration = float((-gap).max(initial=0.0))
        return reached.energy, self.residual(reached, lam, at.load_factor), penetration

    def _load_step(self, k: int) -> tuple[list[Iteration], int]:
        """Go from step k − 1 to step k, in halves of what is left where it fails."""
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
                found = self._solve_load(load_factor, u, lam)
            except NoEquilibriumError as e:
                size /= 2
                if size < least:
                    raise InputError(
                        f"load step {k} of {self.steps}: the last equilibrium is that "
                        f"at the load factor {reached:.6g}; beyond it, {e}; expected "
                        f"{self._advice(target)}"
                    ) from None
                continue
            parts += 1
            if load_factor == target:
                return found, parts
            reached, (u, lam) = load_factor, self._end(found)

    def _advice(self, load_factor: float) -> str:
        """Name a problem with an equilibrium where a load has none that is found.

        Entries of F = I + ∂u/∂X are known to the rounding of 1: of cells of size h that
        leaves forces of about h|K|·1, whatever the load. Beside a tiny load they are
        more than TOLERANCE.
        """
        h = float(np.sqrt(self.cells.volumes.sum(axis=1).mean()))
        rounded = h * self._free_norm(
            abs(self.bodies.K) @ np.ones(self.bodies.mesh.dofs)
        )
        share = (
            ROUNDING * rounded / (load_factor * self._free_norm(self.bodies.f) or 1.0)
        )
        if share <= TOLERANCE:
            return "a smaller load, or supports that hold the bodies better"
        return (
            f"a larger load, or kinematics=linear: of strains this small, rounding "
            f"leaves {share:.0e} of the forces, and {TOLERANCE:g} is asked for"
        )

    def _start(self, k: int) -> tuple[Vector, Vector]:
        if k == 1:
            return np.zeros(self.bodies.mesh.dofs), np.zeros(self._places)
        return self._end(self.iterations(k - 1))

    def _end(self, found: list[Iteration]) -> tuple[Vector, Vector]:
        last = found[-1]
        return last.answer.x, self._at_places(last)

    @property
    def _places(self) -> int:
        return sum(pair.slave.size for pair in self.bodies.pairs)

    def _at_places(self, at: Iteration) -> Vector:
        """Return the multiplier (places,) of each slave node; zero without a row."""
        force = np.zeros(self._places)
        force[at.rows.place] = np.maximum(at.answer.z, 0.0)
        return force

    def _solve_load(
        self, load_factor: float, u: Vector, lam: Vector
    ) -> list[Iteration]:
        """Iterate at one load, from u and the multipliers (places,).

        Where that does not settle, nodes that press keep their segments from there on.
        """
        gaps = self.gaps
        at = self._configuration(u, load_factor, gaps)
        best, weight = self.residual(at, lam, load_factor), 0.0
        found: list[Iteration] = []
        while len(found) < MAX_ITERATIONS:
            stuck = ""
            if len(found) < KEEP_AFTER or gaps.keep_segments is None:
                posed = self._linearise(at, lam, load_factor, gaps)
                lam = self._at_places(posed)
                weight = max(weight, PENALTY_FACTOR * lam.max(initial=0.0))
                try:
                    at, length, residual = self._line_search(
                        at, posed, lam, weight, best
                    )
                except NoEquilibriumError as e:
                    stuck = str(e)
                else:
                    best = min(best, residual)
                    found.append(replace(posed, length=length, residual=residual))
                    if length == 1 and residual <= TOLERANCE + self._rounding(
                        at, lam, posed
                    ):
                        return found
                    continue
            if gaps.keep_segments is None:
                raise NoEquilibriumError(
                    f"at {load_factor:.6g}, iteration {len(found) + 1} ended with a "
                    f"residual of {best:.1e}: {stuck}"
                )
            pressing = lam > ACTIVE_THRESHOLD * lam.max(initial=0.0)
            gaps = gaps.keep_segments(at.u * self.bodies.length, pressing)
            at = self._configuration(at.u, load_factor, gaps)
            best = self.residual(at, lam, load_factor)
        raise NoEquilibriumError(
            f"at {load_factor:.6g}, {MAX_ITERATIONS} iterations left a residual of "
            f"{best:.1e}"
        )

    def _configuration(
        self, u: Vector, load_factor: float, gaps: Gaps
    ) -> Configuration:
        rows = gaps.linearise(u * self.bodies.length)
        gap = rows.c / self.bodies.length - rows.B @ u
        cells, f = evaluate(self.cells, u), load_factor * self.bodies.f
        return Configuration(
            u, rows, gap, cells, cells.energy - float(f @ u), cells.forces - f
        )

    def residual(self, at: Configuration, lam: Vector, load_factor: float) -> float:
        """Measure equilibrium and contact at u, with multipliers (places,).

        The larger of ‖r + Bᵀλ‖ on the free components, over that of the load or of Bᵀλ;
        the largest penetration; and the largest gap under a multiplier, times its part
        of the largest one. Gaps are in lengths of the bodies.
        """
        pressing = lam[at.rows.place]
        contact = at.rows.B.T @ pressing
        left = self._free_norm(at.r + contact) / self._forces(at, lam, load_factor)
        most = pressing.max(initial=0.0) or 1.0
        penetration = float((-at.gap).max(initial=0.0))
        apart = float((pressing / most * np.abs(at.gap)).max(initial=0.0))
        return max(left, penetration, apart)

    def _forces(self, at: Configuration, lam: Vector, load_factor: float) -> float:
        """Return the larger norm of the load and of Bᵀλ; 1 where there is neither."""
        contact = at.rows.B.T @ lam[at.rows.place]
        load = self._free_norm(load_factor * self.bodies.f)
        return max(load, self._free_norm(contact)) or 1.0

    def _free_norm(self, force: Vector) -> float:
        """Return the norm of a force (n,) on the components that no support holds."""
        free = np.ones(force.size, dtype=bool)
        free[self.bodies.B_D.indices] = False
        return float(np.linalg.norm(force[free]))

    def _rounding(self, at: Configuration, lam: Vector, posed: Iteration) -> float:
        """Bound what rounding leaves of `residual`.

        The strains of a cell are differences of displacements, which are known to their
        own rounding: of forces Ku it leaves a part of |K||u|.
        """
        rounded = self._free_norm(abs(posed.tangent.K) @ np.abs(at.u))
        return ROUNDING * rounded / self._forces(at, lam, posed.load_factor)

    def _linearise(
        self, at: Configuration, lam: Vector, load_factor: float, gaps: Gaps
    ) -> Iteration:
        """Pose (1) and solve it."""
        K, inverse, clipped = self._convex(at, lam, gaps.curvature)
        tangent = replace(self.bodies, K=K, f=K @ at.u - at.r)
        primal = primal_qp(tangent, at.rows)
        answer = self._solve(primal, inverse)
        return Iteration(
            tangent=tangent, primal=primal, rows=at.rows, gaps=gaps, u=at.u,
            load_factor=load_factor, clipped=clipped, answer=answer,
            constant=float(at.energy - at.r @ at.u + 0.5 * at.u @ (K @ at.u)),
        )  # fmt: skip

    def _convex(
        self, at: Configuration, lam: Vector, curvature: Curvature | None
    ) -> tuple[csc_array, GeneralisedInverse, int]:
        """Make the tangent positive definite where it is not, and factorise it.

        Where contact stiffness is part of it, its own negative eigenvalues go first.
        """
        held = self.bodies.B_D
        found: list[tuple[csc_array, GeneralisedInverse]] = []
        contact = self._contact_stiffness(at, lam, curvature)

        def positive(K: csc_array) -> bool:
            K = csc_array(K + contact)
            K = csc_array(K + K.diagonal().max() * (held.T @ held))
            try:
                found.append((K, self._inverse(K)))
            except np.linalg.LinAlgError:
                return False
            return True

        tangents = at.cells.tangents
        if contact.nnz and not positive(assemble(self.cells, tangents)):
            contact = self._contact_stiffness(at, lam, curvature, convex=True)
        clipped = 0
        if not found:
            try:
                _, clipped = convex_tangent(self.cells, tangents, positive)
            except ArithmeticError as e:
                raise NoEquilibriumError(str(e)) from None
        return *found[-1], clipped

    def _contact_stiffness(
        self,
        at: Configuration,
        lam: Vector,
        curvature: Curvature | None,
        *,
        convex: bool = False,
    ) -> csc_array:
        """Assemble −Σ λ_i g_i'', without dimensions; empty where it is left out."""
        n = at.u.size
        if curvature is None:
            return csc_array((n, n))
        l, F = self.bodies.length, self.bodies.force
        blocks, dofs = curvature(at.u * l, lam[at.rows.place] * F)
        if convex:
            blocks, _ = clip_eigenvalues(blocks)
        i, j = np.repeat(dofs, dofs.shape[1], axis=1), np.tile(dofs, (1, dofs.shape[1]))
        return csc_array((blocks.ravel() * l / F, (i.ravel(), j.ravel())), shape=(n, n))

    def _inverse(self, K: csc_array) -> GeneralisedInverse:
        tangent = replace(self.bodies, K=K)
        return (
            factorise_clamped(tangent)
            if self._is_supported
            else sliding_inverse(tangent)
        )

    @cached_property
    def _is_supported(self) -> bool:
        """Whether the supports alone hold every body."""
        return not free_rigid_motions(self.bodies).shape[1]

    @cached_property
    def _kernel_defect(self) -> str:
        """Say why the tangent's kernel is not translations; empty where it is."""
        try:
            free_translations(self.bodies)
        except InputError as e:
            return str(e)
        if self.gaps.curvature is not None and not self._is_supported:
            return (
                "contact_stiffness=geometric where contact alone holds a body is not "
                "built: its translations change the contact forces; expected "
                "contact_stiffness=none, or supports that hold every body"
            )
        return ""

    def _solve(self, primal: QP, inverse: GeneralisedInverse) -> Solution:
        transform = dual_bounds if self._is_supported else dualise
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
        self, at: Configuration, posed: Iteration, lam: Vector, weight: float,
        best: float,
    ) -> tuple[Configuration, float, float]:  # fmt: skip
        """Search along the step: the new configuration, the length, the residual."""
        load_factor = posed.load_factor
        d = posed.answer.x - at.u
        merit = _merit(at, weight)
        noise = MERIT_ROUNDING * (abs(at.cells.energy) + abs(at.energy))
        slope = float(at.r @ d) - weight * float(np.maximum(-at.gap, 0.0).sum())
        length, inverted = 1.0, None
        while length >= MIN_STEP:
            try:
                new = self._configuration(at.u + length * d, load_factor, posed.gaps)
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
    """Evaluate φ."""
    return at.energy + weight * float(np.maximum(-at.gap, 0.0).sum())


def free_rigid_motions(bodies: Bodies) -> NDArray[np.float64]:
    """Return an orthonormal basis (n, r) of the rigid motions that the supports leave.

    Of the undeformed bodies; exact for translations, whatever the deformation.
    """
    rigid = bodies.rigid
    held = rigid[bodies.B_D.indices]
    return np.asarray(rigid @ null_space(held)) if held.size else rigid


def free_translations(bodies: Bodies) -> list[NDArray[np.float64]]:
    """Find per body an orthonormal basis (2N_body, r) of the translations left.

    Raises
    ------
    InputError
        When a rotation is left: the tangent at finite strain may be indefinite there,
        and what holds the body (contact) is no part of it.

    """
    owner, found = bodies.body_of_node, []
    held = np.zeros(bodies.mesh.dofs, dtype=bool)
    held[bodies.B_D.indices] = True
    rigid = bodies.rigid
    for b, name in enumerate(bodies.names):
        own = dofs_of(np.flatnonzero(owner == b), bodies.mesh.dim)
        R = rigid[own][:, 3 * b : 3 * b + 3]
        left = null_space(R[held[own]]) if held[own].any() else np.eye(3)
        if np.abs(left[2]).max(initial=0.0) > MAX_ROTATION:
            raise InputError(
                f"kinematics=finite: the supports leave body {name!r} to rotate, where "
                "a stressed body has a stiffness of either sign; expected supports "
                "that leave translations at most"
            )
        found.append(R @ left)
    return found


def sliding_inverse(tangent: Bodies) -> GeneralisedInverse:
    """Factorise K with the translations that its supports leave, as `dual` needs it."""
    kernels = free_translations(tangent)
    owner, points = tangent.body_of_node, tangent.mesh.points
    dim, none = tangent.mesh.dim, np.zeros(0, dtype=np.int64)
    fixing = [
        dofs_of(fixing_nodes(points[owner == b]), dim) if R.shape[1] else none
        for b, R in enumerate(kernels)
    ]
    touched = np.union1d(tangent.interface, tangent.B_D.indices)
    return floating_inverse(tangent.K, kernels, fixing, Interface(touched, points))
