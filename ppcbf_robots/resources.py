"""Where things are: bundled robots and worlds, and the URDFs of example-robot-data."""

from __future__ import annotations

import importlib.metadata
from importlib.resources import files
from pathlib import Path

from ppcbf_robots.errors import InputError

YAML_SUFFIXES = (".yaml", ".yml")
WORLD_SUFFIXES = (".scene", ".urdf", ".xml")  # of worlds that are not YAML
ALIASES = {"baxter": "baxter_left", "tiago_no_hand": "tiago_arm"}
"""Robots of example-robot-data that have more than an arm, and the bundled spec of one arm that their name gives."""


def is_file(path: Path) -> bool:
    """Whether a path leads to a file: not to a folder, pipe or device, and not what no path can be."""
    try:
        return path.is_file()
    except (OSError, ValueError):  # too long, not permitted
        return False


def bundled(folder: str, suffix: str = ".yaml") -> dict[str, Path]:
    """Bundled files by name; ``folder`` is 'robots' or 'obstacles'."""
    root = Path(str(files(f"ppcbf_robots.{folder}")))
    return {p.stem: p for p in sorted(root.glob(f"*{suffix}"))}


def find_robot(name: str) -> Path:
    """Path of a robot: a file as given, a bundled spec, or a URDF of example-robot-data.

    Raises:
        InputError: if nothing by that name exists.
    """
    path = Path(name)
    if path.suffix in (".yaml", ".yml", ".urdf", ".xml"):
        if is_file(path):
            return path
        raise InputError(f"robot file not found: {path}")
    specs = bundled("robots")
    name = ALIASES.get(name, name)
    if name in specs:
        return specs[name]
    example = find_example(name)
    if example is not None:
        return example
    if is_file(path):
        raise InputError(f"{path}: a robot is a .urdf, .xml, .yaml or .yml file, or by xacro made into one")
    raise InputError(
        f"no robot named '{name}': give a URDF or YAML path, a bundled name ({', '.join(specs)}), "
        "or the name of a URDF in example-robot-data, such as ur5, z1 or xarm7"
    )


def find_example(name: str) -> Path | None:
    """The URDF of a robot in example-robot-data, by file name (``ur5`` finds ``ur5_robot.urdf``), or None."""
    example = _example_urdfs()
    return example.get(f"{name}_robot") or example.get(name)  # in this order: its ur3.urdf is empty


def find_world(name: str) -> Path:
    """Path of a world: a file as given, or a bundled name; InputError if neither."""
    path = Path(name)
    if path.suffix.lower() in (*YAML_SUFFIXES, *WORLD_SUFFIXES):
        if is_file(path):
            return path
        raise InputError(f"obstacle file not found: {path}")
    worlds = bundled("obstacles")
    if name in worlds:
        return worlds[name]
    raise InputError(
        f"no world named '{name}': give a YAML, .scene or URDF path or a bundled name ({', '.join(worlds)})"
    )


def portable(name: str) -> str:
    """A robot or world by a name that holds in any folder: paths become absolute."""
    return str(Path(name).resolve()) if is_file(Path(name)) else name


def _example_urdfs() -> dict[str, Path]:
    try:
        distribution = importlib.metadata.distribution("example-robot-data")
    except importlib.metadata.PackageNotFoundError:
        return {}
    found = [f for f in distribution.files or [] if str(f).endswith(".urdf")]
    return {f.stem: Path(str(distribution.locate_file(f))).resolve() for f in found}


def default_package_dirs(urdf: Path) -> list[Path]:
    """Folders against which ``package://`` is tried: around the file and example-robot-data's share."""
    around = list(urdf.resolve().parents)[:5]
    example = _example_urdfs()
    share = next((p for path in example.values() for p in path.parents if p.name == "share"), None)
    return around + ([share] if share else [])
