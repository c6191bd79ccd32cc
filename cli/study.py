"""``ppcbf study``: the paper's comparisons of safe sets."""

from __future__ import annotations

import typer

from ppcbf_robots.cli.study_nmpc import nmpc
from ppcbf_robots.cli.study_safe_set import safe_set

study = typer.Typer(
    no_args_is_help=True, rich_markup_mode="rich", help="The paper's studies over many runs, for any robot and world."
)
for command in (safe_set, nmpc):
    study.command()(command)
