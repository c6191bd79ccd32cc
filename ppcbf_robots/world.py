"""What users write about the surroundings: obstacles in the robot's base frame, in metres and radians."""

from __future__ import annotations

import math
from typing import Annotated, Literal

import numpy as np
from pydantic import Field, field_validator, model_validator

from ppcbf_robots.specs import Array, NonNegative, Positive, Spec, Vector3


class _Named(Spec):
    """What all obstacles have."""

    name: str
    margin: NonNegative = 0.0  # [m], kept free around the obstacle


class _Posed(_Named):
    """An obstacle with a frame of its own at ``xyz``, turned by ``rpy`` (fixed axes, as in URDF) or a quaternion."""

    xyz: Vector3 = [0.0, 0.0, 0.0]  # noqa: RUF012 - pydantic copies it
    rpy: Vector3 | None = None  # [rad]
    quat_xyzw: Annotated[list[float], Field(min_length=4, max_length=4)] | None = None

    @model_validator(mode="after")
    def _one_rotation(self) -> _Posed:
        if self.rpy is not None and self.quat_xyzw is not None:
            raise ValueError("give rpy or quat_xyzw, not both")
        if self.quat_xyzw is not None and abs(math.hypot(*self.quat_xyzw) - 1.0) > 1e-3:
            raise ValueError(f"the quaternion must have length 1, got {math.hypot(*self.quat_xyzw):.6g}")
        return self

    @property
    def rotation(self) -> Array:
        """(3, 3): base frame from the obstacle's."""
        if self.quat_xyzw is not None:
            return _from_quaternion(np.asarray(self.quat_xyzw) / math.hypot(*self.quat_xyzw))
        return _from_rpy(*(self.rpy or (0.0, 0.0, 0.0)))


class Sphere(_Named):
    """Solid ball."""

    type: Literal["sphere"]
    center: Vector3
    radius: Positive


class HalfSpace(_Named):
    """Everything with ``normal . p < offset`` is solid; the free side is ``normal . p >= offset``."""

    type: Literal["half_space"]
    normal: Vector3
    offset: float

    @field_validator("normal")
    @classmethod
    def _unit(cls, value: list[float]) -> list[float]:
        norm = math.sqrt(sum(x * x for x in value))
        if abs(norm - 1.0) > 1e-3:
            raise ValueError(f"the normal must have length 1, got {norm:.6g}")
        return [x / norm for x in value]


class Box(_Posed):
    """Solid box, centred in its frame."""

    type: Literal["box"]
    size: Annotated[list[Positive], Field(min_length=3, max_length=3)]  # full edge lengths


class Capsule(_Posed):
    """All points within ``radius`` of a segment of ``length`` along its frame's z axis, centred there."""

    type: Literal["capsule"]
    radius: Positive
    length: Positive  # of the segment, caps not counted


class Cylinder(_Posed):
    """Solid cylinder about its frame's z axis, centred there."""

    type: Literal["cylinder"]
    radius: Positive
    length: Positive


class ConvexMesh(_Posed):
    """The convex hull of vertices, given here or read from a mesh file (STL, OBJ, DAE) beside the world's file."""

    type: Literal["mesh"]
    file: str | None = None
    scale: Positive = 1.0
    vertices: list[Vector3] | None = None

    @model_validator(mode="after")
    def _one_source(self) -> ConvexMesh:
        if (self.file is None) == (self.vertices is None):
            raise ValueError("give either file or vertices")
        return self


Obstacle = Annotated[Sphere | HalfSpace | Box | Capsule | Cylinder | ConvexMesh, Field(discriminator="type")]


class WorldSpec(Spec):
    """The obstacles around the robot, in its base frame."""

    obstacles: Annotated[list[Obstacle], Field(min_length=1)]

    @field_validator("obstacles")
    @classmethod
    def _unique_names(cls, value: list[Obstacle]) -> list[Obstacle]:
        names = [o.name for o in value]
        for name in names:
            if names.count(name) > 1:
                raise ValueError(f"two obstacles are named '{name}'; give each its own name")
        return value


def _from_rpy(roll: float, pitch: float, yaw: float) -> Array:
    (cr, sr), (cp, sp), (cy, sy) = ((math.cos(a), math.sin(a)) for a in (roll, pitch, yaw))
    return np.array(
        [[cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
         [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
         [-sp, cp * sr, cp * cr]]
    )  # fmt: skip


def _from_quaternion(q: Array) -> Array:
    x, y, z, w = q
    return np.array(
        [[1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
         [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
         [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)]]
    )  # fmt: skip
