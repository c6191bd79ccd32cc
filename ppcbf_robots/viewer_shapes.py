"""What robots and obstacles look like: coal's shapes as meshcat geometries; a robot's in one list per joint.

Meshes come from Pinocchio, which has read and scaled them whatever their format; meshcat only draws triangles.
"""

from __future__ import annotations

from dataclasses import dataclass

import coal
import numpy as np
import pinocchio as pin
from meshcat import geometry as mg

from ppcbf_robots.robot import RobotModel
from ppcbf_robots.specs import Array

_SEGMENTS = 40  # around an axis
_OCTAHEDRON = np.concatenate([np.eye(3), -np.eye(3)])
_OCTAHEDRON_FACES = np.array([[0, 1, 2], [1, 3, 2], [3, 4, 2], [4, 0, 2], [1, 0, 5], [3, 1, 5], [4, 3, 5], [0, 4, 5]])


@dataclass(frozen=True)
class Part:
    """A shape fixed to a joint."""

    joint: int
    shape: mg.Geometry
    placement: Array  # (4, 4) in the joint's frame


def robot_parts(robot: RobotModel, tip_joint: int, tip: Array) -> list[Part]:
    """Visual geometry, else collision geometry, else bones between the joints and out to the tip.

    Args:
        robot: the model.
        tip_joint: joint that carries the end effector.
        tip: end effector in that joint's frame (3,) [m].
    """
    for kind in (pin.GeometryType.VISUAL, pin.GeometryType.COLLISION):
        try:
            objects = list(robot.geometry(kind).geometryObjects)
        except (ValueError, RuntimeError):  # a mesh is missing or cannot be read
            continue
        if objects:
            return [Part(int(o.parentJoint), drawable(o.geometry), o.placement.homogeneous) for o in objects]
    return _bones(robot, tip_joint, tip)


def drawable(shape: coal.CollisionGeometry) -> mg.Geometry:
    """A box, sphere, cylinder, capsule, convex hull or triangle mesh for meshcat, in the same frame."""
    match shape:
        case coal.Box():
            return mg.Box([float(2.0 * x) for x in shape.halfSide])
        case coal.Sphere():
            return ball(float(shape.radius))
        case coal.Cylinder():
            return _cylinder(float(shape.radius), float(shape.halfLength))
        case coal.Capsule():
            return _capsule(float(shape.radius), float(shape.halfLength))
        case coal.Convex():
            return _faceted(shape)
    triangles = (shape.tri_indices(i) for i in range(shape.num_tris))
    return mg.TriangularMeshGeometry(shape.vertices(), np.array([[t[0], t[1], t[2]] for t in triangles]))


def align(direction: Array, origin: Array) -> Array:
    """Placement (4, 4) at ``origin`` whose z axis points along ``direction``."""
    rotation = pin.Quaternion.FromTwoVectors(np.array([0.0, 0.0, 1.0]), np.asarray(direction, float)).matrix()
    return np.asarray(pin.SE3(rotation, np.asarray(origin, float)).homogeneous)


def _faceted(shape: coal.Convex) -> mg.Geometry:
    """Every triangle with corners of its own, so that the shading keeps the edges."""
    faces = [shape.polygons(i) for i in range(shape.num_polygons)]
    corners = np.asarray(shape.points())[[k for f in faces for k in (f[0], f[1], f[2])]]
    return mg.TriangularMeshGeometry(corners, np.arange(len(corners)).reshape(-1, 3))


def ball(radius: float) -> mg.Geometry:
    """A sphere [m], finer than meshcat's own."""
    return _capsule(radius, 0.0)


def beads(points: Array, radius: float, colors: Array) -> mg.TriangularMeshGeometry:
    """One small octahedron per point (N, 3) in one mesh, coloured by row (N, 3) in [0, 1]."""
    vertices = points[:, None, :] + radius * _OCTAHEDRON
    faces = _OCTAHEDRON_FACES + len(_OCTAHEDRON) * np.arange(len(points))[:, None, None]
    corner_colors = np.repeat(colors, len(_OCTAHEDRON), axis=0)
    return mg.TriangularMeshGeometry(vertices.reshape(-1, 3), faces.reshape(-1, 3), corner_colors)


def floor_grid(center: Array, radius: float) -> mg.PointsGeometry:
    """Ends of lines at z = 0 around ``center`` (3,), ..., 0.01, 0.1, 1, ... m apart as suits ``radius`` [m]."""
    step = 10.0 ** np.floor(np.log10(radius))
    middle, half = np.round(center[:2] / step) * step, step * np.ceil(1.6 * radius / step)
    offsets = np.arange(-half, half + 0.5 * step, step)
    lines = [[sign * half, x] for x in offsets for sign in (-1.0, 1.0)]
    flat = np.concatenate([lines, np.flip(lines, axis=1)]) + middle
    return mg.PointsGeometry(np.concatenate([flat, np.zeros((len(flat), 1))], axis=1).T.astype(np.float32))


def _cylinder(radius: float, half_length: float) -> mg.Geometry:
    """About z; the rims stand twice so that the shading keeps their edges."""
    return _revolve(radius * np.array([0, 1, 1, 1, 1, 0]), half_length * np.array([-1, -1, -1, 1, 1, 1]))


def _capsule(radius: float, half_length: float) -> mg.Geometry:
    angle = np.linspace(-np.pi / 2.0, np.pi / 2.0, _SEGMENTS // 2)  # an even number: no ring lies on the equator
    return _revolve(radius * np.cos(angle), radius * np.sin(angle) + half_length * np.sign(angle))


def _revolve(radius: Array, z: Array) -> mg.Geometry:
    """Surface swept by a profile (N,), (N,) [m] about the z axis."""
    turn = np.linspace(0.0, 2.0 * np.pi, _SEGMENTS, endpoint=False)
    ring = np.stack([np.cos(turn), np.sin(turn)], axis=1)
    xy = radius[:, None, None] * ring
    vertices = np.concatenate([xy, np.broadcast_to(z[:, None, None], (len(z), _SEGMENTS, 1))], axis=2)
    i = np.arange(len(z) - 1)[:, None] * _SEGMENTS
    a, b = i + np.arange(_SEGMENTS), i + (np.arange(_SEGMENTS) + 1) % _SEGMENTS
    faces = np.stack([np.stack([a, b, b + _SEGMENTS], -1), np.stack([a, b + _SEGMENTS, a + _SEGMENTS], -1)])
    return mg.TriangularMeshGeometry(vertices.reshape(-1, 3), faces.reshape(-1, 3))


def _bones(robot: RobotModel, tip_joint: int, tip: Array) -> list[Part]:
    model = robot.model
    ends = [(int(model.parents[j]), np.array(model.jointPlacements[j].translation)) for j in range(1, model.njoints)]
    ends.append((tip_joint, np.asarray(tip, float)))
    reach = sum(float(np.linalg.norm(end)) for _, end in ends)
    parts = []
    for joint, end in ends:
        length = float(np.linalg.norm(end))
        if length > 1e-6:
            parts.append(Part(joint, _cylinder(0.015 * reach, 0.5 * length), align(end, 0.5 * end)))
    return parts
