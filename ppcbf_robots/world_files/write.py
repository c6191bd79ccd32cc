"""Worlds as YAML that people can read and edit."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from ppcbf_robots.errors import InputError
from ppcbf_robots.world import ConvexMesh, Obstacle, WorldSpec

DIGITS = 9  # nanometres at a metre
VERTEX_DIGITS = 7  # what mesh files hold
_PLAIN = re.compile(r"[A-Za-z_][A-Za-z0-9_]*")
_WORDS = ("true", "false", "yes", "no", "on", "off", "null", "y", "n")  # that YAML readers may not take as text


def world_yaml(world: WorldSpec, title: str) -> str:
    """Text of a world file, one obstacle per line; meshes, which must have vertices, one vertex per line."""
    lines = [f"# {_text(title)[1:-1]}", "# Metres and radians, in the robot's base frame.", "obstacles:"]
    for obstacle in world.obstacles:
        lines += _mesh(obstacle) if isinstance(obstacle, ConvexMesh) else [f"  - {{{', '.join(_fields(obstacle))}}}"]
    return "\n".join(lines) + "\n"


def write_world(world: WorldSpec, path: Path, title: str, overwrite: bool = False) -> None:
    """Write a world as YAML.

    Raises:
        InputError: if the file exists and must not be overwritten, or cannot be written.
    """
    try:
        if path.exists() and not path.is_file():
            raise InputError(f"{path} is not a file; give the path of one")
        if path.exists() and not overwrite:
            raise InputError(f"{path} exists; give --force to overwrite it")
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(world_yaml(world, title), encoding="utf-8")
    except OSError as error:
        raise InputError(f"{path}: cannot be written ({error.strerror})") from None


def _fields(obstacle: Obstacle) -> list[str]:
    """``key: value`` of whatever is not at its default, name and type first."""
    kind = type(obstacle)
    measures = [k for k in kind.model_fields if k not in ("name", "type", "margin", "vertices")]
    keys = ["name", "type", *measures, "margin"]
    values = {key: getattr(obstacle, key) for key in keys}
    return [f"{k}: {_value(v)}" for k, v in values.items() if v != kind.model_fields[k].default]


def _mesh(mesh: ConvexMesh) -> list[str]:
    first, *rest = _fields(mesh)
    lines = [f"  - {first}", *(f"    {field}" for field in rest)]
    if mesh.vertices is None:
        return lines
    return [*lines, "    vertices:", *(f"      - {_value(v, VERTEX_DIGITS)}" for v in mesh.vertices)]


def _value(value: object, digits: int = DIGITS) -> str:
    if isinstance(value, list):
        return f"[{', '.join(_value(x, digits) for x in value)}]"
    return _number(value, digits) if isinstance(value, float) else _text(str(value), plain=True)


def _number(x: float, digits: int) -> str:
    """Never with an exponent, which some YAML readers take for text."""
    text = np.format_float_positional(x, precision=digits, fractional=False, trim="0")
    return "0.0" if float(text) == 0.0 else text


def _text(text: str, plain: bool = False) -> str:
    """In quotes, unless it may and can do without."""
    if plain and _PLAIN.fullmatch(text) and text.lower() not in _WORDS:
        return text
    special = {'"': '\\"', "\\": "\\\\"}
    return '"' + "".join(special.get(c, c if c.isprintable() else f"\\U{ord(c):08x}") for c in text) + '"'
