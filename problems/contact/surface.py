"""Contact sides in the current configuration: facets, normals and nodal areas.

In 2D, facets are the segments of a chain of nodes; in 3D, facets are the faces of
cells.

For closest points, facets are divided into simplices, on which shape functions are
linear. A segment is a simplex; a quadrilateral face is divided into four triangles
about the mean of its corners, with shape functions that are ¼ at the centre. Thus the
surface is continuous, and integrals over overlaps of two sides are exact. On plane
faces, the integrals ∫N_j equal those of the bilinear shape functions.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

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
_CORNERS = np.eye(4)
#: (4, 3, 4) shape functions at the vertices of the triangles of a quadrilateral
_QUAD = np.array(
    [[_CORNERS[k], _CORNERS[(k + 1) % 4], np.full(4, 0.25)] for k in range(4)]
)
#: (3, 4) shape functions at the vertices of a triangular face, which is stored with its
#: last corner repeated
_TRIANGLE = _CORNERS[:3]
#: the closest points on two facets are the same point of a common border if their
#: distance, relative to the radius of a facet, is below this value; closest points
#: within this distance, in barycentric coordinates, of a vertex are moved to the vertex
SAME_POINT = 1e-9
#: number of pairs of points and facets up to which all are compared, because the import
#: of a search tree takes 0.1 s
MAX_PAIRS = 10**5
#: relative tolerance for rounding of distances
ROUNDING = 1e-12


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


class ClosestPoints(NamedTuple):
    """Closest points of s positions on a contact side."""

    facet: Nodes  #: (s,) facet that contains the closest point
    simplex: Nodes  #: (s,) simplex of this facet
    N: NDArray[np.float64]  #: (s, c) shape functions of the facet at the closest point
    normal: Points  #: (s, dim) outward unit normal of the side at the closest point
    #: (s,) distance along the side by which a point is beyond its border, m; else 0
    beyond: Vector


class Simplices(NamedTuple):
    """Simplices of the facets of a contact side, with dim vertices each."""

    surface: Surface
    centre: Points  #: (f, dim) means of the corners of each facet, m
    radius: Vector  #: (f,) largest distance of a corner from the centre, m
    number: Nodes  #: (f,) number of simplices of each facet, 1 or 4
    facet: Nodes  #: (t,) facet of each simplex, ascending
    #: (t, dim, c) shape functions of the facet at the vertices of the simplex
    shape: NDArray[np.float64]
    vertices: Points  #: (t, dim, dim) positions of the vertices, m

    @property
    def normals(self) -> Points:
        """Unit normals of the simplices, (t, dim)."""
        if self.vertices.shape[1] == 2:
            return self.surface.normal
        a, b = (self.vertices[:, k] - self.vertices[:, 0] for k in (1, 2))
        return unit_vectors(np.cross(a, b))

    @property
    def border(self) -> NDArray[np.bool_]:
        """Mask (t, dim) of the borders of simplices that bound a single facet.

        In 3D, border k is the edge from vertex k to k + 1. In 2D, it is vertex k, and
        only the two ends of the chain bound a single segment.
        """
        facets = self.surface.facets
        if facets.shape[1] == 2:
            ends = np.zeros(facets.shape, dtype=bool)
            ends[0, 0] = ends[-1, 1] = True
            return ends
        node = np.take_along_axis(facets[self.facet], self.shape.argmax(axis=2), axis=1)
        node[self.shape.max(axis=2) < 1] = -1  # the centre of a quadrilateral
        low, high = np.sort(np.stack([node, np.roll(node, -1, axis=1)]), axis=0)
        edge = low * len(self.surface.x) + high
        _, place, count = np.unique(edge, return_inverse=True, return_counts=True)
        once = (count == 1)[place].reshape(edge.shape)
        return np.asarray(once & (low >= 0))

    def of_facets(self, facets: Nodes) -> tuple[Nodes, Nodes]:
        """Return the simplices (k,) of the given facets (p,).

        The second result (k,) is the index in `facets` of the facet of each simplex.
        """
        count = self.number[facets]
        place = np.repeat(np.arange(len(facets)), count)
        offset = np.arange(len(place)) - np.repeat(np.cumsum(count) - count, count)
        return np.searchsorted(self.facet, facets)[place] + offset, place


def divided(surface: Surface) -> Simplices:
    """Divide the facets of a surface into simplices."""
    facets = surface.facets
    is_quad = facets[:, -2] != facets[:, -1]
    number, at = np.ones(len(facets), dtype=np.int64), surface.x[facets]
    centre, shape = at.mean(axis=1), np.broadcast_to(np.eye(2), (len(facets), 2, 2))
    if facets.shape[1] > 2:
        number[is_quad] = 4
        centre = np.where(is_quad[:, None], centre, at[:, :3].mean(axis=1))
    facet = np.repeat(np.arange(len(number)), number)
    if facets.shape[1] > 2:
        k = np.arange(len(facet)) - np.repeat(np.cumsum(number) - number, number)
        shape = np.where(is_quad[facet, None, None], _QUAD[k], _TRIANGLE)
    radius = np.linalg.norm(at - centre[:, None], axis=2).max(axis=1)
    vertices = np.einsum("tvc,tcx->tvx", shape, at[facet])
    return Simplices(surface, centre, radius, number, facet, shape, vertices)


def closest_points(x: Points, side: Simplices) -> ClosestPoints:
    """Return the closest points of x (s, dim) on a side, with outward normals.

    If several facets are equally close up to rounding, the first one is selected.
    """
    # `nearest` is the distance to the closest centre of a facet. Facets contain their
    # centres, so the distance to the closest point is at most `nearest`. The distance
    # to the centre of the facet that contains this point is larger by at most the
    # radius of the facet
    if len(x) * len(side.centre) <= MAX_PAIRS:
        apart = np.linalg.norm(x[:, None] - side.centre, axis=2)
        nearest = apart.min(axis=1)
        reach = nearest * (1 + SAME_POINT) + side.radius.max()
        near, candidate = np.nonzero(apart <= reach[:, None])
    else:
        from scipy.spatial import KDTree

        tree = KDTree(side.centre)
        nearest, _ = tree.query(x)
        reach = nearest * (1 + SAME_POINT) + side.radius.max()
        found = tree.query_ball_point(x, reach, return_sorted=True)
        candidate = np.concatenate([np.asarray(k, dtype=np.int64) for k in found])
        near = np.repeat(np.arange(len(x)), [len(k) for k in found])
    t, pair = side.of_facets(candidate)
    node = near[pair]
    coordinates = closest_in_simplices(x[node], side.vertices[t])
    at = np.einsum("pv,pvx->px", coordinates, side.vertices[t])
    distance = np.linalg.norm(at - x[node], axis=1)
    first = np.flatnonzero(np.diff(node, prepend=-1))
    least = np.minimum.reduceat(distance, first)[node]
    close = np.flatnonzero(distance <= least * (1 + ROUNDING))
    best = close[np.unique(node[close], return_index=True)[1]]
    # average the normals of all facets that meet at the closest point
    same = np.linalg.norm(at - at[best][node], axis=1)
    meets = same <= SAME_POINT * side.radius[side.facet[t]]
    touching = np.unique(np.stack([node, side.facet[t]])[:, meets], axis=1)
    total = np.zeros_like(x)
    np.add.at(total, touching[0], side.surface.normal[touching[1]])
    facet = side.facet[t[best]]
    normal = unit(total, side.surface.normal[facet])
    # components of x − x_c outwards, along the facets whose border contains x_c
    vertices = side.vertices[t]
    edges = np.roll(vertices, -1, axis=1) - vertices
    if x.shape[1] == 2:
        outwards = -unit_vectors(edges)  # away from the other vertex
    else:
        outwards = unit_vectors(np.cross(edges, side.normals[t, None]))
    opposite = np.roll(coordinates, 1 - x.shape[1], axis=1)
    on_border = side.border[t] & (opposite <= 0) & meets[:, None]
    excess = np.einsum("pkx,px->pk", outwards, x[node] - at)
    excess[~on_border | (excess <= SAME_POINT * side.radius[side.facet[t], None])] = 0
    beyond = np.zeros(len(x))
    np.maximum.at(beyond, node, excess.max(axis=1))
    # snap to vertices, so that rows do not depend on the rounding of coordinates
    inner = np.where(coordinates[best] <= SAME_POINT, 0.0, coordinates[best])
    inner = np.where(inner >= 1 - SAME_POINT, 1.0, inner)
    N = np.einsum("sv,svc->sc", inner, side.shape[t[best]])
    return ClosestPoints(facet, t[best], N, normal, beyond)


def projected(x: Points, simplex: Points) -> NDArray[np.float64]:
    """Return barycentric coordinates (p, dim) of the projections of x (p, dim).

    Points are projected onto the lines (2D) or planes (3D) of the simplices.

    simplex : (p, dim, dim) vertices
    """
    edges = np.roll(simplex, -1, axis=1) - simplex  # edge k from vertex k to k + 1
    offset = x[:, None] - simplex
    if x.shape[1] == 2:
        square = np.einsum("px,px->p", edges[:, 0], edges[:, 0])
        along = np.einsum("px,px->p", offset[:, 0], edges[:, 0]) / square
        return np.stack([1 - along, along], axis=-1)
    normal = np.cross(edges[:, 0], edges[:, 1])
    square = np.einsum("px,px->p", normal, normal)[:, None]
    # the barycentric coordinate of vertex k + 2 is the area over edge k
    parts = np.einsum("pkx,px->pk", np.cross(edges, offset), normal) / square
    return np.roll(parts, 2, axis=1)


def closest_in_simplices(x: Points, simplex: Points) -> NDArray[np.float64]:
    """Return barycentric coordinates (p, dim) of the closest points of x (p, dim).

    In a triangle, the closest point is the foot of the perpendicular if the foot is
    inside, and otherwise the closest point of the nearest edge.

    simplex : (p, dim, dim) vertices
    """
    foot = projected(x, simplex)
    if x.shape[1] == 2:
        return np.clip(foot, 0.0, 1.0)
    edges = np.roll(simplex, -1, axis=1) - simplex  # edge k from vertex k to k + 1
    offset = x[:, None] - simplex
    length = np.einsum("pkx,pkx->pk", edges, edges)
    along = np.clip(np.einsum("pkx,pkx->pk", offset, edges) / length, 0.0, 1.0)
    away = offset - along[..., None] * edges
    k = np.einsum("pkx,pkx->pk", away, away).argmin(axis=1)
    p = np.arange(len(x))
    on_edge = np.zeros((len(x), 3))
    on_edge[p, k], on_edge[p, (k + 1) % 3] = 1 - along[p, k], along[p, k]
    inside = np.asarray((foot >= 0).all(axis=1))
    return np.where(inside[:, None], foot, on_edge)


def unit_vectors(v: Points) -> Points:
    """Normalise vectors (…, dim)."""
    return np.asarray(v / np.linalg.norm(v, axis=-1, keepdims=True))
