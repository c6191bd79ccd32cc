"""MoveIt's planning scene message as YAML, as MotionBenchMaker and robowflex write it."""

from __future__ import annotations

import reprlib
from typing import Any

import numpy as np
import pinocchio as pin

from ppcbf_robots.errors import InputError
from ppcbf_robots.world_files.scene_parts import (
    Scene,
    components,
    mapping,
    number,
    numbers,
    part_names,
    point_rows,
    pose_of,
    positive,
)

SCENE_KEYS = (
    "name", "robot_state", "robot_model_name", "fixed_frame_transforms", "allowed_collision_matrix", "link_padding",
    "link_scale", "object_colors", "world", "is_diff", "collision_objects", "octomap",
)  # fmt: skip
OBJECT_KEYS = (
    "header", "id", "type", "pose", "primitives", "primitive_poses", "meshes", "mesh_poses", "planes", "plane_poses",
    "subframe_names", "subframe_poses", "operation",
)  # fmt: skip
PRIMITIVES = {1: "box", 2: "sphere", 3: "cylinder", 4: "cone"}  # of shape_msgs/SolidPrimitive
DIMENSIONS = {"box": 3, "sphere": 1, "cylinder": 2, "cone": 2}
BASE_FRAMES = ("", "world", "base", "base_link", "root", "root_link", "link0", "link_0")
BASE_ENDINGS = ("_base", "_base_link", "_link0", "_link_0")  # such as panda_link0
CARRIED = {"camera", "ee", "eef", "finger", "flange", "gripper", "hand", "head", "lidar", "mobile", "sensor", "tool",
           "torso", "wrist"}  # fmt: skip
ADDED = (None, 0, "0", "add", "ADD", "\0", b"\0")  # ROS 2 prints a byte


def read_moveit(scene: Scene, data: dict[str, Any]) -> None:
    """Add the collision objects of a planning scene to a scene.

    Raises:
        InputError: naming the object and the key, also for what moves with the robot and for frames that only a
            running ROS system knows.
    """
    mapping(data, SCENE_KEYS, scene.at("file"))
    world = data
    if "world" in data:
        world = mapping(data["world"], ("collision_objects", "octomap"), scene.at("world"))
    _refuse_the_rest(scene, data, world)
    objects = world.get("collision_objects") or []
    if not isinstance(objects, list):
        raise InputError(f"{scene.at('collision_objects')}: expected a list, got {reprlib.repr(objects)}")
    frames: dict[str, str] = {}
    for i, item in enumerate(objects):
        fields = mapping(item, OBJECT_KEYS, scene.at(f"collision_objects[{i}]"))
        where = f"collision_objects[{i}]" if fields.get("id") is None else f"object '{fields['id']}'"
        frames.setdefault(_frame(scene, where, fields), where)
        _add_object(scene, where, fields)
    if len(frames) > 1:
        (first, a), (second, b) = list(frames.items())[:2]
        raise InputError(
            f"{scene.path}: {a} is in frame '{first}' and {b} in frame '{second}', and how the two lie to each other "
            "is not in the file; give all objects in the robot's base frame"
        )


def _refuse_the_rest(scene: Scene, data: dict[str, Any], world: dict[str, Any]) -> None:
    """What would make the obstacles alone a wrong world."""
    state = data.get("robot_state")
    if isinstance(state, dict) and state.get("attached_collision_objects"):
        raise InputError(f"{scene.at('robot_state')}: attached objects move with the robot; give it body spheres there")
    if any(_has_octomap(x.get("octomap")) for x in (data, world)):
        raise InputError(f"{scene.at('octomap')}: octomaps cannot be represented; give shapes or meshes")
    _refuse_other_frames(scene, data.get("fixed_frame_transforms") or [])
    for key in ("link_padding", "link_scale"):
        if data.get(key):
            scene.notes.append(f"{key} belongs to the robot and is left out; give obstacles a margin instead")


def _has_octomap(message: Any) -> bool:
    """Whether an OctomapWithPose holds a map: ROS prints the message even if it does not."""
    inner = message.get("octomap") if isinstance(message, dict) else message
    return bool(inner.get("data")) if isinstance(inner, dict) else bool(inner)


def _refuse_other_frames(scene: Scene, transforms: Any) -> None:
    if not isinstance(transforms, list):
        raise InputError(f"{scene.at('fixed_frame_transforms')}: expected a list, got {reprlib.repr(transforms)}")
    for i, item in enumerate(transforms):
        where = scene.at(f"fixed_frame_transforms[{i}]")
        transform = item.get("transform") if isinstance(item, dict) else None
        if not isinstance(transform, dict):
            raise InputError(f"{where}: expected a mapping with a transform")
        xyz = components(transform.get("translation", [0.0] * 3), "xyz", f"{where}.translation")
        turn = components(transform.get("rotation", [0.0, 0.0, 0.0, 1.0]), "xyzw", f"{where}.rotation")
        if any(abs(x) > 1e-6 for x in (*xyz, *turn[:3])):
            raise InputError(
                f"{where}: frames that differ are not followed; give all objects in the robot's base frame"
            )


def _frame(scene: Scene, where: str, fields: dict[str, Any]) -> str:
    header = fields.get("header")
    frame = header.get("frame_id") if isinstance(header, dict) else None
    name = "" if frame is None else str(frame).strip("/")
    known = name.endswith(BASE_ENDINGS) and not CARRIED & set(name.lower().split("_"))
    if name not in BASE_FRAMES and not known:
        raise InputError(
            f"{scene.at(where)}: its frame '{name}' is not known; give it in the robot's base frame, or write "
            "base_link where the two are the same"
        )
    note = f"frame '{name}' is taken to be the robot's base"
    if known and note not in scene.notes:
        scene.notes.append(note)
    return name


def _add_object(scene: Scene, where: str, fields: dict[str, Any]) -> None:
    if fields.get("operation") not in ADDED:
        raise InputError(
            f"{scene.at(where)}: operation {fields['operation']!r:.40} is no obstacle; keep objects to add"
        )
    if fields.get("id") is None:
        raise InputError(f"{scene.at(where)}: the key 'id' is missing")
    parts = [part for kind in ("primitive", "mesh", "plane") for part in _parts(scene, where, fields, kind)]
    if not parts:
        raise InputError(f"{scene.at(where)}: it has no primitives, meshes or planes")
    origin = _pose(fields.get("pose"), f"{scene.at(where)}.pose")
    for name, (kind, place, shape, pose) in zip(part_names(str(fields["id"]), len(parts)), parts, strict=True):
        match kind:
            case "primitive":
                _add_primitive(scene, place, name, origin * pose, shape)
            case "mesh":
                _add_mesh(scene, place, name, origin * pose, shape)
            case _:
                keys = mapping(shape, ("coef",), scene.at(place))
                scene.add_plane(place, name, origin * pose, numbers(keys.get("coef"), 4, f"{scene.at(place)}.coef"))


def _parts(scene: Scene, where: str, fields: dict[str, Any], kind: str) -> list[tuple[str, str, Any, pin.SE3]]:
    """(kind, place, shape, pose in the object's frame) of every primitive, mesh or plane."""
    plural = {"primitive": "primitives", "mesh": "meshes", "plane": "planes"}[kind]
    shapes, poses = (fields.get(key) or [] for key in (plural, f"{kind}_poses"))
    if not isinstance(shapes, list) or not isinstance(poses, list) or len(poses) not in (0, len(shapes)):
        raise InputError(f"{scene.at(where)}: expected one of {kind}_poses for each of {plural}")
    places = [f"{where}, {plural}[{i}]" for i in range(len(shapes))]
    if not poses:  # MoveIt then takes the object's own pose
        return [(kind, place, shape, pin.SE3.Identity()) for place, shape in zip(places, shapes, strict=True)]
    found = [_pose(pose, f"{scene.at(where)}, {kind}_poses[{i}]") for i, pose in enumerate(poses)]
    return [(kind, *part) for part in zip(places, shapes, found, strict=True)]


def _add_primitive(scene: Scene, where: str, name: str, pose: pin.SE3, shape: Any) -> None:
    fields = mapping(shape, ("type", "dimensions", "polygon"), scene.at(where))
    kind = fields.get("type")
    known = PRIMITIVES.get(kind, "") if isinstance(kind, int) and not isinstance(kind, bool) else str(kind).lower()
    if known not in DIMENSIONS:
        raise InputError(f"{scene.at(where)}: the type {reprlib.repr(kind)} is not one of {', '.join(DIMENSIONS)}")
    place = f"{scene.at(where)}.dimensions"
    size = [positive(x, place) for x in numbers(fields.get("dimensions"), DIMENSIONS[known], place)]
    match known:
        case "box":
            scene.add(where, "box", name, pose, size=size)
        case "sphere":
            scene.add(where, "sphere", name, pose, radius=size[0])
        case "cylinder":  # height first, unlike in .scene files
            scene.add(where, "cylinder", name, pose, radius=size[1], length=size[0])
        case _:
            scene.add_cone(where, name, pose, radius=size[1], length=size[0])


def _add_mesh(scene: Scene, where: str, name: str, pose: pin.SE3, shape: Any) -> None:
    fields = mapping(shape, ("triangles", "vertices", "resource", "dimensions"), scene.at(where))
    if fields.get("resource") is None:
        scene.add_points(where, name, pose, point_rows(fields.get("vertices"), f"{scene.at(where)}.vertices"))
        return
    scale = [1.0] * 3
    if fields.get("dimensions") is not None:
        scale = [number(x, scene.at(where)) for x in numbers(fields["dimensions"], 3, f"{scene.at(where)}.dimensions")]
    scene.add_mesh_file(where, name, pose, str(fields["resource"]), scale)


def _pose(value: Any, where: str) -> pin.SE3:
    """geometry_msgs/Pose, whose parts are lists or mappings; a quaternion of zeros is no rotation, as in MoveIt."""
    if value is None:
        return pin.SE3.Identity()
    fields = mapping(value, ("position", "orientation"), where)
    xyz, turn = fields.get("position"), fields.get("orientation")
    position = [0.0] * 3 if xyz is None else components(xyz, "xyz", f"{where}.position")
    xyzw = [0.0, 0.0, 0.0, 1.0] if turn is None else components(turn, "xyzw", f"{where}.orientation")
    if np.array_equal(xyzw, np.zeros(4)):
        xyzw = [0.0, 0.0, 0.0, 1.0]
    return pose_of(position, xyzw, where)
