"""Mesh files and vertex lists, reduced to the vertices of their convex hulls."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import coal
import numpy as np

from ppcbf_robots.errors import InputError
from ppcbf_robots.meshes import mesh_problem
from ppcbf_robots.resources import default_package_dirs
from ppcbf_robots.specs import Array
from ppcbf_robots.world_shapes import convex

MAX_POINTS = 500_000  # of a mesh as given
MAX_HULL = 2_000  # vertices of a hull; distances to more would not keep up with a control loop


def mesh_hull(resource: str, scale: Sequence[float], world: Path, where: str) -> list[list[float]]:
    """Vertices of the convex hull of a mesh file, in the mesh's frame times ``scale`` (3,) [m].

    Args:
        resource: path relative to the world's folder, or a file:// or package:// address.
        scale: along the mesh's axes.
        world: the file that names the mesh.
        where: file and key, with which errors begin.

    Raises:
        InputError: if the mesh is missing, unreadable, flat, or has too many vertices.
    """
    path = _find(resource, world, where)
    if problem := mesh_problem(path):
        raise InputError(f"{where}: mesh '{resource}' {problem}")
    try:
        points = np.array(coal.MeshLoader().load(str(path), np.asarray(scale, float)).vertices(), dtype=float)
    except (OSError, ValueError, RuntimeError) as error:
        raise InputError(f"{where}: mesh '{resource}' cannot be read ({_reason(error)})") from None
    return hull(points, f"{where}: mesh '{resource}'")


def hull(points: Array, where: str) -> list[list[float]]:
    """Vertices of the convex hull of points (N, 3) [m] in a fixed order, so that equal hulls have equal fingerprints.

    Raises:
        InputError: for NaN, flat hulls and too many vertices.
    """
    if len(points) > MAX_POINTS:
        raise InputError(f"{where}: {len(points)} vertices; at most {MAX_POINTS} are read, simplify the mesh")
    shape, center = convex(points, where)
    kept = {tuple(p) for p in np.asarray(shape.points())}
    if len(kept) > MAX_HULL:
        raise InputError(
            f"{where}: its convex hull has {len(kept)} vertices; at most {MAX_HULL} are taken, simplify it"
        )
    return sorted([float(x) for x in p] for p in np.unique(points, axis=0) if tuple(p - center) in kept)


def _find(resource: str, world: Path, where: str) -> Path:
    scheme, separator, rest = resource.partition("://")
    if not separator:
        candidates = [world.parent / resource]
    elif scheme == "file":
        candidates = [Path(rest)]
    elif scheme == "package":
        candidates = [folder / rest for folder in default_package_dirs(world)]
    else:
        raise InputError(f"{where}: mesh '{resource}': only file:// and package:// addresses can be read")
    try:
        found = next((p for p in candidates if p.is_file()), None)
    except OSError as error:
        raise InputError(f"{where}: mesh '{resource[:80]}' cannot be read ({error.strerror})") from None
    if found is None:
        tried = candidates[0] if len(candidates) == 1 else f"{len(candidates)} folders around {world.parent}"
        raise InputError(f"{where}: mesh file not found: {resource} (tried {tried})")
    return found


def _reason(error: Exception) -> str:
    """The loader's own words, without its source lines and hints."""
    if isinstance(error, OSError):
        return str(error.strerror)
    lines = [line for line in str(error).partition("Could not load resource")[2].splitlines()[1:] if line]
    return lines[0] if lines else "not a mesh"
