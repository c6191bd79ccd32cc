"""A world from any file that describes one, whatever its format."""

from __future__ import annotations

import logging
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ppcbf_robots.errors import InputError
from ppcbf_robots.resources import WORLD_SUFFIXES, YAML_SUFFIXES
from ppcbf_robots.specs import read_mapping, read_text, validate
from ppcbf_robots.world import ConvexMesh, Obstacle, WorldSpec
from ppcbf_robots.world_files.curobo import GRIDS, GROUPS, read_curobo
from ppcbf_robots.world_files.meshes import hull, mesh_hull
from ppcbf_robots.world_files.moveit import read_moveit
from ppcbf_robots.world_files.moveit_scene import read_moveit_scene
from ppcbf_robots.world_files.scene_parts import Scene
from ppcbf_robots.world_files.urdf_world import read_urdf_world

OUR_KEY = "obstacles"
MOVEIT_KEYS = ("world", "collision_objects")


@dataclass(frozen=True)
class ReadWorld:
    """A world as read, its format in words, and what the reading changed."""

    world: WorldSpec
    format: str
    notes: list[str]


def load_world(path: Path) -> WorldSpec:
    """The obstacles of a file in the robot's base frame [m]; notes on how it was read go to the log as warnings.

    Raises:
        InputError: one sentence naming the file, the line or key, and what was expected.
    """
    read = read_world(path)
    for note in read.notes:
        logging.getLogger(__name__).warning("%s: %s", path, note)
    return read.world


def read_world(path: Path) -> ReadWorld:
    """As :func:`load_world`, with the format and the notes; meshes have become the vertices of their convex hulls.

    Raises:
        InputError: one sentence naming the file, the line or key, and what was expected.
    """
    suffix = path.suffix.lower()
    if suffix in YAML_SUFFIXES:
        return _read_yaml(path)
    scene = Scene(path)
    if suffix == ".scene":
        read_moveit_scene(scene, read_text(path, "scene file"))
        return ReadWorld(scene.world(), "MoveIt scene", scene.notes)
    if suffix in WORLD_SUFFIXES:
        read_urdf_world(scene)
        return ReadWorld(scene.world(), "URDF", scene.notes)
    raise InputError(f"{path}: a world is a {', '.join((*YAML_SUFFIXES, *WORLD_SUFFIXES))} file")


def _read_yaml(path: Path) -> ReadWorld:
    data = read_mapping(path, "obstacle spec", [OUR_KEY])
    foreign = [key for key in (*MOVEIT_KEYS, *GROUPS, *GRIDS) if key in data]
    if OUR_KEY in data or not foreign:  # also for the message of what is missing
        return ReadWorld(_with_hulls(path, validate(data, WorldSpec, str(path))), "our YAML", [])
    scene = Scene(path)
    if foreign[0] in MOVEIT_KEYS:
        read_moveit(scene, data)
        return ReadWorld(scene.world(), "MoveIt YAML", scene.notes)
    read_curobo(scene, data)
    return ReadWorld(scene.world(), "cuRobo YAML", scene.notes)


def _with_hulls(path: Path, world: WorldSpec) -> WorldSpec:
    """The same world with meshes as the vertices of their hulls, so that it is the content that is compared later."""
    obstacles: list[Obstacle] = []
    for obstacle in world.obstacles:
        if isinstance(obstacle, ConvexMesh):
            where = f"{path}: obstacle '{obstacle.name}'"
            if obstacle.file is not None:
                vertices = mesh_hull(obstacle.file, [obstacle.scale] * 3, path, where)
            else:
                points = np.array(obstacle.vertices, dtype=float).reshape(-1, 3)
                vertices = hull(obstacle.scale * points, where)
            data = {**obstacle.model_dump(), "file": None, "scale": 1.0, "vertices": vertices}
            obstacles.append(validate(data, ConvexMesh, where))
        else:
            obstacles.append(obstacle)
    return WorldSpec(obstacles=obstacles)
