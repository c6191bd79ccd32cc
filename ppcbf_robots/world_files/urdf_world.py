"""A URDF as a world: its collision geometry, placed by fixed joints, with the root link at the robot's base."""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree

import numpy as np
import pinocchio as pin

from ppcbf_robots.errors import InputError
from ppcbf_robots.urdf import check_urdf, parse_xml
from ppcbf_robots.world_files.scene_parts import Scene, number, part_names, positive

GEOMETRIES = ("box", "sphere", "cylinder", "mesh")


def read_urdf_world(scene: Scene) -> None:
    """Add the collision geometry of a URDF to a scene.

    Raises:
        InputError: for whatever :func:`ppcbf_robots.urdf.check_urdf` refuses, joints that move, and geometry that a
            world cannot have.
    """
    check_urdf(scene.path)
    root = parse_xml(scene.path)
    placements = _placements(scene, root)
    for link in root.findall("link"):
        name = str(link.get("name"))
        parts = link.findall("collision")
        if not parts and link.find("visual") is not None:
            scene.notes.append(f"link '{name}' is left out: it has visual geometry, but none for collisions")
        for part, collision in zip(part_names(name, len(parts)), parts, strict=True):
            where = f"link '{name}'"
            _add(scene, where, part, placements[name] * _origin(scene, where, collision), collision)


def _placements(scene: Scene, root: ElementTree.Element) -> dict[str, pin.SE3]:
    """Pose of every link in the root link's frame."""
    joints = root.findall("joint")
    for joint in joints:
        if joint.get("type") != "fixed":
            where = scene.at(f"joint '{joint.get('name')}'")
            raise InputError(f"{where}: it is {joint.get('type')}, but a world stands still; make it fixed")
    ends = [(_link(joint, "parent"), _link(joint, "child"), joint) for joint in joints]
    children = {child for _, child, _ in ends}
    placed = {str(link.get("name")): pin.SE3.Identity() for link in root.findall("link")}
    reached = {name for name in placed if name not in children}
    while ends:
        ready = [(parent, child, joint) for parent, child, joint in ends if parent in reached]
        for parent, child, joint in ready:
            placed[child] = placed[parent] * _origin(scene, f"joint '{joint.get('name')}'", joint)
            reached.add(child)
        ends = [end for end in ends if end[1] not in reached]
    return placed


def _link(joint: ElementTree.Element, side: str) -> str:
    element = joint.find(side)
    return "" if element is None else str(element.get("link"))


def _origin(scene: Scene, where: str, element: ElementTree.Element) -> pin.SE3:
    origin = element.find("origin")
    if origin is None:
        return pin.SE3.Identity()
    xyz, rpy = (_vector(scene, where, origin, key, "0 0 0") for key in ("xyz", "rpy"))
    rotation = pin.rpy.rpyToMatrix(*rpy) if any(rpy) else np.eye(3)
    return pin.SE3(rotation, np.array(xyz))


def _add(scene: Scene, where: str, name: str, pose: pin.SE3, collision: ElementTree.Element) -> None:
    geometry = collision.find("geometry")
    shapes = [] if geometry is None else list(geometry)
    if len(shapes) != 1 or shapes[0].tag not in GEOMETRIES:
        found = ", ".join(f"<{shape.tag}>" for shape in shapes) or "none"
        raise InputError(f"{scene.at(where)}: its <geometry> must be one of {', '.join(GEOMETRIES)}, got {found}")
    shape = shapes[0]
    match shape.tag:
        case "box":
            scene.add(where, "box", name, pose, size=_vector(scene, where, shape, "size"))
        case "sphere":
            scene.add(where, "sphere", name, pose, radius=_size(scene, where, shape, "radius"))
        case "cylinder":
            radius, length = (_size(scene, where, shape, key) for key in ("radius", "length"))
            scene.add(where, "cylinder", name, pose, radius=radius, length=length)
        case _:
            resource = shape.get("filename") or ""
            scene.add_mesh_file(where, name, pose, resource, _vector(scene, where, shape, "scale", "1 1 1"))


def _vector(scene: Scene, where: str, element: ElementTree.Element, key: str, default: str = "") -> list[float]:
    words = (element.get(key) or default).split()
    if len(words) != 3:
        raise InputError(f"{scene.at(where)}: <{element.tag}> needs {key} with three numbers")
    return [number(float(word), f"{scene.at(where)}, {key}") for word in words]  # check_urdf has seen that they are


def _size(scene: Scene, where: str, element: ElementTree.Element, key: str) -> float:
    words = (element.get(key) or "").split()
    if len(words) != 1:
        raise InputError(f"{scene.at(where)}: <{element.tag}> needs {key} with one number")
    return positive(float(words[0]), f"{scene.at(where)}, {key}")
