"""``ppcbf convert``: a world from another program's file as our YAML."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from ppcbf_robots.cli.output import JsonOption, emit_json, err, obstacle_rows, out, table
from ppcbf_robots.errors import InputError
from ppcbf_robots.resources import YAML_SUFFIXES, find_world
from ppcbf_robots.world_files.load import read_world
from ppcbf_robots.world_files.write import write_world


def convert(
    world: Annotated[
        str,
        typer.Argument(metavar="IN", help="cuRobo YAML, MoveIt .scene or YAML, URDF, our YAML, or a bundled name."),
    ],
    out_file: Annotated[Path, typer.Argument(metavar="OUT.yaml", help="File to write.")],
    force: Annotated[bool, typer.Option("--force", help="Overwrite OUT.yaml.")] = False,
    json: JsonOption = False,
) -> None:
    """Write a world as our YAML, to read and edit; meshes become the vertices of their convex hulls.

    Example: ppcbf convert kitchen.scene kitchen.yaml
    """
    if out_file.suffix.lower() not in YAML_SUFFIXES:
        raise InputError(f"{out_file}: a world is written as YAML; give a name that ends in .yaml")
    path = find_world(world)
    read = read_world(path)
    write_world(read.world, out_file, f"Converted from {path.name} ({read.format}).", force)
    if json:
        types = [o.type for o in read.world.obstacles]
        counts = {kind: types.count(kind) for kind in sorted(set(types))}
        emit_json({"format": read.format, "obstacles": counts, "notes": read.notes, "out": str(out_file)})
        return
    for note in read.notes:
        err.print(f"note: {note}", soft_wrap=True)
    table(f"{path}: {read.format}", ["obstacle", "type", ""], obstacle_rows(read.world))
    out.print(f"wrote {out_file} ({len(read.world.obstacles)} obstacles)")
