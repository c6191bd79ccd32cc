"""MoveIt's ``.scene`` text files, old (shapes in the planning frame) and new (object pose, shapes in it, subframes)."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pinocchio as pin

from ppcbf_robots.errors import InputError
from ppcbf_robots.world_files.meshes import MAX_POINTS
from ppcbf_robots.world_files.scene_parts import Scene, part_names, pose_of, positive
from ppcbf_robots.world_shapes import FARTHEST

SHAPES = {"sphere": 1, "box": 3, "cylinder": 2, "cone": 2, "plane": 4, "mesh": 2}  # numbers after the name
MAX_COUNT = 10_000  # shapes or subframes of an object


class _Words:
    """The words of a text one after another, each with the number of its line."""

    def __init__(self, path: Path, lines: list[str]) -> None:
        self.path, self.lines = path, lines
        self.line, self.rest = 0, ""  # the line last read from, counted from 1, and what is left of it

    def where(self) -> str:
        """The current line, for messages."""
        return f"line {self.line}"

    def word(self, what: str) -> str:
        """Next word, or an error that says what should have been there."""
        while not self.rest.strip():
            if self.line >= len(self.lines):
                raise InputError(f"{self.path}: the file ends where {what} is expected")
            self.rest = self.lines[self.line]
            self.line += 1
        word, _, self.rest = self.rest.strip().partition(" ")
        return word

    def remainder(self) -> str:
        """What is left of the current line."""
        text, self.rest = self.rest.strip(), ""
        return text

    def number(self, what: str) -> float:
        """Next word as a finite number that can be a length."""
        word = self.word(what)
        try:
            value = float(word) if "_" not in word else np.nan
        except ValueError:
            value = np.nan
        if not abs(value) <= FARTHEST:
            raise InputError(f"{self.path}: {self.where()}: expected {what}, got '{word[:40]}'")
        return value

    def numbers(self, count: int, what: str) -> list[float]:
        """That many numbers."""
        return [self.number(what) for _ in range(count)]

    def count(self, what: str, most: int) -> int:
        """Next word as a count."""
        word = self.word(what)
        if not (word.isascii() and word.isdigit() and len(word) < 9 and int(word) <= most):
            raise InputError(f"{self.path}: {self.where()}: expected {what}, at most {most}, got '{word[:40]}'")
        return int(word)


def read_moveit_scene(scene: Scene, text: str) -> None:
    """Add the objects of a ``.scene`` file to a scene.

    Raises:
        InputError: naming the line and what was expected there, also for a file that is cut off.
    """
    lines = [line.replace("\t", " ") for line in text.splitlines()]
    words = _Words(scene.path, lines)
    words.line = 1  # the first line is the scene's name
    new_format = _is_new_format(lines)
    while (marker := words.word("'*' or '.'")) != ".":
        if marker != "*":
            raise InputError(f"{scene.at(words.where())}: expected '* NAME' or '.', got '{marker[:40]}'")
        _read_object(scene, words, words.remainder(), new_format)


def _is_new_format(lines: list[str]) -> bool:
    """MoveIt's own rule: the line after the first object's name is a position, not a count."""
    first = next((i for i, line in enumerate(lines[1:], 1) if line.startswith("*")), len(lines))
    return first + 1 < len(lines) and " " in lines[first + 1].strip()


def _read_object(scene: Scene, words: _Words, name: str, new_format: bool) -> None:
    if not name:
        raise InputError(f"{scene.at(words.where())}: the object has no name")
    origin = _pose(scene, words, "an object's pose") if new_format else pin.SE3.Identity()
    names = part_names(name, words.count("a number of shapes", MAX_COUNT))
    for part in names:
        _read_shape(scene, words, part, origin)
    if not names:
        scene.notes.append(f"'{name}' has no shapes and is left out")
    if new_format:
        for _ in range(words.count("a number of subframes", MAX_COUNT)):
            words.word("the name of a subframe")
            _pose(scene, words, "a subframe's pose")


def _read_shape(scene: Scene, words: _Words, name: str, origin: pin.SE3) -> None:
    kind = words.word("a shape")
    where = f"{words.where()} ({kind[:20]} of '{name}')"
    if kind not in SHAPES:
        raise InputError(f"{scene.at(where)}: the shape is not one of {', '.join(SHAPES)}")
    if kind == "mesh":
        corners, triangles = words.count("a number of vertices", MAX_POINTS), words.count("triangles", 2 * MAX_POINTS)
        points = np.array(words.numbers(3 * corners, "a vertex")).reshape(-1, 3)
        words.numbers(3 * triangles, "a triangle")
    else:
        size = words.numbers(SHAPES[kind], f"a dimension of the {kind}")
    pose = origin * _pose(scene, words, "a shape's pose")
    words.numbers(4, "a colour")
    if kind == "mesh":
        scene.add_points(where, name, pose, points)
    elif kind == "plane":
        scene.add_plane(where, name, pose, size)
    else:
        _add_primitive(scene, where, kind, name, pose, [positive(x, scene.at(where)) for x in size])


def _add_primitive(scene: Scene, where: str, kind: str, name: str, pose: pin.SE3, size: list[float]) -> None:
    match kind:
        case "box":
            scene.add(where, "box", name, pose, size=size)
        case "sphere":
            scene.add(where, "sphere", name, pose, radius=size[0])
        case "cylinder":  # radius first, unlike in messages
            scene.add(where, "cylinder", name, pose, radius=size[0], length=size[1])
        case _:
            scene.add_cone(where, name, pose, radius=size[0], length=size[1])


def _pose(scene: Scene, words: _Words, what: str) -> pin.SE3:
    xyz = words.numbers(3, what)
    xyzw = words.numbers(4, what)
    return pose_of(xyz, xyzw, scene.at(words.where()))
