"""What the readers of foreign formats share: checked numbers, poses, and obstacles with their place in the file."""

from __future__ import annotations

import math
import reprlib
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin

from ppcbf_robots.errors import InputError
from ppcbf_robots.specs import Array, Spec, validate
from ppcbf_robots.world import Box, Capsule, ConvexMesh, Cylinder, HalfSpace, Sphere, WorldSpec
from ppcbf_robots.world_files.meshes import hull, mesh_hull
from ppcbf_robots.world_shapes import FARTHEST

KINDS: dict[str, type[Spec]] = {
    "sphere": Sphere,
    "half_space": HalfSpace,
    "box": Box,
    "capsule": Capsule,
    "cylinder": Cylinder,
    "mesh": ConvexMesh,
}
QUATERNION_TOLERANCE = 0.02  # files hold two digits at times; world specs are stricter
DECIMALS = 12  # of composed poses, which hides what floating point adds to zeros
CONE_SIDES = 24


@dataclass
class Scene:
    """Obstacles read so far from one file, and what the user should know about them."""

    path: Path
    obstacles: list[Any] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)

    def at(self, where: str) -> str:
        """File and place, with which errors begin."""
        return f"{self.path}: {where}"

    def add(self, where: str, kind: str, name: str, pose: pin.SE3, **fields: Any) -> None:
        """An obstacle of a kind at a pose in the base frame; InputError if its numbers make no sense."""
        data = {"type": kind, "name": name, **fields}
        xyz, xyzw = _tidy(pose.translation), _tidy(pin.Quaternion(pose.rotation).coeffs())
        if kind == "sphere":
            data["center"] = xyz
        else:
            data["xyz"] = xyz
            if any(xyzw[:3]):
                data["quat_xyzw"] = xyzw
        self.obstacles.append(validate(data, KINDS[kind], self.at(where)))

    def add_points(self, where: str, name: str, pose: pin.SE3, points: Array) -> None:
        """The convex hull of a mesh's vertices (N, 3) [m]."""
        self._add_hull(where, name, pose, hull(points, self.at(where)))

    def add_mesh_file(self, where: str, name: str, pose: pin.SE3, resource: str, scale: Sequence[float]) -> None:
        """The convex hull of a mesh file."""
        self._add_hull(where, name, pose, mesh_hull(resource, scale, self.path, self.at(where)))

    def _add_hull(self, where: str, name: str, pose: pin.SE3, vertices: list[list[float]]) -> None:
        self.add(where, "mesh", name, pose, vertices=vertices)
        self.notes.append(f"'{name}' is a mesh: its convex hull is taken, which fills what is hollow")

    def add_cone(self, where: str, name: str, pose: pin.SE3, radius: float, length: float) -> None:
        """A cone with its tip up z and its frame halfway, as the smallest pyramid of CONE_SIDES sides around it."""
        turn = np.linspace(0.0, 2.0 * np.pi, CONE_SIDES, endpoint=False)
        corner = positive(radius, self.at(where)) / math.cos(math.pi / CONE_SIDES)
        half = 0.5 * positive(length, self.at(where))
        base = np.column_stack([corner * np.cos(turn), corner * np.sin(turn), np.full(CONE_SIDES, -half)])
        points = np.round(np.vstack([base, [0.0, 0.0, half]]), DECIMALS)
        self.add(where, "mesh", name, pose, vertices=hull(points, self.at(where)))
        grown = 1.0 / math.cos(math.pi / CONE_SIDES) - 1.0
        self.notes.append(f"'{name}' is a cone: it becomes a pyramid around it, at most {grown:.1%} wider")

    def add_plane(self, where: str, name: str, pose: pin.SE3, coefficients: Sequence[float]) -> None:
        """A plane ``a x + b y + c z + d = 0`` as the half-space behind it, seen from the robot's base."""
        a, d = np.asarray(coefficients[:3]), coefficients[3]
        length = float(np.linalg.norm(a))
        if length < 1e-9:
            raise InputError(f"{self.at(where)}: the plane's normal has length 0")
        normal = np.asarray(pose.rotation @ a) / length
        offset = float(normal @ pose.translation) - d / length
        if offset > 0.0:  # the base is on the negative side, so that is the free one
            normal, offset = -normal, -offset
        data = {"type": "half_space", "name": name, "normal": _tidy(normal), "offset": offset + 0.0}
        self.obstacles.append(validate(data, HalfSpace, self.at(where)))
        shown = ", ".join(f"{x:.3g}" for x in normal)
        self.notes.append(f"'{name}' is a plane: the side of the base stays free (normal {shown}), the other is solid")

    def world(self) -> WorldSpec:
        """All of them as one world; InputError if there are none, or two have one name."""
        if not self.obstacles:
            raise InputError(f"{self.path}: the file holds no obstacles")
        return validate({"obstacles": self.obstacles}, WorldSpec, str(self.path))


def _tidy(values: Array) -> list[float]:
    """Rounded, and without negative zeros."""
    return [float(x) + 0.0 for x in np.round(values, DECIMALS)]


def number(value: Any, where: str) -> float:
    """A finite number that can be a length in metres."""
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise InputError(f"{where}: expected a number, got {reprlib.repr(value)}")
    if not abs(value) <= FARTHEST:  # also false for NaN
        raise InputError(f"{where}: expected a number of at most {FARTHEST:g}, got {reprlib.repr(value)}")
    return float(value)


def positive(value: Any, where: str) -> float:
    """As :func:`number`, and above 0."""
    if (x := number(value, where)) <= 0.0:
        raise InputError(f"{where}: expected a number above 0, got {x:g}")
    return x


def numbers(value: Any, count: int, where: str) -> list[float]:
    """A list of that many numbers."""
    if not isinstance(value, list | tuple) or len(value) != count:
        raise InputError(f"{where}: expected a list of {count} numbers, got {reprlib.repr(value)}")
    return [number(x, f"{where}[{i}]") for i, x in enumerate(value)]


def point_rows(value: Any, where: str) -> Array:
    """(N, 3) from a list of lists or of mappings with x, y, z."""
    if not isinstance(value, list):
        raise InputError(f"{where}: expected a list of vertices, got {reprlib.repr(value)}")
    rows = [components(v, "xyz", f"{where}[{i}]") for i, v in enumerate(value)]
    return np.array(rows, dtype=float).reshape(-1, 3)


def components(value: Any, names: str, where: str) -> list[float]:
    """Numbers from a list, or from a mapping that has just these keys."""
    if isinstance(value, dict):
        if set(value) != set(names):
            raise InputError(f"{where}: expected the keys {', '.join(names)}, got {reprlib.repr(list(value))}")
        value = [value[k] for k in names]
    return numbers(value, len(names), where)


def pose_of(xyz: Sequence[float], xyzw: Sequence[float], where: str) -> pin.SE3:
    """Pose from a position [m] and a quaternion (x, y, z, w), whose length may be off by rounding."""
    length = math.hypot(*xyzw)
    if abs(length - 1.0) > QUATERNION_TOLERANCE:
        raise InputError(f"{where}: the quaternion must have length 1, got {length:.4g}")
    x, y, z, w = (q / length for q in xyzw)
    return pin.SE3(pin.Quaternion(w, x, y, z).matrix(), np.asarray(xyz, float))


def mapping(value: Any, known: Sequence[str], where: str) -> dict[str, Any]:
    """A mapping none of whose keys is unknown: a misspelt key would be a wrong world."""
    if not isinstance(value, dict):
        raise InputError(f"{where}: expected a mapping, got {reprlib.repr(value)}")
    for key in value:
        if key not in known:
            raise InputError(f"{where}: unknown key {reprlib.repr(key)} (known: {', '.join(known)})")
    return value


def part_names(name: str, count: int) -> list[str]:
    """Names for the shapes of one object: its own for a single shape, else numbered."""
    return [name] if count == 1 else [f"{name}_{i + 1}" for i in range(count)]
