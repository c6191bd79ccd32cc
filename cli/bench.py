"""``ppcbf bench``: times on this machine, of the filter unless something else is named."""

from __future__ import annotations

from typing import Any

import typer
from typer.core import TyperGroup

from ppcbf_robots.cli.bench_filter import bench as bench_filter
from ppcbf_robots.cli.bench_train import train as bench_train


class FilterByDefault(TyperGroup):
    """``ppcbf bench panda`` is ``ppcbf bench filter panda``."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Put ``filter`` first where no subcommand is named."""
        if not args or (args[0] not in self.commands and args[0] != "--help"):
            args = ["filter", *args]
        return list(super().parse_args(ctx, args))


bench = typer.Typer(cls=FilterByDefault, rich_markup_mode="rich", help="Time the filter (by default) or the learner.")
bench.command("filter")(bench_filter)
bench.command("train")(bench_train)
