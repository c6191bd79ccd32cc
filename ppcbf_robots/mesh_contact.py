"""Whether a link's mesh itself touches an obstacle, where a simulator knows only the mesh's convex hull.

The hull fills hollows and spans between protrusions, so it can touch where the link does not. The body spheres are
fitted to the mesh, since that is the robot; a contact of the hull alone says nothing against them.
"""

from __future__ import annotations

from collections.abc import Sequence

import coal
import numpy as np

from ppcbf_robots.specs import Array
from ppcbf_robots.world import Box, Capsule, ConvexMesh, Cylinder, HalfSpace, Obstacle, Sphere


class MeshContact:
    """Tests meshes against the obstacles of a world, by name."""

    def __init__(self, obstacles: Sequence[Obstacle]) -> None:
        self._obstacles = {o.name: o for o in obstacles}
        self._solids: dict[str, tuple[coal.CollisionGeometry, coal.Transform3s]] = {}

    def touches(self, mesh: coal.BVHModelBase, rotation: Array, xyz: Array, obstacle: str) -> bool:
        """Whether some triangle of the mesh, placed in the base frame, meets the solid obstacle."""
        if obstacle not in self._solids:
            self._solids[obstacle] = _solid(self._obstacles[obstacle])
        shape, place = self._solids[obstacle]
        found = coal.CollisionResult()
        coal.collide(mesh, coal.Transform3s(rotation, xyz), shape, place, coal.CollisionRequest(), found)
        return bool(found.isCollision())


def _solid(o: Obstacle) -> tuple[coal.CollisionGeometry, coal.Transform3s]:
    """An obstacle as coal's shape and its placement in the base frame."""
    match o:
        case Sphere():
            return coal.Sphere(o.radius), coal.Transform3s(np.eye(3), np.array(o.center))
        case HalfSpace():
            return coal.Halfspace(np.array(o.normal), o.offset), coal.Transform3s(np.eye(3), np.zeros(3))
    return _shape(o), coal.Transform3s(o.rotation, np.array(o.xyz))


def _shape(o: Box | Capsule | Cylinder | ConvexMesh) -> coal.CollisionGeometry:
    match o:
        case Box():
            return coal.Box(*o.size)
        case Capsule():
            return coal.Capsule(o.radius, o.length)
        case Cylinder():
            return coal.Cylinder(o.radius, o.length)
    points = coal.StdVec_Vec3s()
    for vertex in o.vertices or []:
        points.append(o.scale * np.array(vertex))
    return coal.Convex.convexHull(points, True, "Qt")
