"""Obstacles as shapes of the coal library, and points on their surfaces, for whoever draws or measures them."""

from __future__ import annotations

import coal
import numpy as np

from ppcbf_robots.errors import InputError
from ppcbf_robots.specs import Array
from ppcbf_robots.world import Box, Capsule, ConvexMesh, Cylinder, Sphere

Solid = Sphere | Box | Capsule | Cylinder | ConvexMesh  # every obstacle that ends somewhere

FLAT = 1e-5  # least over largest width of a mesh; qhull crashes the process on flatter ones
MIN_WIDTH = 1e-6  # [m]
FARTHEST = 1e4  # [m]; farther than any arm reaches
_RING = 48  # points around an axis


def coal_shape(obstacle: Solid) -> tuple[coal.CollisionGeometry, Array]:
    """The obstacle without its margin as coal geometry, and its placement (4, 4) in the base frame [m].

    Raises:
        InputError: if a mesh is flat, or its file was not read (see :func:`ppcbf_robots.world_files.load.load_world`).
    """
    if isinstance(obstacle, Sphere):
        return coal.Sphere(obstacle.radius), _placement(np.eye(3), np.asarray(obstacle.center))
    rotation, origin = obstacle.rotation, np.asarray(obstacle.xyz)
    match obstacle:
        case Box():
            return coal.Box(*obstacle.size), _placement(rotation, origin)
        case Capsule():
            return coal.Capsule(obstacle.radius, obstacle.length), _placement(rotation, origin)
        case Cylinder():
            return coal.Cylinder(obstacle.radius, obstacle.length), _placement(rotation, origin)
    shape, center = convex(_vertices(obstacle), f"obstacle '{obstacle.name}'")
    return shape, _placement(rotation, origin + rotation @ center)


def surface_points(obstacle: Solid) -> Array:
    """Points (N, 3) [m] in the base frame whose convex hull is the obstacle, up to 0.3 % of a radius inside it."""
    if isinstance(obstacle, Sphere):
        return np.asarray(obstacle.center) + obstacle.radius * _ball()
    match obstacle:
        case Box():
            corners = np.array(np.meshgrid(*[(-0.5, 0.5)] * 3)).reshape(3, -1).T
            points = corners * np.asarray(obstacle.size)
        case Capsule():
            ball = _ball()
            points = obstacle.radius * ball + 0.5 * obstacle.length * np.sign(ball) * [0.0, 0.0, 1.0]
        case Cylinder():
            z = np.repeat([-0.5 * obstacle.length, 0.5 * obstacle.length], _RING)
            points = np.column_stack([np.tile(obstacle.radius * _circle(), (2, 1)), z])
        case ConvexMesh():
            points = _vertices(obstacle)
    return np.asarray(points @ obstacle.rotation.T + np.asarray(obstacle.xyz))


def convex(points: Array, where: str) -> tuple[coal.Convex, Array]:
    """Convex hull of points (N, 3) about their middle, and that middle (3,) in the frame of the points [m].

    Raises:
        InputError: beginning with ``where``, for numbers that are not finite and for a hull without volume.
    """
    if not np.all(np.isfinite(points)):
        raise InputError(f"{where}: a vertex of the mesh is not finite")
    size = float(np.abs(points).max(initial=0.0))
    if size > FARTHEST:  # qhull crashes the process on very large numbers
        raise InputError(f"{where}: the mesh reaches {size:.3g} m from its origin; check its scale")
    points = np.unique(points, axis=0)
    if len(points) < 4:
        raise InputError(f"{where}: a solid needs at least 4 different vertices, this mesh has {len(points)}")
    center = 0.5 * (points.min(axis=0) + points.max(axis=0))
    centered = points - center
    axes = np.linalg.svd(centered - centered.mean(axis=0), full_matrices=False)[2]
    widths = np.ptp(centered @ axes.T, axis=0)
    if widths[2] < max(FLAT * widths[0], MIN_WIDTH):
        raise InputError(f"{where}: the mesh is flat ({widths[2]:.1g} m thick); a solid has a volume")
    cloud = coal.StdVec_Vec3s()
    for point in centered:
        cloud.append(point)
    try:
        return coal.Convex.convexHull(cloud, True, "Qt"), center
    except (ValueError, RuntimeError) as error:
        raise InputError(f"{where}: the mesh has no convex hull ({' '.join(str(error).split())[-120:]})") from None


def _vertices(mesh: ConvexMesh) -> Array:
    if mesh.vertices is None:
        raise InputError(f"obstacle '{mesh.name}': its file '{mesh.file}' was not read; load the world with load_world")
    return np.asarray(mesh.scale * np.array(mesh.vertices, dtype=float).reshape(-1, 3))


def _circle() -> Array:
    turn = np.linspace(0.0, 2.0 * np.pi, _RING, endpoint=False)
    return np.column_stack([np.cos(turn), np.sin(turn)])


def _ball() -> Array:
    """Points on the unit sphere in rings about z, with poles; twice on the equator, for the two halves of a capsule."""
    up = np.linspace(0.0, np.pi / 2.0, _RING // 4 + 1)
    up[0] = 1e-9  # so that the equator's ring knows to which half it belongs
    rings = [np.column_stack([np.cos(a) * _circle(), np.full(_RING, np.sin(a))]) for a in (*-up, *up)]
    return np.concatenate(rings)


def _placement(rotation: Array, origin: Array) -> Array:
    placement = np.eye(4)
    placement[:3, :3], placement[:3, 3] = rotation, origin
    return placement
