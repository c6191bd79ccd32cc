"""Obstacles as arrays for the compiled geometry, their motion, and how far smoothing keeps the arm away."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import ConvexHull, QhullError

from ppcbf_robots import kernels
from ppcbf_robots.errors import InputError
from ppcbf_robots.specs import Array
from ppcbf_robots.world import Box, Capsule, ConvexMesh, Cylinder, HalfSpace, Obstacle, Sphere

EDGE = 0.01  # [m], rho of boxes, capsules and cylinders: the width over which an edge is rounded
MESH_GAP = 0.005  # [m], how far a convex mesh's smooth maximum lies below the distance to its faces
EDGE_STEP = 0.3  # [rad], between neighbouring supporting planes around an edge of a convex mesh
ROTATION_TOLERANCE = 1e-3  # of RᵀR - 1, for matrices from a tracker
DIRECTIONS = 162  # supporting planes of a convex mesh besides its faces: they round its corners


@dataclass(frozen=True)
class Motion:
    """How an obstacle moves at this instant, in the base frame. What is None stays as in the world's file."""

    xyz: Array | None = None  # (3,) position of its origin (a sphere's centre) [m]
    rotation: Array | None = None  # (3, 3)
    velocity: Array = field(default_factory=lambda: np.zeros(3))  # of that origin [m/s]
    acceleration: Array = field(default_factory=lambda: np.zeros(3))  # of that origin [m/s²]
    angular_velocity: Array = field(default_factory=lambda: np.zeros(3))  # [rad/s], taken as constant


@dataclass(frozen=True)
class Packed:
    """All obstacles of a world as arrays, one row each; see :mod:`ppcbf_robots.kernels`."""

    names: tuple[str, ...]
    kinds: NDArray[np.int64]  # (O,)
    sizes: Array  # (O, 4)
    margins: Array  # (O,) [m]
    planes: Array  # (all planes, 4) of convex meshes
    plane_start: NDArray[np.int64]  # (O + 1,)
    frames: Array  # (O, 3, 4) rotation and origin in the base frame
    motions: Array  # (O, 3, 3) velocity and acceleration of the origin, angular velocity

    def moved(self, motions: Mapping[str, Motion]) -> Packed:
        """The same obstacles, some of them elsewhere and moving.

        Raises:
            InputError: for a name that is not in the world, or what is not a motion: other shapes, numbers that are not
                finite, a matrix that does not rotate.
        """
        frames, rates = self.frames.copy(), self.motions.copy()
        if not isinstance(motions, Mapping):
            raise InputError(f"motions: expected a Motion by obstacle name, got {type(motions).__name__}")
        for name, motion in motions.items():
            if name not in self.names:
                raise InputError(f"no obstacle is named '{name}' (obstacles: {', '.join(self.names)})")
            if not isinstance(motion, Motion):
                raise InputError(f"obstacle '{name}': expected a Motion, got {type(motion).__name__}")
            o = self.names.index(name)
            if motion.rotation is not None:
                frames[o, :, :3] = R = _finite(name, "rotation", motion.rotation, (3, 3))
                if np.abs(R.T @ R - np.eye(3)).max() > ROTATION_TOLERANCE or np.linalg.det(R) < 0.0:
                    raise InputError(f"obstacle '{name}': rotation is not a rotation matrix")
            if motion.xyz is not None:
                frames[o, :, 3] = _finite(name, "xyz", motion.xyz, (3,))
            for i, what in enumerate(("velocity", "acceleration", "angular_velocity")):
                rates[o, i] = _finite(name, what, getattr(motion, what), (3,))
        return dataclasses.replace(self, frames=frames, motions=rates)

    def distance(self, o: int, p: Array) -> float:
        """Smoothed distance [m] of a point (3,) in the base frame to obstacle o, margin not counted."""
        x, y, z = self.frames[o, :, :3].T @ (p - self.frames[o, :, 3])
        return float(self.core(o, (x, y, z), (0.0, 0.0, 0.0))[0])

    def core(self, o: int, x: kernels.Vector, w: kernels.Vector) -> kernels.Core:
        """:func:`ppcbf_robots.kernels.core` of obstacle o, for a point and its velocity in the obstacle's frame."""
        first, end = int(self.plane_start[o]), int(self.plane_start[o + 1])
        return kernels.core(int(self.kinds[o]), x, w, self.sizes[o], self.planes, first, end)


def _finite(name: str, what: str, value: ArrayLike, shape: tuple[int, ...]) -> Array:
    """Finite numbers of a shape, or an InputError that names the obstacle."""
    try:
        x = np.asarray(value, dtype=float)
    except (TypeError, ValueError):
        x = np.zeros(0)
    if x.shape != shape or not np.all(np.isfinite(x)):
        raise InputError(f"obstacle '{name}': {what} must be finite numbers of shape {shape}")
    return x


def pack(obstacles: Sequence[Obstacle]) -> Packed:
    """Obstacles as arrays; InputError for a mesh that has no volume."""
    planes = [_planes(o) if isinstance(o, ConvexMesh) else np.zeros((0, 4)) for o in obstacles]
    kinds, sizes = zip(*(_size(o, len(k)) for o, k in zip(obstacles, planes, strict=True)), strict=True)
    count = len(obstacles)
    return Packed(
        names=tuple(o.name for o in obstacles),
        kinds=np.array(kinds, dtype=np.int64),
        sizes=np.array([np.pad(np.asarray(s, float), (0, 4 - len(s))) for s in sizes]),
        margins=np.array([o.margin for o in obstacles]),
        planes=np.concatenate(planes),
        plane_start=np.concatenate([[0], np.cumsum([len(k) for k in planes])]).astype(np.int64),
        frames=np.array([_frame(o) for o in obstacles]),
        motions=np.zeros((count, 3, 3)),
    )


def smoothing_gap(obstacle: Obstacle) -> float:
    """Largest amount [m] by which a point at the obstacle's surface is taken to be inside it."""
    match obstacle:
        case Box():
            return 0.5 * (math.sqrt(3.0) - 1.0) * _rho(*obstacle.size)
        case Cylinder():
            return 0.5 * (math.sqrt(2.0) - 1.0) * _rho(2.0 * obstacle.radius, obstacle.length)
        case Capsule():
            return 0.5 * _rho(2.0 * obstacle.radius, obstacle.length)
        case ConvexMesh():
            return MESH_GAP
    return 0.0


def _rho(*widths: float) -> float:
    return min(EDGE, *(0.5 * w for w in widths))


def _size(o: Obstacle, planes: int) -> tuple[int, list[float]]:
    match o:
        case Sphere():
            return kernels.SPHERE, [o.radius]
        case HalfSpace():
            return kernels.HALF_SPACE, []
        case Box():
            return kernels.BOX, [*(0.5 * x for x in o.size), _rho(*o.size)]
        case Capsule():
            return kernels.CAPSULE, [o.radius, 0.5 * o.length, _rho(2.0 * o.radius, o.length)]
        case Cylinder():
            return kernels.CYLINDER, [o.radius, 0.5 * o.length, _rho(2.0 * o.radius, o.length)]
    return kernels.MESH, [math.log(planes) / MESH_GAP]


def _frame(o: Obstacle) -> Array:
    if isinstance(o, Sphere):
        return np.column_stack([np.eye(3), o.center])
    if isinstance(o, HalfSpace):
        z = np.asarray(o.normal)
        x = np.cross(z, np.eye(3)[int(np.argmin(np.abs(z)))])
        x /= np.linalg.norm(x)
        return np.column_stack([x, np.cross(z, x), z, o.offset * z])
    return np.column_stack([o.rotation, o.xyz])


def _planes(mesh: ConvexMesh) -> Array:
    """Supporting planes (m, 4) of the hull: its faces, normals turned from face to face around its edges, and others.

    The largest distance over all supporting planes is the distance to the hull. Faces and edges are met by planes of
    their own, corners by directions spread over the sphere.
    """
    if mesh.vertices is None:
        raise InputError(f"obstacle '{mesh.name}': its mesh file was not read; load the world with `load_world`")
    vertices = np.asarray(mesh.vertices)
    try:
        hull = ConvexHull(vertices)
    except (QhullError, ValueError):
        raise InputError(f"obstacle '{mesh.name}': its vertices span no volume; give it some thickness") from None
    faces = hull.equations[:, :3]
    i = np.arange(DIRECTIONS) + 0.5
    z, turn = 1.0 - 2.0 * i / DIRECTIONS, np.pi * (1.0 + math.sqrt(5.0)) * i
    around = np.sqrt(1.0 - z * z)
    spread = np.column_stack([around * np.cos(turn), around * np.sin(turn), z])
    normals = np.concatenate([faces, *_edge_normals(faces, hull.neighbors), spread])
    normals = np.unique(np.round(normals, 9), axis=0)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return np.column_stack([normals, (vertices @ normals.T).max(axis=0)])


def _edge_normals(faces: Array, neighbors: NDArray[np.int32]) -> list[Array]:
    """Directions (k, 3) between the normals of every two neighbouring faces that differ by more than EDGE_STEP."""
    found = []
    for i, row in enumerate(neighbors):
        for j in row[row > i]:
            angle = math.acos(float(np.clip(faces[i] @ faces[j], -1.0, 1.0)))
            t = np.linspace(0.0, 1.0, 1 + math.ceil(angle / EDGE_STEP))[1:-1, None]
            if len(t):
                found.append(np.sin((1.0 - t) * angle) * faces[i] + np.sin(t * angle) * faces[j])
                found[-1] /= math.sin(angle)
    return found
