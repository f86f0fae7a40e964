"""Contact sides in the current configuration: facets, normals and nodal areas.

In 2D, facets are the segments of a chain of nodes; in 3D, facets are the faces of
cells.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from mortarbench.harness import InputError, Vector
from mortarbench.problems.fem.mesh import Nodes, as_vectors, nodal_areas

Points = NDArray[np.float64]  #: (…, dim) positions in m, or dimensionless vectors

#: segments shorter than this fraction of the longest segment of their chain count as
#: points, because their direction is dominated by rounding; likewise, faces with an
#: area below this fraction of the largest one, and sums of unit normals shorter than
#: this value count as zero
MIN_RELATIVE_LENGTH = 1e-12


@dataclass(frozen=True, eq=False)
class Surface:
    """Facets with the body on their left; segments of zero length are dropped.

    A segment with the unit tangent t has the outward normal (t_y, −t_x). The normal of
    a face is that of the plane through the midpoints of its edges. The normal of a node
    is the normalised sum of the normals of its facets (the averaged nodal normal of
    Popp, Gee and Wall 2009, without weights). In 2D, a node at an end of the
    chain has one facet, any other node has two.
    """

    x: Points  #: (v, dim) nodes, m
    #: first and second node (f, 2) of each segment, or corners (f, 4) of each face
    facets: Nodes
    normal: Points  #: (f, dim) outward unit normals of the facets
    node_normal: Points  #: (v, dim) averaged outward unit normals of the nodes

    @property
    def start(self) -> Points:
        """Position of the first node of each segment, (f, dim)."""
        return self.x[self.facets[:, 0]]

    @property
    def end(self) -> Points:
        """Position of the second node of each segment, (f, dim)."""
        return self.x[self.facets[:, 1]]

    @property
    def tangents(self) -> Points:
        """Unit tangents at the nodes, (v, dim − 1, dim)."""
        return tangents(self.node_normal)

    @property
    def areas(self) -> Vector:
        """Nodal ∫N_j (v,): lengths in m (2D), or areas in m² (3D)."""
        return self.areas_in(np.ones(len(self.facets), dtype=bool))

    @property
    def radius(self) -> Vector:
        """Largest distance of a corner from the centre of a facet of each node (v,), m.

        In 2D, this is half the length of the longer segment.
        """
        corners, radius = self.x[self.facets], np.zeros(len(self.x))
        offset = corners - corners.mean(axis=1, keepdims=True)
        largest = np.linalg.norm(offset, axis=2).max(axis=1)
        np.maximum.at(radius, self.facets, largest[:, None])
        return radius

    def areas_in(self, part: NDArray[np.bool_]) -> Vector:
        """Return ∫N_j (v,) over the facets in a mask (f,); see `areas`."""
        areas = np.zeros(len(self.x))
        nodes, values = nodal_areas(self.x, self.facets[part])
        areas[nodes] = values
        return areas

    def part(self, facets: NDArray[np.bool_]) -> Surface:
        """Return the facets in a mask (f,), with the nodes and normals of the side."""
        return replace(self, facets=self.facets[facets], normal=self.normal[facets])

    @property
    def extent(self) -> float:
        """Diagonal of the bounding box of the nodes, m."""
        return float(np.linalg.norm(np.ptp(self.x, axis=0)))


@dataclass(frozen=True)
class Reach:
    """Limits on the angle between the normals, and on the distance, of two sides."""

    #: largest n_s·n_m of the normals of slave and master; −½ admits normals that are at
    #: most 60° from opposite
    cosine: float = -0.5
    #: largest distance, m; None selects the larger extent of the two sides
    distance: float | None = None

    def __post_init__(self) -> None:
        if not -1 <= self.cosine <= 1:
            raise InputError(f"reach: cosine={self.cosine} must be in [-1, 1]")
        if self.distance is not None and not self.distance > 0:
            raise InputError(f"reach: distance={self.distance} m must be positive")

    def max_distance(self, slave: Surface, master: Surface) -> float:
        """Return the largest distance allowed between two sides, m."""
        if self.distance is not None:
            return self.distance
        return max(slave.extent, master.extent)


def current_surface(points: Points, u: Vector, side: Nodes, name: str) -> Surface:
    """Return the surface of a side at X + u.

    Parameters
    ----------
    points : (N, dim) reference positions X, m
    u : (n,) displacement, m
    side : chain (v,) of nodes, or faces (f, 4); see `Mesh`
    name : name of the side, for messages

    Raises
    ------
    InputError
        If a position is not finite, all segments have zero length, or a face has zero
        area.

    """
    if side.ndim == 1:
        return surface(current_positions(points, u, side, name), name)
    nodes, faces = np.unique(side, return_inverse=True)
    x = current_positions(points, u, nodes, name)
    return faceted_surface(x, faces.reshape(side.shape), name)


def current_positions(points: Points, u: Vector, nodes: Nodes, name: str) -> Points:
    """Return the positions X + u of `nodes` (k,), (k, dim).

    Raises
    ------
    InputError
        If a position is not finite.

    """
    x = points[nodes] + as_vectors(u, points.shape[1])[nodes]
    if not np.isfinite(x).all():
        k = int(np.flatnonzero(~np.isfinite(x).all(axis=1))[0])
        raise InputError(
            f"contact {name}: node {nodes[k]} is at {x[k].tolist()}; expected a "
            "finite position"
        )
    return x


def surface(x: Points, name: str) -> Surface:
    """Return the segments and normals of a chain at positions x (v, 2)."""
    edge = np.diff(x, axis=0)
    length = np.sqrt(np.einsum("ex,ex->e", edge, edge))
    first = np.flatnonzero(length > MIN_RELATIVE_LENGTH * length.max(initial=0.0))
    if not len(first):
        raise InputError(
            f"contact {name}: {len(x)} node(s) and no segment of positive length; "
            "expected a chain of at least two nodes"
        )
    normal = -tangents(edge[first] / length[first, None])[:, 0]
    # nodes of dropped segments have the normals of the nearest remaining segments
    after = np.searchsorted(first, np.arange(len(x)))
    before = np.maximum(after - 1, 0)
    after = np.minimum(after, len(first) - 1)
    mean = normal[before] + normal[after]
    facets = np.stack([first, first + 1])
    return Surface(x, facets.T, normal, unit(mean, normal[before]))


def faceted_surface(x: Points, faces: Nodes, name: str) -> Surface:
    """Return the faces (f, 4) and normals of a side in 3D at positions x (v, 3)."""
    a, b, c, d = np.moveaxis(x[faces], 1, 0)
    area = np.cross(c - a, d - b)  # twice the area vector, also for triangles (c = d)
    size = np.linalg.norm(area, axis=1, keepdims=True)
    flat = size[:, 0] <= MIN_RELATIVE_LENGTH * size.max(initial=0.0)
    if flat.any():
        raise InputError(
            f"contact {name}: the face around {x[faces[flat.argmax()]].mean(axis=0)} "
            "has no area; expected faces with distinct corners"
        )
    normal = area / size
    mean = np.zeros_like(x)
    np.add.at(mean, faces[:, :3], normal[:, None])
    is_quad = faces[:, 2] != faces[:, 3]
    np.add.at(mean, faces[is_quad, 3], normal[is_quad])
    of_node = np.zeros_like(x)
    of_node[faces] = normal[:, None]
    return Surface(x, faces, normal, unit(mean, of_node))


def tangents(normal: Points) -> Points:
    """Return unit tangents (…, dim − 1, dim) of unit normals (…, dim).

    In 2D, the tangent is the normal rotated anticlockwise by a right angle,
    (−n_y, n_x). In 3D, there are two orthogonal tangents, which are −e_x and −e_y
    for the normal e_z (Duff et al., Building an orthonormal basis, revisited, J.
    Comput. Graph. Tech. 6, 2017).
    """
    if normal.shape[-1] == 2:
        return np.stack([-normal[..., 1], normal[..., 0]], axis=-1)[..., None, :]
    x, y, z = np.moveaxis(normal, -1, 0)
    sign = np.copysign(1.0, z)
    a = -1 / (sign + z)
    first = -1 - sign * x * x * a, -sign * x * y * a, sign * x
    second = -x * y * a, -sign - y * y * a, y
    return np.stack([np.stack(first, axis=-1), np.stack(second, axis=-1)], axis=-2)


def unit(vectors: Points, otherwise: Points) -> Points:
    """Normalise vectors (…, dim) of order one; replace zero vectors by `otherwise`.

    The sum of two opposite normals is zero where a chain folds back onto itself.
    """
    length = np.sqrt(np.einsum("...x,...x->...", vectors, vectors))[..., None]
    vanishes = length <= MIN_RELATIVE_LENGTH
    return np.where(vanishes, otherwise, vectors / np.where(vanishes, 1.0, length))
