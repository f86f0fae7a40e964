"""Reference solve of QPs with an operator P: active sets with CG on faces.

The problem is to minimise ½xᵀFx + qᵀx subject to Gx = e, l ≤ x ≤ u and ‖x_I‖ ≤ r on
discs, where F is an operator with a preconditioner, such as the dual of decomposed
bodies. The equality rows must be linearly independent on the components without bounds,
which is the case if all bodies are supported.

1. On a face, some components are fixed at bounds, and the free components x_𝓕 solve a
   linear system. The system is solved by conjugate gradients with a preconditioner and
   the projector 𝒫 = I − G_𝓕ᵀ(G_𝓕G_𝓕ᵀ)⁻¹G_𝓕. The iteration is restarted from the true
   residual until only rounding errors remain (iterative refinement). If x is on the
   boundary of a disc, with the multipliers z_I = ηx_I, the disc is linearised as in
   Newton's method: the normal component of x_I is fixed by nᵀx_I = r with the outward
   normal n, and x_I varies along the tangents. The curvature of the boundary adds η to
   F along the tangents.
2. The active sets are updated by the primal-dual method (Hintermüller, Ito and Kunisch
   2003, SIAM J. Optim. 13): components with a multiplier of the wrong sign are
   released, and components that violate a bound are fixed at this bound. Discs are
   treated in the same way, with n and η computed from w = x_I + γz_I (for friction, see
   Hüeber, Stadler and Wohlmuth 2008, SIAM J. Sci. Comput. 30). The active sets may
   cycle. After ten consecutive changes that did not reduce the number of wrong
   components, only the last wrong component changes, until the number of wrong
   components decreases (block principal pivoting, Júdice and Pires 1994, Comput. Oper.
   Res. 21). Without discs, the algorithm ends after finitely many changes.

The active set of the result has no multipliers of the wrong sign, and the result
violates no bounds. The errors of the result are about as large as rounding errors. The
module uses no code of the solvers under test.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csc_matrix, csr_array, diags_array
from sksparse.cholmod import CholmodNotPositiveDefiniteError, cholesky

from mortarbench.harness import QP, Discs, Solution, Status, Vector
from mortarbench.harness.operators import is_semidefinite, preconditioned
from mortarbench.harness.sets.blocks import norms
from mortarbench.solvers.common.stopping import relative_residual

Mask = NDArray[np.bool_]

MAX_FACES = 300
#: Largest number of consecutive changes of the active set that do not reduce the number
#: of wrong components. Afterwards, components change one at a time.
PATIENCE = 10
CG_REDUCTION = 1e-6  #: reduction of the projected residual in each round of CG
MAX_CG_ROUNDS = 3  #: largest number of CG rounds on a face
MAX_CG_STEPS = 300  #: largest number of CG steps in a round
#: largest ratio of wᵀMw to its smallest value in a round, with the residual w; in exact
#: arithmetic, the condition number of MF limits this ratio
MAX_GROWTH = 1e6
#: no further CG round starts if the norm of the projected residual is at most this
#: factor times the norm of the projected q
ROUNDING_RESIDUAL = 1e-14
#: multipliers of the wrong sign, relative to the largest multiplier, and violations of
#: bounds, relative to the largest component, count as rounding errors below this value
SIGN_ROUNDING = 1e-12
#: largest final angle in radians between x and the normal at which a disc was
#: linearised; the remaining error of Newton's method is about the square of the angle
MAX_TURN = 1e-7
MAX_REFERENCE_RESIDUAL = 1e-9  #: largest KKT residual of a reference solution


def reference_of_operator(qp: QP, start: Solution | None = None) -> Solution:
    """Solve a QP whose P provides preconditioners to about working precision.

    qp : a QP without inequality rows, over bounds and at most one set of discs
    start : solution of a QP that differs only in its bounds; its active set is tried
        first

    Raises
    ------
    ValueError
        If P has no diagonal or no preconditioners, or if the QP has other constraints.
    ArithmeticError
        If no active set is confirmed after 300 faces, if the point of the confirmed
        active set has a KKT residual above 1e-9, or if the equality rows are linearly
        dependent on a face.

    """
    task = _Task.of(qp)
    point = (
        task.zero_point() if start is None else _Point(start.x, start.y, start.z_box)
    )
    face = task.first_face(point)
    fewest, patience = np.inf, PATIENCE
    for faces in range(1, MAX_FACES + 1):
        point = task.minimise_on_face(point.x, face)
        following = task.next_face(point, face)
        wrong = np.flatnonzero(face.state != following.state)
        if not wrong.size and task.is_normal(point, face):
            return _check_residual(qp, task, point, faces)
        patience = PATIENCE if wrong.size < fewest else patience - 1
        fewest = min(fewest, wrong.size)
        if patience < 0:
            wrong = wrong[-1:]
        state = face.state.copy()
        state[wrong] = following.state[wrong]
        face = following._replace(state=state)
    raise ArithmeticError(
        "the reference solve of an operator did not find the optimal active set among "
        f"{MAX_FACES} trials"
    )


def _check_residual(qp: QP, task: _Task, point: _Point, faces: int) -> Solution:
    s = Solution(
        status=Status.SOLVED,
        x=task.discs.project(point.x),
        y=point.y,
        z=np.zeros(0),
        z_box=point.z,
        iterations=faces,
        counts={"P_products": task.products},
    )
    worst = relative_residual(qp, s, MAX_REFERENCE_RESIDUAL)
    if not worst <= MAX_REFERENCE_RESIDUAL:
        raise ArithmeticError(
            f"the reference solve of an operator left a KKT residual of {worst:.1e}, "
            f"more than {MAX_REFERENCE_RESIDUAL:g}"
        )
    return s


class _Point(NamedTuple):
    """A point with its multipliers."""

    x: Vector  #: (n,)
    y: Vector  #: (r,) multipliers of Gx = e
    z: Vector  #: (n,) multipliers, normal to the sets; negative at a lower bound


class _Face(NamedTuple):
    """Face, described by components at bounds and by discs with x_I on the boundary."""

    #: (n + k,) states: −1 for a component at its lower bound, 1 for a component at its
    #: upper bound and for a disc with x_I on the boundary, otherwise 0
    state: NDArray[np.int8]
    normal: NDArray[np.float64]  #: (k, d) outward unit normals
    curvature: Vector  #: (k,) η ≥ 0


@dataclass(eq=False)
class _Task:
    """A QP with its preconditioner."""

    F: Callable[[Vector], Vector]
    M: Callable[[Vector], Vector]  #: product with an approximation of F⁻¹
    G: csr_array
    e: Vector
    q: Vector
    lower: Vector
    upper: Vector
    discs: Discs
    length: Vector  #: (k,) γ of each disc, in units of x divided by units of z
    has_kernel: bool  #: True if F is semidefinite
    products: int = 0

    @classmethod
    def of(cls, qp: QP) -> _Task:
        P, diagonal = preconditioned(qp.P), qp.diagonal()
        none = Discs(np.zeros((0, 2), dtype=np.int64), np.zeros(0))
        discs, *others = *qp.sets[1:], none
        if P is None or diagonal is None:
            raise ValueError(
                "the reference solve needs P as a matrix; got an operator without a "
                "diagonal or preconditioners"
            )
        if qp.h.size or len(others) > 1 or not isinstance(discs, Discs):
            raise ValueError(
                "the reference solve of an operator needs a QP with bounds, equality "
                "rows and at most one set of discs"
            )
        return cls(
            lambda x: np.asarray(qp.P @ x),
            P.preconditioner("dirichlet", "stiffness"),
            csr_array(qp.A),
            qp.b,
            qp.q,
            qp.lb,
            qp.ub,
            discs,
            1 / diagonal[discs.index].mean(axis=1),
            is_semidefinite(qp.P),
        )

    def zero_point(self) -> _Point:
        zero = np.zeros(self.q.size)
        return _Point(zero, np.zeros(self.e.size), zero)

    def gradient(self, x: Vector) -> Vector:
        """Return Fx + q."""
        self.products += 1
        return self.F(x) + self.q

    def moving(self, face: _Face) -> tuple[csr_array, Vector]:
        """Return the projector (n, n) onto directions in the face, and an origin (n,).

        The origin contains the fixed components of x; the projection of the origin is
        zero.
        """
        n, (index, radius) = self.q.size, (self.discs.index, self.discs.radius)
        at_bound, sliding = face.state[:n], self.on_disc(face)
        free = (at_bound == 0).astype(float)
        origin = np.where(at_bound < 0, self.lower, self.upper)
        origin[at_bound == 0] = 0.0
        free[index[radius == 0]] = 0.0
        at, normal = index[sliding], face.normal[sliding]
        origin[at] = radius[sliding, None] * normal
        outward = normal[:, :, None] * normal[:, None, :]
        row, column = np.broadcast_arrays(at[:, :, None], at[:, None, :])
        across = csr_array((outward.ravel(), (row.ravel(), column.ravel())), (n, n))
        return csr_array(diags_array(free) - across), origin

    def minimise_on_face(self, x: Vector, face: _Face) -> _Point:
        """Return the minimiser on a face, computed by CG with the starting point x."""
        moving, origin = self.moving(face)
        curvature, on_disc = np.zeros(x.size), self.on_disc(face)
        curvature[self.discs.index] = (face.curvature * on_disc)[:, None]
        columns = csr_array(self.G @ moving)
        try:
            coarse = cholesky(csc_matrix(columns @ columns.T))
        except CholmodNotPositiveDefiniteError:
            raise ArithmeticError(
                "the reference solve of an operator reached a face with linearly "
                "dependent equality rows; a body whose contacts are open on this face "
                "may lack supports"
            ) from None

        def spread(t: Vector) -> Vector:
            """Return Π Gᵀ(G Π Gᵀ)⁻¹t, with the projector Π onto the face."""
            return np.asarray(columns.T @ coarse(t))

        def project(v: Vector) -> Vector:
            v = moving @ v
            return np.asarray(v - spread(self.G @ v))

        def bent(v: Vector) -> Vector:
            """Return the curvature terms of disc boundaries, multiplied by v."""
            return np.asarray(curvature * (moving @ v))

        # M ≈ F⁻¹ is too large an approximation of (F + curvature)⁻¹ if the curvature
        # exceeds F, as on small discs. Along redundant rows (friction on supported
        # nodes), M is zero, but the curvature is not.
        length = np.zeros(x.size)
        length[self.discs.index] = (self.length * on_disc)[:, None]
        soft = 1 / np.sqrt(1 + length * curvature)

        def precondition(v: Vector) -> Vector:
            """Return an approximation of (F + curvature)⁻¹v along the face."""
            return project(soft * (self.M(soft * v) + length * (soft * v)))

        x = origin + moving @ x
        x += spread(self.e - self.G @ x)
        size = np.linalg.norm(project(self.q))

        def residual(x: Vector) -> tuple[Vector, Vector]:
            """Return −(Fx + q), and the part of it that CG reduces to zero."""
            r = -self.gradient(x)
            # the second projection removes the rounding errors of the first projection
            return r, project(project(r - bent(x)))

        r, w = residual(x)
        for _ in range(MAX_CG_ROUNDS):
            if np.linalg.norm(w) <= ROUNDING_RESIDUAL * size:
                break
            better = x + self._correction(w, project, precondition, bent)
            better += spread(self.e - self.G @ better)
            r_better, w_better = residual(better)
            # CG on rounding errors can diverge along redundant rows, where F is zero
            if not np.linalg.norm(w_better) < np.linalg.norm(w):
                break
            x, r, w = better, r_better, w_better
        y = coarse(columns @ (r - bent(x)))
        is_free = face.state[: x.size] == 0
        is_free[self.discs.index[on_disc | (self.discs.radius == 0)]] = False
        return _Point(x, y, np.where(is_free, 0.0, r - np.asarray(self.G.T @ y)))

    def _correction(
        self,
        w: Vector,
        project: Callable[[Vector], Vector],
        precondition: Callable[[Vector], Vector],
        bent: Callable[[Vector], Vector],
    ) -> Vector:
        """Return d in the face with a small 𝒫(w − Fd − bent(d)), computed by CG.

        With redundant rows, F is semidefinite, and directions that consist of rounding
        errors approach its kernel. Therefore the result is then d at the smallest wᵀMw
        if wᵀMw grows by MAX_GROWTH, which exact arithmetic excludes.
        """
        d, enough = np.zeros(w.size), CG_REDUCTION * np.linalg.norm(w)
        p = y = precondition(w)
        wy = float(w @ y)
        best, least = d.copy(), wy
        for _ in range(MAX_CG_STEPS):
            Fp = self.F(p) + bent(p)
            self.products += 1
            curvature = float(p @ Fp)
            if not min(wy, curvature) > 0:  # only rounding errors of redundant rows
                break
            alpha = wy / curvature
            d += alpha * p
            w = w - alpha * project(Fp)
            if np.linalg.norm(w) <= enough:
                break
            y = precondition(w)
            wy, before = float(w @ y), wy
            if wy < least:
                best, least = d.copy(), wy
            elif self.has_kernel and wy > MAX_GROWTH * least:
                return best
            p = y + (wy / before) * p
        return d

    def first_face(self, point: _Point) -> _Face:
        """Return the face that contains `point`, the solution of a similar problem."""
        x, z, index = point.x, point.z, self.discs.index
        at_bound = (z != 0) | (self.lower == self.upper)
        # take the nearer bound instead of the bound that the sign of z indicates,
        # because rounding may change the sign of a multiplier near zero
        below = x - self.lower <= self.upper - x
        at_bound[index] = False
        state = np.where(at_bound, np.where(below, -1, 1), 0)
        normal, _ = self._pushes(point)
        forces, radius = norms(z[index]), self.discs.radius
        on_disc = (forces > 0) & (radius > 0)
        return _Face(
            np.append(state, on_disc).astype(np.int8),
            normal,
            forces / np.where(on_disc, radius, 1.0),
        )

    def next_face(self, point: _Point, face: _Face) -> _Face:
        """Return the face predicted by the signs of multipliers and violated bounds."""
        x, _, z = point
        n, radius = x.size, self.discs.radius
        off_x, off_z = (SIGN_ROUNDING * abs(v).max(initial=0.0) for v in (x, z))
        same, state = self.lower == self.upper, face.state[:n]
        below = np.where(state < 0, (z <= off_z) | same, x < self.lower - off_x)
        above = np.where(state > 0, z >= -off_z, x > self.upper + off_x) & ~below
        normal, push = self._pushes(point)
        slack = np.where(self.on_disc(face), -off_z * self.length, off_x)
        pushed = (push > radius + slack) & (radius > 0)
        safe = np.where(radius > 0, radius, 1.0)
        curvature = np.maximum(push / safe - 1, 0) / self.length
        state = above.astype(np.int8) - below.astype(np.int8)
        return _Face(np.append(state, pushed).astype(np.int8), normal, curvature)

    def on_disc(self, face: _Face) -> Mask:
        """Return the mask (k,) of discs that are linearised on their boundary."""
        return np.asarray(face.state[self.q.size :] > 0)

    def is_normal(self, point: _Point, face: _Face) -> bool:
        """Return True if x_I is normal to each linearised disc, up to `MAX_TURN`."""
        on, across = self.on_disc(face), np.asarray(self.moving(face)[0] @ point.x)
        turn = norms(across[self.discs.index])[on] / self.discs.radius[on]
        return bool(turn.max(initial=0.0) <= MAX_TURN)

    def _pushes(self, point: _Point) -> tuple[NDArray[np.float64], Vector]:
        """Return w/‖w‖ (k, d) and ‖w‖ (k,) for w = x_I + γz_I of each disc."""
        index = self.discs.index
        w = point.x[index] + self.length[:, None] * point.z[index]
        size = norms(w)
        return w / np.where(size > 0, size, 1.0)[:, None], size
