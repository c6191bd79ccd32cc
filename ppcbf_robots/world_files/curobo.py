"""cuRobo's world YAML: one mapping per shape, from names to dimensions and poses [x, y, z, qw, qx, qy, qz]."""

from __future__ import annotations

from typing import Any

import numpy as np
import pinocchio as pin

from ppcbf_robots.errors import InputError
from ppcbf_robots.world_files.scene_parts import (
    Scene,
    mapping,
    number,
    numbers,
    point_rows,
    pose_of,
    positive,
)

GROUPS = ("cuboid", "sphere", "capsule", "cylinder", "mesh")
GRIDS = ("blox", "voxel")  # distance fields, which have no shape
_LOOKS = ("color", "texture", "texture_id", "material")
_KEYS = {
    "cuboid": ("dims",),
    "sphere": ("radius", "position"),
    "capsule": ("radius", "base", "tip"),
    "cylinder": ("radius", "height"),
    "mesh": ("file_path", "vertices", "faces", "vertex_colors", "vertex_normals", "face_colors"),
}


def read_curobo(scene: Scene, data: dict[str, Any]) -> None:
    """Add the obstacles of a cuRobo world to a scene.

    Raises:
        InputError: naming the obstacle and the key.
    """
    for grid in GRIDS:
        if data.get(grid):
            raise InputError(f"{scene.at(grid)}: maps and voxel grids cannot be represented; give shapes or meshes")
    mapping(data, (*GROUPS, *GRIDS), scene.at("file"))
    for group in GROUPS:
        entries = data.get(group)
        if entries is None:
            continue
        if not isinstance(entries, dict):
            raise InputError(f"{scene.at(group)}: expected a mapping from names to obstacles")
        for name, fields in entries.items():
            _add(scene, group, str(name), fields)


def _add(scene: Scene, group: str, name: str, fields: Any) -> None:
    where = f"{group}.{name}"
    mapping(fields, (*_KEYS[group], "pose", "scale", *_LOOKS), scene.at(where))
    scale = _scale(scene, where, fields)
    if group != "mesh" and scale != [1.0, 1.0, 1.0]:
        raise InputError(f"{scene.at(where)}.scale: only meshes can be scaled; change the dimensions instead")
    pose = _pose(scene, group, where, fields)

    def size(key: str) -> float:
        return positive(_needed(scene, where, fields, key), f"{scene.at(where)}.{key}")

    match group:
        case "cuboid":
            dims = numbers(_needed(scene, where, fields, "dims"), 3, f"{scene.at(where)}.dims")
            scene.add(where, "box", name, pose, size=dims)
        case "sphere":
            scene.add(where, "sphere", name, pose, radius=size("radius"))
        case "cylinder":
            scene.add(where, "cylinder", name, pose, radius=size("radius"), length=size("height"))
        case "capsule":
            _add_capsule(scene, where, name, pose, fields, size("radius"))
        case _:
            _add_mesh(scene, where, name, pose, fields, scale)


def _add_capsule(scene: Scene, where: str, name: str, pose: pin.SE3, fields: dict[str, Any], radius: float) -> None:
    """From the centres of its two caps, given in its frame."""
    ends = [np.array(numbers(_needed(scene, where, fields, k), 3, f"{scene.at(where)}.{k}")) for k in ("base", "tip")]
    axis = ends[1] - ends[0]
    length = float(np.linalg.norm(axis))
    middle = pin.SE3(np.eye(3), 0.5 * (ends[0] + ends[1]))
    if length < 1e-9:
        scene.add(where, "sphere", name, pose * middle, radius=radius)
        return
    if abs(axis[2]) < length:  # along z already needs no rotation, which keeps the numbers as they were
        middle.rotation = pin.Quaternion.FromTwoVectors(np.array([0.0, 0.0, 1.0]), axis).matrix()
    scene.add(where, "capsule", name, pose * middle, radius=radius, length=length)


def _add_mesh(scene: Scene, where: str, name: str, pose: pin.SE3, fields: dict[str, Any], scale: list[float]) -> None:
    resource, vertices = fields.get("file_path"), fields.get("vertices")
    if (resource is None) == (vertices is None):
        raise InputError(f"{scene.at(where)}: give either file_path or vertices")
    if vertices is not None:
        scene.add_points(where, name, pose, point_rows(vertices, f"{scene.at(where)}.vertices") * scale)
    elif not isinstance(resource, str):
        raise InputError(f"{scene.at(where)}.file_path: expected a path")
    else:
        scene.add_mesh_file(where, name, pose, resource, scale)


def _pose(scene: Scene, group: str, where: str, fields: dict[str, Any]) -> pin.SE3:
    if group == "sphere" and fields.get("position") is not None:
        return pin.SE3(np.eye(3), np.array(numbers(fields["position"], 3, f"{scene.at(where)}.position")))
    place = f"{scene.at(where)}.pose"
    x, y, z, qw, qx, qy, qz = numbers(_needed(scene, where, fields, "pose"), 7, place)
    return pose_of([x, y, z], [qx, qy, qz, qw], place)


def _scale(scene: Scene, where: str, fields: dict[str, Any]) -> list[float]:
    value = fields.get("scale")
    if value is None:
        return [1.0, 1.0, 1.0]
    place = f"{scene.at(where)}.scale"
    return numbers(value, 3, place) if isinstance(value, list) else [number(value, place)] * 3


def _needed(scene: Scene, where: str, fields: dict[str, Any], key: str) -> Any:
    if fields.get(key) is None:
        raise InputError(f"{scene.at(where)}: the key '{key}' is missing")
    return fields[key]
