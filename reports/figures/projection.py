"""Surfaces of three-dimensional bodies, projected orthographically onto the picture."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from mortarbench.harness import Vector
from mortarbench.reports.figures.fields import ColourScale, Faces

Points = NDArray[np.float64]  #: (…, 3)
Integers = NDArray[np.int64]

#: direction of a camera that sees three sides of a box at different angles
_STANDARD = np.array([0.62, -0.64, 0.45])
#: approximate number of tiles on the visible surface; with fewer tiles, steps between
#: colours would be visible
_TILES = 12_000
_MAX_TILES = 20  #: largest number of tiles along an edge of a face


class Camera(NamedTuple):
    """An orthographic camera, given by a right-handed system of unit vectors."""

    right: Vector
    up: Vector
    towards: Vector  #: direction from the bodies to the camera

    def project(self, points: Points) -> NDArray[np.float64]:
        """Return the positions (…, 2) of points in the picture."""
        return np.stack([points @ self.right, points @ self.up], axis=-1)


def camera_towards(direction: Vector) -> Camera:
    """Return a camera in a given direction from the bodies, with z up if possible."""
    towards = direction / np.linalg.norm(direction)
    vertical = np.eye(3)[2 if abs(towards[2]) < 0.9 else 1]
    right = np.cross(vertical, towards)
    right /= np.linalg.norm(right)
    return Camera(right, np.cross(towards, right), towards)


def camera_seeing(normal: Vector) -> Camera:
    """Return a camera, oblique to all axes, that sees a side with outward `normal`."""
    away = (np.abs(normal) > 0.5) & (normal * _STANDARD < 0)
    return camera_towards(np.where(away, -_STANDARD, _STANDARD))


def camera_above(normal: Vector) -> Camera:
    """Return a camera that looks down from the side to which a normal points."""
    return camera_seeing(normal * [1, 1, 0])


def face_normals(points: Points, faces: Integers) -> Points:
    """Return normals (k, 3) of faces (k, 4); the length of each is twice the area."""
    a, b, c, d = np.moveaxis(points[faces], 1, 0)
    return np.asarray(np.cross(c - a, d - b))


def visible_faces(
    camera: Camera,
    points: Points,
    faces: Integers,
    values: Vector,
    scale: ColourScale,
    *,
    mesh: bool,
) -> Faces:
    """Divide the faces (k, 4) towards the camera into tiles, sorted back to front.

    A face may be large compared with the distance between bodies. Sorting whole faces
    by depth could then draw hidden parts on top. Sorting tiles avoids this error.

    values : (N,) values at the nodes, shown as colours and bilinear within faces
    mesh : True to outline each face
    """
    visible = faces[face_normals(points, faces) @ camera.towards > 0]
    tiles = int(np.clip(np.sqrt(_TILES / max(len(visible), 1)), 1, _MAX_TILES))
    ends = np.linspace(0, 1, tiles + 1)
    corners, middles = _bilinear(ends, ends), _bilinear(ends[:-1] + 0.5 / tiles)
    number = np.arange((tiles + 1) ** 2).reshape(tiles + 1, tiles + 1)
    around = np.stack(
        [number[:-1, :-1], number[1:, :-1], number[1:, 1:], number[:-1, 1:]], axis=-1
    ).reshape(-1, 4)
    grid = np.einsum("ta,kax->ktx", corners, points[visible])  # (k, (tiles + 1)², 3)
    at = grid[:, around].reshape(-1, 4, 3)
    colours = np.einsum("ta,ka->kt", middles, values[visible]).ravel()
    depth = (at @ camera.towards).mean(axis=1)
    if mesh:
        # pieces of the outline of a face, each with the depth of the tile beside it, so
        # that nearer tiles of other faces cover it
        sides = np.stack([number[:, 0], number[-1], number[::-1, -1], number[0, ::-1]])
        start, end = sides[:, :-1].ravel(), sides[:, 1:].ravel()
        pieces = grid[:, np.stack([start, end, end, start], axis=-1)].reshape(-1, 4, 3)
        edge = np.arange(tiles)
        beside = np.concatenate(
            [
                edge * tiles,
                (tiles - 1) * tiles + edge,
                edge[::-1] * tiles + tiles - 1,
                edge[::-1],
            ]
        )
        after = depth.reshape(len(visible), -1)[:, beside].ravel()
        at, depth = np.concatenate([at, pieces]), np.append(depth, after)
        colours = np.append(colours, np.full(len(pieces), np.nan))
    order = np.argsort(depth, kind="stable")  # outlines after their tiles
    return Faces(corners=camera.project(at[order]), values=colours[order], scale=scale)


def _bilinear(x: Vector, y: Vector | None = None) -> NDArray[np.float64]:
    """Return bilinear shape functions (nx·ny, 4) on the grid of x and y in [0, 1]."""
    x, y = np.meshgrid(x, x if y is None else y, indexing="ij")
    x, y = x.ravel(), y.ravel()
    return np.stack([(1 - x) * (1 - y), x * (1 - y), x * y, (1 - x) * y], axis=-1)


def crease_edges(
    camera: Camera, points: Points, faces: Integers, least: float
) -> NDArray[np.float64]:
    """Return the edges (e, 2, 2) in the picture at which faces meet at an angle.

    Edges of faces that all point away from the camera are left out.

    least : smallest angle, rad; edges of a single face always count as creases
    """
    normal = face_normals(points, faces)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    ends = np.stack([faces, np.roll(faces, -1, axis=1)], axis=-1).reshape(-1, 2)
    face = np.repeat(np.arange(len(faces)), 4)
    real = ends[:, 0] != ends[:, 1]
    edge, place, count = np.unique(
        np.sort(ends[real], axis=1), axis=0, return_inverse=True, return_counts=True
    )
    order = np.argsort(place.ravel(), kind="stable")
    first = np.cumsum(count) - count
    one, other = face[real][order[first]], face[real][order[first + count - 1]]
    bends = np.einsum("ex,ex->e", normal[one], normal[other]) < np.cos(least)
    seen = np.maximum(normal[one] @ camera.towards, normal[other] @ camera.towards) > 0
    return np.asarray(camera.project(points)[edge[(bends | (count == 1)) & seen]])
