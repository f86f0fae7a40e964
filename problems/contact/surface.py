"""Contact sides in the current configuration: facets, normals and nodal areas.

In the plane, facets are the segments of a chain of nodes.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mortarbench.harness import InputError, Vector
from mortarbench.problems.fem.mesh import Nodes, as_vectors, nodal_lengths

Points = NDArray[np.float64]  #: (…, dim), m or dimensionless

#: segments shorter than this times the longest of their chain count as points: the
#: direction of their edge is rounding
MIN_RELATIVE_LENGTH = 1e-12


@dataclass(frozen=True, eq=False)
class Surface:
    """Facets with the body on their left; facets of zero length are left out.

    A segment with the unit tangent t has the outward normal (t_y, −t_x). The normal of
    a node is the normalised sum of the normals of its segments, one at an end of the
    chain and two elsewhere (the averaged nodal normal of Popp, Gee and Wall 2009, in
    two dimensions and without weights).
    """

    x: Points  #: (v, dim) nodes, m
    facets: Nodes  #: (f, 2) first and second node of each segment
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
        """Nodal areas ∫N_j (v,); in the plane lengths, m."""
        return nodal_lengths(self.x)

    @property
    def extent(self) -> float:
        """Diagonal of the bounding box of the nodes, m."""
        return float(np.linalg.norm(np.ptp(self.x, axis=0)))


def current_surface(points: Points, u: Vector, chain: Nodes, name: str) -> Surface:
    """Return the surface of a chain of nodes at X + u.

    Parameters
    ----------
    points : (N, dim) reference positions X, m
    u : (n,) displacement, m
    chain : (v,) nodes, the body on their left
    name : name of the side, for messages

    Raises
    ------
    InputError
        When a position is not finite or no segment has a length.

    """
    return surface(current_positions(points, u, chain, name), name)


def current_positions(points: Points, u: Vector, nodes: Nodes, name: str) -> Points:
    """Return X + u of some nodes, (len(nodes), dim); raise InputError unless finite."""
    x = points[nodes] + as_vectors(u, points.shape[1])[nodes]
    if not np.isfinite(x).all():
        k = int(np.flatnonzero(~np.isfinite(x).all(axis=1))[0])
        raise InputError(
            f"contact {name}: node {nodes[k]} is at {x[k].tolist()}, expected a "
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
            f"contact {name}: {len(x)} node(s) and no segment of positive length, "
            "expected a chain of at least two nodes"
        )
    normal = -tangents(edge[first] / length[first, None])[:, 0]
    # nodes of skipped segments take the normals of the nearest segments left
    after = np.searchsorted(first, np.arange(len(x)))
    before = np.maximum(after - 1, 0)
    after = np.minimum(after, len(first) - 1)
    mean = normal[before] + normal[after]
    facets = np.stack([first, first + 1])
    return Surface(x, facets.T, normal, unit(mean, normal[before]))


def tangents(normal: Points) -> Points:
    """Return unit tangents (…, dim − 1, dim) of normals (…, dim).

    In the plane, the normal rotated anticlockwise by a right angle, (−n_y, n_x).
    """
    return np.stack([-normal[..., 1], normal[..., 0]], axis=-1)[..., None, :]


def unit(vectors: Points, otherwise: Points) -> Points:
    """Normalise vectors (…, dim) of order one; replace zero vectors by `otherwise`.

    The sum of two opposite normals is zero: there the chain folds back onto itself.
    """
    length = np.sqrt(np.einsum("...x,...x->...", vectors, vectors))[..., None]
    vanishes = length <= MIN_RELATIVE_LENGTH
    return np.where(vanishes, otherwise, vectors / np.where(vanishes, 1.0, length))
