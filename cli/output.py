"""Printing for people and for programs, and the exit codes."""

from __future__ import annotations

import json
import logging
import math
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console
from rich.table import Table

from ppcbf_robots.errors import InputError
from ppcbf_robots.world import WorldSpec

_PIPE_WIDTH = 120  # of tables that do not go to a terminal
_width = None if sys.stdout.isatty() else _PIPE_WIDTH
out = Console(highlight=False, markup=False, soft_wrap=True, width=_width)  # no markup: units and paths have brackets
err = Console(stderr=True, highlight=False, markup=False)

RobotArgument = Annotated[
    str, typer.Argument(metavar="ROBOT", help="Bundled name, robot spec (YAML), URDF path, or example-robot-data name.")
]
WorldArgument = Annotated[
    str,
    typer.Argument(metavar="OBSTACLES", help="Bundled world name, or path: YAML (ours, cuRobo, MoveIt), .scene, URDF."),
]
JsonOption = Annotated[bool, typer.Option("--json", help="Print one JSON object on stdout instead of text.")]


@contextmanager
def alarms_expected() -> Iterator[None]:
    """The filter's alarms are not logged, where they are counted or shown in another way."""
    logger = logging.getLogger("ppcbf_robots")
    level = logger.level
    logger.setLevel(logging.ERROR)
    try:
        yield
    finally:
        logger.setLevel(level)


def warn(warnings: Sequence[str]) -> None:
    """A line each, on standard error."""
    for warning in warnings:
        err.print(f"warning: {warning}", style="yellow", soft_wrap=True)


def emit_json(data: dict[str, Any]) -> None:
    """One JSON object on stdout; NaN and infinity become null, as JSON has neither."""
    typer.echo(json.dumps(_plain(data), indent=2))


def _plain(x: Any) -> Any:
    if isinstance(x, dict):
        return {str(k): _plain(y) for k, y in x.items()}
    if isinstance(x, list | tuple):
        return [_plain(y) for y in x]
    if isinstance(x, float) and not math.isfinite(x):
        return None
    return x.item() if hasattr(x, "item") else x


def table(title: str, columns: list[str], rows: list[list[str]]) -> None:
    """A table on stdout; words in its head are not broken, at the price of the space about the cells."""
    heads = [max(map(len, name.split()), default=0) for name in columns]
    tight = sum(heads) + 3 * len(heads) + 1 > out.width
    t = Table(title=title, title_justify="left", title_style="bold", padding=(0, 0) if tight else (0, 1))
    for i, name in enumerate(columns):
        t.add_column(name, justify="left" if i == 0 else "right", overflow="fold", no_wrap=i == 0, min_width=heads[i])
    for row in rows:
        t.add_row(*row)
    out.print(t)


def check_folder(path: Path) -> None:
    """InputError if results cannot go there, since it is a file."""
    if path.exists() and not path.is_dir():
        raise InputError(f"--out: {path} is a file; give a folder")


def obstacle_rows(world: WorldSpec) -> list[list[str]]:
    """Name, type and measures of every obstacle, for a table."""
    rows = []
    for o in world.obstacles:
        facts = o.model_dump(exclude={"name", "type"}, exclude_defaults=True)
        if "vertices" in facts:
            facts["vertices"] = len(facts["vertices"])
        rows.append([o.name, o.type, ", ".join(f"{k} {_short(v)}" for k, v in facts.items())])
    return rows


def _short(value: Any) -> str:
    return f"[{', '.join(map(_short, value))}]" if isinstance(value, list) else f"{value:.4g}"


def number(x: float | None, digits: int = 4) -> str:
    """A number for a table, or a dash."""
    return "-" if x is None else f"{x:.{digits}g}"


def yes(x: bool) -> str:
    """A truth value for a table."""
    return "yes" if x else "no"
