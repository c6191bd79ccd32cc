"""The viable set, as two studies ask for it."""

from __future__ import annotations

from collections.abc import Callable
from typing import Annotated, Any

import typer
from rich.progress import Progress

from ppcbf_robots.cli.extras import needs
from ppcbf_robots.cli.output import err
from ppcbf_robots.problem import Problem
from ppcbf_robots.viable_set import ViableSet

NodesOption = Annotated[int, typer.Option(min=7, max=101, help="Nodes per axis of the viable set's grid.")]
ViableOption = Annotated[bool, typer.Option(help="The viable set too, where the robot has 2 joints.")]


def viable_set(problem: Problem, nodes: int) -> ViableSet:
    """The viable set, with its progress on stderr."""
    with needs("study", "the viable set"):
        from ppcbf_robots import viability
    with Progress(console=err, transient=True) as progress:
        task = progress.add_task("viable set", total=None)
        return viability.solve(problem, nodes, on_sweeps=_shown(progress, task))


def _shown(progress: Progress, task: Any) -> Callable[[int, float], None]:
    def show(sweeps: int, change: float) -> None:
        progress.update(task, description=f"viable set: {sweeps} sweeps, V changes by {change:.1e} m")

    return show
