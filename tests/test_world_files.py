"""Worlds from files in each format and from damaged ones, and what is refused with which sentence."""

from __future__ import annotations

import itertools
import json
import logging
import os
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st

from ppcbf_robots.errors import InputError
from ppcbf_robots.problem import load_problem
from ppcbf_robots.resources import find_world
from ppcbf_robots.world import Box, Capsule, ConvexMesh, Cylinder, HalfSpace, Obstacle, Sphere
from ppcbf_robots.world_files import meshes
from ppcbf_robots.world_files.load import load_world, read_world
from ppcbf_robots.world_files.write import write_world
from ppcbf_robots.world_shapes import coal_shape, surface_points

DATA = Path(__file__).parent / "data" / "worlds"
FORMATS = {
    "curobo.yml": "cuRobo YAML",
    "moveit_old.scene": "MoveIt scene",
    "moveit_new.scene": "MoveIt scene",
    "motion_bench_maker.yaml": "MoveIt YAML",
    "planning_scene.yaml": "MoveIt YAML",
    "cell.urdf": "URDF",
    "ours.yaml": "our YAML",
}
QUARTER = [0.0, 0.0, np.sqrt(0.5), np.sqrt(0.5)]  # a quarter turn about z, xyzw


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A copy of the sample files, to change."""
    return Path(shutil.copytree(DATA, tmp_path / "worlds"))


def refusal(path: Path) -> str:
    """The one sentence with which a file is refused, without its path."""
    with pytest.raises(InputError) as error:
        load_world(path)
    text = str(error.value)
    assert "\n" not in text and error.value.exit_code == 2
    assert text.startswith(f"{path}: ")
    return text.removeprefix(f"{path}: ")


def obstacles(name: str) -> dict[str, Any]:
    return {o.name: o for o in load_world(DATA / name).obstacles}


def same(got: Obstacle, expected: Obstacle) -> None:
    """Equal types and numbers up to rounding, rotations compared as matrices."""
    assert type(got) is type(expected)
    turn = ("rpy", "quat_xyzw")
    ours, theirs = ({k: v for k, v in o.model_dump().items() if k not in turn} for o in (got, expected))
    assert ours.keys() == theirs.keys()
    for key, value in theirs.items():
        if isinstance(value, str) or value is None:
            assert ours[key] == value
        else:
            np.testing.assert_allclose(ours[key], value, atol=1e-7, err_msg=key)
    if not isinstance(got, Sphere | HalfSpace):
        assert not isinstance(expected, Sphere | HalfSpace)
        np.testing.assert_allclose(got.rotation, expected.rotation, atol=1e-7)


def box(name: str, xyz: list[float], size: list[float], **more: Any) -> Box:
    return Box(name=name, type="box", xyz=xyz, size=size, **more)


def ball(name: str, center: list[float], radius: float) -> Sphere:
    return Sphere(name=name, type="sphere", center=center, radius=radius)


def cylinder(name: str, xyz: list[float], radius: float, length: float, **more: Any) -> Cylinder:
    return Cylinder(name=name, type="cylinder", xyz=xyz, radius=radius, length=length, **more)


def wedge(name: str, xyz: list[float], scale: tuple[float, float, float] = (1.0, 1.0, 1.0), **more: Any) -> ConvexMesh:
    corners = [[0, 0, 0], [0, 0, 0.1], [0, 0.1, 0], [0, 0.1, 0.1], [0.2, 0, 0], [0.2, 0.1, 0]]
    vertices = (np.array(corners) * scale).tolist()
    return ConvexMesh(name=name, type="mesh", xyz=xyz, vertices=vertices, **more)


# Each format


EXPECTED: dict[str, list[Obstacle]] = {
    "curobo.yml": [
        box("bench", [0.7, 0, -0.075], [1.2, 0.8, 0.05]),
        box("crate", [0.6, 0.2, 0], [0.2, 0.3, 0.1], quat_xyzw=QUARTER),
        ball("lamp", [0.4, -0.3, 0.9], 0.08),
        ball("bulb", [0.4, -0.3, 0.7], 0.03),
        Capsule(name="rail", type="capsule", xyz=[0.5, 0.4, 0.3], radius=0.02, length=0.4),
        cylinder("tin", [0.5, -0.1, 0.06], 0.04, 0.12),
        wedge("wedge", [0.9, 0, 0], (1, 2, 1), quat_xyzw=[0, 0, 1, 0]),
    ],
    "moveit_new.scene": [
        box("shelf_1", [0.8, 0.2, 0.3], [0.6, 0.3, 0.02], quat_xyzw=QUARTER),
        box("shelf_2", [0.8, 0.2, 0.6], [0.6, 0.3, 0.02], quat_xyzw=QUARTER),
        cylinder("Can1", [0.5, -0.1, 0.06], 0.04, 0.12),
    ],
    "motion_bench_maker.yaml": [
        cylinder("Can1", [0.5, -0.1, 0.06], 0.04, 0.12),
        box("shelf_top", [0.8, 0, 0.6], [0.3, 0.9, 0.04], quat_xyzw=QUARTER),
    ],
    "planning_scene.yaml": [
        box("post_1", [0.5, 0, 0.2], [0.1, 0.1, 0.4], quat_xyzw=QUARTER),
        ball("post_2", [0.5, 0, 0.4], 0.08),
        ConvexMesh(
            name="post_3", type="mesh", xyz=[0.5, 0.3, 0.2], quat_xyzw=QUARTER,
            vertices=[[0, 0, 0], [0, 0, 0.1], [0, 0.1, 0], [0.1, 0, 0]],
        ),
        HalfSpace(name="post_4", type="half_space", normal=[0, 0, 1], offset=-0.1),
    ],
    "cell.urdf": [
        box("table", [0.8, 0, -0.075], [1.2, 0.8, 0.05], quat_xyzw=QUARTER),
        cylinder("post_1", [0.8, 0.2, 0.2], 0.04, 0.5, quat_xyzw=QUARTER),
        ball("post_2", [0.8, 0.2, 0.45], 0.06),
        wedge("wedge", [0.3, 0.4, 0], (1, 1, 2)),
    ],
    "ours.yaml": [
        ball("ball", [0.5, 0, 0.5], 0.1),
        HalfSpace(name="floor", type="half_space", normal=[0, 0, 1], offset=-0.05, margin=0.01),
        box("crate", [0.6, 0.3, 0.1], [0.3, 0.2, 0.2], rpy=[0, 0, 0.4]),
        Capsule(
            name="pipe", type="capsule", xyz=[0.4, -0.4, 0.5], rpy=[np.pi / 2, 0, 0], radius=0.03, length=0.6
        ),
        cylinder("post", [0.7, -0.2, 0.3], 0.05, 0.6),
        wedge("wedge", [0.3, 0.4, 0], (2, 2, 2)),
        ConvexMesh(
            name="pyramid", type="mesh", xyz=[0.3, -0.4, 0],
            vertices=[[0, 0, 0], [0, 0.1, 0], [0.02, 0.02, 0.1], [0.1, 0, 0]],
        ),
    ],
}  # fmt: skip


@pytest.mark.parametrize("name", EXPECTED)
def test_a_file_of_each_format(name: str) -> None:
    read = read_world(DATA / name)
    assert read.format == FORMATS[name]
    for got, expected in itertools.zip_longest(read.world.obstacles, EXPECTED[name]):
        assert got.name == expected.name
        same(got, expected)


def test_an_old_scene_file() -> None:
    found = obstacles("moveit_old.scene")
    assert list(found) == ["table", "can 1", "fixture_1", "fixture_2", "back wall", "wedge"]
    same(found["table"], box("table", [0.7, 0, -0.075], [1.2, 0.8, 0.05]))
    same(found["can 1"], cylinder("can 1", [0.5, -0.1, 0.06], 0.04, 0.12))
    same(found["fixture_1"], ball("fixture_1", [0.4, -0.3, 0.9], 0.08))
    same(found["back wall"], HalfSpace(name="back wall", type="half_space", normal=[-1, 0, 0], offset=-1.1))
    same(found["wedge"], wedge("wedge", [0.9, 0, 0]))


def test_every_sample_is_tested() -> None:
    assert {p.name for p in DATA.glob("*.*")} == set(FORMATS) == {*EXPECTED, "moveit_old.scene"}


def test_a_cone_is_covered_and_hardly_wider() -> None:
    mesh = obstacles("moveit_old.scene")["fixture_2"]
    rng = np.random.default_rng(0)
    turn, up = rng.uniform(0, 2 * np.pi, 2000), rng.uniform(0, 1, 2000)
    radius = 0.05 * (1.0 - up)  # on the cone's surface, base at z = -0.1 and tip at 0.1
    surface = np.column_stack([0.4 + radius * np.cos(turn), 0.3 + radius * np.sin(turn), 0.1 + 0.2 * up])
    shape, placement = coal_shape(mesh)
    normals, offsets = np.array(shape.normals()), np.array(shape.offsets()).ravel()
    depth = (surface - placement[:3, 3]) @ normals.T + offsets  # of each point behind each face, negative inside
    assert depth.max() < 1e-9
    assert np.abs(surface_points(mesh)[:, :2] - [0.4, 0.3]).max() < 0.05 * 1.01


def test_a_capsule_between_any_two_points(tmp_path: Path) -> None:
    path = tmp_path / "w.yml"
    fields = (
        "{radius: 0.1, base: [0.1, 0.2, 0.3], tip: [0.4, -0.2, 0.3], pose: [1, 0, 0, 0.70710678, 0, 0, 0.70710678]}"
    )
    path.write_text(f"capsule: {{bar: {fields}, ball: {fields.replace('[0.4, -0.2, 0.3]', '[0.1, 0.2, 0.3]')}}}")
    bar, dot = load_world(path).obstacles
    assert isinstance(bar, Capsule) and isinstance(dot, Sphere)
    ends = [np.array(bar.xyz) + s * 0.5 * bar.length * bar.rotation[:, 2] for s in (-1, 1)]
    np.testing.assert_allclose(ends, [[0.8, 0.1, 0.3], [1.2, 0.4, 0.3]], atol=1e-7)  # turned by 90 degrees about z
    np.testing.assert_allclose(dot.center, [0.8, 0.1, 0.3], atol=1e-7)


@pytest.mark.parametrize(
    ("coefficients", "normal", "offset"),
    [
        ("0 0 1 0", [0, 0, 1], 0.0),
        ("0 0 2 0.2", [0, 0, 1], -0.1),
        ("0 0 -1 -0.1", [0, 0, 1], -0.1),  # the same floor, seen from below
        ("0 0 1 -0.5", [0, 0, -1], -0.5),  # a ceiling
    ],
)
def test_the_base_is_on_the_free_side_of_a_plane(
    coefficients: str, normal: list[float], offset: float, tmp_path: Path
) -> None:
    path = tmp_path / "plane.scene"
    path.write_text(f"s\n* p\n1\nplane\n{coefficients}\n0 0 0\n0 0 0 1\n0 0 0 0\n.\n")
    (plane,) = load_world(path).obstacles
    same(plane, HalfSpace(name="p", type="half_space", normal=normal, offset=offset))


def test_a_turned_plane_moves_with_its_pose(tmp_path: Path) -> None:
    path = tmp_path / "plane.scene"
    path.write_text("s\n* p\n1\nplane\n0 0 1 0\n0.5 0 0\n0 0.70710678 0 0.70710678\n0 0 0 0\n.\n")
    (plane,) = load_world(path).obstacles
    same(plane, HalfSpace(name="p", type="half_space", normal=[-1, 0, 0], offset=-0.5))


def test_an_object_pose_in_the_new_format_moves_what_the_old_one_says(folder: Path) -> None:
    """Both formats of the same objects are the same world."""
    old = (
        "s\n* a\n2\nbox\n1 2 3\n1 2 0.3\n0 0 0.70710678 0.70710678\n0 0 0 0\n"
        "sphere\n0.1\n0.8 3 0\n0 0 0 1\n0 0 0 0\n.\n"
    )
    new = (
        "s\n* a\n1 3 0\n0 0 0.70710678 0.70710678\n2\nbox\n1 2 3\n-1 0 0.3\n0 0 0 1\n0 0 0 0\n"
        "sphere\n0.1\n0 0.2 0\n0 0 0 1\n0 0 0 0\n0\n.\n"
    )
    (folder / "old.scene").write_text(old)
    (folder / "new.scene").write_text(new)
    for a, b in zip(
        load_world(folder / "old.scene").obstacles, load_world(folder / "new.scene").obstacles, strict=True
    ):
        same(a, b)


def test_notes_are_logged_and_the_problem_uses_the_reader(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    path = tmp_path / "floor.scene"
    plane = "* floor\n1\nplane\n0 0 1 1\n0 0 0\n0 0 0 1\n0 0 0 0\n"
    path.write_text(f"s\n{plane}* ball\n1\nsphere\n0.2\n0.6 0 0.6\n0 0 0 1\n0 0 0 0\n.\n")
    with caplog.at_level(logging.WARNING):
        problem = load_problem("two_link", str(path))
    assert [o.type for o in problem.world.obstacles] == ["half_space", "sphere"]
    assert caplog.messages == [
        f"{path}: 'floor' is a plane: the side of the base stays free (normal 0, 0, 1), the other is solid"
    ]


# Refusals


CHANGES = [
    ("curobo.yml", "radius: 0.08", "radius: -0.08", "sphere.lamp.radius: expected a number above 0, got -0.08"),
    ("curobo.yml", "radius: 0.08", "", "sphere.lamp: the key 'radius' is missing"),
    ("curobo.yml", "radius: 0.08", "radius: .nan", "sphere.lamp.radius: expected a number of at most 10000, got nan"),
    ("curobo.yml", "radius: 0.08", "radius: big", "sphere.lamp.radius: expected a number, got 'big'"),
    ("curobo.yml", "radius: 0.08", "raduis: 0.08", "sphere.lamp: unknown key 'raduis' (known: radius, position, pose, "
     "scale, color, texture, texture_id, material)"),
    ("curobo.yml", "[1.2, 0.8, 0.05]", "[1.2, 0.8]", "cuboid.bench.dims: expected a list of 3 numbers, got [1.2, 0.8]"),
    ("curobo.yml", "[1.2, 0.8, 0.05]", "[1.2, 0, 0.05]",
     "cuboid.bench: size.1: input should be greater than 0, got 0.0"),
    ("curobo.yml", ", -0.075, 1, 0, 0, 0.0]", ", -0.075, 1, 1, 0, 0]",
     "cuboid.bench.pose: the quaternion must have length 1, got 1.414"),
    ("curobo.yml", "    height: 0.12\n", "    height: 0.12\n    scale: 2\n",
     "cylinder.tin.scale: only meshes can be scaled; change the dimensions instead"),
    ("curobo.yml", "cuboid:", "cuboids:",
     "file: unknown key 'cuboids' (known: cuboid, sphere, capsule, cylinder, mesh, "
     "blox, voxel)"),
    ("curobo.yml", "mesh:\n  wedge:", "blox:\n  wedge:",
     "blox: maps and voxel grids cannot be represented; give shapes or meshes"),
    ("curobo.yml", "meshes/wedge.obj", "gone.obj", None),
    ("moveit_old.scene", "1.2 0.8 0.05", "1.2 0.8 wide", "line 5: expected a dimension of the box, got 'wide'"),
    ("moveit_old.scene", "1.2 0.8 0.05", "1.2 0.8 -1",
     "line 4 (box of 'table'): expected a number above 0, got -1"),
    ("moveit_old.scene", "0.04 0.12", "inf 0.12", "line 12: expected a dimension of the cylinder, got 'inf'"),
    ("moveit_old.scene", "box", "torus",
     "line 4 (torus of 'table'): the shape is not one of sphere, box, cylinder, cone, plane, mesh"),
    ("moveit_old.scene", "* can 1", "+ can 1", "line 9: expected '* NAME' or '.', got '+'"),
    ("moveit_old.scene", "* can 1", "*", "line 9: the object has no name"),
    ("moveit_old.scene", "* can 1", "* table",
     "obstacles: two obstacles are named 'table'; give each its own name"),
    ("moveit_old.scene", "0 0 0 0\n.\n", "0 0 0 0\n", "the file ends where '*' or '.' is expected"),
    ("moveit_old.scene", "0 0 0 0\n.\n", "0 0", "the file ends where a colour is expected"),
    ("moveit_old.scene", "-1 0 0 1.1", "0 0 0 1.1", "line 30 (plane of 'back wall'): the plane's normal has length 0"),
    ("moveit_old.scene", "6 8", "600000 8", "line 38: expected a number of vertices, at most 500000, got '600000'"),
    ("moveit_new.scene", "0 0 0.70710678 0.70710678", "0 0 0.7 0.1",
     "line 4: the quaternion must have length 1, got 0.7071"),
    ("moveit_new.scene", "front\n", "", "line 19: expected a subframe's pose, got '*'"),
    ("motion_bench_maker.yaml", "frame_id: base_link\n      id: Can1", "frame_id: camera_base_link\n      id: Can1",
     "object 'Can1': its frame 'camera_base_link' is not known; give it in the robot's base frame, or write "
     "base_link where the two are the same"),
    ("motion_bench_maker.yaml", "frame_id: base_link\n      id: Can1", "frame_id: gripper_base\n      id: Can1",
     "object 'Can1': its frame 'gripper_base' is not known; give it in the robot's base frame, or write "
     "base_link where the two are the same"),
    ("motion_bench_maker.yaml", "frame_id: base_link\n      id: Can1", "frame_id: camera\n      id: Can1",
     "object 'Can1': its frame 'camera' is not known; give it in the robot's base frame, or write base_link where the "
     "two are the same"),
    ("motion_bench_maker.yaml", "frame_id: base_link\n      id: Can1", "frame_id: world\n      id: Can1",
     "object 'Can1' is in frame 'world' and object 'shelf_top' in frame 'base_link', and how the two lie to each other "
     "is not in the file; give all objects in the robot's base frame"),
    ("motion_bench_maker.yaml", "[0.12, 0.04]", "[0.12]",
     "object 'Can1', primitives[0].dimensions: expected a list of 2 numbers, got [0.12]"),
    ("motion_bench_maker.yaml", "type: cylinder", "type: prism",
     "object 'Can1', primitives[0]: the type 'prism' is not one of box, sphere, cylinder, cone"),
    ("motion_bench_maker.yaml", "      id: Can1\n", "", "collision_objects[0]: the key 'id' is missing"),
    ("motion_bench_maker.yaml", "id: Can1", "id: Can1\n      operation: remove",
     "object 'Can1': operation 'remove' is no obstacle; keep objects to add"),
    ("motion_bench_maker.yaml", "primitive_poses", "poses", None),
    ("motion_bench_maker.yaml", "orientation: [0, 0, 0, 1]", "orientation: [0, 0, 1]",
     "object 'Can1', primitive_poses[0].orientation: expected a list of 4 numbers, got [0, 0, 1]"),
    ("planning_scene.yaml", "attached_collision_objects: []", "attached_collision_objects: [{link_name: hand}]",
     "robot_state: attached objects move with the robot; give it body spheres there"),
    ("planning_scene.yaml", "data: []", "data: [1, 2]",
     "octomap: octomaps cannot be represented; give shapes or meshes"),
    ("planning_scene.yaml", "translation: {x: 0.0", "translation: {x: 0.5",
     "fixed_frame_transforms[0]: frames that differ are not followed; give all objects in the robot's base frame"),
    ("planning_scene.yaml", "{x: 0.5, y: 0.0, z: 0.2}", "{x: 0.5, y: 0.0}",
     "object 'post'.pose.position: expected the keys x, y, z, got ['x', 'y']"),
    ("cell.urdf", 'name="post_mount" type="fixed"', 'name="post_mount" type="continuous"',
     "joint 'post_mount': it is continuous, but a world stands still; make it fixed"),
    ("cell.urdf", 'radius="0.06"', 'radius="-1"', "link 'post', sphere radius: -1.0 is negative; correct it"),
    ("cell.urdf", 'radius="0.06"', "", "link 'post', sphere radius: expected 1 number, got ''"),
    ("cell.urdf", '<collision><geometry><cylinder radius="0.04" length="0.5"/>', "<collision><geometry><torus/>",
     "link 'post': its <geometry> must be one of box, sphere, cylinder, mesh, got <torus>"),
    ("cell.urdf", 'xyz="0.3 0.4 0"', 'xyz="0.3 0.4"',
     "joint 'wedge_mount', origin xyz: expected 3 numbers, got '0.3 0.4'"),
    ("cell.urdf", 'xyz="0.3 0.4 0"', 'xyz="0.3 0.4 east"', "joint 'wedge_mount', origin xyz: 'east' is not a number"),
    ("cell.urdf", "package://worlds", "http://worlds",
     "link 'wedge': mesh 'http://worlds/meshes/wedge.obj': only file:// and package:// addresses can be read"),
    ("ours.yaml", "quat_xyzw: [0.70710678,", "quat_xyzw: [0.8,", None),
    ("ours.yaml", "[0.02, 0.02, 0.1]", "[0.02, 0.02, 0]",
     "obstacle 'pyramid': the mesh is flat (0 m thick); a solid has a volume"),
    ("ours.yaml", ", [0.02, 0.02, 0.1]]", "]",
     "obstacle 'pyramid': a solid needs at least 4 different vertices, this mesh has 3"),
]  # fmt: skip


@pytest.mark.parametrize(("name", "old", "new", "expected"), CHANGES, ids=[f"{c[0]} {c[2][:25]}" for c in CHANGES])
def test_what_is_wrong_is_said(name: str, old: str, new: str, expected: str | None, folder: Path) -> None:
    path = folder / name
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new, 1))
    said = refusal(path)
    assert expected is None or said == expected


@pytest.mark.parametrize("name", ["w.yaml", "w.scene", "w.urdf", "w.txt"])
def test_empty_and_foreign_files(name: str, tmp_path: Path) -> None:
    path = tmp_path / name
    path.write_text("")
    assert (
        refusal(path)
        == {
            "w.yaml": "expected a mapping with keys such as obstacles",
            "w.scene": "the file ends where '*' or '.' is expected",
            "w.urdf": "not valid XML (no element found: line 1, column 0)",
            "w.txt": "a world is a .yaml, .yml, .scene, .urdf, .xml file",
        }[name]
    )


def test_files_without_obstacles(tmp_path: Path) -> None:
    for name, text in (
        ("a.scene", "s\n.\n"),
        ("b.yaml", "world: {collision_objects: []}"),
        ("c.yaml", "cuboid: {}\nsphere:\n"),
        ("d.urdf", '<robot name="r"><link name="base"/></robot>'),
    ):
        (tmp_path / name).write_text(text)
        assert refusal(tmp_path / name) == "the file holds no obstacles"


def test_worlds_are_found_by_path_and_name() -> None:
    assert find_world(str(DATA / "cell.urdf")) == DATA / "cell.urdf"
    with pytest.raises(InputError, match=r"^obstacle file not found: gone\.scene$"):
        find_world("gone.scene")


# Meshes


def mesh_world(folder: Path, file: str, more: str = "") -> Path:
    path = folder / "mesh.yaml"
    path.write_text(f"obstacles: [{{name: m, type: mesh, file: {json.dumps(file)}{more}}}]")
    return path


def tetrahedron_stl(scale: float = 1.0) -> str:
    corners = scale * np.array([[0, 0, 0], [0.1, 0, 0], [0, 0.1, 0], [0, 0, 0.1]])
    facets = [
        "facet normal 0 0 0\nouter loop\n" + "\n".join("vertex {} {} {}".format(*corners[i]) for i in face)
        + "\nendloop\nendfacet" for face in ([0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3])
    ]  # fmt: skip
    return "solid t\n" + "\n".join(facets) + "\nendsolid t\n"


COLLADA = """<?xml version="1.0"?>
<COLLADA xmlns="http://www.collada.org/2005/11/COLLADASchema" version="1.4.1">
<asset><unit name="meter" meter="1"/><up_axis>Z_UP</up_axis></asset>
<library_geometries><geometry id="g"><mesh>
<source id="p"><float_array id="a" count="12">0 0 0 0.1 0 0 0 0.1 0 0 0 0.1</float_array><technique_common>
<accessor source="#a" count="4" stride="3"><param name="X" type="float"/><param name="Y" type="float"/>
<param name="Z" type="float"/></accessor></technique_common></source>
<vertices id="v"><input semantic="POSITION" source="#p"/></vertices>
<triangles count="4"><input semantic="VERTEX" source="#v" offset="0"/><p>0 2 1 0 1 3 0 3 2 1 2 3</p></triangles>
</mesh></geometry></library_geometries>
<library_visual_scenes><visual_scene id="s"><node><instance_geometry url="#g"/></node></visual_scene>
</library_visual_scenes><scene><instance_visual_scene url="#s"/></scene></COLLADA>
"""
TETRAHEDRON = [[0, 0, 0], [0, 0, 0.1], [0, 0.1, 0], [0.1, 0, 0]]


@pytest.mark.parametrize(
    ("name", "text"), [("t.stl", tetrahedron_stl()), ("t.STL", tetrahedron_stl()), ("t.dae", COLLADA)]
)
def test_mesh_files(name: str, text: str, tmp_path: Path) -> None:
    (tmp_path / name).write_text(text)
    (mesh,) = load_world(mesh_world(tmp_path, name, ", scale: 2")).obstacles
    assert isinstance(mesh, ConvexMesh) and (mesh.file, mesh.scale) == (None, 1.0)
    np.testing.assert_allclose(mesh.vertices, 2.0 * np.array(TETRAHEDRON), atol=1e-8)


def test_the_fingerprint_follows_the_content_of_a_mesh(tmp_path: Path) -> None:
    def dump() -> list[dict[str, Any]]:
        return [o.model_dump() for o in load_world(mesh_world(tmp_path, "t.stl")).obstacles]

    (tmp_path / "t.stl").write_text(tetrahedron_stl())
    first = dump()
    (tmp_path / "t.stl").write_text(tetrahedron_stl(1.1))
    assert dump() != first
    rows = (DATA / "meshes" / "wedge.obj").read_text().splitlines()
    (tmp_path / "t.obj").write_text("\n".join(rows))
    a = load_world(mesh_world(tmp_path, "t.obj")).obstacles
    corners = [row for row in rows if row.startswith("v")]
    shuffled = [corners[i] for i in (3, 1, 5, 0, 2, 4)]
    faces = ["f 1 2 3", "f 4 5 6", "f 1 5 3", "f 2 4 6"]
    (tmp_path / "t.obj").write_text("\n".join(shuffled + faces))
    assert load_world(mesh_world(tmp_path, "t.obj")).obstacles == a


def test_meshes_that_cannot_be_used(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def said(file: str) -> str:
        return refusal(mesh_world(tmp_path, file)).removeprefix("obstacle 'm': ")

    assert said("gone.stl") == f"mesh file not found: gone.stl (tried {tmp_path / 'gone.stl'})"
    assert said("a" * 5000 + ".stl").endswith("cannot be read (File name too long)")
    (tmp_path / "t.glb").write_text("x")
    assert said("t.glb") == "mesh 't.glb' has an unknown format; convert it to stl, dae, obj"
    (tmp_path / "bad.stl").write_text("garbage")
    assert said("bad.stl") == "mesh 'bad.stl' cannot be read (File is too small)"
    (tmp_path / "flat.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nv 1 1 1e-9\nf 1 2 3\nf 2 3 4\n")
    assert said("flat.obj") == "mesh 'flat.obj': the mesh is flat (5e-10 m thick); a solid has a volume"
    (tmp_path / "nan.stl").write_text(tetrahedron_stl().replace("vertex 0.1 0.0 0.0", "vertex nan 0.0 0.0"))
    assert said("nan.stl") == "mesh 'nan.stl': a vertex of the mesh is not finite"
    (tmp_path / "good.stl").write_text(tetrahedron_stl())
    monkeypatch.setattr(meshes, "MAX_HULL", 3)
    assert said("good.stl") == "mesh 'good.stl': its convex hull has 4 vertices; at most 3 are taken, simplify it"
    monkeypatch.setattr(meshes, "MAX_POINTS", 3)
    assert said("good.stl") == "mesh 'good.stl': 4 vertices; at most 3 are read, simplify the mesh"
    monkeypatch.setattr("ppcbf_robots.meshes.MAX_BYTES", 10)
    assert said("good.stl") == "mesh 'good.stl' is larger than 0 MB; simplify it"


CRASHERS = {
    "{file: nodes.dae}": "mesh 'nodes.dae' has 100000 nodes, more than 1000; merge them",
    "{vertices: [[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], scale: 1.0e+11}": "reaches 1e+11 m from its origin",
    "{vertices: [[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], scale: 1.0e+300}": "1e+300 is no quantity of a robot",
}  # each ended the interpreter once
RUN = """
import sys
from pathlib import Path
from ppcbf_robots.errors import InputError
from ppcbf_robots.world_files.load import load_world
for path in sys.argv[1:]:
    try:
        print(load_world(Path(path)), flush=True)
    except InputError as error:
        print(error, flush=True)
"""


def test_meshes_that_might_crash_the_interpreter(tmp_path: Path) -> None:
    node = '<node id="n">' * 100_000 + "</node>" * 100_000
    scene = f'<library_visual_scenes><visual_scene id="s">{node}</visual_scene></library_visual_scenes>'
    (tmp_path / "nodes.dae").write_text(f"<COLLADA>{scene}</COLLADA>")
    paths = [tmp_path / f"world{i}.yaml" for i in range(len(CRASHERS))]
    for path, fields in zip(paths, CRASHERS, strict=True):
        path.write_text(f"obstacles:\n  - {{name: m, type: mesh, {fields[1:]}\n")
    done = subprocess.run([sys.executable, "-c", RUN, *map(str, paths)], capture_output=True, text=True, timeout=60)
    assert done.returncode == 0, (done.stdout[-300:], done.stderr[-300:])
    for line, expected in zip(done.stdout.splitlines(), CRASHERS.values(), strict=True):
        assert expected in line


def test_what_ros2_prints_is_a_world(tmp_path: Path) -> None:
    """An operation printed as a byte, and a document that ends with ---; a frame that only sounds right is named."""
    path = tmp_path / "scene.yaml"
    item = '{header: {frame_id: panda_link0}, id: a, operation: "\\0", primitives: [{type: 2, dimensions: [0.1]}], '
    item += "primitive_poses: [{position: [1, 0, 0], orientation: [0, 0, 0, 1]}]}"
    path.write_text(f"world: {{collision_objects: [{item}]}}\n---\n")
    read = read_world(path)
    assert read.world.obstacles[0].name == "a"
    assert read.notes == ["frame 'panda_link0' is taken to be the robot's base"]
    path.write_text(f"world: {{collision_objects: [{item}]}}\n---\nworld: {{}}\n")
    assert refusal(path) == "holds 2 YAML documents; keep one"
    path.write_text(f"world: {{collision_objects: [{item}]}}\noctomap: {{octomap: {{data: [1]}}}}\n")
    assert "octomaps cannot be represented" in refusal(path)


def test_places_where_no_world_can_be_written(tmp_path: Path) -> None:
    world = load_world(DATA / "cell.urdf")
    os.mkfifo(tmp_path / "pipe.yaml")
    for path, said in ((tmp_path / "pipe.yaml", "is not a file"), (tmp_path / ("a" * 300), "File name too long")):
        with pytest.raises(InputError, match=said):
            write_world(world, path, "t", overwrite=True)
    with pytest.raises(InputError, match="is a pipe or a device"):
        read_world(tmp_path / "pipe.yaml")


# Damaged files


@given(st.data())
@settings(max_examples=150, deadline=None)
def test_damaged_files_are_worlds_or_one_sentence(data: st.DataObject) -> None:
    name = data.draw(st.sampled_from(sorted(FORMATS)))
    text = (DATA / name).read_text()
    for _ in range(data.draw(st.integers(1, 3))):
        at = data.draw(st.integers(0, len(text)))
        kind = data.draw(st.sampled_from(["cut", "drop", "put", "line"]))
        if kind == "cut":
            text = text[:at]
        elif kind == "drop":
            text = text[:at] + text[at + data.draw(st.integers(1, 9)) :]
        elif kind == "put":
            words = [
                "nan",
                "-1",
                "0",
                "1e400",
                "*k",
                "&k ",
                "[]",
                "{}",
                "null",
                "true",
                '"',
                "<",
                ">",
                "\n",
                "\0",
                " ",
                "é",
            ]
            text = text[:at] + data.draw(st.sampled_from(words)) + text[at:]
        else:
            lines = text.split("\n")
            i = data.draw(st.integers(0, len(lines) - 1))
            text = "\n".join(lines[:i] + lines[i + 1 :])
    with tempfile.TemporaryDirectory() as folder:
        shutil.copytree(DATA / "meshes", Path(folder) / "meshes")
        path = Path(folder) / name
        path.write_text(text, encoding="utf-8")
        try:
            world = load_world(path)
        except InputError as error:
            assert "\n" not in str(error) and str(error).startswith(f"{path}: ")
        else:
            for o in world.obstacles:
                if not isinstance(o, HalfSpace):
                    assert np.all(np.isfinite(surface_points(o)))


VALUES = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=4),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=4) | st.integers(), inner, max_size=3),
    max_leaves=6,
)


@given(st.sampled_from([n for n in FORMATS if n.endswith(("yml", "yaml"))]), st.data())
@settings(max_examples=150, deadline=None)
def test_any_value_in_any_place_is_a_world_or_one_sentence(name: str, data: st.DataObject) -> None:
    tree = yaml.safe_load((DATA / name).read_text())
    node: Any = tree
    while True:
        key = data.draw(st.sampled_from(list(node) if isinstance(node, dict) else list(range(len(node)))))
        inner = node[key]
        if not isinstance(inner, dict | list) or not inner or data.draw(st.booleans()):
            node[key] = data.draw(VALUES)
            break
        node = inner
    with tempfile.TemporaryDirectory() as folder:
        shutil.copytree(DATA / "meshes", Path(folder) / "meshes")
        path = Path(folder) / name
        path.write_text(yaml.safe_dump(tree, allow_unicode=True), encoding="utf-8")
        try:
            load_world(path)
        except InputError as error:
            assert "\n" not in str(error) and str(error).startswith(f"{path}: ")
