"""Second-order cones ‖x_T‖ ≤ μ x_N of contact forces: Coulomb's law in 3D."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csc_array

from mortarbench.harness.sets.blocks import Blocks, norms
from mortarbench.harness.sets.convex import Limits, Vector

_ANGLES = np.arange(16) * np.pi / 8
#: (16, 2) tangential directions of the normals at the apex of a cone in 3D; their hull
#: contains 98 % of the directions of the polar cone in each plane
_DIRECTIONS = np.stack([np.cos(_ANGLES), np.sin(_ANGLES)], axis=1)


@dataclass(frozen=True, eq=False)
class Cones(Blocks):
    """Cones ‖x_T‖ ≤ slope[i]·x_N and x_N ≥ 0, with N = index[i, 0], T = index[i, 1:].

    Slope 0 means contact without friction: x_T = 0 and x_N ≥ 0. The normal vector
    `z_box` is in the polar cone, slope·‖z_T‖ ≤ −z_N, and orthogonal to x.

    Parameters
    ----------
    index : (k, d) variables of each cone, counted from 0, with the normal component
        first; d ≥ 2, and no variable occurs twice
    slope : (k,) coefficient of friction μ, finite and not negative

    Raises
    ------
    InputError
        If the shapes do not match, an index is not an integer, or a slope is negative
        or not finite.

    Examples
    --------
    >>> import numpy as np
    >>> from mortarbench import Cones
    >>> cones = Cones(index=[[0, 1, 2]], slope=[1.0])
    >>> cones.project(np.array([0.0, 3.0, 4.0]))
    array([2.5, 1.5, 2. ])
    >>> cones.project(np.array([-5.0, 3.0, 4.0]))  # in the polar cone
    array([0., 0., 0.])

    """

    index: NDArray[np.int64]  #: (k, d) variables, the normal component first
    slope: Vector  #: (k,) coefficients of friction

    prefix: ClassVar[str] = "cone"
    least: ClassVar[int] = 2
    columns: ClassVar[str] = "1 + tangents"

    def hull(self, n: int) -> tuple[Vector, Vector]:
        """Return the bounds x_N ≥ 0, and x_T = 0 for cones of slope 0."""
        lower, upper = np.full(n, -np.inf), np.full(n, np.inf)
        lower[self.index[:, 0]] = 0.0
        flat = self.index[self.slope == 0, 1:]
        lower[flat], upper[flat] = 0.0, 0.0
        return lower, upper

    def project(self, x: Vector) -> Vector:
        """Project x (n,) onto the cones; points of polar cones move to the apex."""
        nearest = x.copy()
        normal, tangent = x[self.index[:, 0]], x[self.index[:, 1:]]
        parts = _projection(normal, tangent, np.ones_like(self.slope), self.slope)
        nearest[self.index[:, 0]], nearest[self.index[:, 1:]] = parts
        return nearest

    def limits(self, x: Vector) -> list[Limits]:
        """Return the slacks μx_N − ‖x_T‖ of all cones, followed by the slacks x_N."""
        normal, tangents = x[self.index[:, 0]], norms(x[self.index[:, 1:]])
        pull, zero = self.slope * normal, np.zeros_like(normal)
        first = self.index[:, 0]
        return [
            Limits("cone", pull - tangents, zero, np.abs(pull) + tangents, first),
            Limits("normal of a cone", normal, zero, np.abs(normal), first),
        ]

    def admissible(self, z: Vector) -> Vector:
        """Return the projection of z (n,) onto the polar cones."""
        part = np.zeros_like(z)
        normal, tangent = z[self.index[:, 0]], z[self.index[:, 1:]]
        against, along = _projection(
            -normal, tangent, self.slope, np.ones_like(self.slope)
        )
        part[self.index[:, 0]], part[self.index[:, 1:]] = -against, along
        return part

    def support(self, z: Vector) -> float:
        """Return 0, the supremum of zᵀy over the cones, for z in the polar cones."""
        return 0.0

    def support_gaps(
        self, x: Vector, z: Vector, limits: Sequence[Limits]
    ) -> list[Vector]:
        """Evaluate −zᵀx for each cone, with the admissible part of z."""
        return [-(self.admissible(z) * x)[self.index].sum(axis=1)]

    def normals(
        self, x: Vector, force: Vector | None = None
    ) -> tuple[csc_array, Vector]:
        """Return outward normals (n, j) at x (n,), and their slacks (j,).

        They are the directions (−μ, t)/√(1 + μ²), where t is x_T/‖x_T‖ or one of the
        `_DIRECTIONS`; if a force (n,) is given, t is its direction instead. All of them
        are normal at the apex. The slack is that of a plane that touches the cone,
        (μx_N − tᵀx_T)/√(1 + μ²).
        """
        k, d = self.index.shape
        tangents = (x if force is None else force)[self.index[:, 1:]]
        sizes = norms(tangents)[:, None]
        along = tangents / np.where(sizes > 0, sizes, 1)
        fixed = _DIRECTIONS if d == 3 else np.vstack([np.eye(d - 1), -np.eye(d - 1)])
        fixed = fixed if force is None else fixed[:0]
        t = np.stack([along, *np.broadcast_to(fixed[:, None], (len(fixed), k, d - 1))])
        mu = np.broadcast_to(self.slope[None, :, None], (len(t), k, 1))
        outward = np.concatenate([-mu, t], axis=2) / np.hypot(1, mu)
        outward[np.broadcast_to(mu == 0, outward.shape)] = 0  # slope 0: −x_N alone
        outward[..., 0] = np.where(mu[..., 0] == 0, -1, outward[..., 0])
        index = np.broadcast_to(self.index, outward.shape)
        column = np.repeat(np.arange(len(t) * k), d)
        normals = csc_array(
            (outward.ravel(), (index.ravel(), column)), shape=(x.size, len(t) * k)
        )
        return normals, -(normals.T @ x)

    def substituted(self, T: Any, a: Vector) -> Cones:
        """Return the cones of all x' such that x = T x' + a is in these cones.

        Raises
        ------
        ValueError
            If T scales the tangential components of a cone differently or reverses its
            normal component, or if a is nonzero on a cone.

        """
        columns, entries = self.entries(T, a)
        normal, tangents = entries[:, 0], np.abs(entries[:, 1:])
        if (tangents != tangents[:, :1]).any() or (normal < 0).any():
            raise ValueError("Cones cannot be scaled unevenly or reversed")
        return Cones(columns, self.slope * normal / tangents[:, 0])


def _projection(
    normal: Vector, tangent: Vector, a: Vector, b: Vector
) -> tuple[Vector, Vector]:
    """Project normals n (k,) and tangents t (k, d − 1) onto cones a‖t‖ ≤ bn, n ≥ 0.

    The polar cones are b‖t‖ ≤ −an.

    a, b : (k,) nonnegative, not both zero
    """
    sizes, root = norms(tangent), np.hypot(a, b)
    is_inside = (a * sizes <= b * normal) & (normal >= 0)
    is_polar = b * sizes <= -a * normal
    along = np.where(is_polar, 0.0, (a / root) * normal + (b / root) * sizes)
    factor = np.divide(
        (b / root) * along, sizes, out=np.zeros_like(sizes), where=sizes > 0
    )
    return (
        np.where(is_inside, normal, (a / root) * along),
        np.where(is_inside[:, None], tangent, factor[:, None] * tangent),
    )
