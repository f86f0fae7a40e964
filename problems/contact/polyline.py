"""A contact side in the current configuration: segments and normals of its chain."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mortarbench.harness import InputError, Vector
from mortarbench.problems.fem.mesh import Nodes, as_vectors

Points = NDArray[np.float64]  #: (…, 2), m or dimensionless

#: a segment this much shorter than the longest of its chain has no direction
DEGENERATE = 1e-12


@dataclass(frozen=True, eq=False)
class Polyline:
    """A chain of nodes with its body on the left; segments without length are left out.

    With the unit tangent t of a segment its outward normal is (t_y, −t_x). The normal
    of a node is the normalised sum of those of the segments before and after it, at an
    end of the chain that of the only one (Popp, Gee and Wall 2009, their averaged
    nodal normal, in two dimensions and without weights).
    """

    x: Points  #: (v, 2) nodes, m
    first: Nodes  #: (e,) first node of each segment; first + 1 is the second
    normal: Points  #: (e, 2) outward unit normals of the segments
    node_normal: Points  #: (v, 2) averaged outward unit normals of the nodes

    @property
    def start(self) -> Points:
        """First end of each segment, (e, 2)."""
        return self.x[self.first]

    @property
    def end(self) -> Points:
        """Second end of each segment, (e, 2)."""
        return self.x[self.first + 1]

    @property
    def extent(self) -> float:
        """Diagonal of the box around the chain, m."""
        return float(np.linalg.norm(np.ptp(self.x, axis=0)))


def current_polyline(points: Points, u: Vector, chain: Nodes, name: str) -> Polyline:
    """Place a chain of nodes at X + u.

    Parameters
    ----------
    points : (N, 2) reference positions X, m
    u : (2N,) displacement, m
    chain : (v,) nodes, the body on their left
    name : of the side, for the message

    Raises
    ------
    InputError
        When a position is not finite or no segment has a length.

    """
    return polyline(current_positions(points, u, chain, name), name)


def current_positions(points: Points, u: Vector, nodes: Nodes, name: str) -> Points:
    """Return X + u of some nodes, (len(nodes), 2); refuse what is not finite."""
    x = points[nodes] + as_vectors(u)[nodes]
    if not np.isfinite(x).all():
        k = int(np.flatnonzero(~np.isfinite(x).all(axis=1))[0])
        raise InputError(
            f"contact {name}: node {nodes[k]} is at {x[k].tolist()}, expected a "
            "finite position"
        )
    return x


def polyline(x: Points, name: str) -> Polyline:
    """Compute segments and normals of a chain (v, 2)."""
    edge = np.diff(x, axis=0)
    length = np.sqrt(np.einsum("ex,ex->e", edge, edge))
    first = np.flatnonzero(length > DEGENERATE * length.max(initial=0.0))
    if not len(first):
        raise InputError(
            f"contact {name}: {len(x)} node(s) and no segment of positive length, "
            "expected a chain of at least two nodes"
        )
    tangent = edge[first] / length[first, None]
    normal = np.column_stack([tangent[:, 1], -tangent[:, 0]])
    after = np.searchsorted(first, np.arange(len(x)))
    before = np.maximum(after - 1, 0)
    after = np.minimum(after, len(first) - 1)
    mean = normal[before] + normal[after]
    return Polyline(x, first, normal, unit(mean, normal[before]))


def unit(vectors: Points, otherwise: Points) -> Points:
    """Normalise vectors (…, 2) of order one; those that vanish become `otherwise`.

    Two opposite normals have no mean: there the chain folds back onto itself, and
    the caller says which normal stands in.
    """
    length = np.sqrt(np.einsum("...x,...x->...", vectors, vectors))[..., None]
    vanishes = length <= DEGENERATE
    return np.where(vanishes, otherwise, vectors / np.where(vanishes, 1.0, length))


def cross(a: Points, b: Points) -> Vector:
    """Return a_x b_y − a_y b_x of vectors (…, 2)."""
    product: Vector = a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]
    return product
