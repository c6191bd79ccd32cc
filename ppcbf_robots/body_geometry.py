"""Collision shapes cut into small convex pieces, so that "a ball contains the shape" becomes a finite check.

A piece is the convex hull of a few vertices, grown by a radius. A ball about c with radius R contains it if and only
if ``|x - c| + growth <= R`` for each of its vertices x. Lengths are metres, all in one frame fixed to the
joint that carries the shape.
"""

from __future__ import annotations

import functools
import hashlib
import itertools
from collections.abc import Iterable
from dataclasses import dataclass

import coal
import numpy as np
import pinocchio as pin

from ppcbf_robots.specs import Array

SPACING = 0.006  # [m], longest edge of a piece; a seam between two balls costs at most about half of it
SPACING_SHARE = 0.012  # of the longest extent: on large links the pieces are longer
SIDES = 36  # patches around a cylinder


class UnknownShapeError(ValueError):
    """A shape that is neither a primitive of URDF nor made of triangles."""


@dataclass(frozen=True)
class Pieces:
    """Convex pieces whose union contains a surface, and points of that surface."""

    vertices: Array  # (pieces, V, 3); fewer than V are repeated
    growth: Array  # (pieces,)
    samples: Array  # (samples, 3) on the surface; none for shapes that have a growth

    def required(self, centers: Array) -> Array:
        """(pieces, k): least radius of a ball about each of ``centers`` (k, 3) that contains each piece."""
        columns = [np.linalg.norm(self.vertices - c, axis=2).max(axis=1) + self.growth for c in centers]
        return np.stack(columns, axis=1)

    @functools.cached_property
    def extent(self) -> Array:
        """(3,): lengths along the principal axes, falling."""
        points = self.vertices.reshape(-1, 3)
        along = points @ principal_axes(points).T
        grown = np.repeat(self.growth, self.vertices.shape[1])[:, None]
        return np.sort((along + grown).max(axis=0) - (along - grown).min(axis=0))[::-1]


def principal_axes(points: Array) -> Array:
    """(3, 3): axes of the points' (N, 3) covariance as rows, that of the largest spread first, of definite sign."""
    off = points - points.mean(axis=0)
    axes = np.linalg.eigh(off.T @ off)[1].T[::-1]
    return np.asarray(axes * np.sign(axes[np.arange(3), np.abs(axes).argmax(axis=1)])[:, None])


def digest(shapes: Iterable[pin.GeometryObject]) -> str:
    """SHA-256 over joints, placements, kinds, dimensions, vertices and triangles."""
    found = hashlib.sha256()
    for o in shapes:
        found.update(f"{int(o.parentJoint)} {type(o.geometry).__name__}".encode())
        found.update(np.ascontiguousarray(o.placement.homogeneous, dtype=float).tobytes())
        for array in _description(o.geometry):
            found.update(f"{array.shape}".encode() + np.ascontiguousarray(array, dtype=float).tobytes())
    return found.hexdigest()


def pieces_of(shapes: Iterable[pin.GeometryObject], frame: pin.SE3 | None = None) -> Pieces:
    """Pieces of all ``shapes``, which one joint carries, in that joint's frame or a ``frame`` fixed to it.

    Raises:
        UnknownShapeError: for a shape without triangles that is no box, sphere, cylinder or capsule.
    """
    objects = list(shapes)
    spacing = max([SPACING, *(SPACING_SHARE * longest(o.geometry) for o in objects)])
    frame = pin.SE3.Identity() if frame is None else frame
    return _joined([_placed(_pieces(o.geometry, spacing), frame.actInv(o.placement)) for o in objects])


def longest(shape: coal.CollisionGeometry) -> float:
    """Longest edge [m] of a shape's bounding box in its own frame."""
    shape.computeLocalAABB()
    return float((shape.aabb_local.max_ - shape.aabb_local.min_).max())


def _description(shape: coal.CollisionGeometry) -> list[Array]:
    match shape:
        case coal.Box():
            return [np.asarray(shape.halfSide)]
        case coal.Sphere():
            return [np.array([shape.radius])]
        case coal.Cylinder() | coal.Capsule():
            return [np.array([shape.radius, shape.halfLength])]
    return list(_triangles(shape))


def _pieces(shape: coal.CollisionGeometry, spacing: float) -> Pieces:
    none = np.zeros((0, 3))
    match shape:
        case coal.Sphere():
            return Pieces(np.zeros((1, 1, 3)), np.array([float(shape.radius)]), none)
        case coal.Capsule():
            z = np.linspace(-shape.halfLength, shape.halfLength, 2 + int(2.0 * shape.halfLength / spacing))
            line = np.stack([np.zeros_like(z), np.zeros_like(z), z], axis=1)
            return Pieces(np.stack([line[:-1], line[1:]], axis=1), np.full(len(z) - 1, float(shape.radius)), none)
        case coal.Cylinder():
            return _cylinder(float(shape.radius), float(shape.halfLength), spacing)
        case coal.Box():
            vertices, faces = _box(np.asarray(shape.halfSide))
        case _:
            vertices, faces = _triangles(shape)
    cut = _subdivided(vertices[faces.astype(int)], spacing)
    return Pieces(cut, np.zeros(len(cut)), cut.mean(axis=1))


def _triangles(shape: coal.CollisionGeometry) -> tuple[Array, Array]:
    """Vertices (N, 3) and triangles (M, 3) of a mesh, as Pinocchio has read and scaled it."""
    match shape:
        case coal.BVHModelBase():
            faces = [[shape.tri_indices(i)[k] for k in range(3)] for i in range(shape.num_tris)]
            vertices = np.asarray(shape.vertices())
        case coal.ConvexBase() if hasattr(shape, "polygons"):
            faces = [[shape.polygons(i)[k] for k in range(3)] for i in range(shape.num_polygons)]
            vertices = np.asarray(shape.points())
        case _:
            raise UnknownShapeError(f"a {type(shape).__name__} cannot be covered with spheres")
    if not faces or not np.all(np.isfinite(vertices)):
        raise UnknownShapeError("a mesh without triangles, or with vertices that are not finite")
    return vertices, np.array(faces, dtype=float)


def _box(half: Array) -> tuple[Array, Array]:
    corners = half * np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
    quads = [[0, 1, 3, 2], [4, 5, 7, 6], [0, 1, 5, 4], [2, 3, 7, 6], [0, 2, 6, 4], [1, 3, 7, 5]]
    return corners, np.array([t for a, b, c, d in quads for t in ([a, b, c], [a, c, d])], dtype=float)


def _cylinder(radius: float, half: float, spacing: float) -> Pieces:
    """Patches of the side and sectors of both ends; where tangents meet, a corner outside keeps the arc inside."""
    turn = np.linspace(0.0, 2.0 * np.pi, SIDES + 1)
    ring = radius * np.stack([np.cos(turn), np.sin(turn)], axis=1)
    middle = 0.5 * (turn[:-1] + turn[1:])
    corner = radius / np.cos(np.pi / SIDES) * np.stack([np.cos(middle), np.sin(middle)], axis=1)
    arcs = np.stack([ring[:-1], corner, ring[1:]], axis=1)  # (SIDES, 3, 2)
    z = np.linspace(-half, half, 2 + int(2.0 * half / spacing))
    rows = 2 + int(radius / spacing)
    side = [_lifted(arcs, a, arcs, b) for a, b in itertools.pairwise(z)]
    rings = [share * arcs for share in np.linspace(0.0, 1.0, rows)]
    ends = [_lifted(a, end, b, end) for end in (-half, half) for a, b in itertools.pairwise(rings)]
    vertices = np.concatenate(side + ends)
    return Pieces(vertices, np.zeros(len(vertices)), vertices[:, [0, 2, 3, 5]].mean(axis=1))


def _lifted(lower: Array, z_lower: float, upper: Array, z_upper: float) -> Array:
    """(SIDES, 6, 3) from two plane arcs (SIDES, 3, 2) and their heights."""
    heights = np.full((SIDES, 3, 1), z_lower), np.full((SIDES, 3, 1), z_upper)
    return np.concatenate([np.concatenate([lower, heights[0]], 2), np.concatenate([upper, heights[1]], 2)], axis=1)


def _subdivided(triangles: Array, spacing: float) -> Array:
    """The same surface in triangles (N, 3, 3) without an edge longer than ``spacing``: the longest is halved."""
    done = []
    while len(triangles):
        edges = np.linalg.norm(triangles - np.roll(triangles, -1, axis=1), axis=2)  # (N, 3), from k to k + 1
        longest = edges.argmax(axis=1)
        small = edges.max(axis=1) <= spacing
        done.append(triangles[small])
        order = (longest[~small, None] + np.arange(3)) % 3
        a, b, c = np.moveaxis(np.take_along_axis(triangles[~small], order[:, :, None], axis=1), 1, 0)
        middle = 0.5 * (a + b)
        triangles = np.concatenate([np.stack([a, middle, c], 1), np.stack([middle, b, c], 1)])
    return np.concatenate(done) if done else np.zeros((0, 3, 3))


def _placed(pieces: Pieces, placement: pin.SE3) -> Pieces:
    R, t = placement.rotation, placement.translation
    return Pieces(pieces.vertices @ R.T + t, pieces.growth, pieces.samples @ R.T + t)


def _joined(parts: list[Pieces]) -> Pieces:
    width = max(p.vertices.shape[1] for p in parts)
    padded = [p.vertices[:, np.minimum(np.arange(width), p.vertices.shape[1] - 1)] for p in parts]
    return Pieces(
        np.concatenate(padded), np.concatenate([p.growth for p in parts]), np.concatenate([p.samples for p in parts])
    )
